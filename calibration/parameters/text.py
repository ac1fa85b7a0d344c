"""The figures of a calibration of parameters in words, for console and page."""

from math import floor, isfinite, log10

import numpy as np

from calibration.parameters.result import ParameterCalibration
from calibration.samples.moments import correlation

HEADINGS = ("parameter", "unit", "prior", "posterior", "90 % interval", "prior left")
CHANNEL_HEADINGS = ("channel", "trials", "readings", "rms before", "rms after")
NOTED_CORRELATION = 0.3
PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
}


def figures(value: float, deviation: float) -> str:
    """Return a value with as many decimals as two digits of its deviation need."""
    if not (deviation > 0.0 and isfinite(deviation)):
        return f"{value:.6g}"
    decimals = 1 - floor(log10(deviation))
    if abs(value) >= 1e6 or deviation < 1e-6:
        digits = max(2, floor(log10(max(abs(value), deviation))) + decimals + 1)
        return f"{value:.{min(digits, 12) - 1}e}"
    return f"{value:.{max(decimals, 0)}f}"


def with_deviation(value: float, deviation: float) -> str:
    """Return mean ± standard deviation."""
    return f"{figures(value, deviation)} ± {figures(deviation, deviation)}"


def parameter_rows(result: ParameterCalibration) -> list[tuple[str, ...]]:
    """Return a row of `HEADINGS` for each parameter."""
    rows: list[tuple[str, ...]] = []
    for prior in result.priors:
        deviation = result.standard_deviation(prior.name)
        low, high = result.interval(prior.name)
        rows.append(
            (
                prior.name,
                "" if prior.unit == "1" else prior.unit,
                with_deviation(*result.prior_moments(prior.name)),
                with_deviation(result.mean(prior.name), deviation),
                f"{figures(low, deviation)} to {figures(high, deviation)}",
                _percent(result.kept_share(prior.name)),
            )
        )
    return rows


def channel_rows(result: ParameterCalibration) -> list[tuple[str, ...]]:
    """Return a row of `CHANNEL_HEADINGS` for each channel."""
    return [
        (item.name, item.trials, str(item.readings), *(_size(value) for value in (item.before, item.after)))
        for item in result.channels
    ]


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share > 0.095 else f"{100.0 * share:.1f} %"


def _size(value: float) -> str:
    return f"{value:.2f}" if isfinite(value) else "noise unknown"


def correlation_lines(result: ParameterCalibration) -> list[str]:
    """Return the correlations that are worth a word, the largest first."""
    names = [prior.name for prior in result.priors]
    matrix = correlation(result.samples)
    pairs = [
        (abs(matrix[i, j]), f"Correlation of {names[i]} and {names[j]}: {matrix[i, j]:+.2f}")
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True)
        if abs(matrix[i, j]) >= NOTED_CORRELATION
    ]
    return [text for _, text in sorted(pairs, key=lambda pair: -pair[0])]


def headline(result: ParameterCalibration) -> str:
    """Return what was calibrated, and how."""
    named = "" if result.asset == result.source else f"{result.asset}: "
    return (
        f"{named}{result.model}, campaign {result.source}; posterior {PROCEDURES[result.procedure]}, "
        f"{len(result.samples)} samples, {result.information:.1f} nat gained"
    )
