"""The life of an asset: opened, started again and closed, what its failures say, and its state as bytes.

The bytes are what a mission's checkpoint keeps of an FMU, or of several.
"""

import math
import os
import struct
from collections import deque
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, Literal, NoReturn, Self, Unpack

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.errors import FmuError, FmuOutputError, FmuStateError, said
from fmu_asset.instances.base import status_name
from fmu_asset.instances.plan import Instance
from fmu_asset.worker.client import WorkerInstance

from .binding import Binding, load_binding
from .exchange import Exchange
from .layout import Observation
from .placement import InstanceHost, InstanceStart, worker_limits
from .values import Inputs, PlainValue, Values, check_roles, plain_values

StateMethod = Literal["serialised", "replay"]
"""How a state is kept: serialised by the FMU, or as the inputs of all steps, to be replayed."""
_HEADER = struct.Struct("<8sI")


class PackedState(BaseModel):
    """What is kept of an asset: a head, in JSON, and a body of bytes.

    Attributes
    ----------
    index : int
        Number of steps made.
    body : bytes
        What the FMUs themselves remember.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, ser_json_bytes="hex", val_json_bytes="hex"
    )
    magic: ClassVar[bytes]
    what: ClassVar[str]

    body: bytes = Field(b"", exclude=True)

    def to_bytes(self) -> bytes:
        """Return the state as bytes; equal states give equal bytes."""
        text = self.model_dump_json().encode()
        return _HEADER.pack(self.magic, len(text)) + text + self.body

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Return the state that `to_bytes` packed.

        Raises
        ------
        FmuStateError
            If it is something else, or damaged.
        """
        try:
            magic, length = _HEADER.unpack_from(content)
            begin = _HEADER.size + length
            if magic != cls.magic:
                raise ValueError(magic)
            head = cls.model_validate_json(content[_HEADER.size : begin])
        except (struct.error, ValueError, TypeError) as error:
            raise FmuStateError(
                f"What was given is not a state of {cls.what}, or it is damaged."
            ) from error
        return head.model_copy(update={"body": content[begin:]})


class SavedState(PackedState):
    """A saved state of one FMU; its body is the FMU's serialised state, or the inputs of each step.

    Attributes
    ----------
    method : {"serialised", "replay"}
        What `body` is.
    fmu : str
        SHA-256 of the FMU file.
    step_size, start_time : float
        Time between observations and start of the binding [s].
    parameters : dict of str to float or text, or to a list for an array
        As the caller gave them.
    health : dict of str to float
        Health that was set at the start of the instance, by the binding's names and in its units.
    first_index : int
        Number of the step at which the instance was started: 0, or where such health changed last.
    start_inputs : bytes
        Inputs during initialisation, as doubles; empty if the FMU's start values held.
    inputs : bytes
        The last inputs, as doubles.
    outputs : bytes
        The outputs at that moment, as doubles; the FMU must give them again.
    """

    magic = b"UAVASSET"
    what = "an FMI asset"

    index: int = Field(ge=0)
    method: StateMethod
    fmu: str
    step_size: float
    start_time: float
    parameters: dict[str, PlainValue]
    health: dict[str, PlainValue] = Field(default_factory=dict)
    first_index: int = Field(0, ge=0)
    start_inputs: bytes
    inputs: bytes
    outputs: bytes

    def refuse_other_outputs(self, outputs: bytes, names: Sequence[str]) -> None:
        """Refuse a restored FMU that does not give the outputs that it gave when it was saved.

        Parameters
        ----------
        outputs : bytes
            What it gives now, as doubles.
        names : sequence of str
            Names of the outputs.

        Raises
        ------
        FmuStateError
            If a bit differs: the FMU declares a capability that it does not have.
        """
        if outputs == self.outputs:
            return
        if len(outputs) != len(self.outputs):
            raise FmuStateError("The state was saved with another binding; use that one.")
        then, now = np.frombuffer(self.outputs), np.frombuffer(outputs)
        which = int(np.flatnonzero(now.view(np.int64) != then.view(np.int64))[0])
        if self.method == "replay":
            cause = "it does not give equal outputs for equal inputs, so that it cannot be resumed"
        else:
            cause = said("state.partly", does="does not restore all of its state")
        values = float(now[which]), float(then[which])
        raise FmuStateError(said("state.differs", name=names[which], values=values, cause=cause))


_LOG_LENGTH = 200


class OpenedFmu:
    """An FMU with a binding and the instance that stands for it; `FmiAsset` adds steps and states.

    Parameters, attributes and errors are those of `FmiAsset`.
    """

    def __init__(
        self,
        fmu_path: str | os.PathLike[str] | FmuDescription,
        binding: Binding | str | os.PathLike[str],
        *,
        isolated: bool = True,
        step_timeout: float | None = None,
        load_timeout: float | None = None,
        memory_limit: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        given = binding if isinstance(binding, Binding) else load_binding(binding)
        limits = worker_limits(given, step_timeout, load_timeout, memory_limit)
        if isinstance(fmu_path, FmuDescription):
            description = fmu_path
        else:
            description = read_fmu(fmu_path, given.binding.interface)
        exchange = Exchange(description, given)
        housing = InstanceHost(exchange.description, exchange.plan, limits, isolated=isolated)
        self._settle(exchange, housing, parameters or {})

    def _settle(self, exchange: Exchange, housing: InstanceHost, parameters: Values) -> None:
        """Begin with what is exchanged, and with where the instance lives."""
        self._exchange, self._housing = exchange, housing
        self.description, self.binding = exchange.description, exchange.binding
        self.recorded_units, self.reset_trial = exchange.recorded_units, housing.reset_trial
        able = self.description.can_get_and_set_state and self.description.can_serialise_state
        # A state in model exchange would have to hold our solver as well.
        serialised = able and self.description.interface == "co-simulation"
        wanted = self.binding.binding.state
        self.state_method: StateMethod = (
            wanted if wanted != "auto" else "serialised" if serialised else "replay"
        )
        self._start_time, self._interval = self.binding.binding.start_time, self.binding.interval
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self.step_index = self._first_index = 0
        self._health: dict[str, PlainValue] = {}
        self._set_parameters(parameters)
        self._step_size = self.binding.step_size
        self._lines = exchange.plan.linear_count
        self._record: list[bytes] = []
        self._start_inputs = b""
        self._log: deque[tuple[str, str]] = deque(maxlen=_LOG_LENGTH)

    # ------------------------------------------------------------------ what it is

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self.step_index * self._interval

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMU, oldest first: status and text."""
        instance = self._housing.instance
        if instance is not None and not instance.lost:
            self._log.extend((status_name(status), text) for status, text in instance.take_log())
        return tuple(self._log)

    @property
    def worker_process_id(self) -> int | None:
        """Process number of the worker; None without one."""
        instance = self._housing.instance
        return (
            instance.process_id
            if isinstance(instance, WorkerInstance) and not instance.lost
            else None
        )

    @property
    def worker_memory(self) -> int | None:
        """Resident memory of the worker [bytes]; None without one."""
        instance = self._housing.instance
        return (
            instance.memory if isinstance(instance, WorkerInstance) and not instance.lost else None
        )

    def input_range(self, role: str, name: str) -> tuple[float, float]:
        """Return the range of an input in the binding's unit: that of the FMU and of the binding together.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        slot = self._exchange.slot(role, name)
        low, high = sorted(slot.conversion.from_fmu(end) for end in (slot.low, slot.high))
        return low, high

    def check_parameters(self, parameters: Values) -> None:
        """See whether parameters could be set, without setting them.

        Raises
        ------
        BindingError
            If one is neither in the binding nor a parameter of the FMU.
        FmuInputError
            If a value is not finite, not whole or outside its range.
        """
        self._exchange.settings(parameters)

    # ------------------------------------------------------------------ life

    def __enter__(self) -> Self:
        if self._phase != "ready":
            self.reset()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker and remove its files; the asset can be opened again by `reset`."""
        self._phase = "closed"
        self._housing.close()

    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Go back to the start.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; those of the constructor if absent. They stay for later resets.
        **inputs : mapping of str to float, optional
            `control`, `health`, `load` and `port`: inputs that hold already during initialisation. If none is
            given, the FMU's start values hold.

        Raises
        ------
        FmuInputError
            If a value is not finite or outside its range.
        BindingError
            If a name is not in the binding.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        check_roles(inputs)
        if parameters is not None:
            self._set_parameters(parameters)
        self._start_anew(inputs)

    def renew(self, **inputs: Unpack[Inputs]) -> None:
        """Free the FMU's instance, make another one in the same process, and go back to the start.

        `reset` uses the FMU's own reset; this is what a batch of runs without it costs.

        Parameters
        ----------
        **inputs : mapping of str to float, optional
            `control`, `health`, `load` and `port`, as those of `reset`.

        Raises
        ------
        FmuInputError, BindingError
            If an input does not fit.
        FmuError
            If the FMU fails.
        """
        check_roles(inputs)
        try:
            self._housing.renew()
        except FmuError as error:
            self._fail(error, "making a new instance")
        self._start_anew(inputs, renewed=True)

    def sibling(self, parameters: Values | None = None) -> Self:
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
        other = copy(self)
        other._housing = self._housing.sibling()
        other._phase, other.step_index = "new", 0
        other._record, other._start_inputs = [], b""
        other._log = deque(maxlen=_LOG_LENGTH)
        other._first_index = 0
        other._health = {}
        if parameters is not None or self._health:
            other._set_parameters(self._parameters if parameters is None else parameters)
        return other

    # ------------------------------------------------------------------ inside

    def _set_parameters(self, parameters: Values) -> None:
        self._settings = self._exchange.settings(parameters, self._health)
        self._parameters = plain_values(parameters)

    def _start_anew(self, inputs: Mapping[str, Any], *, renewed: bool = False) -> None:
        if self._exchange.health_slots:
            inputs, health = self._exchange.without_start_health(inputs)
            self._settings = self._exchange.settings(self._parameters, health)
            self._health = plain_values(health)
        start = self._exchange.start_values(inputs)
        given = self._exchange.place(start, inputs)
        self._begin(start, with_inputs=given, renewed=renewed)

    def _enter_health(self, inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Start the FMU anew where health that is set at a start only changes; return the other inputs.

        It starts at this moment and under the inputs that hold now, and forgets its earlier steps.
        """
        inputs, health = self._exchange.without_start_health(inputs)
        wanted = self._health | plain_values(health)
        if wanted == self._health:
            return inputs
        settings = self._exchange.settings(self._parameters, wanted)
        if self._phase == "ready":
            request, with_inputs = list(self._request), True
            self._exchange.place(request, inputs)
        else:
            self._refuse_closed()
            request = self._exchange.start_values(inputs)
            with_inputs = self._exchange.place(request, inputs)
        self._settings = settings
        self._health = wanted
        self._begin(request, with_inputs=with_inputs, index=self.step_index)
        return inputs

    def _begin(
        self, request: list[float], *, with_inputs: bool, renewed: bool = False, index: int = 0
    ) -> None:
        """Bring an instance to its start, which is the moment after `index` steps of the asset."""
        time = self._start_time + index * self._interval
        start = InstanceStart(time, self._settings, request, with_inputs)
        try:
            instance = self._housing.start(start, renewed=renewed)
            self._adopt(instance)
        except FmuError as error:
            self.close()
            self._fail(error, "the start")
        self.step_index = self._first_index = index
        self._record = []
        self._start_inputs = bytes(instance.request)[16:] if with_inputs else b""
        self._phase = "ready"

    def _adopt(self, instance: Instance) -> None:
        self._instance = instance
        self._request = memoryview(instance.request).cast("B").cast("d")
        self._reply = np.frombuffer(memoryview(instance.reply).cast("B"), dtype=np.float64)

    def _stand_in(self, request: bytes, reply: npt.NDArray[np.float64]) -> Instance | None:
        """Return what takes an instance's place if its first step shows that it was not at its start."""
        other = self._housing.contradicted(request, reply)
        if other is not None:
            self._adopt(other)
            self._request.cast("B")[:] = request
        return other

    def _opened(self, given: Mapping[str, Any] | None = None) -> Instance:
        """Return the instance, which is opened by its first use but never started again unasked.

        Where a step gives a whole array that was resized, its start values need not fit.
        """
        self._refuse_closed()
        if self._phase == "new":
            # Without them: what keeps its start values, and lines, which begin at them.
            known = (
                given if self.binding.binding.structural_parameters and not self._lines else None
            )
            self._begin(self._exchange.start_values(known or {}), with_inputs=False)
        return self._instance

    def _refuse_closed(self) -> None:
        if self._phase == "broken":
            raise FmuStateError("A state could not be restored; reset the asset to go on.")
        if self._phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start anew.")

    def _observation(self) -> Observation:
        self._refuse_not_finite()
        return self._exchange.outputs.observation(self._reply, self.time)

    def _refuse_not_finite(self, which: str = "") -> None:
        # The sum of squares is as fast as can be, and can be infinite for large values too.
        if math.isfinite(self._reply.dot(self._reply)):
            return
        finite = np.isfinite(self._reply).tolist()
        bad = [
            name
            for name, good in zip(self._exchange.output_names, finite, strict=False)
            if not good
        ]
        if bad:
            more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
            why = said("running.not_finite", self=self, names=bad[:5], more=more, which=which)
            raise FmuOutputError(why, [text for _, text in self.log[-5:]])

    def _fail(self, error: FmuError, what: str) -> NoReturn:
        """Raise the error with the FMU's file and the moment, and keep its messages."""
        self._log.extend(("Error", message) for message in error.messages)
        if isinstance(error, RuntimeError | TimeoutError):  # the others are about what was asked
            tool = what == "the start" and self.description.needs_tool
            hint = " It declares that it needs its authoring tool on this machine." if tool else ""
            raise type(error)(
                f"{self.description.label}, {what}: {error.sentence}{hint}",
                error.messages,
                error.time,
            ) from error
        raise error
