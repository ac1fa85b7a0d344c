#include "structure_model.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "structure_linear_algebra.h"

#define LARGEST_SIZE 4096.0

/* Return the values of an array with the given shape, or NULL with the problem. */
static const double *shaped(const structure_data *data, const char *name, size_t dimensions, const size_t *shape,
                            structure_problem *problem) {
    const structure_array *array = structure_data_find(data, name);
    if (array == NULL) {
        (void)structure_fail(problem, "the data file lacks the array %s", name);
        return NULL;
    }
    if (array->dimensions != dimensions ||
        (dimensions > 0 && memcmp(array->shape, shape, dimensions * sizeof *shape) != 0)) {
        (void)structure_fail(problem, "the array %s of the data file does not have the shape that the others ask for",
                        name);
        return NULL;
    }
    return array->values;
}

/* Return the extent of one dimension of an array, or 0 if there is none. */
static size_t extent(const structure_data *data, const char *name, size_t dimension) {
    const structure_array *array = structure_data_find(data, name);
    return array == NULL || array->dimensions <= dimension ? 0 : array->shape[dimension];
}

/* result (columns, rows) = matrix (rows, columns) transposed, times a factor; its rows lie `stride` apart */
static void transpose(double *result, const double *matrix, size_t rows, size_t columns, size_t stride,
                      double factor) {
    for (size_t i = 0; i < rows; ++i) {
        for (size_t j = 0; j < columns; ++j) {
            result[j * rows + i] = factor * matrix[i * stride + j];
        }
    }
}

static void lay_out(structure_model *model, size_t anchors, structure_arena *arena) {
    const size_t n = model->static_size, outputs = model->output_count, r = model->residual_size;
    model->stiffness_terms = structure_take(arena, model->terms * model->padded_size * model->stride);
    model->output_columns = structure_take(arena, n * outputs);
    model->modal_output = structure_take(arena, model->modal_size * model->modal_outputs);
    model->cross_mass = structure_take(arena, (model->masses + 1) * n * model->modal_size);
    model->load_residual = structure_take(arena, model->loads * r);
    model->stiffness_residual = structure_take(arena, (model->terms - 1) * n * r);
    model->correction_columns = structure_take(arena, anchors * r * model->functions * outputs);
    model->dual_factor = structure_take(arena, anchors * outputs * model->dual_rows * model->dual_columns);
}

static bool is_count(double value) { return value >= 0.0 && value <= LARGEST_SIZE && value == (double)(size_t)value; }

/* Read how many quantities there are of each kind that can be chosen. */
static bool take_chosen(structure_model *model, structure_problem *problem) {
    const size_t kinds = 4;
    const double *counts = shaped(&model->data, "chosen_counts", 1, &kinds, problem);
    if (counts == NULL) {
        return false;
    }
    for (size_t i = 0; i < kinds; ++i) {
        if (!is_count(counts[i])) {
            return structure_fail(problem, "the data file announces %g quantities of one kind", counts[i]);
        }
    }
    model->parameters = (size_t)counts[0];
    model->regions = (size_t)counts[1];
    model->masses = (size_t)counts[2];
    model->controls = (size_t)counts[3];
    model->health = model->parameters + model->regions;
    model->key = model->health + model->masses;
    model->chosen = model->key + model->controls;
    if (model->regions < 1 || model->regions > STRUCTURE_MOST_REGIONS) {
        return structure_fail(problem, "the data file announces %lu damage regions, but an FMU holds 1 to %d",
                              (unsigned long)model->regions, STRUCTURE_MOST_REGIONS);
    }
    return true;
}

/* Read a table of two numbers a row, counted from one, and turn them into positions among what can be chosen. */
static bool take_factors(const structure_model *model, structure_factors *factors, const char *name, size_t rows,
                         const size_t counts[2], const size_t starts[2], structure_problem *problem) {
    const size_t shape[2] = {rows, 2};
    const double *values = shaped(&model->data, name, 2, shape, problem);
    if (values == NULL) {
        return false;
    }
    for (size_t i = 0; i < 2 * rows; ++i) {
        if (!is_count(values[i]) || (size_t)values[i] > counts[i % 2]) {
            return structure_fail(problem, "the array %s of the data file names what is not there", name);
        }
        const size_t place = values[i] == 0.0 ? 0 : starts[i % 2] + (size_t)values[i];
        *(i % 2 == 0 ? &factors[i / 2].first : &factors[i / 2].second) = place;
    }
    return true;
}

/* Read what each term and load is times, and put the terms that no loss changes first, the last of all before. */
static bool take_terms(structure_model *model, structure_problem *problem) {
    const size_t terms = model->terms, loads = model->loads;
    if (terms < 2 || (double)terms > LARGEST_SIZE || loads < 1 || (double)loads > LARGEST_SIZE) {
        return structure_fail(problem, "the data file announces %lu terms of the stiffness and %lu loads",
                              (unsigned long)terms, (unsigned long)loads);
    }
    model->places = calloc(terms, sizeof *model->places);
    model->factors = calloc(terms + loads, sizeof *model->factors);
    if (model->places == NULL || model->factors == NULL) {
        return structure_fail(problem, "there is no memory for the model");
    }
    model->order = model->places;
    model->stiffness_factors = model->factors;
    model->load_factors = model->factors + terms;
    const size_t stiffness[2] = {model->parameters, model->regions}, of_stiffness[2] = {0, model->parameters},
                 load[2] = {model->controls, model->masses}, of_load[2] = {model->key, model->health};
    if (!take_factors(model, model->stiffness_factors, "stiffness_factors", terms, stiffness, of_stiffness, problem) ||
        !take_factors(model, model->load_factors, "load_factors", loads, load, of_load, problem)) {
        return false;
    }
    const structure_factors *last = &model->stiffness_factors[terms - 1];
    if (last->first != 0 || last->second != 0) {
        return structure_fail(problem, "the last term of the stiffness must be times one");
    }
    model->order[0] = terms - 1;
    model->lasting = 1;
    for (size_t t = 0; t + 1 < terms; ++t) {
        if (model->stiffness_factors[t].second == 0) {
            model->order[model->lasting++] = t;
        }
    }
    size_t next = model->lasting;
    for (size_t t = 0; t + 1 < terms; ++t) {
        if (model->stiffness_factors[t].second != 0) {
            model->order[next++] = t;
        }
    }
    return true;
}

/* Return behind which of some numbers only zeros follow. */
static size_t end_of(const double *values, size_t count) {
    while (count > 0 && values[count - 1] == 0.0) {
        --count;
    }
    return count;
}

static size_t larger(size_t first, size_t second) { return first > second ? first : second; }

/* Find with which column each tile of the residuals begins, which were made triangular. */
static bool find_begins(structure_model *model, structure_problem *problem) {
    const size_t n = model->static_size, r = model->residual_size, tiles = (r + STRUCTURE_TILE - 1) / STRUCTURE_TILE;
    model->residual_begins = calloc((model->terms - model->lasting) * tiles, sizeof *model->residual_begins);
    if (model->residual_begins == NULL) {
        return structure_fail(problem, "there is no memory for the model");
    }
    model->health_residual = 0;
    for (size_t k = 0; k < model->loads; ++k) {
        model->health_residual = larger(model->health_residual, end_of(model->load_residual + k * r, r));
    }
    for (size_t i = model->lasting; i < model->terms; ++i) {
        const double *columns = model->stiffness_residual + (i - 1) * n * r;
        size_t *begin = model->residual_begins + (i - model->lasting) * tiles;
        for (size_t tile = 0; tile < tiles; ++tile) {
            while (begin[tile] < n && end_of(columns + begin[tile] * r, r) <= tile * STRUCTURE_TILE) {
                ++begin[tile];
            }
        }
        for (size_t column = 0; column < n; ++column) {
            model->health_residual = larger(model->health_residual, end_of(columns + column * r, r));
        }
    }
    return true;
}

static bool take_arrays(structure_model *model, structure_problem *problem) {
    const structure_data *data = &model->data;
    const size_t n = extent(data, "static_load", 1), outputs = extent(data, "static_output", 0),
                 r = extent(data, "residual_load", 0), nm = extent(data, "modal_load", 1),
                 modal_outputs = extent(data, "modal_output", 0);
    model->terms = extent(data, "static_stiffness", 0);
    model->loads = extent(data, "static_load", 0);
    if (!take_chosen(model, problem) || !take_terms(model, problem)) {
        return false;
    }
    const size_t terms = model->terms, loads = model->loads, mass_terms = model->masses + 1;
    const size_t splits = extent(data, "dual_split", 0) == 0 ? 0 : model->regions; /* none are not in the file */
    const size_t anchors = (size_t)1 << splits;
    if (splits > 0) {
        model->dual_split = shaped(data, "dual_split", 1, &splits, problem);
        if (model->dual_split == NULL) {
            return false;
        }
    }
    model->static_size = n;
    model->padded_size = structure_padded(n);
    model->stride = model->padded_size + structure_padded(loads);
    model->modal_size = nm;
    model->output_count = outputs;
    model->modal_outputs = modal_outputs;
    model->residual_size = r;
    const size_t functions = extent(data, "dual_output", 2);
    model->functions = functions;
    model->dual_rows = extent(data, "dual_residual", 2);
    model->dual_columns = 1 + terms * functions;
    if (functions < 1 || (double)functions > LARGEST_SIZE || (double)model->dual_rows > LARGEST_SIZE) {
        return structure_fail(problem, "the data file combines %lu dual functions", (unsigned long)functions);
    }
    const double *static_stiffness = NULL, *static_output = NULL, *load_residual = NULL,
                 *stiffness_residual = NULL, *correction = NULL, *modes = NULL, *gauges = NULL,
                 *residual_allowance = NULL, *rounding_allowance = NULL, *dual_residual = NULL, *modal_output = NULL,
                 *cross_mass = NULL;
    const struct {
        const char *name;
        const double **values;
        size_t dimensions;
        size_t shape[5];
    } wanted[] = {
        {"static_stiffness", &static_stiffness, 3, {terms, n, n}},
        {"static_load", &model->static_load, 2, {loads, n}},
        {"static_output", &static_output, 2, {outputs, n}},
        {"bound_reference", &model->bound_reference, 1, {terms - 1}},
        {"residual_load", &load_residual, 2, {r, loads}},
        {"residual_stiffness", &stiffness_residual, 3, {r, terms - 1, n}},
        {"residual_allowance", &residual_allowance, 0, {0}},
        {"rounding_allowance", &rounding_allowance, 0, {0}},
        {"dual_correction", &correction, 4, {anchors, functions, outputs, r}},
        {"dual_residual", &dual_residual, 4, {anchors, outputs, model->dual_rows, model->dual_columns}},
        {"dual_stiffness", &model->dual_stiffness, 5, {anchors, outputs, terms, functions, functions}},
        {"dual_output", &model->dual_output, 3, {anchors, outputs, functions}},
        {"modal_stiffness", &model->modal_stiffness, 3, {terms, nm, nm}},
        {"modal_mass", &model->modal_mass, 3, {mass_terms, nm, nm}},
        {"modal_load", &model->modal_load, 2, {loads, nm}},
        {"modal_output", &modal_output, 2, {modal_outputs, nm}},
        {"cross_mass", &cross_mass, 3, {mass_terms, nm, n}},
        {"mode_count", &modes, 0, {0}},
        {"gauge_count", &gauges, 0, {0}},
    };
    for (size_t i = 0; i < sizeof wanted / sizeof *wanted; ++i) {
        *wanted[i].values = shaped(data, wanted[i].name, wanted[i].dimensions, wanted[i].shape, problem);
        if (*wanted[i].values == NULL) {
            return false;
        }
    }
    if (modal_outputs < outputs || !(*modes >= 1.0 && *modes <= (double)nm) || (double)nm > LARGEST_SIZE ||
        !is_count(*gauges) || (size_t)*gauges > outputs) {
        return structure_fail(problem,
                              "the data file announces %g modes of %lu modal basis vectors, %g gauges, %lu outputs and "
                              "%lu of the modes",
                              *modes, (unsigned long)nm, *gauges, (unsigned long)outputs,
                              (unsigned long)modal_outputs);
    }
    model->mode_count = (size_t)*modes;
    model->gauges = (size_t)*gauges;
    model->residual_allowance = *residual_allowance;
    model->rounding_allowance = *rounding_allowance;

    structure_arena count = {NULL, 0};
    lay_out(model, anchors, &count);
    model->memory = calloc(count.used + STRUCTURE_SPARE, sizeof *model->memory);
    if (model->memory == NULL) {
        return structure_fail(problem, "there is no memory for the model");
    }
    structure_arena arena = structure_arena_of(model->memory);
    lay_out(model, anchors, &arena);
    transpose(model->output_columns, static_output, outputs, n, n, 1.0);
    transpose(model->modal_output, modal_output, modal_outputs, nm, nm, 1.0);
    for (size_t i = 0; i < mass_terms; ++i) {
        transpose(model->cross_mass + i * nm * n, cross_mass + i * nm * n, nm, n, n, 1.0);
    }
    transpose(model->load_residual, load_residual, r, loads, loads, 1.0);
    for (size_t i = 0; i < terms; ++i) {
        const size_t t = model->order[i];
        double *term = model->stiffness_terms + i * model->padded_size * model->stride;
        for (size_t row = 0; row < model->padded_size; ++row, term += model->stride) {
            if (row < n) {
                memcpy(term, static_stiffness + (t * n + row) * n, n * sizeof *term);
            } else if (i == 0) {
                term[row] = 1.0;
            }
            for (size_t k = 0; k < loads && i == 0 && row < n; ++k) {
                term[model->padded_size + k] = model->static_load[k * n + row];
            }
        }
        if (i > 0) { /* The residual is the load minus the changes of the stiffness times the coordinates. */
            transpose(model->stiffness_residual + (i - 1) * n * r, stiffness_residual + t * n, r, n, (terms - 1) * n,
                      -1.0);
        }
    }
    for (size_t a = 0; a < anchors; ++a) {
        const size_t all = functions * outputs;
        transpose(model->correction_columns + a * all * r, correction + a * all * r, all, r, r, 1.0);
    }
    for (size_t a = 0; a < anchors; ++a) {
        const size_t values = outputs * model->dual_rows * model->dual_columns;
        for (size_t o = 0; o < outputs; ++o) {
            for (size_t row = 0; row < model->dual_rows; ++row) {
                for (size_t k = 0; k < model->dual_columns; ++k) {
                    model->dual_factor[a * values + (k * model->dual_rows + row) * outputs + o] =
                        dual_residual[a * values + (o * model->dual_rows + row) * model->dual_columns + k];
                }
            }
        }
    }
    return find_begins(model, problem);
}

static double value_at(const double *chosen, size_t place) { return place == 0 ? 1.0 : chosen[place - 1]; }

void structure_stiffness_coefficients(const structure_model *model, const double *chosen, double *theta) {
    for (size_t t = 0; t < model->terms; ++t) {
        const structure_factors *factors = &model->stiffness_factors[t];
        const double left = factors->second == 0 ? 1.0 : 1.0 - chosen[factors->second - 1];
        theta[t] = value_at(chosen, factors->first) * left;
    }
}

void structure_mass_coefficients(const structure_model *model, const double *chosen, double *theta) {
    theta[0] = 1.0;
    memcpy(theta + 1, chosen + model->health, model->masses * sizeof *theta);
}

void structure_load_coefficients(const structure_model *model, const double *chosen, double *load) {
    for (size_t k = 0; k < model->loads; ++k) {
        const structure_factors *factors = &model->load_factors[k];
        load[k] = value_at(chosen, factors->first) * value_at(chosen, factors->second);
    }
}

double structure_stiffness_derivative(const structure_model *model, size_t term, const double *chosen, size_t which) {
    const structure_factors *factors = &model->stiffness_factors[term];
    const double left = factors->second == 0 ? 1.0 : 1.0 - chosen[factors->second - 1];
    return (factors->first == which + 1 ? left : 0.0) -
           (factors->second == which + 1 ? value_at(chosen, factors->first) : 0.0);
}

double structure_load_derivative(const structure_model *model, size_t load, const double *chosen, size_t which) {
    const structure_factors *factors = &model->load_factors[load];
    return (factors->first == which + 1 ? value_at(chosen, factors->second) : 0.0) +
           (factors->second == which + 1 ? value_at(chosen, factors->first) : 0.0);
}

bool structure_is_control(const structure_model *model, size_t which) { return which >= model->key; }

bool structure_model_read(structure_model *model, const char *path, structure_problem *problem) {
    memset(model, 0, sizeof *model);
    if (!structure_data_read(&model->data, path, problem)) {
        return false;
    }
    if (!take_arrays(model, problem)) {
        structure_model_free(model);
        return false;
    }
    return true;
}

void structure_model_free(structure_model *model) {
    structure_data_free(&model->data);
    free(model->memory);
    free(model->places);
    free(model->residual_begins);
    free(model->factors);
    memset(model, 0, sizeof *model);
}
