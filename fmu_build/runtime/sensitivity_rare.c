/* What a simulation with sensitivities seldom does: begin, pass events. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "collocation.h"
#include "sensitivity.h"

int has_sensitivities(const Instance *me) { return me->sensitivity && me->sensitivity->n > 0; }

void free_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (q) {
        free(q->parameters);
        free(q->weights);
        free(q->along);
        free(q->numbers);
        free(q->moves);
        free(q->apart);
        free(q->live);
        free(q->past.rows);
        free(q->past.start);
        free_pivoted(&q->other);
    }
    free(q);
    me->sensitivity = NULL;
}

/* Rows of n in the block of numbers that begins with `moves`. */
#define ROWS ((size_t)LENGTH(NP + ND + NZ + 2 * NX + (2 * RADAU + 1) * N + NV + 4 * NU))

/* Behind them: what has the same length for any number of directions. */
static size_t fixed_bytes(void) {
    const size_t doubles = LENGTH(model.n_switches) + (size_t)BLOCK * model.J.filled + 2 * BLOCK * N + 2;
    return doubles * sizeof(double) + LENGTH(NP + ND + NZ) * sizeof(Span) + LENGTH(model.n_slopes + model.n_elements) * sizeof(int) +
           2 * (size_t)NU;
}

static void lend_fixed(struct Sensitivity *q) {
    q->switches = q->moves + ROWS * q->n;
    q->factors = q->switches + LENGTH(model.n_switches);
    q->work = q->factors + BLOCK * model.J.filled + 1;
    q->moved = (Span *)(void *)(q->work + 2 * BLOCK * N + 1);
    q->active = (int *)(void *)(q->moved + LENGTH(NP + ND + NZ));
    q->drive.driven = (unsigned char *)(q->active + LENGTH(model.n_slopes + model.n_elements));
    q->next.driven = q->drive.driven + NU;
}

static size_t slices(const struct Sensitivity *q) { return q->n / SLICE + 1; }

/* Bytes of a copy: the structure, and what it points to that changes in a simulation. */
size_t sensitivities_size(const Instance *me) {
    const struct Sensitivity *q = me->sensitivity;
    return q ? sizeof *q + q->n * (sizeof *q->along + (DIRECTION_NUMBERS + ROWS) * sizeof(double)) + fixed_bytes() + slices(q) + past_moves_size(q) : 0;
}

void copy_sensitivities(const Instance *me, char *to) {
    const struct Sensitivity *q = me->sensitivity;
    memcpy(to, q, sizeof *q);
    memcpy(to += sizeof *q, q->along, q->n * sizeof *q->along);
    memcpy(to += q->n * sizeof *q->along, q->numbers, DIRECTION_NUMBERS * q->n * sizeof(double));
    memcpy(to += DIRECTION_NUMBERS * q->n * sizeof(double), q->moves, ROWS * q->n * sizeof(double) + fixed_bytes());
    memcpy(to += ROWS * q->n * sizeof(double) + fixed_bytes(), q->live, slices(q));
    copy_past_moves(q, to + slices(q));
}

/* 1: the copy is of other sensitivities than these. */
int restore_sensitivities(Instance *me, const char *from) {
    struct Sensitivity *q = me->sensitivity;
    Pivoted *other = q->other; /* belongs to the last factorisation, which is made anew */
    struct Sensitivity then;
    memcpy(&then, from, sizeof then);
    if (then.moves != q->moves || then.n != q->n) return 1;
    then.past.rows = q->past.rows;
    then.past.start = q->past.start;
    then.past.time = q->past.time;
    then.past.event = q->past.event;
    then.past.room = q->past.room;
    then.past.first = 0;
    *q = then;
    q->other = other;
    memcpy(q->along, from += sizeof *q, q->n * sizeof *q->along);
    memcpy(q->numbers, from += q->n * sizeof *q->along, DIRECTION_NUMBERS * q->n * sizeof(double));
    memcpy(q->moves, from += DIRECTION_NUMBERS * q->n * sizeof(double), ROWS * q->n * sizeof(double) + fixed_bytes());
    memcpy(q->live, from += ROWS * q->n * sizeof(double) + fixed_bytes(), slices(q));
    return restore_past_moves(q, from + slices(q));
}

/* Which derivatives by what the directions move are computed for each direction apart, and which for all together. */
static void choose_slopes(struct Sensitivity *q) {
    size_t elements = 0, others = 0;
    for (size_t j = 0; j < q->n; j++) {
        q->apart[j] = 0;
        for (int k = model.n_slopes; k < model.n_slopes + model.n_elements; k++)
            q->apart[j] |= q->moves[model.slope_column[k] * q->n + j] != 0.0;
        elements += q->apart[j];
    }
    q->elements = elements > (size_t)model.few_elements;
    if (q->elements) memset(q->apart, 0, q->n);
    for (size_t j = 0; j < q->n; j++) others += !q->apart[j];
    q->shared = others > (size_t)model.few_slopes;
    if (!q->shared) memset(q->apart, 1, q->n);
}

/* Direction j changes p, d or z number k by this. */
static void set_move(struct Sensitivity *q, int k, size_t j, double move) {
    q->moves[k * q->n + j] = move;
    if (move == 0.0) return;
    if (j < q->moved[k].first || q->moved[k].end == 0) q->moved[k].first = j;
    if (j >= q->moved[k].end) q->moved[k].end = j + 1;
}

/* The derivatives that hold from here on, from the directions' x and z. */
static void go_on_along(struct Sensitivity *q) {
    for (size_t j = 0; j < q->n; j++) {
        const Direction *s = &q->along[j];
        for (int row = 0; row < NX; row++) {
            q->start[row * q->n + j] = s->x[row];
            q->live[j / SLICE] |= s->x[row] != 0.0;
        }
        for (int k = 0; k < NZ; k++) set_move(q, NP + ND + k, j, s->z[k]);
    }
    q->n_active = 0;
    for (int k = 0; k < model.n_slopes + q->elements * model.n_elements; k++)
        if (q->moved[model.slope_column[k]].end > 0) q->active[q->n_active++] = k;
    q->pieces = q->switches_known = 0;
}

/* Derivatives of the initial state and, with them, of the discrete variables. */
static int initial_values_along(Instance *me, const double *start, Direction *s) {
    enum { MOST = 50 };
    double before[LENGTH(NZ)];
    if (discrete_starts_along(me, s)) return 1;
    for (int round = 0; round < MOST; round++) {
        memcpy(before, s->z, sizeof before);
        if (initial_states_along(me, start, s)) return 1;
        if (!model.has_events) return 0;
        if (event_update_along(me, s, 1, 1, 0)) return 1;
        int settled = 1;
        for (int k = 0; k < NZ; k++) settled &= fabs(s->z[k] - before[k]) <= 1e-12 * fabs(s->z[k]);
        if (settled) {
            memcpy(s->pz, s->z, BYTES(NZ));
            return 0;
        }
    }
    return 1;
}

/* At the initial point, the pre-values still those of before it: derivatives of what the simulation starts from. */
Status start_sensitivities(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (!q || q->n == 0) return STATUS_OK;
    memset(q->moved, 0, LENGTH(NP + ND + NZ) * sizeof *q->moved);
    for (size_t j = 0; j < q->n; j++) {
        Direction *s = &q->along[j];
        DIRECTION(unit);
        ZEROS(start, NX);
        double unit_start[LENGTH(NX)];
        *s = direction_in(s->x);
        for (int i = 0; i < NU; i++) s->u[i] = q->drive.seeds[i * q->n + j];
        for (int k = 0; k < NHELD; k++) s->u[NIN + k] = q->past.start[k * q->n + j];
        for (size_t i = 0; i < q->n_parameters; i++) {
            const double w = q->weights[j * q->n_parameters + i];
            if (w == 0.0) continue;
            unit = direction_in(unit_numbers);
            memset(unit_start, 0, sizeof unit_start);
            parameter_direction(q->parameters[i], &unit, unit_start);
            for (int k = 0; k < NP; k++) s->p[k] += w * unit.p[k];
            for (int k = 0; k < NX; k++) start[k] += w * unit_start[k];
        }
        if (dependent_parameters_along(me, s->p, s->d) || initial_values_along(me, start, s))
            return report(me, STATUS_ERROR, "t = %.9g: the sensitivities of the initial state cannot be computed",
                          me->s.t);
        for (int k = 0; k < NP + ND; k++) set_move(q, k, j, k < NP ? s->p[k] : s->d[k - NP]);
    }
    choose_slopes(q);
    go_on_along(q);
    return model.has_events ? event_start_along(me, q->along, q->n) : STATUS_OK;
}

/* From here on inputs move as was last said. */
static void replace_drive(struct Sensitivity *q) {
    const Drive last = q->drive;
    q->drive = q->next;
    q->next = last;
    q->replaced = 0;
}

static void inputs_along(Instance *me, double t) {
    struct Sensitivity *q = me->sensitivity;
    if (NTRANSPORT > 0) environment_at(me, &t, me->s.x, me->s.u);
    for (size_t j = 0; j < q->n; j++)
        for (int i = 0; i < NU; i++) q->along[j].u[i] = input_move(me, i, j, t);
}

/* Before the event iteration: S at the event, seen from where it moves to. */
Status enter_event(Instance *me, int inside) {
    struct Sensitivity *q = me->sensitivity;
    Status status = advance_sensitivities(me, me->s.t, 1);
    if (!q || q->n == 0 || status > STATUS_WARNING) return status;
    if (model.has_events) {
        for (size_t j = 0; j < q->n; j++)
            for (int row = 0; row < NX; row++) q->along[j].x[row] = q->start[row * q->n + j];
        inputs_along(me, me->s.t);
        if (inside) past_event_moves(me);
        status = event_time_along(me, q->along, q->n, inside);
    }
    if (!inside) {
        if (q->replaced) replace_drive(q);
        if (model.has_events) inputs_along(me, me->s.t); /* a communication point does not move */
    }
    return status;
}

/* In the event iteration, before the pre-values and (with `reinit`) the state change. */
Status update_sensitivities(Instance *me, int reinit) {
    struct Sensitivity *q = me->sensitivity;
    return q && q->n > 0 ? event_update_along(me, q->along, q->n, 0, reinit) : STATUS_OK;
}

/* After the event iteration. */
Status leave_event(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    if (!model.has_events || !q || q->n == 0) return STATUS_OK;
    remember_event_moves(me);
    const Status status = event_end_along(me, q->along, q->n);
    go_on_along(q);
    return status;
}

int fmuidSetSensitivityDirections(void *instance, const unsigned *parameters, size_t n_parameters,
                                  const double *weights, size_t n) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    if (!(me->s.phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION)) || !me->s.is_co_simulation)
        return report(me, STATUS_ERROR, "sensitivities are chosen before a co-simulation starts");
    for (size_t i = 0; i < n_parameters; i++) {
        DIRECTION(s);
        double start[LENGTH(NX)];
        if (!parameter_direction(parameters[i], &s, start))
            return report(me, STATUS_ERROR, "value reference %u is no parameter or start value to differentiate by",
                          parameters[i]);
    }
    free_sensitivities(me);
    me->s.initialised = 0;
    if (n == 0) return STATUS_OK;
    struct Sensitivity *q = me->sensitivity = calloc(1, sizeof *q);
    if (q) {
        q->parameters = malloc(LENGTH(n_parameters) * sizeof *parameters);
        q->weights = malloc(LENGTH(n * n_parameters) * sizeof *weights);
        q->along = calloc(n, sizeof *q->along);
        q->numbers = calloc(n * DIRECTION_NUMBERS, sizeof(double));
        q->moves = calloc(1, n * ROWS * sizeof(double) + fixed_bytes());
        q->apart = malloc(n);
        q->n = n;
        q->live = calloc(slices(q), 1);
    }
    if (q && NPAST > 0) {
        q->past.start = calloc((NHELD + NDELAY + 1) * n, sizeof(double));
        q->past.time = q->past.start + NHELD * n;
        q->past.event = q->past.time + NDELAY * n;
        if (q->live) memset(q->live, 1, slices(q));
    }
    if (!q || (NPAST > 0 && !q->past.start) || !q->numbers || !q->parameters || !q->weights || !q->along || !q->moves || !q->apart || !q->live) {
        free_sensitivities(me);
        return report(me, STATUS_ERROR, "no memory for sensitivities");
    }
    for (size_t j = 0; j < n; j++) q->along[j] = direction_in(q->numbers + j * DIRECTION_NUMBERS);
    lend_fixed(q);
    q->start = q->moves + (NP + ND + NZ) * n;
    q->stages = q->start + NX * n;
    q->now = q->stages + RADAU * N * n;
    q->rest = q->now + NX * n;
    q->by_moves = q->rest + RADAU * N * n;
    q->shown = q->by_moves + N * n;
    q->drive.seeds = q->shown + NV * n;
    q->drive.rates = q->drive.seeds + NU * n;
    q->next.seeds = q->drive.rates + NU * n;
    q->next.rates = q->next.seeds + NU * n;
    memcpy(q->parameters, parameters, n_parameters * sizeof *parameters);
    memcpy(q->weights, weights, n * n_parameters * sizeof *weights);
    q->n_parameters = n_parameters;
    return STATUS_OK;
}

int fmuidSetSensitivityParameters(void *instance, const unsigned *parameters, size_t n) {
    double *unit = calloc(LENGTH(n * n), sizeof *unit);
    if (!unit) return instance ? report(instance, STATUS_ERROR, "no memory for sensitivities") : STATUS_ERROR;
    for (size_t i = 0; i < n; i++) unit[i * n + i] = 1.0;
    const int status = fmuidSetSensitivityDirections(instance, parameters, n, unit, n);
    free(unit);
    return status;
}

int fmuidSetInputDirections(void *instance, const unsigned *inputs, size_t n_inputs, const double *seeds,
                            const double *rates) {
    Instance *me = instance;
    if (!me) return STATUS_ERROR;
    struct Sensitivity *q = me->sensitivity;
    State *s = &me->s;
    const int before = s->phase & (PHASE_INSTANTIATED | PHASE_INITIALIZATION);
    if (!q || q->n == 0 || !(before || s->phase == PHASE_STEP))
        return report(me, STATUS_ERROR, "inputs cannot move with parameters: no sensitivities were chosen");
    const size_t n = q->n;
    Drive *next = &q->next;
    memset(next->seeds, 0, NU * n * sizeof *seeds);
    memset(next->rates, 0, NU * n * sizeof *rates);
    memset(next->driven, 0, (size_t)NU);
    next->t = s->t;
    for (size_t k = 0; k < n_inputs; k++) {
        double sign;
        const int i = input_place(inputs[k], &sign);
        if (i < 0) return report(me, STATUS_ERROR, "value reference %u is no real input", inputs[k]);
        for (size_t j = 0; j < n; j++) {
            const double seed = sign * seeds[k * n + j], rate = sign * rates[k * n + j];
            if (!isfinite(seed) || !isfinite(rate))
                return report(me, STATUS_ERROR, "value reference %u cannot move by a number that is not finite", inputs[k]);
            next->seeds[i * n + j] = seed;
            next->rates[i * n + j] = rate;
            next->driven[i] |= seed != 0.0 || rate != 0.0;
            q->live[j / SLICE] |= next->driven[i];
        }
    }
    int same = 1;
    for (int i = 0; i < NIN; i++)
        for (size_t j = 0; j < n; j++)
            same &= next->seeds[i * n + j] == input_move(me, i, j, s->t) &&
                    next->rates[i * n + j] == q->drive.rates[i * n + j];
    q->replaced = !same;
    if (q->replaced && before) {
        replace_drive(q);
        s->initialised = 0;
    }
    s->changed |= q->replaced;
    return STATUS_OK;
}
