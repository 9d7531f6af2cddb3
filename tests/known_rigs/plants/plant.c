/* Runs of a plant: classical Runge-Kutta on a fixed grid, inputs held from sample to sample. */
#include "plant.h"
#include <string.h>

static const Plant *const plants[] = {&belt_axis, &thermal_block, &circuit, &tanks};

enum {
    VISCOUS, COULOMB, STRIBECK, ASYMMETRY, QUADRATIC, COGGING, WEIGHT, PENDULUM_WEIGHT, PRESLIDING, POSITION_FRICTION,
    THERMAL_FRICTION, LOAD_FRICTION, LEAKAGE, LOSS, RADIATION, OUTFLOW, CAPACITY, HARDENING, HYSTERESIS, BACKLASH, VOLTAGE_DROP,
    RESONATOR, WEAR, PULSATION, RELAY, CHAOS, PRODUCT, SLIP, KINDS
};
static const char *const names[] = {
    "viscous", "coulomb", "stribeck", "asymmetry", "quadratic", "cogging", "weight", "pendulum_weight", "presliding",
    "position_friction", "thermal_friction", "load_friction", "leakage", "loss", "radiation", "outflow", "capacity",
    "hardening", "hysteresis", "backlash", "voltage_drop", "resonator", "wear", "pulsation", "relay", "chaos", "product", "slip"};

const char *extra_name(int kind) { return kind < KINDS ? names[kind] : 0; }

static double sign_of(double v, double narrow) { return v / sqrt(v * v + narrow * narrow); }

static double flow_of(const Moment *at, const Extra *e, const double *z, double *dz, double p, double v, double load) {
    /* Friction sticks; brushes and diodes start to conduct more gently. */
    const double s = e->size, narrow = (e->kind == VOLTAGE_DROP ? 5e-3 : 5e-4) * e->rate, way = sign_of(v, narrow);
    switch ((int)e->kind) {
    case VISCOUS: return s * v;
    case VOLTAGE_DROP: /* of a current */
    case COULOMB: return s * way;
    case STRIBECK: return s * way / (1.0 + (v / e->shape) * (v / e->shape));
    case ASYMMETRY: return s * fabs(way);
    case QUADRATIC: return s * v * fabs(v);
    case COGGING: return s * sin(e->shape * p + 0.7);
    case WEIGHT: return s;
    case PENDULUM_WEIGHT: return s * sin(p);
    case PRESLIDING:
    case HYSTERESIS: dz[0] = (v - fabs(v) * z[0]) / e->shape; return s * z[0];
    case POSITION_FRICTION: return s * cos(p - 0.6) * way;
    case THERMAL_FRICTION: dz[0] = (v * v / (e->rate * e->rate) - z[0]) / e->shape; return s * z[0] * v;
    case LOAD_FRICTION: return s * fabs(load) * way;
    case LEAKAGE: return s * p;
    case LOSS: return s * (p - at->zero);
    case RADIATION: return s * (pow(p, 4) - pow(at->zero, 4));
    case OUTFLOW: return s * p / sqrt(fabs(p) + 1e-4 * e->range);
    case CAPACITY: dz[0] = (p - at->zero - z[0]) / e->shape; return s * dz[0];
    case HARDENING: return s * p * p * p;
    /* From here on what no catalogue has. */
    case RESONATOR: /* a hidden mass on a spring; shape is its angular frequency */
        dz[0] = z[1];
        dz[1] = e->shape * e->shape * (p - at->zero - z[0]) - 0.1 * e->shape * z[1];
        return s * (p - at->zero - z[0]);
    case WEAR: dz[0] = fabs(v) / (e->rate * e->duration); return s * z[0] * z[0] * sign_of(v, 0.1 * e->rate);
    case PULSATION: return s * sin(2.0 * M_PI * e->shape * at->t / e->duration + 1.0);
    case RELAY: /* two states, each of which holds itself until the speed drives it over */
        dz[0] = (tanh(2.0 * z[0] + 4.0 * v / e->rate) - z[0]) / e->shape;
        return s * z[0];
    case CHAOS: { /* Lorenz 1963, driven by the place; it starts off its fixed points */
        const double x = z[0] + 1.0, y = z[1] + 1.0, w = z[2] + 20.0, fast = 1.0 / e->shape;
        dz[0] = fast * 10.0 * (y - x);
        dz[1] = fast * (x * (28.0 - w) - y + 3.0 * (p - at->zero) / e->range);
        dz[2] = fast * (x * y - 8.0 / 3.0 * w);
        return s * x / 10.0;
    }
    case PRODUCT: return s * (p - at->zero) / e->range * v / e->rate * (p - at->zero) / e->range;
    case SLIP: return at->t > e->shape * e->duration ? s : 0.0;
    }
    return 0.0;
}

double extra_flow(const Moment *at, int place, double p, double v, double load) {
    double sum = 0.0;
    for (int k = 0; k < at->count; k++)
        if ((int)at->extras[k].place == place)
            sum += flow_of(at, at->extras + k, at->z + HIDDEN * k, at->dz + HIDDEN * k, p, v, load);
    return sum;
}

double after_play(const Moment *at, int place, double stretch) {
    for (int k = 0; k < at->count; k++)
        if ((int)at->extras[k].place == place && (int)at->extras[k].kind == BACKLASH)
            stretch = beyond(stretch, at->extras[k].size);
    return stretch;
}

/* y: (samples, outputs). An input acts `delay` s late and behind a first-order `lag`, settled in the beginning.
   Returns the sample at which something is not finite, -1 if none is. */
long plant_run(int number, const double *p, double zero, int count, const Extra *extras, long samples, int substeps,
               double dt, const double *u, const double *lag, const double *delay, double *y) {
    const Plant *plant = plants[number];
    const int n = plant->states + HIDDEN * count, m = plant->inputs;
    double x[MOST_STATES] = {0.0}, slopes[4][MOST_STATES], now[MOST_STATES], acting[8], behind[8];
    const double h = dt / substeps, ahead[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    memcpy(behind, u, sizeof(double) * m);
    Moment at = {p, u, extras, count, 0.0, zero, x + plant->states, 0};
    plant->start(&at, x);
    for (long k = 0;; k++) {
        at.t = k * dt, at.u = u + k * m, at.z = x + plant->states;
        plant->read(&at, x, y + k * plant->outputs);
        for (int i = 0; i < plant->outputs; i++)
            if (!isfinite(y[k * plant->outputs + i]))
                return k;
        if (k == samples - 1)
            return -1;
        for (int s = 0; s < substeps; s++) {
            double held[8];
            for (int i = 0; i < m; i++) {
                /* Mean over the step, so that results follow the delay continuously. */
                const double from = k + (double)s / substeps - delay[i] / dt, to = from + 1.0 / substeps;
                const double change = fmax(floor(to), from), after = (to - change) * substeps;
                const long first = (long)floor(from), last = (long)floor(to);
                held[i] = first == last ? u[(first < 0 ? 0 : first) * m + i]
                                        : (1.0 - after) * u[(first < 0 ? 0 : first) * m + i] +
                                              after * u[(last < 0 ? 0 : last) * m + i];
            }
            for (int j = 0; j < 4; j++) {
                memset(slopes[j], 0, sizeof slopes[j]);
                for (int i = 0; i < n; i++)
                    now[i] = x[i] + (j ? ahead[j] * h * slopes[j - 1][i] : 0.0);
                for (int i = 0; i < m; i++)
                    acting[i] = lag[i] > 0.0 ? held[i] + (behind[i] - held[i]) * exp(-ahead[j] * h / lag[i]) : held[i];
                at.t = k * dt + (s + ahead[j]) * h, at.u = acting;
                at.z = now + plant->states, at.dz = slopes[j] + plant->states;
                plant->slope(&at, now, slopes[j]);
            }
            for (int j = 0; j < 4; j++)
                for (int i = 0; i < n; i++)
                    x[i] += h / 6.0 * weight[j] * slopes[j][i];
            memcpy(behind, acting, sizeof(double) * m);
        }
    }
}
