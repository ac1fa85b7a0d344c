/* FMI 2.0 model exchange with state events: a ball that bounces. */
#include "model.h"
enum { HEIGHT, VELOCITY, GRAVITY, RESTITUTION };
void model_start(Model *m) { m->r[HEIGHT] = 1.0; m->r[GRAVITY] = 9.81; m->r[RESTITUTION] = 0.7; }
void model_derivatives(Model *m, double *dx) { dx[0] = m->r[VELOCITY]; dx[1] = -m->r[GRAVITY]; }
void model_event_indicators(Model *m, double *z) { z[0] = m->r[HEIGHT]; }
void model_event(Model *m, int *due, double *time) {
    if (m->r[HEIGHT] <= 0.0 && m->r[VELOCITY] < 0.0) {
        m->r[HEIGHT] = 1e-12;
        m->r[VELOCITY] *= -m->r[RESTITUTION];
        m->i[0]++;
#ifdef ENDS
        m->i[14] = m->i[0] == 2;
#endif
    }
}
