"""Reduced models kept between runs: an unchanged design is built once, a changed one is built anew.

A build works in one thread, because sums over several threads depend on their number: a design gives the same
bytes on a machine whatever its cores do.

Also fields on the whole wing from the reduced model, and VTU files of them for ParaView. No equation of the
full model is solved there: the reduced solution is spread over the mesh with the static basis, which takes
milliseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import FloatArray, IntArray, KeptArrays
from fe.runtime.reduced import ReducedModel
from fe.runtime.wing_rows import PatchArrays
from fe.structure.design import load_structure, structure_hash
from fe.structure.operators import assemble_structure, write_vtu
from fe.structure.tables import StructureSettings
from fe.wing.design import WingDesign, load_design
from fe.wing.operators import AffineOperators, assemble
from reporting.files import atomic_write_bytes, hash_bytes, hash_tree
from reporting.progress import Progress, reporter

from .built_once import built_once, cache_folder

if TYPE_CHECKING:
    from .reduced_basis import Reduction

MODELLING_ROOMS = ("runtime", "elements", "full", "structure", "wing", "reduction")
"""The rooms that decide what a reduced model holds; a change in any of their files makes a new entry."""

_Kept = TypeVar("_Kept", bound=KeptArrays)
Settings = StructureSettings | None


def modelling_hash() -> str:
    """Return the SHA-256 of the modelling code, hexadecimal."""
    rooms = (
        hash_tree(Path(__file__).parents[1] / room, suffixes=[".py", ".toml"]) for room in MODELLING_ROOMS
    )
    return hash_bytes("".join(rooms).encode())


def entry(kind: str, design_hash: str, settings: object) -> Path:
    """Return the file of a cache entry: named by a hash of design, settings and modelling code."""
    content = f"{design_hash} {settings!r} {modelling_hash()}"
    return cache_folder() / f"{kind}-{hash_bytes(content.encode())[:32]}.npz"


def _once(
    kind: type[_Kept], name: str, design_hash: str, settings: object, build: Callable[[], _Kept]
) -> _Kept:
    """Return the arrays of a design from their file, or else build them in one thread, and keep them."""
    path = entry(name, design_hash, settings)
    built: Callable[[], _Kept] = threadpool_limits.wrap(limits=1)(build)
    return built_once(
        path, lambda: kind.load(path), built, lambda made: atomic_write_bytes(path, made.to_bytes())
    )


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


def reduced_model(
    design: WingDesign | None = None, progress: Progress | None = None, settings: Settings = None
) -> ReducedModel:
    """Return the reduced model of a wing, from the cache if it is there.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one if left out.
    progress : Progress, optional
        Where a build reports.
    settings : StructureSettings, optional
        How well the model is to hold.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = design or load_design()

    def build() -> ReducedModel:
        return wing_fields(wing, progress, settings).model

    return _once(ReducedModel, "wing", wing.hash, settings, build)


def wing_fields(
    design: WingDesign | None = None, progress: Progress | None = None, settings: Settings = None
) -> WingFields:
    """Return the reduced model of a wing with its bases on the mesh, from the cache if it is there.

    Parameters and errors as of `reduced_model`.
    """
    wing = design or load_design()
    return _once(WingFields, "fields", wing.hash, settings, lambda: build_fields(wing, progress, settings))


def build_fields(
    design: WingDesign, progress: Progress | None = None, settings: Settings = None
) -> WingFields:
    """Build the reduced model and the bases of a wing, without the cache; see `reduced_model`."""
    from .reduced_basis import reduce_structure

    operators = _assembled(design, progress)
    return field_basis(operators, reduce_structure(operators, settings, progress))


def _assembled(design: WingDesign, progress: Progress | None) -> AffineOperators:
    with reporter(progress).stage("Meshing and assembling the wing"):
        return assemble(design)


def patch_arrays(design: WingDesign | None = None, progress: Progress | None = None) -> PatchArrays:
    """Return the wing for patches of a design, from the cache if it is there.

    Parameters and errors are those of `reduced_model`.
    """
    wing = design or load_design()
    return _once(PatchArrays, "patches", wing.hash, None, lambda: build_patch_arrays(wing, progress))


def build_patch_arrays(design: WingDesign, progress: Progress | None = None) -> PatchArrays:
    """Build the wing for patches of a design, without the cache; see `patch_arrays`."""
    from .patch_basis import reduce_patches

    return reduce_patches(_assembled(design, progress), progress)


def reduced_structure(
    file: Path | str,
    progress: Progress | None = None,
    *,
    memory_limit: float | None = None,
    with_ports: bool = False,
) -> ReducedModel:
    """Return the reduced model of a structure file, from the cache if it is there.

    Parameters
    ----------
    file : Path or str
        The structure file, beside its mesh.
    progress : Progress, optional
        Where a build reports.
    memory_limit : float, optional
        As of `fe.structure.operators.load_and_assemble`.
    with_ports : bool
        Whether the model also holds the force and the displacement at each port of the file, see
        `AffineStructure.pushed_at_ports`. Its `design_hash` is the one of the model without them.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read, modelled or reduced.
    """

    def build() -> ReducedModel:
        from .reduced_basis import reduce_structure

        with reporter(progress).stage("Reading the mesh and assembling"):
            structure = assemble_structure(file, memory_limit)
        if with_ports:
            structure = structure.pushed_at_ports()
        return reduce_structure(structure, progress=progress).model

    return _once(ReducedModel, "structure", *_asked(Path(file), with_ports=with_ports), build)


def check_structure(file: Path | str) -> None:
    """Read a structure file with its mesh and assemble both, unless their reduced model is kept.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read or modelled.
    """
    if not entry("structure", *_asked(Path(file))).is_file():
        assemble_structure(file)


def _asked(file: Path, *, with_ports: bool = False) -> tuple[str, object]:
    """Return the hash of a structure file with its mesh, and how it is to be reduced."""
    design = load_structure(file)
    return structure_hash(design, file.parent, with_ports=with_ports), design.reduction


def field_basis(operators: AffineOperators, reduction: "Reduction") -> WingFields:
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
        The wing, from `wing_fields`.
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
    write_vtu(path, wing.points, (HEXAHEDRA_20.file_type, wing.cells), {"displacement": displacement}, cells)


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
    write_vtu(path, wing.points, (HEXAHEDRA_20.file_type, wing.cells), named, {"region": wing.region})
