"""The one way from a wing design to its FMU: reduced, tailored to a calibration, with missing effects."""

import os
from collections.abc import Mapping, Sequence
from typing import Protocol

from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign
from fmu_asset.compiled.compiler import PLATFORM, Platform
from fmu_asset.compiled.package import FmiVersion
from fmu_asset.instances.plan import Interface
from reporting.progress import Progress, SilentProgress

from .contents import FmuInfo
from .patch_file import PatchFile
from .structure_fmu import FmuKind, build_fmu


class Tailoring(Protocol):
    """What an FMU takes of the calibration of a wing; `calibration.wing.wing_record` makes it."""

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
    kind: FmuKind = "python",
    patch: PatchFile | None = None,
    activate: bool = False,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
    platforms: Sequence[Platform] = (PLATFORM,),
    replace: bool = False,
    progress: Progress | None = None,
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
    kind, patch, activate, fmi, interface, platforms, replace
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
    return build_fmu(
        reduced_model(design, progress=progress),
        path,
        state=None if tailoring is None else tailoring.state,
        note="" if tailoring is None else tailoring.note,
        resources=None if tailoring is None else tailoring.resources,
        kind=kind,
        patch=patch,
        activate=activate,
        arrays=arrays_for(design, patch, progress),
        fmi=fmi,
        interface=interface,
        platforms=platforms,
        replace=replace,
    )


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
