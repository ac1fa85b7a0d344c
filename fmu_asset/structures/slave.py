"""A structure as an FMI slave: modal outputs are computed when they are read. Copied into the FMU."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from fe.runtime.reduced import ReducedModel

from ..companions.slave import CompanionSlave
from ..slaves.base import INSTANTIATED, REFUSED, Contents
from ..slaves.variables import STATUS_OK
from .behaviour import StructureBehaviour
from .table import structure_table


def load_contents(resources: Path) -> Contents:
    """Return table and behaviour of the structure that was packed."""
    model = ReducedModel.load(resources / "structure.npz")
    start = json.loads((resources / "start.json").read_text(encoding="utf-8"))
    return Contents(structure_table(model, start), lambda: StructureBehaviour(model))


class StructureSlave(CompanionSlave):
    """FMI co-simulation slave of a structure."""

    state_magic: ClassVar[bytes] = b"UAVSTRU1"

    _behaviour: StructureBehaviour

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._modal = next(row.reference for row in self._table if row.name == "frequency[1]")
        self._stale_modal = True

    def _accept(self, outputs: Sequence[float]) -> None:
        self._values[self._first_output : self._first_output + len(outputs)] = outputs
        self._values[self._status] = STATUS_OK
        self._stale = False
        self._stale_modal = True

    def _get(self, vrs: Sequence[int]) -> list[float]:
        found = super()._get(vrs)
        if (
            self._stale_modal
            and self._phase not in (INSTANTIATED, REFUSED)
            and any(self._modal <= vr < self._status for vr in vrs)
        ):
            self._values[self._modal : self._status] = self._behaviour.modal_data()
            self._stale_modal = False
            return super()._get(vrs)
        return found

    def set_integer(self, vrs: Sequence[int], values: Sequence[int]) -> None:
        """Set the enumeration `response`."""
        self._set("Enumeration", vrs, values)

    def _set_fmu_state(self, state: object) -> None:
        """Restore a saved state; modal outputs are computed anew when they are read."""
        super()._set_fmu_state(state)
        self._stale_modal = True
