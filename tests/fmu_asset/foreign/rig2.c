/* FMI 2.0 co-simulation: a mass on a spring with viscous damping, exact while the force is held. A cubic spring
   or a stop beside it makes it nonlinear (Runge-Kutta then). */
#include <math.h>
#include "model.h"
enum { X, V, STRAIN, FORCE, STIFFNESS, DAMPING, RELEASE, SPEED, CUBIC };
#define MASS 2.0
#define RIGIDITY 1974.0
void model_start(Model *m) { m->r[STIFFNESS] = m->r[DAMPING] = 1.0; }
int model_initialise(Model *m) {
    m->r[X] = m->r[RELEASE];
    m->r[V] = m->r[SPEED];
    return OK;
}
static double rigidity(Model *m) { return RIGIDITY * m->r[STIFFNESS]; }
static double damping(Model *m) { return 2.0 * 0.01 * sqrt(rigidity(m) * MASS) * m->r[DAMPING]; }
static double acceleration(Model *m, double x, double v) {
    return (m->r[FORCE] - rigidity(m) * x - m->r[CUBIC] * x * x * x - damping(m) * v) / MASS;
}
static void exact(Model *m, double h) {
    double w = sqrt(rigidity(m) / MASS), d = damping(m) / (2.0 * MASS), wd = sqrt(w * w - d * d);
    double still = m->r[FORCE] / rigidity(m), x = m->r[X] - still, v = m->r[V];
    double c = cos(wd * h), s = sin(wd * h), e = exp(-d * h);
    m->r[X] = still + e * (x * c + (v + d * x) / wd * s);
    m->r[V] = e * (v * c - (d * v + w * w * x) / wd * s);
}
static void runge_kutta(Model *m, double h) {
    double x = m->r[X], v = m->r[V];
    double k1 = acceleration(m, x, v), v2 = v + h / 2 * k1, x2 = x + h / 2 * v;
    double k2 = acceleration(m, x2, v2), v3 = v + h / 2 * k2, x3 = x + h / 2 * v2;
    double k3 = acceleration(m, x3, v3), v4 = v + h * k3, x4 = x + h * v3;
    m->r[X] += h / 6 * (v + 2 * v2 + 2 * v3 + v4);
    m->r[V] += h / 6 * (k1 + 2 * k2 + 2 * k3 + acceleration(m, x4, v4));
}
int model_step(Model *m, double time, double size) {
    if (m->r[CUBIC] == 0.0) exact(m, size);
    else for (int k = 0; k < 4; k++) runge_kutta(m, size / 4);
    return OK;
}
void model_outputs(Model *m) { m->r[STRAIN] = 0.0375 * m->r[X]; }
