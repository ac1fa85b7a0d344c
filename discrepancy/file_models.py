"""Shape of `verdict.json` and `patch.json`: the models that check them and that make their JSON Schemas.

Keys are described in docs/verdict.md. A number that is not a number is null, an infinite one "Infinity" or
"-Infinity", because JSON has neither.
"""

from __future__ import annotations

import json
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, create_model

from discrepancy.verdict import VerdictKind
from fe.patch import PRIMITIVES, Primitive

VERDICT_SCHEMA = "uav-twin verdict 1"
"""Value of the key `schema` of verdict.json."""

PATCH_SCHEMA = "uav-twin patch 1"
"""Value of the key `schema` of patch.json."""

CHANNEL_UNIT = "channel's unit"

PRIMITIVE_UNITS: dict[str, dict[str, str]] = {
    "point_mass": {"mass": "kg", "station": "m"},
    "root_compliance": {"compliance": "rad/(N m)"},
    "local_stiffness_loss": {"loss": "1", "start": "m", "length": "m"},
    "modulus_temperature": {"coefficient": "1/K"},
    "stiffness_drift": {"rate": "1/s"},
    "power_damping": {
        "coefficient": "N or N m", "velocity_exponent": "1", "displacement_exponent": "1",
        "reference_velocity": "m/s or rad/s", "reference_displacement": "m or rad",
    },
    "power_stiffness": {
        "coefficient": "N or N m", "exponent": "1", "reference_displacement": "m or rad",
    },
    "free_play": {"stiffness": "N/m or N m/rad", "half_width": "m or rad"},
    "micro_slip": {"slip_force": "N or N m", "stiffness": "N/m or N m/rad", "chi": "1"},
    "bouc_wen": {"stiffness": "N/m or N m/rad", "yield_displacement": "m or rad", "order": "1"},
    "load_place": {"along_span": "m", "along_chord": "m"},
    "load_gain": {"gain": "1", "tare": "N"},
    "washout": {"coefficient": "1", "exponent": "1"},
    "inertia_relief": {"fraction": "1"},
    "sensor_gain": {"gain": "1"},
    "sensor_drift": {"amplitude": CHANNEL_UNIT, "time": "s", "exponent": "1"},
    "sensor_rotation": {"angle": "rad"},
    "thermal_strain": {"coefficient": "1/K"},
    "high_pass": {"time_constant": "s", "order": "1"},
    "clock": {"rate": "1", "zero": "s"},
    "line": {"frequency": "Hz", "cosine": CHANNEL_UNIT, "sine": CHANNEL_UNIT},
    "decaying_line": {
        "frequency": "Hz", "damping_ratio": "1",
        "cosine": f"{CHANNEL_UNIT} per release amplitude", "sine": f"{CHANNEL_UNIT} per release amplitude",
    },
    "run_offset": {"offset": CHANNEL_UNIT},
}  # fmt: skip
"""Unit of every real parameter of every primitive (translational or rotational port: the first or second)."""

Number = Annotated[
    FiniteFloat | Literal["Infinity", "-Infinity"] | None,
    Field(description="null: not a number, or not known."),
]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def _primitive_model(primitive: type[Primitive]) -> type[BaseModel]:
    """Return the model of one kind of primitive, from its own fields."""
    units = PRIMITIVE_UNITS.get(primitive.kind, {})
    columns: dict[str, Any] = {"kind": (Literal[primitive.kind], Field())}
    for item in fields(primitive):
        value = FiniteFloat if item.type is float else item.type
        unit = f"[{units[item.name]}]" if item.name in units else None
        columns[item.name] = (value, Field(description=unit))
    return create_model(
        primitive.__name__, __base__=_Record, __doc__=(primitive.__doc__ or "").split("\n")[0], **columns
    )


if TYPE_CHECKING:
    PrimitiveModel = BaseModel
else:
    PrimitiveModel = Annotated[
        Union[tuple(_primitive_model(primitive) for primitive in PRIMITIVES.values())],  # noqa: UP007
        Field(discriminator="kind"),
    ]


class EstimateModel(_Record):
    """A number with its 90 % interval (posterior median, quantiles 0.05 and 0.95)."""

    name: str
    value: Number
    low: Number
    high: Number
    unit: str
    description: str


class EffectModel(_Record):
    """An effect, its place, its parameters and the primitives that it stands for."""

    identifier: str
    name: str
    place: str
    family: str
    parameters: list[EstimateModel]
    shape: list[EstimateModel]
    patch: list[PrimitiveModel]


class HypothesisModel(_Record):
    """A hypothesis that was compared; no effect is 'none'."""

    effects: list[EffectModel]
    log_evidence: Number
    probability: Number
    chi_square: Number
    degrees_of_freedom: Number


class GateModel(_Record):
    """Outcome of a gate; `passed` null: it could not be applied."""

    name: str
    passed: bool | None
    statistic: Number
    limit: Number
    reason: str


class ExperimentModel(_Record):
    """A proposed next experiment."""

    description: str
    information: Number
    cost: Number
    reason: str


class VerdictModel(_Record):
    """The conclusion."""

    kind: Literal[tuple(kind.value for kind in VerdictKind)]  # type: ignore[valid-type]
    sentence: str
    probability: Number
    log_bayes_factor: Number
    effects: list[EffectModel]
    group: list[str]
    family: str
    gates: list[GateModel]
    hypotheses: list[HypothesisModel]
    inclusion: dict[str, Number]
    next_experiments: list[ExperimentModel]
    remarks: list[str]
    resembles: list[str]


class ScoresModel(_Record):
    """Scores on a set of trials."""

    rms: dict[str, Number]
    chi_square_per_dof: Number
    log_score: Number
    coverage_50: Number
    coverage_90: Number
    whiteness: Number
    sample_count: int
    chi_square_deviation: Number
    pit: list[Number]
    pit_p_value: Number


class ProofModel(_Record):
    """Scores before and after."""

    held_out_before: ScoresModel | None
    held_out_after: ScoresModel | None
    fitted_before: ScoresModel
    fitted_after: ScoresModel
    gap_closed: Number
    log_score_gain: Number
    log_score_gain_error: Number
    remaining: str
    gap_reason: str


class ProvenanceModel(_Record):
    """What is needed to repeat the result."""

    seed: int | None
    versions: dict[str, str]
    source_hashes: dict[str, str]
    input_hashes: dict[str, str]


class _Document(_Record):
    campaign: str
    model: str
    command: str
    data_hash: str
    model_hash: str
    provenance: ProvenanceModel


class VerdictDocument(_Document):
    """The file verdict.json."""

    schema_: Literal["uav-twin verdict 1"] = Field(alias="schema")
    verdict: VerdictModel
    proof: ProofModel | None


class IntervalModel(_Record):
    """90 % posterior interval of one parameter of one primitive of an effect."""

    primitive: int = Field(ge=0, description="Index in the effect's list `patch`.")
    parameter: str
    value: FiniteFloat
    low: Number
    high: Number
    unit: str


class PatchEffectModel(EffectModel):
    """An effect with the intervals of its primitives."""

    intervals: list[IntervalModel]


class PatchDocument(_Document):
    """The file patch.json."""

    schema_: Literal["uav-twin patch 1"] = Field(alias="schema")
    verdict: Literal["named", "family", "group"] = Field(
        description="What the patch rests on; of a group it is the most probable member, which is no name."
    )
    sentence: str
    effects: list[PatchEffectModel]
    channels: dict[str, str] = Field(
        default_factory=dict, description="Outputs of the wing FMU by the names of channels."
    )


def json_schema(document: type[BaseModel]) -> str:
    """Return the JSON Schema (draft 2020-12) of a document as it is shipped beside this module."""
    content = {"$schema": "https://json-schema.org/draft/2020-12/schema", **document.model_json_schema()}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"
