/* Plants of the blind check: networks of stores and branches by nodal assembly, classical Runge-Kutta on a fixed grid.

   Every node has a potential (speed, voltage, temperature, pressure, level) and a store, unless an input drives it.
   Elements carry flows between nodes. Effects, in shapes of their own, act at nodes and in elements. */
#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846

enum { COND, SPRING, COIL, VALVE, MOTOR, GEAR, PISTON, HEATER, STREAM, IN, DRAG, DRY };
/* Where effects act: flow out of a node; flow through an element besides; a drop of an element's potential; a factor
   on an element's parameter. */
enum { AT_NODE, BESIDE, DROP, VARIES };
enum {
    VISCOUS, COULOMB, STRIBECK, ASYMMETRY, QUADRATIC, PRESLIDING, COGGING, WEIGHT, HARDENING, HYSTERESIS, BACKLASH,
    LEAKAGE, CAPACITY, LOSS, RADIATION, OUTFLOW, OVERFLOW, VOLTAGE_DROP, EDDY, COEFFICIENT,
    RESONATOR, WEAR, PULSATION, RELAY, CHAOS, SLIP
};
#define HIDDEN 4   /* states of an effect */
#define STATES 96
#define PARAMETERS 4

typedef struct { double kind, a, b, c, u, p[PARAMETERS]; } Element;
/* scale: usual size of its variable, rate: of its rate; gate: over (1) or under (-1) a threshold, on the potential (at
   a node) or the absolute rate; u: of a coefficient, where its variable comes from. */
typedef struct { double law, shape, target, where, size, s1, s2, scale, rate, zero, gate, threshold, source, index; } Effect;

typedef struct {
    int nodes, elements, effects, inputs, columns;
    const double *capacity, *driven, *mechanical; /* driven: input or -1; mechanical: 1 where a position counts */
    const Element *element;
    const Effect *effect;
    double duration;
} Plant;

static double sgn(double x) { return (x > 0.0) - (x < 0.0); }
static double soft(double x, double w) { return x / sqrt(x * x + w * w); }
static double power(double x, double n, double w) { return x * pow(x * x + w * w, 0.5 * (n - 1.0)); }
static double beyond(double x, double gap) { return x > gap ? x - gap : x < -gap ? x + gap : 0.0; }
static double softplus(double x, double w) { return x > 30.0 * w ? x : x < -30.0 * w ? 0.0 : w * log1p(exp(x / w)); }

/* Dry friction with a standstill in which it holds whatever acts (Karnopp 1985). */
static double karnopp(double v, double size, double band, double acting) {
    return fabs(v) < band ? fmax(-size, fmin(size, acting)) : size * sgn(v);
}

/* Elements in series of a spring and a slider, each with its own limit (Maxwell, Iwan); z are their deflections. */
static double slipping(const double *z, double *dz, double rate, double yield, int count) {
    double sum = 0.0;
    for (int j = 0; j < count; j++) {
        const double limit = yield * (0.4 + 0.4 * j);
        const double full = z[j] / limit;
        dz[j] = rate * full > 0.0 ? rate * (1.0 - pow(fmin(fabs(full), 1.0), 8.0)) : rate;
        sum += full / count;
    }
    return sum;
}

static double tabulated(double v, double speed) { /* a Stribeck curve read from a table of a data sheet */
    static const double at[] = {0.0, 0.25, 0.5, 1.0, 1.7, 2.8, 5.0}, value[] = {1.0, 0.94, 0.8, 0.45, 0.2, 0.06, 0.0};
    const double x = fabs(v) / speed;
    for (int k = 1; k < 7; k++)
        if (x < at[k])
            return value[k - 1] + (value[k] - value[k - 1]) * (x - at[k - 1]) / (at[k] - at[k - 1]);
    return 0.0;
}

typedef struct { double p, rate, position, through, acting, t, duration; } Moment;

/* Shape 0 is the catalogue's own; the check uses the others, and 0 in a stratum of its own. */
static double law(const Effect *e, const Moment *m, const double *z, double *dz) {
    const int shape = (int)e->shape;
    const double s = e->size, v = m->rate, p = m->p - e->zero, narrow = 1e-3 * e->rate;
    switch ((int)e->law) {
    case VISCOUS: return s * (shape == 0 ? v : shape == 1 ? power(v, 1.15, narrow) * pow(e->rate, -0.15) : e->rate * asinh(v / e->rate));
    case COULOMB:
        return shape == 0 ? s * tanh(v / narrow) : shape == 1 ? karnopp(v, s, narrow, m->acting)
             : shape == 2 ? s * soft(v, 2.0 * narrow) : s * 2.0 / PI * atan(v / narrow);
    case STRIBECK:
        switch (shape) {
        case 0: return s * tanh(v / narrow) / (1.0 + pow(v / e->s1, 2.0));
        case 1: return s * soft(v, 2.0 * narrow) * tabulated(v, e->s1);
        case 2: return s * soft(v, narrow) * exp(-pow(fabs(v) / e->s1, 0.8));
        default: return karnopp(v, s * exp(-pow(v / e->s1, 2.0)), narrow, m->acting);
        }
    case ASYMMETRY:
        return shape == 0 ? s * pow(tanh(v / (1e-2 * narrow)), 2.0) : shape == 1 ? s * (1.0 - exp(-pow(v / (2.0 * narrow), 2.0)))
             : s * fabs(v) / (fabs(v) + narrow);
    case QUADRATIC:
        return shape == 0 ? s * v * fabs(v) : shape == 1 ? s * power(v, 1.85, narrow) * pow(e->rate, 0.15)
             : s * v * (sqrt(v * v + 0.04 * e->rate * e->rate) - 0.2 * e->rate);
    case PRESLIDING:
    case HYSTERESIS:
        switch (shape) {
        case 0: dz[0] = (v - fabs(v) * z[0]) / e->s1; return s * z[0];
        case 1: return s * slipping(z, dz, v, e->s1, 4); /* generalised Maxwell slip */
        case 2: { /* Dahl with another exponent; Bouc and Wen with n = 2 */
            const double full = fmin(fabs(z[0]), 1.0);
            dz[0] = (v - v * pow(full, (int)e->law == PRESLIDING ? 1.5 : 2.0) * (v * z[0] > 0.0)) / e->s1;
            return s * z[0];
        }
        default: { /* elasto-plastic bristles, Preisach-like play in two steps */
            for (int j = 0; j < 2; j++) {
                const double full = fabs(z[j]) / (0.5 + j);
                dz[j] = (v - (v * z[j] > 0.0 && full > 0.7 ? v * fmin((full - 0.7) / 0.3, 1.0) : 0.0)) / e->s1;
            }
            return s * (z[0] + z[1]) / 2.0;
        }
        }
    case COGGING: {
        const double x = e->s1 * m->position + e->s2;
        return shape == 0 ? s * sin(x) : shape == 1 ? s * tanh(2.0 * sin(x)) : shape == 2 ? s * (sin(x) + 0.25 * sin(2.0 * x + 1.0))
             : s * asin(0.98 * sin(x));
    }
    case WEIGHT: { /* s1: 1 where it turns */
        const double x = m->position, far = x / e->scale;
        return e->s1 > 0.5 ? s * (sin(x) + (shape == 0 ? 0.0 : shape == 1 ? 0.08 * sin(2.0 * x + 0.5) : 0.06 * sin(3.0 * x)))
                           : s * (1.0 + (shape == 0 ? 0.0 : 0.05 * (shape == 1 ? tanh(far) : far * far)));
    }
    case HARDENING: {
        const double x = p / e->scale;
        return shape == 0 ? s * x * x * x : shape == 1 ? s * (sinh(2.0 * x) - 2.0 * x) / 2.0
             : shape == 2 ? s * (softplus(x - 0.4, 0.05) - softplus(-x - 0.4, 0.05)) : s * x * fabs(x) * (1.0 + x * x);
    }
    case BACKLASH: /* returns what is left of the deflection, less the deflection */
        return (shape == 0 ? beyond(p, s) : shape == 1 ? softplus(p - s, 0.1 * s + 1e-300) - softplus(-p - s, 0.1 * s + 1e-300)
              : p * pow(1.0 - 1.0 / (1.0 + pow(p / (s + 1e-300), 6.0)), 0.5)) - p;
    case LEAKAGE: return s * (shape == 0 ? p : shape == 1 ? power(p, 1.15, 1e-3 * e->scale) * pow(e->scale, -0.15) : e->scale * sinh(p / e->scale) / 1.1752);
    case CAPACITY: /* a store behind a resistance: one, a chain of two, one that is larger where it is full */
        dz[0] = (m->p - e->zero - z[0]) / e->s1;
        if (shape == 1) {
            dz[0] += (z[1] - z[0]) / e->s1;
            dz[1] = (z[0] - z[1]) / (2.0 * e->s1);
        } else if (shape == 2)
            dz[0] /= 1.0 + 0.5 * tanh(z[0] / e->scale);
        return s * (m->p - e->zero - z[0]) / e->s1;
    case LOSS:
        return shape == 0 ? s * p : shape == 1 ? s * power(p, 1.25, 1e-3 * e->scale) * pow(e->scale, -0.25)
             : shape == 2 ? s * p * (1.0 + 0.15 * tanh(p / e->scale)) : s * (0.8 * p + 0.2 * p * fabs(p) / e->scale);
    case RADIATION: {
        const double t4 = pow(m->p, 4.0) - pow(e->zero, 4.0), full = pow(e->zero + e->scale, 4.0) - pow(e->zero, 4.0);
        return shape == 0 ? s * t4 / full : shape == 1 ? s * t4 / full * (m->p / (e->zero + 0.5 * e->scale))
             : s * t4 / full * (1.0 - 0.1 * p / e->scale);
    }
    case OUTFLOW: return s * (shape == 0 ? power(m->p, 0.5, 1e-4 * e->scale) : shape == 1 ? power(m->p, 0.58, 1e-3 * e->scale) * pow(e->scale, -0.08) : power(m->p, 0.5, 0.05 * e->scale));
    case OVERFLOW: { /* s1: the rim */
        const double over = m->p - e->s1;
        return shape == 0 ? s * fmax(over, 0.0) : shape == 1 ? s * pow(fmax(over, 0.0), 1.5) / sqrt(0.1 * e->scale) : s * softplus(over, 0.01 * e->scale);
    }
    case VOLTAGE_DROP: {
        const double i = m->through, knee = 0.05 * e->scale;
        return shape == 0 ? s * tanh(i / (0.01 * e->scale)) : shape == 1 ? s * asinh(i / (0.1 * knee)) / asinh(e->scale / (0.1 * knee))
             : shape == 2 ? (fabs(i) > knee ? s * sgn(i) : s * (2.0 * i / knee - i * fabs(i) / (knee * knee))) /* Shichman and Hodges */
             : s * soft(i, 0.3 * knee);
    }
    case EDDY: { /* a shorted turn around a coil; in shape 1 two of them; in shape 2 one that grows warm */
        const double i = m->through - z[0];
        dz[0] = i / e->s1;
        dz[1] = (m->through - z[1]) / (4.0 * e->s1);
        return s * i * (shape == 2 ? 1.0 - 0.3 * tanh(fabs(i) / e->scale) : 1.0) + (shape == 1 ? 0.4 * s * (m->through - z[1]) : 0.0);
    }
    /* From here on what no catalogue has. */
    case RESONATOR:
        dz[0] = z[1];
        dz[1] = e->s1 * e->s1 * (p - z[0]) - 0.1 * e->s1 * z[1];
        return s * (p - z[0]) / e->scale;
    case WEAR: dz[0] = fabs(v) / (e->rate * m->duration); return s * z[0] * z[0] * soft(v, 0.1 * e->rate);
    case PULSATION: return s * sin(2.0 * PI * e->s1 * m->t / m->duration + e->s2);
    case RELAY: dz[0] = (tanh(2.0 * z[0] + 4.0 * v / e->rate) - z[0]) / e->s1; return s * z[0];
    case CHAOS: { /* Lorenz 1963, driven by the place */
        const double x = z[0] + 1.0, y = z[1] + 1.0, w = z[2] + 20.0, fast = 1.0 / e->s1;
        dz[0] = fast * 10.0 * (y - x);
        dz[1] = fast * (x * (28.0 - w) - y + 3.0 * p / e->scale);
        dz[2] = fast * (x * y - 8.0 / 3.0 * w);
        return s * x / 10.0;
    }
    case SLIP: return m->t > e->s1 * m->duration ? s : 0.0;
    }
    return 0.0;
}

static double gated(const Effect *e, double p, double rate) {
    if (e->gate == 0.0)
        return 1.0;
    const double x = fabs(e->gate) > 1.5 ? fabs(rate) : p;
    return 0.5 * (1.0 + tanh((e->gate > 0 ? 1.0 : -1.0) * (x - e->threshold) / (0.03 * (fabs(e->gate) > 1.5 ? e->rate : e->scale))));
}

static double shaped(const Effect *e, double x) { /* how a coefficient varies, 0 at its variable's zero */
    switch ((int)e->shape) {
    case 0: return e->size * x;
    case 1: return e->size * x / (1.0 + 0.5 * fabs(x));
    case 2: return e->size * x * (1.0 + 0.25 * fabs(x));
    case 3: return e->size * sinh(x) / 1.1752;
    case 4: return e->size * 0.5 * (1.0 + soft(x - 0.5, 0.15));
    default: return e->size * fabs(x); /* of a speed, as another name for a law */
    }
}

/* State: potentials, positions, states of elements, hidden states of effects. */
static void slopes(const Plant *P, double t, const double *x, const double *u, const double *columns, double *dx) {
    const int n = P->nodes, first = 2 * n, hidden = 2 * n + P->elements;
    double net[STATES] = {0.0}, p[STATES], late[STATES] = {0.0}, factor[STATES][PARAMETERS];
    int sticking[STATES];
    memset(dx, 0, sizeof(double) * (hidden + HIDDEN * P->effects));
    for (int k = 0; k < n; k++) {
        p[k] = P->driven[k] >= 0.0 ? u[(int)P->driven[k]] : x[k];
        sticking[k] = -1;
    }
    for (int k = 0; k < P->elements; k++)
        for (int j = 0; j < PARAMETERS; j++)
            factor[k][j] = 1.0;
    for (int k = 0; k < P->effects; k++) {
        const Effect *e = P->effect + k;
        if ((int)e->target != VARIES)
            continue;
        const int from = (int)e->index;
        double *z = dx + hidden + HIDDEN * k, value = 0.0;
        switch ((int)e->source) {
        case 0: value = (p[from] - e->zero) / e->scale; break;
        case 1: value = (columns[from] - e->zero) / e->scale; break;
        case 2: value = t / P->duration; break;
        case 3: value = fabs(x[first + from]) / e->scale; break; /* of a coil's current or a spring's twist */
        default: value = x[hidden + HIDDEN * k]; /* a memory of dissipated power */
            z[0] = (pow(x[first + from] / e->scale, 2.0) - value) / e->s1;
        }
        factor[(int)e->where][(int)e->s2] *= 1.0 + shaped(e, value);
    }
    double drop[STATES] = {0.0}, beside[STATES] = {0.0};
    for (int k = 0; k < P->effects; k++) {
        const Effect *e = P->effect + k;
        const double *z = x + hidden + HIDDEN * k;
        double *dz = dx + hidden + HIDDEN * k;
        if ((int)e->target == AT_NODE) {
            const int node = (int)e->where;
            const double turning = P->mechanical[node];
            Moment m = {turning > 0.5 ? x[n + node] : p[node], turning > 0.5 ? p[node] : 0.0, x[n + node], 0.0, 0.0, t, P->duration};
            if (turning < 0.5)
                m.rate = p[node] - e->zero; /* the relay and wear follow the potential itself */
            const double on = gated(e, p[node], m.rate);
            if (((int)e->law == COULOMB && (int)e->shape == 1) || ((int)e->law == STRIBECK && (int)e->shape == 3)) {
                sticking[node] = k;
                late[node] = on;
            } else
                net[node] -= on * law(e, &m, z, dz);
        } else if ((int)e->target != VARIES) {
            const Element *l = P->element + (int)e->where;
            const double q = x[first + (int)e->where], pa = p[(int)l->a], pb = l->b < 0.0 ? 0.0 : p[(int)l->b];
            const double rate = (int)l->kind == GEAR ? l->p[0] * pa - pb : pa - pb;
            Moment m = {q, rate, q, q, 0.0, t, P->duration};
            const double value = gated(e, q, rate) * law(e, &m, z, dz);
            *((int)e->target == DROP ? drop + (int)e->where : beside + (int)e->where) += value;
        }
    }
    for (int k = 0; k < P->elements; k++) {
        const Element *l = P->element + k;
        const int a = (int)l->a, b = (int)l->b, c = (int)l->c;
        double v[PARAMETERS], *state = dx + first + k, q = x[first + k], flow = 0.0;
        for (int j = 0; j < PARAMETERS; j++)
            v[j] = l->p[j] * factor[k][j];
        const double pa = a < 0 ? 0.0 : p[a], pb = b < 0 ? 0.0 : p[b];
        switch ((int)l->kind) {
        case COND: flow = v[0] * (pa - (b < 0 ? l->p[1] : pb)); break;
        case SPRING: *state = pa - pb; flow = v[0] * (q + drop[k]) + v[1] * (pa - pb); break;
        case COIL: *state = (pa - pb - v[1] * q - drop[k]) / v[0]; flow = q; break;
        case VALVE: flow = v[0] * power(pa - pb, 0.5, l->p[1]) * (l->u >= 0.0 ? u[(int)l->u] : 1.0); break;
        case MOTOR: *state = (pa - v[1] * q - v[2] * pb - drop[k]) / v[0]; net[b] += v[2] * q; net[a] -= q; break;
        case GEAR: *state = v[0] * pa - pb; flow = v[1] * (q + drop[k]) + v[2] * *state + beside[k]; net[a] -= v[0] * flow; net[b] += flow; break;
        case PISTON: net[a] -= v[0] * pb; net[b] += v[0] * pa; break;
        case HEATER: flow = (pa - pb) / v[0]; net[c] += (pa - pb) * flow; break;
        case STREAM: flow = v[0] * u[(int)l->u] * (pa - l->p[1]); break;
        case IN: flow = -v[0] * u[(int)l->u]; break;
        case DRAG: flow = v[0] * pa * fabs(pa); break;
        case DRY: flow = v[0] * tanh(pa / l->p[1]); break;
        }
        if ((int)l->kind == MOTOR || (int)l->kind == GEAR || (int)l->kind == PISTON)
            continue;
        flow += beside[k];
        if (a >= 0) net[a] -= flow;
        if (b >= 0) net[b] += flow;
    }
    for (int k = 0; k < n; k++) {
        if (sticking[k] >= 0) {
            Moment m = {x[n + k], p[k], x[n + k], 0.0, net[k], t, P->duration};
            double none[HIDDEN];
            net[k] -= late[k] * law(P->effect + sticking[k], &m, 0, none);
        }
        dx[k] = P->driven[k] >= 0.0 ? 0.0 : net[k] / P->capacity[k];
        dx[n + k] = P->mechanical[k] > 0.5 ? p[k] : 0.0;
    }
}

/* A controller at the rate of the log: what it reads has the sensor's noise. */
typedef struct { double input, output, kp, ki, low, high; } Controller;

/* y: (samples, readings); a reading is (what, index): 0 potential, 1 position, 2 state of an element, 3 flow of a
   spring. read: share of the sample by which readings come late. u is overwritten where a controller acts.
   linear: inputs go straight from sample to sample. Returns the sample at which something is not finite, or -1. */
long network_run(const double *sizes, const double *capacity, const double *driven, const double *mechanical,
                 const double *element, const double *effect, const double *start, long samples, long substeps, double dt,
                 double read, long linear, double *u, const double *columns, const double *readings, long count,
                 const double *controller, const double *reference, const double *noise, double *y) {
    Plant P = {(int)sizes[0], (int)sizes[1], (int)sizes[2], (int)sizes[3], (int)sizes[4], capacity, driven, mechanical,
               (const Element *)element, (const Effect *)effect, dt * (samples - 1)};
    const int n = P.nodes, total = 2 * n + P.elements + HIDDEN * P.effects;
    if (total > STATES)
        return 0;
    double x[STATES] = {0.0}, k[4][STATES], now[STATES], acting[16], given[16], integral = 0.0;
    const double h = dt / substeps, ahead[4] = {0.0, 0.5, 0.5, 1.0};
    const long late = (long)(read * substeps + 0.5);
    const Controller *C = (const Controller *)controller;
    memcpy(x, start, sizeof(double) * (2 * n + P.elements));
    for (long i = 0; i < samples; i++) {
        for (long s = 0; s <= substeps; s++) {
            if (s == late || (s == 0 && C)) {
                double out[16];
                for (long j = 0; j < count; j++) {
                    const int what = (int)readings[2 * j], index = (int)readings[2 * j + 1];
                    const Element *l = P.element + index;
                    out[j] = what == 0 ? x[index] : what == 1 ? x[n + index] : what == 2 ? x[2 * n + index]
                           : l->p[0] * x[2 * n + index] + l->p[1] * (x[(int)l->a] - (l->b < 0.0 ? 0.0 : x[(int)l->b]));
                    if (!isfinite(out[j]) || fabs(out[j]) > 1e30)
                        return i;
                }
                if (s == late)
                    memcpy(y + i * count, out, sizeof(double) * count);
                if (s == 0 && C) {
                    const double error = reference[i] - out[(int)C->output] - noise[i];
                    double want = C->kp * error + C->ki * integral;
                    const double held = fmax(C->low, fmin(C->high, want));
                    if (want == held)
                        integral += error * dt;
                    u[i * P.inputs + (int)C->input] = held;
                }
            }
            if (s == substeps || (i == samples - 1 && s >= late))
                break;
            const double *from = u + i * P.inputs, *to = i == samples - 1 || C ? from : from + P.inputs;
            for (int j = 0; j < 4; j++) {
                const double share = (s + ahead[j]) / substeps;
                for (int m = 0; m < P.inputs; m++)
                    acting[m] = linear ? from[m] + (to[m] - from[m]) * share : from[m];
                for (int m = 0; m < P.columns; m++)
                    given[m] = columns[i * P.columns + m];
                for (int m = 0; m < total; m++)
                    now[m] = x[m] + (j ? ahead[j] * h * k[j - 1][m] : 0.0);
                slopes(&P, (i + share) * dt, now, acting, given, k[j]);
            }
            for (int m = 0; m < total; m++)
                x[m] += h / 6.0 * (k[0][m] + 2.0 * k[1][m] + 2.0 * k[2][m] + k[3][m]);
        }
    }
    return -1;
}

void network_slopes(const double *sizes, const double *capacity, const double *driven, const double *mechanical,
                    const double *element, const double *effect, double duration, const double *x, const double *u,
                    const double *columns, double *dx) {
    Plant P = {(int)sizes[0], (int)sizes[1], (int)sizes[2], (int)sizes[3], (int)sizes[4], capacity, driven, mechanical,
               (const Element *)element, (const Effect *)effect, duration};
    slopes(&P, 0.0, x, u, columns, dx);
}
