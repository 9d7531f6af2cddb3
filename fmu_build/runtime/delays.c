/* What delay() and spatialDistribution() remember. The values of delay() are the last entries of u: between events they follow from the past.
 *
 * The past is a row of pieces; in each, an expression is a cubic with the values and slopes of its ends, exact ones. Pieces
 * are bisected until the cubic is right in their middle. An event ends a piece, so that what jumps stays a jump; it
 * arrives as a time event. A further time event follows each event by the shortest delay: no step reaches beyond what is
 * remembered, in model exchange neither. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "past.h"

enum { DEEPEST = 12 };

/* The motion over which the past grows: dense output of the last step, or, in model exchange, cubics between its ends. */
typedef struct {
    double t0, t1;
    const double *x0, *x1, *dx0, *dx1, *u0, *u1;
    int is_dense;
} Motion;

/* Values and slopes of what is remembered, 2 NPAST numbers. */
static int expressions_at(Instance *me, const Motion *way, double t, double *values) {
    double x[LENGTH(NX)], u[LENGTH(NU)], du[LENGTH(NU)];
    if (way->is_dense) {
        dense_output(&me->s.step, t, x);
        input_at(me, t);
        memcpy(u, me->ut, sizeof u);
        memcpy(du, me->s.step.du, sizeof du);
    } else {
        const double h = way->t1 - way->t0, a = h > 0.0 ? (t - way->t0) / h : 0.0, b = 1.0 - a;
        for (int i = 0; i < NX; i++)
            x[i] = b * b * (1.0 + 2.0 * a) * way->x0[i] + a * a * (1.0 + 2.0 * b) * way->x1[i] +
                   h * a * b * (b * way->dx0[i] - a * way->dx1[i]);
        for (int i = 0; i < NU; i++) {
            u[i] = b * way->u0[i] + a * way->u1[i];
            du[i] = h > 0.0 ? (way->u1[i] - way->u0[i]) / h : 0.0;
        }
    }
    delayed_at(me, t, u, du);
    return delayed_expressions(me, t, x, u, du, values, values + NPAST);
}

static Status append_piece(Instance *me, double t0, const double *a, double t1, const double *b) {
    Memory *m = &me->s.memory;
    if (m->first_row > 0 && m->first_row >= m->rows) { /* use the space of what was forgotten */
        memmove(me->remembered, nth_piece(me, 0), m->rows * ROW * sizeof(double));
        m->first_row = 0;
    }
    if (m->first_row + m->rows + 1 > me->room) {
        const size_t room = me->room ? 2 * me->room : 64;
        double *more = realloc(me->remembered, room * ROW * sizeof(double));
        if (!more) return report(me, STATUS_ERROR, "no memory for the past of delay()");
        me->remembered = more;
        me->room = room;
    }
    double *piece = nth_piece(me, m->rows++);
    piece[0] = t0;
    piece[1] = t1;
    for (int k = 0; k < NPAST; k++) {
        double *c = piece + 2 + 4 * k;
        c[0] = a[k], c[1] = b[k], c[2] = a[NPAST + k], c[3] = b[NPAST + k];
    }
    return STATUS_OK;
}

static Status add_pieces(Instance *me, const Motion *way, double t0, const double *a, double t1, const double *b,
                         int depth) {
    double middle[2 * NPAST], piece[ROW], slope;
    const double t = t0 + 0.5 * (t1 - t0);
    piece[0] = t0, piece[1] = t1;
    int right = depth == DEEPEST || t <= t0 || t >= t1;
    if (!right) {
        if (expressions_at(me, way, t, middle))
            return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", t);
        right = 1;
        for (int k = 0; k < NPAST; k++) {
            double *c = piece + 2 + 4 * k;
            c[0] = a[k], c[1] = b[k], c[2] = a[NPAST + k], c[3] = b[NPAST + k];
            const int is_place = k >= NDELAY && (k - NDELAY) % 3 == 2; /* in lengths of the contents */
            const double size = is_place ? 1.0 : fmax(fmax(fabs(a[k]), fabs(b[k])), me->s.memory.size[k]);
            right &= !(fabs(in_piece(piece, k, t, &slope) - middle[k]) > 0.1 * me->s.tolerance * size);
        }
    }
    if (right) return append_piece(me, t0, a, t1, b);
    const Status status = add_pieces(me, way, t0, a, t, middle, depth + 1);
    return status > STATUS_WARNING ? status : add_pieces(me, way, t, middle, t1, b, depth + 1);
}

/* Remembers what has happened up to time t. */
Status remember(Instance *me, double t) {
    State *s = &me->s;
    Memory *m = &s->memory;
    if (NPAST == 0 || !(t > m->until)) return STATUS_OK;
    Motion way = {.t0 = m->until, .t1 = t, .is_dense = s->is_co_simulation};
    double shortest = INFINITY, longest = 0.0, a[2 * NPAST], b[2 * NPAST];
    double x1[LENGTH(NX)], dx1[LENGTH(NX)], u1[LENGTH(NU)];
    for (int k = 0; k < NDELAY; k++) {
        shortest = fmin(shortest, m->time[k]);
        longest = fmax(longest, m->time[k]);
    }
    if (t > m->event + shortest + rounding(t))
        return report(me, STATUS_ERROR, "t = %.9g: the step passed the time event at t = %.9g", t, m->event + shortest);
    if (!way.is_dense) {
        way.x0 = m->x, way.dx0 = m->dx, way.u0 = m->u;
        if (evaluate_derivatives(me))
            return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution", t);
        memcpy(x1, s->x, sizeof x1);
        memcpy(dx1, s->dx, sizeof dx1);
        memcpy(u1, s->u, sizeof u1);
        way.x1 = x1, way.dx1 = dx1, way.u1 = u1;
    }
    if (expressions_at(me, &way, way.t0, a) || expressions_at(me, &way, t, b))
        return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", t);
    for (int k = 0; k < NPAST; k++) m->size[k] = fmax(m->size[k], fmax(fabs(a[k]), fabs(b[k])));
    const Status status = add_pieces(me, &way, way.t0, a, t, b, 0);
    m->until = t;
    const size_t inside = oldest_inside(me);
    size_t old = 0;
    while (old + 1 < m->rows && old < inside && nth_piece(me, old + 1)[1] < t - longest) old++;
    m->first_row += old;
    m->rows -= old;
    s->have_dx = s->have_v = 0;
    return status;
}

/* In model exchange: from here the next step begins. */
Status remember_point(Instance *me) {
    State *s = &me->s;
    Memory *m = &s->memory;
    if (NPAST == 0 || s->is_co_simulation) return STATUS_OK;
    if (evaluate_derivatives(me))
        return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution", s->t);
    memcpy(m->x, s->x, BYTES(NX));
    memcpy(m->dx, s->dx, BYTES(NX));
    memcpy(m->u, s->u, BYTES(NU));
    return STATUS_OK;
}

/* An event at the present point: from now on the delayed values are those after it. */
Status pass_delays(Instance *me) {
    State *s = &me->s;
    if (NPAST == 0) return STATUS_OK;
    const Status status = remember(me, s->t);
    s->memory.event = s->t;
    delayed_at(me, s->t, s->u, NULL);
    pass_transports(me);
    move_past_jumps(me);
    return status;
}

/* Of initial contents: value number k of an outlet among those. */
static double at_outlet(const double *profile, int k) {
    return profile[k % 2 ? 2 * ((model.n_points - 2) * NTRANSPORT + k / 2) + 1 : k];
}

/* The start of the past: before it the expressions had the values that they have now, on which they may depend. */
Status begin_past(Instance *me, int *settled) {
    State *s = &me->s;
    Memory *m = &s->memory;
    if (NPAST == 0) return STATUS_OK;
    double values[NDELAYED];
    const double *profile = values + NPAST + NDELAY;
    m->until = m->event = s->t;
    m->first_row = m->rows = 0;
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = values;
    if (CALL(delayed)) return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", s->t);
    *settled = 1;
    for (int k = 0; k < NDELAY; k++) {
        const double time = values[NPAST + k];
        if (!(time > 0.0))
            return report(me, STATUS_ERROR, "t = %.9g: delay() by %g s; the delay must be positive", s->t, time);
        *settled &= time == m->time[k];
        m->time[k] = time;
    }
    for (int k = 0; k < NHELD; k++) {
        const double value = k < NDELAY ? values[k] : at_outlet(profile, k - NDELAY);
        *settled &= value == s->u[NIN + k];
        m->at_start[k] = s->u[NIN + k] = value;
    }
    s->have_dx = s->have_v = 0;
    s->next_event = fmin(s->next_event, next_delayed_event(me));
    const int moved = start_past_moves(me);
    if (moved < 0) return report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", s->t);
    *settled &= moved;
    if (!*settled) return STATUS_OK;
    const Status status = initial_contents(me, values, profile, append_piece);
    pass_transports(me);
    return status <= STATUS_WARNING ? remember_point(me) : status;
}

/* ---- How the past moves along the directions of sensitivities */

/* A new piece of how the past moved; NULL: no memory. */
static double *new_moves(struct Sensitivity *q, double from, double to) {
    if (q->past.first > 0 && q->past.first >= q->past.count) {
        memmove(q->past.rows, nth_move(q, 0), q->past.count * width(q) * sizeof(double));
        q->past.first = 0;
    }
    if (q->past.first + q->past.count + 1 > q->past.room) {
        const size_t room = q->past.room ? 2 * q->past.room : 64;
        double *more = realloc(q->past.rows, room * width(q) * sizeof(double));
        if (!more) return NULL;
        q->past.rows = more;
        q->past.room = room;
    }
    double *piece = nth_move(q, q->past.count++);
    piece[0] = from;
    piece[1] = to;
    memset(piece + 2, 0, q->n * sizeof *piece);
    return piece;
}

/* At the start, from the directions there: 1 if that changes nothing, -1 if it fails. */
int start_past_moves(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const int intervals = NTRANSPORT > 0 ? model.n_points - 1 : 0;
    int settled = 1;
    if (NPAST == 0 || !q || q->n == 0) return 1;
    q->past.first = q->past.count = 0;
    memset(q->past.event, 0, q->n * sizeof(double));
    for (int i = intervals - 1; i >= 0; i--)
        if (!new_moves(q, me->s.t - model.points[i + 1], me->s.t - model.points[i])) return -1;
    for (size_t j = 0; j < q->n; j++) {
        DIRECTION(s);
        double along[NDELAYED];
        copy_direction(&q->along[j], &s);
        for (int k = 0; k < NHELD; k++) s.u[NIN + k] = q->past.start[k * q->n + j];
        s.t = 0.0;
        if (delayed_along(me, me->s.t, me->s.x, me->s.u, &s, along)) return -1;
        for (int k = 0; k < NHELD; k++) {
            double *start = &q->past.start[k * q->n + j];
            const double now = k < NDELAY ? along[k] : at_outlet(along + NPAST + NDELAY, k - NDELAY);
            settled &= fabs(*start - now) <= 1e-12 * fabs(now);
            *start = now;
        }
        for (int k = 0; k < NDELAY; k++) q->past.time[k * q->n + j] = along[NPAST + k];
        for (int i = 0; i < intervals; i++) initial_moves(q, intervals - 1 - i, j, along, nth_move(q, i));
    }
    return settled;
}

/* Remembers how the past moved in a piece of the last step; `at` gives S. */
Status record_past_moves(Instance *me, double from, double to, void (*at)(const struct Sensitivity *, double, double *)) {
    struct Sensitivity *q = me->sensitivity;
    const Memory *m = &me->s.memory;
    const size_t n = q->n;
    if (NPAST == 0 || !(to > from)) return STATUS_OK;
    double x[LENGTH(NX)], u[LENGTH(NU)], along[NDELAYED], longest = 0.0, oldest = INFINITY;
    for (int k = 0; k < NDELAY; k++) longest = fmax(longest, m->time[k]);
    if (NTRANSPORT > 0) oldest = nth_piece(me, oldest_inside(me))[0];
    while (q->past.count > 1 && nth_move(q, 1)[1] < fmin(from - longest, oldest)) q->past.first++, q->past.count--;
    double *piece = new_moves(q, from, to), *S = malloc(LENGTH(NX) * n * sizeof(double));
    if (!piece || !S) {
        free(S);
        return report(me, STATUS_ERROR, "no memory for the past of delay()");
    }
    for (size_t j = 0; j < n; j++) piece[2 + j] = from == m->event ? q->past.event[j] : 0.0;
    int failed = 0;
    for (int i = 0; i < 4 && !failed; i++) {
        const double t = i == 3 ? to : from + i * (to - from) / 3.0;
        at(q, t, S);
        dense_output(&me->s.step, t, x);
        input_at(me, t);
        memcpy(u, me->ut, sizeof u);
        for (size_t j = 0; j < n && !failed; j++) {
            DIRECTION(s);
            copy_direction(&q->along[j], &s);
            for (int row = 0; row < NX; row++) s.x[row] = S[row * n + j];
            if (NTRANSPORT > 0) environment_at(me, &t, x, u);
            for (int k = 0; k < NU; k++) s.u[k] = input_move(me, k, j, t);
            s.t = 0.0;
            failed = delayed_along(me, t, x, u, &s, along);
            for (int k = 0; k < NPAST; k++) piece[2 + n + (4 * k + i) * n + j] = along[k];
        }
    }
    free(S);
    return failed ? report(me, STATUS_ERROR, "t = %.9g: the sensitivities cannot be computed", from) : STATUS_OK;
}

/* Before a time event that is not the model's own: how its time moves. */
void past_event_moves(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const State *s = &me->s;
    double past;
    if (NDELAY == 0 || s->next_event > s->t || s->memory.own_next <= s->t) return;
    const int k = jump_due(me, &past);
    for (size_t j = 0; j < q->n; j++) q->along[j].next_event = 0.0;
    if (k < 0) return;
    for (size_t i = 0; i < q->past.count; i++)
        if (nth_move(q, i)[0] == past)
            for (size_t j = 0; j < q->n; j++)
                q->along[j].next_event = nth_move(q, i)[2 + j] + q->past.time[k * q->n + j];
}

/* What is delayed, after an event and seen from where that moves to. */
void move_past_jumps(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    const double t = me->s.t;
    if (!q) return;
    if (NTRANSPORT > 0) environment_at(me, &t, me->s.x, me->s.u);
    for (size_t j = 0; j < q->n; j++) {
        for (int k = 0; k < NDELAY; k++)
            q->along[j].u[NIN + k] = past_move(me, k, j, t, 1) + q->along[j].t * delayed_slope(me, k, t, 1);
        for (int k = NDELAY; k < NU - NIN; k++) q->along[j].u[NIN + k] = past_move(me, k, j, t, 1);
    }
}

void remember_event_moves(Instance *me) {
    struct Sensitivity *q = me->sensitivity;
    for (size_t j = 0; j < q->n && NPAST > 0; j++) q->past.event[j] = q->along[j].t;
}

size_t past_moves_size(const struct Sensitivity *q) {
    return NPAST > 0 ? (q->past.count * width(q) + (NHELD + NDELAY + 1) * q->n) * sizeof(double) : 0;
}

void copy_past_moves(const struct Sensitivity *q, char *to) {
    if (NPAST == 0) return;
    const size_t own = (NHELD + NDELAY + 1) * q->n * sizeof(double);
    memcpy(to, q->past.start, own);
    if (q->past.count > 0) memcpy(to + own, nth_move(q, 0), q->past.count * width(q) * sizeof(double));
}

/* After q->past.count is that of the copy; 1: no memory. */
int restore_past_moves(struct Sensitivity *q, const char *from) {
    if (NPAST == 0) return 0;
    const size_t own = (NHELD + NDELAY + 1) * q->n * sizeof(double);
    if (q->past.count > q->past.room) {
        double *more = realloc(q->past.rows, q->past.count * width(q) * sizeof(double));
        if (!more) return 1;
        q->past.rows = more;
        q->past.room = q->past.count;
    }
    memcpy(q->past.start, from, own);
    if (q->past.count > 0) memcpy(q->past.rows, from + own, q->past.count * width(q) * sizeof(double));
    return 0;
}
