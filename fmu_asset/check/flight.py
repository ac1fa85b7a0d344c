"""What an FMU does when it is flown: the same twice, finite, resumable, at other steps, again and again."""

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.door.binding import INPUT_ROLES, Binding, Input
from fmu_asset.door.layout import Place, find
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuError
from reporting.progress import Progress

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
Series = npt.NDArray[np.float64]


class Flights:
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
            for name in [*others, "instances"]:
                yield name, "skipped", "It does not fly."
            return
        step = self._binding.step_size
        yield "first flight", "ok", f"{_STEPS} steps of {step:g} s, {self._series.shape[1]} finite outputs."
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
        changed = self._binding.binding.model_copy(update=header)
        return self._open(self._binding.model_copy(update={"binding": changed}))

    def _base_inputs(self) -> Inputs:
        """Return zeros for arrays whose start values a new size took; all else begins at its own."""
        base: Inputs = {role: {} for role in INPUT_ROLES}
        for role in INPUT_ROLES if self._binding.binding.structural_parameters else ():
            for name, item in self._binding.inputs(role).items():
                place = self._place(role, name, item)
                if len((place.variable.start or "0").split()) not in (1, place.variable.size):
                    base[role][name] = [0.0] * len(place.elements)
        return base

    def _place(self, role: str, name: str, item: Input) -> Place:
        return find(self._description, item.variable, f"{role}.{name}", "input")

    def _fly(self, asset: FmiAsset | None = None) -> Series:
        """Return the outputs (N, n) of a flight at the start values, from the start."""
        if asset is None:
            with closing(self._asset()) as own:
                return self._fly(own)
        asset.reset(**self._base)
        return _outputs(asset, _STEPS)

    # ------------------------------------------------------------------ the checks

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
                hint = (
                    "it declares canGetAndSetFMUstate but keeps part of its state elsewhere; write "
                    '`state = "replay"` into the table [binding] of its binding'
                )
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


def _outputs(asset: FmiAsset, steps: int) -> Series:
    """Return the outputs (N, n) of steps with the inputs as they are."""
    seen = (asset.step() for _ in range(steps))
    return np.array([[*one.values.tolist(), *one.extra.values()] for one in seen])


def _difference(one: Series, two: Series) -> str:
    # By their bits: 0.0 and -0.0 are equal numbers.
    at = np.flatnonzero(one.ravel().view(np.uint64) != two.ravel().view(np.uint64))
    return f"first {one.flat[at[0]]!r}, then {two.flat[at[0]]!r}".replace("np.float64", "")


def _sentence(error: FmuError) -> str:
    """Return the error in one line."""
    more = f" The FMU says: {error.messages[-1]}" if error.messages else ""
    return " ".join(f"{error.sentence}{more}".split())
