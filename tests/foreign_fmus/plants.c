/* Six models as FMUs for model exchange, FMI 2.0 or 3.0 (-DFMI=2|3), written by hand: a drive, a house, a circuit, two tanks, a vessel
 * and a rod, whose states, and their derivatives, are one array (FMI 3.0).
 * Value references are places in `r`: inputs and parameters as plants.py lists them, then states, then their derivatives. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define X(i) m->r[KNOWN + (i)]
#define DX(i) m->r[KNOWN + STATES + (i)]

#if defined DRIVE /* tau; J1, c, d, J2; angles, then speeds */
enum { KNOWN = 5, STATES = 4 };
static const double START[KNOWN + STATES] = {0, 2e-3, 15, 0.02, 5e-3, 0, 0, 0, 0};
#elif defined HOUSE /* heating, outside; capacity of the room, to the wall, of the wall, to the outside; temperatures */
enum { KNOWN = 6, STATES = 2 };
static const double START[KNOWN + STATES] = {0, 0, 2e5, 80, 3e6, 40, 293, 290};
#elif defined CIRCUIT /* source; L, R, C, load; current, voltage */
enum { KNOWN = 5, STATES = 2 };
static const double START[KNOWN + STATES] = {0, 1e-2, 2, 1e-3, 20, 0, 0};
#elif defined ROD /* heating; capacity of a part, between parts, to the surroundings and their temperature; temperatures */
enum { KNOWN = 5, STATES = 3 };
#define ARRAYS 1
static const double START[KNOWN + STATES] = {0, 60, 0.8, 0.3, 293, 293, 293, 293};
#elif defined VESSEL /* inflow; capacity, leak; pressure */
enum { KNOWN = 3, STATES = 1 };
static const double START[KNOWN + STATES] = {0, 0.5, 0.3, 1};
#else /* inflow; areas and outlets of two tanks; levels */
enum { KNOWN = 5, STATES = 2 };
static const double START[KNOWN + STATES] = {0, 0.02, 0.015, 1.2e-3, 1e-3, 0.3, 0.25};
#endif
enum { N = KNOWN + 2 * STATES };
#ifdef ARRAYS
#define FIRST(vr) ((vr) <= KNOWN ? (vr) : KNOWN + STATES)
#define SIZE(vr) ((vr) < KNOWN ? 1 : STATES)
#else
#define FIRST(vr) (vr)
#define SIZE(vr) 1
#endif
typedef struct { double r[N]; bool begun; } Model; /* values are readable once the initialisation has begun, as FMI says */

static void evaluate(Model *m)
{
    const double *k = m->r;
#if defined DRIVE
    double shaft = k[2] * (X(0) - X(1)) + k[3] * (X(2) - X(3));
    DX(0) = X(2), DX(1) = X(3), DX(2) = (k[0] - shaft) / k[1], DX(3) = shaft / k[4];
#elif defined HOUSE
    double inside = k[3] * (X(0) - X(1));
    DX(0) = (k[0] - inside) / k[2], DX(1) = (inside - k[5] * (X(1) - k[1])) / k[4];
#elif defined CIRCUIT
    DX(0) = (k[0] - k[2] * X(0) - X(1)) / k[1], DX(1) = (X(0) - X(1) / k[4]) / k[3];
#elif defined ROD
    double left = k[2] * (X(0) - X(1)), right = k[2] * (X(1) - X(2));
    DX(0) = (k[0] - left) / k[1], DX(1) = (left - right) / k[1], DX(2) = (right - k[3] * (X(2) - k[4])) / k[1];
#elif defined VESSEL
    DX(0) = (k[0] - k[2] * X(0)) / k[1];
#else
    double between = k[3] * sqrt(fmax(X(0), 0));
    DX(0) = (k[0] - between) / k[1], DX(1) = (between - k[4] * sqrt(fmax(X(1), 0))) / k[2];
#endif
}

#if FMI == 2
#define NAME(x) fmi2##x
#define TAIL
#else
#define NAME(x) fmi3##x
#define TAIL , size_t values
#endif

static void *make(void)
{
    Model *m = calloc(1, sizeof *m);
    memcpy(m->r, START, sizeof START);
    return m;
}
#if FMI == 2
const char *fmi2GetTypesPlatform(void) { return "default"; }
void *fmi2Instantiate(const char *n, int t, const char *g, const char *l, const void *c, int v, int o) { return make(); }
int fmi2SetupExperiment(void *c, int d, double t, double a, int s, double b) { return 0; }
int fmi2EnterInitializationMode(void *c) { return ((Model *)c)->begun = true, 0; }
int fmi2NewDiscreteStates(void *c, void *info) { return memset(info, 0, 32), 0; }
int fmi2CompletedIntegratorStep(void *c, int n, int *e, int *t) { return *e = *t = 0; }
#else
void *fmi3InstantiateModelExchange(const char *n, const char *t, const char *r, bool v, bool l, void *e, void *m) { return make(); }
int fmi3EnterInitializationMode(void *c, bool d, double t, double a, bool s, double b) { return ((Model *)c)->begun = true, 0; }
int fmi3UpdateDiscreteStates(void *c, bool *a, bool *b, bool *d, bool *e, bool *f, double *t) { return *a = *b = *d = *e = *f = false; }
int fmi3CompletedIntegratorStep(void *c, bool n, bool *e, bool *t) { return *e = *t = false; }
#endif
const char *NAME(GetVersion)(void) { return FMI == 2 ? "2.0" : "3.0"; }
void NAME(FreeInstance)(void *c) { free(c); }
int NAME(ExitInitializationMode)(void *c) { return 0; }
int NAME(EnterContinuousTimeMode)(void *c) { return 0; }
int NAME(EnterEventMode)(void *c) { return 0; }
int NAME(Terminate)(void *c) { return 0; }
int NAME(Reset)(void *c) { return ((Model *)c)->begun = false, memcpy(((Model *)c)->r, START, sizeof START), 0; }
int NAME(SetTime)(void *c, double t) { return 0; }
int NAME(SetContinuousStates)(void *c, const double x[], size_t n) { return memcpy(((Model *)c)->r + KNOWN, x, n * sizeof *x), 0; }
int NAME(GetContinuousStates)(void *c, double x[], size_t n) { return memcpy(x, ((Model *)c)->r + KNOWN, n * sizeof *x), 0; }
int NAME(GetNominalsOfContinuousStates)(void *c, double x[], size_t n)
{
    for (size_t i = 0; i < n; i++) x[i] = 1;
    return 0;
}
static int slopes(Model *m, double x[], size_t n) { return evaluate(m), memcpy(x, m->r + KNOWN + STATES, n * sizeof *x), 0; }
#if FMI == 2
int fmi2GetDerivatives(void *c, double x[], size_t n) { return slopes(c, x, n); }
#else
int fmi3GetContinuousStateDerivatives(void *c, double x[], size_t n) { return slopes(c, x, n); }
#endif
int NAME(GetEventIndicators)(void *c, double x[], size_t n) { return 0; }
static int get(Model *m, const unsigned vr[], size_t n, double x[])
{
    if (!m->begun) return 3;
    evaluate(m);
    for (size_t i = 0; i < n; x += SIZE(vr[i]), i++) memcpy(x, m->r + FIRST(vr[i]), SIZE(vr[i]) * sizeof *x);
    return 0;
}
static int set(Model *m, const unsigned vr[], size_t n, const double x[])
{
    for (size_t i = 0; i < n; x += SIZE(vr[i]), i++) memcpy(m->r + FIRST(vr[i]), x, SIZE(vr[i]) * sizeof *x);
    return 0;
}
#if FMI == 2
int fmi2GetReal(void *c, const unsigned vr[], size_t n, double x[]) { return get(c, vr, n, x); }
int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double x[]) { return set(c, vr, n, x); }
#else
int fmi3GetFloat64(void *c, const unsigned vr[], size_t n, double x[], size_t values) { return get(c, vr, n, x); }
int fmi3SetFloat64(void *c, const unsigned vr[], size_t n, const double x[], size_t values) { return set(c, vr, n, x); }
#endif
