/* Gantry crane, ball screw with an elastic nut, two-link arm. */
#include "plant.h"
#define P(name) at->p[name]

static void at_rest(const Moment *at, double *x) { (void)at, (void)x; }

/* Trolley on rails, a payload that swings below; buffers at the ends. Places: 0 trolley, 1 payload (angle). */
enum { C_DRIVE, C_TROLLEY, C_FRICTION, C_DRY, C_PAYLOAD, C_ROPE, C_SWING, C_BUFFER };
static void crane(const Moment *at, const double *x, double *dx) {
    const double s = x[0], v = x[1], th = x[2], w = x[3], l = P(C_ROPE), m = P(C_PAYLOAD), sn = sin(th), cs = cos(th);
    const double pull = P(C_DRIVE) * at->u[0] - P(C_FRICTION) * v - P(C_DRY) * tanh(v / 0.01) -
                        P(C_BUFFER) * beyond(s, 1.5) - extra_flow(at, 0, s, v, m * 9.81 * cs);
    const double back = 9.81 * sn + l * P(C_SWING) * w + extra_flow(at, 1, th, w, 0.0) / (m * l);
    dx[0] = v;
    dx[1] = (pull + m * cs * back + m * l * w * w * sn) / (P(C_TROLLEY) + m * sn * sn);
    dx[2] = w;
    dx[3] = -(dx[1] * cs + back) / l;
}
static void crane_read(const Moment *at, const double *x, double *y) { (void)at, y[0] = x[0], y[1] = x[2]; }
const Plant gantry_crane = {4, 1, 2, at_rest, crane, crane_read};

/* Motor and screw, a nut that gives way, a table with a wiper; a rubber stop. Places: 0 screw, 1 table, 2 nut. */
enum { B_K, B_J, B_SCREW, B_C, B_D, B_M, B_TABLE, B_DRY, B_STOP };
static void screw(const Moment *at, const double *x, double *dx) {
    const double phi = x[0], w = x[1], s = x[2], v = x[3], r = 0.01 / (2.0 * M_PI);
    const double whole = s - r * phi, stretch = after_play(at, 2, whole), rate = v - r * w;
    const double f = P(B_C) * stretch + (stretch == whole || stretch != 0.0 ? P(B_D) * rate : 0.0) +
                     extra_flow(at, 2, whole, rate, 0.0);
    dx[0] = w;
    dx[1] = (P(B_K) * at->u[0] - P(B_SCREW) * w + r * f - extra_flow(at, 0, phi, w, f * r)) / P(B_J);
    dx[2] = v;
    dx[3] = (-f - P(B_TABLE) * v - P(B_DRY) * tanh(v / 0.002) - P(B_STOP) * beyond(s, 0.06) -
             extra_flow(at, 1, s, v, f)) / P(B_M);
}
const Plant ball_screw = {4, 1, 2, at_rest, screw, crane_read};

/* Two links in a horizontal plane; a soft stop at the shoulder. Places: 0 shoulder, 1 elbow. */
enum { A_I1, A_I2, A_H, A_D1, A_F1, A_D2, A_F2, A_STOP };
static void arm(const Moment *at, const double *x, double *dx) {
    const double q2 = x[1], w1 = x[2], w2 = x[3], c = P(A_H) * cos(q2), s = P(A_H) * sin(q2);
    const double a = P(A_I1) + 2.0 * c, b = P(A_I2) + c, d = P(A_I2);
    const double t1 = at->u[0] + s * (2.0 * w1 * w2 + w2 * w2) - P(A_D1) * w1 - P(A_F1) * tanh(w1 / 0.02) -
                      P(A_STOP) * beyond(x[0], 2.0) - extra_flow(at, 0, x[0], w1, 0.0);
    const double t2 = at->u[1] - s * w1 * w1 - P(A_D2) * w2 - P(A_F2) * tanh(w2 / 0.02) - extra_flow(at, 1, q2, w2, 0.0);
    const double determinant = a * d - b * b;
    dx[0] = w1, dx[1] = w2;
    dx[2] = (d * t1 - b * t2) / determinant;
    dx[3] = (a * t2 - b * t1) / determinant;
}
static void arm_read(const Moment *at, const double *x, double *y) { (void)at, y[0] = x[0], y[1] = x[1]; }
static void bent(const Moment *at, double *x) { (void)at, x[1] = 0.5; }
const Plant two_link_arm = {4, 2, 2, bent, arm, arm_read};
