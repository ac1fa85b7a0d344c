"""A calibration as plain data, ready for JSON: for runs of a twin and for FMUs."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.result.file import SCHEMA, result_bytes
from calibration.result.record import STATE, Calibration
from reporting.provenance import hash_bytes

RESOURCE_NAME = "calibration.json"
"""The file among the FMU's resources that says what the wing was calibrated with."""

_GRID_POINTS = 401


def tailoring(calibration: Calibration) -> dict[str, Any]:
    """Return what the FMU of a calibrated wing carries, as options of `fmu_asset`'s `pack_wing`.

    It starts at the means of the samples of e, masses and damping; its description has the name of the wing
    and the standard deviations, and `RESOURCE_NAME` the figures with intervals and correlations. Equal input
    gives equal bytes.
    """
    text = json.dumps(
        plain_record(calibration), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False
    )
    resources = {RESOURCE_NAME: f"{text}\n".encode()}
    return {"state": calibration.mean_state(), "note": description(calibration), "resources": resources}


def description(calibration: Calibration) -> str:
    """Return one sentence with the name of the wing and its figures, mean and standard deviation."""
    figures = ", ".join(
        f"{name} {calibration.mean(name):.6g} +- {calibration.standard_deviation(name):.3g} "
        f"{figure.shown_unit}".rstrip()
        for figure in calibration.figures
        if (name := figure.name) in STATE
    )
    return f"Calibrated for the wing '{calibration.asset}' (mean +- standard deviation): {figures}."


def plain_record(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration with intervals, and the correlation of its parameters."""
    figures = {
        figure.name: {
            "title": figure.title,
            "unit": figure.unit,
            "mean": calibration.mean(figure.name),
            "standard_deviation": calibration.standard_deviation(figure.name),
            "interval_95": list(calibration.interval(figure.name, 0.95)),
        }
        for figure in calibration.figures
    }
    parameters = [prior.name for prior in calibration.priors]
    quantities = [figure.name for figure in calibration.quantities]
    words = ("asset", "procedure", "seed", "model", "design_hash")
    return {
        "schema": SCHEMA,
        **{name: getattr(calibration, name) for name in words},
        "samples": len(calibration.samples),
        "calibration_sha256": hash_bytes(result_bytes(calibration)),
        "campaign" if calibration.design is None else "laboratory": calibration.source,
        "findings": list(calibration.findings),
        "state": {name: figures[name] for name in parameters},
        "quantities": {name: figures[name] for name in quantities},
        "correlation": {"names": parameters, "matrix": calibration.correlation.tolist()},
        # JSON is written with sorted keys, and pages list the quantities in the order of the calibration
        "names": {"quantities": quantities},
    }


def run_record(calibration: Calibration, parameter: str) -> dict[str, Any]:
    """Return what `calibration.json` of a run folder holds, with the parameter that the twin draws."""
    mean, deviation = calibration.prior_moments(parameter)
    prior: dict[str, Any] = {"mean": mean, "standard_deviation": deviation}
    for item in (item for item in calibration.priors if item.name == parameter):
        prior = {"mean": item.mean, "standard_deviation": item.deviation, "range": [item.low, item.high]}
    measured = calibration.measured
    return {
        **plain_record(calibration),
        "parameter": parameter,
        "prior": prior,
        "posterior": _density(calibration.draws_of(parameter)),
        "data": {str(name): measured[name].values.tolist() for name in measured},
    }


def _density(values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return a Gaussian kernel density of samples; nothing if they do not vary."""
    spread = float(values.std())
    if spread <= 1e-12 * abs(float(values.mean())):
        return {}
    from scipy.stats import gaussian_kde  # takes a second to load

    grid = np.linspace(values.min() - spread, values.max() + spread, _GRID_POINTS)
    return {"grid": grid.tolist(), "density": gaussian_kde(values)(grid).tolist()}
