/* Creation of instances, the complete state as a value, and the arrays of model exchange. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* NULL, with a message, if there is no memory, the GUID is another model's or the start values cannot be read. */
Instance *new_instance(const char *name, const char *guid, const char *resources, Listener listener,
                       int is_co_simulation) {
    Instance sizes;
    Instance *me = calloc(1, sizeof *me + lend_instance(&sizes, NULL));
    if (!name) name = model.identifier;
    if (me) me->name = malloc(strlen(name) + 1);
    if (!me || !me->name) {
        listener.log(listener.callback, listener.environment, name, STATUS_ERROR, "no memory for an instance");
        free(me);
        return NULL;
    }
    strcpy(me->name, name);
    lend_instance(me, (char *)(me + 1));
    me->listener = listener;
    if (!guid || strcmp(guid, model.guid) != 0) {
        report(me, STATUS_ERROR, "the GUID %s is not the one of this FMU, %s: modelDescription.xml and binary differ",
               guid ? guid : "(none)", model.guid);
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
    free_initial(me);
    free(me->remembered);
    free(me->name);
    free(me);
}

/* A copy of the complete state: this, and behind it the arrays of the state, the sensitivities and what delay()
 * remembers. */
typedef struct {
    size_t sensitivities, memory; /* bytes */
    State s;
} Copy;

static size_t bytes_of_arrays(void) {
    State s;
    return lend_state(&s, NULL);
}

/* With the arrays of `from` somewhere else than in its block, or with those of `to`. */
static void copy_scalars(const State *from, State *to, char *block) {
    *to = *from;
    lend_state(to, block);
}

static Status make_room(const Instance *me, void **copy, size_t sensitivities, size_t memory) {
    Copy *old = *copy;
    if (old && (old->sensitivities != sensitivities || old->memory != memory)) {
        free(old);
        *copy = NULL;
    }
    if (!*copy) *copy = malloc(sizeof(Copy) + bytes_of_arrays() + sensitivities + memory);
    if (!*copy) return report(me, STATUS_ERROR, "no memory for an FMU state");
    ((Copy *)*copy)->sensitivities = sensitivities;
    ((Copy *)*copy)->memory = memory;
    return STATUS_OK;
}

Status copy_state(const Instance *me, void **copy) {
    const Status status = make_room(me, copy, sensitivities_size(me), memory_size(me));
    if (status != STATUS_OK) return status;
    Copy *to = *copy;
    char *arrays = (char *)(to + 1), *behind = arrays + bytes_of_arrays();
    copy_scalars(&me->s, &to->s, NULL);
    memcpy(arrays, me->s.block, bytes_of_arrays());
    if (to->sensitivities > 0) copy_sensitivities(me, behind);
    copy_memory(me, behind + to->sensitivities);
    return STATUS_OK;
}

Status restore_state(Instance *me, const void *copy) {
    const Copy *from = copy;
    if (!from) return report(me, STATUS_ERROR, "no FMU state to set");
    const size_t own = sensitivities_size(me);
    const char *arrays = (const char *)(from + 1), *behind = arrays + bytes_of_arrays();
    if ((NPAST > 0 ? !from->sensitivities != !own : from->sensitivities != own) || (own > 0 && restore_sensitivities(me, behind)))
        return report(me, STATUS_ERROR, "the FMU state has not these sensitivities: reset instead");
    copy_scalars(&from->s, &me->s, me->s.block);
    memcpy(me->s.block, arrays, bytes_of_arrays());
    return restore_memory(me, behind + from->sensitivities);
}

/* Serialised: the GUID, so that another model's state is refused, the bytes of State (this platform's) with its arrays,
 * and the past. */
static size_t bytes_of_guid(void) { return strlen(model.guid) + 1; }

size_t serialised_size(const void *state) {
    return bytes_of_guid() + sizeof(State) + bytes_of_arrays() + (state ? ((const Copy *)state)->memory : 0);
}

Status serialise(const Instance *me, const void *state, char *bytes, size_t size) {
    if (!state || size < serialised_size(state))
        return report(me, STATUS_ERROR, "the buffer for the FMU state is too small or there is no state");
    memcpy(bytes, model.guid, bytes_of_guid());
    const Copy *from = state;
    if (from->sensitivities > 0) return report(me, STATUS_ERROR, "a state with sensitivities cannot be serialised");
    memcpy(bytes + bytes_of_guid(), (const char *)from + offsetof(Copy, s), serialised_size(state) - bytes_of_guid());
    return STATUS_OK;
}

Status deserialise(const Instance *me, const char *bytes, size_t size, void **state) {
    if (size < serialised_size(NULL) || memcmp(bytes, model.guid, bytes_of_guid()) != 0)
        return report(me, STATUS_ERROR, "these bytes are not a state of this FMU");
    const size_t memory = size - serialised_size(NULL);
    const Status status = make_room(me, state, 0, NPAST > 0 ? memory : 0);
    if (status != STATUS_OK) return status;
    Copy *to = *state;
    memcpy((char *)to + offsetof(Copy, s), bytes + bytes_of_guid(), serialised_size(to) - bytes_of_guid());
    return STATUS_OK;
}

static Status check_length(const Instance *me, size_t n, size_t expected, const char *what) {
    if (n == expected) return STATUS_OK;
    return report(me, STATUS_ERROR, "%zu %s asked for, the model has %zu", n, what, expected);
}

Status set_states(Instance *me, const double *x, size_t n) {
    const Status status = check_length(me, n, (size_t)NX, "continuous states");
    if (status != STATUS_OK) return status;
    if (n > 0) memcpy(me->s.x, x, n * sizeof *x);
    me->s.have_dx = me->s.have_v = 0;
    return STATUS_OK;
}

Status get_states(const Instance *me, double *x, size_t n) {
    const Status status = check_length(me, n, (size_t)NX, "continuous states");
    if (status == STATUS_OK && n > 0) memcpy(x, me->s.x, n * sizeof *x);
    return status;
}

/* A point where the derivatives do not exist is discarded: the importer's solver may try a shorter step. */
Status get_derivatives(Instance *me, double *dx, size_t n) {
    const Status status = check_length(me, n, (size_t)NX, "derivatives");
    if (status != STATUS_OK) return status;
    if (evaluate_derivatives(me))
        return report(me, STATUS_DISCARD, "t = %.9g: an algebraic loop has no solution", me->s.t);
    if (n > 0) memcpy(dx, me->s.dx, n * sizeof *dx);
    for (size_t i = 0; i < n; i++)
        if (!isfinite(dx[i]))
            return report(me, STATUS_DISCARD, "t = %.9g: the derivative of %s is not finite", me->s.t, model.x_name[i]);
    return STATUS_OK;
}

Status get_indicators(Instance *me, double *g, size_t n) {
    const Status status = check_length(me, n, (size_t)NM, "event indicators");
    if (status == STATUS_OK && NM > 0 && event_indicators(me, g))
        return report(me, STATUS_DISCARD, "t = %.9g: an algebraic loop has no solution", me->s.t);
    return status;
}

Status get_nominals(const Instance *me, double *nominals, size_t n) {
    const Status status = check_length(me, n, (size_t)NX, "nominal values");
    for (size_t i = 0; status == STATUS_OK && i < n; i++) nominals[i] = model.x_scale[i] > 0.0 ? model.x_scale[i] : 1.0;
    return status;
}
