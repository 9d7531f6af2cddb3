/* The one loop of sensitivities that is worth the processor's vectors: over a fixed number of directions. */
#include "rows.h"

void solve_slice(const struct Sensitivity *q, size_t n, double *y, double *to) { solve_rows(q, SLICE, n, y, to); }
