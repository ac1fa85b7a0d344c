"""Single readings that cannot be right: found by their neighbours or repeats, and left out with a remark."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, lru_cache, partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d
from scipy.signal import savgol_coeffs

from discrepancy.campaign.noise import repeated
from discrepancy.campaign.records import BoolArray, Campaign, Channel, FloatArray, Trial
from discrepancy.campaign.sampling import is_even, quantum_of
from discrepancy.errors import said

LARGEST_SHARE = 0.03
"""Largest share of a record in time that may be left out; above it the record is at fault."""
SIGNIFICANT = 5.0
"""A sample is an outlier if it is this many robust deviations off what its neighbours say, and as many
deviations of its channel's stated noise."""
WRONG_END = 8.0
"""The same at the ends of a record, beside what a model predicts."""
SIGNIFICANT_ROW = 8.0
"""The same for a row of a static or flight trial, in deviations of the noise record."""
_SHAPES = ((3, 5), (4, 5), (6, 5), (9, 5), (13, 5), (18, 5), (6, 9), (9, 9), (9, 13), (13, 13), (18, 13))
_EDGE = 3  # samples at either end that are not judged, and the narrowest half width
_NEAR = 25  # half width of the neighbourhood whose roughness a sample is compared with
_PASSES = 8
Weights = Callable[[int, int], FloatArray]
"""Half width and degree to what `_weights` and `_uneven_weights` return."""
_NORMAL = 1.4826  # standard deviation of a normal variable over its median absolute deviation


def mark_outliers(campaign: Campaign) -> Campaign:
    """Return the campaign with isolated outliers left out, and a remark for each channel and trial.

    Records in time: a sample is compared with a local polynomial through its neighbours, whose width is the
    one that predicts the record best. It is an outlier if it is five robust deviations off, in the scatter
    of the whole record and in that of its surroundings, five deviations of the channel's noise record, and
    alone: three of five samples in a row are an
    event, such as an impact, and stay, and so does a sample at a kink or a step. The first and last three
    samples are not judged. Where more than 3 % of a record would go, nothing is left out (`check_data`
    reports a fault), nor where the campaign accepts outliers.

    Static and flight trials: a row of at least three repeats is compared with their median; else, in trials
    of eight or more rows, one row may go if a parabola through the others explains them within twice the
    noise and misses this one by eight deviations. Both ask for a noise record.
    """
    used = {trial.name: trial.used.copy() for trial in campaign.trials}
    remarks = list(campaign.remarks)
    for trial, channel, found in find_outliers(campaign):
        count, total = int(found.sum()), len(found)
        if trial.is_dynamic and count > LARGEST_SHARE * total:
            continue
        if "outliers" in campaign.accepted(channel, trial.name):
            continue
        used[trial.name][found, trial.channels.index(channel)] = False
        told = {"channel": channel, "trial": trial.name, "count": count, "total": total}
        are = "is an outlier" if count == 1 else "are outliers"
        remarks.append(said("remarks.left_out", are=are, **told))
    trials = tuple(replace(trial, used=used[trial.name]) for trial in campaign.trials)
    return replace(campaign, trials=trials, remarks=tuple(remarks))


def find_outliers(campaign: Campaign) -> Iterator[tuple[Trial, str, BoolArray]]:
    """Yield trial, channel and the outliers (N,) of every record that has any."""
    # all channels of a trial have its stamps
    weights = {trial.name: _weights_at(trial.time) for trial in campaign.trials if trial.is_dynamic}
    for name, channel in campaign.channels.items():
        by_repeats = _repeat_outliers(campaign, channel)
        for trial, values, used in campaign.records(name):
            if trial.is_dynamic:
                noise = channel.noise_in(trial)
                found = sample_outliers(values, used, weights[trial.name], noise=noise)
            elif trial.name in by_repeats:
                found = by_repeats[trial.name] & used
            else:
                found = _row_outlier(trial, values, used, channel)
            if found.any():
                yield trial, name, found


def sample_outliers(
    values: FloatArray,
    used: BoolArray | None = None,
    weights: Weights | None = None,
    *,
    noise: float = 0.0,
) -> BoolArray:
    """Return which samples of a record are isolated outliers, (N,); see `mark_outliers`.

    Parameters
    ----------
    values : (N,) ndarray
        The record.
    used : (N,) ndarray of bool, optional
        Samples that count; the others are bridged and never reported.
    weights : callable, optional
        What `_weights_at` says of the stamps; those of even ones if left out.
    noise : float
        Standard deviation of the channel's noise; 0: not known.
    """
    count, size = len(values), float(np.max(np.abs(values), initial=0.0))
    used = np.ones(count, dtype=bool) if used is None else used
    suspects, events = np.zeros((2, count), dtype=bool)
    if count < 4 * _EDGE + 4 or used.sum() < 0.5 * count or size == 0.0:
        return suspects
    rows = np.arange(count)
    # squares of readings of any size stay in range
    clean = np.where(used, values / size, np.interp(rows, rows[used], values[used] / size))
    judged = clean.copy()
    weights = weights or _weights
    known = [shape for shape in _SHAPES if weights is _weights or shape[1] == _SHAPES[0][1]]
    shapes = [_Surroundings(weights, shape) for shape in known if 4 * shape[0] + 4 <= count]
    around = min(shapes, key=lambda shape: _scatter(shape.rest(clean)))
    width, degree = around.shape
    # what rounding to digits leaves at least, which a record at rest does not show
    rounding = quantum_of(values[used] / size) * 12.0**-0.5 * float(np.linalg.norm(_weights(width, degree)))
    edge = _EDGE if degree == _SHAPES[0][1] else width
    for _ in range(_PASSES):
        rest = around.rest(clean)
        share = np.abs(rest) / _scale(rest, rounding)
        share[:edge] = share[-edge:] = 0.0
        # Only the worst of each neighbourhood: it spoils the prediction of the samples around it.
        peaks = share == maximum_filter1d(share, 2 * width + 1, mode="constant")
        beyond_noise = np.abs(rest) > SIGNIFICANT * noise / size
        new = np.flatnonzero((share > SIGNIFICANT) & beyond_noise & peaks & ~suspects & ~events)
        if not new.size:
            break
        event = np.array([_is_event(rest, int(index), around.shape) for index in new])
        events[new[event]] = True
        suspects[new[~event]] = True
        clean[new[~event]] -= (rest / around.own(count))[new[~event]]
    # Judge again with clean neighbours, and let events stay: three of five in a row are no single readings.
    rest = around.rest(clean)
    far = np.abs((judged - clean) * around.own(count) + rest)
    beyond_noise = far > SIGNIFICANT * noise / size
    found = used & suspects & beyond_noise & (far > SIGNIFICANT * _scale(rest, rounding))
    crowded = np.convolve(found, np.ones(5), mode="same") >= 3
    event = np.convolve(crowded, np.ones(5), mode="same") > 0
    result: BoolArray = found & ~event
    return result


def wrong_ends(residual: FloatArray, used: BoolArray, noise: FloatArray | float = 0.0) -> BoolArray:
    """Return which samples at the ends of a trial's records are single wrong readings, (N, C).

    `sample_outliers` cannot judge the ends; beside a model they can be. What several channels show at once,
    or several samples in a row, is no single reading: a release, an impact, a trigger that came late.

    Parameters
    ----------
    residual : (N, C) ndarray
        Measured less predicted; the model need not fit.
    used : (N, C) ndarray of bool
        Samples that count.
    noise : (C,) ndarray or float
        Standard deviation of each channel's noise, in the unit of the residual; 0: not known.
    """
    found = np.zeros(residual.shape, dtype=bool)
    noise = np.broadcast_to(noise, residual.shape[1:])
    for column in range(residual.shape[1]):
        rows = np.flatnonzero(used[:, column])
        if len(rows) < 8 * _EDGE:
            continue
        rest = residual[rows, column]
        padded = np.pad(rest, 2, constant_values=np.nan)
        around = sliding_window_view(padded, 5)[:, [0, 1, 3, 4]]
        beside = rest - np.nanmedian(around, axis=1)
        alone = np.abs(rest) > 2.0 * np.nanmax(np.abs(around), axis=1)
        for end in (slice(0, _EDGE), slice(-_EDGE, None)):
            # beside the roughness near that end, where the motion may be fastest
            near = beside[: 4 * _NEAR] if end.stop else beside[-4 * _NEAR :]
            scale = max(_NORMAL * float(np.median(np.abs(near))), float(noise[column]), 1e-300)
            far = alone[end] & (np.abs(beside[end]) > WRONG_END * scale)
            found[rows[end][far], column] = far.sum() == 1
    for end in (slice(0, _EDGE), slice(-_EDGE, None)):
        if found[end].any(axis=0).sum() > 1:
            found[end] = False
    return found


def _is_event(rest: FloatArray, index: int, shape: tuple[int, int]) -> bool:
    """Return whether a kink or a step explains the rest near a sample better than one wrong reading."""
    width = shape[0]
    low, high = max(index - width, 0), min(index + width + 1, len(rest))
    patterns = _patterns(*shape)[:, low - index + width : high - index + width]
    explained = (patterns @ rest[low:high]) ** 2 / np.sum(patterns**2, axis=1)
    return int(np.argmax(explained)) > 0


@lru_cache(maxsize=32)
def _patterns(width: int, degree: int) -> FloatArray:
    """Return what the local polynomial leaves of a wrong reading (row 0), a kink and steps at a sample."""
    places = np.arange(-2 * width, 2 * width + 1)
    signals = places == 0, np.abs(places), places >= 0, places > 0
    weights = _weights(width, degree)
    return np.stack([np.convolve(np.asarray(signal, dtype=float), weights, "valid") for signal in signals])


class _Surroundings:
    """Local polynomials through the neighbours of the samples of a record.

    Near the edges narrower neighbourhoods do; the wider overwrite the inside.

    Parameters
    ----------
    weights : callable
        See `Weights`.
    shape : (int, int)
        Half width of the neighbourhood, and degree.
    """

    def __init__(self, weights: Weights, shape: tuple[int, int]) -> None:
        self.shape = shape
        shapes = [*((item, 5) for item in (3, 4, 6, 9, 13) if item < shape[0]), shape]
        self._weights = {item[0]: weights(*item) for item in shapes}

    def rest(self, values: FloatArray) -> FloatArray:
        """Return what they leave of each sample (N,), of one scatter where there is noise; zero at edges."""
        rest = np.zeros(len(values))
        for width, weights in self._weights.items():
            if weights.ndim == 1:
                inside = np.convolve(values, weights, mode="valid")
            else:
                inside = np.einsum("nw,nw->n", sliding_window_view(values, 2 * width + 1), weights)
            rest[width : len(values) - width] = inside
        return rest

    def own(self, count: int) -> FloatArray:
        """Return the share of each sample itself in its rest (count,)."""
        own = np.ones(count)
        for width, weights in self._weights.items():
            own[width : count - width] = weights[..., width]
        return own


@lru_cache(maxsize=32)
def _weights(width: int, degree: int) -> FloatArray:
    """Return the weights of a sample and its neighbours in the rest of a local polynomial, (2 width + 1,)."""
    weights = -savgol_coeffs(2 * width + 1, degree)
    weights[width] += 1.0
    return np.asarray(weights / weights[width])  # as if the middle were not among what it goes through


def _weights_at(time: FloatArray) -> Weights:
    return _weights if is_even(time) else cache(partial(_uneven_weights, time))


def _uneven_weights(time: FloatArray, width: int, degree: int) -> FloatArray:
    """Return the same for each sample (N - 2 width, 2 width + 1), as sure as those of even samples are."""
    places = sliding_window_view(time, 2 * width + 1) - time[width : len(time) - width, np.newaxis]
    places /= np.max(np.abs(places), axis=1, keepdims=True)
    basis = np.polynomial.polynomial.polyvander(np.delete(places, width, axis=1), degree)
    # beside a wide gap the samples may tell less than the whole polynomial
    inverse = np.linalg.inv(basis.transpose(0, 2, 1) @ basis + 1e-10 * np.eye(degree + 1))
    weights = np.insert(-(basis @ inverse[..., :1])[..., 0], width, 1.0, axis=1)
    size = np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray(weights * (np.linalg.norm(_weights(width, degree)) / size))


def _scatter(rest: FloatArray) -> float:
    return _NORMAL * float(np.median(np.abs(rest[_EDGE:-_EDGE])))


def _scale(rest: FloatArray, least: float) -> FloatArray:
    """Return the scatter that a sample is measured by: of the record or its surroundings, the larger."""
    whole = max(_scatter(rest), least, 1e-300)
    inner = np.abs(rest[_EDGE:-_EDGE])
    if len(inner) <= 2 * _NEAR:
        return np.full(len(rest), whole)
    windows = sliding_window_view(np.pad(inner, _NEAR, mode="reflect"), 2 * _NEAR + 1)
    near = np.pad(np.median(windows, axis=1), _EDGE, mode="edge")
    return np.maximum(whole, _NORMAL * near)


# ---------------------------------------------------------------- rows of static and flight trials


def _repeat_outliers(campaign: Campaign, channel: Channel) -> dict[str, BoolArray]:
    """Return outliers of trials with at least two repeats, by trial: against the median of each row."""
    result: dict[str, BoolArray] = {}
    if channel.noise is None:
        return result
    for group, stack, _ in repeated(campaign.trials, channel.name):
        if len(group) < 3:
            continue
        if channel.offset_deviation > 0.0:
            stack = stack - np.median(stack - np.median(stack, axis=0), axis=1, keepdims=True)
        rest = stack - np.median(stack, axis=0)
        noise = channel.noise.standard_deviation * group[0].noise_factor
        scale = max(noise, _NORMAL * float(np.median(np.abs(rest))))
        far = np.abs(rest) > SIGNIFICANT_ROW * scale
        # A trial that is off in several rows has an offset or a gain of its own; that is no single reading.
        alone = (far.sum(axis=1, keepdims=True) == 1) & (far.shape[1] > 1)
        result |= {trial.name: row for trial, row in zip(group, far & alone, strict=True)}
    return result


def _row_outlier(trial: Trial, values: FloatArray, used: BoolArray, channel: Channel) -> BoolArray:
    """Return the one row that a parabola through the others misses, if they agree among themselves."""
    found = np.zeros(len(values), dtype=bool)
    load, rows = trial.load, np.flatnonzero(used)
    if channel.noise is None or len(rows) < 8 or np.ptp(load[rows]) == 0.0:
        return found
    left, singular, _ = np.linalg.svd(
        np.vander(load[rows] / np.max(np.abs(load[rows])), 3), full_matrices=False
    )
    left = left[:, singular > 1e-12 * singular[0]]
    rest = values[rows] - left @ (left.T @ values[rows])
    free = np.maximum(1.0 - np.sum(left**2, axis=1), 1e-12)
    # what the parabola through the others misses a row by, and how far these lie from it
    missed, degrees = np.abs(rest / free), len(rows) - 1 - left.shape[1]
    spread = np.sqrt(np.maximum(rest @ rest - rest**2 / free, 0.0) / degrees)
    noise = channel.noise_in(trial)
    spread[missed <= SIGNIFICANT_ROW * noise] = np.inf
    worst = int(np.argmin(spread))
    found[rows[worst]] = spread[worst] < 2.0 * noise
    return found
