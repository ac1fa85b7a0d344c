"""`verdict.json`: what was concluded, what it rests on, and the proof."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema

from discrepancy.campaign.records import Channel, Quantity
from discrepancy.document import PRIMITIVE_UNITS, Number, Origin, read_document, write_document
from discrepancy.errors import VerdictFileError
from discrepancy.files.residuals import RESIDUALS_NAME, read_residuals
from discrepancy.location.residuals import ResidualSet
from discrepancy.proof_record import Proof
from discrepancy.verdict import CalibratedParameter, NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch
from fmu_asset.packing.patch_file import FIRST_SCHEMA
from fmu_asset.packing.patch_file import SCHEMA as PATCH_SCHEMA
from reporting.folders import restore_folder
from reporting.words import brief

VERDICT_SCHEMA = "uav-twin verdict 5"
"""Value of the key `schema`; files of earlier numbers are read too."""
VERDICT_NAME = "verdict.json"
OLDER_SCHEMAS = tuple(f"uav-twin verdict {number}" for number in (1, 2, 3, 4))
"""They lack keys of this one, which have defaults, and shares of another definition, which are left
out."""
OLD_SHARE = (
    "The file is of an earlier version, whose share divided the error after by the doubt of the posterior "
    "too; run its command again."
)
"""Why the proof of an older file has no share."""


@dataclass(frozen=True)
class StoredVerdict:
    """Content of verdict.json."""

    verdict: Verdict
    proof: Proof | None
    origin: Origin

    def __repr__(self) -> str:
        return brief(self, verdict=self.verdict, model=self.origin.model, campaign=self.origin.campaign)


@dataclass(frozen=True, repr=False)
class VerdictFolder(StoredVerdict):
    """What `uav-twin discrepancy run` left: the content of `verdict.json`, and more.

    Attributes
    ----------
    patch : ModelPatch or None
        The effects that were found, identical to what was found; None without `patch.json`.
    residuals : ResidualSet or None
        Data minus model with the effects, in standard deviations of the noise; None where faults of the data
        stopped the work.
    """

    patch: ModelPatch | None
    residuals: ResidualSet | None


def write_verdict(path: Path, verdict: Verdict, proof: Proof | None, origin: Origin) -> Path:
    """Write verdict.json, whole or not at all; equal verdicts give equal bytes.

    Raises
    ------
    VerdictFileError
        If a record does not fit the schema.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return write_document(path, VERDICT_SCHEMA, StoredVerdict(verdict, proof, origin))


def read_verdict_file(path: Path) -> StoredVerdict:
    """Read the verdict.json that `write_verdict` wrote; the records are equal, nan included.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema, or holds something else than it should.
    """
    return read_document(path, VERDICT_SCHEMA, StoredVerdict, OLDER_SCHEMAS, _without_old_shares)


def _without_old_shares(content: dict[str, Any]) -> None:
    """Leave out of an older file what was told as a share or as chi-square by other definitions."""
    verdict, proof = content["verdict"], content["proof"]
    verdict.pop("explained", None)
    force = verdict.get("force") or {}
    for role in ("fitted", "held_out"):
        for name in ("value", "low", "high", "ahead"):
            (force.get(role) or {}).pop(name, None)
    if proof is None:
        return
    for name in ("gap_closed", "gap_reason"):
        proof.pop(name, None)
    for name in ("held_out_before", "held_out_after", "fitted_before", "fitted_after"):
        scores = proof[name]
        if scores is not None:
            scores.pop("chi_square_per_dof", None)
            scores |= {"chi_square_per_sample": None, "chi_square_deviation": None}
    proof |= {"closed": None, "closed_reason": OLD_SHARE}


def read_verdict(folder: Path | str) -> VerdictFolder:
    """Read the folder of a verdict.

    Parameters
    ----------
    folder : path
        As `uav-twin discrepancy run --out` leaves it.

    Raises
    ------
    VerdictFileError
        If a file is missing, damaged, of another schema, or holds something else than it should.
    """
    place = Path(folder)
    restore_folder(place)
    stored = read_verdict_file(place / VERDICT_NAME)
    patch, residuals = place / PATCH_NAME, place / RESIDUALS_NAME
    return VerdictFolder(
        **vars(stored),
        patch=read_patch(patch).patch if patch.is_file() else None,
        residuals=read_residuals(residuals) if residuals.is_file() else None,
    )


PATCHED = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART, VerdictKind.FAMILY, VerdictKind.GROUP)
"""Verdicts that leave a patch."""
APPLIED = (*PATCHED, VerdictKind.UNEXPLAINED)
"""What a patch may rest on; on an unexplained gap where its best hypothesis is applied."""
PATCH_NAME = "patch.json"

_INTERVAL = (0.05, 0.95)
_OUTPUTS = {
    Quantity.STRAIN: re.compile(r"strain\[\d+\]"),
    Quantity.DISPLACEMENT: re.compile("(tip|load_point)_displacement"),
}


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
    if kind not in APPLIED:
        raise ValueError(f"a patch rests on a name, a family, a group or a hypothesis, not on {kind.value!r}")
    return kind


@dataclass(frozen=True)
class StoredPatch:
    """Content of patch.json.

    Attributes
    ----------
    verdict : VerdictKind
        What the patch rests on; of a group it is one member, mostly the most probable, and of an unexplained
        gap the best hypothesis: these are no names.
    sentence : str
        The verdict in words.
    effects : tuple of PatchEffect
        In order.
    channels : mapping of str to str
        Outputs of the wing FMU by the names of channels.
    parameters : tuple of CalibratedParameter
        Of the model, beside these effects.
    origin : Origin
        What it was reached from.
    """

    verdict: Annotated[
        VerdictKind, AfterValidator(_patched), WithJsonSchema({"enum": [kind.value for kind in APPLIED]})
    ]
    sentence: str
    effects: tuple[PatchEffect, ...]
    channels: Mapping[str, str]
    parameters: tuple[CalibratedParameter, ...]
    origin: Origin

    @property
    def patch(self) -> ModelPatch:
        """The whole patch: that of all effects, in order."""
        return sum((effect.patch for effect in self.effects), ModelPatch())

    def upon(self, earlier: "StoredPatch | None") -> "StoredPatch":
        """Return this patch and the one that was built into its model, for the model that had neither."""
        if earlier is None:
            return self
        beneath = earlier.origin
        origin = replace(self.origin, model_file=beneath.model_file, model_hash=beneath.model_hash)
        effects, channels = earlier.effects + self.effects, {**earlier.channels, **self.channels}
        return replace(self, effects=effects, origin=origin, channels=channels)


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
    kinds, *others = (", ".join(item.kind for item in each) or "none" for each in (patch, *draws))
    for count, came in enumerate(others, start=1):
        if came != kinds:
            odd = f"Draw {count} of the posterior has the primitives {came}"
            raise VerdictFileError(f"{odd}, but the patch has {kinds}.")
    found = []
    for place, primitive in enumerate(patch):
        for name, unit in PRIMITIVE_UNITS[primitive.kind].items():
            values = [float(getattr(draw.primitives[place], name)) for draw in draws]
            low, high = np.quantile(values, _INTERVAL).tolist() if values else (nan, nan)
            found.append(PrimitiveInterval(place, name, float(getattr(primitive, name)), low, high, unit))
    return tuple(found)


def patch_effects(
    effects: Sequence[NamedEffect], draws: Sequence[Sequence[ModelPatch]] = ()
) -> tuple[PatchEffect, ...]:
    """Return effects with the intervals of their primitives.

    Parameters
    ----------
    effects : sequence of NamedEffect
        In order.
    draws : sequence of sequence of ModelPatch, optional
        For each effect, in order: its patch at draws of the posterior. Without, intervals are null.

    Raises
    ------
    VerdictFileError
        As `primitive_intervals`.
    """
    rows = zip(effects, draws or [()] * len(effects), strict=True)
    return tuple(
        PatchEffect(**vars(effect), intervals=primitive_intervals(effect.patch, own)) for effect, own in rows
    )


def write_patch(path: Path, stored: StoredPatch) -> Path:
    """Write patch.json, whole or not at all.

    Raises
    ------
    VerdictFileError, reporting.errors.FileNotWrittenError
        As `write_verdict`.
    """
    return write_document(path, PATCH_SCHEMA, stored)


def fmu_outputs(channels: Mapping[str, Channel]) -> dict[str, str]:
    """Return the outputs of the wing FMU by the names of the channels that measure them.

    Gauges count from 1 in campaigns, in patches and in the FMU alike, so that `strain[k]` of a channel is
    `strain[k]` of the FMU, whatever the channel is called. Channels that the FMU has no output for
    (velocities, displacements of other places) are not in the table.

    Parameters
    ----------
    channels : mapping of str to Channel
        By name.

    Returns
    -------
    dict of str to str
        Output by channel, such as "strain[17]" for "g17".
    """
    return {
        name: channel.output
        for name, channel in channels.items()
        if (known := _OUTPUTS.get(channel.quantity)) and known.fullmatch(channel.output)
    }


def read_patch(path: Path) -> StoredPatch:
    """Read the patch.json that `write_patch` wrote; the patch is identical to the last bit.

    Raises
    ------
    VerdictFileError
        As `read_verdict_file`.
    """
    return read_document(path, PATCH_SCHEMA, StoredPatch, (FIRST_SCHEMA,), parameters=[])
