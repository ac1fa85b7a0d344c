"""Patch files as an FMU takes them: effects with an id and primitives, channels named as outputs.

The file may hold more (posterior, data hash); what is read here, in the names of
`discrepancy.files.verdict` or in shorter ones, is

```json
{"schema": "uav-twin patch 2",
 "effects": [{"id": "gauge_zero_drift", "primitives": [{"kind": "sensor_drift", "channel": "g17", ...}]}],
 "channels": {"g17": "strain[17]"}}
```

where `id` may also be called `identifier`, and `primitives` `patch`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    EVERY_CHANNEL,
    SENSORS,
    Clock,
    HighPass,
    LoggerClock,
    ModelPatch,
    PortForce,
    Primitive,
    RunOffset,
)
from fe.runtime.sensors import check_channels
from fmu_asset.errors import PatchFileError, said
from fmu_asset.slaves.effects import output_channels
from reporting.json_file import parse_json, read_json

SCHEMA = "uav-twin patch 2"
"""Value of `schema` in a patch file; files of number 1 are read too."""
FIRST_SCHEMA = "uav-twin patch 1"

QUANTITIES = ("", "strain", "displacement")
"""Quantities of outputs that `channel = "*"` may be restricted to."""

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NO_MEANING = {
    Clock: "inputs and outputs of an FMU belong to the communication points of its master, so there is no "
    "second clock that could be wrong",
    LoggerClock: "what an FMU is given carries the time of its master, and nothing is logged",
    RunOffset: "an FMU has no runs between which its zero could have moved; a constant offset is a "
    "sensor_drift with exponent 0",
}


class Effect(NamedTuple):
    """One effect of a patch file: an identifier, and the changes that it stands for."""

    id: str
    patch: ModelPatch


@dataclass(frozen=True)
class PatchFile:
    """What an FMU takes of a patch file.

    Attributes
    ----------
    effects : tuple of Effect
        In the order of the file; an id that comes again has `_2`, `_3`, ... appended.
    channels : mapping of str to str
        Outputs by the names of channels.
    """

    effects: tuple[Effect, ...]
    channels: Mapping[str, str]

    @property
    def patch(self) -> ModelPatch:
        """All effects together."""
        return sum((effect.patch for effect in self.effects), ModelPatch())

    @property
    def of_structure(self) -> PatchFile:
        """The same without what changes what is read and not what happens."""
        rest = (Effect(name, patch.without(*SENSORS)) for name, patch in self.effects)
        return PatchFile(tuple(effect for effect in rest if len(effect.patch)), self.channels)

    @property
    def plain(self) -> list[dict[str, Any]]:
        """`id` and `primitives` of each effect, as `fmu_asset.slaves.effects` takes them."""
        return [{"id": name, "primitives": patch.to_list()} for name, patch in self.effects]

    def for_gauges(self, count: int, where: str = "The patch") -> PatchFile:
        """Return the same with channels replaced by the outputs that they are.

        Parameters
        ----------
        count : int
            Number of gauges of the wing.
        where : str
            What was read, for the error.

        Raises
        ------
        PatchFileError
            If a channel is no such output, or a primitive has no meaning in an FMU.
        """
        outputs, found = output_channels(count), []
        for name, patch in self.effects:
            label = f"{where}: the effect {name!r}"
            items = tuple(self._with_output(item, outputs, label) for item in patch)
            found.append(Effect(name, ModelPatch(items)))
        return PatchFile(tuple(found), {})

    def _with_output(self, item: Primitive, outputs: Sequence[tuple[str, str]], where: str) -> Primitive:
        label = f"{where} has the primitive {item.kind!r}"
        for kind, reason in _NO_MEANING.items():
            if isinstance(item, kind):
                raise PatchFileError(f"{label}, which has no meaning inside an FMU: {reason}.")
        if isinstance(item, HighPass) and item.order not in (1.0, 2.0, 3.0, 4.0):
            raise PatchFileError(said("patch.high_pass", label=label, item=item))
        channel, quantity = getattr(item, "channel", EVERY_CHANNEL), getattr(item, "quantity", "")
        if channel == EVERY_CHANNEL:
            if quantity not in QUANTITIES:
                raise PatchFileError(said("patch.every_channel", label=label, quantity=quantity))
            return item
        item = replace(item, channel=self.channels.get(channel, channel))  # type: ignore[call-arg]
        try:
            check_channels(ModelPatch((item,)), outputs)
        except InvalidPatchError as cause:
            why = said("patch.channel", label=label, channel=channel, known=_listed(outputs))
            raise PatchFileError(why) from cause
        return item


def _listed(outputs: Sequence[tuple[str, str]]) -> str:
    strains = [name for name, quantity in outputs if quantity == "strain"]
    others = [name for name, quantity in outputs if quantity != "strain"]
    return ", ".join([*([f"{strains[0]} to {strains[-1]}"] if strains else []), *others])


def load_patch(path: str | os.PathLike[str]) -> PatchFile:
    """Read a patch file.

    Raises
    ------
    PatchFileError
        If it cannot be read, is no patch file, or holds something that no patch can hold.
    """
    return _of_record(read_json(Path(path), PatchFileError, what="patch file"), f"The patch file {path}")


def parse_patch(content: bytes, where: str = "The patch file") -> PatchFile:
    """Return what the bytes of a patch file say; see `load_patch`."""
    return _of_record(parse_json(content, where, PatchFileError), where)


def _of_record(record: Any, where: str) -> PatchFile:
    if not isinstance(record, dict) or record.get("schema") not in (SCHEMA, FIRST_SCHEMA):
        came = record.get("schema") if isinstance(record, dict) else type(record).__name__
        raise PatchFileError(f'{where} must have "schema": "{SCHEMA}", but has {came!r}.')
    rows, channels = record.get("effects"), record.get("channels", {})
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise PatchFileError(f'{where} must have a list of tables "effects".')
    if not rows:
        raise PatchFileError(f"{where} names no effect, so there is nothing to add.")
    if not isinstance(channels, dict) or not all(isinstance(name, str) for name in channels.values()):
        raise PatchFileError(f'"channels" in {where[:1].lower() + where[1:]} must map names to outputs.')
    return PatchFile(_effects(rows, where), channels)


def _effects(rows: list[dict[str, Any]], where: str) -> tuple[Effect, ...]:
    effects: list[Effect] = []
    taken: set[str] = set()
    for number, row in enumerate(rows, start=1):
        name = row.get("id", row.get("identifier"))
        if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name):
            raise PatchFileError(said("patch.identifier", where=where, number=number, name=name))
        with PatchFileError.instead_of(InvalidPatchError):
            patch = ModelPatch.from_list(row.get("primitives", row.get("patch")), f"{where}, effect {name}")
            for item in patch:
                if item.windows or item.formula_fields:
                    raise PatchFileError(said("patch.windows", where=where, name=name, item=item))
                if isinstance(item, PortForce) and item.magnitude:
                    item.check()
        if not len(patch):
            raise PatchFileError(f"{where}: the effect {name!r} has no primitives.")
        unique, count = name, 1
        while unique in taken:
            count += 1
            unique = f"{name}_{count}"
        taken.add(unique)
        effects.append(Effect(unique, patch))
    return tuple(effects)
