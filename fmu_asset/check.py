"""Checks of an FMU beyond what flying it shows: rules of the standard, rules of ours, its behaviour.

When it is flown: the same twice, finite, resumable, at other steps, again and again.
"""

import os
import zipfile
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import INPUT_ROLES, Binding, load_binding
from fmu_asset.client.bound_variables import InputBinding
from fmu_asset.client.experiment import whole_binding
from fmu_asset.client.layout import VariableElements, find_variable
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.units import contradictions
from fmu_asset.errors import BindingError, FmuCallError, FmuError, said, visible
from fmu_asset.packing.structure_fmu import recorded_content_hash
from fmu_asset.worker.refusals import watch_for_refusals
from fmu_asset.worker.sandbox import landlock_version
from reporting.arrays import Float
from reporting.progress import Progress, reporter
from reporting.units import meaning_of

_STEPS = 6
_SAME = 1e-9
_CLOSE = 0.02
_MUCH = 0.5
_KIBIBYTE = 1024
# What a long-lived process may grow by without being suspected: allocators keep some memory.
_SMALL_GROWTH, _LARGE_GROWTH = 1.0, 16.0
_NOISE = 1024 * _KIBIBYTE

Verdict = Literal["ok", "warning", "problem", "skipped"]
Told = tuple[Verdict, str]
"""What a check says: a verdict, and one sentence."""
Inputs = dict[str, dict[str, Any]]


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
        used = given or drafted_binding(description, step_size)
        flights = CheckRuns(description, used, step_timeout, memory_limit)
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


def drafted_binding(description: FmuDescription, step_size: float | None) -> Binding:
    """Return a binding of the whole FMU, which ends where the FMU says, unless the checks fly further."""
    binding = whole_binding(description, step_size=step_size)
    checked_end = binding.binding.start_time + _STEPS * binding.interval
    end = description.stop_time
    return binding if end is None or end < checked_end else binding.with_header(stop_time=end)


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


class CheckRuns:
    """Flights of one FMU with one binding, each in a worker of its own.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    binding : Binding
        The binding.
    step_timeout, memory_limit : float or None
        As in `FmiAsset`.
    """

    def __init__(
        self,
        description: FmuDescription,
        binding: Binding,
        step_timeout: float | None,
        memory_limit: float | None,
    ) -> None:
        self._binding = binding
        self._open = partial(FmiAsset, description.path, step_timeout=step_timeout, memory_limit=memory_limit)
        # Whether it fits is found here, before anything is started.
        self._description = self._asset().description
        self._base = self._base_inputs()

    def checks(self, cycles: int, progress: Progress) -> Iterator[tuple[str, *Told]]:
        """Yield all findings, each with the name of its check; without a first flight the others are skipped.

        Parameters
        ----------
        cycles : int
            How many instances are made one after the other; 0 skips that.
        progress : Progress
            Shows the cycles.
        """
        others = {
            "determinism": self._determinism,
            "state": self._state,
            "step size": self._step_size,
            "range edges": self._edges,
            "reset": self._reset,
        }
        try:
            self._series = self._fly()
        except FmuError as error:
            yield "first flight", "problem", _sentence(error)
            yield "sandbox", *self._sandbox()
            for name in [*others, "instances"]:
                yield name, "skipped", "It does not fly."
            return
        step = self._binding.interval
        yield "first flight", "ok", f"{_STEPS} steps of {step:g} s, {self._series.shape[1]} finite outputs."
        yield "sandbox", *self._sandbox()
        for name, check in others.items():
            with progress.stage(f"Checking {name}"):
                try:
                    yield name, *check()
                except FmuError as error:
                    yield name, "problem", _sentence(error)
        if cycles:
            yield "instances", *self._instances(cycles, progress)

    # ------------------------------------------------------------------ flying

    def _asset(self, **header: Any) -> FmiAsset:
        return self._open(self._binding.with_header(**header))

    def _base_inputs(self) -> Inputs:
        """Return zeros for arrays whose start values a new size took; all else begins at its own."""
        base: Inputs = {role: {} for role in INPUT_ROLES}
        for role in INPUT_ROLES if self._binding.binding.structural_parameters else ():
            for name, item in self._binding.inputs(role).items():
                place = self._place(role, name, item)
                if len((place.variable.start or "0").split()) not in (1, place.variable.size):
                    base[role][name] = [0.0] * len(place.elements)
        return base

    def _place(self, role: str, name: str, item: InputBinding) -> VariableElements:
        return find_variable(self._description, item.variable, f"{role}.{name}", "input")

    def _fly(self, asset: FmiAsset | None = None) -> Float:
        """Return the outputs (N, n) of a flight at the start values, from the start."""
        if asset is None:
            with closing(self._asset()) as own:
                return self._fly(own)
        asset.reset(**self._base)
        return _outputs(asset, _STEPS)

    # ------------------------------------------------------------------ the checks

    def _sandbox(self) -> Told:
        """Fly once more, and count what the sandbox refuses until the flight ends or fails."""
        if not (self._binding.limits.sandbox and landlock_version()):
            return "skipped", "There is no sandbox: the binding turns it off, or the kernel has none."
        with watch_for_refusals() as report:
            with suppress(FmuError):
                self._fly()
            return report.verdict(), report.sentence()

    def _determinism(self) -> Told:
        again = self._fly()
        if again.tobytes() == self._series.tobytes():
            return "ok", "Two flights in two processes are equal to the bit."
        return "problem", (
            f"Two flights with the same inputs differ ({_difference(self._series, again)}): runs of it "
            "are not reproducible, and a state cannot be replayed."
        )

    def _state(self) -> Told:
        with closing(self._asset()) as asset:
            asset.reset(**self._base)
            _outputs(asset, 2)
            saved, method = asset.save_state(), asset.state_method
            expected = _outputs(asset, _STEPS - 2)
        with closing(self._asset()) as other:
            other.restore_state(saved)
            found = _outputs(other, _STEPS - 2)
        if found.tobytes() != expected.tobytes():
            hint = "its outputs are not a function of its inputs"
            if method == "serialised":
                hint = said("state.partly", does="keeps part of its state elsewhere")
            return "problem", (
                "A flight that goes on from a saved state in a new process differs from the one that was "
                f"not interrupted ({_difference(expected, found)}): {hint}."
            )
        if method == "serialised":
            return "ok", f"Saved ({len(saved)} bytes), restored in a new process, equal to the bit."
        return "warning", (
            "Its state cannot be serialised; a mission is resumed by replaying the inputs, which is equal to "
            "the bit here."
        )

    def _step_size(self) -> Told:
        header = self._binding.binding
        half = header.step_size / 2.0
        with closing(self._asset(step_size=half, decimation=2 * header.decimation)) as asset:
            try:
                halved = self._fly(asset)
            except FmuCallError as error:
                if self._description.can_vary_step:
                    text = f"It declares that it takes any step size, but not {half:g} s: {_sentence(error)}"
                    return "problem", text
                text = f"It takes {header.step_size:g} s only; `decimation` observes every n-th step."
                return "warning", text
        scale = max(float(np.abs(self._series).max(initial=0.0)), 1e-300)
        error_size = float(np.abs(halved - self._series).max(initial=0.0)) / scale
        if error_size <= _SAME:
            return "ok", "Half the step size gives the same outputs."
        advice = "" if error_size <= _CLOSE else "; choose a smaller one"
        if error_size > _MUCH:
            advice = "; it counts steps rather than time, or the step is far too large"
        text = f"Half the step size changes the outputs by {100.0 * error_size:.2g} % of the largest{advice}."
        return "warning" if advice else "ok", text

    def _edges(self) -> Told:
        """Fly one step at the ends of each range."""
        tried, refused = 0, []
        with closing(self._asset()) as asset:
            for role in INPUT_ROLES:
                for name, item in self._binding.inputs(role).items():
                    single = len(self._place(role, name, item).elements) == 1
                    ends = asset.input_range(role, name) if single else ()
                    for value in (end for end in ends if abs(end) < 1e9):
                        tried += 1
                        inputs = self._base | {role: self._base[role] | {name: value}}
                        try:
                            asset.reset(**self._base)
                            asset.step(**inputs)
                        except FmuError as error:
                            refused.append(f"{item.variable} = {value:g} {item.unit}: {_sentence(error)}")
        if refused:
            return "warning", f"{len(refused)} of {tried} ends of ranges fail, such as {refused[0]}"
        if tried:
            return "ok", f"{tried} ends of ranges give finite outputs."
        return "skipped", "No input has a range."

    def _reset(self) -> Told:
        with closing(self._asset()) as asset:
            first, second = self._fly(asset), self._fly(asset)
            trial = asset.reset_trial
        if not np.array_equal(first, second):
            return "problem", f"Started again it is not as new ({_difference(first, second)})."
        if trial.works is False:
            return "problem" if trial.lies else "warning", trial.fault
        return "ok", "After a reset it is as new."

    def _instances(self, cycles: int, progress: Progress) -> Told:
        """Make, step and free instances in one process, and look at its memory."""
        done = half = 0
        try:
            asset = self._asset()
            with closing(asset), progress.stage("Making instances", cycles, "instances") as stage:
                asset.reset(**self._base)
                for done in range(cycles):
                    if done == cycles // 2:
                        half = asset.worker_memory or 0
                    asset.renew(**self._base)
                    asset.step()
                    stage.advance()
                end = asset.worker_memory or 0
        except FmuError as error:
            return "problem", f"Instance {done + 1} of {cycles} in one process: {_sentence(error)}"
        growth = (end - half) / _KIBIBYTE / max(cycles - cycles // 2, 1)
        text = f"{cycles} made and freed in one process; it grows by {max(growth, 0.0):.2g} KiB with each"
        if end - half < _NOISE or growth <= _SMALL_GROWTH:
            return "ok", f"{text}."
        if growth > _LARGE_GROWTH:
            return "problem", f"{text}: it leaks."
        return "warning", f"{text}: it leaks a little."


def _outputs(asset: FmiAsset, steps: int) -> Float:
    """Return the outputs (N, n) of steps with the inputs as they are."""
    seen = (asset.step() for _ in range(steps))
    return np.array([[*one.values.tolist(), *one.extra.values()] for one in seen])


def _difference(one: Float, two: Float) -> str:
    # By their bits: 0.0 and -0.0 are equal numbers.
    at = np.flatnonzero(one.ravel().view(np.uint64) != two.ravel().view(np.uint64))
    return f"first {one.flat[at[0]]!r}, then {two.flat[at[0]]!r}".replace("np.float64", "")


def _sentence(error: FmuError) -> str:
    """Return the error in one line."""
    more = f" The FMU says: {error.messages[-1]}" if error.messages else ""
    return " ".join(f"{error.sentence}{more}".split())
