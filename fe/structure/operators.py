"""From a structure file and its mesh to affine operators, and their fields as VTU files for ParaView."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.cells import unit_vector
from fe.elements.kinds import meshio_with_wedges
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError, MeshError
from fe.sentences import said
from reporting.files import atomic_file

from .affine import AffineStructure, static_response
from .design import MatrixDesign, MeshDesign, load_structure, structure_hash
from .location import gauge_rows, nodal_load, point_shares, port_row
from .matrices import assemble_matrices
from .mesh import Body, PointMass, StructureMesh, supported
from .mesh_file import check_memory, read_mesh


@dataclass(frozen=True)
class Structure(AffineStructure):
    """Finite element model of a structure.

    Attributes
    ----------
    design : MeshDesign
        What was asked for.
    body : Body
        Its mesh, and what it is made of.
    material_of : (nc,)
        Number of the material of each cell.
    region_of : (nc,)
        Number of the damage region of each cell, -1 for none.
    gauges_moved : (gauges,) m
        How far each gauge lies from where it was asked for.
    """

    design: MeshDesign
    body: Body[StructureMesh]
    material_of: IntArray
    region_of: IntArray
    gauges_moved: FloatArray

    @property
    def mesh(self) -> StructureMesh:
        """Its mesh."""
        return self.body.mesh


def structure_mesh(design: MeshDesign, file: Path) -> StructureMesh:
    """Read the mesh of the design in `file`, which may name it relative to itself, with the design's sets.

    Raises
    ------
    MeshError
        If the mesh cannot be read or is faulty.
    """
    mesh = read_mesh(file.parent / design.mesh, design.unit, design.length_unit)
    sets: dict[str, dict[str, IntArray]] = {"nodes": {}, "cells": {}}
    for part in design.set:
        places = mesh.points if part.of == "nodes" else mesh.centres
        low, high = design.unit * np.array(part.box)
        slack = 1e-9 * mesh.size
        inside = ((places >= low - slack) & (places <= high + slack)).all(axis=1)
        sets[part.of][part.name] = np.flatnonzero(inside)
    return replace(mesh, node_sets=mesh.node_sets | sets["nodes"], cell_sets=mesh.cell_sets | sets["cells"])


def _owners(mesh: StructureMesh, design: MeshDesign, key: str, what: str) -> IntArray:
    """Find the number (nc,) of the part whose set holds each cell, -1 for none.

    Parameters
    ----------
    mesh, design : StructureMesh, MeshDesign
        The mesh and its design.
    key : str
        The table of the parts in the design.
    what : str
        What they are, for the sentence.

    Raises
    ------
    MeshError
        If a set is missing or empty, or two overlap.
    """
    owner = np.full(len(mesh.cells), -1, dtype=np.int64)
    for number, (where, part) in enumerate(design.numbered(key)):
        cells = mesh.cells_of(part.set, where)
        taken = cells[owner[cells] >= 0]
        if len(taken):
            other, count = getattr(design, key)[owner[taken[0]]], len(taken)
            both = {"what": what, "name": part.name, "other": other.name, "cell": mesh.cell(taken[0])}
            raise MeshError(said("mesh.shared", where=where, count=count, **both))
        owner[cells] = number
    return owner


def load_and_assemble(
    file: Path | str, memory_limit: float | None = None, *, mass_as_stiffness: bool = False
) -> Structure:
    """Read a structure file with its mesh, check both and assemble the affine operators.

    Parameters
    ----------
    file : Path or str
        The structure file.
    memory_limit : float, optional
        Bytes that assembly and factorisation may take; what the machine has left by default.
    mass_as_stiffness : bool
        Integrate the mass at the points of the stiffness, as CalculiX does: not exact for tetrahedra.

    Raises
    ------
    DesignFileError, InvalidDesignError
        If the structure file cannot be read, or is no structure.
    MeshError
        If the mesh cannot be read, is faulty or does not hold what the design names, or would take too much
        memory.
    """
    file = Path(file)
    design = load_structure(file)
    if isinstance(design, MatrixDesign):
        raise InvalidDesignError(said("design.without_mesh", file=file))
    mesh = structure_mesh(design, file)
    check_memory(mesh, memory_limit)
    material_of = _owners(mesh, design, "material", "material")
    bare = np.flatnonzero(material_of < 0)
    if len(bare):
        counts = {"count": len(bare), "all": len(mesh.cells)}
        raise MeshError(said("mesh.bare", mesh=mesh, cell=mesh.cell(bare[0]), **counts))
    region_of = _owners(mesh, design, "damage", "damage region")
    parameters, regions = ([*(part.name for part in own), None] for own in (design.parameter, design.damage))
    scaled = np.array([parameters.index(part.scaled_by) for part in design.material])
    pairs, part = np.unique(
        np.column_stack((scaled[material_of], region_of % len(regions))), axis=0, return_inverse=True
    )
    body = Body(
        mesh,
        supported(design, mesh),
        np.array([own.elasticity for own in design.material])[material_of],
        np.array([own.density for own in design.material])[material_of],
        part,
        tuple((parameters[first], regions[second]) for first, second in pairs.tolist()),
        tuple(
            PointMass(own.name, own.mass, point_shares(mesh, own.point, where)[None])
            for where, own in design.numbered("mass")
        ),
        mass_rule=mesh.kind.stiffness_rule if mass_as_stiffness else None,
    )
    gauges, moved = gauge_rows(mesh, design.gauge)
    loads = (nodal_load(mesh, load, where).ravel() for where, load in design.numbered("load"))
    points = {key: _point_rows(design, mesh, key) for key in ("displacement", "acceleration")}
    ports = [port_row(mesh, port, where).ravel() for where, port in design.numbered("port")]
    port_rows = sparse.csr_array(np.reshape(ports, (-1, mesh.unknowns)))
    return Structure(
        **body.assembled(design, loads, {"gauge": gauges, **points, "port": port_rows}),
        design_hash=structure_hash(design, file.parent),
        material_of=material_of,
        region_of=region_of,
        gauges_moved=moved,
    )


def assemble_structure(file: Path | str, memory_limit: float | None = None) -> AffineStructure:
    """Read a structure file with its mesh or matrices; parameters and errors as of `load_and_assemble`."""
    design, folder = load_structure(file), Path(file).parent
    if isinstance(design, MatrixDesign):
        return assemble_matrices(design, folder, structure_hash(design, folder))
    return load_and_assemble(file, memory_limit)


def _point_rows(design: MeshDesign, mesh: StructureMesh, key: str) -> sparse.csr_array:
    """Rows (m, full) of the displacements of points along directions."""
    rows = [
        np.outer(point_shares(mesh, part.point, where), unit_vector(part.direction)).ravel()
        for where, part in design.numbered(key)
    ]
    return sparse.csr_array(np.reshape(rows, (-1, mesh.unknowns)))


def weighed(structure: Structure) -> tuple[float, FloatArray]:
    """Mass [kg] with the nominal point masses, and the centre of gravity (3,) [m]."""
    shares, points = structure.body.nodal_mass, structure.mesh.points
    mass = float(shares.sum())
    return mass, shares @ points / mass if mass > 0.0 else points.mean(axis=0)


def write_structure_vtu(
    path: Path | str, structure: Structure, values: Mapping[str, float] | None = None
) -> None:
    """Solve the full model and write its field, whole or not at all.

    Point data: `displacement` [m]. Cell data: `strain` at the centres, `material` and `region` (their numbers
    in the file from 1, 0 for no region), `stiffness_loss`.

    Parameters
    ----------
    path : Path or str
        Where to write.
    structure : Structure
        The structure.
    values : mapping of str to float, optional
        Parameters, losses, free masses and controls by name; what is left out is nominal, and healthy.

    Raises
    ------
    SolutionError
        If the structure cannot be solved.
    FileNotWrittenError
        If the file cannot be written.
    """
    mesh, given = structure.mesh, dict(values or {})
    displacement = structure.full_displacement(static_response(structure, given).displacement)
    lost = [*(given.get(name, 0.0) for name in structure.regions), 0.0]  # the last one is that of no region
    write_vtu(
        path,
        mesh.points,
        (mesh.kind.file_type, mesh.cells),
        {"displacement": displacement},
        {
            "strain": mesh.strains(displacement)[:, 0],
            "material": structure.material_of + 1,
            "region": structure.region_of + 1,
            "stiffness_loss": np.array(lost)[structure.region_of],
        },
    )


Data = dict[str, NDArray[Any]]
"""What is written of points or cells, by name."""


def write_vtu(
    path: Path | str, points: FloatArray, cells: tuple[str, IntArray], point_data: Data, cell_data: Data
) -> None:
    """Write a VTU file, whole or not at all; `cells` are their kind in meshio and their nodes."""
    meshio, values = meshio_with_wedges(), {name: [value] for name, value in cell_data.items()}
    mesh = meshio.Mesh(points, [cells], point_data=point_data, cell_data=values)
    with atomic_file(path) as temporary:
        meshio.write(temporary, mesh, file_format="vtu")
