/* A model as the test FMUs see it. Each frame (frame1.c, frame2.c, frame3.c) speaks one FMI version for
   co-simulation and model exchange; a model file overrides the hooks that it needs. */
#ifndef MODEL_H
#define MODEL_H
#include <stdlib.h>
#include <string.h>

typedef struct {
    double time;
    double r[64]; /* reals: the continuous states first */
    int i[16]; /* 14: the model ends the simulation */
    int b[16];
    int stepped; /* number of steps made */
    void *parts[4]; /* what a frame needs */
    char name[256];
} Model;

enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING };

#define HOOK __attribute__((weak, visibility("hidden")))

void model_start(Model *m);                          /* start values */
int model_initialise(Model *m);                      /* status */
int model_configure(Model *m, int begins);           /* FMI 3: configuration mode begins or ends; status */
int model_input_slope(Model *m, unsigned int reference, double slope); /* status */
int model_take_text(Model *m, unsigned int reference, const char *text); /* status */
int model_step(Model *m, double time, double size);  /* status */
void model_outputs(Model *m);                        /* before values are read */
void model_derivatives(Model *m, double *dx);
void model_event_indicators(Model *m, double *z);
void model_event(Model *m, int *due, double *time);  /* at an event, and at the start */
int model_locate(unsigned int reference, int *first, int *count); /* FMI 3: place and length in r */
void model_free(Model *m);
void model_say(Model *m, int status, const char *text); /* given by the frame */

/* Whether the end of the experiment is the one that -DWANTS_STOP_TIME=... asks for; a status. */
static inline int experiment_status(Model *m, int told, double stop) {
#ifdef WANTS_STOP_TIME
    if (!told || stop != WANTS_STOP_TIME) {
        model_say(m, ERROR, "the stop time must be given, in whole days");
        return ERROR;
    }
#endif
    return OK;
}
#endif
