"""The FMI slave of all FMUs that are packed here: phases, values, refusals, log and saved states.

A table of variables and a behaviour say what an FMU does. This file is copied into the FMUs, so it
imports only the standard library and neighbouring files. No method raises an exception, because one
that reaches the FMI wrapper of pythonfmu is fatal to the instance. A call that cannot be executed
is logged and sets the output `status`; state and other outputs stay as they were.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from functools import partial, partialmethod
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from .contents import SlaveContents, UnacceptableValuesError
from .variables import Status

INSTANTIATED, INITIALISING, READY, REFUSED, TERMINATED = range(5)
"""Phases of an instance; REFUSED is an initialisation that was not accepted."""

_DISCARD, _ERROR = 2, 3
"""Statuses of FMI in log messages."""
_MAGIC = b"UAVSLAV2"
_STATE_HEADER = struct.Struct("<8s16sI")
"""Header of a saved state: magic, tag of the FMU's content, number of doubles."""
_TAG_LENGTH = 16
_PHASE_NAMES = {
    INSTANTIATED: "before initialisation",
    INITIALISING: "during initialisation",
    REFUSED: "after an initialisation that was refused",
    TERMINATED: "after termination",
}
_KINDS_OF_CALLS = {
    "Real": ("Real",),
    "Integer": ("Integer", "Enumeration"),
    "Boolean": ("Boolean",),
}
"""Kinds of variables that the calls of a base type may set."""


class LogMessage(NamedTuple):
    """A message as the FMI wrapper of pythonfmu reads it from the log queue."""

    status: int
    category: str
    msg: str


class Slave:
    """An FMI co-simulation slave; packing combines a subclass with pythonfmu's `Fmi2Slave`.

    Attributes
    ----------
    content_tag : str
        The content hash of the FMU; a state that another FMU has saved is refused.
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
        # The wrapper puts the resources in front of sys.path for every instance and leaves them.
        while resources in sys.path:
            sys.path.remove(resources)
        table = contents.table
        self._table = table
        self._behaviour = contents.make_behaviour()
        # values and ranges by value reference
        self._values = [0.0 if row.start is None else float(row.start) for row in table]
        self._low = [-math.inf if row.minimum is None else row.minimum for row in table]
        self._high = [math.inf if row.maximum is None else row.maximum for row in table]
        # sections of the table: inputs, parameters, outputs, tunable rows
        causalities = [row.causality for row in table]
        is_input = [causality == "input" for causality in causalities]
        self._input_count = is_input.index(False)
        self._first_output = causalities.index("output")
        self._end_of_outputs = len(causalities) - causalities[::-1].index("output")
        self._tunable = {row.name: row.reference for row in table[self._end_of_outputs :]}
        self._status = next(row.reference for row in table if row.name == "status")
        # groups of outputs that are computed when they are read
        self._groups = contents.later
        self._group_references = [
            frozenset(range(group.start, group.stop)) for group in contents.later
        ]
        self._pending = [True] * len(contents.later)
        # whether inputs or parameters have changed since the last outputs
        self._stale = True
        self._phase = INSTANTIATED
        self._time = 0.0
        self._start_time = 0.0

    # ------------------------------------------------------------------ life of an instance

    def setup_experiment(self, start_time: float = 0.0, *_: object) -> None:
        """Set the start time [s]."""
        if math.isfinite(start_time):
            self._time = float(start_time)
            self._start_time = float(start_time)
        else:
            self._refuse(Status.NOT_FINITE, f"the start time is {start_time!r}; it must be finite")

    def enter_initialization_mode(self) -> None:
        """Begin the initialisation."""
        if self._phase in (INSTANTIATED, REFUSED):
            self._phase = INITIALISING
        else:
            self._refuse(
                Status.BAD_CALL, "initialisation was entered a second time; reset the FMU first"
            )

    def exit_initialization_mode(self) -> None:
        """Check parameters and inputs, and compute the initial state."""
        if self._phase != INITIALISING:
            self._refuse(Status.BAD_CALL, "initialisation was left without having been entered")
            return
        self._phase = READY if self._initialise() else REFUSED

    def terminate(self) -> None:
        """End the simulation; values can still be read."""
        self._phase = TERMINATED

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance by one communication step, over which the inputs are constant.

        Parameters
        ----------
        current_time, step_size : float
            The begin and the duration of the step [s].

        Returns
        -------
        bool
            Whether the step was made. If not (fmi2Discard), only the output `status` has changed.
        """
        if not self._may_step(current_time, step_size):
            return False
        is_done = self._compute_outputs(
            partial(self._behaviour.advance, current_time, step_size),
            self._input_count,
            f"the step from t = {current_time:g} s",
            "the step was refused and the state is as it was",
        )
        if is_done:
            self._time = current_time + step_size
        return is_done

    def _initialise(self) -> bool:
        """Compute the outputs at the start; return whether the values were accepted."""
        return self._compute_outputs(
            partial(self._behaviour.start, self._parameters(self._values), self._time),
            self._first_output,
            "the initialisation",
            "the initialisation was refused",
        )

    def _compute_outputs(
        self,
        compute: Callable[[Sequence[float]], Sequence[float]],
        checked_rows: int,
        action: str,
        consequence: str,
    ) -> bool:
        """Compute the outputs for the present inputs, and store them; return whether this worked.

        The values of the first `checked_rows` rows must lie in their ranges. `action` and
        `consequence` say in messages what was tried and what a refusal means.
        """
        try:
            if not self._check_ranges(checked_rows, consequence):
                return False
            outputs = compute(self._values[: self._input_count])
        except UnacceptableValuesError as error:
            sentence = f"{consequence[:1].upper()}{consequence[1:]}"
            return self._refuse(Status.OUTSIDE_RANGE, f"{error} {sentence}")
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(Status.INTERNAL, f"{action} failed: {error!r}")
        self._values[self._first_output : self._first_output + len(outputs)] = outputs
        self._values[self._status] = Status.OK
        self._stale = False
        self._pending = [True] * len(self._pending)
        return True

    def _check_ranges(self, checked_rows: int, consequence: str) -> bool:
        """Return whether values lie in their ranges; pass tunable values to the behaviour."""
        if not self._check_rows(0, checked_rows, consequence):
            return False
        if self._tunable:
            if not self._check_rows(self._end_of_outputs, len(self._values), consequence):
                return False
            values = {name: self._values[number] for name, number in self._tunable.items()}
            self._behaviour.tune(values, self._start_time)
        return True

    def _may_step(self, current_time: float, step_size: float) -> bool:
        """Return whether a step is possible now; log the reason if it is not."""
        if self._phase != READY:
            phase = _PHASE_NAMES[self._phase]
            return self._refuse(Status.BAD_CALL, f"a step was requested {phase}")
        is_finite = math.isfinite(step_size) and math.isfinite(current_time)
        if not (step_size > 0.0 and is_finite):
            return self._refuse(
                Status.BAD_STEP,
                f"the step from t = {current_time!r} s over {step_size!r} s was refused: the "
                "communication point must be finite, the step size finite and positive",
            )
        # The master adds up its steps with rounding errors of its own.
        tolerance = 1e-6 * step_size + 1e-9 * abs(self._time)
        if abs(current_time - self._time) > tolerance:
            return self._refuse(
                Status.BAD_STEP,
                f"the step from t = {current_time!r} s was refused: the FMU stands at t = "
                f"{self._time!r} s",
            )
        return True

    def _parameters(self, values: Sequence[float]) -> dict[str, float]:
        """Return the parameters by name, given the values of all rows."""
        rows = [row for row in self._table if row.causality == "parameter"]
        return {row.name: values[row.reference] for row in rows}

    # ------------------------------------------------------------------ values

    def _set(self, kind: str, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set variables by their value references, in a call for a base type.

        Inputs and tunable parameters can be set at any time, other parameters until the
        initialisation has succeeded.
        """
        for vr, value in zip(vrs, values, strict=True):
            row = self._table[vr] if 0 <= vr < len(self._table) else None
            if row is None or row.causality == "output" or row.kind not in _KINDS_OF_CALLS[kind]:
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
        """Return values of variables; outputs that were not computed yet are computed now."""
        values = self._values
        if min(vrs, default=0) < 0 or max(vrs, default=0) >= len(values):
            unknown = next(vr for vr in vrs if not 0 <= vr < len(values))
            self._refuse(Status.BAD_CALL, f"there is no value reference {unknown}")
            return [math.nan] * len(vrs)
        if self._stale and self._phase == INITIALISING:
            self._initialise()
        if self._phase not in (INSTANTIATED, REFUSED):
            for number, references in enumerate(self._group_references):
                if self._pending[number] and not references.isdisjoint(vrs):
                    self._compute_group(number)
        return [values[vr] for vr in vrs]

    def _compute_group(self, number: int) -> None:
        """Compute and store a pending group of outputs."""
        group = self._groups[number]
        try:
            self._values[group] = self._behaviour.later(number)
            self._pending[number] = False
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(Status.INTERNAL, f"values could not be read: {error!r}")
            self._values[group] = [math.nan] * (group.stop - group.start)

    def get_integer(self, vrs: Sequence[int]) -> list[int]:
        """Return integers and enumerations."""
        return [int(value) if math.isfinite(value) else 0 for value in self.get_real(vrs)]

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
        """Return the state of the instance and all its values as bytes.

        The numbers are the phase, the time and the start time; flags of stale and pending outputs;
        the values of all rows; and the state of the behaviour.
        """
        flags = [float(flag) for flag in (self._stale, *self._pending)]
        leading_numbers = [float(self._phase), self._time, self._start_time, *flags]
        numbers = [*leading_numbers, *map(float, self._values), *self._behaviour.state()]
        tag = self.content_tag.encode("ascii")[:_TAG_LENGTH].ljust(_TAG_LENGTH, b"\0")
        header = _STATE_HEADER.pack(_MAGIC, tag, len(numbers))
        return header + struct.pack(f"<{len(numbers)}d", *numbers)

    def _set_fmu_state(self, state: object) -> None:
        """Restore a state that `_get_fmu_state` returned; refuse anything else."""
        flags_begin = 3
        values_begin = flags_begin + 1 + len(self._pending)
        values_end = values_begin + len(self._values)
        try:
            numbers = self._numbers_of_state(state)
            values = numbers[values_begin:values_end]
            self._behaviour.restore(self._parameters(values), numbers[values_end:])
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(Status.BAD_STATE, f"the FMU state was not restored: {error}")
            return
        phase, self._time, self._start_time = numbers[:flags_begin]
        self._phase = int(phase)
        self._stale, *self._pending = (flag != 0.0 for flag in numbers[flags_begin:values_begin])
        self._values[:] = values

    def _numbers_of_state(self, state: object) -> tuple[float, ...]:
        """Return the numbers in a saved state; raise `ValueError` if it is damaged or foreign."""
        if not isinstance(state, bytes) or len(state) < _STATE_HEADER.size:
            raise ValueError("it is not a state of this kind of FMU")
        magic, tag, count = _STATE_HEADER.unpack_from(state)
        if magic != _MAGIC or len(state) < _STATE_HEADER.size + 8 * count:
            raise ValueError("it is damaged or not a state of this kind of FMU")
        if tag.rstrip(b"\0").decode("ascii", "replace") != self.content_tag:
            raise ValueError("it was saved by an FMU with other content")
        return struct.unpack_from(f"<{count}d", state, _STATE_HEADER.size)

    # A state is bytes already.
    _fmu_state_to_bytes = _fmu_state_from_bytes = staticmethod(bytes)

    # ------------------------------------------------------------------ refusals

    def _check_rows(self, first: int, end: int, consequence: str) -> bool:
        """Return whether the values of the rows from `first` to before `end` are in their ranges.

        If a value is outside or not finite, the call is refused with a message that ends with
        `consequence`: what happens because of this.
        """
        values = self._values
        for index in range(first, end):
            value = values[index]
            if self._low[index] <= value <= self._high[index] and math.isfinite(value):
                continue
            row = self._table[index]
            if not math.isfinite(value):
                return self._refuse(
                    Status.NOT_FINITE,
                    f"{row.name} is {value!r}, which is not finite; {consequence}",
                )
            unit = "" if row.unit in (None, "1") else f" {row.unit}"
            return self._refuse(
                Status.OUTSIDE_RANGE,
                f"{row.name} = {value!r} lies outside its range {self._low[index]:g} to "
                f"{self._high[index]:g}{unit}; {consequence}",
            )
        return True

    def _refuse(self, status: int, sentence: str) -> bool:
        """Refuse a call: set the output `status`, log the reason, and return False."""
        self._values[self._status] = status
        is_discarded = self._phase == READY and status != Status.BAD_STATE
        if is_discarded:
            message = LogMessage(_DISCARD, "logStatusDiscard", sentence)
        else:
            message = LogMessage(_ERROR, "logStatusError", sentence)
        self.log_queue.append(message)
        return False
