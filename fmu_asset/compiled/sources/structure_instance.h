/* An instance of a structure as a co-simulation slave: values, phases, refusals, log and saved state.

   What cannot be done is logged, named by the output `status`, and leaves state and outputs as they were. */
#ifndef STRUCTURE_INSTANCE_H
#define STRUCTURE_INSTANCE_H

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

/* What became of a call; the numbers are those of the statuses of FMI 2 and 3. */
typedef enum { STRUCTURE_DONE = 0, STRUCTURE_DISCARD = 2, STRUCTURE_ERROR = 3 } structure_result;

/* The host's logger, of which every version of FMI has its own. */
typedef struct structure_host {
    void (*log)(const struct structure_host *host, const char *name, structure_result result, const char *category,
                const char *sentence);
    void (*callback)(void);
    void *environment;
} structure_host;

typedef struct {
    char *name;
    structure_host host;
    bool logged[STRUCTURE_LOG_CATEGORIES];
    structure_model model;
    structure_behaviour behaviour;
    structure_phase phase;
    double time;
    bool discarded; /* the last step was refused */
    double values[STRUCTURE_VARIABLE_COUNT]; /* by value reference */
    double outputs[STRUCTURE_OUTPUT_COUNT];
    double chosen[STRUCTURE_CHOSEN_COUNT]; /* of the values, in the order of the model */
    double slopes[STRUCTURE_INPUT_COUNT];  /* of inputs over the next step */
    bool sloping;                          /* whether one is not zero */
    /* Outputs that are computed when somebody reads them, since most masters do not. */
    bool stale_response;
    bool stale_bound;
    bool stale_modal;
    /* Of model exchange: whether it is in event mode, and whether an event has changed the states since it was told. */
    bool event_mode;
    bool states_changed;
} structure_instance;

typedef struct {
    size_t count;
    double *body;
} structure_saved_state;

/* Log through a host's logger without an instance. */
void structure_log(const structure_host *host, const char *name, structure_result result, const char *sentence);

/* Make an instance of the data file in a folder, if the token is that of this FMU; NULL, logged, if not. The caller
   frees it with `structure_instance_free`. */
structure_instance *structure_instance_open(const structure_host *host, const char *name, const char *token,
                                            const char *folder);
void structure_instance_free(structure_instance *instance);

/* Switch categories of log messages; all of them where none is named. */
void structure_instance_log(structure_instance *instance, bool on, size_t count, const char *const *categories);

/* Bring the instance back to the moment after it was made. */
void structure_instance_reset(structure_instance *instance);

/* Refuse a call: log the sentence, set `status`, and return Discard while stepping, Error otherwise. */
structure_result structure_refuse(structure_instance *instance, int status, const char *format, ...);

structure_result structure_setup(structure_instance *instance, double start_time);
structure_result structure_enter_initialisation(structure_instance *instance);
structure_result structure_exit_initialisation(structure_instance *instance);
structure_result structure_step(structure_instance *instance, double time, double step_size);

/* Set or read the values that references stand for, one after another; of an array all of them. A reading brings
   up to date what it concerns. */
structure_result structure_set(structure_instance *instance, const unsigned int *references, size_t count,
                               const double *values, size_t value_count, bool enumeration);
structure_result structure_get(structure_instance *instance, const unsigned int *references, size_t count,
                               double *values, size_t value_count, bool enumeration);

/* Set the first derivatives in time of inputs, for the next step alone. */
structure_result structure_set_slopes(structure_instance *instance, const unsigned int *references, size_t count,
                                      const int *orders, const double *slopes);

/* How many values a reference stands for, or zero, refused, if it is of no variable of that kind. */
size_t structure_length(structure_instance *instance, unsigned int reference, bool enumeration);

/* Bring the outputs that a reading concerns up to date. */
structure_result structure_update(structure_instance *instance, const unsigned int *references, size_t count);

/* Model exchange. Health is discrete: it can be set in event mode, and `structure_event` then expresses the motion in
   its modes. States are the modal coordinates and their rates, which can be set where there are as many. */
structure_result structure_event(structure_instance *instance, bool *states_changed);
structure_result structure_set_states(structure_instance *instance, const double *states, size_t count);
structure_result structure_get_states(structure_instance *instance, double *states, size_t count);
structure_result structure_get_rates(structure_instance *instance, double *rates, size_t count);
void structure_nominals(double *nominals, size_t count);

/* The state as numbers, to be freed by the caller; false without memory. */
bool structure_save(const structure_instance *instance, structure_saved_state *saved);
structure_result structure_restore(structure_instance *instance, const structure_saved_state *saved);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
