"""The one way from a wing design to its FMU: reduced, tailored to a calibration, with missing effects."""

import os
from collections.abc import Mapping
from typing import Protocol, Unpack

from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign
from reporting.progress import Progress, SilentProgress

from .contents import FmuInfo
from .patch_file import PatchFile
from .structure_fmu import FmuOptions, build_fmu


class Tailoring(Protocol):
    """What an FMU takes of the calibration of a wing; `calibration.result.plain` makes it."""

    @property
    def state(self) -> DigitalState:
        """Start values of parameters and health."""

    @property
    def note(self) -> str:
        """A sentence for the description."""

    @property
    def resources(self) -> Mapping[str, bytes]:
        """Files that say what the wing was calibrated with, by name."""


def pack_wing(
    design: WingDesign,
    path: str | os.PathLike[str],
    *,
    tailoring: Tailoring | None = None,
    replace: bool = False,
    progress: Progress | None = None,
    **options: Unpack[FmuOptions],
) -> FmuInfo:
    """Reduce a wing design and pack it as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    design : WingDesign
        The wing; of a calibrated one its tailored design.
    path : path-like
        Where to write, with the suffix .fmu.
    tailoring : Tailoring, optional
        The calibration: the FMU starts at its means and carries its record.
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
    progress = progress or SilentProgress()
    model = reduced_model(design, progress=progress)
    options["arrays"] = arrays_for(design, options.get("patch"), progress)
    if tailoring is not None:
        options |= {"state": tailoring.state, "note": tailoring.note, "resources": tailoring.resources}
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
    if patch is None or not patch.needs_arrays:
        return None
    return patch_arrays(design, progress or SilentProgress())
