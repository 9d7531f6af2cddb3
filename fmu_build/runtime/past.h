/* Where the pieces of the past lie: what past.c and delays.c share. */
#ifndef FMUID_PAST_H
#define FMUID_PAST_H

#include <math.h>

#include "collocation.h"

#define ROW ((size_t)(2 + 4 * NPAST))

static inline double *nth_piece(const Instance *me, size_t i) { return me->remembered + (me->s.memory.first_row + i) * ROW; }

static inline double rounding(double t) { return 1e-13 * fmax(1.0, fabs(t)); }

/* Expression k in a piece. */
static inline double in_piece(const double *piece, int k, double t, double *slope) {
    const double *c = piece + 2 + 4 * k, h = piece[1] - piece[0], a = (t - piece[0]) / h, b = 1.0 - a;
    *slope = 6.0 * a * b * (c[1] - c[0]) / h + b * (1.0 - 3.0 * a) * c[2] + a * (3.0 * a - 2.0) * c[3];
    return c[0] + a * a * (1.0 + 2.0 * b) * (c[1] - c[0]) + h * a * b * (b * c[2] - a * c[3]);
}

/* How the past moved. */
static inline size_t width(const struct Sensitivity *q) { return 2 + q->n * (1 + 4 * NPAST); }

static inline double *nth_move(const struct Sensitivity *q, size_t i) { return q->past.rows + (q->past.first + i) * width(q); }

/* past.c, transport.c */
double column_move(const struct Sensitivity *q, int k, size_t j, double then, int after);
void pass_transports(Instance *me);
size_t oldest_inside(const Instance *me);
Status initial_contents(Instance *me, const double *values, const double *profile,
                        Status (*append)(Instance *, double, const double *, double, const double *));
void initial_moves(const struct Sensitivity *q, int i, size_t j, const double *along, double *piece);
#endif
