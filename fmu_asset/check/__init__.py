"""Checks of an FMU beyond what flying it shows: rules of the standard, rules of ours, its behaviour."""

import os

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.door.draft import trial_binding
from fmu_asset.errors import BindingError, FmuError
from reporting.progress import Progress, SilentProgress

from .file import check_file
from .flight import Flights
from .result import Finding, FmuCheck

__all__ = ["Finding", "FmuCheck", "check_fmu"]


def check_fmu(
    path: str | os.PathLike[str],
    binding: Binding | str | os.PathLike[str] | None = None,
    *,
    cycles: int = 0,
    step_size: float | None = None,
    step_timeout: float | None = None,
    memory_limit: float | None = None,
    progress: Progress | None = None,
) -> FmuCheck:
    """Check an FMU: file, `fmpy validate`, units, and what it does in workers.

    Parameters
    ----------
    path : path-like
        Any FMU.
    binding : Binding or path-like, optional
        How it is flown; drafted from the model description if absent.
    cycles : int
        How many instances are made and freed one after the other in one process; 0 skips that.
    step_size : float, optional
        Communication step size of a drafted binding [s].
    step_timeout, memory_limit : float, optional
        Limits of the workers, as in `FmiAsset`.
    progress : Progress, optional
        Shows the stages.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If there is no FMU to check.
    BindingError
        If the binding file cannot be read.
    """
    given = binding if isinstance(binding, Binding) or binding is None else load_binding(binding)
    description = read_fmu(path, given.binding.interface if given else None)
    findings = list(check_file(description))
    try:
        used = given or trial_binding(description, step_size=step_size)
        limits = {"step_timeout": step_timeout, "memory_limit": memory_limit}
        flights = Flights(
            description, used, {name: value for name, value in limits.items() if value is not None}
        )
    except FmuError as error:
        if isinstance(error, BindingError) and given is None:
            error = BindingError(f"No binding can be drafted for it: {error.sentence}")
        findings.append(Finding("binding", "problem", error.sentence))
    else:
        origin = f"{used.name} fits" if given else "Drafted; give --binding to check your own"
        findings.append(Finding("binding", "ok", f"{origin}."))
        findings += flights.checks(cycles, progress or SilentProgress())
    return FmuCheck(description.path, tuple(findings))
