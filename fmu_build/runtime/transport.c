/* spatialDistribution(): a pipe of length 1 whose contents move by x. What enters at its ends, and x, are remembered as
 * what is delayed is; what leaves entered when x was less by 1, or as it is now if the flow has turned meanwhile.
 *
 * Between events each outlet has a value, a slope by x and the place x that they belong to: the equations follow the line
 * through it, so that their derivatives by whatever x depends on are right. Where a jump or a bend leaves, and each time
 * that the contents were replaced, is a state event. For the left outlet all is mirrored: places are -x. */
#include <float.h>
#include <math.h>

#include "past.h"

static const double NEAR = 1e-9; /* of the length: a jump so near has left */

/* Which columns of the past an outlet is about: entered at the other end, entered at this one, moved. */
typedef struct { int far, near, place; double sign; } Outlet;

static Outlet outlet(int o) {
    const int first = NDELAY + 3 * (o / 2), right = o % 2;
    const Outlet a = {first + !right, first + right, first + 2, right ? 1.0 : -1.0};
    return a;
}

static double first_place(const Outlet *a, const double *piece) { return a->sign * piece[2 + 4 * a->place]; }
static double last_place(const Outlet *a, const double *piece) { return a->sign * piece[2 + 4 * a->place + 1]; }

/* When the contents were at a place, in a piece in which they pass it. */
static double time_of(const Outlet *a, const double *piece, double place) {
    const double aim = a->sign * place, begins = piece[2 + 4 * a->place], ends = piece[2 + 4 * a->place + 1];
    double low = piece[0], high = piece[1], t = low + (aim - begins) / (ends - begins) * (high - low);
    if ((aim - begins) * (ends - begins) <= 0.0) return low;
    if ((ends - aim) * (ends - begins) <= 0.0) return high;
    for (int round = 0; round < 100 && high - low > DBL_EPSILON * fabs(high); round++) {
        double slope;
        const double off = in_piece(piece, a->place, t, &slope) - aim;
        if (off == 0.0) break;
        if (off * (ends - begins) < 0.0) low = t;
        else high = t;
        const double next = t - off / slope;
        if (fabs(next - t) <= DBL_EPSILON * fabs(t)) break;
        t = next > low && next < high ? next : 0.5 * (low + high);
    }
    return t;
}

/* What entered, and its slope by the place: of the piece, where the contents stood still. */
typedef struct { double value, slope; } Content;

static Content content_at(const Outlet *a, const double *piece, int column, double t) {
    const double *moved = piece + 2 + 4 * a->place, *entered = piece + 2 + 4 * column;
    double by_time, speed;
    Content c = {in_piece(piece, column, t, &by_time), 0.0};
    in_piece(piece, a->place, t, &speed);
    if (speed != 0.0) c.slope = by_time / speed;
    else if (moved[1] != moved[0]) c.slope = (entered[1] - entered[0]) / (moved[1] - moved[0]);
    return c;
}

static Content content(const Outlet *a, const double *piece, int column, double place) {
    return content_at(a, piece, column, time_of(a, piece, place));
}

/* How the contents near an outlet are found from the newest piece backwards: those up to `near` entered here, those from
 * 1 + `far` on entered at the other end. Has this piece some of them? */
typedef struct { double near, far; } Reach;

static int extend(const Outlet *a, const double *piece, Reach *r) {
    const double begins = first_place(a, piece), ends = last_place(a, piece);
    const int more = begins > ends ? begins > r->near : begins < r->far;
    if (begins > ends) r->near = fmax(r->near, begins);
    else r->far = fmin(r->far, begins);
    return more;
}

static Reach present(const Instance *me, const Outlet *a) {
    const double place = last_place(a, nth_piece(me, me->s.memory.rows - 1));
    const Reach r = {place, place};
    return r;
}

/* Where what leaves at `place` entered. */
typedef struct { const double *piece; int column; double t; } Origin;

static Origin origin(const Instance *me, const Outlet *a, double place) {
    Reach r = present(me, a);
    for (size_t i = me->s.memory.rows; i-- > 0;) {
        const double *piece = nth_piece(me, i), begins = first_place(a, piece), ends = last_place(a, piece);
        if (!extend(a, piece, &r)) continue;
        if (begins > ends && place <= r.near) return (Origin){piece, a->near, time_of(a, piece, place)};
        if (begins < ends && place >= 1.0 + r.far) return (Origin){piece, a->far, time_of(a, piece, place - 1.0)};
    }
    return (Origin){nth_piece(me, 0), a->far, nth_piece(me, 0)[0]};
}

/* The place nearest to x on what leaves before the next jump, in the mirrored direction. */
static double nearest(const Memory *m, int o, double place) {
    return fmax(fmin(place, m->high[o] - NEAR), m->low[o]);
}

/* What leaves now, into the entries of u: the value, its slope, the place and that of the next jump. */
static void leaving(const Instance *me, int o, double x, double *u) {
    const Memory *m = &me->s.memory;
    const Outlet a = outlet(o);
    Content c = {m->at_start[NDELAY + o], 0.0};
    double jump = x + a.sign;
    if (m->rows > 0) {
        const double place = nearest(m, o, a.sign * x);
        const Origin from = origin(me, &a, place);
        c = content_at(&a, from.piece, from.column, from.t);
        c.value += c.slope * (x - a.sign * place);
        jump = a.sign * m->high[o];
    }
    u[OUTLETS + o] = c.value;
    u[OUTLETS + 2 * NTRANSPORT + o] = c.slope;
    u[OUTLETS + 4 * NTRANSPORT + o] = x;
    u[OUTLETS + 6 * NTRANSPORT + o] = jump;
}

/* The inputs u with what leaves at (t, x, u); me->moved is kept. */
const double *with_transports(Instance *me, const double *u) {
    me->res[0] = me->moved;
    CALL(moved);
    me->res[0] = NULL;
    memcpy(me->uw, u, BYTES(NU));
    for (int o = 0; o < 2 * NTRANSPORT; o++) leaving(me, o, me->moved[o / 2], me->uw);
    return me->uw;
}

static int differs(double a, double b, double part) { return fabs(a - b) > part * fmax(fabs(a), fabs(b)); }

static int is_jump(Content a, Content b) { return differs(a.value, b.value, 1e-12) || differs(a.slope, b.slope, 1e-6); }

/* The next jump that leaves at an outlet, seen from a place: nearest to it among what entered here, else the last one
 * met among what entered at the other end, at the latest what is entering there now. */
static void next_jump(Instance *me, int o) {
    Memory *m = &me->s.memory;
    const Outlet a = outlet(o);
    Reach r = present(me, &a);
    Content near = {NAN, NAN}, far = near;
    double when = m->until, near_since = when, far_since = when;
    m->low[o] = r.near + NEAR;
    m->high[o] = 1.0 + r.far;
    for (size_t i = m->rows; i-- > 0;) {
        const double *piece = nth_piece(me, i), begins = first_place(&a, piece), ends = last_place(&a, piece);
        const Reach before = r;
        if (!extend(&a, piece, &r)) continue;
        if (begins > ends) {
            const Content c = content(&a, piece, a.near, before.near);
            if (before.near > m->low[o] && is_jump(near, c)) {
                m->high[o] = before.near, when = piece[1];
                break;
            }
            near = content(&a, piece, a.near, fmin(begins, 1.0 + r.far));
            near_since = piece[0];
        } else {
            const Content c = content(&a, piece, a.far, before.far);
            if (1.0 + before.far > m->low[o] && is_jump(far, c)) m->high[o] = 1.0 + before.far, when = piece[1];
            far = content(&a, piece, a.far, fmax(begins, r.near - 1.0));
            far_since = piece[0];
        }
        if (r.near < 1.0 + r.far) continue; /* else what entered at both ends meets */
        const double meets = begins > ends ? 1.0 + r.far : r.near;
        if (meets > m->low[o] && is_jump(near, far)) m->high[o] = meets, when = begins > ends ? far_since : near_since;
        break;
    }
    m->when[o] = when;
}

/* At an event: up to where what leaves now goes on without a jump. */
void pass_transports(Instance *me) {
    for (int o = 0; o < 2 * NTRANSPORT; o++) next_jump(me, o);
}

/* The oldest piece with contents that are still inside. */
size_t oldest_inside(const Instance *me) {
    size_t oldest = me->s.memory.rows;
    for (int o = 1; o < 2 * NTRANSPORT; o += 2) {
        const Outlet a = outlet(o);
        Reach r = present(me, &a);
        size_t i = me->s.memory.rows;
        while (i-- > 1) {
            extend(&a, nth_piece(me, i), &r);
            if (r.near > 1.0 + r.far + NEAR) break;
        }
        oldest = i < oldest ? i : oldest;
    }
    return oldest;
}

/* The contents at the start, as if they had entered at the left within one second. `profile` has both ends of each
 * interval; `append` adds a piece with values and slopes at its ends. */
Status initial_contents(Instance *me, const double *values, const double *profile,
                        Status (*append)(Instance *, double, const double *, double, const double *)) {
    Status status = STATUS_OK;
    const double start = me->s.t;
    for (int i = model.n_points - 2; i >= 0 && status <= STATUS_WARNING; i--) {
        const double left = model.points[i], right = model.points[i + 1];
        double a[2 * NPAST], b[2 * NPAST];
        for (int k = 0; k < NPAST; k++) a[k] = b[k] = values[k], a[NPAST + k] = b[NPAST + k] = 0.0;
        for (int n = 0; n < NTRANSPORT; n++) {
            const int k = NDELAY + 3 * n;
            const double *ends = profile + 2 * (i * NTRANSPORT + n);
            a[k] = ends[1], b[k] = ends[0];
            a[NPAST + k] = b[NPAST + k] = (ends[0] - ends[1]) / (right - left);
            a[k + 2] = values[k + 2] - right, b[k + 2] = values[k + 2] - left;
            a[NPAST + k + 2] = b[NPAST + k + 2] = 1.0;
        }
        status = append(me, start - right, a, start - left, b);
    }
    return status;
}

/* The same of how they move along direction j, into a piece of past moves (see record_past_moves). */
void initial_moves(const struct Sensitivity *q, int i, size_t j, const double *along, double *piece) {
    const double *profile = along + NPAST + NDELAY;
    for (int k = 0; k < NPAST; k++) {
        const int n = (k - NDELAY) / 3, entered = k >= NDELAY && (k - NDELAY) % 3 == 0;
        const double *ends = profile + 2 * (i * NTRANSPORT + n);
        for (int part = 0; part < 4; part++)
            piece[2 + q->n + (4 * k + part) * q->n + j] =
                entered ? ends[1] + part / 3.0 * (ends[0] - ends[1]) : along[k];
    }
}

/* The derivative of an entry of u that belongs to an outlet along direction j, x held, at the point of which
 * `with_transports` was called last. */
static double transport_move(const Instance *me, int entry, size_t j) {
    const Memory *m = &me->s.memory;
    const struct Sensitivity *q = me->sensitivity;
    const int kind = entry / (2 * NTRANSPORT), o = entry % (2 * NTRANSPORT);
    const Outlet a = outlet(o);
    if (m->rows == 0) return kind == 0 ? q->past.start[(NDELAY + o) * q->n + j] : 0.0;
    if (kind == 0) {
        const Origin from = origin(me, &a, nearest(m, o, a.sign * me->moved[o / 2]));
        const int late = from.t - from.piece[0] < from.piece[1] - from.t;
        const double slope = content_at(&a, from.piece, from.column, from.t).slope;
        return column_move(q, from.column, j, from.t, late) - slope * column_move(q, a.place, j, from.t, late);
    }
    if (kind < 3) return 0.0;
    double moved = column_move(q, a.place, j, m->when[o], 0), speed = 0.0;
    for (size_t i = 0; i < m->rows; i++)
        if (nth_piece(me, i)[1] == m->when[o]) in_piece(nth_piece(me, i), a.place, m->when[o], &speed);
    for (size_t i = 0; i < q->past.count; i++)
        if (nth_move(q, i)[0] == m->when[o]) moved += speed * nth_move(q, i)[2 + j];
    return moved;
}

/* The derivative of an entry of u behind the inputs along direction j. */
double past_move(const Instance *me, int k, size_t j, double t, int after) {
    const struct Sensitivity *q = me->sensitivity;
    if (k >= NDELAY) return transport_move(me, k - NDELAY, j);
    return column_move(q, k, j, t - me->s.memory.time[k], after) -
           delayed_slope(me, k, t, after) * q->past.time[k * q->n + j];
}
