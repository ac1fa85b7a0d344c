"""The one way from a wing design to its FMU: reduced, tailored to a calibration, with missing effects."""

import os
from typing import Unpack

from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.sensors import needs_structure
from fe.wing.design import WingDesign
from reporting.progress import Progress

from .contents import FmuInfo
from .patch_file import PatchFile
from .structure_fmu import FmuOptions, build_fmu


def pack_wing(
    design: WingDesign,
    path: str | os.PathLike[str],
    *,
    replace: bool = False,
    progress: Progress | None = None,
    **options: Unpack[FmuOptions],
) -> FmuInfo:
    """Reduce a wing design and pack it as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    design : WingDesign
        The wing; of a calibrated one its tailored design, with what `calibration.result.file.tailoring`
        gives among the options.
    path : path-like
        Where to write, with the suffix .fmu.
    replace, **options
        See `fmu_asset.packing.structure_fmu.build_fmu`.
    progress : Progress, optional
        Shows what takes long.

    Raises
    ------
    FiniteElementError
        The design cannot be modelled.
    FmuBuildError, PatchFileError
        See `fmu_asset.packing.structure_fmu.build_fmu`.
    """
    model = reduced_model(design, progress=progress)
    options["arrays"] = arrays_for(design, options.get("patch"), progress)
    return build_fmu(model, path, replace=replace, **options)


def arrays_for(
    design: WingDesign, patch: PatchFile | None, progress: Progress | None = None
) -> PatchArrays | None:
    """Return the wing in the basis for patches; None where the patch does not need it.

    Raises
    ------
    FiniteElementError
        The design cannot be modelled.
    """
    if patch is None or not needs_structure(patch.patch):
        return None
    return patch_arrays(design, progress)
