/* FMI 3.0 co-simulation with a structural parameter n: y[n] sums w[i] u[i] over the steps, total all of y. */
#include "model.h"
enum { MOST = 8, Y = 0, U = MOST, W = 2 * MOST, TOTAL = 3 * MOST };
/* integers: n at 0 (reference 100), whether it is configured at 1 (reference 101) */
static int length;
int model_locate(unsigned int reference, int *first, int *count) {
    static const int begin[] = {0, Y, U, W, TOTAL};
    if (reference > 4) return 0;
    *first = begin[reference];
    *count = reference == 4 ? 1 : length;
    return 1;
}
void model_start(Model *m) {
    m->i[0] = length = 2;
    for (int k = 0; k < MOST; k++) m->r[W + k] = k + 1;
}
int model_configure(Model *m, int begins) {
    m->i[1] = begins;
    if (m->i[0] < 0 || m->i[0] > MOST) return ERROR;
    length = m->i[0];
    return OK;
}
int model_step(Model *m, double time, double size) {
    m->r[TOTAL] = 0.0;
    for (int k = 0; k < length; k++) {
        m->r[Y + k] += m->r[W + k] * m->r[U + k];
        m->r[TOTAL] += m->r[Y + k];
    }
    return OK;
}
