/* The first undamped eigenmodes at one state, Kapteyn et al. 2021, eq. (16). */
#ifndef WING_MODES_H
#define WING_MODES_H

#include "wing_model.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Room for a key: e, the losses, servo mass [kg], pitot mass [kg]. */
#define WING_MOST_KEYS (WING_MOST_REGIONS + 3)

typedef struct {
    const wing_model *model;
    bool known;
    double key[WING_MOST_KEYS];
    double *angular_frequency; /* (M) rad/s, ascending */
    double *shape;             /* (M, Nm), mass-normalised, the tip moves upwards */
    double *output;            /* (M, G + 1) per unit of modal coordinate */
    double *participation;     /* (M, 2) modal force per unit of load */
    double *mass;              /* (Nm, Nm) */
    double *factor, *matrix, *vectors; /* (Nm, Nm) */
    double *values, *work;     /* (Nm), (3 Nm) */
} wing_modes;

void wing_modes_lay_out(wing_modes *modes, const wing_model *model, wing_arena *arena);

/* Find the modes; does nothing if the key is that of the last call. */
bool wing_modes_find(wing_modes *modes, const double *key, wing_problem *problem);

/* result (M) = shape' M u for displacements u = modal (Nm) in the modal plus static (N) in the static basis;
   `work` has room for Nm doubles. */
void wing_modes_project(const wing_modes *modes, const double *modal, const double *static_part, double *result,
                        double *work);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
