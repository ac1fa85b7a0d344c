"""`FmiAsset`: the only door to an FMU. It knows FMI and roles, not wings."""

from __future__ import annotations

import difflib
import json
import math
import os
import shutil
import struct
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from .archive import FmuDescription, VariableInfo, extract_fmu, read_fmu
from .binding import INPUT_ROLES, Binding, Scalar, load_binding
from .errors import (
    BindingError,
    FmuCallError,
    FmuError,
    FmuInputError,
    FmuOutputError,
    FmuStateError,
    FmuWorkerError,
)
from .instance import STATUS_NAMES, FmuInstance, Plan, Settings
from .units import IDENTITY, Conversion, conversion
from .worker import WorkerInstance

StateMethod = Literal["serialised", "replay"]

_MAGIC = b"UAVASSET"
_STATE_HEADER = struct.Struct("<8sI")
_KINDS = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean"}
_LOG_LENGTH = 200
_CAUSALITY = {
    "input": ("input",),
    "parameter": ("parameter",),
    "output": ("output", "local", "calculatedParameter"),
}


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


class _Slot(NamedTuple):
    """Where an input goes: index in the request block, range in the FMU's unit, conversion."""

    index: int
    low: float
    high: float
    conversion: Conversion
    label: str
    whole: bool
    variable: VariableInfo


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
        self._slots: dict[str, dict[str, _Slot]] = {}
        self._plan = self._make_plan()
        self._parameter_slots = self._make_slots("parameter", 0)
        self._parameters = dict(parameters or {})
        self._settings = self._make_settings(self._parameters)
        self._instance: FmuInstance | WorkerInstance | None = None
        self._ready = False
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
        if not self._ready:
            self.reset()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the worker and remove its files; the asset can be opened again by `reset`."""
        instance, self._instance, self._ready = self._instance, None, False
        if instance is not None:
            instance.close()
        if isinstance(instance, FmuInstance):
            shutil.rmtree(self._folder, ignore_errors=True)

    def __del__(self) -> None:
        if getattr(self, "_instance", None) is not None:
            self.close()

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
            self._settings = self._make_settings(parameters)
            self._parameters = dict(parameters)
        start = self._start_values()
        given = self._place(start, control, health, load)
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
        if not self._ready:
            self.reset()
        instance = self._instance
        assert instance is not None
        request = instance.request
        before = request[:]
        values = before[2:]
        self._place(values, control, health, load)
        begin = self._start_time + self._index * self._step_size
        request[:] = [begin, self._step_size, *values]
        try:
            instance.step()
        except FmuError as error:
            request[:] = before
            raise self._told(error, f"step {self._index} from t = {begin:g} s") from error
        self._index += 1
        if self._recording:
            self._record.append(bytes(memoryview(request).cast("B")[16:]))
        return self._observation(instance.reply)

    def observe(self) -> Observation:
        """Return the observation of this moment without a step, such as the initial one."""
        if not self._ready:
            self.reset()
        instance = self._instance
        assert instance is not None
        try:
            instance.read()
        except FmuError as error:
            raise self._told(error, f"reading at t = {self.time:g} s") from error
        return self._observation(instance.reply)

    # ------------------------------------------------------------------ state

    def save_state(self) -> bytes:
        """Return the state of the asset, for `restore_state` in this or another process.

        If the FMU can serialise its state, that is what is kept; if not, the inputs of all steps since the last
        reset are, and restoring replays them (see `state_method`).

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuCallError
            If the FMU fails to save.
        """
        if not self._ready or self._instance is None:
            raise FmuStateError("There is no state to save before the first reset or step.")
        if self.state_method == "serialised":
            try:
                body = self._instance.save()
            except FmuError as error:
                raise self._told(error, "saving the state") from error
        else:
            body = b"".join(self._record)
        head = {
            "method": self.state_method,
            "fmu": self._description.sha256,
            "index": self._index,
            "step_size": self._binding.step_size,
            "start_time": self._binding.binding.start_time,
            "parameters": self._parameters,
            "start_inputs": self._start_inputs.hex(),
            "inputs": bytes(memoryview(self._instance.request).cast("B")[16:]).hex(),
        }
        text = json.dumps(head, sort_keys=True).encode()
        return _STATE_HEADER.pack(_MAGIC, len(text)) + text + body

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
        head, body = _unpack_state(content)
        if head["fmu"] != self._description.sha256:
            raise FmuStateError(
                f"The state was saved with another FMU than {self._description.path} (its hash differs); use that one."
            )
        if (head["step_size"], head["start_time"]) != (
            self._binding.step_size,
            self._binding.binding.start_time,
        ):
            raise FmuStateError("The state was saved with another step size or start time; use that binding.")
        width = 8 * self._plan.input_count
        if head["method"] != self.state_method or (
            head["method"] == "replay" and len(body) != width * int(head["index"])
        ):
            raise FmuStateError("The saved state is damaged: its length is not what it says.")
        self._settings = self._make_settings(head["parameters"])
        self._parameters = dict(head["parameters"])
        start_inputs = bytes.fromhex(head["start_inputs"])
        start = list(np.frombuffer(start_inputs)) if start_inputs else self._start_values()
        self._begin([float(value) for value in start], with_inputs=bool(start_inputs))
        instance = self._instance
        assert instance is not None
        try:
            if head["method"] == "serialised":
                instance.restore(body)
                self._index = int(head["index"])
                memoryview(instance.request).cast("B")[16:] = bytes.fromhex(head["inputs"])
            else:
                for index in range(int(head["index"])):
                    self._replay(body[index * width : (index + 1) * width])
        except FmuError as error:
            self._ready = False
            raise self._told(error, "restoring the state") from error

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
        self._ready = False
        if self._instance is not None and self._instance.lost:
            self.close()
        try:
            if self._instance is None:
                self._open()
            else:
                self._instance.reset()
            instance = self._instance
            assert instance is not None
            instance.request[2:] = start
            instance.initialise(self._binding.binding.start_time, self._settings, with_inputs=with_inputs)
        except FmuError as error:
            told = self._told(error, "the start")
            self.close()
            raise told from error
        self._index = 0
        self._record = []
        self._start_inputs = bytes(memoryview(instance.request).cast("B")[16:]) if with_inputs else b""
        self._ready = True

    def _open(self) -> None:
        folder = extract_fmu(self._description)
        self._folder = folder
        plan = replace(self._plan, folder=str(folder))
        try:
            self._instance = (
                WorkerInstance(plan, step_timeout=self._step_timeout) if self._isolated else FmuInstance(plan)
            )
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _make_plan(self) -> Plan:
        """Resolve all names of the binding and lay out the two blocks."""
        binding, inputs = self._binding, {}
        for role in INPUT_ROLES:
            self._slots[role] = self._make_slots(role, 0)
            inputs.update({slot.label: slot for slot in self._slots[role].values()})
        order = {"Real": 0, "Integer": 1, "Boolean": 2}
        # Stable: within a base type the order is that of the binding.
        labels = sorted(inputs, key=lambda label: order[_KINDS[inputs[label].variable.kind]])
        self._ordered = [inputs[label].variable for label in labels]
        for role, slots in self._slots.items():
            self._slots[role] = {
                name: slot._replace(index=labels.index(slot.label)) for name, slot in slots.items()
            }
        observed = [
            (name, self._resolve(name, f"observation.{key}", "output"), vector.unit, f"observation.{key}")
            for key, vector in binding.observation.items()
            for name in vector.variables
        ]
        monitored = [
            (
                name,
                self._resolve(scalar.variable, f"monitor.{name}", "output"),
                scalar.unit,
                f"monitor.{name}",
            )
            for name, scalar in binding.monitor.items()
        ]
        everything = [*observed, *monitored]
        outputs = sorted(range(len(everything)), key=lambda i: order[_KINDS[everything[i][1].kind]])
        place = {which: position for position, which in enumerate(outputs)}
        self._output_names = [everything[which][1].name for which in outputs]
        conversions = [
            conversion(unit, variable, self._description.units, where=where)
            for _, variable, unit, where in everything
        ]
        self._observation_count = len(observed)
        index = np.array([place[which] for which in range(len(observed))])
        self._observation_index = None if np.array_equal(index, np.arange(len(observed))) else index
        own = conversions[: len(observed)]
        self._observation_scale = (
            None
            if all(item == IDENTITY for item in own)
            else (np.array([item.factor for item in own]), np.array([item.offset for item in own]))
        )
        self._monitors = [
            (name, place[len(observed) + position], conversions[len(observed) + position])
            for position, (name, *_) in enumerate(monitored)
        ]

        def references(kind: str, variables: Sequence[VariableInfo]) -> list[int]:
            return [variable.reference for variable in variables if _KINDS[variable.kind] == kind]

        read = [everything[which][1] for which in outputs]
        return Plan(
            folder="",
            guid=self._description.guid,
            model_identifier=self._description.model_identifier,
            instance_name=binding.name,
            real_inputs=references("Real", self._ordered),
            integer_inputs=references("Integer", self._ordered),
            boolean_inputs=references("Boolean", self._ordered),
            real_outputs=references("Real", read),
            integer_outputs=references("Integer", read),
            boolean_outputs=references("Boolean", read),
        )

    def _make_slots(self, role: str, index: int) -> dict[str, _Slot]:
        slots = {}
        table: Mapping[str, Scalar] = getattr(self._binding, role)
        for name, scalar in table.items():
            label = f"{role}.{name}"
            causality = "parameter" if role == "parameter" else "input"
            variable = self._resolve(scalar.variable, label, causality)
            slots[name] = _Slot(
                index=index,
                low=-math.inf if variable.minimum is None else variable.minimum,
                high=math.inf if variable.maximum is None else variable.maximum,
                conversion=conversion(scalar.unit, variable, self._description.units, where=label),
                label=label,
                whole=variable.kind != "Real",
                variable=variable,
            )
        return slots

    def _resolve(self, name: str, label: str, causality: str) -> VariableInfo:
        variable = self._description.variable(name)
        if variable is None:
            near = difflib.get_close_matches(name, [v.name for v in self._description.variables], 1, 0.6)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise BindingError(
                f"{label} of the binding {self._binding.name} names {name!r}, which is not a variable of "
                f"{self._description.path}{hint}"
            )
        if variable.causality not in _CAUSALITY[causality]:
            raise BindingError(
                f"{label} of the binding {self._binding.name} needs an {causality}, but {name!r} is declared as "
                f"{variable.causality} in {self._description.path}."
            )
        if variable.kind not in _KINDS:
            raise BindingError(
                f"{label} of the binding {self._binding.name} names {name!r}, which is of type {variable.kind}; "
                "only numbers can be bound."
            )
        return variable

    def _start_values(self) -> list[float]:
        return [_start_value(variable) for variable in self._ordered]

    def _make_settings(self, parameters: Mapping[str, float]) -> Settings:
        slots = self._parameter_slots
        for name in parameters:
            if name not in slots:
                raise BindingError(
                    f"The binding {self._binding.name} has no parameter {name!r}; it has {', '.join(slots) or 'none'}."
                )
        fixed = {
            name: parameter.value
            for name, parameter in self._binding.parameter.items()
            if parameter.value is not None
        }
        return [
            (_KINDS[slots[name].variable.kind], slots[name].variable.reference, _checked(slots[name], value))
            for name, value in {**fixed, **parameters}.items()
        ]

    def _place(
        self,
        target: Any,
        control: Mapping[str, float] | None,
        health: Mapping[str, float] | None,
        load: Mapping[str, float] | None,
    ) -> bool:
        given = False
        for role, values in (("control", control), ("health", health), ("load", load)):
            if not values:
                continue
            given = True
            slots = self._slots[role]
            for name, value in values.items():
                slot = slots.get(name)
                if slot is None:
                    raise BindingError(
                        f"The binding {self._binding.name} has no {role} {name!r}; it has {', '.join(slots) or 'none'}."
                    )
                target[slot.index] = _checked(slot, value)
        return given

    def _observation(self, reply: Any) -> Observation:
        block = np.frombuffer(reply, dtype=np.float64)
        if not math.isfinite(block.sum()):
            self._refuse_not_finite(block)
        if self._observation_index is None:
            values = block[: self._observation_count].copy()
        else:
            values = block[self._observation_index]
        if self._observation_scale is not None:
            factor, offset = self._observation_scale
            values = (values - offset) / factor
        extra = {name: scale.from_fmu(reply[index]) for name, index, scale in self._monitors}
        return Observation(values, self._start_time + self._index * self._step_size, extra)

    def _refuse_not_finite(self, block: npt.NDArray[np.float64]) -> None:
        bad = np.flatnonzero(~np.isfinite(block[: len(self._output_names)]))
        if bad.size:
            first = int(bad[0])
            raise FmuOutputError(
                f"The FMU {self._description.path} gave {self._output_names[first]} = {block[first]} at "
                f"t = {self.time:g} s ({bad.size} of {len(self._output_names)} outputs are not finite).",
                [text for _, text in self.log[-5:]],
            )

    def _collect_log(self) -> None:
        instance = self._instance
        if instance is not None and instance.has_log and not instance.lost:
            for status, text in instance.take_log():
                name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
                self._log.append((name, text))

    def _told(self, error: FmuError, what: str) -> FmuError:
        """Return the error with the FMU's file and the moment, and keep its messages."""
        self._log.extend(("Error", message) for message in error.messages)
        if isinstance(error, FmuCallError | FmuWorkerError | TimeoutError):
            return type(error)(f"{self._description.path}, {what}: {error.sentence}", error.messages)
        return error


def describe_fmu(description: FmuDescription, roles: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return an FMU's description as plain records, with the role of each variable if known.

    Parameters
    ----------
    description : FmuDescription
        As `read_fmu` returns it.
    roles : mapping of str to str, optional
        Role by variable name.

    Returns
    -------
    dict
        Plain values, JSON-serialisable.
    """
    record = asdict(description)
    record["path"] = str(description.path)
    record["platforms"] = list(description.platforms)
    record["units"] = [asdict(unit) for unit in description.units]
    record["variables"] = [
        asdict(variable) | {"role": (roles or {}).get(variable.name, "")}
        for variable in description.variables
    ]
    return record


def _checked(slot: _Slot, value: float) -> float:
    """Return the value in the FMU's unit, refused if it is not finite, not whole or out of range."""
    try:
        number = slot.conversion.to_fmu(float(value))
    except (TypeError, ValueError) as error:
        raise FmuInputError(f"{slot.label} must be a number, but is {value!r}.") from error
    if slot.low <= number <= slot.high and not slot.whole and number - number == 0.0:
        return number
    if not math.isfinite(number):
        raise FmuInputError(f"{slot.label} must be finite, but is {value!r}; nothing was sent to the FMU.")
    if slot.whole and not number.is_integer():
        raise FmuInputError(
            f"{slot.label} must be a whole number, but is {value!r}; nothing was sent to the FMU."
        )
    # A conversion of units may round a value at the edge of the range to just outside of it.
    inside = min(max(number, slot.low), slot.high)
    if abs(inside - number) > 1e-12 * max(abs(inside), 1.0):
        unit = slot.variable.unit
        raise FmuInputError(
            f"{slot.label} = {value!r} lies outside the range of {slot.variable.name!r}, {slot.low:g} to "
            f"{slot.high:g}{'' if unit is None else ' ' + unit}; nothing was sent to the FMU."
        )
    return inside


def _start_value(variable: VariableInfo) -> float:
    text = (variable.start or "0").lower()
    return float({"true": "1", "false": "0"}.get(text, text))


def _unpack_state(content: bytes) -> tuple[dict[str, Any], bytes]:
    try:
        magic, length = _STATE_HEADER.unpack_from(content)
        if magic != _MAGIC:
            raise ValueError(magic)
        begin = _STATE_HEADER.size + length
        head = json.loads(content[_STATE_HEADER.size : begin])
        return dict(head), content[begin:]
    except (struct.error, ValueError, TypeError) as error:
        raise FmuStateError("What was given is not a state of an FMI asset, or it is damaged.") from error
