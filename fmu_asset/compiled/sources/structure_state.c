#include "structure_state.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define TAG_BYTES 16
#define STATE_HEADER (8 + TAG_BYTES + 4)

static const char STATE_MAGIC[9] = "UAVTWINC";

static void free_state(structure_saved_state *saved) {
    if (saved != NULL) {
        free(saved->body);
        free(saved);
    }
}

structure_result structure_state_save(structure_instance *instance, void **state) {
    structure_saved_state *saved = calloc(1, sizeof *saved);
    if (saved == NULL || !structure_save(instance, saved)) {
        free(saved);
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, "there is no memory for the FMU state");
    }
    free_state(*state); /* what the host hands in again is used up */
    *state = saved;
    return STRUCTURE_DONE;
}

structure_result structure_state_restore(structure_instance *instance, void *state) {
    if (state == NULL) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, "the FMU state was not restored: it is empty");
    }
    return structure_restore(instance, state);
}

void structure_state_free(void **state) {
    if (state != NULL) {
        free_state(*state);
        *state = NULL;
    }
}

size_t structure_state_size(const void *state) {
    return STATE_HEADER + 8 * ((const structure_saved_state *)state)->count;
}

static void write_number(unsigned char *bytes, uint64_t value, size_t count) {
    for (size_t i = 0; i < count; ++i) {
        bytes[i] = (unsigned char)(value >> 8 * i & 0xFFu);
    }
}

static uint64_t read_number(const unsigned char *bytes, size_t count) {
    uint64_t value = 0;
    for (size_t i = count; i > 0; --i) {
        value = value << 8 | bytes[i - 1];
    }
    return value;
}

static void write_tag(char tag[TAG_BYTES]) {
    memset(tag, 0, TAG_BYTES);
    memcpy(tag, STRUCTURE_CONTENT_TAG, sizeof STRUCTURE_CONTENT_TAG - 1);
}

structure_result structure_state_serialise(structure_instance *instance, const void *state, unsigned char *bytes,
                                           size_t size) {
    const structure_saved_state *saved = state;
    if (size < STATE_HEADER + 8 * saved->count) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, "there is too little room for the FMU state");
    }
    char tag[TAG_BYTES];
    write_tag(tag);
    memcpy(bytes, STATE_MAGIC, 8);
    memcpy(bytes + 8, tag, TAG_BYTES);
    write_number(bytes + 8 + TAG_BYTES, saved->count, 4);
    for (size_t i = 0; i < saved->count; ++i) {
        uint64_t bits;
        memcpy(&bits, saved->body + i, sizeof bits);
        write_number(bytes + STATE_HEADER + 8 * i, bits, 8);
    }
    return STRUCTURE_DONE;
}

structure_result structure_state_deserialise(structure_instance *instance, const unsigned char *bytes, size_t size,
                                             void **state) {
    static const char sentence[] = "the FMU state was not restored: %s";
    if (size < STATE_HEADER || memcmp(bytes, STATE_MAGIC, 8) != 0) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it is not a state of this kind of FMU");
    }
    char tag[TAG_BYTES];
    write_tag(tag);
    if (memcmp(bytes + 8, tag, TAG_BYTES) != 0) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it was saved by an FMU with other content");
    }
    const size_t count = (size_t)read_number(bytes + 8 + TAG_BYTES, 4);
    if (count == 0 || size != STATE_HEADER + 8 * count) {
        return structure_refuse(instance, STRUCTURE_STATUS_BAD_STATE, sentence, "it is damaged");
    }
    structure_saved_state *saved = calloc(1, sizeof *saved);
    if (saved != NULL) {
        saved->count = count;
        saved->body = calloc(count, sizeof *saved->body);
    }
    if (saved == NULL || saved->body == NULL) {
        free_state(saved);
        return structure_refuse(instance, STRUCTURE_STATUS_INTERNAL, sentence, "there is no memory for it");
    }
    for (size_t i = 0; i < count; ++i) {
        const uint64_t bits = read_number(bytes + STATE_HEADER + 8 * i, 8);
        memcpy(saved->body + i, &bits, sizeof bits);
    }
    free_state(*state);
    *state = saved;
    return STRUCTURE_DONE;
}
