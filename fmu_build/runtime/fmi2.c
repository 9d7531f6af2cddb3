/* FMI 2.0: co-simulation and model exchange. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "instance.h"

#define IN(phases)                                        \
    Instance *me = c;                                     \
    if (!me || !allowed(me, (phases), __func__)) return fmi2Error

enum {
    BEFORE = PHASE_INSTANTIATED | PHASE_INITIALIZATION,
    RUNNING = PHASE_STEP | PHASE_EVENT | PHASE_CONTINUOUS,
    READABLE = BEFORE | RUNNING | PHASE_TERMINATED | PHASE_ERROR,
    ANY = READABLE
};

static int allowed(Instance *me, int phases, const char *function) {
    if (me->s.phase & phases) return 1;
    report(me, STATUS_ERROR, "%s is not allowed in this state of the FMU", function);
    return 0;
}

static void log_message(void (*callback)(void), void *environment, const char *name, Status status,
                        const char *message) {
    const fmi2CallbackLogger logger = (fmi2CallbackLogger)callback;
    if (!logger) return;
    const char *category = status >= STATUS_ERROR ? "logStatusError" : "logStatusWarning";
    /* The message is itself the format: importers that cannot read variadic arguments get it whole. */
    char format[1024];
    size_t n = 0;
    for (; *message && n + 2 < sizeof format; message++) {
        if (*message == '%') format[n++] = '%';
        format[n++] = *message;
    }
    format[n] = '\0';
    logger(environment, name, (fmi2Status)status, category, format);
}

/* A failed step or evaluation leaves the instance readable; only reset, terminate and free make sense after it. */
static fmi2Status failed(Instance *me, Status status) {
    if (status >= STATUS_ERROR) me->s.phase = PHASE_ERROR;
    return (fmi2Status)status;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn) {
    (void)visible;
    Listener listener = {.log = log_message};
    if (functions) {
        listener.callback = (void (*)(void))functions->logger;
        listener.environment = functions->componentEnvironment;
    }
    Instance *me = new_instance(instanceName, fmuGUID, fmuResourceLocation, listener, fmuType == fmi2CoSimulation);
    if (me) me->logging = loggingOn;
    return me;
}

void fmi2FreeInstance(fmi2Component c) { free_instance(c); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    (void)nCategories;
    (void)categories;
    IN(ANY);
    me->logging = loggingOn;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    IN(PHASE_INSTANTIATED);
    return (fmi2Status)set_experiment(me, toleranceDefined, tolerance, startTime, stopTimeDefined, stopTime);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    IN(PHASE_INSTANTIATED);
    me->s.phase = PHASE_INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    IN(PHASE_INITIALIZATION);
    return failed(me, start_simulation(me));
}

fmi2Status fmi2Terminate(fmi2Component c) {
    IN(RUNNING | PHASE_ERROR);
    me->s.phase = PHASE_TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    IN(ANY);
    set_defaults(me);
    return fmi2OK;
}

/* Reading and writing values */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    IN(READABLE);
    for (size_t i = 0; i < nvr; i++) {
        const Status status = get_value(me, vr[i], TYPE_REAL, &value[i]);
        if (status > STATUS_WARNING) return (fmi2Status)status;
    }
    return fmi2OK;
}

static fmi2Status get_whole(fmi2Component c, VariableType type, const fmi2ValueReference vr[], size_t nvr,
                            int value[]) {
    IN(READABLE);
    for (size_t i = 0; i < nvr; i++) {
        double number = 0.0;
        const Status status = get_value(me, vr[i], type, &number);
        if (status > STATUS_WARNING) return (fmi2Status)status;
        value[i] = type == TYPE_BOOLEAN ? number != 0.0 : (int)lround(number);
    }
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[]) {
    return get_whole(c, TYPE_INTEGER, vr, nvr, value);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[]) {
    return get_whole(c, TYPE_BOOLEAN, vr, nvr, value);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
    IN(BEFORE | RUNNING);
    for (size_t i = 0; i < nvr; i++) {
        const Status status = set_value(me, vr[i], TYPE_REAL, value[i]);
        if (status > STATUS_WARNING) return (fmi2Status)status;
    }
    return fmi2OK;
}

static fmi2Status set_whole(fmi2Component c, VariableType type, const fmi2ValueReference vr[], size_t nvr,
                            const int value[]) {
    IN(BEFORE | RUNNING);
    for (size_t i = 0; i < nvr; i++) {
        const double number = type == TYPE_BOOLEAN ? value[i] != 0 : value[i];
        const Status status = set_value(me, vr[i], type, number);
        if (status > STATUS_WARNING) return (fmi2Status)status;
    }
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[]) {
    return set_whole(c, TYPE_INTEGER, vr, nvr, value);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Boolean value[]) {
    return set_whole(c, TYPE_BOOLEAN, vr, nvr, value);
}

static fmi2Status no_strings(fmi2Component c, size_t nvr) {
    IN(ANY);
    return nvr == 0 ? fmi2OK : (fmi2Status)report(me, STATUS_ERROR, "the model has no variables of type String");
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[]) {
    (void)vr;
    (void)value;
    return no_strings(c, nvr);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[]) {
    (void)vr;
    (void)value;
    return no_strings(c, nvr);
}

/* The complete state */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    IN(ANY);
    return (fmi2Status)copy_state(me, FMUstate);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    IN(ANY);
    return (fmi2Status)restore_state(me, FMUstate);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    IN(ANY);
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    IN(ANY);
    *size = serialised_size(FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte bytes[], size_t size) {
    IN(ANY);
    return (fmi2Status)serialise(me, FMUstate, bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *FMUstate) {
    IN(ANY);
    return (fmi2Status)deserialise(me, bytes, size, FMUstate);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
    IN(PHASE_INITIALIZATION | RUNNING | PHASE_TERMINATED | PHASE_ERROR);
    return (fmi2Status)get_directional_derivative(me, vUnknown_ref, nUnknown, vKnown_ref, nKnown, dvKnown, dvUnknown);
}

/* Model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    return failed(me, enter_event_mode(me));
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    IN(PHASE_EVENT);
    const State *s = &me->s;
    int states_changed = 0;
    const Status status = update_discrete_states(me, &states_changed);
    info->newDiscreteStatesNeeded = fmi2False;
    info->terminateSimulation = s->terminate;
    info->nominalsOfContinuousStatesChanged = fmi2False;
    info->valuesOfContinuousStatesChanged = states_changed;
    info->nextEventTimeDefined = isfinite(s->next_event);
    info->nextEventTime = s->next_event;
    return failed(me, status);
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    IN(PHASE_EVENT);
    return failed(me, enter_continuous_mode(me));
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(PHASE_CONTINUOUS);
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return failed(me, completed_step(me));
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    set_time(me, time);
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    return (fmi2Status)set_states(me, x, nx);
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    IN(PHASE_INITIALIZATION | RUNNING | PHASE_TERMINATED | PHASE_ERROR);
    return (fmi2Status)get_states(me, x, nx);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    IN(PHASE_INITIALIZATION | RUNNING | PHASE_TERMINATED | PHASE_ERROR);
    return (fmi2Status)get_derivatives(me, derivatives, nx);
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t ni) {
    IN(PHASE_INITIALIZATION | RUNNING | PHASE_TERMINATED | PHASE_ERROR);
    return (fmi2Status)get_indicators(me, indicators, ni);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    IN(ANY);
    return (fmi2Status)get_nominals(me, x_nominal, nx);
}

/* Co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    IN(PHASE_INITIALIZATION | PHASE_STEP);
    for (size_t i = 0; i < nvr; i++) {
        if (order[i] != 1)
            return (fmi2Status)report(me, STATUS_ERROR, "input derivatives of order %d are not supported", order[i]);
        const Status status = set_input_slope(me, vr[i], value[i]);
        if (status > STATUS_WARNING) return (fmi2Status)status;
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr;
    (void)order;
    (void)value;
    IN(ANY);
    return nvr == 0 ? fmi2OK : (fmi2Status)report(me, STATUS_ERROR, "output derivatives are not provided");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(PHASE_STEP);
    const Status status = do_step(me, currentCommunicationPoint, communicationStepSize);
    if (status <= STATUS_WARNING && me->s.terminate)
        return (fmi2Status)report(me, STATUS_DISCARD, "t = %.9g: the model ends the simulation", me->s.t);
    return failed(me, status);
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    IN(ANY);
    return (fmi2Status)report(me, STATUS_ERROR, "steps are not asynchronous: there is nothing to cancel");
}

static fmi2Status no_status(fmi2Component c, fmi2StatusKind kind) {
    IN(ANY);
    return (fmi2Status)report(me, STATUS_DISCARD, "there is no status of kind %d: no step is pending", (int)kind);
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    (void)value;
    return no_status(c, kind);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    IN(ANY);
    if (kind != fmi2LastSuccessfulTime) return no_status(c, kind);
    *value = me->s.t;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    (void)value;
    return no_status(c, kind);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    IN(ANY);
    if (kind != fmi2Terminated) return no_status(c, kind);
    *value = me->s.terminate;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    (void)value;
    return no_status(c, kind);
}
