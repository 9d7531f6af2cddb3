/* Kinks of the right-hand side inside a rejected step: where abs, min, max or a noEvent condition switches. */
#include <math.h>
#include <string.h>

#include "instance.h"

static int switches_at(Instance *me, double t, const double *x, double *value) {
    input_at(me, t);
    if (solve_loop(me, t, x, me->ut)) return 1;
    environment_at(me, &t, x, me->ut);
    me->res[0] = value;
    return model_switches(me->arg, me->res, me->iw, me->w, 0);
}

/* The state tau after the start of a rejected step: by its first derivatives, or by what the step itself computed. */
static void predict(const Instance *me, const double *second, int from_step, double tau, double *x) {
    const Step *step = &me->s.step;
    if (from_step) {
        dense_output(step, step->t0 + tau, x);
        return;
    }
    for (int i = 0; i < NX; i++) x[i] = step->x0[i] + tau * (me->f0[i] + 0.5 * tau * second[i]);
}

/* Part of the rejected step of size h after which the first switching function has changed its sign; 1: none has.
 * Only a proposal for the step size: behind a kink a long step is far off, so the first guess extrapolates from the
 * start; `again` takes the dense output of the attempt, which then was short. */
double first_kink(Instance *me, double h, int again) {
    enum { SAMPLES = 4, BISECTIONS = 14 };
    Step *step = &me->s.step;
    double start[LENGTH(MODEL_NSWITCH)], now[LENGTH(MODEL_NSWITCH)], at_end[LENGTH(MODEL_NSWITCH)] = {0};
    double x[LENGTH(NX)], second[LENGTH(NX)], part = 1.0;
    if (MODEL_NSWITCH == 0 || switches_at(me, step->t0, step->x0, start)) return 1.0;
    for (int i = 0; i < NX; i++)
        if (!isfinite(step->x1[i])) return 1.0;
    memcpy(second, me->dfdt, sizeof second);
    for (int j = 0; j < NX; j++)
        for (int i = 0; i < NX; i++) second[i] += me->jacobian[j * NX + i] * me->f0[j];
    step->h = h; /* for the dense output */
    for (int attempt = 0; attempt < 3; attempt++) {
        double before = 0.0, after = 1.0;
        int found = 0;
        for (int trial = 1; trial <= SAMPLES + BISECTIONS && (found || trial <= SAMPLES); trial++) {
            const double middle = found ? 0.5 * (before + after) : (double)trial / SAMPLES;
            predict(me, second, again, middle * h, x);
            if (switches_at(me, step->t0 + middle * h, x, now)) break;
            int changed = 0;
            for (int i = 0; i < MODEL_NSWITCH; i++) changed |= start[i] * now[i] < 0.0;
            found |= changed;
            if (changed) {
                after = middle;
                memcpy(at_end, now, sizeof now);
            } else {
                before = middle;
            }
        }
        if (!found) break;
        if (after > 1e-3) {
            part = after;
            break;
        }
        /* What rests at zero (a saturated bristle) changes its sign by rounding: that is no kink ahead. */
        for (int i = 0; i < MODEL_NSWITCH; i++)
            if (start[i] * at_end[i] < 0.0) start[i] = 0.0;
    }
    step->h = 0.0;
    return part;
}

/* A time in (from, to) of the last step from which on a switching function has another sign than at its beginning, the
 * first such time where there are several; `to` if all signs at both ends are the same. `start` holds the functions at
 * the beginning if they are `known`, and on return those at `to` if that is where it ends. */
double next_kink(Instance *me, double from, double to, double *start, int *known) {
    enum { BISECTIONS = 10 };
    const Step *step = &me->s.step;
    double now[LENGTH(MODEL_NSWITCH)], x[LENGTH(NX)];
    double before = from + 1e-9 * (to - from), after = INFINITY; /* `from` may be a kink itself */
    const int given = *known;
    *known = 0;
    if (MODEL_NSWITCH == 0 || !(before > from)) return to;
    if (!given) dense_output(step, before, x);
    if (!given && switches_at(me, before, x, start)) return to;
    for (int trial = 0; trial <= BISECTIONS; trial++) {
        const double t = trial == 0 ? to : 0.5 * (before + after);
        dense_output(step, t, x);
        if (switches_at(me, t, x, now)) return to;
        int changed = 0;
        for (int i = 0; i < MODEL_NSWITCH; i++) changed |= start[i] * now[i] < 0.0;
        if (changed) after = t;
        else if (trial == 0) break;
        else before = t;
    }
    *known = after > to;
    if (*known) memcpy(start, now, sizeof now);
    return fmin(after, to);
}
