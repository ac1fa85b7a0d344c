/* What every file shares: problems as sentences, memory in one piece.

   No globals but constants anywhere, so that any number of instances live side by side in a process and in
   its threads; one instance is used by one thread at a time, as FMI 2.0 demands. */
#ifndef STRUCTURE_COMMON_H
#define STRUCTURE_COMMON_H

#include <stdbool.h>
#include <stddef.h>

/* Nothing but the FMI functions is visible outside the shared library, whatever flags it is built with. */
#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Why something could not be done, as a sentence for the log. */
typedef struct {
    char text[400];
} structure_problem;

/* Write the sentence and return false, so that a function can end with `return structure_fail(...)`. */
bool structure_fail(structure_problem *problem, const char *format, ...);

/* Doubles handed out from one block, by lines of the cache. With `base` NULL it only counts, so that laying out twice,
   first to count and then for real, finds the size. */
typedef struct {
    double *base;
    size_t used;
} structure_arena;

/* The arena in a block of memory that has room for one line more than is taken. */
#define STRUCTURE_SPARE 8
structure_arena structure_arena_of(double *memory);

/* Return room for `count` doubles (NULL while counting). */
double *structure_take(structure_arena *arena, size_t count);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
