/* The loop over communication points for any FMU: FMI 2.0 and 3.0, co-simulation and model exchange.
 *
 * One call of fmuid_run is one whole simulation: reset, set start values, initialise, then set inputs, step and
 * read outputs at every communication point. The caller (stepper.py) fills in a Plan whose layout is mirrored
 * there field by field; stepper_python.py does the same without a compiler, call by call and digit by digit.
 */
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef void *Instance;

/* How a value is stored on the FMU's side; fmi2Integer and fmi2Boolean are INT32, fmi3Boolean is UINT8. */
enum { FLOAT64, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64 };

/* The functions of an FMU that are called here, the same places for FMI 2.0 and 3.0. */
enum {
    RESET, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION, TERMINATE, DO_STEP, SET_INPUT_DERIVATIVES,
    GET_BOOLEAN_STATUS, ENTER_EVENT_MODE, UPDATE_DISCRETE_STATES, ENTER_CONTINUOUS_TIME_MODE,
    COMPLETED_INTEGRATOR_STEP, SET_TIME, SET_STATES, GET_STATES, GET_DERIVATIVES, GET_INDICATORS, GET_NOMINALS,
    SET_VALUES, GET_VALUES, N_FUNCTIONS
};

/* Why a run ended; mirrored in stepper.py. */
enum { DONE, PAUSED, CALL_FAILED, NOT_FINITE, TERMINATED, EARLY_RETURN, STEP_TOO_SMALL, EVENTS_DO_NOT_SETTLE, NO_MEMORY };

typedef struct {           /* variables of one type, set or read by one call */
    void *function;        /* fmi2SetReal, fmi3GetFloat64, ... */
    const uint32_t *references;
    size_t n_references;
    size_t n_values;       /* of the buffer; more than n_references if there are FMI 3.0 arrays */
    int32_t type;
    int32_t n_columns;
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
    double tolerance;
    double stop;
    size_t n_times, n_inputs, n_outputs, n_starts, n_states, n_indicators;
    const double *time;     /* (n_times) */
    const double *inputs;   /* (n_times, n_inputs) */
    const double *starts;
    double *outputs;        /* (n_outputs, n_times) */
    double *row;            /* scratch, max(n_inputs, n_outputs) */
    int32_t n_start_groups, n_input_groups, n_output_groups, n_slopes;
    const Group *start_groups, *input_groups, *output_groups;
    const uint32_t *slope_references; /* continuous real inputs, for fmi2SetRealInputDerivatives */
    const int32_t *slope_columns;
    const int32_t *slope_orders;      /* all one */
    double *slopes;
    void *integrator;       /* state of the model-exchange integrator between pauses */
    /* progress and outcome */
    int64_t reached;        /* last communication point whose outputs are there, -1 before initialisation */
    int32_t status;         /* fmi status of the call that failed */
    int32_t call;           /* its place in `function` */
    int32_t column;         /* output that is not finite */
    int32_t unused;
    double reached_time;
} Plan;

typedef int32_t (*Plain)(Instance);

#define CALL(place, type, ...) \
    do { \
        int32_t status_ = ((type)plan->function[place])(__VA_ARGS__); \
        if (status_ > 1) return fail(plan, place, status_); \
    } while (0)
#define TRY(expression) do { int32_t outcome_ = (expression); if (outcome_ != DONE) return outcome_; } while (0)

static int32_t fail(Plan *plan, int32_t place, int32_t status)
{
    plan->call = place;
    plan->status = status;
    return CALL_FAILED;
}

static int32_t exchange(Plan *plan, const Group *g, int32_t place)
{
    int32_t status;
    if (plan->fmi == 2)
        status = ((int32_t (*)(Instance, const uint32_t *, size_t, void *))g->function)(
            plan->instance, g->references, g->n_references, g->buffer);
    else
        status = ((int32_t (*)(Instance, const uint32_t *, size_t, void *, size_t))g->function)(
            plan->instance, g->references, g->n_references, g->buffer, g->n_values);
    return status > 1 ? fail(plan, place, status) : DONE;
}

#define EACH(statement) for (int32_t i = 0; i < g->n_columns; i++) { statement; } break
#define PUT(T) EACH(((T *)g->buffer)[g->place[i]] = (T)row[g->column[i]])
#define TAKE(T) EACH(row[g->column[i]] = (double)((const T *)g->buffer)[g->place[i]])

static int32_t set_values(Plan *plan, const Group *groups, int32_t n_groups, const double *row)
{
    for (const Group *g = groups; g < groups + n_groups; g++) {
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
        TRY(exchange(plan, g, SET_VALUES));
    }
    return DONE;
}

static int32_t read_outputs(Plan *plan, size_t k)
{
    double *row = plan->row;
    for (const Group *g = plan->output_groups; g < plan->output_groups + plan->n_output_groups; g++) {
        TRY(exchange(plan, g, GET_VALUES));
        switch (g->type) {
        case FLOAT64: TAKE(double);
        case FLOAT32: TAKE(float);
        case INT8: TAKE(int8_t);
        case UINT8: TAKE(uint8_t);
        case INT16: TAKE(int16_t);
        case UINT16: TAKE(uint16_t);
        case INT32: TAKE(int32_t);
        case UINT32: TAKE(uint32_t);
        case INT64: TAKE(int64_t);
        default: TAKE(uint64_t);
        }
    }
    for (size_t j = 0; j < plan->n_outputs; j++) {
        plan->outputs[j * plan->n_times + k] = row[j];
        if (!isfinite(row[j])) {
            plan->column = (int32_t)j;
            plan->reached_time = plan->time[k];
            return NOT_FINITE;
        }
    }
    plan->reached = (int64_t)k;
    plan->reached_time = plan->time[k];
    return DONE;
}

static int32_t initialise(Plan *plan)
{
    Instance c = plan->instance;
    plan->reached = -1;
    plan->reached_time = plan->time[0];
    if (plan->reset) CALL(RESET, Plain, c);
    if (plan->fmi == 2)
        CALL(SETUP_EXPERIMENT, int32_t (*)(Instance, int, double, double, int, double), c, plan->tolerance_defined,
             plan->tolerance, plan->time[0], 1, plan->stop);
    TRY(set_values(plan, plan->start_groups, plan->n_start_groups, plan->starts));
    if (plan->fmi == 2)
        CALL(ENTER_INITIALIZATION, Plain, c);
    else
        CALL(ENTER_INITIALIZATION, int32_t (*)(Instance, bool, double, double, bool, double), c,
             (bool)plan->tolerance_defined, plan->tolerance, plan->time[0], true, plan->stop);
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, plan->inputs));
    CALL(EXIT_INITIALIZATION, Plain, c);
    return DONE;
}

static int32_t do_step(Plan *plan, size_t k)
{
    Instance c = plan->instance;
    const double t = plan->time[k], h = plan->time[k + 1] - t, *u = plan->inputs + k * plan->n_inputs;
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, u));
    if (plan->fmi == 2) {
        if (plan->n_slopes > 0) {
            for (int32_t i = 0; i < plan->n_slopes; i++) {
                int32_t j = plan->slope_columns[i];
                plan->slopes[i] = (u[plan->n_inputs + j] - u[j]) / h;
            }
            CALL(SET_INPUT_DERIVATIVES, int32_t (*)(Instance, const uint32_t *, size_t, const int32_t *, const double *),
                 c, plan->slope_references, (size_t)plan->n_slopes, plan->slope_orders, plan->slopes);
        }
        int32_t status = ((int32_t (*)(Instance, double, double, int))plan->function[DO_STEP])(c, t, h, 1);
        if (status == 2 && plan->function[GET_BOOLEAN_STATUS]) { /* discarded: perhaps it ended the simulation */
            int terminated = 0;
            int32_t answer = ((int32_t (*)(Instance, int, int *))plan->function[GET_BOOLEAN_STATUS])(c, 3, &terminated);
            if (answer <= 1 && terminated) return TERMINATED;
        }
        return status > 1 ? fail(plan, DO_STEP, status) : DONE;
    }
    bool event = false, terminate = false, early = false;
    double last = t;
    CALL(DO_STEP, int32_t (*)(Instance, double, double, bool, bool *, bool *, bool *, double *), c, t, h, true, &event,
         &terminate, &early, &last);
    if (terminate) return TERMINATED;
    if (early) {
        plan->reached_time = last;
        return EARLY_RETURN;
    }
    return DONE;
}

/* ---- The FMU's log: the messages of the highest severity since the last fmuid_clear_log of this thread. ---- */

#ifdef _MSC_VER
#define THREAD_LOCAL __declspec(thread)
#else
#define THREAD_LOCAL _Thread_local
#endif

static THREAD_LOCAL struct { int32_t severity; size_t length; char text[1024]; } kept;

void fmuid_clear_log(void) { memset(&kept, 0, sizeof kept); }

const char *fmuid_read_log(void) { return kept.text; }

static void keep(int32_t severity, const char *message, va_list *values)
{
    if (severity < 1 || severity < kept.severity || message == NULL) return;
    if (severity > kept.severity) kept.length = 0;
    kept.severity = severity;
    size_t room = sizeof kept.text - kept.length;
    if (room < 8) return;
    const char *comma = kept.length ? ", " : "";
    char *to = kept.text + kept.length;
    int n = snprintf(to, room, "%s", comma), m;
    if (values)
        m = vsnprintf(to + n, room - (size_t)n, message, *values);
    else
        m = snprintf(to + n, room - (size_t)n, "%s", message);
    if (m > 0) kept.length += (size_t)n + ((size_t)m < room - (size_t)n ? (size_t)m : room - (size_t)n - 1);
}

void fmuid_log_fmi2(void *environment, const char *instance, int status, const char *category, const char *message, ...)
{
    (void)environment, (void)instance, (void)category;
    va_list values;
    va_start(values, message);
    keep(status, message, &values);
    va_end(values);
}

void fmuid_log_fmi3(void *environment, int status, const char *category, const char *message)
{
    (void)environment, (void)category;
    keep(status, message, NULL);
}

static double seconds(void)
{
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int32_t begin_model_exchange(Plan *plan);
static int32_t integrate(Plan *plan, size_t k);

/* Simulate, or go on where the last call paused; returns PAUSED after about `slice` seconds. */
int32_t fmuid_run(Plan *plan, int32_t resume, double slice)
{
    if (!resume) {
        TRY(initialise(plan));
        if (plan->model_exchange) TRY(begin_model_exchange(plan));
        TRY(read_outputs(plan, 0));
    }
    double begun = seconds(), checked = begun;
    size_t stride = 1, countdown = 1;
    for (size_t k = (size_t)plan->reached; k + 1 < plan->n_times; k++) {
        TRY(plan->model_exchange ? integrate(plan, k) : do_step(plan, k));
        TRY(read_outputs(plan, k + 1));
        if (--countdown == 0) { /* look at the clock often enough for Ctrl-C, seldom enough to cost nothing */
            double now = seconds();
            if (now - begun > slice && k + 2 < plan->n_times) return PAUSED;
            stride = now - checked < 1e-3 ? 2 * stride : (stride + 1) / 2;
            countdown = stride;
            checked = now;
        }
    }
    /* Results are complete: what Terminate answers cannot change them. */
    if (plan->function[TERMINATE]) ((Plain)plan->function[TERMINATE])(plan->instance);
    return DONE;
}

static int32_t begin_model_exchange(Plan *plan) { return fail(plan, ENTER_EVENT_MODE, 3); }
static int32_t integrate(Plan *plan, size_t k) { (void)k; return fail(plan, ENTER_EVENT_MODE, 3); }
