"""The check of an FMU: rules of the FMI standard and of this package, and its behaviour."""

import os
from dataclasses import dataclass
from pathlib import Path

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.binding_remarks import unset_inputs_sentence
from fmu_asset.client.experiment import whole_binding
from fmu_asset.errors import BindingError, FmuError, visible
from reporting.progress import Progress, reporter

from .file_checks import check_file
from .finding import Finding
from .run_checks import RUN_STEPS, RunChecks


@dataclass(frozen=True)
class FmuCheck:
    """All checks of one FMU.

    Attributes
    ----------
    findings : tuple of Finding
        In the order in which they were made.
    """

    path: Path
    findings: tuple[Finding, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """The messages of the findings that are problems; empty if there are none."""
        return tuple(finding.text for finding in self.findings if finding.verdict == "problem")

    @property
    def passed(self) -> bool:
        """Whether there is no problem; warnings are allowed."""
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
    """Check an FMU: its file, `fmpy validate`, its units, and its behaviour in workers.

    Parameters
    ----------
    binding : Binding or path-like, optional
        The binding with which the FMU is run; by default it is drafted from the model description.
    cycles : int
        Number of instances that are made and freed one after the other in one process; 0 skips this
        check.
    step_size : float, optional
        Communication step size of a drafted binding [s].
    step_timeout, memory_limit : float, optional
        Limits of the workers, as in `FmiAsset`.

    Returns
    -------
    FmuCheck
        A binding that does not fit the FMU is a finding, not an error.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the file is missing, damaged or not an FMU that can run here.
    BindingError
        If the binding file cannot be read.
    """
    if binding is not None and not isinstance(binding, Binding):
        binding = load_binding(binding)
    description = read_fmu(path, None if binding is None else binding.binding.interface)
    findings = list(check_file(description))
    try:
        used_binding = binding or drafted_binding(description, step_size)
        runs = RunChecks(description, used_binding, step_timeout, memory_limit)
    except FmuError as error:
        text = error.sentence
        if binding is None and isinstance(error, BindingError):
            text = f"No binding can be drafted for it: {text}"
        findings.append(Finding("binding", "problem", text))
    else:
        text = "Drafted; give --binding to check your own."
        if binding is not None:
            text = f"{binding.name} fits."
        findings.append(Finding("binding", "ok", text))
        unset = "" if binding is None else unset_inputs_sentence(description, binding)
        if unset:
            findings.append(Finding("inputs", "warning", unset))
        findings += runs.findings(cycles, reporter(progress))
    # Names in an FMU may contain control characters, which a terminal would obey.
    printable = tuple(
        Finding(entry.check, entry.verdict, visible(entry.text)) for entry in findings
    )
    return FmuCheck(description.path, printable)


def drafted_binding(description: FmuDescription, step_size: float | None) -> Binding:
    """Return a binding for the checks of an FMU, drafted from its model description.

    It has all inputs and outputs, and the stop time of the default experiment, unless the checks
    would step beyond that.

    Parameters
    ----------
    step_size : float or None
        Communication step size [s]; the FMU's own if None.

    Raises
    ------
    BindingError
        If the FMU has no numeric output to observe, or the step size is not positive.
    """
    binding = whole_binding(description, step_size=step_size)
    stop_time = description.stop_time
    end_of_checks = binding.binding.start_time + RUN_STEPS * binding.interval
    if stop_time is None or stop_time < end_of_checks:
        return binding
    return binding.with_header(stop_time=stop_time)
