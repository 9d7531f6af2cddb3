/* A test FMU for FMI 2.0 and 3.0, co-simulation and model exchange: a driven oscillator with a latching switch.
 *
 *     der(x) = v,  m der(v) = u + w - d v - c x,  y = gain x (+ bias if flip),  stored = int(trunc)
 *     model exchange: `count` counts the falls of x through `level`, each a state event that adds `kick` to v; `ticks` counts time events
 *
 * Co-simulation integrates with the explicit midpoint rule, 1 ms at most. `fault` makes it misbehave at t >= 0.1.
 * Compile with -DFMI=2 or 3 and perhaps -DRESET_FAILS, -DRESET_CRASHES, -DRESET_FORGETS_STATE, -DRESET_FORGETS_PARAMETERS, -DONCE,
 * -DBAD=fault (where c > 140), -DNOISE=x (of derivatives, as an inner solver leaves it; `count` is of their evaluations) with directional derivatives, -DDECLARES (them, but they fail), -DCALLS (`count` is of the calls that set, step and get reals in co-simulation), -DTIRES=n (dies at the n-th instantiation), -DLIMIT=x, -DSTUCK, -DRESTLESS (events without end).
 */
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#if FMI == 2
#include "fmi2Functions.h"
typedef fmi2Status Status;
typedef fmi2Component Handle;
#define F(name) fmi2##name
#else
#include "fmi3Functions.h"
typedef fmi3Status Status;
typedef fmi3Instance Handle;
#define F(name) fmi3##name
#endif

enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { NO_FAULT, CRASH, HANG, NOT_A_NUMBER, FAILS, LEAKS, DEVOURS, FATALLY, ENDS, SEGFAULTS, SLOW, LEAVES, INTERRUPTS };
/* value references */
enum { TIME, M, D, C, GAIN, U, X, V, Y, DX, DV, FLIP, FAULT, BIAS, COUNT, LEVEL, TICKS, MODE, TABLE, TABLE_SUM, ZERO, W, KICK, N };

typedef struct {
    double t, r[N], table[6];
    int broken;   /* by an error, until it is instantiated anew */
    double limit; /* of x, beyond which there are no derivatives */
    double slope; /* of the input, in co-simulation */
    int continuous;
    double tick;
#if FMI == 2
    const fmi2CallbackFunctions *callbacks;
#else
    fmi3LogMessageCallback log;
#endif
} Model;

static int instances, age, interrupted;
static void *volatile leaked;

static int fault(const Model *s)
{
#ifdef BAD
    if (s->r[C] > 140) return BAD;
#endif
    return (int)s->r[FAULT];
}

static void defaults(Model *s)
{
    memset(s->r, 0, sizeof s->r);
    s->r[M] = 1; s->r[D] = 0.5; s->r[C] = 100; s->r[GAIN] = 1; s->r[X] = 0.1; s->r[BIAS] = 3; s->r[LEVEL] = 0; s->r[MODE] = 1;
    for (int i = 0; i < 6; i++) s->table[i] = i;
    s->t = s->slope = 0;
    s->limit = HUGE_VAL;
#ifdef LIMIT
    s->limit = LIMIT;
#endif
    s->tick = 0.25;
}

static double value(Model *s, unsigned vr)
{
    switch (vr) {
    case TIME: return s->t;
    case DX: return s->r[V];
    case DV: return (s->r[U] + s->r[W] - s->r[D] * s->r[V] - s->r[C] * s->r[X]) / s->r[M];
    case Y: {
        double y = s->r[GAIN] * s->r[X] + (s->r[FLIP] ? s->r[BIAS] : 0) + (s->r[MODE] - 1);
        return fault(s) == NOT_A_NUMBER && s->t >= 0.1 ? NAN : y;
    }
    case TABLE_SUM: { double sum = 0; for (int i = 0; i < 6; i++) sum += (i + 1) * s->table[i]; return sum; }
    default: return s->r[vr];
    }
}

static Status say(Model *s, Status status, const char *text)
{
#if FMI == 2
    s->callbacks->logger(s->callbacks->componentEnvironment, "oscillator", status, "error", "%s at %g s", text, s->t);
#else
    s->log(NULL, status, "error", text);
#endif
    return status;
}

static void called(Model *s)
{
#ifdef CALLS
    s->r[COUNT]++;
#else
    (void)s;
#endif
}

static Status misbehave(Model *s)
{
    if (s->broken) return say(s, ERROR, "still broken");
    if (s->t < 0.1) return OK;
    switch (fault(s)) {
    case CRASH: abort();
    case SEGFAULTS: *(volatile int *)8 = 1; break;
    case LEAVES: exit(0);
    case HANG: for (volatile int i = 0;; i = !i); break;
    case INTERRUPTS: if (!interrupted++) raise(SIGINT); /* falls through */
    case SLOW: usleep(20000); break;
    case FAILS: s->broken = 1; return say(s, ERROR, "the bearing has melted");
    case FATALLY: return say(s, FATAL, "everything is lost");
    case LEAKS: memset(leaked = malloc(1 << 15), 1, 1 << 15); break;
    case DEVOURS: for (;;) memset(leaked = malloc(1 << 22), 1, 1 << 22);
    }
    return OK;
}

static void step(Model *s, double h)
{
#ifdef COARSE /* one step of the solver from sample to sample */
    int n = 1;
#else
    int n = (int)ceil(h / 1e-3 - 1e-6);
#endif
    double dt = h / n, t0 = s->t, u0 = s->r[U];
    for (int i = 0; i < n; i++) {
        s->r[U] = u0 + i * dt * s->slope;
        double x = s->r[X], v = s->r[V], a = value(s, DV);
        s->r[X] = x + dt / 2 * v; s->r[V] = v + dt / 2 * a;
        s->r[U] = u0 + (i + 0.5) * dt * s->slope;
        double vm = s->r[V], am = value(s, DV);
        s->r[X] = x + dt * vm; s->r[V] = v + dt * am;
    }
    s->t = t0 + h;
}

/* ---- both versions ---- */

static void *create(void)
{
#ifdef ONCE
    if (instances) return NULL;
#endif
#ifdef TIRES
    if (++age > TIRES) abort();
#endif
    instances++;
    Model *s = calloc(1, sizeof(Model));
    defaults(s);
    return s;
}

void F(FreeInstance)(Handle c) { free(c); (void)instances; (void)age; }
Status F(ExitInitializationMode)(Handle c) { Model *s = c; if (s->r[M] <= 0) return say(s, ERROR, "m must be positive"); return OK; }
Status F(Terminate)(Handle c) { (void)c; return OK; }
Status F(Reset)(Handle c)
{
    Model *s = c, old = *s;
    (void)old;
#ifdef RESET_FAILS
    return ERROR;
#endif
#ifdef RESET_CRASHES
    abort();
#endif
    defaults(s);
#ifdef RESET_FORGETS_STATE
    s->r[V] = old.r[V];
#endif
#ifdef RESET_FORGETS_PARAMETERS
    for (int i = M; i <= GAIN; i++) s->r[i] = old.r[i];
#endif
    return OK;
}
Status F(EnterEventMode)(Handle c) { (void)c; return OK; }
Status F(EnterContinuousTimeMode)(Handle c) { (void)c; return OK; }
Status F(SetTime)(Handle c, double t) { ((Model *)c)->t = t; return misbehave(c); }
Status F(SetContinuousStates)(Handle c, const double x[], size_t n) { Model *s = c; (void)n; s->r[X] = x[0]; s->r[V] = x[1]; return OK; }
Status F(GetContinuousStates)(Handle c, double x[], size_t n) { Model *s = c; (void)n; x[0] = s->r[X]; x[1] = s->r[V]; return OK; }
Status F(GetNominalsOfContinuousStates)(Handle c, double x[], size_t n) { (void)c; (void)n; x[0] = x[1] = 1; return OK; }
Status F(GetEventIndicators)(Handle c, double z[], size_t n) { Model *s = c; (void)n; z[0] = s->r[X] - s->r[LEVEL]; return OK; }
static Status derivatives(Model *s, double dx[])
{
    if (s->r[X] > s->limit) return say(s, DISCARD, "beyond the limit");
    dx[0] = value(s, DX); dx[1] = value(s, DV);
#ifdef NOISE
    s->r[COUNT]++;
    dx[1] *= 1 + NOISE * sin(1e12 * (s->r[X] + s->r[V]));
#endif
    return OK;
}
static int event(Model *s, int *next_defined, double *next)
{
    int kicked = 0;
    double z = s->r[X] - s->r[LEVEL];
    if (s->continuous == 0) { s->continuous = z > 0 ? 1 : -1; }
    if (s->continuous > 0 && z <= 0) {
        s->r[COUNT]++;
        s->continuous = -1;
        s->r[V] += s->r[KICK];
        kicked = s->r[KICK] != 0;
    }
    else if (s->continuous < 0 && z > 0) s->continuous = 1;
    if (s->t >= s->tick - 1e-12) { s->r[TICKS]++; s->tick += 0.25; }
    *next_defined = 1;
    *next = s->tick;
#ifdef STUCK
    if (s->t > 0.2) *next = 0.2;
#endif
    return kicked;
}

static Status advance(Model *s, double t, double h)
{
    s->t = t;
    Status status = misbehave(s);
    if (status > 1) return status;
#ifdef STEP
    if (fabs(h - STEP) > 1e-12) return say(s, ERROR, "another step size");
#endif
    step(s, h);
    return OK;
}

#ifdef NOISE
static Status directional(Model *s, const unsigned a[], size_t n, unsigned b, double x, double y[])
{
    for (size_t i = 0; i < n; i++)
        y[i] = x * (a[i] == DX ? b == V : a[i] == DV ? (b == X ? -s->r[C] : -s->r[D]) / s->r[M] : a[i] == b);
    return OK;
}
#else
static Status directional(Model *s, const unsigned a[], size_t n, unsigned b, double x, double y[])
{ (void)s; (void)a; (void)n; (void)b; (void)x; (void)y; return ERROR; }
#endif

#if FMI == 2
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Component fmi2Instantiate(fmi2String n, fmi2Type t, fmi2String guid, fmi2String r, const fmi2CallbackFunctions *f, fmi2Boolean v, fmi2Boolean l)
{
    (void)n; (void)t; (void)r; (void)v; (void)l;
    if (strcmp(guid, "oscillator")) return NULL;
    Model *s = create();
    if (s) s->callbacks = f;
    return s;
}
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean td, fmi2Real tol, fmi2Real t0, fmi2Boolean sd, fmi2Real t1)
{ (void)td; (void)tol; (void)sd; (void)t1; ((Model *)c)->t = t0; return OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { ((Model *)c)->continuous = 0; return OK; }
#define GETTER(T) for (size_t i = 0; i < n; i++) value_[i] = (T)value(c, vr[i]); return OK
#define SETTER for (size_t i = 0; i < n; i++) ((Model *)c)->r[vr[i]] = value_[i]; return OK
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value_[]) { called(c); GETTER(double); }
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value_[]) { GETTER(int); }
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value_[]) { GETTER(int); }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value_[]) { called(c); SETTER; }
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value_[]) { SETTER; }
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value_[]) { SETTER; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean n)
{
    (void)n;
    called(c);
    if (fault((Model *)c) == ENDS && t >= 0.1) return DISCARD;
    return advance(c, t, h);
}
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind k, fmi2Boolean *b) { (void)c; *b = k == fmi2Terminated; return OK; }
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) { (void)n; return derivatives(c, dx); }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *e)
{
    memset(e, 0, sizeof *e);
    e->valuesOfContinuousStatesChanged = event(c, &e->nextEventTimeDefined, &e->nextEventTime);
#ifdef RESTLESS
    e->newDiscreteStatesNeeded = 1;
#endif
    return OK;
}
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean n, fmi2Boolean *e, fmi2Boolean *t) { (void)c; (void)n; *e = *t = 0; return OK; }
/* FMPy asks for every function of the standard to be there. */
#define ABSENT(name, ...) fmi2Status name(__VA_ARGS__) { return ERROR; }
ABSENT(fmi2SetDebugLogging, fmi2Component c, fmi2Boolean l, size_t n, const fmi2String k[])
ABSENT(fmi2GetString, fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String x[])
ABSENT(fmi2SetString, fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String x[])
ABSENT(fmi2GetFMUstate, fmi2Component c, fmi2FMUstate *s)
ABSENT(fmi2SetFMUstate, fmi2Component c, fmi2FMUstate s)
ABSENT(fmi2FreeFMUstate, fmi2Component c, fmi2FMUstate *s)
ABSENT(fmi2SerializedFMUstateSize, fmi2Component c, fmi2FMUstate s, size_t *n)
ABSENT(fmi2SerializeFMUstate, fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n)
ABSENT(fmi2DeSerializeFMUstate, fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference a[], size_t n, const fmi2ValueReference b[],
                                        size_t m, const fmi2Real x[], fmi2Real y[])
{ (void)m; return directional(c, a, n, b[0], x[0], y); }
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference v[], size_t n, const fmi2Integer o[], const fmi2Real x[])
{
    if (n != 1 || v[0] != U || o[0] != 1) return ERROR;
    ((Model *)c)->slope = x[0];
    return OK;
}
ABSENT(fmi2GetRealOutputDerivatives, fmi2Component c, const fmi2ValueReference v[], size_t n, const fmi2Integer o[], fmi2Real x[])
ABSENT(fmi2CancelStep, fmi2Component c)
ABSENT(fmi2GetStatus, fmi2Component c, const fmi2StatusKind k, fmi2Status *x)
ABSENT(fmi2GetRealStatus, fmi2Component c, const fmi2StatusKind k, fmi2Real *x)
ABSENT(fmi2GetIntegerStatus, fmi2Component c, const fmi2StatusKind k, fmi2Integer *x)
ABSENT(fmi2GetStringStatus, fmi2Component c, const fmi2StatusKind k, fmi2String *x)
#else
const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String n, fmi3String token, fmi3String r, fmi3Boolean v, fmi3Boolean l, fmi3Boolean em, fmi3Boolean er,
    const fmi3ValueReference i[], size_t ni, fmi3InstanceEnvironment e, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback u)
{
    (void)n; (void)r; (void)v; (void)l; (void)em; (void)er; (void)i; (void)ni; (void)e; (void)u;
    if (strcmp(token, "oscillator")) return NULL;
    Model *s = create();
    if (s) s->log = log;
    return s;
}
fmi3Instance fmi3InstantiateModelExchange(fmi3String n, fmi3String token, fmi3String r, fmi3Boolean v, fmi3Boolean l, fmi3InstanceEnvironment e, fmi3LogMessageCallback log)
{ return fmi3InstantiateCoSimulation(n, token, r, v, l, 0, 0, NULL, 0, e, log, NULL); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean td, fmi3Float64 tol, fmi3Float64 t0, fmi3Boolean sd, fmi3Float64 t1)
{ (void)td; (void)tol; (void)sd; (void)t1; ((Model *)c)->t = t0; ((Model *)c)->continuous = 0; return OK; }
#define GET(name, T) fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, T x[], size_t m) \
{ Model *s = c; (void)m; for (size_t i = 0; i < n; i++) { if (vr[i] == TABLE) { for (int j = 0; j < 6; j++) *x++ = (T)s->table[j]; } else *x++ = (T)value(s, vr[i]); } return OK; }
#define SET(name, T) fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const T x[], size_t m) \
{ Model *s = c; (void)m; for (size_t i = 0; i < n; i++) { if (vr[i] == TABLE) { for (int j = 0; j < 6; j++) s->table[j] = *x++; } else s->r[vr[i]] = *x++; } return OK; }
GET(Float64, fmi3Float64) SET(Float64, fmi3Float64)
GET(Int32, fmi3Int32) SET(Int32, fmi3Int32)
GET(Int64, fmi3Int64) SET(Int64, fmi3Int64)
GET(Boolean, fmi3Boolean) SET(Boolean, fmi3Boolean)
GET(Float32, fmi3Float32) SET(Float32, fmi3Float32)
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean n, fmi3Boolean *ev, fmi3Boolean *term, fmi3Boolean *early, fmi3Float64 *last)
{
    (void)n;
    *ev = *early = 0;
    *term = fault((Model *)c) == ENDS && t >= 0.1;
    Status status = advance(c, t, h);
    *last = t + h;
    return status;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { (void)n; return derivatives(c, dx); }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need, fmi3Boolean *term, fmi3Boolean *nom, fmi3Boolean *val, fmi3Boolean *def, fmi3Float64 *next)
{
    int defined;
    *need = *term = *nom = *val = 0;
    *val = event(c, &defined, next);
    *def = defined;
    return OK;
}
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference a[], size_t n, const fmi3ValueReference b[],
                                        size_t m, const fmi3Float64 x[], size_t nx, fmi3Float64 y[], size_t ny)
{ (void)m; (void)nx; (void)ny; return directional(c, a, n, b[0], x[0], y); }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean n, fmi3Boolean *e, fmi3Boolean *t) { (void)c; (void)n; *e = *t = 0; return OK; }
#endif
