/* Transient response by modes, Kapteyn et al. 2021, eq. (12): exact for a load that is held or linear in time, for any
   damping ratio. Modes that are not kept follow the load without delay (static correction). */
#ifndef STRUCTURE_TRANSIENT_H
#define STRUCTURE_TRANSIENT_H

#include "structure_modes.h"
#include "structure_static.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* All that is derived from one state of health, mass and damping. */
typedef struct {
    const structure_model *model;
    structure_static steady;
    structure_modes modes;
    double *damping_ratio; /* (M), eq. (18) */
    double *modal_static;  /* (L, M) modal coordinates at rest under one unit of each load */
    double *correction;    /* (L, O) what the modes that are not kept contribute, per unit of load */
    double duration;       /* of the propagator; 0 if there is none */
    double *propagator;    /* (4, M): q from q and q', q' from q and q' */
    double *work;          /* (M + 2 Nm + N) */
} structure_integrator;

/* All that the structure remembers between two steps. */
typedef struct {
    double *displacement; /* (M) modal coordinates q */
    double *velocity;     /* (M) their rates */
    double *load;         /* (L) coefficients of the loads */
} structure_motion;

void structure_integrator_lay_out(structure_integrator *integrator, const structure_model *model, structure_arena *arena);
void structure_motion_lay_out(structure_motion *motion, const structure_model *model, structure_arena *arena);

/* Write the damping ratios of eq. (18) at the modes that were found. */
void structure_integrator_damp(structure_integrator *integrator, double alpha, double beta);

/* Take parameters, losses, masses (the first of what can be chosen) and damping. */
bool structure_integrator_prepare(structure_integrator *integrator, const double *chosen, double alpha, double beta,
                                  structure_problem *problem);

/* The motion at rest under a load, but for the last output: a force, the load of index `point`, held that aside and
   lets it go. */
void structure_integrator_release(structure_integrator *integrator, size_t point, double displacement,
                                  const double *load, structure_motion *motion);

/* Carry a motion over a duration in which the load is held, or, where `begin` is given, moves from there to `load` in
   a straight line. */
void structure_integrator_advance(structure_integrator *integrator, const structure_motion *before, double duration,
                                  const double *begin, const double *load, structure_motion *after);

/* Express a motion in the modes of this integrator after a change of health: displacement and velocity of the
   structure stay, projected with the mass matrix. */
void structure_integrator_take_over(structure_integrator *integrator, structure_integrator *former, const structure_motion *before,
                               structure_motion *after);

/* Second derivative of one modal coordinate. */
double structure_integrator_acceleration(const structure_integrator *integrator, const structure_motion *motion,
                                         size_t mode);

/* Write strains and displacements (O), then the accelerations of the kept modes. */
void structure_integrator_output(const structure_integrator *integrator, const structure_motion *motion, double *output);

/* Write the derivatives of the outputs with respect to one control of the loads, the motion of the modes being given,
   of the displacement along the load of index `point`, and of the rates (2 M) of modal coordinates and velocities. */
void structure_integrator_derivative(structure_integrator *integrator, const double *chosen, size_t which, size_t point,
                                     double *output, double *load_point, double *rates);

/* The same with respect to one modal coordinate, or from M on one of their rates. */
void structure_integrator_state_derivative(const structure_integrator *integrator, size_t state, size_t point,
                                           double *output, double *load_point, double *rates);

/* Displacement along the load of index `point` at its point [m]. */
double structure_integrator_load_point(structure_integrator *integrator, size_t point,
                                       const structure_motion *motion);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
