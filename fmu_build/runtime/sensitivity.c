/* Forward sensitivities S = dx/dp by the variational equations S' = (df/dx) S + df/dp.
 *
 * On every step that the state's integrator accepts they are solved by the collocation method Radau IIA with three
 * stages (order 5, L-stable: as stiff as the model may be) along the dense output of the state. The equations are
 * linear, so a step is one LU factorisation for all parameters, and no error control of its own is needed. The
 * solution between the communication points is the collocation polynomial. A step is worked off only when it is
 * needed: a lookahead that a new input makes void costs nothing. Where the step runs over kinks of f, whose Jacobian
 * jumps there, it is solved in pieces between them. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "lu.h"
#include "sensitivity.h"

enum { RADAU = 3, SIZE = RADAU * NX };

struct Sensitivity {
    size_t n, n_parameters;
    unsigned *parameters;
    double *weights;  /* n rows of n_parameters: how they move together */
    Direction *along; /* p and d as they change, the rest is work memory */
    double *start;    /* NX rows of n: at the beginning of the last step */
    double *stages;   /* RADAU * NX rows of n: at its collocation points */
    double *now;      /* NX rows of n: where they were asked for */
    double from, to;  /* the piece of the last step that `stages` belong to ... */
    int pieces;       /* ... and how many of it there were; 0: none is solved yet */
    double jacobian[RADAU][LENGTH(NX) * LENGTH(NX)];
    double matrix[LENGTH(SIZE) * LENGTH(SIZE)];
    int pivot[LENGTH(SIZE)];
};

static const double SQRT6 = 2.449489742783178;

static double node(int i) { return i == 0 ? (4 - SQRT6) / 10 : i == 1 ? (4 + SQRT6) / 10 : 1.0; }

static double weight(int i, int j) {
    const double a[RADAU][RADAU] = {
        {(88 - 7 * SQRT6) / 360, (296 - 169 * SQRT6) / 1800, (-2 + 3 * SQRT6) / 225},
        {(296 + 169 * SQRT6) / 1800, (88 + 7 * SQRT6) / 360, (-2 - 3 * SQRT6) / 225},
        {(16 - SQRT6) / 36, (16 + SQRT6) / 36, 1.0 / 9},
    };
    return a[i][j];
}

/* Adds h A b to the right-hand sides `stages`, b_i the derivatives of f by the parameters at collocation point i. */
static int add_forcing(Instance *me, int i, double t, const double *x, double h) {
    struct Sensitivity *q = me->sensitivity;
    input_at(me, t);
    for (size_t p = 0; p < q->n; p++) {
        Direction *along = &q->along[p];
        memset(along->x, 0, sizeof along->x);
        if (derivatives_along(me, t, x, me->ut, along)) return 1;
        for (int row = 0; row < NX; row++) {
            if (along->dx[row] == 0.0) continue;
            for (int j = 0; j < RADAU; j++) q->stages[(j * NX + row) * q->n + p] += h * weight(j, i) * along->dx[row];
        }
    }
    return 0;
}

/* The collocation equations of a piece of the last step. */
static Status solve_piece(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    double x[RADAU][LENGTH(NX)], t[RADAU];
    const double h = q->to - q->from;
    for (int i = 0; i < RADAU; i++) memcpy(q->stages + i * NX * q->n, q->start, NX * q->n * sizeof(double));
    if (h <= 0.0) return STATUS_OK;
    int failed = 0;
    for (int i = 0; i < RADAU; i++) {
        t[i] = q->from + node(i) * h;
        dense_output(step, t[i], x[i]);
        failed |= linearise(me, t[i], x[i]);
        memcpy(q->jacobian[i], me->jacobian, sizeof me->jacobian);
        failed = failed || add_forcing(me, i, t[i], x[i], h);
    }
    for (int j = 0; j < RADAU; j++)
        for (int column = 0; column < NX; column++) {
            double *target = q->matrix + (j * NX + column) * SIZE;
            for (int i = 0; i < RADAU; i++) {
                const double a = h * weight(i, j);
                for (int row = 0; row < NX; row++) target[i * NX + row] = -a * q->jacobian[j][column * NX + row];
            }
            target[j * NX + column] += 1.0;
        }
    failed = failed || lu_factor(SIZE, q->matrix, q->pivot);
    if (!failed) lu_solve_many(SIZE, q->matrix, q->pivot, q->n, q->stages);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", q->from);
    return STATUS_OK;
}

/* Solves the pieces of the last step up to the one that holds time t. */
static Status solve_until(Instance *me, double t) {
    enum { MOST = 20 }; /* kinks that follow each other without end are rounding: what rests at its threshold */
    struct Sensitivity *q = me->sensitivity;
    double y[LENGTH(NY)]; /* loops go on from where the prediction left them */
    memcpy(y, me->s.y, sizeof y);
    const Step *step = &me->s.step;
    const double end = step->t0 + step->h;
    Status status = STATUS_OK;
    while (status == STATUS_OK && (q->pieces == 0 || (t > q->to && q->to < end))) {
        if (q->pieces > 0) memcpy(q->start, q->stages + (RADAU - 1) * NX * q->n, NX * q->n * sizeof(double));
        q->from = q->pieces > 0 ? q->to : step->t0;
        q->to = q->pieces < MOST ? next_kink(me, q->from, end) : end;
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
    const double at[RADAU + 1] = {0.0, node(0), node(1), node(2)};
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

/* To be called before the integrator forgets its last step, which was used up to time t. */
Status advance_sensitivities(Instance *me, double t) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    const Status status = evaluate(me, t, q->now);
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
        free(q->start);
        free(q->stages);
        free(q->now);
    }
    free(q);
    me->sensitivity = NULL;
}

/* Derivatives of the initial state. */
Status start_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
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
        if (dependent_parameters_along(me, s->p, s->d) || initial_states_along(me, start, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities of the initial state cannot be computed",
                          me->s.t);
        for (int row = 0; row < NX; row++) q->start[row * q->n + j] = s->x[row];
    }
    q->pieces = 0;
    return STATUS_OK;
}

int fmuidSetSensitivityDirections(void *instance, const unsigned *parameters, size_t n_parameters, const double *weights,
                                  size_t n) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    if (!(me->s.phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION)) || !me->s.is_co_simulation)
        return report(me, STATUS_ERROR, "sensitivities are chosen before a co-simulation starts");
    if (MODEL_HAS_EVENTS && n > 0)
        return report(me, STATUS_ERROR, "sensitivities of a model with events are not supported");
    for (size_t i = 0; i < n_parameters; i++) {
        Direction s;
        double start[LENGTH(NX)];
        if (!parameter_direction(parameters[i], &s, start))
            return report(me, STATUS_ERROR, "value reference %u is no parameter or start value to differentiate by",
                          parameters[i]);
    }
    free_sensitivities(me);
    if (n == 0) return STATUS_OK;
    struct Sensitivity *q = me->sensitivity = calloc(1, sizeof *q);
    if (q) {
        q->parameters = malloc(LENGTH(n_parameters) * sizeof *parameters);
        q->weights = malloc(LENGTH(n * n_parameters) * sizeof *weights);
        q->along = calloc(n, sizeof *q->along);
        q->start = calloc(n * LENGTH(NX), sizeof(double));
        q->stages = calloc(n * LENGTH(SIZE), sizeof(double));
        q->now = calloc(n * LENGTH(NX), sizeof(double));
    }
    if (!q || !q->parameters || !q->weights || !q->along || !q->start || !q->stages || !q->now) {
        free_sensitivities(me);
        return report(me, STATUS_ERROR, "no memory for sensitivities");
    }
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
    double y[LENGTH(NY)];
    memcpy(y, now->y, sizeof y);
    int slopes = NY > 0; /* derivatives of dx are seldom asked for, but bring those of loops */
    for (size_t i = 0; i < n; i++) slopes |= is_slope(variables[i]);
    for (size_t j = 0; j < q->n && status <= STATUS_WARNING; j++) {
        Direction *s = &q->along[j];
        for (int row = 0; row < NX; row++) s->x[row] = q->now[row * q->n + j];
        if ((slopes && derivatives_along(me, now->t, now->x, now->u, s)) || variables_along(me, now->t, now->x, now->u, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", now->t);
        for (size_t i = 0; i < n && status <= STATUS_WARNING; i++)
            status = pick_derivative(me, variables[i], s, &values[i * q->n + j]);
    }
    memcpy(me->s.y, y, sizeof y);
    return status;
}
