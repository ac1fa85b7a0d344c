/* Transient response by modes, Kapteyn et al. 2021, eq. (12): exact for a load that is linear in time, for any
   damping ratio. Modes that are not kept follow the load without delay (static correction). */
#ifndef WING_TRANSIENT_H
#define WING_TRANSIENT_H

#include "wing_modes.h"
#include "wing_static.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* All that is derived from one state of health, mass and damping. */
typedef struct {
    const wing_model *model;
    wing_static steady;
    wing_modes modes;
    double *damping_ratio; /* (M), eq. (18) */
    double *modal_static;  /* (2, M) modal coordinates at rest under one unit of each load */
    double *correction;    /* (2, G + 1) what the modes that are not kept contribute, per unit of load */
    double duration;       /* of the propagator; 0 if there is none */
    double *propagator;    /* (4, M): q from q and q', q' from q and q' */
    double *work;          /* (M + 2 Nm + N) */
} wing_integrator;

/* All that the wing remembers between two steps. */
typedef struct {
    double *displacement; /* (M) modal coordinates q */
    double *velocity;     /* (M) their rates */
    double load[WING_LOADS];
} wing_motion;

void wing_integrator_lay_out(wing_integrator *integrator, const wing_model *model, wing_arena *arena);
void wing_motion_lay_out(wing_motion *motion, const wing_model *model, wing_arena *arena);

/* Write the damping ratios of eq. (18) at the modes that were found. */
void wing_integrator_damp(wing_integrator *integrator, double alpha, double beta);

/* Take a state of health (e and the losses), mass and damping. */
bool wing_integrator_prepare(wing_integrator *integrator, const double *key, double alpha,
                             double beta, wing_problem *problem);

/* The motion just after a tip that was held aside by a tip force is let go. */
void wing_integrator_release(wing_integrator *integrator, double tip_displacement,
                             const double load[WING_LOADS], wing_motion *motion);

/* Carry a motion over a duration in which the load is held. */
void wing_integrator_advance(wing_integrator *integrator, const wing_motion *before, double duration,
                             const double load[WING_LOADS], wing_motion *after);

/* Express a motion in the modes of this integrator after a change of health: displacement and velocity of the
   structure stay, projected with the mass matrix. */
void wing_integrator_take_over(wing_integrator *integrator, wing_integrator *former, const wing_motion *before,
                               wing_motion *after);

/* Write strains and tip displacement (G + 1). */
void wing_integrator_output(const wing_integrator *integrator, const wing_motion *motion, double *output);

/* Displacement of the point where the tip force acts [m]. */
double wing_integrator_load_point(wing_integrator *integrator, const wing_motion *motion);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
