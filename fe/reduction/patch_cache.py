"""Wings for patches kept between runs, beside the reduced models and like them."""

from typing import TYPE_CHECKING

from fe.runtime.errors import ReducedModelFileError
from fe.runtime.patch_arrays import PatchArrays

from .built_once import built_once, cache_folder, kept
from .model_cache import assembled, cache_key, given_or_shipped

if TYPE_CHECKING:
    from fe.wing.design import WingDesign

    from .patch_basis import PatchSettings
    from .stages import Progress


def patch_arrays(
    design: "WingDesign | None" = None,
    progress: "Progress | None" = None,
    settings: "PatchSettings | None" = None,
) -> PatchArrays:
    """Return the wing for patches of a design, from the cache if it is there.

    Parameters and errors are those of `fe.reduction.model_cache.reduced_model`; the settings say how far
    changes may go and how well they are held.
    """
    wing = given_or_shipped(design)
    path = cache_folder() / f"wing-{cache_key(wing, settings)}-patches.npz"

    def load() -> PatchArrays:
        arrays = PatchArrays.load(path)
        if arrays.design_hash != wing.hash:
            raise ReducedModelFileError(f"{path} holds the wing of another design; delete it.")
        return arrays

    return kept(load) or built_once(
        path,
        load=load,
        build=lambda: build_patch_arrays(wing, progress, settings),
        keep=lambda arrays: arrays.save(path),
    )


def build_patch_arrays(
    design: "WingDesign", progress: "Progress | None" = None, settings: "PatchSettings | None" = None
) -> PatchArrays:
    """Build the wing for patches of a design in one thread, without the cache.

    Parameters and errors as of `patch_arrays`.
    """
    from .patch_basis import reduce_patches

    with assembled(design, progress) as operators:
        return reduce_patches(operators, settings, progress)
