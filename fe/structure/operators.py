"""Assemble the affine operators of a structure file, and write its fields for ParaView."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.elements.elasticity import unit_vector
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError, MeshError

from .affine import AffineStructure, static_response
from .affine_fields import OutputRows
from .body import Body, MassAtPoints
from .design import (
    Damage,
    MeshDesign,
    MeshMaterial,
    MeshPort,
    NamedSet,
    PointOutput,
    load_structure,
    structure_hash,
)
from .gauges import gauge_rows, strain_factors
from .interfaces import with_interfaces
from .matrices import assemble_matrices
from .matrix_design import MatrixDesign
from .mesh import StructureMesh
from .mesh_file import check_connected, check_memory, read_mesh
from .nodal_loads import nodal_load, point_weights, port_row
from .supports import Supports, supports_of_design
from .vtu import write_vtu


@dataclass(frozen=True)
class Structure(AffineStructure):
    """Finite element model of a structure from a mesh.

    Attributes
    ----------
    material_of : (nc,) array of int
        Index of the material of each cell.
    region_of : (nc,) array of int
        Index of the damage region of each cell, -1 for none.
    gauges_moved : (gauges,) array
        Distance of each gauge from its position in the design [m].
    """

    design: MeshDesign
    body: Body[StructureMesh]
    material_of: IntArray
    region_of: IntArray
    gauges_moved: FloatArray

    @property
    def mesh(self) -> StructureMesh:
        """The mesh of the body."""
        return self.body.mesh


def structure_mesh(design: MeshDesign, file: Path) -> StructureMesh:
    """Read the mesh of a design, and add the sets and the interfaces that the design defines.

    The path of the mesh is relative to `file`, the path of the design's file.

    Raises
    ------
    MeshError
        If the mesh cannot be read or is faulty.
    """
    mesh = read_mesh(
        file.parent / design.mesh,
        design.unit,
        design.length_unit,
        in_one_piece=not design.interface,
    )
    node_sets = dict(mesh.node_sets)
    cell_sets = dict(mesh.cell_sets)
    tolerance = 1e-9 * mesh.size
    for label, named_set in design.numbered("set"):
        is_set_of_nodes = named_set.of == "nodes"
        sets = node_sets if is_set_of_nodes else cell_sets
        if named_set.numbers is not None:
            numbers = mesh.node_numbers if is_set_of_nodes else mesh.cell_numbers
            sets[named_set.name] = _indices_of(numbers, named_set, f"{file}: {label}")
            continue
        points = mesh.points if is_set_of_nodes else mesh.centres
        low, high = design.unit * np.array(named_set.box)
        is_above_low = (points >= low - tolerance).all(axis=1)
        is_below_high = (points <= high + tolerance).all(axis=1)
        sets[named_set.name] = np.flatnonzero(is_above_low & is_below_high)
    mesh = with_interfaces(replace(mesh, node_sets=node_sets, cell_sets=cell_sets), design)
    check_connected(mesh)
    return mesh


def _indices_of(numbers: IntArray, named_set: NamedSet, where: str) -> IntArray:
    """Return the indices of nodes or cells by their numbers in the mesh file.

    Raises `MeshError` if the mesh has no node or element of a number.
    """
    indices = {number: index for index, number in enumerate(numbers.tolist())}
    missing = [number for number in named_set.numbers or () if number not in indices]
    if missing:
        what = "node" if named_set.of == "nodes" else "element"
        raise MeshError(f"{where}: the mesh has no {what} {missing[0]}.")
    return np.array([indices[number] for number in named_set.numbers or ()], dtype=np.int64)


def part_of_cells(
    mesh: StructureMesh, labelled: list[tuple[str, MeshMaterial | Damage]], kind: str
) -> IntArray:
    """Return the index (nc,) of the material or region whose sets hold each cell, -1 for none.

    Raises
    ------
    MeshError
        If a set is missing or empty, or those of two materials or regions overlap.
    """
    part_of_cell = np.full(len(mesh.cells), -1, dtype=np.int64)
    for number, (label, part) in enumerate(labelled):
        cells = np.unique(np.concatenate([mesh.cells_of(name, label) for name in part.sets]))
        shared_cells = cells[part_of_cell[cells] >= 0]
        if len(shared_cells):
            _, other_part = labelled[part_of_cell[shared_cells[0]]]
            raise MeshError(
                f"{label}: the {kind}s {part.name!r} and {other_part.name!r} share "
                f"{len(shared_cells)} elements, such as {mesh.describe_cell(shared_cells[0])}; "
                "their sets must not overlap."
            )
        part_of_cell[cells] = number
    return part_of_cell


class _StiffnessParts(NamedTuple):
    """The pairs of parameter and damage region that share a stiffness term.

    Attributes
    ----------
    part_of : (nc,) array of int
        Index of the pair of each cell.
    names : tuple of (str or None, str or None)
        Parameter and damage region of each pair.
    """

    part_of: IntArray
    names: tuple[tuple[str | None, str | None], ...]


def _stiffness_parts(
    design: MeshDesign, material_of: IntArray, region_of: IntArray
) -> _StiffnessParts:
    """Divide the cells into parts of the same stiffness parameter and the same damage region.

    `material_of` and `region_of` (nc,) are the indices of the material and of the region of each
    cell; the region is -1 for none.
    """
    parameters: list[str | None] = [parameter.name for parameter in design.parameter]
    parameters.append(None)
    regions: list[str | None] = [region.name for region in design.damage]
    regions.append(None)
    parameter_of_material = np.array(
        [parameters.index(material.scaled_by) for material in design.material]
    )
    region_number = region_of % len(regions)  # -1 becomes the number of no region, the last one
    pair_of_cell = np.column_stack((parameter_of_material[material_of], region_number))
    pairs, part_of = np.unique(pair_of_cell, axis=0, return_inverse=True)
    names = tuple((parameters[parameter], regions[region]) for parameter, region in pairs.tolist())
    return _StiffnessParts(part_of, names)


def load_and_assemble(
    file: Path | str,
    memory_limit: float | None = None,
    *,
    mass_as_stiffness: bool = False,
    yielding: bool = False,
) -> Structure:
    """Read a structure file and its mesh, check both and assemble the affine operators.

    Parameters
    ----------
    memory_limit : float, optional
        Memory that assembly and factorisation may take [bytes]; by default all that is free.
    mass_as_stiffness : bool
        Integrate the mass at the points of the stiffness, as CalculiX does; this is not exact for
        tetrahedra.
    yielding : bool
        Whether the motions that the supports hold are unknowns, too, see
        `fe.structure.supports.supports_of_design`.

    Raises
    ------
    DesignFileError, InvalidDesignError
        If the structure file cannot be read, or does not describe a structure from a mesh.
    MeshError
        If the mesh cannot be read, is faulty, does not hold what the design names, or would take
        too much memory.
    """
    file = Path(file)
    design = load_structure(file)
    if isinstance(design, MatrixDesign):
        raise InvalidDesignError(
            f"{file} is a structure from matrices: without a mesh there is no field to draw, and "
            "nothing that CalculiX could solve."
        )
    mesh = structure_mesh(design, file)
    check_memory(mesh, memory_limit)
    # what each cell belongs to
    material_of = part_of_cells(mesh, list(design.numbered("material")), "material")
    _check_materials(mesh, material_of)
    region_of = part_of_cells(mesh, list(design.numbered("damage")), "damage region")
    # the body, its loads and outputs
    body = _body(
        design,
        mesh,
        material_of,
        region_of,
        supports_of_design(design, mesh, yielding=yielding),
        mass_as_stiffness=mass_as_stiffness,
    )
    gauges, gauges_moved = gauge_rows(mesh, design.gauge, factors=strain_factors(mesh, design))
    outputs = OutputRows(
        gauge=gauges,
        displacement=_point_rows(mesh, list(design.numbered("displacement"))),
        acceleration=_point_rows(mesh, list(design.numbered("acceleration"))),
        port=_port_rows(mesh, list(design.numbered("port"))),
    )
    loads = (nodal_load(mesh, load, label).ravel() for label, load in design.numbered("load"))
    return Structure(
        design=design,
        **body.affine_fields(design, loads, outputs),
        stiffness_terms=body.stiffness_terms,
        body=body,
        design_hash=structure_hash(design, file.parent),
        material_of=material_of,
        region_of=region_of,
        gauges_moved=gauges_moved,
    )


def _check_materials(mesh: StructureMesh, material_of: IntArray) -> None:
    """Raise `MeshError` if a cell has no material."""
    cells_without_material = np.flatnonzero(material_of < 0)
    if len(cells_without_material):
        raise MeshError(
            f"{mesh.source}: {len(cells_without_material)} of {len(mesh.cells)} elements have no "
            f"material, among them {mesh.describe_cell(cells_without_material[0])}."
        )


def _body(
    design: MeshDesign,
    mesh: StructureMesh,
    material_of: IntArray,
    region_of: IntArray,
    supports: Supports,
    *,
    mass_as_stiffness: bool,
) -> Body[StructureMesh]:
    """Combine mesh, materials, supports and point masses into a body.

    `material_of` and `region_of` (nc,) are the indices of the material and of the region of each
    cell. `mass_as_stiffness` integrates the mass by the rule of the stiffness.
    """
    parts = _stiffness_parts(design, material_of, region_of)
    elasticities = np.array([material.elasticity for material in design.material])
    remaining_fraction = np.ones(len(mesh.cells))
    for label, loss in design.numbered("stiffness_loss"):
        remaining_fraction[mesh.cells_of(loss.set, label)] *= 1.0 - loss.fraction
    densities = np.array([material.density for material in design.material])
    return Body(
        mesh=mesh,
        supports=supports,
        elasticity=remaining_fraction[:, np.newaxis, np.newaxis] * elasticities[material_of],
        density=densities[material_of],
        part=parts.part_of,
        parts=parts.names,
        masses=tuple(
            MassAtPoints(mass.name, mass.mass, point_weights(mesh, mass.point, label)[None])
            for label, mass in design.numbered("mass")
        ),
        mass_rule=mesh.kind.stiffness_rule if mass_as_stiffness else None,
    )


def assemble_structure(
    file: Path | str, memory_limit: float | None = None, *, yielding: bool = False
) -> AffineStructure:
    """Read a structure file with its mesh or matrices, and assemble the affine operators.

    Parameters
    ----------
    memory_limit : float, optional
        Memory that assembly and factorisation of a mesh may take [bytes]; by default all that is
        free.
    yielding : bool
        Whether the motions that the supports hold are unknowns, too.

    Raises
    ------
    DesignFileError, InvalidDesignError
        If the structure file cannot be read, or does not describe a structure.
    MeshError
        If mesh or matrices cannot be read, are faulty, or do not hold what the design names.
    """
    design = load_structure(file)
    folder = Path(file).parent
    if isinstance(design, MatrixDesign):
        design_hash = structure_hash(design, folder)
        return assemble_matrices(design, folder, design_hash, yielding=yielding)
    return load_and_assemble(file, memory_limit, yielding=yielding)


def _point_rows(mesh: StructureMesh, labelled: list[tuple[str, PointOutput]]) -> sparse.csr_array:
    """Return rows (m, full) that read displacements of points along directions."""
    rows = []
    for label, output in labelled:
        weights = point_weights(mesh, output.point, label)
        rows.append(np.outer(weights, unit_vector(output.direction)).ravel())
    return sparse.csr_array(np.reshape(rows, (-1, mesh.unknowns)))


def _port_rows(mesh: StructureMesh, labelled: list[tuple[str, MeshPort]]) -> sparse.csr_array:
    """Return rows (ports, full) that read the displacements of ports."""
    rows = []
    for label, port in labelled:
        row = port_row(mesh, port, label)
        rows.append(row.ravel())
    shape = (-1, mesh.unknowns)  # also without ports
    return sparse.csr_array(np.reshape(rows, shape))


def mass_and_centre(structure: Structure) -> tuple[float, FloatArray]:
    """Return the mass [kg] with nominal point masses, and the centre of gravity (3,) [m].

    The centre of a structure without mass is the mean of its nodes.
    """
    nodal_mass = structure.body.nodal_mass
    points = structure.mesh.points
    mass = float(nodal_mass.sum())
    centre = nodal_mass @ points / mass if mass > 0.0 else points.mean(axis=0)
    return mass, centre


def write_structure_vtu(
    path: Path | str, structure: Structure, values: Mapping[str, float] | None = None
) -> None:
    """Solve the structure for all loads together and write the fields as a VTU file.

    Point data is `displacement` [m]. Cell data are `strain` at the centres, `material` and `region`
    (their numbers in the structure file, from 1; 0 for no region) and `stiffness_loss`.

    Parameters
    ----------
    values : mapping of str to float, optional
        Parameters, losses, free masses and controls by name. All others have their nominal values,
        and the losses are zero.

    Raises
    ------
    SolutionError
        If the structure cannot be solved.
    FileNotWrittenError
        If the file cannot be written; it is written whole or not at all.
    """
    mesh = structure.mesh
    chosen_values = dict(values or {})
    response = static_response(structure, chosen_values)
    displacement = structure.full_displacement(response.displacement)
    losses = [chosen_values.get(name, 0.0) for name in structure.regions]
    losses.append(0.0)  # of no region, whose number is -1
    write_vtu(
        path,
        mesh.points,
        (mesh.kind.file_type, mesh.cells),
        point_data={"displacement": displacement},
        cell_data={
            "strain": mesh.strains(displacement).squeeze(axis=1),
            "material": structure.material_of + 1,
            "region": structure.region_of + 1,
            "stiffness_loss": np.array(losses)[structure.region_of],
        },
    )
