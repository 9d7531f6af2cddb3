/* Forward sensitivities S = dx/dp by the variational equations S' = (df/dx) S + df/dp.
 *
 * On every step that the state's integrator accepts they are solved by the collocation method Radau IIA with three
 * stages (order 5, L-stable: as stiff as the model may be) along the dense output of the state, the unknowns of
 * algebraic loops with them. The equations are linear, so a step is one factorisation for all parameters, of blocks of
 * three where the model's Jacobian has entries, and no error control of its own is needed. The solution between the
 * communication points is the collocation polynomial. A step is worked off only when it is
 * needed: a lookahead that a new input makes void costs nothing. Where the step runs over kinks of f, whose Jacobian
 * jumps there, it is solved in pieces between them. What an event does to S is in event_sensitivity.c. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "sensitivity.h"

enum { N = NX + NY, RADAU = 3, BLOCK = RADAU * RADAU };

struct Sensitivity {
    size_t n, n_parameters;
    unsigned *parameters;
    double *weights;  /* n rows of n_parameters: how they move together */
    Direction *along; /* p, d, z and pz as they change, the rest is work memory */
    double *moves;    /* the same p, d and z in NP + ND + NZ rows of n, in one block with what follows ... */
    unsigned char moved[LENGTH(NP + ND + NZ)]; /* ... which of them change at all ... */
    int elements;     /* ... and, if elements of arrays do, how many derivatives by those there are */
    double *start;    /* NX rows of n: at the beginning of the last step */
    double *stages;   /* N times RADAU rows of n: of each unknown at the collocation points */
    double *now;      /* NX rows of n: where they were asked for */
    double *rest;     /* N times RADAU rows of n: work memory */
    double from, to;  /* the piece of the last step that `stages` belong to ... */
    double smooth;    /* ... up to where f has no kink in it ... */
    int pieces;       /* ... and how many of it there were; 0: none is solved yet */
    double switches[LENGTH(MODEL_NSWITCH)]; /* their values at the end of the last piece ... */
    int switches_known;                     /* ... if f goes on from there as it was */
    double factors[BLOCK * MODEL_J_FILLED + 1]; /* blocks of L and U, on the diagonal inverses */
    Pivoted *other;                             /* of the whole matrix, where the planned pivots will not do ... */
    int use_other;                              /* ... as in the last piece */
    double work[2 * BLOCK * N + 1];
};

static const Pattern PATTERN_J = PATTERN(J);
static const double NODE[RADAU] = {0.1550510257216822, 0.6449489742783178, 1.0};
/* Inverse of the method's matrix, and its row sums. */
static const double W[RADAU][RADAU] = {
    {3.224744871391589, 1.1678400846904056, -0.25319726474218085},
    {-3.5678400846904057, 0.775255128608411, 1.0531972647421808},
    {5.531972647421808, -7.531972647421808, 5.0},
};
static const double W_SUM[RADAU] = {4.139387691339814, -1.7393876913398136, 3.0};

/* What multiplies a row of the collocation equations: loops are no differential equations. */
static inline double row_factor(int row, double h) { return row < NX ? h : 1.0; }

/* The entries of J, and the derivatives of [f; r] along the directions, into the rows of stage i. */
static int slopes_at(Instance *me, double t, const double *x, double h, int i, double *jacobian, double *rows) {
    struct Sensitivity *q = me->sensitivity;
    double by_parameter[LENGTH(MODEL_NSLOPE + MODEL_NELEMENT)];
    const size_t n = q->n;
    input_at(me, t);
    if (solve_loop(me, t, x, me->ut)) return 1;
    environment_at(me, &t, x, me->ut);
    me->res[0] = jacobian;
    me->res[1] = by_parameter;
    if (model_slopes(me->arg, me->res, me->iw, me->w, 0)) return 1;
    if (q->elements) {
        environment_at(me, &t, x, me->ut);
        me->res[0] = by_parameter + MODEL_NSLOPE;
        if (model_element_slopes(me->arg, me->res, me->iw, me->w, 0)) return 1;
    }
    for (int k = 0; k < MODEL_NSLOPE + q->elements; k++) {
        const int column = MODEL_SLOPE_COLUMN[k], row = MODEL_SLOPE_ROW[k];
        double *target = rows + ((size_t)MODEL_J_PLACE[row] * RADAU + i) * n;
        const double slope = row_factor(row, h) * by_parameter[k];
        if (q->moved[column])
            for (size_t p = 0; p < n; p++) target[p] += slope * q->moves[column * n + p];
    }
    return 0;
}

/* c -= a b */
static inline void subtract_product(const double *restrict a, const double *restrict b, double *restrict c) {
    for (int i = 0; i < RADAU; i++)
        for (int j = 0; j < RADAU; j++)
            c[i * RADAU + j] -= a[i * RADAU] * b[j] + a[i * RADAU + 1] * b[RADAU + j] + a[i * RADAU + 2] * b[2 * RADAU + j];
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
static int planned_factor(struct Sensitivity *q, double h, double (*jacobian)[LENGTH(MODEL_J_NONZEROS)]) {
    static const double GROWTH = 1e5;
    const Pattern *p = &PATTERN_J;
    double *restrict x = q->work, *restrict bound = x + BLOCK * N, *restrict lu = q->factors;
    int grown = 0;
    for (int i = 0; i < N; i++) bound[p->place[i]] = i < NX ? GROWTH : 0.0;
    for (int k = 0; k < MODEL_J_NONZEROS; k++) {
        double *b = &bound[p->place[p->row[k]]];
        for (int i = 0; i < RADAU; i++) *b = fmax(*b, GROWTH * fabs(row_factor(p->row[k], h) * jacobian[i][k]));
    }
    for (int k = 0; k < N; k++) {
        const int column = p->column[k], diagonal = MODEL_J_LU_DIAGONAL[k], end = MODEL_J_LU_START[k + 1];
        for (int r = MODEL_J_LU_START[k]; r < end; r++)
            for (int i = 0; i < BLOCK; i++) x[MODEL_J_LU_ROW[r] * BLOCK + i] = 0.0;
        for (int s = p->start[column]; s < p->start[column + 1]; s++) {
            double *block = x + p->place[p->row[s]] * BLOCK;
            for (int i = 0; i < RADAU; i++) block[i * (RADAU + 1)] = -row_factor(p->row[s], h) * jacobian[i][s];
            if (p->row[s] == column && column < NX)
                for (int i = 0; i < BLOCK; i++) block[i] += W[i / RADAU][i % RADAU];
        }
        for (int s = MODEL_J_LU_START[k]; s < diagonal; s++) {
            const int j = MODEL_J_LU_ROW[s];
            const double *u = x + j * BLOCK;
            for (int i = 0; i < BLOCK; i++) {
                lu[s * BLOCK + i] = u[i];
                grown |= !(fabs(u[i]) <= bound[j]);
            }
            for (int r = MODEL_J_LU_DIAGONAL[j] + 1; r < MODEL_J_LU_START[j + 1]; r++)
                subtract_product(lu + r * BLOCK, u, x + MODEL_J_LU_ROW[r] * BLOCK);
        }
        grown |= invert(x + k * BLOCK, lu + diagonal * BLOCK);
        for (int r = diagonal + 1; r < end; r++) {
            const double *own = x + MODEL_J_LU_ROW[r] * BLOCK;
            for (int i = 0; i < BLOCK; i++) {
                grown |= !(fabs(own[i]) <= bound[MODEL_J_LU_ROW[r]]);
                lu[r * BLOCK + i] = 0.0;
            }
            double negative[BLOCK];
            for (int i = 0; i < BLOCK; i++) negative[i] = -own[i];
            subtract_product(negative, lu + diagonal * BLOCK, lu + r * BLOCK);
        }
    }
    return grown;
}

/* The same with pivots chosen by size, blocks written out. */
static int pivoted_blocks(struct Sensitivity *q, double h, double (*jacobian)[LENGTH(MODEL_J_NONZEROS)]) {
    const Pattern *p = &PATTERN_J;
    int *index = malloc((LENGTH(RADAU * MODEL_J_NONZEROS + 2 * RADAU * NX) + 6 * N + 1) * sizeof *index);
    double *value = malloc(LENGTH(RADAU * MODEL_J_NONZEROS + 2 * RADAU * NX) * sizeof *value);
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

/* rows -= block * other, each RADAU rows of n */
static inline void subtract_rows(size_t n, const double *block, const double *restrict other, double *restrict rows) {
    for (int i = 0; i < RADAU; i++)
        for (size_t p = 0; p < n; p++)
            rows[i * n + p] -= block[i * RADAU] * other[p] + block[i * RADAU + 1] * other[n + p] +
                               block[i * RADAU + 2] * other[2 * n + p];
}

/* Solves for all directions: `y` has the rows in steps, `to` receives those of the unknowns. */
static inline void solve_rows(const struct Sensitivity *q, size_t n, double *y, double *to) {
    const Pattern *p = &PATTERN_J;
    const double *lu = q->factors;
    const size_t m = RADAU * n;
    for (int k = 0; k < N; k++)
        for (int r = MODEL_J_LU_DIAGONAL[k] + 1; r < MODEL_J_LU_START[k + 1]; r++)
            subtract_rows(n, lu + r * BLOCK, y + k * m, y + MODEL_J_LU_ROW[r] * m);
    for (int k = N - 1; k >= 0; k--) {
        const int diagonal = MODEL_J_LU_DIAGONAL[k];
        double *solved = to + p->column[k] * m, negative[BLOCK];
        for (int i = 0; i < BLOCK; i++) negative[i] = -lu[diagonal * BLOCK + i];
        for (size_t i = 0; i < m; i++) solved[i] = 0.0;
        subtract_rows(n, negative, y + k * m, solved);
        for (int s = MODEL_J_LU_START[k]; s < diagonal; s++)
            subtract_rows(n, lu + s * BLOCK, solved, y + MODEL_J_LU_ROW[s] * m);
    }
}

static int solve_pivoted(struct Sensitivity *q, const double *y, double *to) {
    double *b = malloc((2 * RADAU * N + 1) * sizeof *b);
    if (!b) return 1;
    for (size_t p = 0; p < q->n; p++) {
        for (int i = 0; i < RADAU * N; i++)
            b[i] = y[((size_t)PATTERN_J.place[i / RADAU] * RADAU + i % RADAU) * q->n + p];
        int *column = (int *)(void *)(b + RADAU * N);
        for (int i = 0; i < RADAU * N; i++) column[i] = PATTERN_J.column[i / RADAU] * RADAU + i % RADAU;
        pivoted_solve(RADAU * N, column, q->other, q->work, b);
        for (int i = 0; i < RADAU * N; i++) to[i * q->n + p] = b[i];
    }
    free(b);
    return 0;
}

/* The collocation equations of a piece of the last step: with W the inverse of the method's matrix,
 *     sum_j W_ij S_j - h J_i S_i = h df/dp_i + (sum_j W_ij) S_0,
 * and for the unknowns of loops without W and h. */
static Status solve_piece(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    const double h = q->to - q->from;
    const size_t n = q->n;
    double x[LENGTH(NX)], jacobian[RADAU][LENGTH(MODEL_J_NONZEROS)];
    int failed = 0;
    memset(q->rest, 0, RADAU * N * n * sizeof *q->rest);
    for (int row = 0; row < NX; row++)
        for (int i = 0; i < RADAU; i++) {
            double *target = q->rest + ((size_t)PATTERN_J.place[row] * RADAU + i) * n;
            for (size_t p = 0; p < n; p++) target[p] = W_SUM[i] * q->start[row * n + p];
        }
    for (int i = 0; i < RADAU && !failed; i++) {
        const double t = fmin(q->from + NODE[i] * h, q->smooth); /* not with the Jacobian behind a kink */
        dense_output(step, t, x);
        failed = slopes_at(me, t, x, h, i, jacobian[i], q->rest);
    }
    q->use_other = !failed && planned_factor(q, h, jacobian);
    if (q->use_other) failed = pivoted_blocks(q, h, jacobian) || solve_pivoted(q, q->rest, q->stages);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", q->from);
    if (q->use_other) return STATUS_OK;
#define SOLVE_ROWS(k) solve_rows(q, k, q->rest, q->stages)
    UNROLLED(n, SOLVE_ROWS);
#undef SOLVE_ROWS
    return STATUS_OK;
}

/* S at the end of the last piece becomes its beginning. */
static void take_over(struct Sensitivity *q) {
    for (int row = 0; row < NX; row++)
        memcpy(q->start + row * q->n, q->stages + (row * RADAU + RADAU - 1) * q->n, q->n * sizeof(double));
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
        if (q->pieces > 0) take_over(q);
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
    const Status status = solve_until(me, t);
    if (status != STATUS_OK) return status;
    const double r = q->to > q->from ? (t - q->from) / (q->to - q->from) : 1.0;
    const double at[RADAU + 1] = {0.0, NODE[0], NODE[1], NODE[2]};
    double basis[RADAU + 1];
    for (int i = 0; i <= RADAU; i++) {
        basis[i] = 1.0;
        for (int j = 0; j <= RADAU; j++)
            if (j != i) basis[i] *= (r - at[j]) / (at[i] - at[j]);
    }
    for (int row = 0; row < NX; row++)
        for (size_t p = 0; p < q->n; p++) {
            const double *stage = q->stages + row * RADAU * q->n + p;
            target[row * q->n + p] = basis[0] * q->start[row * q->n + p] + basis[1] * stage[0] +
                                     basis[2] * stage[q->n] + basis[3] * stage[2 * q->n];
        }
    return STATUS_OK;
}

/* To be called before the integrator forgets its last step, which was used up to time t; with `restart` the inputs or
 * the state may be others from there on. */
Status advance_sensitivities(Instance *me, double t, int restart) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    const Status status = evaluate(me, t, q->now);
    q->switches_known &= !restart && q->to == t;
    memcpy(q->start, q->now, q->n * NX * sizeof(double));
    q->pieces = 0;
    return status;
}

void free_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (q) {
        free(q->parameters);
        free(q->weights);
        free(q->along);
        free(q->moves);
        free_pivoted(&q->other);
    }
    free(q);
    me->sensitivity = NULL;
}

/* The derivatives that hold from here on, from the directions' x and z. */
static void go_on_along(struct Sensitivity *q) {
    for (size_t j = 0; j < q->n; j++) {
        const Direction *s = &q->along[j];
        for (int row = 0; row < NX; row++) q->start[row * q->n + j] = s->x[row];
        for (int k = 0; k < NZ; k++) {
            const int row = NP + ND + k;
            q->moves[row * q->n + j] = s->z[k];
            q->moved[row] |= s->z[k] != 0.0;
        }
    }
    q->pieces = q->switches_known = 0;
}

/* Derivatives of the initial state and, with them, of the discrete variables. */
static int initial_values_along(Instance *me, const double *start, Direction *s) {
    enum { MOST = 50 };
    double before[LENGTH(NZ)];
    if (discrete_starts_along(me, s)) return 1;
    for (int round = 0; round < MOST; round++) {
        memcpy(before, s->z, sizeof before);
        if (initial_states_along(me, start, s)) return 1;
        if (!MODEL_HAS_EVENTS) return 0;
        if (event_update_along(me, s, 1, 1, 0)) return 1;
        int settled = 1;
        for (int k = 0; k < NZ; k++) settled &= fabs(s->z[k] - before[k]) <= 1e-12 * fabs(s->z[k]);
        if (settled) {
            memcpy(s->pz, s->z, sizeof s->z);
            return 0;
        }
    }
    return 1;
}

/* At the initial point, the pre-values still those of before it: derivatives of what the simulation starts from. */
Status start_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    memset(q->moved, 0, sizeof q->moved);
    for (size_t j = 0; j < q->n; j++) {
        Direction *s = &q->along[j], unit;
        double start[LENGTH(NX)] = {0}, unit_start[LENGTH(NX)];
        memset(s, 0, sizeof *s);
        for (size_t i = 0; i < q->n_parameters; i++) {
            const double w = q->weights[j * q->n_parameters + i];
            if (w == 0.0) continue;
            memset(&unit, 0, sizeof unit);
            memset(unit_start, 0, sizeof unit_start);
            parameter_direction(q->parameters[i], &unit, unit_start);
            for (int k = 0; k < NP; k++) s->p[k] += w * unit.p[k];
            for (int k = 0; k < NX; k++) start[k] += w * unit_start[k];
        }
        if (dependent_parameters_along(me, s->p, s->d) || initial_values_along(me, start, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities of the initial state cannot be computed",
                          me->s.t);
        for (int k = 0; k < NP + ND; k++) {
            const double move = q->moves[k * q->n + j] = k < NP ? s->p[k] : s->d[k - NP];
            q->moved[k] |= move != 0.0;
        }
    }
    q->elements = 0;
    for (int k = MODEL_NSLOPE; k < MODEL_NSLOPE + MODEL_NELEMENT; k++)
        if (q->moved[MODEL_SLOPE_COLUMN[k]]) q->elements = MODEL_NELEMENT;
    go_on_along(q);
    return MODEL_HAS_EVENTS ? event_start_along(me, q->along, q->n) : STATUS_OK;
}

/* Before the event iteration: S at the event, seen from where it moves to. */
Status enter_event(Instance *me, int inside) {
    struct Sensitivity *q = me->sensitivity;
    const Status status = advance_sensitivities(me, me->s.t, 1);
    if (!MODEL_HAS_EVENTS || !q || q->n == 0 || status > STATUS_WARNING) return status;
    for (size_t j = 0; j < q->n; j++)
        for (int row = 0; row < NX; row++) q->along[j].x[row] = q->start[row * q->n + j];
    return event_time_along(me, q->along, q->n, inside);
}

/* In the event iteration, before the pre-values and (with `reinit`) the state change. */
Status update_sensitivities(Instance *me, int reinit) {
    struct Sensitivity *q = me->sensitivity;
    return q && q->n > 0 ? event_update_along(me, q->along, q->n, 0, reinit) : STATUS_OK;
}

/* After the event iteration. */
Status leave_event(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (!MODEL_HAS_EVENTS || !q || q->n == 0) return STATUS_OK;
    const Status status = event_end_along(me, q->along, q->n);
    go_on_along(q);
    return status;
}

int fmuidSetSensitivityDirections(void *instance, const unsigned *parameters, size_t n_parameters,
                                  const double *weights, size_t n) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    if (!(me->s.phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION)) || !me->s.is_co_simulation)
        return report(me, STATUS_ERROR, "sensitivities are chosen before a co-simulation starts");
    for (size_t i = 0; i < n_parameters; i++) {
        Direction s;
        double start[LENGTH(NX)];
        if (!parameter_direction(parameters[i], &s, start))
            return report(me, STATUS_ERROR, "value reference %u is no parameter or start value to differentiate by",
                          parameters[i]);
    }
    free_sensitivities(me);
    me->s.initialised = 0;
    if (n == 0) return STATUS_OK;
    struct Sensitivity *q = me->sensitivity = calloc(1, sizeof *q);
    if (q) {
        q->parameters = malloc(LENGTH(n_parameters) * sizeof *parameters);
        q->weights = malloc(LENGTH(n * n_parameters) * sizeof *weights);
        q->along = calloc(n, sizeof *q->along);
        q->moves = calloc(n * LENGTH(NP + ND + NZ + 2 * NX + 2 * RADAU * N), sizeof(double));
    }
    if (!q || !q->parameters || !q->weights || !q->along || !q->moves) {
        free_sensitivities(me);
        return report(me, STATUS_ERROR, "no memory for sensitivities");
    }
    q->start = q->moves + (NP + ND + NZ) * n;
    q->stages = q->start + NX * n;
    q->now = q->stages + RADAU * N * n;
    q->rest = q->now + NX * n;
    memcpy(q->parameters, parameters, n_parameters * sizeof *parameters);
    memcpy(q->weights, weights, n * n_parameters * sizeof *weights);
    q->n_parameters = n_parameters;
    q->n = n;
    return STATUS_OK;
}

int fmuidSetSensitivityParameters(void *instance, const unsigned *parameters, size_t n) {
    double *unit = calloc(LENGTH(n * n), sizeof *unit);
    if (!unit) return instance ? report(instance, STATUS_ERROR, "no memory for sensitivities") : STATUS_ERROR;
    for (size_t i = 0; i < n; i++) unit[i * n + i] = 1.0;
    const int status = fmuidSetSensitivityDirections(instance, parameters, n, unit, n);
    free(unit);
    return status;
}

int fmuidGetSensitivities(void *instance, const unsigned *variables, size_t n, double *values) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0 || me->s.phase != PHASE_STEP)
        return report(me, STATUS_ERROR, "no sensitivities were chosen before the simulation, or it has not started");
    Status status = evaluate(me, me->s.t, q->now);
    const State *now = &me->s;
    double y[LENGTH(NY)], kept[LENGTH(NM)];
    memcpy(y, now->y, sizeof y);
    if (relations_for_input(me, kept)) status = STATUS_ERROR;
    int slopes = NY > 0; /* derivatives of dx are seldom asked for, but bring those of loops */
    int outputs = 1;   /* what a run is compared by is cheaper than all that the model computes */
    for (size_t i = 0; i < n; i++) {
        slopes |= is_slope(variables[i]);
        outputs &= !is_hidden(variables[i]);
    }
    for (size_t j = 0; j < q->n && status <= STATUS_WARNING; j++) {
        Direction *s = &q->along[j];
        for (int row = 0; row < NX; row++) s->x[row] = q->now[row * q->n + j];
        if ((slopes && derivatives_along(me, now->t, now->x, now->u, s)) ||
            variables_along(me, now->t, now->x, now->u, s, outputs))
            status = report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", now->t);
        for (size_t i = 0; i < n && status <= STATUS_WARNING; i++)
            status = pick_derivative(me, variables[i], s, &values[i * q->n + j]);
    }
    memcpy(me->s.y, y, sizeof y);
    memcpy(me->s.m, kept, sizeof kept);
    return status;
}
