/* An FMU (FMI 2.0, co-simulation) that contains another one for model exchange and adds laws to its derivatives.
 *
 * `resources/contained` is the other FMU, unpacked, and `resources/laws.txt` says what it has and lists the laws: see
 * fmu_with_laws.py, which writes both. The integrator is that of model_exchange.c. This library depends on libc and libm only.
 * If the other FMU offers directional derivatives, runs are differentiated by parameters as those of FMUs from fmu_build
 * (fmu_build/runtime/sensitivity.h). Such a run fails at its first event, and the caller compares runs instead.
 */
#ifndef _WIN32
#define _POSIX_C_SOURCE 200809L
#endif
#include "laws.h"

#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <windows.h>
#define API __declspec(dllexport)
#define open_library(path) ((void *)LoadLibraryA(path))
#define symbol(library, name) ((void *)GetProcAddress((HMODULE)(library), name))
#define close_library(library) FreeLibrary((HMODULE)(library))
#else
#include <dlfcn.h>
#define API __attribute__((visibility("default")))
#define open_library(path) dlopen(path, RTLD_NOW | RTLD_LOCAL)
#define symbol(library, name) dlsym(library, name)
#define close_library(library) dlclose(library)
#endif

enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { LONGEST = 4096 };
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
} Callbacks;

typedef struct { /* a scalar of the contained FMU */
    uint32_t reference;
    int32_t element, input; /* column of an input, or -1 */
    int given;              /* a value has been set since the last reset */
    int shares;             /* its buffer is that of the element of the array before it */
    double value, start;    /* the start value matters for arrays, which are set as a whole */
    Group set, get;
} Scalar;

typedef struct {
    Callbacks callbacks;
    char *label, *resources, name[LONGEST], token[LONGEST];
    void *library;
    PlanWithLaws run;
    Scalar *scalar;
    Group *input_group;
    size_t n_scalars, n_own_inputs, n_law_inputs;
    double *inputs, *slope, *default_parameter, *default_input, time[2], tolerance;
    int32_t *column;
    uint32_t *directional; /* references of derivatives, then of states, or NULL */
    size_t n_moved, n_held; /* of directions: the parameters that move, and the directions for which there is room */
    unsigned *moved, *moving; /* and those that move in one direction, with their values there */
    double *weight, *value; /* (directions, parameters that move) */
    int initialised, stepped, terminated;
} Me;

static int report(Me *me, const char *format, ...)
{
    char text[1024];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (me->callbacks.logger)
        me->callbacks.logger(me->callbacks.environment, me->label ? me->label : "", ERROR, "logStatusError", "%s", text);
    return ERROR;
}

static void log_of_contained(void *environment, int status, const char *category, const char *message)
{
    Me *me = environment;
    if (me->callbacks.logger)
        me->callbacks.logger(me->callbacks.environment, me->label, status, category ? category : "", "%s", message ? message : "");
}

/* ---- The file laws.txt ---- */

static void *function_of(Me *me, const char *name)
{
    char full[96];
    snprintf(full, sizeof full, "fmi%d%s", (int)me->run.plan.fmi, name);
    return symbol(me->library, full);
}

static int read_line(FILE *file, const char *word, char *text)
{
    char line[LONGEST];
    size_t n = strlen(word);
    if (!fgets(line, sizeof line, file) || strncmp(line, word, n) || line[n] != ' ') return 0;
    line[strcspn(line, "\r\n")] = 0;
    strcpy(text, line + n + 1);
    return 1;
}

static const int32_t FIRST = 0;

static int read_scalar(Me *me, Scalar *scalar, FILE *file)
{
    char suffix[32], name[40];
    int32_t type;
    size_t size;
    if (fscanf(file, "%31s %" SCNd32 " %" SCNu32 " %zu %" SCNd32 " %" SCNd32, suffix, &type, &scalar->reference, &size,
               &scalar->element, &scalar->input) != 6 || !read_double(file, &scalar->start))
        return 0;
    if (type < FLOAT64 || type > UINT64 || size < 1 || size > 1000000 || scalar->element < 0 ||
        (size_t)scalar->element >= size || scalar->input >= (int32_t)me->n_own_inputs)
        return 0;
    scalar->set = (Group){.references = &scalar->reference, .n_references = 1, .n_values = size, .type = type,
                          .n_columns = 1, .column = &FIRST, .place = &scalar->element};
    const Scalar *before = scalar > me->scalar ? scalar - 1 : NULL;
    scalar->shares = size > 1 && before && before->reference == scalar->reference && before->set.n_values == size;
    scalar->set.buffer = scalar->shares ? before->set.buffer : calloc(size, sizeof(double));
    scalar->get = scalar->set;
    snprintf(name, sizeof name, "Set%s", suffix);
    scalar->set.function = function_of(me, name);
    snprintf(name, sizeof name, "Get%s", suffix);
    scalar->get.function = function_of(me, name);
    return scalar->set.buffer && scalar->set.function && scalar->get.function;
}

static const char *const NAMES[2][N_FUNCTIONS] = {
    {[RESET] = "Reset", [SETUP_EXPERIMENT] = "SetupExperiment", [ENTER_INITIALIZATION] = "EnterInitializationMode",
     [EXIT_INITIALIZATION] = "ExitInitializationMode", [TERMINATE] = "Terminate", [ENTER_EVENT_MODE] = "EnterEventMode",
     [UPDATE_DISCRETE_STATES] = "NewDiscreteStates", [ENTER_CONTINUOUS_TIME_MODE] = "EnterContinuousTimeMode",
     [COMPLETED_INTEGRATOR_STEP] = "CompletedIntegratorStep", [SET_TIME] = "SetTime",
     [SET_STATES] = "SetContinuousStates", [GET_STATES] = "GetContinuousStates", [GET_DERIVATIVES] = "GetDerivatives",
     [GET_INDICATORS] = "GetEventIndicators", [GET_NOMINALS] = "GetNominalsOfContinuousStates",
     [GET_DIRECTIONAL_DERIVATIVE] = "GetDirectionalDerivative"},
    {[RESET] = "Reset", [ENTER_INITIALIZATION] = "EnterInitializationMode",
     [EXIT_INITIALIZATION] = "ExitInitializationMode", [TERMINATE] = "Terminate", [ENTER_EVENT_MODE] = "EnterEventMode",
     [UPDATE_DISCRETE_STATES] = "UpdateDiscreteStates", [ENTER_CONTINUOUS_TIME_MODE] = "EnterContinuousTimeMode",
     [COMPLETED_INTEGRATOR_STEP] = "CompletedIntegratorStep", [SET_TIME] = "SetTime",
     [SET_STATES] = "SetContinuousStates", [GET_STATES] = "GetContinuousStates",
     [GET_DERIVATIVES] = "GetContinuousStateDerivatives", [GET_INDICATORS] = "GetEventIndicators",
     [GET_NOMINALS] = "GetNominalsOfContinuousStates", [GET_DIRECTIONAL_DERIVATIVE] = "GetDirectionalDerivative"},
};

static int read_all(Me *me, FILE *file)
{
    Plan *plan = &me->run.plan;
    char text[LONGEST], path[2 * LONGEST];
    int fmi, completed;
    size_t n_states, n_indicators;
    if (!read_line(file, "fmuid-laws", text) || strcmp(text, "5") || !read_line(file, "library", text) ||
        !read_line(file, "name", me->name) || !read_line(file, "token", me->token))
        return 0;
    snprintf(path, sizeof path, "%s/contained/%s", me->resources, text);
    me->library = open_library(path);
    if (!me->library) {
        report(me, "the contained library %s cannot be loaded", path);
        return 0;
    }
    if (fscanf(file, "%d %d %zu %zu %zu %zu %zu", &fmi, &completed, &n_states, &n_indicators, &me->n_scalars,
               &me->n_own_inputs, &me->n_law_inputs) != 7 || !read_double(file, &me->tolerance))
        return 0;
    if ((fmi != 2 && fmi != 3) || n_states > 100000 || n_indicators > 1000000 || me->n_scalars > 1000000 ||
        me->n_own_inputs > 100000 || me->n_law_inputs > 100000)
        return 0;
    plan->fmi = fmi, plan->model_exchange = 1, plan->completed_step_needed = completed, plan->n_states = n_states;
    plan->n_indicators = n_indicators;
    for (int i = 0; i < N_FUNCTIONS; i++)
        if (NAMES[fmi - 2][i]) plan->function[i] = function_of(me, NAMES[fmi - 2][i]);
    plan->n_inputs = me->n_own_inputs + me->n_law_inputs;
    me->scalar = calloc(me->n_scalars + 1, sizeof *me->scalar);
    me->input_group = calloc(me->n_own_inputs + 1, sizeof *me->input_group);
    me->inputs = calloc(2 * plan->n_inputs + 1, sizeof(double));
    me->slope = calloc(plan->n_inputs + 1, sizeof(double));
    me->column = calloc(plan->n_inputs + 1, sizeof(int32_t));
    if (!me->scalar || !me->input_group || !me->inputs || !me->slope || !me->column) return 0;
    for (size_t j = 0; j < plan->n_inputs; j++) me->column[j] = (int32_t)j;
    int given;
    if (fscanf(file, "%d", &given) != 1) return 0;
    if (given && !(me->directional = calloc(2 * n_states + 1, sizeof *me->directional))) return 0;
    for (size_t i = 0; given && i < 2 * n_states; i++)
        if (fscanf(file, "%" SCNu32, me->directional + i) != 1) return 0;
    for (size_t i = 0; i < me->n_scalars; i++) {
        if (!read_scalar(me, me->scalar + i, file)) return 0;
        if (me->scalar[i].input >= 0) {
            Group *group = me->input_group + me->scalar[i].input;
            *group = me->scalar[i].set;
            group->column = me->column + me->scalar[i].input;
        }
    }
    if (!read_laws(&me->run.laws, file, n_states, me->n_scalars)) return 0;
    me->default_parameter = calloc(me->run.laws.n_parameters + 1, sizeof(double));
    me->default_input = calloc(me->n_own_inputs + 1, sizeof(double));
    if (!me->default_parameter || !me->default_input) return 0;
    for (size_t i = 0; i < me->run.laws.n_parameters; i++)
        if (!read_double(file, me->default_parameter + i)) return 0;
    for (size_t i = 0; i < me->n_own_inputs; i++)
        if (!read_double(file, me->default_input + i)) return 0;
    size_t n = n_states + me->run.laws.n_inner;
    plan->work = calloc(15 * n + 2 * n * n + 2 * n_indicators + plan->n_inputs + 1, sizeof(double));
    plan->pivots = calloc(n + 1, sizeof(int32_t));
    plan->time = me->time, plan->inputs = me->inputs, plan->n_times = 2, plan->branch = -1;
    plan->input_groups = plan->slope_groups = me->input_group;
    plan->n_input_groups = (int32_t)me->n_own_inputs;
    plan->slope_columns = me->column;
    return plan->work && plan->pivots;
}

/* ---- Instances ---- */

/* A file URI, or a path, as a path. */
static char *local_path(const char *location)
{
    char *path = calloc(strlen(location) + 1, 1), *to = path;
    if (!path) return NULL;
    const int uri = !strncmp(location, "file:", 5);
    if (uri) location += 5;
    if (uri && !strncmp(location, "//", 2)) {
        location += 2;
        while (*location && *location != '/') location++;
#ifdef _WIN32
        if (*location == '/') location++;
#endif
    }
    for (unsigned byte; *location; to++) {
        if (uri && sscanf(location, "%%%2x", &byte) == 1) *to = (char)byte, location += 3;
        else *to = *location++;
    }
    while (to > path && (to[-1] == '/' || to[-1] == '\\')) *--to = 0;
    return path;
}

static Instance instantiated(Me *me)
{
    char resources[2 * LONGEST];
    Plan *plan = &me->run.plan;
    if (plan->fmi == 2) {
        size_t n = (size_t)snprintf(resources, sizeof resources, "file://%s", me->resources[0] == '/' ? "" : "/");
        static const char plain[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-._~/:";
        for (const char *c = me->resources; *c && n + 32 < sizeof resources; c++) {
            if (strchr(plain, *c)) resources[n++] = *c;
            else n += (size_t)snprintf(resources + n, 4, "%%%02X", (unsigned char)*c);
        }
        strcpy(resources + n, "/contained/resources");
        void *(*make)(const char *, int, const char *, const char *, const void *, int, int) = function_of(me, "Instantiate");
        return make ? make(me->name, 0, me->token, resources, &me->callbacks, 0, 0) : NULL;
    }
    snprintf(resources, sizeof resources, "%s/contained/resources/", me->resources);
    void *(*make)(const char *, const char *, const char *, bool, bool, void *, void *) =
        function_of(me, "InstantiateModelExchange");
    return make ? make(me->name, me->token, resources, false, false, me, (void *)log_of_contained) : NULL;
}

static int instantiate(Me *me)
{
    me->run.plan.instance = instantiated(me);
    return me->run.plan.instance ? OK : report(me, "the contained FMU cannot be instantiated");
}

static void release(Me *me, Instance *instance)
{
    void (*free_instance)(Instance) = function_of(me, "FreeInstance");
    if (*instance && free_instance) free_instance(*instance);
    *instance = NULL;
}

static void release_directions(Me *me)
{
    for (size_t d = 0; d < me->n_held; d++) {
        Direction *one = me->run.direction + d;
        release(me, &one->instance);
        free(one->parameter), free(one->s);
    }
    free(me->run.direction), free(me->run.room), free(me->run.pivots);
    me->run.direction = NULL, me->run.room = NULL, me->run.pivots = NULL;
    me->n_held = me->run.n_directions = 0;
}

static void release_aside(Me *me)
{
    for (size_t i = 0; me->run.laws.coefficient && i < me->run.laws.n_coefficients; i++)
        for (int k = 0; k < 2; k++) release(me, &me->run.laws.coefficient[i].instance[k]);
}

/* Arrays are set as a whole: with the values that have been given, and else those of the description. */
static void fill_arrays(const Me *me)
{
    for (const Scalar *scalar = me->scalar; scalar < me->scalar + me->n_scalars; scalar++)
        if (scalar->set.n_values > 1) put_values(&scalar->set, scalar->given ? &scalar->value : &scalar->start);
}

static int set(Me *me, unsigned reference, double value)
{
    size_t n = me->n_scalars, p = me->run.laws.n_parameters;
    if (reference < n) {
        Scalar *scalar = me->scalar + reference;
        if (scalar->input >= 0) me->inputs[scalar->input] = value;
        if (scalar->input >= 0 && me->initialised) return OK; /* it acts in the next step */
        scalar->given = 1, scalar->value = value;
        if (set_values(&me->run.plan, &scalar->set, 1, &value) == DONE) return OK;
        return report(me, "the contained FMU refuses the value %g of variable %u", value, reference);
    }
    if (reference < n + p) {
        if (me->initialised) return report(me, "parameters of laws are set before the initialisation");
        me->run.laws.parameter[reference - n] = value;
        return OK;
    }
    if (reference < n + p + me->n_law_inputs) {
        me->inputs[me->n_own_inputs + (reference - n - p)] = value;
        return OK;
    }
    return report(me, "there is no variable %u", reference);
}

static int get(Me *me, unsigned reference, double *value)
{
    size_t n = me->n_scalars, p = me->run.laws.n_parameters;
    if (reference < n) {
        me->run.plan.output_groups = &me->scalar[reference].get;
        me->run.plan.n_output_groups = 1;
        if (get_values(&me->run.plan, value) == DONE) return OK;
        return report(me, "the contained FMU does not return variable %u", reference);
    }
    if (reference < n + p) return *value = me->run.laws.parameter[reference - n], OK;
    if (reference < n + p + me->n_law_inputs) return *value = me->inputs[me->n_own_inputs + (reference - n - p)], OK;
    return report(me, "there is no variable %u", reference);
}

/* Start values written into a copy of this FMU; the format is that of fmu_build/runtime/starts.c. */
static int begin(Me *me)
{
    char path[2 * LONGEST];
    memcpy(me->run.laws.parameter, me->default_parameter, me->run.laws.n_parameters * sizeof(double));
    memset(me->inputs, 0, 2 * me->run.plan.n_inputs * sizeof(double));
    memset(me->slope, 0, me->run.plan.n_inputs * sizeof(double));
    me->initialised = me->stepped = me->terminated = 0;
    me->run.n_directions = 0;
    for (size_t i = 0; i < me->n_scalars; i++) me->scalar[i].given = 0;
    fill_arrays(me);
    release_aside(me);
    memcpy(me->inputs, me->default_input, me->n_own_inputs * sizeof(double)); /* many FMUs are not read before their initialisation */
    snprintf(path, sizeof path, "%s/start_values.txt", me->resources);
    FILE *file = fopen(path, "r");
    if (!file) return OK;
    unsigned reference, type;
    uint64_t bits;
    int found, status = OK;
    while (status == OK && (found = fscanf(file, "%u %u %" SCNx64 "%*[^\n]", &reference, &type, &bits)) == 3) {
        double value;
        memcpy(&value, &bits, sizeof value);
        status = set(me, reference, value);
    }
    fclose(file);
    return status == OK && found != EOF ? report(me, "start_values.txt is damaged") : status;
}

API void fmi2FreeInstance(void *c)
{
    Me *me = c;
    if (!me) return;
    if (me->library) release_directions(me), release_aside(me), release(me, &me->run.plan.instance), close_library(me->library);
    for (size_t i = 0; me->scalar && i < me->n_scalars; i++)
        if (!me->scalar[i].shares) free(me->scalar[i].set.buffer);
    free_laws(&me->run.laws);
    free(me->run.plan.work), free(me->run.plan.pivots), free(me->scalar), free(me->input_group), free(me->inputs);
    free(me->moved), free(me->moving), free(me->weight), free(me->value);
    free(me->slope), free(me->column), free(me->directional), free(me->default_parameter), free(me->default_input), free(me->label), free(me->resources), free(me);
}

API void *fmi2Instantiate(const char *label, int type, const char *guid, const char *location, const Callbacks *callbacks,
                          int visible, int logging)
{
    (void)guid, (void)visible, (void)logging;
    Me *me = calloc(1, sizeof *me);
    if (!me) return NULL;
    if (callbacks) me->callbacks = *callbacks;
    me->label = calloc(strlen(label ? label : "") + 1, 1);
    me->resources = location ? local_path(location) : NULL;
    if (me->label) strcpy(me->label, label ? label : "");
    char path[2 * LONGEST] = "";
    if (me->resources) snprintf(path, sizeof path, "%s/laws.txt", me->resources);
    FILE *file = type == 1 && me->label && *path ? fopen(path, "r") : NULL;
    int fine = 0;
    if (!file) report(me, "needs its resources, and co-simulation");
    else {
        fine = read_all(me, file);
        fclose(file);
        if (!fine) report(me, "resources/laws.txt does not fit the contained FMU");
    }
    if (fine && instantiate(me) == OK && begin(me) == OK) return me;
    fmi2FreeInstance(me);
    return NULL;
}

/* ---- A run ---- */

static int outcome(Me *me, int32_t found)
{
    if (found == DONE) return OK;
    if (found == TERMINATED) return me->terminated = 1, DISCARD;
    static const char *const words[] = {[CALL_FAILED] = "a call of the contained FMU failed",
                                        [STEP_TOO_SMALL] = "the integrator cannot keep its error within the tolerance",
                                        [EVENTS_DO_NOT_SETTLE] = "the event iteration does not settle",
                                        [NOT_DIFFERENTIABLE] = "derivatives by parameters are not given, or there is an event"};
    const char *name = found == CALL_FAILED ? NAMES[me->run.plan.fmi - 2][me->run.plan.call] : NULL;
    const char *what = found < (int32_t)(sizeof words / sizeof *words) && words[found] ? words[found] : "the step failed";
    return report(me, "%s at t = %.9g s%s%s", what, me->run.plan.reached_time, name ? ": " : "", name ? name : "");
}

API int fmi2SetupExperiment(void *c, int given, double tolerance, double start, int ends, double stop)
{
    Me *me = c;
    Plan *plan = &me->run.plan;
    plan->tolerance_defined = 1;
    plan->tolerance = given && tolerance > 0 ? tolerance : me->tolerance;
    plan->stop = ends ? stop : start + 1e9;
    me->time[0] = start, me->time[1] = ends ? stop : start + 1;
    if (plan->fmi == 3) return OK;
    int32_t (*setup)(Instance, int, double, double, int, double) = plan->function[SETUP_EXPERIMENT];
    /* A step may end beyond the stop time by rounding; the integrator does not go further. */
    return setup ? setup(plan->instance, 1, plan->tolerance, start, 0, 0) : OK;
}

static int enter_initialization(Me *me, const Plan *plan)
{
    if (plan->fmi == 2) return ((Plain)plan->function[ENTER_INITIALIZATION])(plan->instance);
    return ((int32_t (*)(Instance, bool, double, double, bool, double))plan->function[ENTER_INITIALIZATION])(
        plan->instance, true, plan->tolerance, me->time[0], false, 0);
}

API int fmi2EnterInitializationMode(void *c)
{
    Me *me = c;
    if (!me->run.plan.tolerance_defined) fmi2SetupExperiment(me, 0, 0, 0, 0, 0);
    return enter_initialization(me, &me->run.plan);
}

/* Bring a further instance, with other values of n parameters, to where derivatives can be read. */
static int32_t begin_aside(Me *me, Plan *plan, const unsigned *parameter, const double *value, size_t n)
{
    if (plan->fmi == 2 && plan->function[SETUP_EXPERIMENT])
        CALL(SETUP_EXPERIMENT, int32_t (*)(Instance, int, double, double, int, double), plan->instance, 1, plan->tolerance,
             me->time[0], 0, 0.0);
    fill_arrays(me);
    for (size_t i = 0; i < me->n_scalars; i++) {
        Scalar *scalar = me->scalar + i;
        if (scalar->given) TRY(set_values(plan, &scalar->set, 1, &scalar->value));
    }
    for (size_t i = 0; i < n; i++)
        if (parameter[i] < me->n_scalars) TRY(set_values(plan, &me->scalar[parameter[i]].set, 1, value + i));
    int32_t status = enter_initialization(me, plan);
    if (status > WARNING) return fail(plan, ENTER_INITIALIZATION, status);
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, me->inputs));
    CALL(EXIT_INITIALIZATION, Plain, plan->instance);
    plan->reached = 0; /* the states of the run are kept */
    return settle_events(plan);
}

static int look_for_coefficients(Me *me)
{
    for (size_t i = 0; i < me->run.laws.n_coefficients; i++) {
        Coefficient *one = me->run.laws.coefficient + i;
        if (!one->active) continue;
        if (get(me, (unsigned)one->scalar, &one->own) != OK) return ERROR;
        if (one->own == 0) return report(me, "a parameter whose value is zero cannot vary by a share of it");
        one->at[0] = 1.25 * one->own, one->at[1] = 0.8 * one->own;
        for (int k = 0; k < 2; k++) {
            PlanWithLaws aside = me->run;
            aside.plan.instance = one->instance[k] = instantiated(me);
            if (!aside.plan.instance) return report(me, "the contained FMU cannot be instantiated again");
            const unsigned scalar = (unsigned)one->scalar;
            if (begin_aside(me, &aside.plan, &scalar, &one->at[k], 1) != DONE)
                return report(me, "a further instance of the contained FMU cannot be initialised");
        }
    }
    return OK;
}

/* ---- Derivatives of a run along directions ---- */

static const double STEP = 1e-5; /* relative: between its truncation and the error of an FMU that solves equations inside */

/* Create or reset the instance of a direction, and initialise it with the parameters moved along that direction. */
static int begin_direction(Me *me, size_t number)
{
    Direction *one = me->run.direction + number;
    const double *weight = me->weight + number * me->n_moved;
    size_t n = 0;
    one->size = INFINITY;
    for (size_t i = 0; i < me->n_moved; i++) {
        if (weight[i] == 0) continue;
        if (get(me, me->moved[i], me->value + n) != OK) return ERROR;
        one->size = fmin(one->size, STEP * (me->value[n] != 0 ? fabs(me->value[n]) : 1) / fabs(weight[i]));
        me->moving[n++] = me->moved[i];
    }
    if (n == 0) return report(me, "direction %zu is empty", number);
    memcpy(one->parameter, me->run.laws.parameter, me->run.laws.n_parameters * sizeof(double));
    for (size_t i = 0, j = 0; i < me->n_moved; i++) {
        if (weight[i] == 0) continue;
        me->value[j] += one->size * weight[i];
        if (me->moved[i] >= me->n_scalars) one->parameter[me->moved[i] - me->n_scalars] = me->value[j];
        j++;
    }
    Plain reset = (Plain)me->run.plan.function[RESET];
    if (one->instance && (!reset || reset(one->instance) > WARNING)) release(me, &one->instance);
    if (!one->instance) one->instance = instantiated(me);
    if (!one->instance) return report(me, "the contained FMU cannot be instantiated again");
    PlanWithLaws aside = aside_of(&me->run.plan, one);
    int32_t (*states)(Instance, double *, size_t) = aside.plan.function[GET_STATES];
    if (begin_aside(me, &aside.plan, me->moving, me->value, n) != DONE || states(one->instance, one->s, me->run.laws.n_states) > WARNING)
        return report(me, "a further instance of the contained FMU cannot be initialised");
    return OK;
}

/* Called before start values are set. Directions of the last run are forgotten by a reset. */
API int fmuidSetSensitivityDirections(void *c, const unsigned moved[], size_t n_moved, const double weights[], size_t n)
{
    Me *me = c;
    const size_t n_own = me->n_scalars, most = me->run.laws.n_states + me->run.laws.n_inner;
    if (!me->directional) return report(me, "the contained FMU gives no directional derivatives");
    for (size_t i = 0; i < n_moved; i++)
        if (moved[i] >= n_own + me->run.laws.n_parameters ||
            (moved[i] < n_own && (me->scalar[moved[i]].input >= 0 || me->scalar[moved[i]].set.type != FLOAT64)))
            return report(me, "there are no derivatives by variable %u", moved[i]);
    if (n > me->n_held) {
        release_directions(me);
        me->run.direction = calloc(n, sizeof(Direction));
        me->run.room = calloc(ROOM(most, n) + 1, sizeof(double));
        me->run.pivots = calloc(STAGES * most + 1, sizeof(int32_t));
        if (!me->run.direction || !me->run.room || !me->run.pivots) return report(me, "out of memory");
        for (me->n_held = 0; me->n_held < n; me->n_held++) {
            Direction *one = me->run.direction + me->n_held;
            one->parameter = calloc(me->run.laws.n_parameters + 1, sizeof(double));
            one->s = calloc(most + 1, sizeof(double));
            if (!one->parameter || !one->s) return me->n_held++, report(me, "out of memory");
        }
    }
    free(me->moved), free(me->moving), free(me->weight), free(me->value);
    me->moved = calloc(n_moved + 1, sizeof *me->moved), me->moving = calloc(n_moved + 1, sizeof *me->moving);
    me->weight = calloc(n * n_moved + 1, sizeof(double)), me->value = calloc(n_moved + 1, sizeof(double));
    if (!me->moved || !me->moving || !me->weight || !me->value) return report(me, "out of memory");
    memcpy(me->moved, moved, n_moved * sizeof *moved), memcpy(me->weight, weights, n * n_moved * sizeof(double));
    me->n_moved = n_moved, me->run.n_directions = n;
    return OK;
}

/* (n, directions) derivatives of variables, at the end of the last step. */
API int fmuidGetSensitivities(void *c, const unsigned vr[], size_t n, double value[])
{
    Me *me = c;
    const size_t n_own = me->n_scalars, n_states = me->run.laws.n_states, directions = me->run.n_directions;
    for (size_t d = 0; d < directions; d++) {
        const Direction *one = me->run.direction + d;
        bool moved = false;
        for (size_t i = 0; i < n; i++) {
            size_t state = 0;
            while (state < n_states && (vr[i] >= n_own || me->scalar[vr[i]].reference != me->directional[n_states + state])) state++;
            if (state < n_states) {
                value[i * directions + d] = one->s[state];
                continue;
            }
            /* Any other variable follows from the states there. */
            PlanWithLaws plain = me->run, aside = aside_of(&plain.plan, one);
            double here, there;
            if (!moved && move_aside(&aside, one) != DONE) return report(me, "a further instance of the contained FMU fails");
            moved = true;
            if (get(me, vr[i], &here) != OK) return ERROR;
            me->run = aside;
            int status = get(me, vr[i], &there);
            me->run = plain;
            if (status != OK) return status;
            value[i * directions + d] = (there - here) / one->size;
        }
    }
    return OK;
}

API int fmi2ExitInitializationMode(void *c)
{
    Me *me = c;
    Plan *plan = &me->run.plan;
    int32_t status = ((Plain)plan->function[EXIT_INITIALIZATION])(plan->instance);
    if (status > WARNING) return status;
    for (size_t d = 0; d < me->run.n_directions; d++)
        if (begin_direction(me, d) != OK) return ERROR;
    me->run.n_added = activate_laws(&me->run.laws, me->run.direction, me->run.n_directions);
    plan->n_states = me->run.laws.n_states + me->run.n_added;
    if (me->run.n_directions > 0 && parameters_vary(plan)) return report(me, "there are no derivatives while a parameter varies");
    plan->reached = -1, plan->reached_time = me->time[0], plan->n_slopes = 0, plan->n_slope_groups = 0;
    memset(plan->work, 0, plan->n_states * sizeof(double));
    plan->derivative_references = me->directional;
    if (look_for_coefficients(me) != OK) return ERROR;
    int32_t found = begin_model_exchange(plan);
    if (found == DONE) start_directions(plan);
    plan->reached = 0;
    me->initialised = 1;
    return outcome(me, found);
}

API int fmi2DoStep(void *c, double t, double h, int keeps)
{
    Me *me = c;
    Plan *plan = &me->run.plan;
    (void)keeps;
    if (!me->initialised || !(h > 0)) return report(me, "a step of %g s is not possible now", h);
    if (!me->stepped) plan->step_size = h;
    me->stepped = 1;
    me->time[0] = t, me->time[1] = t + h;
    bool moves = false;
    for (size_t j = 0; j < plan->n_inputs; j++) {
        me->inputs[plan->n_inputs + j] = me->inputs[j] + h * me->slope[j];
        moves |= me->slope[j] != 0;
    }
    plan->n_slopes = moves ? (int32_t)plan->n_inputs : 0;
    plan->n_slope_groups = moves ? (int32_t)me->n_own_inputs : 0;
    int32_t found = integrate(plan, 0);
    memset(me->slope, 0, plan->n_inputs * sizeof(double));
    return outcome(me, found);
}

API int fmi2SetRealInputDerivatives(void *c, const unsigned vr[], size_t n, const int order[], const double value[])
{
    Me *me = c;
    size_t first = me->n_scalars + me->run.laws.n_parameters;
    for (size_t i = 0; i < n; i++) {
        int32_t column = vr[i] < me->n_scalars ? me->scalar[vr[i]].input : -1;
        if (vr[i] >= first && vr[i] < first + me->n_law_inputs) column = (int32_t)(me->n_own_inputs + vr[i] - first);
        if (column < 0 || order[i] != 1) return report(me, "variable %u takes no derivative of order %d", vr[i], order[i]);
        me->slope[column] = value[i];
    }
    return OK;
}

API int fmi2Terminate(void *c)
{
    Me *me = c;
    return me->run.plan.function[TERMINATE] ? ((Plain)me->run.plan.function[TERMINATE])(me->run.plan.instance) : OK;
}

API int fmi2Reset(void *c)
{
    Me *me = c;
    me->run.plan.tolerance_defined = 0;
    if (!me->run.plan.function[RESET] || ((Plain)me->run.plan.function[RESET])(me->run.plan.instance) > WARNING) {
        release(me, &me->run.plan.instance);
        if (instantiate(me) != OK) return ERROR;
    }
    return begin(me);
}

#define EACH_VALUE(action) \
    for (size_t i = 0; i < n; i++) { \
        int status = action; \
        if (status != OK) return status; \
    } \
    return OK

static int get_as_int(Me *me, unsigned reference, int *value)
{
    double found;
    int status = get(me, reference, &found);
    if (status == OK) *value = (int)found;
    return status;
}

API int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[]) { EACH_VALUE(get(c, vr[i], value + i)); }
API int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[]) { EACH_VALUE(set(c, vr[i], value[i])); }
API int fmi2GetInteger(void *c, const unsigned vr[], size_t n, int value[]) { EACH_VALUE(get_as_int(c, vr[i], value + i)); }
API int fmi2SetInteger(void *c, const unsigned vr[], size_t n, const int value[]) { EACH_VALUE(set(c, vr[i], value[i])); }
API int fmi2GetBoolean(void *c, const unsigned vr[], size_t n, int value[]) { EACH_VALUE(get_as_int(c, vr[i], value + i)); }
API int fmi2SetBoolean(void *c, const unsigned vr[], size_t n, const int value[]) { EACH_VALUE(set(c, vr[i], value[i])); }

API int fmi2GetBooleanStatus(void *c, int kind, int *value) { return kind == 3 ? (*value = ((Me *)c)->terminated, OK) : DISCARD; }
API int fmi2GetRealStatus(void *c, int kind, double *value)
{
    return kind == 2 ? (*value = ((Me *)c)->run.plan.reached_time, OK) : DISCARD;
}

/* ---- What the description does not offer ---- */

API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
API int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const categories[]) { return (void)c, (void)on, (void)n, (void)categories, OK; }
API int fmi2GetString(void *c, const unsigned vr[], size_t n, const char *value[]) { return (void)vr, (void)value, n ? report(c, "there are no strings") : OK; }
API int fmi2SetString(void *c, const unsigned vr[], size_t n, const char *const value[]) { return (void)vr, (void)value, n ? report(c, "there are no strings") : OK; }
API int fmi2CancelStep(void *c) { return report(c, "steps are not asynchronous"); }
API int fmi2GetStatus(void *c, int kind, int *value) { return (void)c, (void)kind, (void)value, DISCARD; }
API int fmi2GetIntegerStatus(void *c, int kind, int *value) { return (void)c, (void)kind, (void)value, DISCARD; }
API int fmi2GetStringStatus(void *c, int kind, const char **value) { return (void)c, (void)kind, (void)value, DISCARD; }
API int fmi2GetRealOutputDerivatives(void *c, const unsigned vr[], size_t n, const int order[], double value[]) { return (void)vr, (void)n, (void)order, (void)value, report(c, "derivatives of outputs are not offered"); }
API int fmi2GetFMUstate(void *c, void **state) { return (void)state, report(c, "states are not saved"); }
API int fmi2SetFMUstate(void *c, void *state) { return (void)state, report(c, "states are not saved"); }
API int fmi2FreeFMUstate(void *c, void **state) { return (void)c, (void)state, OK; }
API int fmi2SerializedFMUstateSize(void *c, void *state, size_t *size) { return (void)state, (void)size, report(c, "states are not saved"); }
API int fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size) { return (void)state, (void)bytes, (void)size, report(c, "states are not saved"); }
API int fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state) { return (void)bytes, (void)size, (void)state, report(c, "states are not saved"); }
API int fmi2GetDirectionalDerivative(void *c, const unsigned a[], size_t n, const unsigned b[], size_t m, const double d[], double e[]) { return (void)a, (void)n, (void)b, (void)m, (void)d, (void)e, report(c, "derivatives are not offered"); }
