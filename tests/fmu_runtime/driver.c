/* The FMI functions as a plain program calls them: runs in both interfaces, states, refusals. Made for sanitizers and
 * valgrind; exits with 1 at the first thing that is not as it should be. Linked with the sources of one FMU (FMI 2.0). */
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "model.h"
#include "instance.h"
#include "model_config.h"
#include "sensitivity.h"

enum { STEPS = 60 };
static const VariableEntry VARIABLE[] = MODEL_VARIABLES;
static const double H = 0.01;
static _Thread_local int messages;

static void logger(void *environment, const char *name, fmi2Status status, const char *category, const char *message, ...) {
    (void)environment, (void)status, (void)category;
    if (!name || !strlen(message)) abort();
    messages++;
}

#define CHECK(condition)                                                         \
    do {                                                                         \
        if (!(condition)) {                                                      \
            fprintf(stderr, "driver.c:%d: not so: %s\n", __LINE__, #condition);  \
            exit(1);                                                             \
        }                                                                        \
    } while (0)
#define OK(call) CHECK((call) == fmi2OK)
/* Not only fails: says why. */
#define REFUSED(call)                        \
    do {                                     \
        const int before = messages;         \
        CHECK((call) >= fmi2Discard);        \
        CHECK(messages > before);            \
    } while (0)

static const fmi2CallbackFunctions CALLBACKS = {.logger = logger};

static fmi2Component make(fmi2Type type) {
    fmi2Component c = fmi2Instantiate("one", type, MODEL_GUID, "file:///nowhere", &CALLBACKS, 0, 0);
    CHECK(c);
    return c;
}

static fmi2Component start(fmi2Component c, double tolerance) {
    OK(fmi2SetupExperiment(c, 1, tolerance, 0.0, 1, STEPS * H));
    OK(fmi2EnterInitializationMode(c));
    OK(fmi2ExitInitializationMode(c));
    return c;
}

static double read_all(fmi2Component c) {
    double sum = 0.0;
    for (unsigned i = 0; i < MODEL_N_VARIABLES; i++) {
        double value = 0.0;
        int whole = 0;
        if (VARIABLE[i].type == TYPE_REAL) OK(fmi2GetReal(c, &i, 1, &value));
        else if (VARIABLE[i].type == TYPE_INTEGER) OK(fmi2GetInteger(c, &i, 1, &whole));
        else OK(fmi2GetBoolean(c, &i, 1, &whole));
        CHECK(isfinite(value));
        sum += value + whole;
    }
    return sum;
}

static void set_inputs(fmi2Component c, double value) {
    for (unsigned i = 0; i < MODEL_N_VARIABLES; i++)
        if (VARIABLE[i].settable == SETTABLE_INPUT && VARIABLE[i].type == TYPE_REAL) OK(fmi2SetReal(c, &i, 1, &value));
}

static double steps(fmi2Component c, int from, int to) {
    double sum = 0.0;
    for (int k = from; k < to; k++) {
        set_inputs(c, k / 7 % 2 ? 0.3 : -0.3);
        OK(fmi2DoStep(c, k * H, H, 1));
        sum += read_all(c);
    }
    return sum;
}

static void co_simulation(void) {
    fmi2Component c = start(make(fmi2CoSimulation), 1e-6);
    steps(c, 0, STEPS / 2);
    fmi2FMUstate state = NULL;
    OK(fmi2GetFMUstate(c, &state));
    const double rest = steps(c, STEPS / 2, STEPS);
    REFUSED(fmi2DoStep(c, STEPS * H, H, 1)); /* past the stop time */
    OK(fmi2SetFMUstate(c, state));
    CHECK(steps(c, STEPS / 2, STEPS) == rest);

    size_t size = 0;
    OK(fmi2SerializedFMUstateSize(c, state, &size));
    char *bytes = malloc(size);
    OK(fmi2SerializeFMUstate(c, state, bytes, size));
    REFUSED(fmi2SerializeFMUstate(c, state, bytes, size - 1));
    REFUSED(fmi2SerializeFMUstate(c, NULL, bytes, size));
    OK(fmi2FreeFMUstate(c, &state));
    REFUSED(fmi2SetFMUstate(c, state));
    fmi2Component other = make(fmi2CoSimulation);
    OK(fmi2DeSerializeFMUstate(other, bytes, size, &state));
    REFUSED(fmi2DeSerializeFMUstate(other, bytes, size - 1, &state));
    OK(fmi2SetFMUstate(other, state));
    CHECK(steps(other, STEPS / 2, STEPS) == rest);
    OK(fmi2FreeFMUstate(other, &state));
    fmi2FreeInstance(other);
    free(bytes);

    OK(fmi2Terminate(c));
    read_all(c);
    OK(fmi2Reset(c));
    const double first = steps(start(c, 1e-6), 0, STEPS);
    OK(fmi2Reset(c));
    CHECK(steps(start(c, 1e-6), 0, STEPS) == first);
    fmi2FreeInstance(c);
}

static void model_exchange(void) {
    fmi2Component c = start(make(fmi2ModelExchange), 1e-6);
    double x[LENGTH(NX)], dx[LENGTH(NX)], g[LENGTH(NM)];
    fmi2EventInfo info = {.newDiscreteStatesNeeded = 1};
    OK(fmi2NewDiscreteStates(c, &info));
    OK(fmi2EnterContinuousTimeMode(c));
    for (int k = 0; k < STEPS; k++) {
        fmi2Boolean event = 0, end = 0;
        OK(fmi2SetTime(c, k * H));
        OK(fmi2GetContinuousStates(c, x, NX));
        OK(fmi2GetDerivatives(c, dx, NX));
        OK(fmi2GetEventIndicators(c, g, NM));
        for (int i = 0; i < NX; i++) x[i] += 1e-4 * H * dx[i];
        OK(fmi2SetContinuousStates(c, x, NX));
        OK(fmi2CompletedIntegratorStep(c, 1, &event, &end));
        if (k % 10 == 0) {
            OK(fmi2EnterEventMode(c));
            set_inputs(c, 0.1 * k);
            OK(fmi2NewDiscreteStates(c, &info));
            OK(fmi2EnterContinuousTimeMode(c));
        }
    }
    OK(fmi2GetNominalsOfContinuousStates(c, x, NX));
    REFUSED(fmi2GetContinuousStates(c, x, NX + 1));
    REFUSED(fmi2SetContinuousStates(c, x, NX + 1));
    REFUSED(fmi2GetDerivatives(c, dx, NX + 1));
    REFUSED(fmi2GetEventIndicators(c, g, NM + 1));
    REFUSED(fmi2DoStep(c, 0.0, H, 1));
    for (unsigned known = 0; known < MODEL_N_VARIABLES; known++) {
        const Vector v = VARIABLE[known].vector;
        const int may = VARIABLE[known].type == TYPE_REAL && (v == VECTOR_X || v == VECTOR_U || v == VECTOR_P || v == VECTOR_D);
        for (unsigned unknown = 0; unknown < MODEL_N_VARIABLES; unknown++) {
            const double seed = 1.0;
            double value = NAN;
            if (!may) {
                REFUSED(fmi2GetDirectionalDerivative(c, &unknown, 1, &known, 1, &seed, &value));
            } else if (VARIABLE[unknown].type == TYPE_REAL && VARIABLE[unknown].vector != VECTOR_G) {
                OK(fmi2GetDirectionalDerivative(c, &unknown, 1, &known, 1, &seed, &value));
                CHECK(isfinite(value));
            }
        }
    }
    fmi2FreeInstance(c);
}

static void sensitivities(void) {
    fmi2Component c = make(fmi2CoSimulation);
    unsigned parameter[MODEL_N_VARIABLES], variable[MODEL_N_VARIABLES];
    size_t n = 0, m = 0;
    for (unsigned i = 0; i < MODEL_N_VARIABLES; i++) {
        const Settable s = VARIABLE[i].settable;
        if (VARIABLE[i].type != TYPE_REAL || VARIABLE[i].vector == VECTOR_G) continue;
        variable[m++] = i;
        if (s == SETTABLE_FIXED || s == SETTABLE_TUNABLE || s == SETTABLE_START) parameter[n++] = i;
    }
    double *values = malloc((n * m + 1) * sizeof *values);
    REFUSED((fmi2Status)fmuidGetSensitivities(c, variable, m, values));
    if (n > 0) {
        const unsigned none = MODEL_N_VARIABLES;
        REFUSED((fmi2Status)fmuidSetSensitivityParameters(c, &none, 1));
        OK((fmi2Status)fmuidSetSensitivityParameters(c, parameter, n));
        OK((fmi2Status)fmuidSetSensitivityParameters(c, parameter, n)); /* chosen anew */
        const int before = messages;
        OK(fmi2SetupExperiment(c, 1, 1e-6, 0.0, 1, STEPS * H));
        OK(fmi2EnterInitializationMode(c));
        if (fmi2ExitInitializationMode(c) != fmi2OK) { /* an event indicator may be zero at the start */
            CHECK(MODEL_HAS_EVENTS && messages > before);
            free(values);
            fmi2FreeInstance(c);
            return;
        }
        for (int k = 0; k < STEPS; k++) {
            steps(c, k, k + 1);
            OK((fmi2Status)fmuidGetSensitivities(c, variable, m, values));
            for (size_t i = 0; i < n * m; i++) CHECK(isfinite(values[i]));
        }
        REFUSED((fmi2Status)fmuidSetSensitivityParameters(c, parameter, n));
        OK(fmi2Reset(c));
        OK((fmi2Status)fmuidSetSensitivityParameters(c, parameter, n));
        start(c, 1e-6);
    }
    free(values);
    fmi2FreeInstance(c);
}

static void refusals(void) {
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, "another", NULL, &CALLBACKS, 0, 0));
    CHECK(messages > 0);
    CHECK(!fmi2Instantiate(NULL, fmi2CoSimulation, NULL, NULL, NULL, 0, 0)); /* nobody to tell */
    CHECK(fmi2Reset(NULL) == fmi2Error);
    fmi2FreeInstance(NULL);

    fmi2Component c = make(fmi2CoSimulation);
    fmi2Boolean flag = 0;
    fmi2EventInfo info;
    fmi2Status status;
    fmi2String text = "";
    const unsigned none = MODEL_N_VARIABLES, first = 0;
    const int whole = 0, order = 1, high = 2;
    const double value = 0.0, wrong = NAN;
    double read[LENGTH(NX)] = {0};
    int number = 0;
    REFUSED(fmi2SetupExperiment(c, 1, -1.0, 0.0, 0, 0.0));
    REFUSED(fmi2SetupExperiment(c, 1, NAN, 0.0, 0, 0.0));
    REFUSED(fmi2ExitInitializationMode(c));
    REFUSED(fmi2Terminate(c));
    start(c, 1e-5);
    REFUSED(fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0));
    REFUSED(fmi2EnterInitializationMode(c));
    REFUSED(fmi2GetReal(c, &none, 1, read));
    REFUSED(fmi2SetReal(c, &none, 1, &value));
    REFUSED(fmi2GetInteger(c, &none, 1, &number));
    REFUSED(fmi2SetInteger(c, &none, 1, &whole));
    REFUSED(fmi2GetBoolean(c, &none, 1, &number));
    REFUSED(fmi2SetBoolean(c, &none, 1, &whole));
    REFUSED(fmi2GetString(c, &none, 1, &text));
    REFUSED(fmi2SetString(c, &none, 1, &text));
    REFUSED(fmi2SetRealInputDerivatives(c, &none, 1, &order, &value));
    REFUSED(fmi2SetRealInputDerivatives(c, &first, 1, &high, &value));
    REFUSED(fmi2GetRealOutputDerivatives(c, &first, 1, &order, read));
    for (unsigned i = 0; i < MODEL_N_VARIABLES; i++) {
        const VariableEntry *v = &VARIABLE[i];
        if (v->settable == SETTABLE_INPUT && v->type == TYPE_REAL) {
            REFUSED(fmi2SetReal(c, &i, 1, &wrong));
            REFUSED(fmi2SetRealInputDerivatives(c, &i, 1, &order, &wrong));
        } else if (v->settable != SETTABLE_TUNABLE) {
            REFUSED(v->type == TYPE_REAL ? fmi2SetReal(c, &i, 1, &value)
                    : v->type == TYPE_INTEGER ? fmi2SetInteger(c, &i, 1, &whole) : fmi2SetBoolean(c, &i, 1, &whole));
            REFUSED(fmi2SetRealInputDerivatives(c, &i, 1, &order, &value));
        }
        REFUSED(v->type == TYPE_REAL ? fmi2GetInteger(c, &i, 1, &number) : fmi2GetReal(c, &i, 1, read));
    }
    REFUSED(fmi2NewDiscreteStates(c, &info));
    REFUSED(fmi2EnterEventMode(c));
    REFUSED(fmi2EnterContinuousTimeMode(c));
    REFUSED(fmi2SetTime(c, 0.0));
    REFUSED(fmi2SetContinuousStates(c, read, NX));
    REFUSED(fmi2CompletedIntegratorStep(c, 0, &flag, &flag));
    REFUSED(fmi2CancelStep(c));
    REFUSED(fmi2GetStatus(c, fmi2DoStepStatus, &status));
    REFUSED(fmi2GetIntegerStatus(c, fmi2DoStepStatus, &number));
    REFUSED(fmi2GetRealStatus(c, fmi2DoStepStatus, read));
    REFUSED(fmi2GetBooleanStatus(c, fmi2DoStepStatus, &flag));
    REFUSED(fmi2GetStringStatus(c, fmi2PendingStatus, &text));
    OK(fmi2GetBooleanStatus(c, fmi2Terminated, &flag));
    REFUSED(fmi2DoStep(c, 0.0, -H, 1));
    REFUSED(fmi2DoStep(c, 0.0, H, 1)); /* the failure before ended the run */
    OK(fmi2Reset(c));
    REFUSED(fmi2DoStep(start(c, 1e-5), 1.0, H, 1));
    fmi2FreeInstance(c);
}

static void *everything(void *unused) {
    co_simulation();
    model_exchange();
    sensitivities();
    refusals();
    return unused;
}

int main(void) {
    pthread_t thread[2];
    for (int i = 0; i < 2; i++) CHECK(!pthread_create(&thread[i], NULL, everything, NULL));
    for (int i = 0; i < 2; i++) CHECK(!pthread_join(thread[i], NULL));
    return 0;
}
