/* FMI 1.0 model exchange: x' = u - k x. */
#include "model.h"
enum { X, U, K };
void model_start(Model *m) { m->r[X] = 1.0; m->r[K] = 1.0; }
void model_derivatives(Model *m, double *dx) { dx[0] = m->r[U] - m->r[K] * m->r[X]; }
#ifdef ENDS
void model_event(Model *m, int *due, double *time) {
    m->i[14] = m->time >= 1.0 - 1e-12;
    *due = !m->i[14];
    *time = 1.0;
}
#endif
