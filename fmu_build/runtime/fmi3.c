/* FMI 3.0: co-simulation and model exchange; scheduled execution, clocks, strings and binaries are not in the model. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "instance.h"

#define IN(phases)                                        \
    Instance *me = instance;                              \
    if (!me || !allowed(me, (phases), __func__)) return fmi3Error

enum {
    BEFORE = PHASE_INSTANTIATED | PHASE_INITIALIZATION,
    RUNNING = PHASE_STEP | PHASE_EVENT | PHASE_CONTINUOUS,
    AFTER = PHASE_TERMINATED | PHASE_ERROR,
    ANY = BEFORE | RUNNING | AFTER
};

static int allowed(Instance *me, int phases, const char *function) {
    if (me->s.phase & phases) return 1;
    report(me, STATUS_ERROR, "%s is not allowed in this state of the FMU", function);
    return 0;
}

static void log_message(void (*callback)(void), void *environment, const char *name, Status status,
                        const char *message) {
    (void)name; /* the environment tells instances apart */
    const fmi3LogMessageCallback log = (fmi3LogMessageCallback)callback;
    if (!log) return;
    log(environment, (fmi3Status)status, status >= STATUS_ERROR ? "logStatusError" : "logStatusWarning", message);
}

/* What an instantiation that cannot be served says. */
static fmi3Instance decline(fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, const char *what) {
    log_message((void (*)(void))log, environment, NULL, STATUS_ERROR, what);
    return NULL;
}

/* A failed step or evaluation leaves the instance readable; only reset, terminate and free make sense after it. */
static fmi3Status failed(Instance *me, Status status) {
    if (status >= STATUS_ERROR) me->s.phase = PHASE_ERROR;
    return (fmi3Status)status;
}

static fmi3Status refuse(fmi3Instance instance, const char *what) {
    IN(ANY);
    return (fmi3Status)report(me, STATUS_ERROR, "the model has no %s", what);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

static fmi3Instance instantiate(fmi3String name, fmi3String token, fmi3String resources,
                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, int logging,
                                int is_co_simulation) {
    const Listener listener = {log_message, (void (*)(void))log, environment};
    Instance *me = new_instance(name, token, resources, listener, is_co_simulation);
    if (me) me->logging = logging;
    return me;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    (void)visible;
    return instantiate(instanceName, instantiationToken, resourcePath, instanceEnvironment, logMessage, loggingOn, 0);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment,
                                         fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)visible;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    if (eventModeUsed)
        return decline(instanceEnvironment, logMessage, "there is no event mode: events are handled inside the steps");
    if (nRequiredIntermediateVariables > 0)
        return decline(instanceEnvironment, logMessage, "intermediate values of variables are not provided");
    return instantiate(instanceName, instantiationToken, resourcePath, instanceEnvironment, logMessage, loggingOn, 1);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken,
                                               fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment,
                                               fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName;
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    return decline(instanceEnvironment, logMessage, "scheduled execution is not supported");
}

void fmi3FreeInstance(fmi3Instance instance) { free_instance(instance); }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    (void)nCategories;
    (void)categories;
    IN(ANY);
    me->logging = loggingOn;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    IN(PHASE_INSTANTIATED);
    const Status status = set_experiment(me, toleranceDefined, tolerance, startTime, stopTimeDefined, stopTime);
    if (status <= STATUS_WARNING) me->s.phase = PHASE_INITIALIZATION;
    return (fmi3Status)status;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    IN(PHASE_INITIALIZATION);
    return failed(me, start_simulation(me));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    IN(RUNNING | PHASE_ERROR);
    me->s.phase = PHASE_TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    IN(ANY);
    set_defaults(me);
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) { return refuse(instance, "structural parameters"); }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) { return refuse(instance, "structural parameters"); }

/* Reading and writing values: Float64, Int32 (also for enumerations: Int64) and Boolean occur in the models. */

#define GET(name, type, kind)                                                                                    \
    fmi3Status fmi3Get##name(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, type values[],      \
                             size_t nValues) {                                                                   \
        IN(ANY);                                                                                                 \
        if (n != nValues) return (fmi3Status)report(me, STATUS_ERROR, "%zu values for %zu variables", nValues, n); \
        for (size_t i = 0; i < n; i++) {                                                                         \
            double value = 0.0;                                                                                  \
            const Status status = get_value(me, vr[i], kind, &value);                                            \
            if (status > STATUS_WARNING) return (fmi3Status)status;                                              \
            values[i] = (type)(kind == TYPE_BOOLEAN ? value != 0.0 : kind == TYPE_INTEGER ? round(value) : value); \
        }                                                                                                        \
        return fmi3OK;                                                                                           \
    }
#define SET(name, type, kind)                                                                                    \
    fmi3Status fmi3Set##name(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const type values[], \
                             size_t nValues) {                                                                   \
        IN(BEFORE | RUNNING);                                                                                    \
        if (n != nValues) return (fmi3Status)report(me, STATUS_ERROR, "%zu values for %zu variables", nValues, n); \
        for (size_t i = 0; i < n; i++) {                                                                         \
            const Status status = set_value(me, vr[i], kind, (double)values[i]);                                 \
            if (status > STATUS_WARNING) return (fmi3Status)status;                                              \
        }                                                                                                        \
        return fmi3OK;                                                                                           \
    }
#define NONE(name, type)                                                                                         \
    fmi3Status fmi3Get##name(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, type values[],      \
                             size_t nValues) {                                                                   \
        (void)vr, (void)n, (void)values, (void)nValues;                                                          \
        return refuse(instance, "variables of type " #name);                                                     \
    }                                                                                                            \
    fmi3Status fmi3Set##name(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const type values[], \
                             size_t nValues) {                                                                   \
        (void)vr, (void)n, (void)values, (void)nValues;                                                          \
        return refuse(instance, "variables of type " #name);                                                     \
    }

GET(Float64, fmi3Float64, TYPE_REAL)
SET(Float64, fmi3Float64, TYPE_REAL)
GET(Int32, fmi3Int32, TYPE_INTEGER)
SET(Int32, fmi3Int32, TYPE_INTEGER)
GET(Int64, fmi3Int64, TYPE_INTEGER)
SET(Int64, fmi3Int64, TYPE_INTEGER)
GET(Boolean, fmi3Boolean, TYPE_BOOLEAN)
SET(Boolean, fmi3Boolean, TYPE_BOOLEAN)
NONE(Float32, fmi3Float32)
NONE(Int8, fmi3Int8)
NONE(UInt8, fmi3UInt8)
NONE(Int16, fmi3Int16)
NONE(UInt16, fmi3UInt16)
NONE(UInt32, fmi3UInt32)
NONE(UInt64, fmi3UInt64)
NONE(String, fmi3String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t nValues) {
    (void)vr, (void)n, (void)sizes, (void)values, (void)nValues;
    return refuse(instance, "variables of type Binary");
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary values[], size_t nValues) {
    (void)vr, (void)n, (void)sizes, (void)values, (void)nValues;
    return refuse(instance, "variables of type Binary");
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, fmi3Clock values[]) {
    (void)vr, (void)n, (void)values;
    return refuse(instance, "clocks");
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const fmi3Clock values[]) {
    (void)vr, (void)n, (void)values;
    return refuse(instance, "clocks");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]) {
    (void)vr, (void)n, (void)intervals, (void)qualifiers;
    return refuse(instance, "clocks");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[]) {
    (void)vr, (void)n, (void)counters, (void)resolutions, (void)qualifiers;
    return refuse(instance, "clocks");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, fmi3Float64 shifts[]) {
    (void)vr, (void)n, (void)shifts;
    return refuse(instance, "clocks");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[]) {
    (void)vr, (void)n, (void)counters, (void)resolutions;
    return refuse(instance, "clocks");
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                  const fmi3Float64 intervals[]) {
    (void)vr, (void)n, (void)intervals;
    return refuse(instance, "clocks");
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    (void)vr, (void)n, (void)counters, (void)resolutions;
    return refuse(instance, "clocks");
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                               const fmi3Float64 shifts[]) {
    (void)vr, (void)n, (void)shifts;
    return refuse(instance, "clocks");
}

fmi3Status fmi3SetShiftFraction(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    (void)vr, (void)n, (void)counters, (void)resolutions;
    return refuse(instance, "clocks");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 time) {
    (void)clock, (void)time;
    return refuse(instance, "clocks");
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference vr, size_t *n) {
    (void)vr, (void)n;
    return refuse(instance, "dependencies other than those of the model description");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent, size_t dependentElements[],
                                       fmi3ValueReference independents[], size_t independentElements[],
                                       fmi3DependencyKind kinds[], size_t n) {
    (void)dependent, (void)dependentElements, (void)independents, (void)independentElements, (void)kinds, (void)n;
    return refuse(instance, "dependencies other than those of the model description");
}

/* The complete state */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state) {
    IN(ANY);
    return (fmi3Status)copy_state(me, state);
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state) {
    IN(ANY);
    return (fmi3Status)restore_state(me, state);
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state) {
    IN(ANY);
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size) {
    IN(ANY);
    *size = serialised_size(state);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    IN(ANY);
    return (fmi3Status)serialise(me, state, (char *)bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    IN(ANY);
    return (fmi3Status)deserialise(me, (const char *)bytes, size, state);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                        size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    IN(PHASE_INITIALIZATION | RUNNING | AFTER);
    if (nSeed != nKnowns || nSensitivity != nUnknowns)
        return (fmi3Status)report(me, STATUS_ERROR, "seed or sensitivity have another length than their variables");
    return (fmi3Status)get_directional_derivative(me, unknowns, nUnknowns, knowns, nKnowns, seed, sensitivity);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed;
    (void)sensitivity, (void)nSensitivity;
    return refuse(instance, "adjoint derivatives");
}

/* Model exchange */

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    return failed(me, enter_event_mode(me));
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    IN(PHASE_EVENT);
    const State *s = &me->s;
    int states_changed = 0;
    const Status status = update_discrete_states(me, &states_changed);
    *discreteStatesNeedUpdate = fmi3False;
    *terminateSimulation = s->terminate != 0;
    *nominalsOfContinuousStatesChanged = fmi3False;
    *valuesOfContinuousStatesChanged = states_changed != 0;
    *nextEventTimeDefined = isfinite(s->next_event) != 0;
    *nextEventTime = s->next_event;
    return failed(me, status);
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) {
    IN(PHASE_INITIALIZATION | PHASE_EVENT);
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    IN(PHASE_EVENT);
    return failed(me, enter_continuous_mode(me));
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(PHASE_CONTINUOUS);
    *enterEventMode = fmi3False;
    *terminateSimulation = fmi3False;
    return failed(me, completed_step(me));
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    set_time(me, time);
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 x[], size_t n) {
    IN(PHASE_EVENT | PHASE_CONTINUOUS);
    return (fmi3Status)set_states(me, x, n);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 x[], size_t n) {
    IN(PHASE_INITIALIZATION | RUNNING | AFTER);
    return (fmi3Status)get_states(me, x, n);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 dx[], size_t n) {
    IN(PHASE_INITIALIZATION | RUNNING | AFTER);
    return (fmi3Status)get_derivatives(me, dx, n);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t n) {
    IN(PHASE_INITIALIZATION | RUNNING | AFTER);
    return (fmi3Status)get_indicators(me, indicators, n);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t n) {
    IN(ANY);
    return (fmi3Status)get_nominals(me, nominals, n);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n) {
    IN(ANY);
    *n = (size_t)NM;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n) {
    IN(ANY);
    *n = (size_t)NX;
    return fmi3OK;
}

/* Co-simulation */

fmi3Status fmi3EnterStepMode(fmi3Instance instance) {
    IN(PHASE_STEP);
    return fmi3OK;
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues) {
    (void)vr, (void)n, (void)orders, (void)values, (void)nValues;
    return refuse(instance, "output derivatives");
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(PHASE_STEP);
    const Status status = do_step(me, currentCommunicationPoint, communicationStepSize);
    *eventHandlingNeeded = fmi3False;
    *terminateSimulation = me->s.terminate != 0;
    *earlyReturn = fmi3False;
    *lastSuccessfulTime = me->s.t;
    return failed(me, status);
}
