"""A trial, linear along a trajectory, with the laws of a hypothesis and missing forces.

The state s of a trial is what forces at ports add to the response of the linear model. With the
forces G of the hypothesis' laws, the missing forces f (Gaussian processes in time) and the unknowns
w, it obeys

    s' = A(w) s - sum_p b_p (G_p(x, v; w) + f_p),
    reading = r(w) + C(w) s - sum_p e_p (G_p(x, v; w) + f_p) + noise.

Here x and v are the position and the speed of port p, and r is the reading of the linear model. All
of it is linearised along a trajectory. A weight is a factor of a column of the linear model: the
first weight is one, that of the constant part, and the others are the unknowns.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray, IntArray
from discrepancy.missing_force.filtered import ForceFilter, Process
from discrepancy.missing_force.kalman import discretise, respond_to_inputs
from discrepancy.missing_force.trial import PortedTrial

from .kernel import filter_record, smooth_record, substep_matrices_with_laws
from .trajectory import LinearisedForce, LinearisedSensorErrors, Trajectory

CONSTANT = 0
"""Number of the constant among the weights (1, unknowns)."""


@dataclass(frozen=True, eq=False)
class LinearisedTrial:
    """A trial, linear along a trajectory.

    The unknowns are the K shared ones, the E ones of the hypothesis' effects, and those of the
    trial alone, in this order. Shapes: F fine stamps, N samples, C channels, n states, W weights
    (one, then all unknowns), L ports with a law of the hypothesis.

    Attributes
    ----------
    trial : PortedTrial
        The trial with its residuals, its linear system, and the motion of its ports.
    processes : mapping of int to Process
        The missing forces, by the number of the port.
    trajectory : Trajectory
        The trajectory along which it is linear.
    forces : mapping of int to LinearisedForce
        The forces of the hypothesis' laws, by port.
    sensor_errors : LinearisedSensorErrors
        The changes of readings by the hypothesis' effects of sensors.
    effect : (E,) ndarray
        The values of the effects' unknowns at which laws and sensors are linearised.
    shared : (K,) ndarray
        The values of the shared unknowns at which they are linearised.
    """

    trial: PortedTrial
    processes: Mapping[int, Process]
    trajectory: Trajectory
    forces: Mapping[int, LinearisedForce]
    sensor_errors: LinearisedSensorErrors
    effect: FloatArray
    shared: FloatArray

    # ------------------------------------------------------------ layout

    @cached_property
    def force_filter(self) -> ForceFilter:
        """The linear system with its missing forces, scaled so that its states are of size one."""
        return ForceFilter(self.trial, tuple(self.processes.items()))

    @property
    def structure(self) -> slice:
        """The indices of the structure's states, which come before missing forces and noises."""
        return slice(0, len(self.trial.system.generator))

    @property
    def weight_count(self) -> int:
        """The number W of weights: the first is one, the others are the unknowns."""
        return 1 + len(self.shared) + len(self.effect) + len(self.trial.local_derivatives)

    def weight_index(self, unknown_index: int) -> int:
        """Return where an unknown that is no effect parameter stands among the weights.

        Parameters
        ----------
        unknown_index : int
            The number of the unknown in `PortedTrial.linearisation_point`, where those of the trial
            alone follow the shared ones. In the weights, those of effects stand between both.
        """
        shared_count = len(self.shared)
        return 1 + unknown_index + (len(self.effect) if unknown_index >= shared_count else 0)

    @cached_property
    def law_ports(self) -> tuple[int, ...]:
        """The numbers of the L ports at which a law of the hypothesis acts."""
        return tuple(self.forces)

    # ------------------------------------------------------------ forces of the laws

    @cached_property
    def force_by_state(self) -> FloatArray:
        """The derivatives (F, L, n) of the laws' force at each port by the scaled state."""
        state_count = len(self.force_filter.state_space.generator)
        derivatives = np.zeros((len(self.trial.fine_time), len(self.law_ports), state_count))
        system = self.trial.system
        units = self.force_filter.state_units
        for row, port in enumerate(self.law_ports):
            law = self.forces[port].law_force
            derivatives[:, row, self.structure] = (
                law.by_position[:, None] * system.positions[port] * units
                + law.by_speed[:, None] * system.speeds[port] * units
            )
        return derivatives

    @cached_property
    def force_by_weight(self) -> FloatArray:
        """The coefficients (F, L, W) of the laws' force at each port in the weights [N or N m].

        The weights are (1, unknowns). The laws are linear about the trajectory and about values u0
        of the unknowns, so that their force is

            f = force_by_weight @ (1, u) + force_by_state @ state.

        Each derivative d by an unknown contributes d (u - u0): d is the coefficient of the unknown,
        and -d u0 is added to the constant, which is the coefficient of the first weight.
        """
        trial = self.trial
        trajectory = self.trajectory
        force_coefficients = np.zeros(
            (len(trial.fine_time), len(self.law_ports), self.weight_count)
        )
        for row, port in enumerate(self.law_ports):
            law = self.forces[port].law_force
            # motion of the model's response (state zero), minus that of the trajectory
            position_offset = trial.port_positions[:, port] - trajectory.positions[:, port]
            speed_offset = trial.port_speeds[:, port] - trajectory.speeds[:, port]
            # unknowns that change the motion of the ports: their part of the motion is removed from
            # the offsets, which are then at zero unknowns
            for unknown_index, (positions, speeds) in trial.port_motion_derivatives.items():
                present_value = trial.linearisation_point[unknown_index]
                position_offset = position_offset - present_value * positions[:, port]
                speed_offset = speed_offset - present_value * speeds[:, port]
                force_coefficients[:, row, self.weight_index(unknown_index)] += (
                    law.by_position * positions[:, port] + law.by_speed * speeds[:, port]
                )
            # the first weight: the force at zero unknowns
            force_coefficients[:, row, CONSTANT] = (
                law.force + law.by_position * position_offset + law.by_speed * speed_offset
            )
            # unknowns that change the laws; `law.force` is the force at u0
            for unknown_index, derivative in self.forces[port].by_unknown.items():
                force_coefficients[:, row, 1 + unknown_index] += derivative
                present_value = self._value_of_unknown(unknown_index)
                force_coefficients[:, row, CONSTANT] -= present_value * derivative
        return force_coefficients

    def _value_of_unknown(self, unknown_index: int) -> float:
        """Return the value of an unknown, shared or of an effect, about which laws are linear."""
        return float(np.concatenate((self.shared, self.effect))[unknown_index])

    @cached_property
    def state_rate_by_force(self) -> FloatArray:
        """The rate (n, L) of the scaled state by a unit force at each port with a law."""
        state_count = len(self.force_filter.state_space.generator)
        rates = np.zeros((state_count, len(self.law_ports)))
        # a force acts against the motion: s' = A s - b force, see `PortedSystem`
        for row, port in enumerate(self.law_ports):
            rates[self.structure, row] = (
                -self.trial.system.actions[port] / self.force_filter.state_units
            )
        return rates

    # ------------------------------------------------------------ steps

    def _substep_matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return transitions, process noises and drifts of all substeps, the laws included.

        n is the number of states, F that of fine stamps, and W that of weights: one, then the
        unknowns.

        Returns
        -------
        transitions, noises : (F - 1, n, n) array
            The transition of each substep, and the covariance of its process noise.
        drifts : (F - 1, n, W) array
            The state that a unit of each weight adds in each substep.
        """
        state_space = self.force_filter.state_space
        lengths, interval_of_sample = self.trial.intervals
        substep_lengths = lengths / self.trial.substeps
        free_transition, free_noise = discretise(
            state_space.generator, state_space.intensity, substep_lengths
        )
        _, by_input_at_begin, by_input_at_end = respond_to_inputs(
            state_space.generator, substep_lengths
        )
        drifts = self._drift_by_system_parameters(
            by_input_at_begin, by_input_at_end, interval_of_sample
        )
        # `drifts` is changed in place: the drift by the laws is added to it
        transitions, noises = substep_matrices_with_laws(
            self.trial.substeps,
            interval_of_sample,
            free_transition,
            free_noise,
            np.ascontiguousarray(by_input_at_begin @ self.state_rate_by_force),
            np.ascontiguousarray(by_input_at_end @ self.state_rate_by_force),
            self.force_by_state,
            self.force_by_weight,
            drifts,
        )
        return transitions, noises, drifts

    def _drift_by_system_parameters(
        self,
        by_input_at_begin: FloatArray,
        by_input_at_end: FloatArray,
        interval_of_sample: IntArray,
    ) -> FloatArray:
        """Return the drift (F - 1, n, W) by parameters that change the linear system itself.

        Parameters
        ----------
        by_input_at_begin, by_input_at_end : (K, n, n) array
            The change of the state over a substep for a unit input at its start, or at its end,
            for each of the K lengths of intervals.
        interval_of_sample : (N,) array of int
            The index of the length of the interval that ends at each sample.
        """
        trial = self.trial
        structure = self.structure
        step_count = len(trial.fine_time) - 1
        drift = np.zeros((step_count, len(by_input_at_begin[0]), self.weight_count))
        by_input_at_begin = by_input_at_begin[:, :, structure]
        by_input_at_end = by_input_at_end[:, :, structure]
        interval_of_substep = interval_of_sample[np.arange(step_count) // trial.substeps + 1]
        for unknown_index, derivative in enumerate(trial.system_derivatives):
            if derivative is None:
                continue
            # derivative of A s - sum_p b_p force_p by the parameter, along the trajectory
            rate_change = self.trajectory.added_state @ derivative.generator.T
            for port, force in self.trajectory.forces.items():
                rate_change = rate_change - np.outer(force, derivative.actions[port])
            rate_change = rate_change / self.force_filter.state_units
            state_change = _change_over_substeps(
                by_input_at_begin, interval_of_substep, rate_change[:-1]
            )
            state_change += _change_over_substeps(
                by_input_at_end, interval_of_substep, rate_change[1:]
            )
            # linear about u0 = `linearisation_point`: the change is proportional to u - u0
            drift[:, :, 1 + unknown_index] += state_change
            present_value = trial.linearisation_point[unknown_index]
            drift[:, :, CONSTANT] -= present_value * state_change
        return drift

    def _initial_state(self) -> tuple[FloatArray, FloatArray]:
        """Return covariance (n, n) and mean (n, W) of the state before the first reading.

        The mean has one column for each weight.
        """
        generator = self.force_filter.state_space.generator
        covariance = self.force_filter.state_space.initial_covariance
        mean = np.zeros((len(generator), self.weight_count))
        if not self.trial.begins_at_rest:
            return covariance, mean
        # At rest the rate of the structure's state s is zero under the laws and the missing forces
        # f. With the laws' force T s + u and its effect B on the rate,
        #     (A + B T) s + B u + a f = 0,  a: the column of the generator A for f.
        # The solution for u is the mean. The first value of f is not known and has variance one, so
        # that its solution s = h f adds h h^T to the covariance.
        structure = self.structure
        state_rate_by_force = self.state_rate_by_force[structure]
        rate_matrix = (
            generator[structure, structure]
            + state_rate_by_force @ self.force_by_state[0][:, structure]
        )
        mean[structure] = np.linalg.lstsq(
            rate_matrix, -state_rate_by_force @ self.force_by_weight[0], rcond=1e-12
        )[0]
        covariance = covariance.copy()
        covariance[structure, structure] = 0.0
        for index in self.force_filter.force_state_indices:
            state_per_force = np.linalg.lstsq(
                rate_matrix, -generator[structure, index], rcond=1e-12
            )[0]
            covariance[structure, structure] += np.outer(state_per_force, state_per_force)
            covariance[structure, index] = state_per_force
            covariance[index, structure] = state_per_force
        return covariance, mean

    # ------------------------------------------------------------ readings

    def _observations(self) -> tuple[FloatArray, FloatArray]:
        """Return the two matrices of the observation equation of the Kalman filter.

        The residual is the reading minus the prediction of the model, and depends on the unknowns
        u. The filter explains the residual by its state, which contains the missing forces, the
        coloured noise, and the change of the structure's motion by forces:

            coefficients @ (1, u) = output_rows @ state + noise.

        The white part of the noise has variance one, since both sides are divided by its standard
        deviation.

        Returns
        -------
        output_rows : (N, C, n) array
            The derivatives of the readings by the state, for N samples, C channels and n states.
        coefficients : (N, C, W) array
            First the residual at zero unknowns, then its derivatives by the W - 1 unknowns. All are
            zero for a reading that does not count.
        """
        trial = self.trial
        noise_scale = self.force_filter.white_noise_scale
        constant_rows = self.force_filter.state_space.output_rows
        output_rows = np.repeat(constant_rows[None], len(trial.residual), axis=0)
        coefficients = np.zeros((*trial.residual.shape, self.weight_count))
        # Errors of sensors change the readings by c0 + d (u - u0), which reduces the residual: -d
        # is added to the coefficient of the unknown u, and -c0 + d u0 to the constant.
        coefficients[:, :, CONSTANT] = trial.residual - self.sensor_errors.change
        for unknown_index, derivative in self.sensor_errors.by_unknown.items():
            present_value = self._value_of_unknown(unknown_index)
            coefficients[:, :, 1 + unknown_index] -= derivative
            coefficients[:, :, CONSTANT] += present_value * derivative
        # The response of the model needs no constant, as `trial.residual` is at zero unknowns. The
        # unknowns of this trial follow the shared ones here; in u those of effects are between.
        derivatives = np.concatenate((trial.shared_derivatives, trial.local_derivatives))
        for unknown_index, derivative in enumerate(derivatives):
            coefficients[:, :, self.weight_index(unknown_index)] -= derivative
        # parameters and gains change the readings of a fixed state by d (u - u0)
        for unknown_index, derivative in self._readings_by_shared_unknowns().items():
            present_value = trial.linearisation_point[unknown_index]
            coefficients[:, :, 1 + unknown_index] -= derivative
            coefficients[:, :, CONSTANT] += present_value * derivative
        coefficients *= noise_scale[:, None]
        # A force at a port changes some readings at once, such as accelerations: by -e per unit of
        # force, with e in `direct_reading`. The force of the hypothesis' laws at the port is
        # force_by_weight @ (1, u) + force_by_state @ state. Its first term is brought to the left
        # side of the observation equation, which turns the sign.
        for law_index, port in enumerate(self.law_ports):
            direct_reading = trial.system.through[port] / trial.deviation * noise_scale
            if not np.any(direct_reading):
                continue
            force_by_state = self.force_by_state[:: trial.substeps, law_index]
            force_by_weight = self.force_by_weight[:: trial.substeps, law_index]
            output_rows = output_rows - direct_reading[:, None] * force_by_state[:, None, :]
            coefficients += force_by_weight[:, None, :] * direct_reading[:, None]
        return np.ascontiguousarray(output_rows), coefficients * trial.used[:, :, None]

    def _readings_by_shared_unknowns(self) -> dict[int, FloatArray]:
        """Return the derivatives (N, C) of the readings by shared unknowns at a fixed added state.

        They are divided by the noise. The shared unknowns are parameters that change the output
        equation, and gains of channels.
        """
        trial = self.trial
        trajectory = self.trajectory
        derivatives: dict[int, FloatArray] = {}
        # parameters change the matrices of the output equation
        for unknown_index, derivative in enumerate(trial.system_derivatives):
            if derivative is not None:
                derivatives[unknown_index] = trial.divide_by_noise(
                    trial.outputs_of_state(derivative, trajectory.added_state, trajectory.forces)
                )
        # a gain multiplies the readings of its channel
        added_readings = trial.readings_of_state(trajectory.added_state, trajectory.forces)
        for unknown_index, channel, scale in trial.gain_unknowns:
            derivatives[unknown_index] = (
                added_readings * scale * np.eye(added_readings.shape[1])[channel]
            )
        return derivatives

    # ------------------------------------------------------------ filter and smoother

    @cached_property
    def filtered_record(self) -> "FilteredRecord":
        """The results of one pass of the Kalman filter."""
        transitions, noises, drifts = self._substep_matrices()
        output_rows, columns = self._observations()
        covariance, mean = self._initial_state()
        means, covariances, innovations, gains, variances = filter_record(
            self.trial.substeps,
            transitions,
            noises,
            drifts,
            output_rows,
            columns,
            self.trial.used,
            covariance,
            mean,
        )
        return FilteredRecord(
            transitions=transitions,
            output_rows=output_rows,
            means=means,
            covariances=covariances,
            innovations=innovations,
            gains=gains,
            variances=variances,
        )

    @cached_property
    def whitened_products(self) -> tuple[FloatArray, float]:
        """The inner products (W, W) of the whitened columns, and half a log determinant [nat].

        The columns are the residual and its derivatives by the unknowns. The determinant is that of
        the covariance of the readings: the product of their variances, each given those before it.
        """
        record = self.filtered_record
        whitened_columns = record.innovations / np.sqrt(record.variances)[:, :, None]
        whitened_columns = whitened_columns.reshape(-1, self.weight_count)
        # the columns of `_observations` are minus the derivatives of the readings: change the sign
        whitened_columns[:, 1:] *= -1.0
        is_used = self.trial.used
        half_log_determinant = 0.5 * float(np.sum(np.log(record.variances)[is_used]))
        # readings were multiplied by `white_noise_scale`, and their deviations with them
        half_log_determinant -= float(np.sum(np.log(self.force_filter.white_noise_scale) * is_used))
        return whitened_columns.T @ whitened_columns, half_log_determinant

    def smooth(self, unknowns: FloatArray) -> "SmoothedTrial":
        """Return the smoothed trajectory and forces of the trial, given all readings.

        Parameters
        ----------
        unknowns : (W - 1,) ndarray
            The values of all unknowns.
        """
        trial = self.trial
        record = self.filtered_record
        weights = np.concatenate(([1.0], unknowns))
        states, variance = smooth_record(
            trial.substeps,
            record.transitions,
            record.output_rows,
            trial.used,
            record.means @ weights,
            record.covariances,
            record.innovations @ weights,
            record.gains,
            record.variances,
        )
        # the states of the structure and of the missing forces, in their units
        added_state = states[:, self.structure] * self.force_filter.state_units
        state_deviation = np.sqrt(variance[:, self.structure]) * self.force_filter.state_units
        missing_forces: dict[int, FloatArray] = {}
        deviations: dict[int, FloatArray] = {}
        for (port, process), index in zip(
            self.processes.items(), self.force_filter.force_state_indices, strict=True
        ):
            missing_forces[port] = states[:, index] * process.standard_deviation
            deviations[port] = np.sqrt(variance[:, index]) * process.standard_deviation
        # forces of the laws, at each fine stamp f by the states n there
        law_forces: dict[int, FloatArray] = {}
        forces = dict(missing_forces)
        for row, port in enumerate(self.law_ports):
            force_by_states = np.einsum("fn,fn->f", self.force_by_state[:, row], states)
            law_forces[port] = self.force_by_weight[:, row] @ weights + force_by_states
            forces[port] = forces.get(port, 0.0) + law_forces[port]
        # motion of the ports
        shared_values = unknowns[: len(self.shared)]
        local_values = unknowns[len(self.shared) + len(self.effect) :]
        positions, speeds = trial.port_motion(
            np.concatenate((shared_values, local_values)), added_state
        )
        trajectory = Trajectory(added_state, positions, speeds, forces)
        return SmoothedTrial(
            trajectory=trajectory,
            missing_forces=missing_forces,
            law_forces=law_forces,
            missing_force_deviations=deviations,
            state_deviation=state_deviation,
        )


@dataclass(frozen=True, eq=False)
class FilteredRecord:
    """The results of one pass of the filter over a trial.

    Attributes
    ----------
    transitions : (F - 1, n, n) ndarray
        The transition of each substep.
    output_rows : (N, C, n) ndarray
        The readings for a unit of each state.
    means, covariances : (F, n, W), (F, n, n) ndarray
        The predicted state at each fine stamp; its mean is that for a unit of each weight.
    innovations : (N, C, W) ndarray
        The readings minus their predictions, for a unit of each weight.
    gains, variances : (N, C, n), (N, C) ndarray
        The gain of each reading, and the variance of its innovation.
    """

    transitions: FloatArray
    output_rows: FloatArray
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
    missing_forces : mapping of int to (F,) ndarray
        The missing force at each port, which no law explains, by the number of the port [N or N m].
    law_forces : mapping of int to (F,) ndarray
        The force of the laws at each port, linear about the previous trajectory.
    missing_force_deviations : mapping of int to (F,) ndarray
        The posterior standard deviation of `missing_forces`.
    state_deviation : (F, n) ndarray
        The posterior standard deviation of the added state.
    """

    trajectory: Trajectory
    missing_forces: Mapping[int, FloatArray]
    law_forces: Mapping[int, FloatArray]
    missing_force_deviations: Mapping[int, FloatArray]
    state_deviation: FloatArray


def _change_over_substeps(
    by_input: FloatArray, interval_of_substep: IntArray, rates: FloatArray
) -> FloatArray:
    """Return the change (J, n) of the state over each of J substeps by an input to its rate.

    Parameters
    ----------
    by_input : (K, n, s) array
        The change for a unit of the input to each of s states, for K lengths of substeps.
    interval_of_substep : (J,) array of int
        The index of the length of each substep.
    rates : (J, s) array
        The input in each substep.
    """
    if len(by_input) == 1:  # nearly all records: no matrix needs to be copied for each substep
        return np.asarray(rates @ by_input[0].T)
    return np.asarray(np.einsum("jab,jb->ja", by_input[interval_of_substep], rates))
