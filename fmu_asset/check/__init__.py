"""Checks of an FMU beyond what flying it shows: rules of the standard, rules of ours, its behaviour."""

import os
from dataclasses import dataclass
from pathlib import Path

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.door.experiment import whole_binding
from fmu_asset.errors import BindingError, FmuError, visible
from reporting.progress import Progress, SilentProgress

from .file import check_file
from .flight import Flights, Verdict


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes
    ----------
    check : str
        What was checked, in a few words.
    verdict : {"ok", "warning", "problem", "skipped"}
        A warning is allowed but makes an FMU harder to use.
    text : str
        What was found, one sentence.
    """

    check: str
    verdict: Verdict
    text: str

    def __post_init__(self) -> None:
        """Make control characters, which names of an FMU may hold, visible."""
        object.__setattr__(self, "text", visible(self.text))


@dataclass(frozen=True)
class FmuCheck:
    """All checks of one FMU.

    Attributes
    ----------
    path : Path
        The FMU.
    findings : tuple of Finding
        In the order in which they were made.
    """

    path: Path
    findings: tuple[Finding, ...]

    def _texts(self, verdict: Verdict) -> tuple[str, ...]:
        return tuple(finding.text for finding in self.findings if finding.verdict == verdict)

    @property
    def problems(self) -> tuple[str, ...]:
        """One sentence each; empty if nothing is wrong."""
        return self._texts("problem")

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is allowed but makes the FMU harder to use."""
        return self._texts("warning")

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems


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
    found = list(check_file(description))
    try:
        used = given or whole_binding(description, step_size=step_size)
        flights = Flights(description, used, step_timeout, memory_limit)
    except FmuError as error:
        if isinstance(error, BindingError) and given is None:
            error = BindingError(f"No binding can be drafted for it: {error.sentence}")
        found.append(("binding", "problem", error.sentence))
    else:
        origin = f"{used.name} fits" if given else "Drafted; give --binding to check your own"
        found.append(("binding", "ok", f"{origin}."))
        found += flights.checks(cycles, progress or SilentProgress())
    return FmuCheck(description.path, tuple(Finding(*told) for told in found))
