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

#endif
