/* Evaluations of the model that take little of the time of steps. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* The environment with the direction as further arguments, from arg[first] on. */
void environment_along(Instance *me, const double *t, const double *x, const double *u, const Direction *s,
                       int first) {
    environment_at(me, t, x, u);
    const double *const seeds[] = {s->x, s->u, s->p, s->d, s->y, s->z, s->pz, &s->t};
    for (int i = 0; i < 8; i++) me->arg[first + i] = seeds[i];
}

/* The same of loop_partials, which have no seed of y. */
void loop_environment_along(Instance *me, const double *t, const double *x, const double *u,
                            const Direction *s) {
    environment_along(me, t, x, u, s, 9);
    me->arg[13] = s->z;
    me->arg[14] = s->pz;
}

/* The derivatives of f along a direction into s->dx, and of r into s->y, y held. */
int partials_along(Instance *me, double t, const double *x, const double *u, Direction *s) {
    memset(s->y, 0, BYTES(NY));
    environment_along(me, &t, x, u, s, 9);
    me->res[0] = s->dx;
    if (CALL(partials)) return 1;
    if (NY == 0) return 0;
    loop_environment_along(me, &t, x, u, s);
    me->res[0] = s->y;
    return CALL(loop_partials);
}

static inline int moving(const double *du) {
    int ramp = 0;
    for (int i = 0; i < NU; i++) ramp |= du[i] != 0.0;
    return ramp;
}

/* Adds what slopes of the inputs do to the derivatives by t, where `linearise` was called last. */
int with_slopes_of_inputs(Instance *me, double t, const double *x) {
    if (NDELAY == 0 && !moving(me->s.step.du)) return 0;
    DIRECTION(s);
    memcpy(s.u, me->s.step.du, BYTES(NU));
    if (NDELAY > 0) delayed_at(me, t, me->ut, s.u);
    if (!moving(s.u)) return 0;
    if (partials_along(me, t, x, me->ut, &s)) return 1;
    for (int i = 0; i < NX; i++) me->by_time[i] += s.dx[i];
    for (int i = 0; i < NY; i++) me->by_time[NX + i] += s.y[i];
    return 0;
}

/* x'' where `linearise` was called last. */
int second_derivatives(Instance *me, double t, const double *x, double *second) {
    const Pattern *j = &model.J;
    double sum[LENGTH(NX + NY)];
    memcpy(sum, me->by_time, sizeof sum);
    for (int column = 0; column < NX; column++)
        for (int k = j->start[column]; k < j->start[column + 1]; k++) sum[j->row[k]] += me->jacobian[k] * me->f0[column];
    if (NY > 0) { /* y' */
        if (solve_loop(me, t, x, me->ut) || factorise_loop(me, t, x, me->ut)) return 1;
        SOLVE(R, &me->lu_loop, sum + NX);
        for (int column = NX; column < NX + NY; column++)
            for (int k = j->start[column]; k < j->start[column + 1]; k++)
                if (j->row[k] < NX) sum[j->row[k]] -= me->jacobian[k] * sum[column];
    }
    memcpy(second, sum, NX * sizeof *second);
    return 0;
}

/* Truth of every relation at (t, x, u) with the present m, z and y; within `slack` of its threshold it is as in m. */
void relations_within(Instance *me, double slack, double t, const double *x, const double *u, double *m) {
    ZEROS(g, NM);
    environment_at(me, &t, x, u);
    me->res[0] = g;
    CALL(indicators);
    for (int i = 0; i < NM; i++)
        m[i] = fabs(g[i]) <= slack ? me->s.m[i] : model.inclusive[i] ? g[i] >= 0.0 : g[i] > 0.0;
}

void relations(Instance *me, double t, const double *x, const double *u, double *m) {
    relations_within(me, -1.0, t, x, u, m); /* no such tolerance */
}

/* Whether an input has changed between communication points, before the event iteration of the next step. */
static inline int relations_are_late(const Instance *me) {
    return me->s.input_event && NM > 0 && me->s.phase == PHASE_STEP;
}

/* For reading variables the relations follow it at once, the discrete variables do not. `kept` receives the old ones. */
int relations_for_input(Instance *me, double *kept) {
    State *s = &me->s;
    memcpy(kept, s->m, BYTES(NM));
    if (!relations_are_late(me)) return 0;
    for (int round = 0; round < 10; round++) {
        ZEROS(m, NM);
        if (solve_loop(me, s->t, s->x, s->u)) return 1;
        relations(me, s->t, s->x, s->u, m);
        if (!memcmp(m, s->m, sizeof m)) break;
        memcpy(s->m, m, sizeof m);
    }
    return 0;
}

/* Evaluates a function of the model at the present point, unless its values are there. */
static int evaluate(Instance *me, int *have, double *values, ModelFunction function) {
    State *s = &me->s;
    if (*have) return 0;
    double kept[LENGTH(NM)];
    const int late = relations_are_late(me);
    int failed = (late && relations_for_input(me, kept)) || solve_loop(me, s->t, s->x, s->u);
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = values;
    failed = failed || function(me->arg, me->res, me->iw, me->w, s->laws);
    if (late) memcpy(s->m, kept, sizeof kept);
    *have = !failed;
    return failed;
}

int evaluate_derivatives(Instance *me) { return evaluate(me, &me->s.have_dx, me->s.dx, model_derivatives); }

int evaluate_variables(Instance *me) { return evaluate(me, &me->s.have_v, me->s.v, model_variables); }
