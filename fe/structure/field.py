"""Fields as VTU files for ParaView."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.full.statics import Factorisation

from .elements import ElementKind, meshio_with_wedges
from .operators import Structure

FloatArray = NDArray[np.float64]


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
    _, slopes = kind.shape_functions(centre[None])
    jacobian = np.einsum("nai,aj->nij", points[cells], slopes[0])
    along = np.einsum("ak,nki->nai", slopes[0], np.linalg.inv(jacobian))
    gradient = np.einsum("nai,naj->nij", displacement[cells], along)
    strain = gradient + gradient.transpose(0, 2, 1)
    diagonal = 0.5 * np.einsum("nii->ni", strain)
    return np.column_stack((diagonal, strain[:, 1, 2], strain[:, 0, 2], strain[:, 0, 1]))


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
