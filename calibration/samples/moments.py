"""Samples as plain data, ready for JSON: moments, intervals, correlations, densities."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.samples.record import SampledCalibration, SampleTable

_GRID_POINTS = 401


def sampled_record(calibration: SampledCalibration) -> dict[str, Any]:
    """Return the figures of a calibration with intervals, and the correlation of the calibrated ones."""
    table, derived = calibration.calibrated, calibration.derived
    return {
        "state": figures_record(table),
        "quantities": {} if derived is None else figures_record(derived),
        "correlation": {
            "names": [figure.name for figure in table.figures],
            "matrix": correlation(table.samples).tolist(),
        },
    }


def drawn_record(calibration: SampledCalibration, parameter: str) -> dict[str, Any]:
    """Return what a calibration says of the parameter that a twin draws: moments before, density after."""
    return {
        "parameter": parameter,
        "prior": moments(calibration.draws_of(parameter, prior=True)),
        "posterior": density(calibration.draws_of(parameter)),
    }


def moments(values: NDArray[np.float64]) -> dict[str, float]:
    """Return mean and standard deviation of samples (N,)."""
    deviation = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return {"mean": float(values.mean()), "standard_deviation": deviation}


def figures_record(table: SampleTable) -> dict[str, Mapping[str, Any]]:
    """Return title, unit, moments and 95 % interval of each figure, by name."""
    return {
        figure.name: {
            "title": figure.title,
            "unit": figure.unit,
            **moments(table.samples[:, index]),
            "interval_95": np.quantile(table.samples[:, index], [0.025, 0.975]).tolist(),
        }
        for index, figure in enumerate(table.figures)
    }


def correlation(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation matrix; a figure that does not vary is correlated with itself alone."""
    centred = values - values.mean(axis=0)
    norm = np.linalg.norm(centred, axis=0)
    scaled = centred / np.where(norm > 0.0, norm, 1.0)
    matrix = np.clip(scaled.T @ scaled, -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return np.asarray(matrix)


def density(values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return a Gaussian kernel density of samples; nothing if they do not vary."""
    spread = float(values.std())
    if spread <= 1e-12 * abs(float(values.mean())):
        return {}
    from scipy.stats import gaussian_kde  # takes a second to load

    grid = np.linspace(values.min() - spread, values.max() + spread, _GRID_POINTS)
    return {"grid": grid.tolist(), "density": gaussian_kde(values)(grid).tolist()}
