/* The first undamped eigenmodes at one state, Kapteyn et al. 2021, eq. (16). */
#ifndef STRUCTURE_MODES_H
#define STRUCTURE_MODES_H

#include "structure_model.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    const structure_model *model;
    bool known, basis_known;
    double *key;               /* parameters, losses and masses of these modes */
    double *basis_key;         /* the same of the basis, without losses */
    double *theta;             /* (T) */
    double *mass_theta;        /* (1 + P) */
    double *angular_frequency; /* (M) rad/s, ascending */
    double *shape;             /* (M, Nm), mass-normalised, the last output is not negative */
    double *output;            /* (M, O and accelerations) per unit of modal coordinate */
    double *participation;     /* (M, L) modal force per unit of load */
    double *mass;              /* (Nm, Nm) */
    double *cross_mass;        /* (N, Nm) between the static and the modal basis */
    double *factor;            /* of the stiffness without a loss, padded */
    double *basis;             /* (Nm, Nm) all modes without a loss, by which the others are found */
    double *stiffness;         /* (1 + damaged terms, Nm, Nm) in it, first what no loss changes */
    double *present;           /* (Nm, Nm) their sum */
    double *images;            /* (2, M, Nm) */
    double *matrix, *vectors;  /* (Nm, Nm) */
    double *values, *work;
} structure_modes;

void structure_modes_lay_out(structure_modes *modes, const structure_model *model, structure_arena *arena);

/* Find the modes; does nothing if parameters, losses and masses are those of the last call. */
bool structure_modes_find(structure_modes *modes, const double *chosen, structure_problem *problem);

/* Derivative of the square of the angular frequency of a mode with respect to one of what can be chosen, of which
   `chosen` holds the values: x' (dK - omega^2 dM) x. */
double structure_modes_square_derivative(const structure_modes *modes, size_t mode, const double *chosen, size_t which);

/* result (M) = shape' M u for displacements u = modal (Nm) in the modal plus static (N), if not NULL, in the static basis;
   `work` has room for Nm doubles. */
void structure_modes_project(const structure_modes *modes, const double *modal, const double *static_part, double *result,
                        double *work);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
