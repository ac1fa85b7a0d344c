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
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import FloatArray
from fe.structure.affine import AffineStructure
from fe.structure.supports import RigidSet, SupportedUnknowns

_PER_LINE, _NODES_PER_LINE = 4, 12
_BLOCK = 0.01  # side of the block that stands for a point mass [m]


class PointBlock(NamedTuple):
    """A point mass [kg], where it is drawn (3,) [m], and the shares (nodes,) in its displacement."""

    mass: float
    place: FloatArray
    shares: FloatArray


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
    materials : tuple of str
        Lines of materials, orientations and sections.
    masses : tuple of PointBlock
        Point masses.
    probed : tuple of (n,)
        Rows on the free unknowns that are read behind the gauges and the displacement outputs.
    """

    title: str
    structure: AffineStructure
    values: Mapping[str, float]
    mesh: CellMesh
    supports: SupportedUnknowns
    materials: tuple[str, ...]
    masses: tuple[PointBlock, ...]
    probed: tuple[FloatArray, ...] = ()

    @cached_property
    def probes(self) -> FloatArray:
        """Rows (m, n) of what is read, on the free unknowns."""
        own = (self.structure.gauge_output.toarray(), self.structure.displacement_output.toarray())
        return np.vstack((*own, *self.probed))

    def definition(self) -> Iterator[str]:
        """Yield the lines of the model definition, before the first step."""
        yield "*HEADING"
        yield f"{self.title} {self.structure.design_hash[:12]}"
        yield "*NODE, NSET=NALL"
        for number, point in enumerate(self.mesh.points, start=1):
            yield f"{number},{number_line(point)}"
        yield f"*ELEMENT, TYPE={self.mesh.kind.calculix}, ELSET=EALL"
        for number, nodes in enumerate(self.mesh.cells + 1, start=1):
            yield from wrapped([str(value) for value in (number, *nodes)], _NODES_PER_LINE, end=",")
        yield from self.materials
        elements = itertools.count(len(self.mesh.cells) + 1)
        yield from self._supports(elements)
        yield from self._masses(elements)
        first = self._node_count + 8 * len(self.masses) + 1
        if len(self.probes):
            yield "*NODE, NSET=NPROBES"
        for node in range(first, first + (len(self.probes) + 2) // 3):
            yield f"{node},0.,0.,0."
        for number, row in enumerate(self.probes):
            yield from equation_lines([(first + number // 3, number % 3 + 1, -1.0), *self._terms(row)])

    def static_steps(self, loads: Iterable[Iterable[str]], prints: Iterable[str] = ()) -> str:
        """Input of one linear static step for each load, which prints all nodes, the probes, and `prints`."""
        lines = [*self.definition()]
        for load in loads:
            lines += ["*STEP", "*STATIC", *load, "*NODE PRINT, NSET=NALL", "U"]
            if len(self.probes):
                lines += ["*NODE PRINT, NSET=NPROBES", "U"]
            lines += [*prints, "*END STEP"]
        return "\n".join(lines) + "\n"

    def frequency_step(self, count: int) -> str:
        """Input of the lowest undamped modes."""
        return "\n".join([*self.definition(), "*STEP", "*FREQUENCY", str(count), "*END STEP"]) + "\n"

    def ring_down_steps(self, load: FloatArray, increment: float, steps: int) -> str:
        """Input of a static load (n,) and its sudden removal: direct integration by the trapezoidal rule.

        Parameters
        ----------
        load : (n,) N
            Load that is removed at time zero.
        increment : float
            Fixed time increment [s].
        steps : int
            Number of increments.
        """
        lines = [*self.definition(), "*STEP", "*STATIC", *self.force_lines(load)]
        # CalculiX balances energy in a dynamic step and wants it asked for from the first step on.
        lines += ["*EL PRINT, ELSET=E0", "ENER", "*END STEP"]
        lines += [f"*STEP, INC={steps + 10}", "*DYNAMIC, DIRECT, ALPHA=0."]
        lines += [f"{increment:.12E},{increment * steps:.12E}"]
        lines += [*self.force_lines(0.0 * load), "*NODE PRINT, NSET=NPROBES, FREQUENCY=1", "U", "*END STEP"]
        return "\n".join(lines) + "\n"

    def force_lines(self, load: FloatArray) -> Iterator[str]:
        """Yield nodal forces (n,) in the place of those of the step before."""
        yield "*CLOAD, OP=NEW"
        yield f"{self._places[0][0]},{self._places[0][1]},0."
        for node, direction, value in self._terms(load):
            yield f"{node},{direction},{value:.13E}"

    @property
    def _node_count(self) -> int:
        """Nodes of the mesh, then two of each rigid set: what these move is its shift and its turn."""
        return len(self.mesh.points) + 2 * len(self.supports.rigid)

    def _motion_places(self, number: int) -> list[tuple[int, int]]:
        """Node and direction of the six motions of a rigid set."""
        first = len(self.mesh.points) + 1 + 2 * number
        return [(first + motion // 3, motion % 3 + 1) for motion in range(6)]

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        """Node and direction of each free unknown."""
        found = [(unknown // 3 + 1, unknown % 3 + 1) for unknown in self.supports.alone.tolist()]
        for number, body in enumerate(self.supports.rigid):
            motions = self._motion_places(number)
            found += [motions[motion] for motion in np.flatnonzero(~body.held)]
        return found

    def _terms(self, values: FloatArray) -> Iterator[tuple[int, int, float]]:
        """Yield (node, direction, value) of the values (n,) that are not zero."""
        for unknown in np.flatnonzero(values).tolist():
            yield (*self._places[unknown], float(values[unknown]))

    def _supports(self, elements: Iterator[int]) -> Iterator[str]:
        held = self.supports
        yield "*BOUNDARY"
        for unknown in np.flatnonzero(held.held).tolist():
            yield f"{unknown // 3 + 1},{unknown % 3 + 1}"
        for unknown in np.flatnonzero(held.springs > 0.0).tolist():
            place = (unknown // 3 + 1, unknown % 3 + 1)
            yield from spring_lines(next(elements), place, held.springs[unknown])
        for number, body in enumerate(held.rigid):
            yield from self._rigid_lines(self._motion_places(number), body, elements)

    def _rigid_lines(
        self, places: list[tuple[int, int]], body: RigidSet, elements: Iterator[int]
    ) -> Iterator[str]:
        """Yield the motions of a rigid set, what holds and springs them, and the nodes that follow them."""
        yield "*NODE"
        for node in (places[0][0], places[3][0]):
            yield f"{node},{number_line(body.point)}"
        yield "*BOUNDARY"
        for motion in np.flatnonzero(body.held).tolist():
            yield "{},{}".format(*places[motion])
        for motion in np.flatnonzero(body.springs > 0.0).tolist():
            yield from spring_lines(next(elements), places[motion], body.springs[motion])
        for row, shares in enumerate(body.motions.tolist()):
            moved = [(*place, share) for place, share in zip(places, shares, strict=True) if share]
            yield from equation_lines([(int(body.nodes[row // 3]) + 1, row % 3 + 1, -1.0), *moved])

    def _masses(self, elements: Iterator[int]) -> Iterator[str]:
        yield "*ELSET, ELSET=EHEAVY"
        yield "EALL"
        for number, block in enumerate(self.masses):
            if block.mass > 0.0:
                yield from mass_block_lines(number, block, self._node_count + 1 + 8 * number, next(elements))
                yield "*ELSET, ELSET=EHEAVY"
                yield f"MASS{number}"


def wrapped(parts: list[str], count: int, end: str = "") -> Iterator[str]:
    """Yield lines of `count` parts each; all but the last end in `end`."""
    for start in range(0, len(parts), count):
        rest = end if start + count < len(parts) else ""
        yield ",".join(parts[start : start + count]) + rest


def spring_lines(element: int, place: tuple[int, int], stiffness: float) -> Iterator[str]:
    """Yield a spring [N/m] to the ground of a node along a direction."""
    node, direction = place
    yield f"*ELEMENT, TYPE=SPRING1, ELSET=SPRING{element}"
    yield f"{element},{node}"
    yield f"*SPRING, ELSET=SPRING{element}"
    yield str(direction)
    yield number_line([stiffness])


def number_line(values: Iterable[float]) -> str:
    """Return numbers with the digits of a double, at most 20 characters each, as CalculiX reads them."""
    return ",".join(f"{value:.13E}" for value in values)


def equation_lines(terms: Iterable[tuple[int, int, float]]) -> Iterator[str]:
    """Yield an equation: the terms (node, direction, factor) are zero together, the first one depends."""
    text = [f"{node},{direction},{value:.13E}" for node, direction, value in terms]
    yield "*EQUATION"
    yield str(len(text))
    yield from wrapped(text, _PER_LINE)


def mass_block_lines(number: int, block: PointBlock, node: int, element: int) -> Iterator[str]:
    """Yield a point mass [kg] as a block that moves with the weighted mean of nodes, as element set MASSn.

    The block only translates, so that its elasticity does not count. CalculiX 2.20 ends with an error in
    `add_sm_st` when an element of type MASS sits on a node that depends on others.

    Parameters
    ----------
    number : int
        Number n of the mass.
    block : PointBlock
        The mass.
    node, element : int
        The first of its eight nodes, and its element, as numbers that are free.
    """
    yield "*NODE"
    for corner, local in enumerate(HEXAHEDRA_20.places[:8] * _BLOCK):
        yield f"{node + corner},{number_line(block.place + local)}"
    yield f"*ELEMENT, TYPE=C3D8, ELSET=MASS{number}"
    yield ",".join(str(n) for n in (element, *range(node, node + 8)))
    yield f"*MATERIAL, NAME=MASS{number}"
    yield "*ELASTIC"
    yield "1.E6,0."
    yield "*DENSITY"
    yield f"{block.mass / _BLOCK**3:.13E}"
    yield f"*SOLID SECTION, ELSET=MASS{number}, MATERIAL=MASS{number}"
    shares = [(other + 1, float(block.shares[other])) for other in np.flatnonzero(block.shares).tolist()]
    for own in range(node, node + 8):
        for component in (1, 2, 3):
            moved = [(other, component, share) for other, share in shares]
            yield from equation_lines([(own, component, -1.0), *moved])
