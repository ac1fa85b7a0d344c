/* Drives a wing or a structure in C, to be compiled with its sources and with sanitizers: every FMI function, several instances,
   restored states, refused calls, damaged data files.

   driver RESOURCES [DAMAGED ...]: the URI of the resources, and of folders whose data file must be refused. */
#include "fmi2Functions.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "structure_instance.h"

static int failures = 0;

#define CHECK(condition)                                                                                       \
    do {                                                                                                       \
        if (!(condition)) {                                                                                    \
            ++failures;                                                                                        \
            printf("line %d: %s\n", __LINE__, #condition);                                                     \
        }                                                                                                      \
    } while (0)

static char last_message[1024];

static void take_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                         fmi2String category, fmi2String message, ...) {
    (void)environment;
    (void)name;
    (void)status;
    (void)category;
    (void)snprintf(last_message, sizeof last_message, "%s", message);
}

static const fmi2CallbackFunctions callbacks = {take_message, calloc, free, NULL, NULL};

static fmi2Component make(const char *guid, const char *resources, fmi2Type type) {
    return fmi2Instantiate("driven", type, guid, resources, &callbacks, fmi2False, fmi2True);
}

/* Numbers that look random, the same in every run. */
static double random_number(unsigned long *state) {
    *state = (*state * 1103515245UL + 12345UL) & 0x7fffffffUL;
    return (double)*state / 2147483648.0;
}

static void start(fmi2Component wing, int response, double alpha) {
    const fmi2ValueReference parameters[] = {STRUCTURE_DAMPING_ALPHA, structure_release_place};
    const fmi2Real values[] = {alpha, 0.05};
    const size_t count = structure_release_place < STRUCTURE_VARIABLE_COUNT ? 2 : 1;
    const fmi2ValueReference mode[] = {STRUCTURE_RESPONSE};
    const fmi2Integer wanted[] = {response};
    CHECK(fmi2Reset(wing) == fmi2OK);
    CHECK(fmi2SetupExperiment(wing, fmi2True, 1e-6, 0.0, fmi2True, 1e3) == fmi2OK);
    CHECK(fmi2EnterInitializationMode(wing) == fmi2OK);
    CHECK(fmi2SetReal(wing, parameters, count, values) == fmi2OK);
    CHECK(fmi2SetInteger(wing, mode, 1, wanted) == fmi2OK);
    CHECK(fmi2ExitInitializationMode(wing) == fmi2OK);
}

static void read_all(fmi2Component wing, fmi2Real values[STRUCTURE_VARIABLE_COUNT]) {
    for (fmi2ValueReference i = 0; i < STRUCTURE_VARIABLE_COUNT; ++i) {
        if (structure_variables[i].enumeration) {
            fmi2Integer value = -1;
            CHECK(fmi2GetInteger(wing, &i, 1, &value) == fmi2OK);
            values[i] = value;
        } else {
            CHECK(fmi2GetReal(wing, &i, 1, &values[i]) == fmi2OK);
        }
    }
}

static void step(fmi2Component wing, unsigned long *seed, double *time, double size) {
    fmi2ValueReference references[STRUCTURE_INPUT_COUNT];
    fmi2Real inputs[STRUCTURE_INPUT_COUNT];
    for (fmi2ValueReference i = 0; i < STRUCTURE_INPUT_COUNT; ++i) {
        references[i] = i;
        inputs[i] = structure_variables[i].minimum +
                    random_number(seed) * (structure_variables[i].maximum - structure_variables[i].minimum);
    }
    CHECK(fmi2SetReal(wing, references, STRUCTURE_INPUT_COUNT, inputs) == fmi2OK);
    CHECK(fmi2DoStep(wing, *time, size, fmi2True) == fmi2OK);
    *time += size;
}

/* Some variables by every variable: a derivative or a refusal, and never anything else. */
static void differentiate(fmi2Component wing) {
    int given = 0;
    for (fmi2ValueReference unknown = 0; unknown <= STRUCTURE_VARIABLE_COUNT; unknown += 6) {
        for (fmi2ValueReference known = 0; known <= STRUCTURE_VARIABLE_COUNT; ++known) {
            const fmi2Real seed = 1.0;
            fmi2Real slope = 0.0;
            const fmi2Status status = fmi2GetDirectionalDerivative(wing, &unknown, 1, &known, 1, &seed, &slope);
            CHECK(status == fmi2OK || status == fmi2Discard);
            given += status == fmi2OK;
        }
    }
    CHECK(given > 0);
}

static void fly(const char *resources, int response, double alpha) {
    fmi2Component wing = make(STRUCTURE_GUID, resources, fmi2CoSimulation);
    fmi2Component twin = make(STRUCTURE_GUID, resources, fmi2CoSimulation);
    CHECK(wing != NULL && twin != NULL);
    if (wing == NULL || twin == NULL) {
        return;
    }
    start(wing, response, alpha);
    unsigned long seed = 7;
    double time = 0.0, seen[STRUCTURE_VARIABLE_COUNT], expected[STRUCTURE_VARIABLE_COUNT];
    for (int i = 0; i < 50; ++i) {
        if (i % 10 == 0) {
            step(wing, &seed, &time, 0.02);
            /* through bytes into the other instance, which then flies beside it */
            fmi2FMUstate state = NULL, copy = NULL;
            size_t size = 0;
            CHECK(fmi2GetFMUstate(wing, &state) == fmi2OK);
            CHECK(fmi2GetFMUstate(wing, &state) == fmi2OK);
            CHECK(fmi2SerializedFMUstateSize(wing, state, &size) == fmi2OK);
            fmi2Byte *bytes = malloc(size);
            CHECK(fmi2SerializeFMUstate(wing, state, bytes, size - 1) != fmi2OK);
            CHECK(fmi2SerializeFMUstate(wing, state, bytes, size) == fmi2OK);
            CHECK(fmi2DeSerializeFMUstate(twin, bytes, size, &copy) == fmi2OK);
            CHECK(fmi2SetFMUstate(twin, copy) == fmi2OK);
            CHECK(fmi2SetFMUstate(twin, NULL) == fmi2Error);
            CHECK(fmi2SetFMUstate(twin, copy) == fmi2OK);
            CHECK(fmi2FreeFMUstate(twin, &copy) == fmi2OK && copy == NULL);
            for (size_t cut = 0; cut < size; cut += 7) { /* whatever is given as a state */
                fmi2Byte kept = bytes[cut];
                CHECK(fmi2DeSerializeFMUstate(twin, bytes, cut, &copy) != fmi2OK);
                bytes[cut] = (fmi2Byte)(kept ^ 0x55);
                if (fmi2DeSerializeFMUstate(twin, bytes, size, &copy) == fmi2OK) {
                    fmi2FMUstate before = NULL;
                    CHECK(fmi2GetFMUstate(twin, &before) == fmi2OK);
                    (void)fmi2SetFMUstate(twin, copy);
                    CHECK(fmi2SetFMUstate(twin, before) == fmi2OK);
                    CHECK(fmi2FreeFMUstate(twin, &before) == fmi2OK);
                }
                (void)fmi2FreeFMUstate(twin, &copy);
                bytes[cut] = kept;
            }
            free(bytes);
            CHECK(fmi2SetFMUstate(wing, state) == fmi2OK);
            CHECK(fmi2FreeFMUstate(wing, &state) == fmi2OK);
        } else {
            unsigned long same = seed;
            double there = time;
            step(wing, &seed, &time, 0.01);
            step(twin, &same, &there, 0.01);
            read_all(wing, seen);
            read_all(twin, expected);
            CHECK(memcmp(seen + STRUCTURE_FIRST_OUTPUT, expected + STRUCTURE_FIRST_OUTPUT,
                         (STRUCTURE_VARIABLE_COUNT - STRUCTURE_FIRST_OUTPUT) * sizeof *seen) == 0);
        }
    }
    differentiate(wing);
    CHECK(fmi2Terminate(wing) == fmi2OK);
    fmi2FreeInstance(wing);
    fmi2FreeInstance(twin);
}

static void refuse(const char *resources) {
    CHECK(make("{another}", resources, fmi2CoSimulation) == NULL);
    CHECK(strstr(last_message, "GUID") != NULL);
    CHECK(make(NULL, resources, fmi2CoSimulation) == NULL);
    CHECK(make(STRUCTURE_GUID, resources, fmi2ModelExchange) == NULL);
    CHECK(make(STRUCTURE_GUID, NULL, fmi2CoSimulation) == NULL);
    CHECK(make(STRUCTURE_GUID, "file:///there/is/no%20such%2/place", fmi2CoSimulation) == NULL);
    CHECK(strstr(last_message, "/there/is/no such%%2/place/reduced_model.bin") != NULL);
    CHECK(fmi2Instantiate("", fmi2CoSimulation, STRUCTURE_GUID, resources, &callbacks, 0, 0) == NULL);
    CHECK(fmi2Instantiate("x", fmi2CoSimulation, STRUCTURE_GUID, resources, NULL, 0, 0) == NULL);

    fmi2Component wing = make(STRUCTURE_GUID, resources, fmi2CoSimulation);
    const fmi2ValueReference references[] = {0, STRUCTURE_VARIABLE_COUNT, 4000000000u};
    fmi2Real reals[3] = {1.0, 2.0, 3.0};
    fmi2Integer integers[3] = {1, 2, 3};
    fmi2Boolean booleans[3] = {0, 0, 0};
    fmi2String strings[3] = {"", "", ""};
    fmi2FMUstate state = NULL;
    fmi2Status status;
    CHECK(fmi2SetReal(wing, references, 3, reals) == fmi2Error);
    CHECK(fmi2GetReal(wing, references, 3, reals) == fmi2Error && isnan(reals[2]));
    CHECK(fmi2SetInteger(wing, references, 3, integers) == fmi2Error);
    CHECK(fmi2GetInteger(wing, references, 3, integers) == fmi2Error);
    CHECK(fmi2SetBoolean(wing, references, 3, booleans) == fmi2Error);
    CHECK(fmi2GetBoolean(wing, references, 3, booleans) == fmi2Error);
    CHECK(fmi2SetString(wing, references, 3, strings) == fmi2Error);
    CHECK(fmi2GetString(wing, references, 3, strings) == fmi2Error);
    CHECK(fmi2GetString(wing, references, 0, strings) == fmi2OK);
    CHECK(fmi2DoStep(wing, 0.0, 1.0, fmi2True) == fmi2Error);
    CHECK(fmi2GetDirectionalDerivative(wing, references, 1, references, 1, reals, reals) == fmi2Error);
    CHECK(fmi2SetRealInputDerivatives(wing, references, 1, integers, reals) == fmi2Error);
    CHECK(fmi2GetRealOutputDerivatives(wing, references, 1, integers, reals) == fmi2Error);
    CHECK(fmi2CancelStep(wing) == fmi2Error);
    CHECK(fmi2GetStatus(wing, fmi2DoStepStatus, &status) == fmi2Discard);
    CHECK(fmi2GetRealStatus(wing, fmi2LastSuccessfulTime, reals) == fmi2OK && reals[0] == 0.0);
    CHECK(fmi2GetRealStatus(wing, fmi2Terminated, reals) == fmi2Discard);
    CHECK(fmi2GetIntegerStatus(wing, fmi2DoStepStatus, integers) == fmi2Discard);
    CHECK(fmi2GetBooleanStatus(wing, fmi2Terminated, booleans) == fmi2OK && booleans[0] == fmi2True);
    CHECK(fmi2Reset(wing) == fmi2OK);
    CHECK(fmi2GetBooleanStatus(wing, fmi2Terminated, booleans) == fmi2OK && booleans[0] == fmi2False);
    CHECK(fmi2GetBooleanStatus(wing, fmi2DoStepStatus, booleans) == fmi2Discard);
    CHECK(fmi2GetStringStatus(wing, fmi2PendingStatus, strings) == fmi2Discard);
    CHECK(fmi2GetFMUstate(wing, &state) == fmi2OK);
    CHECK(fmi2SetFMUstate(wing, state) == fmi2OK);
    CHECK(fmi2FreeFMUstate(wing, &state) == fmi2OK);
    CHECK(fmi2FreeFMUstate(wing, NULL) == fmi2OK);

    const fmi2String errors[] = {"logStatusError", "logAll"};
    last_message[0] = '\0';
    CHECK(fmi2SetDebugLogging(wing, fmi2False, 2, errors) == fmi2OK);
    CHECK(fmi2CancelStep(wing) == fmi2Error && last_message[0] == '\0');
    CHECK(fmi2SetDebugLogging(wing, fmi2True, 0, NULL) == fmi2OK);
    CHECK(fmi2CancelStep(wing) == fmi2Error && last_message[0] != '\0');
    fmi2FreeInstance(wing);
    fmi2FreeInstance(NULL);
    CHECK(strcmp(fmi2GetTypesPlatform(), "default") == 0 && strcmp(fmi2GetVersion(), "2.0") == 0);
}

/* A load that is held: one step, many small ones, and the rest far from the start must agree, for light damping,
   critical damping, and far above it. */
static void hold(const char *folder) {
    char path[2048];
    structure_model model;
    structure_behaviour wing;
    structure_problem problem;
    (void)snprintf(path, sizeof path, "%s/reduced_model.bin", folder + strlen("file://"));
    CHECK(structure_model_read(&model, path, &problem));
    CHECK(structure_behaviour_make(&wing, &model, &problem));
    const double alphas[] = {0.0, 2.0, 2.0, 900.0};
    for (size_t k = 0; k < 4; ++k) {
        structure_integrator *integrator = &wing.integrators[0];
        double chosen[STRUCTURE_CHOSEN_COUNT];
        for (size_t i = 0; i < STRUCTURE_CHOSEN_COUNT; ++i) {
            const structure_variable *variable = &structure_variables[structure_chosen_places[i]];
            chosen[i] = 0.7 * variable->minimum + 0.3 * variable->maximum;
        }
        double alpha = alphas[k];
        CHECK(structure_integrator_prepare(integrator, chosen, alpha, 1e-4, &problem));
        if (k == 2) { /* the first mode is critically damped, to rounding */
            alpha = 2.0 * integrator->modes.angular_frequency[0];
            CHECK(structure_integrator_prepare(integrator, chosen, alpha, 0.0, &problem));
            CHECK(fabs(integrator->damping_ratio[0] - 1.0) < 1e-12);
        }
        double once[2][64], often[2][64], other[2][64];
        const double load[8] = {3.0, 7.0}, none[8] = {0.0};
        double loads[3][8];
        structure_motion whole = {once[0], once[1], loads[0]}, parts = {often[0], often[1], loads[1]},
                         next = {other[0], other[1], loads[2]};
        CHECK(model.mode_count <= 64 && model.loads <= 8);
        structure_integrator_release(integrator, STRUCTURE_POINT_LOAD, 0.02, none, &next);
        structure_integrator_advance(integrator, &next, 0.4, NULL, load, &whole);
        for (int i = 0; i < 16; ++i) {
            structure_integrator_advance(integrator, &next, 0.025, NULL, load, &parts);
            memcpy(other, often, sizeof other);
            memcpy(loads[2], loads[1], sizeof *loads);
        }
        for (size_t i = 0; i < model.mode_count; ++i) {
            const double omega = integrator->modes.angular_frequency[i];
            const double size = fabs(once[0][i]) + fabs(once[1][i]) / omega + 1e-3;
            CHECK(fabs(once[0][i] - often[0][i]) < 1e-11 * size);
            CHECK(fabs(once[1][i] - often[1][i]) < 1e-11 * size * omega);
        }
        /* A line from one load to another, in one step and in parts. */
        double first[8], last[8];
        structure_integrator_release(integrator, STRUCTURE_POINT_LOAD, 0.02, none, &next);
        structure_integrator_advance(integrator, &next, 0.4, none, load, &whole);
        for (int i = 0; i < 16; ++i) {
            for (size_t l = 0; l < model.loads; ++l) {
                first[l] = load[l] * i / 16.0;
                last[l] = load[l] * (i + 1) / 16.0;
            }
            structure_integrator_advance(integrator, &next, 0.025, first, last, &parts);
            memcpy(other, often, sizeof other);
            memcpy(loads[2], loads[1], sizeof *loads);
        }
        for (size_t i = 0; i < model.mode_count; ++i) {
            const double omega = integrator->modes.angular_frequency[i];
            const double size = fabs(once[0][i]) + fabs(once[1][i]) / omega + 1e-3;
            CHECK(fabs(once[0][i] - often[0][i]) < 1e-11 * size);
            CHECK(fabs(once[1][i] - often[1][i]) < 1e-11 * size * omega);
        }
        /* Long after, the wing is at rest under its load. */
        if (k > 0) {
            structure_integrator_advance(integrator, &next, 1e3, NULL, load, &parts);
            for (size_t i = 0; i < model.mode_count; ++i) {
                double rest = 0.0;
                for (size_t l = 0; l < model.loads; ++l) {
                    rest += load[l] * integrator->modal_static[l * model.mode_count + i];
                }
                CHECK(fabs(often[0][i] - rest) < 1e-9 * fabs(rest) + 1e-12);
                CHECK(fabs(often[1][i]) < 1e-12);
            }
        }
    }
    structure_behaviour_free(&wing);
    structure_model_free(&model);
}

int main(int count, char **arguments) {
    if (count < 2) {
        return 2;
    }
    for (int response = 1; response <= 2; ++response) {
        fly(arguments[1], response, 1.0);
        fly(arguments[1], response, 500.0);
    }
    refuse(arguments[1]);
    hold(arguments[1]);
    for (int i = 2; i < count; ++i) {
        last_message[0] = '\0';
        fmi2Component wing = make(STRUCTURE_GUID, arguments[i], fmi2CoSimulation);
        if (wing != NULL || last_message[0] == '\0') {
            ++failures;
            printf("%s was not refused\n", arguments[i]);
            fmi2FreeInstance(wing);
        }
    }
    printf("%d failures\n", failures);
    return failures == 0 ? 0 : 1;
}
