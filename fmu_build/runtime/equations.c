/* Evaluation of the model's equations; nonlinear algebraic loops are solved for y by Newton's method on the way. Compiled
 * for each model: see model_data.h. */
#include <math.h>
#include <string.h>

#include "model.h"
#include "newton.h"

const double **environment_at(Instance *me, const double *t, const double *x, const double *u) {
    State *s = &me->s;
    const double **arg = me->arg;
    arg[0] = t;
    arg[1] = x;
    arg[2] = u;
    arg[3] = s->p;
    arg[4] = s->d;
    arg[5] = s->z;
    arg[6] = s->pz;
    arg[7] = s->m;
    arg[8] = s->y;
    for (int i = 0; i < SZ_RES; i++) me->res[i] = NULL;
    if (NTRANSPORT > 0) arg[2] = with_transports(me, u);
    return arg;
}

static inline int loop_at(Instance *me, const Place *at, const double *y, double *r, int with_matrix) {
    (void)y; /* where environment_at takes it from */
    environment_at(me, &at->t, at->x, at->u);
    me->res[0] = r;
    me->res[1] = with_matrix ? me->drdy : NULL;
    return CALL(loop);
}

static inline double loop_nominal(int i) { return model.y_nominal[i]; }

static inline int factorise_matrix(Instance *me) { return FACTORISE(R, me->drdy, &me->lu_loop); }

INLINED void solve_matrix(Instance *me, double *b) { SOLVE(R, &me->lu_loop, b); }

void solve_linear_loop(Instance *me, double *b) { solve_matrix(me, b); }

static int newton(Instance *me, double t, const double *x, const double *u) {
    static const Unknowns loop = {NY, loop_nominal, loop_at, factorise_matrix, solve_matrix};
    const Place at = {t, x, u};
    double work[3 * LENGTH(NY)];
    return damped_newton(me, &loop, &at, me->s.y, work);
}

/* The model's start values of y. */
void begin_loop(Instance *me) {
    me->arg[0] = me->s.p;
    me->arg[1] = me->s.d;
    for (int i = 0; i < SZ_RES; i++) me->res[i] = NULL;
    me->res[2] = me->s.y;
    CALL(start);
}

/* Solves loop(t, x, u, ..., y) = 0 for s.y from the last solution, or else from the model's start values; 0 on success.
 * A failure leaves the last solution. */
int solve_loop(Instance *me, double t, const double *x, const double *u) {
    if (NY == 0) return 0;
    double last[LENGTH(NY)];
    memcpy(last, me->s.y, sizeof last);
    if (!newton(me, t, x, u)) return 0;
    begin_loop(me);
    if (!newton(me, t, x, u)) return 0;
    memcpy(me->s.y, last, sizeof last);
    return 1;
}

/* The input of the current integration step at time t, in me->ut. */
void input_at(Instance *me, double t) {
    const Step *step = &me->s.step;
    for (int i = 0; i < NU; i++) me->ut[i] = step->u[i] + step->du[i] * (t - step->u_time);
    if (NDELAY > 0) delayed_at(me, t, me->ut, NULL);
}

int right_hand_side(Instance *me, double t, const double *x, double *dx) {
    input_at(me, t);
    if (solve_loop(me, t, x, me->ut)) return 1;
    environment_at(me, &t, x, me->ut);
    me->res[0] = dx;
    return CALL(derivatives);
}

/* f in me->f0, and the derivatives of [f; r] by [x; y] and t, the inputs held: see `with_slopes_of_inputs`. */
int linearise(Instance *me, double t, const double *x) {
    input_at(me, t);
    if (solve_loop(me, t, x, me->ut)) return 1;
    environment_at(me, &t, x, me->ut);
    me->res[0] = me->f0;
    me->res[1] = me->jacobian;
    me->res[2] = me->by_time;
    return CALL(jacobian);
}

/* Where the algebraic loops are solved: the factors of dr/dy, and dr/dt. */
int factorise_loop(Instance *me, double t, const double *x, const double *u) {
    environment_at(me, &t, x, u);
    me->res[1] = me->drdy;
    me->res[2] = me->drdt;
    return CALL(loop) || factorise_matrix(me);
}
