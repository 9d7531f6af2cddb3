/* Dense LU factorisation with partial pivoting; column-major, for the small matrices of one model. */
#ifndef FMUID_LU_H
#define FMUID_LU_H

#include <math.h>
#include <stddef.h>

/* Factorises the n x n matrix `a` in place; 0 on success, 1 if singular or not finite. */
static inline int lu_factor(int n, double *a, int *pivot) {
    for (int c = 0; c < n; c++) {
        double *column = a + c * n;
        int best = c;
        for (int i = c + 1; i < n; i++)
            if (fabs(column[i]) > fabs(column[best])) best = i;
        pivot[c] = best;
        if (!(fabs(column[best]) > 0.0 && isfinite(column[best]))) return 1;
        if (best != c)
            for (int j = 0; j < n; j++) {
                const double swap = a[j * n + c];
                a[j * n + c] = a[j * n + best];
                a[j * n + best] = swap;
            }
        const double inverse = 1.0 / column[c];
        column[c] = inverse; /* the diagonal keeps its reciprocal: no division when solving */
        for (int i = c + 1; i < n; i++) column[i] *= inverse;
        for (int j = c + 1; j < n; j++) {
            double *other = a + j * n;
            const double factor = other[c];
            if (factor != 0.0) /* a drive train couples neighbours only: many zeros */
                for (int i = c + 1; i < n; i++) other[i] -= column[i] * factor;
        }
    }
    return 0;
}

/* Solves with the factors of `lu_factor`; `b` becomes the solution. */
static inline void lu_solve(int n, const double *a, const int *pivot, double *b) {
    for (int c = 0; c < n; c++) {
        const double swap = b[pivot[c]];
        b[pivot[c]] = b[c];
        b[c] = swap;
    }
    for (int c = 0; c < n; c++)
        for (int i = c + 1; i < n; i++) b[i] -= a[c * n + i] * b[c];
    for (int c = n - 1; c >= 0; c--) {
        b[c] *= a[c * n + c];
        for (int i = 0; i < c; i++) b[i] -= a[c * n + i] * b[c];
    }
}

/* Lists what is not zero in the factors, for many solutions: `row` and `value` (n x n) column by column, of L from the
 * first column to the last and then of U from the last to the first; column k of the 2 n begins at start[k]. */
static inline void lu_pack(int n, const double *a, int *start, int *row, double *value) {
    int k = 0;
    for (int column = 0; column < 2 * n; column++) {
        const int lower = column < n, c = lower ? column : 2 * n - 1 - column;
        start[column] = k;
        for (int i = lower ? c + 1 : 0; i < (lower ? n : c); i++) {
            row[k] = i;
            value[k] = a[c * n + i];
            k += value[k] != 0.0;
        }
    }
    start[2 * n] = k;
}

/* As `lu_solve`, to the same bits, with the lists of `lu_pack`. */
static inline void lu_solve_packed(int n, const double *a, const int *pivot, const int *start, const int *row,
                                   const double *value, double *b) {
    for (int c = 0; c < n; c++) {
        const double swap = b[pivot[c]];
        b[pivot[c]] = b[c];
        b[c] = swap;
    }
    for (int column = 0; column < 2 * n; column++) {
        const int c = column < n ? column : 2 * n - 1 - column;
        if (column >= n) b[c] *= a[c * n + c];
        const double x = b[c];
        for (int k = start[column]; k < start[column + 1]; k++) b[row[k]] -= value[k] * x;
    }
}

/* Where vectors lie side by side in rows of m: does(m), and for few of them with a constant, so that loops over them
 * are unrolled. */
#define UNROLLED(m, does)                                                                                          \
    do {                                                                                                           \
        if ((m) == 1) does(1);                                                                                     \
        else if ((m) == 2) does(2);                                                                                \
        else if ((m) == 3) does(3);                                                                                \
        else if ((m) == 4) does(4);                                                                                \
        else does(m);                                                                                              \
    } while (0)

/* As `lu_solve` for m right-hand sides at once, `b` with n rows of m; what is zero in the factors costs nothing. */
static inline void lu_solve_rows(int n, const double *a, const int *pivot, size_t m, double *b) {
    for (int c = 0; c < n; c++) {
        double *row = b + c * m, *other = b + pivot[c] * m;
        for (size_t k = 0; k < m && other != row; k++) {
            const double swap = row[k];
            row[k] = other[k];
            other[k] = swap;
        }
    }
    for (int c = 0; c < n; c++)
        for (int i = c + 1; i < n; i++) {
            const double factor = a[c * n + i];
            if (factor == 0.0) continue;
            for (size_t k = 0; k < m; k++) b[i * m + k] -= factor * b[c * m + k];
        }
    for (int c = n - 1; c >= 0; c--) {
        for (size_t k = 0; k < m; k++) b[c * m + k] *= a[c * n + c];
        for (int i = 0; i < c; i++) {
            const double factor = a[c * n + i];
            if (factor == 0.0) continue;
            for (size_t k = 0; k < m; k++) b[i * m + k] -= factor * b[c * m + k];
        }
    }
}

static inline void lu_solve_many(int n, const double *a, const int *pivot, size_t m, double *b) {
#define SOLVE(k) lu_solve_rows(n, a, pivot, k, b)
    UNROLLED(m, SOLVE);
#undef SOLVE
}

#endif
