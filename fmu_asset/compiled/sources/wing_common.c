#include "wing_common.h"

#include <stdarg.h>
#include <stdio.h>

bool wing_fail(wing_problem *problem, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(problem->text, sizeof problem->text, format, arguments);
    va_end(arguments);
    return false;
}

double *wing_take(wing_arena *arena, size_t count) {
    double *room = arena->base == NULL ? NULL : arena->base + arena->used;
    arena->used += count;
    return room;
}
