/* What the parts of the stepper share. Mirrored in stepper.py, field by field. */
#ifndef FMUID_STEPPER_H
#define FMUID_STEPPER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef void *Instance;

/* How a value is stored on the FMU's side; fmi2Integer and fmi2Boolean are INT32, fmi3Boolean is UINT8. */
enum { FLOAT64, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64 };

/* The functions of an FMU that are called here, the same places for FMI 2.0 and 3.0. */
enum {
    RESET, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION, TERMINATE, DO_STEP, SET_INPUT_DERIVATIVES,
    GET_BOOLEAN_STATUS, ENTER_EVENT_MODE, UPDATE_DISCRETE_STATES, ENTER_CONTINUOUS_TIME_MODE,
    COMPLETED_INTEGRATOR_STEP, SET_TIME, SET_STATES, GET_STATES, GET_DERIVATIVES, GET_INDICATORS, GET_NOMINALS,
    GET_FMU_STATE, SET_FMU_STATE, FREE_FMU_STATE, SET_DIRECTIONS, SET_INPUT_DIRECTIONS,
    GET_SENSITIVITIES, GET_DIRECTIONAL_DERIVATIVE, SET_VALUES, GET_VALUES, N_FUNCTIONS
};

enum { SAMPLES = 8 }; /* whose derivatives are put among the outputs together: that fills lines of the cache */

/* Why a run ended; mirrored in stepper.py. */
enum { DONE, PAUSED, CALL_FAILED, NOT_FINITE, TERMINATED, EARLY_RETURN, STEP_TOO_SMALL, EVENTS_DO_NOT_SETTLE, LOOP_NOT_SOLVED,
       NOT_DIFFERENTIABLE = 100 }; /* the last one only inside of FMUs with laws */

typedef struct {           /* variables of one type, set or read by one call */
    void *function;        /* fmi2SetReal, fmi3GetFloat64, ... */
    const uint32_t *references;
    size_t n_references;
    size_t n_values;       /* of the buffer; more than n_references if there are FMI 3.0 arrays */
    int32_t type;
    int32_t direct;        /* the buffer is laid out as the row of numbers: no copying */
    int32_t n_columns;
    int32_t after;         /* outputs: read after the inputs of the sample act, else before */
    const int32_t *column; /* where in the row of numbers ... */
    const int32_t *place;  /* ... and where in the buffer */
    void *buffer;
} Group;

typedef struct {
    Instance instance;
    void *function[N_FUNCTIONS];
    int32_t fmi;            /* 2 or 3 */
    int32_t model_exchange;
    int32_t reset;          /* the instance has run before */
    int32_t linear;         /* inputs are interpolated, else held */
    int32_t tolerance_defined;
    int32_t completed_step_needed;
    int32_t rewinds;        /* a step may be taken again from a state before it */
    double tolerance;
    double stop;
    double fixed_step;      /* size of every step of co-simulation, 0: from sample to sample */
    size_t n_times, n_inputs, n_outputs, n_starts, n_states, n_indicators;
    const double *time;     /* (n_times) */
    const double *inputs;   /* (n_times, n_inputs) */
    const double *starts;
    double *outputs;        /* (n_outputs, n_times), with directions (1 + n_directions, n_outputs, n_times) */
    double *row;            /* scratch, max(n_inputs, n_outputs) */
    int32_t n_start_groups, n_input_groups, n_output_groups, n_slope_groups, n_slopes;
    const Group *start_groups, *input_groups, *output_groups;
    const Group *slope_groups;        /* continuous inputs, to interpolate them ... */
    const uint32_t *slope_references; /* ... or to have them interpolated by fmi2SetRealInputDerivatives */
    const int32_t *slope_columns;
    const int32_t *slope_orders;      /* all one */
    double *slopes;
    /* derivatives of the outputs along directions, by the functions that FMUs of fmu_build export */
    size_t n_directions, n_moved;
    const uint32_t *moved;             /* (n_moved) parameters */
    const double *weights;             /* (n_directions, n_moved) */
    const uint32_t *output_references; /* (n_outputs) */
    double *sensitivities;             /* scratch, (SAMPLES, n_outputs, n_directions) ... */
    size_t n_kept;                     /* ... samples in it that are not among the outputs yet */
    size_t n_driven;                   /* inputs that move along the directions ... */
    const uint32_t *driven;            /* (n_driven) */
    const int32_t *driven_lines;       /* (n_driven) ... on lines between the samples, else held */
    const double *seeds;               /* (n_times, n_driven, n_directions) */
    double *rates;                     /* scratch, (n_driven, n_directions) */
    /* output feedback of model exchange: x += gain (measured - outputs) at every communication point */
    const double *measured; /* (n_outputs, length of the task), NaN: nothing to correct by; NULL: no feedback */
    const double *gain;     /* (n_states, n_outputs) */
    size_t n_measured;      /* length of a row of `measured` */
    /* model exchange: see model_exchange.c */
    double *work;
    int32_t *pivots;
    const uint32_t *derivative_references; /* of derivatives, then of states, for the FMU's directional derivatives; NULL: differences */
    double step_size;
    double next_event;
    int32_t next_event_defined;
    /* runs that share their beginning: where to go on from, and where to keep a state for others */
    void *from;             /* state of the FMU at sample `begin`, up to which the outputs are there; NULL: from the start */
    int64_t begin;
    int64_t branch;         /* sample at which the state is kept, -1: nowhere */
    void *kept;             /* the state, NULL until then */
    /* progress and outcome */
    int64_t reached;        /* last communication point whose outputs are there, -1 before initialisation */
    int32_t status;         /* fmi status of the call that failed */
    int32_t call;           /* its place in `function` */
    int32_t column;         /* output that is not finite */
    double reached_time;
    double taken;           /* s of stepping since the run began, or went on */
} Plan;

/* When a run looks at the clock: seldom enough to cost nothing, and soon after a slow step, which may be the first of many. */
typedef struct {
    double begun, looked;
    int64_t stride;         /* steps until the next look */
} Pace;

Pace begin_pace(void);
double look_at_clock(Pace *pace); /* s since it began */
void fmuid_clear_log(void);

typedef int32_t (*Plain)(Instance);

static inline int32_t fail(Plan *plan, int32_t place, int32_t status)
{
    plan->call = place;
    plan->status = status;
    return CALL_FAILED;
}

/* Call the FMU's function at `place`; leave if it answers Discard, Error or Fatal. */
#define CALL(place, type, ...) \
    do { \
        int32_t status_ = ((type)plan->function[place])(__VA_ARGS__); \
        if (status_ > 1) return fail(plan, place, status_); \
    } while (0)
/* Leave with what went wrong, if anything did. */
#define TRY(expression) do { int32_t outcome_ = (expression); if (outcome_ != DONE) return outcome_; } while (0)

static inline int32_t exchange(Plan *plan, int32_t fmi, const Group *g, int32_t place, void *buffer)
{
    int32_t status;
    if (fmi == 2)
        status = ((int32_t (*)(Instance, const uint32_t *, size_t, void *))g->function)(
            plan->instance, g->references, g->n_references, buffer);
    else
        status = ((int32_t (*)(Instance, const uint32_t *, size_t, void *, size_t))g->function)(
            plan->instance, g->references, g->n_references, buffer, g->n_values);
    return status > 1 ? fail(plan, place, status) : DONE;
}

#define EACH(statement) for (int32_t i = 0; i < g->n_columns; i++) { statement; } break
#define PUT(T) EACH(((T *)g->buffer)[g->place[i]] = (T)row[g->column[i]])

/* Into the buffer of variables. */
static inline void put_values(const Group *g, const double *row)
{
    switch (g->type) {
    case FLOAT64: PUT(double);
    case FLOAT32: PUT(float);
    case INT8: PUT(int8_t);
    case UINT8: PUT(uint8_t);
    case INT16: PUT(int16_t);
    case UINT16: PUT(uint16_t);
    case INT32: PUT(int32_t);
    case UINT32: PUT(uint32_t);
    case INT64: PUT(int64_t);
    default: PUT(uint64_t);
    }
}

static inline int32_t set_values(Plan *plan, const Group *groups, int32_t n_groups, const double *row)
{
    for (const Group *g = groups; g < groups + n_groups; g++) {
        if (!g->direct) put_values(g, row);
        TRY(exchange(plan, plan->fmi, g, SET_VALUES, g->direct ? (void *)row : g->buffer));
    }
    return DONE;
}

/* Derivatives of the FMU itself at a point. */
static inline int32_t derivatives_at(Plan *plan, const double *input, double t, const double *x, size_t n, double *f)
{
    CALL(SET_TIME, int32_t (*)(Instance, double), plan->instance, t);
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, input));
    if (n == 0) return DONE;
    CALL(SET_STATES, int32_t (*)(Instance, const double *, size_t), plan->instance, x, n);
    CALL(GET_DERIVATIVES, int32_t (*)(Instance, double *, size_t), plan->instance, f, n);
    return DONE;
}

/* Derivatives of what `references` name by a state, at the point that is set: false if the FMU does not give them. */
static inline bool directional(Plan *plan, const uint32_t *references, size_t n, uint32_t state, double *to)
{
    void *function = plan->function[GET_DIRECTIONAL_DERIVATIVE];
    const double one = 1;
    if (!function) return false;
    if (plan->fmi == 2)
        return ((int32_t (*)(Instance, const uint32_t *, size_t, const uint32_t *, size_t, const double *, double *))function)(
                   plan->instance, references, n, &state, 1, &one, to) <= 1;
    return ((int32_t (*)(Instance, const uint32_t *, size_t, const uint32_t *, size_t, const double *, size_t, double *,
                         size_t))function)(plan->instance, references, n, &state, 1, &one, 1, to, n) <= 1;
}

int32_t get_values(Plan *plan, double *row);
int32_t enter_initialisation(Plan *plan);
int32_t do_step(Plan *plan, size_t k);
int32_t begin_model_exchange(Plan *plan);
int32_t integrate(Plan *plan, size_t k);
int32_t act(Plan *plan, size_t k);
int32_t settle_events(Plan *plan);
int32_t feed_back(Plan *plan, size_t k);

/* Laws that are added to the derivatives of model exchange: laws.c, in the library of FMUs with laws; the stepper has none. */
#ifdef FMUID_WITH_LAWS
size_t added_states(const Plan *plan); /* of plan->n_states, the last ones */
bool parameters_vary(const Plan *plan); /* then the FMU's own directional derivatives are not those of the model */
int32_t add_laws(Plan *plan, const double *input, double t, const double *x, double *f);
void start_laws(const Plan *plan, const double *input, double t, double *x);
bool has_directions(const Plan *plan); /* derivatives of the states are integrated as well */
#else
#define added_states(plan) ((void)(plan), (size_t)0)
#define parameters_vary(plan) ((void)(plan), false)
#define add_laws(plan, input, t, x, f) DONE
#define start_laws(plan, input, t, x) ((void)0)
#define has_directions(plan) ((void)(plan), false)
#define follow_directions(plan, w, k, t, end) DONE
#endif

#endif
