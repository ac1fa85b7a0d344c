"""A trial, linear along a trajectory, with the laws of a hypothesis and missing forces.

The state s of a trial is what forces at ports add to the response of the linear model. With the
forces G of the hypothesis' laws, the missing forces f (Gaussian processes in time) and the unknowns
w, it obeys

    s' = A(w) s - sum_p b_p (G_p(x, v; w) + f_p),
    reading = r(w) + C(w) s - sum_p e_p (G_p(x, v; w) + f_p) + noise.

Here x and v are the position and the speed of port p, and r is the reading of the linear model. All
of it is linearised along a trajectory. The state is then the sum of two parts: a known one, which
is linear in the weights (1, unknowns) and computed here, and a random one, which the missing forces
add (see `filtered`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.trials_in_motion.trial import PortedTrial

from .kernel import respond_to_drift, substep_matrices_with_laws
from .linear_about_trajectory import CONSTANT, LinearAboutTrajectory


@dataclass(frozen=True, eq=False)
class LinearisedTrial(LinearAboutTrajectory):
    """A trial, linear along a trajectory, with the part of its state that the weights determine.

    The unknowns are the K shared ones, the E ones of the hypothesis' effects, and those of the
    trial alone, in this order. Shapes: F fine stamps, N samples, C channels, n states of the
    structure, W weights (one, then all unknowns), L ports with a law of the hypothesis.

    Attributes
    ----------
    trial : PortedTrial
        The trial with its residuals, its linear system, and the motion of its ports.
    """

    trial: PortedTrial

    @cached_property
    def law_ports(self) -> tuple[int, ...]:
        """The numbers of the L ports at which a law of the hypothesis acts."""
        return tuple(self.forces)

    # ------------------------------------------------------------ forces of the laws

    @cached_property
    def force_by_state(self) -> FloatArray:
        """The derivatives (F, L, n) of the laws' force at each port by the structure's state."""
        system = self.trial.system
        derivatives = np.zeros(
            (len(self.trial.fine_time), len(self.law_ports), len(system.generator))
        )
        for row, port in enumerate(self.law_ports):
            law = self.forces[port].law_force
            derivatives[:, row] = (
                law.by_position[:, None] * system.positions[port]
                + law.by_speed[:, None] * system.speeds[port]
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
                present_value = self.shared_and_effect[unknown_index]
                force_coefficients[:, row, CONSTANT] -= present_value * derivative
        return force_coefficients

    @cached_property
    def state_rate_by_force(self) -> FloatArray:
        """The rate (n, L) of the structure's state under a unit force at each port with a law."""
        # a force acts against the motion: s' = A s - b force, see `PortedSystem`
        actions = self.trial.system.actions[list(self.law_ports)]
        return np.ascontiguousarray(-actions.T)

    # ------------------------------------------------------------ known part of the state

    @cached_property
    def step_kinds(self) -> IntArray:
        """The kind (F,) of the step that leads to each fine stamp, see `kernel`.

        With a law each step is of its own kind; else all steps of one length are of one kind.
        """
        stamp_count = len(self.trial.fine_time)
        if self.law_ports:
            kinds = np.arange(-1, stamp_count - 1)
        else:
            kinds = self.interval_of_stamp.copy()
            kinds[0] = -1
        return kinds

    @cached_property
    def interval_of_stamp(self) -> IntArray:
        """The index (F,) of the length of the interval that ends at or after each fine stamp."""
        stamps = np.arange(len(self.trial.fine_time))
        _, interval_of_sample = self.trial.intervals
        return interval_of_sample[(stamps + self.trial.substeps - 1) // self.trial.substeps]

    @cached_property
    def known_states(self) -> FloatArray:
        """The n states (F, n, W) at the fine stamps, by the weights, without missing forces.

        The states are linear in the W weights, which are one and the unknowns: entry w is what a
        unit of weight w adds. It is the response to the forces of the laws, and to the parameters
        that change the linear system.
        """
        trial = self.trial
        matrices = trial.substep_matrices
        drifts = self._drift_by_system_parameters(
            matrices.by_input_at_begin, matrices.by_input_at_end
        )
        transitions = matrices.transitions
        if self.law_ports:
            # `drifts` is changed in place: the drift by the laws is added to it
            transitions, _ = substep_matrices_with_laws(
                trial.substeps,
                trial.intervals.length_of_sample,
                transitions,
                np.zeros_like(transitions),
                np.ascontiguousarray(matrices.by_input_at_begin @ self.state_rate_by_force),
                np.ascontiguousarray(matrices.by_input_at_end @ self.state_rate_by_force),
                self.force_by_state,
                self.force_by_weight,
                drifts,
            )
        return respond_to_drift(self.step_kinds, transitions, drifts, self._known_state_at_start())

    def _known_state_at_start(self) -> FloatArray:
        """Return the state (n, W) at the first sample for a unit of each weight."""
        trial = self.trial
        rate = np.zeros((len(trial.system.generator), self.weight_count))
        if not trial.begins_at_rest:
            return rate
        # At rest the rate is zero. With the laws' force T s + u, its effect B on the rate, and the
        # rate r by parameters of the linear system, (A + B T) s + B u + r = 0.
        rate += self.state_rate_by_force @ self.force_by_weight[0]
        for unknown_index, rate_change in self._rate_by_system_parameters.items():
            rate[:, 1 + unknown_index] += rate_change[0]
            rate[:, CONSTANT] -= trial.linearisation_point[unknown_index] * rate_change[0]
        return np.asarray(np.linalg.lstsq(self.rate_matrix_at_start, -rate, rcond=1e-12)[0])

    @cached_property
    def rate_matrix_at_start(self) -> FloatArray:
        """The matrix (n, n) from the state to its rate at the first sample, laws included [1/s]."""
        return np.asarray(
            self.trial.system.generator + self.state_rate_by_force @ self.force_by_state[0]
        )

    @cached_property
    def _rate_by_system_parameters(self) -> dict[int, FloatArray]:
        """The derivatives (F, n) of A s - sum_p b_p force_p by parameters, along the trajectory."""
        derivatives = {}
        for unknown_index, derivative in enumerate(self.trial.system_derivatives):
            if derivative is None:
                continue
            rate_change = self.trajectory.added_state @ derivative.generator.T
            for port, force in self.trajectory.forces.items():
                rate_change = rate_change - np.outer(force, derivative.actions[port])
            derivatives[unknown_index] = rate_change
        return derivatives

    def _drift_by_system_parameters(
        self, by_input_at_begin: FloatArray, by_input_at_end: FloatArray
    ) -> FloatArray:
        """Return the drift (F - 1, n, W) by parameters that change the linear system itself.

        Parameters
        ----------
        by_input_at_begin, by_input_at_end : (J, n, n) array
            The change of the state over a substep for a unit input at its start, or at its end,
            for each of the J lengths of intervals.
        """
        trial = self.trial
        step_count = len(trial.fine_time) - 1
        drift = np.zeros((step_count, len(trial.system.generator), self.weight_count))
        interval_of_substep = self.interval_of_stamp[1:]
        for unknown_index, rate_change in self._rate_by_system_parameters.items():
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

    # ------------------------------------------------------------ readings

    @cached_property
    def columns(self) -> FloatArray:
        """The residuals (N, C, W) without missing forces, for a unit of each weight.

        First the readings minus their prediction at zero unknowns, then minus the derivatives of
        the prediction by the unknowns. All are divided by the noise, and zero for a reading that
        does not count.
        """
        trial = self.trial
        columns = self.columns_of_model_and_sensors(self._readings_by_shared_unknowns())
        # the known part of the state is read, and the laws' forces that a sensor shows at once
        known_states = self.known_states[:: trial.substeps]
        outputs_over_noise = trial.system.outputs / trial.deviation[:, None]
        columns -= np.einsum("cn,knw->kcw", outputs_over_noise, known_states)
        columns += self.direct_readings(self.known_forces[:: trial.substeps])
        if self.simulation is not None:
            # The substeps integrate a law to first order. At the values of the simulation the
            # residual is that of the simulation; the derivatives are those along its motion.
            error = self.error_of_columns(columns)
            columns[:, :, CONSTANT] += np.where(self._shows_laws_at_once, 0.0, error)
        return columns * trial.used[:, :, None]

    @property
    def _shows_laws_at_once(self) -> BoolArray:
        """Whether each channel (C,) shows the force of a law at once, as an acceleration does.

        Such a reading jumps where dry friction changes its sign, and at which side of the jump it
        was taken depends on less than a time step.
        """
        return np.asarray(np.any(self.trial.system.through[list(self.law_ports)], axis=0))

    @cached_property
    def known_forces(self) -> FloatArray:
        """The laws' force (F, L, W) at each port without missing forces, for each weight."""
        return np.asarray(self.force_by_weight + self.force_by_state @ self.known_states)

    def direct_readings(self, law_forces: FloatArray) -> FloatArray:
        """Return by how much laws' forces lower the readings at once, as those of accelerations.

        Parameters
        ----------
        law_forces : (N, L, M) array
            M series of forces at the samples and at the L ports with a law.

        Returns
        -------
        (N, C, M) array
            The decrease of the readings, divided by the noise.
        """
        direct = self.trial.system.through[list(self.law_ports)] / self.trial.deviation
        return np.asarray(np.einsum("lc,klm->kcm", direct, law_forces))

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
