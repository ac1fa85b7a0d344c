"""What trials in motion and at rest have in common when they are linear about a trajectory."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.trials_in_motion.trajectory import (
    LinearisedForce,
    LinearisedSensorErrors,
    Trajectory,
)
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

CONSTANT = 0
"""Index of the constant among the weights (1, unknowns)."""


class Simulation(NamedTuple):
    """A trial as simulated under laws alone, without missing forces.

    Attributes
    ----------
    local : (L,) ndarray
        The values of the unknowns of the trial alone.
    residual : (N, C) ndarray
        The readings minus the prediction, divided by the noise.
    """

    local: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class LinearAboutTrajectory:
    """A trial whose laws and readings are linear about a trajectory and values of the unknowns.

    The unknowns are the K shared ones, the E ones of the hypothesis' effects, and those of the
    trial alone, in this order. The W weights are one, then all unknowns.

    Attributes
    ----------
    trial : PortedTrial or TrialAtRest
        The trial with its residuals, and the motion of its ports by the model.
    trajectory : Trajectory
        The trajectory about which it is linear.
    forces : mapping of int to LinearisedForce
        The forces of all laws, by the index of the port.
    sensor_errors : LinearisedSensorErrors
        The changes of readings caused by the errors of sensors in the hypothesis.
    effect, shared : (E,), (K,) ndarray
        The values of the unknowns of effects, and of the shared ones, at which laws and sensors are
        linear.
    simulation : Simulation or None
        The trial as simulated with these values, along whose motion it is linear.
    """

    trial: LinearTrial
    trajectory: Trajectory
    forces: Mapping[int, LinearisedForce]
    sensor_errors: LinearisedSensorErrors
    effect: FloatArray
    shared: FloatArray
    simulation: Simulation | None = None

    @property
    def weight_count(self) -> int:
        """The number W of weights: the first is one, the others are the unknowns."""
        return 1 + len(self.shared) + len(self.effect) + len(self.trial.local_derivatives)

    def weight_index(self, unknown_index: int) -> int:
        """Return the index among the weights of an unknown that is no effect parameter.

        Its given index is that in `linearisation_point` of the trial, where the unknowns of the
        trial alone follow the shared ones. In the weights, those of effects are between both.
        """
        is_local = unknown_index >= len(self.shared)
        return 1 + unknown_index + (len(self.effect) if is_local else 0)

    @property
    def shared_and_effect(self) -> FloatArray:
        """The values (K + E,) of the unknowns about which laws and sensors are linear."""
        return np.concatenate((self.shared, self.effect))

    @property
    def effect_forces(self) -> dict[int, FloatArray]:
        """The forces (F,) of the hypothesis' effects along the trajectory, by port."""
        return {port: force.law_force.force - force.by_model for port, force in self.forces.items()}

    def columns_of_model_and_sensors(
        self, readings_by_unknown: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return the residuals (N, C, W) without the forces of laws, for a unit of each weight.

        They are the readings minus the response of the model, with the errors of sensors.

        Parameters
        ----------
        readings_by_unknown : mapping of int to (N, C) array
            The derivatives of the readings caused by the forces of the trajectory, with respect to
            parameters and gains, by the index of the unknown in `linearisation_point`.
        """
        trial = self.trial
        columns = np.zeros((*trial.residual.shape, self.weight_count))
        # Errors of sensors change the readings by c0 + d (u - u0), which reduces the residual: -d
        # is added to the coefficient of the unknown u, and -c0 + d u0 to the constant.
        columns[:, :, CONSTANT] = trial.residual - self.sensor_errors.change
        for unknown_index, derivative in self.sensor_errors.by_unknown.items():
            columns[:, :, 1 + unknown_index] -= derivative
            columns[:, :, CONSTANT] += self.shared_and_effect[unknown_index] * derivative
        # the response of the model needs no constant, as `trial.residual` is at zero unknowns
        derivatives = np.concatenate((trial.shared_derivatives, trial.local_derivatives))
        for unknown_index, derivative in enumerate(derivatives):
            columns[:, :, self.weight_index(unknown_index)] -= derivative
        # parameters and gains change the readings of given forces by d (u - u0)
        for unknown_index, derivative in readings_by_unknown.items():
            columns[:, :, self.weight_index(unknown_index)] -= derivative
            columns[:, :, CONSTANT] += trial.linearisation_point[unknown_index] * derivative
        return columns

    def error_of_columns(self, columns: FloatArray) -> FloatArray:
        """Return the residuals (N, C) of the simulation minus those of columns at its values."""
        assert self.simulation is not None
        weights = np.concatenate(([1.0], self.shared_and_effect, self.simulation.local))
        return np.asarray(self.simulation.residual - columns @ weights)
