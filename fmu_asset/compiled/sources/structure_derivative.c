#include "structure_derivative.h"

#include <math.h>
#include <string.h>

/* What can be chosen, after it the two numbers of damping, then the states; the last is none of them. */
enum { ALPHA = STRUCTURE_CHOSEN_COUNT, BETA, STATE, NOTHING = STATE + STRUCTURE_STATE_COUNT };

static size_t quantity_of(unsigned int place) {
    for (size_t i = 0; i < STRUCTURE_CHOSEN_COUNT; ++i) {
        if (structure_chosen_places[i] == place) {
            return i;
        }
    }
    if (place >= STRUCTURE_FIRST_STATE && place < STRUCTURE_FIRST_STATE + STRUCTURE_STATE_COUNT) {
        return STATE + (place - STRUCTURE_FIRST_STATE);
    }
    return place == STRUCTURE_DAMPING_ALPHA ? ALPHA : place == STRUCTURE_DAMPING_BETA ? BETA : NOTHING;
}

/* Derivatives of frequencies and damping ratios. */
static bool find_modal(structure_behaviour *behaviour, size_t quantity, double *frequency, double *damping_ratio,
                       structure_problem *problem) {
    const size_t count = STRUCTURE_OUTPUT_MODES;
    /* The modes are brought up to date; of what they give, the damping ratios are not needed. */
    if (!structure_behaviour_modal_data(behaviour, count, frequency, damping_ratio, problem)) {
        return false;
    }
    const structure_modes *modes = &behaviour->integrators[behaviour->integrator].modes;
    const structure_parameters *parameters = &behaviour->parameters;
    for (size_t i = 0; i < count; ++i) {
        const double omega = modes->angular_frequency[i];
        double change = 0.0; /* of omega */
        damping_ratio[i] = quantity == ALPHA ? 0.5 / omega : quantity == BETA ? 0.5 * omega : 0.0;
        if (quantity < STRUCTURE_CHOSEN_COUNT) {
            change = structure_modes_square_derivative(modes, i, behaviour->chosen, quantity) / (2.0 * omega);
            damping_ratio[i] =
                0.5 * (parameters->damping_beta - parameters->damping_alpha / (omega * omega)) * change;
        }
        frequency[i] = change / 6.283185307179586;
    }
    return true;
}

/* Derivatives of all outputs with respect to one quantity, by their places; NaN where there is none. */
static bool find_column(structure_instance *instance, size_t quantity, bool modal, double *column,
                        structure_problem *problem) {
    structure_behaviour *behaviour = &instance->behaviour;
    for (size_t i = 0; i < STRUCTURE_VARIABLE_COUNT; ++i) {
        column[i] = NAN;
    }
    double load_point = NAN, *output = column + STRUCTURE_FIRST_OUTPUT, *rates = behaviour->rates;
    const size_t states = 2 * behaviour->model->mode_count;
    const bool of_motion = behaviour->moving;
    for (size_t i = 0; i < states; ++i) {
        rates[i] = NAN;
    }
    if (quantity < STRUCTURE_CHOSEN_COUNT &&
        (!of_motion || structure_is_control(behaviour->model, quantity))) {
        if (!structure_behaviour_derivative(behaviour, quantity, STRUCTURE_POINT_LOAD, output, &load_point, rates,
                                            problem)) {
            return false;
        }
    } else if (quantity >= STATE && quantity < NOTHING) {
        structure_behaviour_state_derivative(behaviour, quantity - STATE, STRUCTURE_POINT_LOAD, output, &load_point,
                                             rates);
    } else if (quantity < STATE && !of_motion) { /* damping, at rest */
        memset(output, 0, STRUCTURE_OUTPUT_COUNT * sizeof *output);
        load_point = 0.0;
    }
    if (STRUCTURE_STATE_COUNT > 0) {
        memcpy(column + STRUCTURE_FIRST_STATE + STRUCTURE_STATE_COUNT, rates, states * sizeof *rates);
    }
    if (structure_load_point_place < STRUCTURE_VARIABLE_COUNT) {
        column[structure_load_point_place] = load_point;
    }
    double *frequency = column + STRUCTURE_FIRST_FREQUENCY;
    return !modal || quantity == NOTHING ||
           find_modal(behaviour, quantity, frequency, frequency + STRUCTURE_OUTPUT_MODES, problem);
}

static bool is_modal(unsigned int place) {
    return place >= STRUCTURE_FIRST_FREQUENCY && place < STRUCTURE_FIRST_FREQUENCY + 2 * STRUCTURE_OUTPUT_MODES;
}

/* Number of values of some references; zero, refused, where one is of no real variable. */
static size_t count_values(structure_instance *instance, const unsigned int *references, size_t count) {
    size_t sum = 0;
    for (size_t i = 0; i < count; ++i) {
        const size_t length = structure_length(instance, references[i], false);
        if (length == 0) {
            return 0;
        }
        sum += length;
    }
    return sum;
}

static structure_result refuse(structure_instance *instance, const char *sentence) {
    return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL, "the derivative was refused: %s", sentence);
}

/* Add one column of the Jacobian to the sensitivity. */
static structure_result add_column(structure_instance *instance, const structure_pairs *pairs, unsigned int known,
                                   const double *column, bool adjoint, const double *seed, double *sensitivity) {
    size_t at = 0;
    for (size_t i = 0; i < pairs->unknown_count; ++i) {
        const unsigned int first = pairs->unknowns[i];
        for (unsigned int k = 0; k < structure_variables[first].length; ++k, ++at) {
            const double value = column[first + k];
            if (!isfinite(value)) {
                return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                                        "the derivative of %s with respect to %s is not offered%s",
                                        structure_variables[first + k].name, structure_variables[known].name,
                                        instance->behaviour.moving ? " in motion" : "");
            }
            if (adjoint) {
                *sensitivity += value * seed[at];
            } else {
                sensitivity[at] += value * *seed;
            }
        }
    }
    return STRUCTURE_DONE;
}

static structure_result differentiate(structure_instance *instance, const structure_pairs *pairs, bool adjoint,
                                      const double *seed, size_t seed_count, double *sensitivity,
                                      size_t sensitivity_count) {
    const size_t unknowns = count_values(instance, pairs->unknowns, pairs->unknown_count);
    const size_t knowns = count_values(instance, pairs->knowns, pairs->known_count);
    if (unknowns == 0 || knowns == 0 || seed_count != (adjoint ? unknowns : knowns) ||
        sensitivity_count != (adjoint ? knowns : unknowns)) {
        return refuse(instance, "seed and sensitivity must have one number for each value of known real variables");
    }
    const structure_result current = structure_update(instance, pairs->unknowns, pairs->unknown_count);
    if (current != STRUCTURE_DONE) {
        return current;
    }
    if (!instance->behaviour.started) {
        return refuse(instance, "the FMU is not initialised");
    }
    bool modal = false;
    for (size_t i = 0; i < pairs->unknown_count; ++i) {
        modal = modal || is_modal(pairs->unknowns[i]);
    }
    memset(sensitivity, 0, sensitivity_count * sizeof *sensitivity);
    size_t at = 0;
    for (size_t i = 0; i < pairs->known_count; ++i) {
        const unsigned int first = pairs->knowns[i];
        for (unsigned int k = 0; k < structure_variables[first].length; ++k, ++at) {
            double column[STRUCTURE_VARIABLE_COUNT];
            structure_problem problem;
            if (!adjoint && seed[at] == 0.0) {
                continue;
            }
            if (!find_column(instance, quantity_of(first + k), modal, column, &problem)) {
                return refuse(instance, problem.text);
            }
            const structure_result result =
                add_column(instance, pairs, first + k, column, adjoint, adjoint ? seed : seed + at,
                           adjoint ? sensitivity + at : sensitivity);
            if (result != STRUCTURE_DONE) {
                return result;
            }
        }
    }
    return STRUCTURE_DONE;
}

structure_result structure_directional_derivative(structure_instance *instance, const structure_pairs *pairs,
                                                  const double *seed, size_t seed_count, double *sensitivity,
                                                  size_t sensitivity_count) {
    return differentiate(instance, pairs, false, seed, seed_count, sensitivity, sensitivity_count);
}

structure_result structure_adjoint_derivative(structure_instance *instance, const structure_pairs *pairs,
                                              const double *seed, size_t seed_count, double *sensitivity,
                                              size_t sensitivity_count) {
    return differentiate(instance, pairs, true, seed, seed_count, sensitivity, sensitivity_count);
}
