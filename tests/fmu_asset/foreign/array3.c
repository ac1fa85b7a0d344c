/* FMI 3.0 co-simulation with arrays: y = gain A u + offset, summed over the steps while active. */
#include "model.h"
/* r: y[2] at 0, u[3] at 2, A[2][3] at 5, gain at 11 */
static const struct { unsigned int reference; int first, count; } places[] = {
    {1, 0, 2}, {2, 2, 3}, {3, 5, 6}, {4, 11, 1}, {0, 12, 1}};
int model_locate(unsigned int reference, int *first, int *count) {
    for (size_t k = 0; k < sizeof places / sizeof places[0]; k++)
        if (places[k].reference == reference) { *first = places[k].first; *count = places[k].count; return 1; }
    return 0;
}
void model_start(Model *m) {
    for (int k = 0; k < 6; k++) m->r[5 + k] = k + 1;
    m->r[11] = 1.0;
    m->b[0] = 1;
}
int model_step(Model *m, double time, double size) {
    for (int row = 0; row < 2 && m->b[0]; row++) {
        double sum = 0.0;
        for (int column = 0; column < 3; column++) sum += m->r[5 + 3 * row + column] * m->r[2 + column];
        m->r[row] += m->r[11] * sum + m->i[0];
    }
    m->i[1]++;
    return OK;
}
int model_finished(Model *m) { return m->i[0] == 99; }
int model_early(Model *m) { return m->i[0] == 98; }
