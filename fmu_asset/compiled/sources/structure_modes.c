#include "structure_modes.h"

#include <math.h>
#include <string.h>

#include "structure_linear_algebra.h"

void structure_modes_lay_out(structure_modes *modes, const structure_model *model, structure_arena *arena) {
    const size_t size = model->modal_size, count = model->mode_count;
    modes->model = model;
    modes->key = structure_take(arena, model->key);
    modes->theta = structure_take(arena, model->terms);
    modes->mass_theta = structure_take(arena, model->masses + 1);
    modes->angular_frequency = structure_take(arena, count);
    modes->shape = structure_take(arena, count * size);
    modes->output = structure_take(arena, count * model->modal_outputs);
    modes->participation = structure_take(arena, count * model->loads);
    modes->mass = structure_take(arena, size * size);
    modes->factor = structure_take(arena, size * size);
    modes->matrix = structure_take(arena, size * size);
    modes->vectors = structure_take(arena, size * size);
    modes->values = structure_take(arena, size);
    modes->work = structure_take(arena, 3 * size);
}

static void transpose_square(double *matrix, size_t size) {
    for (size_t i = 0; i < size; ++i) {
        for (size_t j = 0; j < i; ++j) {
            const double kept = matrix[i * size + j];
            matrix[i * size + j] = matrix[j * size + i];
            matrix[j * size + i] = kept;
        }
    }
}

/* The largest eigenvalue that is left, which then is no longer there; `size` if none is positive. */
static size_t take_largest(double *values, size_t size) {
    size_t largest = size;
    for (size_t i = 0; i < size; ++i) {
        if (values[i] > (largest < size ? values[largest] : 0.0)) {
            largest = i;
        }
    }
    return largest;
}

bool structure_modes_find(structure_modes *modes, const double *chosen, structure_problem *problem) {
    const structure_model *model = modes->model;
    const size_t size = model->modal_size, outputs = model->modal_outputs, loads = model->loads;
    if (modes->known && memcmp(modes->key, chosen, model->key * sizeof *chosen) == 0) {
        return true;
    }
    modes->known = false;
    structure_stiffness_coefficients(model, chosen, modes->theta);
    structure_mass_coefficients(model, chosen, modes->mass_theta);
    structure_sum_terms(modes->factor, size, model->modal_stiffness, model->terms, modes->theta);
    structure_sum_terms(modes->mass, size, model->modal_mass, model->masses + 1, modes->mass_theta);
    if (!structure_cholesky(modes->factor, size)) {
        return structure_fail(problem,
                              "the modal stiffness under these parameters and losses is not positive definite");
    }
    /* M x = K x / omega^2 with K = U' U: the eigenvalues of U'^-1 M U^-1 are 1 / omega^2. The stiffness is well
       conditioned in this basis, the mass is not, and the low modes are the largest eigenvalues, which keep all
       their digits. */
    memcpy(modes->matrix, modes->mass, size * size * sizeof *modes->matrix);
    structure_solve_lower_columns(modes->factor, size, modes->matrix);
    transpose_square(modes->matrix, size);
    structure_solve_lower_columns(modes->factor, size, modes->matrix);
    if (!structure_symmetric_eigen(modes->matrix, size, modes->values, modes->vectors, modes->work)) {
        return structure_fail(problem, "the modes under these parameters and losses were not found");
    }
    for (size_t mode = 0; mode < model->mode_count; ++mode) {
        const size_t found = take_largest(modes->values, size);
        if (found == size) {
            return structure_fail(problem, "the modal mass under these masses is not positive definite");
        }
        double *shape = modes->shape + mode * size, *output = modes->output + mode * outputs;
        const double root = sqrt(modes->values[found]);
        modes->values[found] = 0.0;
        memcpy(shape, modes->vectors + found * size, size * sizeof *shape);
        structure_solve_upper(modes->factor, size, shape);
        const double last = structure_dot(model->modal_output + (outputs - 1) * size, shape, size);
        const double scale = (last < 0.0 ? -1.0 : 1.0) / root;
        for (size_t i = 0; i < size; ++i) {
            shape[i] *= scale;
        }
        structure_multiply(output, model->modal_output, outputs, size, shape);
        structure_multiply(modes->participation + mode * loads, model->modal_load, loads, size, shape);
        modes->angular_frequency[mode] = 1.0 / root;
    }
    memcpy(modes->key, chosen, model->key * sizeof *chosen);
    modes->known = true;
    return true;
}

/* x' A x */
static double quadratic(const double *matrix, size_t size, const double *x) {
    double sum = 0.0;
    for (size_t i = 0; i < size; ++i) {
        sum += x[i] * structure_dot(matrix + i * size, x, size);
    }
    return sum;
}

double structure_modes_square_derivative(const structure_modes *modes, size_t mode, const double *chosen, size_t which) {
    const structure_model *model = modes->model;
    const size_t size = model->modal_size;
    const double *shape = modes->shape + mode * size;
    const double omega = modes->angular_frequency[mode];
    double sum = 0.0;
    for (size_t t = 0; t < model->terms; ++t) {
        const double factor = structure_stiffness_derivative(model, t, chosen, which);
        if (factor != 0.0) {
            sum += factor * quadratic(model->modal_stiffness + t * size * size, size, shape);
        }
    }
    if (which >= model->health && which < model->key) { /* a mass */
        const size_t term = which - model->health + 1;
        sum -= omega * omega * quadratic(model->modal_mass + term * size * size, size, shape);
    }
    return sum;
}

void structure_modes_project(const structure_modes *modes, const double *modal, const double *static_part, double *result,
                        double *work) {
    const structure_model *model = modes->model;
    const size_t size = model->modal_size, n = model->static_size;
    structure_multiply(work, modes->mass, size, size, modal);
    for (size_t k = 0; k <= model->masses; ++k) {
        for (size_t i = 0; i < size; ++i) {
            work[i] += modes->mass_theta[k] * structure_dot(model->cross_mass + (k * size + i) * n, static_part, n);
        }
    }
    structure_multiply(result, modes->shape, model->mode_count, size, work);
}
