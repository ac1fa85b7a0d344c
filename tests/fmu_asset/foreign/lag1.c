/* FMI 1.0 co-simulation as block-diagram tools export it: no units, names with blanks and brackets.
   A first-order lag, exact for inputs that are held over the step. */
#include <math.h>
#include "model.h"
enum { Y, U, GAIN, TIME_CONSTANT };
void model_start(Model *m) { m->r[GAIN] = 2.0; m->r[TIME_CONSTANT] = 0.5; }
int model_step(Model *m, double time, double size) {
    if (!m->b[0]) m->r[Y] += (m->r[GAIN] * m->r[U] - m->r[Y]) * (1.0 - exp(-size / m->r[TIME_CONSTANT]));
    m->i[0]++;
    if (m->r[U] > 1e3) { model_say(m, ERROR, "In1 (rad/s) saturates"); return ERROR; }
    return OK;
}
