"""`patch.json`: the change of a model that an effect stands for, with posterior intervals and units."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

import numpy as np

from discrepancy.campaign import Campaign, Quantity
from discrepancy.document_file import (
    Origin,
    effects_of,
    number,
    origin_of,
    origin_rows,
    plain,
    read_document,
    write_document,
)
from discrepancy.errors import VerdictFileError
from discrepancy.file_models import PATCH_SCHEMA, PRIMITIVE_UNITS, PatchDocument
from discrepancy.verdict import NamedEffect, VerdictKind
from fe.patch import ModelPatch

PATCH_NAME = "patch.json"

_INTERVAL = (0.05, 0.95)
_STRAIN = re.compile(r"strain\[\d+\]")
_DISPLACEMENTS = ("tip_displacement", "load_point_displacement")


@dataclass(frozen=True)
class PrimitiveInterval:
    """90 % posterior interval of a parameter of the primitive `primitive` (index in the effect's patch).

    `low`, `high` are nan where the posterior was not drawn from; `unit` is that of the parameter.
    """

    primitive: int
    parameter: str
    value: float
    low: float
    high: float
    unit: str


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
    rows = []
    for place, effect in enumerate(effects):
        intervals = primitive_intervals(effect.patch, draws[place] if draws else ())
        rows.append(plain(effect) | {"intervals": [plain(item) for item in intervals]})
    content = {
        "schema": PATCH_SCHEMA,
        **origin_rows(origin),
        "verdict": verdict.value,
        "sentence": sentence,
        "effects": rows,
        "channels": dict(channels or {}),
    }
    return write_document(path, content, PatchDocument)


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
    content = read_document(path, PatchDocument, PATCH_SCHEMA)
    effects = effects_of(content["effects"], path)
    intervals = tuple(
        tuple(
            PrimitiveInterval(
                i["primitive"], i["parameter"], number(i["value"]), number(i["low"]), number(i["high"]),
                i["unit"],
            )
            for i in row["intervals"]
        )
        for row in content["effects"]
    )  # fmt: skip
    return StoredPatch(
        effects,
        intervals,
        origin_of(content),
        content.get("channels", {}),
        VerdictKind(content["verdict"]),
    )
