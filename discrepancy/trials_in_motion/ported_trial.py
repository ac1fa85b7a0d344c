"""A trial of a problem, made into a `PortedTrial`: linear about a point, with its ports.

Terms and shapes are those of `trial`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.fits.candidate import PARAMETER_STEP, SHARED_STEP, Candidate, Point, with_step
from discrepancy.fits.problem import Problem
from discrepancy.system.response import PortedSystem
from discrepancy.system.sensing import shift_clock_to_first_sample
from fe.runtime.patch import ModelPatch
from reporting.arrays import LEAST_DIVISOR

from .trial import ColouredNoise, GainUnknown, PortedTrial

MOST_SUBSTEPS, FEWEST_SUBSTEPS = 16, 4
"""Largest and smallest number of substeps in an interval between two samples."""
LONG_RECORD, FEWEST_SUBSTEPS_OF_LONG_RECORD = 5000, 2
"""Number of samples from which on a trial is long, and the smallest number of substeps then. A long
record is sampled densely, or has slow modes; substeps are what costs time and memory."""
LARGEST_SUBSTEP_PHASE = 0.15
"""Largest phase of the fastest mode in a substep [rad]."""
LONGEST_CORRELATION, LEAST_WHITE_SHARE = 2000, 1e-3
"""Largest number of samples over which the correlation of a noise is computed. Least share of its
variance that is taken as white, so that the filter does not divide by zero."""
FEWEST_SAMPLES = 200
"""Number of samples that thinning leaves of a trial at least."""
HALF_DIFFERENCE = 1e-3
"""Half the difference of a parameter in the derivative of a system [prior standard deviations]."""


def correlated_noise_part(
    channel: int, noise: NoiseModel, interval: float | None
) -> ColouredNoise | None:
    """Return the part of a channel's noise that is correlated in time, or None if it is white.

    The noise is taken as the sum of white noise and an autoregression of first order. Let c_k be
    the autocovariance at a lag of k samples, `share` the fraction of the variance c_0 that is
    correlated, and `decay` the correlation of its successive samples. Then

        c_1 = share c_0 decay,   c_2 = c_1 decay.

    The noise counts as white if no such sum has its autocovariances, or if its autoregression was
    fitted at another sampling interval.

    Parameters
    ----------
    channel : int
        The index of the channel.
    noise : NoiseModel
        Its noise, with the coefficients of an autoregression of any order.
    interval : float or None
        The interval between samples [s]; None if the samples are not equally spaced.
    """
    if interval is None or not noise.can_whiten(interval):
        return None
    impulse_response = lfilter(
        [1.0], np.r_[1.0, -noise.autoregression], np.r_[1.0, np.zeros(LONGEST_CORRELATION)]
    )
    # c_0, c_1 and c_2 up to a common factor, from the response of the autoregression to an impulse
    autocovariances = [
        float(impulse_response[: len(impulse_response) - lag] @ impulse_response[lag:])
        for lag in range(3)
    ]
    # the decay must be between 0 and 1
    if not 0.0 < autocovariances[2] < autocovariances[1]:
        return None
    decay = autocovariances[2] / autocovariances[1]
    share = autocovariances[1] / decay / autocovariances[0]
    return ColouredNoise(
        channel=channel,
        share=min(share, 1.0 - LEAST_WHITE_SHARE),
        decay_rate=-float(np.log(decay)) / interval,
    )


def ported_trial(problem: Problem, trial_index: int, point: Point) -> PortedTrial:
    """Return a dynamic trial of a problem, linear about a point.

    Parameters
    ----------
    problem : Problem
        The campaign and model; the model must describe how its ports move.
    trial_index : int
        The index of the trial in the problem.
    point : Point
        The values of the unknowns about which the trial is linear.
    """
    data = problem.trials[trial_index]
    trial = data.trial
    # linear system with ports, at the point
    gains = 1.0 + problem.shared.gains(point.shared, trial.channels)
    system, system_derivatives = _ported_system(problem, trial, point.shared)
    system = _with_gains(system, gains)
    substeps = _substep_count(problem, trial)
    # response of the model, about which the missing forces are added
    positions_and_speeds, by_unknowns = _port_motion(problem, trial_index, point, substeps)
    residual, by_shared, by_local = residual_and_derivatives(problem, trial_index, point)
    deviation = data.sample_deviation
    return PortedTrial(
        name=trial.name,
        time=trial.time,
        residual=residual / deviation * trial.used,
        used=trial.used,
        deviation=deviation,
        coloured_noises=_coloured_noises(data.noise_models, trial.whitening_interval),
        shared_derivatives=by_shared / deviation * trial.used,
        local_derivatives=by_local / deviation * trial.used,
        local_precision=data.unknowns.precision,
        system=system,
        system_derivatives=[
            None if derivative is None else _with_gains(derivative, gains)
            for derivative in system_derivatives
        ],
        substeps=substeps,
        port_positions=positions_and_speeds[0],
        port_speeds=positions_and_speeds[1],
        begins_at_rest=trial.begins.value == "settled" and trial.kind.value != "ringdown",
        linearisation_point=np.concatenate((point.shared, point.local[trial_index])),
        gain_unknowns=gain_unknowns(problem, trial, gains),
        port_motion_derivatives=by_unknowns,
    )


def thinning_stride(trial: PortedTrial, wanted_stride: float) -> int:
    """Return the stride with which a trial is thinned, at most the wanted one.

    In a substep of the thinned trial, the phase of the fastest mode and that of the motion of each
    port must change by at most `LARGEST_SUBSTEP_PHASE`. A trial with uneven intervals is not
    thinned.

    Parameters
    ----------
    trial : PortedTrial
        The trial with all samples.
    wanted_stride : float
        The stride with which it would have the wanted number of samples.
    """
    lengths, _ = trial.intervals
    if len(lengths) > 1:
        return 1
    interval = float(lengths[0])
    phase_of_modes = interval * float(
        np.max(np.abs(np.linalg.eigvals(trial.system.generator)), initial=0.0)
    )
    # for a sine, the rms rate of the speed over the rms speed is its angular frequency
    rms_change = np.sqrt(np.mean(np.diff(trial.port_speeds, axis=0) ** 2, axis=0)) * trial.substeps
    rms_speed = np.sqrt(np.mean(trial.port_speeds**2, axis=0))
    phase_of_motion = float(np.max(rms_change / np.maximum(rms_speed, LEAST_DIVISOR), initial=0.0))
    # a thinned trial has at least `FEWEST_SUBSTEPS`
    largest_phase = LARGEST_SUBSTEP_PHASE * max(trial.substeps, FEWEST_SUBSTEPS)
    longest_stride = largest_phase / max(phase_of_modes, phase_of_motion, LEAST_DIVISOR)
    stride = int(min(wanted_stride, longest_stride, len(trial.time) / FEWEST_SAMPLES))
    # a substep of the thinned trial must consist of whole substeps of the trial
    multiple = FEWEST_SUBSTEPS // trial.substeps if trial.substeps < FEWEST_SUBSTEPS else 1
    return max(1, stride - stride % multiple)


def thin_trial(trial: PortedTrial, stride: int) -> PortedTrial:
    """Return a trial with every `stride`-th sample, and at least `FEWEST_SUBSTEPS` between two."""
    if stride == 1:
        return trial
    return trial.thinned(stride, max(trial.substeps, FEWEST_SUBSTEPS))


def residual_and_derivatives(
    problem: Problem, trial_index: int, unknowns: Point
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the residuals at zero unknowns, and the derivatives of the readings.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    trial_index : int
        The index of the trial in the problem.
    unknowns : Point
        The values u_0 of the unknowns about which the model is linearised.

    Returns
    -------
    residual : (N, C) array
        The readings minus the prediction of the linear model at zero unknowns [unit of the
        channel].
    by_shared, by_local : (K, N, C), (L, N, C) array
        The derivatives D of the prediction by the shared unknowns, and by those of the trial alone.
    """
    data = problem.trials[trial_index]
    linear_response = problem.linearise(trial_index, unknowns, Candidate())
    derivatives, shared_of_column = problem.prediction_derivatives(
        trial_index, unknowns, linear_response, Candidate()
    )
    by_local = derivatives[: data.unknowns.unknown_count]
    by_shared = np.zeros((problem.shared.unknown_count, *linear_response.response.shape))
    by_shared[shared_of_column] = derivatives[data.unknowns.unknown_count :]
    residual = data.trial.values - problem.prediction(
        trial_index, unknowns, linear_response.response
    )
    # the linear prediction is p(u_0) + D (u - u_0); at u = 0 it is p(u_0) - D u_0
    residual += np.tensordot(unknowns.shared, by_shared, 1) + np.tensordot(
        unknowns.local[trial_index], by_local, 1
    )
    return residual, by_shared, by_local


def gain_unknowns(problem: Problem, trial: Trial, gains: FloatArray) -> list[GainUnknown]:
    """Return the shared unknowns that are gains of the trial's channels.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    trial : Trial
        The trial with its readings, inputs and sample times.
    gains : (C,) array
        The present gain of each channel of the trial; 1 for a channel without a gain error.
    """
    layout = problem.shared
    unknowns = []
    for gain_index, channel_name in enumerate(layout.gain_channels):
        if channel_name in trial.channels:
            unknown_index = layout.parameter_count + gain_index
            column = trial.channels.index(channel_name)
            # The predicted readings are multiplied by the present gain already. So a change of the
            # gain by one scale changes them by scale / gain of their value.
            relative_change = float(layout.scale[unknown_index]) / float(gains[column])
            unknowns.append(GainUnknown(unknown_index, column, relative_change))
    return unknowns


def _coloured_noises(noises: Sequence[NoiseModel], interval: float | None) -> list[ColouredNoise]:
    """Return the parts of the channels' noises that are correlated in time."""
    noise_parts = [
        correlated_noise_part(channel, noise, interval) for channel, noise in enumerate(noises)
    ]
    return [noise_part for noise_part in noise_parts if noise_part is not None]


def _substep_count(problem: Problem, trial: Trial) -> int:
    """Return the number of substeps in an interval between two samples of a trial.

    The phase of the fastest mode may change by at most `LARGEST_SUBSTEP_PHASE` in a substep. The
    mode is that at the prior means, so that trials that are linear about other values have the same
    fine stamps. The number is at most `MOST_SUBSTEPS`, and at least `FEWEST_SUBSTEPS`, or
    `FEWEST_SUBSTEPS_OF_LONG_RECORD` for a record of more than `LONG_RECORD` samples.
    """
    prior_means = problem.prior_mean_point(Candidate())
    parameters = problem.shared.parameters(prior_means.shared)
    system = problem.model.ported_system(trial, problem.campaign.outputs(trial), parameters)
    interval = float(np.median(np.diff(trial.time)))
    fastest_angular_frequency = float(
        np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)
    )
    substeps_needed = np.ceil(fastest_angular_frequency * interval / LARGEST_SUBSTEP_PHASE)
    is_long = len(trial.time) > LONG_RECORD
    fewest = FEWEST_SUBSTEPS_OF_LONG_RECORD if is_long else FEWEST_SUBSTEPS
    return int(np.clip(substeps_needed, fewest, MOST_SUBSTEPS))


def _port_motion(
    problem: Problem, trial_index: int, point: Point, substeps: int
) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Return the motion of the ports caused by the model alone, and its derivatives.

    The derivatives are those with respect to the unknowns.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    trial_index : int
        The index of the trial in the problem.
    point : Point
        The values of the unknowns.
    substeps : int
        The number of substeps in an interval between two samples.

    Returns
    -------
    motion : (2, F, P) array
        The positions and speeds of the P ports at the fine stamps [m or rad, and per s].
    by_unknowns : dict of int to (2, F, P) array
        The derivatives of the motion, by the number of the unknown in
        `PortedTrial.linearisation_point`.
    """
    data = problem.trials[trial_index]
    layout = problem.shared
    trial_in_own_clock, _ = shift_clock_to_first_sample(data.trial, ModelPatch())

    def motion(shared_values: FloatArray, local_values: FloatArray) -> FloatArray:
        parameters = layout.parameters(shared_values)
        conditions = data.unknowns.conditions(data.trial, parameters, local_values)
        return np.stack(problem.model.port_motion(trial_in_own_clock, conditions, substeps))

    local_at_point = point.local[trial_index]
    motion_at_point = motion(point.shared, local_at_point)
    by_unknowns = {}
    # central quotients by parameters, see `two_sided_quotient`
    for k in range(layout.parameter_count):
        motion_above = motion(with_step(point.shared, k, SHARED_STEP), local_at_point)
        motion_below = motion(with_step(point.shared, k, -SHARED_STEP), local_at_point)
        by_unknowns[k] = (motion_above - motion_below) / (2.0 * SHARED_STEP)
    # The motion is nearly linear in the unknowns of the trial. The first of them are the zeros of
    # its channels, which do not move the ports.
    for k in range(data.unknowns.zero_count, data.unknowns.unknown_count):
        stepped_motion = motion(point.shared, with_step(local_at_point, k))
        by_unknowns[layout.unknown_count + k] = (stepped_motion - motion_at_point) / PARAMETER_STEP
    return motion_at_point, by_unknowns


def _with_gains(system: PortedSystem, gains: FloatArray) -> PortedSystem:
    """Return a system whose outputs are multiplied by the gains (C,) of their channels."""
    return replace(system, outputs=system.outputs * gains[:, None], through=system.through * gains)


def _ported_system(
    problem: Problem, trial: Trial, shared_values: FloatArray
) -> tuple[PortedSystem, list[PortedSystem | None]]:
    """Return the linear system of a trial with its ports, and its derivatives by shared unknowns.

    A port is a place of the structure where a force may act. A derivative that is zero is None; so
    are those by the last unknowns, the gains of channels, which do not change the system.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    trial : Trial
        The trial with its readings, inputs and sample times.
    shared_values : (K,) array
        The values of the shared unknowns.
    """
    unknowns = problem.shared
    outputs = problem.campaign.outputs(trial)

    def system(shared_at: FloatArray) -> PortedSystem:
        return problem.model.ported_system(trial, outputs, unknowns.parameters(shared_at))

    derivatives: list[PortedSystem | None] = []
    for k in range(unknowns.parameter_count):
        system_above = system(with_step(shared_values, k, HALF_DIFFERENCE))
        system_below = system(with_step(shared_values, k, -HALF_DIFFERENCE))
        derivatives.append(_system_derivative(system_above, system_below))
    derivatives += [None] * (unknowns.unknown_count - len(derivatives))
    return system(shared_values), derivatives


def _system_derivative(
    system_above: PortedSystem, system_below: PortedSystem
) -> PortedSystem | None:
    """Return the derivative of a system by a parameter, a central difference; None if zero.

    Parameters
    ----------
    system_above, system_below : PortedSystem
        The system with the parameter `HALF_DIFFERENCE` above and below its value.
    """

    def slope(value_above: FloatArray, value_below: FloatArray) -> FloatArray:
        return np.asarray((value_above - value_below) / (2.0 * HALF_DIFFERENCE))

    derivative = replace(
        system_above,
        generator=slope(system_above.generator, system_below.generator),
        actions=slope(system_above.actions, system_below.actions),
        outputs=slope(system_above.outputs, system_below.outputs),
        through=slope(system_above.through, system_below.through),
    )
    arrays = (derivative.generator, derivative.actions, derivative.outputs, derivative.through)
    return derivative if any(np.any(array) for array in arrays) else None
