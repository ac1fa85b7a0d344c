"""The motion of a trial, and the laws and sensor errors of a hypothesis along it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray

from .laws import LawForce, PortMotion


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The motion of a trial along which it is linearised, at its F fine stamps.

    Attributes
    ----------
    added_state : (F, n) ndarray
        The state that forces at ports add to the response of the linear model.
    positions, speeds : (F, P) ndarray
        The motion of the P ports [m or rad, and per s].
    forces : mapping of int to (F,) ndarray
        The force at a port that the linear model does not contain, by the index of the port [N or
        N m].
    """

    added_state: FloatArray
    positions: FloatArray
    speeds: FloatArray
    forces: Mapping[int, FloatArray]

    @cached_property
    def port_motions(self) -> tuple[PortMotion, ...]:
        """The motion of each of the P ports."""
        return tuple(
            PortMotion(np.ascontiguousarray(positions), np.ascontiguousarray(speeds))
            for positions, speeds in zip(self.positions.T, self.speeds.T, strict=True)
        )

    def interpolate(self, other_trajectory: "Trajectory", fraction: float) -> "Trajectory":
        """Return the trajectory that lies a fraction of the way to another one."""
        ports = {*self.forces, *other_trajectory.forces}
        forces = {
            port: (1.0 - fraction) * self.forces.get(port, 0.0)
            + fraction * other_trajectory.forces.get(port, 0.0)
            for port in ports
        }
        return Trajectory(
            self.added_state + fraction * (other_trajectory.added_state - self.added_state),
            self.positions + fraction * (other_trajectory.positions - self.positions),
            self.speeds + fraction * (other_trajectory.speeds - self.speeds),
            {port: np.asarray(force) for port, force in forces.items()},
        )


@dataclass(frozen=True, eq=False)
class LawArguments:
    """The arguments of a hypothesis' laws in one trial: its motion, and the values of unknowns.

    Attributes
    ----------
    trial_index : int
        The index of the trial.
    trajectory : Trajectory
        The motion of the trial.
    effect : (E,) ndarray
        The values of the effects' unknowns.
    shared : (K,) ndarray
        The values of the shared unknowns.
    speed_window : float
        The half width of the window of speeds over which laws of the speed are averaged, divided by
        the rms speed.
    """

    trial_index: int
    trajectory: Trajectory
    effect: FloatArray
    shared: FloatArray
    speed_window: float


@dataclass(frozen=True, eq=False)
class LinearisedForce:
    """The force of a hypothesis' laws at a port along a trajectory, with its derivatives.

    Attributes
    ----------
    law_force : LawForce
        The force of all laws at the port, and its derivatives with respect to the motion.
    by_unknown : mapping of int to (F,) ndarray
        The derivatives of the force by unknowns, by the number of the unknown.
    by_model : (F,) ndarray or float
        The part of the force that the model's own laws have.
    """

    law_force: LawForce
    by_unknown: Mapping[int, FloatArray]
    by_model: FloatArray | float = 0.0

    def extrapolate(
        self, position_change: FloatArray, speed_change: FloatArray, unknowns_change: FloatArray
    ) -> FloatArray:
        """Return the force (F,) that the linear laws have after a change of motion and unknowns.

        Parameters
        ----------
        position_change, speed_change : (F,) array
            The change of the motion of the port [m or rad, and per s].
        unknowns_change : (K + E,) array
            The change of the shared unknowns, then of those of effects.
        """
        law = self.law_force
        force = law.force + law.by_position * position_change
        force = force + law.by_speed * speed_change
        for unknown_index, derivative in self.by_unknown.items():
            force = force + unknowns_change[unknown_index] * derivative
        return force


@dataclass(frozen=True, eq=False)
class LinearisedSensorErrors:
    """The changes of a trial's readings by errors of sensors, divided by the noise.

    Attributes
    ----------
    change : (N, C) ndarray
        The change at the present values of the unknowns.
    by_unknown : mapping of int to (N, C) ndarray
        The derivatives of the change with respect to unknowns, by the index of the unknown.
    """

    change: FloatArray
    by_unknown: Mapping[int, FloatArray]


NO_SENSOR_ERRORS = LinearisedSensorErrors(np.zeros(()), {})
"""The changes of readings where no sensor has an error."""
