#include "wing_modes.h"

#include <math.h>
#include <string.h>

#include "wing_linear_algebra.h"

void wing_modes_lay_out(wing_modes *modes, const wing_model *model, wing_arena *arena) {
    const size_t size = model->modal_size, count = model->mode_count;
    modes->model = model;
    modes->angular_frequency = wing_take(arena, count);
    modes->shape = wing_take(arena, count * size);
    modes->output = wing_take(arena, count * model->output_count);
    modes->participation = wing_take(arena, count * WING_LOADS);
    modes->mass = wing_take(arena, size * size);
    modes->factor = wing_take(arena, size * size);
    modes->matrix = wing_take(arena, size * size);
    modes->vectors = wing_take(arena, size * size);
    modes->values = wing_take(arena, size);
    modes->work = wing_take(arena, 3 * size);
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

bool wing_modes_find(wing_modes *modes, const double *key, wing_problem *problem) {
    const wing_model *model = modes->model;
    const size_t size = model->modal_size, outputs = model->output_count;
    const size_t keys = model->regions + 3;
    if (modes->known && memcmp(modes->key, key, keys * sizeof *key) == 0) {
        return true;
    }
    modes->known = false;
    double theta[WING_MOST_TERMS] = {key[0]};
    for (size_t k = 1; k <= model->regions; ++k) {
        theta[k] = 1.0 - key[k];
    }
    theta[model->regions + 1] = 1.0;
    const double mass_theta[WING_MASS_TERMS] = {1.0, key[keys - 2], key[keys - 1]};
    wing_sum_terms(modes->factor, size, model->modal_stiffness, model->terms, theta);
    wing_sum_terms(modes->mass, size, model->modal_mass, WING_MASS_TERMS, mass_theta);
    if (!wing_cholesky(modes->factor, size)) {
        return wing_fail(problem, "the modal stiffness at e = %g with the first loss %g is not positive definite",
                         key[0], key[1]);
    }
    /* M x = K x / omega^2 with K = U' U: the eigenvalues of U'^-1 M U^-1 are 1 / omega^2. The stiffness is well
       conditioned in this basis, the mass is not, and the low modes are the largest eigenvalues, which keep all
       their digits. */
    memcpy(modes->matrix, modes->mass, size * size * sizeof *modes->matrix);
    wing_solve_lower_columns(modes->factor, size, modes->matrix);
    transpose_square(modes->matrix, size);
    wing_solve_lower_columns(modes->factor, size, modes->matrix);
    if (!wing_symmetric_eigen(modes->matrix, size, modes->values, modes->vectors, modes->work)) {
        return wing_fail(problem, "the modes at e = %g with the first loss %g were not found", key[0], key[1]);
    }
    for (size_t mode = 0; mode < model->mode_count; ++mode) {
        const size_t found = take_largest(modes->values, size);
        if (found == size) {
            return wing_fail(problem, "the modal mass at %g kg and %g kg is not positive definite",
                             mass_theta[1], mass_theta[2]);
        }
        double *shape = modes->shape + mode * size, *output = modes->output + mode * outputs;
        const double root = sqrt(modes->values[found]);
        modes->values[found] = 0.0;
        memcpy(shape, modes->vectors + found * size, size * sizeof *shape);
        wing_solve_upper(modes->factor, size, shape);
        const double tip = wing_dot(model->modal_output + (outputs - 1) * size, shape, size);
        const double scale = (tip < 0.0 ? -1.0 : 1.0) / root;
        for (size_t i = 0; i < size; ++i) {
            shape[i] *= scale;
        }
        wing_multiply(output, model->modal_output, outputs, size, shape);
        wing_multiply(modes->participation + mode * WING_LOADS, model->modal_load, WING_LOADS, size, shape);
        modes->angular_frequency[mode] = 1.0 / root;
    }
    memcpy(modes->key, key, keys * sizeof *key);
    modes->known = true;
    return true;
}

void wing_modes_project(const wing_modes *modes, const double *modal, const double *static_part, double *result,
                        double *work) {
    const wing_model *model = modes->model;
    const size_t size = model->modal_size, n = model->static_size;
    const double mass_theta[WING_MASS_TERMS] = {1.0, modes->key[model->regions + 1], modes->key[model->regions + 2]};
    wing_multiply(work, modes->mass, size, size, modal);
    for (size_t k = 0; k < WING_MASS_TERMS; ++k) {
        for (size_t i = 0; i < size; ++i) {
            work[i] += mass_theta[k] * wing_dot(model->cross_mass + (k * size + i) * n, static_part, n);
        }
    }
    wing_multiply(result, modes->shape, model->mode_count, size, work);
}
