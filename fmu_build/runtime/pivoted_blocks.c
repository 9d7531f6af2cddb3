/* The factorisation of the collocation equations where the planned pivots will not do. */
#include <stdlib.h>

#include "collocation.h"

/* As `planned_blocks` in sensitivity.c, with pivots chosen by size and blocks written out. */
int pivoted_blocks(struct Sensitivity *q, double h, double *const *jacobian) {
    const Pattern *p = &model.J;
    int *index = malloc((LENGTH(RADAU * model.J.nonzeros + 2 * RADAU * NX) + 6 * N + 1) * sizeof *index);
    double *value = malloc(LENGTH(RADAU * model.J.nonzeros + 2 * RADAU * NX) * sizeof *value);
    int failed = !index || !value, used = 0;
    int *start = index, *column = start + RADAU * N + 1, *row = column + RADAU * N;
    for (int c = 0; !failed && c < RADAU * N; c++) {
        const int j = c / RADAU, i = c % RADAU;
        start[c] = used;
        column[c] = p->column[j] * RADAU + i;
        for (int k = p->start[j]; k < p->start[j + 1]; k++)
            for (int other = 0; other < RADAU; other++) {
                const int state = p->row[k] == j && j < NX;
                if (other != i && !state) continue;
                row[used] = p->row[k] * RADAU + other;
                value[used++] = (other == i ? -row_factor(p->row[k], h) * jacobian[i][k] : 0.0) + (state ? W[other][i] : 0.0);
            }
        start[c + 1] = used;
    }
    failed = failed || pivoted_factor(RADAU * N, start, row, column, value, &q->other);
    free(index);
    free(value);
    return failed;
}

int solve_pivoted(struct Sensitivity *q, const double *y, double *to) {
    double *b = malloc((2 * RADAU * N + 1) * sizeof *b);
    if (!b) return 1;
    for (size_t p = 0; p < q->n; p++) {
        for (int i = 0; i < RADAU * N; i++)
            b[i] = y[((size_t)model.J.place[i / RADAU] * RADAU + i % RADAU) * q->n + p];
        int *column = (int *)(void *)(b + RADAU * N);
        for (int i = 0; i < RADAU * N; i++) column[i] = model.J.column[i / RADAU] * RADAU + i % RADAU;
        pivoted_solve(RADAU * N, column, q->other, q->work, b);
        for (int i = 0; i < RADAU * N; i++) to[i * q->n + p] = b[i];
    }
    free(b);
    return 0;
}
