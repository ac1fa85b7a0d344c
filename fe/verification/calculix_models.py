"""A structure, and the wing, as input for CalculiX."""

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from fe.elements.cells import CellMesh, rotate_elasticity
from fe.elements.kinds import WEDGES_6
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.structure.affine import AffineStructure
from fe.structure.design import Load
from fe.structure.operators import Structure
from fe.structure.supports import SupportedUnknowns
from fe.wing.operators import (
    AffineOperators,
    cell_axes,
    cell_density,
    cell_elasticity,
    point_mass_weights,
    root_support,
)

from .calculix_deck import CalculixDeck, PointBlock, number_line

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

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
        _point_block(part.mass, mesh.unit * np.asarray(part.point), structure.point_weights[part.name])
        for part in design.mass
    )
    return _deck(
        "structure", structure, mesh, structure.unknowns_held, _structure_materials(structure), masses
    )


def _deck(
    title: str,
    structure: AffineStructure,
    mesh: CellMesh,
    supports: SupportedUnknowns,
    materials: Iterable[str],
    masses: Iterable[PointBlock],
    *probes: FloatArray,
) -> CalculixDeck:
    """Return the deck; it probes the gauges, the displacement outputs and further rows (n,)."""
    rows = (structure.gauge_output.toarray(), structure.displacement_output.toarray())
    return CalculixDeck(
        title=f"{title} {structure.design_hash[:12]}",
        kind=mesh.kind.calculix,
        points=mesh.points,
        cells=mesh.cells,
        materials=tuple(materials),
        supports=supports,
        masses=tuple(masses),
        probes=np.vstack((*rows, *probes)),
    )


def _point_block(mass: float, place: FloatArray, shares: FloatArray) -> PointBlock:
    return PointBlock(mass, place, {int(node): float(shares[node]) for node in np.flatnonzero(shares)})


def _structure_materials(structure: Structure) -> Iterator[str]:
    for number, part in enumerate(structure.design.material):
        factor = structure.parameters.get(part.scaled_by or "", 1.0)
        yield f"*MATERIAL, NAME=M{number}"
        yield "*ELASTIC, TYPE=ORTHO"
        local = factor * np.linalg.inv(part.compliance)
        yield from _constant_lines(np.array([local[place] for place in ORTHOTROPIC]))
        yield "*DENSITY"
        yield number_line([part.density])
        orientation = ""
        if part.axes is not None:
            yield f"*ORIENTATION, NAME=O{number}, SYSTEM=RECTANGULAR"
            yield number_line([*part.axes[0], *part.axes[1]])
            orientation = f", ORIENTATION=O{number}"
        yield f"*ELSET, ELSET=E{number}"
        yield from (str(cell + 1) for cell in np.flatnonzero(structure.material_of == number))
        yield f"*SOLID SECTION, ELSET=E{number}, MATERIAL=M{number}{orientation}"


def structure_loads(structure: Structure, deck: CalculixDeck) -> Iterator[list[str]]:
    """Yield the lines of each load of a structure, its control at the nominal value."""
    for load in structure.design.load:
        yield [*_load_lines(structure, deck, load)]


def _load_lines(structure: Structure, deck: CalculixDeck, load: Load) -> Iterator[str]:
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
        _point_block(
            state.servo_mass if place.kind == "servo" else state.pitot_mass,
            np.array([0.0, place.station * mesh.design.planform.semi_span, 0.0]),  # where it is drawn
            point_mass_weights(mesh, place),
        )
        for place in mesh.design.point_masses
    )
    materials = itertools.chain(_wing_materials(operators, state), _gauge_set(operators))
    return _deck("wing, design", operators, mesh, root_support(mesh), materials, masses, operators.load_tip)


def gauge_cells(operators: AffineOperators) -> IntArray:
    """Numbers of the cells of a wing that hold the middle of a gauge; they are the set EGAUGES."""
    mesh = operators.wing_mesh
    plan = mesh.design.planform
    cells = [
        mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
        for distance, chord in mesh.design.gauges.positions
    ]
    return np.unique(cells)


def _gauge_set(operators: AffineOperators) -> Iterator[str]:
    yield "*ELSET, ELSET=EGAUGES"
    yield from (str(cell + 1) for cell in gauge_cells(operators))


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
            yield from _constant_lines(modulus * constants[first], temperature)
        yield "*DENSITY"
        yield number_line(density[first : first + 1])
        if state.damping_alpha or state.damping_beta:
            yield f"*DAMPING, ALPHA={state.damping_alpha:.12E}, BETA={state.damping_beta:.12E}"
    if graded.any():
        # The station of a node stands as its temperature, on which the skin's constants depend.
        yield "*INITIAL CONDITIONS, TYPE=TEMPERATURE"
        span = mesh.design.planform.semi_span
        for node, place in enumerate(mesh.points[:, 1] / span, start=1):
            yield f"{node},{place:.13E}"
    for cell, key in enumerate(rounded):
        yield f"*ORIENTATION, NAME=O{cell}, SYSTEM=RECTANGULAR"
        yield number_line(axes[cell, :2].ravel())
        yield f"*ELSET, ELSET=E{cell}"
        yield str(cell + 1)
        yield f"*SOLID SECTION, ELSET=E{cell}, MATERIAL=M{materials[key]}, ORIENTATION=O{cell}"


def _constant_lines(constants: FloatArray, temperature: float = 0.0) -> Iterator[str]:
    """Yield nine orthotropic constants [Pa] at a temperature."""
    yield number_line(constants[:8])
    yield number_line((constants[8], temperature))
