/* Assertions and the texts of their messages. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "instance.h"

/* Appends `more` to a text with room for n characters. */
static void append(char *text, size_t n, const char *more, size_t length) {
    const size_t used = strlen(text);
    if (used + length >= n) length = n - used - 1;
    memcpy(text + used, more, length);
    text[used + length] = 0;
}

/* The message of assertion i with the values at the current point. */
static const char *message_of(Instance *me, int i, char *text, size_t n) {
    ZEROS(values, model.n_shown);
    const double *value = values + model.shown[i];
    const char *at = model.assert_message[i], *form;
    if (model.n_shown > 0) {
        environment_at(me, &me->s.t, me->s.x, me->s.u);
        me->res[0] = values;
        CALL(messages);
    }
    *text = 0;
    for (; (form = strchr(at, 1)) != NULL; at = strchr(form + 1, 1) + 1) {
        append(text, n, at, (size_t)(form - at));
        if (form[1] == '=') { /* words for 0, 1, 2 ... */
            const char *word = form + 2;
            for (double k = *value++; k >= 0.5 && word[strcspn(word, "|\001")] == '|'; k--) word = strchr(word, '|') + 1;
            append(text, n, word, strcspn(word, "|\001"));
        } else {
            char conversion[32] = "", number[64];
            append(conversion, sizeof conversion, form + 1, strcspn(form + 1, "\001"));
            snprintf(number, sizeof number, conversion, *value++);
            append(text, n, number, strlen(number));
        }
    }
    append(text, n, at, strlen(at));
    return text;
}

/* Failed assertions at the current point; one with level warning is told once a run. */
Status check_assertions(Instance *me) {
    if (model.n_asserts == 0) return STATUS_OK;
    State *s = &me->s;
    double holds[LENGTH(model.n_asserts)];
    char text[1024];
    if (solve_loop(me, s->t, s->x, s->u))
        return report(me, STATUS_ERROR, "t = %.9g: the model's algebraic loop has no solution", s->t);
    environment_at(me, &s->t, s->x, s->u);
    me->res[0] = holds;
    CALL(asserts);
    for (int i = 0; i < model.n_asserts; i++) {
        if (holds[i] != 0.0 && !isnan(holds[i])) continue;
        if (!model.assert_is_warning[i])
            return report(me, STATUS_ERROR, "t = %.9g: assertion violated: %s", s->t,
                          message_of(me, i, text, sizeof text));
        if (!s->warned[i]) report(me, STATUS_WARNING, "t = %.9g: %s", s->t, message_of(me, i, text, sizeof text));
        s->warned[i] = 1;
    }
    return STATUS_OK;
}
