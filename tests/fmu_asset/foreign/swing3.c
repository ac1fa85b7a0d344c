/* FMI 3.0 model exchange with a vector of states and a time event: x'' = -w^2 (x - a), and a becomes 1 at t = 1. */
#include "model.h"
static const struct { unsigned int reference; int first, count; } places[] = {
    {1, 0, 2}, {2, 2, 2}, {3, 4, 1}, {4, 5, 1}};
int model_locate(unsigned int reference, int *first, int *count) {
    for (size_t k = 0; k < sizeof places / sizeof places[0]; k++)
        if (places[k].reference == reference) { *first = places[k].first; *count = places[k].count; return 1; }
    return 0;
}
void model_start(Model *m) { m->r[0] = 0.5; m->r[4] = 2.0; }
void model_derivatives(Model *m, double *dx) {
    dx[0] = m->r[1];
    dx[1] = -m->r[4] * m->r[4] * (m->r[0] - m->r[5]);
}
void model_event(Model *m, int *due, double *time) {
    if (m->time >= 1.0 - 1e-12) m->r[5] = 1.0;
    *due = m->time < 1.0 - 1e-12;
    *time = 1.0;
#ifdef ENDS
    m->i[14] = !*due;
#endif
}
