/* What every plant in C is made of. Nothing here knows a model or the diagnosis. */
#ifndef PLANT_H
#define PLANT_H
#define _GNU_SOURCE /* for M_PI */
#include <math.h>

#define MOST_STATES 32
#define HIDDEN 3 /* states that one extra may have */

/* What a plant has beyond its model. */
typedef struct {
    double kind;  /* its place in the list of `extra_name` */
    double place; /* number of the place where it acts, in the plant's own count */
    double size;
    double shape; /* a speed, distance, time, order or frequency, as its kind needs it */
    double rate, range, duration; /* usual speed and excursion at the place, length of a run */
} Extra;

/* A moment of a run. */
typedef struct {
    const double *p, *u;
    const Extra *extras;
    int count;
    double t, zero; /* of the potential that stores are at in the beginning */
    const double *z;
    double *dz;
} Moment;

typedef struct {
    int states, inputs, outputs;
    void (*start)(const Moment *at, double *x);
    void (*slope)(const Moment *at, const double *x, double *dx);
    void (*read)(const Moment *at, const double *x, double *y);
} Plant;

/* Flow that leaves a place: p is its potential (of a branch the difference), v its rate, load a force beside it. */
double extra_flow(const Moment *at, int place, double p, double v, double load);

/* Deflection that is left behind play. */
double after_play(const Moment *at, int place, double stretch);

/* One-sided stop: what is beyond it. */
static inline double beyond(double x, double limit) { return x > limit ? x - limit : x < -limit ? x + limit : 0.0; }

extern const Plant belt_axis, thermal_block, circuit, tanks;
#endif
