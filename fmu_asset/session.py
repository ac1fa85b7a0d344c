"""`FmiAsset`: the only door to an FMU. It knows FMI and roles, not wings."""

from __future__ import annotations

import math
import os
import shutil
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NoReturn, Self

import numpy as np
import numpy.typing as npt

from .archive import FmuDescription, describe_fmu, extract_fmu, read_fmu
from .binding import INPUT_ROLES, Binding, load_binding
from .errors import (
    FmuCallError,
    FmuError,
    FmuInputError,
    FmuOutputError,
    FmuStateError,
    FmuWorkerError,
)
from .exchange import Exchange
from .instance import STATUS_NAMES, FmuInstance, forget_modules
from .saved_state import SavedState, StateMethod
from .worker import WorkerInstance

_LOG_LENGTH = 200


@dataclass(frozen=True, slots=True)
class Observation:
    """What came out of one communication step.

    Attributes
    ----------
    values : (n_obs,) ndarray
        The observations of the binding in their order and units.
    time : float
        Time at the end of the step [s]: start + i * step size.
    extra : dict of str to float
        The monitors of the binding.
    """

    values: npt.NDArray[np.float64]
    time: float
    extra: dict[str, float] = field(default_factory=dict)


class FmiAsset:
    """An FMU that is flown step by step through a binding.

    The FMU runs in a worker process of its own unless `isolated` is False: only then are the wall-clock limit
    and protection against crashes given. The asset is opened by the first `reset`, `step` or `with`.

    Parameters
    ----------
    fmu_path : path-like
        An FMI 2.0 co-simulation FMU.
    binding : Binding or path-like
        The binding, or its file.
    isolated : bool
        Whether the FMU runs in a worker process.
    step_timeout : float
        Wall-clock limit of one step [s].
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units; they are set at every reset that gives no others.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the FMU is missing, damaged, unsafe or of another kind.
    BindingError
        If the binding does not fit the FMU: a variable is missing, of the wrong causality or in another unit.
    FmuInputError
        If a parameter lies outside its range.
    """

    def __init__(
        self,
        fmu_path: str | os.PathLike[str],
        binding: Binding | str | os.PathLike[str],
        *,
        isolated: bool = True,
        step_timeout: float = 10.0,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        self._binding = binding if isinstance(binding, Binding) else load_binding(binding)
        self._description = read_fmu(fmu_path)
        self._isolated = isolated
        if not (math.isfinite(step_timeout) and step_timeout > 0.0):
            raise FmuInputError(
                f"step_timeout must be a positive number of seconds, but is {step_timeout!r}."
            )
        self._step_timeout = step_timeout
        self._exchange = Exchange(self._description, self._binding)
        self._settings = self._exchange.settings(parameters or {})
        self._parameters = {name: float(value) for name, value in (parameters or {}).items()}
        self._instance: FmuInstance | WorkerInstance | None = None
        self._release: Callable[[], object] = lambda: None
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self._index = 0
        self._step_size = self._binding.step_size
        self._start_time = self._binding.binding.start_time
        self._recording = self.state_method == "replay"
        self._record: list[bytes] = []
        self._start_inputs = b""
        self._log: deque[tuple[str, str]] = deque(maxlen=_LOG_LENGTH)

    # ------------------------------------------------------------------ what it is

    @property
    def binding(self) -> Binding:
        """The binding."""
        return self._binding

    @property
    def description(self) -> FmuDescription:
        """What the FMU declares."""
        return self._description

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * step size, never accumulated."""
        return self._start_time + self._index * self._step_size

    @property
    def step_index(self) -> int:
        """Number of steps since the last reset."""
        return self._index

    @property
    def state_method(self) -> StateMethod:
        """How `save_state` keeps the state: serialised by the FMU, or by replaying the recorded inputs."""
        able = self._description.can_get_and_set_state and self._description.can_serialise_state
        return "serialised" if able else "replay"

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMU, oldest first: status and text."""
        self._collect_log()
        return tuple(self._log)

    @property
    def worker_process_id(self) -> int | None:
        """Process number of the worker; None without one."""
        instance = self._instance
        return instance.process_id if isinstance(instance, WorkerInstance) and not instance.lost else None

    def describe(self) -> dict[str, Any]:
        """Return what the FMU is and how it is bound, as plain records for a listing.

        Returns
        -------
        dict
            `file`, `sha256`, `size`, `guid`, ... as in `FmuDescription`, `variables` as a list of
            records with their role, and the binding's name, step size and state method.
        """
        roles = {
            scalar.variable: f"{role}.{name}"
            for role in (*INPUT_ROLES, "parameter", "monitor")
            for name, scalar in getattr(self._binding, role).items()
        }
        for name, vector in self._binding.observation.items():
            roles.update(dict.fromkeys(vector.variables, f"observation.{name}"))
        return describe_fmu(self._description, roles) | {
            "binding": self._binding.name,
            "step_size": self._binding.step_size,
            "state_method": self.state_method,
        }

    # ------------------------------------------------------------------ life

    def __enter__(self) -> Self:
        if self._phase != "ready":
            self.reset()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the worker and remove its files; the asset can be opened again by `reset`."""
        self._instance, self._phase = None, "closed"
        self._release()

    def reset(
        self,
        parameters: Mapping[str, float] | None = None,
        *,
        control: Mapping[str, float] | None = None,
        health: Mapping[str, float] | None = None,
        load: Mapping[str, float] | None = None,
    ) -> None:
        """Go back to the start.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; those of the constructor if absent. They stay for later resets.
        control, health, load : mapping of str to float, optional
            Inputs that hold already during initialisation. If none is given, the FMU's start values hold.

        Raises
        ------
        FmuInputError
            If a value is not finite or outside its range.
        BindingError
            If a name is not in the binding.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        if parameters is not None:
            self._settings = self._exchange.settings(parameters)
            self._parameters = {name: float(value) for name, value in parameters.items()}
        start = self._exchange.start_values()
        given = self._exchange.place(start, control, health, load)
        self._begin(start, with_inputs=given)

    def step(
        self,
        control: Mapping[str, float] | None = None,
        health: Mapping[str, float] | None = None,
        load: Mapping[str, float] | None = None,
    ) -> Observation:
        """Make one communication step.

        Inputs are given by the binding's names and in its units; one that is not given keeps its last value.
        If the FMU refuses the step, the asset is where it was before it.

        Parameters
        ----------
        control, health, load : mapping of str to float
            Inputs of this step.

        Returns
        -------
        Observation
            What was observed at the end of the step.

        Raises
        ------
        FmuInputError
            If a value is not finite or outside the FMU's range; nothing was sent.
        BindingError
            If a name is not in the binding.
        FmuCallError
            If the FMU refused the step (Discard) or failed.
        FmuOutputError
            If an output is not finite.
        FmuWorkerError, FmuTimeoutError
            If the worker died or took too long.
        """
        instance = self._opened()
        request = instance.request
        before = bytes(request)
        begin = self._start_time + self._index * self._step_size
        try:
            self._exchange.place(request, control, health, load)
            request[0] = begin
            request[1] = self._step_size
            instance.step()
        except FmuError as error:
            memoryview(request).cast("B")[:] = before
            self._fail(error, f"step {self._index} from t = {begin:g} s")
        self._index += 1
        if self._recording:
            self._record.append(bytes(request)[16:])
        return self._observation()

    def observe(self) -> Observation:
        """Return the observation of this moment without a step, such as the initial one."""
        instance = self._opened()
        try:
            instance.read()
        except FmuError as error:
            self._fail(error, f"reading at t = {self.time:g} s")
        return self._observation()

    # ------------------------------------------------------------------ state

    def save_state(self) -> bytes:
        """Return the state of the asset, for `restore_state` in this or another process.

        If the FMU can serialise its state, that is what is kept; if not, the inputs of all steps since the
        last reset are, and restoring replays them (see `state_method`).

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuCallError
            If the FMU fails to save.
        """
        if self._phase != "ready" or self._instance is None:
            raise FmuStateError("There is no state to save before the first reset or step.")
        if self.state_method == "serialised":
            try:
                body = self._instance.save()
            except FmuError as error:
                self._fail(error, "saving the state")
        else:
            body = b"".join(self._record)
        return SavedState(
            method=self.state_method,
            fmu=self._description.sha256,
            index=self._index,
            step_size=self._step_size,
            start_time=self._start_time,
            parameters=self._parameters,
            start_inputs=self._start_inputs,
            inputs=bytes(self._instance.request)[16:],
            body=body,
        ).to_bytes()

    def restore_state(self, content: bytes) -> None:
        """Bring the asset to a state that `save_state` returned, in this or an earlier process.

        Parameters
        ----------
        content : bytes
            The state.

        Raises
        ------
        FmuStateError
            If it is damaged, or belongs to another FMU or step size.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU fails.
        """
        saved = SavedState.from_bytes(content)
        if saved.fmu != self._description.sha256:
            raise FmuStateError(
                f"The state was saved with another FMU than {self._description.path} (its hash differs); "
                "use that one."
            )
        if (saved.step_size, saved.start_time) != (self._step_size, self._start_time):
            raise FmuStateError("The state was saved with another step size or start time; use that binding.")
        width = 8 * self._exchange.plan.input_count
        replayed = saved.method == "replay"
        if (
            saved.method != self.state_method
            or len(saved.inputs) != width
            or len(saved.start_inputs) not in (0, width)
            or (replayed and len(saved.body) != width * saved.index)
        ):
            raise FmuStateError(
                "The saved state is damaged, or another binding was in use; use that binding."
            )
        self._settings = self._exchange.settings(saved.parameters)
        self._parameters = dict(saved.parameters)
        start = self._exchange.start_values()
        if saved.start_inputs:
            start[2:] = np.frombuffer(saved.start_inputs).tolist()
        self._begin(start, with_inputs=bool(saved.start_inputs))
        instance = self._instance
        assert instance is not None
        try:
            if replayed:
                for index in range(saved.index):
                    self._replay(saved.body[index * width : (index + 1) * width])
            else:
                instance.restore(saved.body)
                self._index = saved.index
                memoryview(instance.request).cast("B")[16:] = saved.inputs
        except FmuError as error:
            self._phase = "broken"
            self._fail(error, "restoring the state")

    def _replay(self, inputs: bytes) -> None:
        instance = self._instance
        assert instance is not None
        instance.request[0], instance.request[1] = self.time, self._binding.step_size
        memoryview(instance.request).cast("B")[16:] = inputs
        instance.step()
        self._index += 1
        self._record.append(inputs)

    # ------------------------------------------------------------------ inside

    def _begin(self, start: Sequence[float], *, with_inputs: bool) -> None:
        try:
            instance = self._fresh()
            instance.request[:] = list(start)
            instance.initialise(self._binding.binding.start_time, self._settings, with_inputs=with_inputs)
        except FmuError as error:
            self.close()
            self._fail(error, "the start")
        self._index = 0
        self._record = []
        self._start_inputs = bytes(instance.request)[16:] if with_inputs else b""
        self._phase = "ready"

    def _opened(self) -> FmuInstance | WorkerInstance:
        """Return the instance, which is opened by its first use but never started again unasked."""
        if self._phase == "broken":
            raise FmuStateError("A state could not be restored; reset the asset to go on.")
        if self._phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start anew.")
        if self._phase == "new":
            self.reset()
        instance = self._instance
        assert instance is not None
        return instance

    def _fresh(self) -> FmuInstance | WorkerInstance:
        """Return an instance as after its instantiation; never one that a fatal error has touched."""
        if self._instance is not None and not self._instance.lost:
            try:
                self._instance.reset()
                return self._instance
            except FmuCallError:
                pass  # an FMU that cannot be reset is instantiated anew
        self.close()
        folder = extract_fmu(self._description)
        plan = replace(self._exchange.plan, folder=str(folder))
        try:
            instance = (
                WorkerInstance(plan, step_timeout=self._step_timeout) if self._isolated else FmuInstance(plan)
            )
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self._instance = instance
        # Also at the end of the interpreter, or when the asset is forgotten without being closed.
        self._release = weakref.finalize(self, _release, instance, folder)
        self._reply = np.frombuffer(memoryview(instance.reply).cast("B"), dtype=np.float64)
        return instance

    def _observation(self) -> Observation:
        block = self._reply
        # The sum of squares tells whether all are finite; only a suspicion is looked at more closely.
        if not math.isfinite(block.dot(block)):
            bad = self._exchange.not_finite(block)
            if bad:
                more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
                raise FmuOutputError(
                    f"The FMU {self._description.path} gave values that are not finite at "
                    f"t = {self.time:g} s: {', '.join(bad[:5])}{more}.",
                    [text for _, text in self.log[-5:]],
                )
        values, extra = self._exchange.read(block)
        return Observation(values, self._start_time + self._index * self._step_size, extra)

    def _collect_log(self) -> None:
        instance = self._instance
        if instance is not None and instance.has_log and not instance.lost:
            for status, text in instance.take_log():
                name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
                self._log.append((name, text))

    def _fail(self, error: FmuError, what: str) -> NoReturn:
        """Raise the error with the FMU's file and the moment, and keep its messages."""
        self._log.extend(("Error", message) for message in error.messages)
        if isinstance(error, FmuCallError | FmuWorkerError | TimeoutError):
            raise type(error)(
                f"{self._description.path}, {what}: {error.sentence}", error.messages
            ) from error
        raise error


def _release(instance: FmuInstance | WorkerInstance, folder: Path) -> None:
    instance.close()
    if isinstance(instance, FmuInstance):
        forget_modules(str(folder))
    shutil.rmtree(folder, ignore_errors=True)
