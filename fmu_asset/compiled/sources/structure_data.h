/* The data file of a reduced model: named arrays of doubles, checked as a whole.

   All numbers are little endian, whatever the machine. The file is
     8 bytes   magic "UAVTWIN" and a zero
     uint32    version, STRUCTURE_DATA_VERSION
     uint32    number of arrays
   then for each array
     32 bytes  name, filled up with zeros
     uint32    number of dimensions, at most STRUCTURE_DATA_DIMENSIONS
     uint32    zero
     uint64    size of each dimension, as many as there are dimensions
     float64   the values, last index fastest
   and at the end
     uint32    CRC-32 (as in zip and PNG) of all bytes before it. */
#ifndef STRUCTURE_DATA_H
#define STRUCTURE_DATA_H

#include "structure_common.h"

#define STRUCTURE_DATA_VERSION 2u
#define STRUCTURE_DATA_DIMENSIONS 6
#define STRUCTURE_DATA_NAME 32

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    char name[STRUCTURE_DATA_NAME];
    size_t dimensions;
    size_t shape[STRUCTURE_DATA_DIMENSIONS];
    const double *values;
} structure_array;

typedef struct {
    size_t count;
    structure_array *arrays;
    double *values; /* of all arrays, one after another */
} structure_data;

/* Read and check a file. On success the caller frees `data` with `structure_data_free`. */
bool structure_data_read(structure_data *data, const char *path, structure_problem *problem);

/* The same for the content of a file; `where` names it in the problem. */
bool structure_data_parse(structure_data *data, const unsigned char *content, size_t size, const char *where,
                     structure_problem *problem);

void structure_data_free(structure_data *data);

/* Return the array of that name, or NULL. */
const structure_array *structure_data_find(const structure_data *data, const char *name);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
