/* Saved states of an instance as FMI hands them around, and as bytes that another process can read.

   A serialised state is: magic, tag of the content, number of doubles, the doubles; little endian. */
#ifndef STRUCTURE_STATE_H
#define STRUCTURE_STATE_H

#include "structure_instance.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Save into `*state`, which is NULL or a state that is used up. */
structure_result structure_state_save(structure_instance *instance, void **state);
structure_result structure_state_restore(structure_instance *instance, void *state);
void structure_state_free(void **state);

size_t structure_state_size(const void *state);
structure_result structure_state_serialise(structure_instance *instance, const void *state, unsigned char *bytes,
                                           size_t size);
structure_result structure_state_deserialise(structure_instance *instance, const unsigned char *bytes, size_t size,
                                             void **state);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
