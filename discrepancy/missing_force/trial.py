"""A trial in which a missing force is looked for: what is left of its readings, and what unknowns do to them.

Readings and columns are over the deviations of their noise. The unknowns are those of
`fits.trial_data`, taken at their prior means; a calibrated parameter acts on the motion that the model has (a
column) and on what the missing force adds to it (`slopes`), so that both together are exact along the motion
that was.
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
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Point, moved
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
"""Samples that a coloured noise remembers at most; the least share of its variance that is taken as white."""
SMALL = 1e-3
"""Step of the derivative of a system by a parameter, in prior deviations."""

NO_FORCES: Mapping[int, FloatArray] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Part:
    """What an effect does in a trial, for a unit of its unknown.

    Attributes
    ----------
    readings : (N, C) ndarray
        Over the noise's deviations.
    added : (F, n) ndarray or None
        State that it adds.
    forces : mapping of int to (F,) ndarray
        Its force at ports, by their numbers.
    """

    readings: FloatArray
    added: FloatArray | None = None
    forces: Mapping[int, FloatArray] = field(default_factory=dict)

    def plus(self, other: "Part", factor: float) -> "Part":
        """Return the sum with another part that is taken `factor` times."""
        added = [item * part.added for item, part in ((1.0, self), (factor, other)) if part.added is not None]
        forces = dict(self.forces)
        for port, force in other.forces.items():
            forces[port] = forces.get(port, 0.0) + factor * force
        readings = self.readings + factor * other.readings
        return Part(readings, sum(added[1:], added[0]) if added else None, forces)


@dataclass(frozen=True, eq=False)
class SeenTrial:
    """A dynamic trial.

    Attributes
    ----------
    name : str
        Of the trial.
    time : (N,) ndarray
        Stamps [s].
    residual : (N, C) ndarray
        Readings less the model, as if it were linear between the prior means and the point.
    used : (N, C) ndarray of bool
        Readings that count.
    deviation : (C,) ndarray
        Of the noise.
    coloured : sequence of (int, float, float)
        Channels whose noise has a part that decays in time: its share of the variance, and its rate [1/s].
    shared, local : (K, N, C), (L, N, C) ndarray
        What a unit of each scaled unknown does to readings.
    local_precision : (L,) ndarray
        Prior precision of the latter.
    system : PortedSystem
        At the point, with its gains.
    slopes : sequence of PortedSystem or None
        Its derivative by each shared unknown.
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
        What a unit of unknowns, by their numbers in `about`, does to positions and speeds of ports.
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
        """Different lengths (J,) of the intervals [s], and which of them leads to each sample (N,)."""
        lengths = np.diff(self.time)
        mean = float(lengths.mean())
        if np.all(np.abs(lengths - mean) < 1e-3 * mean):
            return np.array([mean]), np.zeros(len(self.time), dtype=np.int64)
        found, which = np.unique(np.round(lengths / mean, 9), return_inverse=True)
        return found * mean, np.concatenate(([0], which)).astype(np.int64)

    @cached_property
    def fine(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Transition (J, n, n) of a fine step, and what a push at its begin and end does (J, n, n)."""
        n, lengths = len(self.system.generator), self.steps[0][:, None, None] / self.parts
        blocks = np.zeros((len(lengths), 3 * n, 3 * n))
        blocks[:, :n, :n], blocks[:, :n, n : 2 * n] = self.system.generator * lengths, np.eye(n) * lengths
        blocks[:, n : 2 * n, 2 * n :] = np.eye(n)
        move, held, end = (np.ascontiguousarray(item) for item in np.split(expm(blocks)[:, :n], 3, axis=2))
        return move, held - end, end

    @cached_property
    def fine_time(self) -> FloatArray:
        """Fine stamps (F,) [s]."""
        return subdivide(self.time, self.parts)

    def port_motion(self, unknowns: FloatArray, added: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (F, P) of the ports.

        They are the model's at values (K + L,) of shared unknowns and the trial's own, and of an added state
        (F, n).
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

    def turned(self, slope: PortedSystem, added: FloatArray, forces: Mapping[int, FloatArray]) -> Part:
        """Return what a change of the system makes of an added state (F, n) and `forces` that added it."""
        pushes = added @ slope.generator.T
        for port, force in forces.items():
            pushes -= np.outer(force, slope.actions[port])
        start = np.zeros(len(slope.generator))
        if self.settled:
            start = -np.linalg.lstsq(self.system.generator, pushes[0], rcond=1e-12)[0]
        rows = np.flatnonzero(np.any(pushes, axis=0))
        state = self._moved(start, np.eye(len(start))[:, rows], pushes[:, rows])
        return Part(self.readings(state) + self.over_noise(self.shown(slope, added, forces)), state)

    def _moved(
        self, start: FloatArray, directions: FloatArray, pushes: FloatArray, which: IntArray | None = None
    ) -> FloatArray:
        moves, begins, ends = self.fine
        begins, ends = np.ascontiguousarray(begins @ directions), np.ascontiguousarray(ends @ directions)
        pushes = np.ascontiguousarray(pushes)
        which = self.steps[1] if which is None else which
        return np.asarray(driven(self.parts, moves, begins, ends, which, start, pushes))

    def readings(self, states: FloatArray, forces: Mapping[int, FloatArray] = NO_FORCES) -> FloatArray:
        """Return what readings (N, C) show of an added state (F, n), and at once of forces (F,) at ports."""
        return self.over_noise(self.shown(self.system, states, forces))

    def shown(self, system: PortedSystem, states: FloatArray, forces: Mapping[int, FloatArray]) -> FloatArray:
        """Return what readings (N, C) show of an added state (F, n) and of forces (F,) at ports."""
        shown = states[:: self.parts] @ system.outputs.T
        for port, force in forces.items():
            shown -= np.outer(force[:: self.parts], system.through[port])
        return np.asarray(shown)

    def ahead(self, forces: Mapping[int, FloatArray], begin: int, end: int) -> FloatArray:
        """Return what forces at ports (F,) do to the readings from one sample until another, from nothing."""
        fine = slice(begin * self.parts, (end - 1) * self.parts + 1)
        acting = {port: force[fine] for port, force in forces.items()}
        directions = -np.array([self.system.actions[port] for port in acting]).T
        which = np.ascontiguousarray(self.steps[1][begin:end])
        pushes = np.array([*acting.values()]).T
        states = self._moved(np.zeros(len(directions)), directions, pushes, which)
        shown = self.shown(self.system, states, acting)
        return np.asarray(shown / self.deviation * self.used[begin:end])

    def over_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) over the noise's deviations, zero where a reading does not count."""
        return np.asarray(columns / self.deviation * self.used)


def decaying_part(noise: NoiseModel, interval: float | None) -> tuple[float, float] | None:
    """Return the share of a noise's variance that decays in time, and its rate [1/s]; None: it is white.

    From the correlation at one and two samples: exact for an autoregression of first order.
    """
    if interval is None or not noise.applies(interval):
        return None
    answer = lfilter([1.0], np.r_[1.0, -noise.autoregression], np.r_[1.0, np.zeros(LONGEST_MEMORY)])
    at = [float(answer[: len(answer) - lag] @ answer[lag:]) for lag in range(3)]
    if not 0.0 < at[2] < at[1]:
        return None
    decay = at[2] / at[1]
    return min(at[1] / decay / at[0], 1.0 - LEAST_WHITE), -float(np.log(decay)) / interval


def seen_trial(problem: Problem, number: int, point: Point) -> SeenTrial:
    """Return a dynamic trial of a problem, linear about a point; its model must tell how ports move."""
    data, model = problem.trials[number], problem.model
    trial, shared, unknowns = data.trial, problem.shared, data.unknowns
    parts = problem.linearise(number, point, Candidate())
    gains = 1.0 + shared.gains(point.shared, trial.channels)
    gain_unknowns = []
    for row, name in enumerate(shared.gain_channels):
        if name in trial.channels:
            column, scale = trial.channels.index(name), float(shared.scale[shared.count + row])
            gain_unknowns.append((shared.count + row, column, scale / float(gains[column])))
    columns, index = problem.columns(number, point, parts, Candidate())
    by_local, by_shared = columns[: unknowns.size], np.zeros((shared.size, *parts.response.shape))
    by_shared[index] = columns[unknowns.size :]
    residual = trial.values - problem.prediction(number, point, parts.response)
    residual += np.tensordot(point.shared, by_shared, 1) + np.tensordot(point.local[number], by_local, 1)
    base, slopes = _ported(problem, trial, point.shared)
    base = _shown(base, gains)
    slopes = [None if item is None else _shown(item, gains) for item in slopes]
    used = trial.used
    deviation = trial.noise_factor * np.array([item.static_deviation for item in data.noise])
    coloured = [
        (number, *part)
        for number, item in enumerate(data.noise)
        if (part := decaying_part(item, trial.whitened_at)) is not None
    ]
    interval = float(np.median(np.diff(trial.time)))
    fastest = float(np.max(np.abs(np.linalg.eigvals(base.generator)), initial=0.0))
    count = int(np.clip(np.ceil(fastest * interval / FINE_PHASE), COARSEST, FINEST))

    from_its_begin, _ = in_own_clock(trial, ModelPatch())

    def moving(of_all: FloatArray, local: FloatArray) -> FloatArray:
        conditions = unknowns.conditions(trial, shared.parameters(of_all), local)
        return np.stack(model.port_motion(from_its_begin, conditions, count))

    local = point.local[number]
    here = moving(point.shared, local)
    ways = {k: (moved(point.shared, k), local) for k in range(shared.count)}
    ways |= {shared.size + k: (point.shared, moved(local, k)) for k in range(unknowns.zeros, unknowns.size)}
    by_unknowns = {k: (moving(*there) - here) / PARAMETER_STEP for k, there in ways.items()}
    residual, by_shared, by_local = (item / deviation * used for item in (residual, by_shared, by_local))
    return SeenTrial(
        trial.name, trial.time, residual, used,
        deviation, coloured, by_shared, by_local, unknowns.precision, base, slopes, count,
        here[0], here[1], trial.begins.value == "settled" and trial.kind.value != "ringdown",
        np.concatenate((point.shared, local)), gain_unknowns, by_unknowns,
    )  # fmt: skip


def _shown(system: PortedSystem, gains: FloatArray) -> PortedSystem:
    """Return a system whose outputs are shown with gains (C,)."""
    return replace(system, outputs=system.outputs * gains[:, None], through=system.through * gains)


def _ported(
    problem: Problem, trial: Trial, shared: FloatArray
) -> tuple[PortedSystem, list[PortedSystem | None]]:
    """Return how the ports of a trial move, and the derivatives of that by the shared unknowns."""
    model, unknowns, outputs = problem.model, problem.shared, problem.campaign.outputs(trial)

    def system(u: FloatArray) -> PortedSystem:
        return model.ported(trial, outputs, unknowns.parameters(u))

    def slope(k: int) -> PortedSystem | None:
        above, below = (system(moved(shared, k, sign * SMALL)) for sign in (1.0, -1.0))
        found = {
            name: (getattr(above, name) - getattr(below, name)) / (2.0 * SMALL)
            for name in ("generator", "actions", "outputs", "through")
        }
        return replace(above, **found) if any(np.any(item) for item in found.values()) else None

    of_parameters = [slope(k) for k in range(unknowns.count)]
    return system(shared), of_parameters + [None] * (unknowns.size - len(of_parameters))
