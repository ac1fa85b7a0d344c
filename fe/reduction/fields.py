"""Fields on the whole wing from the reduced model, and VTU files of them for ParaView.

No equation of the full model is solved here: the reduced solution is spread over the mesh with the static
basis, which takes milliseconds.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.reduced import ReducedModel
from fe.structure.operators import write_vtu

if TYPE_CHECKING:
    from fe.wing.operators import AffineOperators

    from .reduced_basis import Reduction


_CELLS = HEXAHEDRA_20.file_type


@dataclass(frozen=True, repr=False)
class WingFields(ReducedModel):
    """A reduced model with its bases on the nodes and cells of the mesh; `wing_fields` gives it.

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

    @property
    def model(self) -> ReducedModel:
        """The reduced model alone."""
        return ReducedModel(**_content(self))


def _content(model: ReducedModel) -> dict[str, Any]:
    """Return what a reduced model holds, by the names of its fields."""
    return {item.name: getattr(model, item.name) for item in fields(ReducedModel)}


def field_basis(operators: "AffineOperators", reduction: "Reduction") -> WingFields:
    """Spread the bases of a reduction of the full model over its mesh."""
    mesh = operators.wing_mesh
    static, modal = (
        np.asarray(operators.expansion @ basis).reshape(-1, 3, basis.shape[1])
        for basis in (reduction.static_basis, reduction.modal_basis)
    )
    return WingFields(
        **_content(reduction.model),
        points=mesh.points,
        cells=mesh.cells,
        region=mesh.region,
        static_displacement=static,
        modal_displacement=modal,
    )


def write_wing_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write displacement, strain and damage of the wing at rest as a VTU file.

    Point data: `displacement` [m]. Cell data, at the centres of the cells: `strain` (xx, yy, zz, yz, xz, xy),
    `spanwise_strain` (yy, positive where compressed, as the gauges), `region` (as in `WingFields`),
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
    FileNotWrittenError
        If the file cannot be written.
    """
    displacement = wing.static_displacement @ wing.static_response(vector).coordinates
    lost = [0.0, *(vector[wing.chosen.index(name)] for name in wing.regions), 0.0, 0.0]  # of each region
    strain = CellMesh(HEXAHEDRA_20, wing.points, wing.cells).strains(displacement)[:, 0]
    cells = {
        "strain": strain,
        "spanwise_strain": -strain[:, 1],
        "region": wing.region,
        "stiffness_loss": np.array(lost)[wing.region],
    }
    write_vtu(path, wing.points, (_CELLS, wing.cells), {"displacement": displacement}, cells)


def write_modes_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write the mode shapes of the wing as a VTU file.

    Point data: `mode_1_5.632Hz` and so on, mass-normalised displacements [kg^-1/2]. Cell data: `region`.
    Parameters and errors are those of `write_wing_vtu`.
    """
    modes = wing.modes(vector)
    named = {
        f"mode_{number}_{frequency:.3f}Hz": wing.modal_displacement @ shape
        for number, (frequency, shape) in enumerate(zip(modes.frequency, modes.shape.T, strict=True), start=1)
    }
    write_vtu(path, wing.points, (_CELLS, wing.cells), named, {"region": wing.region})
