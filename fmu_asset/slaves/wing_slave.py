"""The wing as an FMI slave: its values, outputs that are computed when they are read, its state.

This file is copied into the FMU, as `behaviour`, where the physics is;
the names, units and ranges are in `variables`, and what all slaves do alike is in `base`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from .base import INITIALISING, INSTANTIATED, READY, REFUSED, TERMINATED, BaseSlave
from .behaviour import Moment, Response, UnacceptableEffectError, WingBehaviour, WingParameters
from .variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_INTERNAL,
    STATUS_OK,
    STATUS_OUTSIDE_RANGE,
)


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


class WingSlave(BaseSlave):
    """FMI co-simulation slave of the wing; the build joins it with pythonfmu's `Fmi2Slave`."""

    state_magic: ClassVar[bytes] = b"UAVWING1"

    _behaviour: WingBehaviour

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._reference = {row.name: row.reference for row in self._table}
        self._input_references = list(range(self._input_count))
        self._strain = self._reference["strain[1]"]
        self._tip = self._reference["tip_displacement"]
        self._bound = self._reference["strain_error_bound"]
        self._load_point = self._reference["load_point_displacement"]
        self._modal = self._load_point + 1
        # Rows of missing effects, at the end of the table: they can be set between steps.
        names = [row.name for row in self._table if row.variability == "tunable"]
        self._first_effect = self._reference[names[0]] if names else len(self._table)
        self._effects = {row.name: row.reference for row in self._table[self._first_effect :]}
        self._reading = _reading((), 0)
        # Outputs that are computed when somebody reads them, since most masters do not.
        self._stale_response = True
        self._stale_bound = True
        self._stale_modal = True

    # ------------------------------------------------------------------ life of an instance

    def _step(self, current_time: float, step_size: float) -> bool:
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
        return self._packed(body)

    def _set_fmu_state(self, state: object) -> None:
        """Restore what `_get_fmu_state` returned; anything else is refused."""
        try:
            body = self._unpacked(state)
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
