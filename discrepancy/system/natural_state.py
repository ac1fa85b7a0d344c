"""Typical magnitudes of an unknown initial state, which make it dimensionless."""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.system.motion import Motion
from discrepancy.system.output_equation import OutputEquation

SMALLEST_SIZE = 1e-9
"""Magnitude [SI] of all states if nothing moves and all readings are zero."""


def natural_state_magnitudes(
    motion: Motion, equations: Sequence[OutputEquation], trial: Trial
) -> FloatArray:
    """Return typical magnitudes (L,) of the unknown state at the start of a trial.

    The magnitude of an amplitude is the larger of its largest value in the motion from rest, and
    of the value that could explain the largest reading of a channel. An amplitude that neither
    shows has the largest magnitude of all.

    Parameters
    ----------
    motion : Motion
        The motion of the trial if it begins at rest.
    equations : sequence of OutputEquation
        The equation of the output of each channel.
    trial : Trial
        The trial, with its readings.

    Returns
    -------
    (L,) array
        The magnitudes of the displacements of the modes, of their speeds, then of the states.
    """
    system = motion.system
    mode_count = len(system.angular_frequency)
    displacement_mode_count = system.displacement_mode_count
    position_magnitudes = np.max(np.abs(motion.q[:, :mode_count]), axis=0)
    speed_magnitudes = np.max(np.abs(motion.velocity[:, :mode_count]), axis=0)
    duration = float(trial.time[-1] - trial.time[0])
    # rigid motions have no frequency: their changes take the whole record
    angular_frequency = np.maximum(
        system.angular_frequency[:displacement_mode_count], 1.0 / duration
    )
    for column, equation in enumerate(equations):
        is_used = trial.used[:, column]
        readings = trial.values[is_used, column] - equation.constant
        # an output with a direct part of a load does not show the state alone
        if equation.feedthrough is not None or not readings.size:
            continue
        largest_reading = float(np.max(np.abs(readings)))
        rows = equation.rows @ system.shapes  # (4, modes), by order of the time derivative
        displacement_rows = rows[:, :displacement_mode_count]
        state_rows = rows[:, displacement_mode_count:]
        if np.any(displacement_rows):
            # the lowest derivative that the output reads; each order multiplies an amplitude by w
            derivative = np.argmax(np.any(rows, axis=1))
            amplitude = (
                largest_reading
                / float(np.linalg.norm(displacement_rows))
                / angular_frequency**derivative
            )
            position_magnitudes[:displacement_mode_count] = np.maximum(
                position_magnitudes[:displacement_mode_count], amplitude
            )
            speed_magnitudes[:displacement_mode_count] = np.maximum(
                speed_magnitudes[:displacement_mode_count], amplitude * angular_frequency
            )
        if np.any(state_rows):
            state_magnitude = largest_reading / float(np.linalg.norm(state_rows))
            speed_magnitudes[displacement_mode_count:] = np.maximum(
                speed_magnitudes[displacement_mode_count:], state_magnitude
            )
    magnitudes = np.concatenate((position_magnitudes[:displacement_mode_count], speed_magnitudes))
    default_magnitude = max(float(magnitudes.max(initial=0.0)), SMALLEST_SIZE)
    return np.asarray(np.where(magnitudes > 0.0, magnitudes, default_magnitude))
