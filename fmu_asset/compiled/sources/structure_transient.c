#include "structure_transient.h"

#include <math.h>
#include <string.h>

#include "structure_linear_algebra.h"

void structure_integrator_lay_out(structure_integrator *integrator, const structure_model *model, structure_arena *arena) {
    const size_t count = model->mode_count;
    integrator->model = model;
    structure_static_lay_out(&integrator->steady, model, arena);
    structure_modes_lay_out(&integrator->modes, model, arena);
    integrator->damping_ratio = structure_take(arena, count);
    integrator->modal_static = structure_take(arena, model->loads * count);
    integrator->correction = structure_take(arena, model->loads * model->output_count);
    integrator->propagator = structure_take(arena, 4 * count);
    integrator->work = structure_take(arena, count + 2 * model->modal_size + model->static_size);
}

void structure_motion_lay_out(structure_motion *motion, const structure_model *model, structure_arena *arena) {
    motion->displacement = structure_take(arena, model->mode_count);
    motion->velocity = structure_take(arena, model->mode_count);
    motion->load = structure_take(arena, model->loads);
}

void structure_integrator_damp(structure_integrator *integrator, double alpha, double beta) {
    for (size_t i = 0; i < integrator->model->mode_count; ++i) {
        const double omega = integrator->modes.angular_frequency[i];
        integrator->damping_ratio[i] = 0.5 * (alpha / omega + beta * omega);
    }
}

bool structure_integrator_prepare(structure_integrator *integrator, const double *chosen, double alpha, double beta,
                                  structure_problem *problem) {
    const structure_model *model = integrator->model;
    const size_t count = model->mode_count, outputs = model->output_count, loads = model->loads;
    structure_modes *modes = &integrator->modes;
    integrator->duration = 0.0;
    if (!structure_static_prepare(&integrator->steady, chosen, problem) || !structure_modes_find(modes, chosen, problem)) {
        return false;
    }
    structure_integrator_damp(integrator, alpha, beta);
    for (size_t load = 0; load < loads; ++load) {
        double *modal_static = integrator->modal_static + load * count;
        double *correction = integrator->correction + load * outputs;
        structure_static_solve(&integrator->steady, load);
        memcpy(correction, integrator->steady.output + load * outputs, outputs * sizeof *correction);
        for (size_t i = 0; i < count; ++i) {
            const double omega = modes->angular_frequency[i];
            modal_static[i] = modes->participation[i * loads + load] / (omega * omega);
            structure_add(correction, outputs, -modal_static[i], modes->output + i * model->modal_outputs);
        }
    }
    return true;
}

/* rest (M) = modal coordinates at rest under a load */
static void find_rest(const structure_integrator *integrator, const double *load, double *rest) {
    const size_t count = integrator->model->mode_count, loads = integrator->model->loads;
    for (size_t i = 0; i < count; ++i) {
        double sum = integrator->modal_static[i] * load[0];
        for (size_t k = 1; k < loads; ++k) {
            sum += integrator->modal_static[k * count + i] * load[k];
        }
        rest[i] = sum;
    }
}

void structure_integrator_release(structure_integrator *integrator, size_t point, double displacement,
                                  const double *load, structure_motion *motion) {
    const structure_model *model = integrator->model;
    const size_t count = model->mode_count, outputs = model->output_count;
    find_rest(integrator, load, motion->displacement);
    if (displacement != 0.0) {
        structure_static_solve(&integrator->steady, point);
        const double holding_force = displacement / integrator->steady.output[point * outputs + outputs - 1];
        structure_add(motion->displacement, count, holding_force, integrator->modal_static + point * count);
    }
    memset(motion->velocity, 0, count * sizeof *motion->velocity);
    memcpy(motion->load, load, model->loads * sizeof *load);
}

/* Exact free response of one mode after a duration, without differences of large numbers, so that damping ratios
   near 1 and far above it are accurate. */
static void propagate_mode(double omega, double zeta, double duration, double factor[4]) {
    const double decay = zeta * omega;
    const double root = omega * sqrt(fabs((zeta - 1.0) * (zeta + 1.0)));
    double sinus;
    if (zeta > 1.0) { /* two decays, slow times fast = omega^2 */
        const double fast = decay + root, slow = omega * omega / fast, gap = 2.0 * root;
        const double part = gap * duration > 0.0 ? -expm1(-gap * duration) / gap : duration;
        const double slow_exponential = exp(-slow * duration);
        sinus = slow_exponential * part;
        factor[0] = slow_exponential + slow * sinus;
        factor[3] = exp(-fast * duration) - slow * sinus;
    } else {
        const double envelope = exp(-decay * duration), angle = root * duration;
        sinus = envelope * duration * (angle > 0.0 ? sin(angle) / angle : 1.0);
        factor[0] = envelope * cos(angle) + decay * sinus;
        factor[3] = envelope * cos(angle) - decay * sinus;
    }
    factor[1] = sinus;
    factor[2] = -(omega * omega) * sinus;
}

void structure_integrator_advance(structure_integrator *integrator, const structure_motion *before, double duration,
                                  const double *begin, const double *load, structure_motion *after) {
    const size_t count = integrator->model->mode_count;
    const double *omega = integrator->modes.angular_frequency;
    if (integrator->duration != duration) {
        for (size_t i = 0; i < count; ++i) {
            propagate_mode(omega[i], integrator->damping_ratio[i], duration, integrator->propagator + 4 * i);
        }
        integrator->duration = duration;
    }
    double *rest = integrator->work, *first = rest + count;
    find_rest(integrator, load, rest);
    find_rest(integrator, begin == NULL ? load : begin, first);
    for (size_t i = 0; i < count; ++i) {
        /* Under a load that moves, the motion without oscillation is that at rest, behind it in time. */
        const double *factor = integrator->propagator + 4 * i, speed = (rest[i] - first[i]) / duration;
        const double behind = speed == 0.0 ? 0.0 : 2.0 * integrator->damping_ratio[i] / omega[i] * speed;
        const double aside = before->displacement[i] - (first[i] - behind), velocity = before->velocity[i] - speed;
        after->displacement[i] = factor[0] * aside + factor[1] * velocity + (rest[i] - behind);
        after->velocity[i] = factor[2] * aside + factor[3] * velocity + speed; /* 0, not -0, at rest */
    }
    memcpy(after->load, load, integrator->model->loads * sizeof *load);
}

void structure_integrator_take_over(structure_integrator *integrator, structure_integrator *former, const structure_motion *before,
                               structure_motion *after) {
    const structure_model *model = integrator->model;
    const size_t count = model->mode_count, size = model->modal_size, n = model->static_size;
    double *deviation = integrator->work, *modal = deviation + count, *scratch = modal + size,
           *steady = scratch + size;
    find_rest(former, before->load, deviation);
    for (size_t i = 0; i < count; ++i) {
        deviation[i] = before->displacement[i] - deviation[i];
    }
    memset(modal, 0, size * sizeof *modal);
    structure_add_columns(modal, size, former->modes.shape, size, count, deviation);
    memset(steady, 0, n * sizeof *steady);
    for (size_t load = 0; load < model->loads; ++load) {
        structure_static_solve(&former->steady, load);
        structure_add(steady, n, before->load[load], former->steady.coordinates + load * n);
    }
    structure_modes_project(&integrator->modes, modal, steady, after->displacement, scratch);
    memset(modal, 0, size * sizeof *modal);
    structure_add_columns(modal, size, former->modes.shape, size, count, before->velocity);
    structure_modes_project(&integrator->modes, modal, NULL, after->velocity, scratch);
    memcpy(after->load, before->load, model->loads * sizeof *after->load);
}

double structure_integrator_acceleration(const structure_integrator *integrator, const structure_motion *motion,
                                         size_t mode) {
    const structure_modes *modes = &integrator->modes;
    const size_t loads = integrator->model->loads;
    const double omega = modes->angular_frequency[mode];
    const double force = structure_dot(modes->participation + mode * loads, motion->load, loads);
    return force - 2.0 * integrator->damping_ratio[mode] * omega * motion->velocity[mode] -
           omega * omega * motion->displacement[mode];
}

/* Add the accelerations that a second derivative of one modal coordinate makes. */
static void add_acceleration(const structure_integrator *integrator, size_t mode, double acceleration, double *output) {
    const size_t outputs = integrator->model->output_count, all = integrator->model->modal_outputs;
    structure_add(output + outputs, all - outputs, acceleration, integrator->modes.output + mode * all + outputs);
}

void structure_integrator_output(const structure_integrator *integrator, const structure_motion *motion, double *output) {
    const structure_model *model = integrator->model;
    const structure_modes *modes = &integrator->modes;
    const size_t outputs = model->output_count, all = model->modal_outputs, count = model->mode_count;
    memset(output, 0, all * sizeof *output);
    structure_add_columns(output, outputs, modes->output, all, count, motion->displacement);
    structure_add_columns(output, outputs, integrator->correction, outputs, model->loads, motion->load);
    if (all == outputs) {
        return;
    }
    for (size_t i = 0; i < count; ++i) {
        const double acceleration = structure_integrator_acceleration(integrator, motion, i);
        add_acceleration(integrator, i, acceleration, output);
    }
}

/* What the modes that are not kept contribute to the displacement of a point, per unit of a load. */
static double point_correction(structure_integrator *integrator, size_t point, size_t load) {
    const size_t count = integrator->model->mode_count, loads = integrator->model->loads;
    const double *modal_static = integrator->modal_static + load * count;
    double correction = structure_static_load_point(&integrator->steady, point, load);
    for (size_t i = 0; i < count; ++i) {
        correction -= integrator->modes.participation[i * loads + point] * modal_static[i];
    }
    return correction;
}

void structure_integrator_derivative(structure_integrator *integrator, const double *chosen, size_t which, size_t point,
                                     double *output, double *load_point, double *rates) {
    const structure_model *model = integrator->model;
    const size_t outputs = model->output_count, count = model->mode_count;
    memset(output, 0, model->modal_outputs * sizeof *output);
    memset(rates, 0, 2 * count * sizeof *rates);
    *load_point = 0.0;
    for (size_t k = 0; k < model->loads; ++k) {
        const double factor = structure_load_derivative(model, k, chosen, which);
        if (factor == 0.0) {
            continue;
        }
        structure_add(output, outputs, factor, integrator->correction + k * outputs);
        *load_point += factor * point_correction(integrator, point, k);
        for (size_t i = 0; i < count; ++i) {
            const double acceleration = factor * integrator->modes.participation[i * model->loads + k];
            rates[count + i] += acceleration;
            add_acceleration(integrator, i, acceleration, output);
        }
    }
}

void structure_integrator_state_derivative(const structure_integrator *integrator, size_t state, size_t point,
                                           double *output, double *load_point, double *rates) {
    const structure_model *model = integrator->model;
    const structure_modes *modes = &integrator->modes;
    const size_t count = model->mode_count, mode = state % count;
    const double omega = modes->angular_frequency[mode];
    const bool velocity = state >= count;
    memset(output, 0, model->modal_outputs * sizeof *output);
    memset(rates, 0, 2 * count * sizeof *rates);
    *load_point = 0.0;
    if (velocity) {
        rates[mode] = 1.0;
    } else {
        structure_add(output, model->output_count, 1.0, modes->output + mode * model->modal_outputs);
        *load_point = modes->participation[mode * model->loads + point];
    }
    rates[count + mode] = velocity ? -2.0 * integrator->damping_ratio[mode] * omega : -omega * omega;
    add_acceleration(integrator, mode, rates[count + mode], output);
}

double structure_integrator_load_point(structure_integrator *integrator, size_t point,
                                       const structure_motion *motion) {
    const structure_model *model = integrator->model;
    const size_t count = model->mode_count, loads = model->loads;
    /* How far a mode moves the point is its participation in a force there. */
    const double *participation = integrator->modes.participation;
    double sum = 0.0;
    for (size_t i = 0; i < count; ++i) {
        sum += participation[i * loads + point] * motion->displacement[i];
    }
    for (size_t load = 0; load < loads; ++load) {
        sum += point_correction(integrator, point, load) * motion->load[load];
    }
    return sum;
}
