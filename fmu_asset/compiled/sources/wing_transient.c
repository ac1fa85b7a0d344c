#include "wing_transient.h"

#include <math.h>
#include <string.h>

#include "wing_linear_algebra.h"

void wing_integrator_lay_out(wing_integrator *integrator, const wing_model *model, wing_arena *arena) {
    const size_t count = model->mode_count;
    integrator->model = model;
    wing_static_lay_out(&integrator->steady, model, arena);
    wing_modes_lay_out(&integrator->modes, model, arena);
    integrator->damping_ratio = wing_take(arena, count);
    integrator->modal_static = wing_take(arena, WING_LOADS * count);
    integrator->correction = wing_take(arena, WING_LOADS * model->output_count);
    integrator->propagator = wing_take(arena, 4 * count);
    integrator->work = wing_take(arena, count + 2 * model->modal_size + model->static_size);
}

void wing_motion_lay_out(wing_motion *motion, const wing_model *model, wing_arena *arena) {
    motion->displacement = wing_take(arena, model->mode_count);
    motion->velocity = wing_take(arena, model->mode_count);
}

void wing_integrator_damp(wing_integrator *integrator, double alpha, double beta) {
    for (size_t i = 0; i < integrator->model->mode_count; ++i) {
        const double omega = integrator->modes.angular_frequency[i];
        integrator->damping_ratio[i] = 0.5 * (alpha / omega + beta * omega);
    }
}

bool wing_integrator_prepare(wing_integrator *integrator, const double *key, double alpha,
                             double beta, wing_problem *problem) {
    const wing_model *model = integrator->model;
    const size_t count = model->mode_count, outputs = model->output_count;
    wing_modes *modes = &integrator->modes;
    integrator->duration = 0.0;
    if (!wing_static_prepare(&integrator->steady, key, problem) || !wing_modes_find(modes, key, problem)) {
        return false;
    }
    wing_integrator_damp(integrator, alpha, beta);
    for (size_t load = 0; load < WING_LOADS; ++load) {
        double *modal_static = integrator->modal_static + load * count;
        double *correction = integrator->correction + load * outputs;
        memcpy(correction, wing_static_unit(&integrator->steady, load)->output, outputs * sizeof *correction);
        for (size_t i = 0; i < count; ++i) {
            const double omega = modes->angular_frequency[i];
            modal_static[i] = modes->participation[i * WING_LOADS + load] / (omega * omega);
            wing_add(correction, outputs, -modal_static[i], modes->output + i * outputs);
        }
    }
    return true;
}

/* rest (M) = modal coordinates at rest under a load */
static void find_rest(const wing_integrator *integrator, const double load[WING_LOADS], double *rest) {
    const size_t count = integrator->model->mode_count;
    for (size_t i = 0; i < count; ++i) {
        rest[i] = integrator->modal_static[i] * load[0] + integrator->modal_static[count + i] * load[1];
    }
}

void wing_integrator_release(wing_integrator *integrator, double tip_displacement,
                             const double load[WING_LOADS], wing_motion *motion) {
    const size_t count = integrator->model->mode_count;
    const wing_unit_response *tip = wing_static_unit(&integrator->steady, 1);
    const double holding_force = tip_displacement / tip->output[integrator->model->output_count - 1];
    find_rest(integrator, load, motion->displacement);
    wing_add(motion->displacement, count, holding_force, integrator->modal_static + count);
    memset(motion->velocity, 0, count * sizeof *motion->velocity);
    memcpy(motion->load, load, sizeof motion->load);
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

void wing_integrator_advance(wing_integrator *integrator, const wing_motion *before, double duration,
                             const double load[WING_LOADS], wing_motion *after) {
    const size_t count = integrator->model->mode_count;
    const double *omega = integrator->modes.angular_frequency;
    if (integrator->duration != duration) {
        for (size_t i = 0; i < count; ++i) {
            propagate_mode(omega[i], integrator->damping_ratio[i], duration, integrator->propagator + 4 * i);
        }
        integrator->duration = duration;
    }
    double *rest = integrator->work;
    find_rest(integrator, load, rest);
    for (size_t i = 0; i < count; ++i) {
        const double *factor = integrator->propagator + 4 * i;
        const double aside = before->displacement[i] - rest[i], velocity = before->velocity[i];
        after->displacement[i] = factor[0] * aside + factor[1] * velocity + rest[i];
        after->velocity[i] = factor[2] * aside + factor[3] * velocity + 0.0; /* 0, not -0, at rest */
    }
    memcpy(after->load, load, sizeof after->load);
}

void wing_integrator_take_over(wing_integrator *integrator, wing_integrator *former, const wing_motion *before,
                               wing_motion *after) {
    const wing_model *model = integrator->model;
    const size_t count = model->mode_count, size = model->modal_size, n = model->static_size;
    double *deviation = integrator->work, *modal = deviation + count, *scratch = modal + size,
           *steady = scratch + size;
    find_rest(former, before->load, deviation);
    for (size_t i = 0; i < count; ++i) {
        deviation[i] = before->displacement[i] - deviation[i];
    }
    memset(modal, 0, size * sizeof *modal);
    wing_add_columns(modal, size, former->modes.shape, size, count, deviation);
    memset(steady, 0, n * sizeof *steady);
    for (size_t load = 0; load < WING_LOADS; ++load) {
        wing_add(steady, n, before->load[load], wing_static_unit(&former->steady, load)->coordinates);
    }
    wing_modes_project(&integrator->modes, modal, steady, after->displacement, scratch);
    memset(modal, 0, size * sizeof *modal);
    wing_add_columns(modal, size, former->modes.shape, size, count, before->velocity);
    memset(steady, 0, n * sizeof *steady);
    wing_modes_project(&integrator->modes, modal, steady, after->velocity, scratch);
    memcpy(after->load, before->load, sizeof after->load);
}

void wing_integrator_output(const wing_integrator *integrator, const wing_motion *motion, double *output) {
    const size_t outputs = integrator->model->output_count;
    memset(output, 0, outputs * sizeof *output);
    wing_add_columns(output, outputs, integrator->modes.output, outputs, integrator->model->mode_count,
                     motion->displacement);
    wing_add_columns(output, outputs, integrator->correction, outputs, WING_LOADS, motion->load);
}

double wing_integrator_load_point(wing_integrator *integrator, const wing_motion *motion) {
    const wing_model *model = integrator->model;
    const size_t count = model->mode_count;
    /* How far a mode moves the point is its participation in a force there. */
    const double *participation = integrator->modes.participation;
    double sum = 0.0;
    for (size_t i = 0; i < count; ++i) {
        sum += participation[i * WING_LOADS + 1] * motion->displacement[i];
    }
    for (size_t load = 0; load < WING_LOADS; ++load) {
        const double *modal_static = integrator->modal_static + load * count;
        double correction = wing_static_load_point(&integrator->steady, load);
        for (size_t i = 0; i < count; ++i) {
            correction -= participation[i * WING_LOADS + 1] * modal_static[i];
        }
        sum += correction * motion->load[load];
    }
    return sum;
}
