/* Bench.mo's drive as an FMU for co-simulation (FMI 2.0), for where there is no C compiler: the classical Runge-Kutta
 * method with steps of half a millisecond at most. Value references: modelDescription in drive.py. */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { OK = 0, ERROR = 3 };
enum { TAU, W_MOTOR, W_LOAD, J_ROTOR, C_SHAFT, D_SHAFT, J_LOAD, N };
#define STATES 4 /* angle of the shaft's ends, then speeds */
#define STEP 5e-4

typedef struct { double r[N], x[STATES]; } Drive;

static void defaults(Drive *s)
{
    memset(s, 0, sizeof *s);
    s->r[J_ROTOR] = 2.5e-3;
    s->r[C_SHAFT] = 12;
    s->r[D_SHAFT] = 0.02;
    s->r[J_LOAD] = 4e-3;
}

static void slope(const Drive *s, const double x[], double dx[])
{
    double shaft = s->r[C_SHAFT] * (x[0] - x[1]) + s->r[D_SHAFT] * (x[2] - x[3]);
    dx[0] = x[2];
    dx[1] = x[3];
    dx[2] = (s->r[TAU] - shaft) / s->r[J_ROTOR];
    dx[3] = shaft / s->r[J_LOAD];
}

static void advance(Drive *s, double h)
{
    static const double at[] = {0, 0.5, 0.5, 1}, weight[] = {1, 2, 2, 1};
    double sum[STATES] = {0}, k[STATES] = {0};
    for (int stage = 0; stage < 4; stage++) {
        double x[STATES];
        for (int i = 0; i < STATES; i++) x[i] = s->x[i] + at[stage] * h * k[i];
        slope(s, x, k);
        for (int i = 0; i < STATES; i++) sum[i] += weight[stage] / 6 * k[i];
    }
    for (int i = 0; i < STATES; i++) s->x[i] += h * sum[i];
    s->r[W_MOTOR] = s->x[2];
    s->r[W_LOAD] = s->x[3];
}

#if defined _WIN32
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
API void *fmi2Instantiate(const char *name, int type, const char *guid, const char *folder, const void *callbacks,
                          int visible, int logging)
{
    (void)name, (void)type, (void)guid, (void)folder, (void)callbacks, (void)visible, (void)logging;
    Drive *s = malloc(sizeof *s);
    if (s) defaults(s);
    return s;
}
API void fmi2FreeInstance(void *c) { free(c); }
API int fmi2SetupExperiment(void *c, int given, double tolerance, double start, int ends, double stop)
{
    (void)c, (void)given, (void)tolerance, (void)start, (void)ends, (void)stop;
    return OK;
}
API int fmi2EnterInitializationMode(void *c) { (void)c; return OK; }
API int fmi2ExitInitializationMode(void *c)
{
    const Drive *s = c;
    return s->r[J_ROTOR] > 0 && s->r[J_LOAD] > 0 ? OK : ERROR;
}
API int fmi2Terminate(void *c) { (void)c; return OK; }
API int fmi2Reset(void *c) { defaults(c); return OK; }
API int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[])
{
    for (size_t i = 0; i < n; i++) value[i] = ((Drive *)c)->r[vr[i]];
    return OK;
}
API int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++) ((Drive *)c)->r[vr[i]] = value[i];
    return OK;
}
API int fmi2DoStep(void *c, double t, double h, int keeps)
{
    (void)t, (void)keeps;
    int steps = (int)(h / STEP - 1e-6) + 1;
    for (int i = 0; i < steps; i++) advance(c, h / steps);
    return OK;
}
