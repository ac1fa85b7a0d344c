#include "wing_model.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define LARGEST_SIZE 4096.0

/* Return the values of an array with the given shape, or NULL with the problem. */
static const double *shaped(const wing_data *data, const char *name, size_t dimensions, const size_t *shape,
                            wing_problem *problem) {
    const wing_array *array = wing_data_find(data, name);
    if (array == NULL) {
        (void)wing_fail(problem, "the data file lacks the array %s", name);
        return NULL;
    }
    if (array->dimensions != dimensions ||
        (dimensions > 0 && memcmp(array->shape, shape, dimensions * sizeof *shape) != 0)) {
        (void)wing_fail(problem, "the array %s of the data file does not have the shape that the others ask for",
                        name);
        return NULL;
    }
    return array->values;
}

/* Return the extent of one dimension of an array, or 0 if there is none. */
static size_t extent(const wing_data *data, const char *name, size_t dimension) {
    const wing_array *array = wing_data_find(data, name);
    return array == NULL || array->dimensions <= dimension ? 0 : array->shape[dimension];
}

/* result (columns, rows) = matrix (rows, columns) transposed, times a factor */
static void transpose(double *result, const double *matrix, size_t rows, size_t columns, double factor) {
    for (size_t i = 0; i < rows; ++i) {
        for (size_t j = 0; j < columns; ++j) {
            result[j * rows + i] = factor * matrix[i * columns + j];
        }
    }
}

static void lay_out(wing_model *model, size_t anchors, wing_arena *arena) {
    const size_t n = model->static_size, outputs = model->output_count, r = model->residual_size;
    model->output_columns = wing_take(arena, n * outputs);
    model->load_residual = wing_take(arena, WING_LOADS * r);
    model->stiffness_residual = wing_take(arena, model->terms * n * r);
    model->correction_columns = wing_take(arena, anchors * r * outputs);
}

/* Read how many regions there are and how many approximate dual solutions lie along each of their losses. */
static bool take_regions(wing_model *model, wing_problem *problem) {
    const wing_data *data = &model->data;
    const size_t regions = extent(data, "dual_counts", 0);
    const double *counts = shaped(data, "dual_counts", 1, &regions, problem);
    if (counts == NULL) {
        return false;
    }
    if (regions < 1 || regions > WING_MOST_REGIONS) {
        return wing_fail(problem, "the data file announces %lu damage regions, but this FMU holds 1 to %d",
                         (unsigned long)regions, WING_MOST_REGIONS);
    }
    model->regions = regions;
    model->terms = regions + 2;
    size_t splits = 0;
    for (size_t k = 0; k < regions; ++k) {
        if (!(counts[k] >= 1.0 && counts[k] <= LARGEST_SIZE)) {
            return wing_fail(problem, "the data file announces %g dual solutions along a loss", counts[k]);
        }
        model->anchors[k] = (size_t)counts[k];
        splits += model->anchors[k] - 1;
    }
    if (splits > 0) { /* an array without values is not in the file */
        const double *values = shaped(data, "dual_split", 1, &splits, problem);
        if (values == NULL) {
            return false;
        }
        for (size_t k = 0; k < regions; ++k) {
            model->dual_split[k] = values;
            values += model->anchors[k] - 1;
        }
    }
    return true;
}

static bool take_arrays(wing_model *model, wing_problem *problem) {
    const wing_data *data = &model->data;
    const size_t n = extent(data, "static_load", 1), outputs = extent(data, "static_output", 0),
                 r = extent(data, "residual_load", 0), nm = extent(data, "modal_load", 1);
    if (!take_regions(model, problem)) {
        return false;
    }
    const size_t terms = model->terms;
    size_t anchors = 1;
    for (size_t k = 0; k < model->regions; ++k) {
        anchors *= model->anchors[k];
    }
    model->static_size = n;
    model->modal_size = nm;
    model->output_count = outputs;
    model->residual_size = r;
    const double *static_output = NULL, *load_residual = NULL, *stiffness_residual = NULL, *correction = NULL,
                 *modes = NULL, *residual_allowance = NULL, *rounding_allowance = NULL;
    const struct {
        const char *name;
        const double **values;
        size_t dimensions;
        size_t shape[4];
    } wanted[] = {
        {"static_stiffness", &model->static_stiffness, 3, {terms, n, n}},
        {"static_load", &model->static_load, 2, {WING_LOADS, n}},
        {"static_output", &static_output, 2, {outputs, n}},
        {"bound_reference", &model->bound_reference, 1, {model->regions + 1}},
        {"residual_load", &load_residual, 2, {r, WING_LOADS}},
        {"residual_stiffness", &stiffness_residual, 3, {r, terms, n}},
        {"residual_allowance", &residual_allowance, 0, {0}},
        {"rounding_allowance", &rounding_allowance, 0, {0}},
        {"dual_correction", &correction, 3, {anchors, outputs, r}},
        {"dual_residual", &model->dual_residual, 4, {anchors, outputs, terms, terms}},
        {"modal_stiffness", &model->modal_stiffness, 3, {terms, nm, nm}},
        {"modal_mass", &model->modal_mass, 3, {WING_MASS_TERMS, nm, nm}},
        {"modal_load", &model->modal_load, 2, {WING_LOADS, nm}},
        {"modal_output", &model->modal_output, 2, {outputs, nm}},
        {"cross_mass", &model->cross_mass, 3, {WING_MASS_TERMS, nm, n}},
        {"mode_count", &modes, 0, {0}},
    };
    for (size_t i = 0; i < sizeof wanted / sizeof *wanted; ++i) {
        *wanted[i].values = shaped(data, wanted[i].name, wanted[i].dimensions, wanted[i].shape, problem);
        if (*wanted[i].values == NULL) {
            return false;
        }
    }
    if (outputs < 2 || !(*modes >= 1.0 && *modes <= (double)nm) || (double)nm > LARGEST_SIZE) {
        return wing_fail(problem, "the data file announces %g modes of %lu modal basis vectors and %lu outputs",
                         *modes, (unsigned long)nm, (unsigned long)outputs);
    }
    model->mode_count = (size_t)*modes;
    model->residual_allowance = *residual_allowance;
    model->rounding_allowance = *rounding_allowance;

    wing_arena count = {NULL, 0};
    lay_out(model, anchors, &count);
    model->memory = calloc(count.used, sizeof *model->memory);
    if (model->memory == NULL) {
        return wing_fail(problem, "there is no memory for the model");
    }
    wing_arena arena = {model->memory, 0};
    lay_out(model, anchors, &arena);
    transpose(model->output_columns, static_output, outputs, n, 1.0);
    transpose(model->load_residual, load_residual, r, WING_LOADS, 1.0);
    /* The residual is the load minus the stiffness times the coordinates. */
    transpose(model->stiffness_residual, stiffness_residual, r, terms * n, -1.0);
    for (size_t a = 0; a < anchors; ++a) {
        transpose(model->correction_columns + a * outputs * r, correction + a * outputs * r, outputs, r, 1.0);
    }
    return true;
}

bool wing_model_read(wing_model *model, const char *path, wing_problem *problem) {
    memset(model, 0, sizeof *model);
    if (!wing_data_read(&model->data, path, problem)) {
        return false;
    }
    if (!take_arrays(model, problem)) {
        wing_model_free(model);
        return false;
    }
    return true;
}

void wing_model_free(wing_model *model) {
    wing_data_free(&model->data);
    free(model->memory);
    memset(model, 0, sizeof *model);
}
