/* The data file of a reduced model: named arrays of doubles, checked as a whole.

   All numbers are little endian, whatever the machine. The file is
     8 bytes   magic "UAVWING" and a zero
     uint32    version, WING_DATA_VERSION
     uint32    number of arrays
   then for each array
     32 bytes  name, filled up with zeros
     uint32    number of dimensions, at most WING_DATA_DIMENSIONS
     uint32    zero
     uint64    size of each dimension, as many as there are dimensions
     float64   the values, last index fastest
   and at the end
     uint32    CRC-32 (as in zip and PNG) of all bytes before it. */
#ifndef WING_DATA_H
#define WING_DATA_H

#include "wing_common.h"

#define WING_DATA_VERSION 1u
#define WING_DATA_DIMENSIONS 6
#define WING_DATA_NAME 32

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    char name[WING_DATA_NAME];
    size_t dimensions;
    size_t shape[WING_DATA_DIMENSIONS];
    const double *values;
} wing_array;

typedef struct {
    size_t count;
    wing_array *arrays;
    double *values; /* of all arrays, one after another */
} wing_data;

/* Read and check a file. On success the caller frees `data` with `wing_data_free`. */
bool wing_data_read(wing_data *data, const char *path, wing_problem *problem);

/* The same for the content of a file; `where` names it in the problem. */
bool wing_data_parse(wing_data *data, const unsigned char *content, size_t size, const char *where,
                     wing_problem *problem);

void wing_data_free(wing_data *data);

/* Return the array of that name, or NULL. */
const wing_array *wing_data_find(const wing_data *data, const char *name);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
