/* FMI 2.0 co-simulation: a mass on a spring, pulled by a force, with friction if -DFRICTION says so. */
#include "model.h"
enum { POSITION, VELOCITY, FORCE, STIFFNESS };

#ifndef FRICTION
#define FRICTION 0.0
#endif
void model_start(Model *m) { m->r[POSITION] = 1.0; m->r[STIFFNESS] = 4.0; }
int model_step(Model *m, double time, double size) {
    for (int k = 0; k < 100; k++) {
        m->r[VELOCITY] += (m->r[FORCE] - m->r[STIFFNESS] * m->r[POSITION] - FRICTION * m->r[VELOCITY]) * size / 100;
        m->r[POSITION] += m->r[VELOCITY] * size / 100;
    }
    return OK;
}
