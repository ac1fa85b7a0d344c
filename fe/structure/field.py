"""Statics and modes of a structure, by the solver of `fe.full`, and its fields as VTU files for ParaView."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.elements.cells import centre_strains
from fe.elements.kinds import meshio_with_wedges
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import SolutionError
from reporting.files import atomic_file

from .affine import AffineStructure
from .operators import Structure


@dataclass(frozen=True)
class StaticResponse:
    """Static response of a structure.

    Attributes
    ----------
    displacement : (n,) m
        Free unknowns.
    largest : float
        Largest displacement of a node [m].
    strain : (gauges,)
        Strain at the gauges, positive in tension.
    output : (displacements,) m
        Displacement outputs.
    """

    displacement: FloatArray
    largest: float
    strain: FloatArray
    output: FloatArray


def static_responses(structure: AffineStructure) -> dict[str, StaticResponse]:
    """Solve for each load alone, its control at the nominal value, the structure undamaged.

    Raises
    ------
    SolutionError
        If the stiffness cannot be factorised, or a solution is not accurate.
    """
    if not structure.loads:
        return {}
    factors = Factorisation(structure.stiffness())
    fields = factors.solve(np.column_stack([structure.load(name) for name in structure.loads]))
    return {name: _response(structure, field) for name, field in zip(structure.loads, fields.T, strict=True)}


def static_response(structure: AffineStructure, values: Mapping[str, float]) -> StaticResponse:
    """Solve for all loads together at values by name; what is left out is nominal, and healthy.

    Raises
    ------
    SolutionError
        As of `static_responses`.
    """
    stiffness, _, load = structure.at(values)
    return _response(structure, Factorisation(stiffness).solve(load))


def _response(structure: AffineStructure, displacement: FloatArray) -> StaticResponse:
    return StaticResponse(
        displacement=displacement,
        largest=float(np.linalg.norm(structure.full_displacement(displacement), axis=1).max()),
        strain=np.asarray(structure.gauge_output @ displacement),
        output=np.asarray(structure.displacement_output @ displacement),
    )


def natural_frequencies(
    structure: AffineStructure, count: int, values: Mapping[str, float] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Lowest frequencies (m,) [Hz], rising, and mass-normalised shapes (n, m), undamped; see `at` for values.

    Raises
    ------
    SolutionError
        If there is no mass, there are not so many modes, or the iteration did not converge.
    """
    if count >= structure.unknowns:
        raise SolutionError(
            f"{count} modes were asked for, but a structure of {structure.unknowns} free unknowns gives at "
            f"most {structure.unknowns - 1}."
        )
    stiffness, mass, _ = structure.at(values or {})
    if not mass.diagonal().any():
        raise SolutionError("The structure has no mass, hence no modes; give its materials a density.")
    squares, shapes = lowest_eigenpairs(stiffness, mass, count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, mass @ shapes))
    return np.sqrt(squares) / (2.0 * np.pi), shapes


def weighed(structure: Structure) -> tuple[float, FloatArray]:
    """Mass [kg] with the nominal point masses, and the centre of gravity (3,) [m]."""
    shares, points = structure.nodal_mass, structure.mesh.points
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
    given = dict(values or {})
    displacement = structure.full_displacement(static_response(structure, given).displacement)
    mesh, loss = structure.mesh, np.zeros(len(structure.mesh.cells))
    for number, name in enumerate(structure.regions):
        loss[structure.region_of == number] = given.get(name, 0.0)
    write_vtu(
        path,
        mesh.points,
        (mesh.kind.file_type, mesh.cells),
        {"displacement": displacement},
        {
            "strain": centre_strains(mesh, displacement),
            "material": structure.material_of + 1,
            "region": structure.region_of + 1,
            "stiffness_loss": loss,
        },
    )


def write_vtu(
    path: Path | str,
    points: FloatArray,
    cells: tuple[str, IntArray],
    point_data: dict[str, FloatArray],
    cell_data: dict[str, NDArray[Any]],
) -> None:
    """Write a VTU file, whole or not at all; `cells` are their kind in meshio and their nodes."""
    meshio, values = meshio_with_wedges(), {name: [value] for name, value in cell_data.items()}
    mesh = meshio.Mesh(points, [cells], point_data=point_data, cell_data=values)
    with atomic_file(path) as temporary:
        meshio.write(temporary, mesh, file_format="vtu")
