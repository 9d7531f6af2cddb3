/* Where the arrays of an instance lie in its memory. */
#include "instance.h"

static size_t lend_room(void *to, char *block, size_t used, size_t bytes) {
    char *pointer = block ? block + used : NULL;
    memcpy(to, &pointer, sizeof pointer); /* a pointer to whatever type */
    return used + (bytes + sizeof(double) - 1) / sizeof(double) * sizeof(double);
}
#define LEND(pointer, n) used = lend_room(&(pointer), block, used, (size_t)LENGTH(n) * sizeof *(pointer))

/* Lets the arrays of a state be in a block of memory, NULL: nowhere; how many bytes these are. */
size_t lend_state(State *s, char *block) {
    Step *step = &s->step;
    Memory *m = &s->memory;
    size_t used = 0;
    s->block = block;
    LEND(s->p, NP), LEND(s->d, ND), LEND(s->u, NU), LEND(s->du, NU);
    LEND(s->xs, NX), LEND(s->x, NX), LEND(s->z, NZ), LEND(s->pz, NZ), LEND(s->m, NM), LEND(s->y, NY);
    LEND(s->dx, NX), LEND(s->v, NV), LEND(s->reach, NM);
    LEND(step->x0, NX), LEND(step->x1, NX), LEND(step->size, NX), LEND(step->u, NU), LEND(step->du, NU);
    for (int i = 0; i < STAGES; i++) LEND(step->k[i], NX);
    LEND(m->time, NDELAY), LEND(m->at_start, NHELD), LEND(m->size, NPAST);
    LEND(m->low, 2 * NTRANSPORT), LEND(m->high, 2 * NTRANSPORT), LEND(m->when, 2 * NTRANSPORT);
    LEND(m->x, NX), LEND(m->dx, NX), LEND(m->u, NU);
    LEND(s->u_set, NU), LEND(s->du_set, NU), LEND(s->xs_set, NX), LEND(s->warned, model.n_asserts);
    return used;
}

/* The same for an instance. */
size_t lend_instance(Instance *me, char *block) {
    const Pattern *const patterns[] = {&model.J, &model.R, &model.I};
    Factors *const lu[] = {&me->lu_step, &me->lu_loop, &me->lu_start};
    size_t used = lend_state(&me->s, block);
    LEND(me->start.p, NP), LEND(me->start.u, NU), LEND(me->start.xs, NX), LEND(me->start.xs_set, NX);
    LEND(me->arg, model.sz_arg + 1), LEND(me->res, model.sz_res + 1), LEND(me->w, model.sz_w + 1);
    LEND(me->ut, NU), LEND(me->uw, NU), LEND(me->moved, NTRANSPORT), LEND(me->g, NM), LEND(me->by_time, NX + NY), LEND(me->f0, NX), LEND(me->drdt, NY);
    LEND(me->jacobian, model.J.nonzeros), LEND(me->matrix, model.J.nonzeros), LEND(me->drdy, model.R.nonzeros);
    LEND(me->initial, model.I.nonzeros);
    for (int i = 0; i < 3; i++) {
        LEND(lu[i]->value, patterns[i]->factors);
        LEND(lu[i]->work, 2 * (NX + NY) + 1);
        LEND(lu[i]->pivot, NX + NY);
    }
    return used;
}
