/* The variables by their value references, and messages. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>

#include "instance.h"

Status report(const Instance *me, Status status, const char *format, ...) {
    char message[512];
    va_list list;
    va_start(list, format);
    vsnprintf(message, sizeof message, format, list);
    va_end(list);
    me->listener.log(me->listener.callback, me->listener.environment, me->name, status, message);
    return status;
}

/* Integers have 32 bits, but are calculated as doubles. */
Status whole_numbers(const Instance *me) {
    for (int i = 0; i < model.n_variables && model.has_integers; i++) {
        const VariableEntry *entry = &model.variables[i];
        if (entry->type != TYPE_INTEGER || (entry->vector != VECTOR_Z && entry->vector != VECTOR_D)) continue;
        const double value = (entry->vector == VECTOR_Z ? me->s.z : me->s.d)[entry->index];
        if (!(fabs(value) <= 2147483648.0))
            return report(me, STATUS_ERROR, "t = %.9g: integer overflow: %s would be %.9g", me->s.t, entry->name, value);
    }
    return STATUS_OK;
}

static const char *const TYPE_NAME[] = {"Real", "Integer", "Boolean"};

/* Says why a value reference does not lead to a variable of this type. */
const VariableEntry *no_entry(const Instance *me, unsigned reference, VariableType type) {
    if (reference >= (unsigned)model.n_variables)
        report(me, STATUS_ERROR, "no variable has the value reference %u", reference);
    else
        report(me, STATUS_ERROR, "%s is of type %s, not %s", model.variables[reference].name,
               TYPE_NAME[model.variables[reference].type], TYPE_NAME[type]);
    return NULL;
}

/* A real variable that has a derivative; NULL with a message. */
const VariableEntry *differentiable(const Instance *me, unsigned reference) {
    const VariableEntry *entry = entry_of(me, reference, TYPE_REAL);
    if (!entry || entry->vector != VECTOR_G) return entry;
    report(me, STATUS_ERROR, "%s has no directional derivative", entry->name);
    return NULL;
}

/* The unit direction of a real parameter (into s->p) or start value (into start); 0: the variable is neither. */
int parameter_direction(unsigned reference, Direction *s, double *start) {
    if (reference >= (unsigned)model.n_variables || model.variables[reference].type != TYPE_REAL) return 0;
    const VariableEntry *entry = &model.variables[reference];
    const int is_parameter = entry->settable == SETTABLE_FIXED || entry->settable == SETTABLE_TUNABLE;
    if (!is_parameter && entry->settable != SETTABLE_START) return 0;
    (is_parameter ? s->p : start)[entry->index] = entry->sign;
    return 1;
}

/* Where a real input is in u, -1: it is none; its value is that times `sign`. */
int input_place(unsigned reference, double *sign) {
    if (reference >= (unsigned)model.n_variables || model.variables[reference].type != TYPE_REAL ||
        model.variables[reference].settable != SETTABLE_INPUT)
        return -1;
    *sign = model.variables[reference].sign;
    return model.variables[reference].index;
}
