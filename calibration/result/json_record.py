"""The record of a calibration in JSON, key by key, for its schema and its page.

A key with `NotRequired` is in the record only if there is something to say.
"""

from typing import NotRequired

from typing_extensions import TypedDict


class FigureRecord(TypedDict):
    """A calibrated quantity."""

    title: str
    """What it is, for people."""
    unit: str
    """Unit of the numbers."""
    mean: float
    """Posterior mean [unit of the entry]."""
    standard_deviation: float
    """Posterior standard deviation [unit of the entry]."""
    interval_95: list[float]
    """Limits of the central 95 % interval [unit of the entry]."""


class CorrelationRecord(TypedDict):
    """Correlations of the parameters in the posterior."""

    names: list[str]
    """Names of the parameters."""
    matrix: list[list[float]]
    """The correlation of each parameter (row) with each other one (column) [1]."""


class NamesRecord(TypedDict):
    """Names in the order of the calibration, since the keys of the file are sorted."""

    quantities: list[str]
    """Names of the further quantities."""


class PriorRecord(TypedDict):
    """What was known of the parameter before the measurements."""

    mean: float
    """Mean of the prior, or of the prior samples [unit of the parameter]."""
    standard_deviation: float
    """Standard deviation of the prior, or of the prior samples [unit of the parameter]."""
    range: NotRequired[list[float]]
    """Limits of the prior, where the calibration states it [unit of the parameter]."""


class DensityRecord(TypedDict):
    """A kernel density of the posterior samples; empty if they do not vary."""

    grid: NotRequired[list[float]]
    """Values of the parameter [unit of the parameter]."""
    density: NotRequired[list[float]]
    """The density at these values [1 over the unit of the parameter]."""


class CalibrationRecord(TypedDict):
    """The content of `calibration.json` of a run folder, or among the resources of an FMU.

    The last four keys are those of a run folder alone.
    """

    schema: str
    """Name and version of the format."""
    asset: str
    """Name of the asset that was measured."""
    procedure: str
    """The procedure by which the posterior was computed."""
    seed: int
    """Seed of all draws."""
    model: str
    """Name of the model."""
    design_hash: str
    """SHA-256 of the design of the wing; empty if it has none."""
    samples: int
    """Number of posterior samples."""
    calibration_sha256: str
    """SHA-256 of the file of the calibration."""
    campaign: NotRequired[str]
    """The campaign from which a model was calibrated."""
    laboratory: NotRequired[str]
    """The folder of the laboratory from which a wing was calibrated."""
    findings: list[str]
    """What the calibration found to be wrong or doubtful, a sentence each."""
    state: dict[str, FigureRecord]
    """The parameters, by their names."""
    quantities: dict[str, FigureRecord]
    """The further quantities, by their names."""
    correlation: CorrelationRecord
    """Correlations of the parameters."""
    names: NamesRecord
    """Names in the order of the calibration."""
    parameter: NotRequired[str]
    """The parameter or quantity of which the twin has several values."""
    prior: NotRequired[PriorRecord]
    """What was known of it before the measurements."""
    posterior: NotRequired[DensityRecord]
    """The density of its posterior samples."""
    data: NotRequired[dict[str, list[list[float]] | list[float]]]
    """The measurements, by the name of their table [SI]."""
