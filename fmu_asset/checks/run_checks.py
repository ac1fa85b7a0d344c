"""Checks that run an FMU: repetition, resuming, step size, limits of inputs, reset, memory."""

from collections.abc import Callable, Iterator
from contextlib import closing, suppress

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.client.binding import INPUT_ROLES, Binding
from fmu_asset.client.bound_fmu import BoundFmu, VariableElements
from fmu_asset.client.bound_variables import InputBinding
from fmu_asset.client.saved_state import partial_state_sentence
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.values import Value
from fmu_asset.errors import FmuCallError, FmuError
from fmu_asset.worker.refusals import watch_for_refusals
from fmu_asset.worker.sandbox import landlock_version
from reporting.arrays import Float
from reporting.progress import Progress

from .finding import CheckResult, Finding, one_line

RUN_STEPS = 6
"""Number of communication steps of a run."""
_STEPS_BEFORE_SAVING = 2
"""Number of steps after which the state is saved."""
_EQUAL = 1e-9
"""Largest change of the outputs with half the step that counts as none, as a fraction of the
largest output."""
_CLOSE = 0.02
"""Change with half the step, as a fraction of the largest output, above which a smaller step is
advised."""
_FAR = 0.5
"""Change with half the step, as a fraction of the largest output, above which the FMU probably
counts steps instead of time."""
_LARGEST_TRIED_LIMIT = 1e9
"""Magnitude of a range's limit from which it is taken as unlimited, and not tried."""
_KIBIBYTE = 1024
_SMALL_GROWTH = 1.0
"""Largest growth of memory for each instance that is not a leak [KiB]; allocators keep some
memory.
"""
_LARGE_GROWTH = 16.0
"""Growth of memory for each instance above which the leak is a problem [KiB]."""
_MEMORY_NOISE = 1024 * _KIBIBYTE
"""Total growth of memory below which no leak is reported [bytes]."""

RunInputs = dict[str, dict[str, Value]]
"""Inputs by role and name."""


class RunChecks:
    """Checks that run an FMU with a binding, each in a new worker.

    Parameters
    ----------
    step_timeout, memory_limit : float or None
        Limits of the workers, as in `FmiAsset`.

    Raises
    ------
    FmuError
        If the binding does not fit the FMU.
    """

    def __init__(
        self,
        description: FmuDescription,
        binding: Binding,
        step_timeout: float | None,
        memory_limit: float | None,
    ) -> None:
        self._path = description.path
        self._binding = binding
        self._step_timeout = step_timeout
        self._memory_limit = memory_limit
        # An asset checks the binding against the FMU when it is made, before a worker is started.
        self._description = self._asset(binding).description
        self._base_inputs = self._inputs_without_start_values()

    def findings(self, cycles: int, progress: Progress) -> Iterator[Finding]:
        """Run the FMU once, then make all checks, and yield a finding for each.

        If the first run fails, the other checks are skipped.

        Parameters
        ----------
        cycles : int
            Number of instances that are made one after the other; 0 skips that check.
        """
        checks: dict[str, Callable[[], CheckResult]] = {
            "determinism": self._check_determinism,
            "state": self._check_state,
            "step size": self._check_step_size,
            "range edges": self._check_range_edges,
            "reset": self._check_reset,
        }
        try:
            self._first_outputs = self._run()
        except FmuError as error:
            yield Finding("first run", "problem", one_line(error))
            yield self._check_sandbox().named("sandbox")
            for name in [*checks, "instances"]:
                yield Finding(name, "skipped", "The first run failed.")
            return
        count = self._first_outputs.shape[1]
        text = f"{RUN_STEPS} steps of {self._binding.interval:g} s, {count} finite outputs."
        yield Finding("first run", "ok", text)
        yield self._check_sandbox().named("sandbox")
        for name, check in checks.items():
            with progress.stage(f"Checking {name}"):
                try:
                    yield check().named(name)
                except FmuError as error:
                    yield Finding(name, "problem", one_line(error))
        if cycles:
            yield self._check_instances(cycles, progress).named("instances")

    # ------------------------------------------------------------------ runs

    def _asset(self, binding: Binding | None = None) -> FmiAsset:
        """Return a new asset of the FMU, by default with the binding of the checks."""
        return FmiAsset(
            self._path,
            self._binding if binding is None else binding,
            step_timeout=self._step_timeout,
            memory_limit=self._memory_limit,
        )

    def _inputs_without_start_values(self) -> RunInputs:
        """Return zeros, by role, for input arrays whose start values do not fit their length.

        Structural parameters in the binding change the length of an array, but not the number of
        its declared start values.
        """
        zeros: RunInputs = {role: {} for role in INPUT_ROLES}
        # Without structural parameters all start values fit.
        if not self._binding.binding.structural_parameters:
            return zeros
        for role in INPUT_ROLES:
            for name, input_binding in self._binding.inputs(role).items():
                selection = self._find_input(role, name, input_binding)
                # One start value holds for all elements.
                start_count = len((selection.variable.start or "0").split())
                if start_count not in (1, selection.variable.size):
                    zeros[role][name] = [0.0] * len(selection.elements)
        return zeros

    def _find_input(self, role: str, name: str, input_binding: InputBinding) -> VariableElements:
        """Return the FMU's variable that an input of the binding names."""
        fmu = BoundFmu(self._description, self._binding)
        variable = input_binding.variable
        is_start_health = role == "health" and fmu.is_set_at_start(variable)
        return fmu.find(variable, f"{role}.{name}", "parameter" if is_start_health else "input")

    def _run(self) -> Float:
        """Return the outputs (N, n) of N steps in a new worker."""
        with closing(self._asset()) as asset:
            return self._run_from_start(asset)

    def _run_from_start(self, asset: FmiAsset) -> Float:
        """Reset an asset, and return its outputs (N, n) in N steps."""
        asset.reset(**self._base_inputs)
        return _outputs_of_steps(asset, RUN_STEPS)

    # ------------------------------------------------------------------ checks

    def _check_sandbox(self) -> CheckResult:
        """Run once more, and report the system calls that the sandbox refuses.

        If the run fails, this covers the calls before the failure.
        """
        if not (self._binding.limits.sandbox and landlock_version()):
            text = "There is no sandbox: the binding turns it off, or the kernel has none."
            return CheckResult("skipped", text)
        with watch_for_refusals() as report:
            with suppress(FmuError):
                self._run()
            return CheckResult(report.verdict(), report.sentence())

    def _check_determinism(self) -> CheckResult:
        """Check that runs in two processes give bitwise equal outputs."""
        outputs = self._run()
        if outputs.tobytes() == self._first_outputs.tobytes():
            return CheckResult("ok", "Two runs in two processes are equal to the bit.")
        difference = _first_difference(self._first_outputs, outputs)
        text = (
            f"Two runs with the same inputs differ ({difference}): its runs are not reproducible, "
            "and a state cannot be replayed."
        )
        return CheckResult("problem", text)

    def _check_state(self) -> CheckResult:
        """Check that a run equals one that resumes from a saved state in a new process."""
        steps_after = RUN_STEPS - _STEPS_BEFORE_SAVING
        with closing(self._asset()) as asset:
            asset.reset(**self._base_inputs)
            _outputs_of_steps(asset, _STEPS_BEFORE_SAVING)
            state = asset.save_state()
            method = asset.state_method
            expected_outputs = _outputs_of_steps(asset, steps_after)
        with closing(self._asset()) as resumed_asset:
            resumed_asset.restore_state(state)
            resumed_outputs = _outputs_of_steps(resumed_asset, steps_after)
        if resumed_outputs.tobytes() != expected_outputs.tobytes():
            cause = "its outputs are not a function of its inputs"
            if method == "serialised":
                cause = partial_state_sentence("keeps part of its state elsewhere")
            text = (
                "A run that resumes from a saved state in a new process differs from the one "
                "that was not interrupted "
                f"({_first_difference(expected_outputs, resumed_outputs)}): {cause}."
            )
            return CheckResult("problem", text)
        if method == "serialised":
            text = f"Saved ({len(state)} bytes), restored in a new process, equal to the bit."
            return CheckResult("ok", text)
        text = (
            "Its state cannot be serialised; a mission is resumed by replaying the inputs, which "
            "is equal to the bit here."
        )
        return CheckResult("warning", text)

    def _check_step_size(self) -> CheckResult:
        """Check how much the outputs at the same times change with half the step size."""
        header = self._binding.binding
        half_step = header.step_size / 2.0
        # The decimation is the number of steps between two outputs: doubled, it keeps their times.
        binding = self._binding.with_header(step_size=half_step, decimation=2 * header.decimation)
        with closing(self._asset(binding)) as asset:
            try:
                outputs = self._run_from_start(asset)
            except FmuCallError as error:
                return self._refused_step(half_step, error)
        # The change as a fraction of the largest output; 1e-300 avoids a division by zero.
        largest_output = max(float(np.abs(self._first_outputs).max(initial=0.0)), 1e-300)
        change = float(np.abs(outputs - self._first_outputs).max(initial=0.0)) / largest_output
        if change <= _EQUAL:
            return CheckResult("ok", "Half the step size gives the same outputs.")
        advice = ""
        if change > _FAR:
            advice = "; it counts steps rather than time, or the step is far too large"
        elif change > _CLOSE:
            advice = "; choose a smaller one"
        text = (
            f"Half the step size changes the outputs by {100.0 * change:.2g} % of the "
            f"largest{advice}."
        )
        return CheckResult("warning" if advice else "ok", text)

    def _refused_step(self, step: float, error: FmuCallError) -> CheckResult:
        """Return the result for an FMU that refuses half the step size [s]."""
        if self._description.can_vary_step:
            text = f"It declares that it takes any step size, but not {step:g} s: {one_line(error)}"
            return CheckResult("problem", text)
        text = (
            f"It accepts only the step size {self._binding.binding.step_size:g} s; `decimation` "
            "observes every n-th step."
        )
        return CheckResult("warning", text)

    def _check_range_edges(self) -> CheckResult:
        """Make one step at each limit of each scalar input's range, and report failures."""
        limit_count = 0
        failures = []
        with closing(self._asset()) as asset:
            for role in INPUT_ROLES:
                for name, input_binding in self._binding.inputs(role).items():
                    if len(self._find_input(role, name, input_binding).elements) != 1:
                        continue
                    for value in asset.input_range(role, name):
                        if abs(value) >= _LARGEST_TRIED_LIMIT:
                            continue
                        limit_count += 1
                        try:
                            self._step_with(asset, role, name, value)
                        except FmuError as error:
                            # the unit of a plain number, "1", is not printed
                            unit = "" if input_binding.unit == "1" else f" {input_binding.unit}"
                            limit = f"{input_binding.variable} = {value:g}{unit}"
                            failures.append(f"{limit}: {one_line(error)}")
        if failures:
            text = (
                f"{len(failures)} of {limit_count} limits of input ranges make it fail, such as "
                f"{failures[0]}"
            )
            return CheckResult("warning", text)
        if limit_count:
            return CheckResult("ok", f"{limit_count} limits of input ranges give finite outputs.")
        return CheckResult("skipped", "No input has a range.")

    def _step_with(self, asset: FmiAsset, role: str, name: str, value: float) -> None:
        """Reset an asset, and make one step with another value of one input."""
        inputs = self._base_inputs | {role: self._base_inputs[role] | {name: value}}
        asset.reset(**self._base_inputs)
        asset.step(**inputs)

    def _check_reset(self) -> CheckResult:
        """Check that the FMU can be reset: that two runs, each after a reset, are equal."""
        with closing(self._asset()) as asset:
            outputs = self._run_from_start(asset)
            outputs_again = self._run_from_start(asset)
            trial = asset.reset_trial
        if not np.array_equal(outputs, outputs_again):
            difference = _first_difference(outputs, outputs_again)
            return CheckResult(
                "problem",
                "After it was ended and started again, its outputs are not those of a new "
                f"instance ({difference}).",
            )
        if trial.works is False:
            return CheckResult("problem" if trial.reports_false_success else "warning", trial.fault)
        return CheckResult("ok", "After a reset its outputs are those of a new instance.")

    def _check_instances(self, cycles: int, progress: Progress) -> CheckResult:
        """Make, step and free instances in one process, and check the growth of its memory."""
        half_of_cycles = cycles // 2
        number = 0
        memory_half_way = 0
        try:
            asset = self._asset()
            stage_of_progress = progress.stage("Making instances", cycles, "instances")
            with closing(asset), stage_of_progress as stage:
                asset.reset(**self._base_inputs)
                for number in range(cycles):
                    if number == half_of_cycles:
                        memory_half_way = asset.worker_memory or 0
                    asset.renew(**self._base_inputs)
                    asset.step()
                    stage.advance()
                memory_at_end = asset.worker_memory or 0
        except FmuError as error:
            text = f"Instance {number + 1} of {cycles} in one process: {one_line(error)}"
            return CheckResult("problem", text)
        # Only the growth in the second half counts: in the first, the FMU may fill caches.
        growth = memory_at_end - memory_half_way
        growth_of_each = growth / _KIBIBYTE / max(cycles - half_of_cycles, 1)
        text = (
            f"{cycles} made and freed in one process; it grows by {max(growth_of_each, 0.0):.2g} "
            "KiB with each"
        )
        if growth < _MEMORY_NOISE or growth_of_each <= _SMALL_GROWTH:
            return CheckResult("ok", f"{text}.")
        if growth_of_each > _LARGE_GROWTH:
            return CheckResult("problem", f"{text}: it leaks.")
        return CheckResult("warning", f"{text}: it leaks a little.")


def _outputs_of_steps(asset: FmiAsset, steps: int) -> Float:
    """Make N further steps with unchanged inputs, and return the outputs (N, n)."""
    rows = []
    for _ in range(steps):
        observation = asset.step()
        rows.append([*observation.values.tolist(), *observation.extra.values()])
    return np.array(rows)


def _first_difference(first_run: Float, second_run: Float) -> str:
    """Return the first values that differ between two arrays of equal shape, for a message."""
    # Compare bits, since 0.0 and -0.0 are equal numbers.
    differs = first_run.ravel().view(np.uint64) != second_run.ravel().view(np.uint64)
    position = np.flatnonzero(differs)[0]
    return (
        f"first ({float(first_run.flat[position])!r}), then ({float(second_run.flat[position])!r})"
    )
