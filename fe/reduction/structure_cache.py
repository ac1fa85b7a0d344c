"""Reduced structures kept between runs: unchanged files are reduced once, changed ones anew."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from fe.runtime.archive import write_bytes_atomically
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.reduced import ReducedModel

from .built_once import built_once, cache_folder
from .model_cache import MODELLING_ROOMS, modelling_hash

if TYPE_CHECKING:
    from fe.structure.operators import Structure

    from .stages import Progress
    from .structure_basis import StructureSettings


def reduced_structure(
    file: Path | str,
    settings: "StructureSettings | None" = None,
    progress: "Progress | None" = None,
    *,
    memory_limit: float | None = None,
) -> ReducedModel:
    """Return the reduced model of a structure file, from the cache if it is there.

    A build works in one thread, so that the same files give the same bytes on a machine.

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

    def load() -> ReducedModel:
        model = ReducedModel.load(path)
        if model.design_hash != design_hash:
            raise ReducedModelFileError(f"{path} holds the model of another structure; delete it.")
        return model

    def build() -> ReducedModel:
        from fe.structure.operators import load_and_assemble

        from .stages import stage_of

        with stage_of(progress, "Reading the mesh and assembling"):
            structure = load_and_assemble(file, memory_limit)
        return reduced(structure, settings, progress)

    return built_once(
        path, load=load, build=build, keep=lambda model: write_bytes_atomically(path, model.to_bytes())
    )


def check_structure(file: Path | str) -> None:
    """Read a structure file with its mesh and assemble both, unless their reduced model is kept.

    Raises
    ------
    FiniteElementError
        If the structure cannot be read or modelled.
    """
    from fe.structure.operators import load_and_assemble

    if not _place(Path(file))[2].is_file():
        load_and_assemble(file)


def _place(file: Path, settings: "StructureSettings | None" = None) -> tuple["StructureSettings", str, Path]:
    """Return how a structure is reduced, its hash with that of its mesh, and where its model is kept."""
    from fe.structure.design import load_structure, structure_hash

    from .structure_basis import StructureSettings

    design = load_structure(file)
    settings = settings or StructureSettings.of(design)
    design_hash = structure_hash(design, file.parent / design.mesh)
    content = f"{design_hash} {settings!r} {modelling_hash((*MODELLING_ROOMS, 'structure'))}"
    return (
        settings,
        design_hash,
        cache_folder() / f"structure-{hashlib.sha256(content.encode()).hexdigest()[:32]}.npz",
    )


def reduced(
    structure: "Structure", settings: "StructureSettings | None" = None, progress: "Progress | None" = None
) -> ReducedModel:
    """Reduce an assembled structure in one thread, without the cache; see `reduced_structure`."""
    from threadpoolctl import threadpool_limits

    from .structure_basis import StructureSettings, reduce_structure

    settings = settings or StructureSettings.of(structure.design)
    with threadpool_limits(1):
        return reduce_structure(structure, structure.design.name, settings, progress).model
