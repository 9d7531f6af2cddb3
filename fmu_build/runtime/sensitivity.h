/* Forward sensitivities of a whole run, exported beside the FMI functions (for either version of FMI).
 *
 * fmuidSetSensitivityParameters chooses, before the end of the initialization mode, the parameters (and start values
 * of states) to differentiate by; they last until the instance is reset. fmuidSetSensitivityDirections does the same
 * where parameters move together: direction j moves parameter i by weights[j * n_parameters + i].
 * fmuidGetSensitivities then gives, at every communication point of a co-simulation, the total derivatives of variables
 * with respect to them: values[i * n_parameters + j] = d variable[i] / d parameter[j], inputs as they were set.
 * fmuidSetInputDirections says how inputs move with the same directions from the present communication point on, for
 * inputs that follow another model: direction j moves input i by seeds[i * n + j], and by rates[i * n + j] more each
 * second until they are given anew. Inputs that it does not name do not move.
 * All return an FMI status and log what is wrong.
 *
 * fmuidSetPatience lets a communication step of an instance take so many seconds of processor time; any, if infinite. */
#ifndef FMUID_SENSITIVITY_H
#define FMUID_SENSITIVITY_H

#include <stddef.h>

#if defined _WIN32 || defined __CYGWIN__
#define FMUID_EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define FMUID_EXPORT __attribute__((visibility("default")))
#else
#define FMUID_EXPORT
#endif

FMUID_EXPORT int fmuidSetSensitivityParameters(void *instance, const unsigned *parameters, size_t n);
FMUID_EXPORT int fmuidSetSensitivityDirections(void *instance, const unsigned *parameters, size_t n_parameters,
                                               const double *weights, size_t n);
FMUID_EXPORT int fmuidSetInputDirections(void *instance, const unsigned *inputs, size_t n_inputs, const double *seeds,
                                          const double *rates);
FMUID_EXPORT int fmuidGetSensitivities(void *instance, const unsigned *variables, size_t n, double *values);
FMUID_EXPORT void fmuidSetPatience(void *instance, double seconds);

#endif
