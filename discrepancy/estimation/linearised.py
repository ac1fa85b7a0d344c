"""A trial, linear along a trajectory: the laws of a hypothesis in it, missing forces beside them.

The state of a trial is what forces at ports add to the answer of the linear model. With the laws G
of the hypothesis, the missing forces f (Gaussian processes in time) and the unknowns w,

    s' = A(w) s - sum_p b_p (G_p(x, v; w) + f_p),
    reading = r(w) + C(w) s - sum_p e_p (G_p(x, v; w) + f_p) + noise,

where x and v are the position and the speed of a port. All of it is linearised along a trajectory.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import expm

from discrepancy.campaign.records import FloatArray, IntArray
from discrepancy.missing_force.filtered import ForceFilter, Process
from discrepancy.missing_force.kalman import discretised
from discrepancy.missing_force.trial import SeenTrial

from .kernel import filter_record, smooth_record, step_matrices
from .laws import ForceAlong


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The motion of a trial along which it is linearised, at its fine stamps.

    Attributes
    ----------
    added : (F, n) ndarray
        The state that forces at ports add to the response of the linear model.
    positions, speeds : (F, P) ndarray
        The motion of the ports [m or rad, and per s].
    forces : mapping of int to (F,) ndarray
        The force at a port beside the linear model, by the number of the port [N or N m].
    """

    added: FloatArray
    positions: FloatArray
    speeds: FloatArray
    forces: Mapping[int, FloatArray]

    def toward(self, other: "Trajectory", fraction: float) -> "Trajectory":
        """Return the trajectory a fraction of the way to another one."""
        ports = {*self.forces, *other.forces}
        forces = {
            port: (1.0 - fraction) * self.forces.get(port, 0.0)
            + fraction * other.forces.get(port, 0.0)
            for port in ports
        }
        return Trajectory(
            self.added + fraction * (other.added - self.added),
            self.positions + fraction * (other.positions - self.positions),
            self.speeds + fraction * (other.speeds - self.speeds),
            {port: np.asarray(force) for port, force in forces.items()},
        )


@dataclass(frozen=True, eq=False)
class Forces:
    """What the laws of a hypothesis do at a port along a trajectory.

    Attributes
    ----------
    along : ForceAlong
        Force and tangents of all laws at the port.
    by_unknown : mapping of int to (F,) ndarray
        Derivative of the force by an unknown, by its number.
    """

    along: ForceAlong
    by_unknown: Mapping[int, FloatArray]


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """What effects of sensors do to the readings of a trial, over their noise.

    Attributes
    ----------
    known : (N, C) ndarray
        The change of the readings at the values of the unknowns.
    by_unknown : mapping of int to (N, C) ndarray
        Derivative by an unknown, by its number.
    """

    known: FloatArray
    by_unknown: Mapping[int, FloatArray]


@dataclass(frozen=True, eq=False)
class LinearisedTrial:
    """A trial, linear along a trajectory.

    The unknowns are the shared ones, those of the hypothesis' effects, and the trial's own, in this
    order.

    Attributes
    ----------
    trial : SeenTrial
        The readings minus the linear model, and how ports move.
    processes : mapping of int to Process
        Missing forces, by the numbers of their ports.
    trajectory : Trajectory
        The trajectory along which it is linear.
    forces : mapping of int to Forces
        The forces of the hypothesis' laws, by port.
    sensors : SensorReadings
        The changes of readings by the hypothesis' effects of sensors.
    effect : (E,) ndarray
        The values of the effects' unknowns at which laws and sensors are linearised.
    shared : (K,) ndarray
        The values of the shared unknowns there.
    """

    trial: SeenTrial
    processes: Mapping[int, Process]
    trajectory: Trajectory
    forces: Mapping[int, Forces]
    sensors: SensorReadings
    effect: FloatArray
    shared: FloatArray

    # ------------------------------------------------------------ layout

    @cached_property
    def filtered(self) -> ForceFilter:
        """The linear system with its missing forces, scaled so that states are of size one."""
        return ForceFilter(self.trial, tuple(self.processes.items()))

    @property
    def moving(self) -> int:
        """States of the structure; those of missing forces and of coloured noise follow."""
        return len(self.trial.system.generator)

    @property
    def width(self) -> int:
        """Number W of weights: one for what is known, and one for each unknown."""
        return 1 + len(self.shared) + len(self.effect) + len(self.trial.local)

    def weight_of(self, unknown: int) -> int:
        """Return the weight of a shared unknown or, numbered after these, of a trial's own."""
        count = len(self.shared)
        return 1 + unknown + (len(self.effect) if unknown >= count else 0)

    @cached_property
    def ports(self) -> tuple[int, ...]:
        """Ports at which a law of the hypothesis acts."""
        return tuple(self.forces)

    # ------------------------------------------------------------ forces of the laws

    @cached_property
    def tangents(self) -> FloatArray:
        """Change (F, L, n) of the laws' force at each of their ports by the state."""
        generator, _, _, _ = self.filtered.system
        tangents = np.zeros((len(self.trial.fine_time), len(self.ports), len(generator)))
        system = self.trial.system
        units = self.filtered.units
        for row, port in enumerate(self.ports):
            along = self.forces[port].along
            tangents[:, row, : self.moving] = (
                along.by_position[:, None] * system.positions[port] * units
                + along.by_speed[:, None] * system.speeds[port] * units
            )
        return tangents

    @cached_property
    def pushes(self) -> FloatArray:
        """Force (F, L, W) of the laws at each of their ports at state zero, by weight."""
        trial = self.trial
        trajectory = self.trajectory
        pushes = np.zeros((len(trial.fine_time), len(self.ports), self.width))
        for row, port in enumerate(self.ports):
            along = self.forces[port].along
            position = trial.positions[:, port] - trajectory.positions[:, port]
            speed = trial.speeds[:, port] - trajectory.speeds[:, port]
            for unknown, (moved_positions, moved_speeds) in trial.by_unknowns.items():
                position = position - trial.about[unknown] * moved_positions[:, port]
                speed = speed - trial.about[unknown] * moved_speeds[:, port]
                pushes[:, row, self.weight_of(unknown)] += (
                    along.by_position * moved_positions[:, port]
                    + along.by_speed * moved_speeds[:, port]
                )
            pushes[:, row, 0] = along.force + along.by_position * position + along.by_speed * speed
            for unknown, slope in self.forces[port].by_unknown.items():
                pushes[:, row, 1 + unknown] += slope
                pushes[:, row, 0] -= self._value(unknown) * slope
        return pushes

    def _value(self, unknown: int) -> float:
        """Return the value at which a law is linear by a shared unknown or by one of an effect."""
        return float(np.concatenate((self.shared, self.effect))[unknown])

    @cached_property
    def directions(self) -> FloatArray:
        """State (n, L) that a unit force at each of the laws' ports pushes."""
        generator, _, _, _ = self.filtered.system
        directions = np.zeros((len(generator), len(self.ports)))
        for row, port in enumerate(self.ports):
            directions[: self.moving, row] = -self.trial.system.actions[port] / self.filtered.units
        return directions

    # ------------------------------------------------------------ steps

    def _steps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return transition, noise and drift of each fine step."""
        generator, intensity, _, _ = self.filtered.system
        lengths, kind = self.trial.steps
        fine = lengths / self.trial.parts
        free_transition, free_noise = discretised(generator, intensity, fine)
        begin, end = push_matrices(generator, fine)
        drift = self._drift_by_parameters(begin, end, kind)
        transition, noise = step_matrices(
            self.trial.parts,
            kind,
            free_transition,
            free_noise,
            np.ascontiguousarray(begin @ self.directions),
            np.ascontiguousarray(end @ self.directions),
            self.tangents,
            self.pushes,
            drift,
        )
        return transition, noise, drift

    def _drift_by_parameters(
        self, begin: FloatArray, end: FloatArray, kind: IntArray
    ) -> FloatArray:
        """Return the drift (F - 1, n, W) by what parameters change in the system itself."""
        trial = self.trial
        moving = self.moving
        steps = len(trial.fine_time) - 1
        drift = np.zeros((steps, len(begin[0]), self.width))
        kind_of_step = kind[np.arange(steps) // trial.parts + 1]
        for unknown, slope in enumerate(trial.slopes):
            if slope is None:
                continue
            push = self.trajectory.added @ slope.generator.T
            for port, force in self.trajectory.forces.items():
                push = push - np.outer(force, slope.actions[port])
            push = push / self.filtered.units
            added = np.einsum("jab,jb->ja", begin[kind_of_step, :, :moving], push[:-1])
            added += np.einsum("jab,jb->ja", end[kind_of_step, :, :moving], push[1:])
            drift[:, :, 1 + unknown] += added
            drift[:, :, 0] -= trial.about[unknown] * added
        return drift

    def _start(self) -> tuple[FloatArray, FloatArray]:
        """Return covariance (n, n) and mean (n, W) of the state before the first reading."""
        generator, _, _, covariance = self.filtered.system
        mean = np.zeros((len(generator), self.width))
        if not self.trial.settled:
            return covariance, mean
        # at rest under the laws and under the missing forces, whose first values are not known
        moving = self.moving
        directions = self.directions[:moving]
        stiffness = generator[:moving, :moving] + directions @ self.tangents[0][:, :moving]
        mean[:moving] = np.linalg.lstsq(stiffness, -directions @ self.pushes[0], rcond=1e-12)[0]
        covariance = covariance.copy()
        covariance[:moving, :moving] = 0.0
        for place in self.filtered.places:
            at_rest = np.linalg.lstsq(stiffness, -generator[:moving, place], rcond=1e-12)[0]
            covariance[:moving, :moving] += np.outer(at_rest, at_rest)
            covariance[:moving, place] = at_rest
            covariance[place, :moving] = at_rest
        return covariance, mean

    # ------------------------------------------------------------ readings

    def _readings(self) -> tuple[FloatArray, FloatArray]:
        """Return rows (N, C, n) and columns (N, C, W) of the readings."""
        trial = self.trial
        parts = trial.parts
        samples, channels = trial.residual.shape
        _, _, state_rows, _ = self.filtered.system
        rows = np.repeat(state_rows[None], samples, axis=0)
        columns = np.zeros((samples, channels, self.width))
        columns[:, :, 0] = trial.residual - self.sensors.known
        for unknown, slope in self.sensors.by_unknown.items():
            columns[:, :, 1 + unknown] -= slope
            columns[:, :, 0] += self._value(unknown) * slope
        by_unknowns = np.concatenate((trial.shared, trial.local))
        for unknown, column in enumerate(by_unknowns):
            columns[:, :, self.weight_of(unknown)] -= column
        for unknown, column in self._by_parameters().items():
            columns[:, :, 1 + unknown] -= column
            columns[:, :, 0] += trial.about[unknown] * column
        columns *= self.filtered.white[:, None]
        for row, port in enumerate(self.ports):
            through = trial.system.through[port] / trial.deviation * self.filtered.white
            if not np.any(through):
                continue
            rows = rows - through[:, None] * self.tangents[::parts, row][:, None, :]
            columns += self.pushes[::parts, row, None, :] * through[:, None]
        return np.ascontiguousarray(rows), columns * trial.used[:, :, None]

    def _by_parameters(self) -> dict[int, FloatArray]:
        """Return the derivatives of readings by shared unknowns along the trajectory."""
        trial = self.trial
        trajectory = self.trajectory
        derivatives: dict[int, FloatArray] = {}
        for unknown, slope in enumerate(trial.slopes):
            if slope is not None:
                derivatives[unknown] = trial.over_noise(
                    trial.shown(slope, trajectory.added, trajectory.forces)
                )
        shown = trial.readings(trajectory.added, trajectory.forces)
        for unknown, channel, scale in trial.gains:
            derivatives[unknown] = shown * scale * np.eye(shown.shape[1])[channel]
        return derivatives

    # ------------------------------------------------------------ filter and smoother

    @cached_property
    def record(self) -> "FilteredRecord":
        """What one pass of the filter tells."""
        transition, noise, drift = self._steps()
        rows, columns = self._readings()
        covariance, mean = self._start()
        means, covariances, innovations, gains, variances = filter_record(
            self.trial.parts,
            transition,
            noise,
            drift,
            rows,
            columns,
            self.trial.used,
            covariance,
            mean,
        )
        return FilteredRecord(transition, rows, means, covariances, innovations, gains, variances)

    @cached_property
    def products(self) -> tuple[FloatArray, float]:
        """Products (W, W) of whitened residual and unknowns, and half a log determinant [nat].

        The second is half the sum of the logarithms of the readings' variances given those before.
        """
        record = self.record
        white = record.innovations / np.sqrt(record.variances)[:, :, None]
        white = white.reshape(-1, self.width)
        white[:, 1:] *= -1.0  # what an unknown explains of the residual
        used = self.trial.used
        half = 0.5 * float(np.sum(np.log(record.variances)[used]))
        half -= float(np.sum(np.log(self.filtered.white) * used))
        return white.T @ white, half

    def smoothed(self, unknowns: FloatArray) -> "SmoothedTrial":
        """Return the trajectory, and what no law is of the missing forces, given all readings.

        Parameters
        ----------
        unknowns : (W - 1,) ndarray
            Values of all unknowns.
        """
        record, trial = self.record, self.trial
        weights = np.concatenate(([1.0], unknowns))
        smoothed, variance = smooth_record(
            trial.parts,
            record.transition,
            record.rows,
            trial.used,
            record.means @ weights,
            record.covariances,
            record.innovations @ weights,
            record.gains,
            record.variances,
        )
        added = smoothed[:, : self.moving] * self.filtered.units
        missing: dict[int, FloatArray] = {}
        deviations: dict[int, FloatArray] = {}
        for (port, process), place in zip(
            self.processes.items(), self.filtered.places, strict=True
        ):
            missing[port] = smoothed[:, place] * process.size
            deviations[port] = np.sqrt(variance[:, place]) * process.size
        forces = dict(missing)
        laws: dict[int, FloatArray] = {}
        for at, port in enumerate(self.ports):
            law = self.pushes[:, at] @ weights + np.einsum(
                "fn,fn->f", self.tangents[:, at], smoothed
            )
            laws[port] = law
            forces[port] = forces.get(port, 0.0) + law
        shared = unknowns[: len(self.shared)]
        local = unknowns[len(self.shared) + len(self.effect) :]
        positions, speeds = trial.port_motion(np.concatenate((shared, local)), added)
        trajectory = Trajectory(added, positions, speeds, forces)
        state_deviation = np.sqrt(variance[:, : self.moving]) * self.filtered.units
        return SmoothedTrial(trajectory, missing, laws, deviations, state_deviation)


@dataclass(frozen=True, eq=False)
class FilteredRecord:
    """What one pass of the filter tells of a trial; shapes as of `kernel.filter_record`."""

    transition: FloatArray
    rows: FloatArray
    means: FloatArray
    covariances: FloatArray
    innovations: FloatArray
    gains: FloatArray
    variances: FloatArray


@dataclass(frozen=True, eq=False)
class SmoothedTrial:
    """A trial given all of its readings.

    Attributes
    ----------
    trajectory : Trajectory
        The smoothed motion, and all forces at ports.
    missing : mapping of int to (F,) ndarray
        The force at each port that no law explains, by the number of the port [N or N m].
    laws : mapping of int to (F,) ndarray
        Force of the laws at a port, linear about the trajectory before.
    deviations : mapping of int to (F,) ndarray
        Standard deviation of `missing`.
    state_deviation : (F, n) ndarray
        Standard deviation of the added state.
    """

    trajectory: Trajectory
    missing: Mapping[int, FloatArray]
    laws: Mapping[int, FloatArray]
    deviations: Mapping[int, FloatArray]
    state_deviation: FloatArray


def push_matrices(generator: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the state (K, n, n) that a unit push adds over steps of some lengths (K,) [s].

    The push is linear over the step: the first matrix is for its value at the begin, the second for
    that at the end (Van Loan 1978, IEEE Transactions on Automatic Control 23, 395-404).
    """
    n = len(generator)
    blocks = np.zeros((len(lengths), 3 * n, 3 * n))
    blocks[:, :n, :n] = generator * lengths[:, None, None]
    blocks[:, :n, n : 2 * n] = np.eye(n) * lengths[:, None, None]
    blocks[:, n : 2 * n, 2 * n :] = np.eye(n)
    exponential = expm(blocks)[:, :n]
    constant, rising = exponential[:, :, n : 2 * n], exponential[:, :, 2 * n :]
    return constant - rising, rising
