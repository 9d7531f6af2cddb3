/* Heat exchanger, buck converter, pneumatic cylinder, magnetic bearing, ship's drive train. */
#include "plant.h"
#define P(name) at->p[name]

static void at_rest(const Moment *at, double *x) { (void)at, (void)x; }
static void first_two(const Moment *at, const double *x, double *y) { (void)at, y[0] = x[0], y[1] = x[1]; }

/* Hot stream, wall, cold stream, a bleed that opens when it is hot. Places: 0 hot, 1 wall, 2 cold side. */
enum { H_HOT, H_WALL, H_COLD, H_INNER, H_OUTER, H_FLOW, H_BLEED };
static void exchanger(const Moment *at, const double *x, double *dx) {
    const double hot = x[0], cold = x[1], wall = x[2], zero = at->zero;
    const double in = P(H_INNER) * (hot - wall), out = P(H_OUTER) * (wall - cold), over = hot - 345.0;
    const double arrives = at->u[0] * 4180.0 * (at->u[1] - hot), bled = over > 0.0 ? P(H_BLEED) * over : 0.0;
    dx[0] = (arrives - in - bled - extra_flow(at, 0, hot, hot - zero, 0.0)) / P(H_HOT);
    dx[1] = (out - P(H_FLOW) * 4180.0 * (cold - zero) - extra_flow(at, 2, cold, cold - zero, 0.0)) / P(H_COLD);
    dx[2] = (in - out - extra_flow(at, 1, wall, wall - zero, 0.0)) / P(H_WALL);
}
static void all_cold(const Moment *at, double *x) { x[0] = x[1] = x[2] = at->zero; }
const Plant heat_exchanger = {3, 2, 2, all_cold, exchanger, first_two};

/* Averaged switch, choke, capacitor, load, a clamp. Places: 0 output node, 1 choke (current), 2 switch node. */
enum { K_IN, K_L, K_RL, K_C, K_LOAD, K_CLAMP };
static void buck(const Moment *at, const double *x, double *dx) {
    const double v = x[0], i = x[1], over = v - 17.0, clamped = over > 0.0 ? P(K_CLAMP) * over : 0.0;
    dx[0] = (i - v / P(K_LOAD) - clamped - extra_flow(at, 0, v, v, 0.0)) / P(K_C);
    dx[1] = (at->u[0] * P(K_IN) - P(K_RL) * i - v - extra_flow(at, 1, i, i, 0.0)) / P(K_L);
}
const Plant buck_converter = {2, 1, 2, at_rest, buck, first_two};

/* Valve, chamber with a throttle, piston against a spring, a cushion. Places: 0 chamber, 1 piston. */
enum { N_VALVE, N_CHAMBER, N_THROTTLE, N_AREA, N_M, N_D, N_DRY, N_SPRING, N_CUSHION };
static void cylinder(const Moment *at, const double *x, double *dx) {
    const double p = x[0], s = x[1], v = x[2];
    dx[0] = (P(N_VALVE) * at->u[0] - P(N_THROTTLE) * p - P(N_AREA) * v - extra_flow(at, 0, p, p, 0.0)) / P(N_CHAMBER);
    dx[1] = v;
    dx[2] = (P(N_AREA) * p - P(N_D) * v - P(N_DRY) * tanh(v / 0.01) - P(N_SPRING) * s - P(N_CUSHION) * beyond(s, 0.06) -
             extra_flow(at, 1, s, v, P(N_AREA) * p)) / P(N_M);
}
const Plant pneumatic_cylinder = {3, 1, 2, at_rest, cylinder, first_two};

/* Rotor between two magnets, its controller, a coil, a touch-down bearing. Places: 0 rotor, 1 coil (current). */
enum { M_FORCE, M_M, M_R, M_L, M_KP, M_KD, M_TOUCH };
static void bearing(const Moment *at, const double *x, double *dx) {
    const double s = x[0], i = x[1], v = x[2], gap = 0.4e-3, bias = 2.0;
    const double a = (bias + i) / (gap - s), b = (bias - i) / (gap + s);
    const double u = P(M_KP) * (at->u[0] - s) - P(M_KD) * v;
    dx[0] = v;
    dx[1] = (u - P(M_R) * i - extra_flow(at, 1, i, i, 0.0)) / P(M_L);
    dx[2] = (P(M_FORCE) * (a * a - b * b) - P(M_TOUCH) * beyond(s, 6e-5) - extra_flow(at, 0, s, v, 0.0)) / P(M_M);
}
const Plant magnetic_bearing = {3, 1, 2, at_rest, bearing, first_two};

/* Engine, rubber coupling, propeller, hull; waves of its own from a speed on. Places: 0 engine, 1 propeller,
   2 coupling, 3 hull. */
enum { S_ENGINE, S_C, S_D, S_PROPELLER, S_TORQUE, S_ADVANCE, S_THRUST, S_HULL, S_DRAG, S_WAVES };
static void ship(const Moment *at, const double *x, double *dx) {
    const double w1 = x[0], w2 = x[1], twist = x[2], speed = x[3], fast = speed - 4.0;
    const double left = after_play(at, 2, twist), rate = w1 - w2;
    const double torque = P(S_C) * left + (left == twist || left != 0.0 ? P(S_D) * rate : 0.0) +
                          extra_flow(at, 2, twist, rate, 0.0);
    const double load = P(S_TORQUE) * w2 * fabs(w2) - P(S_ADVANCE) * w2 * speed;
    dx[0] = (at->u[0] - torque - extra_flow(at, 0, x[4], w1, torque)) / P(S_ENGINE);
    dx[1] = (torque - load - extra_flow(at, 1, x[4] - twist, w2, torque)) / P(S_PROPELLER);
    dx[2] = rate;
    dx[3] = (P(S_THRUST) * w2 * fabs(w2) - P(S_DRAG) * speed * fabs(speed) - (fast > 0.0 ? P(S_WAVES) * fast * fast : 0.0) -
             extra_flow(at, 3, x[5], speed, 0.0)) / P(S_HULL);
    dx[4] = w1, dx[5] = speed;
}
static void ship_read(const Moment *at, const double *x, double *y) {
    (void)at, y[0] = x[0], y[1] = x[1], y[2] = x[3];
}
const Plant ship_drive = {6, 1, 3, at_rest, ship, ship_read};
