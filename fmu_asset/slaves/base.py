"""What every FMI slave that is packed here does alike: phases, refusals, log and the bytes of a state.

This file is copied into the FMUs: standard library and relative imports only. Nothing here raises, because an
exception that reaches the FMI wrapper of pythonfmu is fatal to the instance: whatever cannot be done is
logged, named by the output `status`, and leaves the state and the outputs as they were.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from .variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_BAD_STEP,
    STATUS_INTERNAL,
    STATUS_NOT_FINITE,
    STATUS_OUTSIDE_RANGE,
    FmuVariable,
)

INSTANTIATED, INITIALISING, READY, REFUSED, TERMINATED = range(5)
"""Phases of an instance; REFUSED is an initialisation that was not accepted."""

_DISCARD, _ERROR = 2, 3
_HEADER = struct.Struct("<8s16sI")
_WHY = {
    INSTANTIATED: "before initialisation",
    INITIALISING: "during initialisation",
    REFUSED: "after an initialisation that was refused",
    TERMINATED: "after termination",
}


class Contents(NamedTuple):
    """What the FMU's resources hold: the table of variables and how to make a fresh behaviour."""

    table: tuple[FmuVariable, ...]
    make_behaviour: Callable[[], Any]


class LogMessage(NamedTuple):
    """What the FMI wrapper of pythonfmu reads from the log queue."""

    status: int
    category: str
    msg: str


class BaseSlave:
    """FMI co-simulation slave without physics; the build joins a subclass of it with pythonfmu's `Fmi2Slave`.

    The table begins with inputs, parameters and outputs, in this order; one output is `status`. A subclass
    says what initialisation and a step are, how values are set and read, and what a state holds.

    Class attributes
    ----------------
    content_tag : str
        The content hash of the FMU; a state that was saved by another FMU is refused.
    load_contents : static method
        Takes the folder of resources and returns `Contents`.
    state_magic : bytes
        Eight bytes that begin a state of this kind of FMU.
    """

    content_tag: ClassVar[str] = ""
    load_contents: ClassVar[staticmethod[[Path], Contents]]
    state_magic: ClassVar[bytes]

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
        # A table may end with rows of effects, which can be inputs too.
        self._input_count = next(n for n, causality in enumerate(causalities) if causality != "input")
        self._first_output = causalities.index("output")
        self._status = next(row.reference for row in self._table if row.name == "status")
        self._phase = INSTANTIATED
        self._time = self._start_time = 0.0

    # ------------------------------------------------------------------ life of an instance

    def setup_experiment(self, start_time: float = 0.0, *_: object) -> None:
        """Take the start time."""
        if math.isfinite(start_time):
            self._time = self._start_time = float(start_time)
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
            return self._may_step(current_time, step_size) and self._step(current_time, step_size)
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(STATUS_INTERNAL, f"the step from t = {current_time:g} s failed: {error!r}")

    def _initialise(self) -> bool:
        """Find the initial state; False, after a refusal, if there is none."""
        raise NotImplementedError

    def _step(self, current_time: float, step_size: float) -> bool:
        """Make a step that begins where the instance stands; False, after a refusal, if it is not made."""
        raise NotImplementedError

    def _may_step(self, current_time: float, step_size: float) -> bool:
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
        return True

    # ------------------------------------------------------------------ values

    def set_string(self, vrs: Sequence[int], values: Sequence[str]) -> None:
        """Refuse: there are no String variables."""
        if vrs:
            self._refuse(STATUS_BAD_CALL, "the FMU has no String variables")

    def get_string(self, vrs: Sequence[int]) -> list[str]:
        """Refuse: there are no String variables."""
        self.set_string(vrs, ())
        return [""] * len(vrs)

    # ------------------------------------------------------------------ state

    def _packed(self, body: Sequence[float]) -> bytes:
        """Return the numbers of a state as bytes, which name the FMU."""
        tag = self.content_tag.encode("ascii")[:16].ljust(16, b"\0")
        return _HEADER.pack(self.state_magic, tag, len(body)) + struct.pack(f"<{len(body)}d", *body)

    def _unpacked(self, state: object) -> tuple[float, ...]:
        """Return the numbers of a state; raises `ValueError` for one of another FMU or a damaged one."""
        if not isinstance(state, bytes) or len(state) < _HEADER.size:
            raise ValueError("it is not a state of this kind of FMU")
        magic, tag, count = _HEADER.unpack_from(state)
        if magic != self.state_magic or len(state) < _HEADER.size + 8 * count:
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

    def _in_range(self, first: int, last: int, consequence: str) -> bool:
        values = self._values
        for index in range(first, last):
            value = values[index]
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
