"""A linear trial with missing forces: its Kalman filter, its smoother, and what they show."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.trials_in_motion.steps import discretise, respond_to_inputs
from discrepancy.trials_in_motion.trajectory import Trajectory
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

from .force_states import ForceStates
from .kernel import (
    filter_record,
    smooth_record,
    smoothed_variances,
    substep_matrices_with_laws,
)
from .linearised import LinearisedTrial
from .process_search import Processes

LEAST_INNOVATION_VARIANCE = 0.5
"""Least variance of an innovation over that of the noise. The exact variance is at least one; with
a missing force that is far too large, rounding errors make the computed one smaller."""


@dataclass(frozen=True, eq=False)
class FilteredTrial:
    """A linear trial with missing forces: its Kalman filter and its smoother.

    Attributes
    ----------
    linear_trial : LinearisedTrial
        The trial, linear along a trajectory.
    processes : mapping of int to Process
        The missing forces, by the index of the port.
    """

    linear_trial: LinearisedTrial
    processes: Processes

    @cached_property
    def force_states(self) -> ForceStates:
        """The states of structure, missing forces and noises, scaled to magnitudes of about one."""
        return ForceStates(self.linear_trial.trial, tuple(self.processes.items()))

    @property
    def _structure(self) -> slice:
        """The indices of the structure's states, which come before missing forces and noises."""
        return slice(0, len(self.linear_trial.trial.system.generator))

    @cached_property
    def _force_by_state(self) -> FloatArray:
        """The derivatives (F, L, n) of the laws' force at each port by the scaled state."""
        by_structure = self.linear_trial.force_by_state
        state_count = len(self.force_states.state_space.generator)
        derivatives = np.zeros((*by_structure.shape[:2], state_count))
        derivatives[:, :, self._structure] = by_structure * self.force_states.state_units
        return derivatives

    def _free_steps(self, substeps: int) -> tuple[FloatArray, FloatArray]:
        """Return transitions and process noises (J, n, n) of steps without laws, by length."""
        state_space = self.force_states.state_space
        lengths, _ = self.linear_trial.trial.intervals
        return discretise(state_space.generator, state_space.intensity, lengths / substeps)

    @cached_property
    def _substeps(self) -> tuple[FloatArray, FloatArray]:
        """The transitions and process noises (S, n, n) of the kinds of substeps, with the laws."""
        linear_trial = self.linear_trial
        trial = linear_trial.trial
        transitions, noises = self._free_steps(trial.substeps)
        if not linear_trial.law_ports:
            return transitions, noises
        state_count = transitions.shape[1]
        lengths, interval_of_sample = trial.intervals
        _, by_input_at_begin, by_input_at_end = respond_to_inputs(
            self.force_states.state_space.generator, lengths / trial.substeps
        )
        rate_by_force = np.zeros((state_count, len(linear_trial.law_ports)))
        rate_by_force[self._structure] = (
            linear_trial.state_rate_by_force / self.force_states.state_units[:, None]
        )
        stamp_count = len(trial.fine_time)
        return substep_matrices_with_laws(
            trial.substeps,
            interval_of_sample,
            transitions,
            noises,
            np.ascontiguousarray(by_input_at_begin @ rate_by_force),
            np.ascontiguousarray(by_input_at_end @ rate_by_force),
            self._force_by_state,
            np.zeros((stamp_count, len(linear_trial.law_ports), 0)),
            np.zeros((stamp_count - 1, state_count, 0)),
        )

    @cached_property
    def output_rows(self) -> FloatArray:
        """The readings (1 or N, C, n) for a unit of each scaled state, over the white noise.

        They change in time if a sensor shows the force of a law at once.
        """
        linear_trial = self.linear_trial
        trial = linear_trial.trial
        rows = self.force_states.state_space.output_rows[None]
        if np.any(trial.system.through[list(linear_trial.law_ports)]):
            force_by_state = self._force_by_state[:: trial.substeps]
            scale = self.force_states.white_noise_scale[:, None]
            rows = rows - linear_trial.direct_readings(force_by_state) * scale
        return np.ascontiguousarray(rows)

    @cached_property
    def _initial_covariance(self) -> FloatArray:
        """The covariance (n, n) of the scaled state before the first reading.

        A trial that begins at rest does so under the missing force and the laws: (A + B T) s + a f
        = 0, with the column a of the generator for f. The first value of f has variance one, so
        that its solution s = h f adds h h^T to the covariance.
        """
        state_space = self.force_states.state_space
        linear_trial = self.linear_trial
        if not (linear_trial.trial.begins_at_rest and linear_trial.law_ports):
            return state_space.initial_covariance
        structure = self._structure
        units = self.force_states.state_units
        rate_matrix = linear_trial.rate_matrix_at_start * units / units[:, None]
        covariance = state_space.initial_covariance.copy()
        covariance[structure, structure] = 0.0
        for index in self.force_states.force_state_indices:
            state_per_force = np.linalg.lstsq(
                rate_matrix, -state_space.generator[structure, index], rcond=1e-12
            )[0]
            covariance[structure, structure] += np.outer(state_per_force, state_per_force)
            covariance[structure, index] = state_per_force
            covariance[index, structure] = state_per_force
        return covariance

    # ------------------------------------------------------------ evidence

    @cached_property
    def whitened_products(self) -> tuple[FloatArray, float]:
        """The inner products (W, W) of the whitened columns, and half a log determinant [nat].

        The columns are the residual and its derivatives with respect to the unknowns. The
        determinant is that of the covariance of the readings: the product of the variances of their
        innovations. It is infinite if a missing force is so large that the readings are lost in
        rounding errors.
        """
        linear_trial = self.linear_trial
        trial = linear_trial.trial
        if linear_trial.law_ports:
            substeps = trial.substeps
            transitions, noises = self._substeps
            step_kinds = linear_trial.step_kinds
        else:
            # without a law no substeps are needed between samples
            substeps = 1
            transitions, noises = self._free_steps(1)
            step_kinds = linear_trial.step_kinds[:: trial.substeps].copy()
        scale = self.force_states.white_noise_scale
        innovations, _, variances, _, _ = filter_record(
            substeps,
            step_kinds,
            transitions,
            noises,
            self.output_rows,
            np.ascontiguousarray(linear_trial.columns * scale[:, None]),
            trial.used,
            self._initial_covariance,
            np.zeros((len(self._initial_covariance), linear_trial.weight_count)),
            False,
        )
        if not np.all(variances > LEAST_INNOVATION_VARIANCE):
            return np.zeros((linear_trial.weight_count,) * 2), np.inf
        whitened_columns = innovations / np.sqrt(variances)[:, :, None]
        whitened_columns = whitened_columns.reshape(-1, linear_trial.weight_count)
        # the columns are minus the derivatives of the prediction: change the sign
        whitened_columns[:, 1:] *= -1.0
        half_log_determinant = 0.5 * float(np.sum(np.log(variances)[trial.used]))
        # the determinant is for readings over their whole noise, not over its white part
        half_log_determinant -= float(np.sum(np.log(scale) * trial.used))
        return whitened_columns.T @ whitened_columns, half_log_determinant

    # ------------------------------------------------------------ smoothing

    def smooth(self, unknowns: FloatArray) -> "SmoothedTrial":
        """Return the smoothed trajectory and forces of the trial, given all readings."""
        linear_trial = self.linear_trial
        trial = linear_trial.trial
        weights = np.concatenate(([1.0], unknowns))
        states = self.smooth_residual(linear_trial.columns @ weights)
        structure_states = states[:, self._structure] * self.force_states.state_units
        added_state = linear_trial.known_states @ weights + structure_states
        # forces of the laws, at each fine stamp by the whole state there
        law_forces: dict[int, FloatArray] = {}
        for row, port in enumerate(linear_trial.law_ports):
            by_state = np.einsum("fn,fn->f", linear_trial.force_by_state[:, row], added_state)
            law_forces[port] = linear_trial.force_by_weight[:, row] @ weights + by_state
        missing_forces = self.missing_forces(states)
        forces = dict(missing_forces)
        for port, force in law_forces.items():
            forces[port] = forces.get(port, 0.0) + force
        # motion of the ports
        shared_count = len(linear_trial.shared)
        local_values = unknowns[shared_count + len(linear_trial.effect) :]
        positions, speeds = trial.port_motion(
            np.concatenate((unknowns[:shared_count], local_values)), added_state
        )
        return SmoothedTrial(
            trial=trial,
            trajectory=Trajectory(added_state, positions, speeds, forces),
            missing_forces=missing_forces,
            effect_forces=linear_trial.effect_forces,
            local=local_values,
        )

    def smooth_residual(self, residual: FloatArray) -> FloatArray:
        """Return the smoothed scaled state (F, n), which contains the missing forces.

        `residual` (N, C) is the readings minus their known part, divided by the noise.
        """
        linear_trial = self.linear_trial
        transitions, _ = self._substeps
        innovations, gains, variances, means, covariances = self._filter_states(residual)
        return smooth_record(
            linear_trial.trial.substeps,
            linear_trial.step_kinds,
            transitions,
            self.output_rows,
            linear_trial.trial.used,
            np.ascontiguousarray(innovations[:, :, 0]),
            gains,
            variances,
            np.ascontiguousarray(means[:, :, 0]),
            covariances,
        )

    def smoothed_state_variances(self) -> FloatArray:
        """Return the variance (F, n) of each entry of the smoothed scaled state.

        It is the same for all readings.
        """
        linear_trial = self.linear_trial
        transitions, _ = self._substeps
        is_used = linear_trial.trial.used
        _, gains, variances, _, covariances = self._filter_states(np.zeros(is_used.shape))
        return smoothed_variances(
            linear_trial.trial.substeps,
            linear_trial.step_kinds,
            transitions,
            self.output_rows,
            is_used,
            gains,
            variances,
            covariances,
        )

    def _filter_states(
        self, residual: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return what `filter_record` returns of a residual (N, C), with the filtered states."""
        linear_trial = self.linear_trial
        transitions, noises = self._substeps
        scaled_residual = residual * self.force_states.white_noise_scale
        return filter_record(
            linear_trial.trial.substeps,
            linear_trial.step_kinds,
            transitions,
            noises,
            self.output_rows,
            np.ascontiguousarray(scaled_residual[:, :, None]),
            linear_trial.trial.used,
            self._initial_covariance,
            np.zeros((len(self._initial_covariance), 1)),
            True,
        )

    @property
    def missing_force_deviations(self) -> dict[int, FloatArray]:
        """The posterior standard deviation (F,) of the missing force at each port, by its index."""
        return self.missing_forces(np.sqrt(self.smoothed_state_variances()))

    def forces_of_residual(self, residual: FloatArray) -> dict[int, FloatArray]:
        """Return the missing force (F,) by port that is estimated from a residual (N, C)."""
        return self.missing_forces(self.smooth_residual(residual))

    def missing_forces(self, states: FloatArray) -> dict[int, FloatArray]:
        """Return the missing force (F,) at each port, given scaled states (F, n).

        Given standard deviations of the states, it is the standard deviation of that force. The
        unit is N, N m or the port's flow.
        """
        forces = {}
        for (port, process), index in zip(
            self.processes.items(), self.force_states.force_state_indices, strict=True
        ):
            forces[port] = states[:, index] * process.standard_deviation
        return forces


@dataclass(frozen=True, eq=False)
class SmoothedTrial:
    """The motion and the forces of a trial, given all of its readings.

    Attributes
    ----------
    trial : PortedTrial or TrialAtRest
        The linear trial with ports.
    trajectory : Trajectory
        The smoothed motion, and all forces at ports.
    missing_forces : mapping of int to (F,) ndarray
        The missing force at each port, which no law explains, by the index of the port [N, N m or
        the port's flow].
    effect_forces : mapping of int to (F,) ndarray
        The forces of the hypothesis' effects, by port, along the trajectory about which they are
        linear. They are not those along the smoothed motion, which differs little: where dry
        friction changes its sign, its linear law exceeds the friction itself.
    local : (L,) ndarray
        The unknowns of this trial alone.
    """

    trial: LinearTrial
    trajectory: Trajectory
    missing_forces: Mapping[int, FloatArray]
    effect_forces: Mapping[int, FloatArray]
    local: FloatArray

    @cached_property
    def lacking_forces(self) -> dict[int, FloatArray]:
        """The forces (F,) that the model lacks, by port: those of effects, and missing ones."""
        forces = dict(self.missing_forces)
        for port, force in self.effect_forces.items():
            forces[port] = forces.get(port, 0.0) + force
        return forces

    @cached_property
    def explained_trajectory(self) -> Trajectory:
        """The trajectory minus what the missing forces, which no law explains, add to it."""
        return self.trial.trajectory_without(self.trajectory, self.missing_forces)
