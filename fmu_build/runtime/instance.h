/* One instance of the model: its state, its work memory and the operations behind the FMI functions.
 *
 * Sizes are those of `model`, so that what does not depend on the model is compiled once for all of them. An instance is
 * one block of memory: State, with the arrays that it points to, is all that a simulation changes, and copying them is
 * what FMI calls getting and setting the FMU state. */
#ifndef FMUID_INSTANCE_H
#define FMUID_INSTANCE_H

#include <stddef.h>

#include <string.h>

#include "linear.h"
#include "model_data.h"

enum { STAGES = 8 };
#define LENGTH(n) ((n) > 0 ? (n) : 1)
#define BYTES(n) ((size_t)LENGTH(n) * sizeof(double))
#define ZEROS(name, n)          \
    double name[LENGTH(n)];     \
    memset(name, 0, sizeof name)

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
    double *x0, *x1;
    double *k[STAGES]; /* stage increments: dense output */
    double h_next;                /* proposed size, 0 before the first step */
    double h_start;               /* proposed for the first step after a restart, once one was rejected */
    double h_old, error_old;      /* last accepted size and error, for the predictive controller */
    double *size;                 /* largest |x| so far: scale of the states without nominal value */
    double *u, *du, u_time;       /* input u + du (t - u_time) that the step was made with */
    int fresh;                    /* the integration (re)starts at t1: nothing is known beyond it */
    int event;                    /* an event waits at t1 */
    long steps, rejections;
} Step;

/* The past of what is delayed, from `until` backwards; its pieces are in Instance. */
typedef struct {
    size_t first_row, rows;
    double until, event, own_next;              /* how far it reaches; time of the last event; the model's next one */
    double *time, *at_start, *size;
    double *low, *high, *when; /* by outlet: between which places no jump leaves, and when the next one entered */
    double *x, *dx, *u; /* at `until`, in model exchange */
} Memory;

typedef struct {
    int phase, is_co_simulation, stop_defined;
    int initialised;  /* x, z, ... follow from what was set before the simulation */
    int changed;      /* a parameter changed between steps */
    int laws;         /* 1: branches that depend on parameters alone are off; 2 or, before that is known, 0: some may be on */
    int input_event;  /* an input changed since the last event iteration */
    int terminate;
    double t, start_time, stop_time, tolerance, next_event;
    double *p, *d;
    double *u, *du; /* value and slope at t */
    unsigned char *u_set, *du_set, *xs_set;
    double *xs, *x, *z, *pz, *m, *y, *dx, *v;
    int have_dx, have_v;
    unsigned char *warned; /* by assertion */
    double *reach;            /* largest indicators so far */
    double event_time;        /* of the last event inside a step */
    int chatter, widened;     /* events in a row about a threshold; how often their width was doubled */
    Step step;
    Memory memory;
    char *block; /* what the arrays are in */
} State;

typedef struct Instance Instance;
typedef struct LeastNorm LeastNorm;

/* Where messages go: the importer's callback, of a type that only `log` knows. */
typedef struct {
    void (*log)(void (*callback)(void), void *environment, const char *name, Status status, const char *message);
    void (*callback)(void);
    void *environment;
} Listener;

struct Instance {
    State s;
    struct {
        double *p, *u, *xs;
        unsigned char *xs_set;
    } start; /* what reset goes back to */
    /* work memory: nothing in it outlives one call */
    const double **arg;
    double **res;
    casadi_int iw[1];
    double *w;
    double *ut, *g;
    double *uw, *moved; /* u with what leaves spatialDistribution(), and how far the contents have moved */
    /* of [dx; r] at the beginning of the step: by [x; y], and by t with the slopes of the inputs */
    double *jacobian, *by_time, *f0;
    double *matrix, *drdy, *drdt;
    double *initial;
    Factors lu_step, lu_loop, lu_start;
    LeastNorm *least_norm; /* instead of lu_start, where the initial equations are singular; else NULL */
    double *remembered; /* pieces of the past of delay(), and room for so many */
    size_t room;
    Listener listener;
    char *name;
    int logging;
    double patience; /* s of processor time that a communication step may take; 0: any */
    struct Sensitivity *sensitivity; /* NULL: none asked for */
};

/* variables.c: by value reference; a failure says what, where and when and returns `status` */
Status report(const Instance *me, Status status, const char *format, ...);
Status whole_numbers(const Instance *me);
const VariableEntry *no_entry(const Instance *me, unsigned reference, VariableType type);
static inline const VariableEntry *entry_of(const Instance *me, unsigned reference, VariableType type) {
    const VariableEntry *entry = model.variables + reference;
    return reference < (unsigned)model.n_variables && entry->type == type ? entry : no_entry(me, reference, type);
}
const VariableEntry *differentiable(const Instance *me, unsigned reference);
int input_place(unsigned reference, double *sign);

/* A direction in the independent vectors (x, u, p, d, z and its pre-values, t), and what follows from it. */
typedef struct {
    double *x, *u, *p, *d, *z, *pz, t;
    double *y, *dx, *v, next_event;
} Direction;

/* The numbers that a direction points to, and a direction with all of them zero. */
#define DIRECTION_NUMBERS                                                                                           \
    ((size_t)(2 * LENGTH(NX) + LENGTH(NU) + LENGTH(NP) + LENGTH(ND) + 2 * LENGTH(NZ) + LENGTH(NY) + LENGTH(NV)))
static inline Direction direction_in(double *numbers) {
    Direction s = {.x = numbers};
    memset(numbers, 0, DIRECTION_NUMBERS * sizeof *numbers);
    s.dx = s.x + LENGTH(NX), s.u = s.dx + LENGTH(NX), s.p = s.u + LENGTH(NU), s.d = s.p + LENGTH(NP);
    s.z = s.d + LENGTH(ND), s.pz = s.z + LENGTH(NZ), s.y = s.pz + LENGTH(NZ), s.v = s.y + LENGTH(NY);
    return s;
}
static inline void copy_direction(const Direction *from, Direction *to) {
    memcpy(to->x, from->x, DIRECTION_NUMBERS * sizeof *to->x);
    to->t = from->t, to->next_event = from->next_event;
}
#define DIRECTION(s)                          \
    double s##_numbers[DIRECTION_NUMBERS];    \
    Direction s = direction_in(s##_numbers)

/* A generated function of what environment_at and me->res point to. */
#define CALL(name) model_##name(me->arg, me->res, me->iw, me->w, me->s.laws)

int parameter_direction(unsigned reference, Direction *s, double *start);

/* equations.c: evaluation of the generated functions */
const double **environment_at(Instance *me, const double *t, const double *x, const double *u);
void begin_loop(Instance *me);
int solve_loop(Instance *me, double t, const double *x, const double *u);
int factorise_loop(Instance *me, double t, const double *x, const double *u);
void solve_linear_loop(Instance *me, double *b);
int right_hand_side(Instance *me, double t, const double *x, double *dx);
int linearise(Instance *me, double t, const double *x);
int with_slopes_of_inputs(Instance *me, double t, const double *x);
int second_derivatives(Instance *me, double t, const double *x, double *second);
void input_at(Instance *me, double t);
void relations_within(Instance *me, double slack, double t, const double *x, const double *u, double *m);
void relations(Instance *me, double t, const double *x, const double *u, double *m);
int relations_for_input(Instance *me, double *kept);
int evaluate_derivatives(Instance *me);
int evaluate_variables(Instance *me);
void environment_along(Instance *me, const double *t, const double *x, const double *u, const Direction *s, int first);
void loop_environment_along(Instance *me, const double *t, const double *x, const double *u, const Direction *s);
int partials_along(Instance *me, double t, const double *x, const double *u, Direction *s);

/* directions.c, assertions.c */
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

/* least_norm.c */
double initial_nominal(int i);
int factorise_initial(Instance *me);
void solve_linear_initial(Instance *me, double *b);
int is_initial(const Instance *me, const double *v, const double *r);
void free_initial(Instance *me);

/* initialise.c */
void set_defaults(Instance *me);
Status initialise(Instance *me);

/* events.c */
int event_indicators(Instance *me, double *g);
Status event_iteration(Instance *me, int initial);
void find_event(Instance *me, double from, double to, int samples);
void watch_chattering(Instance *me);

/* past.c, delays.c */
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

/* transport.c */
const double *with_transports(Instance *me, const double *u);

/* dense_output.c */
void dense_output(const Step *step, double t, double *x);

/* kinks.c */
double first_kink(Instance *me, double h, int again);
double next_kink(Instance *me, double from, double to, double *start, int *known, double *smooth);

/* As fmax, for the loops over all states: compilers may not inline what libm does with zeros. A NaN is passed over. */
static inline double larger(double a, double b) { return a > b || isnan(b) ? a : b; }

/* stages.c */
double tolerance_of(const State *s, int i, double x);
void begin_step(Step *step);
double try_step(Instance *me, double t, double h);
const char *culprit(const Instance *me);

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

/* arrays.c */
size_t lend_state(State *s, char *block);
size_t lend_instance(Instance *me, char *block);

/* lifecycle.c: creation, the complete state, arrays of model exchange */
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
