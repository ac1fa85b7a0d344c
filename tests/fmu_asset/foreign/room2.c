/* FMI 2.0 co-simulation as Modelica tools export it: der(), quoted names, aliases, display units, enumerations.
   A heated room, exact for inputs that are held over the step. */
#include <math.h>
#include "model.h"
enum { T, POWER, AMBIENT, DERIVATIVE };
static const double capacity = 5.0e4, conductance = 100.0;
void model_start(Model *m) { m->r[T] = 293.15; m->r[AMBIENT] = 283.15; m->b[0] = 1; m->i[0] = 1; }
static double power(const Model *m) { return m->b[0] ? (m->i[0] == 2 ? 0.5 : 1.0) * m->r[POWER] : 0.0; }
int model_step(Model *m, double time, double size) {
    double steady = m->r[AMBIENT] + power(m) / conductance;
    m->r[T] = steady + (m->r[T] - steady) * exp(-size * conductance / capacity);
    return OK;
}
void model_outputs(Model *m) { m->r[DERIVATIVE] = (power(m) - conductance * (m->r[T] - m->r[AMBIENT])) / capacity; }
