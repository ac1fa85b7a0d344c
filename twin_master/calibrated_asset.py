"""A wing as its calibration file describes it: the FMU that carries its figures, and the record of a run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gaussian_kde

from calibration.result import QUANTITIES, STATE, CalibrationResult, Quantity
from calibration.result_file import result_bytes
from fe.patch_arrays import PatchArrays
from fe.reduced import ReducedModel
from fmu_asset.build import FmuInfo, FmuKind, build_fmu
from fmu_asset.patch_file import PatchFile
from reporting.provenance import hash_bytes
from twin_master.run_folder import to_json

RESOURCE_NAME = "calibration.json"
"""The file among the FMU's resources that says what the wing was calibrated with."""

SCHEMA = "uav-twin calibrated wing 1"

_GRID_POINTS = 401


def pack_calibrated_wing(
    model: ReducedModel,
    calibration: CalibrationResult,
    path: str | os.PathLike[str],
    *,
    kind: FmuKind = "python",
    patch: PatchFile | None = None,
    activate: bool = False,
    arrays: PatchArrays | None = None,
    replace: bool = False,
) -> FmuInfo:
    """Pack the tailored model as an FMU that starts at the posterior mean; equal input gives equal bytes.

    The start values of e, masses and damping are the means of the samples. The description names the wing
    and the standard deviations, and `resources/calibration.json` holds them with intervals and correlations.

    Parameters
    ----------
    model : ReducedModel
        Of the tailored design.
    calibration : CalibrationResult
        The wing.
    path : path-like
        Where to write, with the suffix .fmu.
    kind, patch, activate, arrays
        See `fmu_asset.build.build_fmu`.
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FmuBuildError
        See `fmu_asset.build.build_fmu`.
    """
    record = to_json(calibrated_wing(calibration)).encode()
    return build_fmu(
        model,
        path,
        state=calibration.mean_state(),
        note=description(calibration),
        resources={RESOURCE_NAME: record},
        kind=kind,
        patch=patch,
        activate=activate,
        arrays=arrays,
        replace=replace,
    )


def description(calibration: CalibrationResult) -> str:
    """Return one sentence with the name of the wing and its figures, mean and standard deviation."""
    figures = ", ".join(
        f"{entry.name} {calibration.mean(entry.name):.6g} +- {calibration.standard_deviation(entry.name):.3g}"
        + ("" if entry.unit == "1" else f" {entry.unit}")
        for entry in STATE
    )
    return f"Calibrated for the wing '{calibration.asset}' (mean +- standard deviation): {figures}."


def calibrated_wing(calibration: CalibrationResult) -> dict[str, Any]:
    """Return the figures of a calibration as plain data, ready for JSON."""
    return {
        "schema": SCHEMA,
        "asset": calibration.asset,
        "procedure": calibration.procedure,
        "seed": calibration.seed,
        "samples": len(calibration.samples),
        "design_hash": calibration.design_hash,
        "calibration_sha256": hash_bytes(result_bytes(calibration)),
        "state": _figures(STATE, calibration.samples),
        "quantities": _figures(QUANTITIES, calibration.quantity_samples),
        "correlation": {
            "names": [entry.name for entry in STATE],
            "matrix": _correlation(calibration.samples).tolist(),
        },
        "geometry_m": {
            length.name: {
                "mean": length.posterior.mean,
                "standard_deviation": length.posterior.standard_deviation,
            }
            for length in calibration.geometry.lengths
        },
        "sources": {
            "geometry": calibration.geometry.source,
            "load_test": calibration.pairs.source,
            "ring_down": calibration.modal.source,
        },
    }


def run_record(calibration: CalibrationResult, parameter: str) -> dict[str, Any]:
    """Return what `calibration.json` of a run folder holds: the wing, and the parameter drawn by the twin."""
    stiffness = calibration.draws_of("tip_stiffness")
    prior = calibration.draws_of(parameter, prior=True)
    return {
        **calibrated_wing(calibration),
        "parameter": parameter,
        "prior": _moments(prior),
        "posterior": _density(calibration.draws_of(parameter)),
        "tip_stiffness": {"unit": "N/m", **_moments(stiffness)},
        "data": {
            "source": calibration.pairs.source,
            "load_N": calibration.pairs.load.tolist(),
            "displacement_m": calibration.pairs.displacement.tolist(),
        },
    }


def _moments(values: NDArray[np.float64]) -> dict[str, float]:
    deviation = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return {"mean": float(values.mean()), "standard_deviation": deviation}


def _figures(columns: tuple[Quantity, ...], values: NDArray[np.float64]) -> dict[str, Mapping[str, Any]]:
    return {
        entry.name: {
            "title": entry.title,
            "unit": entry.unit,
            **_moments(values[:, index]),
            "interval_95": np.quantile(values[:, index], [0.025, 0.975]).tolist(),
        }
        for index, entry in enumerate(columns)
    }


def _correlation(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation matrix; a figure that does not vary is correlated with itself alone."""
    centred = values - values.mean(axis=0)
    norm = np.linalg.norm(centred, axis=0)
    scaled = centred / np.where(norm > 0.0, norm, 1.0)
    matrix = np.clip(scaled.T @ scaled, -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return np.asarray(matrix)


def _density(values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return a Gaussian kernel density of samples; nothing if they do not vary."""
    spread = float(values.std())
    if spread <= 1e-12 * abs(float(values.mean())):
        return {}
    grid = np.linspace(values.min() - spread, values.max() + spread, _GRID_POINTS)
    return {"grid": grid.tolist(), "density": gaussian_kde(values)(grid).tolist()}
