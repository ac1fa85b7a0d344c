/* The functions of FMI 2.0 for co-simulation or model exchange, on top of structure_instance. */
#include "fmi2Functions.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "structure_derivative.h"
#include "structure_state.h"

/* The pointer that a host gives back is the instance that it was given. */
static structure_instance *instance_of(fmi2Component component) { return (structure_instance *)component; }

static fmi2Status status_of(structure_result result) { return (fmi2Status)result; }

static void log_message(const structure_host *host, const char *name, structure_result result, const char *category,
                        const char *sentence) {
    /* Some hosts take the message for the text, others for a format: with every % doubled it is both, but for
       paths that hold one. */
    char format[2 * sizeof(((structure_problem *)0)->text)];
    size_t at = 0;
    for (; *sentence != '\0' && at + 3 < sizeof format; ++sentence) {
        if (*sentence == '%') {
            format[at++] = '%';
        }
        format[at++] = *sentence;
    }
    format[at] = '\0';
    const fmi2CallbackLogger logger = (fmi2CallbackLogger)host->callback;
    if (logger != NULL) {
        logger(host->environment, name, status_of(result), category, format);
    }
}

static int hexadecimal(char digit) {
    if (digit >= '0' && digit <= '9') {
        return digit - '0';
    }
    if (digit >= 'a' && digit <= 'f') {
        return digit - 'a' + 10;
    }
    return digit >= 'A' && digit <= 'F' ? digit - 'A' + 10 : -1;
}

/* Return the path that a file URI (or a plain path) names, without a last separator; the caller frees it. */
static char *path_of(const char *location) {
    static const char scheme[] = "file:";
    if (strncmp(location, scheme, sizeof scheme - 1) == 0) {
        location += sizeof scheme - 1;
        if (strncmp(location, "//", 2) == 0) { /* an authority, empty or localhost, up to the path */
            location += 2;
            location += strcspn(location, "/");
        }
        /* /C:/folder is C:/folder */
        if (location[0] == '/' && location[1] != '\0' && location[2] == ':') {
            ++location;
        }
    }
    char *path = malloc(strlen(location) + 1);
    if (path == NULL) {
        return NULL;
    }
    size_t at = 0;
    for (const char *from = location; *from != '\0'; ++from) {
        const int high = *from == '%' ? hexadecimal(from[1]) : -1;
        const int low = high < 0 ? -1 : hexadecimal(from[2]);
        if (low >= 0) {
            path[at++] = (char)(unsigned char)(16 * high + low);
            from += 2;
        } else {
            path[at++] = *from;
        }
    }
    while (at > 0 && path[at - 1] == '/') {
        --at;
    }
    path[at] = '\0';
    return path;
}

/* ---------------------------------------------------------------- life */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn) {
    (void)visible;
    (void)loggingOn; /* refusals are always logged, and there is nothing else to log */
    if (functions == NULL) {
        return NULL;
    }
    const structure_host host = {log_message, (void (*)(void))functions->logger, functions->componentEnvironment};
    if (fmuType != (STRUCTURE_STATE_COUNT > 0 ? fmi2ModelExchange : fmi2CoSimulation)) {
        structure_log(&host, instanceName == NULL ? "" : instanceName, STRUCTURE_ERROR,
                      STRUCTURE_STATE_COUNT > 0 ? "this FMU is for model exchange only"
                                                : "this FMU is for co-simulation only");
        return NULL;
    }
    char *folder = fmuResourceLocation == NULL ? NULL : path_of(fmuResourceLocation);
    structure_instance *instance = structure_instance_open(&host, instanceName, fmuGUID, folder);
    free(folder);
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { structure_instance_free(instance_of(c)); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    structure_instance_log(instance_of(c), loggingOn != fmi2False, nCategories, categories);
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    return status_of(structure_setup(instance_of(c), startTime));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return status_of(structure_enter_initialisation(instance_of(c)));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    return status_of(structure_exit_initialisation(instance_of(c)));
}

fmi2Status fmi2Terminate(fmi2Component c) {
    instance_of(c)->phase = STRUCTURE_TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    structure_instance_reset(instance_of(c));
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    return status_of(structure_step(instance_of(c), currentCommunicationPoint, communicationStepSize));
}

/* ---------------------------------------------------------------- values */

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
    return status_of(structure_set(instance_of(c), vr, nvr, value, nvr, false));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    return status_of(structure_set_slopes(instance_of(c), vr, nvr, order, value));
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    return status_of(structure_get(instance_of(c), vr, nvr, value, nvr, false));
}

/* Enumerations, of which there are few, pass one by one. */
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[]) {
    structure_result worst = STRUCTURE_DONE;
    for (size_t i = 0; i < nvr; ++i) {
        const double number = value[i];
        const structure_result result = structure_set(instance_of(c), &vr[i], 1, &number, 1, true);
        worst = result > worst ? result : worst;
    }
    return status_of(worst);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[]) {
    structure_result worst = STRUCTURE_DONE;
    for (size_t i = 0; i < nvr; ++i) {
        double number = 0.0;
        const structure_result result = structure_get(instance_of(c), &vr[i], 1, &number, 1, true);
        value[i] = result == STRUCTURE_DONE ? (fmi2Integer)number : 0;
        worst = result > worst ? result : worst;
    }
    return status_of(worst);
}

static fmi2Status refuse_kind(fmi2Component c, size_t count, const char *kind) {
    return count == 0 ? fmi2OK
                      : status_of(structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL,
                                                   "the FMU has no %s variables", kind));
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Boolean value[]) {
    (void)vr;
    (void)value;
    return refuse_kind(c, nvr, "Boolean");
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[]) {
    (void)vr;
    for (size_t i = 0; i < nvr; ++i) {
        value[i] = fmi2False;
    }
    return refuse_kind(c, nvr, "Boolean");
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[]) {
    (void)vr;
    (void)value;
    return refuse_kind(c, nvr, "String");
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[]) {
    (void)vr;
    for (size_t i = 0; i < nvr; ++i) {
        value[i] = "";
    }
    return refuse_kind(c, nvr, "String");
}

/* ---------------------------------------------------------------- state and derivatives */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    return status_of(structure_state_save(instance_of(c), FMUstate));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    return status_of(structure_state_restore(instance_of(c), FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    (void)c;
    structure_state_free(FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    (void)c;
    *size = structure_state_size(FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
    return status_of(structure_state_serialise(instance_of(c), FMUstate, (unsigned char *)serializedState, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    return status_of(
        structure_state_deserialise(instance_of(c), (const unsigned char *)serializedState, size, FMUstate));
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown,
                                        const fmi2Real dvKnown[], fmi2Real dvUnknown[]) {
    const structure_pairs pairs = {vUnknown_ref, nUnknown, vKnown_ref, nKnown};
    return status_of(structure_directional_derivative(instance_of(c), &pairs, dvKnown, nKnown, dvUnknown, nUnknown));
}

/* ---------------------------------------------------------------- model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    instance_of(c)->event_mode = true;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo) {
    bool states_changed = false;
    const structure_result result = structure_event(instance_of(c), &states_changed);
    const fmi2EventInfo none = {0};
    *eventInfo = none;
    eventInfo->valuesOfContinuousStatesChanged = states_changed ? fmi2True : fmi2False;
    return status_of(result);
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    instance_of(c)->event_mode = false;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation) {
    (void)c;
    (void)noSetFMUStatePriorToCurrentPoint;
    *enterEventMode = *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { return status_of(structure_setup(instance_of(c), time)); }

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    return status_of(structure_set_states(instance_of(c), x, nx));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    return status_of(structure_get_states(instance_of(c), x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    return status_of(structure_get_rates(instance_of(c), derivatives, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    (void)c;
    (void)eventIndicators;
    return ni == 0 ? fmi2OK : fmi2Error;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    (void)c;
    structure_nominals(x_nominal, nx);
    return fmi2OK;
}

/* ---------------------------------------------------------------- what this FMU does not offer */

static fmi2Status refuse(fmi2Component c, const char *sentence) {
    return status_of(structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "%s", sentence));
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    return refuse(c, "the FMU does not offer derivatives of outputs");
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return refuse(c, "the FMU does not step asynchronously");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (s != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = instance_of(c)->time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (s != fmi2Terminated) {
        return fmi2Discard;
    }
    /* A host that asks this after a refused step has no other inputs to try, and would try the same ones for ever. */
    *value = instance_of(c)->discarded ? fmi2True : fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}
