/* The master of several coupled FMUs: one call of fmuid_run_coupled is one whole simulation.
 *
 * Every FMU has a Plan (stepper.h) whose times and inputs are a window of two rows: the beginning and the end of the
 * current communication step. layout.py fills in a System.
 */
#include "../stepper.h"

#include <float.h>
#include <math.h>
#include <string.h>
#include <time.h>

typedef struct {        /* an input that follows an output: factor * output + offset */
    int32_t source;     /* the output's place among all outputs ... */
    int32_t from;       /* ... and whose it is */
    int32_t component, column;
    int32_t linear;     /* extrapolated along a line, else held */
    int32_t unknown;    /* its place among the unknowns of an iterated loop, else -1 */
    double factor, offset;
    double start;       /* in initialisation, until the output is known */
    uint32_t reference; /* the input's value reference */
    int32_t unused;
} Link;

typedef struct {        /* an input that follows a signal of the task */
    int32_t signal, component, column, linear;
    double factor, offset;
} Feed;

typedef struct {        /* an output of the system */
    int32_t source, unused;
    double factor, offset;
} Record;

typedef struct {
    Plan **plans;             /* in the order they are stepped */
    const int32_t *places;    /* (n_components + 1) where the outputs of each begin among all outputs */
    const int32_t *loops;     /* of each: where the iterated loop that begins with it ends, 0 if none begins */
    void **states;            /* of each: its state before the step, in an iterated loop */
    const Link *links;
    const Feed *feeds;
    const Record *records;
    int32_t n_components, n_links, n_feeds, n_records, n_values, n_signals, n_unknowns;
    int32_t gauss_seidel, iterations;
    double tolerance;
    int64_t n_times;
    const double *time;       /* (n_times) of the samples */
    const int32_t *steps;     /* (n_times - 1) communication steps between them */
    const double *signals;    /* (n_times, n_signals) */
    double *outputs;          /* (1 + n_directions, n_records, n_times) */
    double *window;           /* beginning and end of the communication step */
    double *before, *now, *next; /* (n_values) all outputs: a step ago, at the beginning, at the end */
    /* derivatives along directions: of the same outputs, in rows of n_directions, ... */
    size_t n_directions;
    double *before_slopes, *now_slopes, *next_slopes;
    double *seeds, *rates;    /* ... and of a component's connected inputs, at a time and by time */
    uint32_t *driven;         /* references of these inputs */
    int32_t *known;           /* (n_components) outputs in `next` are there */
    int32_t *members;         /* unknowns of the loop in hand */
    /* each with its derivatives along the directions, (n_unknowns, 1 + n_directions) */
    double *unknowns, *residual, *last, *change, *scale;
    double *moved, *left, *inverse; /* (n_unknowns), inverse its square */
    /* progress and outcome */
    int64_t reached;          /* last sample whose outputs are there */
    int32_t step;             /* communication steps since then */
    int32_t failed;           /* component */
    double step_before;       /* size of the last communication step, 0 if there was none */
    double taken;             /* s of stepping since the run began, or went on */
} System;

static double *inputs_of(const Plan *plan) { return (double *)plan->inputs; }

/* Where unknown i and its derivatives are among those of the loops. */
static inline size_t row_of(const System *s, int32_t i) { return (size_t)i * (1 + s->n_directions); }

typedef struct { double begin, end; } Window;

/* What link l follows over the communication step: an output, or its derivative along a direction, that was `before` a
 * step ago, is `now` at the beginning and will be `next` at the end, if that is known. */
static inline Window followed(const System *s, const Link *l, double before, double now, double next)
{
    double h = s->window[1] - s->window[0];
    if (s->gauss_seidel && s->known[l->from]) return (Window){l->linear ? now : next, next};
    if (l->linear && s->step_before > 0) return (Window){now, now + (now - before) * (h / s->step_before)};
    return (Window){now, now};
}

/* The window of component c: its connected inputs. In a loop that is iterated, unknowns stand for outputs of the loop. */
static void follow(System *s, int32_t c, bool iterating)
{
    Plan *plan = s->plans[c];
    for (const Link *l = s->links; l < s->links + s->n_links; l++) {
        if (l->component != c) continue;
        Window w = followed(s, l, s->before[l->source], s->now[l->source], s->next[l->source]);
        w = (Window){l->factor * w.begin + l->offset, l->factor * w.end + l->offset};
        if (iterating && l->unknown >= 0) {
            w.end = s->unknowns[row_of(s, l->unknown)];
            w.begin = l->linear ? l->factor * s->now[l->source] + l->offset : w.end;
        }
        inputs_of(plan)[l->column] = w.begin;
        inputs_of(plan)[plan->n_inputs + l->column] = w.end;
    }
}

static bool interpolated(const Plan *plan, int32_t column)
{
    for (int32_t i = 0; i < plan->n_slopes; i++)
        if (plan->slope_columns[i] == column) return plan->fmi == 2;
    return false;
}

/* How the connected inputs of component c move along the directions, over the communication step or in initialisation. */
static int32_t drive(System *s, int32_t c, bool iterating, bool initialising)
{
    Plan *plan = s->plans[c];
    const size_t n = s->n_directions;
    double h = s->window[1] - s->window[0], *seed = s->seeds, *rate = s->rates;
    size_t count = 0;
    if (plan->n_directions == 0) return DONE;
    for (const Link *l = s->links; l < s->links + s->n_links; l++) {
        if (l->component != c) continue;
        const size_t row = (size_t)l->source * n;
        const bool moves = interpolated(plan, l->column);
        for (size_t j = 0; j < n; j++) {
            double next = s->next_slopes[row + j];
            Window w = {s->known[l->from] ? next : 0, 0};
            if (!initialising) w = followed(s, l, s->before_slopes[row + j], s->now_slopes[row + j], next);
            w = (Window){l->factor * w.begin, l->factor * w.end};
            if (iterating && l->unknown >= 0) {
                w.end = s->unknowns[row_of(s, l->unknown) + 1 + j];
                w.begin = l->linear && !initialising ? l->factor * s->now_slopes[row + j] : w.end;
            }
            *seed++ = w.begin;
            *rate++ = !initialising && moves ? (w.end - w.begin) / h : 0;
        }
        s->driven[count++] = l->reference;
    }
    CALL(SET_INPUT_DIRECTIONS, int32_t (*)(Instance, const uint32_t *, size_t, const double *, const double *),
         plan->instance, s->driven, count, s->seeds, s->rates);
    return DONE;
}

/* The same for inputs that follow signals of the task. */
static void feed(System *s, int32_t c)
{
    Plan *plan = s->plans[c];
    const double *u = s->signals + s->reached * s->n_signals, *v = u + s->n_signals;
    double n = s->steps[s->reached];
    for (const Feed *f = s->feeds; f < s->feeds + s->n_feeds; f++) {
        if (f->component != c) continue;
        double begin = u[f->signal], end = begin;
        if (f->linear) {
            double rise = v[f->signal] - begin;
            begin += rise * (s->step / n);
            end += rise * ((s->step + 1) / n);
        }
        inputs_of(plan)[f->column] = f->factor * begin + f->offset;
        inputs_of(plan)[plan->n_inputs + f->column] = f->factor * end + f->offset;
    }
}

/* The outputs of component c and their derivatives, into `next`. */
static int32_t get_outputs(System *s, int32_t c)
{
    Plan *plan = s->plans[c];
    s->known[c] = 1;
    TRY(get_values(plan, s->next + s->places[c]));
    if (plan->n_directions > 0)
        CALL(GET_SENSITIVITIES, int32_t (*)(Instance, const uint32_t *, size_t, double *), plan->instance,
             plan->output_references, plan->n_outputs, s->next_slopes + (size_t)s->places[c] * s->n_directions);
    return DONE;
}

static int32_t take_outputs(System *s, int32_t c)
{
    Plan *plan = s->plans[c];
    TRY(get_outputs(s, c));
    for (size_t j = 0; j < plan->n_outputs; j++) {
        const size_t place = (size_t)s->places[c] + j;
        bool finite = isfinite(s->next[place]);
        for (size_t i = 0; i < s->n_directions; i++) finite &= isfinite(s->next_slopes[place * s->n_directions + i]);
        if (finite) continue;
        plan->column = (int32_t)j;
        plan->reached_time = s->window[plan->reached < 0 ? 0 : 1];
        return NOT_FINITE;
    }
    return DONE;
}

/* One component over the communication step. */
static int32_t step_one(System *s, int32_t c, bool iterating)
{
    Plan *plan = s->plans[c];
    s->failed = c;
    feed(s, c);
    follow(s, c, iterating);
    plan->reached_time = s->window[0];
    TRY(drive(s, c, iterating, false));
    TRY(plan->model_exchange ? integrate(plan, 0) : do_step(plan, 0));
    return take_outputs(s, c);
}

/* One component in initialisation: its outputs for the inputs that are known. */
static int32_t initialise_one(System *s, int32_t c, bool iterating)
{
    Plan *plan = s->plans[c];
    s->failed = c;
    for (const Link *l = s->links; l < s->links + s->n_links; l++) {
        if (l->component != c) continue;
        double value = s->known[l->from] ? l->factor * s->next[l->source] + l->offset : l->start;
        inputs_of(plan)[l->column] = iterating && l->unknown >= 0 ? s->unknowns[row_of(s, l->unknown)] : value;
    }
    TRY(set_values(plan, plan->input_groups, plan->n_input_groups, plan->inputs));
    TRY(drive(s, c, iterating, true));
    return get_outputs(s, c);
}

/* ---- Loops: the connected inputs z of which each is what the outputs make of it, by Broyden's method. ---- */

enum { VALUES_SOLVED = 1, SLOPES_SOLVED = 2 };

/* What each unknown of components first to last should be, less what it is, and whether that is next to nothing. What
 * values are compared with does not grow while the iteration runs away. */
static int miss(System *s, int32_t first, int32_t last, bool begins)
{
    int solved = VALUES_SOLVED | SLOPES_SOLVED;
    for (const Link *l = s->links; l < s->links + s->n_links; l++) {
        if (l->unknown < 0 || l->component < first || l->component >= last) continue;
        const size_t row = row_of(s, l->unknown);
        for (size_t j = 0; j <= s->n_directions; j++) {
            double value = l->factor * (j ? s->next_slopes[(size_t)l->source * s->n_directions + j - 1] : s->next[l->source]);
            if (j == 0) value += l->offset;
            s->residual[row + j] = value - s->unknowns[row + j];
            if (begins || j > 0) s->scale[row + j] = fmax(s->scale[row + j], fabs(value));
            double allowed = s->tolerance * s->scale[row + j]; /* a value whose rounding exceeds it proves nothing */
            if (!(fabs(s->residual[row + j]) <= allowed && DBL_EPSILON * fabs(value) <= allowed))
                solved &= j ? ~SLOPES_SOLVED : ~VALUES_SOLVED;
        }
    }
    return solved;
}

/* Better the inverse Jacobian by what the last change did to the residual (Broyden, 1965), of the values (j = 0) or of
 * their derivatives along a direction, for which it is the same. */
static void learn(System *s, int32_t m, size_t j)
{
    const int32_t n = s->n_unknowns, *i = s->members;
    const double *change = s->change + j, *residual = s->residual + j, *last = s->last + j;
    double *inverse = s->inverse, along = 0;
    for (int32_t a = 0; a < m; a++) {
        s->moved[a] = s->left[a] = 0;
        for (int32_t b = 0; b < m; b++) {
            const size_t row = row_of(s, i[b]);
            s->moved[a] += inverse[i[a] * n + i[b]] * (residual[row] - last[row]);
            s->left[a] += change[row] * inverse[i[b] * n + i[a]];
        }
        along += change[row_of(s, i[a])] * s->moved[a];
    }
    if (along == 0 || !isfinite(along)) return;
    for (int32_t a = 0; a < m; a++)
        for (int32_t b = 0; b < m; b++)
            inverse[i[a] * n + i[b]] += (change[row_of(s, i[a])] - s->moved[a]) * s->left[b] / along;
}

static int32_t keep_states(System *s, int32_t first, int32_t last)
{
    for (int32_t c = first; c < last; c++) {
        Plan *plan = s->plans[c];
        s->failed = c;
        CALL(GET_FMU_STATE, int32_t (*)(Instance, void **), plan->instance, s->states + c);
    }
    return DONE;
}

static int32_t go_back(System *s, int32_t first, int32_t last)
{
    for (int32_t c = first; c < last; c++) {
        Plan *plan = s->plans[c];
        s->failed = c;
        CALL(SET_FMU_STATE, int32_t (*)(Instance, void *), plan->instance, s->states[c]);
    }
    return DONE;
}

/* Find the unknowns of the loop, as a first guess where they were heading. */
static int32_t guess(System *s, int32_t first, int32_t last, bool initialising)
{
    int32_t m = 0;
    double h = s->window[1] - s->window[0];
    for (const Link *l = s->links; l < s->links + s->n_links; l++) {
        if (l->unknown < 0 || l->component < first || l->component >= last) continue;
        s->members[m++] = l->unknown;
        double value = s->now[l->source];
        if (s->step_before > 0) value += (value - s->before[l->source]) * (h / s->step_before);
        double *to = s->unknowns + row_of(s, l->unknown);
        *to++ = initialising ? l->start : l->factor * value + l->offset;
        for (size_t j = (size_t)l->source * s->n_directions; j < (size_t)(l->source + 1) * s->n_directions; j++) {
            double slope = s->now_slopes[j];
            if (s->step_before > 0) slope += (slope - s->before_slopes[j]) * (h / s->step_before);
            *to++ = initialising ? 0 : l->factor * slope;
        }
    }
    return m;
}

static int32_t solve_loop(System *s, int32_t first, int32_t last, bool initialising)
{
    const int32_t m = guess(s, first, last, initialising), n = s->n_unknowns, *i = s->members;
    if (!initialising) TRY(keep_states(s, first, last));
    int solved = 0;
    for (int32_t iteration = 0; iteration < s->iterations; iteration++) {
        if (iteration > 0 && !initialising) TRY(go_back(s, first, last));
        for (int32_t c = first; c < last; c++) TRY(initialising ? initialise_one(s, c, true) : step_one(s, c, true));
        memcpy(s->last, s->residual, row_of(s, n) * sizeof(double));
        const int before = solved;
        solved = miss(s, first, last, iteration == 0);
        if (solved == (VALUES_SOLVED | SLOPES_SOLVED)) return DONE;
        if (iteration > 0) learn(s, m, 0);
        for (size_t j = 1; before & VALUES_SOLVED && j <= s->n_directions; j++) learn(s, m, j);
        for (int32_t a = 0; a < m; a++)
            for (size_t j = 0, row = row_of(s, i[a]); j <= s->n_directions; j++) {
                s->change[row + j] = 0;
                if (j == 0 && solved & VALUES_SOLVED) continue; /* derivatives are of a run that stays as it is */
                for (int32_t b = 0; b < m; b++)
                    s->change[row + j] -= s->inverse[i[a] * n + i[b]] * s->residual[row_of(s, i[b]) + j];
                s->unknowns[row + j] += s->change[row + j];
            }
    }
    s->failed = first;
    s->plans[first]->reached_time = s->window[initialising ? 0 : 1];
    return LOOP_NOT_SOLVED;
}

/* ---- The whole system ---- */

/* Outputs that follow from inputs that follow from outputs: again until nothing changes. */
static int32_t settle_initialisation(System *s)
{
    const size_t n_slopes = (size_t)s->n_values * s->n_directions;
    for (int32_t pass = 0; pass <= s->iterations + s->n_links; pass++) {
        memcpy(s->now, s->next, (size_t)s->n_values * sizeof(double));
        memcpy(s->now_slopes, s->next_slopes, n_slopes * sizeof(double));
        for (int32_t c = 0; c < s->n_components; c++) {
            if (s->loops[c]) {
                TRY(solve_loop(s, c, s->loops[c], true));
                c = s->loops[c] - 1;
            } else
                TRY(initialise_one(s, c, false));
        }
        bool settled = pass > 0;
        for (int32_t i = 0; settled && i < s->n_values; i++)
            settled = fabs(s->next[i] - s->now[i]) <= (pass < s->n_links + 2 ? 0 : s->tolerance * fabs(s->next[i]));
        for (size_t i = 0; settled && i < n_slopes; i++)
            settled = fabs(s->next_slopes[i] - s->now_slopes[i]) <=
                      (pass < s->n_links + 2 ? 0 : s->tolerance * fabs(s->next_slopes[i]));
        if (settled) return DONE;
    }
    s->failed = 0;
    s->plans[0]->reached_time = s->window[0];
    return LOOP_NOT_SOLVED;
}

static void record(System *s)
{
    for (int32_t i = 0; i < s->n_records; i++) {
        const Record *r = s->records + i;
        s->outputs[i * s->n_times + s->reached] = r->factor * s->now[r->source] + r->offset;
        for (size_t j = 0; j < s->n_directions; j++)
            s->outputs[((int64_t)(1 + j) * s->n_records + i) * s->n_times + s->reached] =
                r->factor * s->now_slopes[(size_t)r->source * s->n_directions + j];
    }
}

static void set_window(System *s)
{
    double begin = s->time[s->reached], size = s->time[s->reached + 1] - begin, n = s->steps[s->reached];
    s->window[0] = begin + size * (s->step / n);
    s->window[1] = s->step + 1 == s->steps[s->reached] ? s->time[s->reached + 1] : begin + size * ((s->step + 1) / n);
}

static int32_t initialise_all(System *s)
{
    s->reached = s->step = 0;
    s->step_before = 0;
    memset(s->known, 0, (size_t)s->n_components * sizeof *s->known);
    for (int32_t i = 0; i < s->n_unknowns; i++) {
        for (size_t j = 0; j <= s->n_directions; j++) s->scale[row_of(s, i) + j] = j ? 0 : 1e-6;
        for (int32_t j = 0; j < s->n_unknowns; j++) s->inverse[i * s->n_unknowns + j] = i == j ? -1 : 0;
    }
    memset(s->next, 0, (size_t)s->n_values * sizeof(double));
    memset(s->next_slopes, 0, (size_t)s->n_values * s->n_directions * sizeof(double));
    set_window(s);
    for (int32_t c = 0; c < s->n_components; c++) {
        s->failed = c;
        feed(s, c);
        TRY(enter_initialisation(s->plans[c]));
    }
    TRY(settle_initialisation(s));
    for (int32_t c = 0; c < s->n_components; c++) {
        Plan *plan = s->plans[c];
        s->failed = c;
        CALL(EXIT_INITIALIZATION, Plain, plan->instance);
        if (plan->model_exchange) TRY(begin_model_exchange(plan));
    }
    for (int32_t c = 0; c < s->n_components; c++) {
        s->failed = c;
        TRY(take_outputs(s, c));
        s->plans[c]->reached = 0;
    }
    memcpy(s->now, s->next, (size_t)s->n_values * sizeof(double));
    memcpy(s->now_slopes, s->next_slopes, (size_t)s->n_values * s->n_directions * sizeof(double));
    record(s);
    return DONE;
}

static int32_t step_all(System *s)
{
    set_window(s);
    memset(s->known, 0, (size_t)s->n_components * sizeof *s->known);
    for (int32_t c = 0; c < s->n_components; c++) {
        if (s->loops[c]) {
            TRY(solve_loop(s, c, s->loops[c], false));
            c = s->loops[c] - 1;
        } else
            TRY(step_one(s, c, false));
    }
    double *oldest = s->before, *oldest_slopes = s->before_slopes;
    s->before = s->now, s->now = s->next, s->next = oldest;
    s->before_slopes = s->now_slopes, s->now_slopes = s->next_slopes, s->next_slopes = oldest_slopes;
    s->step_before = s->window[1] - s->window[0];
    if (++s->step == s->steps[s->reached]) {
        s->step = 0;
        s->reached++;
        record(s);
    }
    return DONE;
}

static int32_t run(System *s, int32_t resume, double slice)
{
    if (!resume) {
        fmuid_clear_log();
        TRY(initialise_all(s));
    }
    Pace pace = begin_pace();
    for (int64_t left = 1; s->reached < s->n_times - 1; left--) {
        TRY(step_all(s));
        if (left > 0) continue;
        s->taken = look_at_clock(&pace);
        if (s->taken > slice && s->reached < s->n_times - 1) return PAUSED;
        left = pace.stride;
    }
    s->taken = look_at_clock(&pace);
    return DONE;
}

/* Simulate, or go on where the last call paused; returns PAUSED after about `slice` seconds. */
int32_t fmuid_run_coupled(System *s, int32_t resume, double slice)
{
    int32_t outcome = run(s, resume, slice);
    if (outcome == PAUSED) return outcome;
    for (int32_t c = 0; c < s->n_components; c++) {
        Plan *plan = s->plans[c];
        bool dead = outcome == CALL_FAILED && c == s->failed && plan->status > 3; /* fmi2Fatal: no further call */
        if (s->states[c] && !dead)
            ((int32_t (*)(Instance, void **))plan->function[FREE_FMU_STATE])(plan->instance, s->states + c);
        s->states[c] = NULL;
        /* Results are complete: what Terminate answers cannot change them. */
        if (outcome == DONE && plan->function[TERMINATE]) ((Plain)plan->function[TERMINATE])(plan->instance);
    }
    return outcome;
}
