/* Sensitivities across an event [Rozenvasser 1967; Galan, Feehery, Barton, Appl. Numer. Math. 31, 1999].
 *
 * An event at time tau moves with the parameters: where an indicator ends the continuous motion, g(tau, x(tau), p) = 0
 * gives dtau/dp = - (g_x S + g_p + g_z Z) / (g_t + g_x f + g_u u'); a time event moves with the expression that set it;
 * an input that changes at a communication point does not move. Seen from the moving event the state before it has
 * the derivative S + f dtau/dp. The event iteration is differentiated at the points it settles at, round by round; what
 * it makes of x, less f dtau/dp with the f of afterwards, is S after the event. Relations that the iteration changes,
 * and not the state, need no time of their own.
 *
 * Where this is not defined, it is refused: an indicator that only grazes zero or is zero at the start, two events at
 * once whose times move differently. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* Does an indicator, of total time derivative `rate`, that changes relation i turn back at once? "At once": within a
 * part of the step, the root of the tolerance, in which a parabola changes by no more than the tolerance of what it
 * changes by in the step. */
static int grazes(Instance *me, int i, double rate, int *failed) {
    State *s = &me->s;
    const Step *step = &s->step;
    const double sign = s->m[i] != 0.0 ? 1.0 : -1.0, before = s->t - 0.1 * (s->t - step->t0);
    double x[LENGTH(NX)], g[LENGTH(NM)];
    if (!(sign * rate < 0.0)) return 1;
    if (!(before < s->t)) return 0;
    DIRECTION(flow);
    flow.t = 1.0;
    dense_output(step, before, x);
    *failed = right_hand_side(me, before, x, flow.x);
    memcpy(flow.u, step->du, BYTES(NU));
    delayed_at(me, before, me->ut, flow.u);
    *failed = *failed || indicators_along(me, before, x, me->ut, &flow, g);
    const double bend = sign * (rate - g[i]) / (s->t - before);
    return bend > 0.0 && fabs(rate) < bend * sqrt(s->tolerance) * step->h;
}

static int differ(double a, double b) { return !(fabs(a - b) <= 1e-6 * fmax(fabs(a), fabs(b))); }

/* At the initial point: no indicator may be zero there and move with a parameter, for which way decides a relation. */
Status event_start_along(Instance *me, Direction *along, size_t n) {
    static const double ZERO = 1e-10, ROUNDING = 1e-12;
    State *s = &me->s;
    double y[LENGTH(NY)], value[LENGTH(NM)], g[LENGTH(NM)];
    if (NM == 0) return STATUS_OK;
    memcpy(y, s->y, sizeof y);
    int failed = solve_loop(me, s->t, s->x, s->u), open = 0;
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = value;
    failed = failed || CALL(indicators);
    for (size_t j = 0; j < n && !failed; j++) {
        failed = indicators_along(me, s->t, s->x, s->u, &along[j], g);
        for (int i = 0; i < NM; i++) open |= fabs(value[i]) <= ZERO && fabs(g[i]) > ROUNDING;
    }
    memcpy(s->y, y, sizeof y);
    if (failed) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", s->t);
    if (!open) return STATUS_OK;
    return report(me, STATUS_ERROR, "t = %.9g: the sensitivities are not defined: an event indicator is zero at the "
                  "start", s->t);
}

/* At the point where the continuous motion ends (discrete variables and relations are still those of before): the
 * derivative of the event's time along each direction into its t, and its x and u seen from there. Without `inside` a
 * communication point ends it, else an event. */
Status event_time_along(Instance *me, Direction *along, size_t n, int inside) {
    State *s = &me->s;
    const int due = inside && s->next_event <= s->t;
    double y[LENGTH(NY)], u[LENGTH(NU)], rate[LENGTH(NM)], g[LENGTH(NM)];
    ZEROS(m, NM);
    int changed[LENGTH(NM)], n_changed = 0;
    DIRECTION(flow);
    flow.t = 1.0;
    Status status = STATUS_OK;
    memcpy(y, s->y, sizeof y);
    int failed = right_hand_side(me, s->t, s->x, flow.x);
    memcpy(u, me->ut, sizeof u);
    memcpy(flow.u, s->step.du, BYTES(NU));
    delayed_at(me, s->t, me->ut, flow.u);
    relations(me, s->t, s->x, u, m);
    for (int i = 0; i < NM; i++)
        if (m[i] != s->m[i]) changed[n_changed++] = i;
    if (n_changed > 0) failed = failed || indicators_along(me, s->t, s->x, u, &flow, rate);
    for (int k = 0; k < n_changed && !failed && status == STATUS_OK; k++)
        if (grazes(me, changed[k], rate[changed[k]], &failed))
            status = report(me, STATUS_ERROR, "t = %.9g: the sensitivities are not defined: an event indicator only "
                            "grazes zero", s->t);
    for (size_t j = 0; j < n && !failed && status == STATUS_OK; j++) {
        Direction *a = &along[j];
        double tau = due ? a->next_event : 0.0;
        if (n_changed > 0) failed = indicators_along(me, s->t, s->x, u, a, g);
        for (int k = 0; k < n_changed && status == STATUS_OK; k++) {
            const double own = -g[changed[k]] / rate[changed[k]];
            if (k == 0 && inside && !due) tau = own;
            else if (differ(tau, own))
                status = report(me, STATUS_ERROR, "t = %.9g: the sensitivities are not defined: two events at once "
                                "whose times move differently", s->t);
        }
        a->t = tau;
        for (int i = 0; i < NX; i++) a->x[i] += tau * flow.x[i];
        for (int i = 0; i < NU; i++) a->u[i] += tau * flow.u[i];
    }
    memcpy(s->y, y, sizeof y);
    return failed ? report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", s->t) : status;
}

/* Where the inner loop of an event iteration has settled, before it goes on from new pre-values and (with `reinit`) a
 * new state: the derivatives of what it goes on from. */
Status event_update_along(Instance *me, Direction *along, size_t n, int initial, int reinit) {
    enum { MOST = 100 }; /* rounds, where discrete variables depend on each other in a circle */
    State *s = &me->s;
    double y[LENGTH(NY)], new[NZ + NX + 1];
    memcpy(y, s->y, sizeof y);
    int failed = 0;
    for (size_t j = 0; j < n && !failed; j++) {
        Direction *a = &along[j];
        int settled = 0;
        for (int round = 0; round < MOST && !settled && !failed; round++) {
            failed = update_along(me, initial, a, new);
            settled = 1;
            for (int i = 0; i < NZ; i++) settled &= fabs(new[i] - a->z[i]) <= 1e-12 * fabs(new[i]);
            memcpy(a->z, new, NZ * sizeof *new);
        }
        failed = failed || !settled;
        if (!initial) memcpy(a->pz, new, NZ * sizeof *new);
        if (reinit) memcpy(a->x, new + NZ, NX * sizeof *new);
        a->next_event = new[NZ + NX];
        for (int i = 0; i < NX; i++) failed |= !isfinite(a->x[i]);
    }
    memcpy(s->y, y, sizeof y);
    return failed ? report(me, STATUS_ERROR, "t = %.9g: the sensitivities across the event cannot be computed", s->t)
                  : STATUS_OK;
}

/* After the event iteration: the derivatives of the state at the event's unmoved time. */
Status event_end_along(Instance *me, Direction *along, size_t n) {
    State *s = &me->s;
    double y[LENGTH(NY)], slope[LENGTH(NX)];
    memcpy(y, s->y, sizeof y);
    int failed = solve_loop(me, s->t, s->x, s->u);
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = slope;
    failed = failed || CALL(derivatives);
    for (size_t j = 0; j < n && !failed; j++) {
        for (int i = 0; i < NX; i++) along[j].x[i] -= along[j].t * slope[i];
        along[j].t = 0.0;
        memset(along[j].u, 0, BYTES(NU));
    }
    memcpy(s->y, y, sizeof y);
    return failed ? report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", s->t) : STATUS_OK;
}
