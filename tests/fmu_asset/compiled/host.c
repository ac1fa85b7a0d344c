/* A host that is no Python: loads the binary of an FMU at run time, makes steps and prints what it reads.

   host BINARY GUID RESOURCES STEPS REFERENCE ... */
#include "fmi2FunctionTypes.h"

#ifdef _WIN32
#include <windows.h>
#define dlopen(path, flags) ((void *)LoadLibraryA(path))
#define dlsym(library, name) ((void *)(size_t)GetProcAddress((HMODULE)library, name))
#define dlclose(library) (!FreeLibrary((HMODULE)library))
#define dlerror() "no such library or function"
#else
#include <dlfcn.h>
#endif
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void print_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                          fmi2String category, fmi2String message, ...) {
    (void)environment;
    printf("%s %d %s %s\n", name, status, category, message);
}

/* Find a function; ISO C has no other way from an object pointer to a function pointer. */
static void find(void *library, const char *name, void *function) {
    void *symbol = dlsym(library, name);
    if (symbol == NULL) {
        printf("%s\n", dlerror());
        exit(1);
    }
    memcpy(function, &symbol, sizeof symbol);
}

int main(int count, char **arguments) {
    fmi2InstantiateTYPE *instantiate;
    fmi2SetupExperimentTYPE *setup;
    fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave;
    fmi2DoStepTYPE *step;
    fmi2GetRealTYPE *get;
    fmi2TerminateTYPE *terminate;
    fmi2FreeInstanceTYPE *release;
    void *library = count > 5 ? dlopen(arguments[1], RTLD_NOW | RTLD_LOCAL) : NULL;
    if (library == NULL) {
        printf("%s\n", dlerror());
        return 1;
    }
    find(library, "fmi2Instantiate", &instantiate);
    find(library, "fmi2SetupExperiment", &setup);
    find(library, "fmi2EnterInitializationMode", &enter);
    find(library, "fmi2ExitInitializationMode", &leave);
    find(library, "fmi2DoStep", &step);
    find(library, "fmi2GetReal", &get);
    find(library, "fmi2Terminate", &terminate);
    find(library, "fmi2FreeInstance", &release);
    const fmi2CallbackFunctions callbacks = {print_message, calloc, free, NULL, NULL};
    fmi2Component wing = instantiate("wing", fmi2CoSimulation, arguments[2], arguments[3], &callbacks, 0, 0);
    if (wing == NULL || setup(wing, 0, 0.0, 0.0, 0, 0.0) != fmi2OK || enter(wing) != fmi2OK ||
        leave(wing) != fmi2OK) {
        return 1;
    }
    for (int i = 0; i < atoi(arguments[4]); ++i) {
        if (step(wing, i, 1.0, fmi2True) != fmi2OK) {
            return 1;
        }
    }
    for (int i = 5; i < count; ++i) {
        const fmi2ValueReference reference = (fmi2ValueReference)atoi(arguments[i]);
        fmi2Real value = 0.0;
        if (get(wing, &reference, 1, &value) != fmi2OK) {
            return 1;
        }
        printf("%.17g\n", value);
    }
    const fmi2Status end = terminate(wing);
    release(wing);
    return end == fmi2OK && dlclose(library) == 0 ? 0 : 1;
}
