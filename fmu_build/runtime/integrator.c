/* Rodas5P: a stiffly accurate Rosenbrock method of order 5 with an embedded method of order 4 and a dense output of
 * order 4 [G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia
 * Differential Equations package, BIT Numer. Math. 63:27, 2023].
 *
 * In the transformed variables k_i of Hairer and Wanner one step solves, with one LU factorisation,
 *     (I/(h gamma) - J) k_i = f(t + c_i h, x + sum a_ij k_j) + sum (C_ij/h) k_j + h d_i df/dt,
 * x1 = x + sum m_i k_i. J and df/dt are exact. Where algebraic loops r(t, x, y) = 0 take part, the matrix is that of
 * [f; r] by [x; y] (I for the states alone), which is sparse as the model is: eliminating y from it gives J. There are two error estimates of order 4 and the larger one counts: k_8,
 * and the one of Rodas5Pe [Steinebach, Rackauckas, Rosenbrock methods within OrdinaryDiffEq.jl, Proc. JuliaCon Conf.
 * 2024]. k_8 alone vanishes for what a stiff model pulls to a slow motion: the ends of a step are then exact however
 * long it is, and nothing watches what is between them. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "model.h"
#include "instance.h"

static const double GAMMA = 0.21193756319429014;
static const double A[6][5] = {
    {0},
    {3.0},
    {2.849394379747939, 0.45842242204463923},
    {-6.954028509809101, 2.489845061869568, -10.358996098473584},
    {2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946},
};
static const double C[8][7] = {
    {0},
    {-14.155112264123755},
    {-17.97296035885952, -2.859693295451294},
    {147.12150275711716, -1.41221402718213, 71.68940251302358},
    {165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306},
    {24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471},
    {30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783, -19.097331116725623,
     -28.087943162872662},
    {37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047, -40.06618937091002,
     -54.66780262877968, -9.48861652309627},
};
static const double NODE[8] = {0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664,
                               1.0, 1.0, 1.0};
static const double D[8] = {0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
                            2.325825639765069, 0.0, 0.0, 0.0};
static const double E[8] = {0.2606326497975715, -0.005158627295444251, 1.3038988631109731, 1.235000722062074,
                            -0.7931985603795049, -1.005448461135913, -0.18044626132120234, 0.17051519239113755};

/* Below this a scale is taken for zero: states without nominal value are resolved relative to their own size. */
static const double SMALLEST_SCALE = 1e-6;

/* As fmax, for the loops over all states: compilers may not inline what libm does with zeros. A NaN is passed over. */
static inline double larger(double a, double b) { return a > b || isnan(b) ? a : b; }

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

/* Absolute error of x[i] that counts as one. */
static double tolerance_of(const State *s, int i, double x) {
    const double scale = model.x_scale[i] > 0.0 ? model.x_scale[i] : larger(SMALLEST_SCALE, s->step.size[i]);
    return s->tolerance * larger(scale, fabs(x));
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

/* Estimate of the local error of x[i] in the last attempt. */
static inline double estimate(const Step *step, int i) {
    double other = 0.0;
    for (int j = 0; j < STAGES; j++) other += E[j] * step->k[j][i];
    return larger(fabs(step->k[7][i]), fabs(other));
}

/* The matrix of a step of size h. */
static int factorise_step(Instance *me, double h) {
    double *restrict matrix = me->matrix;
    for (int k = 0; k < model.J.nonzeros; k++) matrix[k] = -me->jacobian[k];
    for (int i = 0; i < NX; i++) matrix[model.J.diagonal[i]] += 1.0 / (h * GAMMA);
    return FACTORISE(J, matrix, &me->lu_step);
}

/* Stages, x1 and error estimate of one step; the largest error in units of the tolerance, NaN if a stage failed. */
static double try_step(Instance *me, double t, double h) {
    Step *step = &me->s.step;
    const double *x = step->x0;
    double *const *k = step->k;
    double argument[LENGTH(NX)], *x1 = step->x1, both[LENGTH(NX + NY)];
    if (factorise_step(me, h)) return NAN;
    for (int stage = 0; stage < STAGES; stage++) {
        double *restrict b = NY > 0 ? both : k[stage];
        if (stage == 0) {
            memcpy(b, me->f0, NX * sizeof *b);
        } else {
            if (stage < 6) {
                memcpy(argument, x, NX * sizeof *x);
                for (int j = 0; j < stage; j++)
                    for (int i = 0; i < NX; i++) argument[i] += A[stage][j] * k[j][i];
            } else {
                for (int i = 0; i < NX; i++) argument[i] += k[stage - 1][i];
            }
            if (right_hand_side(me, t + NODE[stage] * h, argument, b)) return NAN;
            for (int j = 0; j < stage; j++) {
                const double weight = C[stage][j] / h;
                for (int i = 0; i < NX; i++) b[i] += weight * k[j][i];
            }
        }
        for (int i = NX; i < NX + NY; i++) b[i] = 0.0;
        if (D[stage] != 0.0)
            for (int i = 0; i < NX + NY; i++) b[i] += h * D[stage] * me->by_time[i];
        SOLVE(J, &me->lu_step, b);
        if (NY > 0) memcpy(k[stage], both, NX * sizeof *both);
    }
    double error = 0.0;
    for (int i = 0; i < NX; i++) {
        x1[i] = argument[i] + k[7][i];
        const double e = estimate(step, i) / tolerance_of(&me->s, i, larger(fabs(x[i]), fabs(x1[i])));
        if (!(e <= error)) error = e; /* keeps a NaN */
        if (!isfinite(x1[i])) error = NAN;
        if (isnan(error)) break;
    }
    return error;
}

/* Name of the state with the largest share in the error of the last attempt. */
static const char *culprit(const Instance *me) {
    const Step *step = &me->s.step;
    int worst = 0;
    double largest = -1.0;
    for (int i = 0; i < NX; i++) {
        const double e = estimate(step, i) / tolerance_of(&me->s, i, step->x0[i]);
        if (!(e <= largest)) worst = i, largest = e;
        if (isnan(e)) break;
    }
    return model.x_name[worst];
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
    memcpy(step->x0, step->x1, BYTES(NX));
    step->t0 = t;
    step->h = 0.0;
    for (int i = 0; i < NX; i++) step->size[i] = larger(step->size[i], fabs(step->x0[i]));

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
    if (linearise(me, t, step->x0))
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
