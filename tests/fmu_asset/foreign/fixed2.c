/* FMI 2.0 co-simulation with a fixed step of 0.01 s, as controllers are exported: any other is an error. */
#include <math.h>
#include "model.h"
enum { Y, U };
int model_step(Model *m, double time, double size) {
    if (fabs(size - 0.01) > 1e-9) {
        model_say(m, ERROR, "the sample time is 0.01 s");
        return ERROR;
    }
    m->r[Y] += m->r[U] * 0.01;
    m->i[0]++;
    return m->r[Y] > 1e6 ? DISCARD : OK;
}
