/* Values by reference, co-simulation steps and directional derivatives: the FMI functions without their names. */
#include <math.h>
#include <string.h>
#include <time.h>

#include "instance.h"
#include "sensitivity.h"

static const long MAX_STEPS = 5000000; /* in one communication step: something is wrong, do not hang */
static const int MAX_EVENTS = 1000;    /* without progress in time */
static const long LOOKS = 256;         /* integration steps between looks at the clock */

void fmuidSetPatience(void *instance, double seconds) { ((Instance *)instance)->patience = isfinite(seconds) ? seconds : 0.0; }

/* Brings what `vector` holds up to date at the current point. */
static Status refresh(Instance *me, Vector vector) {
    State *s = &me->s;
    if (vector == VECTOR_T || (vector == VECTOR_U && NDELAY == 0) || vector == VECTOR_P || vector == VECTOR_CONSTANT) return STATUS_OK;
    if (s->phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION) && !s->initialised) {
        const Status status = initialise(me);
        if (status > STATUS_WARNING) return status;
    }
    int failed = 0;
    if (vector == VECTOR_Y) failed = solve_loop(me, s->t, s->x, s->u);
    if (vector == VECTOR_DX && !s->have_dx) failed = evaluate_derivatives(me);
    if (vector == VECTOR_V && !s->have_v) failed = evaluate_variables(me);
    if (vector == VECTOR_G) failed = event_indicators(me, me->g);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution", s->t);
    return STATUS_OK;
}

static const double *vector_of(const Instance *me, Vector vector) {
    const State *s = &me->s;
    switch (vector) {
    case VECTOR_T: return &s->t;
    case VECTOR_X: return s->x;
    case VECTOR_DX: return s->dx;
    case VECTOR_U: return s->u;
    case VECTOR_P: return s->p;
    case VECTOR_D: return s->d;
    case VECTOR_Z: return s->z;
    case VECTOR_Y: return s->y;
    case VECTOR_V: return s->v;
    case VECTOR_G: return me->g;
    default: return model.constants;
    }
}

Status get_value(Instance *me, unsigned reference, VariableType type, double *value) {
    const VariableEntry *entry = entry_of(me, reference, type);
    if (!entry) return STATUS_ERROR;
    const Status status = refresh(me, entry->vector);
    if (status > STATUS_WARNING) return status;
    *value = entry->sign * vector_of(me, entry->vector)[entry->index];
    if (!isfinite(*value) && (entry->vector == VECTOR_V || entry->vector == VECTOR_DX))
        return report(me, STATUS_ERROR,
                      "t = %.9g: %s is %g: a division by zero, a singular system of equations or a function outside "
                      "its domain",
                      me->s.t, entry->name, *value);
    return status;
}

Status set_value(Instance *me, unsigned reference, VariableType type, double value) {
    State *s = &me->s;
    const VariableEntry *entry = entry_of(me, reference, type);
    if (!entry) return STATUS_ERROR;
    if (!isfinite(value)) return report(me, STATUS_ERROR, "%s cannot be set to %g", entry->name, value);
    const int before = s->phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION);
    const int i = entry->index;
    value *= entry->sign;
    switch (entry->settable) {
    case SETTABLE_INPUT:
        s->u_set[i] = 1;
        if (s->u[i] == value) return STATUS_OK;
        s->u[i] = value;
        s->input_event = 1;
        break;
    case SETTABLE_FIXED:
    case SETTABLE_TUNABLE:
        if (!before && !(entry->settable == SETTABLE_TUNABLE && s->phase & (PHASE_STEP | PHASE_EVENT)))
            return report(me, STATUS_ERROR, "parameter %s can only be set before the simulation starts", entry->name);
        if (s->p[i] == value) return STATUS_OK;
        if (!before && me->sensitivity)
            return report(me, STATUS_ERROR, "%s cannot change while sensitivities are computed", entry->name);
        s->p[i] = value;
        s->laws = 0;
        if (!before) {
            me->arg[0] = s->p;
            me->res[0] = s->d;
            model_dependent(me->arg, me->res, me->iw, me->w, 0);
            s->laws = model_laws(s->p, me->iw, me->w);
            s->changed = 1;
        }
        break;
    case SETTABLE_START:
        if (!before)
            return report(me, STATUS_ERROR,
                          "%s is a state: its start value can only be set before the simulation starts", entry->name);
        s->xs[i] = value;
        s->xs_set[i] = 1;
        break;
    default:
        return report(me, STATUS_ERROR, "%s is computed by the model and cannot be set", entry->name);
    }
    s->have_dx = s->have_v = 0;
    if (before) s->initialised = 0;
    return STATUS_OK;
}

Status set_input_slope(Instance *me, unsigned reference, double slope) {
    const VariableEntry *entry = entry_of(me, reference, TYPE_REAL);
    if (!entry) return STATUS_ERROR;
    if (entry->settable != SETTABLE_INPUT) return report(me, STATUS_ERROR, "%s is not an input", entry->name);
    if (!isfinite(slope)) return report(me, STATUS_ERROR, "the derivative of %s cannot be %g", entry->name, slope);
    me->s.du[entry->index] = entry->sign * slope;
    me->s.du_set[entry->index] = 1;
    return STATUS_OK;
}

/* Does the input now differ from the one the last step was integrated with? */
static int input_changed(Instance *me) {
    static const double LINE = 1e-11; /* far below any tolerance */
    State *s = &me->s;
    const Step *step = &s->step;
    int changed = 0;
    for (int i = 0; i < NIN; i++) {
        /* A value set without a slope at this point is held. */
        if (s->u_set[i] && !s->du_set[i]) s->du[i] = 0.0;
        const double along = step->du[i] * (s->t - step->u_time), expected = step->u[i] + along;
        /* Samples of one line are rounded. */
        if (fabs(s->u[i] - expected) > LINE * (fabs(expected) + fabs(along)) * (step->du[i] != 0.0) ||
            fabs(s->du[i] - step->du[i]) > LINE * fabs(step->du[i]))
            changed = 1;
        s->u_set[i] = s->du_set[i] = 0;
    }
    return changed;
}

/* A time event is due although only nearly reached: the sums of whoever steps are off by rounding. */
static double at_time_event(const State *s, double t) {
    return fabs(s->next_event - t) <= 1e-13 * fmax(1.0, fabs(t)) ? s->next_event : t;
}

/* Event update in model exchange. */
Status update_discrete_states(Instance *me, int *states_changed) {
    State *s = &me->s;
    double x[LENGTH(NX)];
    memcpy(x, s->x, sizeof x);
    s->t = at_time_event(s, s->t);
    Status status = pass_delays(me);
    if (status <= STATUS_WARNING) status = event_iteration(me, 0);
    *states_changed = memcmp(x, s->x, sizeof x) != 0;
    return status;
}

/* What model exchange calls besides: the ends of steps and of events. */
Status enter_event_mode(Instance *me) {
    const Status status = me->s.phase == PHASE_CONTINUOUS ? remember(me, me->s.t) : STATUS_OK;
    me->s.phase = PHASE_EVENT;
    return status;
}

Status enter_continuous_mode(Instance *me) {
    me->s.phase = PHASE_CONTINUOUS;
    return remember_point(me);
}

Status completed_step(Instance *me) {
    Status status = remember(me, me->s.t);
    if (status <= STATUS_WARNING) status = remember_point(me);
    return status <= STATUS_WARNING ? check_assertions(me) : status;
}

void set_time(Instance *me, double t) {
    me->s.t = t;
    me->s.have_dx = me->s.have_v = 0;
    delayed_at(me, t, me->s.u, NULL);
}

/* Moves on to time t, the inputs along their slopes. */
static void move_to(Instance *me, double t) {
    State *s = &me->s;
    for (int i = 0; i < NIN; i++) s->u[i] += s->du[i] * (t - s->t);
    s->t = t;
    if (NDELAY > 0) delayed_at(me, t, s->u, NULL);
}

/* The event iteration at the present point, `inside` a step or else between two; the integration starts anew. */
static Status pass_event(Instance *me, int inside) {
    Status status = enter_event(me, inside);
    if (status <= STATUS_WARNING) status = pass_delays(me);
    if (status <= STATUS_WARNING) status = event_iteration(me, 0);
    if (status <= STATUS_WARNING) status = leave_event(me);
    restart_integration(me);
    return status;
}

static Status handle_event(Instance *me) {
    State *s = &me->s;
    watch_chattering(me);
    dense_output(&s->step, s->step.t1, s->x);
    move_to(me, at_time_event(s, s->step.t1));
    return pass_event(me, 1);
}

/* One communication step from t to t + h. */
Status do_step(Instance *me, double t, double h) {
    State *s = &me->s;
    Step *step = &s->step;
    const double target = t + h;
    if (!(h >= 0.0) || !isfinite(target))
        return report(me, STATUS_ERROR, "a step from t = %.9g of size %g is not possible: the model is at t = %.9g", t,
                      h, s->t);
    if (s->stop_defined && target > s->stop_time + 1e-9 * (1.0 + fabs(s->stop_time)))
        return report(me, STATUS_ERROR, "the step to t = %.9g goes past the stop time %.9g", target, s->stop_time);
    if (fabs(t - s->t) > 1e-9 * (1.0 + fabs(s->t)))
        return report(me, STATUS_ERROR, "the step starts at t = %.9g but the model is at t = %.9g", t, s->t);
    /* An input that has just changed is likely to change again: end at the communication point, waste nothing. */
    const int restart = input_changed(me) || s->changed || step->t1 < s->t;
    if (restart) {
        s->changed = 0;
        const Status status = pass_event(me, 0);
        if (status > STATUS_WARNING) return status;
    }
    s->input_event = 0;
    const long limit = step->steps + MAX_STEPS;
    const double close = 1e-280 + 4e-16 * fabs(target); /* do not integrate what is only rounding of the time */
    const double late = 1e-13 * fmax(1.0, fabs(target)); /* so much may a sum of sample times be off */
    clock_t begun = 0; /* at the first look: most steps end before it, and a look costs as much as a light one */
    int looked = 0;
    int events = 0;
    double last_event = -INFINITY;
    while (!s->terminate) {
        if (step->t1 >= target - close && s->next_event <= target + late) step->event = 1;
        if (step->event && step->t1 <= target + close) {
            const Status status = handle_event(me);
            if (status > STATUS_WARNING) return status;
            events = s->t - last_event <= 1e-12 * (1.0 + fabs(s->t)) ? events + 1 : 0;
            last_event = s->t;
            if (events > MAX_EVENTS)
                return report(me, STATUS_ERROR, "t = %.9g: %d events without progress in time (chattering)", s->t,
                              events);
            continue;
        }
        if (step->t1 >= target - close) {
            /* A long step may have run over what only shows at the communication points. */
            if (step->t1 > target + close) find_event(me, fmax(s->t, step->t0), target, 1);
            if (!step->event || step->t1 > target + close) break;
            continue;
        }
        const Status status = integrate_step(me, target, restart);
        if (status > STATUS_WARNING) return status;
        if (step->t1 > step->t0) find_event(me, step->t0, step->t1, 4);
        if (step->steps > limit)
            return report(me, STATUS_ERROR, "t = %.9g: more than %ld integration steps", step->t1, MAX_STEPS);
        if (me->patience > 0.0 && step->steps % LOOKS == 0) {
            const clock_t now = clock();
            if (!looked) begun = now, looked = 1;
            if ((double)(now - begun) > me->patience * CLOCKS_PER_SEC)
                return report(me, STATUS_ERROR, "t = %.9g: one step takes over %g s of processor time", step->t1,
                              me->patience);
        }
    }
    if (!s->terminate) {
        move_to(me, target);
        dense_output(step, target, s->x);
    }
    s->have_dx = s->have_v = 0;
    return check_assertions(me);
}

/* The derivatives of a vector along a direction; NULL: zeros. */
static const double *vector_along(const Direction *s, Vector vector) {
    switch (vector) {
    case VECTOR_X: return s->x;
    case VECTOR_U: return s->u;
    case VECTOR_P: return s->p;
    case VECTOR_D: return s->d;
    case VECTOR_Z: return s->z;
    case VECTOR_Y: return s->y;
    case VECTOR_DX: return s->dx;
    case VECTOR_V: return s->v;
    default: return NULL;
    }
}

/* The vector of a direction that a variable's seed goes into; NULL with a message: nothing to differentiate by. */
static double *seed_of(const Instance *me, const VariableEntry *entry, Direction *s, double *start) {
    switch (entry->vector) {
    case VECTOR_X: return me->s.phase == PHASE_INITIALIZATION ? start : s->x;
    case VECTOR_U: return s->u;
    case VECTOR_P: return s->p;
    case VECTOR_D: return s->d;
    default:
        report(me, STATUS_ERROR, "%s is no state, input or parameter to differentiate by", entry->name);
        return NULL;
    }
}

/* Derivative of the unknowns in the direction of the knowns: exact, for continuous states, inputs and parameters.
 * Calculated parameters follow those they are calculated from, in the initialization mode the initial states too. */
Status get_directional_derivative(Instance *me, const unsigned *unknown, size_t n_unknown, const unsigned *known,
                                  size_t n_known, const double *seed, double *sensitivity) {
    State *now = &me->s;
    DIRECTION(s);
    ZEROS(start, NX);
    ZEROS(follow, ND);
    double kept[LENGTH(NM)];
    const Status status = refresh(me, VECTOR_D);
    if (status > STATUS_WARNING) return status;
    for (size_t k = 0; k < n_known; k++) {
        const VariableEntry *entry = entry_of(me, known[k], TYPE_REAL);
        double *direction = entry ? seed_of(me, entry, &s, start) : NULL;
        if (!direction) return STATUS_ERROR;
        direction[entry->index] += entry->sign * seed[k];
    }
    int failed = dependent_parameters_along(me, s.p, follow);
    for (int i = 0; i < ND; i++) s.d[i] += follow[i];
    if (now->phase == PHASE_INITIALIZATION) failed = failed || initial_states_along(me, start, &s);
    failed = relations_for_input(me, kept) || failed;
    failed = failed || derivatives_along(me, now->t, now->x, now->u, &s);
    failed = failed || variables_along(me, now->t, now->x, now->u, &s);
    memcpy(now->m, kept, sizeof kept);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the directional derivative cannot be computed", now->t);
    for (size_t k = 0; k < n_unknown; k++) {
        const VariableEntry *entry = differentiable(me, unknown[k]);
        if (!entry) return STATUS_ERROR;
        const double *along = vector_along(&s, entry->vector);
        sensitivity[k] = along ? entry->sign * along[entry->index] : 0.0;
    }
    return STATUS_OK;
}

Status set_experiment(Instance *me, int tolerance_defined, double tolerance, double start, int stop_defined,
                      double stop) {
    State *s = &me->s;
    if (tolerance_defined && !(tolerance >= 1e-14 && tolerance <= 0.1))
        return report(me, STATUS_ERROR, "tolerance %g is outside 1e-14 .. 0.1", tolerance);
    if (tolerance_defined) s->tolerance = tolerance;
    s->start_time = s->t = start;
    s->stop_defined = stop_defined;
    s->stop_time = stop_defined ? stop : INFINITY;
    s->initialised = 0;
    return STATUS_OK;
}

/* Leaves the initialization mode. */
Status start_simulation(Instance *me) {
    State *s = &me->s;
    const Status status = s->initialised ? STATUS_OK : initialise(me);
    if (status > STATUS_WARNING) return status;
    s->step.t0 = s->step.t1 = s->t;
    restart_integration(me);
    s->changed = 0;
    s->phase = s->is_co_simulation ? PHASE_STEP : PHASE_EVENT;
    return check_assertions(me);
}

int fmuidGetSensitivities(void *instance, const unsigned *variables, size_t n, double *values) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    if (!has_sensitivities(me) || !(me->s.phase & (PHASE_INITIALIZATION | PHASE_STEP)))
        return report(me, STATUS_ERROR, "no sensitivities were chosen before the simulation, or it has not started");
    if (!me->s.initialised && me->s.phase == PHASE_INITIALIZATION && initialise(me) > STATUS_WARNING) return STATUS_ERROR;
    return sensitivities_of(me, variables, n, values);
}
