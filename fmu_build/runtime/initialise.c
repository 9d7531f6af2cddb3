/* From start values to a consistent initial state. */
#include <math.h>
#include <string.h>

#include "newton.h"

/* A new or reset instance: every byte of the state is defined, so that equal runs are equal bit by bit. */
void set_defaults(Instance *me) {
    State *s = &me->s;
    const int is_co_simulation = s->is_co_simulation;
    free_sensitivities(me);
    char *block = s->block;
    memset(s, 0, sizeof *s);
    memset(block, 0, lend_state(s, block));
    s->is_co_simulation = is_co_simulation;
    s->phase = PHASE_INSTANTIATED;
    s->tolerance = model.default_tolerance;
    s->next_event = INFINITY;
    memcpy(s->p, me->start.p, BYTES(NP));
    memcpy(s->u, me->start.u, BYTES(NU));
    memcpy(s->xs, me->start.xs, BYTES(NX));
    memcpy(s->xs_set, me->start.xs_set, (size_t)NX);
}

/* Where the equations are not defined or singular for states of zero, as for a tank without mass: the nominal values of
 * those as a guess; 0: there are none. */
static int leave_zero(State *s) {
    int moved = 0;
    for (int i = 0; i < NX; i++)
        if (s->x[i] == 0.0) s->x[i] = model.x_scale[i] > 0.0 ? model.x_scale[i] : 1.0, moved = 1;
    return moved;
}

static int initial_at(Instance *me, const Place *at, const double *v, double *r, int with_matrix) {
    State *s = &me->s;
    memcpy(s->x, v, BYTES(NX));
    memcpy(s->y, v + NX, (size_t)NY * sizeof *v);
    environment_at(me, &at->t, s->x, at->u);
    me->arg[9] = s->xs;
    me->res[0] = r;
    me->res[1] = with_matrix ? me->initial : NULL;
    return CALL(initial);
}

/* The implicit initial equations: unknowns [x; y]. */
static int newton_from_here(Instance *me) {
    const int N = NX + NY;
    State *s = &me->s;
    double v[LENGTH(N)], work[3 * LENGTH(N)];
    const Unknowns start = {N, initial_nominal, initial_at, factorise_initial, solve_linear_initial};
    const Place at = {s->t, s->x, s->u};
    memcpy(v, s->x, BYTES(NX));
    memcpy(v + NX, s->y, (size_t)NY * sizeof *v);
    if (damped_newton(me, &start, &at, v, work)) return 1;
    if (initial_at(me, &at, v, work, 1)) return 1;
    return !factorise_initial(me) && !is_initial(me, v, work);
}

/* From the last solution, of other relations, or else from the start values, or else with those of zero left. Where the
 * equations leave something open, the start values count, not the other relations. */
static int solve_initial(Instance *me) {
    if (!newton_from_here(me) && !me->least_norm) return 0;
    for (int again = 0; again < 2; again++) {
        memcpy(me->s.x, me->s.xs, BYTES(NX));
        begin_loop(me);
        if (again && !leave_zero(&me->s)) return 1;
        if (!newton_from_here(me)) return 0;
    }
    return 1;
}

static Status solve_start(Instance *me) {
    State *s = &me->s;
    if (model.has_initial) {
        if (solve_initial(me))
            return report(me, STATUS_ERROR, "t = %.9g: the initial equations have no solution near the start values",
                          s->t);
    } else {
        memcpy(s->x, s->xs, BYTES(NX));
    }
    if (solve_loop(me, s->t, s->x, s->u))
        return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution near its start values", s->t);
    return STATUS_OK;
}

/* Dependent parameters, start values, initial equations and the first event iteration, from what has been set. */
static Status initialise_once(Instance *me) {
    State *s = &me->s;
    ZEROS(xs, NX);
    s->t = s->start_time;
    s->have_dx = s->have_v = 0;
    me->arg[0] = s->p;
    for (int i = 0; i < model.sz_res; i++) me->res[i] = NULL;
    me->res[0] = s->d;
    model_dependent(me->arg, me->res, me->iw, me->w, 0);
    s->laws = model_laws(s->p, me->iw, me->w);
    me->arg[0] = s->p;
    me->arg[1] = s->d;
    me->res[0] = xs;
    me->res[1] = s->z;
    me->res[2] = s->y;
    model_start(me->arg, me->res, me->iw, me->w, 0);
    for (int i = 0; i < NX; i++)
        if (!s->xs_set[i]) s->xs[i] = xs[i];
    memcpy(s->x, s->xs, BYTES(NX));
    memcpy(s->pz, s->z, BYTES(NZ));
    memset(s->m, 0, BYTES(NM));
    s->next_event = INFINITY;
    Status status = STATUS_OK;
    if (!model.has_events) {
        status = solve_start(me);
        if (status <= STATUS_WARNING) status = start_sensitivities(me);
    } else {
        /* The initial state and the relations depend on each other: repeat both until nothing changes. */
        relations(me, s->t, s->x, s->u, s->m);
        int settled = 0;
        for (int round = 0; round < 50 && !settled && status <= STATUS_WARNING; round++) {
            double m[LENGTH(NM)], z[LENGTH(NZ)];
            memcpy(m, s->m, sizeof m);
            memcpy(z, s->z, sizeof z);
            status = solve_start(me);
            if (status <= STATUS_WARNING) status = event_iteration(me, 1);
            settled = !memcmp(m, s->m, sizeof m) && !memcmp(z, s->z, sizeof z);
        }
        if (status <= STATUS_WARNING && !settled)
            status = report(me, STATUS_ERROR, "t = %.9g: the discrete variables do not settle at initialisation", s->t);
        if (status <= STATUS_WARNING) status = start_sensitivities(me);
        memcpy(s->pz, s->z, BYTES(NZ));
        if (status <= STATUS_WARNING) status = event_iteration(me, 0);
        if (status <= STATUS_WARNING) status = leave_event(me);
    }
    for (int i = 0; i < NX && status <= STATUS_WARNING; i++)
        if (!isfinite(s->x[i]))
            status = report(me, STATUS_ERROR, "t = %.9g: the start value of %s is not finite", s->t, model.x_name[i]);
    if (status <= STATUS_WARNING) status = whole_numbers(me);
    return status;
}

/* The same until the values of delay() are those that they delay. */
Status initialise(Instance *me) {
    int settled = NPAST == 0;
    me->s.memory.rows = 0;
    Status status = initialise_once(me);
    for (int round = 0; round < 100 && status <= STATUS_WARNING; round++) {
        if (round > 0) status = initialise_once(me);
        if (status <= STATUS_WARNING) status = begin_past(me, &settled);
        if (settled) break;
    }
    if (status <= STATUS_WARNING && !settled)
        status = report(me, STATUS_ERROR, "t = %.9g: the values of delay() do not settle at initialisation", me->s.t);
    if (status <= STATUS_WARNING) me->s.initialised = 1;
    return status;
}
