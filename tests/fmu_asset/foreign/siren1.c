/* FMI 1.0 co-simulation. A siren: its loudness is an enumeration, its label a text; how much of it is broken is a fixed parameter.
   It counts its steps since its start, and tells when that was. */
#include <string.h>
#include "model.h"
enum { Y, BROKEN, U, LENGTH, STEPS, BEGAN };
void model_start(Model *m) {
    m->r[U] = 1.0;
    m->i[0] = m->i[1] = 1;
}
int model_initialise(Model *m) {
    m->r[BEGAN] = m->time;
    return OK;
}
int model_take_text(Model *m, unsigned int reference, const char *text) {
    m->r[LENGTH] = strlen(text);
    return OK;
}
int model_step(Model *m, double time, double size) {
    m->r[Y] = (m->i[0] == 3 || m->i[1] == 3 ? 10.0 : 1.0) * (1.0 - m->r[BROKEN]) * m->r[U] + m->r[LENGTH];
    m->r[STEPS] += 1.0;
    return OK;
}
