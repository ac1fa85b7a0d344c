/* What the wing does in one communication step: the steady turn, or the modes integrated in time.

   A function either completes or returns false and leaves everything as it was. */
#ifndef WING_BEHAVIOUR_H
#define WING_BEHAVIOUR_H

#include "wing_transient.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Room for inputs: load factor [1], the losses of the damage regions [1], tip force [N]. */
#define WING_MOST_INPUTS (WING_MOST_REGIONS + 2)

typedef struct {
    double young_modulus_factor;
    double damping_alpha;            /* 1/s */
    double damping_beta;             /* s */
    double servo_mass;               /* kg */
    double pitot_mass;               /* kg */
    double initial_tip_displacement; /* m */
    bool transient;
} wing_parameters;

typedef struct {
    const wing_model *model;
    bool started;
    bool moving; /* transient */
    wing_parameters parameters;
    double inputs[WING_MOST_INPUTS]; /* of the last step */
    /* The integrator in use, and the one that takes over when health changes; motions alike. */
    wing_integrator integrators[2];
    wing_motion motions[2];
    size_t integrator;
    size_t motion;
    double *memory;
} wing_behaviour;

/* Make a wing that is not started. On success the caller frees it with `wing_behaviour_free`. */
bool wing_behaviour_make(wing_behaviour *wing, const wing_model *model, wing_problem *problem);

void wing_behaviour_free(wing_behaviour *wing);

/* Forget the simulation; what is derived from parameters is kept, since it does not depend on the past. */
void wing_behaviour_reset(wing_behaviour *wing);

/* Find the initial state and its outputs (G + 1). */
bool wing_behaviour_start(wing_behaviour *wing, const wing_parameters *parameters,
                          const double *inputs, double *output, wing_problem *problem);

/* Advance by a duration with the inputs held, and write the outputs (G + 1). */
bool wing_behaviour_advance(wing_behaviour *wing, const double *inputs, double duration,
                            double *output, wing_problem *problem);

/* Certified bound of the static strains under the last inputs. */
bool wing_behaviour_error_bound(wing_behaviour *wing, double *bound, wing_problem *problem);

/* Displacement of the point where the tip force acts [m]. */
bool wing_behaviour_load_point(wing_behaviour *wing, double *displacement, wing_problem *problem);

/* Natural frequencies [Hz] and damping ratios [1] of the first `count` modes under the last inputs. */
bool wing_behaviour_modal_data(wing_behaviour *wing, size_t count, double *frequency, double *damping_ratio,
                               wing_problem *problem);

/* The state as plain numbers: at most `wing_behaviour_state_size` of them; returns how many were written. */
size_t wing_behaviour_state_size(const wing_behaviour *wing);
size_t wing_behaviour_save(const wing_behaviour *wing, double *state);

/* Take back what was saved, with the parameters of that moment. */
bool wing_behaviour_restore(wing_behaviour *wing, const wing_parameters *parameters, const double *state,
                            size_t count, wing_problem *problem);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
