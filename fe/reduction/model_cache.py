"""Reduced models kept between runs: an unchanged design is built once, a changed one is built anew.

A build works in one thread, because sums over several threads depend on their number: a design gives the same
bytes on a machine whatever its cores do.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from fe.runtime.errors import ReducedModelFileError
from fe.runtime.kept_arrays import KeptArrays
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from reporting.progress import SilentProgress

from .built_once import built_once, cache_folder, kept
from .fields import FieldBasis, WingFields, field_basis

if TYPE_CHECKING:
    from fe.structure.affine import DesignedStructure
    from fe.wing.design import WingDesign
    from fe.wing.operators import AffineOperators
    from reporting.progress import Progress

    from .patch_basis import PatchSettings
    from .settings import ReductionSettings, StructureSettings

MODELLING_ROOMS = ("runtime", "elements", "full", "structure", "wing", "reduction")
"""The rooms that decide what a reduced model holds; a change in any of their files makes a new entry."""

_Kept = TypeVar("_Kept", bound=KeptArrays)


def modelling_hash() -> str:
    """Return the SHA-256 of the modelling code, hexadecimal."""
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for room in MODELLING_ROOMS:
        for path in sorted((package / room).rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def entry(kind: str, design_hash: str, settings: object) -> Path:
    """Return the file of a cache entry: named by a hash of design, settings and modelling code."""
    content = f"{design_hash} {settings!r} {modelling_hash()}"
    return cache_folder() / f"{kind}-{hashlib.sha256(content.encode()).hexdigest()[:32]}.npz"


def _loaded(kind: type[_Kept], path: Path, design_hash: str) -> _Kept:
    arrays = kind.load(path)
    if arrays.design_hash != design_hash:
        raise ReducedModelFileError(f"{path} holds {kind.what} of another design; delete it.")
    return arrays


def _once(kind: type[_Kept], path: Path, design_hash: str, build: Callable[[], _Kept]) -> _Kept:
    return built_once(path, lambda: _loaded(kind, path, design_hash), build, lambda made: made.save(path))


# ---------------------------------------------------------------- wings


def given_or_shipped(design: "WingDesign | None") -> "WingDesign":
    """Return a design, the shipped one if none is given."""
    if design is not None:
        return design
    from fe.wing.design import load_design

    return load_design()


def reduced_model(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "ReductionSettings | None" = None,
) -> ReducedModel:
    """Return the reduced model of a wing, from the cache if it is there.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one if left out.
    progress : Progress, optional
        Where a build reports.
    settings : ReductionSettings, optional
        Where and how well the model is to hold.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = given_or_shipped(design)
    path = entry("wing", wing.hash, settings)
    found = kept(lambda: _loaded(ReducedModel, path, wing.hash))
    return found or _kept_fields(wing, path, progress, settings).model


def wing_fields(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "ReductionSettings | None" = None,
) -> WingFields:
    """Return the reduced model of a wing with its field basis, from the cache if both are there.

    Parameters and errors as of `reduced_model`.
    """
    wing = given_or_shipped(design)
    path = entry("wing", wing.hash, settings)
    return _kept_fields(wing, path, progress, settings)


def _kept_fields(
    design: "WingDesign", path: Path, progress: "Progress | None", settings: "ReductionSettings | None"
) -> WingFields:
    fields = path.with_name(f"{path.stem}-fields.npz")

    def load() -> WingFields:
        model = _loaded(ReducedModel, path, design.hash)
        return WingFields(model, _loaded(FieldBasis, fields, design.hash))

    def keep(wing: WingFields) -> None:
        wing.basis.save(fields)
        wing.model.save(path)

    return built_once(path, load, lambda: build(design, progress, settings), keep)


def build(
    design: "WingDesign", progress: "Progress | None" = None, settings: "ReductionSettings | None" = None
) -> WingFields:
    """Build the reduced model and the field basis of a wing, without the cache; see `reduced_model`."""
    from .reduced_basis import reduce_model

    with assembled(design, progress) as operators:
        reduction = reduce_model(operators, settings, progress)
        return WingFields(reduction.model, field_basis(operators, reduction))


@contextmanager
def assembled(design: "WingDesign", progress: "Progress | None") -> "Iterator[AffineOperators]":
    """Give the full model of a design, and hold the process to one thread meanwhile."""
    from threadpoolctl import threadpool_limits

    from fe.wing.operators import assemble

    with threadpool_limits(1):
        with (progress or SilentProgress()).stage("Meshing and assembling the wing"):
            operators = assemble(design)
        yield operators


def patch_arrays(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "PatchSettings | None" = None,
) -> PatchArrays:
    """Return the wing for patches of a design, from the cache if it is there.

    Parameters and errors are those of `reduced_model`; the settings say how far changes may go and how well
    they are held.
    """
    wing = given_or_shipped(design)
    path = entry("patches", wing.hash, settings)
    return _once(PatchArrays, path, wing.hash, lambda: build_patch_arrays(wing, progress, settings))


def build_patch_arrays(
    design: "WingDesign", progress: "Progress | None" = None, settings: "PatchSettings | None" = None
) -> PatchArrays:
    """Build the wing for patches of a design, without the cache; see `patch_arrays`."""
    from .patch_basis import reduce_patches

    with assembled(design, progress) as operators:
        return reduce_patches(operators, settings, progress)


# ---------------------------------------------------------------- structures from a mesh


def reduced_structure(
    file: Path | str,
    settings: "StructureSettings | None" = None,
    progress: "Progress | None" = None,
    *,
    memory_limit: float | None = None,
) -> ReducedModel:
    """Return the reduced model of a structure file, from the cache if it is there.

    Parameters
    ----------
    file : Path or str
        The structure file, beside its mesh.
    settings : StructureSettings, optional
        How well it is to hold; by default as its file says.
    progress : Progress, optional
        Where a build reports.
    memory_limit : float, optional
        As of `fe.structure.operators.load_and_assemble`.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read, modelled or reduced.
    """
    file = Path(file)
    settings, design_hash, path = _place(file, settings)

    def build_structure() -> ReducedModel:
        from fe.structure.operators import assemble_structure

        with (progress or SilentProgress()).stage("Reading the mesh and assembling"):
            structure = assemble_structure(file, memory_limit)
        return reduced(structure, settings, progress)

    return _once(ReducedModel, path, design_hash, build_structure)


def check_structure(file: Path | str) -> None:
    """Read a structure file with its mesh and assemble both, unless their reduced model is kept.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read or modelled.
    """
    from fe.structure.operators import assemble_structure

    if not _place(Path(file))[2].is_file():
        assemble_structure(file)


def _place(file: Path, settings: "StructureSettings | None" = None) -> tuple["StructureSettings", str, Path]:
    """Return how a structure is reduced, its hash with that of its mesh, and where its model is kept."""
    from fe.structure.design import load_structure, structure_hash

    from .settings import StructureSettings

    design = load_structure(file)
    settings = settings or StructureSettings.of(design)
    design_hash = structure_hash(design, file.parent)
    return settings, design_hash, entry("structure", design_hash, settings)


def reduced(
    structure: "DesignedStructure",
    settings: "StructureSettings | None" = None,
    progress: "Progress | None" = None,
) -> ReducedModel:
    """Reduce an assembled structure in one thread, without the cache; see `reduced_structure`."""
    from threadpoolctl import threadpool_limits

    from .reduced_basis import reduce_structure
    from .settings import StructureSettings

    settings = settings or StructureSettings.of(structure.design)
    with threadpool_limits(1):
        return reduce_structure(structure, structure.design.name, settings, progress).model
