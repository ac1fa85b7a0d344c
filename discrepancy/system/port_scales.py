"""Scales of a structure and its ports, estimated from the loads and motions of the trials."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Quantity, Trial
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.motion import Motion
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.scales import PortScale

FORCE_PER_RMS = 5.0
"""Ratio of the force scale of a port without stiffness to the rms of the forces that act there.
With this ratio, a friction of 1 to 25 % of the acting force lies in the middle of its prior, and so
does a drag of that size at the largest speed."""
LEAST_REVERSE_SPEED = 1e-3
"""A motion reverses if the speed exceeds this fraction of its largest value in both directions."""
FAR_FROM_MEASURED = 2.0
"""Ratio of a port's computed displacement to its measured one, either way, beyond which its motion
is scaled by the measured one. What the model lacks can make its motion far too large: near a
resonance, or in a fall without drag."""
FAR_IN_SPEED = 1.5
"""The same ratio for the speed of a free port. It is smaller, since laws of speed are scaled by the
square of it, or more."""
WINDOWS_OF_SPEED = 8
"""Number of windows in a motion; the speed of a free port is compared with its measured one by the
largest change of displacement within a window. A fall with drag is as long as one without, but
slower at its end."""
EXACT_COMBINATION = 1e-9
"""Part of a port's row that no combination of outputs and drives gives, below which it counts as
zero."""
LEAST_PARTICIPATION = 1e-6
"""Share of the squared amplitudes of all modes at a port above which a mode moves the port."""


class GlobalScales(NamedTuple):
    """Stiffness [N/m], mass [kg] and angular frequency [rad/s] of a structure as a whole."""

    stiffness: float
    mass: float
    angular_frequency: float


class LargestMotion(NamedTuple):
    """Largest magnitudes of displacement [m], speed [m/s] and load [N]; zero if there are none."""

    displacement: float
    speed: float
    load: float


class DisplacementReadings(NamedTuple):
    """The channels of a trial that show displacements.

    Attributes
    ----------
    rows : (D, N) ndarray
        The rows of the D displacements in the N unknowns.
    values : (T, D) ndarray
        The readings of T samples; NaN where one does not count [m or rad].
    """

    rows: FloatArray
    values: FloatArray


def displacement_readings(
    trial: Trial, equations: Sequence[OutputEquation]
) -> DisplacementReadings:
    """Return the readings of those channels of a trial that show displacements only.

    `equations` are those of the output of each channel, whose constant is subtracted. A channel
    that also shows a rate, a state or a load directly is left out.
    """
    columns = []
    for column, equation in enumerate(equations):
        shows_displacement = np.any(equation.rows[0]) and not np.any(equation.rows[1:])
        if shows_displacement and not equation.feedthrough:
            columns.append(column)
    readings = np.where(trial.used, trial.values, np.nan)  # (samples, channels)
    rows = np.array([equation.rows[0] for equation in equations])  # (channels, unknowns)
    constants = np.array([equation.constant for equation in equations])
    return DisplacementReadings(rows[columns], readings[:, columns] - constants[columns])


def scales_of_moving_structure(
    system: LinearSystem, largest: LargestMotion, duration: float
) -> GlobalScales:
    """Return the scales of a whole structure from the loads and motions of the trials.

    The angular frequency omega is the lowest one of the system above zero, or else the largest
    speed over the largest displacement, or else one over the duration of the longest record. The
    mass is the mean of the diagonal of the mass matrix. The stiffness is the largest load over the
    largest displacement, or else the mass times omega squared.

    Parameters
    ----------
    system : LinearSystem
        The system at the prior mean.
    largest : LargestMotion
        Largest displacement, speed and load in the trials.
    duration : float
        The duration of the longest dynamic record [s].
    """
    angular_frequencies = system.angular_frequency[system.angular_frequency > 0.0]
    moves = largest.displacement > 0.0
    if len(angular_frequencies):
        angular_frequency = float(angular_frequencies[0])
    elif moves and largest.speed > 0.0:
        angular_frequency = largest.speed / largest.displacement
    else:
        angular_frequency = 1.0 / duration
    mass = float(np.trace(system.mass)) / max(system.unknown_count, 1)
    if moves and largest.load > 0.0:
        stiffness = largest.load / largest.displacement
    else:
        stiffness = mass * angular_frequency**2
    return GlobalScales(stiffness, mass, angular_frequency)


def larger_magnitude(largest: float, values: FloatArray) -> float:
    """Return the larger of a number and the largest absolute value of an array."""
    return float(np.maximum(largest, np.max(np.abs(values), initial=0.0)))


def largest_measured_force(campaign: Campaign, trial: Trial) -> float:
    """Return the largest force or moment that a channel measured in a trial [N or N m], or 0."""
    is_force = [
        campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        for name in trial.channels
    ]
    is_used = trial.used & np.array(is_force, bool)
    return float(np.max(np.abs(trial.values), where=is_used, initial=0.0))


class PortScaleEstimator:
    """Collects the forces and motions at ports in a campaign, one trial after the other.

    If no spring of the structure holds a port (the stiffness of a controller does not count), the
    port has no natural frequency that could set its scales. Its force scale is then
    `FORCE_PER_RMS` times the rms of the forces there (the largest of inertia, damping and loads),
    and its displacement and speed scales are the largest displacement and speed. The same holds at
    a port of a state, with flows in the place of forces. If only drives (prescribed motions) move a
    port, its force scale is the largest force that a channel measured.

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
        # of each port, over the trials that were added so far
        self.fitted_displacement = np.zeros(count)
        self.largest_displacement = np.zeros(count)
        self.largest_speed = np.zeros(count)
        self.force_squares = np.zeros(count)  # sums over samples
        self.sample_count = 0
        self.turns = np.zeros(count, bool)  # whether the motion reverses
        self.follows_drives = np.ones(count, bool)  # whether no mode moves the port

    def add_displacements(self, displacements: FloatArray, *, is_fitted: bool) -> None:
        """Add displacements of the structure at rest, or those from which it is released.

        Parameters
        ----------
        displacements : (L, N) array
            The displacements of all unknowns, one row for each load level [m].
        is_fitted : bool
            Whether the trial is fitted (dynamic and not held out).
        """
        largest_displacements = np.max(np.abs(displacements @ self.rows.T), axis=0)
        speeds_at_rest = np.zeros_like(largest_displacements)
        self._add_largest(largest_displacements, speeds_at_rest, is_fitted=is_fitted)

    def add_motion(
        self,
        motion: Motion,
        measured_force: float,
        readings: DisplacementReadings,
        *,
        is_fitted: bool,
    ) -> FloatArray:
        """Add a motion of the structure, and return the loads in it.

        Parameters
        ----------
        motion : Motion
            The motion in a dynamic trial of T samples.
        measured_force : float
            The largest force that a channel measured in the motion [N].
        readings : DisplacementReadings
            The displacements that channels measured in the motion.
        is_fitted : bool
            Whether the trial is fitted.

        Returns
        -------
        (T, N) array
            The loads on all unknowns in the motion [N].
        """
        positions, speeds = motion.displacements_and_speeds_at(self.rows)  # (T, P)
        measured_ratios, speed_ratios = self._measured_over_computed(  # (P,) each
            motion, positions, readings
        )
        largest_positions = np.max(np.abs(positions), axis=0, initial=0.0) * measured_ratios
        largest_speeds = np.max(np.abs(speeds), axis=0, initial=0.0) * speed_ratios
        self._add_largest(largest_positions, largest_speeds, is_fitted=is_fitted)
        least_speed = LEAST_REVERSE_SPEED * np.max(np.abs(speeds), axis=0)
        self.turns |= (np.min(speeds, axis=0) < -least_speed) & (
            np.max(speeds, axis=0) > least_speed
        )
        # loads, inertia and damping (T, N) on the N unknowns
        system = motion.system
        shapes = system.shapes
        mode_count = shapes.shape[1]
        loads = motion.excitation.loads_at(motion.time, np.eye(system.unknown_count))
        inertia = motion.acceleration[:, :mode_count] @ (system.mass @ shapes).T
        damping = motion.velocity[:, :mode_count] @ (self.system.damping @ shapes).T
        # The force at a port p that would accelerate the port as the loads do: the acceleration is
        # p @ shapes @ (modal forces), and that by a unit force at the port is |p @ shapes|^2, the
        # mobility (P,).
        mobility = np.sum((self.rows @ shapes) ** 2, axis=1)
        is_free_to_move = mobility > 0.0
        port_forces_per_load = (  # (N, P)
            shapes @ (shapes.T @ self.rows.T) / np.where(is_free_to_move, mobility, 1.0)
        )
        mean_squares = [
            np.mean((inertia @ port_forces_per_load * measured_ratios) ** 2, axis=0),
            np.mean((damping @ port_forces_per_load * measured_ratios) ** 2, axis=0),
            np.mean((loads @ port_forces_per_load) ** 2, axis=0),
        ]
        largest_mean_square = np.max(mean_squares, axis=0)
        # a port that no mode moves is moved by drives: the divisor makes its force scale, which is
        # FORCE_PER_RMS times the rms, equal to the measured force
        measured_force_square = (measured_force / FORCE_PER_RMS) ** 2
        self.force_squares += len(motion.time) * np.where(
            is_free_to_move, largest_mean_square, measured_force_square
        )
        self.sample_count += len(motion.time)
        self.follows_drives &= mobility == 0.0
        return loads

    def _measured_over_computed(
        self, motion: Motion, positions: FloatArray, readings: DisplacementReadings
    ) -> tuple[FloatArray, FloatArray]:
        """Return factors for ports whose motion was measured to be far from the computed one.

        A factor is the largest measured displacement of a port over the largest computed one. The
        factor is 1 for ports that are not measured, for ports of states, and if the two
        displacements differ by less than the factor `FAR_FROM_MEASURED`. A port is measured if its
        row is a combination of those of channels and drives. A free port has no zero of
        displacement; its speed has a factor of its own, see `WINDOWS_OF_SPEED`.

        Parameters
        ----------
        motion : Motion
            The computed motion of T samples.
        positions : (T, P) array
            The computed displacements of the ports [m or rad].
        readings : DisplacementReadings
            The displacements that channels measured.

        Returns
        -------
        ratios, speed_ratios : (P,) ndarray
            The factors on displacements and on speeds.
        """
        ratios = np.ones(len(self.rows))
        speed_ratios = np.ones(len(self.rows))
        reading_count = len(readings.rows)
        if not reading_count:
            return ratios, speed_ratios
        computed_readings, _ = motion.displacements_and_speeds_at(readings.rows)
        drives = motion.system.drives.reshape(-1, self.rows.shape[1])
        known_rows = np.vstack((readings.rows, drives))
        for port, row in enumerate(self.rows):
            if not np.any(row[: motion.system.displacement_count]):
                continue  # a port of a state, whose value is a speed here
            coefficients = _combination_of(known_rows, row)
            if coefficients is None:
                continue
            # prescribed motions are the same in both: only readings differ from the computed motion
            difference = (readings.values - computed_readings) @ coefficients[:reading_count]
            measured = positions[:, port] + difference  # (T,)
            is_measured = np.isfinite(measured)
            computed = positions[is_measured, port]
            ratios[port] = _ratio_if_far(
                larger_magnitude(0.0, measured[is_measured]),
                larger_magnitude(0.0, computed),
                FAR_FROM_MEASURED,
            )
            speed_ratios[port] = ratios[port]
            if self._is_free(row):
                speed_ratios[port] = _ratio_if_far(
                    _largest_change(measured[is_measured]), _largest_change(computed), FAR_IN_SPEED
                )
        return ratios, speed_ratios

    def _is_free(self, row: FloatArray) -> bool:
        """Return whether only modes without stiffness move a port with a given row (n,)."""
        count = self.system.displacement_mode_count
        return not np.any(self.system.angular_frequency[:count][self._moves_port(row)] > 0.0)

    def _moves_port(self, row: FloatArray) -> BoolArray:
        """Return which modes with displacements move a port with a given row (n,)."""
        participations = self._participations(row)
        return participations > LEAST_PARTICIPATION * float(participations.sum())

    def _participations(self, row: FloatArray) -> FloatArray:
        """Return the squared amplitude of a port per unit of each mode with displacements.

        The shapes have a modal mass of one.
        """
        return (row @ self.system.shapes)[: self.system.displacement_mode_count] ** 2

    def _add_largest(
        self, displacements: FloatArray, speeds: FloatArray, *, is_fitted: bool
    ) -> None:
        """Update the largest displacements and speeds of the P ports by those (P,) of a trial."""
        self.fitted_displacement = np.maximum(self.fitted_displacement, displacements * is_fitted)
        self.largest_displacement = np.maximum(self.largest_displacement, displacements)
        self.largest_speed = np.maximum(self.largest_speed, speeds)

    def port_scales(
        self, static_stiffness: Sequence[float], *, only_driven: bool
    ) -> list[PortScale]:
        """Return the scale of each port, after all trials of the campaign have been added.

        Parameters
        ----------
        static_stiffness : sequence of float
            The static stiffness of each port [N/m or N m/rad]; zero if it is not known and has to
            be computed from the modes.
        only_driven : bool
            Whether every trial is computed in time from recorded inputs. The computed motion is
            then complete: a port whose speed never changes its sign in it never reverses.
            Otherwise a port may reverse although no computed motion shows it.
        """
        force_rms = np.sqrt(self.force_squares / max(self.sample_count, 1))
        force_scales = (FORCE_PER_RMS * force_rms).tolist()
        scales = []
        for port_number, (stiffness_at_rest, force_scale) in enumerate(
            zip(static_stiffness, force_scales, strict=True)
        ):
            scales.append(
                self._port_scale(
                    port_number, stiffness_at_rest, force_scale, only_driven=only_driven
                )
            )
        return scales

    def _port_scale(
        self, port_index: int, static_stiffness: float, force: float, *, only_driven: bool
    ) -> PortScale:
        """Return the typical force, displacement and stiffness of one port.

        There are three cases: a port that a mode without stiffness moves, or no mode at all, is
        scaled by the forces and motions of the trials; a port on springs that drives alone move,
        by the measured force; any other port on springs, by the first mode that moves it.

        Parameters
        ----------
        port_index : int
            The index of the port.
        static_stiffness : float
            The static stiffness of the port [N/m or N m/rad]; zero if it has to be computed from
            the modes.
        force : float
            The scale of the force at the port [N or N m]; zero if nothing acted there.
        only_driven : bool
            Whether every trial is a motion under recorded inputs; see `port_scales`.
        """
        system = self.system
        fitted_displacement = float(self.fitted_displacement[port_index])
        largest_displacement = float(self.largest_displacement[port_index])
        largest_speed = float(self.largest_speed[port_index])
        displacement = fitted_displacement or largest_displacement or 1.0
        # modes that move the port
        angular_frequencies = system.angular_frequency[: system.displacement_mode_count]
        row = self.rows[port_index]
        participations = self._participations(row)
        moves_port = self._moves_port(row)
        is_free = self._is_free(row)
        is_held = np.any(moves_port) and np.all(angular_frequencies[moves_port] > 0.0)
        if not is_held:
            is_known_not_to_turn = is_free and only_driven and np.any(moves_port)
            return PortScale(
                displacement=displacement,
                stiffness=(force or 1.0) / displacement,
                angular_frequency=(largest_speed or 1.0) / displacement,
                largest_displacement=largest_displacement or displacement,
                free=is_free,
                turns=bool(self.turns[port_index]) or not is_known_not_to_turn,
                of_state=not np.any(row[: system.displacement_count]),
            )
        # each mode adds (row @ shape)^2 / omega^2 to the static compliance of the port
        compliance = np.sum(participations[moves_port] / angular_frequencies[moves_port] ** 2)
        static_stiffness = static_stiffness or 1.0 / float(compliance)
        is_driven = only_driven and self.follows_drives[port_index]
        if is_driven and force > 0.0 and largest_speed > 0.0:
            return PortScale(
                displacement=displacement,
                stiffness=force / displacement,
                angular_frequency=largest_speed / displacement,
                static_stiffness=static_stiffness,
                largest_displacement=largest_displacement or displacement,
                driven=True,
            )
        first_angular_frequency = float(angular_frequencies[moves_port][0])
        first_participation = float(participations[moves_port][0])
        # the first mode alone has the compliance p / omega^2 at the port, so its stiffness is
        # omega^2 / p, with p its participation
        return PortScale(
            displacement=displacement,
            stiffness=first_angular_frequency**2 / first_participation,
            angular_frequency=first_angular_frequency,
            static_stiffness=static_stiffness,
            largest_displacement=largest_displacement or 1.0,
        )


def _ratio_if_far(measured: float, computed: float, far: float) -> float:
    """Return a measured over a computed magnitude, or one unless they differ by a factor `far`."""
    if measured == 0.0 or computed == 0.0:
        return 1.0
    ratio = measured / computed
    return 1.0 if 1.0 / far < ratio < far else ratio


def _largest_change(values: FloatArray) -> float:
    """Return the largest change of a series within one of its windows."""
    step = max(len(values) // WINDOWS_OF_SPEED, 1)
    return float(np.max(np.abs(values[step:] - values[:-step]), initial=0.0))


def _combination_of(known_rows: FloatArray, row: FloatArray) -> FloatArray | None:
    """Return coefficients (K,) with which known rows (K, n) add to a row (n,); None if none do.

    A displacement is known, for example, as that of a body minus that of its moved support.
    """
    coefficients = np.asarray(np.linalg.lstsq(known_rows.T, row, rcond=None)[0])
    unknown_part = np.abs(known_rows.T @ coefficients - row).max()
    return None if unknown_part > EXACT_COMBINATION * np.abs(row).max() else coefficients
