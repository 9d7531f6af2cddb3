/* How value references lead to the vectors of a model. */
#ifndef FMUID_VARIABLES_H
#define FMUID_VARIABLES_H

typedef enum { VECTOR_T, VECTOR_X, VECTOR_DX, VECTOR_U, VECTOR_P, VECTOR_D, VECTOR_Z, VECTOR_Y, VECTOR_V,
               VECTOR_G, VECTOR_CONSTANT } Vector;
typedef enum { TYPE_REAL, TYPE_INTEGER, TYPE_BOOLEAN } VariableType;
typedef enum { SETTABLE_NO, SETTABLE_INPUT, SETTABLE_FIXED, SETTABLE_TUNABLE, SETTABLE_START } Settable;
typedef struct {
    Vector vector;
    int index;
    int sign;
    VariableType type;
    Settable settable;
    const char *name;
} VariableEntry;

#endif
