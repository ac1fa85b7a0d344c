"""In which state an FMU is run, and what moves it."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """Parameters and constant inputs of a run, sorted by name; by keys of the binding and the FMU's names."""

    parameters: tuple[tuple[str, float], ...]
    inputs: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Excitation:
    """What moves the FMU, per unit of a factor.

    Attributes
    ----------
    kind : str
        "displacement", "velocity": parameters of the release; "hold": a force is let go that had brought the
        release point to the displacement; "input": an input.
    name : str
        The input.
    series : (N,) ndarray
        Its values, each held over a step.
    begin : float
        Its value before the motion, under which the FMU is at rest.
    """

    kind: str
    name: str = ""
    series: FloatArray = field(default_factory=lambda: np.zeros(0))
    begin: float = 0.0

    @property
    def key(self) -> Hashable:
        """What tells it from others."""
        return self.kind, self.name, blake2b(self.series.tobytes(), digest_size=16).digest(), self.begin


Loads = Sequence[tuple[Excitation, float]]
"""Excitations with their factors."""


class Run(NamedTuple):
    """A motion that is asked of an FMU: in which state, communication step [s], how many, what excites it."""

    state: State
    step: float
    steps: int
    loads: Loads
