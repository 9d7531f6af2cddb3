/* Creation of instances, the complete state as a value, and the arrays of model exchange. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* NULL, with a message, if there is no memory, the GUID is another model's or the start values cannot be read. */
Instance *new_instance(const char *name, const char *guid, const char *resources, Listener listener,
                       int is_co_simulation) {
    Instance *me = calloc(1, sizeof *me);
    if (!name) name = MODEL_IDENTIFIER;
    if (me) me->name = malloc(strlen(name) + 1);
    if (!me || !me->name) {
        listener.log(listener.callback, listener.environment, name, STATUS_ERROR, "no memory for an instance");
        free(me);
        return NULL;
    }
    strcpy(me->name, name);
    Factors *const lu[] = {&me->lu_step, &me->lu_loop, &me->lu_start};
    double *const value[] = {me->factors.step, me->factors.loop, me->factors.start};
    for (int i = 0; i < 3; i++) {
        lu[i]->value = value[i];
        lu[i]->pivot = me->factors.pivot[i];
        lu[i]->work = me->factors.work[i];
    }
    me->listener = listener;
    if (!guid || strcmp(guid, MODEL_GUID) != 0) {
        report(me, STATUS_ERROR, "the GUID %s is not the one of this FMU, %s: modelDescription.xml and binary differ",
               guid ? guid : "(none)", MODEL_GUID);
        free_instance(me);
        return NULL;
    }
    me->s.is_co_simulation = is_co_simulation;
    if (read_starts(me, resources) > STATUS_WARNING) {
        free_instance(me);
        return NULL;
    }
    return me;
}

void free_instance(Instance *me) {
    if (!me) return;
    free_sensitivities(me);
    free_pivoted(&me->lu_step.other);
    free_pivoted(&me->lu_loop.other);
    free_pivoted(&me->lu_start.other);
#if MODEL_NDELAY > 0
    free(me->remembered);
#endif
    free(me->name);
    free(me);
}

/* A copy of the complete state: this, and behind it the sensitivities and what delay() remembers. */
typedef struct {
    State s;
    size_t sensitivities, memory; /* bytes */
} Copy;

static Status make_room(const Instance *me, void **copy, size_t sensitivities, size_t memory) {
    Copy *old = *copy;
    if (old && (old->sensitivities != sensitivities || old->memory != memory)) {
        free(old);
        *copy = NULL;
    }
    if (!*copy) *copy = malloc(sizeof(Copy) + sensitivities + memory);
    if (!*copy) return report(me, STATUS_ERROR, "no memory for an FMU state");
    ((Copy *)*copy)->sensitivities = sensitivities;
    ((Copy *)*copy)->memory = memory;
    return STATUS_OK;
}

Status copy_state(const Instance *me, void **copy) {
    const Status status = make_room(me, copy, sensitivities_size(me), memory_size(me));
    if (status != STATUS_OK) return status;
    Copy *to = *copy;
    memcpy(&to->s, &me->s, sizeof(State));
    if (to->sensitivities > 0) copy_sensitivities(me, (char *)(to + 1));
    copy_memory(me, (char *)(to + 1) + to->sensitivities);
    return STATUS_OK;
}

Status restore_state(Instance *me, const void *copy) {
    const Copy *from = copy;
    if (!from) return report(me, STATUS_ERROR, "no FMU state to set");
    const size_t own = sensitivities_size(me);
    if ((NDELAY > 0 ? !from->sensitivities != !own : from->sensitivities != own) || (own > 0 && restore_sensitivities(me, (const char *)(from + 1))))
        return report(me, STATUS_ERROR, "the FMU state has not these sensitivities: reset instead");
    memcpy(&me->s, &from->s, sizeof(State));
    return restore_memory(me, (const char *)(from + 1) + from->sensitivities);
}

/* Serialised: the GUID, so that another model's state is refused, the bytes of State (this platform's), and the past. */
size_t serialised_size(const void *state) {
    return sizeof MODEL_GUID + sizeof(State) + (state ? ((const Copy *)state)->memory : 0);
}

Status serialise(const Instance *me, const void *state, char *bytes, size_t size) {
    if (!state || size < serialised_size(state))
        return report(me, STATUS_ERROR, "the buffer for the FMU state is too small or there is no state");
    memcpy(bytes, MODEL_GUID, sizeof MODEL_GUID);
    const Copy *from = state;
    if (from->sensitivities > 0) return report(me, STATUS_ERROR, "a state with sensitivities cannot be serialised");
    memcpy(bytes + sizeof MODEL_GUID, &from->s, sizeof(State));
    memcpy(bytes + sizeof MODEL_GUID + sizeof(State), from + 1, from->memory);
    return STATUS_OK;
}

Status deserialise(const Instance *me, const char *bytes, size_t size, void **state) {
    if (size < serialised_size(NULL) || memcmp(bytes, MODEL_GUID, sizeof MODEL_GUID) != 0)
        return report(me, STATUS_ERROR, "these bytes are not a state of this FMU");
    const size_t memory = size - serialised_size(NULL);
    const Status status = make_room(me, state, 0, NDELAY > 0 ? memory : 0);
    if (status != STATUS_OK) return status;
    Copy *to = *state;
    memcpy(&to->s, bytes + sizeof MODEL_GUID, sizeof(State));
    memcpy(to + 1, bytes + sizeof MODEL_GUID + sizeof(State), to->memory);
    return STATUS_OK;
}

static Status check_length(const Instance *me, size_t n, size_t expected, const char *what) {
    if (n == expected) return STATUS_OK;
    return report(me, STATUS_ERROR, "%zu %s asked for, the model has %zu", n, what, expected);
}

Status set_states(Instance *me, const double *x, size_t n) {
    const Status status = check_length(me, n, NX, "continuous states");
    if (status != STATUS_OK) return status;
    if (n > 0) memcpy(me->s.x, x, n * sizeof *x);
    me->s.have_dx = me->s.have_v = 0;
    return STATUS_OK;
}

Status get_states(const Instance *me, double *x, size_t n) {
    const Status status = check_length(me, n, NX, "continuous states");
    if (status == STATUS_OK && n > 0) memcpy(x, me->s.x, n * sizeof *x);
    return status;
}

/* A point where the derivatives do not exist is discarded: the importer's solver may try a shorter step. */
Status get_derivatives(Instance *me, double *dx, size_t n) {
    static const char *const name[] = MODEL_X_NAME;
    const Status status = check_length(me, n, NX, "derivatives");
    if (status != STATUS_OK) return status;
    if (evaluate_derivatives(me))
        return report(me, STATUS_DISCARD, "t = %.9g: an algebraic loop has no solution", me->s.t);
    if (n > 0) memcpy(dx, me->s.dx, n * sizeof *dx);
    for (size_t i = 0; i < n; i++)
        if (!isfinite(dx[i]))
            return report(me, STATUS_DISCARD, "t = %.9g: the derivative of %s is not finite", me->s.t, name[i]);
    return STATUS_OK;
}

Status get_indicators(Instance *me, double *g, size_t n) {
    const Status status = check_length(me, n, NM, "event indicators");
    if (status == STATUS_OK && NM > 0 && event_indicators(me, g))
        return report(me, STATUS_DISCARD, "t = %.9g: an algebraic loop has no solution", me->s.t);
    return status;
}

Status get_nominals(const Instance *me, double *nominals, size_t n) {
    static const double nominal[] = MODEL_X_SCALE;
    const Status status = check_length(me, n, NX, "nominal values");
    for (size_t i = 0; status == STATUS_OK && i < n; i++) nominals[i] = nominal[i] > 0.0 ? nominal[i] : 1.0;
    return status;
}
