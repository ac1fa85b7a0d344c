"""A structure, and the wing, as input for CalculiX."""

from collections.abc import Iterable, Iterator

import numpy as np

from fe.elements.cells import rotate_elasticity
from fe.elements.kinds import WEDGES_6
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.structure.design import Load
from fe.structure.location import point_shares
from fe.structure.operators import Structure
from fe.wing.operators import (
    AffineOperators,
    cell_axes,
    cell_density,
    cell_elasticity,
    point_mass_weights,
    root_support,
)
from fe.wing.responses import wing_values

from .calculix_deck import CalculixDeck, PointBlock, number_line

NOT_COMPARABLE = (WEDGES_6,)
"""Kinds that CalculiX integrates otherwise (C3D6 at two points)."""
ORTHOTROPIC = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (5, 5), (4, 4), (3, 3))
"""Rows and columns of an elasticity in the order of CalculiX's nine orthotropic constants."""


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
    return CalculixDeck(
        "structure",
        structure,
        {},
        mesh,
        structure.unknowns_held,
        tuple(_structure_materials(structure)),
        tuple(masses),
    )


def _structure_materials(structure: Structure) -> Iterator[str]:
    for number, part in enumerate(structure.design.material):
        factor = structure.parameters.get(part.scaled_by or "", 1.0)
        local = factor * np.linalg.inv(part.compliance)
        yield from material_lines(number, [(0.0, np.array([local[p] for p in ORTHOTROPIC]))], part.density)
        axes = np.array(part.axes or np.eye(3)[:2])
        yield from section_lines(number, axes, np.flatnonzero(structure.material_of == number))


def load_lines(deck: CalculixDeck, load: Load) -> Iterator[str]:
    """Yield the lines of a load of a structure, its control at the nominal value."""
    structure = deck.structure
    assert isinstance(structure, Structure)
    factor = 1.0 if load.control is None else structure.controls[load.control]
    force = structure.load(load.name)
    yield from deck.force_lines(0.0 * force if load.force is None else force)
    yield "*DLOAD, OP=NEW"
    if load.acceleration is not None:
        size = float(np.linalg.norm(load.acceleration))
        direction = np.sign(factor) * np.asarray(load.acceleration) / size
        yield f"EHEAVY,GRAV,{number_line([abs(factor) * size, *direction])}"
    elif load.pressure is not None and load.set is not None:
        surface = structure.mesh.faces_of(load.set, load.name)
        for cell, face in zip(surface.cell, surface.face, strict=True):
            yield f"{cell + 1},P{face + 1},{factor * load.pressure:.13E}"
    else:
        yield "EALL,GRAV,0.,0.,0.,1."


def wing_deck(operators: AffineOperators, state: DigitalState) -> CalculixDeck:
    """Return the wing in one state; it reads the gauges, the displacement at the tip, then at the test load.

    The root is a rigid set about the straight chord line, which moves in heave, flap and yaw on its springs.
    """
    mesh = operators.wing_mesh
    masses = (
        PointBlock(
            state.servo_mass if place.kind == "servo" else state.pitot_mass,
            np.array([0.0, place.station * mesh.design.planform.semi_span, 0.0]),  # where it is drawn
            point_mass_weights(mesh, place),
        )
        for place in mesh.design.point_masses
    )
    return CalculixDeck(
        "wing, design",
        operators,
        wing_values(operators, stiffness_loss=state.stiffness_loss, **state.values),
        mesh,
        root_support(mesh),
        (*_wing_materials(operators, state), *cell_set("EGAUGES", gauge_cells(operators))),
        tuple(masses),
        (operators.load_tip,),
    )


def gauge_cells(operators: AffineOperators) -> IntArray:
    """Numbers of the cells of a wing that hold the middle of a gauge; they are the set EGAUGES."""
    mesh = operators.wing_mesh
    plan = mesh.design.planform
    cells = [
        mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
        for distance, chord in mesh.design.gauges.positions
    ]
    return np.unique(cells)


def _wing_materials(operators: AffineOperators, state: DigitalState) -> Iterator[str]:
    mesh = operators.wing_mesh
    axes = cell_axes(mesh)
    # Constants in the cell's own axes; CalculiX turns them by the orientation.
    local = rotate_elasticity(cell_elasticity(mesh), np.swapaxes(axes, 1, 2))
    parameters = {"young_modulus_factor": state.young_modulus_factor}
    factor = operators.theta(parameters, state.stiffness_loss)[mesh.stiffness_term]
    constants = np.column_stack([local[:, row, column] for row, column in ORTHOTROPIC])
    constants *= factor[:, None]
    density = cell_density(mesh)
    # Whether Young's modulus changes inside a cell.
    graded = (mesh.web < 0) & (mesh.rib < 0) & bool(mesh.design.skin.stations)
    if graded.any():
        centre = mesh.design.skin.young_modulus(mesh.centres[graded, 1] / mesh.design.planform.semi_span)
        constants[graded] /= centre[:, None]
    damping = f"*DAMPING, ALPHA={state.damping_alpha:.12E}, BETA={state.damping_beta:.12E}"
    course = [(place.station, place.young_modulus) for place in mesh.design.skin.stations]
    for cell, own in enumerate(constants):
        moduli = course if graded[cell] else [(0.0, 1.0)]
        rows = [(temperature, modulus * own) for temperature, modulus in moduli]
        yield from material_lines(cell, rows, float(density[cell]))
        if state.damping_alpha or state.damping_beta:
            yield damping
        yield from section_lines(cell, axes[cell, :2], [cell])
    if graded.any():
        # The station of a node stands as its temperature, on which the skin's constants depend.
        yield "*INITIAL CONDITIONS, TYPE=TEMPERATURE"
        span = mesh.design.planform.semi_span
        for node, place in enumerate(mesh.points[:, 1] / span, start=1):
            yield f"{node},{place:.13E}"


def material_lines(number: int, courses: Iterable[tuple[float, FloatArray]], density: float) -> Iterator[str]:
    """Yield a material: nine orthotropic constants [Pa] at each of some temperatures, density [kg/m^3]."""
    yield f"*MATERIAL, NAME=M{number}"
    yield "*ELASTIC, TYPE=ORTHO"
    for temperature, constants in courses:
        yield number_line(constants[:8])
        yield number_line((constants[8], temperature))
    yield "*DENSITY"
    yield number_line([density])


def section_lines(number: int, axes: FloatArray, cells: Iterable[int]) -> Iterator[str]:
    """Yield which cells are of the material of a number, in axes by two vectors (2, 3)."""
    yield f"*ORIENTATION, NAME=O{number}, SYSTEM=RECTANGULAR"
    yield number_line(axes.ravel())
    yield from cell_set(f"E{number}", cells)
    yield f"*SOLID SECTION, ELSET=E{number}, MATERIAL=M{number}, ORIENTATION=O{number}"


def cell_set(name: str, cells: Iterable[int]) -> Iterator[str]:
    """Yield a set of cells, which count from 0."""
    yield f"*ELSET, ELSET={name}"
    yield from (str(cell + 1) for cell in cells)
