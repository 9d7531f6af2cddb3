/* Sparse factorisation with the planned pivots, or, where those will not do, with those of pivoting.c. */
#include <math.h>

#include "linear.h"

static int planned_factor(const Pattern *p, const double *a, Factors *f) {
    const int n = p->n;
    double *restrict x = f->work, *restrict bound = f->work + n, *restrict lu = f->value;
    for (int i = 0; i < n; i++) bound[i] = 0.0;
    for (int k = 0; k < p->nonzeros; k++) {
        const double size = p->growth * fabs(a[k]);
        double *b = &bound[p->place[p->row[k]]];
        if (size > *b) *b = size;
    }
    int grown = 0;
    for (int k = 0; k < n; k++) {
        const int column = p->column[k], diagonal = p->lu_diagonal[k], end = p->lu_start[k + 1];
        for (int q = p->start[column]; q < p->start[column + 1]; q++) x[p->place[p->row[q]]] = a[q];
        for (int q = p->lu_start[k]; q < diagonal; q++) {
            const int j = p->lu_row[q];
            const double u = lu[q] = x[j];
            x[j] = 0.0;
            grown |= !(fabs(u) <= bound[j]);
            for (int r = p->lu_diagonal[j] + 1; r < p->lu_start[j + 1]; r++) x[p->lu_row[r]] -= lu[r] * u;
        }
        const double pivot = x[k];
        const int usable = fabs(pivot) <= bound[k] && fabs(pivot) > 0.0;
        const double inverse = usable ? 1.0 / pivot : 0.0;
        x[k] = 0.0;
        grown |= !usable;
        lu[diagonal] = inverse;
        for (int r = diagonal + 1; r < end; r++) {
            const int i = p->lu_row[r];
            grown |= !(fabs(x[i]) <= bound[i]);
            lu[r] = x[i] * inverse;
            x[i] = 0.0;
        }
    }
    return grown;
}

int sparse_factor(const Pattern *p, const double *a, Factors *f) {
    f->use_other = p->factor ? p->factor(a, f->value) : planned_factor(p, a, f);
    return f->use_other && pivoted_factor(p->n, p->start, p->row, p->column, a, &f->other);
}

void sparse_solve(const Pattern *p, const Factors *f, double *b) {
    const int n = p->n;
    double *restrict y = f->work + n;
    const double *restrict lu = f->value;
    if (f->use_other) {
        pivoted_solve(n, p->column, f->other, y, b);
        return;
    }
    if (p->solve) {
        p->solve(lu, b);
        return;
    }
    for (int i = 0; i < n; i++) y[p->place[i]] = b[i];
    for (int k = 0; k < n; k++) {
        const double v = y[k];
        for (int r = p->lu_diagonal[k] + 1; r < p->lu_start[k + 1]; r++) y[p->lu_row[r]] -= lu[r] * v;
    }
    for (int k = n - 1; k >= 0; k--) {
        const int diagonal = p->lu_diagonal[k];
        const double v = y[k] * lu[diagonal];
        for (int q = p->lu_start[k]; q < diagonal; q++) y[p->lu_row[q]] -= lu[q] * v;
        b[p->column[k]] = v;
    }
}
