#include "structure_instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define DATA_FILE "reduced_model.bin"

/* phase, time and five flags, then the values, then the behaviour */
#define SAVED_HEAD 7
#define SAVED_FIXED (SAVED_HEAD + STRUCTURE_VARIABLE_COUNT + STRUCTURE_INPUT_COUNT)

void structure_log(const structure_host *host, const char *name, structure_result result, const char *sentence) {
    host->log(host, name, result,
              structure_log_categories[result == STRUCTURE_DISCARD ? STRUCTURE_LOG_DISCARD : STRUCTURE_LOG_ERROR],
              sentence);
}

static structure_instance *make(const char *name, const char *data_file, structure_problem *problem) {
    structure_instance *instance = calloc(1, sizeof *instance);
    char *kept_name = malloc(strlen(name) + 1);
    if (instance == NULL || kept_name == NULL) {
        free(instance);
        free(kept_name);
        (void)structure_fail(problem, "there is no memory for an instance");
        return NULL;
    }
    instance->name = strcpy(kept_name, name);
    for (size_t i = 0; i < STRUCTURE_LOG_CATEGORIES; ++i) {
        instance->logged[i] = true;
    }
    bool made = structure_model_read(&instance->model, data_file, problem);
    if (made && (instance->model.modal_outputs != STRUCTURE_OUTPUT_COUNT ||
                 instance->model.mode_count < STRUCTURE_OUTPUT_MODES ||
                 instance->model.chosen != STRUCTURE_CHOSEN_COUNT ||
                 (STRUCTURE_STATE_COUNT > 0 && 2 * instance->model.mode_count != STRUCTURE_STATE_COUNT))) {
        made = structure_fail(problem,
                              "%s belongs to another FMU: %lu outputs, %lu modes, %lu quantities that can be chosen",
                              data_file, (unsigned long)instance->model.modal_outputs,
                              (unsigned long)instance->model.mode_count, (unsigned long)instance->model.chosen);
    }
    if (!made || !structure_behaviour_make(&instance->behaviour, &instance->model, problem)) {
        structure_instance_free(instance);
        return NULL;
    }
    structure_instance_reset(instance);
    return instance;
}

structure_instance *structure_instance_open(const structure_host *host, const char *name, const char *token,
                                            const char *folder) {
    structure_problem problem;
    structure_instance *instance = NULL;
    if (name == NULL || *name == '\0') {
        (void)structure_fail(&problem, "an instance needs a name");
    } else if (token == NULL || strcmp(token, STRUCTURE_GUID) != 0) {
        (void)structure_fail(&problem, "the GUID %.60s was given, but this is " STRUCTURE_GUID,
                             token == NULL ? "(none)" : token);
    } else if (folder == NULL) {
        (void)structure_fail(&problem, "the location of the resources was not given");
    } else {
        const char *parts[] = {folder, "/" DATA_FILE};
        char *path = malloc(strlen(parts[0]) + strlen(parts[1]) + 1);
        if (path == NULL) {
            (void)structure_fail(&problem, "there is no memory for an instance");
        } else {
            strcat(strcpy(path, parts[0]), parts[1]);
            instance = make(name, path, &problem);
            free(path);
        }
    }
    if (instance == NULL) {
        structure_log(host, name == NULL ? "" : name, STRUCTURE_ERROR, problem.text);
        return NULL;
    }
    instance->host = *host;
    return instance;
}

void structure_instance_log(structure_instance *instance, bool on, size_t count, const char *const *categories) {
    for (size_t i = 0; i < STRUCTURE_LOG_CATEGORIES; ++i) {
        bool named = count == 0;
        for (size_t k = 0; k < count; ++k) {
            named = named || strcmp(categories[k], structure_log_categories[i]) == 0;
        }
        if (named) {
            instance->logged[i] = on;
        }
    }
}

void structure_instance_free(structure_instance *instance) {
    if (instance != NULL) {
        structure_behaviour_free(&instance->behaviour);
        structure_model_free(&instance->model);
        free(instance->name);
        free(instance);
    }
}

/* Time is a variable in FMI 3 only. */
static void set_time(structure_instance *instance, double time) {
    instance->time = time;
    if (structure_time_place < STRUCTURE_VARIABLE_COUNT) {
        instance->values[structure_time_place] = time;
    }
}

static void end_slopes(structure_instance *instance) {
    memset(instance->slopes, 0, sizeof instance->slopes);
    instance->sloping = false;
}

void structure_instance_reset(structure_instance *instance) {
    structure_behaviour_reset(&instance->behaviour);
    end_slopes(instance);
    instance->phase = STRUCTURE_INSTANTIATED;
    instance->discarded = false;
    for (size_t i = 0; i < STRUCTURE_VARIABLE_COUNT; ++i) {
        instance->values[i] = structure_variables[i].start;
    }
    set_time(instance, 0.0);
    instance->stale_response = instance->stale_bound = instance->stale_modal = true;
}

structure_result structure_refuse(structure_instance *instance, int status, const char *format, ...) {
    structure_problem problem;
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(problem.text, sizeof problem.text, format, arguments);
    va_end(arguments);
    instance->values[STRUCTURE_STATUS] = status;
    const bool discard = instance->phase == STRUCTURE_READY && status != STRUCTURE_STATUS_BAD_STATE;
    const structure_result level = discard ? STRUCTURE_DISCARD : STRUCTURE_ERROR;
    if (instance->logged[discard ? STRUCTURE_LOG_DISCARD : STRUCTURE_LOG_ERROR] || instance->logged[STRUCTURE_LOG_ALL]) {
        structure_log(&instance->host, instance->name, level, problem.text);
    }
    return level;
}

/* ---------------------------------------------------------------- ranges and parameters */

static structure_result check_range(structure_instance *instance, size_t first, size_t last, const char *consequence) {
    for (size_t i = first; i < last; ++i) {
        const structure_variable *variable = &structure_variables[i];
        const double value = instance->values[i];
        if (!isfinite(value)) {
            return structure_refuse(instance, STRUCTURE_STATUS_NOT_FINITE, "%s is %g, which is not finite; %s",
                               variable->name, value, consequence);
        }
        if (value < variable->minimum || value > variable->maximum) {
            return structure_refuse(instance, STRUCTURE_STATUS_OUTSIDE_RANGE,
                               "%s = %.17g lies outside its range %g to %g%s%s; %s", variable->name, value,
                               variable->minimum, variable->maximum, *variable->unit == '\0' ? "" : " ",
                               variable->unit, consequence);
        }
    }
    return STRUCTURE_DONE;
}

static structure_parameters parameters_of(const double *values) {
    const structure_parameters parameters = {
        .damping_alpha = values[STRUCTURE_DAMPING_ALPHA],
        .damping_beta = values[STRUCTURE_DAMPING_BETA],
        .transient = values[STRUCTURE_RESPONSE] == STRUCTURE_RESPONSE_TRANSIENT,
        .displacement = structure_release_place < STRUCTURE_VARIABLE_COUNT ? values[structure_release_place] : 0.0,
        .point = STRUCTURE_POINT_LOAD,
    };
    return parameters;
}

/* All that can be chosen, in the order of the model. */
static void choose(const double *values, double *chosen) {
    for (size_t i = 0; i < STRUCTURE_CHOSEN_COUNT; ++i) {
        chosen[i] = values[structure_chosen_places[i]];
    }
}

static const double *chosen_of(structure_instance *instance) {
    choose(instance->values, instance->chosen);
    return instance->chosen;
}

static void accept_outputs(structure_instance *instance) {
    memcpy(instance->values + STRUCTURE_FIRST_OUTPUT, instance->outputs, sizeof instance->outputs);
    if (STRUCTURE_STATE_COUNT > 0) {
        structure_behaviour_states(&instance->behaviour, instance->values + STRUCTURE_FIRST_STATE);
        structure_behaviour_rates(&instance->behaviour,
                                  instance->values + STRUCTURE_FIRST_STATE + STRUCTURE_STATE_COUNT);
    }
    instance->values[STRUCTURE_STATUS] = STRUCTURE_STATUS_OK;
    instance->stale_response = false;
    instance->stale_bound = instance->stale_modal = true;
}

/* ---------------------------------------------------------------- life of an instance */

structure_result structure_setup(structure_instance *instance, double start_time) {
    if (!isfinite(start_time)) {
        return structure_refuse(instance, STRUCTURE_STATUS_NOT_FINITE, "the start time is %g; it must be finite",
                           start_time);
    }
    set_time(instance, start_time);
    return STRUCTURE_DONE;
}

structure_result structure_enter_initialisation(structure_instance *instance) {
    if (instance->phase != STRUCTURE_INSTANTIATED && instance->phase != STRUCTURE_REFUSED) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                           "initialisation was entered a second time; reset the FMU first");
    }
    instance->phase = STRUCTURE_INITIALISING;
    return STRUCTURE_DONE;
}

static structure_result initialise(structure_instance *instance) {
    const structure_result range = check_range(instance, 0, STRUCTURE_FIRST_OUTPUT, "the initialisation was refused");
    if (range != STRUCTURE_DONE) {
        return range;
    }
    const structure_parameters parameters = parameters_of(instance->values);
    structure_problem problem;
    if (!structure_behaviour_start(&instance->behaviour, &parameters, chosen_of(instance), instance->outputs,
                                   &problem)) {
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "the initialisation failed: %s", problem.text);
    }
    accept_outputs(instance);
    return STRUCTURE_DONE;
}

structure_result structure_exit_initialisation(structure_instance *instance) {
    if (instance->phase != STRUCTURE_INITIALISING) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                           "initialisation was left without having been entered");
    }
    const structure_result status = initialise(instance);
    instance->phase = status == STRUCTURE_DONE ? STRUCTURE_READY : STRUCTURE_REFUSED;
    instance->event_mode = true;
    instance->states_changed = false;
    return status;
}

static const char *phase_name(structure_phase phase) {
    switch (phase) {
    case STRUCTURE_INSTANTIATED:
        return "before initialisation";
    case STRUCTURE_INITIALISING:
        return "during initialisation";
    case STRUCTURE_REFUSED:
        return "after an initialisation that was refused";
    case STRUCTURE_TERMINATED:
        return "after termination";
    case STRUCTURE_READY:
        break;
    }
    return "";
}

/* Bring the inputs to the end of a step, and see that they are in range there and at its begin. */
static structure_result move_inputs(structure_instance *instance, double step_size) {
    static const char consequence[] = "the step was refused and the state is as it was";
    const structure_result range = check_range(instance, 0, STRUCTURE_INPUT_COUNT, consequence);
    if (!instance->sloping || range != STRUCTURE_DONE) {
        return range;
    }
    for (size_t i = 0; i < STRUCTURE_INPUT_COUNT; ++i) {
        const structure_variable *variable = &structure_variables[i];
        double *value = instance->values + i;
        *value += instance->slopes[i] * step_size;
        /* A line to the edge of the range may end beside it by rounding. */
        const double rounding = 1e-12 * (variable->maximum - variable->minimum);
        if (*value > variable->maximum && *value <= variable->maximum + rounding) {
            *value = variable->maximum;
        } else if (*value < variable->minimum && *value >= variable->minimum - rounding) {
            *value = variable->minimum;
        }
    }
    return check_range(instance, 0, STRUCTURE_INPUT_COUNT, consequence);
}

structure_result structure_step(structure_instance *instance, double time, double step_size) {
    instance->discarded = true; /* until it is done */
    if (STRUCTURE_STATE_COUNT > 0) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL, "this FMU is for model exchange only");
    }
    if (instance->phase != STRUCTURE_READY) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL, "a step was asked for %s", phase_name(instance->phase));
    }
    if (!(step_size > 0.0) || !isfinite(step_size) || !isfinite(time)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STEP,
                           "the step from t = %.17g s over %.17g s was refused: the communication point must be "
                           "finite, the step size finite and positive",
                           time, step_size);
    }
    if (fabs(time - instance->time) > 1e-6 * step_size + 1e-9 * fabs(instance->time)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STEP,
                           "the step from t = %.17g s was refused: the FMU stands at t = %.17g s", time,
                           instance->time);
    }
    double inputs[STRUCTURE_INPUT_COUNT], begin[STRUCTURE_CHOSEN_COUNT];
    memcpy(inputs, instance->values, sizeof inputs);
    choose(instance->values, begin);
    const bool sloping = instance->sloping;
    const structure_result range = move_inputs(instance, step_size);
    if (range != STRUCTURE_DONE) {
        memcpy(instance->values, inputs, sizeof inputs);
        return range;
    }
    structure_problem problem;
    if (!structure_behaviour_advance(&instance->behaviour, sloping ? begin : NULL, chosen_of(instance), step_size,
                                     instance->outputs, &problem)) {
        memcpy(instance->values, inputs, sizeof inputs);
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "the step from t = %g s failed: %s", time,
                           problem.text);
    }
    set_time(instance, time + step_size);
    end_slopes(instance);
    instance->discarded = false;
    accept_outputs(instance);
    return STRUCTURE_DONE;
}

/* ---------------------------------------------------------------- model exchange */

/* Bring the outputs, states and rates up to date under the inputs and states at hand. */
static structure_result evaluate(structure_instance *instance) {
    if (!instance->stale_response || instance->phase != STRUCTURE_READY) {
        return STRUCTURE_DONE;
    }
    const structure_result range =
        check_range(instance, 0, STRUCTURE_INPUT_COUNT, "nothing was computed and the state is as it was");
    if (range != STRUCTURE_DONE) {
        return range;
    }
    structure_problem problem;
    bool taken_over = false;
    if (!structure_behaviour_evaluate(&instance->behaviour, chosen_of(instance), instance->outputs, &taken_over,
                                      &problem)) {
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "the model at t = %g s failed: %s",
                                instance->time, problem.text);
    }
    instance->states_changed = instance->states_changed || taken_over;
    accept_outputs(instance);
    return STRUCTURE_DONE;
}

static structure_result check_states(structure_instance *instance, size_t count) {
    if (count != STRUCTURE_STATE_COUNT || (instance->phase != STRUCTURE_READY && count > 0)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                                "%lu states were given or asked for %s; this FMU has %d, after its initialisation",
                                (unsigned long)count, phase_name(instance->phase), STRUCTURE_STATE_COUNT);
    }
    return STRUCTURE_DONE;
}

structure_result structure_event(structure_instance *instance, bool *states_changed) {
    const structure_result result = evaluate(instance);
    *states_changed = instance->states_changed;
    instance->states_changed = false;
    return result;
}

structure_result structure_set_states(structure_instance *instance, const double *states, size_t count) {
    const structure_result result = check_states(instance, count);
    if (result == STRUCTURE_DONE && count > 0) {
        structure_behaviour_set_states(&instance->behaviour, states);
        instance->stale_response = true;
    }
    return result;
}

structure_result structure_get_states(structure_instance *instance, double *states, size_t count) {
    const structure_result result = check_states(instance, count);
    if (result == STRUCTURE_DONE && count > 0) {
        structure_behaviour_states(&instance->behaviour, states);
    }
    return result;
}

structure_result structure_get_rates(structure_instance *instance, double *rates, size_t count) {
    structure_result result = check_states(instance, count);
    if (result == STRUCTURE_DONE && count > 0) {
        result = evaluate(instance);
        structure_behaviour_rates(&instance->behaviour, rates);
    }
    return result;
}

void structure_nominals(double *nominals, size_t count) {
    for (size_t i = 0; i < count; ++i) { /* a wing tip that moves by centimetres, at a few hertz */
        nominals[i] = 2 * i < count ? 0.01 : 1.0;
    }
}

/* ---------------------------------------------------------------- values */

size_t structure_length(structure_instance *instance, unsigned int reference, bool enumeration) {
    if (reference < STRUCTURE_VARIABLE_COUNT && structure_variables[reference].length > 0 &&
        structure_variables[reference].enumeration == enumeration) {
        return structure_variables[reference].length;
    }
    (void)structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL, "there is no %s variable with value reference %u",
                           enumeration ? "enumeration" : "real", reference);
    return 0;
}

/* Whether a variable changes the modes, which in model exchange is an event. */
static bool changes_modes(const structure_instance *instance, unsigned int reference) {
    for (size_t i = 0; i < instance->model.key; ++i) {
        if (structure_chosen_places[i] == reference) {
            return true;
        }
    }
    return false;
}

static structure_result set_one(structure_instance *instance, unsigned int reference, const double *values,
                                size_t length) {
    const char *name = structure_variables[reference].name;
    if (reference >= STRUCTURE_FIRST_OUTPUT) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                                "%s (value reference %u) is an output and cannot be set", name, reference);
    }
    if (reference >= STRUCTURE_INPUT_COUNT &&
        (instance->phase == STRUCTURE_READY || instance->phase == STRUCTURE_TERMINATED)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                                "%s is a fixed parameter and can be set only before the first step", name);
    }
    if (STRUCTURE_STATE_COUNT > 0 && instance->phase == STRUCTURE_READY && !instance->event_mode &&
        changes_modes(instance, reference)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL, "%s is discrete and can be set in event mode only",
                                name);
    }
    memcpy(instance->values + reference, values, length * sizeof *values);
    instance->stale_response = true;
    return STRUCTURE_DONE;
}

static structure_result wrong_count(structure_instance *instance, size_t count) {
    return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                            "%lu values were given or asked for, which is not the number that the variables have",
                            (unsigned long)count);
}

structure_result structure_set(structure_instance *instance, const unsigned int *references, size_t count,
                               const double *values, size_t value_count, bool enumeration) {
    structure_result worst = STRUCTURE_DONE;
    size_t at = 0;
    for (size_t i = 0; i < count; ++i) {
        const size_t length = structure_length(instance, references[i], enumeration);
        if (length == 0) {
            return instance->phase == STRUCTURE_READY ? STRUCTURE_DISCARD : STRUCTURE_ERROR;
        }
        if (at + length > value_count) {
            return wrong_count(instance, value_count);
        }
        const structure_result result = set_one(instance, references[i], values + at, length);
        worst = result > worst ? result : worst;
        at += length;
    }
    return at == value_count ? worst : wrong_count(instance, value_count);
}

structure_result structure_set_slopes(structure_instance *instance, const unsigned int *references, size_t count,
                                      const int *orders, const double *slopes) {
    for (size_t i = 0; i < count; ++i) {
        if (STRUCTURE_STATE_COUNT > 0 || references[i] >= STRUCTURE_INPUT_COUNT || orders[i] != 1 ||
            !isfinite(slopes[i])) {
            return structure_refuse(instance, STRUCTURE_STATUS_BAD_CALL,
                                    "derivatives of inputs must be finite, of the first order and of inputs of "
                                    "co-simulation, but order %d of value reference %u was set to %g",
                                    orders[i], references[i], slopes[i]);
        }
    }
    for (size_t i = 0; i < count; ++i) {
        instance->slopes[references[i]] = slopes[i];
    }
    instance->sloping = false;
    for (size_t i = 0; i < STRUCTURE_INPUT_COUNT; ++i) {
        instance->sloping = instance->sloping || instance->slopes[i] != 0.0;
    }
    return STRUCTURE_DONE;
}

structure_result structure_update(structure_instance *instance, const unsigned int *references, size_t count) {
    unsigned int highest = 0;
    bool bound = false, load_point = false, modal = false;
    for (size_t i = 0; i < count; ++i) {
        const unsigned int reference = references[i];
        if (reference >= STRUCTURE_VARIABLE_COUNT) {
            continue;
        }
        highest = reference > highest ? reference : highest;
        bound = bound || reference == STRUCTURE_STRAIN_BOUND || reference == structure_displacement_bound_place;
        load_point = load_point || reference == structure_load_point_place;
        modal = modal || (reference >= STRUCTURE_FIRST_FREQUENCY &&
                          reference < STRUCTURE_FIRST_FREQUENCY + 2 * STRUCTURE_OUTPUT_MODES);
    }
    if (highest < STRUCTURE_FIRST_OUTPUT) {
        return STRUCTURE_DONE;
    }
    if (instance->stale_response && instance->phase == STRUCTURE_INITIALISING) {
        const structure_result status = initialise(instance);
        if (status != STRUCTURE_DONE) {
            return status;
        }
    }
    if (instance->phase == STRUCTURE_INSTANTIATED || instance->phase == STRUCTURE_REFUSED) {
        return STRUCTURE_DONE;
    }
    const structure_result current = STRUCTURE_STATE_COUNT > 0 ? evaluate(instance) : STRUCTURE_DONE;
    if (current != STRUCTURE_DONE) {
        return current;
    }
    structure_problem problem;
    if (bound && instance->stale_bound) {
        structure_bounds bounds;
        if (!structure_behaviour_error_bounds(&instance->behaviour, &bounds, &problem)) {
            return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "values could not be read: %s", problem.text);
        }
        instance->values[STRUCTURE_STRAIN_BOUND] = bounds.strain;
        if (structure_displacement_bound_place < STRUCTURE_VARIABLE_COUNT) {
            instance->values[structure_displacement_bound_place] = bounds.displacement;
        }
        instance->stale_bound = false;
    }
    if (load_point && !structure_behaviour_load_point(&instance->behaviour, STRUCTURE_POINT_LOAD,
                                                      &instance->values[structure_load_point_place], &problem)) {
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "values could not be read: %s", problem.text);
    }
    if (modal && instance->stale_modal) {
        double *frequency = instance->values + STRUCTURE_FIRST_FREQUENCY;
        if (!structure_behaviour_modal_data(&instance->behaviour, STRUCTURE_OUTPUT_MODES, frequency,
                                       frequency + STRUCTURE_OUTPUT_MODES, &problem)) {
            return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "values could not be read: %s", problem.text);
        }
        instance->stale_modal = false;
    }
    return STRUCTURE_DONE;
}

structure_result structure_get(structure_instance *instance, const unsigned int *references, size_t count,
                               double *values, size_t value_count, bool enumeration) {
    structure_result worst = structure_update(instance, references, count);
    size_t at = 0;
    for (size_t i = 0; i < count; ++i) {
        const size_t length = structure_length(instance, references[i], enumeration);
        if (at + (length == 0 ? 1 : length) > value_count) {
            return wrong_count(instance, value_count);
        }
        if (length == 0) {
            values[at++] = NAN;
            worst = STRUCTURE_ERROR;
            continue;
        }
        memcpy(values + at, instance->values + references[i], length * sizeof *values);
        at += length;
    }
    return at == value_count ? worst : wrong_count(instance, value_count);
}

/* ---------------------------------------------------------------- state */

bool structure_save(const structure_instance *instance, structure_saved_state *saved) {
    const size_t most = SAVED_FIXED + structure_behaviour_state_size(&instance->behaviour);
    double *body = calloc(most, sizeof *body);
    if (body == NULL) {
        return false;
    }
    body[0] = (double)instance->phase;
    body[1] = instance->time;
    body[2] = instance->stale_response ? 1.0 : 0.0;
    body[3] = instance->stale_bound ? 1.0 : 0.0;
    body[4] = instance->stale_modal ? 1.0 : 0.0;
    body[5] = instance->event_mode ? 1.0 : 0.0;
    body[6] = instance->states_changed ? 1.0 : 0.0;
    memcpy(body + SAVED_HEAD, instance->values, sizeof instance->values);
    saved->body = body;
    memcpy(body + SAVED_HEAD + STRUCTURE_VARIABLE_COUNT, instance->slopes, sizeof instance->slopes);
    saved->count = SAVED_FIXED + structure_behaviour_save(&instance->behaviour, body + SAVED_FIXED);
    return true;
}

structure_result structure_restore(structure_instance *instance, const structure_saved_state *saved) {
    const double *body = saved->body;
    structure_problem problem;
    if (saved->count <= SAVED_FIXED || !(body[0] >= 0.0 && body[0] <= STRUCTURE_TERMINATED) ||
        !isfinite(body[1])) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, "the FMU state was not restored: it is damaged");
    }
    const double *values = body + SAVED_HEAD, *slopes = values + STRUCTURE_VARIABLE_COUNT;
    const structure_parameters parameters = parameters_of(values);
    if (!structure_behaviour_restore(&instance->behaviour, &parameters, body + SAVED_FIXED, saved->count - SAVED_FIXED,
                                     &problem)) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, "the FMU state was not restored: %s", problem.text);
    }
    instance->phase = (structure_phase)(int)body[0];
    instance->time = body[1];
    instance->discarded = false;
    instance->stale_response = body[2] != 0.0;
    instance->stale_bound = body[3] != 0.0;
    instance->stale_modal = body[4] != 0.0;
    instance->event_mode = body[5] != 0.0;
    instance->states_changed = body[6] != 0.0;
    memcpy(instance->values, values, sizeof instance->values);
    end_slopes(instance);
    for (unsigned int i = 0; i < STRUCTURE_INPUT_COUNT; ++i) {
        instance->slopes[i] = slopes[i];
        instance->sloping = instance->sloping || slopes[i] != 0.0;
    }
    return STRUCTURE_DONE;
}
