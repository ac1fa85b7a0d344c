"""The file `self_calibration.json`: its records, its JSON Schema, and how it is written."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from discrepancy.document import Origin, document_schema, write_document
from discrepancy.self_calibration import (
    CalibrationCase,
    Proportion,
    SelfCalibration,
    ordered_outcomes,
)
from reporting.formats.schema import JsonSchema

SELF_CALIBRATION_NAME = "self_calibration.json"
SCHEMA = "uav-twin self calibration 1"


@dataclass(frozen=True)
class StoredProportion:
    """A fraction of cases, as it is stored."""

    count: int
    """The number of these cases."""
    total: int
    """The number of all cases."""
    low: float
    """Lower limit of the 90 % Wilson interval of the fraction [1]."""
    high: float
    """Upper limit of this interval [1]."""
    share: float | None
    """The fraction; null without cases [1]."""


@dataclass(frozen=True)
class StoredOutcomes:
    """The fractions of all outcomes, by their names."""

    with_an_effect: Mapping[str, StoredProportion]
    """The fractions of the campaigns in which an effect was hidden."""
    with_nothing: Mapping[str, StoredProportion]
    """The fractions of the campaigns in which nothing was hidden."""


@dataclass(frozen=True)
class StoredConfusion:
    """The numbers of simulated campaigns by hidden effect and verdict."""

    hidden: tuple[str, ...]
    """Names of the rows: the hidden effects."""
    verdict: tuple[str, ...]
    """Names of the columns: the named effects, and the other verdicts."""
    counts: tuple[tuple[int, ...], ...]
    """The numbers of campaigns by row and column."""


@dataclass(frozen=True)
class StoredSelfCalibration:
    """The content of `self_calibration.json`."""

    seed: int
    """Seed of the simulated campaigns."""
    not_detectable: tuple[str, ...]
    """Identifiers of the effects that no draw of their priors made detectable, so that none was
    hidden."""
    outcomes: StoredOutcomes
    """The fractions of the outcomes."""
    coverage_90: StoredProportion
    """The fraction of the 90 % intervals of rightly named effects that hold the true value."""
    confusion: StoredConfusion
    """How often each verdict was reached for each hidden effect."""
    cases: tuple[CalibrationCase, ...]
    """All simulated campaigns."""
    origin: Origin
    """What the verdict was reached from."""


def write_self_calibration(path: Path, self_calibration: SelfCalibration, origin: Origin) -> Path:
    """Write `self_calibration.json`: every case, the proportions and the confusion matrix.

    The file is written completely or not at all.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    rows, columns, counts = self_calibration.confusion()
    content = StoredSelfCalibration(
        seed=self_calibration.seed,
        not_detectable=self_calibration.not_detectable,
        outcomes=StoredOutcomes(
            with_an_effect=_stored_outcomes(self_calibration, null=False),
            with_nothing=_stored_outcomes(self_calibration, null=True),
        ),
        coverage_90=_stored_proportion(self_calibration.coverage()),
        confusion=StoredConfusion(
            hidden=tuple(rows),
            verdict=tuple(columns),
            counts=tuple(tuple(row) for row in counts.tolist()),
        ),
        cases=self_calibration.cases,
        origin=origin,
    )
    return write_document(path, SCHEMA, content)


def self_calibration_schema() -> JsonSchema:
    """Return the JSON Schema of `self_calibration.json`; a null number is not known."""
    return document_schema(StoredSelfCalibration, SCHEMA)


def _stored_outcomes(
    self_calibration: SelfCalibration, *, null: bool
) -> dict[str, StoredProportion]:
    """Return the proportion of each outcome among the campaigns without an effect, or with one.

    `null` is True for those without an effect.
    """
    proportions = {}
    for outcome in ordered_outcomes(self_calibration, null=null):
        proportions[outcome] = _stored_proportion(self_calibration.share(outcome, null=null))
    return proportions


def _stored_proportion(proportion: Proportion) -> StoredProportion:
    """Return a proportion as it is stored; its fraction is None, not nan, without cases."""
    return StoredProportion(
        count=proportion.count,
        total=proportion.total,
        low=proportion.low,
        high=proportion.high,
        share=proportion.value if proportion.total else None,
    )
