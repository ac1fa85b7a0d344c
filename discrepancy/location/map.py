"""The map of residuals: cells of sensor, trial and bin, with the statistics of each.

Whole records are correlated with what they could depend on (columns); bins of time, amplitude, frequency and
load are tested for their mean and size.

A column b has z = b . r / sqrt(b . b - |S^T b|^2): every p-value allows for what the fit has absorbed, and a
column that the fit absorbs is not tested.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from discrepancy.campaign.noise_tests import benjamini_yekutieli, periodogram, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray

from .residuals import FittedTrial, ResidualSet, quadratic_moments

_FREE_SHARE = 0.02  # of a direction's square must survive the fit, else it says nothing


class Part(NamedTuple):
    """One channel of a dependence: B'B, B'r and S'B, where B has unit columns."""

    gram: FloatArray
    along: FloatArray
    absorbed: FloatArray


def part_of(basis: FloatArray, items: Sequence[tuple[FittedTrial, BoolArray]], column: int) -> Part | None:
    """Return columns (n, k) over rows (N,) of trials beside residuals; None if they explain anything."""
    size = np.linalg.norm(basis, axis=0)
    basis = basis[:, size > 0.0] / size[size > 0.0]
    residual = np.concatenate([item.standardised[rows, column] for item, rows in items])
    if not 0 < basis.shape[1] < max(residual.size, 2):
        return None  # as many coefficients as samples explain anything
    sensitive = [item.sensitivity[rows, column] for item, rows in items if item.sensitivity is not None]
    if len(sensitive) == len(items):
        return Part(basis.T @ basis, basis.T @ residual, np.vstack(sensitive).T @ basis)
    expected = np.concatenate([item.expected_variance[rows, column] for item, rows in items])
    return Part((basis.T * expected) @ basis, basis.T @ residual, np.zeros((0, basis.shape[1])))


def explained(parts: Sequence[Part]) -> tuple[float, int]:
    """Return the sum of squares that a dependence explains, and the number of its coefficients.

    B'r has the covariance G = B'(I - S S')B under the null, so that (B'r)' G^-1 (B'r) is chi^2; with a gap it
    is what B explains of it after the fit has absorbed its share. Directions that it absorbs are left out.
    """
    gram = block_diag(*(part.gram for part in parts))
    if all(part.absorbed.shape[0] for part in parts):
        absorbed = np.hstack([part.absorbed for part in parts])
        gram = gram - absorbed.T @ absorbed
    along = np.concatenate([part.along for part in parts])
    values, vectors = np.linalg.eigh(gram)
    kept = values > _FREE_SHARE
    return float(np.sum((vectors[:, kept].T @ along) ** 2 / values[kept])), int(kept.sum())


def envelope(item: FittedTrial, column: int) -> FloatArray:
    """Return the amplitude of a channel's predicted motion, (N,): sqrt(x^2 + (v / w)^2) over one period.

    w is the ratio of the root mean squares of rate and value; the mean is taken out first.
    """
    assert item.rates is not None
    x = item.prediction[:, column] - _resting(item, column)
    v = item.rates[:, column]
    size, speed = float(np.sqrt(np.mean(x**2))), float(np.sqrt(np.mean(v**2)))
    if size == 0.0 or speed == 0.0:
        return np.abs(x)
    amplitude = np.hypot(x, v * size / speed)
    width = min(max(1, round(2.0 * np.pi * size / (speed * item.trial.interval))), len(x))
    kernel = np.ones(width)
    return np.asarray(np.convolve(amplitude, kernel, "same") / np.convolve(np.ones_like(x), kernel, "same"))


def _resting(item: FittedTrial, column: int) -> float:
    """Return the value about which a dynamic prediction oscillates: that of its last quarter."""
    values = item.prediction[:, column]
    return float(np.mean(values[-max(len(values) // 4, 1) :]))


def features(item: FittedTrial, column: int) -> dict[str, FloatArray]:
    """Return what residuals of a channel may go with, (n, k) each at the used samples.

    Shapes beyond the linear ones (x^3, |v|v and so on) are made orthogonal to mean, x and v, so that an
    error of amplitude or phase does not show in all of them.
    """
    used, trial = item.used[:, column], item.trial
    ones = np.ones(int(used.sum()))
    x = item.prediction[used, column] - (_resting(item, column) if trial.is_dynamic else 0.0)
    linear = {"mean": ones, "x": x}
    bent = {"x^3": [x**3], "|x|": [np.abs(x)], "sgn x": [np.sign(x)]}
    # loads, time and temperature are themselves what a reader looks for: only their mean goes out
    inputs = {"time": trial.time[used], "temperature": trial.temperature[used]}
    if not trial.is_dynamic:
        inputs |= {"load": trial.force[used], "load factor": trial.load_factor[used]}
    elif item.rates is not None:
        v = linear["v"] = item.rates[used, column]
        bent |= {"sgn v": [np.sign(v)], "|v|v": [np.abs(v) * v]}
        wave = x / _scale(x) - 1j * v / _scale(v)
        amplitude, phase = envelope(item, column)[used], np.angle(wave)
        for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
            bent[name] = [amplitude * np.cos(order * phase), amplitude * np.sin(order * phase)]
    base = np.linalg.qr(np.column_stack([values / _scale(values) for values in linear.values()]))[0]
    found = {name: values[:, np.newaxis] for name, values in linear.items() if np.any(values)}
    for name, rows in {**bent, **{name: [values] for name, values in inputs.items()}}.items():
        table = np.column_stack(rows)
        against = base[:, :1] if name in inputs else base
        rest = table - against @ (against.T @ table)
        size = np.linalg.norm(table, axis=0)
        if np.all((size > 0.0) & (np.linalg.norm(rest, axis=0) > 1e-6 * size)):
            found[name] = rest
    return found


def _scale(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) or 1.0


BINS = 6
"""Bins of time, amplitude and frequency of a dynamic record."""

_FEWEST = 4  # samples of a cell whose size is tested


@dataclass(frozen=True)
class Cell:
    """One entry of the map.

    Attributes
    ----------
    trial, channel : str
        Names.
    axis : str
        "whole", "time", "amplitude", "frequency" or "load".
    low, high : float
        Bin on that axis: [s], [channel's unit], [Hz], [N] or load factor; nan for the whole record.
    count : int
        Samples.
    statistic : str
        "mean", "variance", or the feature that residuals go with: "x", "v", "sgn v", "|v|v", "x^3", "sgn x"
        (odd), "|x|" (even), "2nd harmonic", "3rd harmonic", "time", "load", "load factor", "temperature".
    value : float
        Mean [noise deviation]; mean square over its expectation; correlation coefficient.
    p_value : float
        Two-sided, for a variance one-sided.
    significant : bool
        Discovery at the map's false discovery rate.
    """

    trial: str
    channel: str
    axis: str
    low: float
    high: float
    count: int
    statistic: str
    value: float
    p_value: float
    significant: bool = False


def residual_map(
    residuals: ResidualSet, white: tuple[FloatArray, ...], rate: float = 0.05
) -> tuple[Cell, ...]:
    """Return all cells, significant where the false discovery rate (Benjamini-Yekutieli) allows.

    Parameters
    ----------
    residuals : ResidualSet
        Fitted trials.
    white : tuple of (N, C) ndarray
        What its `white` returned, for the bins of frequency.
    rate : float
        False discovery rate.
    """
    cells = [cell for item, values in zip(residuals.trials, white, strict=True)
             for cell in _cells(residuals, item, values)]  # fmt: skip
    found = benjamini_yekutieli(np.array([cell.p_value for cell in cells]), rate)
    return tuple(replace(cell, significant=bool(flag)) for cell, flag in zip(cells, found, strict=True))


def _cells(residuals: ResidualSet, item: FittedTrial, white: FloatArray) -> Iterator[Cell]:
    trial = item.trial
    for column, channel in enumerate(trial.channels):
        freedom, used = residuals.degrees_of_freedom(channel), item.used[:, column]
        if not used.any():
            continue
        base = Cell(trial.name, channel, "whole", np.nan, np.nan, 0, "", np.nan, 1.0)
        for axis, low, high, where in _stretches(item, column):
            cell = replace(base, axis=axis, low=low, high=high, count=int(where.sum()))
            tables = features(item, column) if axis == "whole" else {"mean": np.ones((cell.count, 1))}
            for name, table in tables.items():
                yield from _along(item, column, where, table, replace(cell, statistic=name), freedom)
            yield from _size(item, column, where, cell, freedom)
        if trial.is_dynamic and used.all():
            yield from _bands(white[:, column], trial.interval, base, freedom)


def _stretches(item: FittedTrial, column: int) -> Iterator[tuple[str, float, float, BoolArray]]:
    """Yield axis, ends, and which used samples (N,) lie between: of the whole record, then of the bins."""
    trial, used = item.trial, item.used[:, column]
    yield "whole", np.nan, np.nan, used
    axes: list[tuple[str, FloatArray, FloatArray]] = []
    if trial.is_dynamic:
        axes.append(("time", trial.time, np.linspace(trial.time[0], trial.time[-1], BINS + 1)))
    else:
        axes.append(("load", trial.load, np.linspace(trial.load.min(), trial.load.max(), 4)))
    if trial.is_dynamic and item.rates is not None and (amplitude := envelope(item, column)).any():
        least = max(amplitude.min(), 1e-4 * amplitude.max())
        axes.append(("amplitude", amplitude, np.geomspace(least, amplitude.max(), BINS + 1)))
    for axis, values, edges in axes:
        place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
        for number, (low, high) in enumerate(pairwise(edges.tolist())):
            if low < high:
                yield axis, low, high, used & (place == number)


def _along(
    item: FittedTrial, column: int, where: BoolArray, table: FloatArray, cell: Cell, freedom: float
) -> Iterator[Cell]:
    """Yield a cell on whether residuals go with columns (n, k) at some samples, if the fit leaves these."""
    part = part_of(table, ((item, where),), column)
    statistic, count = (0.0, 0) if part is None else explained((part,))
    if part is None or count < table.shape[1]:
        return
    residual = item.standardised[where, column]
    value = float(np.mean(residual))
    if cell.statistic != "mean":
        along = part.along / (float(np.linalg.norm(residual)) or 1.0)
        value = float(along[0] if count == 1 else np.linalg.norm(along))
    yield replace(cell, value=value, p_value=variance_p_value(statistic / count, count, freedom or np.inf))


def _size(item: FittedTrial, column: int, where: BoolArray, cell: Cell, freedom: float) -> Iterator[Cell]:
    """Yield a cell on the size of the residuals at some samples, where the noise is recorded."""
    if freedom <= 0.0 or cell.count < (1 if cell.axis == "whole" else _FEWEST):
        return
    sensitive = None if item.sensitivity is None else item.sensitivity[where, column]
    mean, own = quadratic_moments([(item.expected_variance[where, column], sensitive)])
    if own >= 0.5:
        value = float(np.sum(item.standardised[where, column] ** 2)) / mean
        p = variance_p_value(value, own, freedom)
        yield replace(cell, statistic="variance", value=value, p_value=p)


def _bands(series: FloatArray, interval: float, base: Cell, freedom: float) -> Iterator[Cell]:
    """Yield the size of the residual in bands of frequency that widen upwards."""
    ordinates = periodogram(series)
    if ordinates.size < 4 * BINS or freedom <= 0.0:
        return
    edges = np.unique(np.round(np.geomspace(4, ordinates.size, BINS)).astype(int)).tolist()
    step = 1.0 / (series.size * interval)
    cell = replace(base, axis="frequency", statistic="variance")
    for first, last in pairwise([0, *edges]):
        count, value = 2 * (last - first), float(ordinates[first:last].mean())
        ends = {"low": (first + 0.5) * step, "high": (last + 0.5) * step}
        p = variance_p_value(value, count, freedom)
        yield replace(cell, **ends, count=count, value=value, p_value=p)
