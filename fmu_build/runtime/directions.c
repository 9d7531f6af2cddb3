/* Derivatives along directions of what equations.c evaluates. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* Derivatives of the algebraic loops' unknowns along a direction, into s->y; leaves y itself solved. */
static int loops_along(Instance *me, double t, const double *x, const double *u, Direction *s) {
    if (NY == 0) return 0;
    if (solve_loop(me, t, x, u) || factorise_loop(me, t, x, u)) return 1;
    loop_environment_along(me, &t, x, u, s);
    me->res[0] = s->y;
    if (CALL(loop_partials)) return 1;
    for (int i = 0; i < NY; i++) s->y[i] = -(s->t != 0.0 ? s->y[i] + s->t * me->drdt[i] : s->y[i]); /* no 0 * inf */
    SOLVE(R, &me->lu_loop, s->y);
    return 0;
}

/* Prepares a call at (*t, x, u) along a direction, with s->y, and with its result in `along`. */
static int prepare_along(Instance *me, const double *t, const double *x, const double *u, Direction *s, double *along) {
    if (loops_along(me, *t, x, u, s)) return 1;
    environment_along(me, t, x, u, s, 9);
    me->res[0] = along;
    return 0;
}

/* Exact derivatives of the indicators along a direction at (t, x, u), into g, with s->y. */
int indicators_along(Instance *me, double t, const double *x, const double *u, Direction *s, double *g) {
    return prepare_along(me, &t, x, u, s, g) || CALL(indicator_partials);
}

/* The same of what an update gives at the present point, [z; x; next_event], into `updated`. */
int update_along(Instance *me, double initial, Direction *s, double *updated) {
    const State *now = &me->s;
    if (loops_along(me, now->t, now->x, now->u, s)) return 1;
    environment_along(me, &now->t, now->x, now->u, s, 10);
    me->arg[9] = &initial;
    me->res[0] = updated;
    return CALL(update_partials);
}

/* Exact derivatives of dx along a direction at (t, x, u), into s->dx (and s->y). */
int derivatives_along(Instance *me, double t, const double *x, const double *u, Direction *s) {
    return prepare_along(me, &t, x, u, s, s->dx) || CALL(partials);
}

/* Values of what is delayed, and their slopes along the motion with inputs of slopes du. */
int delayed_expressions(Instance *me, double t, const double *x, const double *u, const double *du, double *value,
                        double *slope) {
    DIRECTION(s);
    s.t = 1.0;
    memcpy(s.u, du, BYTES(NU));
    if (solve_loop(me, t, x, u)) return 1;
    environment_at(me, &t, x, u);
    me->res[0] = s.x;
    if (CALL(derivatives)) return 1;
    environment_at(me, &t, x, u);
    double both[NDELAYED];
    me->res[0] = both;
    if (CALL(delayed)) return 1;
    memcpy(value, both, NPAST * sizeof *value);
    if (prepare_along(me, &t, x, u, &s, both) || CALL(delayed_partials)) return 1;
    memcpy(slope, both, NPAST * sizeof *slope);
    return 0;
}

/* Derivatives along a direction of what is delayed, of the delays and of initial contents, NDELAYED numbers. */
int delayed_along(Instance *me, double t, const double *x, const double *u, Direction *s, double *along) {
    return prepare_along(me, &t, x, u, s, along) || CALL(delayed_partials);
}

/* The same of v, into s->v; s->y is that of `derivatives_along` at the same point. */
int variables_along(Instance *me, double t, const double *x, const double *u, Direction *s) {
    environment_along(me, &t, x, u, s, 9);
    me->res[0] = s->v;
    return CALL(variable_partials);
}

/* Derivative of the calculated parameters in the direction sp. */
int dependent_parameters_along(Instance *me, const double *sp, double *sd) {
    me->arg[0] = me->s.p;
    me->arg[1] = sp;
    me->res[0] = sd;
    return model_dependent_partials(me->arg, me->res, me->iw, me->w, 0);
}

/* Derivative of the start values [x; z] along s->p and s->d. */
static int starts_along(Instance *me, const Direction *s, double *starts) {
    const double *const arguments[] = {me->s.p, me->s.d, s->p, s->d};
    for (int i = 0; i < 4; i++) me->arg[i] = arguments[i];
    me->res[0] = starts;
    return model_start_partials(me->arg, me->res, me->iw, me->w, 0);
}

/* The same of the discrete variables alone, into s->z and s->pz. */
int discrete_starts_along(Instance *me, Direction *s) {
    double starts[LENGTH(NX + NZ)];
    if (NZ == 0) return 0;
    if (starts_along(me, s, starts)) return 1;
    memcpy(s->z, starts + NX, BYTES(NZ));
    memcpy(s->pz, starts + NX, BYTES(NZ));
    return 0;
}

/* Derivative of the initial state along s->u, s->p, s->d, s->z, s->pz and the start values that were or can be set,
 * into s->x. */
int initial_states_along(Instance *me, const double *start, Direction *s) {
    const int N = NX + NY;
    const State *now = &me->s;
    double r[LENGTH(N)];
    ZEROS(sxs, NX + NZ);
    if (starts_along(me, s, sxs)) return 1;
    for (int i = 0; i < NX; i++) s->x[i] = now->xs_set[i] ? start[i] : sxs[i] + start[i];
    if (!model.has_initial) return 0;
    memcpy(sxs, s->x, BYTES(NX));
    environment_at(me, &now->t, now->x, now->u);
    me->arg[9] = now->xs;
    me->res[0] = NULL;
    me->res[1] = me->initial;
    if (CALL(initial) || factorise_initial(me)) return 1;
    environment_at(me, &now->t, now->x, now->u);
    const double *const seeds[] = {now->xs, s->u, s->p, s->d, sxs, s->z, s->pz};
    for (int i = 0; i < 7; i++) me->arg[9 + i] = seeds[i];
    me->res[0] = r;
    if (model_initial_partials(me->arg, me->res, me->iw, me->w, 0)) return 1;
    solve_linear_initial(me, r);
    for (int i = 0; i < NX; i++) s->x[i] = -r[i];
    return 0;
}
