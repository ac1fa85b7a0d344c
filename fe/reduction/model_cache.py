"""A cache of reduced models: an unchanged design is read, a changed one is built.

A build works in one thread, because sums over several threads depend on their number. A design
therefore gives the same bytes on a machine with any number of cores.

Reading a model takes a fraction of the time that the modelling code takes to import, with
scikit-fem and SciPy's sparse matrices. So only the functions that build a model import that code.

This module also computes fields on the whole wing from the reduced model, and writes them as VTU
files for ParaView. The full model is not solved for them: the reduced solution is expanded on the
mesh by the static basis, which takes milliseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, overload

import numpy as np
from threadpoolctl import threadpool_limits

from fe.runtime.arrays import FloatArray, IntArray, StoredArrays
from fe.runtime.changeable import ChangeableModel
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fe.structure.design import load_structure, structure_hash
from fe.structure.tables import StructureSettings
from fe.structure.vtu import write_vtu
from fe.wing.design import WingDesign, load_design
from reporting.files import atomic_write_bytes, hash_bytes, hash_tree
from reporting.progress import Progress, reporter

from .built_once import built_once, cache_folder

if TYPE_CHECKING:
    from fe.wing.operators import AffineOperators

    from .reduced_basis import Reduction

MODELLING_PACKAGES = ("runtime", "elements", "full", "structure", "wing", "reduction")
"""The subpackages that determine a reduced model: a change in any of their files makes a new cache
entry."""

_WING_CELLS = "hexahedron20"
"""The kind of the cells of a wing, as `fe.structure.vtu` names it."""

_Record = TypeVar("_Record", bound=StoredArrays)


def modelling_hash() -> str:
    """Return the SHA-256 of the modelling code in hexadecimal."""
    package = Path(__file__).parents[1]
    hashes = [hash_tree(package / name, suffixes=[".py", ".toml"]) for name in MODELLING_PACKAGES]
    return hash_bytes("".join(hashes).encode())


def cache_file(kind: str, design_hash: str, settings: object) -> Path:
    """Return the path of a cache entry, named by a hash of design, settings and modelling code.

    Parameters
    ----------
    kind : str
        The kind of record, such as "wing".
    settings : object
        The settings of the build; their `repr` must contain them all.
    """
    content = f"{design_hash} {settings!r} {modelling_hash()}"
    return cache_folder() / f"{kind}-{hash_bytes(content.encode())[:32]}.npz"


def _cached(record: type[_Record], path: Path, build: Callable[[], _Record]) -> _Record:
    """Return a record from its cache file, or build it in one thread and write the file."""
    build_in_one_thread: Callable[[], _Record] = threadpool_limits.wrap(limits=1)(build)
    return built_once(
        path,
        load=lambda: record.load(path),
        build=build_in_one_thread,
        keep=lambda result: atomic_write_bytes(path, result.to_bytes()),
    )


@dataclass(frozen=True, repr=False)
class WingFields(ReducedModel):
    """A reduced model with its bases on the nodes and cells of the mesh, from `wing_fields`.

    Attributes
    ----------
    points : (P, 3) array
        Positions of the nodes [m].
    cells : (C, 20) array of int
        Nodes of the cells in VTK's order, with positive Jacobians.
    region : (C,) array of int
        The region of each cell: 0 is the skin, 1 to K are the damage regions, K + 1 the webs, K + 2
        the ribs.
    static_displacement : (P, 3, N) array
        Static basis vectors [m per unit coordinate].
    static_strain : (C, 6, N) array
        Strains xx, yy, zz, yz, xz, xy of the static basis vectors at the centres of the cells, with
        engineering shear strains [1 per unit coordinate].
    modal_displacement : (P, 3, Nm) array
        Modal basis vectors.
    """

    record_name = "a field basis"

    points: Annotated[FloatArray, "points", 3]
    cells: Annotated[IntArray, "cells", 20]
    region: Annotated[IntArray, "cells"]
    static_displacement: Annotated[FloatArray, "points", 3, "static"]
    static_strain: Annotated[FloatArray, "cells", 6, "static"]
    modal_displacement: Annotated[FloatArray, "points", 3, "modal"]

    @property
    def model(self) -> ReducedModel:
        """The reduced model without the fields on the mesh."""
        return ReducedModel(**self.field_values(ReducedModel))


@overload
def reduced_model(
    source: WingDesign | None = None,
    progress: Progress | None = None,
    settings: StructureSettings | None = None,
) -> ReducedModel: ...


@overload
def reduced_model(
    source: Path | str,
    progress: Progress | None = None,
    *,
    memory_limit: float | None = None,
) -> ReducedModel: ...


def reduced_model(
    source: WingDesign | Path | str | None = None,
    progress: Progress | None = None,
    settings: StructureSettings | None = None,
    *,
    memory_limit: float | None = None,
) -> ReducedModel:
    """Return the reduced model of a wing or of a structure file, from the cache if possible.

    Parameters
    ----------
    source : WingDesign, Path or str, optional
        The design of a wing, by default the shipped one, or the path of a structure file.
    settings : StructureSettings, optional
        The required accuracy for a wing; by default that of the design.
    memory_limit : float, optional
        Memory that assembly and factorisation of a structure may take [bytes], as in
        `fe.structure.operators.load_and_assemble`.

    Raises
    ------
    FiniteElementError
        If the design or the structure cannot be read, modelled or reduced.
    """
    if isinstance(source, Path | str):
        return _reduced_structure(source, progress, memory_limit)
    wing = source or load_design()
    return _cached(
        ReducedModel,
        cache_file("wing", wing.hash, settings),
        lambda: wing_fields(wing, progress, settings).model,
    )


def wing_fields(
    design: WingDesign | None = None,
    progress: Progress | None = None,
    settings: StructureSettings | None = None,
) -> WingFields:
    """Return the reduced model of a wing with its bases on the mesh, from the cache if possible.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one by default.
    settings : StructureSettings, optional
        The required accuracy; by default that of the design.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = design or load_design()
    return _cached(
        WingFields,
        cache_file("fields", wing.hash, settings),
        lambda: build_fields(wing, progress, settings),
    )


def build_fields(
    design: WingDesign,
    progress: Progress | None = None,
    settings: StructureSettings | None = None,
) -> WingFields:
    """Build what `wing_fields` returns, without using the cache."""
    from .reduced_basis import reduce_structure

    operators = _assembled(design, progress)
    return field_basis(operators, reduce_structure(operators, settings, progress))


def _assembled(design: WingDesign, progress: Progress | None) -> "AffineOperators":
    """Assemble the operators of a wing as a stage of the progress."""
    from fe.wing.operators import assemble

    with reporter(progress).stage("Meshing and assembling the wing"):
        return assemble(design)


def patch_arrays(design: WingDesign | None = None, progress: Progress | None = None) -> PatchArrays:
    """Return the arrays of a wing that can be patched, from the cache if possible.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one by default.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = design or load_design()
    return _cached(
        PatchArrays,
        cache_file("patches", wing.hash, None),
        lambda: build_patch_arrays(wing, progress),
    )


def build_patch_arrays(design: WingDesign, progress: Progress | None = None) -> PatchArrays:
    """Build what `patch_arrays` returns, without using the cache."""
    from .patch_basis import reduce_patches

    return reduce_patches(_assembled(design, progress), progress)


def _reduced_structure(
    file: Path | str, progress: Progress | None, memory_limit: float | None
) -> ReducedModel:
    """Return the reduced model of a structure file, as `reduced_model` does."""

    def build() -> ReducedModel:
        from fe.structure.operators import assemble_structure

        from .reduced_basis import reduce_structure

        with reporter(progress).stage("Reading the mesh and assembling"):
            structure = assemble_structure(file, memory_limit)
        return reduce_structure(structure, progress=progress).model

    return _cached(ReducedModel, _structure_cache_file(Path(file)), build)


def changeable_model(file: Path | str, progress: Progress | None = None) -> ChangeableModel:
    """Return the changeable model of a structure file, from the cache if possible.

    It has a force and a displacement at each port of the file, see
    `AffineStructure.with_port_forces`, and the columns for changes of the structure. Its
    `design_hash` is that of the model without ports.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read, modelled or reduced.
    """

    def build() -> ChangeableModel:
        from fe.structure.operators import assemble_structure

        from .change_basis import with_changes
        from .reduced_basis import reduce_structure

        with reporter(progress).stage("Reading the mesh and assembling"):
            yielding = assemble_structure(file, yielding=True).with_port_forces()
        reduction = reduce_structure(yielding.with_held_supports(), progress=progress)
        with reporter(progress).stage("Reducing the changes of the structure"):
            return with_changes(yielding, reduction)

    return _cached(ChangeableModel, _structure_cache_file(Path(file), with_ports=True), build)


def check_structure(file: Path | str) -> None:
    """Check that a structure file can be assembled, unless its reduced model is in the cache.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read or modelled.
    """
    if not _structure_cache_file(Path(file)).is_file():
        from fe.structure.operators import assemble_structure

        assemble_structure(file)


def _structure_cache_file(file: Path, *, with_ports: bool = False) -> Path:
    """Return the path of a structure file's cache entry, with ports or without."""
    design = load_structure(file)
    design_hash = structure_hash(design, file.parent, with_ports=with_ports)
    kind = "changeable" if with_ports else "structure"
    return cache_file(kind, design_hash, design.reduction)


def field_basis(operators: "AffineOperators", reduction: "Reduction") -> WingFields:
    """Return a reduced model of a wing with its basis vectors as fields on the full mesh."""
    from fe.elements.cells import CellMesh
    from fe.elements.kinds import HEXAHEDRA_20

    mesh = operators.wing_mesh

    def on_nodes(basis: FloatArray) -> FloatArray:
        return np.asarray(operators.expansion @ basis).reshape(-1, 3, basis.shape[1])

    static_displacement = on_nodes(reduction.static_basis)
    cells = CellMesh(HEXAHEDRA_20, mesh.points, mesh.cells)
    static_strain = [
        cells.strains(vector)[:, 0] for vector in np.moveaxis(static_displacement, 2, 0)
    ]

    return WingFields(
        **reduction.model.field_values(),
        points=mesh.points,
        cells=mesh.cells,
        region=mesh.region,
        static_displacement=static_displacement,
        static_strain=np.stack(static_strain, axis=2),
        modal_displacement=on_nodes(reduction.modal_basis),
    )


def write_wing_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write static displacement, strain and damage of the wing as a VTU file.

    Point data is `displacement` [m]. Cell data, at the centres of the cells, are `strain` (xx, yy,
    zz, yz, xz, xy), `spanwise_strain` (yy, positive if compressed, as the gauges read it), `region`
    (as in `WingFields`) and `stiffness_loss` (fraction).

    Parameters
    ----------
    path : str or Path
        The file; an existing one is replaced.
    vector : (V,) array
        Values of the inputs, from `ReducedModel.vector`.

    Raises
    ------
    OutsideModelError
        If a value lies outside the validity box of the model.
    FileNotWrittenError
        If the file cannot be written.
    """
    coordinates = wing.static_response(vector).coordinates
    displacement = wing.static_displacement @ coordinates
    strain = wing.static_strain @ coordinates
    _, strain_along_span, *_ = strain.T
    region_losses = [vector[wing.input_names.index(name)] for name in wing.regions]
    skin_loss, web_loss, rib_loss = 0.0, 0.0, 0.0
    losses = np.array([skin_loss, *region_losses, web_loss, rib_loss])
    write_vtu(
        path,
        wing.points,
        (_WING_CELLS, wing.cells),
        point_data={"displacement": displacement},
        cell_data={
            "strain": strain,
            "spanwise_strain": -strain_along_span,
            "region": wing.region,
            "stiffness_loss": losses[wing.region],
        },
    )


def write_modes_vtu(path: str | Path, wing: WingFields, vector: FloatArray) -> None:
    """Write the mode shapes of the wing as a VTU file.

    Point data are `mode_1_5.632Hz` and so on, mass-normalised displacements [kg^-1/2]. Cell data is
    `region`.

    Parameters
    ----------
    path : str or Path
        The file; an existing one is replaced.
    vector : (V,) array
        Values of the inputs, from `ReducedModel.vector`.

    Raises
    ------
    OutsideModelError
        If a value lies outside the validity box of the model.
    FileNotWrittenError
        If the file cannot be written.
    """
    modes = wing.modes(vector)
    shapes = {}
    for number, (frequency, shape) in enumerate(
        zip(modes.frequency, modes.shape.T, strict=True), start=1
    ):
        shapes[f"mode_{number}_{frequency:.3f}Hz"] = wing.modal_displacement @ shape
    write_vtu(
        path,
        wing.points,
        (_WING_CELLS, wing.cells),
        point_data=shapes,
        cell_data={"region": wing.region},
    )
