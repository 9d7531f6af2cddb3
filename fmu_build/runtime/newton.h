/* Newton's method for what holds at one time: algebraic loops, initial equations. */
#ifndef FMUID_NEWTON_H
#define FMUID_NEWTON_H

#include <math.h>
#include <string.h>

#include "instance.h"

/* Where equations are solved. */
typedef struct {
    double t;
    const double *x, *u;
} Place;

/* Equations for n unknowns v. `evaluate` gives their residuals and, where `with_matrix`, keeps derivatives by v, which
 * `factorise` takes; both return 0 on success. */
typedef struct {
    int n;
    double (*nominal)(int i);
    int (*evaluate)(Instance *me, const Place *at, const double *v, double *r, int with_matrix);
    int (*factorise)(Instance *me);
    void (*solve)(Instance *me, double *b);
} Unknowns;

#ifdef __GNUC__
#define INLINED static inline __attribute__((always_inline)) /* with constant functions: none is called by a pointer */
#else
#define INLINED static inline
#endif

static inline int all_finite(const double *values, int n) {
    for (int i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

/* Size of a correction of v, relative to v or its nominal values. */
INLINED double relative_size(const Unknowns *q, const double *correction, const double *v) {
    double size = 0.0;
    for (int i = 0; i < q->n; i++) size = fmax(size, fabs(correction[i]) / fmax(q->nominal(i), fabs(v[i])));
    return size;
}

/* Newton's method from v, damped until the next correction (with the same Jacobian) is smaller: the natural
 * monotonicity test, which no scaling of the equations changes [Deuflhard, Newton Methods for Nonlinear Problems,
 * 2004]. `work` has room for 3 n numbers. 0 on success. */
INLINED int damped_newton(Instance *me, const Unknowns *q, const Place *at, double *v, double *work) {
    static const double CONVERGED = 1e-9;  /* the error after this correction is about its square */
    static const double ROUNDING = 1e-6;   /* corrections that are smaller and no longer shrink are rounding */
    static const double SHORTEST = 1e-12;  /* part of a correction */
    static const int STALLED = 3;          /* corrections of which no part helps, as at a kink, before it is given up */
    const int n = q->n;
    double *r = work, *old = work + n, *next = work + 2 * n, part;
    for (int iteration = 0, stalled = 0; iteration < 100 && stalled < STALLED; iteration++) {
        if (q->evaluate(me, at, v, r, 1) || !all_finite(r, n)) return 1;
        int solved = 1;
        for (int i = 0; i < n; i++) solved &= r[i] == 0.0;
        if (solved) return 0;
        if (q->factorise(me)) { /* half the way back from where they are singular */
            if (iteration == 0) return 1;
            for (int i = 0; i < n; i++) v[i] = 0.5 * (v[i] + old[i]);
            continue;
        }
        q->solve(me, r);
        const double size = relative_size(q, r, v);
        memcpy(old, v, (size_t)n * sizeof *v);
        for (int i = 0; i < n; i++) v[i] -= r[i];
        if (size <= CONVERGED) return !all_finite(v, n);
        for (part = 1.0; part > SHORTEST; part *= 0.5) {
            for (int i = 0; i < n; i++) v[i] = old[i] - part * r[i];
            if (q->evaluate(me, at, v, next, 0)) return 1;
            if (!all_finite(next, n)) continue;
            q->solve(me, next);
            const double left = relative_size(q, next, old);
            if (left < (1.0 - 0.5 * part) * size) break;
            if (size < ROUNDING) return 0;
        }
        stalled += part <= SHORTEST;
    }
    return 1;
}

#endif
