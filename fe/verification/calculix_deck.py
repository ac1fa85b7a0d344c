"""A model as input for CalculiX; `fe.verification.calculix_job` runs it and reads the results.

CalculiX (`ccx`, Debian package calculix-ccx) is an independent finite element code. It gets nodes, cells,
local material constants with their orientations, supports and springs, rigid sets as equations on two
reference nodes, and point masses as blocks tied to the structure; it integrates, assembles and solves on its
own, and applies pressures and acceleration fields itself. What is read are nodes whose displacement is the
strain or displacement, by an equation, because printed displacements hold seven digits only.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.elements.kinds import HEXAHEDRA_20
from fe.structure.supports import RigidSet, SupportedUnknowns

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PER_LINE, _NODES_PER_LINE = 4, 12
_BLOCK = 0.01  # side of the block that stands for a point mass [m]


class PointBlock(NamedTuple):
    """A point mass [kg], where it is drawn (3,) [m], and the shares of nodes in its displacement."""

    mass: float
    place: FloatArray
    weights: Mapping[int, float]


@dataclass(frozen=True)
class CalculixDeck:
    """A model in one state, as input for CalculiX.

    Attributes
    ----------
    title : str
        What it is.
    kind : str
        CalculiX' name of its elements.
    points : (nodes, 3) m
        Nodes.
    cells : (nc, k)
        Nodes of the cells, counted from 0, in CalculiX' order.
    materials : tuple of str
        Lines of materials, orientations and sections.
    supports : SupportedUnknowns
        What is held, sprung and rigid; the n free unknowns are in its order.
    masses : tuple of PointBlock
        Point masses.
    probes : (m, n)
        Rows of what is read, on the free unknowns.
    """

    title: str
    kind: str
    points: FloatArray
    cells: IntArray
    materials: tuple[str, ...]
    supports: SupportedUnknowns
    masses: tuple[PointBlock, ...]
    probes: FloatArray

    def definition(self) -> Iterator[str]:
        """Yield the lines of the model definition, before the first step."""
        yield "*HEADING"
        yield self.title
        yield from cell_lines(self.kind, self.points, self.cells)
        yield from self.materials
        yield from self._supports()
        yield from self._masses()
        first = self._node_count + 8 * len(self.masses) + 1
        yield from probe_lines(first, map(list, map(self._terms, self.probes)))

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
        return len(self.points) + 2 * len(self.supports.rigid)

    def _motion_places(self, number: int) -> list[tuple[int, int]]:
        """Node and direction of the six motions of a rigid set."""
        first = len(self.points) + 1 + 2 * number
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

    def _supports(self) -> Iterator[str]:
        held = self.supports
        yield "*BOUNDARY"
        for unknown in np.flatnonzero(held.held).tolist():
            yield f"{unknown // 3 + 1},{unknown % 3 + 1}"
        element = len(self.cells)
        axes = np.arange(len(held.springs)) % 3
        for axis in range(3):
            values = np.where(axes == axis, held.springs, 0.0)
            for group, spring in enumerate(np.unique(values[values > 0.0])):
                nodes = (np.flatnonzero(values == spring) // 3 + 1).tolist()
                yield from spring_lines(f"SPRING{axis}X{group}", element + 1, nodes, axis + 1, spring)
                element += len(nodes)
        for number, body in enumerate(held.rigid):
            yield from self._rigid_lines(number, body, element)
            element += int((body.springs > 0.0).sum())

    def _rigid_lines(self, number: int, body: RigidSet, element: int) -> Iterator[str]:
        """Yield the motions of a rigid set, what holds and springs them, and the nodes that follow them."""
        places = self._motion_places(number)
        yield "*NODE"
        for node in (places[0][0], places[3][0]):
            yield f"{node},{number_line(body.point)}"
        yield "*BOUNDARY"
        for motion in np.flatnonzero(body.held).tolist():
            yield "{},{}".format(*places[motion])
        for motion in np.flatnonzero(body.springs > 0.0).tolist():
            element += 1
            node, direction = places[motion]
            name = f"RIGID{number}X{motion}"
            yield from spring_lines(name, element, [node], direction, body.springs[motion])
        for row, shares in enumerate(body.motions.tolist()):
            moved = [(*place, share) for place, share in zip(places, shares, strict=True) if share]
            yield from equation_lines([(int(body.nodes[row // 3]) + 1, row % 3 + 1, -1.0), *moved])

    def _masses(self) -> Iterator[str]:
        springs = (self.supports.springs, *(body.springs for body in self.supports.rigid))
        element = len(self.cells) + sum(int((part > 0.0).sum()) for part in springs) + 1
        yield "*ELSET, ELSET=EHEAVY"
        yield "EALL"
        for number, block in enumerate(self.masses):
            if block.mass <= 0.0:
                continue
            yield from mass_block_lines(number, block, self._node_count + 1 + 8 * number, element + number)
            yield "*ELSET, ELSET=EHEAVY"
            yield f"MASS{number}"


def cell_lines(kind: str, points: FloatArray, cells: IntArray) -> Iterator[str]:
    """Yield nodes (n, 3) [m] and cells (c, k), which count nodes from 0, of a kind of CalculiX."""
    yield "*NODE, NSET=NALL"
    for number, point in enumerate(points, start=1):
        yield f"{number},{number_line(point)}"
    yield f"*ELEMENT, TYPE={kind}, ELSET=EALL"
    for number, nodes in enumerate(cells + 1, start=1):
        text = [str(value) for value in (number, *nodes)]
        for start in range(0, len(text), _NODES_PER_LINE):
            rest = "," if start + _NODES_PER_LINE < len(text) else ""
            yield ",".join(text[start : start + _NODES_PER_LINE]) + rest


def spring_lines(
    name: str, element: int, nodes: Iterable[int], direction: int, stiffness: float
) -> Iterator[str]:
    """Yield springs [N/m] of nodes to the ground along a direction, their elements from `element` on."""
    yield f"*ELEMENT, TYPE=SPRING1, ELSET={name}"
    for number, node in enumerate(nodes, start=element):
        yield f"{number},{node}"
    yield f"*SPRING, ELSET={name}"
    yield str(direction)
    yield number_line([stiffness])


def probe_lines(first: int, probes: Iterable[list[tuple[int, int, float]]]) -> Iterator[str]:
    """Yield nodes from `first` on whose displacements are read, each of terms (node, direction, share)."""
    found = list(probes)
    if found:
        yield "*NODE, NSET=NPROBES"
    for node in range(first, first + (len(found) + 2) // 3):
        yield f"{node},0.,0.,0."
    for number, terms in enumerate(found):
        yield from equation_lines([(first + number // 3, number % 3 + 1, -1.0), *terms])


def number_line(values: Iterable[float]) -> str:
    """Return numbers with the digits of a double, at most 20 characters each, as CalculiX reads them."""
    return ",".join(f"{value:.13E}" for value in values)


def equation_lines(terms: Iterable[tuple[int, int, float]]) -> Iterator[str]:
    """Yield an equation: the terms (node, direction, factor) are zero together, the first one depends."""
    text = [f"{node},{direction},{value:.13E}" for node, direction, value in terms]
    yield "*EQUATION"
    yield str(len(text))
    for start in range(0, len(text), _PER_LINE):
        yield ",".join(text[start : start + _PER_LINE])


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
    for own in range(node, node + 8):
        for component in (1, 2, 3):
            yield from equation_lines(
                [(own, component, -1.0), *((n + 1, component, w) for n, w in block.weights.items())]
            )
