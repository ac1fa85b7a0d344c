"""What a model is asked for and what it answers: conditions, response, a linear system with ports."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity

Place = str | tuple[float, float]
MOVES, TURNS, EITHER = ("N", "m"), ("N m", "rad"), ("N or N m", "m or rad")
"""Units of a force and of a motion at a port."""


@dataclass(frozen=True)
class Conditions:
    """All that a response depends on besides trial and patch.

    Attributes
    ----------
    parameters : (P,) ndarray
        Values of `Model.parameters`, in order.
    initial : (R, 2) ndarray
        Ring-downs. At rest: column 0 holds deviations from the static release shape, in units of the release
        displacement, by mode, row 0 that of the whole shape (so the motion starts at (1 + initial[0, 0])
        times the static shape plus initial[r, 0] of mode r); column 1 is zero. Not at rest: displacement and
        velocity / w_r of mode r, in units of the release displacement, at the release point.
    clock : tuple of float
        (rate, zero): a sample stamped t shows the motion at (1 + rate) t + zero [1], [s].
    health : (N, 2) ndarray
        Stiffness losses z1, z2 of each row (dynamic trials: row 0 holds for all).
    offset : tuple of float
        Constants that the recorded inputs of a driven trial lack, in their order [SI]; empty: none.
    refinement : int
        Time steps are this many times smaller than usual, to check the integration.
    """

    parameters: FloatArray
    initial: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    clock: tuple[float, float] = (0.0, 0.0)
    health: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    offset: tuple[float, ...] = ()
    refinement: int = 1

    def stamps(self, time: FloatArray) -> FloatArray:
        """Return the times at which samples with stamps (N,) show the motion [s]."""
        return (1.0 + self.clock[0]) * time + self.clock[1]

    @property
    def key(self) -> tuple[object, ...]:
        """All of it as a value that can be looked up."""
        values = vars(self).values()
        return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in values)


class Response(NamedTuple):
    """What perfect sensors would show.

    Attributes
    ----------
    values : (N, C) ndarray
        By output, SI units.
    rates : (N, C) ndarray or None
        Their time derivatives, for dynamic trials.
    """

    values: FloatArray
    rates: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PortedSystem:
    """A model in motion as a linear system with ports: what a force that nobody knows of does to readings.

    s' = A s - sum_p b_p g_p, y = C s - sum_p e_p g_p, in the coordinates s = (q, q') of the modes. What is
    known to act is in the model's own response; s is what a missing force adds to it.

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


Outputs = tuple[tuple[str, Quantity], ...]
"""Outputs, and the quantity wanted of each."""
ACROSS = ".transverse", ".shear"
"""What follows the name of a strain in those across its gauge's direction: strain, engineering shear."""
