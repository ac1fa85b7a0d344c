"""Wings for patches kept between runs, beside the reduced models and like them."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from .cache import given_or_shipped, modelling_hash
from .errors import ReducedModelFileError
from .kept import built_once, cache_folder, kept
from .patch_arrays import PatchArrays

if TYPE_CHECKING:
    from .design import WingDesign
    from .patch_reduction import PatchSettings
    from .reduction import Progress

PATCH_FILES = ("patch_arrays.py", "patch_operators.py", "patch_reduction.py")
"""The files that decide, besides `fe.cache.MODELLING_FILES`, what a wing for patches holds."""


def patch_cache_key(design: "WingDesign", settings: "PatchSettings | None" = None) -> str:
    """Return the name of a cache entry: a hash of design, settings and modelling code."""
    digest = hashlib.sha256(f"{design.hash} {settings!r} {modelling_hash()}".encode())
    for name in PATCH_FILES:
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()[:32]


def patch_arrays(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "PatchSettings | None" = None,
) -> PatchArrays:
    """Return the wing for patches of a design, from the cache if it is there.

    Parameters
    ----------
    design : WingDesign, optional
        The wing; the shipped one if left out.
    progress : Progress, optional
        Where a build reports.
    settings : PatchSettings, optional
        How far changes may go and how well they are held.

    Returns
    -------
    PatchArrays
        For `fe.patched_wing.PatchedWing`.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled or reduced.
    """
    wing = given_or_shipped(design)
    path = cache_folder() / f"wing-{patch_cache_key(wing, settings)}-patches.npz"

    def load() -> PatchArrays:
        return _checked(path, wing)

    return kept(load) or built_once(
        path,
        load=load,
        build=lambda: build_patch_arrays(wing, progress, settings),
        keep=lambda arrays: arrays.save(path),
    )


def _checked(path: Path, design: "WingDesign") -> PatchArrays:
    arrays = PatchArrays.load(path)
    if arrays.design_hash != design.hash:
        raise ReducedModelFileError(f"{path} holds the wing of another design; delete it.")
    return arrays


def build_patch_arrays(
    design: "WingDesign", progress: "Progress | None" = None, settings: "PatchSettings | None" = None
) -> PatchArrays:
    """Build the wing for patches of a design in one thread, without the cache.

    Parameters and errors as of `patch_arrays`.
    """
    from threadpoolctl import threadpool_limits

    from .operators import assemble
    from .patch_reduction import reduce_patches
    from .reduction import stage_of

    with threadpool_limits(1):
        with stage_of(progress, "Meshing and assembling the wing"):
            operators = assemble(design)
        return reduce_patches(operators, settings, progress)
