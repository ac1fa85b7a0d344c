"""The FMI slave of all FMUs that are packed here: phases, values, refusals, log and the bytes of a state.

What an FMU does is told by a table of variables and a behaviour. This file is copied into the FMUs: standard
library and relative imports only. Nothing here raises, because an exception that reaches the FMI wrapper of
pythonfmu is fatal to the instance: whatever cannot be done is logged, named by the output `status`, and
leaves the state and the outputs as they were.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from functools import partial, partialmethod
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from .variables import FmuVariable, Status

INSTANTIATED, INITIALISING, READY, REFUSED, TERMINATED = range(5)
"""Phases of an instance; REFUSED is an initialisation that was not accepted."""

_DISCARD, _ERROR = 2, 3
_MAGIC = b"UAVSLAV2"
_HEADER = struct.Struct("<8s16sI")
_WHY = {
    INSTANTIATED: "before initialisation",
    INITIALISING: "during initialisation",
    REFUSED: "after an initialisation that was refused",
    TERMINATED: "after termination",
}
_KINDS = {"Real": ("Real",), "Integer": ("Integer", "Enumeration"), "Boolean": ("Boolean",)}


class UnacceptableValuesError(ValueError):
    """The values lie in their ranges, but the asset cannot have them; one sentence with its full stop."""


class SlaveContents(NamedTuple):
    """What the FMU's resources hold.

    Attributes
    ----------
    table : tuple of FmuVariable
        Inputs, parameters and outputs, in this order; one output is `status`. Tunable parameters and further
        inputs may follow at its end: the behaviour is told of them by `tune(values by name, start time)`.
    make_behaviour : callable
        Makes afresh what the FMU does: `start(parameters by name, time [s], inputs)` and
        `advance(time, duration, inputs)` return the outputs, the first of the table in order, Booleans 0 or
        1; `state()` all that is remembered without the parameters, as floats; `restore(parameters, state)`
        takes it back. A call either completes or raises and leaves everything as it was.
    later : tuple of slice
        Outputs that are computed when somebody reads them, since most masters do not: groups of rows that
        follow one another, of which the behaviour's `later(number)` returns the values.
    """

    table: tuple[FmuVariable, ...]
    make_behaviour: Callable[[], Any]
    later: tuple[slice, ...] = ()


class LogMessage(NamedTuple):
    """What the FMI wrapper of pythonfmu reads from the log queue."""

    status: int
    category: str
    msg: str


class Slave:
    """FMI co-simulation slave; the build joins a subclass of it with pythonfmu's `Fmi2Slave`.

    Class attributes
    ----------------
    content_tag : str
        The content hash of the FMU; a state that was saved by another FMU is refused.
    load_contents : static method
        Takes the folder of resources and returns `SlaveContents`.
    """

    content_tag: ClassVar[str] = ""
    load_contents: ClassVar[staticmethod[[Path], SlaveContents]]

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
        self._input_count = next(
            n for n, causality in enumerate(causalities) if causality != "input"
        )
        self._first_output = causalities.index("output")
        self._end = len(causalities) - causalities[::-1].index("output")
        self._tuned = {row.name: row.reference for row in self._table[self._end :]}
        self._status = next(row.reference for row in self._table if row.name == "status")
        self._later = [(frozenset(range(part.start, part.stop)), part) for part in contents.later]
        self._pending = [True] * len(self._later)
        self._stale = True
        self._phase = INSTANTIATED
        self._time = self._start_time = 0.0

    # ------------------------------------------------------------------ life of an instance

    def setup_experiment(self, start_time: float = 0.0, *_: object) -> None:
        """Take the start time."""
        if math.isfinite(start_time):
            self._time = self._start_time = float(start_time)
        else:
            self._refuse(Status.NOT_FINITE, f"the start time is {start_time!r}; it must be finite")

    def enter_initialization_mode(self) -> None:
        """Begin initialisation."""
        if self._phase in (INSTANTIATED, REFUSED):
            self._phase = INITIALISING
        else:
            self._refuse(
                Status.BAD_CALL, "initialisation was entered a second time; reset the FMU first"
            )

    def exit_initialization_mode(self) -> None:
        """Check parameters and inputs, and find the initial state."""
        if self._phase != INITIALISING:
            self._refuse(Status.BAD_CALL, "initialisation was left without having been entered")
            return
        self._phase = READY if self._initialise() else REFUSED

    def terminate(self) -> None:
        """End the simulation; values can still be read."""
        self._phase = TERMINATED

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance by one communication step, the inputs held; False (fmi2Discard) means nothing changed."""
        step = partial(self._behaviour.advance, current_time, step_size)
        if not self._may_step(current_time, step_size):
            return False
        consequence = "the step was refused and the state is as it was"
        if not self._done(
            step, self._input_count, f"the step from t = {current_time:g} s", consequence
        ):
            return False
        self._time = current_time + step_size
        return True

    def _initialise(self) -> bool:
        begin = partial(self._behaviour.start, self._parameters(self._values), self._time)
        return self._done(
            begin, self._first_output, "the initialisation", "the initialisation was refused"
        )

    def _done(
        self, act: Callable[..., Sequence[float]], last: int, what: str, consequence: str
    ) -> bool:
        """Whether values were acceptable and something was done with the inputs, whose outputs are kept."""
        try:
            if not self._acceptable(last, consequence):
                return False
            outputs = act(self._values[: self._input_count])
        except UnacceptableValuesError as error:
            return self._refuse(
                Status.OUTSIDE_RANGE, f"{error} {consequence[:1].upper()}{consequence[1:]}"
            )
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(Status.INTERNAL, f"{what} failed: {error!r}")
        self._values[self._first_output : self._first_output + len(outputs)] = outputs
        self._values[self._status] = Status.OK
        self._stale = False
        self._pending = [True] * len(self._later)
        return True

    def _acceptable(self, last: int, consequence: str) -> bool:
        """Whether the first rows and those to be tuned lie in their ranges; the latter are handed on."""
        if not self._in_range(0, last, consequence):
            return False
        if self._tuned:
            if not self._in_range(self._end, len(self._values), consequence):
                return False
            values = {name: self._values[reference] for name, reference in self._tuned.items()}
            self._behaviour.tune(values, self._start_time)
        return True

    def _may_step(self, current_time: float, step_size: float) -> bool:
        if self._phase != READY:
            return self._refuse(Status.BAD_CALL, f"a step was asked for {_WHY[self._phase]}")
        if not (step_size > 0.0 and math.isfinite(step_size) and math.isfinite(current_time)):
            return self._refuse(
                Status.BAD_STEP,
                f"the step from t = {current_time!r} s over {step_size!r} s was refused: the communication "
                "point must be finite, the step size finite and positive",
            )
        if abs(current_time - self._time) > 1e-6 * step_size + 1e-9 * abs(self._time):
            return self._refuse(
                Status.BAD_STEP,
                f"the step from t = {current_time!r} s was refused: the FMU stands at t = {self._time!r} s",
            )
        return True

    def _parameters(self, values: Sequence[float]) -> dict[str, float]:
        return {
            row.name: values[row.reference] for row in self._table if row.causality == "parameter"
        }

    # ------------------------------------------------------------------ values

    def _set(self, kind: str, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set inputs and tunable parameters at any time, others before the end of initialisation."""
        for vr, value in zip(vrs, values, strict=True):
            row = self._table[vr] if 0 <= vr < len(self._table) else None
            if row is None or row.causality == "output" or row.kind not in _KINDS[kind]:
                name = "an unknown variable" if row is None else row.name
                self._refuse(
                    Status.BAD_CALL, f"{name} (value reference {vr}) cannot be set as {kind}"
                )
            elif row.variability == "fixed" and self._phase in (READY, TERMINATED):
                self._refuse(
                    Status.BAD_CALL,
                    f"{row.name} is a fixed parameter and can be set only before the first step",
                )
            else:
                self._values[vr] = float(value)
                self._stale = True

    set_real = partialmethod(_set, "Real")
    set_integer = partialmethod(_set, "Integer")  # enumerations, too
    set_boolean = partialmethod(_set, "Boolean")

    def get_real(self, vrs: Sequence[int]) -> list[float]:
        """Return values; some outputs are computed when they are asked for."""
        values = self._values
        if min(vrs, default=0) < 0 or max(vrs, default=0) >= len(values):
            unknown = next(vr for vr in vrs if not 0 <= vr < len(values))
            self._refuse(Status.BAD_CALL, f"there is no value reference {unknown}")
            return [math.nan] * len(vrs)
        if self._stale and self._phase == INITIALISING:
            self._initialise()
        if self._phase not in (INSTANTIATED, REFUSED):
            for number, (rows, part) in enumerate(self._later):
                if self._pending[number] and not rows.isdisjoint(vrs):
                    self._complete(number, part)
        return [values[vr] for vr in vrs]

    def _complete(self, number: int, part: slice) -> None:
        """Compute a group of outputs that is asked for and not known yet."""
        try:
            self._values[part] = self._behaviour.later(number)
            self._pending[number] = False
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(Status.INTERNAL, f"values could not be read: {error!r}")
            self._values[part] = [math.nan] * (part.stop - part.start)

    def get_integer(self, vrs: Sequence[int]) -> list[int]:
        """Return integers and enumerations."""
        return [int(value) if value - value == 0.0 else 0 for value in self.get_real(vrs)]

    def get_boolean(self, vrs: Sequence[int]) -> list[bool]:
        """Return Booleans."""
        return [value != 0.0 for value in self.get_real(vrs)]

    def set_string(self, vrs: Sequence[int], values: Sequence[str]) -> None:
        """Refuse: there are no String variables."""
        if vrs:
            self._refuse(Status.BAD_CALL, "the FMU has no String variables")

    def get_string(self, vrs: Sequence[int]) -> list[str]:
        """Refuse: there are no String variables."""
        self.set_string(vrs, ())
        return [""] * len(vrs)

    # ------------------------------------------------------------------ state

    def _get_fmu_state(self) -> bytes:
        """Return everything that the future depends on, and every value that can be read, as bytes."""
        flags = (self._stale, *self._pending)
        head = (float(self._phase), self._time, self._start_time, *map(float, flags))
        body = [*head, *map(float, self._values), *self._behaviour.state()]
        tag = self.content_tag.encode("ascii")[:16].ljust(16, b"\0")
        return _HEADER.pack(_MAGIC, tag, len(body)) + struct.pack(f"<{len(body)}d", *body)

    def _set_fmu_state(self, state: object) -> None:
        """Restore what `_get_fmu_state` returned; anything else is refused."""
        count, flags = len(self._values), 4 + len(self._later)
        try:
            body = self._unpacked(state)
            values = body[flags : flags + count]
            self._behaviour.restore(self._parameters(values), body[flags + count :])
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(Status.BAD_STATE, f"the FMU state was not restored: {error}")
            return
        self._phase, self._time, self._start_time = int(body[0]), body[1], body[2]
        self._stale, *self._pending = (flag != 0.0 for flag in body[3:flags])
        self._values[:] = values

    def _unpacked(self, state: object) -> tuple[float, ...]:
        """Return the numbers of a state; raises `ValueError` for one of another FMU or a damaged one."""
        if not isinstance(state, bytes) or len(state) < _HEADER.size:
            raise ValueError("it is not a state of this kind of FMU")
        magic, tag, count = _HEADER.unpack_from(state)
        if magic != _MAGIC or len(state) < _HEADER.size + 8 * count:
            raise ValueError("it is damaged or not a state of this kind of FMU")
        if tag.rstrip(b"\0").decode("ascii", "replace") != self.content_tag:
            raise ValueError("it was saved by an FMU with other content")
        return struct.unpack_from(f"<{count}d", state, _HEADER.size)

    # A state is bytes already.
    _fmu_state_to_bytes = _fmu_state_from_bytes = staticmethod(bytes)

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
                    Status.NOT_FINITE,
                    f"{row.name} is {value!r}, which is not finite; {consequence}",
                )
            return self._refuse(
                Status.OUTSIDE_RANGE,
                f"{row.name} = {value!r} lies outside its range {self._low[index]:g} to {self._high[index]:g}"
                f"{'' if row.unit in (None, '1') else f' {row.unit}'}; {consequence}",
            )
        return True

    def _refuse(self, status: int, sentence: str) -> bool:
        self._values[self._status] = status
        level = _DISCARD if self._phase == READY and status != Status.BAD_STATE else _ERROR
        category = "logStatusDiscard" if level == _DISCARD else "logStatusError"
        self.log_queue.append(LogMessage(level, category, sentence))
        return False
