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

/* The state tau after the start of the last step: by its first derivatives, or (`second` NULL) by its dense output. */
static void predict(const Instance *me, const double *second, double tau, double *x) {
    const Step *step = &me->s.step;
    if (!second) {
        dense_output(step, step->t0 + tau, x);
        return;
    }
    for (int i = 0; i < NX; i++) x[i] = step->x0[i] + tau * (me->f0[i] + 0.5 * tau * second[i]);
}

/* A stretch of the last step at whose end a switching function has another sign than in `signs`. */
typedef struct {
    double before, after; /* since the start of the step */
    double *low, *high; /* the functions at both */
} Bracket;

/* Moves one end of the bracket to tau; 1: the functions cannot be evaluated there. */
static int cut(Instance *me, const double *second, const double *signs, double tau, Bracket *b) {
    double now[LENGTH(model.n_switches)], x[LENGTH(NX)];
    predict(me, second, tau, x);
    if (switches_at(me, me->s.step.t0 + tau, x, now)) return 1;
    int changed = 0;
    for (int i = 0; i < model.n_switches; i++) changed |= signs[i] * now[i] < 0.0;
    *(changed ? &b->after : &b->before) = tau;
    memcpy(changed ? b->high : b->low, now, sizeof now);
    return 0;
}

/* Narrows the bracket to `width`: from either side of where straight lines say that the first of the functions crosses,
 * then in the middle, in case they are wrong. */
static void narrow(Instance *me, const double *second, const double *signs, double width, Bracket *b) {
    enum { TRIALS = 14 };
    for (int trial = 0; trial < TRIALS && b->after - b->before > width; trial++) {
        const double room = b->after - b->before;
        double first = 1.0;
        for (int i = 0; i < model.n_switches; i++)
            if (signs[i] * b->high[i] < 0.0) first = fmin(first, b->low[i] / (b->low[i] - b->high[i]));
        first += trial % 3 == 0 ? 0.03 : -0.03;
        if (trial % 3 == 2 || !(first > 0.0 && first < 1.0)) first = 0.5;
        if (cut(me, second, signs, b->before + first * room, b)) return;
    }
}

/* Part of the rejected step of size h after which the first switching function has changed its sign; 1: none has.
 * Only a proposal for the step size: behind a kink a long step is far off, so the first guess extrapolates from the
 * start; `again` takes the dense output of the attempt, which then was short. */
double first_kink(Instance *me, double h, int again) {
    enum { SAMPLES = 4, TRIES = 3 };
    static const double FINE = 2e-5; /* parts of the step */
    Step *step = &me->s.step;
    double start[LENGTH(model.n_switches)], low[LENGTH(model.n_switches)], high[LENGTH(model.n_switches)];
    double curvature[LENGTH(NX)], part = 1.0;
    if (model.n_switches == 0 || switches_at(me, step->t0, step->x0, start)) return 1.0;
    for (int i = 0; i < NX; i++)
        if (!isfinite(step->x1[i])) return 1.0;
    input_at(me, step->t0);
    if (second_derivatives(me, step->t0, step->x0, curvature)) return 1.0;
    const double *second = again ? NULL : curvature;
    step->h = h; /* for the dense output */
    for (int attempt = 0; attempt < TRIES; attempt++) {
        Bracket b = {0.0, INFINITY, low, high};
        memcpy(low, start, sizeof low);
        for (int sample = 1; sample <= SAMPLES && b.after > h; sample++)
            if (cut(me, second, start, h * sample / SAMPLES, &b)) break;
        if (b.after > h) break;
        narrow(me, second, start, FINE * h, &b);
        if (b.after > 1e-3 * h) {
            part = b.after / h;
            break;
        }
        /* What rests at zero (a saturated bristle) changes its sign by rounding: that is no kink ahead. */
        for (int i = 0; i < model.n_switches; i++)
            if (start[i] * b.high[i] < 0.0) start[i] = 0.0;
    }
    step->h = 0.0;
    return part;
}

/* A time in (from, to) of the last step from which on a switching function has another sign than at its beginning, the
 * first such time where there are several; `to` if all signs at both ends are the same. `start` holds the functions at
 * the beginning if they are `known`, and on return those at `to` if that is where it ends; `smooth` receives a time
 * close before, when all signs were still the same. */
double next_kink(Instance *me, double from, double to, double *start, int *known, double *smooth) {
    static const double FINE = 1e-3; /* parts of the stretch */
    const Step *step = &me->s.step;
    const double beginning = from + 1e-9 * (to - from); /* `from` may be a kink itself */
    const int given = *known;
    *known = 0;
    *smooth = to;
    if (model.n_switches == 0 || !(beginning > from)) return to;
    double x[LENGTH(NX)];
    if (!given) {
        dense_output(step, beginning, x);
        if (switches_at(me, beginning, x, start)) return to;
    }
    double low[LENGTH(model.n_switches)], high[LENGTH(model.n_switches)];
    Bracket b = {beginning - step->t0, INFINITY, low, high};
    memcpy(low, start, sizeof low);
    if (cut(me, NULL, start, to - step->t0, &b)) return to;
    if (b.after == INFINITY) {
        *known = 1;
        memcpy(start, low, sizeof low);
        return to;
    }
    narrow(me, NULL, start, FINE * (to - from), &b);
    *smooth = step->t0 + b.before;
    return fmin(step->t0 + b.after, to);
}
