/* Integrating a model-exchange FMU from one communication point to the next, with its events.
 *
 * Method: RODAS, a linearly implicit (Rosenbrock) pair of orders 4 and 3 in six stages, L-stable and stiffly accurate,
 * with a dense output of order 3 (Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7). A
 * one-step method, because held inputs jump at every communication point and restart a multistep one. The Jacobian
 * consists of the FMU's directional derivatives where it gives them, else of forward differences. State events are bracketed on the dense output by bisection.
 */
#include "stepper.h"
#ifdef FMUID_WITH_LAWS
#include "laws.h"
#endif

#include <math.h>
#include <string.h>

enum { MAX_EVENT_ITERATIONS = 1000, MAX_EVENTS = 100000, MAX_BISECTIONS = 60 };

static const double GAMMA = 0.25;
static const double NODE[6] = {0, 0.386, 0.21, 0.63, 1, 1};
static const double SLOPE[6] = {0.25, -0.1043, 0.1035, -0.03620000000000023, 0, 0};
static const double A[6][5] = {
    {0},
    {1.544},
    {0.9466785280815826, 0.2557011698983284},
    {3.314825187068521, 2.896124015972201, 0.9986419139977817},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1},
};
static const double C[6][5] = {
    {0},
    {-5.6688},
    {-2.430093356833875, -0.2063599157091915},
    {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
    {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
    {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054},
};
static const double DENSE[2][5] = {
    {10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662},
    {-0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872},
};

typedef struct { /* the plan's work array, cut up */
    double *x, *end, *trial, *nominal, *f, *f_moved, *f_time, *dense1, *dense2, *stage[6], *jacobian, *matrix;
    double *before, *after, *input;
} Work;

static Work cut(Plan *plan)
{
    size_t n = plan->n_states, nz = plan->n_indicators;
    double *next = plan->work;
    Work w;
    double **vectors[] = {&w.x, &w.end, &w.trial, &w.nominal, &w.f, &w.f_moved, &w.f_time, &w.dense1, &w.dense2,
                          &w.stage[0], &w.stage[1], &w.stage[2], &w.stage[3], &w.stage[4], &w.stage[5]};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++, next += n) *vectors[i] = next;
    w.jacobian = next, next += n * n;
    w.matrix = next, next += n * n;
    w.before = next, next += nz;
    w.after = next, next += nz;
    w.input = next;
    return w;
}

/* Inputs at time t of the step from communication point k, with those that are interpolated; nothing to do if held. */
static int32_t set_inputs(Plan *plan, const Work *w, size_t k, double t)
{
    if (plan->n_slopes == 0) return DONE;
    const double *u = plan->inputs + k * plan->n_inputs, *v = u + plan->n_inputs;
    double s = (t - plan->time[k]) / (plan->time[k + 1] - plan->time[k]);
    bool at_end = t == plan->time[k + 1]; /* then exactly the next sample, or it would look like a jump */
    for (int32_t i = 0; i < plan->n_slopes; i++) {
        int32_t j = plan->slope_columns[i];
        w->input[j] = at_end ? v[j] : u[j] + s * (v[j] - u[j]);
    }
    return set_values(plan, plan->slope_groups, plan->n_slope_groups, w->input);
}

/* The FMU's own states come first, those of laws after them. */
static size_t own_states(const Plan *plan) { return plan->n_states - added_states(plan); }

static int32_t set_point(Plan *plan, const Work *w, size_t k, double t, const double *x)
{
    CALL(SET_TIME, int32_t (*)(Instance, double), plan->instance, t);
    TRY(set_inputs(plan, w, k, t));
    if (own_states(plan) > 0)
        CALL(SET_STATES, int32_t (*)(Instance, const double *, size_t), plan->instance, x, own_states(plan));
    return DONE;
}

/* Without laws. */
static int32_t own_derivatives(Plan *plan, const Work *w, size_t k, double t, const double *x, double *f)
{
    TRY(set_point(plan, w, k, t, x));
    CALL(GET_DERIVATIVES, int32_t (*)(Instance, double *, size_t), plan->instance, f, own_states(plan));
    return DONE;
}

static int32_t derivatives(Plan *plan, const Work *w, size_t k, double t, const double *x, double *f)
{
    TRY(own_derivatives(plan, w, k, t, x, f));
    TRY(add_laws(plan, w->input, t, x, f));
    return DONE;
}

static int32_t indicators(Plan *plan, double *z)
{
    if (plan->n_indicators > 0)
        CALL(GET_INDICATORS, int32_t (*)(Instance, double *, size_t), plan->instance, z, plan->n_indicators);
    return DONE;
}

static bool crossed(const Plan *plan, const Work *w)
{
    for (size_t i = 0; i < plan->n_indicators; i++)
        if ((w->before[i] > 0) != (w->after[i] > 0)) return true;
    return false;
}

/* From event mode, inputs being set, back to continuous-time mode. */
static int32_t settle(Plan *plan, const Work *w)
{
    Instance c = plan->instance;
    bool again = true, changed = false, nominals = plan->reached < 0;
    for (int i = 0; again; i++) {
        if (i == MAX_EVENT_ITERATIONS) return EVENTS_DO_NOT_SETTLE;
        bool terminate, nominals_now, values_now;
        if (plan->fmi == 2) {
            struct { int need, terminate, nominals, values, defined; double next; } info = {0};
            CALL(UPDATE_DISCRETE_STATES, int32_t (*)(Instance, void *), c, &info);
            again = info.need, terminate = info.terminate, nominals_now = info.nominals, values_now = info.values;
            plan->next_event_defined = info.defined;
            plan->next_event = info.next;
        } else {
            bool defined = false;
            terminate = nominals_now = values_now = again = false;
            CALL(UPDATE_DISCRETE_STATES, int32_t (*)(Instance, bool *, bool *, bool *, bool *, bool *, double *), c,
                 &again, &terminate, &nominals_now, &values_now, &defined, &plan->next_event);
            plan->next_event_defined = defined;
        }
        if (terminate) return TERMINATED;
        changed |= values_now;
        nominals |= nominals_now;
    }
    CALL(ENTER_CONTINUOUS_TIME_MODE, Plain, c);
    size_t n = own_states(plan);
    if (changed && plan->reached >= 0 && has_directions(plan)) return NOT_DIFFERENTIABLE;
    if (n > 0 && (changed || plan->reached < 0))
        CALL(GET_STATES, int32_t (*)(Instance, double *, size_t), c, w->x, n);
    if (plan->reached < 0) start_laws(plan, w->input, plan->time[0], w->x);
    if (plan->n_states > 0 && nominals) {
        for (size_t i = 0; i < plan->n_states; i++) w->nominal[i] = 1;
        if (plan->function[GET_NOMINALS] && n > 0)
            CALL(GET_NOMINALS, int32_t (*)(Instance, double *, size_t), c, w->nominal, n);
        for (size_t i = 0; i < plan->n_states; i++)
            w->nominal[i] = w->nominal[i] != 0 && isfinite(w->nominal[i]) ? fabs(w->nominal[i]) : 1;
    }
    return indicators(plan, w->before);
}

int32_t settle_events(Plan *plan)
{
    Work w = cut(plan);
    return settle(plan, &w);
}

/* Factor the matrix in place with partial pivoting; false if it is singular. */
static bool factor(double *m, int32_t *pivots, size_t n)
{
    for (size_t c = 0; c < n; c++) {
        size_t best = c;
        for (size_t r = c + 1; r < n; r++)
            if (fabs(m[r * n + c]) > fabs(m[best * n + c])) best = r;
        pivots[c] = (int32_t)best;
        if (!(fabs(m[best * n + c]) > 0)) return false;
        if (best != c)
            for (size_t j = 0; j < n; j++) {
                double swap = m[c * n + j];
                m[c * n + j] = m[best * n + j];
                m[best * n + j] = swap;
            }
        for (size_t r = c + 1; r < n; r++) {
            double ratio = m[r * n + c] / m[c * n + c];
            m[r * n + c] = ratio;
            for (size_t j = c + 1; j < n; j++) m[r * n + j] -= ratio * m[c * n + j];
        }
    }
    return true;
}

static void solve(const double *m, const int32_t *pivots, size_t n, double *b)
{
    for (size_t r = 0; r < n; r++) {
        double swap = b[r];
        b[r] = b[pivots[r]];
        b[pivots[r]] = swap;
    }
    for (size_t r = 0; r < n; r++)
        for (size_t j = 0; j < r; j++) b[r] -= m[r * n + j] * b[j];
    for (size_t r = n; r-- > 0;) {
        for (size_t j = r + 1; j < n; j++) b[r] -= m[r * n + j] * b[j];
        b[r] /= m[r * n + r];
    }
}

/* Column j of df/dx by the FMU's directional derivatives, and differences of the laws: false if it does not give them.
 * `before` are its derivatives without laws; w->trial is moved along state j. */
static bool column_given(Plan *plan, const Work *w, double t, size_t j, double moved, const double *before)
{
    const size_t n = plan->n_states, own = own_states(plan);
    const uint32_t *references = plan->derivative_references;
    double *column = w->end, *shifted = w->f_time; /* not in use yet */
    memset(column, 0, n * sizeof(double));
    if (j < own && !directional(plan, references, own, references[own + j], column)) return false;
    for (size_t i = 0; i < n; i++) shifted[i] = w->f_moved[i] = (i < own ? before[i] : 0) + moved * column[i];
    if (add_laws(plan, w->input, t, w->trial, shifted) != DONE) return false;
    for (size_t i = 0; i < n; i++) {
        double laws = w->f[i] - (i < own ? before[i] : 0);
        w->jacobian[i * n + j] = column[i] + (shifted[i] - w->f_moved[i] - laws) / moved;
    }
    return true;
}

/* f and df/dx at w->x. */
static int32_t slopes(Plan *plan, const Work *w, size_t k, double t)
{
    size_t n = plan->n_states;
    double *before = w->dense1;
    TRY(own_derivatives(plan, w, k, t, w->x, w->f));
    memcpy(before, w->f, own_states(plan) * sizeof(double));
    TRY(add_laws(plan, w->input, t, w->x, w->f));
    memcpy(w->trial, w->x, n * sizeof(double));
    bool given = plan->derivative_references && !parameters_vary(plan);
    for (size_t j = 0; j < n; j++) {
        double scale = fmax(fabs(w->x[j]), 1e-3 * w->nominal[j]);
        w->trial[j] = w->x[j] + 1.5e-8 * scale;
        double moved = w->trial[j] - w->x[j];
        if (given && !column_given(plan, w, t, j, moved, before)) {
            given = false; /* and is not asked again */
            plan->derivative_references = NULL;
        }
        if (!given) {
            TRY(derivatives(plan, w, k, t, w->trial, w->f_moved));
            for (size_t i = 0; i < n; i++) w->jacobian[i * n + j] = (w->f_moved[i] - w->f[i]) / moved;
        }
        w->trial[j] = w->x[j];
    }
    return DONE;
}

/* f, df/dx and df/dt at the start of a step. */
static int32_t linearise(Plan *plan, const Work *w, size_t k, double t, double h)
{
    size_t n = plan->n_states;
    TRY(slopes(plan, w, k, t));
    double moved_time = t + 1e-4 * h, moved = moved_time - t;
    TRY(derivatives(plan, w, k, moved_time, w->x, w->f_moved));
    for (size_t i = 0; i < n; i++) w->f_time[i] = (w->f_moved[i] - w->f[i]) / moved;
    return DONE;
}

/* One step of size h from w->x to w->end; `error` is its estimate over the tolerance, infinite if it cannot be taken. */
static int32_t rodas(Plan *plan, const Work *w, size_t k, double t, double h, double *error)
{
    size_t n = plan->n_states;
    *error = INFINITY;
    for (size_t i = 0; i < n * n; i++) w->matrix[i] = -w->jacobian[i];
    for (size_t i = 0; i < n; i++) w->matrix[i * n + i] += 1 / (h * GAMMA);
    if (!factor(w->matrix, plan->pivots, n)) return DONE;
    for (int s = 0; s < 6; s++) {
        const double *f = w->f;
        for (size_t i = 0; i < n; i++) {
            double x = w->x[i];
            for (int j = 0; j < s; j++) x += A[s][j] * w->stage[j][i];
            w->end[i] = x;
        }
        if (s > 0) {
            int32_t outcome = derivatives(plan, w, k, t + NODE[s] * h, w->end, w->f_moved);
            /* What is discarded in the middle of a step may be fine closer to its start. */
            if (outcome == CALL_FAILED && plan->status == 2) return DONE;
            TRY(outcome);
            f = w->f_moved;
        }
        for (size_t i = 0; i < n; i++) {
            double sum = 0;
            for (int j = 0; j < s; j++) sum += C[s][j] * w->stage[j][i];
            w->stage[s][i] = f[i] + sum / h + h * SLOPE[s] * w->f_time[i];
        }
        solve(w->matrix, plan->pivots, n, w->stage[s]);
    }
    double sum = 0;
    for (size_t i = 0; i < n; i++) {
        w->end[i] += w->stage[5][i];
        double scale = plan->tolerance * (fmax(fabs(w->x[i]), fabs(w->end[i])) + 0.01 * w->nominal[i]);
        double part = w->stage[5][i] / scale;
        sum += part * part;
        if (!isfinite(w->end[i])) return DONE;
    }
    *error = sqrt(sum / (double)n);
    return DONE;
}

static void prepare_dense(const Plan *plan, const Work *w)
{
    for (size_t i = 0; i < plan->n_states; i++) {
        double a = 0, b = 0;
        for (int j = 0; j < 5; j++) a += DENSE[0][j] * w->stage[j][i], b += DENSE[1][j] * w->stage[j][i];
        w->dense1[i] = a, w->dense2[i] = b;
    }
}

/* States at the fraction s of the last step, into w->trial. */
static void interpolate(const Plan *plan, const Work *w, double s)
{
    for (size_t i = 0; i < plan->n_states; i++)
        w->trial[i] = w->x[i] * (1 - s) + s * (w->end[i] + (1 - s) * (w->dense1[i] + s * w->dense2[i]));
}

/* Shorten the step from t to the first crossing; the FMU is left just behind it, its states in w->end. */
static int32_t locate(Plan *plan, const Work *w, size_t k, double t, double *h)
{
    double low = 0, high = 1;
    prepare_dense(plan, w);
    for (int i = 0; i < MAX_BISECTIONS && (high - low) * *h > 1e-14 * (1 + fabs(t)); i++) {
        double middle = 0.5 * (low + high);
        interpolate(plan, w, middle);
        TRY(set_point(plan, w, k, t + middle * *h, w->trial));
        TRY(indicators(plan, w->after));
        if (crossed(plan, w)) high = middle;
        else low = middle;
    }
    if (high < 1) {
        interpolate(plan, w, high);
        memcpy(w->end, w->trial, plan->n_states * sizeof(double));
        *h *= high;
    }
    return set_point(plan, w, k, t + *h, w->end);
}

#ifdef FMUID_WITH_LAWS

/* Derivatives along the directions, over a step from t to `end` that is accepted: the variational equations s' = df/dx s + df/dp,
 * by the Radau IIA method of order 5. df/dp compares the instance of a direction with the FMU. */
static int32_t follow_directions(Plan *plan, const Work *w, size_t k, double t, double end)
{
    static const double node[STAGES] = {0.1550510257216822, 0.6449489742783178, 1};
    static const double share[STAGES][STAGES] = {{0.19681547722366044, -0.06553542585019839, 0.02377097434822015},
                                                 {0.39442431473908727, 0.29207341166522844, -0.04154875212599793},
                                                 {0.37640306270046725, 0.5124858261884216, 0.1111111111111111}};
    PlanWithLaws *run = (PlanWithLaws *)plan;
    const size_t n = plan->n_states, own = own_states(plan), directions = run->n_directions, size = STAGES * n;
    const double h = end - t;
    if (directions == 0 || n == 0) return DONE;
    double *before = run->room, *point = before + n, *matrix = point + size, *right = matrix + size * size;
    double *moved = right + size; /* (stages, directions, n) */
    memcpy(before, w->x, n * sizeof(double));
    prepare_dense(plan, w);
    for (size_t i = 0; i < STAGES; i++) {
        interpolate(plan, w, node[i]);
        memcpy(point + i * n, w->trial, n * sizeof(double));
    }
    for (size_t i = 0; i < STAGES; i++) {
        double at = i + 1 < STAGES ? t + node[i] * h : end;
        memcpy(w->x, point + i * n, n * sizeof(double));
        TRY(slopes(plan, w, k, at));
        if (!plan->derivative_references) return NOT_DIFFERENTIABLE; /* the FMU has refused to give them */
        for (size_t r = 0; r < STAGES; r++)
            for (size_t a = 0; a < n; a++)
                for (size_t b = 0; b < n; b++)
                    matrix[(r * n + a) * size + i * n + b] = (r == i && a == b) - h * share[r][i] * w->jacobian[a * n + b];
        for (size_t d = 0; d < directions; d++) {
            double *to = moved + (i * directions + d) * n;
            PlanWithLaws aside = aside_of(plan, run->direction + d);
            TRY(derivatives_at(&aside.plan, w->input, at, w->x, own, to));
            TRY(add_laws(&aside.plan, w->input, at, w->x, to));
            for (size_t a = 0; a < n; a++) to[a] = (to[a] - w->f[a]) / run->direction[d].size;
        }
    }
    memcpy(w->x, before, n * sizeof(double));
    memcpy(w->end, point + 2 * n, n * sizeof(double));
    if (!factor(matrix, run->pivots, size)) return NOT_DIFFERENTIABLE;
    for (size_t d = 0; d < directions; d++) {
        double *s = run->direction[d].s;
        for (size_t r = 0; r < STAGES; r++)
            for (size_t a = 0; a < n; a++) {
                double sum = 0;
                for (size_t i = 0; i < STAGES; i++) sum += share[r][i] * moved[(i * directions + d) * n + a];
                right[r * n + a] = s[a] + h * sum;
            }
        solve(matrix, run->pivots, size, right);
        memcpy(s, right + 2 * n, n * sizeof(double));
    }
    return DONE;
}

/* From the FMU's own states in each direction, where a run begins, to the derivatives of all. */
void start_directions(Plan *plan)
{
    Work w = cut(plan);
    PlanWithLaws *run = (PlanWithLaws *)plan;
    for (Direction *one = run->direction; one < run->direction + run->n_directions; one++) {
        PlanWithLaws aside = aside_of(plan, one);
        start_laws(&aside.plan, w.input, plan->time[0], one->s);
        for (size_t i = 0; i < plan->n_states; i++) one->s[i] = (one->s[i] - w.x[i]) / one->size;
    }
}

/* Bring the instance of a direction to where the run is, with the states that have moved along it. */
int32_t move_aside(PlanWithLaws *aside, const Direction *direction)
{
    Work w = cut(&aside->plan);
    for (size_t i = 0; i < aside->plan.n_states; i++) w.trial[i] = w.x[i] + direction->size * direction->s[i];
    return derivatives_at(&aside->plan, w.input, aside->plan.reached_time, w.trial, own_states(&aside->plan), w.f_moved);
}

#endif

int32_t begin_model_exchange(Plan *plan)
{
    Work w = cut(plan);
    plan->step_size = plan->time[1] - plan->time[0];
    if (plan->n_inputs > 0) memcpy(w.input, plan->inputs, plan->n_inputs * sizeof(double));
    return settle(plan, &w);
}

/* Move the states by what the outputs in plan->row are off; where an indicator crosses zero by it, that is an event. */
int32_t feed_back(Plan *plan, size_t k)
{
    Work w = cut(plan);
    size_t n = plan->n_outputs;
    for (size_t j = 0; j < n; j++) {
        double off = plan->measured[j * plan->n_measured + k] - plan->row[j];
        if (isfinite(off))
            for (size_t i = 0; i < plan->n_states; i++) w.x[i] += plan->gain[i * n + j] * off;
    }
    CALL(SET_STATES, int32_t (*)(Instance, const double *, size_t), plan->instance, w.x, own_states(plan));
    if (plan->n_indicators == 0) return DONE;
    TRY(indicators(plan, w.after));
    if (crossed(plan, &w)) {
        CALL(ENTER_EVENT_MODE, Plain, plan->instance);
        return settle(plan, &w);
    }
    memcpy(w.before, w.after, plan->n_indicators * sizeof(double));
    return DONE;
}

/* Inputs of communication point k; those that jump are an event. */
static int32_t take_inputs(Plan *plan, const Work *w, size_t k, double t)
{
    const double *u = plan->inputs + k * plan->n_inputs;
    bool jump = false;
    for (size_t j = 0; j < plan->n_inputs; j++) jump |= w->input[j] != u[j];
    if (!jump) return DONE;
    CALL(SET_TIME, int32_t (*)(Instance, double), plan->instance, t);
    CALL(ENTER_EVENT_MODE, Plain, plan->instance);
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, u));
    memcpy(w->input, u, plan->n_inputs * sizeof(double));
    return settle(plan, w);
}

int32_t act(Plan *plan, size_t k)
{
    Work w = cut(plan);
    return take_inputs(plan, &w, k, plan->time[k]);
}

int32_t integrate(Plan *plan, size_t k)
{
    Work w = cut(plan);
    double t = plan->time[k], stop = plan->time[k + 1], *h = &plan->step_size;
    TRY(take_inputs(plan, &w, k, t));
    for (int events = 0; t < stop;) {
        bool time_event = plan->next_event_defined && plan->next_event < stop;
        double target = time_event ? fmax(plan->next_event, t) : stop, wanted = *h, step = target - t, error = 0;
        bool whole = true;
        if (step > 0 && plan->n_states > 0) {
            TRY(linearise(plan, &w, k, t, fmin(step, wanted)));
            for (;;) {
                double left = target - t;
                whole = 1.01 * wanted >= left;
                step = whole ? left : left < 2 * wanted ? 0.5 * left : wanted;
                TRY(rodas(plan, &w, k, t, step, &error));
                double ratio = isfinite(error) ? sqrt(sqrt(error)) / 0.9 : 5;
                double proposed = step / fmin(5, fmax(1.0 / 6, ratio));
                if (error <= 1) {
                    /* An easy step that was cut short says nothing against the longer one. */
                    *h = ratio <= 1.0 / 6 ? fmax(proposed, wanted) : proposed;
                    break;
                }
                wanted = proposed;
                if (wanted < 1e-14 * (1 + fabs(t))) return plan->reached_time = t, STEP_TOO_SMALL;
            }
        }
        double end = whole ? target : t + step;
        bool enter = false;
        if (step > 0) {
            TRY(follow_directions(plan, &w, k, t, end));
            TRY(set_point(plan, &w, k, end, w.end));
            TRY(indicators(plan, w.after));
            if (crossed(plan, &w)) {
                TRY(locate(plan, &w, k, t, &step));
                enter = true;
                time_event = time_event && t + step >= target;
                end = whole && t + step >= target ? target : t + step;
                whole = end == target;
            } else if (plan->n_indicators > 0)
                memcpy(w.before, w.after, plan->n_indicators * sizeof(double));
            memcpy(w.x, w.end, plan->n_states * sizeof(double));
        }
        t = end;
        plan->reached_time = t;
        if (plan->completed_step_needed && step > 0) {
            bool terminate = false;
            if (plan->fmi == 2) {
                int asked = 0, ended = 0;
                CALL(COMPLETED_INTEGRATOR_STEP, int32_t (*)(Instance, int, int *, int *), plan->instance, 1, &asked,
                     &ended);
                enter |= asked, terminate = ended;
            } else {
                bool asked = false;
                CALL(COMPLETED_INTEGRATOR_STEP, int32_t (*)(Instance, bool, bool *, bool *), plan->instance, true, &asked,
                     &terminate);
                enter |= asked;
            }
            if (terminate) return TERMINATED;
        }
        if (enter || (time_event && whole)) {
            if (has_directions(plan)) return NOT_DIFFERENTIABLE;
            if (++events > MAX_EVENTS) return EVENTS_DO_NOT_SETTLE;
            if (step <= 0) CALL(SET_TIME, int32_t (*)(Instance, double), plan->instance, t);
            CALL(ENTER_EVENT_MODE, Plain, plan->instance);
            TRY(settle(plan, &w));
        }
    }
    return DONE;
}
