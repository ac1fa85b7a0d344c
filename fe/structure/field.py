"""Statics and modes of a structure, by the solver of `fe.full`, and its fields as VTU files for ParaView."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.elements.cells import gradients, strain_matrix
from fe.elements.kinds import ElementKind, meshio_with_wedges
from fe.full.modes import lowest_eigenpairs
from fe.full.statics import Factorisation
from fe.runtime.errors import SolutionError

from .affine import AffineStructure
from .operators import Structure

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class StaticResponse:
    """Static response of a structure to one load.

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
    return {name: response(structure, fields[:, number]) for number, name in enumerate(structure.loads)}


def response(structure: AffineStructure, displacement: FloatArray) -> StaticResponse:
    """Evaluate the outputs of free unknowns (n,)."""
    return StaticResponse(
        displacement=displacement,
        largest=float(np.linalg.norm(structure.full_displacement(displacement), axis=1).max()),
        strain=np.asarray(structure.gauge_output @ displacement),
        output=np.asarray(structure.displacement_output @ displacement),
    )


def natural_frequencies(structure: AffineStructure, count: int) -> tuple[FloatArray, FloatArray]:
    """Lowest frequencies (m,) [Hz], rising, and mass-normalised shapes (n, m), undamaged and undamped.

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
    if not structure.mass().diagonal().any():
        raise SolutionError("The structure has no mass, hence no modes; give its materials a density.")
    values, shapes = lowest_eigenpairs(structure.stiffness(), structure.mass(), count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, structure.mass() @ shapes))
    return np.sqrt(values) / (2.0 * np.pi), shapes


def weighed(structure: Structure) -> tuple[float, FloatArray]:
    """Mass [kg] with the nominal point masses, and the centre of gravity (3,) [m]."""
    mesh, shares = structure.mesh, structure.nodal_mass
    for name, value in structure.masses.items():
        shares = shares + value * structure.point_weights[name]
    mass = float(shares.sum())
    return mass, shares @ mesh.points / mass if mass > 0.0 else mesh.points.mean(axis=0)


def centre_strains(
    kind: ElementKind, points: FloatArray, cells: NDArray[np.int64], displacement: FloatArray
) -> FloatArray:
    """Strains (nc, 6) xx, yy, zz, yz, xz, xy, shear as engineering strain, at the centres of the cells.

    Parameters
    ----------
    kind : ElementKind
        Of the cells.
    points : (nodes, 3) m
        The nodes.
    cells : (nc, k)
        Nodes of the cells.
    displacement : (nodes, 3) m
        Of all nodes.
    """
    centre = kind.places[: len(kind.corners)].mean(axis=0)
    slopes, _ = gradients(kind, points[cells], centre[None])
    moved = displacement[cells].reshape(len(cells), -1)
    return np.asarray(np.einsum("nij,nj->ni", strain_matrix(slopes[:, 0]), moved))


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
    OSError
        If the file cannot be written.
    """
    given = dict(values or {})
    stiffness, _, load = structure.at(given)
    free = Factorisation(stiffness).solve(load)
    displacement = structure.full_displacement(free)
    mesh, loss = structure.mesh, np.zeros(len(structure.mesh.cells))
    for number, name in enumerate(structure.regions):
        loss[structure.region_of == number] = given.get(name, 0.0)
    write_vtu(
        path,
        mesh.points,
        (mesh.kind.file_type, mesh.cells),
        {"displacement": displacement},
        {
            "strain": centre_strains(mesh.kind, mesh.points, mesh.cells, displacement),
            "material": structure.material_of + 1,
            "region": structure.region_of + 1,
            "stiffness_loss": loss,
        },
    )


def write_vtu(
    path: Path | str,
    points: FloatArray,
    cells: tuple[str, NDArray[np.int64]],
    point_data: dict[str, FloatArray],
    cell_data: dict[str, NDArray[Any]],
) -> None:
    """Write a VTU file, whole or not at all; `cells` are their kind in meshio and their nodes."""
    meshio, path = meshio_with_wedges(), Path(path)
    values = {name: [value] for name, value in cell_data.items()}
    mesh = meshio.Mesh(points, [cells], point_data=point_data, cell_data=values)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            temporary = Path(folder) / "field.vtu"
            meshio.write(temporary, mesh, file_format="vtu")
            temporary.replace(path)
    except OSError as error:  # with the name that was asked for, not that of the temporary file
        raise OSError(error.errno, error.strerror, str(path)) from error
