#include "wing_instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* phase, time and three flags, then the values, then the behaviour */
#define SAVED_HEAD 5

static const char *category_of(fmi2Status status) {
    return wing_log_categories[status == fmi2Discard ? WING_LOG_DISCARD : WING_LOG_ERROR];
}

void wing_log(fmi2CallbackLogger logger, fmi2ComponentEnvironment environment, const char *name,
              fmi2Status status, const char *sentence) {
    /* Some hosts take the message for the text, others for a format: with every % doubled it is both, but for
       paths that hold one. */
    char format[2 * sizeof(((wing_problem *)0)->text)];
    size_t at = 0;
    for (; *sentence != '\0' && at + 3 < sizeof format; ++sentence) {
        if (*sentence == '%') {
            format[at++] = '%';
        }
        format[at++] = *sentence;
    }
    format[at] = '\0';
    if (logger != NULL) {
        logger(environment, name, status, category_of(status), format);
    }
}

wing_instance *wing_instance_make(const char *name, const char *data_file, wing_problem *problem) {
    wing_instance *instance = calloc(1, sizeof *instance);
    char *kept_name = malloc(strlen(name) + 1);
    if (instance == NULL || kept_name == NULL) {
        free(instance);
        free(kept_name);
        (void)wing_fail(problem, "there is no memory for an instance");
        return NULL;
    }
    instance->name = strcpy(kept_name, name);
    for (size_t i = 0; i < WING_LOG_CATEGORIES; ++i) {
        instance->logged[i] = true;
    }
    bool made = wing_model_read(&instance->model, data_file, problem);
    if (made && (instance->model.output_count != WING_GAUGE_COUNT + 1 ||
                 instance->model.mode_count < WING_OUTPUT_MODES ||
                 instance->model.regions + 2 != WING_INPUT_COUNT)) {
        made = wing_fail(problem, "%s belongs to another FMU: %lu outputs, %lu modes and %lu damage regions",
                         data_file, (unsigned long)instance->model.output_count,
                         (unsigned long)instance->model.mode_count, (unsigned long)instance->model.regions);
    }
    if (!made || !wing_behaviour_make(&instance->behaviour, &instance->model, problem)) {
        wing_instance_free(instance);
        return NULL;
    }
    wing_instance_reset(instance);
    return instance;
}

void wing_instance_free(wing_instance *instance) {
    if (instance != NULL) {
        wing_behaviour_free(&instance->behaviour);
        wing_model_free(&instance->model);
        free(instance->name);
        free(instance);
    }
}

void wing_instance_reset(wing_instance *instance) {
    wing_behaviour_reset(&instance->behaviour);
    instance->phase = WING_INSTANTIATED;
    instance->time = 0.0;
    instance->discarded = false;
    for (size_t i = 0; i < WING_VARIABLE_COUNT; ++i) {
        instance->values[i] = wing_variables[i].start;
    }
    instance->stale_response = instance->stale_bound = instance->stale_modal = true;
}

fmi2Status wing_refuse(wing_instance *instance, int status, const char *format, ...) {
    wing_problem problem;
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(problem.text, sizeof problem.text, format, arguments);
    va_end(arguments);
    instance->values[WING_STATUS] = status;
    const bool discard = instance->phase == WING_READY && status != WING_STATUS_BAD_STATE;
    const fmi2Status level = discard ? fmi2Discard : fmi2Error;
    if (instance->logged[discard ? WING_LOG_DISCARD : WING_LOG_ERROR] || instance->logged[WING_LOG_ALL]) {
        wing_log(instance->logger, instance->environment, instance->name, level, problem.text);
    }
    return level;
}

/* ---------------------------------------------------------------- ranges and parameters */

static fmi2Status check_range(wing_instance *instance, size_t first, size_t last, const char *consequence) {
    for (size_t i = first; i < last; ++i) {
        const wing_variable *variable = &wing_variables[i];
        const double value = instance->values[i];
        if (!isfinite(value)) {
            return wing_refuse(instance, WING_STATUS_NOT_FINITE, "%s is %g, which is not finite; %s",
                               variable->name, value, consequence);
        }
        if (value < variable->minimum || value > variable->maximum) {
            return wing_refuse(instance, WING_STATUS_OUTSIDE_RANGE,
                               "%s = %.17g lies outside its range %g to %g%s%s; %s", variable->name, value,
                               variable->minimum, variable->maximum, *variable->unit == '\0' ? "" : " ",
                               variable->unit, consequence);
        }
    }
    return fmi2OK;
}

static wing_parameters parameters_of(const double *values) {
    const wing_parameters parameters = {
        .young_modulus_factor = values[WING_YOUNG_MODULUS_FACTOR],
        .damping_alpha = values[WING_DAMPING_ALPHA],
        .damping_beta = values[WING_DAMPING_BETA],
        .servo_mass = values[WING_MASS_SERVO],
        .pitot_mass = values[WING_MASS_PITOT],
        .initial_tip_displacement = values[WING_INITIAL_TIP_DISPLACEMENT],
        .transient = values[WING_RESPONSE] == WING_RESPONSE_TRANSIENT,
    };
    return parameters;
}


static void accept_outputs(wing_instance *instance) {
    memcpy(instance->values + WING_STRAIN_1, instance->outputs, WING_GAUGE_COUNT * sizeof *instance->outputs);
    instance->values[WING_TIP_DISPLACEMENT] = instance->outputs[WING_GAUGE_COUNT];
    instance->values[WING_STATUS] = WING_STATUS_OK;
    instance->stale_response = false;
    instance->stale_bound = instance->stale_modal = true;
}

/* ---------------------------------------------------------------- life of an instance */

fmi2Status wing_setup(wing_instance *instance, double start_time) {
    if (!isfinite(start_time)) {
        return wing_refuse(instance, WING_STATUS_NOT_FINITE, "the start time is %g; it must be finite",
                           start_time);
    }
    instance->time = start_time;
    return fmi2OK;
}

fmi2Status wing_enter_initialisation(wing_instance *instance) {
    if (instance->phase != WING_INSTANTIATED && instance->phase != WING_REFUSED) {
        return wing_refuse(instance, WING_STATUS_BAD_CALL,
                           "initialisation was entered a second time; reset the FMU first");
    }
    instance->phase = WING_INITIALISING;
    return fmi2OK;
}

static fmi2Status initialise(wing_instance *instance) {
    const fmi2Status range = check_range(instance, 0, WING_FIRST_OUTPUT, "the initialisation was refused");
    if (range != fmi2OK) {
        return range;
    }
    const wing_parameters parameters = parameters_of(instance->values);
    wing_problem problem;
    const double *inputs = instance->values; /* the first variables are the inputs in the behaviour's order */
    if (!wing_behaviour_start(&instance->behaviour, &parameters, inputs, instance->outputs, &problem)) {
        return wing_refuse(instance, WING_STATUS_INTERNAL, "the initialisation failed: %s", problem.text);
    }
    accept_outputs(instance);
    return fmi2OK;
}

fmi2Status wing_exit_initialisation(wing_instance *instance) {
    if (instance->phase != WING_INITIALISING) {
        return wing_refuse(instance, WING_STATUS_BAD_CALL,
                           "initialisation was left without having been entered");
    }
    const fmi2Status status = initialise(instance);
    instance->phase = status == fmi2OK ? WING_READY : WING_REFUSED;
    return status;
}

static const char *phase_name(wing_phase phase) {
    switch (phase) {
    case WING_INSTANTIATED:
        return "before initialisation";
    case WING_INITIALISING:
        return "during initialisation";
    case WING_REFUSED:
        return "after an initialisation that was refused";
    case WING_TERMINATED:
        return "after termination";
    case WING_READY:
        break;
    }
    return "";
}

fmi2Status wing_step(wing_instance *instance, double time, double step_size) {
    instance->discarded = true; /* until it is done */
    if (instance->phase != WING_READY) {
        return wing_refuse(instance, WING_STATUS_BAD_CALL, "a step was asked for %s", phase_name(instance->phase));
    }
    if (!(step_size > 0.0) || !isfinite(step_size) || !isfinite(time)) {
        return wing_refuse(instance, WING_STATUS_BAD_STEP,
                           "the step from t = %.17g s over %.17g s was refused: the communication point must be "
                           "finite, the step size finite and positive",
                           time, step_size);
    }
    if (fabs(time - instance->time) > 1e-6 * step_size + 1e-9 * fabs(instance->time)) {
        return wing_refuse(instance, WING_STATUS_BAD_STEP,
                           "the step from t = %.17g s was refused: the FMU stands at t = %.17g s", time,
                           instance->time);
    }
    const fmi2Status range =
        check_range(instance, 0, WING_INPUT_COUNT, "the step was refused and the state is as it was");
    if (range != fmi2OK) {
        return range;
    }
    wing_problem problem;
    const double *inputs = instance->values; /* the first variables are the inputs in the behaviour's order */
    if (!wing_behaviour_advance(&instance->behaviour, inputs, step_size, instance->outputs, &problem)) {
        return wing_refuse(instance, WING_STATUS_INTERNAL, "the step from t = %g s failed: %s", time,
                           problem.text);
    }
    instance->time = time + step_size;
    instance->discarded = false;
    accept_outputs(instance);
    return fmi2OK;
}

/* ---------------------------------------------------------------- values */

fmi2Status wing_set(wing_instance *instance, unsigned int reference, double value, bool enumeration) {
    if (reference >= WING_VARIABLE_COUNT || reference >= WING_FIRST_OUTPUT ||
        wing_variables[reference].enumeration != enumeration) {
        return wing_refuse(instance, WING_STATUS_BAD_CALL, "%s (value reference %u) cannot be set%s",
                           reference < WING_VARIABLE_COUNT ? wing_variables[reference].name
                                                           : "an unknown variable",
                           reference, enumeration ? " as an integer" : "");
    }
    if (reference >= WING_INPUT_COUNT && (instance->phase == WING_READY || instance->phase == WING_TERMINATED)) {
        return wing_refuse(instance, WING_STATUS_BAD_CALL,
                           "%s is a fixed parameter and can be set only before the first step",
                           wing_variables[reference].name);
    }
    instance->values[reference] = value;
    instance->stale_response = true;
    return fmi2OK;
}

const wing_variable *wing_readable(wing_instance *instance, unsigned int reference, bool enumeration) {
    if (reference < WING_VARIABLE_COUNT && wing_variables[reference].enumeration == enumeration) {
        return &wing_variables[reference];
    }
    (void)wing_refuse(instance, WING_STATUS_BAD_CALL, "there is no %s variable with value reference %u",
                      enumeration ? "enumeration" : "real", reference);
    return NULL;
}

fmi2Status wing_update(wing_instance *instance, const unsigned int *references, size_t count) {
    unsigned int highest = 0;
    bool bound = false, load_point = false;
    for (size_t i = 0; i < count; ++i) {
        highest = references[i] > highest ? references[i] : highest;
        bound = bound || references[i] == WING_STRAIN_ERROR_BOUND;
        load_point = load_point || references[i] == WING_LOAD_POINT_DISPLACEMENT;
    }
    if (highest < WING_FIRST_OUTPUT) {
        return fmi2OK;
    }
    if (instance->stale_response && instance->phase == WING_INITIALISING) {
        const fmi2Status status = initialise(instance);
        if (status != fmi2OK) {
            return status;
        }
    }
    if (instance->phase == WING_INSTANTIATED || instance->phase == WING_REFUSED) {
        return fmi2OK;
    }
    wing_problem problem;
    if (bound && instance->stale_bound) {
        if (!wing_behaviour_error_bound(&instance->behaviour, &instance->values[WING_STRAIN_ERROR_BOUND],
                                        &problem)) {
            return wing_refuse(instance, WING_STATUS_INTERNAL, "values could not be read: %s", problem.text);
        }
        instance->stale_bound = false;
    }
    if (load_point && !wing_behaviour_load_point(&instance->behaviour,
                                                 &instance->values[WING_LOAD_POINT_DISPLACEMENT], &problem)) {
        return wing_refuse(instance, WING_STATUS_INTERNAL, "values could not be read: %s", problem.text);
    }
    if (highest >= WING_FREQUENCY_1 && instance->stale_modal) {
        double *frequency = instance->values + WING_FREQUENCY_1;
        if (!wing_behaviour_modal_data(&instance->behaviour, WING_OUTPUT_MODES, frequency,
                                       frequency + WING_OUTPUT_MODES, &problem)) {
            return wing_refuse(instance, WING_STATUS_INTERNAL, "values could not be read: %s", problem.text);
        }
        instance->stale_modal = false;
    }
    return fmi2OK;
}

/* ---------------------------------------------------------------- state */

bool wing_save(const wing_instance *instance, wing_saved_state *saved) {
    const size_t most = SAVED_HEAD + WING_VARIABLE_COUNT + wing_behaviour_state_size(&instance->behaviour);
    double *body = calloc(most, sizeof *body);
    if (body == NULL) {
        return false;
    }
    body[0] = (double)instance->phase;
    body[1] = instance->time;
    body[2] = instance->stale_response ? 1.0 : 0.0;
    body[3] = instance->stale_bound ? 1.0 : 0.0;
    body[4] = instance->stale_modal ? 1.0 : 0.0;
    memcpy(body + SAVED_HEAD, instance->values, sizeof instance->values);
    saved->body = body;
    saved->count = SAVED_HEAD + WING_VARIABLE_COUNT +
                   wing_behaviour_save(&instance->behaviour, body + SAVED_HEAD + WING_VARIABLE_COUNT);
    return true;
}

fmi2Status wing_restore(wing_instance *instance, const wing_saved_state *saved) {
    const double *body = saved->body;
    wing_problem problem;
    if (saved->count <= SAVED_HEAD + WING_VARIABLE_COUNT || !(body[0] >= 0.0 && body[0] <= WING_TERMINATED) ||
        !isfinite(body[1])) {
        return wing_refuse(instance, WING_STATUS_BAD_STATE, "the FMU state was not restored: it is damaged");
    }
    const double *values = body + SAVED_HEAD, *rest = values + WING_VARIABLE_COUNT;
    const wing_parameters parameters = parameters_of(values);
    if (!wing_behaviour_restore(&instance->behaviour, &parameters, rest,
                                saved->count - SAVED_HEAD - WING_VARIABLE_COUNT, &problem)) {
        return wing_refuse(instance, WING_STATUS_BAD_STATE, "the FMU state was not restored: %s", problem.text);
    }
    instance->phase = (wing_phase)(int)body[0];
    instance->time = body[1];
    instance->discarded = false;
    instance->stale_response = body[2] != 0.0;
    instance->stale_bound = body[3] != 0.0;
    instance->stale_modal = body[4] != 0.0;
    memcpy(instance->values, values, sizeof instance->values);
    return fmi2OK;
}
