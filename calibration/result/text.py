"""The figures of a calibration in words, for console and page."""

from math import floor, isfinite, log10

import numpy as np

from calibration.result.record import Calibration

HEADINGS = ("parameter", "unit", "prior", "posterior", "90 % interval", "prior left")
READING_HEADINGS = ("experiment", "figure", "unit", "measured", "before", "after", "in deviations")
CHANNEL_HEADINGS = ("channel", "trials", "readings", "rms before", "rms after")
NOTED_CORRELATION = 0.3
PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
    "joint": "of all experiments together, by importance sampling",
    "paper": "by the paper's procedure, step after step",
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


def parameter_rows(result: Calibration) -> list[tuple[str, ...]]:
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


def reading_rows(result: Calibration) -> list[tuple[str, ...]]:
    """Return a row of `READING_HEADINGS` for each reading."""
    units = {figure.name: "" if figure.unit == "1" else figure.unit for figure in result.figures}
    return [
        (
            item.experiment,
            item.name,
            units[item.name],
            with_deviation(item.value, item.deviation),
            with_deviation(*result.prior_moments(item.name)),
            with_deviation(result.mean(item.name), result.standard_deviation(item.name)),
            f"{result.score(item):+.1f}",
        )
        for item in result.readings
    ]


def channel_rows(result: Calibration) -> list[tuple[str, ...]]:
    """Return a row of `CHANNEL_HEADINGS` for each channel."""
    return [
        (item.name, item.trials, str(item.readings), *(_size(value) for value in (item.before, item.after)))
        for item in result.channels
    ]


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share > 0.095 else f"{100.0 * share:.1f} %"


def _size(value: float) -> str:
    return f"{value:.2f}" if isfinite(value) else "noise unknown"


def correlation_lines(result: Calibration) -> list[str]:
    """Return the correlations that are worth a word, the largest first."""
    names = [prior.name for prior in result.priors]
    matrix = result.correlation
    pairs = [
        (abs(matrix[i, j]), f"Correlation of {names[i]} and {names[j]}: {matrix[i, j]:+.2f}")
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True)
        if abs(matrix[i, j]) >= NOTED_CORRELATION
    ]
    return [text for _, text in sorted(pairs, key=lambda pair: -pair[0])]


def headline(result: Calibration) -> str:
    """Return what was calibrated, and how."""
    named = "" if result.asset == result.source else f"{result.asset}: "
    told = f", {gained:.1f} nat gained" if (gained := result.information) is not None else ""
    where = f", campaign {result.source}" if result.design is None else ""
    return (
        f"{named}{result.model}{where}; posterior {PROCEDURES[result.procedure]}, "
        f"{len(result.samples)} samples{told}"
    )
