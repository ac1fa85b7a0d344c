"""The map of residuals: cells of sensor, trial and bin, with the statistics of each.

Whole records are correlated with what they could depend on; bins of time, amplitude, frequency and load are
tested for their mean and size. Every p-value allows for what the fit has absorbed: a feature f has
z = f . r / sqrt(f . f - |S^T f|^2), and a feature that the fit absorbs is not tested.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtr

from discrepancy.campaign.noise_tests import benjamini_yekutieli, periodogram, variance_p_value
from discrepancy.campaign.records import Trial
from discrepancy.location.residuals import FittedTrial, ResidualSet, quadratic_moments

FloatArray = NDArray[np.float64]

BINS = 6
"""Bins of time, amplitude and frequency of a dynamic record."""

_FREE_SHARE = 0.02  # of a feature's square must survive the fit, else it says nothing
_FEWEST = 4  # samples of a cell whose size is tested


@dataclass(frozen=True)
class Cell:
    """One entry of the map.

    Attributes
    ----------
    trial, channel : str
        Names.
    state : str
        Kind, run and health of the trial.
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
    state: str
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


def envelope(item: FittedTrial, column: int) -> FloatArray:
    """Return the amplitude of a channel's predicted motion, (N,): sqrt(x^2 + (v / w)^2) over one period.

    w is the ratio of the root mean squares of rate and value; the mean is taken out first.
    """
    if item.rates is None:
        raise ValueError(f"The trial {item.trial.name!r} has no rates.")
    x = item.prediction[:, column] - _resting(item, column)
    v = item.rates[:, column]
    size, speed = float(np.sqrt(np.mean(x**2))), float(np.sqrt(np.mean(v**2)))
    if size == 0.0 or speed == 0.0:
        return np.abs(x)
    amplitude = np.hypot(x, v * size / speed)
    width = max(1, round(2.0 * np.pi * size / (speed * item.trial.interval)))
    width = min(width, len(x))
    kernel = np.ones(width)
    return np.asarray(np.convolve(amplitude, kernel, "same") / np.convolve(np.ones_like(x), kernel, "same"))


def _resting(item: FittedTrial, column: int) -> float:
    """Return the value about which a dynamic prediction oscillates: that of its last quarter."""
    values = item.prediction[:, column]
    return float(np.mean(values[-max(len(values) // 4, 1) :]))


def state_of(trial: Trial) -> str:
    """Return kind, run and health of a trial in a few words."""
    words = [trial.kind.value]
    if trial.run:
        words.append(f"run {trial.run}")
    if np.any(trial.health):
        losses = ", ".join(
            f"{name} = {loss:.2g}" for name, loss in zip(trial.regions, trial.health[0], strict=True)
        )
        words.append(losses + ("" if np.ptp(trial.health, axis=0).max() == 0 else " .."))
    return ", ".join(words)


def features(item: FittedTrial, column: int) -> dict[str, FloatArray]:
    """Return what residuals of a channel may go with, (n,) each at the used samples.

    Shapes beyond the linear ones (x^3, |v|v and so on) are made orthogonal to mean, x and v, so that an
    error of amplitude or phase does not show in all of them.
    """
    used, trial = item.used[:, column], item.trial
    count = int(used.sum())
    ones = np.ones(count)
    x = item.prediction[used, column] - (_resting(item, column) if trial.is_dynamic else 0.0)
    found: dict[str, FloatArray] = {"mean": ones, "x": x}
    linear = [ones, x]
    candidates: dict[str, FloatArray] = {"x^3": x**3, "|x|": np.abs(x), "sgn x": np.sign(x)}
    if trial.is_dynamic:
        candidates["time"] = trial.time[used]
        if item.rates is not None:
            v = item.rates[used, column]
            found["v"] = v
            linear.append(v)
            candidates |= {"sgn v": np.sign(v), "|v|v": np.abs(v) * v}
            amplitude = envelope(item, column)[used]
            phase = np.arctan2(-v / _scale(v), x / _scale(x))
            for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
                candidates[f"{name} cos"] = amplitude * np.cos(order * phase)
                candidates[f"{name} sin"] = amplitude * np.sin(order * phase)
    else:
        candidates["time"] = trial.time[used]
        candidates["load"] = trial.force[used]
        candidates["load factor"] = trial.load_factor[used]
    candidates["temperature"] = trial.temperature[used]
    base = np.linalg.qr(np.column_stack([column_ / _scale(column_) for column_ in linear]))[0]
    for name, values in candidates.items():
        size = float(np.linalg.norm(values))
        if size == 0.0:
            continue
        # Loads and temperature are themselves what a reader looks for: only their mean goes out.
        against = base[:, :1] if name in ("load", "load factor", "temperature", "time") else base
        rest = values - against @ (against.T @ values)
        if np.linalg.norm(rest) > 1e-6 * size:
            found[name] = rest
    return {name: values for name, values in found.items() if np.any(values)}


def _scale(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) or 1.0


def _cells(residuals: ResidualSet, item: FittedTrial, white: FloatArray) -> Iterator[Cell]:
    trial = item.trial
    for column, channel in enumerate(trial.channels):
        used = item.used[:, column]
        count = int(used.sum())
        if count == 0:
            continue
        base = Cell(trial.name, channel, state_of(trial), "whole", np.nan, np.nan, count, "", np.nan, 1.0)
        freedom = residuals.degrees_of_freedom(channel)
        yield from _whole(item, column, base, freedom)
        yield from _bins(item, column, base, freedom)
        if trial.is_dynamic and count == len(used):
            yield from _bands(white[:, column], trial.interval, base, freedom)


def _whole(item: FittedTrial, column: int, base: Cell, freedom: float) -> Iterator[Cell]:
    named = features(item, column)
    table = np.column_stack(list(named.values()))
    table = table / np.linalg.norm(table, axis=0)
    z, free = _projected(item, column, table)
    residual = item.standardised[item.used[:, column], column]
    size = float(np.linalg.norm(residual)) or 1.0
    pairs: dict[str, list[int]] = {}
    for number, name in enumerate(named):
        pairs.setdefault(name.removesuffix(" cos").removesuffix(" sin"), []).append(number)
    for name, numbers in pairs.items():
        if not all(free[number] for number in numbers):
            continue
        if name == "mean":
            value = float(np.mean(residual))
        else:
            along = table[:, numbers].T @ residual
            value = float(along[0] if len(numbers) == 1 else np.linalg.norm(along)) / size
        if len(numbers) == 1:
            p = 2.0 * float(_tail(abs(z[numbers[0]]), freedom))
        else:
            # Cosine and sine of one harmonic are all but orthogonal: chi^2 or F with two degrees of freedom.
            p = variance_p_value(float(np.mean(z[numbers] ** 2)), len(numbers), freedom or np.inf)
        yield replace(base, statistic=name, value=value, p_value=min(p, 1.0))
    yield from _size(item, column, item.used[:, column], base, freedom)


def _projected(item: FittedTrial, column: int, table: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return z of each feature (unit columns) and whether the fit leaves enough of it."""
    used = item.used[:, column]
    residual = item.standardised[used, column]
    if item.sensitivity is None:
        variance = np.asarray((table**2).T @ item.expected_variance[used, column])
    else:
        variance = 1.0 - np.sum((item.sensitivity[used, column].T @ table) ** 2, axis=0)
    free = variance > _FREE_SHARE
    z = np.where(free, table.T @ residual / np.sqrt(np.where(free, variance, 1.0)), 0.0)
    return z, free


def _tail(z: float, freedom: float) -> float:
    if freedom <= 0.0 or np.isinf(freedom):
        return float(ndtr(-z))
    return float(stdtr(freedom, -z))


def _size(
    item: FittedTrial, column: int, where: NDArray[np.bool_], base: Cell, freedom: float
) -> Iterator[Cell]:
    count = int(where.sum())
    if freedom <= 0.0 or count < (1 if base.axis == "whole" else _FEWEST):
        return
    sensitive = None if item.sensitivity is None else item.sensitivity[where, column]
    mean, own = quadratic_moments([(item.expected_variance[where, column], sensitive)])
    if own < 0.5:
        return
    value = float(np.sum(item.standardised[where, column] ** 2)) / mean
    yield replace(
        base, count=count, statistic="variance", value=value, p_value=variance_p_value(value, own, freedom)
    )


def _edges(values: FloatArray, bins: int, *, logarithmic: bool = False) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    if logarithmic:
        low = max(low, 1e-4 * high)
        return np.geomspace(low, high, bins + 1) if high > low > 0.0 else np.array([low, high])
    return np.linspace(low, high, bins + 1) if high > low else np.array([low, high])


def _bins(item: FittedTrial, column: int, base: Cell, freedom: float) -> Iterator[Cell]:
    trial, used = item.trial, item.used[:, column]
    if trial.is_dynamic:
        axes = [("time", trial.time, _edges(trial.time, BINS))]
        if item.rates is not None:
            amplitude = envelope(item, column)
            axes.append(("amplitude", amplitude, _edges(amplitude, BINS, logarithmic=True)))
    else:
        load = trial.force if np.any(trial.force) else trial.load_factor
        axes = [("load", load, _edges(load, 3))]
    for axis, values, edges in axes:
        if edges.size < 3 or edges[-1] <= edges[0]:
            continue
        place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
        for number in range(edges.size - 1):
            where = used & (place == number)
            if not where.any():
                continue
            cell = replace(base, axis=axis, low=float(edges[number]), high=float(edges[number + 1]))
            table = where[used].astype(float)[:, np.newaxis] / np.sqrt(where.sum())
            z, free = _projected(item, column, table)
            if free[0]:
                value = float(np.mean(item.standardised[where, column]))
                p = min(1.0, 2.0 * _tail(abs(float(z[0])), freedom))
                yield replace(cell, count=int(where.sum()), statistic="mean", value=value, p_value=p)
            yield from _size(item, column, where, cell, freedom)


def _bands(series: FloatArray, interval: float, base: Cell, freedom: float) -> Iterator[Cell]:
    """Yield the size of the residual in bands of frequency that widen upwards."""
    ordinates = periodogram(series)
    if ordinates.size < 4 * BINS or freedom <= 0.0:
        return
    edges = np.unique(np.round(np.geomspace(4, ordinates.size, BINS)).astype(int))
    step = 1.0 / (series.size * interval)
    for first, last in zip([0, *edges[:-1]], edges, strict=True):
        value = float(ordinates[first:last].mean())
        p = variance_p_value(value, 2.0 * (last - first), freedom)
        yield replace(
            base, axis="frequency", low=(first + 0.5) * step, high=(last + 0.5) * step,
            count=int(2 * (last - first)), statistic="variance", value=value, p_value=p,
        )  # fmt: skip
