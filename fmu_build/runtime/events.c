/* Relations, event iteration and location of state events. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* A relation changes during integration only when its indicator is beyond zero by this much: no chattering of a
 * quantity that rests at its threshold. */
static const double HYSTERESIS = 1e-10;
static const double EXACT = -1.0; /* no such tolerance */
/* After so many changes one after the other between which an indicator hardly left zero, this much is doubled, up to the
 * tolerance of the integration: what is driven back to its threshold from both sides stays as near to it. */
enum { CHATTERING = 100 };
static const double HARDLY = 10.0;

static double width(const State *s, int i) {
    return s->widened ? fmax(HYSTERESIS, fmin(ldexp(HYSTERESIS, s->widened), s->tolerance * s->reach[i])) : HYSTERESIS;
}

static int indicators_at(Instance *me, double t, const double *x, const double *u, double *g) {
    if (solve_loop(me, t, x, u)) return 1;
    environment_at(me, &t, x, u);
    me->res[0] = g;
    return CALL(indicators);
}

/* Indicators for an importer's root finder: they cross zero where the relation shall change. */
int event_indicators(Instance *me, double *g) {
    State *s = &me->s;
    const int failed = indicators_at(me, s->t, s->x, s->u, g);
    for (int i = 0; i < NM; i++) g[i] += s->m[i] != 0.0 ? HYSTERESIS : -HYSTERESIS;
    return failed;
}

static int same(const double *a, const double *b, int n) {
    for (int i = 0; i < n; i++)
        if (a[i] != b[i] && !(isnan(a[i]) && isnan(b[i]))) return 0;
    return 1;
}

/* Takes over new relations: all, or (where the plain fixed point alternates) only those that turn false, or else the
 * first that turns true. */
static void adopt(double *m, const double *new, int few) {
    int falls = 0;
    for (int i = 0; i < NM; i++) falls |= m[i] != 0.0 && new[i] == 0.0;
    for (int i = 0; i < NM; i++) {
        if (m[i] == new[i] || (few && falls && new[i] != 0.0)) continue;
        m[i] = new[i];
        if (few && !falls) break;
    }
}

/* What an update gives beside z. */
typedef struct {
    double *x, next_event, terminate, reinit;
} Update;

/* Where an iteration begins. */
typedef struct {
    const double *m, *z, *y;
} Modes;

typedef enum { CHANGED, SETTLED, FAILED } Round;

/* One round of the inner iteration: new z, and in m the relations that belong to it. */
static Round one_round(Instance *me, double flag, double slack, Update *update, double *m) {
    State *s = &me->s;
    ZEROS(z, NZ);
    if (solve_loop(me, s->t, s->x, s->u)) return FAILED;
    environment_at(me, &s->t, s->x, s->u);
    me->arg[9] = &flag;
    me->res[0] = z;
    me->res[1] = update->x;
    me->res[2] = &update->next_event;
    me->res[3] = &update->terminate;
    me->res[4] = &update->reinit;
    CALL(update);
    const int settled = same(z, s->z, NZ);
    memcpy(s->z, z, NZ * sizeof *z);
    if (NY > 0 && !settled && solve_loop(me, s->t, s->x, s->u)) return FAILED;
    relations_within(me, slack, s->t, s->x, s->u, m);
    return settled ? SETTLED : CHANGED;
}

/* Are the relations `tried` consistent, all others as they follow? Starts from z, m and y of `before`. */
static Round try_modes(Instance *me, double flag, double slack, const Modes *before, const unsigned char *tried,
                       Update *update) {
    State *s = &me->s;
    ZEROS(m, NM);
    for (int round = 0; round < 20; round++) {
        const Round now = one_round(me, flag, slack, update, m);
        if (now == FAILED) break;
        int consistent = 1, settled = now == SETTLED;
        for (int i = 0; i < NM; i++) {
            consistent &= !tried[i] || m[i] == s->m[i];
            settled &= m[i] == s->m[i];
            if (!tried[i]) s->m[i] = m[i];
        }
        if (settled) return SETTLED;
        if (!consistent && now == SETTLED) break;
    }
    memcpy(s->z, before->z, BYTES(NZ));
    memcpy(s->y, before->y, BYTES(NY));
    return CHANGED;
}

/* Where the fixed point does not settle: the consistent combination of the relations that changed, and of those that
 * depend on them, with the fewest changes. */
static Round search_modes(Instance *me, double flag, double slack, const Modes *before, const unsigned char *changed,
                          Update *update) {
    enum { MOST = 12 };
    State *s = &me->s;
    unsigned char tried[LENGTH(NM)];
    int member[MOST], n = 0;
    memset(tried, 0, sizeof tried);
    for (int i = 0; i < NM && n < MOST; i++) {
        for (int j = 0; j < NM; j++) tried[i] |= changed[j] && model.group[i] == model.group[j];
        if (tried[i]) member[n++] = i;
    }
    for (int distance = 0; distance <= n; distance++)
        for (unsigned mask = 0; mask < 1u << n; mask++) {
            int bits = 0;
            for (unsigned rest = mask; rest; rest &= rest - 1) bits++;
            if (bits != distance) continue;
            memcpy(s->m, before->m, BYTES(NM));
            memcpy(s->z, before->z, BYTES(NZ));
            memcpy(s->y, before->y, BYTES(NY));
            for (int k = 0; k < n; k++)
                if (mask >> k & 1) s->m[member[k]] = s->m[member[k]] == 0.0;
            if (try_modes(me, flag, slack, before, tried, update) == SETTLED) return SETTLED;
        }
    return FAILED;
}

/* The inner iteration: z and m that belong to each other at (s.t, s.x, s.u). */
static Status settle(Instance *me, double flag, Update *update) {
    State *s = &me->s;
    double m0[LENGTH(NM)], z0[LENGTH(NZ)], y0[LENGTH(NY)];
    const Modes before = {m0, z0, y0};
    unsigned char changed[LENGTH(NM)];
    memcpy(m0, s->m, sizeof m0);
    memcpy(z0, s->z, sizeof z0);
    memcpy(y0, s->y, sizeof y0);
    memset(changed, 0, sizeof changed);
    for (int inner = 0; inner < 100; inner++) {
        ZEROS(m, NM);
        const Round now = one_round(me, flag, EXACT, update, m);
        if (now == FAILED) {
            if (inner > 0) break;
            return report(me, STATUS_ERROR, "t = %.9g: an algebraic loop has no solution at an event", s->t);
        }
        if (now == SETTLED && same(m, s->m, NM)) return STATUS_OK;
        for (int i = 0; i < NM; i++) changed[i] |= m[i] != s->m[i];
        adopt(s->m, m, inner >= 10);
    }
    if (search_modes(me, flag, EXACT, &before, changed, update) == SETTLED) return STATUS_OK;
    /* Where several modes meet, as where the diodes of a bridge stop to conduct, rounding alone may rule out each. */
    if (search_modes(me, flag, HYSTERESIS, &before, changed, update) == SETTLED) return STATUS_OK;
    return report(me, STATUS_ERROR, "t = %.9g: the event iteration finds no consistent discrete variables", s->t);
}

/* The event iteration at (s.t, s.x, s.u), as fmu_build/model.py defines it. With `initial` only the inner loop runs,
 * and when-clauses fire where they name initial(). */
Status event_iteration(Instance *me, int initial) {
    State *s = &me->s;
    s->have_dx = s->have_v = 0;
    if (!model.has_events) return STATUS_OK;
    for (int outer = 0; outer < 100; outer++) {
        double x[LENGTH(NX)];
        Update update = {.x = x, .next_event = INFINITY};
        memcpy(x, s->x, sizeof x);
        Status status = settle(me, initial, &update);
        if (status > STATUS_WARNING) return status;
        s->next_event = update.next_event;
        s->memory.own_next = update.next_event;
        s->next_event = fmin(s->next_event, next_delayed_event(me));
        if (update.terminate != 0.0) s->terminate = 1;
        if (initial) return whole_numbers(me);
        status = update_sensitivities(me, update.reinit != 0.0);
        if (status > STATUS_WARNING) return status;
        const int again = !same(s->z, s->pz, NZ) || update.reinit != 0.0;
        memcpy(s->pz, s->z, BYTES(NZ));
        if (update.reinit != 0.0) memcpy(s->x, update.x, NX * sizeof *s->x);
        if (!again) return whole_numbers(me);
    }
    return report(me, STATUS_ERROR, "t = %.9g: the event iteration does not end", s->t);
}

/* Indicators at time t of the last step, each turned so that it is positive while its relation stays as it is in m.
 * Is one of them beyond its change? */
static int changed_at(Instance *me, double t, double *g) {
    State *s = &me->s;
    double x[LENGTH(NX)];
    int changed = 0;
    dense_output(&s->step, t, x);
    input_at(me, t);
    memset(g, 0, NM * sizeof *g);
    if (indicators_at(me, t, x, me->ut, g)) return 0;
    for (int i = 0; i < NM; i++) {
        if (s->m[i] == 0.0) g[i] = -g[i];
        changed |= g[i] < -HYSTERESIS;
    }
    if (changed && s->widened) {
        changed = 0;
        for (int i = 0; i < NM; i++) changed |= g[i] < -width(s, i);
    }
    return changed;
}

/* Looks at the state event that ends the last step: is it one of many in a row about a threshold? */
void watch_chattering(Instance *me) {
    State *s = &me->s;
    double at[LENGTH(NM)], middle[LENGTH(NM)];
    const int in_one_step = s->step.t0 == s->event_time;
    int near = 0;
    s->event_time = s->step.t1;
    if (NM == 0 || !in_one_step || !changed_at(me, s->step.t1, at)) return;
    changed_at(me, 0.5 * (s->step.t0 + s->step.t1), middle);
    for (int i = 0; i < NM; i++) near |= at[i] < -width(s, i) && fabs(middle[i]) <= HARDLY * width(s, i);
    s->chatter = near ? s->chatter + 1 : 0;
    if (s->chatter < CHATTERING || s->widened >= 64) return;
    s->chatter = 0;
    if (!s->widened++)
        report(me, STATUS_WARNING,
               "t = %.9g: a relation changes to and fro about its threshold (chattering); from here on it does so within "
               "the tolerance of the integration",
               s->step.t1);
}

/* Between three samples at equal distances, none of which has changed, a relation may change and change back: looks
 * where the parabola through them comes close to that. The time of a change found, or NAN. */
static double between_samples(Instance *me, double middle, double distance, double g[3][LENGTH(NM)]) {
    double unused[LENGTH(NM)];
    for (int i = 0; i < NM; i++) {
        const double slope = 0.5 * (g[2][i] - g[0][i]), bend = 0.5 * (g[2][i] + g[0][i]) - g[1][i];
        if (!(fabs(slope) < 2.0 * bend)) continue; /* no minimum inside */
        const double lowest = g[1][i] - 0.25 * slope * slope / bend, t = middle - 0.5 * slope / bend * distance;
        if (lowest < 0.25 * g[1][i] && changed_at(me, t, unused)) return t;
    }
    return NAN;
}

/* Ends the last step at the first state event that `samples` samples of (from, to] see, just past the change. */
void find_event(Instance *me, double from, double to, int samples) {
    Step *step = &me->s.step;
    if (NM == 0) return;
    double g[3][LENGTH(NM)], before = from, after = NAN;
    const double distance = (to - from) / samples;
    if (samples > 1) changed_at(me, from, g[2]);
    for (int i = 1; i <= samples && isnan(after); i++) {
        const double t = i == samples ? to : from + i * distance;
        memcpy(g[0], g[1], sizeof g[0]);
        memcpy(g[1], g[2], sizeof g[0]);
        if (changed_at(me, t, g[2])) after = t;
        else if (i >= 2) after = between_samples(me, t - distance, distance, g);
        if (isnan(after) && i >= 2) before = t - distance;
    }
    if (isnan(after)) {
        for (int i = 0; i < NM; i++) me->s.reach[i] = fmax(me->s.reach[i], fabs(g[2][i]));
        return;
    }
    for (;;) {
        const double middle = before + 0.5 * (after - before);
        if (middle <= before || middle >= after) break;
        if (changed_at(me, middle, g[0])) after = middle;
        else before = middle;
    }
    step->t1 = after;
    step->event = 1;
}
