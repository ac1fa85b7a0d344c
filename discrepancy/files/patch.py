"""`patch.json`: the change of a model that an effect stands for, with posterior intervals and units."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import nan
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema

from discrepancy.campaign.records import Campaign, Quantity
from discrepancy.document_types import PRIMITIVE_UNITS, Number
from discrepancy.errors import VerdictFileError
from discrepancy.files.document import Origin, read_document, write_document
from discrepancy.verdict import NamedEffect, VerdictKind
from fe.runtime.patch import ModelPatch
from fmu_asset.packing.patch_file import SCHEMA as PATCH_SCHEMA

PATCHED = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART, VerdictKind.FAMILY, VerdictKind.GROUP)
"""Verdicts that leave a patch."""
PATCH_NAME = "patch.json"

_INTERVAL = (0.05, 0.95)
_STRAIN = re.compile(r"strain\[\d+\]")
_DISPLACEMENTS = ("tip_displacement", "load_point_displacement")


@dataclass(frozen=True)
class PrimitiveInterval:
    """90 % posterior interval of a parameter of the primitive `primitive` (index in the effect's patch).

    `low`, `high` are nan where the posterior was not drawn from; `unit` is that of the parameter.
    """

    primitive: Annotated[int, Field(ge=0, description="Index in the effect's list `patch`.")]
    parameter: str
    value: Annotated[float, Field(allow_inf_nan=False)]
    low: Number
    high: Number
    unit: str


@dataclass(frozen=True)
class PatchEffect(NamedEffect):
    """An effect with the intervals of its primitives."""

    intervals: tuple[PrimitiveInterval, ...]


def _patched(kind: VerdictKind) -> VerdictKind:
    if kind not in PATCHED:
        raise ValueError(f"a patch rests on a name, a family or a group, and {kind.value!r} came")
    return kind


@dataclass(frozen=True)
class PatchDocument:
    """Content of patch.json after its origin.

    Attributes
    ----------
    verdict : VerdictKind
        What the patch rests on; of a group it is the most probable member, which is no name.
    sentence : str
        The verdict in words.
    effects : tuple of PatchEffect
        In order.
    channels : mapping of str to str
        Outputs of the wing FMU by the names of channels.
    """

    verdict: Annotated[
        VerdictKind, AfterValidator(_patched), WithJsonSchema({"enum": [kind.value for kind in PATCHED]})
    ]
    sentence: str
    effects: tuple[PatchEffect, ...]
    channels: Mapping[str, str]


@dataclass(frozen=True)
class StoredPatch:
    """Content of patch.json: effects, intervals of their primitives, origin, outputs by channel, verdict."""

    effects: tuple[NamedEffect, ...]
    intervals: tuple[tuple[PrimitiveInterval, ...], ...]
    origin: Origin
    channels: Mapping[str, str] = field(default_factory=dict)
    verdict: VerdictKind = VerdictKind.NAMED

    @property
    def patch(self) -> ModelPatch:
        """The whole patch: that of all effects, in order."""
        return sum((effect.patch for effect in self.effects), ModelPatch())


def primitive_intervals(patch: ModelPatch, draws: Sequence[ModelPatch] = ()) -> tuple[PrimitiveInterval, ...]:
    """Return the interval of each real parameter of a patch.

    Parameters
    ----------
    patch : ModelPatch
        At the posterior's centre.
    draws : sequence of ModelPatch
        Patches of the same effect at draws of its posterior; their quantiles 0.05 and 0.95 are taken.

    Raises
    ------
    VerdictFileError
        If a draw has other primitives than the patch.
    """
    kinds = [item.kind for item in patch]
    for count, draw in enumerate(draws, start=1):
        if [item.kind for item in draw] != kinds:
            raise VerdictFileError(
                f"Draw {count} of the posterior has the primitives "
                f"{', '.join(item.kind for item in draw) or 'none'}, but the patch has "
                f"{', '.join(kinds) or 'none'}."
            )
    found = []
    for place, primitive in enumerate(patch):
        for name, unit in PRIMITIVE_UNITS[primitive.kind].items():
            values = [float(getattr(draw.primitives[place], name)) for draw in draws]
            low, high = np.quantile(values, _INTERVAL).tolist() if values else (nan, nan)
            found.append(PrimitiveInterval(place, name, float(getattr(primitive, name)), low, high, unit))
    return tuple(found)


def write_patch(
    path: Path,
    effects: Sequence[NamedEffect],
    origin: Origin,
    draws: Sequence[Sequence[ModelPatch]] = (),
    channels: Mapping[str, str] | None = None,
    *,
    verdict: VerdictKind = VerdictKind.NAMED,
    sentence: str = "",
) -> Path:
    """Write patch.json, whole or not at all.

    Parameters
    ----------
    path : Path
        Destination.
    effects : sequence of NamedEffect
        What the patch stands for.
    origin : Origin
        What it was found from.
    draws : sequence of sequence of ModelPatch, optional
        For each effect, in order: its patch at draws of the posterior. Without, intervals are null.
    channels : mapping of str to str, optional
        Outputs of the wing FMU by the names of channels, as `fmu_outputs` returns them: by it the FMU knows
        what the patch's sensors are.
    verdict : VerdictKind
        On what the patch rests: a name, a family, or a group of which it is the most probable member.
    sentence : str
        The verdict in words.

    Raises
    ------
    VerdictFileError, reporting.errors.FileNotWrittenError
        As `write_verdict` and `primitive_intervals`.
    """
    if draws and len(draws) != len(effects):
        raise VerdictFileError(
            f"Draws are needed for each of {len(effects)} effects, or none, but came for {len(draws)}."
        )
    rows = tuple(
        PatchEffect(
            **_fields(effect),
            intervals=primitive_intervals(effect.patch, draws[place] if draws else ()),
        )
        for place, effect in enumerate(effects)
    )
    return write_document(
        path, PATCH_SCHEMA, origin, PatchDocument(verdict, sentence, rows, dict(channels or {}))
    )


def _fields(effect: NamedEffect) -> dict[str, Any]:
    return {item.name: getattr(effect, item.name) for item in fields(NamedEffect)}


def fmu_outputs(campaign: Campaign) -> dict[str, str]:
    """Return the outputs of the wing FMU by the names of the channels that measure them.

    Gauges count from 1 in campaigns, in patches and in the FMU alike, so that `strain[k]` of a channel is
    `strain[k]` of the FMU, whatever the channel is called. Channels that the FMU has no output for
    (velocities, displacements of other places) are not in the table.

    Parameters
    ----------
    campaign : Campaign
        Whose channels are asked for.

    Returns
    -------
    dict of str to str
        Output by channel, such as "strain[17]" for "g17".
    """
    outputs = {}
    for name, channel in campaign.channels.items():
        strain = channel.quantity is Quantity.STRAIN and _STRAIN.fullmatch(channel.output)
        displacement = channel.quantity is Quantity.DISPLACEMENT and channel.output in _DISPLACEMENTS
        if strain or displacement:
            outputs[name] = channel.output
    return outputs


def read_patch(path: Path) -> StoredPatch:
    """Read the patch.json that `write_patch` wrote; the patch is identical to the last bit.

    Raises
    ------
    VerdictFileError
        As `read_verdict`.
    """
    found, origin = read_document(path, PATCH_SCHEMA, PatchDocument)
    return StoredPatch(
        tuple(NamedEffect(**_fields(effect)) for effect in found.effects),
        tuple(effect.intervals for effect in found.effects),
        origin,
        found.channels,
        found.verdict,
    )
