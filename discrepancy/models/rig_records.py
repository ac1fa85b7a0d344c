"""What acts on a system in a trial, and what its outputs show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity, Start
from discrepancy.models.input_course import Course, Drive, FormulaCourse

Load = tuple[FloatArray, Course | FormulaCourse]
"""Row (N,) along which a load acts, and its course."""


@dataclass(frozen=True)
class Acting:
    """What acts in a trial.

    Attributes
    ----------
    time : (N,) ndarray
        Stamps of the inputs and of the samples [s].
    constant : (n + m,) ndarray
        Constant load.
    loads : sequence of Load
        What else pushes.
    drives : sequence of Drive
        Prescribed motions, in the order of `LinearSystem.drives`.
    begins : Start
        How it began.
    initial : (L,) ndarray
        State at the first stamp, where it is unknown: displacements and speeds of the modes, then the states.
    clock : tuple of float
        Rate and zero of the samples beside the inputs.
    references : mapping of str to sequence of Load
        Those of the loads that are the reference of a controller, by its name.
    """

    time: FloatArray
    constant: FloatArray
    loads: Sequence[Load] = ()
    drives: Sequence[Drive] = ()
    begins: Start = Start.SETTLED
    initial: FloatArray = field(default_factory=lambda: np.zeros(0))
    clock: tuple[float, float] = (0.0, 0.0)
    references: Mapping[str, Sequence[Load]] = field(default_factory=dict)

    @property
    def sampled(self) -> FloatArray:
        """Times (N,) at which the samples show the motion [s]."""
        return (1.0 + self.clock[0]) * self.time + self.clock[1]

    def load_at(self, time: FloatArray, base: FloatArray) -> FloatArray:
        """Return the loads (T, B) in a base (n + m, B) at times, held ones as they were just before."""
        return self.total([course.at(time) for _, course in self.loads], base, len(time))

    def ends(self, time: FloatArray, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the loads (K, B) at the begin and the end of the steps between times (K + 1,)."""
        found = [course.ends(time) for _, course in self.loads]
        begin, end = ([pair[side] for pair in found] for side in (0, 1))
        return self.total(begin, base, len(time) - 1), self.total(end, base, len(time) - 1)

    def total(self, amounts: Sequence[FloatArray], base: FloatArray, count: int) -> FloatArray:
        """Return the loads (T, B) of amounts (T,) of each beside the constant one."""
        constant, *rows = np.array([self.constant, *(row for row, _ in self.loads)]) @ base
        if not rows:
            return np.tile(constant, (count, 1))
        found: FloatArray = np.array(amounts).T @ np.array(rows)
        return found + constant if constant.any() else found


class Shown(NamedTuple):
    """What an output shows: row . u and row . x, speed . u', courses with their factors, and a constant.

    `order` is how often row . u is derived, `further` how often row . x; `reaction` is the number of a drive
    whose force it shows instead.
    """

    row: FloatArray
    order: int = 0
    further: int = 0
    reaction: int | None = None
    constant: float = 0.0
    speed: FloatArray | None = None
    courses: tuple[tuple[float, Course | FormulaCourse], ...] = ()


@cache
def order_of(quantity: Quantity) -> int:
    """Return how often a displacement is derived to be of a quantity."""
    return quantity.moving.index(quantity) if quantity.moving else 0


def shown_rows(rows: FloatArray, quantities: Sequence[Quantity]) -> list[Shown]:
    """Return what sensors of displacements and their derivatives show at rows (C, n)."""
    return [Shown(row, order_of(quantity)) for row, quantity in zip(rows, quantities, strict=True)]
