"""Checks of an FMU beyond what flying it shows: rules of the standard, rules of ours, its behaviour."""

import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.door.experiment import whole_binding
from fmu_asset.door.units import contradictions
from fmu_asset.errors import BindingError, FmuError, visible
from fmu_asset.packing.structure_fmu import recorded_content_hash
from reporting.progress import Progress, reporter
from reporting.units import meaning_of

from .flight import Flights, Told, Verdict


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

    @property
    def problems(self) -> tuple[str, ...]:
        """One sentence each; empty if nothing is wrong."""
        return tuple(finding.text for finding in self.findings if finding.verdict == "problem")

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
        undrafted = isinstance(error, BindingError) and given is None
        why = "No binding can be drafted for it: " if undrafted else ""
        found.append(("binding", "problem", f"{why}{error.sentence}"))
    else:
        origin = f"{used.name} fits" if given else "Drafted; give --binding to check your own"
        found.append(("binding", "ok", f"{origin}."))
        found += flights.checks(cycles, reporter(progress))
    # Names of an FMU may hold control characters.
    findings = tuple(Finding(check, verdict, visible(text)) for check, verdict, text in found)
    return FmuCheck(description.path, findings)


def check_file(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    """Yield what the file of an FMU tells without running it: name of the check, verdict, sentence."""
    checks = {
        "archive": _archive, "fmpy validate": _schema, "content": _content, "units": _units, "ranges": _ranges
    }  # fmt: skip
    for name, check in checks.items():
        for told in check(description):
            yield name, *told


def _archive(description: FmuDescription) -> list[Told]:
    kinds, platforms = " and ".join(description.interfaces), ", ".join(description.platforms)
    count = len(description.variables)
    text = f"FMI {description.fmi_version}, {kinds}, {count} variables, binaries for {platforms}."
    return [("ok", text)]


def _schema(description: FmuDescription) -> list[Told]:
    # It needs a grammar parser and an XML schema; those who only fly an FMU shall not pay for it.
    from fmpy.validation import validate_fmu

    problems = [" ".join(str(problem).split()) for problem in validate_fmu(str(description.path))]
    fine: Told = "ok", "The model description keeps the schema and the standard's rules."
    return [("problem", problem) for problem in problems] or [fine]


def _content(description: FmuDescription) -> list[Told]:
    """Compare the GUID of a wing or structure FMU of ours with its content."""
    with zipfile.ZipFile(description.path) as archive:
        names = set(archive.namelist())
    python = {"resources/start.json", "resources/reduced_model.npz"}
    compiled = {"resources/reduced_model.bin", "sources/structure_variables.h"}
    if not (python <= names or compiled <= names):
        return []
    changed = "the file was changed after its build."
    try:
        declared, actual = recorded_content_hash(description.path)
    except (KeyError, IndexError, UnicodeDecodeError):
        return [("problem", f"Its parts are not those of an FMU as we build it: {changed}")]
    if declared == actual:
        return [("ok", "The GUID is the hash of the content.")]
    return [("problem", f"The GUID {declared} does not fit the content ({actual}): {changed}")]


def _units(description: FmuDescription) -> list[Told]:
    reals = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality != "independent"]
    found = contradictions(description.units)
    if bare := [v.name for v in reals if v.unit is None]:
        found.append(f"{len(bare)} real variables have no unit: {', '.join(bare[:5])}.")
    defined = {unit.name for unit in description.units if unit.exponents is not None}
    if unknown := {v.unit for v in reals if v.unit and v.unit not in defined and meaning_of(v.unit) is None}:
        listed = ", ".join(sorted(unknown)[:5])
        found.append(f"Nothing can be converted to {listed}: the FMU does not define it in SI.")
    fine: Told = "ok", "All real variables have units, and these mean what is usual."
    return [("warning", sentence) for sentence in found] or [fine]


def _ranges(description: FmuDescription) -> list[Told]:
    inputs = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality == "input"]
    found: list[Told] = []
    ends = ((v.name, v.minimum, v.maximum) for v in description.variables)
    if empty := [name for name, low, high in ends if low is not None and high is not None and low > high]:
        found.append(("problem", f"The range of {', '.join(empty[:5])} is empty."))
    if unlimited := [v.name for v in inputs if v.minimum is None or v.maximum is None]:
        found.append(("warning", f"{len(unlimited)} inputs have no range: {', '.join(unlimited[:5])}."))
    if inputs and not found:
        found.append(("ok", "All real inputs have ranges."))
    return found
