"""A model as input for CalculiX; `fe.verification.calculix_job` runs it and reads the results.

CalculiX (`ccx`, Debian package calculix-ccx) is an independent finite element code. It gets nodes, cells,
local material constants with their orientations, supports and springs, rigid sets as equations on two
reference nodes, and point masses as blocks tied to the structure; it integrates, assembles and solves on its
own, and applies pressures and acceleration fields itself. What is read are nodes whose displacement is the
strain or displacement, by an equation, because printed displacements hold seven digits only.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from numpy.typing import ArrayLike

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import FloatArray, IntArray
from fe.structure.affine import AffineStructure
from fe.structure.supports import SupportedUnknowns

_BLOCK = 0.01  # side of the block that stands for a point mass [m]
Term = tuple[int, int, float]
"""A node, its direction from 1, and what stands with it: a force or a factor."""


class CellMaterial(NamedTuple):
    """What some cells are made of.

    Attributes
    ----------
    courses : list of (float, (9,) Pa)
        CalculiX's nine orthotropic constants at each of some temperatures.
    density : float
        kg/m^3.
    axes : (2, 3)
        Two vectors of the material's axes.
    cells : (m,)
        The cells.
    """

    courses: list[tuple[float, FloatArray]]
    density: float
    axes: FloatArray
    cells: Iterable[int]


class PointBlock(NamedTuple):
    """A point mass [kg], where it is drawn (3,) [m], and the shares (nodes,) in its displacement."""

    mass: float
    place: FloatArray
    shares: FloatArray


class Step(NamedTuple):
    """A step of a job.

    Attributes
    ----------
    load : (n,) N
        What acts, in the place of that of the step before; empty where that stays.
    lines : iterable of str
        Loads that CalculiX applies itself, and what is printed.
    nodal : bool
        Whether the load is given as forces of nodes, and not by lines.
    procedure : tuple of str
        Lines that say what is solved.
    increments : int
        At most so many.
    """

    load: FloatArray = np.empty(0)
    lines: Iterable[str] = ()
    nodal: bool = True
    procedure: tuple[str, ...] = ("*STATIC",)
    increments: int = 100


@dataclass(frozen=True)
class CalculixDeck:
    """A model in one state, as input for CalculiX.

    Attributes
    ----------
    title : str
        What it is.
    structure : AffineStructure
        The model.
    values : mapping of str to float
        Its state by name; what is left out is nominal, and healthy.
    mesh : CellMesh
        Its mesh.
    supports : SupportedUnknowns
        What is held, sprung and rigid; the n free unknowns are in its order.
    materials : tuple of CellMaterial
        What the cells are made of.
    masses : tuple of PointBlock
        Point masses.
    probed : tuple of (n,)
        Rows on the free unknowns that are read behind the gauges and the displacement outputs.
    gauge_cells : (m,)
        Cells that are the set EGAUGES.
    temperatures : (nodes,), optional
        Temperatures of the nodes, where constants of materials depend on them.
    damping : (float, float)
        Rayleigh damping [1/s] and [s] of a step in time.
    """

    title: str
    structure: AffineStructure
    values: Mapping[str, float]
    mesh: CellMesh
    supports: SupportedUnknowns
    materials: tuple[CellMaterial, ...]
    masses: tuple[PointBlock, ...]
    probed: tuple[FloatArray, ...] = ()
    gauge_cells: IntArray | tuple[()] = ()
    temperatures: FloatArray | None = None
    damping: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def probes(self) -> FloatArray:
        """Rows (m, n) of what is read, on the free unknowns."""
        own = (self.structure.gauge_output.toarray(), self.structure.displacement_output.toarray())
        return np.vstack((*own, *self.probed))

    def text(self, *steps: Step) -> str:
        """Input of a job: the model, then its steps."""
        held, motions = self.supports, self._motions
        springs = [(*_place(own), held.springs[own]) for own in np.flatnonzero(held.springs).tolist()]
        fixed = [*map(_place, np.flatnonzero(held.held).tolist())]
        for places, body in zip(motions, held.rigid, strict=True):
            springs += [(*places[own], body.springs[own]) for own in np.flatnonzero(body.springs)]
            fixed += [places[own] for own in np.flatnonzero(body.held)]
        # Behind the nodes of the mesh: two of each rigid set, eight of each point mass, then the probes.
        heavy = [block for block in self.masses if block.mass > 0.0]
        first = len(self.mesh.points) + 2 * len(motions) + 1
        corners = np.arange(first, first + 8 * len(heavy)).reshape(-1, 8).tolist()
        first_probe = first + 8 * len(heavy)
        blocks = [*zip(heavy, corners, strict=True)]
        return _template().render(
            deck=self,
            cells=np.column_stack((np.arange(len(self.mesh.cells)), self.mesh.cells)) + 1,
            rigid_nodes=[
                (places[motion][0], body.point)
                for places, body in zip(motions, held.rigid, strict=True)
                for motion in (0, 3)
            ],
            held=fixed,
            springs=springs,
            blocks=[
                (block.mass, [*zip(nodes, block.place + HEXAHEDRA_20.places[:8] * _BLOCK, strict=True)])
                for block, nodes in blocks
            ],
            block_side=_BLOCK,
            probe_nodes=range(first_probe, first_probe + -(-len(self.probes) // 3)),
            equations=self._equations(blocks, first_probe),
            steps=steps,
        )

    def _equations(
        self, blocks: Iterable[tuple[PointBlock, list[int]]], first_probe: int
    ) -> Iterator[list[Term]]:
        """Yield sums that are zero, of which the first term depends on the others."""
        for places, body in zip(self._motions, self.supports.rigid, strict=True):
            for row, shares in enumerate(body.motions.tolist()):
                moved = [(*place, share) for place, share in zip(places, shares, strict=True) if share]
                yield [(int(body.nodes[row // 3]) + 1, row % 3 + 1, -1.0), *moved]
        for block, nodes in blocks:
            shares = [(own + 1, float(block.shares[own])) for own in np.flatnonzero(block.shares).tolist()]
            for node, component in itertools.product(nodes, (1, 2, 3)):
                yield [(node, component, -1.0), *((own, component, share) for own, share in shares)]
        for number, row in enumerate(self.probes):
            yield [(first_probe + number // 3, number % 3 + 1, -1.0), *self.terms(row)]

    @cached_property
    def _motions(self) -> list[list[tuple[int, int]]]:
        """Node and direction of the six motions of each rigid set: shifts of one node, turns as another's."""
        first = 3 * len(self.mesh.points)
        return [
            [_place(first + 6 * number + motion) for motion in range(6)]
            for number in range(len(self.supports.rigid))
        ]

    @cached_property
    def places(self) -> list[tuple[int, int]]:
        """Node and direction of each free unknown."""
        found = [*map(_place, self.supports.alone.tolist())]
        for places, body in zip(self._motions, self.supports.rigid, strict=True):
            found += [places[motion] for motion in np.flatnonzero(~body.held)]
        return found

    def terms(self, values: FloatArray) -> Iterator[Term]:
        """Yield node, direction and value of the values (n,) that are not zero."""
        for unknown in np.flatnonzero(values).tolist():
            yield (*self.places[unknown], float(values[unknown]))


def _place(unknown: int) -> tuple[int, int]:
    """Return node and direction, both from 1, of an unknown."""
    return unknown // 3 + 1, unknown % 3 + 1


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("fe.verification"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["numbers"] = number_line
    return environment.get_template("calculix.inp.jinja")


def number_line(values: ArrayLike) -> str:
    """Return numbers with the digits of a double, at most 20 characters each, as CalculiX reads them."""
    return ",".join(f"{value:.13E}" for value in np.asarray(values).ravel().tolist())
