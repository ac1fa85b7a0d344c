#include <stdio.h>
#include "fmi1Functions.h"
#include "model.h"

#define JOIN(A, B) A##B
#define NAME(A, B) JOIN(A, B)
#define F(X) NAME(IDENTIFIER, _fmi##X)
#define M ((Model *)c)

HOOK void model_start(Model *m) {}
HOOK int model_initialise(Model *m) { return OK; }
HOOK int model_take_text(Model *m, unsigned int reference, const char *text) { return ERROR; }
HOOK int model_input_slope(Model *m, unsigned int reference, double slope) { return ERROR; }
HOOK int model_step(Model *m, double time, double size) { return OK; }
HOOK void model_outputs(Model *m) {}
HOOK void model_derivatives(Model *m, double *dx) {}
HOOK void model_event_indicators(Model *m, double *z) {}
HOOK void model_event(Model *m, int *due, double *time) {}

void model_say(Model *m, int status, const char *text) {
    ((fmi1CallbackLogger)m->parts[0])(m, m->name, (fmi1Status)status, "model", "%s", text);
}
static fmi1Component make(fmi1String name, fmi1CallbackFunctions functions) {
    Model *m = calloc(1, sizeof(Model));
    m->parts[0] = (void *)functions.logger;
    snprintf(m->name, sizeof m->name, "%s", name);
    model_start(m);
    return m;
}
const char *F(GetVersion)(void) { return "1.0"; }
fmi1Status F(SetDebugLogging)(fmi1Component c, fmi1Boolean on) { return fmi1OK; }
#define GET(NAME_, TYPE, FIELD) \
    fmi1Status F(Get##NAME_)(fmi1Component c, const fmi1ValueReference vr[], size_t n, TYPE value[]) { \
        model_outputs(M); \
        for (size_t k = 0; k < n; k++) value[k] = (TYPE)M->FIELD[vr[k]]; \
        return fmi1OK; \
    }
#define SET(NAME_, TYPE, FIELD) \
    fmi1Status F(Set##NAME_)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const TYPE value[]) { \
        for (size_t k = 0; k < n; k++) M->FIELD[vr[k]] = value[k]; \
        return fmi1OK; \
    }
GET(Real, fmi1Real, r) SET(Real, fmi1Real, r)
GET(Integer, fmi1Integer, i) SET(Integer, fmi1Integer, i)
GET(Boolean, fmi1Boolean, b) SET(Boolean, fmi1Boolean, b)
fmi1Status F(GetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1String value[]) { return fmi1Error; }
fmi1Status F(SetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1String value[]) {
    for (size_t k = 0; k < n; k++) if (model_take_text(M, vr[k], value[k]) != OK) return fmi1Error;
    return fmi1OK;
}

#ifndef MODEL_EXCHANGE
const char *F(GetTypesPlatform)(void) { return "standard32"; }
fmi1Component F(InstantiateSlave)(fmi1String name, fmi1String guid, fmi1String location, fmi1String mime, fmi1Real timeout,
                                  fmi1Boolean visible, fmi1Boolean interactive, fmi1CallbackFunctions functions, fmi1Boolean logging) {
    return make(name, functions);
}
fmi1Status F(InitializeSlave)(fmi1Component c, fmi1Real start, fmi1Boolean defined, fmi1Real stop) {
    M->time = start;
    if (experiment_status(M, defined, stop) != OK) return fmi1Error;
    return (fmi1Status)model_initialise(M);
}
fmi1Status F(TerminateSlave)(fmi1Component c) { return fmi1OK; }
fmi1Status F(ResetSlave)(fmi1Component c) {
    memset(M->r, 0, sizeof M->r); memset(M->i, 0, sizeof M->i); memset(M->b, 0, sizeof M->b);
    M->stepped = 0;
    model_start(M);
    return fmi1OK;
}
void F(FreeSlaveInstance)(fmi1Component c) { free(c); }
fmi1Status F(SetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1Integer order[], const fmi1Real value[]) {
    for (size_t k = 0; k < n; k++)
        if (order[k] != 1 || model_input_slope(M, vr[k], value[k]) != OK) return fmi1Error;
    return fmi1OK;
}
fmi1Status F(GetRealOutputDerivatives)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1Integer order[], fmi1Real value[]) { return fmi1Error; }
fmi1Status F(CancelStep)(fmi1Component c) { return fmi1Error; }
fmi1Status F(DoStep)(fmi1Component c, fmi1Real time, fmi1Real size, fmi1Boolean new_step) {
    int status = model_step(M, time, size);
    if (status <= WARNING) { M->time = time + size; M->stepped++; }
    return (fmi1Status)status;
}
fmi1Status F(GetStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Status *value) { return fmi1Discard; }
fmi1Status F(GetRealStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Real *value) { return fmi1Discard; }
fmi1Status F(GetIntegerStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Integer *value) { return fmi1Discard; }
fmi1Status F(GetBooleanStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Boolean *value) { return fmi1Discard; }
fmi1Status F(GetStringStatus)(fmi1Component c, const fmi1StatusKind s, fmi1String *value) { return fmi1Discard; }
#else
const char *F(GetModelTypesPlatform)(void) { return "standard32"; }
fmi1Component F(InstantiateModel)(fmi1String name, fmi1String guid, fmi1CallbackFunctions functions, fmi1Boolean logging) {
    return make(name, functions);
}
void F(FreeModelInstance)(fmi1Component c) { free(c); }
fmi1Status F(SetTime)(fmi1Component c, fmi1Real time) { M->time = time; return fmi1OK; }
fmi1Status F(SetContinuousStates)(fmi1Component c, const fmi1Real x[], size_t n) { memcpy(M->r, x, n * sizeof(double)); return fmi1OK; }
fmi1Status F(CompletedIntegratorStep)(fmi1Component c, fmi1Boolean *event) { *event = 0; return fmi1OK; }
static fmi1Status update(Model *m, fmi1EventInfo *info) {
    int due = 0;
    memset(info, 0, sizeof *info);
    model_event(m, &due, &info->nextEventTime);
    info->upcomingTimeEvent = (fmi1Boolean)due;
    info->iterationConverged = 1;
    info->terminateSimulation = m->i[14];
    return fmi1OK;
}
fmi1Status F(Initialize)(fmi1Component c, fmi1Boolean controlled, fmi1Real tolerance, fmi1EventInfo *info) { return update(M, info); }
fmi1Status F(EventUpdate)(fmi1Component c, fmi1Boolean intermediate, fmi1EventInfo *info) { return update(M, info); }
fmi1Status F(GetDerivatives)(fmi1Component c, fmi1Real dx[], size_t n) { model_derivatives(M, dx); return fmi1OK; }
fmi1Status F(GetEventIndicators)(fmi1Component c, fmi1Real z[], size_t n) { model_event_indicators(M, z); return fmi1OK; }
fmi1Status F(GetContinuousStates)(fmi1Component c, fmi1Real x[], size_t n) { memcpy(x, M->r, n * sizeof(double)); return fmi1OK; }
fmi1Status F(GetNominalContinuousStates)(fmi1Component c, fmi1Real x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = 1.0;
    return fmi1OK;
}
fmi1Status F(GetStateValueReferences)(fmi1Component c, fmi1ValueReference vr[], size_t n) {
    for (size_t k = 0; k < n; k++) vr[k] = (fmi1ValueReference)k;
    return fmi1OK;
}
fmi1Status F(Terminate)(fmi1Component c) { return fmi1OK; }
#endif
