/* Control of steps, which stages.c attempts. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* Starts anew at (s.t, s.x) with the present inputs; what was integrated beyond s.t is forgotten. */
void restart_integration(Instance *me) {
    State *s = &me->s;
    Step *step = &s->step;
    step->t0 = step->t1 = s->t;
    step->h = 0.0;
    memcpy(step->x0, s->x, BYTES(NX));
    memcpy(step->x1, s->x, BYTES(NX));
    memcpy(step->u, s->u, BYTES(NU));
    memcpy(step->du, s->du, BYTES(NU));
    step->u_time = s->t;
    step->event = 0;
    step->fresh = 1;
    step->h_old = 0.0;
}

/* First step size of a run from the first two derivatives [Hairer, Norsett, Wanner I, II.4]. */
static double first_step(Instance *me, double t, const double *x) {
    double d0 = 0.0, d1 = 0.0, d2 = 0.0, second[LENGTH(NX)];
    if (second_derivatives(me, t, x, second)) return 1e-6;
    for (int i = 0; i < NX; i++) {
        const double unit = tolerance_of(&me->s, i, x[i]);
        d0 = larger(d0, fabs(x[i]) / unit);
        d1 = larger(d1, fabs(me->f0[i]) / unit);
        d2 = larger(d2, fabs(second[i]) / unit);
    }
    const double fastest = larger(d1, d2);
    const double h = fastest > 1e-15 ? pow(0.01 / fastest, 0.2) : 1e-3;
    return d0 > 1e-5 && d1 > 1e-5 ? fmin(h, d0 / d1) : h;
}

static Status step_too_small(const Instance *me, double t, double error) {
    if (isnan(error))
        return report(me, STATUS_ERROR, "t = %.9g: the equations cannot be evaluated or solved any further (state %s)",
                      t, culprit(me));
    return report(me, STATUS_ERROR,
                  "t = %.9g: with the smallest step size the error of %s still exceeds the tolerance %.3g; the model "
                  "has a discontinuity or a singularity there",
                  t, culprit(me), me->s.tolerance);
}

/* One accepted step from step.t1. It may run past `target`, unless `exact` or the integration has just (re)started. */
Status integrate_step(Instance *me, double target, int exact) {
    State *s = &me->s;
    Step *step = &s->step;
    const double t = step->t1;
    /* A lookahead reaches where nobody has been: never past the end of the experiment or a time event. */
    double limit = s->next_event;
    if (s->stop_defined && s->stop_time >= target) limit = fmin(limit, s->stop_time);
    if (step->fresh || exact) limit = fmin(limit, target);
    step->event = 0;
    Status status = advance_sensitivities(me, t, 0);
    if (NPAST > 0 && status <= STATUS_WARNING) status = remember(me, t);
    if (status > STATUS_WARNING) return status;
    begin_step(step);

    const double room = limit - t;
    if (room <= 0.0 && s->next_event <= t) { /* a time event that is due now */
        step->event = 1;
        return STATUS_OK;
    }
    if (NX == 0) {
        step->t1 = fmin(limit, fmax(target, t));
        step->h = step->t1 - t;
        step->fresh = 0;
        return STATUS_OK;
    }
    if (linearise(me, t, step->x0) || with_slopes_of_inputs(me, t, step->x0))
        return report(me, STATUS_ERROR, "t = %.9g: the model's equations cannot be evaluated or solved", t);
    for (int i = 0; i < NX; i++)
        if (!isfinite(me->f0[i]))
            return report(me, STATUS_ERROR, "t = %.9g: the derivative of %s is not finite", t, model.x_name[i]);
    if (!(step->h_next > 0.0)) step->h_next = first_step(me, t, step->x0);

    /* What an input that has just changed sets off is as fast as after the last change. */
    const int start = step->fresh;
    double h = start && step->h_start > 0.0 ? fmin(step->h_next, step->h_start) : step->h_next;
    const double wanted = h;
    double last = 0.0;
    int rejected = 0, at_kink = 0;
    for (;;) {
        const int cut = h >= room || (h > 0.5 * room && isfinite(room));
        double attempt = h;
        if (h >= 0.999999 * room) attempt = room;
        else if (cut) attempt = 0.5 * room; /* two equal steps instead of one and a sliver */
        if (t + attempt <= t || attempt < 1e-290)
            return step_too_small(me, t, last);
        const double error = last = try_step(me, t, attempt);
        const double factor = 0.9 * pow(error, -0.2);
        if (error <= 1.0) {
            double grow = error > 0.0 ? factor : 8.0;
            double cap = rejected ? 1.0 : 8.0;
            if (step->h_old > 0.0 && !cut) /* Gustafsson's predictive controller */
                cap = fmin(cap, 0.9 * attempt / step->h_old * pow(step->error_old / (error * error + 1e-30), 0.2));
            grow = fmax(0.2, fmin(grow, cap));
            const double proposed = attempt * grow;
            /* A step cut short by a limit says little about the size possible: keep the larger one. */
            step->h_next = cut && !rejected && error > 0.0 && factor * attempt < h
                               ? factor * attempt
                               : (cut && !rejected ? fmax(h, proposed) : proposed);
            if (start && (rejected || step->h_start > 0.0))
                step->h_start = fmax(proposed, attempt == room ? step->h_start : 0.0);
            if (at_kink) step->h_next = fmax(step->h_next, 0.1 * fmin(wanted, room));
            step->h_old = at_kink ? 0.0 : attempt;
            step->error_old = fmax(error, 1e-2);
            step->h = attempt;
            step->t1 = attempt == room ? limit : t + attempt;
            step->fresh = 0;
            step->steps++;
            if (step->t1 >= s->next_event) step->event = 1;
            return STATUS_OK;
        }
        step->rejections++;
        h = attempt * (isfinite(error) ? fmax(0.1, factor) : 0.1);
        /* Rejected again: the error does not fall with the method's order, as behind a kink. */
        if (rejected) h = fmin(h, 0.5 * attempt);
        rejected = 1;
        /* An error out of all proportion comes from a kink in f: end the next attempt just past it. */
        if (error > 100.0 && at_kink < 4 && !step->fresh) {
            const double part = first_kink(me, attempt, at_kink);
            if (part < 1.0) {
                at_kink++;
                h = part * attempt * (1.0 + 1e-3 * pow(0.1, at_kink));
            }
        }
    }
}
