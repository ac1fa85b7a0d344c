"""Fields on the whole wing from the reduced model, and VTU files of them for ParaView.

No equation of the full model is solved here: the reduced solution is spread over the mesh with the static
basis, which takes milliseconds.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt

from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.kept_arrays import KeptArrays
from fe.runtime.reduced import ReducedModel
from fe.structure.field import centre_strains, write_vtu

if TYPE_CHECKING:
    from fe.wing.operators import AffineOperators

    from .reduced_basis import Reduction

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_CELLS = HEXAHEDRA_20.file_type


@dataclass(frozen=True, repr=False)
class FieldBasis(KeptArrays):
    """The bases of a reduced model on the nodes and cells of the mesh.

    Attributes
    ----------
    points : (P, 3) ndarray
        Nodes [m].
    cells : (C, 20) ndarray
        Nodes of the cells in VTK's order, with positive Jacobians.
    region : (C,) ndarray
        0 skin, 1 to K the damage regions, K + 1 webs, K + 2 ribs.
    static_displacement : (P, 3, N) ndarray
        Static basis vectors [m per unit coordinate].
    modal_displacement : (P, 3, Nm) ndarray
        Modal basis vectors.
    """

    what = "a field basis"

    points: Annotated[FloatArray, "points", 3]
    cells: Annotated[IntArray, "cells", 20]
    region: Annotated[IntArray, "cells"]
    static_displacement: Annotated[FloatArray, "points", 3, "static"]
    modal_displacement: Annotated[FloatArray, "points", 3, "modal"]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cells.min() < 0 or self.cells.max() >= len(self.points):
            raise ReducedModelFileError(
                "The cells of a field basis have nodes that are not there; build the basis anew."
            )


@dataclass(frozen=True)
class WingFields:
    """A reduced model with its field basis; `fe.reduction.model_cache.wing_fields` gives it.

    Attributes
    ----------
    model : ReducedModel
        The reduced model.
    basis : FieldBasis
        Its bases on the mesh.
    """

    model: ReducedModel
    basis: FieldBasis

    def __post_init__(self) -> None:
        sizes = (self.basis.static_displacement.shape[-1], self.basis.modal_displacement.shape[-1])
        wanted = (self.model.static_stiffness.shape[-1], self.model.modal_stiffness.shape[-1])
        if sizes != wanted or self.basis.design_hash != self.model.design_hash:
            raise ReducedModelFileError(
                f"The field basis, for {sizes} basis vectors, does not belong to the reduced model, which "
                f"has {wanted}; build both anew."
            )


def field_basis(operators: "AffineOperators", reduction: "Reduction") -> FieldBasis:
    """Spread the bases of a reduction over the mesh.

    Parameters
    ----------
    operators : AffineOperators
        The full model.
    reduction : Reduction
        What was made of it.
    """
    mesh = operators.wing_mesh

    def spread(vectors: FloatArray) -> FloatArray:
        return np.asarray(operators.expansion @ vectors)

    static = spread(reduction.static_basis)
    modal = spread(reduction.modal_basis)
    return FieldBasis(
        design_hash=operators.design_hash,
        points=mesh.points,
        cells=mesh.cells,
        region=mesh.region,
        static_displacement=static.reshape(-1, 3, static.shape[1]),
        modal_displacement=modal.reshape(-1, 3, modal.shape[1]),
    )


def write_wing_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write displacement, strain and damage of the wing at rest as a VTU file.

    Point data: `displacement` [m]. Cell data, at the centres of the cells: `strain` (xx, yy, zz, yz, xz, xy),
    `spanwise_strain` (yy, positive where compressed, as the gauges), `region` (as in `FieldBasis`),
    `stiffness_loss` (fraction).

    Parameters
    ----------
    path : str or Path
        The file; an existing one is replaced.
    wing : WingFields
        The wing, from `fe.reduction.model_cache.wing_fields`.
    vector : (V,) ndarray
        Values of all that can be chosen, from `ReducedModel.vector`.

    Raises
    ------
    OutsideModelError
        If a value lies outside the validity box of the model.
    OSError
        If the file cannot be written.
    """
    coordinates, basis = wing.model.static_response(vector).coordinates, wing.basis
    displacement, loss = basis.static_displacement @ coordinates, np.zeros(len(basis.region))
    strain = centre_strains(HEXAHEDRA_20, basis.points, basis.cells, displacement)
    for number, name in enumerate(wing.model.regions, start=1):
        loss[basis.region == number] = vector[wing.model.chosen.index(name)]
    cells = {
        "strain": strain,
        "spanwise_strain": -strain[:, 1],
        "region": basis.region,
        "stiffness_loss": loss,
    }
    write_vtu(path, basis.points, (_CELLS, basis.cells), {"displacement": displacement}, cells)


def write_modes_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write the mode shapes of the wing as a VTU file.

    Point data: `mode_1_5.632Hz` and so on, mass-normalised displacements [kg^-1/2]. Cell data: `region`.
    Parameters and errors are those of `write_wing_vtu`.
    """
    modes, basis = wing.model.modes(vector), wing.basis
    shapes = basis.modal_displacement @ modes.shape
    named = {
        f"mode_{number + 1}_{frequency:.3f}Hz": np.ascontiguousarray(shapes[:, :, number])
        for number, frequency in enumerate(modes.frequency)
    }
    write_vtu(path, basis.points, (_CELLS, basis.cells), named, {"region": basis.region})
