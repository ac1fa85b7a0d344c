"""What a model of a structure asks of its structure: rows, stiffness, motion."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Quantity, Trial
from discrepancy.models.interface import PortScale
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.patch import ModelPatch, Primitive
from fe.runtime.state import Losses

FloatArray = NDArray[np.float64]
Outputs = tuple[tuple[str, Quantity], ...]
Place = str | tuple[float, float]
DEFAULT_PLACE = "tip_load"
"""Place of a load where a trial says none."""


class Moving(NamedTuple):
    """A structure in a basis (n, k) of its first modes and some static shapes, in which it moves."""

    basis: FloatArray
    system: SecondOrderSystem


class Solver(Protocol):
    """The stiffness (n, n) of a structure in one state."""

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, (n,) or (n, k)."""


class Body(Protocol):
    """What a model of a structure asks of its structure, in n coordinates of its own.

    Attributes
    ----------
    regions : tuple of str
        Damage regions.
    points : mapping of str to (n,) ndarray
        Rows of the ports whose laws act on one motion.
    port_rows : mapping of str to (n,) ndarray
        Rows of all ports where laws act.
    missing : tuple of str
        Further ports of `port_rows` where missing forces are looked for.
    length : float or None
        Largest station [m], if it has any.
    reference : str
        Place whose stiffness and modal mass are the natural ones.
    """

    regions: tuple[str, ...]
    points: Mapping[str, FloatArray]
    port_rows: Mapping[str, FloatArray]
    missing: tuple[str, ...]
    length: float | None
    reference: str

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if there is no such output."""

    def output_rows(self, outputs: Outputs, component: int, losses: ModelPatch) -> FloatArray:
        """Return the rows (C, n) of outputs; `component` 1 and 2: transverse and shear strain."""

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the structure can carry a primitive."""

    def internal_forces(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at ports of `port_rows`."""

    def force_row(self, place: Place, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the load (n,) of 1 N at a place, as load primitives have it."""

    def units(self, trial: Trial, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the unit loads (k, n) of a trial at rest, as load primitives have them; `always` last."""

    def always(self, parameters: FloatArray) -> FloatArray | None:
        """Return the load (n,) that acts in every motion, too, if there is one."""

    def stiffness(
        self, parameters: FloatArray, health: Losses, structure: ModelPatch, temperature: float
    ) -> Solver:
        """Return the stiffness at parameters, losses, a patch and a temperature less the reference [K]."""

    def moving(
        self, parameters: FloatArray, health: Losses, structure: ModelPatch, temperature: float, place: Place,
        ports: tuple[str, ...] = (),
    ) -> Moving:  # fmt: skip
        """Return the structure as it moves when let go, or pushed, at a place, with forces at `ports`."""

    def spread(self, ports: Mapping[str, PortScale], shape: FloatArray) -> dict[str, PortScale]:
        """Return the scales of forces that are spread over the structure, by the first mode (n,)."""
