"""What acts on a rig in a trial, and what its outputs show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Start
from discrepancy.models.input_course import Course, Drive, FormulaCourse

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Acting:
    """What acts in a trial.

    Attributes
    ----------
    time : (N,) ndarray
        Stamps of the inputs and of the samples [s].
    loads : sequence of ((n + m,) ndarray, Course)
        Vector and course of each load.
    constant : (n + m,) ndarray
        Constant load.
    drives : sequence of Drive
        Prescribed motions, in the order of `Rig.drives`.
    begins : Start
        How it began.
    initial : (L,) ndarray
        State at the first stamp, where it is unknown: displacements and speeds of the modes, then the states.
    clock : tuple of float
        Rate and zero of the samples beside the inputs.
    references : mapping of str to sequence of ((n + m,) ndarray, Course)
        Those of the loads that are the reference of a controller, by its name.
    """

    time: FloatArray
    loads: Sequence[tuple[FloatArray, Course | FormulaCourse]]
    constant: FloatArray
    drives: Sequence[Drive] = ()
    begins: Start = Start.SETTLED
    initial: FloatArray = field(default_factory=lambda: np.zeros(0))
    clock: tuple[float, float] = (0.0, 0.0)
    references: Mapping[str, Sequence[tuple[FloatArray, Course]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Effort:
    """What a controller gives: by u (n,), u' (n,), x (m,), and by courses with their factors."""

    by_displacement: FloatArray
    by_speed: FloatArray
    by_state: FloatArray
    courses: tuple[tuple[float, Course], ...] = ()


@dataclass(frozen=True)
class Shown:
    """What an output shows: row . u and row . x, or the reaction of a drive (its number), and a constant.

    Or what a controller gives, `effort`.

    `order` is how often u is derived, `further` how often x.
    """

    row: FloatArray
    order: int = 0
    further: int = 0
    reaction: int | None = None
    constant: float = 0.0
    effort: Effort | None = None
