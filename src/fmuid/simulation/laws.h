/* Laws that are added to the derivatives of an FMU: compiled expressions, evaluated by a stack machine.
 *
 * They are written by law_code.py. An expression refers to states, to the derivatives that the FMU gives, to inputs, to the laws'
 * parameters and to time. A law is active while one of its sizes differs from its neutral value; others cost nothing.
 */
#ifndef FMUID_LAWS_H
#define FMUID_LAWS_H

#include "stepper.h"

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

/* Operations; mirrored in law_code.py. Those before ADD push a value; JUMP and UNLESS go to an instruction. */
enum {
    CONSTANT, STATE, DERIVATIVE, INPUT, PARAMETER, TIME, ADDED_STATE, OWN, ADD, SUBTRACT, MULTIPLY, DIVIDE, POWER, LESS, AT_MOST,
    EQUAL, AND, OR, MINIMUM, MAXIMUM, ATAN2, NEGATE, NOT, ABS, SIGN, SQRT, EXP, LOG, LOG10, SIN, COS, TAN, ASIN, ACOS, ATAN,
    SINH, COSH, TANH, JUMP, UNLESS, N_OPERATIONS
};
enum { DEEPEST = 64 };
#define NONE SIZE_MAX

typedef struct { int32_t operation, index; double value; } Instruction;
typedef struct { size_t n; Instruction *code; } Program;
typedef struct { size_t target; Program flow; } Term;            /* der(state) -= flow */
typedef struct { Program derivative, start; size_t place; } Inner; /* a state of a law; its place among the active ones */
typedef struct {
    size_t n_sizes, n_terms, n_inner;
    size_t *size;      /* parameters that turn it on ... */
    double *neutral;   /* ... and their values at which it is off; without any, it is always on */
    Term *term;
    Inner *inner;
    size_t coefficient; /* its only term is the value of this coefficient; NONE: terms are flows */
    int active;
} Law;
/* A parameter of the FMU that laws may vary during a run. Parameters are fixed then, so two further instances show the derivatives
 * at other values of it. In between, a derivative is taken for a quotient of lines, (a + b p)/(1 + c p), as it is for stiffnesses,
 * conductances, inertias and their like. */
typedef struct {
    size_t scalar;      /* its number in the FMU */
    Instance instance[2];
    double own, at[2], *f[2]; /* its value in the run, those of the instances, and their derivatives */
    int active;
} Coefficient;
typedef struct {
    size_t n_laws, n_parameters, n_states, n_coefficients;
    Law *law;
    Coefficient *coefficient;
    double *parameter;
    double *plain;     /* derivatives of the FMU */
    size_t *place;     /* of each law's state among the active ones */
    size_t n_inner;    /* of all laws */
} Laws;

/* A direction in which parameters move: an instance in which they are `size` further along it. */
typedef struct {
    Instance instance;
    double size, *parameter, *s; /* ... the laws' parameters there, and the derivatives of the states along the direction */
} Direction;

typedef struct {
    Plan plan;         /* first, so that a pointer to it leads to the laws */
    Laws laws;
    size_t n_added;    /* states of the active laws */
    size_t n_directions;
    Direction *direction;
    double *room;      /* scratch of the variational equations ... */
    int32_t *pivots;
} PlanWithLaws;

enum { STAGES = 3 }; /* of the variational equations' method */
#define ROOM(n, directions) (STAGES * (n) * (STAGES * (n) + (directions) + 2) + (n))

int read_double(FILE *file, double *value);
int read_laws(Laws *laws, FILE *file, size_t n_states, size_t n_scalars);
void free_laws(Laws *laws);
size_t activate_laws(Laws *laws, const Direction *directions, size_t n); /* number of states that the active ones have */
PlanWithLaws aside_of(const Plan *plan, const Direction *direction);
void start_directions(Plan *plan);
int32_t move_aside(PlanWithLaws *aside, const Direction *direction);

#endif
