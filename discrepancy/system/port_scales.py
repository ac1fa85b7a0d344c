"""Scales of a system and its ports by what acts and moves in the trials of a campaign."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Trial
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.motion import Motion
from discrepancy.system.scales import PortScale

FORCE_PER_RMS = 5.0
"""Force scale of a port that no stiffness holds, over the rms of the forces there: friction of 1 to
25 % of what acts is in the middle of its prior, and drag of as much at the largest speed."""
BOTH_WAYS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""


class GlobalScales(NamedTuple):
    """Stiffness [N/m], mass [kg] and angular frequency [rad/s] of a structure as a whole."""

    stiffness: float
    mass: float
    angular_frequency: float


def moving_scales(
    system: LinearSystem,
    largest_displacement: float,
    largest_speed: float,
    largest_load: float,
    duration: float,
) -> GlobalScales:
    """Return the scales of a system by what acts and moves in the trials.

    Parameters
    ----------
    system : LinearSystem
        The system at the prior mean.
    largest_displacement, largest_speed, largest_load : float
        Largest values in the trials [SI]; zero where nothing moves or acts.
    duration : float
        Longest dynamic record [s].
    """
    elastic = system.angular_frequency[system.angular_frequency > 0.0]
    moves = largest_displacement > 0.0
    if len(elastic):
        frequency = float(elastic[0])
    elif moves and largest_speed > 0.0:
        frequency = largest_speed / largest_displacement
    else:
        frequency = 1.0 / duration
    mass = float(np.trace(system.mass)) / max(system.size, 1)
    if moves and largest_load > 0.0:
        stiffness = largest_load / largest_displacement
    else:
        stiffness = mass * frequency**2
    return GlobalScales(stiffness, mass, frequency)


def larger(largest: float, values: FloatArray) -> float:
    """Return the larger of a number and the largest absolute value of an array."""
    return float(np.maximum(largest, np.max(np.abs(values), initial=0.0)))


def largest_measured_force(campaign: Campaign, trial: Trial) -> float:
    """Return the largest force or moment that a channel measured in a trial [N or N m]."""
    is_force = [
        campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        for name in trial.channels
    ]
    is_used = trial.used & np.array(is_force, bool)
    return float(np.max(np.abs(trial.values), where=is_used, initial=0.0))


class PortScaleEstimator:
    """Collects what acts and moves at ports in a campaign, one trial after the other.

    Where no stiffness of the structure holds a port (that of a controller does not count), its
    force scale is `FORCE_PER_RMS` times the rms of inertia, damping, own laws and loads there; its
    displacement and speed scales are the largest ones. Effects are so measured by what acts and
    moves. The same holds at a port of a state, with flows. Where drives alone move a port, no
    frequency of the structure says how fast it moves: its force scale is the largest measured
    force.

    Parameters
    ----------
    system : LinearSystem
        The system at the prior mean, without controllers.
    rows : (P, N) ndarray
        Rows of the ports.
    """

    def __init__(self, system: LinearSystem, rows: FloatArray) -> None:
        self.system = system
        self.rows = rows
        count = len(rows)
        self.fitted_displacement = np.zeros(count)
        self.largest_displacement = np.zeros(count)
        self.largest_speed = np.zeros(count)
        self.force_squares = np.zeros(count)
        self.sample_count = 0
        self.turns = np.zeros(count, bool)
        self.follows_drives = np.ones(count, bool)

    def add_displacements(self, displacements: FloatArray, *, fitted: bool) -> None:
        """Add displacements (L, N) at rest, or from which a structure is released."""
        largest = np.max(np.abs(displacements @ self.rows.T), axis=0)
        self._add_largest(largest, 0.0 * largest, fitted=fitted)

    def add_motion(self, motion: Motion, measured_force: float, *, fitted: bool) -> FloatArray:
        """Add a motion and the largest force measured in it [N].

        Returns
        -------
        (T, N) array
            The loads in the motion.

        Parameters
        ----------
        motion : Motion
            Motion in a dynamic trial.
        measured_force : float
            Largest force that was measured in it [N].
        fitted : bool
            Whether the trial is fitted.
        """
        position, speed = motion.at_rows(self.rows)
        largest_position = np.max(np.abs(position), axis=0, initial=0.0)
        largest_speed = np.max(np.abs(speed), axis=0, initial=0.0)
        self._add_largest(largest_position, largest_speed, fitted=fitted)
        least = BOTH_WAYS * np.max(np.abs(speed), axis=0)
        self.turns |= (np.min(speed, axis=0) < -least) & (np.max(speed, axis=0) > least)
        # inertia, damping and loads (N unknowns)
        system = motion.system
        shapes = system.shapes
        modes = shapes.shape[1]
        loads = motion.excitation.loads_at(motion.time, np.eye(system.size))
        forces = (
            motion.acceleration[:, :modes] @ (system.mass @ shapes).T,
            motion.velocity[:, :modes] @ (self.system.damping @ shapes).T,
            loads,
        )
        # modal force along the port, over what a unit force there gives
        mobility = np.sum((self.rows @ shapes) ** 2, axis=1)
        is_free_to_move = mobility > 0.0
        along = shapes @ (shapes.T @ self.rows.T) / np.where(is_free_to_move, mobility, 1.0)
        mean_squares = [np.mean((force @ along) ** 2, axis=0) for force in forces]
        largest = np.max(mean_squares, axis=0)
        measured = (measured_force / FORCE_PER_RMS) ** 2
        self.force_squares += len(motion.time) * np.where(is_free_to_move, largest, measured)
        self.sample_count += len(motion.time)
        self.follows_drives &= mobility == 0.0
        return loads

    def _add_largest(self, displacement: FloatArray, speed: FloatArray, *, fitted: bool) -> None:
        """Add the largest displacements and speeds (P,) of a trial."""
        self.fitted_displacement = np.maximum(self.fitted_displacement, displacement * fitted)
        self.largest_displacement = np.maximum(self.largest_displacement, displacement)
        self.largest_speed = np.maximum(self.largest_speed, speed)

    def port_scales(
        self, static_stiffness: Sequence[float], *, only_driven: bool
    ) -> list[PortScale]:
        """Return the scale of each port.

        Parameters
        ----------
        static_stiffness : sequence of float
            Stiffness at rest of each port [N/m or N m/rad]; zero where the modes tell it.
        only_driven : bool
            Whether all trials are followed in time from known inputs, so that a motion that was not
            seen to turn does not turn.
        """
        rms = np.sqrt(self.force_squares / max(self.sample_count, 1))
        forces = (FORCE_PER_RMS * rms).tolist()
        scales = []
        for number, (stiffness, force) in enumerate(zip(static_stiffness, forces, strict=True)):
            scales.append(self._port_scale(number, stiffness, force, only_driven=only_driven))
        return scales

    def _port_scale(
        self, number: int, static_stiffness: float, force: float, *, only_driven: bool
    ) -> PortScale:
        """Return the scale of one port, given its stiffness at rest and its force scale."""
        system = self.system
        fitted = float(self.fitted_displacement[number])
        largest = float(self.largest_displacement[number])
        speed = float(self.largest_speed[number])
        displacement = fitted or largest or 1.0
        # modes that move the port
        frequency = system.angular_frequency[: system.displacement_modes]
        row = self.rows[number]
        participation = (row @ system.shapes)[: system.displacement_modes] ** 2
        moves = participation > 1e-6 * float(participation.sum())
        is_free = not np.any(frequency[moves] > 0.0)
        is_held = np.any(moves) and np.all(frequency[moves] > 0.0)
        if not is_held:
            is_known_not_to_turn = is_free and only_driven and np.any(moves)
            return PortScale(
                displacement=displacement,
                stiffness=(force or 1.0) / displacement,
                angular_frequency=(speed or 1.0) / displacement,
                largest_displacement=largest or displacement,
                free=is_free,
                turns=bool(self.turns[number]) or not is_known_not_to_turn,
                of_state=not np.any(row[: system.displacement_count]),
            )
        compliance = np.sum(participation[moves] / frequency[moves] ** 2)
        static_stiffness = static_stiffness or 1.0 / float(compliance)
        is_driven = only_driven and self.follows_drives[number]
        if is_driven and force > 0.0 and speed > 0.0:
            return PortScale(
                displacement=displacement,
                stiffness=force / displacement,
                angular_frequency=speed / displacement,
                static_stiffness=static_stiffness,
                largest_displacement=largest or displacement,
                driven=True,
            )
        first_frequency = float(frequency[moves][0])
        first_participation = float(participation[moves][0])
        return PortScale(
            displacement=displacement,
            stiffness=first_frequency**2 / first_participation,
            angular_frequency=first_frequency,
            static_stiffness=static_stiffness,
            largest_displacement=largest or 1.0,
        )
