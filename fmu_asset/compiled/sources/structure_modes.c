#include "structure_modes.h"

#include <math.h>
#include <string.h>

#include "structure_linear_algebra.h"

/* Modes whose squared frequencies lie closer, relative to them, are not corrected by each other. */
#define LEAST_GAP 0.01

static size_t damaged_terms(const structure_model *model) { return model->terms - model->lasting; }

void structure_modes_lay_out(structure_modes *modes, const structure_model *model, structure_arena *arena) {
    const size_t size = model->modal_size, count = model->mode_count;
    modes->model = model;
    modes->key = structure_take(arena, model->key);
    modes->basis_key = structure_take(arena, model->key);
    modes->theta = structure_take(arena, model->terms);
    modes->mass_theta = structure_take(arena, model->masses + 1);
    modes->angular_frequency = structure_take(arena, count);
    modes->shape = structure_take(arena, count * size);
    modes->output = structure_take(arena, count * model->modal_outputs);
    modes->participation = structure_take(arena, count * model->loads);
    modes->mass = structure_take(arena, size * size);
    modes->cross_mass = structure_take(arena, size * model->static_size);
    modes->basis = structure_take(arena, size * size);
    modes->factor = structure_take(arena, structure_padded(size) * structure_padded(size));
    modes->stiffness = structure_take(arena, (1 + damaged_terms(model)) * size * size);
    modes->present = structure_take(arena, size * size);
    modes->images = structure_take(arena, 2 * count * size);
    modes->matrix = structure_take(arena, size * size);
    modes->vectors = structure_take(arena, size * size);
    modes->values = structure_take(arena, size);
    modes->work = structure_take(arena, STRUCTURE_EIGEN_WORK(size));
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

/* result = basis A basis' of a symmetric matrix A */
static void project(double *result, const structure_modes *modes, const double *matrix) {
    const size_t size = modes->model->modal_size;
    for (size_t i = 0; i < size; ++i) {
        structure_multiply(modes->work, matrix, size, size, modes->basis + i * size);
        structure_multiply(result + i * size, modes->basis, size, size, modes->work);
    }
}

/* Make the basis in which other losses are found: all modes without a loss under the same parameters and masses,
   mass-normalised, from the highest. In it the mass is one, so that only a sum of stiffnesses is left to do, and this
   is graded, so that the low modes keep all their digits. It depends on nothing that was computed before. */
static bool make_basis(structure_modes *modes, const double *chosen, structure_problem *problem) {
    const structure_model *model = modes->model;
    const size_t size = model->modal_size, n = model->static_size, square = size * size;
    const size_t stride = structure_padded(size);
    double *factor = modes->factor;
    memcpy(modes->basis_key, chosen, model->key * sizeof *chosen);
    memset(modes->basis_key + model->parameters, 0, model->regions * sizeof *chosen);
    structure_stiffness_coefficients(model, modes->basis_key, modes->theta);
    structure_mass_coefficients(model, chosen, modes->mass_theta);
    structure_sum_terms(modes->matrix, size, model->modal_stiffness, model->terms, modes->theta);
    structure_pad(factor, modes->matrix, size);
    structure_sum_terms(modes->mass, size, model->modal_mass, model->masses + 1, modes->mass_theta);
    memset(modes->cross_mass, 0, size * n * sizeof *modes->cross_mass);
    structure_add_columns(modes->cross_mass, size * n, model->cross_mass, size * n, model->masses + 1,
                          modes->mass_theta);
    if (!structure_cholesky(factor, size, stride, factor, NULL, 0, NULL)) {
        return structure_fail(problem, "the modal stiffness under these parameters is not positive definite");
    }
    /* M x = K x / omega^2 with K = U' U: the eigenvalues of U'^-1 M U^-1 are 1 / omega^2. The stiffness is well
       conditioned in this basis, the mass is not, and the low modes are the largest eigenvalues, which keep all
       their digits. */
    memcpy(modes->matrix, modes->mass, square * sizeof *modes->matrix);
    structure_solve_lower_columns(factor, size, stride, modes->matrix);
    transpose_square(modes->matrix, size);
    structure_solve_lower_columns(factor, size, stride, modes->matrix);
    if (!structure_symmetric_eigen(modes->matrix, size, size, modes->values, modes->basis, modes->work)) {
        return structure_fail(problem, "the modes under these parameters and masses were not found");
    }
    if (!(modes->values[0] > 0.0)) {
        return structure_fail(problem, "the modal mass under these masses is not positive definite");
    }
    for (size_t i = 0; i < size; ++i) {
        double *shape = modes->basis + i * size;
        const double scale = 1.0 / sqrt(modes->values[i]);
        structure_solve_upper(factor, size, stride, shape);
        for (size_t j = 0; j < size; ++j) {
            shape[j] *= scale;
        }
    }
    double *joined = modes->vectors;
    memset(joined, 0, square * sizeof *joined);
    for (size_t i = 0; i < model->terms; ++i) {
        const size_t t = model->order[i];
        const double *term = model->modal_stiffness + t * square;
        if (i < model->lasting) {
            structure_add(joined, square, modes->theta[t], term);
        } else {
            project(modes->stiffness + (1 + i - model->lasting) * square, modes, term);
        }
    }
    project(modes->stiffness, modes, joined);
    return true;
}

static bool has_basis(const structure_modes *modes, const double *chosen) {
    const structure_model *model = modes->model;
    return modes->basis_known &&
           memcmp(modes->basis_key, chosen, model->parameters * sizeof *chosen) == 0 &&
           memcmp(modes->basis_key + model->health, chosen + model->health, model->masses * sizeof *chosen) == 0;
}

/* Correct eigenpairs of the present stiffness in the first order: values by Rayleigh quotients, vectors by what others
   of them have a part in the residual, and along the high modes by its diagonal. That brings back the digits that the
   tridiagonal matrix has lost to the highest modes. Vectors of values that lie close to each other are kept. */
static void refine(structure_modes *modes) {
    const size_t size = modes->model->modal_size, count = modes->model->mode_count;
    double *values = modes->values, *images = modes->images, *corrections = images + count * size;
    memset(images, 0, 2 * count * size * sizeof *images);
    for (size_t j = 0; j < count; ++j) {
        const double *vector = modes->vectors + j * size;
        double *image = images + j * size;
        structure_add_columns(image, size, modes->present, size, size, vector);
        values[j] = structure_dot(image, vector, size);
        for (size_t i = 0; i < size; ++i) { /* the residual */
            image[i] -= values[j] * vector[i];
        }
    }
    for (size_t j = 0; j < count; ++j) {
        double *residual = images + j * size, *correction = corrections + j * size;
        for (size_t i = 0; i < count; ++i) {
            const double *other = modes->vectors + i * size;
            const double gap = values[j] - values[i];
            if (fabs(gap) > LEAST_GAP * values[j]) {
                const double share = structure_dot(residual, other, size);
                structure_add(correction, size, share / gap, other);
                structure_add(residual, size, -share, other);
            }
        }
        for (size_t i = 0; i < size; ++i) {
            const double distance = modes->present[i * size + i] - values[j];
            correction[i] -= distance > 3.0 * values[j] ? residual[i] / distance : 0.0;
        }
    }
    for (size_t i = 0; i < count * size; ++i) {
        modes->vectors[i] += corrections[i];
    }
}

bool structure_modes_find(structure_modes *modes, const double *chosen, structure_problem *problem) {
    const structure_model *model = modes->model;
    const size_t size = model->modal_size, outputs = model->modal_outputs, loads = model->loads;
    const size_t square = size * size, damaged = damaged_terms(model);
    if (modes->known && memcmp(modes->key, chosen, model->key * sizeof *chosen) == 0) {
        return true;
    }
    modes->known = false;
    if (!has_basis(modes, chosen)) {
        modes->basis_known = make_basis(modes, chosen, problem);
        if (!modes->basis_known) {
            return false;
        }
    }
    structure_stiffness_coefficients(model, chosen, modes->theta);
    double *losses = modes->work;
    for (size_t i = 0; i < damaged; ++i) {
        losses[i] = modes->theta[model->order[model->lasting + i]];
    }
    memcpy(modes->present, modes->stiffness, square * sizeof *modes->present);
    structure_add_columns(modes->present, square, modes->stiffness + square, square, damaged, losses);
    if (!structure_symmetric_eigen(modes->present, size, model->mode_count, modes->values, modes->vectors,
                                   modes->work)) {
        return structure_fail(problem, "the modes under these parameters and losses were not found");
    }
    if (!(modes->values[0] > 0.0)) { /* also NaN */
        return structure_fail(problem,
                              "the modal stiffness under these parameters and losses is not positive definite");
    }
    refine(modes);
    for (size_t mode = 0; mode < model->mode_count; ++mode) {
        modes->angular_frequency[mode] = sqrt(modes->values[mode]);
        double *shape = modes->shape + mode * size, *output = modes->output + mode * outputs;
        memset(shape, 0, size * sizeof *shape);
        structure_add_columns(shape, size, modes->basis, size, size, modes->vectors + mode * size);
        memset(output, 0, outputs * sizeof *output);
        structure_add_columns(output, outputs, model->modal_output, outputs, size, shape);
        if (output[outputs - 1] < 0.0) {
            for (size_t i = 0; i < size; ++i) {
                shape[i] = -shape[i];
            }
            for (size_t i = 0; i < outputs; ++i) {
                output[i] = -output[i];
            }
        }
        structure_multiply(modes->participation + mode * loads, model->modal_load, loads, size, shape);
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
    const size_t size = model->modal_size;
    memset(work, 0, size * sizeof *work);
    structure_add_columns(work, size, modes->mass, size, size, modal); /* symmetric */
    if (static_part != NULL) {
        structure_add_columns(work, size, modes->cross_mass, size, model->static_size, static_part);
    }
    structure_multiply(result, modes->shape, model->mode_count, size, work);
}
