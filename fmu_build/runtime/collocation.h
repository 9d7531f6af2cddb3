/* The collocation equations of sensitivity.c: what it shares with sensitivity_rare.c and pivoted_blocks.c. */
#ifndef FMUID_COLLOCATION_H
#define FMUID_COLLOCATION_H

#include "instance.h"

enum { RADAU = 3, BLOCK = RADAU * RADAU, SLICE = 8 };
#define N (NX + NY)

/* How the inputs move along the directions: NU rows of n, at time t and by time from there on. */
typedef struct {
    double *seeds, *rates, t;
    unsigned char *driven; /* whether an input moves at all */
} Drive;

typedef struct { size_t first, end; } Span;

struct Sensitivity {
    size_t n, n_parameters;
    unsigned *parameters;
    double *weights;  /* n rows of n_parameters: how they move together */
    Direction *along; /* p, d, z and pz as they change, the rest is work memory ... */
    double *numbers;  /* ... and what they point to */
    double *moves;    /* the same p, d and z in NP + ND + NZ rows of n, in one block with what follows ... */
    Span *moved;      /* ... along which directions they change at all ... */
    int *active, n_active; /* ... and which derivatives are by those ... */
    int elements;     /* ... 1: those by elements of arrays, too */
    unsigned char *live;  /* by slices of directions: 0: nothing has moved along them yet, all that follows is zero */
    unsigned char *apart; /* by direction: whether derivatives along it alone cost less than all of these */
    int shared;       /* whether there are other directions */
    Drive drive, next; /* of the inputs since the integration last restarted, and ... */
    int replaced;      /* ... 1: from its next restart on */
    double *by_moves; /* N rows of n: derivatives of [f; r] along the directions, x and y held */
    double *start;    /* NX rows of n: at the beginning of the last step */
    double *stages;   /* N times RADAU rows of n: of each unknown at the collocation points */
    double *now;      /* NX rows of n: where the next step begins */
    double *rest;     /* N times RADAU rows of n: work memory; of [x; y; dx] where they were asked for */
    double *shown;    /* NV rows of n: of v where they were asked for */
    double from, to;  /* the piece of the last step that `stages` belong to ... */
    double smooth;    /* ... up to where f has no kink in it ... */
    int pieces;       /* ... and how many of it there were; 0: none is solved yet */
    double *switches; /* their values at the end of the last piece ... */
    int switches_known;                     /* ... if f goes on from there as it was */
    double *factors; /* blocks of L and U, on the diagonal inverses */
    Pivoted *other;                             /* of the whole matrix, where the planned pivots will not do ... */
    int use_other;                              /* ... as in the last piece */
    double *work;     /* 2 BLOCK N + 1 */
    /* How the past moved: pieces with their ends, the motion of their beginning where that is an event (n), and each
     * delayed expression at four times in equal distances (4 rows of n). */
    struct {
        double *rows, *start, *time, *event; /* NDELAY rows of n: at the start; of the delays; n: of the last event */
        size_t first, count, room;
    } past;
};

/* Inverse of the method's matrix, and its row sums. */
static const double W[RADAU][RADAU] = {
    {3.224744871391589, 1.1678400846904056, -0.25319726474218085},
    {-3.5678400846904057, 0.775255128608411, 1.0531972647421808},
    {5.531972647421808, -7.531972647421808, 5.0},
};

/* What multiplies a row of the collocation equations: loops are no differential equations. */
static inline double row_factor(int row, double h) { return row < NX ? h : 1.0; }

/* Directions first to end of each slice along which something moves: all that may differ from zero. */
#define EACH_LIVE(q, first, end)                                                                                   \
    for (size_t first = 0, end; end = first + SLICE < (q)->n ? first + SLICE : (q)->n, first < (q)->n; first = end)       \
        if ((q)->live[first / SLICE])

/* The derivative of input i along direction j at time t; of one that is delayed, from its past. */
static inline double driven_move(const Drive *a, size_t n, int i, size_t j, double t) {
    return a->seeds[i * n + j] + a->rates[i * n + j] * (t - a->t);
}
double past_move(const Instance *me, int k, size_t j, double t, int after);
#define input_move(me, i, j, t)                                                                                    \
    ((i) < NIN ? driven_move(&(me)->sensitivity->drive, (me)->sensitivity->n, i, j, t)                             \
               : past_move(me, (i) - NIN, j, t, (t) <= (me)->s.memory.event))
int start_past_moves(Instance *me);
Status record_past_moves(Instance *me, double from, double to, void (*at)(const struct Sensitivity *, double, double *));
void past_event_moves(Instance *me);
void move_past_jumps(Instance *me);
void remember_event_moves(Instance *me);
size_t past_moves_size(const struct Sensitivity *q);
void copy_past_moves(const struct Sensitivity *q, char *to);
int restore_past_moves(struct Sensitivity *q, const char *from);

/* pivoted_blocks.c: the factorisation with pivots chosen by size, and the solution by it. */
int pivoted_blocks(struct Sensitivity *q, double h, double *const *jacobian);
int solve_pivoted(struct Sensitivity *q, const double *y, double *to);

#endif
