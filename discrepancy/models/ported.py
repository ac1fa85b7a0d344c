"""A model in motion as a linear system with ports: what a force that nobody knows of would do to readings.

s' = A s - sum_p b_p g_p, y = C s - sum_p e_p g_p, in the coordinates s = (q, q') of the modes. What is known
to act is in the model's own response; s is what a missing force adds to it.
"""

from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.records import FloatArray, Hold, Trial
from discrepancy.models.input_course import Course
from fe.runtime.patch import ModelPatch

NO_PATCH = ModelPatch()


@dataclass(frozen=True, eq=False)
class PortedSystem:
    """A linear system with ports.

    Attributes
    ----------
    generator : (n, n) ndarray
        A [1/s].
    ports : tuple of str
        Names, P of them.
    actions : (P, n) ndarray
        b of each port: what takes its force from the state.
    positions, speeds : (P, n) ndarray
        Rows by which a port moves. A port of a state moves at the speed that the state is.
    outputs : (C, n) ndarray
        Rows of the outputs.
    through : (P, C) ndarray
        e of each port: what an output shows of its force at once.
    """

    generator: FloatArray
    ports: tuple[str, ...]
    actions: FloatArray
    positions: FloatArray
    speeds: FloatArray
    outputs: FloatArray
    through: FloatArray


def refined(trial: Trial, parts: int) -> Trial:
    """Return a trial with stamps that are `parts` times denser, its inputs as they are between samples."""
    count = len(trial.time)
    at = np.arange((count - 1) * parts + 1) / parts
    row = np.minimum(at.astype(np.int64), count - 2)
    time = np.interp(at, np.arange(count), trial.time)
    time[::parts] = trial.time

    def dense(values: FloatArray) -> FloatArray:
        share = (at - row).reshape((-1, *(1,) * (values.ndim - 1)))
        return np.asarray((1.0 - share) * values[row] + share * values[row + 1])

    def held(values: FloatArray, hold: Hold | None) -> FloatArray:
        if hold is Hold.ZERO_ORDER:
            return np.asarray(values[np.minimum((at + 1e-9).astype(np.int64), count - 1)])
        return Course.of(trial.time, values, hold).at(time)

    return replace(
        trial, time=time, values=dense(trial.values), used=np.ones((len(time), trial.used.shape[1]), bool),
        force=held(trial.force, trial.hold), load_factor=dense(trial.load_factor),
        temperature=dense(trial.temperature),
        health=dense(trial.health), health_deviation=dense(trial.health_deviation),
        inputs=tuple(replace(item, values=held(item.values, item.hold)) for item in trial.inputs),
    )  # fmt: skip
