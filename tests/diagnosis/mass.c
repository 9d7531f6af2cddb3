/* A driven mass with friction, by explicit Euler steps: see plants.py. */
#include <math.h>

/* p: m, d, Fc, a, square, grip, hill, and what is constant; rows[k] gets x and v at time[k]. */
void mass_run(const double *p, const double *time, const double *u, const double *port, long n, double longest,
              double *rows) {
    const double m = p[0], d = p[1], fc = p[2], a = p[3], square = p[4], grip = p[5], hill = p[6], constant = p[7];
    double x = 0.0, v = 0.0;
    rows[0] = rows[1] = 0.0;
    for (long k = 0; k + 1 < n; k++) {
        const double step = time[k + 1] - time[k];
        const long count = (long)ceil(step / longest - 1e-9);
        const double h = step / count;
        for (long i = 0; i < count; i++) {
            const double s = tanh(v / 0.02), place = x - 0.3 * floor(x / 0.3);
            const double dry = fc + (0.1 < place && place < 0.15 ? grip : 0.0);
            double force = u[k] - d * v - dry * s - a * fabs(s) - constant - square * v * fabs(v) - port[k];
            force -= fabs(x) < 1e9 ? hill * sin(8.0 * x) : 0.0;
            v += h * force / m;
            x += h * v;
        }
        rows[2 * k + 2] = x;
        rows[2 * k + 3] = v;
    }
}
