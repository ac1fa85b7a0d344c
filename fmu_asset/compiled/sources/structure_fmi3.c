/* The functions of FMI 3.0 for co-simulation or model exchange, on top of structure_instance. */
#include "fmi3Functions.h"

#include <stdlib.h>
#include <string.h>

#include "structure_derivative.h"
#include "structure_state.h"

/* The pointer that a host gives back is the instance that it was given. */
static structure_instance *instance_of(fmi3Instance instance) { return (structure_instance *)instance; }

static fmi3Status status_of(structure_result result) { return (fmi3Status)result; }

static fmi3Status refuse(fmi3Instance instance, const char *sentence) {
    return status_of(structure_refuse(instance_of(instance), STRUCTURE_STATUS_BAD_CALL, "%s", sentence));
}

static void log_message(const structure_host *host, const char *name, structure_result result, const char *category,
                        const char *sentence) {
    (void)name;
    const fmi3LogMessageCallback callback = (fmi3LogMessageCallback)host->callback;
    if (callback != NULL) {
        callback(host->environment, status_of(result), category, sentence);
    }
}

/* ---------------------------------------------------------------- life */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    structure_instance_log(instance_of(instance), loggingOn, nCategories, categories);
    return fmi3OK;
}

#define ONLY(INTERFACE) "this FMU is for " INTERFACE " only"
#define OWN_INTERFACE (STRUCTURE_STATE_COUNT > 0 ? ONLY("model exchange") : ONLY("co-simulation"))

static fmi3Instance open_instance(fmi3String name, fmi3String token, fmi3String folder, bool own,
                                  fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage) {
    const structure_host host = {log_message, (void (*)(void))logMessage, environment};
    if (!own) {
        structure_log(&host, name == NULL ? "" : name, STRUCTURE_ERROR, OWN_INTERFACE);
        return NULL;
    }
    return structure_instance_open(&host, name, token, folder);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    (void)visible;
    (void)loggingOn; /* refusals are always logged, and there is nothing else to log */
    return open_instance(instanceName, instantiationToken, resourcePath, STRUCTURE_STATE_COUNT > 0,
                         instanceEnvironment, logMessage);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken,
                                               fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment,
                                               fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)visible;
    (void)loggingOn;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    return open_instance(instanceName, instantiationToken, resourcePath, false, instanceEnvironment, logMessage);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment,
                                         fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)visible;
    (void)loggingOn;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    if (eventModeUsed || nRequiredIntermediateVariables > 0) {
        const structure_host host = {log_message, (void (*)(void))logMessage, instanceEnvironment};
        structure_log(&host, instanceName == NULL ? "" : instanceName, STRUCTURE_ERROR,
                      "this FMU has no event mode and no intermediate variables");
        return NULL;
    }
    return open_instance(instanceName, instantiationToken, resourcePath, STRUCTURE_STATE_COUNT == 0,
                         instanceEnvironment, logMessage);
}

void fmi3FreeInstance(fmi3Instance instance) { structure_instance_free(instance_of(instance)); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    const structure_result result = structure_setup(instance_of(instance), startTime);
    return status_of(result == STRUCTURE_DONE ? structure_enter_initialisation(instance_of(instance)) : result);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    return status_of(structure_exit_initialisation(instance_of(instance)));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    instance_of(instance)->phase = STRUCTURE_TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    structure_instance_reset(instance_of(instance));
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    const structure_result result =
        structure_step(instance_of(instance), currentCommunicationPoint, communicationStepSize);
    *eventHandlingNeeded = *terminateSimulation = *earlyReturn = fmi3False;
    *lastSuccessfulTime = instance_of(instance)->time;
    return status_of(result);
}

/* ---------------------------------------------------------------- values */

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues) {
    return status_of(
        structure_set(instance_of(instance), valueReferences, nValueReferences, values, nValues, false));
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues) {
    return status_of(
        structure_get(instance_of(instance), valueReferences, nValueReferences, values, nValues, false));
}

/* Enumerations, of which there are few and no arrays, pass one by one. */
fmi3Status fmi3SetInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Int64 values[], size_t nValues) {
    structure_result worst = nValues == nValueReferences ? STRUCTURE_DONE : STRUCTURE_ERROR;
    for (size_t i = 0; i < nValueReferences && i < nValues; ++i) {
        const double number = (double)values[i];
        const structure_result result =
            structure_set(instance_of(instance), &valueReferences[i], 1, &number, 1, true);
        worst = result > worst ? result : worst;
    }
    return status_of(worst);
}

fmi3Status fmi3GetInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        fmi3Int64 values[], size_t nValues) {
    structure_result worst = nValues == nValueReferences ? STRUCTURE_DONE : STRUCTURE_ERROR;
    for (size_t i = 0; i < nValueReferences && i < nValues; ++i) {
        double number = 0.0;
        const structure_result result =
            structure_get(instance_of(instance), &valueReferences[i], 1, &number, 1, true);
        values[i] = result == STRUCTURE_DONE ? (fmi3Int64)number : 0;
        worst = result > worst ? result : worst;
    }
    return status_of(worst);
}

/* ---------------------------------------------------------------- state and derivatives */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    return status_of(structure_state_save(instance_of(instance), FMUState));
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    return status_of(structure_state_restore(instance_of(instance), FMUState));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    (void)instance;
    structure_state_free(FMUState);
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    (void)instance;
    *size = structure_state_size(FMUState);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[],
                                 size_t size) {
    return status_of(structure_state_serialise(instance_of(instance), FMUState, serializedState, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size,
                                   fmi3FMUState *FMUState) {
    return status_of(structure_state_deserialise(instance_of(instance), serializedState, size, FMUState));
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                        size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    const structure_pairs pairs = {unknowns, nUnknowns, knowns, nKnowns};
    return status_of(structure_directional_derivative(instance_of(instance), &pairs, seed, nSeed, sensitivity,
                                                      nSensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    const structure_pairs pairs = {unknowns, nUnknowns, knowns, nKnowns};
    return status_of(
        structure_adjoint_derivative(instance_of(instance), &pairs, seed, nSeed, sensitivity, nSensitivity));
}

/* ---------------------------------------------------------------- model exchange */

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    if (STRUCTURE_STATE_COUNT == 0) {
        return refuse(instance, "the FMU has no event mode");
    }
    instance_of(instance)->event_mode = true;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    *discreteStatesNeedUpdate = *terminateSimulation = *nominalsOfContinuousStatesChanged = fmi3False;
    *valuesOfContinuousStatesChanged = *nextEventTimeDefined = fmi3False;
    *nextEventTime = 0.0;
    return status_of(structure_event(instance_of(instance), valuesOfContinuousStatesChanged));
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    instance_of(instance)->event_mode = false;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    (void)instance;
    (void)noSetFMUStatePriorToCurrentPoint;
    *enterEventMode = *terminateSimulation = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    return status_of(structure_setup(instance_of(instance), time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    return status_of(structure_set_states(instance_of(instance), continuousStates, nContinuousStates));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[], size_t nContinuousStates) {
    return status_of(structure_get_states(instance_of(instance), continuousStates, nContinuousStates));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t nContinuousStates) {
    return status_of(structure_get_rates(instance_of(instance), derivatives, nContinuousStates));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                             size_t nContinuousStates) {
    (void)instance;
    structure_nominals(nominals, nContinuousStates);
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    (void)instance;
    *nContinuousStates = STRUCTURE_STATE_COUNT;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    (void)instance;
    *nEventIndicators = 0;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[], size_t nEventIndicators) {
    (void)eventIndicators;
    return nEventIndicators == 0 ? fmi3OK : refuse(instance, "the FMU has no event indicators");
}

/* ---------------------------------------------------------------- what this FMU does not offer */

#define UNUSED_REFERENCES const fmi3ValueReference valueReferences[], size_t nValueReferences
#define NO_VARIABLES(TYPE, KIND)                                                                                     \
    fmi3Status fmi3Get##TYPE(fmi3Instance instance, UNUSED_REFERENCES, fmi3##TYPE values[], size_t nValues) {        \
        (void)valueReferences;                                                                                       \
        (void)values;                                                                                                \
        return nValueReferences + nValues == 0 ? fmi3OK : refuse(instance, "the FMU has no " KIND " variables");     \
    }                                                                                                                \
    fmi3Status fmi3Set##TYPE(fmi3Instance instance, UNUSED_REFERENCES, const fmi3##TYPE values[], size_t nValues) {  \
        (void)valueReferences;                                                                                       \
        (void)values;                                                                                                \
        return nValueReferences + nValues == 0 ? fmi3OK : refuse(instance, "the FMU has no " KIND " variables");     \
    }

NO_VARIABLES(Float32, "Float32")
NO_VARIABLES(Int8, "Int8")
NO_VARIABLES(UInt8, "UInt8")
NO_VARIABLES(Int16, "Int16")
NO_VARIABLES(UInt16, "UInt16")
NO_VARIABLES(Int32, "Int32")
NO_VARIABLES(UInt32, "UInt32")
NO_VARIABLES(UInt64, "UInt64")
NO_VARIABLES(Boolean, "Boolean")
NO_VARIABLES(String, "String")

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#elif defined(_MSC_VER)
#pragma warning(disable : 4100)
#endif

#define REFUSED(NAME, SENTENCE, ...) \
    fmi3Status fmi3##NAME(fmi3Instance instance, __VA_ARGS__) { return refuse(instance, SENTENCE); }
#define REFUSED_CALL(NAME, SENTENCE) \
    fmi3Status fmi3##NAME(fmi3Instance instance) { return refuse(instance, SENTENCE); }

#define NO_BINARIES "the FMU has no binary variables"
#define NO_CLOCKS "the FMU has no clocks"
#define NO_EVENTS "the FMU has no step mode and no discrete states"
#define NO_DEPENDENCIES "the FMU does not tell dependencies of elements"

REFUSED(GetBinary, NO_BINARIES, UNUSED_REFERENCES, size_t sizes[], fmi3Binary values[], size_t nValues)
REFUSED(SetBinary, NO_BINARIES, UNUSED_REFERENCES, const size_t sizes[], const fmi3Binary values[], size_t nValues)
REFUSED(GetClock, NO_CLOCKS, UNUSED_REFERENCES, fmi3Clock values[])
REFUSED(SetClock, NO_CLOCKS, UNUSED_REFERENCES, const fmi3Clock values[])
REFUSED(GetIntervalDecimal, NO_CLOCKS, UNUSED_REFERENCES, fmi3Float64 i[], fmi3IntervalQualifier q[])
REFUSED(GetIntervalFraction, NO_CLOCKS, UNUSED_REFERENCES, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[])
REFUSED(GetShiftDecimal, NO_CLOCKS, UNUSED_REFERENCES, fmi3Float64 shifts[])
REFUSED(GetShiftFraction, NO_CLOCKS, UNUSED_REFERENCES, fmi3UInt64 a[], fmi3UInt64 b[])
REFUSED(SetIntervalDecimal, NO_CLOCKS, UNUSED_REFERENCES, const fmi3Float64 intervals[])
REFUSED(SetIntervalFraction, NO_CLOCKS, UNUSED_REFERENCES, const fmi3UInt64 a[], const fmi3UInt64 b[])
REFUSED(SetShiftDecimal, NO_CLOCKS, UNUSED_REFERENCES, const fmi3Float64 shifts[])
REFUSED(SetShiftFraction, NO_CLOCKS, UNUSED_REFERENCES, const fmi3UInt64 a[], const fmi3UInt64 b[])
REFUSED(ActivateModelPartition, NO_CLOCKS, fmi3ValueReference clockReference, fmi3Float64 activationTime)
REFUSED(GetNumberOfVariableDependencies, NO_DEPENDENCIES, fmi3ValueReference valueReference, size_t *nDependencies)
REFUSED(GetVariableDependencies, NO_DEPENDENCIES, fmi3ValueReference dependent, size_t elementsOfDependent[],
        fmi3ValueReference independents[], size_t elementsOfIndependents[], fmi3DependencyKind kinds[], size_t count)
REFUSED(GetOutputDerivatives, "the FMU does not offer derivatives of outputs", UNUSED_REFERENCES,
        const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues)
REFUSED_CALL(EnterConfigurationMode, "the FMU has no structural parameters")
REFUSED_CALL(ExitConfigurationMode, "the FMU has no structural parameters")
REFUSED_CALL(EnterStepMode, NO_EVENTS)
REFUSED_CALL(EvaluateDiscreteStates, NO_EVENTS)
