/* An instance of the wing as a co-simulation slave: values, phases, refusals, log and saved state.

   What cannot be done is logged, named by the output `status`, and leaves state and outputs as they were. */
#ifndef WING_INSTANCE_H
#define WING_INSTANCE_H

#include "fmi2FunctionTypes.h"
#include "wing_behaviour.h"
#include "wing_variables.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef enum {
    WING_INSTANTIATED,
    WING_INITIALISING,
    WING_READY,
    WING_REFUSED, /* an initialisation that was not accepted */
    WING_TERMINATED
} wing_phase;

typedef struct {
    char *name;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    bool logged[WING_LOG_CATEGORIES];
    wing_model model;
    wing_behaviour behaviour;
    wing_phase phase;
    double time;
    bool discarded; /* the last step was refused */
    double values[WING_VARIABLE_COUNT]; /* by value reference */
    double outputs[WING_GAUGE_COUNT + 1];
    /* Outputs that are computed when somebody reads them, since most masters do not. */
    bool stale_response;
    bool stale_bound;
    bool stale_modal;
} wing_instance;

typedef struct {
    size_t count;
    double *body;
} wing_saved_state;

/* Log through a host's logger without an instance. */
void wing_log(fmi2CallbackLogger logger, fmi2ComponentEnvironment environment, const char *name,
              fmi2Status status, const char *sentence);

/* Make an instance from a data file; NULL with the problem. The caller frees it with `wing_instance_free`. */
wing_instance *wing_instance_make(const char *name, const char *data_file, wing_problem *problem);
void wing_instance_free(wing_instance *instance);

/* Bring the instance back to the moment after it was made. */
void wing_instance_reset(wing_instance *instance);

/* Refuse a call: log the sentence, set `status`, and return Discard while stepping, Error otherwise. */
fmi2Status wing_refuse(wing_instance *instance, int status, const char *format, ...);

fmi2Status wing_setup(wing_instance *instance, double start_time);
fmi2Status wing_enter_initialisation(wing_instance *instance);
fmi2Status wing_exit_initialisation(wing_instance *instance);
fmi2Status wing_step(wing_instance *instance, double time, double step_size);

fmi2Status wing_set(wing_instance *instance, unsigned int reference, double value, bool enumeration);

/* Bring the outputs that a reading concerns up to date. */
fmi2Status wing_update(wing_instance *instance, const unsigned int *references, size_t count);

/* Return the variable of a reference, if it is of that kind; NULL, refused, if not. */
const wing_variable *wing_readable(wing_instance *instance, unsigned int reference, bool enumeration);

/* The state as numbers, to be freed by the caller; false without memory. */
bool wing_save(const wing_instance *instance, wing_saved_state *saved);
fmi2Status wing_restore(wing_instance *instance, const wing_saved_state *saved);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
