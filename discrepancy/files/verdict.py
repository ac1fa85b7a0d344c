"""`verdict.json`: what was concluded, what it rests on, and the proof."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema

from discrepancy.campaign.records import Channel, Quantity
from discrepancy.document import (
    Number,
    Origin,
    document_schema,
    read_document,
    write_document,
)
from discrepancy.errors import VerdictFileError
from discrepancy.files.residuals import RESIDUALS_NAME, read_residuals
from discrepancy.location.residuals import ResidualSet
from discrepancy.proof_record import Proof
from discrepancy.verdict import CalibratedParameter, NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch, Primitive
from fmu_asset.packing.patch_file import FIRST_SCHEMA
from fmu_asset.packing.patch_file import SCHEMA as PATCH_SCHEMA
from reporting.folders import restore_folder
from reporting.formats.schema import JsonSchema
from reporting.json_file import JsonObject
from reporting.words import brief

VERDICT_SCHEMA = "uav-twin verdict 5"
"""Value of the key `schema`; files of earlier numbers are read too."""
VERDICT_NAME = "verdict.json"
OLDER_SCHEMAS = tuple(f"uav-twin verdict {number}" for number in (1, 2, 3, 4))
"""Earlier schemas, which are read, too.

They lack keys of this one, which have defaults. Their fractions have another definition and are
left out."""
OLD_SHARE = (
    "The file is of an earlier version, which also divided the error with the effects by the "
    "uncertainty of the posterior; run its command again."
)
"""Why the proof of an older file has no share."""


@dataclass(frozen=True)
class StoredVerdict:
    """Content of `verdict.json`."""

    verdict: Verdict
    """What was concluded."""
    proof: Proof | None
    """Its proof on trials that were held out, if there are any."""
    origin: Origin
    """Model, campaign and program that it comes from."""

    def __repr__(self) -> str:
        return brief(
            self, verdict=self.verdict, model=self.origin.model, campaign=self.origin.campaign
        )

    def _repr_html_(self) -> str:
        """Return the verdict, for a notebook."""
        return self.verdict._repr_html_()


@dataclass(frozen=True, repr=False)
class VerdictFolder(StoredVerdict):
    """The folder that `uav-twin discrepancy run` leaves: the content of `verdict.json`, and more.

    Attributes
    ----------
    patch : ModelPatch or None
        The effects that were found, to the last bit; None without `patch.json`.
    residuals : ResidualSet or None
        Data minus model with the effects; None if faults of the data stopped the work.
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


def verdict_schema() -> JsonSchema:
    """Return the JSON Schema of `verdict.json`; a null number is not a number, or not known."""
    return document_schema(StoredVerdict, VERDICT_SCHEMA)


def patch_schema() -> JsonSchema:
    """Return the JSON Schema of `patch.json`; a null number is not a number, or not known."""
    return document_schema(StoredPatch, PATCH_SCHEMA)


def read_verdict_file(path: Path) -> StoredVerdict:
    """Read the `verdict.json` that `write_verdict` wrote; the records are equal, nan included.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema, or holds something else than it should.
    """
    return read_document(path, VERDICT_SCHEMA, StoredVerdict, OLDER_SCHEMAS, _drop_old_definitions)


def _drop_old_definitions(content: JsonObject) -> None:
    """Remove entries of an older file, in place, whose definition has changed since.

    They are the explained fractions and chi-squared. The proof then says why it has no fraction.
    """
    verdict = content["verdict"]
    proof = content["proof"]
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
            scores["chi_square_per_sample"] = None
            scores["chi_square_deviation"] = None
    proof["closed"] = None
    proof["closed_reason"] = OLD_SHARE


def read_verdict(folder: Path | str) -> VerdictFolder:
    """Read the folder of a verdict that `uav-twin discrepancy run --out` leaves.

    If the folder was being replaced when a run was interrupted, it is restored first.

    Raises
    ------
    VerdictFileError
        If a file is missing, damaged, of another schema, or holds something else than it should.
    """
    folder = Path(folder)
    restore_folder(folder)
    stored = read_verdict_file(folder / VERDICT_NAME)
    patch_file = folder / PATCH_NAME
    residuals_file = folder / RESIDUALS_NAME
    return VerdictFolder(
        verdict=stored.verdict,
        proof=stored.proof,
        origin=stored.origin,
        patch=read_patch(patch_file).patch if patch_file.is_file() else None,
        residuals=read_residuals(residuals_file) if residuals_file.is_file() else None,
    )


PATCHED = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART, VerdictKind.FAMILY, VerdictKind.GROUP)
"""Verdicts that leave a patch."""
APPLIED = (*PATCHED, VerdictKind.UNEXPLAINED)
"""Verdicts on which a patch may rest: on an unexplained one if its best hypothesis is applied."""
PATCH_NAME = "patch.json"

_INTERVAL = (0.05, 0.95)
_OUTPUTS = {
    Quantity.STRAIN: re.compile(r"strain\[\d+\]"),
    Quantity.DISPLACEMENT: re.compile("(tip|load_point)_displacement"),
}


@dataclass(frozen=True)
class PrimitiveInterval:
    """90 % posterior interval of one parameter of a primitive."""

    primitive: Annotated[int, Field(ge=0)]
    """Index of the primitive in the effect's patch."""
    parameter: str
    """Name of the parameter."""
    value: Annotated[float, Field(allow_inf_nan=False)]
    """Value in the patch [unit of the entry]."""
    low: Number
    """Lower end of the interval; nan if no draws of the posterior were taken [unit of the
    entry]."""
    high: Number
    """Upper end of the interval; nan if no draws of the posterior were taken [unit of the
    entry]."""
    unit: str
    """Unit of the parameter."""


@dataclass(frozen=True)
class PatchEffect(NamedEffect):
    """An effect with the intervals of its primitives."""

    intervals: tuple[PrimitiveInterval, ...]
    """90 % posterior intervals of the numbers of its primitives."""


def _checked_basis(kind: VerdictKind) -> VerdictKind:
    """Return a kind of verdict on which a patch may rest; raise ValueError for any other."""
    if kind not in APPLIED:
        raise ValueError(
            f"a patch rests on a name, a family, a group or a hypothesis, not on {kind.value!r}"
        )
    return kind


@dataclass(frozen=True)
class StoredPatch:
    """Content of patch.json."""

    verdict: Annotated[
        VerdictKind,
        AfterValidator(_checked_basis),
        WithJsonSchema({"enum": [kind.value for kind in APPLIED]}),
    ]
    """Verdict on which the patch rests. For a group the patch is one member, mostly the most
    probable, and for an unexplained gap the best hypothesis: these are not names."""
    sentence: str
    """The verdict in words."""
    effects: tuple[PatchEffect, ...]
    """The effects in order."""
    channels: Mapping[str, str]
    """Output of the model that a channel is, for each channel that a primitive names."""
    parameters: tuple[CalibratedParameter, ...]
    """Calibrated parameters of the model, fitted together with these effects."""
    origin: Origin
    """Model, campaign and program that it comes from."""

    @property
    def patch(self) -> ModelPatch:
        """The patches of all effects, in order, as one."""
        return sum((effect.patch for effect in self.effects), ModelPatch())

    def combine_with(self, earlier: "StoredPatch | None") -> "StoredPatch":
        """Return this patch combined with an earlier one that is already in its model.

        The result applies to the model without either patch, and its origin names this model. The
        verdict, the sentence and the parameters are those of this patch. Without an earlier patch
        the result is this one.
        """
        if earlier is None:
            return self
        origin = replace(
            self.origin,
            model_file=earlier.origin.model_file,
            model_hash=earlier.origin.model_hash,
        )
        return replace(
            self,
            effects=earlier.effects + self.effects,
            origin=origin,
            channels={**earlier.channels, **self.channels},
        )


def primitive_intervals(
    patch: ModelPatch, draws: Sequence[ModelPatch] = ()
) -> tuple[PrimitiveInterval, ...]:
    """Return the 90 % interval of each parameter of a patch's primitives.

    Parameters
    ----------
    patch : ModelPatch
        Patch at the centre of the posterior.
    draws : sequence of ModelPatch
        Patches of the same effect at draws of its posterior. The ends of an interval are their
        quantiles 0.05 and 0.95; nan without draws.

    Raises
    ------
    VerdictFileError
        If a draw has other primitives than the patch.
    """
    kinds = _kinds_text(patch)
    for number, draw in enumerate(draws, start=1):
        if _kinds_text(draw) != kinds:
            raise VerdictFileError(
                f"Draw {number} of the posterior has the primitives {_kinds_text(draw)}, but the "
                f"patch has {kinds}."
            )
    intervals = []
    for index, primitive in enumerate(patch):
        numbers_of_draws = [_numbers_of(draw.primitives[index]) for draw in draws]
        for parameter, (value, unit) in _numbers_of(primitive).items():
            low = high = nan
            if draws:
                values = [numbers[parameter][0] for numbers in numbers_of_draws]
                low, high = np.quantile(values, _INTERVAL).tolist()
            intervals.append(PrimitiveInterval(index, parameter, value, low, high, unit))
    return tuple(intervals)


def _numbers_of(primitive: Primitive) -> dict[str, tuple[float, str]]:
    """Return the real numbers of a primitive with their units, by name.

    Those of a table are called `forces[0]`, `forces[1]` and so on.
    """
    numbers: dict[str, tuple[float, str]] = {}
    for name, unit in primitive.units.items():
        value = getattr(primitive, name)
        if isinstance(value, tuple):
            for index, entry in enumerate(value):
                numbers[f"{name}[{index}]"] = (entry, unit)
        else:
            numbers[name] = (float(value), unit)
    return numbers


def _kinds_text(patch: ModelPatch) -> str:
    """Return the kinds of a patch's primitives in order, for a message; "none" if it is empty."""
    return ", ".join(primitive.kind for primitive in patch) or "none"


def patch_effects(
    effects: Sequence[NamedEffect], draws: Sequence[Sequence[ModelPatch]] = ()
) -> tuple[PatchEffect, ...]:
    """Return effects with the intervals of their primitives.

    Parameters
    ----------
    effects : sequence of NamedEffect
        The effects in order.
    draws : sequence of sequence of ModelPatch, optional
        Patches of each effect at draws of the posterior; without them intervals are null.

    Raises
    ------
    VerdictFileError
        If a draw has other primitives than the effect's patch.
    """
    draws_of_effects = draws or [()] * len(effects)
    with_intervals = []
    for effect, draws_of_effect in zip(effects, draws_of_effects, strict=True):
        intervals = primitive_intervals(effect.patch, draws_of_effect)
        with_intervals.append(PatchEffect(**vars(effect), intervals=intervals))
    return tuple(with_intervals)


def write_patch(path: Path, stored: StoredPatch) -> Path:
    """Write `patch.json`, completely or not at all.

    Raises
    ------
    VerdictFileError
        If a record does not fit the schema.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return write_document(path, PATCH_SCHEMA, stored)


def fmu_outputs(channels: Mapping[str, Channel]) -> dict[str, str]:
    """Return the outputs of the wing FMU that channels measure.

    Gauges count from 1 in campaigns, in patches and in the FMU, so that `strain[k]` of a channel is
    `strain[k]` of the FMU, whatever the name of the channel. Channels for which the FMU has no
    output (velocities, displacements of other points) are left out.

    Parameters
    ----------
    channels : mapping of str to Channel
        Channels by name.

    Returns
    -------
    dict of str to str
        Output by channel, such as "strain[17]" for "g17".
    """
    outputs = {}
    for name, channel in channels.items():
        pattern = _OUTPUTS.get(channel.quantity)
        if pattern is not None and pattern.fullmatch(channel.output):
            outputs[name] = channel.output
    return outputs


def read_patch(path: Path) -> StoredPatch:
    """Read the `patch.json` that `write_patch` wrote; the patch is identical to the last bit.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema, or holds something else than it should.
    """
    return read_document(path, PATCH_SCHEMA, StoredPatch, (FIRST_SCHEMA,), parameters=[])
