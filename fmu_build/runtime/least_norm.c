/* The linear equations of the start, which may be singular in a mode: where friction holds a shaft, its acceleration is
 * zero whatever the current. Their solution is then the one nearest to the start values. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* Independent rows (scaled, in units of the nominal values) as a lower triangle times orthonormal rows. */
struct LeastNorm {
    int rank, *order;
    double *q, *l, *scale;
};

double initial_nominal(int i) {
    return i >= NX ? model.y_nominal[i - NX] : model.x_scale[i] > 0.0 ? model.x_scale[i] : 1.0;
}

static double dot(int n, const double *a, const double *b) {
    double sum = 0.0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

static void free_least_norm(LeastNorm *f) {
    if (!f) return;
    free(f->order);
    free(f->q);
    free(f);
}

/* Gram and Schmidt's method, of the rows left the longest first; 1: no memory, or not finite. */
static int least_norm_factor(const Pattern *p, const double *a, LeastNorm **to) {
    static const double DEPENDENT = 1e-10; /* what is left of a row, of size one, that ten digits of others make up */
    const int n = p->n;
    const size_t size = (size_t)n;
    if (!*to && !(*to = calloc(1, sizeof **to))) return 1;
    LeastNorm *f = *to;
    if (!f->order) f->order = malloc((size + 1) * sizeof *f->order);
    if (!f->q) f->q = malloc((2 * size * size + size + 1) * sizeof *f->q);
    if (!f->order || !f->q) return 1;
    f->l = f->q + size * size;
    f->scale = f->l + size * size;
    memset(f->q, 0, (2 * size * size + size) * sizeof *f->q);
    for (int j = 0; j < n; j++)
        for (int k = p->start[j]; k < p->start[j + 1]; k++) {
            const double entry = f->q[(size_t)p->row[k] * size + (size_t)j] = a[k] * initial_nominal(j);
            if (!isfinite(entry)) return 1;
            f->scale[p->row[k]] = fmax(f->scale[p->row[k]], fabs(entry));
        }
    for (int i = 0; i < n; i++) {
        f->order[i] = i;
        for (int j = 0; j < n && f->scale[i] > 0.0; j++) f->q[(size_t)i * size + (size_t)j] /= f->scale[i];
    }
    for (f->rank = 0; f->rank < n; f->rank++) {
        const int k = f->rank;
        double longest = DEPENDENT;
        int best = -1;
        for (int i = k; i < n; i++) {
            const double *row = f->q + (size_t)f->order[i] * size, length = sqrt(dot(n, row, row));
            if (length > longest) longest = length, best = i;
        }
        if (best < 0) break;
        const int chosen = f->order[best];
        double *own = f->q + (size_t)chosen * size;
        f->order[best] = f->order[k];
        f->order[k] = chosen;
        f->l[(size_t)chosen * size + (size_t)k] = longest;
        for (int j = 0; j < n; j++) own[j] /= longest;
        for (int i = k + 1; i < n; i++) {
            double *row = f->q + (size_t)f->order[i] * size;
            const double along = f->l[(size_t)f->order[i] * size + (size_t)k] = dot(n, row, own);
            for (int j = 0; j < n; j++) row[j] -= along * own[j];
        }
    }
    return 0;
}

static void least_norm_solve(const Pattern *p, const LeastNorm *f, double *b) {
    const int n = p->n;
    double y[LENGTH(n)];
    for (int k = 0; k < f->rank; k++) {
        const double *l = f->l + (size_t)f->order[k] * (size_t)n;
        y[k] = (b[f->order[k]] / f->scale[f->order[k]] - dot(k, l, y)) / l[k];
    }
    memset(b, 0, (size_t)n * sizeof *b);
    for (int k = 0; k < f->rank; k++)
        for (int j = 0; j < n; j++) b[j] += y[k] * f->q[(size_t)f->order[k] * (size_t)n + (size_t)j];
    for (int j = 0; j < n; j++) b[j] *= initial_nominal(j);
}

/* Factorises me->initial. It is singular if a solution that is known does not come out of it to three digits. */
int factorise_initial(Instance *me) {
    const Pattern *p = &model.I;
    const int n = p->n;
    ZEROS(b, n);
    int singular = FACTORISE(I, me->initial, &me->lu_start);
    for (int j = 0; j < n; j++)
        for (int k = p->start[j]; k < p->start[j + 1]; k++) b[p->row[k]] += me->initial[k] * initial_nominal(j);
    if (!singular) SOLVE(I, &me->lu_start, b);
    for (int j = 0; j < n; j++) singular |= !(fabs(b[j] / initial_nominal(j) - 1.0) <= 1e-3);
    if (singular) return least_norm_factor(p, me->initial, &me->least_norm);
    free_initial(me);
    return 0;
}

/* b becomes the solution; exactly so where an equation has one unknown, which the rounding of others must not move:
 * what is at rest stays at rest. */
void solve_linear_initial(Instance *me, double *b) {
    const Pattern *p = &model.I;
    const int n = p->n;
    double given[LENGTH(n)];
    int entries[LENGTH(n)];
    memcpy(given, b, sizeof given);
    memset(entries, 0, sizeof entries);
    if (me->least_norm) least_norm_solve(p, me->least_norm, b);
    else SOLVE(I, &me->lu_start, b);
    for (int k = 0; k < p->nonzeros; k++) entries[p->row[k]]++;
    for (int j = 0; j < n; j++)
        for (int k = p->start[j]; k < p->start[j + 1]; k++)
            if (entries[p->row[k]] == 1 && me->initial[k] != 0.0) b[j] = given[p->row[k]] / me->initial[k];
}

/* Where the equations are singular at v: do the residuals of those vanish, too, that depend on others? */
int is_initial(const Instance *me, const double *v, const double *r) {
    const Pattern *p = &model.I;
    ZEROS(size, p->n);
    for (int j = 0; j < p->n && me->least_norm; j++)
        for (int k = p->start[j]; k < p->start[j + 1]; k++)
            size[p->row[k]] += fabs(me->initial[k]) * fmax(initial_nominal(j), fabs(v[j]));
    for (int i = 0; i < p->n && me->least_norm; i++)
        if (!(fabs(r[i]) <= 1e-12 + 1e-9 * size[i])) return 0;
    return 1;
}

void free_initial(Instance *me) {
    free_least_norm(me->least_norm);
    me->least_norm = NULL;
}
