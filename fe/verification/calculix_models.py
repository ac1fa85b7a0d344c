"""A structure, and the wing, as input for CalculiX."""

from collections.abc import Iterator

import numpy as np

from fe.elements.cells import rotate_elasticity
from fe.elements.kinds import WEDGES_6
from fe.runtime.arrays import IntArray
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

from .calculix_deck import CalculixDeck, CellMaterial, PointBlock, Step, number_line

NOT_COMPARABLE = (WEDGES_6,)
"""Kinds that CalculiX integrates otherwise (C3D6 at two points)."""
ORTHOTROPIC = ([0, 0, 1, 0, 1, 2, 5, 4, 3], [0, 1, 1, 2, 2, 2, 5, 4, 3])
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
    materials = []
    for number, part in enumerate(design.material):
        factor = structure.parameters.get(part.scaled_by or "", 1.0)
        constants = np.asarray(factor * np.linalg.inv(part.compliance)[ORTHOTROPIC], dtype=np.float64)
        cells, axes = np.flatnonzero(structure.material_of == number), np.array(part.axes or np.eye(3)[:2])
        materials.append(CellMaterial([(0.0, constants)], part.density, axes, cells))
    return CalculixDeck(
        "structure", structure, {}, mesh, structure.unknowns_held, tuple(materials), tuple(masses)
    )


def load_step(structure: Structure, load: Load) -> Step:
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
    # The station of a node stands as its temperature, on which the constants of a graded skin depend.
    stations = mesh.points[:, 1] / mesh.design.planform.semi_span if mesh.design.skin.stations else None
    return CalculixDeck(
        "wing, design",
        operators,
        wing_values(operators, stiffness_loss=state.stiffness_loss, **state.values),
        mesh,
        root_support(mesh),
        tuple(_wing_materials(operators, state)),
        tuple(masses),
        (operators.load_tip,),
        gauge_cells(operators),
        stations,
        (state.damping_alpha, state.damping_beta),
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


def _wing_materials(operators: AffineOperators, state: DigitalState) -> Iterator[CellMaterial]:
    mesh, skin = operators.wing_mesh, operators.wing_mesh.design.skin
    axes = cell_axes(mesh)
    # Constants in the cell's own axes; CalculiX turns them by the orientation.
    local = rotate_elasticity(cell_elasticity(mesh), np.swapaxes(axes, 1, 2))
    parameters = {"young_modulus_factor": state.young_modulus_factor}
    factor = operators.theta(parameters, state.stiffness_loss)[mesh.stiffness_term]
    constants, density = factor[:, None] * local[:, *ORTHOTROPIC], cell_density(mesh)
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
