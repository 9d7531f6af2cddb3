/* Start values that were written into a copy of the FMU after it was compiled: resources/start_values.txt.
 *
 * A line has value reference, type (VariableType) and the bits of the double in hexadecimal, which no locale
 * misreads; what follows is for people. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

static const char FILE_NAME[] = "/start_values.txt";

/* Resource location (a file URI in FMI 2.0, a path in 3.0) as a path; as long as the location at most. */
static void local_path(const char *location, char *path) {
    const int is_uri = !strncmp(location, "file:", 5);
    if (is_uri) location += 5;
    if (is_uri && !strncmp(location, "//", 2)) { /* an empty host, or this one */
        location += 2;
        while (*location && *location != '/') location++;
    }
    while (*location) {
        unsigned byte;
        if (is_uri && sscanf(location, "%%%2x", &byte) == 1) {
            *path++ = (char)byte;
            location += 3;
        } else {
            *path++ = *location++;
        }
    }
    *path = '\0';
}

/* What a new or reset instance starts with: as compiled, then as the file says. */
Status read_starts(Instance *me, const char *location) {
    memcpy(me->start.p, model.p_start, NP * sizeof(double));
    memcpy(me->start.u, model.u_start, NU * sizeof(double));
    set_defaults(me);
    char *path = malloc((location ? strlen(location) : 0) + sizeof FILE_NAME);
    if (!path) return report(me, STATUS_ERROR, "no memory for the path of the resources");
    local_path(location ? location : "", path);
    strcat(path, FILE_NAME);
    FILE *file = location ? fopen(path, "r") : NULL;
    free(path);
    if (!file) return STATUS_OK;
    unsigned reference, type;
    uint64_t bits;
    int found = 0;
    Status status = STATUS_OK;
    while (status <= STATUS_WARNING) {
        found = fscanf(file, "%u %u %" SCNx64 "%*[^\n]", &reference, &type, &bits);
        if (found != 3) break;
        double value;
        memcpy(&value, &bits, sizeof value);
        status = set_value(me, reference, (VariableType)type, value);
    }
    fclose(file);
    if (status <= STATUS_WARNING && found != EOF)
        status = report(me, STATUS_ERROR, "resources%s is damaged", FILE_NAME);
    memcpy(me->start.p, me->s.p, BYTES(NP));
    memcpy(me->start.u, me->s.u, BYTES(NU));
    memcpy(me->start.xs, me->s.xs, BYTES(NX));
    memcpy(me->start.xs_set, me->s.xs_set, (size_t)NX);
    set_defaults(me);
    return status;
}
