/* One instance of the model: its state, its work memory and the operations behind the FMI functions.
 *
 * Sizes are compile-time constants of the model (model.h), so an instance is one flat block: State is all that a
 * simulation changes, and copying it is what FMI calls getting and setting the FMU state. */
#ifndef FMUID_INSTANCE_H
#define FMUID_INSTANCE_H

#include <stddef.h>

#include "linear.h"
#include "model.h"
#include "model_config.h"
#include "switches.h"

enum { NX = MODEL_NX, NU = MODEL_NU, NP = MODEL_NP, ND = MODEL_ND, NZ = MODEL_NZ };
enum { NDELAY = MODEL_NDELAY, NIN = NU - NDELAY }; /* the values of delay() follow the inputs in u */
enum { NM = MODEL_NM, NY = MODEL_NY, NV = MODEL_NV, STAGES = 8 };
#define LENGTH(n) ((n) > 0 ? (n) : 1)
#define LARGER(a, b) ((a) > (b) ? (a) : (b))

typedef enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL } Status; /* as in FMI */

typedef enum {
    PHASE_INSTANTIATED = 1,
    PHASE_INITIALIZATION = 2,
    PHASE_STEP = 4,       /* co-simulation between steps */
    PHASE_EVENT = 8,      /* model exchange */
    PHASE_CONTINUOUS = 16,
    PHASE_TERMINATED = 32,
    PHASE_ERROR = 64
} Phase;

/* The last accepted integration step and the memory of the step size control. */
typedef struct {
    double t0, h;                 /* the step started at t0 with size h ... */
    double t1;                    /* ... and is valid up to t1 <= t0 + h: an event may end it earlier */
    double x0[LENGTH(NX)], x1[LENGTH(NX)];
    double k[STAGES][LENGTH(NX)]; /* stage increments: dense output */
    double h_next;                /* proposed size, 0 before the first step */
    double h_start;               /* proposed for the first step after a restart, once one was rejected */
    double h_old, error_old;      /* last accepted size and error, for the predictive controller */
    double size[LENGTH(NX)];      /* largest |x| so far: scale of the states without nominal value */
    double u[LENGTH(NU)], du[LENGTH(NU)], u_time; /* input u + du (t - u_time) that the step was made with */
    int fresh;                    /* the integration (re)starts at t1: nothing is known beyond it */
    int event;                    /* an event waits at t1 */
    long steps, rejections;
} Step;

/* The past of what is delayed, from `until` backwards; its pieces are in Instance. */
typedef struct {
    size_t first_row, rows;
    double until, event, own_next;              /* how far it reaches; time of the last event; the model's next one */
    double time[LENGTH(NDELAY)], at_start[LENGTH(NDELAY)], size[LENGTH(NDELAY)];
    double x[LENGTH(NX)], dx[LENGTH(NX)], u[LENGTH(NU)]; /* at `until`, in model exchange */
} Memory;

typedef struct {
    int phase, is_co_simulation, stop_defined;
    int initialised;  /* x, z, ... follow from what was set before the simulation */
    int changed;      /* a parameter changed between steps */
    int laws;         /* 1: branches that depend on parameters alone are off; 2 or, before that is known, 0: some may be on */
    int input_event;  /* an input changed since the last event iteration */
    int terminate;
    double t, start_time, stop_time, tolerance, next_event;
    double p[LENGTH(NP)], d[LENGTH(ND)];
    double u[LENGTH(NU)], du[LENGTH(NU)]; /* value and slope at t */
    unsigned char u_set[LENGTH(NU)], du_set[LENGTH(NU)], xs_set[LENGTH(NX)];
    double xs[LENGTH(NX)], x[LENGTH(NX)], z[LENGTH(NZ)], pz[LENGTH(NZ)], m[LENGTH(NM)], y[LENGTH(NY)];
    double dx[LENGTH(NX)], v[LENGTH(NV)];
    int have_dx, have_v;
    unsigned char warned[LENGTH(MODEL_NASSERT)];
    double reach[LENGTH(NM)]; /* largest indicators so far */
    double event_time;        /* of the last event inside a step */
    int chatter, widened;     /* events in a row about a threshold; how often their width was doubled */
    Step step;
#if MODEL_NDELAY > 0
    Memory memory;
#endif
} State;

typedef struct Instance Instance;

/* Where messages go: the importer's callback, of a type that only `log` knows. */
typedef struct {
    void (*log)(void (*callback)(void), void *environment, const char *name, Status status, const char *message);
    void (*callback)(void);
    void *environment;
} Listener;

struct Instance {
    State s;
    struct {
        double p[LENGTH(NP)], u[LENGTH(NU)], xs[LENGTH(NX)];
        unsigned char xs_set[LENGTH(NX)];
    } start; /* what reset goes back to */
    /* work memory: nothing in it outlives one call */
    const double *arg[LARGER(MODEL_SZ_ARG, SWITCHES_SZ_ARG) + 1];
    double *res[LARGER(MODEL_SZ_RES, SWITCHES_SZ_RES) + 1];
    casadi_int iw[1];
    double w[LARGER(MODEL_SZ_W, SWITCHES_SZ_W) + 1];
    double ut[LENGTH(NU)], g[LENGTH(NM)];
    /* of [dx; r] at the beginning of the step: by [x; y], and by t with the slopes of the inputs */
    double jacobian[LENGTH(MODEL_J_NONZEROS)], by_time[LENGTH(NX + NY)], f0[LENGTH(NX)];
    double matrix[LENGTH(MODEL_J_NONZEROS)], drdy[LENGTH(MODEL_R_NONZEROS)], drdt[LENGTH(NY)];
    double initial[LENGTH(MODEL_I_NONZEROS)];
    Factors lu_step, lu_loop, lu_start;
    struct {
        double step[LENGTH(MODEL_J_FACTORS)], loop[LENGTH(MODEL_R_FACTORS)], start[LENGTH(MODEL_I_FACTORS)];
        double work[3][2 * (NX + NY) + 1];
        int pivot[3][LENGTH(NX + NY)];
    } factors; /* what Factors point to */
#if MODEL_NDELAY > 0
    double *remembered; /* pieces of the past, and room for so many */
    size_t room;
#endif
    Listener listener;
    char *name;
    int logging;
    struct Sensitivity *sensitivity; /* NULL: none asked for */
};

/* variables.c: by value reference; a failure says what, where and when and returns `status` */
Status report(const Instance *me, Status status, const char *format, ...);
Status whole_numbers(const Instance *me);
const VariableEntry *entry_of(const Instance *me, unsigned reference, VariableType type);
const VariableEntry *differentiable(const Instance *me, unsigned reference);
int input_place(unsigned reference, double *sign);

/* A direction in the independent vectors (x, u, p, d, z and its pre-values, t), and what follows from it. */
typedef struct {
    double x[LENGTH(NX)], u[LENGTH(NU)], p[LENGTH(NP)], d[LENGTH(ND)], z[LENGTH(NZ)], pz[LENGTH(NZ)], t;
    double y[LENGTH(NY)], dx[LENGTH(NX)], v[LENGTH(NV)], next_event;
} Direction;

/* Their matrices: J of integrator and sensitivities, R of Newton's method for loops, I of that for initial equations. */
#define PATTERN(m)                                                                                                 \
    {MODEL_##m##_N, MODEL_##m##_DENSE, MODEL_##m##_NONZEROS, MODEL_##m##_FACTORS, MODEL_##m##_START,               \
     MODEL_##m##_ROW, MODEL_##m##_COLUMN, MODEL_##m##_PLACE, MODEL_##m##_LU_START, MODEL_##m##_LU_DIAGONAL,        \
     MODEL_##m##_LU_ROW, MODEL_GROWTH, MODEL_##m##_FACTOR_CODE, MODEL_##m##_SOLVE_CODE}
#define FACTORISE(m, a, f) factorise(MODEL_##m##_N, MODEL_##m##_DENSE, &PATTERN_##m, a, f)
#define SOLVE(m, f, b) solve(MODEL_##m##_N, MODEL_##m##_DENSE, &PATTERN_##m, f, b)

/* A generated function of what environment_at and me->res point to. */
#define CALL(name) model_##name(me->arg, me->res, me->iw, me->w, me->s.laws)

int parameter_direction(unsigned reference, Direction *s, double *start);

/* equations.c: evaluation of the generated functions */
const double **environment_at(Instance *me, const double *t, const double *x, const double *u);
int solve_loop(Instance *me, double t, const double *x, const double *u);
int factorise_loop(Instance *me, double t, const double *x, const double *u);
void solve_linear_loop(Instance *me, double *b);
int right_hand_side(Instance *me, double t, const double *x, double *dx);
int linearise(Instance *me, double t, const double *x);
int second_derivatives(Instance *me, double t, const double *x, double *second);
void input_at(Instance *me, double t);
void relations_within(Instance *me, double slack, double t, const double *x, const double *u, double *m);
void relations(Instance *me, double t, const double *x, const double *u, double *m);
int relations_for_input(Instance *me, double *kept);
int evaluate_derivatives(Instance *me);
int evaluate_variables(Instance *me);
int partials_along(Instance *me, double t, const double *x, const double *u, Direction *s);
int derivatives_along(Instance *me, double t, const double *x, const double *u, Direction *s);
int variables_along(Instance *me, double t, const double *x, const double *u, Direction *s);
int indicators_along(Instance *me, double t, const double *x, const double *u, Direction *s, double *g);
int update_along(Instance *me, double initial, Direction *s, double *updated);
int dependent_parameters_along(Instance *me, const double *sp, double *sd);
int discrete_starts_along(Instance *me, Direction *s);
int initial_states_along(Instance *me, const double *start, Direction *s);
Status check_assertions(Instance *me);

/* starts.c */
Status read_starts(Instance *me, const char *location);

/* initialise.c */
void set_defaults(Instance *me);
Status initialise(Instance *me);

/* events.c */
int event_indicators(Instance *me, double *g);
Status event_iteration(Instance *me, int initial);
void find_event(Instance *me, double from, double to, int samples);
void watch_chattering(Instance *me);

/* past.c, delays.c */
#if MODEL_NDELAY > 0
void delayed_at(const Instance *me, double t, double *u, double *du);
double next_delayed_event(const Instance *me);
Status remember(Instance *me, double t);
Status remember_point(Instance *me);
Status pass_delays(Instance *me);
Status begin_past(Instance *me, int *settled);
size_t memory_size(const Instance *me);
void copy_memory(const Instance *me, char *to);
Status restore_memory(Instance *me, const char *from);
int delayed_expressions(Instance *me, double t, const double *x, const double *u, const double *du, double *value,
                        double *slope);
int delayed_along(Instance *me, double t, const double *x, const double *u, Direction *s, double *along);
double delayed_slope(const Instance *me, int k, double t, int after);
int jump_due(const Instance *me, double *past);
#else
#define delayed_at(me, t, u, du) ((void)0)
#define remember(me, t) STATUS_OK
#define remember_point(me) STATUS_OK
#define pass_delays(me) STATUS_OK
#define begin_past(me, settled) STATUS_OK
#define memory_size(me) ((size_t)0)
#define copy_memory(me, to) ((void)0)
#define restore_memory(me, from) STATUS_OK
#endif

/* dense_output.c */
void dense_output(const Step *step, double t, double *x);

/* kinks.c */
double first_kink(Instance *me, double h, int again);
double next_kink(Instance *me, double from, double to, double *start, int *known, double *smooth);

/* integrator.c */
void restart_integration(Instance *me);
Status integrate_step(Instance *me, double target, int exact);

/* simulate.c: what the FMI functions of both versions share */
Status do_step(Instance *me, double t, double h);
Status get_value(Instance *me, unsigned reference, VariableType type, double *value);
Status set_value(Instance *me, unsigned reference, VariableType type, double value);
Status set_input_slope(Instance *me, unsigned reference, double slope);
Status get_directional_derivative(Instance *me, const unsigned *unknown, size_t n_unknown, const unsigned *known,
                                  size_t n_known, const double *seed, double *sensitivity);
Status set_experiment(Instance *me, int tolerance_defined, double tolerance, double start, int stop_defined,
                      double stop);
Status start_simulation(Instance *me);
Status update_discrete_states(Instance *me, int *states_changed);
Status enter_event_mode(Instance *me);
Status enter_continuous_mode(Instance *me);
Status completed_step(Instance *me);
void set_time(Instance *me, double t);

/* sensitivity.c, sensitivity_rare.c */
int has_sensitivities(const Instance *me);
Status sensitivities_of(Instance *me, const unsigned *variables, size_t n, double *values);
Status start_sensitivities(Instance *me);
Status advance_sensitivities(Instance *me, double t, int restart);
Status enter_event(Instance *me, int inside);
Status update_sensitivities(Instance *me, int reinit);
Status leave_event(Instance *me);
void free_sensitivities(Instance *me);
size_t sensitivities_size(const Instance *me);
void copy_sensitivities(const Instance *me, char *to);
int restore_sensitivities(Instance *me, const char *from);

/* event_sensitivity.c */
Status event_start_along(Instance *me, Direction *along, size_t n);
Status event_time_along(Instance *me, Direction *along, size_t n, int inside);
Status event_update_along(Instance *me, Direction *along, size_t n, int initial, int reinit);
Status event_end_along(Instance *me, Direction *along, size_t n);

/* lifecycle.c: memory, the complete state, arrays of model exchange */
Instance *new_instance(const char *name, const char *guid, const char *resources, Listener listener,
                       int is_co_simulation);
void free_instance(Instance *me);
Status copy_state(const Instance *me, void **copy);
Status restore_state(Instance *me, const void *copy);
size_t serialised_size(const void *state);
Status serialise(const Instance *me, const void *state, char *bytes, size_t size);
Status deserialise(const Instance *me, const char *bytes, size_t size, void **state);
Status set_states(Instance *me, const double *x, size_t n);
Status get_states(const Instance *me, double *x, size_t n);
Status get_derivatives(Instance *me, double *dx, size_t n);
Status get_indicators(Instance *me, double *g, size_t n);
Status get_nominals(const Instance *me, double *nominals, size_t n);

#endif
