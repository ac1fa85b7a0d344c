#include "wing_static.h"

#include <math.h>
#include <string.h>

#include "wing_linear_algebra.h"

static size_t larger(size_t first, size_t second) { return first > second ? first : second; }

static double smaller(double first, double second) { return first < second ? first : second; }

void wing_static_lay_out(wing_static *wing, const wing_model *model, wing_arena *arena) {
    const size_t n = model->static_size, outputs = model->output_count, r = model->residual_size;
    wing->model = model;
    wing->lasting_stiffness = wing_take(arena, n * n);
    wing->lasting_residual = wing_take(arena, n * r);
    wing->factor = wing_take(arena, n * n);
    wing->dual_norm = wing_take(arena, outputs);
    for (size_t load = 0; load < WING_LOADS; ++load) {
        wing->unit[load].coordinates = wing_take(arena, n);
        wing->unit[load].output = wing_take(arena, outputs);
        wing->unit[load].residual = wing_take(arena, r);
        wing->unit[load].correction = wing_take(arena, outputs);
    }
    wing->work = wing_take(arena, (model->regions + 1) * larger(n, larger(r, outputs)));
}

/* sum = e * first + last, of the terms of an array (T, size) */
static void join_lasting(double *sum, const double *terms, size_t count, size_t size, double skin) {
    memcpy(sum, terms + (count - 1) * size, size * sizeof *sum);
    wing_add(sum, size, skin, terms);
}

bool wing_static_prepare(wing_static *wing, const double *health, wing_problem *problem) {
    const wing_model *model = wing->model;
    const size_t regions = model->regions;
    if (wing->factorised && memcmp(wing->health, health, (regions + 1) * sizeof *health) == 0) {
        return true;
    }
    memcpy(wing->health, health, (regions + 1) * sizeof *health);
    wing->theta[0] = health[0];
    for (size_t k = 1; k <= regions; ++k) {
        wing->theta[k] = 1.0 - health[k];
    }
    wing->theta[regions + 1] = 1.0;
    wing->dual_known = false;
    for (size_t load = 0; load < WING_LOADS; ++load) {
        wing->unit[load].solved = wing->unit[load].bounded = false;
    }
    const size_t n = model->static_size;
    if (!wing->lasting_known || wing->lasting_skin != health[0]) {
        join_lasting(wing->lasting_stiffness, model->static_stiffness, model->terms, n * n, health[0]);
        join_lasting(wing->lasting_residual, model->stiffness_residual, model->terms,
                     n * model->residual_size, health[0]);
        wing->lasting_skin = health[0];
        wing->lasting_known = true;
    }
    memcpy(wing->factor, wing->lasting_stiffness, n * n * sizeof *wing->factor);
    wing_add_columns(wing->factor, n * n, model->static_stiffness + n * n, n * n, regions, wing->theta + 1);
    wing->factorised = wing_cholesky(wing->factor, n);
    return wing->factorised ||
           wing_fail(problem, "the stiffness at e = %g with the first loss %g is not positive definite",
                     health[0], health[1]);
}

const wing_unit_response *wing_static_unit(wing_static *wing, size_t load) {
    const wing_model *model = wing->model;
    wing_unit_response *unit = &wing->unit[load];
    if (!unit->solved) {
        const size_t n = model->static_size, outputs = model->output_count;
        memcpy(unit->coordinates, model->static_load + load * n, n * sizeof *unit->coordinates);
        wing_solve_lower(wing->factor, n, unit->coordinates);
        wing_solve_upper(wing->factor, n, unit->coordinates);
        memset(unit->output, 0, outputs * sizeof *unit->output);
        wing_add_columns(unit->output, outputs, model->output_columns, outputs, n, unit->coordinates);
        unit->solved = true;
    }
    return unit;
}

double wing_static_load_point(wing_static *wing, size_t load) {
    const size_t n = wing->model->static_size;
    const double *coordinates = wing_static_unit(wing, load)->coordinates;
    const double *output = wing->model->static_load + n; /* the tip force's load vector, by reciprocity */
    double sum = 0.0;
    for (size_t i = 0; i < n; ++i) {
        sum += output[i] * coordinates[i];
    }
    return sum;
}

/* sum (size) = load factor times what one unit of lift gives, plus tip force times what 1 N gives */
static void superpose(double *sum, size_t size, const double load[WING_LOADS],
                      const double *const given[WING_LOADS]) {
    memset(sum, 0, size * sizeof *sum);
    for (size_t k = 0; k < WING_LOADS; ++k) {
        if (load[k] != 0.0) {
            wing_add(sum, size, load[k], given[k]);
        }
    }
}

/* The unit responses that a load needs, without those that it does not have. */
static void needed_units(wing_static *wing, const double load[WING_LOADS],
                         const wing_unit_response *units[WING_LOADS]) {
    for (size_t k = 0; k < WING_LOADS; ++k) {
        units[k] = load[k] != 0.0 ? wing_static_unit(wing, k) : &wing->unit[k];
    }
}

void wing_static_response(wing_static *wing, const double load[WING_LOADS], double *output) {
    const wing_unit_response *units[WING_LOADS];
    needed_units(wing, load, units);
    const double *const outputs[WING_LOADS] = {units[0]->output, units[1]->output};
    superpose(output, wing->model->output_count, load, outputs);
}

/* Index of the approximate dual solution of one region: how many splits its loss has reached. */
static size_t anchor_index(const wing_model *model, size_t region, double loss) {
    size_t index = 0;
    while (index + 1 < model->anchors[region] && model->dual_split[region][index] <= loss) {
        ++index;
    }
    return index;
}

static size_t anchor_of(const wing_static *wing) {
    size_t index = 0;
    for (size_t k = 0; k < wing->model->regions; ++k) {
        index = index * wing->model->anchors[k] + anchor_index(wing->model, k, wing->health[k + 1]);
    }
    return index;
}

/* The residual of one unit response, and its product with the approximate dual solutions. */
static void bound_unit(wing_static *wing, size_t load) {
    const wing_model *model = wing->model;
    wing_unit_response *unit = &wing->unit[load];
    const size_t n = model->static_size, r = model->residual_size, outputs = model->output_count;
    memcpy(unit->residual, model->load_residual + load * r, r * sizeof *unit->residual);
    wing_add_columns(unit->residual, r, wing->lasting_residual, r, n, unit->coordinates);
    /* The damage regions, whose columns lie one after another. */
    for (size_t k = 0; k < model->regions; ++k) {
        for (size_t i = 0; i < n; ++i) {
            wing->work[k * n + i] = wing->theta[k + 1] * unit->coordinates[i];
        }
    }
    wing_add_columns(unit->residual, r, model->stiffness_residual + n * r, r, model->regions * n, wing->work);
    memset(unit->correction, 0, outputs * sizeof *unit->correction);
    wing_add_columns(unit->correction, outputs, model->correction_columns + anchor_of(wing) * r * outputs, outputs,
                     r, unit->residual);
    unit->bounded = true;
}

/* Norms of the dual residuals: of the factors times (1, -e, z1 - 1, ...). */
static void find_dual_norms(wing_static *wing) {
    const wing_model *model = wing->model;
    const size_t terms = model->terms;
    const double *factor = model->dual_residual + anchor_of(wing) * model->output_count * terms * terms;
    double coefficients[WING_MOST_TERMS] = {1.0};
    for (size_t k = 1; k < terms; ++k) {
        coefficients[k] = -wing->theta[k - 1];
    }
    for (size_t i = 0; i < model->output_count; ++i) {
        double sum = 0.0;
        for (size_t row = 0; row < terms; ++row, factor += terms) {
            double value = 0.0;
            size_t k = 0;
            for (; k + 2 <= terms; k += 2) {
                value += coefficients[k] * factor[k] + coefficients[k + 1] * factor[k + 1];
            }
            for (; k < terms; ++k) {
                value += coefficients[k] * factor[k];
            }
            sum += value * value;
        }
        wing->dual_norm[i] = sqrt(sum);
    }
    wing->dual_known = true;
}

double wing_static_error_bound(wing_static *wing, const double load[WING_LOADS]) {
    const wing_model *model = wing->model;
    const wing_unit_response *units[WING_LOADS];
    const size_t outputs = model->output_count, gauges = outputs - 1;
    needed_units(wing, load, units);
    for (size_t k = 0; k < WING_LOADS; ++k) {
        if (load[k] != 0.0 && !wing->unit[k].bounded) {
            bound_unit(wing, k);
        }
    }
    if (!wing->dual_known) {
        find_dual_norms(wing);
    }
    const double *const residuals[WING_LOADS] = {units[0]->residual, units[1]->residual};
    const double *const coordinates[WING_LOADS] = {units[0]->coordinates, units[1]->coordinates};
    const double *const corrections[WING_LOADS] = {units[0]->correction, units[1]->correction};
    const double *const strains[WING_LOADS] = {units[0]->output, units[1]->output};
    /* |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha */
    superpose(wing->work, model->residual_size, load, residuals);
    double remainder = wing_norm(wing->work, model->residual_size);
    superpose(wing->work, model->static_size, load, coordinates);
    remainder += model->residual_allowance * wing_norm(wing->work, model->static_size);
    double coercivity = 1.0;
    for (size_t k = 0; k <= model->regions; ++k) {
        coercivity = smaller(coercivity, wing->theta[k] / model->bound_reference[k]);
    }
    remainder /= coercivity;
    superpose(wing->work, outputs, load, corrections);
    double bound = 0.0;
    for (size_t i = 0; i < gauges; ++i) {
        const double of_gauge = remainder * wing->dual_norm[i] + fabs(wing->work[i]);
        bound = bound > of_gauge ? bound : of_gauge;
    }
    superpose(wing->work, gauges, load, strains);
    return bound + model->rounding_allowance * wing_norm(wing->work, gauges);
}
