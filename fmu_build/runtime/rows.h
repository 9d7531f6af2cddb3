/* Derivatives along several directions side by side: rows of them, and the collocation equations' solution. */
#ifndef FMUID_ROWS_H
#define FMUID_ROWS_H

#include "collocation.h"

/* to += a * row for n directions */
static inline void add_row(size_t n, double a, const double *restrict row, double *restrict to) {
    for (size_t p = 0; p < n; p++) to[p] += a * row[p];
}

/* rows -= block * other, each RADAU rows of m, n apart */
static inline void subtract_rows(size_t m, size_t n, const double *block, const double *restrict other,
                                 double *restrict rows) {
    for (int i = 0; i < RADAU; i++)
        for (size_t p = 0; p < m; p++)
            rows[i * n + p] -= block[i * RADAU] * other[p] + block[i * RADAU + 1] * other[n + p] +
                               block[i * RADAU + 2] * other[2 * n + p];
}

/* Solves for m directions: `y` has the rows in steps, `to` receives those of the unknowns, all n apart. */
static inline void solve_rows(const struct Sensitivity *q, size_t m, size_t n, double *y, double *to) {
    const Pattern *p = &PATTERN_BLOCKS;
    const double *lu = q->factors;
    const size_t all = RADAU * n;
    for (int k = 0; k < N; k++)
        for (int r = MODEL_J_LU_DIAGONAL[k] + 1; r < MODEL_J_LU_START[k + 1]; r++)
            subtract_rows(m, n, lu + r * BLOCK, y + k * all, y + MODEL_J_LU_ROW[r] * all);
    for (int k = N - 1; k >= 0; k--) {
        const int diagonal = MODEL_J_LU_DIAGONAL[k];
        double *solved = to + p->column[k] * all, negative[BLOCK];
        for (int i = 0; i < BLOCK; i++) negative[i] = -lu[diagonal * BLOCK + i];
        for (int i = 0; i < RADAU; i++)
            for (size_t j = 0; j < m; j++) solved[i * n + j] = 0.0;
        subtract_rows(m, n, negative, y + k * all, solved);
        for (int s = MODEL_J_LU_START[k]; s < diagonal; s++) {
            const double *block = lu + s * BLOCK;
            double *rows = y + MODEL_J_LU_ROW[s] * all;
            if (MODEL_J_LU_UPDATED[s]) subtract_rows(m, n, block, solved, rows);
            else
                for (int i = 0; i < RADAU; i++) add_row(m, -block[i * (RADAU + 1)], solved + i * n, rows + i * n);
        }
    }
}

/* slices.c: the same for SLICE directions. */
void solve_slice(const struct Sensitivity *q, size_t n, double *y, double *to);

#endif
