"""Input of CalculiX for structures and the wing.

CalculiX (`ccx`, Debian package calculix-ccx) is an independent finite element code. It gets nodes,
cells, local material constants with their orientations, supports and springs, rigid sets as
equations on two reference nodes, and point masses as blocks tied to the structure. It integrates,
assembles and solves on its own, and applies pressures and acceleration fields itself. Strains and
displacement outputs are read as displacements of probe nodes, which equations make equal to them,
because printed displacements have seven digits only.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from typing import NamedTuple

import numpy as np
from jinja2 import StrictUndefined, Template
from numpy.typing import ArrayLike
from scipy import sparse

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20, WEDGES_6
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.structure.affine import AffineStructure
from fe.structure.body import Body
from fe.structure.design import MeshLoad
from fe.structure.operators import Structure
from fe.wing.operators import AffineOperators, wing_values

CALCULIX_STRAINS = [0, 1, 2, 5, 4, 3]
"""Indices of our strains in the order of CalculiX: xx, yy, zz, xy, xz, yz."""
# CalculiX's 21 anisotropic constants are the upper triangle of the elasticity, column by column.
_COLUMNS, _ROWS = np.tril_indices(6)
_ANISOTROPIC_ROWS = np.array(CALCULIX_STRAINS)[_ROWS]
_ANISOTROPIC_COLUMNS = np.array(CALCULIX_STRAINS)[_COLUMNS]
TEST_FORCE = 10.0
"""Upward force of the static test of a wing, and before its ring-down [N]."""
_BLOCK_SIDE = 0.01
"""Side of the block that represents a point mass [m]."""


class Term(NamedTuple):
    """A nodal force, or a term of an equation.

    Attributes
    ----------
    node, direction : int
        Node and direction, both from 1.
    value : float
        The force [N] or the factor.
    """

    node: int
    direction: int
    value: float


class Step(NamedTuple):
    """A step of a job.

    Attributes
    ----------
    load : (n,) array
        The load [N], which replaces that of the previous step; empty if that stays.
    lines : iterable of str
        Loads that CalculiX applies itself, and the printed results.
    nodal : bool
        Whether the load is given as nodal forces instead of lines.
    procedure : tuple of str
        Lines that select the problem to solve.
    """

    load: FloatArray = np.empty(0)
    lines: Iterable[str] = ()
    nodal: bool = True
    procedure: tuple[str, ...] = ("*STATIC",)


class Grading(NamedTuple):
    """Elasticity that varies within cells, which the deck describes as temperature-dependent.

    The nodes get artificial temperatures, between which CalculiX interpolates the elasticity.

    Attributes
    ----------
    course : list of (float, float)
        Temperatures, ascending, each with the factor on the elasticity.
    temperatures : (nodes,) array
        Temperatures of the nodes.
    cells : (nc,) array of bool
        The cells in which the elasticity changes; in others the factor is one.
    """

    course: list[tuple[float, float]]
    temperatures: FloatArray
    cells: BoolArray


class Material(NamedTuple):
    """A material of a deck.

    Attributes
    ----------
    constants : list of (float, (21,) array)
        Temperatures, each with the anisotropic constants of CalculiX [Pa].
    density : float
        Density [kg/m^3].
    cells : (m,) array of int
        The cells of the material.
    """

    constants: list[tuple[float, FloatArray]]
    density: float
    cells: IntArray


class MassBlock(NamedTuple):
    """A block that represents a point mass.

    Attributes
    ----------
    mass : float
        The mass [kg].
    weights : (nodes,) array
        Weights of the nodes in the displacement of the point.
    corners : list of int
        Numbers of the eight corner nodes, from 1.
    """

    mass: float
    weights: FloatArray
    corners: list[int]


@dataclass(frozen=True)
class CalculixDeck:
    """A model in one state, as input for CalculiX.

    Attributes
    ----------
    title : str
        The title of the job.
    body : Body
        Mesh, materials and supports; the n free unknowns are in the order of its supports.
    values : mapping of str to float
        The state of the structure by name; all other values are nominal, and losses are zero.
    loads : mapping of str to Step
        Static steps, one for each load.
    grading : Grading, optional
        Elasticity that varies inside cells.
    damping : (float, float)
        Rayleigh damping [1/s] and [s] of a step in time.
    """

    title: str
    structure: AffineStructure
    body: Body[CellMesh]
    values: Mapping[str, float]
    loads: Mapping[str, Step]
    grading: Grading | None = None
    damping: tuple[float, float] = (0.0, 0.0)

    @property
    def _materials(self) -> Iterator[Material]:
        """The materials of the deck in this state, one for all cells with equal properties."""
        values_by_kind = self.structure.split_values(self.values)
        theta = self.structure.theta(values_by_kind.parameters, values_by_kind.losses)
        factor_of_cell = theta[self.body.part]
        constants = self.body.elasticity[:, _ANISOTROPIC_ROWS, _ANISOTROPIC_COLUMNS]
        scaled_constants = factor_of_cell[:, None] * constants
        no_cells = np.zeros(len(scaled_constants))
        graded = no_cells if self.grading is None else self.grading.cells
        properties = np.column_stack((scaled_constants, self.body.density, graded))
        rows, material_of_cell = np.unique(properties, axis=0, return_inverse=True)
        for number, (*constants_of_row, density, is_graded) in enumerate(rows):
            material_constants = np.array(constants_of_row)
            course = [(0.0, 1.0)]
            if self.grading is not None and is_graded:
                course = self.grading.course
            at_temperatures = []
            for temperature, factor in course:
                at_temperatures.append((temperature, factor * material_constants))
            cells = np.flatnonzero(material_of_cell == number)
            yield Material(at_temperatures, density, cells)

    @property
    def _springs(self) -> FloatArray:
        """The springs (n,) of the supports in this state [N/m, N m/rad]."""
        parameters = self.structure.parameters | self.structure.split_values(self.values).parameters
        springs = np.zeros(len(self.body.supports.springs))
        for parameter, part in self.body.supports.springs_by_parameter.items():
            springs += part if parameter is None else parameters[parameter] * part
        return springs

    @cached_property
    def probes(self) -> FloatArray:
        """Rows (m, n) on the free unknowns of the outputs that are compared."""
        rows = sparse.vstack((self.structure.gauge_output, self.structure.displacement_output))
        return np.asarray(rows.toarray())

    @property
    def _motion_count(self) -> int:
        """Number of free unknowns that are motions of rigid sets."""
        supports = self.body.supports
        return len(supports.springs) - len(supports.free_displacements)

    def text(self, *steps: Step) -> str:
        """Return the input of a job: the model, then its steps.

        The nodes of the mesh are followed by auxiliary nodes: those of rigid motions, with three
        motions each, then the eight corners of the block of each point mass, then the nodes of the
        probes, with three outputs each.
        """
        mesh = self.body.mesh
        supports = self.body.supports
        first_motion_node = len(mesh.points) + 1
        first_corner = first_motion_node + _groups_of_three(self._motion_count)
        blocks = self._mass_blocks(first_corner)
        first_probe = first_corner + 8 * len(blocks)
        last_probe = first_probe + _groups_of_three(len(self.probes)) - 1
        # displacements without a free unknown, and unused directions of motion nodes
        is_held = np.diff(supports.expansion.indptr) == 0
        unused = range(mesh.unknowns + self._motion_count, 3 * (first_corner - 1))
        numbered_cells = np.column_stack((np.arange(len(mesh.cells)), mesh.cells)) + 1
        return _template().render(
            deck=self,
            numbers=number_line,
            materials=self._materials,
            cells=numbered_cells,
            motion_nodes=range(first_motion_node, first_corner),
            held=map(_node_and_direction, (*np.flatnonzero(is_held), *unused)),
            springs=[*self.terms(self._springs)],
            blocks=[(block.mass, self._corner_positions(block)) for block in blocks],
            block_side=_BLOCK_SIDE,
            probe_nodes=range(first_probe, last_probe + 1),
            equations=self._equations(blocks, first_probe),
            steps=steps,
        )

    def _mass_blocks(self, first_corner: int) -> list[MassBlock]:
        """Return the blocks of the point masses that are not zero."""
        blocks: list[MassBlock] = []
        for point_mass in self.body.masses:
            mass = self.values.get(point_mass.name, point_mass.mass)
            if mass > 0.0:
                for weights in point_mass.weights:
                    start = first_corner + 8 * len(blocks)
                    blocks.append(MassBlock(mass, weights, list(range(start, start + 8))))
        return blocks

    def _corner_positions(self, block: MassBlock) -> list[tuple[int, FloatArray]]:
        """Return the corner nodes of a block with their positions (3,) [m]."""
        point = block.weights @ self.body.mesh.points
        corners = HEXAHEDRA_20.node_positions[:8] * _BLOCK_SIDE
        return [*zip(block.corners, point + corners, strict=True)]

    def _equations(self, blocks: Iterable[MassBlock], first_probe: int) -> Iterator[list[Term]]:
        """Yield the constraint equations: terms whose sum is zero, the dependent one first."""
        yield from self._rigid_equations()
        for block in blocks:
            yield from _block_equations(block)
        for number, row in enumerate(self.probes):
            node, direction = divmod(number, 3)
            yield [Term(first_probe + node, direction + 1, -1.0), *self.terms(row)]

    def _rigid_equations(self) -> Iterator[list[Term]]:
        """Yield the equations of displacements that follow a rigid set."""
        supports = self.body.supports
        moving = np.flatnonzero(np.diff(supports.expansion.indptr))
        driven = np.setdiff1d(moving, supports.free_displacements)
        for displacement_number in driven.tolist():
            (row,) = supports.expansion[[displacement_number]].toarray()
            node, direction = _node_and_direction(displacement_number)
            yield [Term(node, direction, -1.0), *self.terms(row)]

    @cached_property
    def dofs(self) -> list[tuple[int, int]]:
        """Node and direction of each free unknown."""
        first_motion = self.body.mesh.unknowns
        motions = range(first_motion, first_motion + self._motion_count)
        unknowns = (*self.body.supports.free_displacements.tolist(), *motions)
        return [_node_and_direction(unknown_number) for unknown_number in unknowns]

    def terms(self, values: FloatArray) -> Iterator[Term]:
        """Yield a term for each nonzero entry of a row (n,) on the free unknowns."""
        for unknown_number in np.flatnonzero(values).tolist():
            node, direction = self.dofs[unknown_number]
            yield Term(node, direction, float(values[unknown_number]))


def _template() -> Template:
    """Return the template of the input."""
    file = resources.files("fe.verification").joinpath("templates/calculix.inp.jinja")
    template: Template = Template(
        file.read_text(encoding="utf-8"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    return template


def _block_equations(block: MassBlock) -> Iterator[list[Term]]:
    """Yield the equations that make the corners of a block move with the point of its mass."""
    nodes = np.flatnonzero(block.weights).tolist()
    for corner, direction in itertools.product(block.corners, (1, 2, 3)):
        equation = [Term(corner, direction, -1.0)]
        for node in nodes:
            weight = float(block.weights[node])
            equation.append(Term(node + 1, direction, weight))
        yield equation


def _groups_of_three(count: int) -> int:
    """Return the number of nodes for `count` values, three directions each."""
    return -(-count // 3)


def _node_and_direction(unknown_number: int) -> tuple[int, int]:
    """Return the node and the direction of an unknown, both from 1."""
    return unknown_number // 3 + 1, unknown_number % 3 + 1


def number_line(values: ArrayLike) -> str:
    """Format numbers with 14 digits, in at most 20 characters each, for CalculiX."""
    return ",".join(f"{value:.13E}" for value in np.asarray(values).ravel().tolist())


def structure_deck(structure: Structure) -> CalculixDeck:
    """Return the deck of a structure, undamaged, with nominal parameters and masses.

    Raises
    ------
    CalculixError
        If CalculiX has no element that is integrated in the same way.
    """
    kind = structure.mesh.kind
    if kind is WEDGES_6:  # C3D6 is integrated at two points
        raise CalculixError(
            f"CalculiX integrates {kind.name} ({kind.calculix}) in another way, so that nothing "
            "can be compared; tetrahedra and hexahedra can."
        )
    loads = {load.name: _load_step(structure, load) for load in structure.design.load}
    return CalculixDeck("structure", structure, structure.body, {}, loads)


def _load_step(structure: Structure, load: MeshLoad) -> Step:
    """Return the static step of a load, its control at `control_value_alone`."""
    factor = structure.control_value_alone(load.name)
    lines = ["*DLOAD, OP=NEW"]
    if load.acceleration is not None:
        magnitude = float(np.linalg.norm(load.acceleration))
        direction = np.sign(factor) * np.asarray(load.acceleration) / magnitude
        magnitude_and_direction = number_line([abs(factor) * magnitude, *direction])
        lines.append(f"EHEAVY,GRAV,{magnitude_and_direction}")
    elif load.pressure is not None and load.set is not None:
        surface = structure.mesh.faces_of(load.set, load.name)
        pressure = number_line([factor * load.pressure])
        for cell, face in zip(surface.cell, surface.face, strict=True):
            lines.append(f"{cell + 1},P{face + 1},{pressure}")
    else:
        lines.append("EALL,GRAV,0.,0.,0.,1.")
    return Step(structure.load(load.name, factor), lines, nodal=load.force is not None)


def wing_deck(operators: AffineOperators, state: DigitalState) -> CalculixDeck:
    """Return the deck of the wing in one state."""
    mesh = operators.wing_mesh
    design = mesh.design
    skin = design.skin
    body = operators.body
    grading = None
    if skin.stations:
        # CalculiX varies the elasticity within a cell by temperature alone, so the station of a
        # node is given as its temperature, and the modulus there is a factor on the elasticity.
        # That of the body has the modulus at the centre of each cell already: it is divided out.
        course = [(place.station, place.young_modulus) for place in skin.stations]
        _, y, _ = mesh.points.T
        grading = Grading(course, y / design.planform.semi_span, mesh.is_skin)
        central_modulus = np.where(mesh.is_skin, skin.young_modulus(mesh.centre_stations), 1.0)
        body = replace(body, elasticity=body.elasticity / central_modulus[:, None, None])
    return CalculixDeck(
        title="wing, design",
        structure=operators,
        body=body,
        values=wing_values(operators, stiffness_loss=state.stiffness_loss, **state.values),
        loads={
            "tip force": Step(operators.turn(0.0, TEST_FORCE)),
            "lift": Step(operators.turn(design.lift.load_factor)),
        },
        grading=grading,
        damping=(state.damping_alpha, state.damping_beta),
    )
