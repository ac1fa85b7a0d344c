#include "structure_behaviour.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Numbers of a saved state before those of the motion. */
static size_t head_of(const structure_behaviour *behaviour) { return 2 + behaviour->model->chosen; }

static size_t motion_size(const structure_model *model) { return 2 * model->mode_count + model->loads; }

static void lay_out(structure_behaviour *behaviour, structure_arena *arena) {
    behaviour->chosen = structure_take(arena, behaviour->model->chosen);
    behaviour->load = structure_take(arena, behaviour->model->loads);
    behaviour->rates = structure_take(arena, 2 * behaviour->model->mode_count);
    for (size_t i = 0; i < 2; ++i) {
        structure_integrator_lay_out(&behaviour->integrators[i], behaviour->model, arena);
        structure_motion_lay_out(&behaviour->motions[i], behaviour->model, arena);
    }
}

bool structure_behaviour_make(structure_behaviour *behaviour, const structure_model *model,
                              structure_problem *problem) {
    memset(behaviour, 0, sizeof *behaviour);
    behaviour->model = model;
    structure_arena count = {NULL, 0};
    lay_out(behaviour, &count);
    behaviour->memory = calloc(count.used + STRUCTURE_SPARE, sizeof *behaviour->memory);
    if (behaviour->memory == NULL) {
        return structure_fail(problem, "there is no memory for an instance");
    }
    structure_arena arena = structure_arena_of(behaviour->memory);
    lay_out(behaviour, &arena);
    return true;
}

void structure_behaviour_free(structure_behaviour *behaviour) {
    free(behaviour->memory);
    memset(behaviour, 0, sizeof *behaviour);
}

void structure_behaviour_reset(structure_behaviour *behaviour) { behaviour->started = behaviour->moving = false; }

static void keep(structure_behaviour *behaviour, const double *chosen) {
    memcpy(behaviour->chosen, chosen, behaviour->model->chosen * sizeof *chosen);
}

/* Static response, with the integrator in use, whose static part follows the inputs. */
static bool find_equilibrium(structure_behaviour *behaviour, const double *chosen, double *output,
                             structure_problem *problem) {
    const structure_model *model = behaviour->model;
    structure_static *steady = &behaviour->integrators[behaviour->integrator].steady;
    if (!structure_static_prepare(steady, chosen, problem)) {
        return false;
    }
    structure_load_coefficients(model, chosen, behaviour->load);
    structure_static_response(steady, behaviour->load, output);
    for (size_t i = model->output_count; i < model->modal_outputs; ++i) {
        output[i] = 0.0; /* accelerations */
    }
    return true;
}

static bool prepare(structure_integrator *integrator, const structure_parameters *parameters, const double *chosen,
                    structure_problem *problem) {
    return structure_integrator_prepare(integrator, chosen, parameters->damping_alpha, parameters->damping_beta,
                                        problem);
}

bool structure_behaviour_start(structure_behaviour *behaviour, const structure_parameters *parameters,
                               const double *chosen, double *output, structure_problem *problem) {
    if (!parameters->transient) {
        if (!find_equilibrium(behaviour, chosen, output, problem)) {
            return false;
        }
        behaviour->moving = false;
    } else {
        const size_t next = 1 - behaviour->integrator;
        structure_integrator *integrator = &behaviour->integrators[next];
        structure_motion *motion = &behaviour->motions[1 - behaviour->motion];
        if (!prepare(integrator, parameters, chosen, problem)) {
            return false;
        }
        structure_load_coefficients(behaviour->model, chosen, behaviour->load);
        structure_integrator_release(integrator, parameters->point, parameters->displacement, behaviour->load, motion);
        structure_integrator_output(integrator, motion, output);
        behaviour->integrator = next;
        behaviour->motion = 1 - behaviour->motion;
        behaviour->moving = true;
    }
    behaviour->parameters = *parameters;
    keep(behaviour, chosen);
    behaviour->started = true;
    return true;
}

static bool is_started(const structure_behaviour *behaviour, structure_problem *problem) {
    return behaviour->started || structure_fail(problem, "the structure was not initialised");
}

/* Find the modes of another health and express the motion in them; after a failure all is as it was. */
static bool take_over(structure_behaviour *behaviour, const double *chosen, structure_problem *problem) {
    structure_integrator *next = &behaviour->integrators[1 - behaviour->integrator];
    if (!prepare(next, &behaviour->parameters, chosen, problem)) {
        return false;
    }
    structure_integrator_take_over(next, &behaviour->integrators[behaviour->integrator],
                                   &behaviour->motions[behaviour->motion], &behaviour->motions[1 - behaviour->motion]);
    behaviour->integrator = 1 - behaviour->integrator;
    behaviour->motion = 1 - behaviour->motion;
    return true;
}

static bool modes_differ(const structure_behaviour *behaviour, const double *chosen) {
    return memcmp(chosen, behaviour->chosen, behaviour->model->key * sizeof *chosen) != 0;
}

bool structure_behaviour_advance(structure_behaviour *behaviour, const double *begin, const double *chosen,
                                 double duration, double *output, structure_problem *problem) {
    if (!is_started(behaviour, problem)) {
        return false;
    }
    if (!behaviour->moving) {
        if (!find_equilibrium(behaviour, chosen, output, problem)) {
            return false;
        }
    } else {
        if (modes_differ(behaviour, chosen) && !take_over(behaviour, chosen, problem)) {
            return false;
        }
        structure_integrator *integrator = &behaviour->integrators[behaviour->integrator];
        structure_motion *after = &behaviour->motions[1 - behaviour->motion];
        structure_motion *before = &behaviour->motions[behaviour->motion];
        structure_load_coefficients(behaviour->model, chosen, behaviour->load);
        if (begin != NULL) {
            structure_load_coefficients(behaviour->model, begin, before->load);
        }
        structure_integrator_advance(integrator, before, duration, begin == NULL ? NULL : before->load,
                                     behaviour->load, after);
        behaviour->motion = 1 - behaviour->motion;
        structure_integrator_output(integrator, after, output);
    }
    keep(behaviour, chosen);
    return true;
}

bool structure_behaviour_evaluate(structure_behaviour *behaviour, const double *chosen, double *output, bool *taken_over,
                                  structure_problem *problem) {
    *taken_over = false;
    if (!is_started(behaviour, problem)) {
        return false;
    }
    if (!behaviour->moving) {
        if (!find_equilibrium(behaviour, chosen, output, problem)) {
            return false;
        }
    } else {
        if (modes_differ(behaviour, chosen)) {
            if (!take_over(behaviour, chosen, problem)) {
                return false;
            }
            *taken_over = true;
        }
        structure_motion *motion = &behaviour->motions[behaviour->motion];
        structure_load_coefficients(behaviour->model, chosen, motion->load);
        structure_integrator_output(&behaviour->integrators[behaviour->integrator], motion, output);
    }
    keep(behaviour, chosen);
    return true;
}

void structure_behaviour_states(const structure_behaviour *behaviour, double *states) {
    const size_t count = behaviour->model->mode_count;
    const structure_motion *motion = &behaviour->motions[behaviour->motion];
    for (size_t i = 0; i < count; ++i) {
        states[i] = behaviour->moving ? motion->displacement[i] : 0.0;
        states[count + i] = behaviour->moving ? motion->velocity[i] : 0.0;
    }
}

void structure_behaviour_set_states(structure_behaviour *behaviour, const double *states) {
    const size_t count = behaviour->model->mode_count;
    structure_motion *motion = &behaviour->motions[behaviour->motion];
    memcpy(motion->displacement, states, count * sizeof *states);
    memcpy(motion->velocity, states + count, count * sizeof *states);
}

void structure_behaviour_rates(const structure_behaviour *behaviour, double *rates) {
    const size_t count = behaviour->model->mode_count;
    const structure_motion *motion = &behaviour->motions[behaviour->motion];
    const structure_integrator *integrator = &behaviour->integrators[behaviour->integrator];
    for (size_t i = 0; i < count; ++i) {
        rates[i] = behaviour->moving ? motion->velocity[i] : 0.0;
        rates[count + i] = behaviour->moving ? structure_integrator_acceleration(integrator, motion, i) : 0.0;
    }
}

bool structure_behaviour_error_bounds(structure_behaviour *behaviour, structure_bounds *bounds,
                                      structure_problem *problem) {
    structure_static *steady = &behaviour->integrators[behaviour->integrator].steady;
    if (!is_started(behaviour, problem) || !structure_static_prepare(steady, behaviour->chosen, problem)) {
        return false;
    }
    structure_load_coefficients(behaviour->model, behaviour->chosen, behaviour->load);
    *bounds = structure_static_error_bounds(steady, behaviour->load);
    return true;
}

bool structure_behaviour_load_point(structure_behaviour *behaviour, size_t point, double *displacement,
                                    structure_problem *problem) {
    if (!is_started(behaviour, problem)) {
        return false;
    }
    structure_integrator *integrator = &behaviour->integrators[behaviour->integrator];
    if (behaviour->moving) {
        *displacement = structure_integrator_load_point(integrator, point, &behaviour->motions[behaviour->motion]);
        return true;
    }
    if (!structure_static_prepare(&integrator->steady, behaviour->chosen, problem)) {
        return false;
    }
    structure_load_coefficients(behaviour->model, behaviour->chosen, behaviour->load);
    *displacement = 0.0;
    for (size_t k = 0; k < behaviour->model->loads; ++k) {
        if (behaviour->load[k] != 0.0) {
            *displacement += behaviour->load[k] * structure_static_load_point(&integrator->steady, point, k);
        }
    }
    return true;
}

bool structure_behaviour_derivative(structure_behaviour *behaviour, size_t which, size_t point, double *output,
                                    double *load_point, double *rates, structure_problem *problem) {
    const structure_model *model = behaviour->model;
    structure_integrator *integrator = &behaviour->integrators[behaviour->integrator];
    if (!is_started(behaviour, problem)) {
        return false;
    }
    if (behaviour->moving) {
        structure_integrator_derivative(integrator, behaviour->chosen, which, point, output, load_point, rates);
        return true;
    }
    if (!structure_static_prepare(&integrator->steady, behaviour->chosen, problem)) {
        return false;
    }
    structure_load_coefficients(model, behaviour->chosen, behaviour->load);
    structure_static_derivative(&integrator->steady, behaviour->chosen, behaviour->load, which, point, output,
                                load_point);
    for (size_t i = model->output_count; i < model->modal_outputs; ++i) {
        output[i] = 0.0; /* accelerations */
    }
    memset(rates, 0, 2 * model->mode_count * sizeof *rates);
    return true;
}

void structure_behaviour_state_derivative(const structure_behaviour *behaviour, size_t state, size_t point,
                                          double *output, double *load_point, double *rates) {
    if (behaviour->moving) {
        structure_integrator_state_derivative(&behaviour->integrators[behaviour->integrator], state, point, output,
                                              load_point, rates);
        return;
    }
    memset(output, 0, behaviour->model->modal_outputs * sizeof *output);
    memset(rates, 0, 2 * behaviour->model->mode_count * sizeof *rates);
    *load_point = 0.0;
}

bool structure_behaviour_modal_data(structure_behaviour *behaviour, size_t count, double *frequency,
                                    double *damping_ratio, structure_problem *problem) {
    structure_integrator *integrator = &behaviour->integrators[behaviour->integrator];
    if (!is_started(behaviour, problem) ||
        !structure_modes_find(&integrator->modes, behaviour->chosen, problem)) {
        return false;
    }
    structure_integrator_damp(integrator, behaviour->parameters.damping_alpha, behaviour->parameters.damping_beta);
    const double two_pi = 6.283185307179586;
    for (size_t i = 0; i < count; ++i) {
        frequency[i] = integrator->modes.angular_frequency[i] / two_pi;
        damping_ratio[i] = integrator->damping_ratio[i];
    }
    return true;
}

size_t structure_behaviour_state_size(const structure_behaviour *behaviour) {
    return head_of(behaviour) + motion_size(behaviour->model);
}

size_t structure_behaviour_save(const structure_behaviour *behaviour, double *state) {
    const size_t count = behaviour->model->mode_count, loads = behaviour->model->loads;
    state[0] = behaviour->started ? 1.0 : 0.0;
    state[1] = behaviour->moving ? 1.0 : 0.0;
    for (size_t i = 0; i < behaviour->model->chosen; ++i) {
        state[2 + i] = behaviour->started ? behaviour->chosen[i] : 0.0;
    }
    if (!behaviour->moving) {
        return head_of(behaviour);
    }
    const structure_motion *motion = &behaviour->motions[behaviour->motion];
    double *rest = state + head_of(behaviour);
    memcpy(rest, motion->displacement, count * sizeof *rest);
    memcpy(rest + count, motion->velocity, count * sizeof *rest);
    memcpy(rest + 2 * count, motion->load, loads * sizeof *rest);
    return structure_behaviour_state_size(behaviour);
}

bool structure_behaviour_restore(structure_behaviour *behaviour, const structure_parameters *parameters,
                                 const double *state, size_t count, structure_problem *problem) {
    const size_t modes = behaviour->model->mode_count, loads = behaviour->model->loads;
    const bool moving = count > 1 && state[1] != 0.0;
    if (count != head_of(behaviour) + (moving ? motion_size(behaviour->model) : 0)) {
        return structure_fail(problem, "it holds %lu numbers of motion, which does not fit", (unsigned long)count);
    }
    for (size_t i = 0; i < count; ++i) {
        if (!isfinite(state[i])) {
            return structure_fail(problem, "it holds a number that is not finite");
        }
    }
    const double *chosen = state + 2;
    if (moving) {
        const size_t next = 1 - behaviour->integrator;
        const double *rest = state + head_of(behaviour);
        if (!prepare(&behaviour->integrators[next], parameters, chosen, problem)) {
            return false;
        }
        structure_motion *motion = &behaviour->motions[behaviour->motion];
        memcpy(motion->displacement, rest, modes * sizeof *rest);
        memcpy(motion->velocity, rest + modes, modes * sizeof *rest);
        memcpy(motion->load, rest + 2 * modes, loads * sizeof *rest);
        behaviour->integrator = next;
    }
    behaviour->started = state[0] != 0.0;
    behaviour->moving = moving;
    behaviour->parameters = *parameters;
    keep(behaviour, chosen);
    return true;
}
