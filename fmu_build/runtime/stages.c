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

/* Absolute error of x[i] that counts as one. */
double tolerance_of(const State *s, int i, double x) {
    const double scale = model.x_scale[i] > 0.0 ? model.x_scale[i] : larger(SMALLEST_SCALE, s->step.size[i]);
    return s->tolerance * larger(scale, fabs(x));
}

/* The next step begins where the last one ends. */
void begin_step(Step *step) {
    step->t0 = step->t1;
    step->h = 0.0;
    for (int i = 0; i < NX; i++) {
        step->x0[i] = step->x1[i];
        step->size[i] = larger(step->size[i], fabs(step->x0[i]));
    }
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
double try_step(Instance *me, double t, double h) {
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
const char *culprit(const Instance *me) {
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
