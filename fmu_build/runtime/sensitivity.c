/* Forward sensitivities S = dx/dp by the variational equations S' = (df/dx) S + df/dp.
 *
 * On every step that the state's integrator accepts they are solved by the collocation method Radau IIA with three
 * stages (order 5, L-stable: as stiff as the model may be) along the dense output of the state, the unknowns of
 * algebraic loops with them. The equations are linear, so a step is one factorisation for all parameters, of blocks of
 * three where the model's Jacobian has entries, and no error control of its own is needed. (With two stages, order 3, a
 * run with derivatives takes a sixth less time, but their errors grow from 1e-5 ... 1e-4 to 1e-3 ... 1e-2.) The solution
 * between the communication points is the collocation polynomial. A step is worked off only when it is needed: a
 * lookahead that a new input makes void costs nothing. Where the step runs over kinks of f, whose Jacobian jumps there,
 * it is solved in pieces between them. Where S begins and what an event makes of it: sensitivity_rare.c. */
#include <math.h>
#include <string.h>

#include "collocation.h"
#include "sensitivity.h"

static const double RADAU_NODE[RADAU] = {0.1550510257216822, 0.6449489742783178, 1.0};
static const double W_SUM[RADAU] = {4.139387691339814, -1.7393876913398136, 3.0};

/* to += a * row for n directions */
static inline void add_row(size_t n, double a, const double *restrict row, double *restrict to) {
    for (size_t p = 0; p < n; p++) to[p] += a * row[p];
}

/* to += a * row k of q->moves */
static inline void add_moved(const struct Sensitivity *q, double a, int k, double *to) {
    const double *row = q->moves + k * q->n;
    if (a == 0.0) return; /* most entries of a table, at any time */
    for (size_t p = q->moved[k].first; p < q->moved[k].end; p++) to[p] += a * row[p];
}

/* Derivatives of [f; r] by what the directions move, along all of them, into q->by_moves; with the entries of J. */
static int shared_slopes(Instance *me, const double *t, const double *x, const double *u, double *jacobian) {
    struct Sensitivity *q = me->sensitivity;
    double by_moved[LENGTH(model.n_slopes + model.n_elements)];
    environment_at(me, t, x, u);
    if (q->n_active > 0 && q->active[0] >= model.n_slopes) { /* of tables alone */
        me->res[0] = me->res[2] = NULL;
        me->res[1] = jacobian;
        if (CALL(jacobian)) return 1;
    } else {
        me->res[0] = jacobian;
        me->res[1] = by_moved;
        if (CALL(slopes)) return 1;
    }
    if (q->elements) {
        environment_at(me, t, x, u);
        me->res[0] = by_moved + model.n_slopes;
        if (CALL(element_slopes)) return 1;
    }
    if (q->n <= SLICE) memset(q->by_moves, 0, N * q->n * sizeof(double));
    else EACH_LIVE(q, first, end)
        for (int row = 0; row < N; row++) memset(q->by_moves + row * q->n + first, 0, (end - first) * sizeof(double));
    for (int a = 0; a < q->n_active; a++) {
        const int k = q->active[a], column = model.slope_column[k];
        if (by_moved[k] == 0.0) continue;
        const Span *moved = &q->moved[column];
        for (size_t slice = moved->first / SLICE; slice * SLICE < moved->end; slice++)
            if (!q->live[slice]) q->live[slice] = 1;
        add_moved(q, by_moved[k], column, q->by_moves + model.slope_row[k] * q->n);
    }
    return 0;
}

/* Adds the derivatives of `entries` quantities by input i, times how it moves, to their rows of n. */
static void add_driven(const Instance *me, int i, double t, const double *by_input, int entries, double *rows) {
    const struct Sensitivity *q = me->sensitivity;
    for (size_t j = 0; j < q->n; j++) {
        const double move = input_move(me, i, j, t);
        for (int row = 0; row < entries; row++) rows[row * q->n + j] += by_input[row] * move;
    }
}

/* The entries of J, and q->by_moves. */
static int slopes_at(Instance *me, double t, const double *x, const double *u, double *jacobian) {
    struct Sensitivity *q = me->sensitivity;
    double along[LENGTH(N)];
    if (solve_loop(me, t, x, u)) return 1;
    if (q->shared) {
        if (shared_slopes(me, &t, x, u, jacobian)) return 1;
    } else {
        environment_at(me, &t, x, u);
        me->res[0] = me->res[2] = NULL;
        me->res[1] = jacobian;
        if (CALL(jacobian)) return 1;
    }
    for (size_t j = 0; j < q->n; j++) {
        if (!q->apart[j]) continue;
        const Direction *s = &q->along[j];
        environment_at(me, &t, x, u);
        me->arg[9] = s->p;
        me->arg[10] = s->d;
        me->arg[11] = me->arg[12] = s->z;
        me->res[0] = along;
        if (CALL(move_partials)) return 1;
        for (int row = 0; row < N; row++) {
            q->by_moves[row * q->n + j] = along[row];
            q->live[j / SLICE] |= along[row] != 0.0;
        }
    }
    for (int i = 0; i < NU; i++) {
        if (i < NIN && !q->drive.driven[i]) continue;
        DIRECTION(s);
        s.u[i] = 1.0;
        if (partials_along(me, t, x, u, &s)) return 1;
        add_driven(me, i, t, s.dx, NX, q->by_moves);
        add_driven(me, i, t, s.y, NY, q->by_moves + NX * q->n);
    }
    return 0;
}

/* The entries of J at collocation point i, and the derivatives of [f; r] along the directions, into its rows. */
static int stage_slopes(Instance *me, double t, const double *x, double h, int i, double *jacobian, double *rows) {
    struct Sensitivity *q = me->sensitivity;
    const size_t n = q->n;
    input_at(me, t);
    if (slopes_at(me, t, x, me->ut, jacobian)) return 1;
    EACH_LIVE(q, first, end)
        for (int row = 0; row < N; row++)
            add_row(end - first, row_factor(row, h), q->by_moves + row * n + first,
                    rows + ((size_t)model.J.place[row] * RADAU + i) * n + first);
    return 0;
}

/* Blocks of J are diagonal until the elimination changes them: with b such a block, c -= a b */
static inline void subtract_scaled(const double *restrict a, const double *restrict b, double *restrict c) {
    for (int i = 0; i < RADAU; i++)
        for (int j = 0; j < RADAU; j++) c[i * RADAU + j] -= a[i * RADAU + j] * b[j * (RADAU + 1)];
}

/* c -= a b */
static inline void subtract_product(const double *restrict a, const double *restrict b, double *restrict c) {
    for (int i = 0; i < RADAU; i++)
        for (int j = 0; j < RADAU; j++)
            c[i * RADAU + j] -= a[i * RADAU] * b[j] + a[i * RADAU + 1] * b[RADAU + j] + a[i * RADAU + 2] * b[2 * RADAU + j];
}

/* c = a b, a diagonal block a unless it is `full` */
static inline void product(int full, const double *restrict a, const double *restrict b, double *restrict c) {
    for (int i = 0; i < RADAU; i++)
        for (int j = 0; j < RADAU; j++)
            c[i * RADAU + j] = full ? a[i * RADAU] * b[j] + a[i * RADAU + 1] * b[RADAU + j] + a[i * RADAU + 2] * b[2 * RADAU + j]
                                    : a[i * (RADAU + 1)] * b[i * RADAU + j];
}

/* 1: singular */
static inline int invert(const double *restrict a, double *restrict inverse) {
    const double c0 = a[4] * a[8] - a[5] * a[7], c1 = a[5] * a[6] - a[3] * a[8], c2 = a[3] * a[7] - a[4] * a[6];
    const double determinant = a[0] * c0 + a[1] * c1 + a[2] * c2;
    if (!(fabs(determinant) > 0.0 && isfinite(determinant))) return 1;
    const double r = 1.0 / determinant;
    inverse[0] = r * c0;
    inverse[1] = r * (a[2] * a[7] - a[1] * a[8]);
    inverse[2] = r * (a[1] * a[5] - a[2] * a[4]);
    inverse[3] = r * c1;
    inverse[4] = r * (a[0] * a[8] - a[2] * a[6]);
    inverse[5] = r * (a[2] * a[3] - a[0] * a[5]);
    inverse[6] = r * c2;
    inverse[7] = r * (a[1] * a[6] - a[0] * a[7]);
    inverse[8] = r * (a[0] * a[4] - a[1] * a[3]);
    return 0;
}

/* Factorises the collocation matrix of blocks -h diag(J_1, J_2, J_3), plus W on the diagonal of the states, with the
 * planned pivots; 1: an entry has grown out of proportion to its row. */
static int planned_blocks(struct Sensitivity *q, double h, double *const *jacobian) {
    const Pattern *p = &model.J;
    double *restrict x = q->work, *restrict bound = x + BLOCK * N, *restrict lu = q->factors;
    int grown = 0;
    for (int i = 0; i < N; i++) bound[p->place[i]] = i < NX ? p->growth : 0.0;
    for (int k = 0; k < model.J.nonzeros; k++) {
        double *b = &bound[p->place[p->row[k]]];
        for (int i = 0; i < RADAU; i++) *b = fmax(*b, p->growth * fabs(row_factor(p->row[k], h) * jacobian[i][k]));
    }
    for (int k = 0; k < N; k++) {
        const int column = p->column[k], diagonal = p->lu_diagonal[k], end = p->lu_start[k + 1];
        for (int r = p->lu_start[k]; r < end; r++)
            for (int i = 0; i < BLOCK; i++) x[p->lu_row[r] * BLOCK + i] = 0.0;
        for (int s = p->start[column]; s < p->start[column + 1]; s++) {
            double *block = x + p->place[p->row[s]] * BLOCK;
            for (int i = 0; i < RADAU; i++) block[i * (RADAU + 1)] = -row_factor(p->row[s], h) * jacobian[i][s];
            if (p->row[s] == column && column < NX)
                for (int i = 0; i < BLOCK; i++) block[i] += W[i / RADAU][i % RADAU];
        }
        for (int s = p->lu_start[k]; s < diagonal; s++) {
            const int j = p->lu_row[s];
            const double *u = x + j * BLOCK;
            for (int i = 0; i < BLOCK; i++) {
                lu[s * BLOCK + i] = u[i];
                grown |= !(fabs(u[i]) <= bound[j]);
            }
            for (int r = p->lu_diagonal[j] + 1; r < p->lu_start[j + 1]; r++)
                (p->lu_updated[s] ? subtract_product : subtract_scaled)(lu + r * BLOCK, u, x + p->lu_row[r] * BLOCK);
        }
        grown |= invert(x + k * BLOCK, lu + diagonal * BLOCK);
        for (int r = diagonal + 1; r < end; r++) {
            const double *own = x + p->lu_row[r] * BLOCK;
            for (int i = 0; i < BLOCK; i++) grown |= !(fabs(own[i]) <= bound[p->lu_row[r]]);
            product(p->lu_updated[r], own, lu + diagonal * BLOCK, lu + r * BLOCK);
        }
    }
    return grown;
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
    const Pattern *p = &model.J;
    const double *lu = q->factors;
    const int *const start = p->lu_start, *const at = p->lu_diagonal, *const row = p->lu_row, size = N;
    const size_t all = RADAU * n;
    for (int k = 0; k < size; k++)
        for (int r = at[k] + 1; r < start[k + 1]; r++)
            subtract_rows(m, n, lu + r * BLOCK, y + k * all, y + row[r] * all);
    for (int k = size - 1; k >= 0; k--) {
        const int diagonal = at[k];
        double *solved = to + p->column[k] * all, negative[BLOCK];
        for (int i = 0; i < BLOCK; i++) negative[i] = -lu[diagonal * BLOCK + i];
        for (int i = 0; i < RADAU; i++)
            for (size_t j = 0; j < m; j++) solved[i * n + j] = 0.0;
        subtract_rows(m, n, negative, y + k * all, solved);
        for (int s = start[k]; s < diagonal; s++) {
            const double *block = lu + s * BLOCK;
            double *rows = y + row[s] * all;
            if (p->lu_updated[s]) subtract_rows(m, n, block, solved, rows);
            else
                for (int i = 0; i < RADAU; i++) add_row(m, -block[i * (RADAU + 1)], solved + i * n, rows + i * n);
        }
    }
}

/* The collocation equations of a piece of the last step: with W the inverse of the method's matrix,
 *     sum_j W_ij S_j - h J_i S_i = h df/dp_i + (sum_j W_ij) S_0,
 * and for the unknowns of loops without W and h. */
static Status solve_piece(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    const double h = q->to - q->from;
    const size_t n = q->n;
    double x[LENGTH(NX)], slopes[RADAU * LENGTH(model.J.nonzeros)];
    double *const jacobian[RADAU] = {slopes, slopes + model.J.nonzeros, slopes + 2 * model.J.nonzeros};
    int failed = 0;
    EACH_LIVE(q, first, end)
        for (int row = 0; row < N; row++)
            for (int i = 0; i < RADAU; i++) {
                double *target = q->rest + ((size_t)model.J.place[row] * RADAU + i) * n;
                for (size_t p = first; p < end; p++) target[p] = row < NX ? W_SUM[i] * q->start[row * n + p] : 0.0;
            }
    for (int i = 0; i < RADAU && !failed; i++) {
        const double t = fmin(q->from + RADAU_NODE[i] * h, q->smooth); /* not with the Jacobian behind a kink */
        dense_output(step, t, x);
        failed = stage_slopes(me, t, x, h, i, jacobian[i], q->rest);
    }
    q->use_other = !failed && planned_blocks(q, h, jacobian);
    if (q->use_other) failed = pivoted_blocks(q, h, jacobian) || solve_pivoted(q, q->rest, q->stages);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", q->from);
    if (q->use_other) return STATUS_OK;
#define SOLVE_FEW(k) solve_rows(q, k, k, q->rest, q->stages)
    if (n < SLICE) UNROLLED(n, SOLVE_FEW);
    else EACH_LIVE(q, first, end) {
        if (end - first == SLICE) solve_rows(q, SLICE, n, q->rest + first, q->stages + first);
        else solve_rows(q, end - first, n, q->rest + first, q->stages + first);
    }
#undef SOLVE_FEW
    return STATUS_OK;
}

/* S at the end of the last piece. */
static void at_end(const struct Sensitivity *q, double *target) {
    for (int row = 0; row < NX; row++)
        memcpy(target + row * q->n, q->stages + (row * RADAU + RADAU - 1) * q->n, q->n * sizeof(double));
}

/* S at time t of the last piece, by its collocation polynomial. */
static void interpolate(const struct Sensitivity *q, double t, double *target) {
    const double r = (t - q->from) / (q->to - q->from);
    const double at[RADAU + 1] = {0.0, RADAU_NODE[0], RADAU_NODE[1], RADAU_NODE[2]};
    double basis[RADAU + 1];
    for (int i = 0; i <= RADAU; i++) {
        basis[i] = 1.0;
        for (int j = 0; j <= RADAU; j++)
            if (j != i) basis[i] *= (r - at[j]) / (at[i] - at[j]);
    }
    EACH_LIVE(q, first, end)
        for (int row = 0; row < NX; row++)
            for (size_t p = first; p < end; p++) {
                const double *stage = q->stages + row * RADAU * q->n + p;
                target[row * q->n + p] = basis[0] * q->start[row * q->n + p] + basis[1] * stage[0] +
                                         basis[2] * stage[q->n] + basis[3] * stage[2 * q->n];
            }
}

/* Solves the pieces of the last step up to the one that holds time t. */
static Status solve_until(Instance *me, double t) {
    enum { MOST = 20 }; /* kinks that follow each other without end are rounding: what rests at its threshold */
    struct Sensitivity *q = me->sensitivity;
    double y[LENGTH(NY)]; /* loops go on from where the prediction left them */
    memcpy(y, me->s.y, sizeof y);
    const Step *step = &me->s.step;
    const double end = step->t1; /* what an event cuts off may be undefined */
    Status status = STATUS_OK;
    while (status == STATUS_OK && (q->pieces == 0 || (t > q->to && q->to < end))) {
        if (q->pieces > 0) {
            status = record_past_moves(me, q->from, q->to, interpolate);
            if (status != STATUS_OK) break;
            at_end(q, q->start);
        }
        q->from = q->pieces > 0 ? q->to : step->t0;
        q->smooth = end;
        q->to = q->pieces < MOST ? next_kink(me, q->from, end, q->switches, &q->switches_known, &q->smooth) : end;
        q->pieces++;
        status = solve_piece(me);
    }
    memcpy(me->s.y, y, sizeof y);
    return status;
}

/* S at time t of the last step, by its collocation polynomial, into `target`. */
static Status evaluate(Instance *me, double t, double *target) {
    struct Sensitivity *q = me->sensitivity;
    if (!(me->s.step.t1 > me->s.step.t0)) { /* the integration has just (re)started */
        memcpy(target, q->start, q->n * NX * sizeof *target);
        return STATUS_OK;
    }
    const Status status = solve_until(me, t);
    if (status != STATUS_OK) return status;
    if (t == q->to) at_end(q, target);
    else interpolate(q, t, target);
    return STATUS_OK;
}

/* To be called before the integrator forgets its last step, which was used up to time t; with `restart` the inputs or
 * the state may be others from there on. */
Status advance_sensitivities(Instance *me, double t, int restart) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    Status status = evaluate(me, t, q->now);
    if (status == STATUS_OK && q->pieces > 0) status = record_past_moves(me, q->from, t, interpolate);
    q->switches_known &= !restart && q->to == t;
    memcpy(q->start, q->now, q->n * NX * sizeof(double));
    q->pieces = 0;
    return status;
}

/* At the present point: the derivatives of y and dx, behind those of x in q->rest. */
static int follow_system(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const State *now = &me->s;
    const Pattern *p = &model.J;
    const size_t n = q->n;
    double jacobian[LENGTH(model.J.nonzeros)], b[LENGTH(NY)];
    double *y = q->rest + NX * n, *dx = y + NY * n;
    if (slopes_at(me, now->t, now->x, now->u, jacobian)) return 1;
    memcpy(dx, q->by_moves, NX * n * sizeof *dx);
    memcpy(y, q->by_moves + NX * n, NY * n * sizeof *y);
#define TARGET(row) ((row) < NX ? dx + (row) * n : y + ((row) - NX) * n)
    for (int column = 0; column < NX; column++)
        for (int k = p->start[column]; k < p->start[column + 1]; k++)
            add_row(n, jacobian[k], q->rest + column * n, TARGET(p->row[k]));
#undef TARGET
    if (NY == 0) return 0;
    if (factorise_loop(me, now->t, now->x, now->u)) return 1;
    for (size_t j = 0; j < n; j++) {
        for (int i = 0; i < NY; i++) b[i] = -y[i * n + j];
        solve_linear_loop(me, b);
        for (int i = 0; i < NY; i++) y[i * n + j] = b[i];
    }
    for (int column = NX; column < N; column++)
        for (int k = p->start[column]; k < p->start[column + 1]; k++)
            if (p->row[k] < NX) add_row(n, jacobian[k], q->rest + column * n, dx + p->row[k] * n);
    return 0;
}

/* The same of those v that are asked for, into q->shown: outputs, or what depends on the unknowns linearly. */
static int follow_variables(Instance *me, const unsigned char *asked) {
    struct Sensitivity *q = me->sensitivity;
    const State *now = &me->s;
    const size_t n = q->n;
    double computed[LENGTH(model.n_output_slopes)];
    environment_at(me, &now->t, now->x, now->u);
    me->res[0] = computed;
    if (CALL(output_slopes)) return 1;
    for (int i = 0; i < NV; i++)
        if (asked[i]) memset(q->shown + i * n, 0, n * sizeof *q->shown);
    for (int k = 0; k < model.n_output_slopes + model.n_constant_slopes; k++) {
        const int column = model.variable_column[k], moved = column - N;
        if (!asked[model.variable_row[k]]) continue;
        const double slope = k < model.n_output_slopes ? computed[k] : model.constant_slope[k - model.n_output_slopes];
        double *row = q->shown + model.variable_row[k] * n;
        if (moved < 0) add_row(n, slope, q->rest + column * n, row);
        else add_moved(q, slope, moved, row);
    }
    for (int i = 0; i < NU; i++) {
        if (i < NIN && !q->drive.driven[i]) continue;
        DIRECTION(s);
        s.u[i] = 1.0;
        if (variables_along(me, now->t, now->x, now->u, &s)) return 1;
        for (int row = 0; row < NV; row++)
            if (asked[row]) add_driven(me, i, now->t, &s.v[row], 1, q->shown + row * n);
    }
    return 0;
}

/* The same of all v: one direction after the other. */
static int follow_all_variables(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const State *now = &me->s;
    const size_t n = q->n;
    if (NTRANSPORT > 0) environment_at(me, &now->t, now->x, now->u);
    for (size_t j = 0; j < n; j++) {
        Direction *s = &q->along[j];
        for (int i = 0; i < NX; i++) s->x[i] = q->rest[i * n + j];
        for (int i = 0; i < NY; i++) s->y[i] = q->rest[(NX + i) * n + j];
        for (int i = 0; i < NU; i++) s->u[i] = input_move(me, i, j, now->t);
        if (variables_along(me, now->t, now->x, now->u, s)) return 1;
        for (int i = 0; i < NV; i++) q->shown[i * n + j] = s->v[i];
    }
    return 0;
}

/* The derivatives of an entry of a vector; NULL: zeros. */
static const double *row_of(const struct Sensitivity *q, Vector vector, int index) {
    switch (vector) {
    case VECTOR_X: return q->rest + index * q->n;
    case VECTOR_Y: return q->rest + (NX + index) * q->n;
    case VECTOR_DX: return q->rest + (N + index) * q->n;
    case VECTOR_V: return q->shown + index * q->n;
    case VECTOR_P: return q->moves + index * q->n;
    case VECTOR_D: return q->moves + (NP + index) * q->n;
    case VECTOR_Z: return q->moves + (NP + ND + index) * q->n;
    default: return NULL;
    }
}

/* The derivatives of variables along the directions, at the present point. */
Status sensitivities_of(Instance *me, const unsigned *variables, size_t n, double *values) {
    struct Sensitivity *q = me->sensitivity;
    int system = NY > 0, shown = 0, all = 0;
    unsigned char asked[LENGTH(NV)];
    memset(asked, 0, sizeof asked);
    for (size_t i = 0; i < n; i++) {
        const VariableEntry *entry = differentiable(me, variables[i]);
        if (!entry) return STATUS_ERROR;
        system |= entry->vector == VECTOR_DX;
        if (entry->vector == VECTOR_V) shown = asked[entry->index] = 1;
        all |= entry->vector == VECTOR_V && !model.is_output[entry->index] && !model.is_linear[entry->index];
    }
    const Status status = evaluate(me, me->s.t, q->rest);
    if (status > STATUS_WARNING) return status;
    double y[LENGTH(NY)], kept[LENGTH(NM)];
    const Drive drive = q->drive;
    if (q->replaced) q->drive = q->next;
    memcpy(y, me->s.y, sizeof y);
    int failed = relations_for_input(me, kept);
    failed = failed || (system && follow_system(me));
    failed = failed || (shown && (all ? follow_all_variables(me) : follow_variables(me, asked)));
    memcpy(me->s.y, y, sizeof y);
    memcpy(me->s.m, kept, sizeof kept);
    for (size_t i = 0; i < n && !failed; i++) {
        const VariableEntry *entry = differentiable(me, variables[i]);
        const double *row = row_of(q, entry->vector, entry->index);
        for (size_t j = 0; j < q->n; j++) {
            const double move = entry->vector == VECTOR_U ? input_move(me, entry->index, j, me->s.t)
                                                          : row ? row[j] : 0.0;
            values[i * q->n + j] = entry->sign * move;
        }
    }
    q->drive = drive;
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", me->s.t);
    return status;
}
