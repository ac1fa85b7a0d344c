"""A structure, and the wing, as input for CalculiX."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHexS2

from fe.full.assembly import cell_axes, rotate_elasticity
from fe.full.operators import AffineOperators, cell_density, cell_elasticity, point_mass_weights
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.structure.design import Load
from fe.structure.elements import HEXAHEDRA_20, WEDGES_6
from fe.structure.operators import Structure
from fe.structure.supports import RigidSet, SupportedUnknowns, rigid_motions

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
    masses = []
    for part in design.mass:
        shares = structure.point_weights[part.name]
        weights = {int(node): float(shares[node]) for node in np.flatnonzero(shares)}
        masses.append(PointBlock(part.mass, mesh.unit * np.asarray(part.point), weights))
    return CalculixDeck(
        title=f"structure {structure.design_hash[:12]}",
        kind=mesh.kind.calculix,
        points=mesh.points,
        cells=mesh.cells,
        materials=tuple(_structure_materials(structure)),
        supports=structure.unknowns_held,
        masses=tuple(masses),
        probes=np.vstack([structure.gauge_output.toarray(), structure.displacement_output.toarray()]),
    )


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
    """Return the wing in one state; it reads the displacement at the test load, at the tip, then the gauges.

    The root is a rigid set about the straight chord line, which moves in heave, flap and yaw on its springs.
    """
    body, design = operators.discretisation, operators.wing_mesh.design
    points, root = body.node_points, design.root
    on_root = np.flatnonzero(np.abs(points[:, 1]) < 1e-9 * design.planform.semi_span)
    motions = rigid_motions(points[on_root], np.zeros(3), 2.0)
    springs = np.array([0.0, 0.0, root.transverse_spring, root.flap_spring, 0.0, root.yaw_spring])
    rib = RigidSet(on_root, np.zeros(3), motions, springs == 0.0, springs)
    nothing = np.zeros(points.size)
    given = ElementHexS2().doflocs
    order = [int(np.flatnonzero(np.all(np.equal(given, place), axis=1))[0]) for place in HEXAHEDRA_20.places]
    probes = (operators.displacement_output, operators.tip_displacement_output)
    return CalculixDeck(
        title=f"wing, design {operators.design_hash[:12]}",
        kind="C3D20",
        points=points,
        cells=body.cell_nodes[:, order],
        materials=(*_wing_materials(operators, state), *_gauge_set(operators)),
        supports=SupportedUnknowns(nothing.astype(bool), nothing, (rib,)),
        masses=tuple(_wing_masses(operators, state)),
        probes=np.vstack((*probes, operators.gauge_output.toarray())),
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


def _gauge_set(operators: AffineOperators) -> Iterator[str]:
    yield "*ELSET, ELSET=EGAUGES"
    yield from (str(cell + 1) for cell in gauge_cells(operators))


def _wing_masses(operators: AffineOperators, state: DigitalState) -> Iterator[PointBlock]:
    """Yield servos and pitots, each tied to the mean of the two skins."""
    mesh, body = operators.wing_mesh, operators.discretisation
    design = mesh.design
    for place in design.point_masses:
        shares = point_mass_weights(mesh, body, place)
        weights = {int(node): float(shares[node]) for node in np.flatnonzero(shares)}
        mass = state.servo_mass if place.kind == "servo" else state.pitot_mass
        drawn = np.array([0.0, place.station * design.planform.semi_span, 0.0])
        yield PointBlock(mass, drawn, weights)


def _wing_materials(operators: AffineOperators, state: DigitalState) -> Iterator[str]:
    mesh = operators.wing_mesh
    axes = cell_axes(mesh.corners)
    # Constants in the cell's own axes; CalculiX turns them by the orientation.
    local = rotate_elasticity(cell_elasticity(mesh), np.swapaxes(axes, 1, 2))
    factor = operators.theta(state.young_modulus_factor, state.stiffness_loss)[mesh.stiffness_term]
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
        for node, place in enumerate(operators.discretisation.node_points[:, 1] / span, start=1):
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
