/* Virtual test rig of the Harmonic-Drive actuator: its own equations, its own time stepping.
 *
 * Generalised coordinates: housing angle, rotor angle, load angle (absolute). The massless Flexspline is
 * condensed: its deflection is delta = (rotor + (n-1) housing)/n - load + kinematic error(theta), with
 * theta = rotor - housing. The motor torque and the gear friction D both act along (rotor - housing).
 *
 * One step of length h is the implicit midpoint rule, linearised at its start, for the average velocity V:
 *   (2M/h + kappa a a' + sigma e_S e_S') V = 2M/h v + forces at the start + e_M (tau_m - D),
 * kappa = h/2 dtau/ddelta + d_G, sigma = h/2 c_S + d_S, a = d delta/dq. The end velocity is 2V - v.
 * D is a set-valued function of the end velocity (a time-stepping complementarity problem in one unknown):
 * the D that stops the rotor is taken when it lies within [lo(T), hi(T)], otherwise D is the sliding value.
 * Losses are Table 1 of Peer, Bajcinca, Schweiger (2003), solved for the load torque T on the motor side.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* name, neutral value, unit, what it is. Neutral: the effect is absent. */
#define PARAMETERS(X)                                                                                     \
  X(n, 50.0, "1", "gear ratio")                                                                           \
  X(K_m, 0.7, "N.m/A", "motor constant")                                                                  \
  X(J_R, 2.0e-4, "kg.m2", "rotor with Wave Generator")                                                    \
  X(J_S, 0.003039, "kg.m2", "housing with stator and Circular Spline")                                    \
  X(c_S, 130000.0, "N.m/rad", "torque sensor stiffness")                                                  \
  X(d_S, 2.66, "N.m.s/rad", "torque sensor damping")                                                      \
  X(c_G, 25500.0, "N.m/rad", "Flexspline stiffness")                                                      \
  X(d_G, 70.625, "N.m.s/rad", "Flexspline damping")                                                       \
  X(J_L, 0.05, "kg.m2", "load inertia")                                                                   \
  X(mgr, 0.0, "N.m", "largest torque of the eccentric load")                                              \
  X(kp, 0.02, "A.s/rad", "speed controller, proportional")                                                \
  X(ki, 0.4, "A/rad", "speed controller, integral")                                                       \
  X(i_max, 6.0, "A", "current limit of the controller")                                                   \
  X(friction_scale, 1.0, "1", "bearing friction of this run over that of the table")                      \
  X(viscous, 0.0, "N.m.s/rad", "bearing friction per speed, motor side")                                  \
  X(stribeck, 0.0, "N.m", "bearing friction added near zero speed")                                       \
  X(stribeck_speed, 3.0, "rad/s", "speed at which that part has halved")                                  \
  X(coulomb_asymmetry, 0.0, "1", "bearing friction (1 + x) forwards, (1 - x) backwards")                  \
  X(presliding, 0.0, "rad", "rotor deflection of the Maxwell-slip elements before they slide")            \
  X(backlash, 0.0, "rad", "lost motion between Flexspline and load, full width")                          \
  X(hardening, 0.0, "1", "rise of the tabulated Flexspline stiffness, relative")                          \
  X(hardening_angle, 5.0e-4, "rad", "spacing of the stiffness table")                                     \
  X(hysteresis, 0.0, "N.m", "torque of the Maxwell-slip elements beside the Flexspline")                  \
  X(hysteresis_angle, 2.0e-4, "rad", "their mean deflection at slip")                                     \
  X(kinematic_error, 0.0, "rad", "amplitude at the output, twice a turn of the Wave Generator")           \
  X(kinematic_phase, 0.0, "rad", "its phase")                                                             \
  X(cogging, 0.0, "N.m", "amplitude of the motor's cogging torque")                                       \
  X(cogging_order, 12.0, "1", "its periods a turn")                                                       \
  X(cogging_phase, 0.0, "rad", "its phase")                                                               \
  X(current_lag, 0.0, "s", "lag of the current loop: two equal poles of half of it")                      \
  X(saturation, 0.0, "1/A", "inverse of the current at which the motor saturates")                        \
  X(sensor_offset, 0.0, "N.m", "offset of the torque sensor")                                             \
  X(sensor_gain, 1.0, "1", "gain of the torque sensor")                                                   \
  X(sensor_lag, 0.0, "s", "lag of the torque sensor: two equal poles of half of it")                      \
  X(imbalance, 0.0, "N.m", "largest torque of an unknown eccentric mass on the load")                     \
  X(imbalance_phase, 0.0, "rad", "its angle")                                                             \
  X(thermal_friction, 0.0, "1/W", "relative fall of the friction a watt of lasting friction power")       \
  X(thermal_time, 10.0, "s", "time constant of warming up")                                               \
  X(delay, 0.0, "s", "dead time between current command and current")                                     \
  X(input_delay, 0.0, "s", "dead time between recorded input and what acts")                              \
  X(windage, 0.0, "N.m.s2/rad2", "drag of the rotor with the square of its speed")                        \
  X(friction_patch, 0.0, "1", "relative rise of the bearing friction in a patch of the output's turn")    \
  X(friction_patch_angle, 0.0, "rad", "middle of the patch; it is about 0.5 rad wide")                    \
  X(rotor_rub, 0.0, "1", "relative swing of the bearing friction once a turn of the rotor")               \
  X(crosstalk, 0.0, "N.m/A", "torque signal per motor current")                                           \
  X(encoder_eccentricity, 0.0, "rad", "encoder error once a turn of the rotor")                           \
  X(load_brush, 0.0, "N.m", "set-valued friction between load and console, falling with speed")           \
  X(gear_ripple, 0.0, "rad", "kinematic error of another order, amplitude at the output")                 \
  X(gear_ripple_order, 1.0, "1", "its periods a turn of the rotor")                                       \
  X(line_hum, 0.0, "A", "50 Hz current the controller does not command")                                  \
  X(sensor_creep, 0.0, "1", "part of the torque that the sensor shows only with time")                    \
  X(sensor_creep_time, 3.0, "s", "its time constant")                                                     \
  X(relaxation, 0.0, "1", "stiffness of a Maxwell element beside the Flexspline, relative")               \
  X(relaxation_time, 0.2, "s", "its time constant")                                                       \
  X(torque_ripple, 0.0, "1", "relative swing of the motor constant over the rotor angle")                 \
  X(torque_ripple_order, 6.0, "1", "its periods a turn")

enum {
#define X(name, neutral, unit, text) P_##name,
  PARAMETERS(X)
#undef X
  N_PARAMETERS
};
static const char *const names[] = {
#define X(name, neutral, unit, text) #name,
    PARAMETERS(X)
#undef X
};
static const char *const units[] = {
#define X(name, neutral, unit, text) unit,
    PARAMETERS(X)
#undef X
};
static const char *const texts[] = {
#define X(name, neutral, unit, text) text,
    PARAMETERS(X)
#undef X
};
static const double neutrals[] = {
#define X(name, neutral, unit, text) neutral,
    PARAMETERS(X)
#undef X
};
int rig_count(void) { return N_PARAMETERS; }
const char *rig_name(int i) { return names[i]; }
const char *rig_unit(int i) { return units[i]; }
const char *rig_text(int i) { return texts[i]; }
double rig_neutral(int i) { return neutrals[i]; }

enum { FIXED_SHAFT, FREE_SHAFT, ECCENTRIC_LOAD };
enum { TAU_SENSOR, THETA, W_MOTOR, I_MOTOR, PHI_LOAD, LOAD_TORQUE, FRICTION, W_LOAD, N_CHANNELS };
enum { WORK_MOTOR, WORK_FRICTION, WORK_DAMPERS, WORK_LOAD, N_WORKS };
enum { HOUSING, ROTOR, LOAD };
#define ELEMENTS 5
#define PI 3.14159265358979323846

/* Maxwell-slip elements: their share of the force and their deflection at slip over the mean one. */
static const double share[ELEMENTS] = {0.30, 0.25, 0.20, 0.15, 0.10};
static const double spread[ELEMENTS] = {0.2, 0.5, 1.0, 1.8, 3.0};

typedef struct {
  const double *p;
  const double *table; /* rows of |w|, eta1, eta2, tau_bf1, tau_bf2 */
  int rows, row;
  double q[3], v[3];
  double slip[ELEMENTS], hyst[ELEMENTS]; /* Maxwell-slip states in [-1, 1] */
  double i_lag[2], s_lag[2], creep, relaxed, heat, integral, t;
  double D, D_load, T; /* as of the last step */
  int dim;             /* 2 while the load is locked */
  double inverse[3][3], key[3];
  int has_inverse;
} Rig;

static double clip(double x, double lo, double hi) { return x < lo ? lo : (x > hi ? hi : x); }

/* ---- gear losses ------------------------------------------------------------------------------ */

typedef struct { double eta1, eta2, tau1, tau2; } Loss;

static Loss loss_at(Rig *r, double w, double theta, double phi_load) {
  const double *p = r->p, *t = r->table, a = fabs(w);
  Loss x;
  int k = r->row;
  while (k > 0 && a < t[5 * k]) --k;
  while (k < r->rows - 2 && a >= t[5 * (k + 1)]) ++k;
  r->row = k;
  const double *lower = t + 5 * k, *upper = r->rows > 1 ? lower + 5 : lower;
  const double span = upper[0] - lower[0];
  const double f = span > 0 ? clip((a - lower[0]) / span, 0.0, 1.0) : 0.0;
  double *out = &x.eta1;
  for (int j = 0; j < 4; ++j) out[j] = lower[j + 1] + f * (upper[j + 1] - lower[j + 1]);
  double scale = p[P_friction_scale];
  if (p[P_thermal_friction] != 0) scale *= exp(-p[P_thermal_friction] * r->heat);
  if (p[P_friction_patch] != 0)
    scale *= 1 + p[P_friction_patch] * exp(-8.0 * (1 - cos(phi_load - p[P_friction_patch_angle])));
  if (p[P_rotor_rub] != 0) scale *= 1 + p[P_rotor_rub] * cos(theta);
  if (p[P_coulomb_asymmetry] != 0) scale *= 1 + copysign(p[P_coulomb_asymmetry], w);
  double more = p[P_viscous] * a + p[P_windage] * a * a;
  if (p[P_stribeck] != 0) {
    const double s = a / p[P_stribeck_speed];
    more += p[P_stribeck] / (1 + s * s);
  }
  x.tau1 = x.tau1 * scale + more;
  x.tau2 = x.tau2 * scale + more;
  return x;
}

/* Friction while sliding forwards under the load torque T (Table 1, first two rows). */
static double forwards(const Loss *x, double T) {
  return T >= -x->tau1 ? ((1 - x->eta1) * T + x->tau1) / x->eta1 : (x->eta2 - 1) * T + x->eta2 * x->tau2;
}

/* Sliding friction at speed w (its sign given apart, for speed zero) under the load torque T. */
static double sliding(Rig *r, double speed, int sign, double T, double theta, double phi_load) {
  const Loss x = loss_at(r, copysign(speed, (double)sign), theta, phi_load);
  return sign > 0 ? forwards(&x, T) : -forwards(&x, -T);
}

/* ---- springs ---------------------------------------------------------------------------------- */

/* Flexspline torque over deflection; its slope in *slope. Tabulated stiffness, dead zone. */
static double flexspline(const double *p, double delta, double *slope) {
  const double half = 0.5 * p[P_backlash];
  double x = fabs(delta) - half;
  if (x <= 0) {
    *slope = 0;
    return 0;
  }
  double c = p[P_c_G], torque = 0;
  if (p[P_hardening] != 0)
    for (int k = 0; k < 3 && x > p[P_hardening_angle]; ++k) { /* stiffer from knot to knot */
      torque += c * p[P_hardening_angle];
      x -= p[P_hardening_angle];
      c += p[P_hardening] * p[P_c_G];
    }
  *slope = c;
  return copysign(torque + c * x, delta);
}

static double maxwell(const double *z, double increment, double length, double *advanced) {
  double sum = 0;
  for (int j = 0; j < ELEMENTS; ++j) {
    const double x = clip(z[j] + increment / (spread[j] * length), -1.0, 1.0);
    sum += share[j] * x;
    if (advanced) advanced[j] = x;
  }
  return sum;
}

static double kinematic(const double *p, double theta, double *slope) {
  const double a = 2 * theta + p[P_kinematic_phase], m = p[P_gear_ripple_order], b = m * theta;
  *slope = 2 * p[P_kinematic_error] * cos(a) + m * p[P_gear_ripple] * cos(b);
  return p[P_kinematic_error] * (sin(a) - sin(p[P_kinematic_phase])) + p[P_gear_ripple] * sin(b);
}

/* ---- linear algebra --------------------------------------------------------------------------- */

/* Inverse of a symmetric positive definite matrix, the rest of the 3 x 3 left zero. */
static void invert(double (*m)[3], int n, double (*out)[3]) {
  double l[3][3] = {{0}}, y[3];
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double s = m[i][j];
      for (int k = 0; k < j; ++k) s -= l[i][k] * l[j][k];
      l[i][j] = i == j ? sqrt(s) : s / l[j][j];
    }
  memset(out, 0, 9 * sizeof(double));
  for (int c = 0; c < n; ++c) {
    for (int i = 0; i < n; ++i) {
      double s = i == c;
      for (int k = 0; k < i; ++k) s -= l[i][k] * y[k];
      y[i] = s / l[i][i];
    }
    for (int i = n - 1; i >= 0; --i) {
      double s = y[i];
      for (int k = i + 1; k < n; ++k) s -= l[k][i] * out[k][c];
      out[i][c] = s / l[i][i];
    }
  }
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void times(double (*m)[3], const double *x, double *y) {
  for (int i = 0; i < 3; ++i) y[i] = dot(m[i], x);
}

/* ---- one step --------------------------------------------------------------------------------- */

static double two_poles(double *state, double x, double lag, double h) {
  const double f = -expm1(-h / (0.5 * lag));
  const double before = state[1];
  state[0] += f * (x - state[0]);
  state[1] += f * (state[0] - state[1]);
  return 0.5 * (before + state[1]);
}

static double motor_torque(Rig *r, double command, double theta, double h) {
  const double *p = r->p;
  double i = p[P_current_lag] > 0 ? two_poles(r->i_lag, command, p[P_current_lag], h) : command;
  if (p[P_line_hum] != 0) i += p[P_line_hum] * sin(2 * PI * 50 * r->t);
  if (p[P_saturation] != 0) i /= pow(1 + pow(fabs(i) * p[P_saturation], 4), 0.25);
  double torque = p[P_K_m] * i;
  if (p[P_torque_ripple] != 0) torque *= 1 + p[P_torque_ripple] * cos(p[P_torque_ripple_order] * theta);
  if (p[P_cogging] != 0) {
    const double a = p[P_cogging_order] * theta + p[P_cogging_phase];
    torque += p[P_cogging] * (sin(a) + 0.3 * sin(2 * a));
  }
  return torque;
}

static void step(Rig *r, double command, double h, double *works) {
  const double *p = r->p, n = p[P_n];
  double *q = r->q, *v = r->v;
  const double w = v[ROTOR] - v[HOUSING], theta = q[ROTOR] - q[HOUSING];
  const double theta_mid = theta + 0.5 * h * w, load_mid = q[LOAD] + 0.5 * h * v[LOAD];
  double ripple_slope, slope;
  const double ripple = kinematic(p, theta, &ripple_slope);
  const double a[3] = {(n - 1) / n - ripple_slope, 1 / n + ripple_slope, -1};
  static const double e_motor[3] = {-1, 1, 0}, e_load[3] = {0, 0, 1};

  /* Forces at the start of the step; those that depend on V linearly go into the matrix. */
  const double delta = (q[ROTOR] + (n - 1) * q[HOUSING]) / n - q[LOAD] + ripple;
  const double rate = dot(a, v);
  double tau = flexspline(p, delta, &slope);
  const double damping = slope > 0 ? p[P_d_G] : 0; /* no contact, no damping */
  if (p[P_hysteresis] != 0)
    tau += p[P_hysteresis] * maxwell(r->hyst, 0.5 * h * rate, p[P_hysteresis_angle], 0);
  if (p[P_relaxation] != 0) tau += p[P_relaxation] * p[P_c_G] * (delta + 0.5 * h * rate - r->relaxed);
  const double kappa = 0.5 * h * slope + damping, sigma = 0.5 * h * p[P_c_S] + p[P_d_S];
  const double mass[3] = {2 * p[P_J_S] / h, 2 * p[P_J_R] / h, 2 * p[P_J_L] / h};
  if (!r->has_inverse || r->key[0] != kappa || r->key[1] != ripple_slope || r->key[2] != h) {
    double m[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) m[i][j] = kappa * a[i] * a[j] + (i == j ? mass[i] : 0);
    m[HOUSING][HOUSING] += sigma;
    invert(m, r->dim, r->inverse);
    r->key[0] = kappa, r->key[1] = ripple_slope, r->key[2] = h;
    r->has_inverse = 1;
  }
  const double torque = motor_torque(r, command, theta_mid, h);
  const double gravity = p[P_mgr] * sin(load_mid) + p[P_imbalance] * sin(load_mid + p[P_imbalance_phase]);
  double force[3], V[3], G[3], G_load[3];
  for (int i = 0; i < 3; ++i) force[i] = mass[i] * v[i] - a[i] * tau + e_motor[i] * torque;
  force[HOUSING] -= p[P_c_S] * q[HOUSING];
  force[LOAD] -= gravity;
  times(r->inverse, force, V);
  times(r->inverse, e_motor, G);
  times(r->inverse, e_load, G_load);

  /* Gear friction D: V = V_free - G D, so mean speed and load torque are affine in D. */
  const double a_free = dot(a, V), a_gain = dot(a, G), g = G[ROTOR] - G[HOUSING];
  const double side = a[ROTOR];
  double D = r->D, D_load = r->D_load;
  const int brush = p[P_load_brush] != 0 && r->dim == 3, bristles = p[P_presliding] > 0;
  for (int sweep = 0; sweep < (brush ? 25 : 1); ++sweep) {
    const double w_free = V[ROTOR] - V[HOUSING] - (brush ? (G_load[ROTOR] - G_load[HOUSING]) * D_load : 0);
    const double d_free = a_free - (brush ? dot(a, G_load) * D_load : 0);
#define LOAD_SIDE(D) (side * (tau + kappa * (d_free - a_gain * (D))))
    const double before = D, before_load = D_load;
    if (bristles) {
      for (int k = 0; k < 12; ++k) {
        const double mean = w_free - g * D, T = LOAD_SIDE(D), last = D;
        const double hi = sliding(r, fabs(mean), 1, T, theta_mid, load_mid);
        const double lo = sliding(r, fabs(mean), -1, T, theta_mid, load_mid);
        const double z = maxwell(r->slip, 0.5 * h * mean, p[P_presliding], 0);
        D = 0.5 * (hi + lo) + 0.5 * (hi - lo) * z;
        if (fabs(D - last) < 1e-14) break;
      }
    } else {
      /* Slide on if the rotor keeps its direction; else try to stop it; else it slides off. */
      int sign = w > 0 ? 1 : (w < 0 ? -1 : 0), slides = sign != 0;
      for (int attempt = 0; attempt < 2; ++attempt) {
        if (!slides) {
          D = (w_free - 0.5 * w) / g;
          const double T = LOAD_SIDE(D), hi = sliding(r, 0, 1, T, theta_mid, load_mid);
          const double lo = sliding(r, 0, -1, T, theta_mid, load_mid);
          if (D <= hi && D >= lo) break;
          sign = D > hi ? 1 : -1;
        }
        for (int k = 0; k < 12; ++k) {
          const double last = D;
          D = sliding(r, fabs(w_free - g * D), sign, LOAD_SIDE(D), theta_mid, load_mid);
          if (fabs(D - last) < 1e-12) break;
        }
        if (!slides || sign * (2 * (w_free - g * D) - w) > 0) break;
        slides = 0;
      }
    }
    r->T = LOAD_SIDE(D);
    if (brush) { /* stop the load if the brush can hold it, else let it slide */
      const double free = V[LOAD] - G[LOAD] * D, stop = (free - 0.5 * v[LOAD]) / G_load[LOAD];
      const double s = (free - G_load[LOAD] * D_load) / 0.05;
      const double level = p[P_load_brush] * (0.6 + 0.4 / (1 + s * s));
      D_load = fabs(stop) <= p[P_load_brush] ? stop : copysign(level, stop);
      if (fabs(D - before) + fabs(D_load - before_load) < 1e-12) break;
    }
#undef LOAD_SIDE
  }
  r->D = D;
  r->D_load = D_load;
  for (int i = 0; i < 3; ++i) V[i] -= G[i] * D + (brush ? G_load[i] * D_load : 0);

  const double mean_w = V[ROTOR] - V[HOUSING], mean_rate = dot(a, V);
  works[WORK_MOTOR] += h * torque * mean_w;
  works[WORK_FRICTION] += h * (D * mean_w + (brush ? D_load * V[LOAD] : 0));
  works[WORK_DAMPERS] += h * (damping * mean_rate * mean_rate + p[P_d_S] * V[HOUSING] * V[HOUSING]);
  works[WORK_LOAD] -= h * gravity * V[LOAD];

  /* Inner states, then positions and velocities. */
  if (bristles) maxwell(r->slip, h * mean_w, p[P_presliding], r->slip);
  if (p[P_hysteresis] != 0) maxwell(r->hyst, h * mean_rate, p[P_hysteresis_angle], r->hyst);
  if (p[P_relaxation] != 0)
    r->relaxed += -expm1(-h / p[P_relaxation_time]) * (delta + 0.5 * h * mean_rate - r->relaxed);
  if (p[P_thermal_friction] != 0) r->heat += h / p[P_thermal_time] * (D * mean_w - r->heat);
  for (int i = 0; i < 3; ++i) {
    q[i] += h * V[i];
    v[i] = 2 * V[i] - v[i];
  }
  r->t += h;
}

/* ---- signals ---------------------------------------------------------------------------------- */

static double spring_torque(const Rig *r) { return -(r->p[P_c_S] * r->q[HOUSING] + r->p[P_d_S] * r->v[HOUSING]); }

static double sensor(const Rig *r, double current) {
  const double *p = r->p;
  double y = p[P_sensor_lag] > 0 ? r->s_lag[1] : spring_torque(r);
  if (p[P_sensor_creep] != 0) y -= p[P_sensor_creep] * (y - r->creep);
  return p[P_sensor_gain] * y + p[P_crosstalk] * current + p[P_sensor_offset];
}

static double encoder_speed(const Rig *r) {
  const double w = r->v[ROTOR] - r->v[HOUSING];
  return w * (1 + r->p[P_encoder_eccentricity] * cos(r->q[ROTOR] - r->q[HOUSING]));
}

/* kp e + ki integral(e), limited; the integral moves over h unless limited (h = 0: only look). */
static double controller(Rig *r, double w_ref, double h) {
  const double *p = r->p, e = w_ref - encoder_speed(r), raw = p[P_kp] * e + r->integral;
  if (fabs(raw) < p[P_i_max]) r->integral += h * p[P_ki] * e;
  return clip(raw, -p[P_i_max], p[P_i_max]);
}

/* Run one experiment from rest.
 * u: (samples) inputs, u[k] acts on [t_k, t_k+1). record: (samples, N_CHANNELS), row k is taken just before
 * u[k] is set (row 0: after). works: (N_WORKS). Returns the index of the first sample that is not finite, or -1. */
long rig_run(const double *p, const double *table, int rows, int setup, long samples, long substeps,
             double interval, const double *u, double *record, double *works) {
  Rig r;
  memset(&r, 0, sizeof r);
  memset(works, 0, N_WORKS * sizeof *works);
  r.p = p;
  r.table = table;
  r.rows = rows;
  r.dim = setup == FIXED_SHAFT ? 2 : 3;
  const double h = interval / (double)substeps;
  const long late = lround(p[P_input_delay] / h), waits = lround(p[P_delay] / h);
  double *queue = waits > 0 ? calloc((size_t)waits, sizeof *queue) : 0; /* commands on their way */
  if (waits > 0 && !queue) return 0;
  long failed = -1;
  for (long k = 0; k < samples; ++k) {
    const long last = k > 0 ? (k * substeps - 1 - late) : -late; /* step whose input is still in force */
    const double held = last >= 0 ? u[last / substeps] : 0;
    const double current = setup == FIXED_SHAFT ? held : controller(&r, held, 0);
    double *y = record + k * N_CHANNELS;
    y[TAU_SENSOR] = sensor(&r, current);
    y[THETA] = r.q[ROTOR] - r.q[HOUSING];
    y[THETA] += p[P_encoder_eccentricity] * sin(y[THETA]);
    y[W_MOTOR] = encoder_speed(&r);
    y[I_MOTOR] = current;
    y[PHI_LOAD] = r.q[LOAD];
    y[LOAD_TORQUE] = r.T;
    y[FRICTION] = r.D;
    y[W_LOAD] = r.v[LOAD];
    if (!isfinite(y[TAU_SENSOR]) || !isfinite(y[THETA])) {
      failed = k;
      break;
    }
    if (k == samples - 1) break;
    for (long s = k * substeps; s < (k + 1) * substeps; ++s) {
      const double input = s >= late ? u[(s - late) / substeps] : 0;
      double command = setup == FIXED_SHAFT ? input : controller(&r, input, h);
      if (waits > 0) {
        const double arrives = queue[s % waits];
        queue[s % waits] = command;
        command = arrives;
      }
      step(&r, command, h, works);
      if (p[P_sensor_lag] > 0) two_poles(r.s_lag, spring_torque(&r), p[P_sensor_lag], h);
      if (p[P_sensor_creep] != 0)
        r.creep += -expm1(-h / p[P_sensor_creep_time]) * (spring_torque(&r) - r.creep);
    }
  }
  free(queue);
  return failed;
}
