"""The wing as an FMI slave: values, phases, refusals, log and serialised state.

This file is copied into the FMU: standard library and relative imports only. The physics is in
`behaviour`, the names, units and ranges are in `variables`. Nothing here raises, because an exception
that reaches the FMI wrapper of pythonfmu is fatal to the instance: whatever cannot be done is logged,
named by the output `status`, and leaves the state and the outputs as they were.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from .behaviour import Moment, Response, UnacceptableEffectError, WingBehaviour, WingParameters
from .variables import (
    INPUTS,
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
_MAGIC = b"UAVWING1"
_HEADER = struct.Struct("<8s16sI")


class LogMessage(NamedTuple):
    """What the FMI wrapper of pythonfmu reads from the log queue."""

    status: int
    category: str
    msg: str


class Contents(NamedTuple):
    """What the FMU's resources hold: the table of variables and how to make a fresh behaviour."""

    table: tuple[FmuVariable, ...]
    make_behaviour: Callable[[], WingBehaviour]


class _Reading(NamedTuple):
    """The references that were read last, their highest, and the slice that they are, if they are one."""

    references: list[int]
    highest: int
    part: slice | None


def _reading(vrs: Sequence[int], known: int) -> _Reading:
    references = list(vrs)
    unknown = [vr for vr in references if not 0 <= vr < known]
    if unknown:
        raise IndexError(f"there is no value reference {unknown[0]}")
    first, highest = min(references, default=0), max(references, default=0)
    contiguous = references == list(range(first, highest + 1))
    return _Reading(references, highest, slice(first, highest + 1) if contiguous else None)


class WingSlave:
    """FMI co-simulation slave of the wing; the build makes a subclass of it and of pythonfmu's `Fmi2Slave`.

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
        self._reference = {row.name: row.reference for row in self._table}
        self._low = [-math.inf if row.minimum is None else row.minimum for row in self._table]
        self._high = [math.inf if row.maximum is None else row.maximum for row in self._table]
        self._values = [0.0 if row.start is None else row.start for row in self._table]
        self._input_count = len(INPUTS)
        self._input_references = list(range(self._input_count))
        self._first_output = next(row.reference for row in self._table if row.causality == "output")
        self._strain = self._reference["strain[1]"]
        self._tip = self._reference["tip_displacement"]
        self._bound = self._reference["strain_error_bound"]
        self._status = self._reference["status"]
        self._load_point = self._reference["load_point_displacement"]
        self._modal = self._load_point + 1
        # Rows of missing effects, at the end of the table: they can be set between steps.
        names = [row.name for row in self._table if row.variability == "tunable"]
        self._first_effect = self._reference[names[0]] if names else len(self._table)
        self._effects = {row.name: row.reference for row in self._table[self._first_effect :]}
        self._reading = _reading((), 0)
        self._phase = INSTANTIATED
        self._time = self._start_time = 0.0
        # Outputs that are computed when somebody reads them, since most masters do not.
        self._stale_response = True
        self._stale_bound = True
        self._stale_modal = True

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
            return self._step(current_time, step_size)
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(STATUS_INTERNAL, f"the step from t = {current_time:g} s failed: {error!r}")
            return False

    def _step(self, current_time: float, step_size: float) -> bool:
        if self._phase != READY:
            why = {
                INSTANTIATED: "before initialisation",
                INITIALISING: "during initialisation",
                REFUSED: "after an initialisation that was refused",
                TERMINATED: "after termination",
            }[self._phase]
            return self._refuse(STATUS_BAD_CALL, f"a step was asked for {why}")
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
        consequence = "the step was refused and the state is as it was"
        if not self._in_range(0, self._input_count, consequence):
            return False
        moment = None
        if self._effects:
            if not self._in_range(self._first_effect, len(self._values), consequence):
                return False
            moment = self._moment(current_time + step_size)
        try:
            response = self._behaviour.advance(self._values[: self._input_count], step_size, moment)
        except UnacceptableEffectError as error:
            return self._refuse(STATUS_OUTSIDE_RANGE, f"{error} {consequence[:1].upper()}{consequence[1:]}")
        self._time = current_time + step_size
        self._accept(response)
        return True

    def _initialise(self) -> bool:
        consequence = "the initialisation was refused"
        if not self._in_range(0, self._first_output, consequence) or not self._in_range(
            self._first_effect, len(self._values), consequence
        ):
            return False
        try:
            moment = self._moment(self._time) if self._effects else None
            response = self._behaviour.start(self._parameters(), self._values[: self._input_count], moment)
        except UnacceptableEffectError as error:
            return self._refuse(STATUS_OUTSIDE_RANGE, f"{error} {consequence[:1].upper()}{consequence[1:]}")
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            return self._refuse(STATUS_INTERNAL, f"the initialisation failed: {error!r}")
        self._accept(response)
        return True

    def _moment(self, time: float) -> Moment:
        values = {name: self._values[reference] for name, reference in self._effects.items()}
        return Moment(time, self._start_time, values)

    def _parameters(self) -> WingParameters:
        value = {row.name: self._values[row.reference] for row in self._table if row.variability == "fixed"}
        return WingParameters(
            young_modulus_factor=value["young_modulus_factor"],
            damping_alpha=value["damping.alpha"],
            damping_beta=value["damping.beta"],
            servo_mass=value["mass.servo"],
            pitot_mass=value["mass.pitot"],
            initial_tip_displacement=value["initial_tip_displacement"],
            response=int(value["response"]),
        )

    def _accept(self, response: Response) -> None:
        values = self._values
        strain = response.strain.tolist()
        values[self._strain : self._strain + len(strain)] = strain
        values[self._tip] = response.tip_displacement
        values[self._status] = STATUS_OK
        self._stale_response = False
        self._stale_bound = True
        self._stale_modal = True

    # ------------------------------------------------------------------ values

    def set_real(self, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set inputs and tunable parameters at any time, others before the end of initialisation."""
        store = self._values
        free = self._input_count
        if vrs == self._input_references:  # all inputs in their order, as most masters send them
            store[:free] = values
        else:
            for vr, value in zip(vrs, values, strict=True):
                if 0 <= vr < free:
                    store[vr] = value
                else:
                    self._set_parameter(vr, value)
        self._stale_response = True

    def set_integer(self, vrs: Sequence[int], values: Sequence[int]) -> None:
        """Set the enumeration `response` before the end of initialisation, whole tunable ones at any time."""
        for vr, value in zip(vrs, values, strict=True):
            self._set_parameter(vr, value)
        self._stale_response = True

    def _set_parameter(self, vr: int, value: float) -> None:
        row = self._table[vr] if 0 <= vr < len(self._table) else None
        if row is None or row.causality == "output":
            name = "an unknown variable" if row is None else row.name
            self._refuse(STATUS_BAD_CALL, f"{name} (value reference {vr}) cannot be set")
        elif vr < self._first_effect and self._phase in (READY, TERMINATED):
            self._refuse(
                STATUS_BAD_CALL, f"{row.name} is a fixed parameter and can be set only before the first step"
            )
        else:
            self._values[vr] = float(value)

    def get_real(self, vrs: Sequence[int]) -> list[float]:
        """Return values; error bound, load point and modal outputs are computed when they are asked for."""
        try:
            if vrs != self._reading.references:
                self._reading = _reading(vrs, len(self._values))
            highest, part = self._reading.highest, self._reading.part
            if highest >= self._first_output:
                if self._stale_response and self._phase == INITIALISING:
                    self._initialise()
                if highest >= self._bound:
                    self._complete(vrs, highest)
            return self._values[part] if part else [self._values[vr] for vr in vrs]
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(STATUS_INTERNAL, f"values could not be read: {error!r}")
            return [math.nan] * len(vrs)

    def get_integer(self, vrs: Sequence[int]) -> list[int]:
        """Return the enumerations `response` and `status`."""
        known = len(self._values)
        return [int(self._values[vr]) if 0 <= vr < known else 0 for vr in vrs]

    def _complete(self, vrs: Sequence[int], highest: int) -> None:
        if self._phase in (INSTANTIATED, REFUSED):
            return
        if self._stale_bound and self._bound in vrs:
            self._values[self._bound] = self._behaviour.strain_error_bound()
            self._stale_bound = False
        if highest >= self._load_point and self._load_point in vrs:
            self._values[self._load_point] = self._behaviour.load_point_displacement()
        if self._stale_modal and highest >= self._modal:
            frequency, damping_ratio = self._behaviour.modal_data()
            self._values[self._modal : self._first_effect] = [*frequency, *damping_ratio]
            self._stale_modal = False

    def set_boolean(self, vrs: Sequence[int], values: Sequence[bool]) -> None:
        """Refuse: there are no Boolean variables."""
        if vrs:
            self._refuse(STATUS_BAD_CALL, "the FMU has no Boolean variables")

    def get_boolean(self, vrs: Sequence[int]) -> list[bool]:
        """Refuse: there are no Boolean variables."""
        self.set_boolean(vrs, ())
        return [False] * len(vrs)

    def set_string(self, vrs: Sequence[int], values: Sequence[str]) -> None:
        """Refuse: there are no String variables."""
        if vrs:
            self._refuse(STATUS_BAD_CALL, "the FMU has no String variables")

    def get_string(self, vrs: Sequence[int]) -> list[str]:
        """Refuse: there are no String variables."""
        self.set_string(vrs, ())
        return [""] * len(vrs)

    # ------------------------------------------------------------------ state

    def _get_fmu_state(self) -> bytes:
        """Return everything that the future depends on, and every value that can be read, as bytes."""
        body = [
            float(self._phase),
            self._time,
            self._start_time,
            float(self._stale_response),
            float(self._stale_bound),
            float(self._stale_modal),
            *map(float, self._values),
            *self._behaviour.state(),
        ]
        tag = self.content_tag.encode("ascii")[:16].ljust(16, b"\0")
        return _HEADER.pack(_MAGIC, tag, len(body)) + struct.pack(f"<{len(body)}d", *body)

    def _set_fmu_state(self, state: object) -> None:
        """Restore what `_get_fmu_state` returned; anything else is refused."""
        try:
            body = self._unpack(state)
            count = len(self._values)
            self._behaviour.restore(self._parameters_of(body[6 : 6 + count]), body[6 + count :])
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(STATUS_BAD_STATE, f"the FMU state was not restored: {error}")
            return
        self._phase = int(body[0])
        self._time, self._start_time = body[1:3]
        self._stale_response, self._stale_bound, self._stale_modal = (flag != 0.0 for flag in body[3:6])
        self._values[:] = body[6 : 6 + count]

    def _parameters_of(self, values: Sequence[float]) -> WingParameters:
        kept = self._values
        self._values = list(values)
        try:
            return self._parameters()
        finally:
            self._values = kept

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
        level = _DISCARD if self._phase == READY else _ERROR
        if status == STATUS_BAD_STATE:
            level = _ERROR
        category = "logStatusDiscard" if level == _DISCARD else "logStatusError"
        self.log_queue.append(LogMessage(level, category, sentence))
        return False

    def _get_log_queue(self) -> list[LogMessage]:
        return self.log_queue
