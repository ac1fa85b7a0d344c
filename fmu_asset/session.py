"""`FmiAsset`: the only door to an FMU. It knows FMI and roles, not wings."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Literal, NoReturn, Self

import numpy as np

from reporting.progress import Progress, SilentProgress, Stage

from .archive import read_fmu
from .binding import INPUT_ROLES, Binding, load_binding
from .declared import FmuDescription, describe_fmu
from .errors import (
    FmuCallError,
    FmuError,
    FmuMemoryError,
    FmuOutputError,
    FmuStateError,
    FmuWorkerError,
)
from .exchange import Exchange, Values, plain_values
from .housing import Housing, Instance, limits_of
from .instances.base import STATUS_NAMES
from .instances.series import Series
from .observation import Observation
from .reading import Reader
from .saved_state import SavedState, StateMethod
from .simulation import Histories, ObservationHistory, blocks, request_rows
from .worker.client import WorkerInstance

_LOG_LENGTH = 200


class FmiAsset:
    """An FMU that is flown step by step through a binding.

    The FMU runs in a worker process of its own unless `isolated` is False: only then are the wall-clock limit
    and protection against crashes given. The asset is opened by the first `reset`, `step` or `with`.

    Parameters
    ----------
    fmu_path : path-like
        An FMU of FMI 1, 2 or 3, for co-simulation or model exchange.
    binding : Binding or path-like
        The binding, or its file.
    isolated : bool
        Whether the FMU runs in a worker process.
    step_timeout, load_timeout : float, optional
        Wall-clock limits of one step, and of loading and initialisation [s]; those of the binding, or 10 and
        60.
    memory_limit : float, optional
        Limit of the worker's resident memory [MiB]; that of the binding, or 4096.
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
        step_timeout: float | None = None,
        load_timeout: float | None = None,
        memory_limit: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        given = binding if isinstance(binding, Binding) else load_binding(binding)
        self._description = read_fmu(fmu_path, given.binding.interface)
        limits = limits_of(given, step_timeout, load_timeout, memory_limit)
        self._exchange = Exchange(self._description, given)
        self._housing = Housing(self._description, self._exchange.plan, limits, isolated=isolated)
        self._binding = self._exchange.binding
        self._settings = self._exchange.settings(parameters or {})
        self._parameters = plain_values(parameters or {})
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self._index = 0
        self._step_size, self._interval = self._binding.step_size, self._binding.interval
        self._start_time = self._binding.binding.start_time
        self._recording = self.state_method == "replay"
        self._record: list[bytes] = []
        self._start_inputs = b""
        self._log: deque[tuple[str, str]] = deque(maxlen=_LOG_LENGTH)

    # ------------------------------------------------------------------ what it is

    @property
    def binding(self) -> Binding:
        """The binding, with arrays that are observed or recorded as their elements."""
        return self._binding

    @property
    def description(self) -> FmuDescription:
        """What the FMU declares."""
        return self._description

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self._index * self._interval

    @property
    def step_index(self) -> int:
        """Number of steps since the last reset."""
        return self._index

    @property
    def state_method(self) -> StateMethod:
        """How `save_state` keeps the state: serialised by the FMU, or by replaying the recorded inputs."""
        wanted = self._binding.binding.state
        if wanted != "auto":
            return wanted
        able = self._description.can_get_and_set_state and self._description.can_serialise_state
        # A state in model exchange would have to hold our solver as well.
        return "serialised" if able and self._description.interface == "co-simulation" else "replay"

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMU, oldest first: status and text."""
        self._collect_log()
        return tuple(self._log)

    @property
    def worker_process_id(self) -> int | None:
        """Process number of the worker; None without one."""
        instance = self._housing.instance
        return instance.process_id if isinstance(instance, WorkerInstance) and not instance.lost else None

    @property
    def worker_memory(self) -> int | None:
        """Resident memory of the worker [bytes]; None without one."""
        instance = self._housing.instance
        return instance.memory if isinstance(instance, WorkerInstance) and not instance.lost else None

    @property
    def recorded_units(self) -> dict[str, str]:
        """Units of `Observation.extra` by name."""
        return dict(self._exchange.recorded_units)

    def input_range(self, role: str, name: str) -> tuple[float, float]:
        """Return the range of an input in the binding's unit: that of the FMU and of the binding together.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        return self._exchange.input_range(role, name)

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
        for name, port in self._binding.port.items():
            for quantity, vector in port.quantities.items():
                roles.update(dict.fromkeys(vector.variables, f"port.{name}.{quantity}"))
        return describe_fmu(self._description, roles) | {
            "binding": self._binding.name,
            "step_size": self._binding.step_size,
            "decimation": self._binding.binding.decimation,
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
        self._phase = "closed"
        self._housing.close()

    def reset(
        self,
        parameters: Values | None = None,
        *,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> None:
        """Go back to the start.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; those of the constructor if absent. They stay for later resets.
        control, health, load, port : mapping of str to float, optional
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
            self._parameters = plain_values(parameters)
        start = self._exchange.start_values()
        given = self._exchange.place(start, control, health, load, port)
        self._begin(start, with_inputs=given)

    def step(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> Observation:
        """Make one communication step.

        Inputs are given by the binding's names and in its units; one that is not given keeps its last value.
        If the FMU refuses the step, the asset is where it was before it.

        Parameters
        ----------
        control, health, load, port : mapping of str to float, or to a sequence for an array
            Inputs of this step; those of a port are called `<port>.<quantity>`.

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
        request = self._request
        before = request.tobytes()
        begin = self._start_time + self._index * self._interval
        try:
            self._exchange.place(request, control, health, load, port)
            request[0] = begin
            request[1] = self._step_size
            instance.step()
        except FmuError as error:
            request.cast("B")[:] = before
            self._fail(error, f"step {self._index} from t = {begin:g} s")
        self._index += 1
        if self._recording:
            self._record.append(request.tobytes()[16:])
        return self._observation()

    def simulate(
        self,
        control: Histories | None = None,
        health: Histories | None = None,
        load: Histories | None = None,
        port: Histories | None = None,
        *,
        steps: int | None = None,
        progress: Progress | None = None,
    ) -> ObservationHistory:
        """Make many communication steps under prescribed inputs, from where the asset is.

        The result is that of as many calls of `step`, to the bit. All inputs are checked before the first
        step. If a step fails, the steps before it are made and the asset is where it was before that one.

        Parameters
        ----------
        control, health, load, port : mapping of str to (N,) array-like or float
            Inputs by the binding's names and in its units: one for each step, or one for all; (N, n) or (n,)
            for an array. One that is not given keeps its last value.
        steps : int, optional
            Number of steps N; that of the histories if absent.
        progress : Progress, optional
            Where progress is shown.

        Returns
        -------
        ObservationHistory
            What was observed at the end of each step.

        Raises
        ------
        FmuInputError
            If a value is not finite or out of range, or histories have different lengths; nothing was sent.
        BindingError, FmuCallError, FmuOutputError, FmuWorkerError, FmuTimeoutError
            As `step`; the message says at which step. A worker that dies or takes too long reports every 20
            ms: the step named may be a little early.
        """
        instance = self._opened()
        roles = {"control": control, "health": health, "load": load, "port": port}
        rows = request_rows(self._exchange, np.array(self._request), roles, steps)
        index = np.arange(self._index, self._index + len(rows) + 1)
        moments = np.asarray(self._start_time + index * self._interval, dtype=np.float64)
        rows[:, 0], rows[:, 1] = moments[:-1], self._step_size
        replies = np.full((len(rows), len(self._reply)), np.nan)
        with (progress or SilentProgress()).stage("Simulating", total=len(rows), unit="steps") as stage:
            for series in blocks(rows, replies):
                self._run(instance, series, stage)
        return ObservationHistory.of(self._exchange.outputs, moments[1:], replies)

    def _run(self, instance: Instance, series: Series, stage: Stage) -> None:
        """Make a block of steps; whatever happens, the asset is where the last complete one has left it."""
        before, begin, shown = self._request.tobytes(), self._index, 0
        width = len(before)

        def report() -> None:
            nonlocal shown
            stage.advance(series.done - shown)
            shown = series.done

        failure: FmuError | None = None
        try:
            instance.run(series, report)
        except FmuError as error:
            failure = error
        finally:
            made = bytes(series.requests[: series.done * width])
            self._index += series.done
            self._request.cast("B")[:] = made[-width:] or before
            if self._recording:
                self._record += [made[i + 16 : i + width] for i in range(0, len(made), width)]
        if failure is not None:
            self._fail(failure, f"step {self._index} from t = {self.time:g} s")
        end = series.done * series.reply_size
        self._reply[:] = np.frombuffer(series.replies[end - series.reply_size : end])
        if self._reader.suspicious():
            self._refuse_not_finite(f" It was step {begin + series.done - 1}.")
        report()

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
        if self._phase != "ready" or self._housing.instance is None:
            raise FmuStateError("There is no state to save before the first reset or step.")
        if self.state_method == "serialised":
            try:
                body = self._housing.instance.save()
            except FmuCallError as error:
                hint = 'If it cannot save its state, write `state = "replay"` into [binding] of its binding.'
                self._fail(FmuCallError(f"{error.sentence} {hint}", error.messages), "saving the state")
            except FmuError as error:
                self._fail(error, "saving the state")
        else:
            body = b"".join(self._record)
        return SavedState(
            method=self.state_method,
            fmu=self._description.sha256,
            index=self._index,
            step_size=self._interval,
            start_time=self._start_time,
            parameters=self._parameters,
            start_inputs=self._start_inputs,
            inputs=bytes(self._housing.instance.request)[16:],
            outputs=self._outputs_now(),
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
            If it is damaged, belongs to another FMU or step size, or the FMU gives other outputs than when it
            was saved.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU fails.
        """
        saved = SavedState.from_bytes(content)
        width = 8 * self._exchange.plan.input_count
        saved.refuse_if_foreign(
            path=self._description.path,
            fmu=self._description.sha256,
            interval=self._interval,
            start_time=self._start_time,
            method=self.state_method,
            width=width,
        )
        replayed = saved.method == "replay"
        ready = (
            self._phase == "ready" and self._housing.instance is not None and not self._housing.instance.lost
        )
        same = (plain_values(saved.parameters), saved.start_inputs) == (self._parameters, self._start_inputs)
        # An instance that was initialised in the same way takes the state as it is: what an ensemble needs.
        if replayed or not (ready and same):
            self._settings = self._exchange.settings(saved.parameters)
            self._parameters = plain_values(saved.parameters)
            start = self._exchange.start_values()
            if saved.start_inputs:
                start[2:] = np.frombuffer(saved.start_inputs).tolist()
            self._begin(start, with_inputs=bool(saved.start_inputs))
        instance = self._housing.instance
        assert instance is not None
        try:
            if replayed:
                for index in range(saved.index):
                    self._replay(saved.body[index * width : (index + 1) * width])
            else:
                instance.restore(saved.body)
                self._index = saved.index
                memoryview(instance.request).cast("B")[16:] = saved.inputs
            saved.refuse_other_outputs(self._outputs_now(), self._exchange.output_name)
        except FmuError as error:
            self._phase = "broken"
            self._fail(error, "restoring the state")

    def fork(self) -> FmiAsset:
        """Return another asset of the same FMU in the same state, with a worker of its own.

        The FMU is not extracted again. Each of the two goes its own way from here.

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuError
            As `save_state` and `restore_state`.
        """
        state = self.save_state()
        other = self.sibling()
        try:
            other.restore_state(state)
        except BaseException:
            other.close()
            raise
        return other

    def sibling(self, parameters: Values | None = None) -> FmiAsset:
        """Return a new asset of the same FMU, binding and limits, without extracting the FMU again.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; those of this asset if absent.

        Raises
        ------
        BindingError, FmuInputError
            If a parameter is unknown or lies outside its range.
        """
        other = FmiAsset.__new__(FmiAsset)
        other.__dict__.update(self.__dict__)
        other._housing = self._housing.sibling()
        other._phase, other._index = "new", 0
        other._record, other._start_inputs = [], b""
        other._log = deque(maxlen=_LOG_LENGTH)
        if parameters is not None:
            other._settings = other._exchange.settings(parameters)
            other._parameters = plain_values(parameters)
        return other

    def renew(self) -> None:
        """Free the FMU's instance, make another one in the same process, and go back to the start.

        `reset` uses the FMU's own reset; this is what a batch of runs without it costs.

        Raises
        ------
        FmuError
            If the FMU fails.
        """
        instance = self._housing.instance
        if isinstance(instance, WorkerInstance) and not instance.lost:
            try:
                instance.renew()
            except FmuError as error:
                self._fail(error, "making a new instance")
            self._begin(self._exchange.start_values(), with_inputs=False, reset=False)
        else:
            self.close()
            self.reset()

    def _replay(self, inputs: bytes) -> None:
        instance = self._housing.instance
        assert instance is not None
        instance.request[0], instance.request[1] = self.time, self._step_size
        memoryview(instance.request).cast("B")[16:] = inputs
        instance.step()
        self._index += 1
        self._record.append(inputs)

    # ------------------------------------------------------------------ inside

    def _begin(self, start: Sequence[float], *, with_inputs: bool, reset: bool = True) -> None:
        try:
            instance = self._housing.instance
            if reset or instance is None:
                instance = self._housing.fresh()
                self._request = memoryview(instance.request).cast("B").cast("d")
                self._reply = np.frombuffer(memoryview(instance.reply).cast("B"), dtype=np.float64)
                self._reader = Reader(self._exchange.outputs, self._reply)
            instance.request[:] = list(start)
            instance.initialise(self._start_time, self._settings, with_inputs=with_inputs)
        except FmuError as error:
            self.close()
            self._fail(error, "the start")
        self._index = 0
        self._record = []
        self._start_inputs = bytes(instance.request)[16:] if with_inputs else b""
        self._phase = "ready"

    def _outputs_now(self) -> bytes:
        """Return the outputs of this moment as the FMU gives them."""
        instance = self._housing.instance
        assert instance is not None
        instance.read()
        return bytes(instance.reply)

    def _opened(self) -> Instance:
        """Return the instance, which is opened by its first use but never started again unasked."""
        if self._phase == "ready" and self._housing.instance is not None:
            return self._housing.instance
        if self._phase == "broken":
            raise FmuStateError("A state could not be restored; reset the asset to go on.")
        if self._phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start anew.")
        if self._phase == "new":
            self.reset()
        instance = self._housing.instance
        assert instance is not None
        return instance

    def _observation(self) -> Observation:
        if self._reader.suspicious():
            self._refuse_not_finite()
        return self._reader.read(self._start_time + self._index * self._interval)

    def _refuse_not_finite(self, which: str = "") -> None:
        bad = self._exchange.not_finite(self._reply)
        if bad:
            more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
            raise FmuOutputError(
                f"The FMU {self._description.path} gave values that are not finite at "
                f"t = {self.time:g} s: {', '.join(bad[:5])}{more}. Its inputs or its step size are "
                "probably beyond what it can compute; reset the asset or restore a state to go on."
                f"{which}",
                [text for _, text in self.log[-5:]],
            )

    def _collect_log(self) -> None:
        instance = self._housing.instance
        if instance is not None and instance.has_log and not instance.lost:
            for status, text in instance.take_log():
                name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
                self._log.append((name, text))

    def _fail(self, error: FmuError, what: str) -> NoReturn:
        """Raise the error with the FMU's file and the moment, and keep its messages."""
        self._log.extend(("Error", message) for message in error.messages)
        if isinstance(error, FmuCallError | FmuWorkerError | FmuStateError | FmuMemoryError | TimeoutError):
            tool = what == "the start" and self._description.needs_tool
            hint = " It declares that it needs its authoring tool on this machine." if tool else ""
            raise type(error)(
                f"{self._description.path}, {what}: {error.sentence}{hint}", error.messages
            ) from error
        raise error
