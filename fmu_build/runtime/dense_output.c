/* The solution between the ends of a step of Rodas5P (see integrator.c). */
#include <string.h>

#include "model.h"
#include "instance.h"

static const double H[3][8] = {
    {25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204, 0.524948541321073,
     1.1241088310450404, 0.4272876194431874, -0.17202221070155493},
    {-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796, 20.176138334709044,
     15.98066361424651, -6.789040303419874, -6.710236069923372},
    {11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643, -52.072871366152654,
     -59.78993625266729, -0.15582684282751913, 4.883087185713722},
};

void dense_output(const Step *step, double t, double *x) {
    if (t >= step->t0 + step->h || step->h <= 0.0) {
        memcpy(x, step->x1, NX * sizeof *x);
        return;
    }
    const double r = (t - step->t0) / step->h, q = 1.0 - r;
    double weight[STAGES];
    for (int j = 0; j < STAGES; j++) weight[j] = r * q * (H[0][j] + r * (H[1][j] + r * H[2][j]));
    for (int i = 0; i < NX; i++) {
        double sum = 0.0;
        for (int j = 0; j < STAGES; j++) sum += weight[j] * step->k[j][i];
        x[i] = q * step->x0[i] + r * step->x1[i] + sum;
    }
}
