"""A small FMI slave that is told what it is by a table and a behaviour.

This file is copied into the FMU: standard library and relative imports only. Nothing here raises, because an
exception that reaches the FMI wrapper of pythonfmu is fatal to the instance: whatever cannot be done is
logged, named by the output `status`, and leaves the state and the outputs as they were.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

from ..variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_BAD_STEP,
    STATUS_INTERNAL,
    STATUS_NOT_FINITE,
    STATUS_OK,
    STATUS_OUTSIDE_RANGE,
    FmuVariable,
)

INSTANTIATED, INITIALISING, READY, REFUSED, TERMINATED = range(5)
"""Phases of an instance; REFUSED is an initialisation that was not accepted."""

_DISCARD, _ERROR = 2, 3
_MAGIC = b"UAVUNIT1"
_HEADER = struct.Struct("<8s16sI")
_WHY = {
    INSTANTIATED: "before initialisation",
    INITIALISING: "during initialisation",
    REFUSED: "after an initialisation that was refused",
    TERMINATED: "after termination",
}


class Behaviour(Protocol):
    """What a companion does; a call either completes or raises and leaves everything as it was.

    Outputs are those of the table without `status`, in order; Booleans are 0 or 1.
    """

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> list[float]:
        """Begin at a time [s] and return the outputs."""

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Advance by one step with the inputs held and return the outputs at its end."""

    def state(self) -> list[float]:
        """Return all that is remembered, without the parameters."""

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned."""


class Contents(NamedTuple):
    """What the FMU's resources hold: the table of variables and how to make a fresh behaviour."""

    table: tuple[FmuVariable, ...]
    make_behaviour: Callable[[], Behaviour]


class LogMessage(NamedTuple):
    """What the FMI wrapper of pythonfmu reads from the log queue."""

    status: int
    category: str
    msg: str


class CompanionSlave:
    """FMI co-simulation slave; the build makes a subclass of it and of pythonfmu's `Fmi2Slave`.

    The table holds inputs, then parameters, then outputs, of which `status` is the last.

    Class attributes
    ----------------
    content_tag : str
        The content hash of the FMU; a state that was saved by another FMU is refused.
    load_contents : callable
        Takes the folder of resources and returns `Contents`.
    """

    content_tag: ClassVar[str] = ""
    load_contents: ClassVar[Callable[[Path], Contents]]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.log_queue: list[LogMessage] = []
        resources = str(kwargs["resources"])
        contents = type(self).load_contents(Path(resources))
        # The wrapper puts the resources in front of sys.path for every instance and leaves them there.
        while resources in sys.path:
            sys.path.remove(resources)
        self._table = contents.table
        self._behaviour = contents.make_behaviour()
        self._low = [-math.inf if row.minimum is None else row.minimum for row in self._table]
        self._high = [math.inf if row.maximum is None else row.maximum for row in self._table]
        self._values = [0.0 if row.start is None else float(row.start) for row in self._table]
        causalities = [row.causality for row in self._table]
        self._input_count = causalities.count("input")
        self._first_output = len(causalities) - causalities.count("output")
        self._status = len(causalities) - 1
        self._phase = INSTANTIATED
        self._time = 0.0
        self._stale = True

    # ------------------------------------------------------------------ life of an instance

    def setup_experiment(self, start_time: float = 0.0, *_: object) -> None:
        """Take the start time."""
        if math.isfinite(start_time):
            self._time = float(start_time)
        else:
            self._refuse(STATUS_NOT_FINITE, f"the start time is {start_time!r}; it must be finite")

    def enter_initialization_mode(self) -> None:
        """Begin initialisation."""
        if self._phase in (INSTANTIATED, REFUSED):
            self._phase = INITIALISING
        else:
            self._refuse(STATUS_BAD_CALL, "initialisation was entered a second time; reset the FMU first")

    def exit_initialization_mode(self) -> None:
        """Check parameters and inputs, and find the initial state."""
        if self._phase != INITIALISING:
            self._refuse(STATUS_BAD_CALL, "initialisation was left without having been entered")
            return
        self._phase = READY if self._initialise() else REFUSED

    def terminate(self) -> None:
        """End the simulation; values can still be read."""
        self._phase = TERMINATED

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance by one communication step, the inputs held; False (fmi2Discard) means nothing changed."""
        try:
            return self._step(current_time, step_size)
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(STATUS_INTERNAL, f"the step from t = {current_time:g} s failed: {error!r}")

    def _step(self, current_time: float, step_size: float) -> bool:
        if self._phase != READY:
            return self._refuse(STATUS_BAD_CALL, f"a step was asked for {_WHY[self._phase]}")
        if not (step_size > 0.0 and math.isfinite(step_size) and math.isfinite(current_time)):
            return self._refuse(
                STATUS_BAD_STEP,
                f"the step from t = {current_time!r} s over {step_size!r} s was refused: the communication "
                "point must be finite, the step size finite and positive",
            )
        if abs(current_time - self._time) > 1e-6 * step_size + 1e-9 * abs(self._time):
            return self._refuse(
                STATUS_BAD_STEP,
                f"the step from t = {current_time!r} s was refused: the FMU stands at t = {self._time!r} s",
            )
        if not self._in_range(self._input_count, "the step was refused and the state is as it was"):
            return False
        outputs = self._behaviour.advance(current_time, step_size, self._values[: self._input_count])
        self._time = current_time + step_size
        self._accept(outputs)
        return True

    def _initialise(self) -> bool:
        if not self._in_range(self._first_output, "the initialisation was refused"):
            return False
        try:
            outputs = self._behaviour.start(
                self._parameters(self._values), self._time, self._values[: self._input_count]
            )
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(STATUS_INTERNAL, f"the initialisation failed: {error!r}")
        self._accept(outputs)
        return True

    def _parameters(self, values: Sequence[float]) -> dict[str, float]:
        return {row.name: values[row.reference] for row in self._table if row.causality == "parameter"}

    def _accept(self, outputs: Sequence[float]) -> None:
        self._values[self._first_output : self._status] = outputs
        self._values[self._status] = STATUS_OK
        self._stale = False

    # ------------------------------------------------------------------ values

    def set_real(self, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set inputs at any time and parameters before the end of initialisation."""
        self._set("Real", vrs, values)

    def set_integer(self, vrs: Sequence[int], values: Sequence[int]) -> None:
        """Set integers, as `set_real`."""
        self._set("Integer", vrs, values)

    def set_boolean(self, vrs: Sequence[int], values: Sequence[bool]) -> None:
        """Set Booleans, as `set_real`."""
        self._set("Boolean", vrs, values)

    def set_string(self, vrs: Sequence[int], values: Sequence[str]) -> None:
        """Refuse: there are no String variables."""
        if vrs:
            self._refuse(STATUS_BAD_CALL, "the FMU has no String variables")

    def _set(self, kind: str, vrs: Sequence[int], values: Sequence[float]) -> None:
        for vr, value in zip(vrs, values, strict=True):
            row = self._table[vr] if 0 <= vr < len(self._table) else None
            if row is None or row.causality == "output" or row.kind != kind:
                name = "an unknown variable" if row is None else row.name
                self._refuse(STATUS_BAD_CALL, f"{name} (value reference {vr}) cannot be set as {kind}")
            elif row.causality == "parameter" and self._phase in (READY, TERMINATED):
                self._refuse(
                    STATUS_BAD_CALL,
                    f"{row.name} is a fixed parameter and can be set only before the first step",
                )
            else:
                self._values[vr] = float(value)
                self._stale = True

    def get_real(self, vrs: Sequence[int]) -> list[float]:
        """Return real values."""
        return self._get(vrs)

    def get_integer(self, vrs: Sequence[int]) -> list[int]:
        """Return integers and enumerations."""
        return [int(value) if value - value == 0.0 else 0 for value in self._get(vrs)]

    def get_boolean(self, vrs: Sequence[int]) -> list[bool]:
        """Return Booleans."""
        return [value != 0.0 for value in self._get(vrs)]

    def get_string(self, vrs: Sequence[int]) -> list[str]:
        """Refuse: there are no String variables."""
        self.set_string(vrs, ())
        return [""] * len(vrs)

    def _get(self, vrs: Sequence[int]) -> list[float]:
        if self._stale and self._phase == INITIALISING:
            self._initialise()
        values = self._values
        try:
            return [values[vr] for vr in vrs]
        except IndexError:
            self._refuse(STATUS_BAD_CALL, f"there is no value reference {max(vrs)}")
            return [math.nan] * len(vrs)

    # ------------------------------------------------------------------ state

    def _get_fmu_state(self) -> bytes:
        """Return everything that the future depends on, and every value that can be read, as bytes."""
        body = [float(self._phase), self._time, float(self._stale), *self._values, *self._behaviour.state()]
        tag = self.content_tag.encode("ascii")[:16].ljust(16, b"\0")
        return _HEADER.pack(_MAGIC, tag, len(body)) + struct.pack(f"<{len(body)}d", *body)

    def _set_fmu_state(self, state: object) -> None:
        """Restore what `_get_fmu_state` returned; anything else is refused."""
        try:
            body = self._unpack(state)
            values = body[3 : 3 + len(self._values)]
            self._behaviour.restore(self._parameters(values), body[3 + len(self._values) :])
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(STATUS_BAD_STATE, f"the FMU state was not restored: {error}")
            return
        self._phase, self._time, self._stale = int(body[0]), body[1], body[2] != 0.0
        self._values[:] = values

    def _unpack(self, state: object) -> tuple[float, ...]:
        if not isinstance(state, bytes) or len(state) < _HEADER.size:
            raise ValueError("it is not a state of this kind of FMU")
        magic, tag, count = _HEADER.unpack_from(state)
        if magic != _MAGIC or len(state) < _HEADER.size + 8 * count:
            raise ValueError("it is damaged or not a state of this kind of FMU")
        if tag.rstrip(b"\0").decode("ascii", "replace") != self.content_tag:
            raise ValueError("it was saved by an FMU with other content")
        return struct.unpack_from(f"<{count}d", state, _HEADER.size)

    @staticmethod
    def _fmu_state_to_bytes(state: bytes) -> bytes:
        return state

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> bytes:
        return bytes(state)

    # ------------------------------------------------------------------ refusals

    def _in_range(self, count: int, consequence: str) -> bool:
        for index in range(count):
            value = self._values[index]
            if self._low[index] <= value <= self._high[index] and value - value == 0.0:
                continue
            row = self._table[index]
            if not math.isfinite(value):
                return self._refuse(
                    STATUS_NOT_FINITE, f"{row.name} is {value!r}, which is not finite; {consequence}"
                )
            return self._refuse(
                STATUS_OUTSIDE_RANGE,
                f"{row.name} = {value!r} lies outside its range {self._low[index]:g} to {self._high[index]:g}"
                f"{'' if row.unit in (None, '1') else f' {row.unit}'}; {consequence}",
            )
        return True

    def _refuse(self, status: int, sentence: str) -> bool:
        self._values[self._status] = status
        level = _DISCARD if self._phase == READY and status != STATUS_BAD_STATE else _ERROR
        category = "logStatusDiscard" if level == _DISCARD else "logStatusError"
        self.log_queue.append(LogMessage(level, category, sentence))
        return False

    def _get_log_queue(self) -> list[LogMessage]:
        return self.log_queue
