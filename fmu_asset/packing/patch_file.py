"""Patch files: physical effects that a model lacks, to be added to an FMU.

An effect has an id and a list of primitives, which are elementary changes of the model or of a
sensor. A patch file may contain more, such as a posterior and a data hash. This module reads

```json {"schema": "uav-twin patch 2", "effects": [{"id": "gauge_zero_drift", "primitives":
[{"kind": "sensor_drift", "channel": "g17", ...}]}], "channels": {"g17": "strain[17]"}} ```

where `channels` maps each channel to an output of the FMU. The key `id` may also be called
`identifier`, and `primitives` may be called `patch`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import INSTALLED_LAWS
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
    SensorLag,
)
from fe.runtime.sensors import check_channels
from fmu_asset.errors import PatchFileError
from fmu_asset.slaves.effects import EffectRecord, output_channels
from reporting.json_file import parse_json, read_json
from reporting.words import small

SCHEMA = "uav-twin patch 2"
"""Value of `schema` in a patch file."""

FIRST_SCHEMA = "uav-twin patch 1"
"""Value of `schema` in files of earlier versions, which are read too."""

QUANTITIES = ("", "strain", "displacement")
"""Quantities of outputs that `channel = "*"` may be restricted to."""

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_HIGH_PASS_ORDERS = (1.0, 2.0, 3.0, 4.0)
_REASONS_WITHOUT_MEANING = {
    Clock: "inputs and outputs of an FMU belong to the communication points of its master, so "
    "there is no second clock that could be wrong",
    LoggerClock: "what an FMU is given carries the time of its master, and nothing is logged",
    SensorLag: "an output is read at its communication point, and none before is kept",
    RunOffset: "an FMU has no runs between which its zero could have moved; a constant offset is a "
    "sensor_drift with exponent 0",
}
"""The kinds of primitives that have no meaning in an FMU, each with the reason."""


class PatchFileEffect(NamedTuple):
    """An effect of a patch file: an identifier, and its changes of the model and the sensors."""

    id: str
    patch: ModelPatch


@dataclass(frozen=True)
class PatchFile:
    """The effects and channels that an FMU takes from a patch file.

    Attributes
    ----------
    effects : tuple of PatchFileEffect
        The effects in the order of the file. The later ones of a repeated id get `_2`, `_3`, ...
    channels : mapping of str to str
        The output of the FMU for each channel.
    """

    effects: tuple[PatchFileEffect, ...]
    channels: Mapping[str, str]

    @property
    def patch(self) -> ModelPatch:
        """The changes of all effects in one patch."""
        return sum((effect.patch for effect in self.effects), ModelPatch())

    @property
    def of_structure(self) -> PatchFile:
        """The effects on structure and loads, without the changes of sensors."""
        effects = []
        for effect in self.effects:
            structural_patch = effect.patch.without(*SENSORS)
            if len(structural_patch):
                effects.append(PatchFileEffect(effect.id, structural_patch))
        return PatchFile(tuple(effects), self.channels)

    @property
    def plain(self) -> list[EffectRecord]:
        """`id` and `primitives` of each effect, as `fmu_asset.slaves.effects` takes them."""
        return [{"id": effect.id, "primitives": effect.patch.to_list()} for effect in self.effects]

    def for_gauges(self, gauge_count: int, patch_label: str = "The patch") -> PatchFile:
        """Replace each channel in the patch by the output of the FMU that it measures.

        Parameters
        ----------
        patch_label : str
            The name of the patch in messages.

        Raises
        ------
        PatchFileError
            If a channel is not an output of the FMU, or a primitive has no meaning in an FMU.
        """
        outputs = output_channels(gauge_count)
        effects = []
        for effect in self.effects:
            effect_label = f"{patch_label}: the effect {effect.id!r}"
            primitives = []
            for primitive in effect.patch:
                primitives.append(self._with_output(primitive, outputs, effect_label))
            effects.append(PatchFileEffect(effect.id, ModelPatch(tuple(primitives))))
        return PatchFile(tuple(effects), {})

    def _with_output(
        self, primitive: Primitive, outputs: Sequence[tuple[str, str]], effect_label: str
    ) -> Primitive:
        """Replace the channel of a primitive by the name of an FMU output.

        `self.channels` maps the channels of a measurement to outputs; `outputs` are the outputs of
        the FMU, by name and quantity. A primitive that acts on every channel stays as it is. A
        `PatchFileError` is raised if there is no such output, if the primitive cannot act on its
        quantity, or if an FMU does not simulate what it changes.
        """
        label = f"{effect_label} has the primitive {primitive.kind!r}"
        _check_meaning_in_fmu(primitive, label)
        channel = getattr(primitive, "channel", EVERY_CHANNEL)
        quantity = getattr(primitive, "quantity", "")
        if channel == EVERY_CHANNEL:
            if quantity not in QUANTITIES:
                raise PatchFileError(
                    f"{label} for every channel of {quantity!r}; the outputs of the FMU are "
                    "strains and displacements."
                )
            return primitive
        # A channel that is not in the map has the name of an output.
        output = self.channels.get(channel, channel)
        primitive = replace(primitive, channel=output)  # type: ignore[call-arg]
        try:
            # The check takes a whole patch, so the primitive is put into one of its own.
            check_channels(ModelPatch((primitive,)), outputs)
        except InvalidPatchError as error:
            raise PatchFileError(
                f"{label} for the channel {channel!r}, which is not an output of the FMU that it "
                f"can act on ({_listed_outputs(outputs)}); name an output, or map the channel to "
                "one in `channels`."
            ) from error
        return primitive


def _check_meaning_in_fmu(primitive: Primitive, label: str) -> None:
    """Raise an error if a primitive has no meaning in an FMU, or an FMU cannot evaluate it."""
    for kind, reason in _REASONS_WITHOUT_MEANING.items():
        if isinstance(primitive, kind):
            raise PatchFileError(f"{label}, which has no meaning inside an FMU: {reason}.")
    if isinstance(primitive, HighPass) and primitive.order not in _HIGH_PASS_ORDERS:
        raise PatchFileError(
            f"{label} of order {primitive.order:g}; an FMU remembers whole stages only, order 1 to "
            "4."
        )


def _listed_outputs(outputs: Sequence[tuple[str, str]]) -> str:
    """Return the names of outputs for a message, with the gauges abbreviated to a range."""
    gauges = [name for name, quantity in outputs if quantity == "strain"]
    names = [f"{gauges[0]} to {gauges[-1]}"] if gauges else []
    names += [name for name, quantity in outputs if quantity != "strain"]
    return ", ".join(names)


def load_patch(path: str | os.PathLike[str]) -> PatchFile:
    """Read a patch file.

    Raises
    ------
    PatchFileError
        If the file cannot be read, is not a patch file, or has no valid effect.
    """
    record = read_json(Path(path), PatchFileError, what="patch file")
    return _patch_of_record(record, f"The patch file {path}")


def parse_patch(content: bytes, file_label: str = "The patch file") -> PatchFile:
    """Return the patch in the bytes of a patch file; see `load_patch`."""
    return _patch_of_record(parse_json(content, file_label, PatchFileError), file_label)


def _patch_of_record(record: object, file_label: str) -> PatchFile:
    """Check the parsed JSON of a patch file, and return the patch that it contains."""
    schema = record.get("schema") if isinstance(record, dict) else type(record).__name__
    if not isinstance(record, dict) or schema not in (SCHEMA, FIRST_SCHEMA):
        raise PatchFileError(f'{file_label} must have "schema": "{SCHEMA}", but has {schema!r}.')
    rows = record.get("effects")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise PatchFileError(f'{file_label} must have a list of tables "effects".')
    if not rows:
        raise PatchFileError(f"{file_label} names no effect, so there is nothing to add.")
    channels = record.get("channels", {})
    is_mapping = isinstance(channels, dict)
    if not is_mapping or not all(isinstance(output, str) for output in channels.values()):
        raise PatchFileError(f'"channels" in {small(file_label)} must map names to outputs.')
    return PatchFile(_read_effects(rows, file_label), channels)


def _read_effects(
    rows: Sequence[Mapping[str, object]], file_label: str
) -> tuple[PatchFileEffect, ...]:
    """Return the effects of a patch file, with unique ids: a repeated id gets `_2`, `_3`, ..."""
    effects: list[PatchFileEffect] = []
    taken_ids: set[str] = set()
    for number, row in enumerate(rows, start=1):
        effect = _read_effect(row, number, file_label)
        unique_id = effect.id
        occurrence = 1
        while unique_id in taken_ids:
            occurrence += 1
            unique_id = f"{effect.id}_{occurrence}"
        taken_ids.add(unique_id)
        effects.append(PatchFileEffect(unique_id, effect.patch))
    return tuple(effects)


def _read_effect(row: Mapping[str, object], number: int, file_label: str) -> PatchFileEffect:
    """Return an effect from its table in the JSON file, with the id that the file states.

    `number` counts the effects from 1, for messages. A `PatchFileError` is raised if the effect has
    no id or no primitives, or if an FMU cannot contain one of them.
    """
    effect_id = row.get("id", row.get("identifier"))
    if not isinstance(effect_id, str) or not _IDENTIFIER.fullmatch(effect_id):
        raise PatchFileError(
            f'{file_label}: the "id" of effect {number} must be letters, digits and underscores, '
            f"but is {effect_id!r}."
        )
    primitives = row.get("primitives", row.get("patch"))
    with PatchFileError.instead_of(InvalidPatchError):
        patch = ModelPatch.from_list(primitives, f"{file_label}, effect {effect_id}")
        for primitive in patch:
            if primitive.windows or primitive.formula_fields:
                raise PatchFileError(
                    f"{file_label}: the effect {effect_id!r} is bound to the time of trials "
                    f"({primitive.kind}), which means nothing in an FMU: leave it out."
                )
            if isinstance(primitive, INSTALLED_LAWS):
                raise PatchFileError(
                    f"{file_label}: the effect {effect_id!r} has the law {primitive.kind!r} of an "
                    "installed package, but an FMU has the laws of uav-twin only: leave it out, or "
                    "add the law to fe/runtime/laws."
                )
            if isinstance(primitive, PortForce) and primitive.magnitude:
                primitive.check()
    if not len(patch):
        raise PatchFileError(f"{file_label}: the effect {effect_id!r} has no primitives.")
    return PatchFileEffect(effect_id, patch)
