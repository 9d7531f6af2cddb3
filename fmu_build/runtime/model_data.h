/* What the runtime knows of a model: sizes, tables and functions, filled in by model_data.c. All other files of the
 * runtime are the same for every model. */
#ifndef FMUID_MODEL_DATA_H
#define FMUID_MODEL_DATA_H

#include "linear.h"
#include "variables.h"

#ifndef casadi_int
#define casadi_int long long int
#endif

#ifdef __GNUC__
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    const char *identifier, *guid;
    double default_tolerance;
    int nx, nu, np, nd, nz, ndelay, ntransport, nm, ny, nv; /* see fmu_build/model.py */
    int has_events, has_integers, has_initial, sz_arg, sz_res, sz_w;
    int n_variables;
    const VariableEntry *variables;
    const double *p_start, *u_start, *constants;
    const char *const *x_name;
    const double *x_scale, *y_nominal; /* x_scale: 0 where no nominal value is given */
    const int *inclusive, *group;      /* of relations */
    int n_asserts, n_shown;
    const int *assert_is_warning, *shown;
    const char *const *assert_message;
    /* derivatives that sensitivities follow from */
    int n_slopes, n_elements, few_slopes, few_elements, n_output_slopes, n_constant_slopes;
    const int *slope_row, *slope_column, *variable_row, *variable_column, *is_output, *is_linear;
    const double *constant_slope;
    int n_switches;
    int n_points; /* of initial contents of spatialDistribution() */
    const double *points;
    Pattern J, R, I; /* matrices of integrator and sensitivities, of algebraic loops, of initial equations */
} Model;

extern const Model model;

/* A file that includes model.h before is compiled for each model, with constant sizes: for small models its loops then
 * take two thirds of the time. */
#ifdef MODEL_NX
enum { NX = MODEL_NX, NU = MODEL_NU, NM = MODEL_NM, NY = MODEL_NY, NDELAY = MODEL_NDELAY, NTRANSPORT = MODEL_NTRANSPORT };
#define SZ_RES MODEL_SZ_RES
#define SIZE(m) MODEL_##m##_N
#define DENSE(m) MODEL_##m##_DENSE
#else
#define NX (model.nx)
#define NU (model.nu)
#define NM (model.nm)
#define NY (model.ny)
#define NDELAY (model.ndelay)
#define NTRANSPORT (model.ntransport)
#define SZ_RES (model.sz_res)
#define SIZE(m) (model.m.n)
#define DENSE(m) (model.m.dense)
#endif
#define NP (model.np)
#define ND (model.nd)
#define NZ (model.nz)
#define NV (model.nv)
/* Behind the inputs in u: the values of delay(); what leaves spatialDistribution() at both ends, slopes, places, jumps. */
#define NIN (NU - NDELAY - 8 * NTRANSPORT)
#define OUTLETS (NIN + NDELAY)
#define NHELD (NDELAY + 2 * NTRANSPORT) /* values among these */
#define NPAST (NDELAY + 3 * NTRANSPORT) /* what is remembered */
#define NDELAYED (NPAST + NDELAY + 2 * (model.n_points - 1) * NTRANSPORT) /* with delays and initial contents */
#define FACTORISE(m, a, f) factorise(SIZE(m), DENSE(m), &model.m, a, f)
#define SOLVE(m, f, b) solve(SIZE(m), DENSE(m), &model.m, f, b)

typedef int ModelFunction(const double **arg, double **res, casadi_int *iw, double *w, int mem);
ModelFunction model_dependent, model_start, model_initial, model_derivatives, model_jacobian, model_loop, model_slopes;
ModelFunction model_element_slopes, model_output_slopes, model_variables, model_move_partials, model_partials;
ModelFunction model_variable_partials, model_loop_partials, model_dependent_partials, model_start_partials;
ModelFunction model_initial_partials, model_indicator_partials, model_update_partials, model_indicators, model_update;
ModelFunction model_asserts, model_messages, model_moved, model_delayed, model_delayed_partials, model_switches;
int model_laws(const double *p, casadi_int *iw, double *w);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif
