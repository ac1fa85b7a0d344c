#include <stdio.h>
#include "fmi2Functions.h"
#include "model.h"

HOOK void model_start(Model *m) {}
HOOK int model_initialise(Model *m) { return OK; }
HOOK int model_take_text(Model *m, unsigned int reference, const char *text) { return ERROR; }
HOOK int model_input_slope(Model *m, unsigned int reference, double slope) { return ERROR; }
HOOK int model_step(Model *m, double time, double size) { return OK; }
HOOK void model_outputs(Model *m) {}
HOOK void model_derivatives(Model *m, double *dx) {}
HOOK void model_event_indicators(Model *m, double *z) {}
HOOK void model_event(Model *m, int *due, double *time) {}
HOOK void model_free(Model *m) {}
HOOK void *frame_instance(Model *m) { return m; }
HOOK int frame_get_state(Model *m, Model *copy) { *copy = *m; return OK; }
HOOK int frame_set_state(Model *m, const Model *copy) { *m = *copy; return OK; }

#define M ((Model *)c)
#ifndef NOMINAL
#define NOMINAL 1.0
#endif
static const fmi2CallbackFunctions *callbacks(Model *m) { return m->parts[0]; }

void model_say(Model *m, int status, const char *text) {
    callbacks(m)->logger(callbacks(m)->componentEnvironment, m->name, (fmi2Status)status, "model", "%s", text);
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) { return fmi2OK; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    Model *m = calloc(1, sizeof(Model));
    m->parts[0] = (void *)functions;
    snprintf(m->name, sizeof m->name, "%s", name);
    model_start(m);
    return frame_instance(m);
}
void fmi2FreeInstance(fmi2Component c) { model_free(M); free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean t, fmi2Real tolerance, fmi2Real start, fmi2Boolean s, fmi2Real stop) {
    M->time = start;
    M->r[63] = t ? tolerance : 0.0;
    return (fmi2Status)experiment_status(M, s, stop);
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
#ifdef NEGATIVE_STATUS_AT_THE_START
    return -1;
#endif
    return fmi2OK;
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return (fmi2Status)model_initialise(M); }
fmi2Status fmi2Terminate(fmi2Component c) {
    M->i[15] = 1;
    return fmi2OK;
}
fmi2Status fmi2Reset(fmi2Component c) {
#ifdef RESET_DOES_NOTHING
    return fmi2OK;
#endif
    Model fresh = {0};
    memcpy(fresh.parts, M->parts, sizeof fresh.parts);
    memcpy(fresh.name, M->name, sizeof fresh.name);
    *M = fresh;
    model_start(M);
    return fmi2OK;
}
#define GET(NAME, TYPE, FIELD) \
    fmi2Status fmi2Get##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, TYPE value[]) { \
        model_outputs(M); \
        for (size_t k = 0; k < n; k++) value[k] = M->FIELD[vr[k]]; \
        return fmi2OK; \
    }
#define SET(NAME, TYPE, FIELD) \
    fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, const TYPE value[]) { \
        for (size_t k = 0; k < n; k++) M->FIELD[vr[k]] = value[k]; \
        return fmi2OK; \
    }
GET(Real, fmi2Real, r) SET(Real, fmi2Real, r)
GET(Integer, fmi2Integer, i) SET(Integer, fmi2Integer, i)
GET(Boolean, fmi2Boolean, b) SET(Boolean, fmi2Boolean, b)
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]) { return fmi2Error; }
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]) {
    for (size_t k = 0; k < n; k++) if (model_take_text(M, vr[k], value[k]) != OK) return fmi2Error;
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (*state == NULL) *state = calloc(1, sizeof(Model));
    return (fmi2Status)frame_get_state(M, *state);
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { return (fmi2Status)frame_set_state(M, state); }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) { free(*state); *state = NULL; return fmi2OK; }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) { *size = sizeof(Model); return fmi2OK; }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    memcpy(bytes, state, sizeof(Model));
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    Model *copy = calloc(1, sizeof(Model));
    memcpy(copy, bytes, sizeof(Model));
    /* pointers and names belong to the instance, not to the state */
    memcpy(copy->parts, M->parts, sizeof copy->parts);
    memcpy(copy->name, M->name, sizeof copy->name);
    *state = copy;
    return fmi2OK;
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference u[], size_t nu, const fmi2ValueReference k[], size_t nk, const fmi2Real dk[], fmi2Real du[]) { return fmi2Error; }
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]) {
    for (size_t k = 0; k < n; k++)
        if (order[k] != 1 || model_input_slope(M, vr[k], value[k]) != OK) return fmi2Error;
    return fmi2OK;
}
fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real value[]) { return fmi2Error; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real size, fmi2Boolean no_return) {
#ifdef STANDS_STILL_ONCE_TERMINATED
    if (M->i[15]) return fmi2OK;
#endif
    int status = model_step(M, time, size);
    if (status == OK || status == WARNING) {
        M->time = time + size;
        M->stepped++;
    }
    return (fmi2Status)status;
}
fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2Error; }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) { return fmi2Discard; }
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    *value = M->time;
    return M->i[14] && s == fmi2LastSuccessfulTime ? fmi2OK : fmi2Discard;
}
fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) { return fmi2Discard; }
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    *value = 1;
    return M->i[14] && s == fmi2Terminated ? fmi2OK : fmi2Discard;
}
fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) { return fmi2Discard; }

fmi2Status fmi2EnterEventMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    int due = 0;
    memset(info, 0, sizeof *info);
    model_event(M, &due, &info->nextEventTime);
    info->nextEventTimeDefined = due;
    info->terminateSimulation = M->i[14];
    return fmi2OK;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *end) { *event = *end = 0; return fmi2OK; }
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { M->time = time; return fmi2OK; }
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) { memcpy(M->r, x, n * sizeof(double)); return fmi2OK; }
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) { model_derivatives(M, dx); return fmi2OK; }
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { model_event_indicators(M, z); return fmi2OK; }
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { memcpy(x, M->r, n * sizeof(double)); return fmi2OK; }
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = NOMINAL;
    return fmi2OK;
}
