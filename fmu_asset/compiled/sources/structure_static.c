#include "structure_static.h"

#include <math.h>
#include <string.h>

#include "structure_linear_algebra.h"

static size_t larger(size_t first, size_t second) { return first > second ? first : second; }

static size_t smaller_size(size_t first, size_t second) { return first < second ? first : second; }

static double smaller(double first, double second) { return first < second ? first : second; }

void structure_static_lay_out(structure_static *steady, const structure_model *model, structure_arena *arena) {
    const size_t n = model->static_size, outputs = model->output_count, r = model->residual_size;
    const size_t damaged = model->terms - model->lasting;
    steady->model = model;
    steady->health = structure_take(arena, model->health);
    steady->theta = structure_take(arena, model->terms);
    steady->theta_damaged = structure_take(arena, damaged);
    steady->theta_change = structure_take(arena, model->terms - 1);
    steady->lasting_parameters = structure_take(arena, model->parameters);
    steady->lasting_stiffness = structure_take(arena, model->padded_size * model->stride);
    steady->lasting_residual = structure_take(arena, n * r);
    steady->factor = structure_take(arena, model->padded_size * model->stride);
    steady->dual_norm = structure_take(arena, outputs);
    const size_t functions = model->functions, padded = structure_padded(functions);
    steady->dual_weights = structure_take(arena, functions * outputs);
    steady->dual_products = structure_take(arena, functions * outputs);
    steady->dual_work = structure_take(
        arena, larger(functions * (functions + 1) + padded * padded, (model->dual_rows + 1) * outputs));
    /* Flags in the room of doubles, of which every byte is zero at first. */
    steady->solved = (bool *)(void *)structure_take(arena, model->loads);
    steady->bounded = (bool *)(void *)structure_take(arena, model->loads);
    steady->coordinates = structure_take(arena, model->loads * n);
    steady->output = structure_take(arena, model->loads * outputs);
    steady->residual = structure_take(arena, model->loads * r);
    steady->correction = structure_take(arena, model->loads * outputs);
    steady->whole_coordinates = structure_take(arena, n);
    steady->whole_residual = structure_take(arena, r);
    steady->whole_correction = structure_take(arena, outputs);
    steady->work = structure_take(arena, larger((damaged + 1) * larger(n, larger(r, outputs)), model->terms));
}

/* Join what losses do not change. */
static void join_lasting(structure_static *steady, const double *chosen) {
    const structure_model *model = steady->model;
    const size_t square = model->padded_size * model->stride, columns = model->static_size * model->residual_size;
    memcpy(steady->lasting_stiffness, model->stiffness_terms, square * sizeof *chosen);
    memset(steady->lasting_residual, 0, columns * sizeof *chosen);
    steady->residual_size = model->health_residual;
    for (size_t i = 1; i < model->lasting; ++i) {
        structure_add(steady->lasting_stiffness, square, steady->theta[model->order[i]],
                      model->stiffness_terms + i * square);
        structure_add(steady->lasting_residual, columns, steady->theta_change[i - 1],
                      model->stiffness_residual + (i - 1) * columns);
        if (steady->theta_change[i - 1] != 0.0) {
            steady->residual_size = model->residual_size;
        }
    }
    memcpy(steady->lasting_parameters, chosen, model->parameters * sizeof *chosen);
    steady->lasting_known = true;
}

bool structure_static_prepare(structure_static *steady, const double *chosen, structure_problem *problem) {
    const structure_model *model = steady->model;
    const size_t parameters = model->parameters * sizeof *chosen;
    if (steady->factorised && memcmp(steady->health, chosen, model->health * sizeof *chosen) == 0) {
        return true;
    }
    memcpy(steady->health, chosen, model->health * sizeof *chosen);
    structure_stiffness_coefficients(model, chosen, steady->theta);
    steady->dual_known = false;
    memset(steady->solved, 0, model->loads * sizeof *steady->solved);
    memset(steady->bounded, 0, model->loads * sizeof *steady->bounded);
    const size_t lasting = model->lasting, damaged = model->terms - lasting;
    for (size_t i = 1; i < model->terms; ++i) {
        const size_t t = model->order[i];
        steady->theta_change[i - 1] = steady->theta[t] - model->bound_reference[t];
        if (i >= lasting) {
            steady->theta_damaged[i - lasting] = steady->theta[t];
        }
    }
    if (!steady->lasting_known || memcmp(steady->lasting_parameters, chosen, parameters) != 0) {
        join_lasting(steady, chosen);
    }
    steady->factorised = structure_cholesky(
        steady->factor, model->static_size, model->stride, steady->lasting_stiffness,
        model->stiffness_terms + lasting * model->padded_size * model->stride, damaged, steady->theta_damaged);
    return steady->factorised ||
           structure_fail(problem, "the stiffness under these parameters and losses is not positive definite");
}

void structure_static_solve(structure_static *steady, size_t load) {
    const structure_model *model = steady->model;
    if (steady->solved[load]) {
        return;
    }
    const size_t n = model->static_size, outputs = model->output_count;
    double *coordinates = steady->coordinates + load * n, *output = steady->output + load * outputs;
    for (size_t i = 0; i < n; ++i) {
        coordinates[i] = steady->factor[i * model->stride + model->padded_size + load];
    }
    structure_solve_upper(steady->factor, n, model->stride, coordinates);
    memset(output, 0, outputs * sizeof *output);
    structure_add_columns(output, outputs, model->output_columns, outputs, n, coordinates);
    steady->solved[load] = true;
}

double structure_static_load_point(structure_static *steady, size_t point, size_t load) {
    const size_t n = steady->model->static_size;
    structure_static_solve(steady, load);
    const double *coordinates = steady->coordinates + load * n;
    const double *output = steady->model->static_load + point * n; /* the load vector, by reciprocity */
    double sum = 0.0;
    for (size_t i = 0; i < n; ++i) {
        sum += output[i] * coordinates[i];
    }
    return sum;
}

/* sum (size) = sum over the loads of their coefficients times what one unit of each gives, (L, size) */
static void superpose(double *sum, size_t size, const structure_model *model, const double *load,
                      const double *given) {
    memset(sum, 0, size * sizeof *sum);
    for (size_t k = 0; k < model->loads; ++k) {
        if (load[k] != 0.0) {
            structure_add(sum, size, load[k], given + k * size);
        }
    }
}

/* Solve for the loads that act. */
static void solve_needed(structure_static *steady, const double *load) {
    for (size_t k = 0; k < steady->model->loads; ++k) {
        if (load[k] != 0.0) {
            structure_static_solve(steady, k);
        }
    }
}

void structure_static_response(structure_static *steady, const double *load, double *output) {
    solve_needed(steady, load);
    superpose(output, steady->model->output_count, steady->model, load, steady->output);
}

void structure_static_derivative(structure_static *steady, const double *chosen, const double *load, size_t which,
                                 size_t point, double *output, double *load_point) {
    const structure_model *model = steady->model;
    const size_t n = model->static_size, outputs = model->output_count;
    double *change = steady->work;
    solve_needed(steady, load);
    superpose(steady->whole_coordinates, n, model, load, steady->coordinates);
    /* K x = f: K dx = df - dK x */
    memset(change, 0, n * sizeof *change);
    for (size_t k = 0; k < model->loads; ++k) {
        structure_add(change, n, structure_load_derivative(model, k, chosen, which), model->static_load + k * n);
    }
    for (size_t i = 0; i < model->terms; ++i) {
        const double factor = structure_stiffness_derivative(model, model->order[i], chosen, which);
        for (size_t row = 0; row < n && factor != 0.0; ++row) {
            change[row] -=
                factor * structure_dot(model->stiffness_terms + (i * model->padded_size + row) * model->stride,
                                       steady->whole_coordinates, n);
        }
    }
    structure_solve_lower(steady->factor, n, model->stride, change);
    structure_solve_upper(steady->factor, n, model->stride, change);
    memset(output, 0, outputs * sizeof *output);
    structure_add_columns(output, outputs, model->output_columns, outputs, n, change);
    *load_point = structure_dot(model->static_load + point * n, change, n);
}

/* Number of the anchor at the losses; that of the last region changes first. */
static size_t anchor_of(const structure_static *steady) {
    const structure_model *model = steady->model;
    size_t index = 0;
    for (size_t k = 0; k < model->regions && model->dual_split != NULL; ++k) {
        index = 2 * index + (steady->health[model->parameters + k] >= model->dual_split[k]);
    }
    return index;
}

/* Combine the dual functions of each output: their Galerkin solution at the present stiffness. */
static void combine_duals(structure_static *steady, size_t anchor) {
    const structure_model *model = steady->model;
    const size_t outputs = model->output_count, m = model->functions, stride = structure_padded(m);
    double *stiffness = steady->dual_work, *weights = stiffness + m * m, *factor = weights + m;
    for (size_t o = 0; o < outputs; ++o) {
        const size_t place = anchor * outputs + o;
        structure_sum_terms(stiffness, m, model->dual_stiffness + place * model->terms * m * m, model->terms,
                            steady->theta);
        memcpy(weights, model->dual_output + place * m, m * sizeof *weights);
        if (m == 1) { /* the most frequent case is much cheaper alone */
            steady->dual_weights[o] = weights[0] / stiffness[0];
            continue;
        }
        structure_pad(factor, stiffness, m);
        /* positive definite where the stiffness is */
        (void)structure_cholesky(factor, m, stride, factor, NULL, 0, NULL);
        structure_solve_lower(factor, m, stride, weights);
        structure_solve_upper(factor, m, stride, weights);
        for (size_t j = 0; j < m; ++j) {
            steady->dual_weights[j * outputs + o] = weights[j];
        }
    }
}

/* Make a residual of that of the loads, which it holds, and find its product with the approximate dual solutions. */
static void take_residual(structure_static *steady, const double *coordinates, double *residual, double *correction) {
    const structure_model *model = steady->model;
    const size_t n = model->static_size, r = model->residual_size, outputs = model->output_count;
    const size_t lasting = model->lasting, damaged = model->terms - lasting, rows = steady->residual_size;
    const size_t tiles = (r + STRUCTURE_TILE - 1) / STRUCTURE_TILE;
    for (size_t k = 0; k < damaged; ++k) {
        for (size_t i = 0; i < n; ++i) {
            steady->work[k * n + i] = steady->theta_change[lasting - 1 + k] * coordinates[i];
        }
    }
    for (size_t i = 0, tile = 0; i < rows; i += STRUCTURE_TILE, ++tile) {
        const size_t size = smaller_size(rows - i, STRUCTURE_TILE);
        for (size_t k = 0; k < damaged; ++k) {
            const size_t begin = model->residual_begins[k * tiles + tile];
            structure_add_columns(residual + i, size,
                                  model->stiffness_residual + ((lasting - 1 + k) * n + begin) * r + i, r, n - begin,
                                  steady->work + k * n + begin);
        }
        if (rows > model->health_residual) {
            structure_add_columns(residual + i, size, steady->lasting_residual + i, r, n, coordinates);
        }
    }
    const size_t functions = model->functions, all = functions * outputs;
    memset(steady->dual_products, 0, all * sizeof *correction);
    const double *columns = model->correction_columns + anchor_of(steady) * r * all;
    structure_add_columns(steady->dual_products, all, columns, all, rows, residual);
    memset(correction, 0, outputs * sizeof *correction);
    for (size_t j = 0; j < functions; ++j) {
        for (size_t o = 0; o < outputs; ++o) {
            correction[o] += steady->dual_weights[j * outputs + o] * steady->dual_products[j * outputs + o];
        }
    }
}

/* The same of one unit response, which is kept. */
static void bound_unit(structure_static *steady, size_t load) {
    const structure_model *model = steady->model;
    const size_t r = model->residual_size;
    double *residual = steady->residual + load * r;
    memcpy(residual, model->load_residual + load * r, r * sizeof *residual);
    take_residual(steady, steady->coordinates + load * model->static_size, residual,
                  steady->correction + load * model->output_count);
    steady->bounded[load] = true;
}

/* Norms of the dual residuals: of the factors times (1, -theta_1 c, -theta_2 c, ...). */
static void find_dual_norms(structure_static *steady, size_t anchor) {
    const structure_model *model = steady->model;
    const size_t rows = model->dual_rows, columns = model->dual_columns, m = model->functions;
    const size_t outputs = model->output_count, values = rows * outputs;
    const double *factor = model->dual_factor + anchor * columns * values;
    double *residual = steady->dual_work, *coefficients = residual + values;
    memcpy(residual, factor, values * sizeof *residual);
    for (size_t k = 1; k < columns; ++k) {
        for (size_t o = 0; o < outputs; ++o) {
            coefficients[o] = -steady->theta[(k - 1) / m] * steady->dual_weights[(k - 1) % m * outputs + o];
        }
        for (size_t row = 0; row < rows; ++row) {
            for (size_t o = 0; o < outputs; ++o) {
                residual[row * outputs + o] += factor[k * values + row * outputs + o] * coefficients[o];
            }
        }
    }
    memset(steady->dual_norm, 0, outputs * sizeof *steady->dual_norm);
    for (size_t row = 0; row < rows; ++row) {
        for (size_t o = 0; o < outputs; ++o) {
            steady->dual_norm[o] += residual[row * outputs + o] * residual[row * outputs + o];
        }
    }
    for (size_t o = 0; o < outputs; ++o) {
        steady->dual_norm[o] = sqrt(steady->dual_norm[o]);
    }
}

/* Largest of the bounds of some outputs, before rounding; `correction` belongs to all outputs. */
static double largest_bound(const structure_static *steady, double remainder, const double *correction, size_t first,
                            size_t last) {
    double bound = 0.0;
    for (size_t i = first; i < last; ++i) {
        const double of_output = remainder * steady->dual_norm[i] + fabs(correction[i]);
        bound = bound > of_output ? bound : of_output;
    }
    return bound;
}

structure_bounds structure_static_error_bounds(structure_static *steady, const double *load) {
    const structure_model *model = steady->model;
    const size_t outputs = model->output_count, gauges = model->gauges;
    const size_t n = model->static_size, r = model->residual_size;
    double *residual = steady->whole_residual, *correction = steady->whole_correction;
    solve_needed(steady, load);
    superpose(steady->whole_coordinates, n, model, load, steady->coordinates);
    if (!steady->dual_known) {
        const size_t anchor = anchor_of(steady);
        combine_duals(steady, anchor);
        find_dual_norms(steady, anchor);
        steady->dual_known = true;
    }
    size_t acting = 0;
    for (size_t k = 0; k < model->loads; ++k) {
        acting += load[k] != 0.0;
    }
    if (acting > 2) { /* once for all of them is cheaper than once for each, to be kept */
        superpose(residual, r, model, load, model->load_residual);
        take_residual(steady, steady->whole_coordinates, residual, correction);
    } else {
        for (size_t k = 0; k < model->loads; ++k) {
            if (load[k] != 0.0 && !steady->bounded[k]) {
                bound_unit(steady, k);
            }
        }
        superpose(residual, r, model, load, steady->residual);
        superpose(correction, outputs, model, load, steady->correction);
    }
    /* |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha */
    double remainder = structure_norm(residual, steady->residual_size);
    remainder += model->residual_allowance * structure_norm(steady->whole_coordinates, n);
    double coercivity = 1.0;
    for (size_t k = 0; k + 1 < model->terms; ++k) {
        coercivity = smaller(coercivity, steady->theta[k] / model->bound_reference[k]);
    }
    remainder /= coercivity;
    structure_bounds bounds = {
        .strain = largest_bound(steady, remainder, correction, 0, gauges),
        .displacement = largest_bound(steady, remainder, correction, gauges, outputs),
    };
    superpose(steady->work, outputs, model, load, steady->output);
    bounds.strain += model->rounding_allowance * structure_norm(steady->work, gauges);
    bounds.displacement += model->rounding_allowance * structure_norm(steady->work + gauges, outputs - gauges);
    return bounds;
}
