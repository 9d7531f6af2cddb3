/* The one file of the runtime that is compiled for each model: it hands the others what was generated for the model. */
#include <stddef.h>

#include "model.h"
#include "model_config.h"
#include "model_data.h"

#define PATTERN(m)                                                                                                  \
    {MODEL_##m##_N, MODEL_##m##_DENSE, MODEL_##m##_NONZEROS, MODEL_##m##_FACTORS, MODEL_##m##_FILLED,               \
     MODEL_##m##_START, MODEL_##m##_ROW, MODEL_##m##_DIAGONAL, MODEL_##m##_COLUMN, MODEL_##m##_PLACE,               \
     MODEL_##m##_LU_START, MODEL_##m##_LU_DIAGONAL, MODEL_##m##_LU_ROW, MODEL_##m##_LU_UPDATED, MODEL_GROWTH,       \
     MODEL_##m##_FACTOR_CODE, MODEL_##m##_SOLVE_CODE}

static const VariableEntry VARIABLES[] = MODEL_VARIABLES;
static const double P_START[] = MODEL_P_START, U_START[] = MODEL_U_START, CONSTANTS[] = MODEL_CONSTANTS;
static const double X_SCALE[] = MODEL_X_SCALE;
static const char *const X_NAME[] = MODEL_X_NAME;

const Model model = {
    .identifier = MODEL_IDENTIFIER, .guid = MODEL_GUID, .default_tolerance = MODEL_TOLERANCE,
    .nx = MODEL_NX, .nu = MODEL_NU, .np = MODEL_NP, .nd = MODEL_ND, .nz = MODEL_NZ, .ndelay = MODEL_NDELAY,
    .ntransport = MODEL_NTRANSPORT, .nm = MODEL_NM, .ny = MODEL_NY, .nv = MODEL_NV,
    .has_events = MODEL_HAS_EVENTS, .has_integers = MODEL_HAS_INTEGERS, .has_initial = MODEL_HAS_INITIAL,
    .sz_arg = MODEL_SZ_ARG, .sz_res = MODEL_SZ_RES, .sz_w = MODEL_SZ_W,
    .n_variables = MODEL_N_VARIABLES, .variables = VARIABLES,
    .p_start = P_START, .u_start = U_START, .constants = CONSTANTS,
    .x_name = X_NAME, .x_scale = X_SCALE, .y_nominal = MODEL_Y_NOMINAL,
    .inclusive = MODEL_INCLUSIVE, .group = MODEL_GROUP,
    .n_asserts = MODEL_NASSERT, .n_shown = MODEL_NSHOWN, .assert_is_warning = MODEL_ASSERT_WARNING, .shown = MODEL_SHOWN,
    .assert_message = MODEL_ASSERT_MESSAGE,
    .n_slopes = MODEL_NSLOPE, .n_elements = MODEL_NELEMENT, .few_slopes = MODEL_FEW_SLOPE, .few_elements = MODEL_FEW_ELEMENT,
    .n_output_slopes = MODEL_NOUTPUT_SLOPE, .n_constant_slopes = MODEL_NCONSTANT_SLOPE,
    .slope_row = MODEL_SLOPE_ROW, .slope_column = MODEL_SLOPE_COLUMN, .variable_row = MODEL_VARIABLE_ROW,
    .variable_column = MODEL_VARIABLE_COLUMN, .is_output = MODEL_OUTPUT, .is_linear = MODEL_LINEAR,
    .constant_slope = MODEL_CONSTANT,
    .n_switches = MODEL_NSWITCH,
    .n_points = MODEL_NPOINT, .points = MODEL_POINT,
    .J = PATTERN(J), .R = PATTERN(R), .I = PATTERN(I),
};
