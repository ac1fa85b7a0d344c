"""From a structure file and its mesh to affine operators."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.kinds import Rule
from fe.runtime.errors import InvalidDesignError, MeshError

from .affine import DesignedStructure, LoadTerm, StiffnessTerm, names_of
from .design import MeshDesign, load_structure, structure_hash
from .gauges import GaugePlace, gauge_rows
from .location import Locator, point_shares, surface_load
from .matrices import assemble_matrices
from .matrix_design import MatrixDesign
from .mesh import StructureMesh
from .mesh_file import check_memory, read_mesh
from .supports import SupportedUnknowns, supported

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Structure(DesignedStructure):
    """Finite element model of a structure.

    Attributes
    ----------
    design : MeshDesign
        What was asked for.
    mesh : StructureMesh
        Its mesh.
    material_of : (nc,)
        Number of the material of each cell.
    region_of : (nc,)
        Number of the damage region of each cell, -1 for none.
    unknowns_held : SupportedUnknowns
        What the supports hold and spring.
    gauge_places : tuple of GaugePlace
        Where the gauges came to lie.
    point_weights : dict of str to (nodes,)
        Share of each node in the displacement of each point mass.
    nodal_mass : (nodes,) kg
        Share of each node in the mass of the structure with its fixed point masses.
    """

    design: MeshDesign
    mesh: StructureMesh
    material_of: IntArray
    region_of: IntArray
    unknowns_held: SupportedUnknowns
    gauge_places: tuple[GaugePlace, ...]
    point_weights: dict[str, FloatArray]
    nodal_mass: FloatArray


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


def cells_by_set(mesh: StructureMesh, parts: tuple[tuple[str, str, str], ...], what: str) -> IntArray:
    """Find the number (nc,) of the part whose set holds each cell, -1 for none.

    Parameters
    ----------
    mesh : StructureMesh
        The mesh.
    parts : tuple of (place in the design, name, set)
        Materials or regions.
    what : str
        What they are, for the sentence.

    Raises
    ------
    MeshError
        If a set is missing or empty, or two overlap.
    """
    owner = np.full(len(mesh.cells), -1, dtype=np.int64)
    for number, (where, name, chosen) in enumerate(parts):
        cells = mesh.cells_of(chosen, where)
        taken = cells[owner[cells] >= 0]
        if len(taken):
            raise MeshError(
                f"{where}: the {what}s {name!r} and {parts[owner[taken[0]]][1]!r} share {len(taken)} "
                f"elements, such as {mesh.cell_numbers[taken[0]]} at {mesh.place(mesh.centres[taken[0]])}; "
                "their sets must not overlap."
            )
        owner[cells] = number
    return owner


def _materials(design: MeshDesign, mesh: StructureMesh) -> IntArray:
    parts = tuple((f"material[{n}]", part.name, part.set) for n, part in enumerate(design.material, 1))
    owner = cells_by_set(mesh, parts, "material")
    bare = np.flatnonzero(owner < 0)
    if len(bare):
        raise MeshError(
            f"{mesh.source}: {len(bare)} of {len(owner)} elements have no material, among them "
            f"{mesh.cell_numbers[bare[0]]} at {mesh.place(mesh.centres[bare[0]])}."
        )
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
        raise InvalidDesignError(
            f"{file} is a structure from matrices: without a mesh there is no field to draw, and nothing "
            "that CalculiX could solve."
        )
    mesh = structure_mesh(design, file)
    check_memory(mesh, memory_limit)
    digest = structure_hash(design, file.parent)
    return assemble(design, mesh, digest, mass_as_stiffness=mass_as_stiffness)


def assemble_structure(file: Path | str, memory_limit: float | None = None) -> DesignedStructure:
    """Read a structure file with its mesh or matrices; parameters and errors as of `load_and_assemble`."""
    design, folder = load_structure(file), Path(file).parent
    if isinstance(design, MatrixDesign):
        return assemble_matrices(design, folder, structure_hash(design, folder))
    return load_and_assemble(file, memory_limit)


def assemble(
    design: MeshDesign, mesh: StructureMesh, design_hash: str, *, mass_as_stiffness: bool = False
) -> Structure:
    """Assemble the affine operators of a design on its mesh, see `load_and_assemble`."""
    material_of = _materials(design, mesh)
    regions = tuple((f"damage[{n}]", part.name, part.set) for n, part in enumerate(design.damage, 1))
    region_of = cells_by_set(mesh, regions, "damage region")
    held = supported(design, mesh)
    expansion = held.expansion
    restriction = expansion.T.tocsr()

    locator = Locator(mesh)
    weights = {
        part.name: point_shares(mesh, locator, part.point, f"mass[{number}]")
        for number, part in enumerate(design.mass, start=1)
    }
    structure_mass = _structure_mass(
        design, mesh, material_of, mesh.kind.stiffness_rule if mass_as_stiffness else mesh.kind.mass_rule
    )
    for part in design.mass:
        if not part.free:
            structure_mass = structure_mass + part.mass * _outer(weights[part.name])
    nodal_mass = np.asarray(structure_mass.sum(axis=1))
    free = tuple(part for part in design.mass if part.free)
    mass_terms = (structure_mass, *(_outer(weights[part.name]) for part in free))

    gauges, places = gauge_rows(mesh, locator, design.gauge)
    return Structure(
        **names_of(design),
        stiffness_terms=_stiffness_terms(design, mesh, material_of, region_of, held),
        mass_terms=tuple(
            (restriction @ sparse.kron(term, sparse.eye_array(3)) @ expansion).tocsr() for term in mass_terms
        ),
        load_terms=tuple(_load_terms(design, mesh, locator, restriction, nodal_mass, weights)),
        gauge_output=(gauges @ expansion).tocsr(),
        displacement_output=_point_rows(design, mesh, locator, "displacement") @ expansion,
        acceleration_output=_point_rows(design, mesh, locator, "acceleration") @ expansion,
        expansion=expansion,
        design_hash=design_hash,
        design=design,
        mesh=mesh,
        material_of=material_of,
        region_of=region_of,
        unknowns_held=held,
        gauge_places=places,
        point_weights=weights,
        nodal_mass=nodal_mass,
    )


def _load_terms(
    design: MeshDesign,
    mesh: StructureMesh,
    locator: Locator,
    restriction: sparse.csr_array,
    nodal_mass: FloatArray,
    weights: dict[str, FloatArray],
) -> Iterator[LoadTerm]:
    """Yield the parts of every load; an acceleration acts on 1 kg of each free mass as well."""
    for number, load in enumerate(design.load, start=1):
        if load.acceleration is None:
            nodal = surface_load(mesh, locator, load, f"load[{number}]")
            yield LoadTerm(load.name, restriction @ nodal.ravel())
            continue
        field = np.asarray(load.acceleration)
        yield LoadTerm(load.name, restriction @ np.outer(nodal_mass, field).ravel())
        for part in design.mass:
            if part.free:
                vector = restriction @ np.outer(weights[part.name], field).ravel()
                yield LoadTerm(load.name, vector, part.name)


def _outer(weights: FloatArray) -> sparse.csr_array:
    column = sparse.csr_array(weights[:, None])
    return (column @ column.T).tocsr()


def _structure_mass(
    design: MeshDesign, mesh: StructureMesh, material_of: IntArray, rule: Rule
) -> sparse.csr_array:
    """Mass (nodes, nodes) [kg] of one component, without point masses."""
    total = sparse.csr_array((len(mesh.points), len(mesh.points)))
    for number, part in enumerate(design.material):
        total = total + mesh.mass(np.flatnonzero(material_of == number), part.density, rule)
    return total


def _stiffness_terms(
    design: MeshDesign,
    mesh: StructureMesh,
    material_of: IntArray,
    region_of: IntArray,
    held: SupportedUnknowns,
) -> tuple[StiffnessTerm, ...]:
    """Sum the cells by pairs of a parameter and a region; the pair of none holds the springs too."""
    restriction = held.expansion.T.tocsr()
    found: dict[tuple[str | None, str | None], sparse.csr_array] = {}
    for number, part in enumerate(design.material):
        for region in np.unique(region_of[material_of == number]):
            cells = np.flatnonzero((material_of == number) & (region_of == region))
            matrix = restriction @ mesh.stiffness(cells, part.elasticity) @ held.expansion
            pair = (part.scaled_by, None if region < 0 else design.damage[region].name)
            found[pair] = found[pair] + matrix if pair in found else matrix
    springs = held.stiffness
    if springs.nnz and springs.max() > 0.0:
        found[None, None] = found[None, None] + springs if (None, None) in found else springs
    order = {name: number for number, name in enumerate(part.name for part in design.parameter)}
    order |= {part.name: number for number, part in enumerate(design.damage)}
    pairs = sorted(
        found, key=lambda pair: [(name is None, 0 if name is None else order[name]) for name in pair]
    )
    return tuple(StiffnessTerm(found[pair].tocsr(), *pair) for pair in pairs)


def _point_rows(design: MeshDesign, mesh: StructureMesh, locator: Locator, key: str) -> sparse.csr_array:
    """Rows (m, full) of the displacements of points along directions."""
    rows = [sparse.csr_array((0, mesh.unknowns))]
    for number, part in enumerate(getattr(design, key), start=1):
        shares = point_shares(mesh, locator, part.point, f"{key}[{number}]")
        direction = np.asarray(part.direction) / np.linalg.norm(part.direction)
        rows.append(sparse.csr_array(np.outer(shares, direction).reshape(1, -1)))
    return sparse.vstack(rows).tocsr()
