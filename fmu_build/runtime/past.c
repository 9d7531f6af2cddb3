/* The past of what is delayed, as delays.c remembers it: values, slopes, jumps and derivatives. */
#include <stdlib.h>
#include <string.h>

#include "past.h"

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

/* The slope of a delayed value. */
double delayed_slope(const Instance *me, int k, double t, int after) {
    const double then = t - me->s.memory.time[k], *piece = piece_at(me, then, after);
    double slope = 0.0;
    if (piece) in_piece(piece, k, fmin(fmax(then, piece[0]), piece[1]), &slope);
    return slope;
}

static int jumps(const double *before, const double *after, int k) {
    const double a = before[2 + 4 * k + 1], b = after[2 + 4 * k];
    return fabs(a - b) > 1e-12 * fmax(fabs(a), fabs(b));
}

/* The expression that jumped, and when, so that it does now after its delay; -1: none. */
int jump_due(const Instance *me, double *past) {
    const State *s = &me->s;
    for (size_t i = 1; i < s->memory.rows; i++)
        for (int k = 0; k < NDELAY; k++) {
            *past = nth_piece(me, i)[0];
            if (fabs(*past + s->memory.time[k] - s->t) <= rounding(s->t) && jumps(nth_piece(me, i - 1), nth_piece(me, i), k))
                return k;
        }
    return -1;
}

/* The next time event that the past sets. */
double next_delayed_event(const Instance *me) {
    const Memory *m = &me->s.memory;
    double next = INFINITY;
    for (int k = 0; k < NDELAY; k++) next = fmin(next, m->event + m->time[k]);
    for (size_t i = 1; i < m->rows; i++) {
        const double *before = nth_piece(me, i - 1), *after = nth_piece(me, i);
        for (int k = 0; k < NDELAY; k++) {
            const double at = after[0] + m->time[k];
            if (jumps(before, after, k) && at > me->s.t + rounding(me->s.t)) next = fmin(next, at);
        }
    }
    return next;
}

/* The derivative of what column k of the past had along direction j. */
double column_move(const struct Sensitivity *q, int k, size_t j, double then, int after) {
    const double reach = after ? then + rounding(then) : then - rounding(then);
    size_t low = 0, high = q->past.count;
    while (low < high) {
        const size_t middle = low + (high - low) / 2;
        if (nth_move(q, middle)[0] <= reach) low = middle + 1;
        else high = middle;
    }
    if (low == 0) return k < NDELAY ? q->past.start[k * q->n + j] : 0.0;
    const double *piece = nth_move(q, low - 1), *at = piece + 2 + q->n + 4 * k * q->n + j;
    const double a = 3.0 * fmin(fmax((then - piece[0]) / (piece[1] - piece[0]), 0.0), 1.0);
    return -(a - 1.0) * (a - 2.0) * (a - 3.0) / 6.0 * at[0] + a * (a - 2.0) * (a - 3.0) / 2.0 * at[q->n] -
           a * (a - 1.0) * (a - 3.0) / 2.0 * at[2 * q->n] + a * (a - 1.0) * (a - 2.0) / 6.0 * at[3 * q->n];
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
