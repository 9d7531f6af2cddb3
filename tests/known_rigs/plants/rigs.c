/* Plants of the home rigs: belt axis, thermal block, RLC circuit, tanks. */
#include "plant.h"
#define P(name) at->p[name]

static void at_rest(const Moment *at, double *x) { (void)at, (void)x; }
static void first_two(const Moment *at, const double *x, double *y) { (void)at, y[0] = x[0], y[1] = x[1]; }

/* Motor and pulley, a belt, a carriage with dry friction. Places: 0 rotor, 1 carriage, 2 belt. */
enum { X_K, X_R, X_J, X_C, X_D, X_M, X_VISCOUS, X_DRY };
static void belt(const Moment *at, const double *x, double *dx) {
    const double phi = x[0], s = x[1], w = x[2], v = x[3], r = P(X_R);
    const double whole = s - r * phi, stretch = after_play(at, 2, whole), rate = v - r * w;
    const double f = P(X_C) * stretch + (stretch == whole || stretch != 0.0 ? P(X_D) * rate : 0.0) +
                     extra_flow(at, 2, whole, rate, 0.0);
    dx[0] = w;
    dx[1] = v;
    dx[2] = (P(X_K) * at->u[0] + r * f - extra_flow(at, 0, phi, w, f * r)) / P(X_J);
    dx[3] = (-f - P(X_VISCOUS) * v - P(X_DRY) * tanh(v / 0.005) - extra_flow(at, 1, s, v, f)) / P(X_M);
}
const Plant belt_axis = {4, 1, 2, at_rest, belt, first_two};

/* A heated block in a casing. Places: 0 body, 1 casing. */
enum { T_BODY, T_CASING, T_WALL, T_AIR };
static void block(const Moment *at, const double *x, double *dx) {
    const double body = x[0], casing = x[1], zero = at->zero, through = P(T_WALL) * (body - casing);
    dx[0] = (at->u[0] - through - extra_flow(at, 0, body, body - zero, 0.0)) / P(T_BODY);
    dx[1] = (through - P(T_AIR) * (casing - zero) - extra_flow(at, 1, casing, casing - zero, 0.0)) / P(T_CASING);
}
static void at_room(const Moment *at, double *x) { x[0] = x[1] = at->zero; }
const Plant thermal_block = {2, 1, 2, at_room, block, first_two};

/* A source, a resistor, an inductor, a capacitor. Places: 0 capacitor, 1 inductor (current). */
enum { R_R, R_L, R_C };
static void resonance(const Moment *at, const double *x, double *dx) {
    const double v = x[0], i = x[1];
    dx[0] = (i - extra_flow(at, 0, v, v, 0.0)) / P(R_C);
    dx[1] = (at->u[0] - P(R_R) * i - v - extra_flow(at, 1, i, i, 0.0)) / P(R_L);
}
const Plant circuit = {2, 1, 2, at_rest, resonance, first_two};

/* A pump, a tank that drains into another, which drains too. Places: 0 upper, 1 lower. */
enum { W_PUMP, W_FIRST, W_SECOND, W_UPPER, W_LOWER };
static void levels(const Moment *at, const double *x, double *dx) {
    const double first = P(W_FIRST) * sqrt(2.0 * 9.81 * fmax(x[0], 1e-6));
    const double second = P(W_SECOND) * sqrt(2.0 * 9.81 * fmax(x[1], 1e-6));
    dx[0] = (P(W_PUMP) * at->u[0] - first - extra_flow(at, 0, x[0], x[0], 0.0)) / P(W_UPPER);
    dx[1] = (first - second - extra_flow(at, 1, x[1], x[1], 0.0)) / P(W_LOWER);
}
static void filled(const Moment *at, double *x) { (void)at, x[0] = x[1] = 0.05; }
const Plant tanks = {2, 1, 2, filled, levels, first_two};
