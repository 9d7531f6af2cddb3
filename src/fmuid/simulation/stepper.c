/* The loop over communication points for any FMU: FMI 2.0 and 3.0, co-simulation and model exchange.
 *
 * One call of fmuid_run is one whole simulation: reset, set start values, initialise, then set inputs, step and
 * read outputs at every communication point. The caller (stepper.py) fills in a Plan.
 */
#include "stepper.h"

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define TAKE(T) EACH(row[g->column[i]] = (double)((const T *)g->buffer)[g->place[i]])

/* Read all outputs, or only those that are read after the inputs act. */
static int32_t get_groups(Plan *plan, double *row, bool after)
{
    for (const Group *g = plan->output_groups; g < plan->output_groups + plan->n_output_groups; g++) {
        if (after && !g->after) continue;
        TRY(exchange(plan, plan->fmi, g, GET_VALUES, g->direct ? row : g->buffer));
        if (g->direct) continue;
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
    return DONE;
}

int32_t get_values(Plan *plan, double *row) { return get_groups(plan, row, false); }

int32_t fmuid_reads_after(const Plan *plan)
{
    for (const Group *g = plan->output_groups; g < plan->output_groups + plan->n_output_groups; g++)
        if (g->after) return 1;
    return 0;
}

static int32_t get_sensitivities(Plan *plan, size_t first, size_t count, double *to)
{
    CALL(GET_SENSITIVITIES, int32_t (*)(Instance, const uint32_t *, size_t, double *), plan->instance,
         plan->output_references + first, count, to);
    return DONE;
}

static double *sensitivities_now(const Plan *plan)
{
    return plan->sensitivities + plan->n_kept * plan->n_outputs * plan->n_directions;
}

/* How inputs move along the directions from a sample to the next. */
static int32_t drive(Plan *plan, size_t k)
{
    if (plan->n_driven == 0) return DONE;
    const size_t n = plan->n_directions, size = plan->n_driven * n;
    const double *seed = plan->seeds + k * size;
    for (size_t i = 0; k + 1 < plan->n_times && i < size; i++)
        plan->rates[i] = plan->driven_lines[i / n] ? (seed[size + i] - seed[i]) / (plan->time[k + 1] - plan->time[k]) : 0;
    CALL(SET_INPUT_DIRECTIONS, int32_t (*)(Instance, const uint32_t *, size_t, const double *, const double *),
         plan->instance, plan->driven, plan->n_driven, seed, plan->rates);
    return DONE;
}

/* Let the inputs of the sample act, and read again the outputs that a machine reads after that. */
static int32_t read_after(Plan *plan, size_t k)
{
    if (plan->model_exchange)
        TRY(act(plan, k));
    else
        TRY(set_values(plan, plan->input_groups, plan->n_input_groups, plan->inputs + k * plan->n_inputs));
    TRY(get_groups(plan, plan->row, true));
    if (plan->n_directions == 0) return DONE;
    TRY(drive(plan, k));
    for (const Group *g = plan->output_groups; g < plan->output_groups + plan->n_output_groups; g++)
        for (int32_t i = 0; g->after && i < g->n_columns; i++) {
            size_t j = (size_t)g->column[i];
            TRY(get_sensitivities(plan, j, 1, sensitivities_now(plan) + j * plan->n_directions));
        }
    return DONE;
}

static int32_t keep_sensitivities(Plan *plan, size_t k)
{
    const size_t n = plan->n_outputs, directions = plan->n_directions, size = n * directions;
    double *now = sensitivities_now(plan);
    for (size_t i = 0; i < size; i++)
        if (!isfinite(now[i])) {
            plan->column = (int32_t)(i / directions);
            plan->reached_time = plan->time[k];
            return NOT_FINITE;
        }
    if (++plan->n_kept < SAMPLES && k + 1 < plan->n_times) return DONE;
    for (size_t d = 0; d < directions; d++)
        for (size_t j = 0; j < n; j++) {
            double *row = plan->outputs + ((1 + d) * n + j) * plan->n_times + (k + 1 - plan->n_kept);
            for (size_t i = 0; i < plan->n_kept; i++) row[i] = plan->sensitivities[i * size + j * directions + d];
        }
    plan->n_kept = 0;
    return DONE;
}

static int32_t read_outputs(Plan *plan, size_t k)
{
    double *row = plan->row;
    TRY(get_values(plan, row));
    if (plan->n_directions > 0) TRY(get_sensitivities(plan, 0, plan->n_outputs, sensitivities_now(plan)));
    if (k > 0 && fmuid_reads_after(plan)) TRY(read_after(plan, k)); /* at first, the inputs act already */
    for (size_t j = 0; j < plan->n_outputs; j++) {
        plan->outputs[j * plan->n_times + k] = row[j];
        if (!isfinite(row[j])) {
            plan->column = (int32_t)j;
            plan->reached_time = plan->time[k];
            return NOT_FINITE;
        }
    }
    if (plan->n_directions > 0) TRY(keep_sensitivities(plan, k));
    if (plan->measured) TRY(feed_back(plan, k));
    plan->reached = (int64_t)k;
    plan->reached_time = plan->time[k];
    return DONE;
}

int32_t enter_initialisation(Plan *plan)
{
    Instance c = plan->instance;
    plan->reached = -1;
    plan->reached_time = plan->time[0];
    if (plan->reset) CALL(RESET, Plain, c);
    if (plan->fmi == 2)
        CALL(SETUP_EXPERIMENT, int32_t (*)(Instance, int, double, double, int, double), c, plan->tolerance_defined,
             plan->tolerance, plan->time[0], 1, plan->stop);
    if (plan->n_directions > 0)
        CALL(SET_DIRECTIONS, int32_t (*)(Instance, const uint32_t *, size_t, const double *, size_t), c, plan->moved,
             plan->n_moved, plan->weights, plan->n_directions);
    TRY(set_values(plan, plan->start_groups, plan->n_start_groups, plan->starts));
    if (plan->fmi == 2)
        CALL(ENTER_INITIALIZATION, Plain, c);
    else
        CALL(ENTER_INITIALIZATION, int32_t (*)(Instance, bool, double, double, bool, double), c,
             (bool)plan->tolerance_defined, plan->tolerance, plan->time[0], true, plan->stop);
    return DONE;
}

static int32_t initialise(Plan *plan)
{
    TRY(enter_initialisation(plan));
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, plan->inputs));
    TRY(drive(plan, 0));
    CALL(EXIT_INITIALIZATION, Plain, plan->instance);
    return DONE;
}

static inline int32_t advance(Plan *plan, int32_t fmi, double t, double h)
{
    Instance c = plan->instance;
    if (fmi == 2) {
        int32_t status = ((int32_t (*)(Instance, double, double, int))plan->function[DO_STEP])(c, t, h, !plan->rewinds);
        if (status == 2 && plan->function[GET_BOOLEAN_STATUS]) { /* discarded: perhaps it ended the simulation */
            int terminated = 0;
            int32_t answer = ((int32_t (*)(Instance, int, int *))plan->function[GET_BOOLEAN_STATUS])(c, 3, &terminated);
            if (answer <= 1 && terminated) return TERMINATED;
        }
        return status > 1 ? fail(plan, DO_STEP, status) : DONE;
    }
    bool event = false, terminate = false, early = false;
    double last = t;
    CALL(DO_STEP, int32_t (*)(Instance, double, double, bool, bool *, bool *, bool *, double *), c, t, h,
         !plan->rewinds, &event, &terminate, &early, &last);
    if (terminate) return TERMINATED;
    if (early) {
        plan->reached_time = last;
        return EARLY_RETURN;
    }
    return DONE;
}

/* Have the FMU interpolate the inputs u of a sample to those of the next, h later. */
static int32_t move_inputs(Plan *plan, const double *u, double h)
{
    if (plan->n_slopes == 0 || plan->fmi != 2) return DONE;
    for (int32_t i = 0; i < plan->n_slopes; i++) {
        int32_t j = plan->slope_columns[i];
        plan->slopes[i] = (u[plan->n_inputs + j] - u[j]) / h;
    }
    CALL(SET_INPUT_DERIVATIVES, int32_t (*)(Instance, const uint32_t *, size_t, const int32_t *, const double *),
         plan->instance, plan->slope_references, (size_t)plan->n_slopes, plan->slope_orders, plan->slopes);
    return DONE;
}

int32_t do_step(Plan *plan, size_t k)
{
    const double begin = plan->time[0], fixed = plan->fixed_step, *u = plan->inputs + k * plan->n_inputs;
    const double size = plan->time[k + 1] - plan->time[k];
    if (fixed == 0) {
        TRY(set_values(plan, plan->input_groups, plan->n_input_groups, u));
        TRY(drive(plan, k));
        TRY(move_inputs(plan, u, size));
        return advance(plan, plan->fmi, plan->time[k], size);
    }
    /* Counted from the first sample, so that rounded times of samples do not add up. */
    const int64_t first = llround((plan->time[k] - begin) / fixed), end = llround((plan->time[k + 1] - begin) / fixed);
    for (int64_t i = first; i < end; i++) {
        memcpy(plan->row, u, plan->n_inputs * sizeof *u);
        for (int32_t s = 0; s < plan->n_slopes; s++) {
            const int32_t j = plan->slope_columns[s];
            plan->row[j] += (u[plan->n_inputs + j] - u[j]) * ((double)(i - first) / (double)(end - first));
        }
        TRY(set_values(plan, plan->input_groups, plan->n_input_groups, plan->row));
        TRY(move_inputs(plan, u, size));
        TRY(advance(plan, plan->fmi, begin + (double)i * fixed, fixed));
    }
    return DONE;
}

static int32_t any_steps(Plan *plan, size_t k, size_t last)
{
    for (; k < last; k++) {
        TRY(plan->model_exchange ? integrate(plan, k) : do_step(plan, k));
        TRY(read_outputs(plan, k + 1));
    }
    return DONE;
}

static bool all_real(const Plan *plan)
{
    return !plan->model_exchange && plan->fixed_step == 0 && plan->n_directions == 0 && plan->n_slopes == 0 && !fmuid_reads_after(plan) && plan->n_output_groups == 1 && plan->output_groups->direct
        && (plan->n_input_groups == 0 || (plan->n_input_groups == 1 && plan->input_groups->direct));
}

/* The same for the usual case, real scalars in and out, with everything at hand: an FMU's step may take 20 ns. */
static inline int32_t real_steps_of(Plan *plan, int32_t fmi, size_t k, size_t last)
{
    const Group inputs = plan->n_input_groups ? plan->input_groups[0] : (Group){0}, outputs = plan->output_groups[0];
    const size_t n_inputs = plan->n_inputs, n_outputs = plan->n_outputs, n_times = plan->n_times;
    const double *const time = plan->time, *u = plan->inputs + k * n_inputs;
    double *const row = plan->row, *y = plan->outputs + k + 1;
    for (; k < last; k++, u += n_inputs, y++) {
        if (n_inputs > 0) TRY(exchange(plan, fmi, &inputs, SET_VALUES, (void *)u));
        TRY(advance(plan, fmi, time[k], time[k + 1] - time[k]));
        TRY(exchange(plan, fmi, &outputs, GET_VALUES, row));
        bool finite = true;
        for (size_t j = 0; j < n_outputs; j++) {
            double value = row[j];
            y[j * n_times] = value;
            finite &= fabs(value) <= DBL_MAX;
        }
        if (!finite) return read_outputs(plan, k + 1); /* which finds out which one it is */
        plan->reached = (int64_t)k + 1;
        plan->reached_time = time[k + 1];
    }
    return DONE;
}

static int32_t real_steps(Plan *plan, size_t k, size_t last)
{
    return plan->fmi == 2 ? real_steps_of(plan, 2, k, last) : real_steps_of(plan, 3, k, last);
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

Pace begin_pace(void)
{
    double now = seconds();
    return (Pace){now, now, 1};
}

double look_at_clock(Pace *pace)
{
    double now = seconds();
    pace->stride = now - pace->looked < 2e-5 ? (pace->stride < 64 ? 2 * pace->stride : 64) : (pace->stride + 1) / 2;
    pace->looked = now;
    return now - pace->begun;
}

/* Simulate, or go on where the last call paused; returns PAUSED after about `slice` seconds. */
int32_t fmuid_run(Plan *plan, int32_t resume, double slice)
{
    if (!resume) {
        fmuid_clear_log();
        plan->n_kept = 0;
    }
    if (!resume && plan->from) {
        CALL(SET_FMU_STATE, int32_t (*)(Instance, void *), plan->instance, plan->from);
        plan->reached = plan->begin;
        plan->reached_time = plan->time[plan->begin];
    } else if (!resume) {
        TRY(initialise(plan));
        if (plan->model_exchange) TRY(begin_model_exchange(plan));
        TRY(read_outputs(plan, 0));
    }
    int32_t (*steps)(Plan *, size_t, size_t) = all_real(plan) ? real_steps : any_steps;
    Pace pace = begin_pace();
    size_t end = plan->n_times - 1;
    for (size_t k = (size_t)plan->reached, next; k < end; k = next) {
        next = (size_t)pace.stride < end - k ? k + (size_t)pace.stride : end;
        if ((int64_t)k < plan->branch && (int64_t)next > plan->branch) next = (size_t)plan->branch;
        if ((int64_t)k == plan->branch && !plan->kept)
            CALL(GET_FMU_STATE, int32_t (*)(Instance, void **), plan->instance, &plan->kept);
        TRY(steps(plan, k, next));
        plan->taken = look_at_clock(&pace);
        if (plan->taken > slice && next < end) return PAUSED;
    }
    /* Results are complete: what Terminate answers cannot change them. */
    if (plan->function[TERMINATE]) ((Plain)plan->function[TERMINATE])(plan->instance);
    return DONE;
}

/* At n points of a run for model exchange, which is only begun: derivatives f and outputs y, one row for a point, and their derivatives by the states, `slope`
 * (points, states, derivatives and outputs), unless NULL. `references` are those of states, derivatives and outputs if the FMU offers
 * directional derivatives, else NULL, and differences are taken over `steps` of the states. */
int32_t fmuid_linearise(Plan *plan, size_t n, const double *t, const double *x, const double *u, const double *steps,
                        const uint32_t *references, double *f, double *y, double *slope, double *moved)
{
    const size_t nx = plan->n_states, ny = plan->n_outputs, size = nx + ny;
    fmuid_clear_log();
    TRY(initialise(plan));
    TRY(begin_model_exchange(plan));
    for (size_t k = 0; k < n; k++) {
        const double *here = x + k * nx, *input = u + k * plan->n_inputs;
        TRY(derivatives_at(plan, input, t[k], here, nx, f + k * nx));
        TRY(get_values(plan, y + k * ny));
        for (size_t j = 0; slope && j < nx; j++) {
            double *column = slope + (k * nx + j) * size;
            if (references && directional(plan, references + nx, size, references[j], column)) continue;
            memcpy(moved, here, nx * sizeof(double));
            double *ends = moved + nx;
            for (int side = 0; side < 2; side++) {
                moved[j] = here[j] + (side ? -steps[j] : steps[j]);
                TRY(derivatives_at(plan, input, t[k], moved, nx, ends + side * size));
                TRY(get_values(plan, ends + side * size + nx));
            }
            for (size_t i = 0; i < size; i++) column[i] = (ends[i] - ends[size + i]) / (2 * steps[j]);
            TRY(derivatives_at(plan, input, t[k], here, nx, f + k * nx));
        }
    }
    if (plan->function[TERMINATE]) ((Plain)plan->function[TERMINATE])(plan->instance);
    return DONE;
}

int32_t fmuid_plan_size(void) { return (int32_t)sizeof(Plan); } /* to see that caller and library are of one version */
