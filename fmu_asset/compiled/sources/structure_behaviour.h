/* What a structure does in one communication step: equilibrium, or its modes integrated in time.

   A function either completes or returns false and leaves everything as it was. */
#ifndef STRUCTURE_BEHAVIOUR_H
#define STRUCTURE_BEHAVIOUR_H

#include "structure_transient.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    double damping_alpha; /* 1/s */
    double damping_beta;  /* s */
    bool transient;
    /* Of a release: how far the last output is held aside by the load of index `point` [m]. */
    double displacement;
    size_t point;
} structure_parameters;

typedef struct {
    const structure_model *model;
    bool started;
    bool moving; /* transient */
    structure_parameters parameters;
    double *chosen; /* (V) all that can be chosen, of the last step */
    double *load;   /* (L) coefficients of the loads, of the call at hand */
    /* The integrator in use, and the one that takes over when health changes; motions alike. */
    structure_integrator integrators[2];
    structure_motion motions[2];
    size_t integrator;
    size_t motion;
    double *rates; /* (2 M) derivatives of the rates, of the call at hand */
    double *memory;
} structure_behaviour;

/* Make a structure that is not started. On success the caller frees it with `structure_behaviour_free`. */
bool structure_behaviour_make(structure_behaviour *behaviour, const structure_model *model,
                              structure_problem *problem);

void structure_behaviour_free(structure_behaviour *behaviour);

/* Forget the simulation; what is derived from parameters is kept, since it does not depend on the past. */
void structure_behaviour_reset(structure_behaviour *behaviour);

/* Find the initial state and its outputs: strains, displacements, accelerations. */
bool structure_behaviour_start(structure_behaviour *behaviour, const structure_parameters *parameters,
                               const double *chosen, double *output, structure_problem *problem);

/* Advance by a duration with what is chosen held, and write the outputs. Where `begin` is given, loads move in straight
   lines from what it chooses. */
bool structure_behaviour_advance(structure_behaviour *behaviour, const double *begin, const double *chosen,
                                 double duration, double *output, structure_problem *problem);

/* For model exchange: the outputs under what is chosen and the motion at hand. Another health takes the motion over
   into its modes, and says so. */
bool structure_behaviour_evaluate(structure_behaviour *behaviour, const double *chosen, double *output, bool *taken_over,
                                  structure_problem *problem);

/* Displacements and velocities of the modes (M each), of which the motion consists, and their rates; zero at
   equilibrium. */
void structure_behaviour_states(const structure_behaviour *behaviour, double *states);
void structure_behaviour_set_states(structure_behaviour *behaviour, const double *states);
void structure_behaviour_rates(const structure_behaviour *behaviour, double *rates);

/* Certified bounds of the static response under the last inputs. */
bool structure_behaviour_error_bounds(structure_behaviour *behaviour, structure_bounds *bounds,
                                      structure_problem *problem);

/* Displacement along the load of index `point` at its point [m]. */
bool structure_behaviour_load_point(structure_behaviour *behaviour, size_t point, double *displacement,
                                    structure_problem *problem);

/* Derivatives of the outputs, of the displacement along the load of index `point`, and of the rates (2 M) with respect
   to one of what can be chosen: at equilibrium; in motion to one control of the loads. */
bool structure_behaviour_derivative(structure_behaviour *behaviour, size_t which, size_t point, double *output,
                                    double *load_point, double *rates, structure_problem *problem);

/* The same with respect to one state; zero at equilibrium. */
void structure_behaviour_state_derivative(const structure_behaviour *behaviour, size_t state, size_t point,
                                          double *output, double *load_point, double *rates);

/* Natural frequencies [Hz] and damping ratios [1] of the first `count` modes under the last inputs. */
bool structure_behaviour_modal_data(structure_behaviour *behaviour, size_t count, double *frequency,
                                    double *damping_ratio, structure_problem *problem);

/* The state as plain numbers: at most `structure_behaviour_state_size` of them; returns how many were written. */
size_t structure_behaviour_state_size(const structure_behaviour *behaviour);
size_t structure_behaviour_save(const structure_behaviour *behaviour, double *state);

/* Take back what was saved, with the parameters of that moment. */
bool structure_behaviour_restore(structure_behaviour *behaviour, const structure_parameters *parameters,
                                 const double *state, size_t count, structure_problem *problem);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
