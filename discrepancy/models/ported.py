"""A model in motion as a linear system with ports: what a force that nobody knows of would do to readings.

s' = A s - sum_p b_p g_p, y = C s - sum_p e_p g_p, in the coordinates s = (q, q') of the modes. What is known
to act is in the model's own response; s is what a missing force adds to it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Hold, Trial
from discrepancy.models.input_course import Course
from discrepancy.models.interface import Model
from discrepancy.models.wrapped import innermost
from fe.runtime.patch import ModelPatch

FloatArray = NDArray[np.float64]

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


@dataclass(frozen=True, eq=False)
class OutputRows:
    """What outputs show: rows of q, q', q'' (C, M) each, and what they show of a port's force (P, C)."""

    displacement: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    force: FloatArray


def modal_system(
    matrices: tuple[FloatArray, FloatArray, FloatArray],
    ports: dict[str, tuple[FloatArray, FloatArray]],
    shown: OutputRows,
    moving: int,
) -> PortedSystem:
    """Return the linear system of M q'' + D q' + K q = -sum_p acts_p g_p.

    Parameters
    ----------
    matrices : tuple of (M, M) ndarray
        M, D and K in modal coordinates.
    ports : dict of str to ((M,) ndarray, (M,) ndarray)
        Row by which each port moves, and row along which its force acts.
    shown : OutputRows
        Of the outputs.
    moving : int
        The first coordinates; of the others, which are states, only the speeds are kept.
    """
    mass, damping, stiffness = matrices
    count = len(mass)
    sees, acts = (np.array([rows[k] for rows in ports.values()]).reshape(len(ports), count) for k in (0, 1))
    by_stiffness, by_damping = np.linalg.solve(mass, stiffness), np.linalg.solve(mass, damping)
    push = np.linalg.solve(mass, acts.T).T
    generator = np.zeros((moving + count, moving + count))
    generator[:moving, moving : 2 * moving] = np.eye(moving)
    generator[moving:, :moving] = -by_stiffness[:, :moving]
    generator[moving:, moving:] = -by_damping
    outputs = np.hstack(
        (
            (shown.displacement - shown.acceleration @ by_stiffness)[:, :moving],
            shown.speed - shown.acceleration @ by_damping,
        )
    )
    none = np.zeros((len(sees), count))
    held, speeds = np.hstack((sees[:, :moving], none)), np.hstack((none[:, :moving], sees))
    return PortedSystem(
        generator, tuple(ports), np.hstack((none[:, :moving], push)), held, speeds, outputs,
        push @ shown.acceleration.T - shown.force,
    )  # fmt: skip


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


def shows_ports(model: Model) -> bool:
    """Whether a model tells how its ports move (`ported` and `port_motion`)."""
    return hasattr(innermost(model), "ported")


def apart(model: Model) -> tuple[Model, ModelPatch]:
    """Return a model without laws at its ports, and these at the prior means."""
    found: tuple[Model, ModelPatch] = model.apart() if hasattr(model, "apart") else (model, NO_PATCH)
    return found
