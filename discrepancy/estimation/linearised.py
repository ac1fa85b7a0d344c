"""A trial, linear along a trajectory, with the laws of a hypothesis and missing forces.

The state s of a trial is what forces at ports add to the response of the linear model. With the
forces G of the hypothesis' laws, the missing forces f (Gaussian processes in time) and the unknowns
w, it obeys

    s' = A(w) s - sum_p b_p (G_p(x, v; w) + f_p),
    reading = r(w) + C(w) s - sum_p e_p (G_p(x, v; w) + f_p) + noise.

Here x and v are the position and the speed of port p, and r is the reading of the linear model. All
of it is linearised along a trajectory. A weight is a factor of the linear model: the first weight
is one and stands for what is known, the others are the unknowns.
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
    """The motion of a trial along which it is linearised, at its F fine stamps.

    Attributes
    ----------
    added : (F, n) ndarray
        The state that forces at ports add to the response of the linear model.
    positions, speeds : (F, P) ndarray
        The motion of the P ports [m or rad, and per s].
    forces : mapping of int to (F,) ndarray
        The force at a port that the linear model does not contain, by the number of the port [N or
        N m].
    """

    added: FloatArray
    positions: FloatArray
    speeds: FloatArray
    forces: Mapping[int, FloatArray]

    def toward(self, other: "Trajectory", fraction: float) -> "Trajectory":
        """Return the trajectory that lies a fraction of the way to another one."""
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
    """The force of a hypothesis' laws at a port along a trajectory, with its derivatives.

    Attributes
    ----------
    along : ForceAlong
        The force of all laws at the port, and its derivatives by the motion.
    by_unknown : mapping of int to (F,) ndarray
        The derivatives of the force by unknowns, by the number of the unknown.
    """

    along: ForceAlong
    by_unknown: Mapping[int, FloatArray]


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """The changes of a trial's readings by errors of sensors, divided by the noise.

    Attributes
    ----------
    known : (N, C) ndarray
        The change at the present values of the unknowns.
    by_unknown : mapping of int to (N, C) ndarray
        The derivatives of the change by unknowns, by the number of the unknown.
    """

    known: FloatArray
    by_unknown: Mapping[int, FloatArray]


@dataclass(frozen=True, eq=False)
class LinearisedTrial:
    """A trial, linear along a trajectory.

    The unknowns are the K shared ones, the E of the hypothesis' effects, and the trial's own, in
    this order. Shapes: F fine stamps, N samples, C channels, n states, W weights (one and all
    unknowns), L ports with a law of the hypothesis.

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
        """The linear system with its missing forces, scaled so that its states are of size one."""
        return ForceFilter(self.trial, tuple(self.processes.items()))

    @property
    def moving(self) -> int:
        """The number of states of the structure; missing forces and coloured noises follow them."""
        return len(self.trial.system.generator)

    @property
    def width(self) -> int:
        """The number W of weights: one for what is known, and one for each unknown."""
        return 1 + len(self.shared) + len(self.effect) + len(self.trial.local)

    def weight_of(self, unknown: int) -> int:
        """Return the index of the weight of a shared unknown, or of one of the trial alone.

        Parameters
        ----------
        unknown : int
            The number of the unknown in `SeenTrial.about`, where those of the trial alone follow
            the shared ones. In the weights, those of effects stand between both.
        """
        shared_count = len(self.shared)
        return 1 + unknown + (len(self.effect) if unknown >= shared_count else 0)

    @cached_property
    def ports(self) -> tuple[int, ...]:
        """The numbers of the L ports at which a law of the hypothesis acts."""
        return tuple(self.forces)

    # ------------------------------------------------------------ forces of the laws

    @cached_property
    def tangents(self) -> FloatArray:
        """The derivatives (F, L, n) of the laws' force at their ports by the scaled state."""
        generator, _, _, _ = self.filtered.system
        tangents = np.zeros((len(self.trial.fine_time), len(self.ports), len(generator)))
        system = self.trial.system
        units = self.filtered.units
        for row, port in enumerate(self.ports):
            law = self.forces[port].along
            tangents[:, row, : self.moving] = (
                law.by_position[:, None] * system.positions[port] * units
                + law.by_speed[:, None] * system.speeds[port] * units
            )
        return tangents

    @cached_property
    def pushes(self) -> FloatArray:
        """The laws' force (F, L, W) at their ports at state zero, for a unit of each weight.

        The whole force of the laws is `pushes` times the weights plus `tangents` times the state.
        """
        trial = self.trial
        trajectory = self.trajectory
        pushes = np.zeros((len(trial.fine_time), len(self.ports), self.width))
        for row, port in enumerate(self.ports):
            law = self.forces[port].along
            # motion at state zero and zero unknowns, minus that of the trajectory
            position_offset = trial.positions[:, port] - trajectory.positions[:, port]
            speed_offset = trial.speeds[:, port] - trajectory.speeds[:, port]
            for unknown, (position_slopes, speed_slopes) in trial.by_unknowns.items():
                position_offset = position_offset - trial.about[unknown] * position_slopes[:, port]
                speed_offset = speed_offset - trial.about[unknown] * speed_slopes[:, port]
                pushes[:, row, self.weight_of(unknown)] += (
                    law.by_position * position_slopes[:, port]
                    + law.by_speed * speed_slopes[:, port]
                )
            pushes[:, row, 0] = (
                law.force + law.by_position * position_offset + law.by_speed * speed_offset
            )
            for unknown, slope in self.forces[port].by_unknown.items():
                pushes[:, row, 1 + unknown] += slope
                # refer the known force from the present value of the unknown to zero
                pushes[:, row, 0] -= self._value(unknown) * slope
        return pushes

    def _value(self, unknown: int) -> float:
        """Return the value of an unknown, shared or of an effect, about which laws are linear."""
        return float(np.concatenate((self.shared, self.effect))[unknown])

    @cached_property
    def directions(self) -> FloatArray:
        """The rate (n, L) of the scaled state for a unit force at each of the laws' ports."""
        generator, _, _, _ = self.filtered.system
        directions = np.zeros((len(generator), len(self.ports)))
        for row, port in enumerate(self.ports):
            directions[: self.moving, row] = -self.trial.system.actions[port] / self.filtered.units
        return directions

    # ------------------------------------------------------------ steps

    def _steps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return transitions, process noises and drifts of all fine steps, with the laws in them.

        Returns
        -------
        transition, noise : (F - 1, n, n) array
            The transition of each fine step, and the covariance of its process noise.
        drift : (F - 1, n, W) array
            The state that each weight adds in a fine step.
        """
        generator, intensity, _, _ = self.filtered.system
        lengths, step_kind = self.trial.steps
        fine_lengths = lengths / self.trial.parts
        free_transition, free_noise = discretised(generator, intensity, fine_lengths)
        by_input_at_begin, by_input_at_end = push_matrices(generator, fine_lengths)
        drift = self._drift_by_parameters(by_input_at_begin, by_input_at_end, step_kind)
        transition, noise = step_matrices(
            self.trial.parts,
            step_kind,
            free_transition,
            free_noise,
            np.ascontiguousarray(by_input_at_begin @ self.directions),
            np.ascontiguousarray(by_input_at_end @ self.directions),
            self.tangents,
            self.pushes,
            drift,
        )
        return transition, noise, drift

    def _drift_by_parameters(
        self, begin: FloatArray, end: FloatArray, kind: IntArray
    ) -> FloatArray:
        """Return the drift (F - 1, n, W) by parameters that change the linear system itself.

        Parameters
        ----------
        begin, end : (K, n, n) array
            The change of the state over a fine step for a unit input at its start, or at its end,
            by the kind of step.
        kind : (N,) array of int
            The kind of step that leads to each sample; steps of one kind have one length.
        """
        trial = self.trial
        moving = self.moving
        step_count = len(trial.fine_time) - 1
        drift = np.zeros((step_count, len(begin[0]), self.width))
        kind_of_step = kind[np.arange(step_count) // trial.parts + 1]
        for unknown, slope in enumerate(trial.slopes):
            if slope is None:
                continue
            # derivative of A s - sum_p b_p force_p by the parameter, along the trajectory
            rate_change = self.trajectory.added @ slope.generator.T
            for port, force in self.trajectory.forces.items():
                rate_change = rate_change - np.outer(force, slope.actions[port])
            rate_change = rate_change / self.filtered.units
            state_change = np.einsum(
                "jab,jb->ja", begin[kind_of_step, :, :moving], rate_change[:-1]
            )
            state_change += np.einsum("jab,jb->ja", end[kind_of_step, :, :moving], rate_change[1:])
            drift[:, :, 1 + unknown] += state_change
            drift[:, :, 0] -= trial.about[unknown] * state_change
        return drift

    def _start(self) -> tuple[FloatArray, FloatArray]:
        """Return covariance (n, n) and mean (n, W) of the state before the first reading.

        The mean has one column for each weight.
        """
        generator, _, _, covariance = self.filtered.system
        mean = np.zeros((len(generator), self.width))
        if not self.trial.settled:
            return covariance, mean
        # At rest s' = 0 under the laws and the missing forces f, whose first values are not known:
        # (A + directions tangents) s + directions pushes + (column of A for f) f = 0
        moving = self.moving
        directions = self.directions[:moving]
        rate_matrix = generator[:moving, :moving] + directions @ self.tangents[0][:, :moving]
        mean[:moving] = np.linalg.lstsq(rate_matrix, -directions @ self.pushes[0], rcond=1e-12)[0]
        covariance = covariance.copy()
        covariance[:moving, :moving] = 0.0
        for index in self.filtered.places:
            at_rest = np.linalg.lstsq(rate_matrix, -generator[:moving, index], rcond=1e-12)[0]
            covariance[:moving, :moving] += np.outer(at_rest, at_rest)
            covariance[:moving, index] = at_rest
            covariance[index, :moving] = at_rest
        return covariance, mean

    # ------------------------------------------------------------ readings

    def _readings(self) -> tuple[FloatArray, FloatArray]:
        """Return the readings as rows on the state and columns of the weights.

        Returns
        -------
        rows : (N, C, n) array
            The derivatives of the readings by the scaled state, divided by the deviation of the
            white part of the noise.
        columns : (N, C, W) array
            The residual at state zero and zero unknowns (first weight), and minus the derivatives
            of the readings by the unknowns; columns times weights is the residual that the state
            explains. Zero if a reading does not count.
        """
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
        derivatives = np.concatenate((trial.shared, trial.local))
        for unknown, derivative in enumerate(derivatives):
            columns[:, :, self.weight_of(unknown)] -= derivative
        for unknown, derivative in self._by_parameters().items():
            columns[:, :, 1 + unknown] -= derivative
            columns[:, :, 0] += trial.about[unknown] * derivative
        columns *= self.filtered.white[:, None]
        # an acceleration shows the forces of laws directly, with the sign of - e_p G_p
        for row, port in enumerate(self.ports):
            through = trial.system.through[port] / trial.deviation * self.filtered.white
            if not np.any(through):
                continue
            rows = rows - through[:, None] * self.tangents[::parts, row][:, None, :]
            columns += self.pushes[::parts, row, None, :] * through[:, None]
        return np.ascontiguousarray(rows), columns * trial.used[:, :, None]

    def _by_parameters(self) -> dict[int, FloatArray]:
        """Return the derivatives (N, C) of readings by shared unknowns, along the trajectory.

        They are the changes of the output equation, divided by the noise: by parameters that change
        the system, and by gains of channels.
        """
        trial = self.trial
        trajectory = self.trajectory
        derivatives: dict[int, FloatArray] = {}
        for unknown, slope in enumerate(trial.slopes):
            if slope is not None:
                derivatives[unknown] = trial.over_noise(
                    trial.shown(slope, trajectory.added, trajectory.forces)
                )
        added_readings = trial.readings(trajectory.added, trajectory.forces)
        for unknown, channel, scale in trial.gains:
            derivatives[unknown] = added_readings * scale * np.eye(added_readings.shape[1])[channel]
        return derivatives

    # ------------------------------------------------------------ filter and smoother

    @cached_property
    def record(self) -> "FilteredRecord":
        """The results of one pass of the Kalman filter."""
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
        """The products (W, W) of whitened residual and derivatives, and half a log determinant.

        The second is half the sum of the logarithms of the readings' variances, each given those
        before it [nat].
        """
        record = self.record
        white = record.innovations / np.sqrt(record.variances)[:, :, None]
        white = white.reshape(-1, self.width)
        # from minus the derivatives of the readings to the derivatives
        white[:, 1:] *= -1.0
        used = self.trial.used
        half_log_determinant = 0.5 * float(np.sum(np.log(record.variances)[used]))
        # readings were multiplied by `white`, and their deviations with them
        half_log_determinant -= float(np.sum(np.log(self.filtered.white) * used))
        return white.T @ white, half_log_determinant

    def smoothed(self, unknowns: FloatArray) -> "SmoothedTrial":
        """Return the smoothed trajectory and forces of the trial, given all readings.

        Parameters
        ----------
        unknowns : (W - 1,) ndarray
            The values of all unknowns.
        """
        record, trial = self.record, self.trial
        weights = np.concatenate(([1.0], unknowns))
        states, variance = smooth_record(
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
        added = states[:, : self.moving] * self.filtered.units
        missing: dict[int, FloatArray] = {}
        deviations: dict[int, FloatArray] = {}
        for (port, process), index in zip(
            self.processes.items(), self.filtered.places, strict=True
        ):
            missing[port] = states[:, index] * process.size
            deviations[port] = np.sqrt(variance[:, index]) * process.size
        forces = dict(missing)
        laws: dict[int, FloatArray] = {}
        for row, port in enumerate(self.ports):
            law = self.pushes[:, row] @ weights + np.einsum(
                "fn,fn->f", self.tangents[:, row], states
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
    """The results of one pass of the filter over a trial; shapes as in `kernel.filter_record`."""

    transition: FloatArray
    rows: FloatArray
    means: FloatArray
    covariances: FloatArray
    innovations: FloatArray
    gains: FloatArray
    variances: FloatArray


@dataclass(frozen=True, eq=False)
class SmoothedTrial:
    """The motion and the forces of a trial, given all of its readings.

    Attributes
    ----------
    trajectory : Trajectory
        The smoothed motion, and all forces at ports.
    missing : mapping of int to (F,) ndarray
        The force at each port that no law explains, by the number of the port [N or N m].
    laws : mapping of int to (F,) ndarray
        The force of the laws at each port, linear about the trajectory before.
    deviations : mapping of int to (F,) ndarray
        The posterior standard deviation of `missing`.
    state_deviation : (F, n) ndarray
        The posterior standard deviation of the added state.
    """

    trajectory: Trajectory
    missing: Mapping[int, FloatArray]
    laws: Mapping[int, FloatArray]
    deviations: Mapping[int, FloatArray]
    state_deviation: FloatArray


def push_matrices(generator: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the changes of the state over a step for a unit input to its rate.

    The input is linear over the step. The matrices follow from one exponential of the system with
    the input and its rate as further states (Van Loan 1978, IEEE Transactions on Automatic Control
    23, 395-404).

    Parameters
    ----------
    generator : (n, n) array
        The rate matrix of the state [1/s].
    lengths : (K,) array
        The lengths of the steps [s].

    Returns
    -------
    by_begin, by_end : (K, n, n) array
        The changes for an input of one at the start of the step, falling to zero, and for an input
        of one at its end, rising from zero.
    """
    n = len(generator)
    blocks = np.zeros((len(lengths), 3 * n, 3 * n))
    blocks[:, :n, :n] = generator * lengths[:, None, None]
    blocks[:, :n, n : 2 * n] = np.eye(n) * lengths[:, None, None]
    blocks[:, n : 2 * n, 2 * n :] = np.eye(n)
    exponential = expm(blocks)[:, :n]
    by_constant_input, by_rising_input = exponential[:, :, n : 2 * n], exponential[:, :, 2 * n :]
    return by_constant_input - by_rising_input, by_rising_input
