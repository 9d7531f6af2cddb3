/* What delay() remembers. The values of delay() are the last entries of u: between events they follow from the past.
 *
 * The past is a row of pieces; in each, an expression is a cubic with the values and slopes of its ends, exact ones. Pieces
 * are bisected until the cubic is right in their middle. An event ends a piece, so that what jumps stays a jump; it
 * arrives as a time event. A further time event follows each event by the shortest delay: no step reaches beyond what is
 * remembered, in model exchange neither. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

#if MODEL_NDELAY > 0
enum { ROW = 2 + 4 * NDELAY, DEEPEST = 12 };

static double *nth_piece(const Instance *me, size_t i) { return me->remembered + (me->s.memory.first_row + i) * ROW; }

static double rounding(double t) { return 1e-13 * fmax(1.0, fabs(t)); }

/* Expression k in a piece. */
static double in_piece(const double *piece, int k, double t, double *slope) {
    const double *c = piece + 2 + 4 * k, h = piece[1] - piece[0], a = (t - piece[0]) / h, b = 1.0 - a;
    *slope = 6.0 * a * b * (c[1] - c[0]) / h + b * (1.0 - 3.0 * a) * c[2] + a * (3.0 * a - 2.0) * c[3];
    return c[0] + a * a * (1.0 + 2.0 * b) * (c[1] - c[0]) + h * a * b * (b * c[2] - a * c[3]);
}

/* The piece of a past time; where two meet, the later one if `after`. NULL: before the start. */
static const double *piece_at(const Instance *me, double t, int after) {
    const Memory *m = &me->s.memory;
    const double reach = after ? t + rounding(t) : t - rounding(t);
    size_t low = 0, high = m->rows;
    while (low < high) { /* the number of pieces that begin before */
        const size_t middle = low + (high - low) / 2;
        if (nth_piece(me, middle)[0] <= reach) low = middle + 1;
        else high = middle;
    }
    return low > 0 ? nth_piece(me, low - 1) : NULL;
}

/* The delayed values at time t, into the last entries of u, and their slopes into those of du (unless NULL). */
void delayed_at(const Instance *me, double t, double *u, double *du) {
    const Memory *m = &me->s.memory;
    for (int k = 0; k < NDELAY; k++) {
        const double then = t - m->time[k];
        const double *piece = piece_at(me, then, t <= m->event);
        double slope = 0.0;
        u[NIN + k] = piece ? in_piece(piece, k, fmin(fmax(then, piece[0]), piece[1]), &slope) : m->at_start[k];
        if (du) du[NIN + k] = slope;
    }
}

/* The next time event that the past sets. */
double next_delayed_event(const Instance *me) {
    const Memory *m = &me->s.memory;
    double next = INFINITY;
    for (int k = 0; k < NDELAY; k++) next = fmin(next, m->event + m->time[k]);
    for (size_t i = 1; i < m->rows; i++) {
        const double *before = nth_piece(me, i - 1), *after = nth_piece(me, i);
        for (int k = 0; k < NDELAY; k++) {
            const double a = before[2 + 4 * k + 1], b = after[2 + 4 * k], at = after[0] + m->time[k];
            if (fabs(a - b) > 1e-12 * fmax(fabs(a), fabs(b)) && at > me->s.t + rounding(me->s.t)) next = fmin(next, at);
        }
    }
    return next;
}

/* The motion over which the past grows: dense output of the last step, or, in model exchange, cubics between its ends. */
typedef struct {
    double t0, t1, x0[LENGTH(NX)], x1[LENGTH(NX)], dx0[LENGTH(NX)], dx1[LENGTH(NX)], u0[LENGTH(NU)], u1[LENGTH(NU)];
    int is_dense;
} Motion;

/* Values and slopes of the delayed expressions, 2 NDELAY numbers. */
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
    return delayed_expressions(me, t, x, u, du, values, values + NDELAY);
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
    for (int k = 0; k < NDELAY; k++) {
        double *c = piece + 2 + 4 * k;
        c[0] = a[k], c[1] = b[k], c[2] = a[NDELAY + k], c[3] = b[NDELAY + k];
    }
    return STATUS_OK;
}

static Status add_pieces(Instance *me, const Motion *way, double t0, const double *a, double t1, const double *b,
                         int depth) {
    double middle[2 * NDELAY], piece[ROW] = {t0, t1}, slope;
    const double t = t0 + 0.5 * (t1 - t0);
    int right = depth == DEEPEST || t <= t0 || t >= t1;
    if (!right) {
        if (expressions_at(me, way, t, middle))
            return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", t);
        right = 1;
        for (int k = 0; k < NDELAY; k++) {
            double *c = piece + 2 + 4 * k;
            c[0] = a[k], c[1] = b[k], c[2] = a[NDELAY + k], c[3] = b[NDELAY + k];
            const double size = fmax(fmax(fabs(a[k]), fabs(b[k])), me->s.memory.size[k]);
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
    if (!(t > m->until)) return STATUS_OK;
    Motion way = {.t0 = m->until, .t1 = t, .is_dense = s->is_co_simulation};
    double shortest = INFINITY, longest = 0.0, a[2 * NDELAY], b[2 * NDELAY];
    for (int k = 0; k < NDELAY; k++) {
        shortest = fmin(shortest, m->time[k]);
        longest = fmax(longest, m->time[k]);
    }
    if (t > m->event + shortest + rounding(t))
        return report(me, STATUS_ERROR, "t = %.9g: the step passed the time event at t = %.9g", t, m->event + shortest);
    if (!way.is_dense) {
        memcpy(way.x0, m->x, sizeof way.x0);
        memcpy(way.dx0, m->dx, sizeof way.dx0);
        memcpy(way.u0, m->u, sizeof way.u0);
        if (evaluate_derivatives(me))
            return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution", t);
        memcpy(way.x1, s->x, sizeof way.x1);
        memcpy(way.dx1, s->dx, sizeof way.dx1);
        memcpy(way.u1, s->u, sizeof way.u1);
    }
    if (expressions_at(me, &way, way.t0, a) || expressions_at(me, &way, t, b))
        return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", t);
    for (int k = 0; k < NDELAY; k++) m->size[k] = fmax(m->size[k], fmax(fabs(a[k]), fabs(b[k])));
    const Status status = add_pieces(me, &way, way.t0, a, t, b, 0);
    m->until = t;
    size_t old = 0;
    while (old + 1 < m->rows && nth_piece(me, old + 1)[1] < t - longest) old++;
    m->first_row += old;
    m->rows -= old;
    s->have_dx = s->have_v = 0;
    return status;
}

/* In model exchange: from here the next step begins. */
Status remember_point(Instance *me) {
    State *s = &me->s;
    Memory *m = &s->memory;
    if (s->is_co_simulation) return STATUS_OK;
    if (evaluate_derivatives(me))
        return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution", s->t);
    memcpy(m->x, s->x, sizeof m->x);
    memcpy(m->dx, s->dx, sizeof m->dx);
    memcpy(m->u, s->u, sizeof m->u);
    return STATUS_OK;
}

/* An event at the present point: from now on the delayed values are those after it. */
Status pass_delays(Instance *me) {
    State *s = &me->s;
    const Status status = remember(me, s->t);
    s->memory.event = s->t;
    delayed_at(me, s->t, s->u, NULL);
    return status;
}

/* The start of the past: before it the expressions had the values that they have now, on which they may depend. */
Status begin_past(Instance *me, int *settled) {
    State *s = &me->s;
    Memory *m = &s->memory;
    double values[2 * NDELAY];
    m->until = m->event = s->t;
    m->first_row = m->rows = 0;
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = values;
    if (CALL(delayed)) return report(me, STATUS_ERROR, "t = %.9g: what delay() remembers cannot be evaluated", s->t);
    *settled = 1;
    for (int k = 0; k < NDELAY; k++) {
        if (!(values[NDELAY + k] > 0.0))
            return report(me, STATUS_ERROR, "t = %.9g: delay() by %g s; the delay must be positive", s->t,
                          values[NDELAY + k]);
        *settled &= values[k] == s->u[NIN + k] && values[NDELAY + k] == m->time[k];
        m->time[k] = values[NDELAY + k];
        m->at_start[k] = s->u[NIN + k] = values[k];
    }
    s->have_dx = s->have_v = 0;
    s->next_event = fmin(s->next_event, next_delayed_event(me));
    return *settled ? remember_point(me) : STATUS_OK;
}

size_t memory_size(const Instance *me) { return me->s.memory.rows * ROW * sizeof(double); }

void copy_memory(const Instance *me, char *to) {
    if (me->s.memory.rows > 0) memcpy(to, nth_piece(me, 0), memory_size(me));
}

/* After the state itself is restored. */
Status restore_memory(Instance *me, const char *from) {
    Memory *m = &me->s.memory;
    if (m->rows > me->room) {
        double *more = realloc(me->remembered, m->rows * ROW * sizeof(double));
        if (!more) return report(me, STATUS_ERROR, "no memory for the past of delay()");
        me->remembered = more;
        me->room = m->rows;
    }
    m->first_row = 0;
    if (m->rows > 0) memcpy(me->remembered, from, memory_size(me));
    return STATUS_OK;
}
#endif
