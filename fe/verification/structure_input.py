"""A structure as input for CalculiX, on the same mesh; `fe.verification.calculix_job` runs it.

CalculiX gets nodes, cells, materials with their orientations, supports and springs, and applies pressures
and acceleration fields itself; forces on sets and points come as nodal forces. Point masses are blocks tied
to the structure, rigid sets follow two nodes by equations, and outputs are nodes whose displacement is the
strain or displacement, by an equation.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fe.runtime.errors import CalculixError
from fe.structure.design import Load, Material
from fe.structure.elements import WEDGES_6
from fe.structure.operators import Structure
from fe.structure.supports import RigidSet

from .calculix_input import (
    ORTHOTROPIC,
    cell_lines,
    equation_lines,
    frequency_text,
    mass_block_lines,
    number_line,
    probe_lines,
    spring_lines,
)

FloatArray = NDArray[np.float64]

NOT_COMPARABLE = (WEDGES_6,)
"""Kinds that CalculiX integrates otherwise (C3D6 at two points)."""


@dataclass(frozen=True)
class StructureDeck:
    """A structure, undamaged and with nominal parameters and masses, as input for CalculiX.

    Raises
    ------
    CalculixError
        If CalculiX has no element that is integrated in the same way.
    """

    structure: Structure

    def __post_init__(self) -> None:
        kind = self.structure.mesh.kind
        if kind in NOT_COMPARABLE:
            raise CalculixError(
                f"CalculiX integrates {kind.name} ({kind.calculix}) in another way, so that nothing can be "
                "compared; tetrahedra and hexahedra can."
            )

    @property
    def probes(self) -> FloatArray:
        """Rows (gauges + displacements, n) of what is read, on the free unknowns."""
        structure = self.structure
        return np.vstack([structure.gauge_output.toarray(), structure.displacement_output.toarray()])

    @property
    def _node_count(self) -> int:
        """Nodes of the mesh, then two of each rigid set: what these move is its shift and its turn."""
        return len(self.structure.mesh.points) + 2 * len(self.structure.unknowns_held.rigid)

    def _motion_places(self, number: int) -> list[tuple[int, int]]:
        """Node and direction of the six motions of a rigid set."""
        first = len(self.structure.mesh.points) + 1 + 2 * number
        return [(first + motion // 3, motion % 3 + 1) for motion in range(6)]

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        """Node and direction of each free unknown."""
        held = self.structure.unknowns_held
        found = [(unknown // 3 + 1, unknown % 3 + 1) for unknown in held.alone.tolist()]
        for number, body in enumerate(held.rigid):
            motions = self._motion_places(number)
            found += [motions[motion] for motion in np.flatnonzero(~body.held)]
        return found

    def _terms(self, values: FloatArray) -> Iterator[tuple[int, int, float]]:
        """Yield (node, direction, value) of the values (n,) that are not zero."""
        for unknown in np.flatnonzero(values).tolist():
            yield (*self._places[unknown], float(values[unknown]))

    def static_steps(self) -> str:
        """Input of one linear static step for each load, its control at the nominal value."""
        lines = [*self._definition()]
        for load in self.structure.design.load:
            lines += ["*STEP", "*STATIC", *self._load_lines(load), "*NODE PRINT, NSET=NALL", "U"]
            if len(self.probes):
                lines += ["*NODE PRINT, NSET=NPROBES", "U"]
            lines += ["*END STEP"]
        return "\n".join(lines) + "\n"

    def frequency_step(self, count: int) -> str:
        """Input of the lowest undamped modes."""
        return frequency_text(self._definition(), count)

    def _definition(self) -> Iterator[str]:
        yield "*HEADING"
        yield f"structure {self.structure.design_hash[:12]}"
        mesh = self.structure.mesh
        yield from cell_lines(mesh.kind.calculix, mesh.points, mesh.cells)
        yield from self._materials()
        yield from self._supports()
        yield from self._masses()
        yield from self._probe_nodes()

    def _materials(self) -> Iterator[str]:
        structure = self.structure
        for number, part in enumerate(structure.design.material):
            cells = np.flatnonzero(structure.material_of == number)
            yield f"*MATERIAL, NAME=M{number}"
            yield from _elastic_lines(part, structure.parameters.get(part.scaled_by or "", 1.0))
            yield "*DENSITY"
            yield number_line([part.density])
            orientation = ""
            if part.axes is not None:
                yield f"*ORIENTATION, NAME=O{number}, SYSTEM=RECTANGULAR"
                yield number_line([*part.axes[0], *part.axes[1]])
                orientation = f", ORIENTATION=O{number}"
            yield f"*ELSET, ELSET=E{number}"
            yield from (str(cell + 1) for cell in cells)
            yield f"*SOLID SECTION, ELSET=E{number}, MATERIAL=M{number}{orientation}"

    def _supports(self) -> Iterator[str]:
        held = self.structure.unknowns_held
        yield "*BOUNDARY"
        for unknown in np.flatnonzero(held.held).tolist():
            yield f"{unknown // 3 + 1},{unknown % 3 + 1}"
        element = len(self.structure.mesh.cells)
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
        structure, held = self.structure, self.structure.unknowns_held
        springs = sum(
            int((part > 0.0).sum()) for part in (held.springs, *(body.springs for body in held.rigid))
        )
        element = len(structure.mesh.cells) + springs + 1
        node = self._node_count + 1
        yield "*ELSET, ELSET=EHEAVY"
        yield "EALL"
        for number, part in enumerate(structure.design.mass):
            if part.mass <= 0.0:
                continue
            shares = structure.point_weights[part.name]
            weights = {int(n): float(shares[n]) for n in np.flatnonzero(shares)}
            place = structure.mesh.unit * np.asarray(part.point)
            yield from mass_block_lines(number, part.mass, place, weights, node, element)
            yield "*ELSET, ELSET=EHEAVY"
            yield f"MASS{number}"
            node, element = node + 8, element + 1

    def _probe_nodes(self) -> Iterator[str]:
        first = self._node_count + 8 * len(self.structure.design.mass) + 1
        yield from probe_lines(first, map(list, map(self._terms, self.probes)))

    def _load_lines(self, load: Load) -> Iterator[str]:
        structure, mesh = self.structure, self.structure.mesh
        factor = 1.0 if load.control is None else structure.controls[load.control]
        yield "*CLOAD, OP=NEW"
        yield "1,1,0."
        if load.force is not None:
            for node, direction, value in self._terms(structure.load(load.name)):
                yield f"{node},{direction},{value:.13E}"
        yield "*DLOAD, OP=NEW"
        if load.acceleration is not None:
            size = float(np.linalg.norm(load.acceleration))
            direction = np.sign(factor) * np.asarray(load.acceleration) / size
            yield f"EHEAVY,GRAV,{number_line([abs(factor) * size, *direction])}"
        elif load.pressure is not None and load.set is not None:
            surface = mesh.faces_of(load.set, load.name)
            for cell, face in zip(surface.cell, surface.face, strict=True):
                yield f"{cell + 1},P{face + 1},{factor * load.pressure:.13E}"
        else:
            yield "EALL,GRAV,0.,0.,0.,1."


def _elastic_lines(part: Material, factor: float) -> Iterator[str]:
    local = factor * np.linalg.inv(part.compliance)
    constants = [float(local[row, column]) for row, column in ORTHOTROPIC]
    yield "*ELASTIC, TYPE=ORTHO"
    yield number_line(constants[:8])
    yield number_line([constants[8], 0.0])
