#include "wing_behaviour.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static size_t inputs_of(const wing_behaviour *wing) { return wing->model->regions + 2; }

/* Numbers of a saved state before those of the motion. */
static size_t head_of(const wing_behaviour *wing) { return 2 + inputs_of(wing); }

static void lay_out(wing_behaviour *wing, wing_arena *arena) {
    for (size_t i = 0; i < 2; ++i) {
        wing_integrator_lay_out(&wing->integrators[i], wing->model, arena);
        wing_motion_lay_out(&wing->motions[i], wing->model, arena);
    }
}

bool wing_behaviour_make(wing_behaviour *wing, const wing_model *model, wing_problem *problem) {
    memset(wing, 0, sizeof *wing);
    wing->model = model;
    wing_arena count = {NULL, 0};
    lay_out(wing, &count);
    wing->memory = calloc(count.used, sizeof *wing->memory);
    if (wing->memory == NULL) {
        return wing_fail(problem, "there is no memory for an instance");
    }
    wing_arena arena = {wing->memory, 0};
    lay_out(wing, &arena);
    return true;
}

void wing_behaviour_free(wing_behaviour *wing) {
    free(wing->memory);
    memset(wing, 0, sizeof *wing);
}

void wing_behaviour_reset(wing_behaviour *wing) { wing->started = wing->moving = false; }

static void loads_of(const wing_behaviour *wing, const double *inputs, double load[WING_LOADS]) {
    load[0] = inputs[0];
    load[1] = inputs[wing->model->regions + 1];
}

/* The key of the modes, which begins with the state of health of the static part. */
static void key_of(const wing_model *model, const wing_parameters *parameters, const double *inputs,
                   double key[WING_MOST_KEYS]) {
    key[0] = parameters->young_modulus_factor;
    memcpy(key + 1, inputs + 1, model->regions * sizeof *key);
    key[model->regions + 1] = parameters->servo_mass;
    key[model->regions + 2] = parameters->pitot_mass;
}

/* Static response, with the integrator in use, whose static part follows the inputs. */
static bool find_equilibrium(wing_behaviour *wing, const wing_parameters *parameters,
                             const double *inputs, double *output, wing_problem *problem) {
    wing_static *steady = &wing->integrators[wing->integrator].steady;
    double health[WING_MOST_KEYS];
    key_of(wing->model, parameters, inputs, health);
    double load[WING_LOADS];
    loads_of(wing, inputs, load);
    if (!wing_static_prepare(steady, health, problem)) {
        return false;
    }
    wing_static_response(steady, load, output);
    return true;
}

/* Bring an integrator to the state of health of these inputs. */
static bool prepare(wing_integrator *integrator, const wing_parameters *parameters,
                    const double *inputs, wing_problem *problem) {
    double key[WING_MOST_KEYS];
    key_of(integrator->model, parameters, inputs, key);
    return wing_integrator_prepare(integrator, key, parameters->damping_alpha, parameters->damping_beta,
                                   problem);
}

bool wing_behaviour_start(wing_behaviour *wing, const wing_parameters *parameters,
                          const double *inputs, double *output, wing_problem *problem) {
    if (!parameters->transient) {
        if (!find_equilibrium(wing, parameters, inputs, output, problem)) {
            return false;
        }
        wing->moving = false;
    } else {
        const size_t next = 1 - wing->integrator;
        wing_integrator *integrator = &wing->integrators[next];
        wing_motion *motion = &wing->motions[1 - wing->motion];
        double load[WING_LOADS];
        loads_of(wing, inputs, load);
        if (!prepare(integrator, parameters, inputs, problem)) {
            return false;
        }
        wing_integrator_release(integrator, parameters->initial_tip_displacement, load, motion);
        wing_integrator_output(integrator, motion, output);
        wing->integrator = next;
        wing->motion = 1 - wing->motion;
        wing->moving = true;
    }
    wing->parameters = *parameters;
    memcpy(wing->inputs, inputs, inputs_of(wing) * sizeof *inputs);
    wing->started = true;
    return true;
}

bool wing_behaviour_advance(wing_behaviour *wing, const double *inputs, double duration,
                            double *output, wing_problem *problem) {
    if (!wing->started) {
        return wing_fail(problem, "the wing was not initialised");
    }
    if (!wing->moving) {
        if (!find_equilibrium(wing, &wing->parameters, inputs, output, problem)) {
            return false;
        }
    } else {
        wing_integrator *integrator = &wing->integrators[wing->integrator];
        wing_motion *motion = &wing->motions[wing->motion], *other = &wing->motions[1 - wing->motion];
        double load[WING_LOADS];
        loads_of(wing, inputs, load);
        if (memcmp(inputs + 1, wing->inputs + 1, wing->model->regions * sizeof *inputs) != 0) {
            wing_integrator *next = &wing->integrators[1 - wing->integrator];
            if (!prepare(next, &wing->parameters, inputs, problem)) {
                return false;
            }
            /* The former motion is not needed again, because nothing after this can fail. */
            wing_integrator_take_over(next, integrator, motion, other);
            wing->integrator = 1 - wing->integrator;
            integrator = next;
            wing_integrator_advance(integrator, other, duration, load, motion);
        } else {
            wing_integrator_advance(integrator, motion, duration, load, other);
            wing->motion = 1 - wing->motion;
            motion = other;
        }
        wing_integrator_output(integrator, motion, output);
    }
    memcpy(wing->inputs, inputs, inputs_of(wing) * sizeof *inputs);
    return true;
}

bool wing_behaviour_error_bound(wing_behaviour *wing, double *bound, wing_problem *problem) {
    if (!wing->started) {
        return wing_fail(problem, "the wing was not initialised");
    }
    wing_static *steady = &wing->integrators[wing->integrator].steady;
    double health[WING_MOST_KEYS];
    key_of(wing->model, &wing->parameters, wing->inputs, health);
    double load[WING_LOADS];
    loads_of(wing, wing->inputs, load);
    if (!wing_static_prepare(steady, health, problem)) {
        return false;
    }
    *bound = wing_static_error_bound(steady, load);
    return true;
}

bool wing_behaviour_load_point(wing_behaviour *wing, double *displacement, wing_problem *problem) {
    if (!wing->started) {
        return wing_fail(problem, "the wing was not initialised");
    }
    wing_integrator *integrator = &wing->integrators[wing->integrator];
    if (wing->moving) {
        *displacement = wing_integrator_load_point(integrator, &wing->motions[wing->motion]);
        return true;
    }
    double health[WING_MOST_KEYS];
    key_of(wing->model, &wing->parameters, wing->inputs, health);
    double load[WING_LOADS];
    loads_of(wing, wing->inputs, load);
    if (!wing_static_prepare(&integrator->steady, health, problem)) {
        return false;
    }
    *displacement = 0.0;
    for (size_t k = 0; k < WING_LOADS; ++k) {
        if (load[k] != 0.0) {
            *displacement += load[k] * wing_static_load_point(&integrator->steady, k);
        }
    }
    return true;
}

bool wing_behaviour_modal_data(wing_behaviour *wing, size_t count, double *frequency, double *damping_ratio,
                               wing_problem *problem) {
    if (!wing->started) {
        return wing_fail(problem, "the wing was not initialised");
    }
    wing_integrator *integrator = &wing->integrators[wing->integrator];
    double key[WING_MOST_KEYS];
    key_of(wing->model, &wing->parameters, wing->inputs, key);
    if (!wing_modes_find(&integrator->modes, key, problem)) {
        return false;
    }
    wing_integrator_damp(integrator, wing->parameters.damping_alpha, wing->parameters.damping_beta);
    const double two_pi = 6.283185307179586;
    for (size_t i = 0; i < count; ++i) {
        frequency[i] = integrator->modes.angular_frequency[i] / two_pi;
        damping_ratio[i] = integrator->damping_ratio[i];
    }
    return true;
}

size_t wing_behaviour_state_size(const wing_behaviour *wing) {
    return head_of(wing) + 2 * wing->model->mode_count + WING_LOADS;
}

size_t wing_behaviour_save(const wing_behaviour *wing, double *state) {
    const size_t count = wing->model->mode_count;
    state[0] = wing->started ? 1.0 : 0.0;
    state[1] = wing->moving ? 1.0 : 0.0;
    for (size_t i = 0; i < inputs_of(wing); ++i) {
        state[2 + i] = wing->started ? wing->inputs[i] : 0.0;
    }
    if (!wing->moving) {
        return head_of(wing);
    }
    const wing_motion *motion = &wing->motions[wing->motion];
    double *rest = state + head_of(wing);
    memcpy(rest, motion->displacement, count * sizeof *rest);
    memcpy(rest + count, motion->velocity, count * sizeof *rest);
    memcpy(rest + 2 * count, motion->load, sizeof motion->load);
    return head_of(wing) + 2 * count + WING_LOADS;
}

bool wing_behaviour_restore(wing_behaviour *wing, const wing_parameters *parameters, const double *state,
                            size_t count, wing_problem *problem) {
    const size_t modes = wing->model->mode_count;
    const bool moving = count > 1 && state[1] != 0.0;
    if (count != head_of(wing) + (moving ? 2 * modes + WING_LOADS : 0)) {
        return wing_fail(problem, "it holds %lu numbers of motion, which does not fit", (unsigned long)count);
    }
    for (size_t i = 0; i < count; ++i) {
        if (!isfinite(state[i])) {
            return wing_fail(problem, "it holds a number that is not finite");
        }
    }
    if (moving) {
        const size_t next = 1 - wing->integrator;
        const double *rest = state + head_of(wing);
        if (!prepare(&wing->integrators[next], parameters, state + 2, problem)) {
            return false;
        }
        wing_motion *motion = &wing->motions[wing->motion];
        memcpy(motion->displacement, rest, modes * sizeof *rest);
        memcpy(motion->velocity, rest + modes, modes * sizeof *rest);
        memcpy(motion->load, rest + 2 * modes, sizeof motion->load);
        wing->integrator = next;
    }
    wing->started = state[0] != 0.0;
    wing->moving = moving;
    wing->parameters = *parameters;
    memcpy(wing->inputs, state + 2, inputs_of(wing) * sizeof *state);
    return true;
}
