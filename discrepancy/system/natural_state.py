"""Natural sizes of an unknown initial state."""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.system.motion import Motion
from discrepancy.system.output_equation import OutputEquation

SMALLEST_SIZE = 1e-9
"""Natural size of a state where nothing moves and nothing is read."""


def natural_state(motion: Motion, equations: Sequence[OutputEquation], trial: Trial) -> FloatArray:
    """Return natural sizes (L,) of the state at the begin of a trial.

    They are the largest of the motion from rest, and of the state that would give the readings.

    Parameters
    ----------
    motion : Motion
        The motion from rest.
    equations : sequence of OutputEquation
        What the outputs of the trial's channels show.
    trial : Trial
        The trial, with its readings.

    Returns
    -------
    (L,) array
        Displacements of the modes, their speeds, then the states.
    """
    system = motion.system
    mode_count = len(system.angular_frequency)
    count = system.displacement_modes
    position_sizes = np.max(np.abs(motion.q[:, :mode_count]), axis=0)
    speed_sizes = np.max(np.abs(motion.velocity[:, :mode_count]), axis=0)
    duration = float(trial.time[-1] - trial.time[0])
    pace = np.maximum(system.angular_frequency[:count], 1.0 / duration)
    for column, equation in enumerate(equations):
        is_used = trial.used[:, column]
        readings = trial.values[is_used, column] - equation.constant
        if equation.feedthrough is not None or not readings.size:
            continue
        largest = float(np.max(np.abs(readings)))
        rows = equation.rows @ system.shapes
        displacement_rows = rows[:, :count]
        state_rows = rows[:, count:]
        if np.any(displacement_rows):
            derivative = np.argmax(np.any(rows, axis=1))
            amplitude = largest / float(np.linalg.norm(displacement_rows)) / pace**derivative
            position_sizes[:count] = np.maximum(position_sizes[:count], amplitude)
            speed_sizes[:count] = np.maximum(speed_sizes[:count], amplitude * pace)
        if np.any(state_rows):
            level = largest / float(np.linalg.norm(state_rows))
            speed_sizes[count:] = np.maximum(speed_sizes[count:], level)
    sizes = np.concatenate((position_sizes[:count], speed_sizes))
    usual = max(float(sizes.max(initial=0.0)), SMALLEST_SIZE)
    return np.asarray(np.where(sizes > 0.0, sizes, usual))
