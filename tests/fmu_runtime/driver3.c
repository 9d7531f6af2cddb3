/* What driver.c does, through the functions of FMI 3.0: runs, the state, and every refusal with its message. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "model.h"
#include "instance.h"
#include "model_config.h"

enum { STEPS = 60 };
static const VariableEntry VARIABLE[] = MODEL_VARIABLES;
static const double H = 0.01;
static int messages;

static void logger(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message) {
    (void)environment, (void)status, (void)category;
    if (!strlen(message)) abort();
    messages++;
}

#define CHECK(condition)                                                         \
    do {                                                                         \
        if (!(condition)) {                                                      \
            fprintf(stderr, "driver3.c:%d: not so: %s\n", __LINE__, #condition); \
            exit(1);                                                             \
        }                                                                        \
    } while (0)
#define OK(call) CHECK((call) == fmi3OK)
#define REFUSED(call)                        \
    do {                                     \
        const int before = messages;         \
        CHECK((call) >= fmi3Discard);        \
        CHECK(messages > before);            \
    } while (0)

static fmi3Instance slave(int event_mode, size_t n_intermediate) {
    const unsigned first = 0;
    return fmi3InstantiateCoSimulation("one", MODEL_GUID, NULL, 0, 0, event_mode, 0, &first, n_intermediate, NULL, logger,
                                       NULL);
}

static fmi3Instance start(fmi3Instance c) {
    CHECK(c);
    OK(fmi3EnterInitializationMode(c, 1, 1e-6, 0.0, 1, STEPS * H));
    OK(fmi3ExitInitializationMode(c));
    return c;
}

static double read_all(fmi3Instance c) {
    double sum = 0.0;
    for (unsigned i = 0; i < MODEL_N_VARIABLES; i++) {
        double value = 0.0;
        int whole = 0;
        fmi3Boolean truth = 0;
        if (VARIABLE[i].type == TYPE_REAL) OK(fmi3GetFloat64(c, &i, 1, &value, 1));
        else if (VARIABLE[i].type == TYPE_INTEGER) OK(fmi3GetInt32(c, &i, 1, &whole, 1));
        else OK(fmi3GetBoolean(c, &i, 1, &truth, 1));
        CHECK(isfinite(value));
        sum += value + whole + truth;
    }
    return sum;
}

static double steps(fmi3Instance c, int from, int to) {
    double sum = 0.0, last = 0.0;
    fmi3Boolean event = 1, end = 1, early = 1;
    for (int k = from; k < to; k++) {
        const double u = k / 7 % 2 ? 0.3 : -0.3;
        for (unsigned i = 0; i < MODEL_N_VARIABLES; i++)
            if (VARIABLE[i].settable == SETTABLE_INPUT && VARIABLE[i].type == TYPE_REAL) OK(fmi3SetFloat64(c, &i, 1, &u, 1));
        OK(fmi3DoStep(c, k * H, H, 1, &event, &end, &early, &last));
        CHECK(!event && !end && !early && fabs(last - (k + 1) * H) < 1e-12);
        sum += read_all(c);
    }
    return sum;
}

static void co_simulation(void) {
    fmi3Instance c = start(slave(0, 0));
    fmi3FMUState state = NULL;
    fmi3Boolean flag;
    double last;
    size_t size = 0;
    OK(fmi3EnterStepMode(c));
    steps(c, 0, STEPS / 2);
    OK(fmi3GetFMUState(c, &state));
    const double rest = steps(c, STEPS / 2, STEPS);
    OK(fmi3SerializedFMUStateSize(c, state, &size));
    fmi3Byte *bytes = malloc(size);
    OK(fmi3SerializeFMUState(c, state, bytes, size));
    OK(fmi3FreeFMUState(c, &state));
    OK(fmi3DeserializeFMUState(c, bytes, size, &state));
    REFUSED(fmi3DeserializeFMUState(c, bytes, 3, &state));
    OK(fmi3SetFMUState(c, state));
    CHECK(steps(c, STEPS / 2, STEPS) == rest);
    REFUSED(fmi3DoStep(c, STEPS * H, H, 1, &flag, &flag, &flag, &last)); /* past the stop time */
    OK(fmi3Reset(c));
    start(c);
    OK(fmi3Terminate(c));
    OK(fmi3FreeFMUState(c, &state));
    fmi3FreeInstance(c);
    free(bytes);
}

static void model_exchange(void) {
    fmi3Instance c = start(fmi3InstantiateModelExchange("one", MODEL_GUID, NULL, 0, 0, NULL, logger));
    double x[LENGTH(NX)], dx[LENGTH(NX)], g[LENGTH(NM)], next;
    fmi3Boolean flag = 0;
    size_t n = 0;
    OK(fmi3EvaluateDiscreteStates(c));
    OK(fmi3UpdateDiscreteStates(c, &flag, &flag, &flag, &flag, &flag, &next));
    OK(fmi3GetNumberOfContinuousStates(c, &n));
    CHECK(n == NX);
    OK(fmi3GetNumberOfEventIndicators(c, &n));
    CHECK(n == NM);
    OK(fmi3EnterContinuousTimeMode(c));
    for (int k = 0; k < STEPS; k++) {
        OK(fmi3SetTime(c, k * H));
        OK(fmi3GetContinuousStates(c, x, NX));
        OK(fmi3GetContinuousStateDerivatives(c, dx, NX));
        OK(fmi3GetEventIndicators(c, g, NM));
        for (int i = 0; i < NX; i++) x[i] += 1e-4 * H * dx[i];
        OK(fmi3SetContinuousStates(c, x, NX));
        OK(fmi3CompletedIntegratorStep(c, 1, &flag, &flag));
    }
    OK(fmi3GetNominalsOfContinuousStates(c, x, NX));
    REFUSED(fmi3GetContinuousStates(c, x, NX + 1));
    REFUSED(fmi3GetEventIndicators(c, g, NM + 1));
    fmi3FreeInstance(c);
}

#define NO_TYPE(name, type)                                  \
    do {                                                     \
        type value[1] = {0};                                 \
        REFUSED(fmi3Get##name(c, &first, 1, value, 1));      \
        REFUSED(fmi3Set##name(c, &first, 1, value, 1));      \
    } while (0)

static void refusals(void) {
    messages = 0;
    CHECK(!slave(1, 0) && messages == 1);
    CHECK(!slave(0, 1) && messages == 2);
    CHECK(!fmi3InstantiateScheduledExecution("one", MODEL_GUID, NULL, 0, 0, NULL, logger, NULL, NULL, NULL) && messages == 3);
    CHECK(!fmi3InstantiateModelExchange("one", "another", NULL, 0, 0, NULL, logger) && messages == 4);
    fmi3Instance c = slave(0, 0);
    const unsigned first = 0, none = MODEL_N_VARIABLES;
    double value = 0.0, seed[2] = {1.0, 1.0};
    fmi3Binary binary = NULL;
    fmi3Clock clock = 0;
    fmi3IntervalQualifier qualifier;
    fmi3DependencyKind kind;
    fmi3UInt64 counter = 0;
    fmi3Int32 order = 1;
    fmi3Boolean flag;
    size_t size = 0;
    REFUSED(fmi3EnterInitializationMode(c, 1, 2.0, 0.0, 0, 0.0));
    REFUSED(fmi3ExitInitializationMode(c));
    REFUSED(fmi3EnterConfigurationMode(c));
    REFUSED(fmi3ExitConfigurationMode(c));
    start(c);
    REFUSED(fmi3GetFloat64(c, &none, 1, &value, 1));
    REFUSED(fmi3GetFloat64(c, &first, 1, &value, 2));
    REFUSED(fmi3SetFloat64(c, &first, 1, &value, 2));
    NO_TYPE(Float32, fmi3Float32);
    NO_TYPE(Int8, fmi3Int8);
    NO_TYPE(UInt8, fmi3UInt8);
    NO_TYPE(Int16, fmi3Int16);
    NO_TYPE(UInt16, fmi3UInt16);
    NO_TYPE(UInt32, fmi3UInt32);
    NO_TYPE(UInt64, fmi3UInt64);
    NO_TYPE(String, fmi3String);
    REFUSED(fmi3GetBinary(c, &first, 1, &size, &binary, 1));
    REFUSED(fmi3SetBinary(c, &first, 1, &size, &binary, 1));
    REFUSED(fmi3GetClock(c, &first, 1, &clock));
    REFUSED(fmi3SetClock(c, &first, 1, &clock));
    REFUSED(fmi3GetIntervalDecimal(c, &first, 1, &value, &qualifier));
    REFUSED(fmi3GetIntervalFraction(c, &first, 1, &counter, &counter, &qualifier));
    REFUSED(fmi3GetShiftDecimal(c, &first, 1, &value));
    REFUSED(fmi3GetShiftFraction(c, &first, 1, &counter, &counter));
    REFUSED(fmi3SetIntervalDecimal(c, &first, 1, &value));
    REFUSED(fmi3SetIntervalFraction(c, &first, 1, &counter, &counter));
    REFUSED(fmi3SetShiftDecimal(c, &first, 1, &value));
    REFUSED(fmi3SetShiftFraction(c, &first, 1, &counter, &counter));
    REFUSED(fmi3ActivateModelPartition(c, first, 0.0));
    REFUSED(fmi3GetNumberOfVariableDependencies(c, first, &size));
    REFUSED(fmi3GetVariableDependencies(c, first, &size, (unsigned[1]){0}, &size, &kind, 1));
    REFUSED(fmi3GetAdjointDerivative(c, &first, 1, &first, 1, seed, 1, &value, 1));
    REFUSED(fmi3GetDirectionalDerivative(c, &first, 1, &first, 1, seed, 2, &value, 1));
    REFUSED(fmi3GetOutputDerivatives(c, &first, 1, &order, &value, 1));
    REFUSED(fmi3EnterEventMode(c));
    REFUSED(fmi3CompletedIntegratorStep(c, 0, &flag, &flag));
    REFUSED(fmi3SetFMUState(c, NULL));
    fmi3FreeInstance(c);
}

int main(void) {
    co_simulation();
    model_exchange();
    refusals();
    return 0;
}
