"""Reduced models kept between runs: an unchanged design is built once, a changed one is built anew.

A build works in one thread, because sums over several threads depend on their number: a design gives the same
bytes on a machine whatever its cores do.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from fe.runtime.arrays import KeptArrays
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fe.structure.design import load_structure, structure_hash
from fe.structure.operators import assemble_structure
from fe.wing.design import WingDesign, load_design
from fe.wing.operators import AffineOperators, assemble
from reporting.files import atomic_write_bytes
from reporting.progress import Progress, reporter
from reporting.provenance import hash_bytes, hash_tree

from .built_once import built_once, cache_folder
from .fields import WingFields, field_basis
from .settings import StructureSettings

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
    file: Path | str, progress: Progress | None = None, *, memory_limit: float | None = None
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

    Raises
    ------
    FiniteElementError
        If the structure cannot be read, modelled or reduced.
    """

    def build() -> ReducedModel:
        from .reduced_basis import reduce_structure

        with reporter(progress).stage("Reading the mesh and assembling"):
            structure = assemble_structure(file, memory_limit)
        return reduce_structure(structure, progress=progress).model

    return _once(ReducedModel, "structure", *_asked(Path(file)), build)


def check_structure(file: Path | str) -> None:
    """Read a structure file with its mesh and assemble both, unless their reduced model is kept.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read or modelled.
    """
    if not entry("structure", *_asked(Path(file))).is_file():
        assemble_structure(file)


def _asked(file: Path) -> tuple[str, object]:
    """Return the hash of a structure file with its mesh, and how it is to be reduced."""
    design = load_structure(file)
    return structure_hash(design, file.parent), design.reduction
