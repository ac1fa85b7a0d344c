"""A dynamic trial in which a missing force is looked for: its residuals, and their derivatives.

The trial is linear in its unknowns. Residuals and derivatives are divided by the standard
deviations of the noise. The unknowns are those of `fits.trial_data`, with prior mean zero. A
calibrated parameter changes the motion of the model (a column of derivatives of the readings) and
the motion that missing forces add to it (`slopes`); both together are exact along the actual
motion.

Terms and shapes: a port is a place where a force can act. An interval between two of the N samples
is divided into `parts` fine steps; their ends are the F = (N - 1) parts + 1 fine stamps. The added
state (F, n) is the state of the linear system that forces at ports add to the model's response. A
column is the change of the readings (N, C) for a unit of one unknown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import BoolArray, FloatArray, IntArray, Trial
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Point, with_step
from discrepancy.fits.problem import Problem
from discrepancy.system.response import PortedSystem
from discrepancy.system.sensing import shift_clock_to_first_sample
from discrepancy.system.time_history import subdivide
from fe.runtime.patch import ModelPatch

from .kalman import driven

FINEST, COARSEST = 16, 4
"""Largest and smallest number of fine steps in an interval between two samples."""
FINE_PHASE = 0.15
"""Largest phase of the fastest mode in a fine step [rad]."""
LONGEST_MEMORY, LEAST_WHITE = 2000, 1e-3
"""Largest number of samples over which the correlation of a noise is computed; least share of its
variance that is taken as white."""
SMALL = 1e-3
"""Half the difference of a parameter in the derivative of a system [prior standard deviations]."""

NO_FORCES: Mapping[int, FloatArray] = MappingProxyType({})
"""Forces by port of a trial without any."""


@dataclass(frozen=True, eq=False)
class TrialColumn:
    """The change of a trial for a unit of one unknown, such as the amplitude of an effect.

    Attributes
    ----------
    readings : (N, C) ndarray
        The change of the readings, divided by the noise deviations.
    added : (F, n) ndarray or None
        The change of the added state; None if it does not change.
    forces : mapping of int to (F,) ndarray
        The change of the force at each port, by the number of the port [N, N m or the port's flow].
    """

    readings: FloatArray
    added: FloatArray | None = None
    forces: Mapping[int, FloatArray] = field(default_factory=dict)

    def plus(self, other: "TrialColumn", factor: float) -> "TrialColumn":
        """Return the sum of this column and another one that is multiplied by `factor`."""
        forces = dict(self.forces)
        for port, force in other.forces.items():
            forces[port] = forces.get(port, 0.0) + factor * force
        if other.added is None:
            added = self.added
        elif self.added is None:
            added = factor * other.added
        else:
            added = self.added + factor * other.added
        return TrialColumn(self.readings + factor * other.readings, added, forces)


@dataclass(frozen=True, eq=False)
class SeenTrial:
    """A dynamic trial as a linear system with ports, with its residuals and their derivatives.

    Shapes: N samples, C channels, F fine stamps, n states, P ports, K shared unknowns, L unknowns
    of this trial alone, J different lengths of intervals.

    Attributes
    ----------
    name : str
        The name of the trial.
    time : (N,) ndarray
        The stamps of the samples [s].
    residual : (N, C) ndarray
        The readings minus the prediction of the linear model at zero unknowns, divided by the noise
        deviations.
    used : (N, C) ndarray of bool
        Whether each reading counts.
    deviation : (C,) ndarray
        The standard deviation of the noise of each channel [unit of the channel].
    coloured : sequence of (int, float, float)
        The channels whose noise has a part correlated in time: the number of the channel, the share
        of that part in the variance, and its decay rate [1/s].
    shared, local : (K, N, C), (L, N, C) ndarray
        The derivatives of the readings by the shared unknowns, and by those of this trial alone,
        divided by the noise deviations.
    local_precision : (L,) ndarray
        The prior precisions of the unknowns of this trial alone.
    system : PortedSystem
        The linear system at the values `about`, with the gains of the channels.
    slopes : sequence of PortedSystem or None
        The derivatives of the system by each shared unknown; None if the derivative is zero.
    parts : int
        The number of fine steps in an interval between two samples.
    positions, speeds : (F, P) ndarray
        The motion of the ports by the model without missing forces [m or rad, and per s].
    settled : bool
        Whether the trial begins at rest under the forces that act at its first sample.
    about : (K + L,) ndarray
        The values of the unknowns about which the trial is linear.
    gains : sequence of (int, int, float)
        The shared unknowns that are gains: the number of the unknown, the number of the channel,
        and the relative change of its reading for a unit of the unknown.
    by_unknowns : mapping of int to (2, F, P) ndarray
        The derivatives of `positions` and `speeds`, by the number of the unknown in `about`.
    """

    name: str
    time: FloatArray
    residual: FloatArray
    used: BoolArray
    deviation: FloatArray
    coloured: Sequence[tuple[int, float, float]]
    shared: FloatArray
    local: FloatArray
    local_precision: FloatArray
    system: PortedSystem
    slopes: Sequence[PortedSystem | None]
    parts: int
    positions: FloatArray
    speeds: FloatArray
    settled: bool
    about: FloatArray = field(default_factory=lambda: np.zeros(0))
    gains: Sequence[tuple[int, int, float]] = ()
    by_unknowns: Mapping[int, FloatArray] = field(default_factory=dict)

    @cached_property
    def steps(self) -> tuple[FloatArray, IntArray]:
        """The different lengths (J,) of intervals between samples [s], and an index (N,) into them.

        Entry k of the index is for the interval that ends at sample k; entry 0 is not used.
        Intervals within 0.1 % of their mean are taken as equal, so that they share the matrices of
        a step.
        """
        lengths = np.diff(self.time)
        mean = float(lengths.mean())
        if np.all(np.abs(lengths - mean) < 1e-3 * mean):
            return np.array([mean]), np.zeros(len(self.time), dtype=np.int64)
        relative_lengths, index = np.unique(np.round(lengths / mean, 9), return_inverse=True)
        return relative_lengths * mean, np.concatenate(([0], index)).astype(np.int64)

    @cached_property
    def fine(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The matrices (J, n, n) by which the state advances over a fine step of each length.

        They are the transition, and the derivatives of the next state by an input to the state's
        rate at the start and at the end of the step. The input is linear over the step (first-order
        hold). One exponential of the system, with the input and its rate as further states, gives
        all three (Van Loan 1978, IEEE Transactions on Automatic Control 23, 395-404).
        """
        n = len(self.system.generator)
        lengths = self.steps[0][:, None, None] / self.parts
        blocks = np.zeros((len(lengths), 3 * n, 3 * n))
        state, input_, input_rate = slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n)
        blocks[:, state, state] = self.system.generator * lengths
        blocks[:, state, input_] = np.eye(n) * lengths
        blocks[:, input_, input_rate] = np.eye(n)
        exponential = expm(blocks)
        transition = np.ascontiguousarray(exponential[:, state, state])
        by_constant_input = np.ascontiguousarray(exponential[:, state, input_])
        by_rising_input = np.ascontiguousarray(exponential[:, state, input_rate])
        # an input that rises from 0 to 1 stands for its value at the end of the step; a constant
        # input minus a rising one falls from 1 to 0, which stands for its value at the start
        return transition, by_constant_input - by_rising_input, by_rising_input

    @cached_property
    def fine_time(self) -> FloatArray:
        """The fine stamps (F,) [s]."""
        return subdivide(self.time, self.parts)

    def port_motion(self, unknowns: FloatArray, added: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (F, P) of the ports [m or rad, and per s].

        Parameters
        ----------
        unknowns : (K + L,) array
            The values of the shared unknowns, then of those of this trial alone.
        added : (F, n) array
            The state that forces at ports add.
        """
        motion = np.stack((self.positions, self.speeds))
        for k, derivative in self.by_unknowns.items():
            motion += (unknowns[k] - self.about[k]) * derivative
        return motion[0] + added @ self.system.positions.T, motion[1] + added @ self.system.speeds.T

    def pushed(self, port: int, force: FloatArray) -> FloatArray:
        """Return the state (F, n) that a force at a port adds.

        Parameters
        ----------
        port : int
            The number of the port.
        force : (F,) array
            The force at the fine stamps [N, N m or the port's flow].
        """
        direction = -self.system.actions[port]
        # s' = A s + direction force (see `PortedSystem`); at rest s' = 0 at the first sample
        start = np.zeros(len(direction))
        if self.settled and force[0] != 0.0:
            start = np.linalg.lstsq(self.system.generator, -direction * force[0], rcond=1e-12)[0]
        return self._moved(start, direction[:, None], force[:, None])

    def turned(
        self, slope: PortedSystem, added: FloatArray, forces: Mapping[int, FloatArray]
    ) -> TrialColumn:
        """Return the change of the trial for a unit of a parameter that changes the system itself.

        With the system s' = A s - b g of `PortedSystem` and its derivative (A', b') by the
        parameter, the derivative d of the added state s obeys d' = A d + (A' s - b' g).

        Parameters
        ----------
        slope : PortedSystem
            The derivative of the system by the parameter.
        added : (F, n) array
            The added state s.
        forces : mapping of int to (F,) array
            The forces g at ports that add it, by the number of the port.
        """
        inputs = added @ slope.generator.T
        for port, force in forces.items():
            inputs -= np.outer(force, slope.actions[port])
        start = np.zeros(len(slope.generator))
        if self.settled:
            start = -np.linalg.lstsq(self.system.generator, inputs[0], rcond=1e-12)[0]
        # only these states have an input: the others need no column in `_moved`
        driven_states = np.flatnonzero(np.any(inputs, axis=0))
        state_derivative = self._moved(
            start, np.eye(len(start))[:, driven_states], inputs[:, driven_states]
        )
        return TrialColumn(
            self.readings(state_derivative) + self.over_noise(self.shown(slope, added, forces)),
            state_derivative,
        )

    def _moved(
        self,
        start: FloatArray,
        directions: FloatArray,
        pushes: FloatArray,
        step_of_sample: IntArray | None = None,
    ) -> FloatArray:
        """Return the state (F, n) of the linear system under inputs to the rate of its state.

        The system is s' = A s + directions u(t), with inputs u that are linear in time between
        neighbouring fine stamps.

        Parameters
        ----------
        start : (n,) array
            The state at the first fine stamp.
        directions : (n, D) array
            The rate of the state for a unit of each of the D inputs.
        pushes : (F, D) array
            The inputs u at the fine stamps.
        step_of_sample : (N,) array of int, optional
            The index in `steps` of the length of the interval that ends at each of the N samples
            that are simulated; by default all samples of the trial.
        """
        transitions, by_input_at_begin, by_input_at_end = self.fine
        if step_of_sample is None:
            _, step_of_sample = self.steps
        states = driven(
            self.parts,
            transitions,
            np.ascontiguousarray(by_input_at_begin @ directions),
            np.ascontiguousarray(by_input_at_end @ directions),
            step_of_sample,
            start,
            np.ascontiguousarray(pushes),
        )
        return np.asarray(states)

    def readings(
        self, states: FloatArray, forces: Mapping[int, FloatArray] = NO_FORCES
    ) -> FloatArray:
        """Return the readings (N, C), over the noise, of an added state (F, n) and forces (F,)."""
        return self.over_noise(self.shown(self.system, states, forces))

    def shown(
        self, system: PortedSystem, states: FloatArray, forces: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return the outputs (N, C) of an added state and of forces, in the units of the channels.

        Parameters
        ----------
        system : PortedSystem
            The system whose outputs are meant, or its derivative by a parameter.
        states : (F, n) array
            The added state.
        forces : mapping of int to (F,) array
            The forces at ports, which an acceleration shows directly, by the number of the port.
        """
        readings = states[:: self.parts] @ system.outputs.T
        for port, force in forces.items():
            readings -= np.outer(force[:: self.parts], system.through[port])
        return np.asarray(readings)

    def ahead(self, forces: Mapping[int, FloatArray], begin: int, end: int) -> FloatArray:
        """Return the change of readings (B, C) by forces in a block of B samples, over the noise.

        The system is at rest at the start of the block, so that forces before it have no effect.

        Parameters
        ----------
        forces : mapping of int to (F,) array
            The forces at ports at all fine stamps, by the number of the port.
        begin, end : int
            The first sample of the block, and the one after its last.
        """
        fine_stamps_of_block = slice(begin * self.parts, (end - 1) * self.parts + 1)
        forces_in_block = {port: force[fine_stamps_of_block] for port, force in forces.items()}
        directions = -np.array([self.system.actions[port] for port in forces_in_block]).T
        _, index_of_all = self.steps
        step_of_sample = np.ascontiguousarray(index_of_all[begin:end])
        inputs = np.array([*forces_in_block.values()]).T
        states = self._moved(np.zeros(len(directions)), directions, inputs, step_of_sample)
        readings = self.shown(self.system, states, forces_in_block)
        return np.asarray(readings / self.deviation * self.used[begin:end])

    def over_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) divided by the noise; 0 if a reading does not count."""
        return np.asarray(columns / self.deviation * self.used)


def decaying_part(noise: NoiseModel, interval: float | None) -> tuple[float, float] | None:
    """Return the part of a noise that is correlated in time: share of the variance, and rate.

    The noise is taken as white noise plus an autoregression of first order. The autocovariance of
    the sum at lags of one and two samples determines both parts.

    Parameters
    ----------
    noise : NoiseModel
        The noise of a channel, with the coefficients of an autoregression of any order.
    interval : float or None
        The interval between samples [s]; None if the samples are not equally spaced.

    Returns
    -------
    (float, float) or None
        The share of the correlated part in the variance, and its decay rate [1/s]; None if the
        noise is white.
    """
    if interval is None or not noise.can_whiten(interval):
        return None
    impulse_response = lfilter(
        [1.0], np.r_[1.0, -noise.autoregression], np.r_[1.0, np.zeros(LONGEST_MEMORY)]
    )
    # up to a common factor, the autocovariances at lags of 0, 1 and 2 samples
    covariances = [
        float(impulse_response[: len(impulse_response) - lag] @ impulse_response[lag:])
        for lag in range(3)
    ]
    if not 0.0 < covariances[2] < covariances[1]:
        return None
    # for a first-order autoregression plus white noise, c_1 = share c_0 decay and c_2 = c_1 decay
    decay = covariances[2] / covariances[1]
    return min(covariances[1] / decay / covariances[0], 1.0 - LEAST_WHITE), -float(
        np.log(decay)
    ) / interval


def seen_trial(problem: Problem, number: int, point: Point) -> SeenTrial:
    """Return a dynamic trial of a problem, linear about a point.

    Parameters
    ----------
    problem : Problem
        The campaign and model; the model must describe how its ports move.
    number : int
        The index of the trial in the problem.
    point : Point
        The values of the unknowns about which the trial is linear.
    """
    data = problem.trials[number]
    trial = data.trial
    gains = 1.0 + problem.shared.gains(point.shared, trial.channels)
    system, slopes = _ported(problem, trial, point.shared)
    system = _with_gains(system, gains)
    parts = _fine_steps(system, trial.time)
    positions_and_speeds, by_unknowns = _port_motion(problem, number, point, parts)
    residual, by_shared, by_local = _linear_readings(problem, number, point)
    deviation = trial.noise_factor * np.array([noise.static_deviation for noise in data.noise])
    return SeenTrial(
        name=trial.name,
        time=trial.time,
        residual=residual / deviation * trial.used,
        used=trial.used,
        deviation=deviation,
        coloured=_coloured_noises(data.noise, trial.whitening_interval),
        shared=by_shared / deviation * trial.used,
        local=by_local / deviation * trial.used,
        local_precision=data.unknowns.precision,
        system=system,
        slopes=[None if slope is None else _with_gains(slope, gains) for slope in slopes],
        parts=parts,
        positions=positions_and_speeds[0],
        speeds=positions_and_speeds[1],
        settled=trial.begins.value == "settled" and trial.kind.value != "ringdown",
        about=np.concatenate((point.shared, point.local[number])),
        gains=_gain_unknowns(problem, trial, gains),
        by_unknowns=by_unknowns,
    )


def _linear_readings(
    problem: Problem, number: int, point: Point
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the residuals at zero unknowns, and the derivatives of the readings.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    number : int
        The index of the trial in the problem.
    point : Point
        The values u_0 of the unknowns about which the model is linear.

    Returns
    -------
    residual : (N, C) array
        The readings minus the prediction of the linear model at zero unknowns [unit of the
        channel].
    by_shared, by_local : (K, N, C), (L, N, C) array
        The derivatives D of the prediction by the shared unknowns, and by those of the trial alone.
    """
    data = problem.trials[number]
    linear_response = problem.linearise(number, point, Candidate())
    derivatives, shared_of_column = problem.prediction_derivatives(
        number, point, linear_response, Candidate()
    )
    by_local = derivatives[: data.unknowns.size]
    by_shared = np.zeros((problem.shared.size, *linear_response.response.shape))
    by_shared[shared_of_column] = derivatives[data.unknowns.size :]
    residual = data.trial.values - problem.prediction(number, point, linear_response.response)
    # the linear prediction is p(u_0) + D (u - u_0); at u = 0 it is p(u_0) - D u_0
    residual += np.tensordot(point.shared, by_shared, 1) + np.tensordot(
        point.local[number], by_local, 1
    )
    return residual, by_shared, by_local


def _gain_unknowns(
    problem: Problem, trial: Trial, gains: FloatArray
) -> list[tuple[int, int, float]]:
    """Return the shared unknowns that are gains of the trial's channels, as `SeenTrial.gains`.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    trial : Trial
        The trial.
    gains : (C,) array
        The gain of each channel of the trial at the point; 1 is a channel without an error.
    """
    shared = problem.shared
    unknowns = []
    for index, channel_name in enumerate(shared.gain_channels):
        if channel_name in trial.channels:
            number = shared.count + index
            channel = trial.channels.index(channel_name)
            unknowns.append((number, channel, float(shared.scale[number]) / float(gains[channel])))
    return unknowns


def _coloured_noises(
    noises: Sequence[NoiseModel], interval: float | None
) -> list[tuple[int, float, float]]:
    """Return the channels whose noise has a correlated part, as `SeenTrial.coloured`."""
    coloured = []
    for channel, noise in enumerate(noises):
        share_and_rate = decaying_part(noise, interval)
        if share_and_rate is not None:
            coloured.append((channel, *share_and_rate))
    return coloured


def _fine_steps(system: PortedSystem, time: FloatArray) -> int:
    """Return the number of fine steps in an interval between two samples.

    The fastest mode moves by at most `FINE_PHASE` in a step, within `COARSEST` and `FINEST` steps.
    """
    interval = float(np.median(np.diff(time)))
    fastest_angular_frequency = float(
        np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)
    )
    return int(
        np.clip(np.ceil(fastest_angular_frequency * interval / FINE_PHASE), COARSEST, FINEST)
    )


def _port_motion(
    problem: Problem, number: int, point: Point, parts: int
) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Return the motion of the ports by the model alone, and its derivatives by the unknowns.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    number : int
        The index of the trial in the problem.
    point : Point
        The values of the unknowns.
    parts : int
        The number of fine steps in an interval between two samples.

    Returns
    -------
    motion : (2, F, P) array
        The positions and speeds of the P ports at the fine stamps [m or rad, and per s].
    by_unknowns : dict of int to (2, F, P) array
        The derivatives of the motion, by the number of the unknown in `SeenTrial.about`.
    """
    data = problem.trials[number]
    shared = problem.shared
    trial_in_own_clock, _ = shift_clock_to_first_sample(data.trial, ModelPatch())

    def motion(shared_values: FloatArray, local_values: FloatArray) -> FloatArray:
        parameters = shared.parameters(shared_values)
        conditions = data.unknowns.conditions(data.trial, parameters, local_values)
        return np.stack(problem.model.port_motion(trial_in_own_clock, conditions, parts))

    local = point.local[number]
    at_point = motion(point.shared, local)
    by_unknowns = {}
    for k in range(shared.count):
        by_unknowns[k] = (motion(with_step(point.shared, k), local) - at_point) / PARAMETER_STEP
    # the first unknowns of a trial are the zeros of its channels, which do not move the ports
    for k in range(data.unknowns.zeros, data.unknowns.size):
        stepped_motion = motion(point.shared, with_step(local, k))
        by_unknowns[shared.size + k] = (stepped_motion - at_point) / PARAMETER_STEP
    return at_point, by_unknowns


def _with_gains(system: PortedSystem, gains: FloatArray) -> PortedSystem:
    """Return a system whose outputs are multiplied by the gains (C,) of their channels."""
    return replace(system, outputs=system.outputs * gains[:, None], through=system.through * gains)


def _ported(
    problem: Problem, trial: Trial, shared: FloatArray
) -> tuple[PortedSystem, list[PortedSystem | None]]:
    """Return the linear system with ports of a trial, and its derivatives by the shared unknowns.

    A derivative is None if it is zero. The last unknowns are gains of channels, which do not change
    the system.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    trial : Trial
        The trial.
    shared : (K,) array
        The values of the shared unknowns.
    """
    unknowns = problem.shared
    outputs = problem.campaign.outputs(trial)

    def system(u: FloatArray) -> PortedSystem:
        return problem.model.ported_system(trial, outputs, unknowns.parameters(u))

    slopes: list[PortedSystem | None] = []
    for k in range(unknowns.count):
        above = system(with_step(shared, k, SMALL))
        below = system(with_step(shared, k, -SMALL))
        slopes.append(_slope_of_system(above, below))
    slopes += [None] * (unknowns.size - len(slopes))
    return system(shared), slopes


def _slope_of_system(above: PortedSystem, below: PortedSystem) -> PortedSystem | None:
    """Return the derivative of a system by a parameter, a central difference; None if zero.

    Parameters
    ----------
    above, below : PortedSystem
        The system with the parameter `SMALL` above and below its value.
    """

    def slope(upper: FloatArray, lower: FloatArray) -> FloatArray:
        return np.asarray((upper - lower) / (2.0 * SMALL))

    derivative = replace(
        above,
        generator=slope(above.generator, below.generator),
        actions=slope(above.actions, below.actions),
        outputs=slope(above.outputs, below.outputs),
        through=slope(above.through, below.through),
    )
    arrays = (derivative.generator, derivative.actions, derivative.outputs, derivative.through)
    return derivative if any(np.any(array) for array in arrays) else None
