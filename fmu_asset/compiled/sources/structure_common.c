#include "structure_common.h"

#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>

#define LINE STRUCTURE_SPARE

bool structure_fail(structure_problem *problem, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(problem->text, sizeof problem->text, format, arguments);
    va_end(arguments);
    return false;
}

double *structure_take(structure_arena *arena, size_t count) {
    double *room = arena->base == NULL ? NULL : arena->base + arena->used;
    arena->used += (count + LINE - 1) / LINE * LINE;
    return room;
}

structure_arena structure_arena_of(double *memory) {
    const uintptr_t line = LINE * sizeof *memory;
    const structure_arena arena = {memory + (line - (uintptr_t)memory % line) % line / sizeof *memory, 0};
    return arena;
}
