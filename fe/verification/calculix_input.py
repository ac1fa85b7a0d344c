"""The same wing as input for CalculiX; `fe.verification.calculix_job` runs it and reads the results.

CalculiX (`ccx`, Debian package calculix-ccx) is an independent finite element code. It gets the identical
mesh as C3D20 elements, local material constants with an orientation for each cell, the rigid root rib as
equations on a reference node that sits on springs, the point masses as blocks tied to the skins, and the
nodal loads; it integrates, assembles and solves on its own. The gauges are nodes whose displacement is the
strain, by an equation, because the printed displacements hold seven digits only.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHexS2

from fe.full.assembly import cell_axes, rotate_elasticity
from fe.full.operators import ROOT_UNKNOWNS, AffineOperators, cell_density, cell_elasticity
from fe.runtime.state import Losses
from fe.structure.elements import HEXAHEDRA_20

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PER_LINE, _NODES_PER_LINE = 4, 12
_BLOCK = 0.01  # side of the block that stands for a point mass [m]

_LINE = 0.5 + 0.5 * np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
INTEGRATION_POINTS = np.array([(x, y, z) for z in _LINE for y in _LINE for x in _LINE])
"""Local places (27, 3) in 0..1 of the integration points of a C3D20 element, in the order of its output."""


@dataclass(frozen=True)
class CalculixModel:
    """The wing in one state, as input for CalculiX.

    Attributes
    ----------
    operators : AffineOperators
        Mesh and free unknowns.
    young_modulus_factor, stiffness_loss, servo_mass, pitot_mass, damping_alpha, damping_beta
        As of `fe.runtime.state.DigitalState`.
    """

    operators: AffineOperators
    young_modulus_factor: float = 1.0
    stiffness_loss: Losses = ()
    servo_mass: float = 0.169
    pitot_mass: float = 0.134
    damping_alpha: float = 0.0
    damping_beta: float = 0.0

    @property
    def node_count(self) -> int:
        """Number of nodes of the mesh; the root's reference node follows them."""
        return len(self.operators.discretisation.node_points)

    @property
    def probes(self) -> FloatArray:
        """Outputs (2 + gauges, n): displacement at the test load, at the tip, then the gauge strains."""
        operators = self.operators
        return np.vstack(
            (
                operators.displacement_output,
                operators.tip_displacement_output,
                operators.gauge_output.toarray(),
            )
        )

    @property
    def gauge_cells(self) -> IntArray:
        """Numbers of the cells that hold the middle of a gauge."""
        mesh = self.operators.wing_mesh
        plan = mesh.design.planform
        cells = [
            mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
            for distance, chord in mesh.design.gauges.positions
        ]
        return np.unique(cells)

    def definition(self) -> Iterator[str]:
        """Yield the lines of the model definition, before the first step."""
        yield "*HEADING"
        yield f"wing, design {self.operators.design_hash[:12]}"
        yield from self._nodes_and_cells()
        yield from self._materials()
        yield from self._root()
        yield from self._masses()
        yield from self._probe_nodes()

    def static_steps(self, loads: Sequence[FloatArray]) -> str:
        """Input of one linear static step for each load (n,) of the free unknowns.

        It prints the displacement of all nodes, the probes and the strain of `gauge_cells`.
        """
        lines = [*self.definition()]
        for load in loads:
            lines += ["*STEP", "*STATIC", *self._load_lines(load), "*NODE PRINT, NSET=NALL", "U"]
            lines += ["*NODE PRINT, NSET=NPROBES", "U"]
            lines += ["*EL PRINT, ELSET=EGAUGES, GLOBAL=YES", "E", "*END STEP"]
        return "\n".join(lines) + "\n"

    def frequency_step(self, count: int) -> str:
        """Input of the lowest undamped modes."""
        return frequency_text(self.definition(), count)

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
        lines = [*self.definition(), "*STEP", "*STATIC", *self._load_lines(load)]
        # CalculiX balances energy in a dynamic step and wants it asked for from the first step on.
        lines += ["*EL PRINT, ELSET=E0", "ENER", "*END STEP"]
        lines += [f"*STEP, INC={steps + 10}", "*DYNAMIC, DIRECT, ALPHA=0."]
        lines += [f"{increment:.12E},{increment * steps:.12E}"]
        lines += [*self._load_lines(0.0 * load), "*NODE PRINT, NSET=NPROBES, FREQUENCY=1", "U", "*END STEP"]
        return "\n".join(lines) + "\n"

    def _nodes_and_cells(self) -> Iterator[str]:
        body, given = self.operators.discretisation, ElementHexS2().doflocs
        order = [
            int(np.flatnonzero(np.all(np.equal(given, place), axis=1))[0]) for place in HEXAHEDRA_20.places
        ]
        yield from cell_lines("C3D20", body.node_points, body.cell_nodes[:, order])
        yield "*ELSET, ELSET=EGAUGES"
        yield from (str(cell + 1) for cell in self.gauge_cells)

    def _materials(self) -> Iterator[str]:
        mesh = self.operators.wing_mesh
        axes = cell_axes(mesh.corners)
        # Constants in the cell's own axes; CalculiX turns them by the orientation.
        local = rotate_elasticity(cell_elasticity(mesh), np.swapaxes(axes, 1, 2))
        factor = self.operators.theta(self.young_modulus_factor, self.stiffness_loss)[mesh.stiffness_term]
        constants = np.column_stack([local[:, row, column] for row, column in ORTHOTROPIC])
        constants *= factor[:, None]
        density = cell_density(mesh)
        graded = self._graded
        if graded.any():
            centre = mesh.design.skin.young_modulus(mesh.centres[graded, 1] / mesh.design.planform.semi_span)
            constants[graded] /= centre[:, None]
        stations = mesh.design.skin.stations
        rounded = [
            (bool(varies), *(f"{value:.10E}" for value in (*row, mass)))
            for varies, row, mass in zip(graded, constants, density, strict=True)
        ]
        materials = {key: number for number, key in enumerate(dict.fromkeys(rounded))}
        for key, number in materials.items():
            first = rounded.index(key)
            courses = [(place.station, place.young_modulus) for place in stations] if key[0] else [(0.0, 1.0)]
            yield f"*MATERIAL, NAME=M{number}"
            yield "*ELASTIC, TYPE=ORTHO"
            for temperature, modulus in courses:
                row = modulus * constants[first]
                yield number_line(row[:8])
                yield number_line((*row[8:], temperature))
            yield "*DENSITY"
            yield number_line(density[first : first + 1])
            if self.damping_alpha or self.damping_beta:
                yield f"*DAMPING, ALPHA={self.damping_alpha:.12E}, BETA={self.damping_beta:.12E}"
        if graded.any():
            # The station of a node stands as its temperature, on which the skin's constants depend.
            yield "*INITIAL CONDITIONS, TYPE=TEMPERATURE"
            span = mesh.design.planform.semi_span
            for node, place in enumerate(self.operators.discretisation.node_points[:, 1] / span, start=1):
                yield f"{node},{place:.13E}"
        for cell, key in enumerate(rounded):
            yield f"*ORIENTATION, NAME=O{cell}, SYSTEM=RECTANGULAR"
            yield number_line(axes[cell, :2].ravel())
            yield f"*ELSET, ELSET=E{cell}"
            yield str(cell + 1)
            yield f"*SOLID SECTION, ELSET=E{cell}, MATERIAL=M{materials[key]}, ORIENTATION=O{cell}"

    @property
    def _graded(self) -> NDArray[np.bool_]:
        """Whether Young's modulus changes inside a cell (nc,)."""
        mesh = self.operators.wing_mesh
        return (mesh.web < 0) & (mesh.rib < 0) & bool(mesh.design.skin.stations)

    def _root(self) -> Iterator[str]:
        """Yield the reference node, whose displacements are heave, flap and yaw, its springs and the rib."""
        points, root = self.operators.discretisation.node_points, self.operators.wing_mesh.design.root
        reference = self.node_count + 1
        yield "*NODE"
        yield f"{reference},0.,0.,0."
        springs = (root.transverse_spring, root.flap_spring, root.yaw_spring)
        for number, spring in enumerate(springs, start=1):
            element = len(self.operators.wing_mesh.cells) + number
            yield from spring_lines(f"SPRING{number}", element, [reference], number, spring)
        span = self.operators.wing_mesh.design.planform.semi_span
        on_root: list[int] = np.flatnonzero(np.abs(points[:, 1]) < 1e-9 * span).tolist()
        for node in on_root:
            yield from equation_lines([(node + 1, 3, -1.0), (reference, 1, 1.0)])
            terms = [
                (node + 1, 2, -1.0),
                (reference, 2, -float(points[node, 2])),
                (reference, 3, float(points[node, 0])),
            ]
            yield from equation_lines(term for term in terms if term[2] != 0.0)
        yield "*BOUNDARY"
        for node in on_root:
            yield f"{node + 1},1"

    def _masses(self) -> Iterator[str]:
        """Yield a block for each point mass, all its nodes tied to the mean of the two skins."""
        mesh, body = self.operators.wing_mesh, self.operators.discretisation
        design = mesh.design
        first_element = len(mesh.cells) + ROOT_UNKNOWNS + 1
        for number, place in enumerate(design.point_masses):
            first = self.node_count + 2 + 8 * number
            distance = place.station * design.planform.semi_span
            behind = place.chord * design.planform.chord(place.station)
            weights: dict[int, float] = {}
            for upper in (True, False):
                point = mesh.skin_point(distance, behind, upper=upper)
                for other, value in zip(*body.point_values(point.cell, point.local), strict=True):
                    if value != 0.0:
                        weights[int(other)] = weights.get(int(other), 0.0) + 0.5 * float(value)
            mass = self.servo_mass if place.kind == "servo" else self.pitot_mass
            if mass <= 0.0:
                continue
            place_of_block = np.array([0.0, distance, 0.0])
            yield from mass_block_lines(number, mass, place_of_block, weights, first, first_element + number)

    def _probe_nodes(self) -> Iterator[str]:
        first = self.node_count + 2 + 8 * len(self.operators.wing_mesh.design.point_masses)
        yield from probe_lines(first, map(list, map(self._terms, self.probes)))

    def _terms(self, free: FloatArray) -> Iterator[tuple[int, int, float]]:
        """Yield (node, direction, value) of the values (n,) of free unknowns that are not zero."""
        places = np.asarray(self.operators.expansion[:, :-ROOT_UNKNOWNS].tocsc().indices)
        for unknown in np.flatnonzero(free):
            if unknown < len(places):
                node, component = divmod(int(places[unknown]), 3)
                yield node + 1, component + 1, float(free[unknown])
            else:
                yield self.node_count + 1, int(unknown) - len(places) + 1, float(free[unknown])

    def _load_lines(self, load: FloatArray) -> Iterator[str]:
        yield "*CLOAD, OP=NEW"
        if not load.any():
            yield f"{self.node_count},3,0."
        for node, direction, value in self._terms(load):
            yield f"{node},{direction},{value:.13E}"


ORTHOTROPIC = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (5, 5), (4, 4), (3, 3))
"""Rows and columns of an elasticity in the order of CalculiX's nine orthotropic constants."""


def frequency_text(definition: Iterable[str], count: int) -> str:
    """Return the input of the lowest undamped modes of a model."""
    return "\n".join([*definition, "*STEP", "*FREQUENCY", str(count), "*END STEP"]) + "\n"


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


def mass_block_lines(
    number: int, mass: float, place: FloatArray, weights: Mapping[int, float], node: int, element: int
) -> Iterator[str]:
    """Yield a point mass [kg] as a block that moves with the weighted mean of nodes, as element set MASSn.

    The block only translates, so that its elasticity does not count. CalculiX 2.20 ends with an error in
    `add_sm_st` when an element of type MASS sits on a node that depends on others.

    Parameters
    ----------
    number : int
        Number n of the mass.
    mass : float
        The mass [kg].
    place : (3,)
        Where the block is drawn [m].
    weights : mapping of int to float
        Nodes, counted from 0, and their shares in the displacement.
    node, element : int
        The first of its eight nodes, and its element, as numbers that are free.
    """
    yield "*NODE"
    for corner, local in enumerate(HEXAHEDRA_20.places[:8] * _BLOCK):
        yield f"{node + corner},{number_line(place + local)}"
    yield f"*ELEMENT, TYPE=C3D8, ELSET=MASS{number}"
    yield ",".join(str(n) for n in (element, *range(node, node + 8)))
    yield f"*MATERIAL, NAME=MASS{number}"
    yield "*ELASTIC"
    yield "1.E6,0."
    yield "*DENSITY"
    yield f"{mass / _BLOCK**3:.13E}"
    yield f"*SOLID SECTION, ELSET=MASS{number}, MATERIAL=MASS{number}"
    for own in range(node, node + 8):
        for component in (1, 2, 3):
            yield from equation_lines(
                [(own, component, -1.0), *((n + 1, component, w) for n, w in weights.items())]
            )
