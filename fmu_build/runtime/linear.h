/* Linear systems of one model: matrices of which it is known before the simulation where they are not zero.
 *
 * Pattern is the plan of fmu_build/elimination.py: the order of elimination and where the factors are not zero. A small
 * or full matrix is factorised densely (lu.h). Otherwise the planned pivots are taken without a search, and watched: if
 * an entry grows out of proportion to its row, the matrix is factorised anew with pivots chosen by size. What comes
 * out depends on the matrix alone, not on those before. */
#ifndef FMUID_LINEAR_H
#define FMUID_LINEAR_H

#include "lu.h"

typedef struct {
    int n, dense;
    int nonzeros, factors, filled; /* how many entries the matrix has, the factors, and where they may be nonzero */
    const int *start, *row;    /* the matrix column by column */
    const int *diagonal;       /* which of its entries are there */
    const int *column, *place; /* column eliminated in each step; for each row the step in which it is the pivot row */
    const int *lu_start, *lu_diagonal, *lu_row; /* the factors column by column, in steps */
    const int *lu_updated; /* whether an elimination changes the entry */
    double growth; /* by how much an entry may outgrow the largest of its row */
    int (*factor)(const double *, double *); /* the same without tables, for a small matrix; else NULL */
    void (*solve)(const double *, double *);
} Pattern;

/* L and U of a factorisation that chose its pivots: columns in steps, rows of L as in the matrix. */
typedef struct {
    int *start[2], *row[2], *pivot; /* of L and U; row of the matrix that is the pivot row of a step */
    double *value[2], *diagonal;    /* reciprocal pivots */
    int room[2];
} Pivoted;

typedef struct {
    double *value;  /* `factors` entries, or n * n */
    int *pivot;     /* n, if dense */
    double *work;   /* 2 n, zeros between calls in the first half */
    Pivoted *other; /* pivots chosen by size: NULL as long as the planned ones did in every factorisation ... */
    int use_other;  /* ... and whether the last one needs them */
    long count;     /* factorisations so far */
} Factors;

int sparse_factor(const Pattern *p, const double *a, Factors *f);
void sparse_solve(const Pattern *p, const Factors *f, double *b);
int pivoted_factor(int n, const int *start, const int *row, const int *column, const double *a, Pivoted **to);
void pivoted_solve(int n, const int *column, const Pivoted *f, double *work, double *b);
void free_pivoted(Pivoted **f);

/* Factorises the matrix with entries `a`; 0 on success, 1 if singular or not finite. */
static inline int factorise(int n, int dense, const Pattern *p, const double *a, Factors *f) {
    f->count++;
    if (!dense) return sparse_factor(p, a, f);
    for (int k = 0; k < n * n; k++) f->value[k] = 0.0;
    for (int j = 0; j < n; j++)
        for (int k = p->start[j]; k < p->start[j + 1]; k++) f->value[j * n + p->row[k]] = a[k];
    return lu_factor(n, f->value, f->pivot);
}

/* b becomes the solution. */
static inline void solve(int n, int dense, const Pattern *p, const Factors *f, double *b) {
    if (dense) lu_solve(n, f->value, f->pivot, b);
    else sparse_solve(p, f, b);
}

#endif
