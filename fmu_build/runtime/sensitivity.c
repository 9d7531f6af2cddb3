/* Forward sensitivities S = dx/dp by the variational equations S' = (df/dx) S + df/dp.
 *
 * On every step that the state's integrator accepts they are solved by the collocation method Radau IIA with three
 * stages (order 5, L-stable: as stiff as the model may be) along the dense output of the state. The equations are
 * linear, so a step is one LU factorisation for all parameters, and no error control of its own is needed. The
 * solution between the communication points is the collocation polynomial. A step is worked off only when it is
 * needed: a lookahead that a new input makes void costs nothing. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "lu.h"
#include "sensitivity.h"

enum { RADAU = 3, SIZE = RADAU * NX };

struct Sensitivity {
    size_t n;
    unsigned *parameters;
    Direction *along; /* of each parameter: p and d as they change with it, the rest is work memory */
    double *start;  /* n columns of NX: at the beginning of the last step */
    double *stages; /* n columns of RADAU * NX: at its collocation points */
    double *now;    /* n columns of NX: where they were asked for */
    int solved;     /* `stages` belong to the last step */
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

/* Derivative of the right-hand side by a parameter at (t, x). */
static int forcing(Instance *me, Direction *along, double t, const double *x, double *b) {
    memset(along->x, 0, sizeof along->x);
    input_at(me, t);
    if (derivatives_along(me, t, x, me->ut, along)) return 1;
    memcpy(b, along->dx, NX * sizeof *b);
    return 0;
}

/* The collocation equations of the last step. */
static Status solve_step(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    double x[RADAU][LENGTH(NX)], t[RADAU];
    const double h = step->h;
    q->solved = 1;
    if (h <= 0.0) {
        for (size_t j = 0; j < q->n; j++)
            for (int i = 0; i < RADAU; i++)
                memcpy(q->stages + (j * RADAU + i) * NX, q->start + j * NX, NX * sizeof(double));
        return STATUS_OK;
    }
    int failed = 0;
    for (int i = 0; i < RADAU; i++) {
        t[i] = step->t0 + node(i) * h;
        dense_output(step, t[i], x[i]);
        failed |= linearise(me, t[i], x[i]);
        memcpy(q->jacobian[i], me->jacobian, sizeof me->jacobian);
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
    for (size_t p = 0; p < q->n && !failed; p++) {
        double b[RADAU][LENGTH(NX)];
        double *y = q->stages + p * SIZE;
        for (int i = 0; i < RADAU; i++) failed |= forcing(me, &q->along[p], t[i], x[i], b[i]);
        for (int i = 0; i < RADAU; i++)
            for (int row = 0; row < NX; row++) {
                double sum = q->start[p * NX + row];
                for (int j = 0; j < RADAU; j++) sum += h * weight(i, j) * b[j][row];
                y[i * NX + row] = sum;
            }
        lu_solve(SIZE, q->matrix, q->pivot, y);
    }
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", step->t0);
    return STATUS_OK;
}

/* S at time t of the last step, by its collocation polynomial, into `target`. */
static Status evaluate(Instance *me, double t, double *target) {
    struct Sensitivity *q = me->sensitivity;
    const Step *step = &me->s.step;
    if (!q->solved) {
        const Status status = solve_step(me);
        if (status != STATUS_OK) return status;
    }
    const double r = step->h > 0.0 ? (t - step->t0) / step->h : 1.0;
    const double at[RADAU + 1] = {0.0, node(0), node(1), node(2)};
    double basis[RADAU + 1];
    for (int i = 0; i <= RADAU; i++) {
        basis[i] = 1.0;
        for (int j = 0; j <= RADAU; j++)
            if (j != i) basis[i] *= (r - at[j]) / (at[i] - at[j]);
    }
    for (size_t p = 0; p < q->n; p++)
        for (int row = 0; row < NX; row++) {
            double sum = basis[0] * q->start[p * NX + row];
            for (int i = 0; i < RADAU; i++) sum += basis[i + 1] * q->stages[p * SIZE + i * NX + row];
            target[p * NX + row] = sum;
        }
    return STATUS_OK;
}

/* To be called before the integrator forgets its last step, which was used up to time t. */
Status advance_sensitivities(Instance *me, double t) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    const Status status = evaluate(me, t, q->now);
    memcpy(q->start, q->now, q->n * NX * sizeof(double));
    q->solved = 0;
    return status;
}

void free_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (q) {
        free(q->parameters);
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
        Direction *s = &q->along[j];
        double start[LENGTH(NX)] = {0};
        memset(s, 0, sizeof *s);
        parameter_direction(q->parameters[j], s, start);
        if (dependent_parameters_along(me, s->p, s->d) || initial_states_along(me, start, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities of the initial state cannot be computed",
                          me->s.t);
        memcpy(q->start + j * NX, s->x, NX * sizeof(double));
    }
    q->solved = 0;
    return STATUS_OK;
}

int fmuidSetSensitivityParameters(void *instance, const unsigned *parameters, size_t n) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    if (!(me->s.phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION)) || !me->s.is_co_simulation)
        return report(me, STATUS_ERROR, "sensitivities are chosen before a co-simulation starts");
    if (MODEL_HAS_EVENTS && n > 0)
        return report(me, STATUS_ERROR, "sensitivities of a model with events are not supported");
    for (size_t i = 0; i < n; i++) {
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
        q->parameters = malloc(n * sizeof *parameters);
        q->along = calloc(n, sizeof *q->along);
        q->start = calloc(n * LENGTH(NX), sizeof(double));
        q->stages = calloc(n * LENGTH(SIZE), sizeof(double));
        q->now = calloc(n * LENGTH(NX), sizeof(double));
    }
    if (!q || !q->parameters || !q->along || !q->start || !q->stages || !q->now) {
        free_sensitivities(me);
        return report(me, STATUS_ERROR, "no memory for sensitivities");
    }
    memcpy(q->parameters, parameters, n * sizeof *parameters);
    q->n = n;
    return STATUS_OK;
}

int fmuidGetSensitivities(void *instance, const unsigned *variables, size_t n, double *values) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0 || me->s.phase != PHASE_STEP)
        return report(me, STATUS_ERROR, "no sensitivities were chosen before the simulation, or it has not started");
    Status status = evaluate(me, me->s.t, q->now);
    const State *now = &me->s;
    for (size_t j = 0; j < q->n && status <= STATUS_WARNING; j++) {
        Direction *s = &q->along[j];
        memcpy(s->x, q->now + j * NX, NX * sizeof(double));
        if (derivatives_along(me, now->t, now->x, now->u, s) || variables_along(me, now->t, now->x, now->u, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", now->t);
        for (size_t i = 0; i < n && status <= STATUS_WARNING; i++)
            status = pick_derivative(me, variables[i], s, &values[i * q->n + j]);
    }
    return status;
}
