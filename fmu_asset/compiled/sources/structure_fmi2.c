/* The functions of FMI 2.0 for co-simulation, on top of structure_instance. */
#include "fmi2Functions.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "structure_instance.h"

#define DATA_FILE "reduced_model.bin"
#define TAG_BYTES 16
/* A serialised state: magic, tag of the content, number of doubles, the doubles; little endian. */
#define STATE_HEADER (8 + TAG_BYTES + 4)

static const char STATE_MAGIC[9] = "UAVTWINC";

/* The pointer that a host gives back is the instance that it was given. */
static structure_instance *instance_of(fmi2Component component) { return (structure_instance *)component; }

static fmi2Status worse(fmi2Status first, fmi2Status second) { return first > second ? first : second; }

static int hexadecimal(char digit) {
    if (digit >= '0' && digit <= '9') {
        return digit - '0';
    }
    if (digit >= 'a' && digit <= 'f') {
        return digit - 'a' + 10;
    }
    return digit >= 'A' && digit <= 'F' ? digit - 'A' + 10 : -1;
}

/* Return the path of the data file in the folder that a file URI (or a plain path) names; the caller frees it. */
static char *data_file(const char *location) {
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
    char *path = malloc(strlen(location) + sizeof "/" DATA_FILE);
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
    memcpy(path + at, "/" DATA_FILE, sizeof "/" DATA_FILE);
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
    structure_problem problem;
    structure_instance *instance = NULL;
    const char *name = instanceName == NULL ? "" : instanceName;
    if (*name == '\0') {
        (void)structure_fail(&problem, "an instance needs a name");
    } else if (fmuType != fmi2CoSimulation) {
        (void)structure_fail(&problem, "this FMU is for co-simulation only");
    } else if (fmuGUID == NULL || strcmp(fmuGUID, STRUCTURE_GUID) != 0) {
        (void)structure_fail(&problem, "the GUID %.60s was given, but this is " STRUCTURE_GUID,
                        fmuGUID == NULL ? "(none)" : fmuGUID);
    } else if (fmuResourceLocation == NULL) {
        (void)structure_fail(&problem, "the location of the resources was not given");
    } else {
        char *path = data_file(fmuResourceLocation);
        if (path == NULL) {
            (void)structure_fail(&problem, "there is no memory for an instance");
        } else {
            instance = structure_instance_make(name, path, &problem);
            free(path);
        }
    }
    if (instance == NULL) {
        structure_log(functions->logger, functions->componentEnvironment, name, fmi2Error, problem.text);
        return NULL;
    }
    instance->logger = functions->logger;
    instance->environment = functions->componentEnvironment;
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { structure_instance_free(instance_of(c)); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    structure_instance *instance = instance_of(c);
    for (size_t i = 0; i < STRUCTURE_LOG_CATEGORIES; ++i) {
        bool named = nCategories == 0;
        for (size_t k = 0; k < nCategories; ++k) {
            named = named || strcmp(categories[k], structure_log_categories[i]) == 0;
        }
        if (named) {
            instance->logged[i] = loggingOn != fmi2False;
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    return structure_setup(instance_of(c), startTime);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return structure_enter_initialisation(instance_of(c)); }

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return structure_exit_initialisation(instance_of(c)); }

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
    return structure_step(instance_of(c), currentCommunicationPoint, communicationStepSize);
}

/* ---------------------------------------------------------------- values */

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
    fmi2Status status = fmi2OK;
    for (size_t i = 0; i < nvr; ++i) {
        status = worse(status, structure_set(instance_of(c), vr[i], value[i], false));
    }
    return status;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[]) {
    fmi2Status status = fmi2OK;
    for (size_t i = 0; i < nvr; ++i) {
        status = worse(status, structure_set(instance_of(c), vr[i], value[i], true));
    }
    return status;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    structure_instance *instance = instance_of(c);
    fmi2Status status = structure_update(instance, vr, nvr);
    for (size_t i = 0; i < nvr; ++i) {
        if (structure_readable(instance, vr[i], false) != NULL) {
            value[i] = instance->values[vr[i]];
        } else {
            value[i] = NAN;
            status = fmi2Error;
        }
    }
    return status;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[]) {
    structure_instance *instance = instance_of(c);
    fmi2Status status = fmi2OK;
    for (size_t i = 0; i < nvr; ++i) {
        if (structure_readable(instance, vr[i], true) != NULL) {
            value[i] = (fmi2Integer)instance->values[vr[i]];
        } else {
            value[i] = 0;
            status = fmi2Error;
        }
    }
    return status;
}

static fmi2Status refuse_kind(fmi2Component c, size_t count, const char *kind) {
    return count == 0 ? fmi2OK
                      : structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "the FMU has no %s variables", kind);
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

/* ---------------------------------------------------------------- state */

static structure_saved_state *state_of(fmi2FMUstate state) { return (structure_saved_state *)state; }

static void free_state(structure_saved_state *saved) {
    if (saved != NULL) {
        free(saved->body);
        free(saved);
    }
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    structure_saved_state *saved = calloc(1, sizeof *saved);
    if (saved == NULL || !structure_save(instance_of(c), saved)) {
        free(saved);
        return structure_refuse(instance_of(c), STRUCTURE_STATUS_INTERNAL, "there is no memory for the FMU state");
    }
    free_state(state_of(*FMUstate)); /* what the host hands in again is used up */
    *FMUstate = saved;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    if (FMUstate == NULL) {
        return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_STATE, "the FMU state was not restored: it is empty");
    }
    return structure_restore(instance_of(c), state_of(FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    (void)c;
    if (FMUstate != NULL) {
        free_state(state_of(*FMUstate));
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    (void)c;
    *size = STATE_HEADER + 8 * state_of(FMUstate)->count;
    return fmi2OK;
}

static void write_number(fmi2Byte *bytes, uint64_t value, size_t count) {
    for (size_t i = 0; i < count; ++i) {
        const unsigned char byte = (unsigned char)(value >> 8 * i & 0xFFu);
        memcpy(bytes + i, &byte, 1);
    }
}

static uint64_t read_number(const fmi2Byte *bytes, size_t count) {
    uint64_t value = 0;
    for (size_t i = count; i > 0; --i) {
        value = value << 8 | (unsigned char)bytes[i - 1];
    }
    return value;
}

static void write_tag(char tag[TAG_BYTES]) {
    memset(tag, 0, TAG_BYTES);
    memcpy(tag, STRUCTURE_CONTENT_TAG, sizeof STRUCTURE_CONTENT_TAG - 1);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
    const structure_saved_state *saved = state_of(FMUstate);
    if (size < STATE_HEADER + 8 * saved->count) {
        return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_STATE, "there is too little room for the FMU state");
    }
    char tag[TAG_BYTES];
    write_tag(tag);
    memcpy(serializedState, STATE_MAGIC, 8);
    memcpy(serializedState + 8, tag, TAG_BYTES);
    write_number(serializedState + 8 + TAG_BYTES, saved->count, 4);
    for (size_t i = 0; i < saved->count; ++i) {
        uint64_t bits;
        memcpy(&bits, saved->body + i, sizeof bits);
        write_number(serializedState + STATE_HEADER + 8 * i, bits, 8);
    }
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    static const char sentence[] = "the FMU state was not restored: %s";
    structure_instance *instance = instance_of(c);
    if (size < STATE_HEADER || memcmp(serializedState, STATE_MAGIC, 8) != 0) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it is not a state of this kind of FMU");
    }
    char tag[TAG_BYTES];
    write_tag(tag);
    if (memcmp(serializedState + 8, tag, TAG_BYTES) != 0) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it was saved by an FMU with other content");
    }
    const size_t count = (size_t)read_number(serializedState + 8 + TAG_BYTES, 4);
    if (count == 0 || size != STATE_HEADER + 8 * count) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it is damaged");
    }
    structure_saved_state *saved = calloc(1, sizeof *saved);
    if (saved != NULL) {
        saved->count = count;
        saved->body = calloc(count, sizeof *saved->body);
    }
    if (saved == NULL || saved->body == NULL) {
        free_state(saved);
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, sentence, "there is no memory for it");
    }
    for (size_t i = 0; i < count; ++i) {
        const uint64_t bits = read_number(serializedState + STATE_HEADER + 8 * i, 8);
        memcpy(saved->body + i, &bits, sizeof bits);
    }
    free_state(state_of(*FMUstate));
    *FMUstate = saved;
    return fmi2OK;
}

/* ---------------------------------------------------------------- what this FMU does not offer */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown,
                                        const fmi2Real dvKnown[], fmi2Real dvUnknown[]) {
    (void)vUnknown_ref;
    (void)nUnknown;
    (void)vKnown_ref;
    (void)nKnown;
    (void)dvKnown;
    (void)dvUnknown;
    return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "the FMU does not offer directional derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "the FMU does not interpolate inputs");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "the FMU does not offer derivatives of outputs");
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return structure_refuse(instance_of(c), STRUCTURE_STATUS_BAD_CALL, "the FMU does not step asynchronously");
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
