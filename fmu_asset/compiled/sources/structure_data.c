#if defined(_MSC_VER) && !defined(_CRT_SECURE_NO_WARNINGS)
#define _CRT_SECURE_NO_WARNINGS /* fopen is what every platform has */
#endif
#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#define NOMINMAX
#include <windows.h>
#endif
#include "structure_data.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECKSUM_BYTES 4u
#define LARGEST_FILE ((size_t)1 << 30)

static const unsigned char MAGIC[8] = {'U', 'A', 'V', 'T', 'W', 'I', 'N', 0};

/* What is left to read. */
typedef struct {
    const unsigned char *content;
    size_t size;
    size_t at;
} reader;

static uint64_t little_endian(const unsigned char *bytes, size_t count) {
    uint64_t value = 0;
    for (size_t i = count; i > 0; --i) {
        value = value << 8 | bytes[i - 1];
    }
    return value;
}

/* Take an unsigned number of `count` bytes; false at the end of the content. */
static bool take_number(reader *from, size_t count, uint64_t *value) {
    if (from->size - from->at < count) {
        return false;
    }
    *value = little_endian(from->content + from->at, count);
    from->at += count;
    return true;
}

static uint32_t crc32_of(const unsigned char *content, size_t size) {
    uint32_t table[256];
    for (uint32_t i = 0; i < 256; ++i) {
        uint32_t entry = i;
        for (int bit = 0; bit < 8; ++bit) {
            entry = entry & 1u ? entry >> 1 ^ 0xEDB88320u : entry >> 1;
        }
        table[i] = entry;
    }
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < size; ++i) {
        crc = crc >> 8 ^ table[(crc ^ content[i]) & 0xFFu];
    }
    return crc ^ 0xFFFFFFFFu;
}

/* Take name and shape of one array; return the number of its values, or 0 if it is not sound. An array always
   has at least one value. */
static size_t take_head(reader *from, structure_array *array) {
    if (from->size - from->at < STRUCTURE_DATA_NAME) {
        return 0;
    }
    memcpy(array->name, from->content + from->at, STRUCTURE_DATA_NAME);
    from->at += STRUCTURE_DATA_NAME;
    uint64_t dimensions, zero;
    if (array->name[STRUCTURE_DATA_NAME - 1] != '\0' || !take_number(from, 4, &dimensions) ||
        !take_number(from, 4, &zero) || dimensions > STRUCTURE_DATA_DIMENSIONS || zero != 0) {
        return 0;
    }
    array->dimensions = (size_t)dimensions;
    size_t values = 1;
    for (size_t i = 0; i < array->dimensions; ++i) {
        uint64_t extent;
        if (!take_number(from, 8, &extent) || extent == 0 || extent > LARGEST_FILE / values) {
            return 0;
        }
        array->shape[i] = (size_t)extent;
        values *= array->shape[i];
    }
    return values <= (from->size - from->at) / 8 ? values : 0;
}

bool structure_data_parse(structure_data *data, const unsigned char *content, size_t size, const char *where,
                     structure_problem *problem) {
    memset(data, 0, sizeof *data);
    uint64_t version, count;
    reader from = {content, size, sizeof MAGIC};
    if (size < sizeof MAGIC + 8 + CHECKSUM_BYTES || memcmp(content, MAGIC, sizeof MAGIC) != 0) {
        return structure_fail(problem, "%s is not the data file of a reduced model", where);
    }
    from.size -= CHECKSUM_BYTES;
    if (crc32_of(content, from.size) != little_endian(content + from.size, CHECKSUM_BYTES)) {
        return structure_fail(problem, "%s is damaged (its checksum is wrong); extract the FMU again", where);
    }
    (void)take_number(&from, 4, &version);
    (void)take_number(&from, 4, &count);
    if (version != STRUCTURE_DATA_VERSION) {
        return structure_fail(problem, "%s has version %lu, but this binary reads %u", where,
                         (unsigned long)version, STRUCTURE_DATA_VERSION);
    }
    /* Each array takes at least its name in the file, so that these sizes are sane. */
    if (count == 0 || count > size / STRUCTURE_DATA_NAME) {
        return structure_fail(problem, "%s does not hold the arrays that it announces", where);
    }
    data->arrays = calloc((size_t)count, sizeof *data->arrays);
    data->values = malloc(size);
    if (data->arrays == NULL || data->values == NULL) {
        structure_data_free(data);
        return structure_fail(problem, "there is no memory for %s", where);
    }
    double *next = data->values;
    for (data->count = 0; data->count < count; ++data->count) {
        structure_array *array = &data->arrays[data->count];
        const size_t values = take_head(&from, array);
        array->values = next;
        for (size_t i = 0; i < values; ++i) {
            uint64_t bits = 0;
            double value;
            (void)take_number(&from, 8, &bits);
            memcpy(&value, &bits, sizeof value);
            if (!isfinite(value)) {
                structure_data_free(data);
                return structure_fail(problem, "%s holds a number that is not finite", where);
            }
            *next++ = value;
        }
        if (values == 0) {
            structure_data_free(data);
            return structure_fail(problem, "%s does not hold the arrays that it announces", where);
        }
    }
    if (from.at != from.size) {
        structure_data_free(data);
        return structure_fail(problem, "%s holds more than the arrays that it announces", where);
    }
    return true;
}

#if defined(_WIN32)
/* Open a file whose path is in UTF-8, as FMI has it: fopen would take it for text in the code page of the system.
   A host that gives the path in that code page is understood as well, since such a path is hardly ever UTF-8. */
static FILE *open_to_read(const char *path) {
    const int length = MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, path, -1, NULL, 0);
    if (length <= 0) {
        return fopen(path, "rb");
    }
    wchar_t *wide_path = malloc((size_t)length * sizeof *wide_path);
    if (wide_path == NULL) {
        return NULL;
    }
    (void)MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, path, -1, wide_path, length);
    FILE *file = _wfopen(wide_path, L"rb");
    free(wide_path);
    return file;
}
#else
static FILE *open_to_read(const char *path) { return fopen(path, "rb"); }
#endif

bool structure_data_read(structure_data *data, const char *path, structure_problem *problem) {
    memset(data, 0, sizeof *data);
    FILE *file = open_to_read(path);
    if (file == NULL) {
        return structure_fail(problem, "the data file %s cannot be opened; extract the FMU again", path);
    }
    unsigned char *content = NULL;
    long size = -1;
    if (fseek(file, 0, SEEK_END) == 0) {
        size = ftell(file);
    }
    bool sound = size > 0 && (size_t)size <= LARGEST_FILE && fseek(file, 0, SEEK_SET) == 0;
    if (sound) {
        content = malloc((size_t)size);
        sound = content != NULL && fread(content, 1, (size_t)size, file) == (size_t)size;
    }
    (void)fclose(file);
    if (sound) {
        sound = structure_data_parse(data, content, (size_t)size, path, problem);
    } else {
        (void)structure_fail(problem, "the data file %s cannot be read; extract the FMU again", path);
    }
    free(content);
    return sound;
}

void structure_data_free(structure_data *data) {
    free(data->arrays);
    free(data->values);
    memset(data, 0, sizeof *data);
}

const structure_array *structure_data_find(const structure_data *data, const char *name) {
    for (size_t i = 0; i < data->count; ++i) {
        if (strcmp(data->arrays[i].name, name) == 0) {
            return &data->arrays[i];
        }
    }
    return NULL;
}
