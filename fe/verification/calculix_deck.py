"""A structure, or the wing, as input for CalculiX, which `calculix_comparison` runs.

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

from fe.elements.cells import CellMesh, rotate_elasticity
from fe.elements.kinds import HEXAHEDRA_20, WEDGES_6
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.structure.affine import AffineStructure
from fe.structure.design import Load
from fe.structure.location import point_shares
from fe.structure.mesh import SupportedUnknowns
from fe.structure.operators import Structure
from fe.wing import operators as wing
from fe.wing.responses import wing_values

NOT_COMPARABLE = (WEDGES_6,)
"""Kinds that CalculiX integrates otherwise (C3D6 at two points)."""
ORTHOTROPIC = ([0, 0, 1, 0, 1, 2, 5, 4, 3], [0, 1, 1, 2, 2, 2, 5, 4, 3])
"""Rows and columns of an elasticity in the order of CalculiX's nine orthotropic constants."""
TEST_FORCE = 10.0
"""Upward force of the static test of a wing, and before its ring-down [N]."""
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
    loads : mapping of str to Step
        Static steps of its loads, each alone.
    probed : tuple of (n,)
        Rows on the free unknowns that are read behind the gauges and the displacement outputs.
    gauge_cells : (m,)
        Cells that are the set EGAUGES.
    temperatures : (nodes,), optional
        Temperatures of the nodes, where constants of materials depend on them.
    damping : (float, float)
        Rayleigh damping [1/s] and [s] of a step in time.
    each_alone : bool
        Whether strains and outputs are compared each over its own, and not over the largest of their kind.
    """

    title: str
    structure: AffineStructure
    values: Mapping[str, float]
    mesh: CellMesh
    supports: SupportedUnknowns
    materials: tuple[CellMaterial, ...]
    masses: tuple[PointBlock, ...]
    loads: Mapping[str, Step]
    probed: tuple[FloatArray, ...] = ()
    gauge_cells: IntArray | tuple[()] = ()
    temperatures: FloatArray | None = None
    damping: tuple[float, float] = (0.0, 0.0)
    each_alone: bool = False

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


def structure_deck(structure: Structure) -> CalculixDeck:
    """Return a structure, undamaged and with nominal parameters and masses.

    Raises
    ------
    CalculixError
        If CalculiX has no element that is integrated in the same way.
    """
    mesh, design = structure.mesh, structure.design
    if mesh.kind in NOT_COMPARABLE:
        raise CalculixError(
            f"CalculiX integrates {mesh.kind.name} ({mesh.kind.calculix}) in another way, so that nothing "
            "can be compared; tetrahedra and hexahedra can."
        )
    masses = (
        PointBlock(part.mass, mesh.unit * np.asarray(part.point), point_shares(mesh, part.point, part.name))
        for part in design.mass
    )
    materials = []
    for number, part in enumerate(design.material):
        factor = structure.parameters.get(part.scaled_by or "", 1.0)
        constants = np.asarray(factor * np.linalg.inv(part.compliance)[ORTHOTROPIC], dtype=np.float64)
        cells, axes = np.flatnonzero(structure.material_of == number), np.array(part.axes or np.eye(3)[:2])
        materials.append(CellMaterial([(0.0, constants)], part.density, axes, cells))
    loads = {load.name: _load_step(structure, load) for load in design.load}
    return CalculixDeck(
        "structure", structure, {}, mesh, structure.unknowns_held, tuple(materials), tuple(masses), loads
    )


def _load_step(structure: Structure, load: Load) -> Step:
    """Return the static step of a load of a structure, its control at the nominal value."""
    factor = 1.0 if load.control is None else structure.controls[load.control]
    lines = ["*DLOAD, OP=NEW"]
    if load.acceleration is not None:
        size = float(np.linalg.norm(load.acceleration))
        direction = np.sign(factor) * np.asarray(load.acceleration) / size
        lines.append(f"EHEAVY,GRAV,{number_line([abs(factor) * size, *direction])}")
    elif load.pressure is not None and load.set is not None:
        surface = structure.mesh.faces_of(load.set, load.name)
        for cell, face in zip(surface.cell, surface.face, strict=True):
            lines.append(f"{cell + 1},P{face + 1},{number_line([factor * load.pressure])}")
    else:
        lines.append("EALL,GRAV,0.,0.,0.,1.")
    return Step(structure.load(load.name), lines, load.force is not None)


def wing_deck(operators: wing.AffineOperators, state: DigitalState) -> CalculixDeck:
    """Return the wing in one state; it reads the gauges, the displacement at the tip, then at the test load.

    The root is a rigid set about the straight chord line, which moves in heave, flap and yaw on its springs.
    """
    mesh, design = operators.wing_mesh, operators.wing_mesh.design
    plan, lift = design.planform, design.lift
    masses = (
        PointBlock(
            state.servo_mass if place.kind == "servo" else state.pitot_mass,
            np.array([0.0, place.station * plan.semi_span, 0.0]),  # where it is drawn
            wing.point_mass_weights(mesh, place),
        )
        for place in design.point_masses
    )
    # The station of a node stands as its temperature, on which the constants of a graded skin depend.
    stations = mesh.points[:, 1] / plan.semi_span if design.skin.stations else None
    cells = [  # that hold the middle of a gauge
        mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
        for distance, chord in design.gauges.positions
    ]
    return CalculixDeck(
        "wing, design",
        operators,
        wing_values(operators, stiffness_loss=state.stiffness_loss, **state.values),
        mesh,
        wing.root_support(mesh),
        tuple(_wing_materials(operators, state)),
        tuple(masses),
        {"tip force": Step(operators.turn(0.0, TEST_FORCE)), "lift": Step(operators.turn(lift.load_factor))},
        (operators.load_tip,),
        np.unique(cells),
        stations,
        (state.damping_alpha, state.damping_beta),
        each_alone=True,
    )


def _wing_materials(operators: wing.AffineOperators, state: DigitalState) -> Iterator[CellMaterial]:
    mesh, skin = operators.wing_mesh, operators.wing_mesh.design.skin
    axes = wing.cell_axes(mesh)
    # Constants in the cell's own axes; CalculiX turns them by the orientation.
    local = rotate_elasticity(wing.cell_elasticity(mesh), np.swapaxes(axes, 1, 2))
    parameters = {"young_modulus_factor": state.young_modulus_factor}
    factor = operators.theta(parameters, state.stiffness_loss)[mesh.stiffness_term]
    constants, density = factor[:, None] * local[:, *ORTHOTROPIC], wing.cell_density(mesh)
    # Whether Young's modulus changes inside a cell.
    graded = (mesh.web < 0) & (mesh.rib < 0) & bool(skin.stations)
    if graded.any():
        centre = skin.young_modulus(mesh.centres[graded, 1] / mesh.design.planform.semi_span)
        constants[graded] /= centre[:, None]
    course = [(place.station, place.young_modulus) for place in skin.stations]
    for cell, own in enumerate(constants):
        moduli = course if graded[cell] else [(0.0, 1.0)]
        rows = [(temperature, modulus * own) for temperature, modulus in moduli]
        yield CellMaterial(rows, float(density[cell]), axes[cell, :2], [cell])
