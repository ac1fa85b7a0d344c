"""A trial in which a missing force is looked for.

What is left of its readings, and what unknowns do to them.

Readings and columns are over the deviations of their noise. The unknowns are those of
`fits.trial_data`, taken at their prior means; a calibrated parameter acts on the motion that the
model has (a column) and on what the missing force adds to it (`slopes`), so that both together are
exact along the motion that was.
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
from discrepancy.system.sensing import in_own_clock
from discrepancy.system.time_history import subdivide
from fe.runtime.patch import ModelPatch

from .kalman import driven

FINEST, COARSEST = 16, 4
"""Steps of an interval on which laws are evaluated, at most and at least."""
FINE_PHASE = 0.15
"""Radians of the fastest mode that such a step may span."""
LONGEST_MEMORY, LEAST_WHITE = 2000, 1e-3
"""Samples that a coloured noise remembers at most; the least share of its variance that is taken as
white."""
SMALL = 1e-3
"""Step of the derivative of a system by a parameter, in prior deviations."""

NO_FORCES: Mapping[int, FloatArray] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class TrialColumn:
    """What an effect does in a trial, for a unit of its unknown.

    Attributes
    ----------
    readings : (N, C) ndarray
        The change of the readings, over the noise deviations.
    added : (F, n) ndarray or None
        The state that it adds.
    forces : mapping of int to (F,) ndarray
        The force at each port, by the number of the port.
    """

    readings: FloatArray
    added: FloatArray | None = None
    forces: Mapping[int, FloatArray] = field(default_factory=dict)

    def plus(self, other: "TrialColumn", factor: float) -> "TrialColumn":
        """Return the sum with another part that is taken `factor` times."""
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
    """A dynamic trial.

    Attributes
    ----------
    name : str
        The name of the trial.
    time : (N,) ndarray
        Stamps [s].
    residual : (N, C) ndarray
        Readings less the model, as if it were linear between the prior means and the point.
    used : (N, C) ndarray of bool
        Readings that count.
    deviation : (C,) ndarray
        The noise deviation of each channel [unit of the channel].
    coloured : sequence of (int, float, float)
        Channels whose noise has a part that decays in time: its share of the variance, and its rate
        [1/s].
    shared, local : (K, N, C), (L, N, C) ndarray
        The derivatives of the readings by the scaled shared unknowns, and by the trial's own.
    local_precision : (L,) ndarray
        Prior precision of the latter.
    system : PortedSystem
        The linear system with ports at the point, with the gains of the channels.
    slopes : sequence of PortedSystem or None
        The derivatives of the system by each shared unknown; None where it is zero.
    parts : int
        Fine steps of an interval.
    positions, speeds : (F, P) ndarray
        Motion of the ports by the model at the fine stamps.
    settled : bool
        Whether it begins at rest under what acts.
    about : (K + L,) ndarray
        Shared unknowns and the trial's own at the point.
    gains : sequence of (int, int, float)
        Shared unknowns that are gains: number, channel, and what a unit is over one and the gain.
    by_unknowns : mapping of int to (2, F, P) ndarray
        The derivatives of positions and speeds of ports, by the number of the unknown in `about`.
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
        """The lengths (J,) of the intervals [s], and the index of that before each sample (N,)."""
        lengths = np.diff(self.time)
        mean = float(lengths.mean())
        if np.all(np.abs(lengths - mean) < 1e-3 * mean):
            return np.array([mean]), np.zeros(len(self.time), dtype=np.int64)
        relative_lengths, index = np.unique(np.round(lengths / mean, 9), return_inverse=True)
        return relative_lengths * mean, np.concatenate(([0], index)).astype(np.int64)

    @cached_property
    def fine(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Transition (J, n, n) of a fine step, and what a push at its begin and end does (J, n, n).

        By one exponential of the system with its push and the push's rate as states (Van Loan 1978,
        IEEE Transactions on Automatic Control 23, 395-404).
        """
        n = len(self.system.generator)
        lengths = self.steps[0][:, None, None] / self.parts
        blocks = np.zeros((len(lengths), 3 * n, 3 * n))
        state, push, push_rate = slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n)
        blocks[:, state, state] = self.system.generator * lengths
        blocks[:, state, push] = np.eye(n) * lengths
        blocks[:, push, push_rate] = np.eye(n)
        exponential = expm(blocks)
        transition = np.ascontiguousarray(exponential[:, state, state])
        by_constant_push = np.ascontiguousarray(exponential[:, state, push])
        by_rising_push = np.ascontiguousarray(exponential[:, state, push_rate])
        return transition, by_constant_push - by_rising_push, by_rising_push

    @cached_property
    def fine_time(self) -> FloatArray:
        """Fine stamps (F,) [s]."""
        return subdivide(self.time, self.parts)

    def port_motion(self, unknowns: FloatArray, added: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (F, P) of the ports.

        They are the model's at values (K + L,) of shared unknowns and the trial's own, and of an
        added state (F, n).
        """
        motion = np.stack((self.positions, self.speeds))
        for k, moves in self.by_unknowns.items():
            motion += (unknowns[k] - self.about[k]) * moves
        return motion[0] + added @ self.system.positions.T, motion[1] + added @ self.system.speeds.T

    def pushed(self, port: int, force: FloatArray) -> FloatArray:
        """Return the state (F, n) that a force (F,) at a port adds."""
        push = -self.system.actions[port]
        start = np.zeros(len(push))
        if self.settled and force[0] != 0.0:
            start = np.linalg.lstsq(self.system.generator, -push * force[0], rcond=1e-12)[0]
        return self._moved(start, push[:, None], force[:, None])

    def turned(
        self, slope: PortedSystem, added: FloatArray, forces: Mapping[int, FloatArray]
    ) -> TrialColumn:
        """Return the effect of a change of the system on an added state (F, n) and its forces."""
        pushes = added @ slope.generator.T
        for port, force in forces.items():
            pushes -= np.outer(force, slope.actions[port])
        start = np.zeros(len(slope.generator))
        if self.settled:
            start = -np.linalg.lstsq(self.system.generator, pushes[0], rcond=1e-12)[0]
        rows = np.flatnonzero(np.any(pushes, axis=0))
        state = self._moved(start, np.eye(len(start))[:, rows], pushes[:, rows])
        return TrialColumn(
            self.readings(state) + self.over_noise(self.shown(slope, added, forces)), state
        )

    def _moved(
        self,
        start: FloatArray,
        directions: FloatArray,
        pushes: FloatArray,
        step_of_sample: IntArray | None = None,
    ) -> FloatArray:
        """Return the state (F, n) of the system under pushes, linear between the fine stamps.

        Parameters
        ----------
        start : (n,) array
            The state at the first stamp.
        directions : (n, D) array
            The directions of the pushes in the state.
        pushes : (F, D) array
            The pushes at the fine stamps.
        step_of_sample : (N,) array of int, optional
            The index of the interval before each sample; those of the trial if left out.
        """
        transitions, by_push_at_begin, by_push_at_end = self.fine
        if step_of_sample is None:
            _, step_of_sample = self.steps
        states = driven(
            self.parts,
            transitions,
            np.ascontiguousarray(by_push_at_begin @ directions),
            np.ascontiguousarray(by_push_at_end @ directions),
            step_of_sample,
            start,
            np.ascontiguousarray(pushes),
        )
        return np.asarray(states)

    def readings(
        self, states: FloatArray, forces: Mapping[int, FloatArray] = NO_FORCES
    ) -> FloatArray:
        """Return the readings (N, C), over their noise, of an added state (F, n) and forces."""
        return self.over_noise(self.shown(self.system, states, forces))

    def shown(
        self, system: PortedSystem, states: FloatArray, forces: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return what readings (N, C) show of an added state (F, n) and of forces (F,) at ports."""
        readings = states[:: self.parts] @ system.outputs.T
        for port, force in forces.items():
            readings -= np.outer(force[:: self.parts], system.through[port])
        return np.asarray(readings)

    def ahead(self, forces: Mapping[int, FloatArray], begin: int, end: int) -> FloatArray:
        """Return what forces (F,) at ports do to the readings of some samples, from rest."""
        fine = slice(begin * self.parts, (end - 1) * self.parts + 1)
        acting = {port: force[fine] for port, force in forces.items()}
        directions = -np.array([self.system.actions[port] for port in acting]).T
        _, all_steps = self.steps
        step_of_sample = np.ascontiguousarray(all_steps[begin:end])
        pushes = np.array([*acting.values()]).T
        states = self._moved(np.zeros(len(directions)), directions, pushes, step_of_sample)
        readings = self.shown(self.system, states, acting)
        return np.asarray(readings / self.deviation * self.used[begin:end])

    def over_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) over the noise; 0 where a reading does not count."""
        return np.asarray(columns / self.deviation * self.used)


def decaying_part(noise: NoiseModel, interval: float | None) -> tuple[float, float] | None:
    """Return the share of a noise's variance that decays in time, and its rate [1/s].

    None: it is white.

    From the correlation at one and two samples: exact for an autoregression of first order.
    """
    if interval is None or not noise.applies(interval):
        return None
    impulse_response = lfilter(
        [1.0], np.r_[1.0, -noise.autoregression], np.r_[1.0, np.zeros(LONGEST_MEMORY)]
    )
    covariances = [
        float(impulse_response[: len(impulse_response) - lag] @ impulse_response[lag:])
        for lag in range(3)
    ]
    if not 0.0 < covariances[2] < covariances[1]:
        return None
    decay = covariances[2] / covariances[1]
    return min(covariances[1] / decay / covariances[0], 1.0 - LEAST_WHITE), -float(
        np.log(decay)
    ) / interval


def seen_trial(problem: Problem, number: int, point: Point) -> SeenTrial:
    """Return a dynamic trial of a problem, linear about a point.

    Its model must say how ports move.
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
        coloured=_coloured_noises(data.noise, trial.whitened_at),
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
    """Return the residuals (N, C) of the linear model at zero unknowns, and its derivatives.

    The latter are (K, N, C) of the shared unknowns and (L, N, C) of the trial's own.
    """
    data = problem.trials[number]
    linear = problem.linearise(number, point, Candidate())
    columns, shared_of_column = problem.prediction_derivatives(number, point, linear, Candidate())
    by_local = columns[: data.unknowns.size]
    by_shared = np.zeros((problem.shared.size, *linear.response.shape))
    by_shared[shared_of_column] = columns[data.unknowns.size :]
    residual = data.trial.values - problem.prediction(number, point, linear.response)
    residual += np.tensordot(point.shared, by_shared, 1) + np.tensordot(
        point.local[number], by_local, 1
    )
    return residual, by_shared, by_local


def _gain_unknowns(
    problem: Problem, trial: Trial, gains: FloatArray
) -> list[tuple[int, int, float]]:
    """Return the shared unknowns that are gains of the trial's channels (`SeenTrial.gains`)."""
    shared = problem.shared
    unknowns = []
    for row, name in enumerate(shared.gain_channels):
        if name in trial.channels:
            number = shared.count + row
            channel = trial.channels.index(name)
            unknowns.append((number, channel, float(shared.scale[number]) / float(gains[channel])))
    return unknowns


def _coloured_noises(
    noises: Sequence[NoiseModel], interval: float | None
) -> list[tuple[int, float, float]]:
    """Return the channels whose noise has a decaying part, with share and rate of that part."""
    coloured = []
    for channel, noise in enumerate(noises):
        part = decaying_part(noise, interval)
        if part is not None:
            coloured.append((channel, *part))
    return coloured


def _fine_steps(system: PortedSystem, time: FloatArray) -> int:
    """Return in how many steps an interval between samples is divided, by the fastest mode."""
    interval = float(np.median(np.diff(time)))
    fastest = float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0))
    return int(np.clip(np.ceil(fastest * interval / FINE_PHASE), COARSEST, FINEST))


def _port_motion(
    problem: Problem, number: int, point: Point, parts: int
) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Return positions and speeds (2, F, P) of the ports, and their derivatives by unknowns."""
    data = problem.trials[number]
    shared = problem.shared
    trial_in_own_clock, _ = in_own_clock(data.trial, ModelPatch())

    def motion(shared_values: FloatArray, local_values: FloatArray) -> FloatArray:
        parameters = shared.parameters(shared_values)
        conditions = data.unknowns.conditions(data.trial, parameters, local_values)
        return np.stack(problem.model.port_motion(trial_in_own_clock, conditions, parts))

    local = point.local[number]
    at_point = motion(point.shared, local)
    by_unknowns = {}
    for k in range(shared.count):
        by_unknowns[k] = (motion(with_step(point.shared, k), local) - at_point) / PARAMETER_STEP
    for k in range(data.unknowns.zeros, data.unknowns.size):
        stepped = motion(point.shared, with_step(local, k))
        by_unknowns[shared.size + k] = (stepped - at_point) / PARAMETER_STEP
    return at_point, by_unknowns


def _with_gains(system: PortedSystem, gains: FloatArray) -> PortedSystem:
    """Return a system whose outputs are shown with gains (C,)."""
    return replace(system, outputs=system.outputs * gains[:, None], through=system.through * gains)


def _ported(
    problem: Problem, trial: Trial, shared: FloatArray
) -> tuple[PortedSystem, list[PortedSystem | None]]:
    """Return how the ports of a trial move, and the derivatives of that by the shared unknowns.

    A derivative is None where it is zero; gains do not change how ports move.
    """
    unknowns = problem.shared
    outputs = problem.campaign.outputs(trial)

    def system(u: FloatArray) -> PortedSystem:
        return problem.model.ported(trial, outputs, unknowns.parameters(u))

    slopes: list[PortedSystem | None] = []
    for k in range(unknowns.count):
        above = system(with_step(shared, k, SMALL))
        below = system(with_step(shared, k, -SMALL))
        slopes.append(_slope_of_system(above, below))
    slopes += [None] * (unknowns.size - len(slopes))
    return system(shared), slopes


def _slope_of_system(above: PortedSystem, below: PortedSystem) -> PortedSystem | None:
    """Return the derivative of a system between values of a parameter `SMALL` above and below."""

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
