#include <stdio.h>
#include "fmi3Functions.h"
#include "model.h"

#define M ((Model *)c)
#define VR const fmi3ValueReference vr[], size_t nvr

HOOK void model_start(Model *m) {}
HOOK int model_initialise(Model *m) { return OK; }
HOOK int model_take_text(Model *m, unsigned int reference, const char *text) { return ERROR; }
HOOK int model_step(Model *m, double time, double size) { return OK; }
HOOK void model_outputs(Model *m) {}
HOOK void model_derivatives(Model *m, double *dx) {}
HOOK void model_event_indicators(Model *m, double *z) {}
HOOK void model_event(Model *m, int *due, double *time) {}
HOOK int model_early(Model *m) { return 0; }
HOOK int model_configure(Model *m, int begins) { return ERROR; }
HOOK int model_finished(Model *m) { return 0; }

typedef struct { fmi3LogMessageCallback log; fmi3InstanceEnvironment environment; } Messenger;

void model_say(Model *m, int status, const char *text) {
    Messenger *messenger = m->parts[0];
    messenger->log(messenger->environment, (fmi3Status)status, "model", text);
}
static fmi3Instance make(fmi3String name, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    Model *m = calloc(1, sizeof(Model));
    Messenger *messenger = calloc(1, sizeof(Messenger));
    messenger->log = log;
    messenger->environment = environment;
    m->parts[0] = messenger;
    snprintf(m->name, sizeof m->name, "%s", name);
    model_start(m);
    return m;
}
const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String names[]) { return fmi3OK; }
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    return make(name, environment, log);
}
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference vr[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    return make(name, environment, log);
}
fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) {
    return NULL;
}
void fmi3FreeInstance(fmi3Instance c) { free(M->parts[0]); free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean t, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean s, fmi3Float64 stop) {
    M->time = start;
    return (fmi3Status)experiment_status(M, s, stop);
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return (fmi3Status)model_initialise(M); }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) {
    memset(M->r, 0, sizeof M->r); memset(M->i, 0, sizeof M->i); memset(M->b, 0, sizeof M->b);
    M->stepped = 0;
    model_start(M);
    return fmi3OK;
}
/* reals are found by model_locate; integers begin at reference 100, Booleans at 200 */
#define REALS(NAME, TYPE) \
    fmi3Status fmi3Get##NAME(fmi3Instance c, VR, TYPE values[], size_t n) { \
        size_t next = 0; \
        model_outputs(M); \
        for (size_t k = 0; k < nvr; k++) { \
            int first, count; \
            if (!model_locate(vr[k], &first, &count)) return fmi3Error; \
            for (int j = 0; j < count; j++) values[next++] = (TYPE)M->r[first + j]; \
        } \
        return next == n ? fmi3OK : fmi3Error; \
    } \
    fmi3Status fmi3Set##NAME(fmi3Instance c, VR, const TYPE values[], size_t n) { \
        size_t next = 0; \
        for (size_t k = 0; k < nvr; k++) { \
            int first, count; \
            if (!model_locate(vr[k], &first, &count)) return fmi3Error; \
            for (int j = 0; j < count; j++) M->r[first + j] = values[next++]; \
        } \
        return next == n ? fmi3OK : fmi3Error; \
    }
REALS(Float32, fmi3Float32) REALS(Float64, fmi3Float64)
#define WHOLE(NAME, TYPE, FIELD, BEGIN) \
    fmi3Status fmi3Get##NAME(fmi3Instance c, VR, TYPE values[], size_t n) { \
        model_outputs(M); \
        for (size_t k = 0; k < nvr; k++) values[k] = (TYPE)M->FIELD[vr[k] - BEGIN]; \
        return fmi3OK; \
    } \
    fmi3Status fmi3Set##NAME(fmi3Instance c, VR, const TYPE values[], size_t n) { \
        for (size_t k = 0; k < nvr; k++) M->FIELD[vr[k] - BEGIN] = (int)values[k]; \
        return fmi3OK; \
    }
WHOLE(Int8, fmi3Int8, i, 100) WHOLE(UInt8, fmi3UInt8, i, 100) WHOLE(Int16, fmi3Int16, i, 100)
WHOLE(UInt16, fmi3UInt16, i, 100) WHOLE(Int32, fmi3Int32, i, 100) WHOLE(UInt32, fmi3UInt32, i, 100)
WHOLE(Int64, fmi3Int64, i, 100) WHOLE(UInt64, fmi3UInt64, i, 100) WHOLE(Boolean, fmi3Boolean, b, 200)
fmi3Status fmi3GetString(fmi3Instance c, VR, fmi3String values[], size_t n) { return fmi3Error; }
fmi3Status fmi3SetString(fmi3Instance c, VR, const fmi3String values[], size_t n) {
    for (size_t k = 0; k < nvr; k++) if (model_take_text(M, vr[k], values[k]) != OK) return fmi3Error;
    return fmi3OK;
}
fmi3Status fmi3GetBinary(fmi3Instance c, VR, size_t sizes[], fmi3Binary values[], size_t n) { return fmi3Error; }
fmi3Status fmi3SetBinary(fmi3Instance c, VR, const size_t sizes[], const fmi3Binary values[], size_t n) { return fmi3Error; }
fmi3Status fmi3GetClock(fmi3Instance c, VR, fmi3Clock values[]) { return fmi3Error; }
fmi3Status fmi3SetClock(fmi3Instance c, VR, const fmi3Clock values[]) { return fmi3Error; }

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    if (*state == NULL) *state = calloc(1, sizeof(Model));
    memcpy(*state, c, sizeof(Model));
    return fmi3OK;
}
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    Model *copy = state;
    memcpy(copy->parts, M->parts, sizeof copy->parts);
    memcpy(copy->name, M->name, sizeof copy->name);
    memcpy(c, copy, sizeof(Model));
    return fmi3OK;
}
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) { free(*state); *state = NULL; return fmi3OK; }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) { *size = sizeof(Model); return fmi3OK; }
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) { memcpy(bytes, state, size); return fmi3OK; }
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    *state = calloc(1, sizeof(Model));
    memcpy(*state, bytes, size);
    return fmi3OK;
}
/* what none of the test models has */
#define NO(NAME, ...) fmi3Status fmi3##NAME(fmi3Instance c, __VA_ARGS__) { return fmi3Error; }
NO(GetNumberOfVariableDependencies, fmi3ValueReference vr, size_t *n)
NO(GetVariableDependencies, fmi3ValueReference d, size_t a[], fmi3ValueReference i[], size_t b[], fmi3DependencyKind k[], size_t n)
NO(GetDirectionalDerivative, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns, fmi3Float64 d[], size_t nd)
NO(GetAdjointDerivative, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns, fmi3Float64 d[], size_t nd)
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return (fmi3Status)model_configure(M, 1); }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return (fmi3Status)model_configure(M, 0); }
NO(GetIntervalDecimal, VR, fmi3Float64 i[], fmi3IntervalQualifier q[])
NO(GetIntervalFraction, VR, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[])
NO(GetShiftDecimal, VR, fmi3Float64 s[])
NO(GetShiftFraction, VR, fmi3UInt64 a[], fmi3UInt64 b[])
NO(SetIntervalDecimal, VR, const fmi3Float64 i[])
NO(SetIntervalFraction, VR, const fmi3UInt64 a[], const fmi3UInt64 b[])
NO(SetShiftDecimal, VR, const fmi3Float64 s[])
NO(SetShiftFraction, VR, const fmi3UInt64 a[], const fmi3UInt64 b[])
NO(GetOutputDerivatives, VR, const fmi3Int32 orders[], fmi3Float64 values[], size_t n)
NO(ActivateModelPartition, fmi3ValueReference clock, fmi3Float64 time)
fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *more, fmi3Boolean *end, fmi3Boolean *nominals, fmi3Boolean *values,
                                    fmi3Boolean *defined, fmi3Float64 *next) {
    int due = 0;
    *more = *end = *nominals = *values = false;
    model_event(M, &due, next);
    *defined = due;
    *end = M->i[14];
    return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *end) { *event = *end = false; return fmi3OK; }
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) { M->time = time; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) { memcpy(M->r, x, n * sizeof(double)); return fmi3OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { model_derivatives(M, dx); return fmi3OK; }
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { model_event_indicators(M, z); return fmi3OK; }
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { memcpy(x, M->r, n * sizeof(double)); return fmi3OK; }
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = 1.0;
    return fmi3OK;
}
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { return fmi3Error; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { return fmi3Error; }
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *reached) {
    int status = model_step(M, time, size);
    *event = false;
    *end = model_finished(M);
    *early = model_early(M);
    *reached = *early ? time + 0.5 * size : time + size;
    if (status <= WARNING) { M->time = time + size; M->stepped++; }
    return (fmi3Status)status;
}
