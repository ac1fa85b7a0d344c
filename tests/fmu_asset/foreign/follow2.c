/* x' = u - x, exact for an input that moves in a straight line: co-simulation of FMI 2.0 or 1.0, and model exchange. */
#include <math.h>
#include "model.h"
enum { X, U, SEEN, SLOPE, START };
int model_initialise(Model *m) { m->r[X] = m->r[START]; return OK; }
int model_input_slope(Model *m, unsigned int reference, double slope) {
    if (reference != U) return ERROR;
    m->r[SLOPE] = slope;
    return OK;
}
int model_step(Model *m, double time, double size) {
    double lost = 1.0 - exp(-size);
    m->r[SEEN] = m->r[U];
    m->r[X] += lost * (m->r[U] - m->r[X]) + m->r[SLOPE] * (size - lost);
    m->r[U] += m->r[SLOPE] * size;
    return OK;
}
void model_derivatives(Model *m, double *dx) { dx[0] = m->r[U] - m->r[X]; }
/* counts the events that the host makes */
void model_event(Model *m, int *due, double *time) { m->i[0]++; }
