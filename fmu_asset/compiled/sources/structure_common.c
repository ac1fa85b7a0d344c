#include "structure_common.h"

#include <stdarg.h>
#include <stdio.h>

bool structure_fail(structure_problem *problem, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(problem->text, sizeof problem->text, format, arguments);
    va_end(arguments);
    return false;
}

double *structure_take(structure_arena *arena, size_t count) {
    double *room = arena->base == NULL ? NULL : arena->base + arena->used;
    arena->used += count;
    return room;
}
