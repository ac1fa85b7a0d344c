/* An instance of a structure as a co-simulation slave: values, phases, refusals, log and saved state.

   What cannot be done is logged, named by the output `status`, and leaves state and outputs as they were. */
#ifndef STRUCTURE_INSTANCE_H
#define STRUCTURE_INSTANCE_H

#include "fmi2FunctionTypes.h"
#include "structure_behaviour.h"
#include "structure_variables.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef enum {
    STRUCTURE_INSTANTIATED,
    STRUCTURE_INITIALISING,
    STRUCTURE_READY,
    STRUCTURE_REFUSED, /* an initialisation that was not accepted */
    STRUCTURE_TERMINATED
} structure_phase;

typedef struct {
    char *name;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    bool logged[STRUCTURE_LOG_CATEGORIES];
    structure_model model;
    structure_behaviour behaviour;
    structure_phase phase;
    double time;
    bool discarded; /* the last step was refused */
    double values[STRUCTURE_VARIABLE_COUNT]; /* by value reference */
    double outputs[STRUCTURE_OUTPUT_COUNT];
    double chosen[STRUCTURE_CHOSEN_COUNT]; /* of the values, in the order of the model */
    /* Outputs that are computed when somebody reads them, since most masters do not. */
    bool stale_response;
    bool stale_bound;
    bool stale_modal;
} structure_instance;

typedef struct {
    size_t count;
    double *body;
} structure_saved_state;

/* Log through a host's logger without an instance. */
void structure_log(fmi2CallbackLogger logger, fmi2ComponentEnvironment environment, const char *name,
              fmi2Status status, const char *sentence);

/* Make an instance from a data file; NULL with the problem. The caller frees it with `structure_instance_free`. */
structure_instance *structure_instance_make(const char *name, const char *data_file, structure_problem *problem);
void structure_instance_free(structure_instance *instance);

/* Bring the instance back to the moment after it was made. */
void structure_instance_reset(structure_instance *instance);

/* Refuse a call: log the sentence, set `status`, and return Discard while stepping, Error otherwise. */
fmi2Status structure_refuse(structure_instance *instance, int status, const char *format, ...);

fmi2Status structure_setup(structure_instance *instance, double start_time);
fmi2Status structure_enter_initialisation(structure_instance *instance);
fmi2Status structure_exit_initialisation(structure_instance *instance);
fmi2Status structure_step(structure_instance *instance, double time, double step_size);

fmi2Status structure_set(structure_instance *instance, unsigned int reference, double value, bool enumeration);

/* Bring the outputs that a reading concerns up to date. */
fmi2Status structure_update(structure_instance *instance, const unsigned int *references, size_t count);

/* Return the variable of a reference, if it is of that kind; NULL, refused, if not. */
const structure_variable *structure_readable(structure_instance *instance, unsigned int reference, bool enumeration);

/* The state as numbers, to be freed by the caller; false without memory. */
bool structure_save(const structure_instance *instance, structure_saved_state *saved);
fmi2Status structure_restore(structure_instance *instance, const structure_saved_state *saved);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
