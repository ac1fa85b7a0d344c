"""A trial at rest, linear about its positions, with the laws of a hypothesis and missing forces.

At each load step, the ports are at x and the readings are y. With the forces G of the hypothesis'
laws, the missing forces f and the unknowns w, they obey

    h = G(x; w) + f,    x = x_m(w) - C h,    y = r(w) - E h + noise.

Here x_m and r are position and reading of the linear model, C its compliance and E the readings by
unit forces. With laws that are linear about given positions, h is linear in w and f, since
x is replaced: (I + T C) h = g + T x_m(w) + f, with the slopes T of the laws. This is the equation
of a trial in motion without time (see `linearised`).

A force that is missing in motion is missing at rest, too. It has the same standard deviation, and
is independent from one load step to the next: by which displacements its values are related
depends on the law, which is not known.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.trials_in_motion.trial_at_rest import TrialAtRest

from .filtered import SmoothedTrial
from .linear_about_trajectory import CONSTANT, LinearAboutTrajectory
from .process_search import Processes


@dataclass(frozen=True, eq=False)
class LinearisedRest(LinearAboutTrajectory):
    """A trial at rest, linear along its positions; it stands beside `LinearisedTrial`.

    Shapes: N load steps, C channels, P ports, W weights (one, then the K shared unknowns, the E of
    effects, and those of the trial alone).

    Attributes
    ----------
    trial : TrialAtRest
        The trial with its residuals and the compliance of the model.
    """

    trial: TrialAtRest

    @cached_property
    def _position_slopes(self) -> FloatArray:
        """T, the slopes (N, P) of the laws' force at each port by its position."""
        slopes = np.zeros_like(self.trial.response.positions)
        for port, force in self.forces.items():
            slopes[:, port] = force.law_force.by_position
        return slopes

    @cached_property
    def force_by_own_force(self) -> FloatArray:
        """(I + T C)^-1 (N, P, P): the force h at each port by an own force there, laws included."""
        compliance = self.trial.response.compliance
        identity = np.eye(compliance.shape[1])
        return np.asarray(np.linalg.inv(identity + self._position_slopes[:, :, None] * compliance))

    @cached_property
    def positions_by_weight(self) -> FloatArray:
        """The positions of the P ports caused by the model alone, per unit of each of W weights.

        An (N, P, W) array for N load steps. An unknown changes the positions under the loads and,
        as it changes the compliance, those under the forces of the trajectory.
        """
        trial = self.trial
        positions = np.zeros((*trial.response.positions.shape, self.weight_count))
        positions[:, :, CONSTANT] = trial.response.positions
        for unknown_index, derivative in trial.response_derivatives.items():
            change = derivative.positions + trial.added_positions(
                derivative, self.trajectory.forces
            )
            positions[:, :, self.weight_index(unknown_index)] += change
            positions[:, :, CONSTANT] -= trial.linearisation_point[unknown_index] * change
        return positions

    @cached_property
    def force_by_weight(self) -> FloatArray:
        """The force h (N, P, W) at each port without missing forces, for a unit of each weight."""
        forces = self._position_slopes[:, :, None] * self.positions_by_weight
        for port, force in self.forces.items():
            law = force.law_force
            forces[:, port, CONSTANT] += (
                law.force - law.by_position * self.trajectory.positions[:, port]
            )
            for unknown_index, derivative in force.by_unknown.items():
                forces[:, port, 1 + unknown_index] += derivative
                forces[:, port, CONSTANT] -= self.shared_and_effect[unknown_index] * derivative
        return np.asarray(self.force_by_own_force @ forces)

    @cached_property
    def columns(self) -> FloatArray:
        """The residuals (N, C, W) without missing forces, for a unit of each weight.

        First the readings minus their prediction at zero unknowns, then minus the derivatives of
        the prediction with respect to the unknowns. All are divided by the standard deviation of
        the noise, and zero for a reading that does not count.
        """
        trial = self.trial
        columns = self.columns_of_model_and_sensors(self._readings_by_unknowns())
        columns += np.einsum("npc,npw->ncw", trial.response.outputs_by_force, self.force_by_weight)
        if self.simulation is not None:
            # at the values of the simulation, the residual is that of the simulation
            columns[:, :, CONSTANT] += self.error_of_columns(columns)
        return columns * trial.used[:, :, None]

    def _readings_by_unknowns(self) -> dict[int, FloatArray]:
        """Return the derivatives (N, C) of the readings caused by forces, by index of the unknown.

        The unknowns are the parameters and the gains.
        """
        trial = self.trial
        forces = self.trajectory.forces
        derivatives = {
            unknown_index: trial.readings_of_forces(derivative, forces)
            for unknown_index, derivative in trial.response_derivatives.items()
        }
        readings = trial.readings_of_forces(trial.response, forces)
        for unknown_index, channel, scale in trial.gain_unknowns:
            derivatives[unknown_index] = readings * scale * np.eye(readings.shape[1])[channel]
        return derivatives


@dataclass(frozen=True, eq=False)
class RestUnderForces:
    """A trial at rest under given missing forces; it stands beside `FilteredTrial`.

    Attributes
    ----------
    linear_trial : LinearisedRest
        The trial, linear along its positions.
    processes : mapping of int to Process
        The missing forces, by the index of the port.
    """

    linear_trial: LinearisedRest
    processes: Processes

    @cached_property
    def _deviations(self) -> FloatArray:
        """The standard deviation (M,) of the missing force at each of M ports."""
        return np.array([process.standard_deviation for process in self.processes.values()])

    @cached_property
    def _residual_by_force(self) -> FloatArray:
        """The residuals (N, C, M) by missing forces of one standard deviation."""
        linear_trial = self.linear_trial
        own_forces = linear_trial.force_by_own_force[:, :, list(self.processes)]
        outputs_by_force = linear_trial.trial.response.outputs_by_force
        own_forces = own_forces * self._deviations
        return np.asarray(np.einsum("npc,npm->ncm", outputs_by_force, own_forces))

    @cached_property
    def _factor(self) -> FloatArray:
        """The Cholesky factor (N, C, C) of the covariance of the residuals."""
        by_force = self._residual_by_force
        covariance = np.eye(by_force.shape[1]) + by_force @ np.swapaxes(by_force, 1, 2)
        return np.asarray(np.linalg.cholesky(covariance))

    @cached_property
    def whitened_products(self) -> tuple[FloatArray, float]:
        """The inner products (W, W) of the whitened columns, and half a log determinant [nat].

        As those of `FilteredTrial`: the columns are the residual and its derivatives with respect
        to the unknowns, the determinant is that of the covariance of the readings.
        """
        columns = self.linear_trial.columns
        whitened_columns = np.linalg.solve(self._factor, columns).reshape(-1, columns.shape[-1])
        # the columns are minus the derivatives of the prediction: change the sign
        whitened_columns[:, 1:] *= -1.0
        diagonals = np.diagonal(self._factor, axis1=1, axis2=2)
        return whitened_columns.T @ whitened_columns, float(np.sum(np.log(diagonals)))

    @cached_property
    def _whitened_by_force(self) -> FloatArray:
        """The whitened residuals (N, C, M) by missing forces of one standard deviation."""
        return np.asarray(np.linalg.solve(self._factor, self._residual_by_force))

    def forces_of_residual(self, residual: FloatArray) -> dict[int, FloatArray]:
        """Return the missing force (N,) by port that is estimated from a residual (N, C)."""
        # With the residual r = B f + noise and f in standard deviations, its mean is
        # B^T (I + B B^T)^-1 r.
        whitened = np.linalg.solve(self._factor, residual[:, :, None])[:, :, 0]
        forces = np.einsum("ncm,nc->nm", self._whitened_by_force, whitened) * self._deviations
        return dict(zip(self.processes, forces.T, strict=True))

    @property
    def missing_force_deviations(self) -> dict[int, FloatArray]:
        """The posterior standard deviation (N,) of the missing force at each port, by its index."""
        explained_shares = np.sum(self._whitened_by_force**2, axis=1)
        deviations = self._deviations * np.sqrt(np.maximum(1.0 - explained_shares, 0.0))
        return dict(zip(self.processes, deviations.T, strict=True))

    def smooth(self, unknowns: FloatArray) -> SmoothedTrial:
        """Return the positions and forces of the trial at values of the unknowns."""
        linear_trial = self.linear_trial
        trial = linear_trial.trial
        weights = np.concatenate(([1.0], unknowns))
        missing_forces = self.forces_of_residual(linear_trial.columns @ weights)
        missing = np.column_stack([*missing_forces.values()])
        own_forces = linear_trial.force_by_own_force[:, :, list(self.processes)]
        forces = linear_trial.force_by_weight @ weights
        forces = forces + np.einsum("npm,nm->np", own_forces, missing)
        positions = linear_trial.positions_by_weight @ weights
        positions = positions - np.einsum("npq,nq->np", trial.response.compliance, forces)
        acting_ports = {*linear_trial.forces, *self.processes}
        return SmoothedTrial(
            trial=trial,
            trajectory=trial.trajectory_at(
                positions, {port: forces[:, port] for port in acting_ports}
            ),
            missing_forces=missing_forces,
            effect_forces=linear_trial.effect_forces,
            local=unknowns[len(linear_trial.shared) + len(linear_trial.effect) :],
        )
