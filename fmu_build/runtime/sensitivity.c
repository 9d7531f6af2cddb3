/* Forward sensitivities S = dx/dp by the variational equations S' = (df/dx) S + df/dp.
 *
 * On every step that the state's integrator accepts they are solved by the collocation method Radau IIA with three
 * stages (order 5, L-stable: as stiff as the model may be) along the dense output of the state. The equations are
 * linear, so a step is one factorisation for all parameters, and no error control of its own is needed. The
 * solution between the communication points is the collocation polynomial. A step is worked off only when it is
 * needed: a lookahead that a new input makes void costs nothing. Where the step runs over kinks of f, whose Jacobian
 * jumps there, it is solved in pieces between them. What an event does to S is in event_sensitivity.c. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "lu.h"
#include "sensitivity.h"

enum { RADAU = 3 };

struct Sensitivity {
    size_t n, n_parameters;
    unsigned *parameters;
    double *weights;  /* n rows of n_parameters: how they move together */
    Direction *along; /* p, d, z and pz as they change, the rest is work memory */
    double *moves;    /* the same p, d and z in NP + ND + NZ rows of n, in one block with what follows ... */
    unsigned char moved[LENGTH(NP + ND + NZ)]; /* ... which of them change at all ... */
    int elements;     /* ... and, if elements of arrays do, how many derivatives by those there are */
    double *start;    /* NX rows of n: at the beginning of the last step */
    double *stages;   /* RADAU * NX rows of n: at its collocation points */
    double *now;      /* NX rows of n: where they were asked for */
    double *rest;     /* NX rows of n: work memory */
    double from, to;  /* the piece of the last step that `stages` belong to ... */
    double smooth;    /* ... up to where f has no kink in it ... */
    int pieces;       /* ... and how many of it there were; 0: none is solved yet */
    double switches[LENGTH(MODEL_NSWITCH)]; /* their values at the end of the last piece ... */
    int switches_known;                     /* ... if f goes on from there as it was */
    double inverse[LENGTH(NX * NX)], matrix[LENGTH(4 * NX * NX)];
    int pivot[LENGTH(2 * NX)];
};

static const double NODE[RADAU] = {0.1550510257216822, 0.6449489742783178, 1.0};
/* Inverse of the method's matrix, and its row sums. */
static const double W[RADAU][RADAU] = {
    {3.224744871391589, 1.1678400846904056, -0.25319726474218085},
    {-3.5678400846904057, 0.775255128608411, 1.0531972647421808},
    {5.531972647421808, -7.531972647421808, 5.0},
};
static const double W_SUM[RADAU] = {4.139387691339814, -1.7393876913398136, 3.0};

/* Derivatives of f by x (column-major) and, times h, along the directions (added to `forcing`, NX rows of n). */
static int slopes_at(Instance *me, double t, const double *x, double h, double *jacobian, double *forcing) {
    struct Sensitivity *q = me->sensitivity;
    double by_parameter[LENGTH(MODEL_NSLOPE + MODEL_NELEMENT)];
    input_at(me, t);
    if (NY > 0) { /* f depends on the parameters through the loops, too */
        if (linearise(me, t, x)) return 1;
        memcpy(jacobian, me->jacobian, sizeof me->jacobian);
        for (size_t p = 0; p < q->n; p++) {
            Direction *along = &q->along[p];
            memset(along->x, 0, sizeof along->x);
            if (derivatives_along(me, t, x, me->ut, along)) return 1;
            for (int i = 0; i < NX; i++) forcing[i * q->n + p] += h * along->dx[i];
        }
        return 0;
    }
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
        const int column = MODEL_SLOPE_COLUMN[k];
        double *target = forcing + MODEL_SLOPE_ROW[k] * q->n;
        if (q->moved[column])
            for (size_t p = 0; p < q->n; p++) target[p] += h * by_parameter[k] * q->moves[column * q->n + p];
    }
    return 0;
}

/* target += factor * inverse * rows (NX rows of n) */
static inline void add_rows(const double *inverse, size_t n, double factor, const double *rows, double *target) {
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            const double a = factor * inverse[i * NX + j];
            if (a == 0.0) continue;
            for (size_t p = 0; p < n; p++) target[i * n + p] += a * rows[j * n + p];
        }
}

static void add_solved(const struct Sensitivity *q, double factor, const double *rows, double *target) {
#define ADD(k) add_rows(q->inverse, k, factor, rows, target)
    UNROLLED(q->n, ADD);
#undef ADD
}

/* The collocation equations of a piece of the last step: with W the inverse of the method's matrix,
 *     sum_j W_ij S_j - h J_i S_i = h df/dp_i + (sum_j W_ij) S_0.
 * Only the diagonal blocks are full: the first stage is eliminated by its inverse, the others by one factorisation. */
static Status solve_piece(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    const double h = q->to - q->from;
    const size_t size = NX * q->n;
    double *const first = q->stages, *const others = q->stages + size, *rest = q->rest;
    double x[LENGTH(NX)], block[RADAU][LENGTH(NX * NX)];
    int failed = 0;
    for (int i = 0; i < RADAU && !failed; i++) {
        double *stage = q->stages + i * size;
        for (size_t k = 0; k < size; k++) stage[k] = W_SUM[i] * q->start[k];
        const double t = fmin(q->from + NODE[i] * h, q->smooth); /* not with the Jacobian behind a kink */
        dense_output(step, t, x);
        failed = slopes_at(me, t, x, h, block[i], stage);
        for (int k = 0; k < NX * NX; k++) block[i][k] *= -h;
        for (int k = 0; k < NX; k++) block[i][k * NX + k] += W[i][i];
    }
    memset(q->inverse, 0, sizeof q->inverse);
    for (int k = 0; k < NX; k++) q->inverse[k * NX + k] = 1.0;
    failed = failed || lu_factor(NX, block[0], q->pivot);
    if (!failed) lu_solve_many(NX, block[0], q->pivot, NX, q->inverse);

    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            for (int column = 0; column < NX; column++) {
                double *target = q->matrix + (j * NX + column) * 2 * NX + i * NX;
                const double eliminated = W[1 + i][0] * W[0][1 + j];
                for (int row = 0; row < NX; row++) {
                    target[row] = -eliminated * q->inverse[row * NX + column];
                    if (i == j) target[row] += block[1 + i][column * NX + row];
                }
                if (i != j) target[column] += W[1 + i][1 + j];
            }
    failed = failed || lu_factor(2 * NX, q->matrix, q->pivot);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", q->from);
    for (int i = 0; i < 2; i++) add_solved(q, -W[1 + i][0], first, others + i * size);
    lu_solve_many(2 * NX, q->matrix, q->pivot, q->n, others);
    for (size_t k = 0; k < size; k++) rest[k] = first[k] - W[0][1] * others[k] - W[0][2] * others[size + k];
    memset(first, 0, size * sizeof *first);
    add_solved(q, 1.0, rest, first);
    return STATUS_OK;
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
        if (q->pieces > 0) memcpy(q->start, q->stages + (RADAU - 1) * NX * q->n, NX * q->n * sizeof(double));
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
    const size_t size = NX * q->n;
    for (size_t k = 0; k < size; k++) target[k] = basis[0] * q->start[k];
    for (int i = 0; i < RADAU; i++)
        for (size_t k = 0; k < size; k++) target[k] += basis[i + 1] * q->stages[i * size + k];
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
        q->moves = calloc(n * LENGTH(NP + ND + NZ + (RADAU + 3) * NX), sizeof(double));
    }
    if (!q || !q->parameters || !q->weights || !q->along || !q->moves) {
        free_sensitivities(me);
        return report(me, STATUS_ERROR, "no memory for sensitivities");
    }
    q->start = q->moves + (NP + ND + NZ) * n;
    q->stages = q->start + NX * n;
    q->now = q->stages + RADAU * NX * n;
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
