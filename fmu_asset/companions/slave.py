"""A small FMI slave that is told what it is by a table and a behaviour.

This file is copied into the FMU: standard library and relative imports only. What all slaves do alike is in
`base`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol

from ..slaves.base import INITIALISING, READY, TERMINATED, BaseSlave, Contents
from ..slaves.variables import STATUS_BAD_CALL, STATUS_BAD_STATE, STATUS_INTERNAL, STATUS_OK


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


def contents_of(companion: Any, resources: Path) -> Contents:
    """Return table and behaviour of a companion, a file of this folder, by the setting that was packed."""
    setting = json.loads((resources / "setting.json").read_text(encoding="utf-8"))
    return Contents(companion.variable_table(setting), lambda: companion.behaviour(setting))


class CompanionSlave(BaseSlave):
    """FMI co-simulation slave; the build makes a subclass of it and of pythonfmu's `Fmi2Slave`.

    `status` is the last variable of the table.
    """

    state_magic: ClassVar[bytes] = b"UAVUNIT1"

    _behaviour: Behaviour

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._stale = True

    def _step(self, current_time: float, step_size: float) -> bool:
        if not self._in_range(0, self._input_count, "the step was refused and the state is as it was"):
            return False
        outputs = self._behaviour.advance(current_time, step_size, self._values[: self._input_count])
        self._time = current_time + step_size
        self._accept(outputs)
        return True

    def _initialise(self) -> bool:
        if not self._in_range(0, self._first_output, "the initialisation was refused"):
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
        return self._packed(body)

    def _set_fmu_state(self, state: object) -> None:
        """Restore what `_get_fmu_state` returned; anything else is refused."""
        try:
            body = self._unpacked(state)
            values = body[3 : 3 + len(self._values)]
            self._behaviour.restore(self._parameters(values), body[3 + len(self._values) :])
        except Exception as error:  # noqa: BLE001 - an exception here is fatal to the instance
            self._refuse(STATUS_BAD_STATE, f"the FMU state was not restored: {error}")
            return
        self._phase, self._time, self._stale = int(body[0]), body[1], body[2] != 0.0
        self._values[:] = values
