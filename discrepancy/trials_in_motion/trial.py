"""A trial in motion as a linear system with ports, whose missing forces are estimated.

The trial is linear in its unknowns, which are those of `fits.trial_data`, with prior mean zero.
Residuals and derivatives are divided by the standard deviations of the noise. A calibrated
parameter changes the response of the model (`shared_derivatives`) and the motion that missing
forces add to it (`system_derivatives`); both together are exact along the actual motion.

Terms and shapes: a port is a place where a force can act. An interval between two of the N samples
is divided into substeps; their ends are the F = (N - 1) substeps + 1 fine stamps. The added
state (F, n) is the state of the linear system that forces at ports add to the model's response.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.system.response import PortedSystem
from discrepancy.system.time_history import subdivide

from .steps import respond_to_inputs, state_under_inputs
from .trajectory import Trajectory

NO_FORCES: Mapping[int, FloatArray] = MappingProxyType({})
"""The forces by port of a trial in which no force acts: an empty mapping."""


class ColouredNoise(NamedTuple):
    """The part of a channel's noise that is correlated in time, as a process of first order.

    Attributes
    ----------
    channel : int
        The index of the channel in the trial.
    share : float
        The share of this part in the variance of the noise.
    decay_rate : float
        The rate at which its correlation decays [1/s].
    """

    channel: int
    share: float
    decay_rate: float


class GainUnknown(NamedTuple):
    """A shared unknown that is the gain of a channel of a trial.

    Attributes
    ----------
    unknown : int
        The number of the unknown.
    channel : int
        The index of the channel in the trial.
    scale : float
        The relative change of the channel's readings for a unit of the unknown.
    """

    unknown: int
    channel: int
    scale: float


class SampleIntervals(NamedTuple):
    """The intervals between the N samples of a trial.

    Attributes
    ----------
    lengths : (J,) ndarray
        The different lengths [s].
    length_of_sample : (N,) ndarray of int
        The index in `lengths` of the interval that ends at each sample; that of sample 0 is not
        used.
    """

    lengths: FloatArray
    length_of_sample: IntArray


class SubstepMatrices(NamedTuple):
    """The matrices by which the state advances over a substep, by the length of the interval.

    Attributes
    ----------
    transitions : (J, n, n) ndarray
        The transitions of the state.
    by_input_at_begin, by_input_at_end : (J, n, n) ndarray
        The derivatives of the next state with respect to an input to the state's rate at the start
        and at the end of the substep. The input is linear over the substep (first-order hold).
    """

    transitions: FloatArray
    by_input_at_begin: FloatArray
    by_input_at_end: FloatArray


@dataclass(frozen=True, eq=False)
class PortedTrial:
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
        Whether each reading is compared with the model.
    deviation : (C,) ndarray
        The standard deviation of the noise of each channel [unit of the channel].
    coloured_noises : sequence of ColouredNoise
        The parts of noises that are correlated in time.
    shared_derivatives, local_derivatives : (K, N, C), (L, N, C) ndarray
        The derivatives of the readings with respect to the shared unknowns, and to those of this
        trial alone, divided by the standard deviations of the noise.
    local_precision : (L,) ndarray
        The prior precisions of the unknowns of this trial alone.
    system : PortedSystem
        The linear system at the values `linearisation_point`; the gains of the channels are
        contained in its outputs.
    system_derivatives : sequence of PortedSystem or None
        The derivatives of the system by each shared unknown; None if the derivative is zero.
    substeps : int
        The number of substeps in an interval between two samples.
    port_positions, port_speeds : (F, P) ndarray
        The motion of the ports by the model without missing forces [m or rad, and per s].
    begins_at_rest : bool
        Whether the trial begins at rest under the forces that act at its first sample.
    linearisation_point : (K + L,) ndarray
        The values of the unknowns about which the trial is linear.
    gain_unknowns : sequence of GainUnknown
        The shared unknowns that are gains of its channels.
    port_motion_derivatives : mapping of int to (2, F, P) ndarray
        The derivatives of `port_positions` and `port_speeds`, by the number of the unknown in
        `linearisation_point`.
    stride : int
        The number of samples of the record from one of the N samples to the next; more than one if
        the trial is thinned.
    """

    name: str
    time: FloatArray
    residual: FloatArray
    used: BoolArray
    deviation: FloatArray
    coloured_noises: Sequence[ColouredNoise]
    shared_derivatives: FloatArray
    local_derivatives: FloatArray
    local_precision: FloatArray
    system: PortedSystem
    system_derivatives: Sequence[PortedSystem | None]
    substeps: int
    port_positions: FloatArray
    port_speeds: FloatArray
    begins_at_rest: bool
    linearisation_point: FloatArray = field(default_factory=lambda: np.zeros(0))
    gain_unknowns: Sequence[GainUnknown] = ()
    port_motion_derivatives: Mapping[int, FloatArray] = field(default_factory=dict)
    stride: int = 1

    is_at_rest = False

    @property
    def ports(self) -> tuple[str, ...]:
        """The names of the ports."""
        return self.system.ports

    def thinned(self, stride: int, substeps: int) -> "PortedTrial":
        """Return the trial with every `stride`-th sample, at equal intervals.

        The samples that are left out are not averaged: the likelihood of the others stays exact.

        Parameters
        ----------
        stride : int
            The number of samples from one that remains to the next.
        substeps : int
            The number of substeps in an interval of the thinned trial. It must divide `stride`
            times the number of substeps of this trial, so that each fine stamp is one of this
            trial.
        """
        time = self.time[::stride]
        stamp_count = (len(time) - 1) * substeps + 1
        stamp_stride = stride * self.substeps // substeps
        assert stamp_stride * substeps == stride * self.substeps

        def at_fine_stamps(series: FloatArray) -> FloatArray:
            # the stamps are the last axis but one
            return series[..., ::stamp_stride, :][..., :stamp_count, :].copy()

        return replace(
            self,
            time=time,
            substeps=substeps,
            residual=self.residual[::stride].copy(),
            used=self.used[::stride].copy(),
            shared_derivatives=self.shared_derivatives[:, ::stride].copy(),
            local_derivatives=self.local_derivatives[:, ::stride].copy(),
            port_positions=at_fine_stamps(self.port_positions),
            port_speeds=at_fine_stamps(self.port_speeds),
            port_motion_derivatives={
                unknown_index: at_fine_stamps(derivative)
                for unknown_index, derivative in self.port_motion_derivatives.items()
            },
            stride=self.stride * stride,
        )

    @cached_property
    def intervals(self) -> SampleIntervals:
        """The intervals between samples.

        Intervals within 0.1 % of their mean are taken as equal, so that they share the matrices of
        a step.
        """
        lengths = np.diff(self.time)
        mean = float(lengths.mean())
        if np.all(np.abs(lengths - mean) < 1e-3 * mean):
            return SampleIntervals(np.array([mean]), np.zeros(len(self.time), dtype=np.int64))
        relative_lengths, index = np.unique(np.round(lengths / mean, 9), return_inverse=True)
        length_of_sample = np.concatenate(([0], index)).astype(np.int64)
        return SampleIntervals(relative_lengths * mean, length_of_sample)

    @cached_property
    def substep_matrices(self) -> SubstepMatrices:
        """The matrices that advance the state over a substep (first-order hold)."""
        substep_lengths = self.intervals.lengths / self.substeps
        return SubstepMatrices(*respond_to_inputs(self.system.generator, substep_lengths))

    @cached_property
    def fine_time(self) -> FloatArray:
        """The times (F,) of the fine stamps, which are the ends of all substeps [s]."""
        return subdivide(self.time, self.substeps)

    def port_motion(
        self, unknowns: FloatArray, added_state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the motion of the P ports at the F fine stamps.

        The motion is the sum of two: that of the model's own response, which is linear in the
        unknowns, and that of the state by which forces at ports change the response.

        Parameters
        ----------
        unknowns : (K + L,) array
            The values of the K unknowns that all trials share, then of the L of this trial alone.
        added_state : (F, n) array
            The change of the state caused by forces at ports.

        Returns
        -------
        positions : (F, P) array
            The positions of the ports [m or rad].
        speeds : (F, P) array
            The speeds of the ports [m/s or rad/s].
        """
        # model's own response: positions first, then speeds
        motion = np.stack((self.port_positions, self.port_speeds))
        for unknown_index, derivative in self.port_motion_derivatives.items():
            motion += (
                unknowns[unknown_index] - self.linearisation_point[unknown_index]
            ) * derivative
        response_positions, response_speeds = motion
        # motion of the ports by the added state
        added_positions = added_state @ self.system.positions.T
        added_speeds = added_state @ self.system.speeds.T
        return response_positions + added_positions, response_speeds + added_speeds

    def system_at(self, shared_values: FloatArray) -> PortedSystem:
        """Return the linear system at values (K,) of the shared unknowns, in which it is linear."""
        generator, actions = self.system.generator, self.system.actions
        changes = shared_values - self.linearisation_point[: len(shared_values)]
        for change, derivative in zip(changes, self.system_derivatives, strict=True):
            if derivative is not None:
                generator = generator + change * derivative.generator
                actions = actions + change * derivative.actions
        return replace(self.system, generator=generator, actions=actions)

    def state_under_force(self, port: int, force: FloatArray) -> FloatArray:
        """Return the state (F, n) that a force at a port adds to the response of the model.

        Parameters
        ----------
        port : int
            The number of the port.
        force : (F,) array
            The force at the fine stamps [N, N m or the port's flow].
        """
        direction = -self.system.actions[port]
        # s' = A s + direction * force (see `PortedSystem`); at rest s' = 0 at the first sample. A
        # rigid motion makes A singular: least squares give the equilibrium without it.
        start = np.zeros(len(direction))
        if self.begins_at_rest and force[0] != 0.0:
            start = np.linalg.lstsq(self.system.generator, -direction * force[0], rcond=1e-12)[0]
        return self._state_under_inputs(start, direction[:, None], force[:, None])

    def _state_under_inputs(
        self,
        start: FloatArray,
        directions: FloatArray,
        inputs: FloatArray,
        step_of_sample: IntArray | None = None,
    ) -> FloatArray:
        """Return the state (F, n) of the linear system s' = A s + directions u(t).

        The inputs u are added to the rate of the state. They are linear in time between
        neighbouring fine stamps.

        Parameters
        ----------
        start : (n,) array
            The state at the first fine stamp.
        directions : (n, D) array
            The rate of the state for a unit of each of the D inputs.
        inputs : (F, D) array
            The inputs u at the fine stamps.
        step_of_sample : (N,) array of int, optional
            For each of the N simulated samples, the index in `intervals` of the length of the
            interval that ends at this sample. By default all samples of the trial are simulated.
        """
        matrices = self.substep_matrices
        if step_of_sample is None:
            step_of_sample = self.intervals.length_of_sample
        states = state_under_inputs(
            self.substeps,
            matrices.transitions,
            np.ascontiguousarray(matrices.by_input_at_begin @ directions),
            np.ascontiguousarray(matrices.by_input_at_end @ directions),
            step_of_sample,
            start,
            np.ascontiguousarray(inputs),
        )
        return np.asarray(states)

    def trajectory_of_model(self) -> Trajectory:
        """Return the motion by the linear model alone, to which no force adds anything."""
        no_state = np.zeros((len(self.fine_time), len(self.system.generator)))
        return Trajectory(no_state, self.port_positions, self.port_speeds, {})

    def trajectory_under(self, forces: Mapping[int, FloatArray]) -> Trajectory:
        """Return the motion by the linear model and by forces (F,) at ports, by port."""
        model = self.trajectory_of_model()
        added_state = self._state_under_forces(forces)
        return Trajectory(
            added_state,
            positions=model.positions + added_state @ self.system.positions.T,
            speeds=model.speeds + added_state @ self.system.speeds.T,
            forces=forces,
        )

    def trajectory_without(
        self, trajectory: Trajectory, forces: Mapping[int, FloatArray]
    ) -> Trajectory:
        """Return a trajectory minus what some of its forces (F,), by port, add to it."""
        state = self._state_under_forces(forces)
        remaining_forces = dict(trajectory.forces)
        for port, force in forces.items():
            remaining_forces[port] = remaining_forces[port] - force
        return Trajectory(
            trajectory.added_state - state,
            trajectory.positions - state @ self.system.positions.T,
            trajectory.speeds - state @ self.system.speeds.T,
            remaining_forces,
        )

    def _state_under_forces(self, forces: Mapping[int, FloatArray]) -> FloatArray:
        """Return the state (F, n) that forces (F,) at ports, by port, add."""
        state = np.zeros((len(self.fine_time), len(self.system.generator)))
        for port, force in forces.items():
            state += self.state_under_force(port, force)
        return state

    def readings_of_state(
        self, states: FloatArray, forces: Mapping[int, FloatArray] = NO_FORCES
    ) -> FloatArray:
        """Return the whitened readings (N, C) caused by an added state and forces.

        They are divided by the standard deviation of the noise.

        Parameters
        ----------
        states : (F, n) array
            The state that missing forces and laws add, at the fine stamps.
        forces : mapping of int to (F,) array
            The forces at ports, which an acceleration shows directly, by the index of the port.
        """
        return self.divide_by_noise(self.outputs_of_state(self.system, states, forces))

    def outputs_of_state(
        self, system: PortedSystem, states: FloatArray, forces: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return the outputs (N, C) that an added state and forces cause, in units of the channels.

        Parameters
        ----------
        system : PortedSystem
            The system of the trial, or its derivative with respect to a parameter.
        states : (F, n) array
            The state that missing forces and laws add, at the fine stamps.
        forces : mapping of int to (F,) array
            The forces at ports, which an acceleration shows directly, by the index of the port.
        """
        readings = states[:: self.substeps] @ system.outputs.T
        for port, force in forces.items():
            readings -= np.outer(force[:: self.substeps], system.through[port])
        return np.asarray(readings)

    def strength_of_port(self, port: int) -> float:
        """Return how strongly a force at a port acts on states and readings, as a weight."""
        strength_on_state = np.linalg.norm(self.system.actions[port])
        strength_on_readings = np.linalg.norm(self.system.through[port])
        return float(np.hypot(strength_on_state, strength_on_readings))

    def readings_of_forces_in_block(
        self, forces: Mapping[int, FloatArray], begin: int, end: int
    ) -> FloatArray:
        """Return the whitened readings that forces cause in a block of samples.

        The system is at rest at the start of the block, so that forces before it have no effect.

        Parameters
        ----------
        forces : mapping of int to (F,) array
            The forces at ports, by the index of the port, at the F fine stamps of the whole trial
            [N, N m or the port's flow].
        begin, end : int
            The first sample of the block, and the one after its last.

        Returns
        -------
        (B, C) array
            The readings of C channels at the B samples, over the standard deviation of the noise;
            0 where a reading does not count.
        """
        fine_stamps_of_block = slice(begin * self.substeps, (end - 1) * self.substeps + 1)
        forces_in_block = {port: force[fine_stamps_of_block] for port, force in forces.items()}
        # s' = A s - sum_p b_p g_p (see `PortedSystem`): hence the minus sign
        directions = -np.array([self.system.actions[port] for port in forces_in_block]).T
        # the index of the length of the interval that ends at each sample
        step_of_sample = np.ascontiguousarray(self.intervals.length_of_sample[begin:end])
        inputs = np.array([*forces_in_block.values()]).T
        states = self._state_under_inputs(
            np.zeros(len(directions)), directions, inputs, step_of_sample
        )
        readings = self.outputs_of_state(self.system, states, forces_in_block)
        return np.asarray(readings / self.deviation * self.used[begin:end])

    def divide_by_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) over the noise deviation; 0 if a reading does not count."""
        return np.asarray(columns / self.deviation * self.used)


def correlation_time_range(trials: Sequence[PortedTrial]) -> tuple[float, float]:
    """Return the bounds of a correlation time [s]: shortest sampling interval, longest record."""
    intervals = [float(np.median(np.diff(trial.time))) for trial in trials]
    durations = [float(trial.time[-1] - trial.time[0]) for trial in trials]
    return min(intervals), max(durations)
