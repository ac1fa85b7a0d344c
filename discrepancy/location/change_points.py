"""Since when, until when: change points of residuals in time.

A record is cut into segments. In each of them a channel is either *quiet*, noise of the stated size and of
any colour, or it holds a *gap*: the same noise about a mean, or an autoregression of second order about a
mean, whose coefficients and variance are its own. An offset, a line, a random motion and a larger scatter are
all of that kind. All evidences have closed forms in sums over the segment, so that the most probable
segmentation is found exactly by dynamic programming (Jackson et al. 2005, IEEE Signal Processing Letters
12(2), 105-108) over evidence in the place of a cost (Killick, Fearnhead and Eckley 2012, JASA 107, 1590-1598;
the pruning there needs costs that only fall when a segment is divided, which evidence does not). A change
falls between two samples; its posterior is that over all places between the neighbouring changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from discrepancy.campaign.records import TrialKind
from discrepancy.location.residuals import FittedTrial, ResidualSet

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

GRID = 120
"""Boundaries between which segments are looked for first; the changes are then placed between samples."""
SHORTEST = 4
"""Samples of a segment: fewer are outliers."""
COLOURS = (0.0, 0.3, 0.5, 0.7, 0.9)
"""Correlations of neighbouring samples that noise may have; all alike before the data."""
GAP_SHARE = 0.1
"""Probability that a channel holds a gap in a segment, before the data."""
CHANGE_PRICE = 4.0
"""ln odds against a change, beside the choice of its place."""
STEP = 3.0
"""Ratio of sizes from which on two parts of a gap that follow each other are told apart."""
LARGEST = 1e4
"""Size of a residual in noises above which all are scaled down: sums lose their digits."""

_ORDER = 2
_MEAN_SCALE, _LAG_SCALE = 1e4, 1.0  # prior variances of mean and lags, over that of the innovations
_SHAPE = 0.5  # of the inverse gamma distribution of the innovations' variance, about that of noise


@dataclass(frozen=True)
class Moment:
    """When something changed [s since the trial's start]: posterior median and 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class GapWindow:
    """A stretch of a record in which the residual is more than noise, and of about one size.

    Attributes
    ----------
    trial : str
        Whose record.
    channels : tuple of str
        Those that hold the gap.
    begin, end : Moment or None
        Since when, until when; None where it is there from the first sample on, or to the last.
    first, last : float
        Times of the first and the last sample of the record [s].
    size : float
        Root mean square residual over the noise, of the channel with the largest.
    with_effect : bool
        Whether it is left by the best hypothesis; else by the model as it was.
    """

    trial: str
    channels: tuple[str, ...]
    begin: Moment | None
    end: Moment | None
    first: float
    last: float
    size: float
    with_effect: bool = False


class SegmentEvidence:
    """Log evidence of segments of a record, from sums up to each sample.

    Parameters
    ----------
    series : (N, C) ndarray
        Residuals in units of the noise.
    used : (N, C) ndarray of bool
        Samples that count.
    freedom : (C,) ndarray
        Degrees of freedom of the noise records; without a record the noise is taken as a rough guess.
    """

    def __init__(self, series: FloatArray, used: BoolArray, freedom: FloatArray) -> None:
        known = _carried(series, used)
        self._unit = 1.0 / np.maximum(1.0, np.max(np.abs(known), axis=0, initial=0.0) / LARGEST)
        known = known * self._unit
        self._freedom = np.where(freedom > 0.0, freedom, 4.0)
        count, channels = known.shape
        lagged = [np.ones_like(known)]
        for lag in range(1, _ORDER + 1):
            lagged.append(np.vstack((np.zeros((min(lag, count), channels)), known[:-lag])))
        rows = np.stack([*lagged, known])  # (4, N, C)
        products = np.einsum("anc,bnc,nc->ncab", rows, rows, used.astype(float))
        self._sums = np.concatenate((np.zeros((1, *products.shape[1:])), np.cumsum(products, axis=0)))
        whole = 0.5 * np.arange(count + 1)
        self._motion_shape = gammaln(_SHAPE + whole) - gammaln(_SHAPE)
        n0 = 0.5 * np.where(np.isinf(self._freedom), 1.0, self._freedom)
        self._noise_shape = (gammaln(n0 + whole[:, np.newaxis]) - gammaln(n0)
                             - whole[:, np.newaxis] * np.log(n0))  # fmt: skip

    def quiet_and_gap(self, first: IntArray, last: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return ln evidence (K, C) of segments as noise, and as a gap; sample `last` is beyond them."""
        square = self._sums[first + 1, :, -1, -1] - self._sums[first, :, -1, -1]  # of their first samples
        begun = self._sums[first + 1, :, 0, 0] - self._sums[first, :, 0, 0]
        after = self._sums[last] - self._sums[first + 1]
        level = self._first(first)
        quiet, shifted = self._noise(square, begun, level, after)
        return quiet, np.logaddexp(shifted, self._motion(first, last)) - np.log(2.0)

    def scores(self, first: IntArray, last: IntArray) -> FloatArray:
        """Return ln evidence (K,) of segments, each channel being quiet or not."""
        quiet, gap = self.quiet_and_gap(first, last)
        both = np.logaddexp(quiet + np.log1p(-GAP_SHARE), gap + np.log(GAP_SHARE))
        return np.asarray(both.sum(axis=-1))

    def _first(self, first: IntArray) -> FloatArray:
        """Return the first readings (K, C) of segments, nought where they do not count."""
        return np.asarray(self._sums[first + 1, :, 0, -1] - self._sums[first, :, 0, -1])

    def _noise(
        self, square: FloatArray, begun: FloatArray, level: FloatArray, after: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ln evidence of noise of any colour, and of the same about a mean of its own.

        A segment begins anew: its first sample does not follow from the one before it.
        """
        quiet, shifted = [], []
        count = begun + after[..., 0, 0]
        for colour in COLOURS:
            rest = 1.0 - colour**2
            moved = after[..., -1, -1] - 2.0 * colour * after[..., 1, -1] + colour**2 * after[..., 1, 1]
            total = square + np.maximum(moved, 0.0) / rest
            log_scale = -0.5 * after[..., 0, 0] * np.log(rest)
            quiet.append(log_scale + self._density(total, count))
            # regression on the mean: 1 at the first sample, (1 - colour) / sqrt(rest) at the others
            along = level + (1.0 - colour) / rest * (after[..., 0, -1] - colour * after[..., 0, 1])
            weight = begun + (1.0 - colour) ** 2 / rest * after[..., 0, 0] + 1.0 / _MEAN_SCALE
            left = total - along**2 / weight
            price = -0.5 * np.log(_MEAN_SCALE * weight)
            shifted.append(log_scale + price + self._density(np.maximum(left, 0.0), count))
        return _mean_of_logs(quiet), _mean_of_logs(shifted)

    def _density(self, total: FloatArray, count: FloatArray) -> FloatArray:
        """Return the log density of a sum of squares of white noise whose variance the record has left."""
        left, n0 = total / self._unit**2, self._freedom
        constant = -0.5 * count * (np.log(2.0 * np.pi) + 2.0 * np.log(self._unit))
        if np.all(np.isinf(n0)):
            return np.asarray(constant - 0.5 * left)
        shape = np.take_along_axis(self._noise_shape, count.astype(np.int64), axis=0)
        with np.errstate(invalid="ignore"):
            loose = shape - 0.5 * (n0 + count) * np.log1p(left / n0)
        return np.asarray(constant + np.where(np.isinf(n0), -0.5 * left, loose))

    def _motion(self, first: IntArray, last: IntArray) -> FloatArray:
        """Return ln evidence (K, C) of an autoregression about a mean, begun at the size of the segment."""
        start = np.minimum(first + _ORDER, last)
        sums, head = self._sums[last] - self._sums[start], self._sums[start] - self._sums[first]
        whole = sums[..., -1, -1] + head[..., -1, -1]
        every = np.maximum(sums[..., 0, 0] + head[..., 0, 0], 1.0)
        size = np.maximum(whole / every, self._unit**2)
        begin = -0.5 * head[..., 0, 0] * np.log(2.0 * np.pi * size) - 0.5 * head[..., -1, -1] / size
        return np.asarray(begin + self._regression(sums))

    def _regression(self, sums: FloatArray) -> FloatArray:
        """Return ln evidence of readings that follow from 1 and the readings before, all unknowns free."""
        prior = np.array([1.0 / _MEAN_SCALE, *(1.0 / _LAG_SCALE for _ in range(_ORDER))])
        size, count = len(prior), sums[..., 0, 0]
        matrix = [[sums[..., a, b] + (prior[a] if a == b else 0.0) for b in range(size)] for a in range(size)]
        # Cholesky of the small matrices, all at once
        root: list[list[FloatArray]] = [[np.zeros(()) for _ in range(size)] for _ in range(size)]
        solved: list[FloatArray] = []
        for a in range(size):
            for b in range(a + 1):
                rest = matrix[a][b] - sum((root[a][k] * root[b][k] for k in range(b)), np.zeros(()))
                root[a][b] = np.sqrt(np.maximum(rest, 1e-300)) if a == b else rest / root[b][b]
            along = sums[..., a, size] - sum((root[a][k] * solved[k] for k in range(a)), np.zeros(()))
            solved.append(along / root[a][a])
        log_root = sum((np.log(root[a][a]) for a in range(size)), np.zeros(()))
        taken = sum((value**2 for value in solved), np.zeros(()))
        begin = _SHAPE * self._unit**2
        end = begin + 0.5 * np.maximum(sums[..., size, size] - taken, 0.0)
        shape = _SHAPE + 0.5 * count
        return np.asarray(
            -0.5 * count * np.log(2.0 * np.pi) + 0.5 * float(np.log(prior).sum()) - log_root
            + _SHAPE * np.log(begin) - shape * np.log(end) + self._motion_shape[count.astype(np.int64)]
        )  # fmt: skip


def _mean_of_logs(values: Sequence[FloatArray]) -> FloatArray:
    """Return ln of the mean of exp(values)."""
    top = np.maximum.reduce(values)
    return np.asarray(top + np.log(sum(np.exp(value - top) for value in values) / len(values)))


def _carried(series: FloatArray, used: BoolArray) -> FloatArray:
    """Return the series with the last reading that counts in the place of each that does not."""
    row = np.where(used, np.arange(len(series))[:, np.newaxis], -1)
    last = np.maximum.accumulate(row, axis=0)
    found = np.take_along_axis(series, np.maximum(last, 0), axis=0)
    return np.where(last >= 0, found, 0.0)


def change_price(count: int) -> float:
    """Return what a change costs in a record of `count` samples [nat]: its place, and that it is there."""
    return float(np.log(max(count, 1))) + CHANGE_PRICE


def best_segmentation(evidence: SegmentEvidence, boundaries: IntArray, price: float) -> list[int]:
    """Return the changes of the most probable segmentation among boundaries, from 0 to N."""
    size = len(boundaries)
    scores = np.full((size, size), -np.inf)
    first, last = np.triu_indices(size, 1)
    long = boundaries[last] - boundaries[first] >= min(SHORTEST, boundaries[-1])
    first, last = first[long], last[long]
    scores[first, last] = evidence.scores(boundaries[first], boundaries[last])
    total = np.full(size, -np.inf)
    total[0] = price  # the first segment begins without a change
    came = np.zeros(size, dtype=np.int64)
    for j in range(1, size):
        reached = total[:j] + scores[:j, j] - price
        came[j] = int(np.argmax(reached))
        total[j] = reached[came[j]]
    found, at = [], size - 1
    while at > 0:
        at = int(came[at])
        if at > 0:
            found.append(int(boundaries[at]))
    return found[::-1]


def _between(evidence: SegmentEvidence, before: int, after: int) -> tuple[IntArray, FloatArray]:
    """Return the places of a change between its neighbours, and ln evidence of each up to a constant."""
    places = np.arange(before + SHORTEST, after - SHORTEST + 1)
    ends = np.full(len(places), before), np.full(len(places), after)
    return places, evidence.scores(ends[0], places) + evidence.scores(places, ends[1])


def segmentation(evidence: SegmentEvidence, count: int) -> list[int]:
    """Return the first samples of the most probable segments after the first.

    Exact up to `GRID` samples. In longer records changes are found on a grid, then placed one after the
    other; what stood in for a place off the grid is taken out again.
    """
    if count < 2 * SHORTEST:
        return []
    boundaries = np.unique(np.linspace(0, count, min(count, GRID) + 1).round().astype(np.int64))
    found = best_segmentation(evidence, boundaries, change_price(count))
    if len(boundaries) > count:
        return found
    found = _placed(evidence, found, count)
    number = 0
    while number < len(found):
        near = found[max(number - 1, 0) : number] + found[number + 1 : number + 2]
        before = found[number - 2] if number > 1 else 0
        after = found[number + 2] if number + 2 < len(found) else count
        fewer = _placed(evidence, near, after, before)
        gain = _total(evidence, fewer, before, after) - _total(
            evidence, found[max(number - 1, 0) : number + 2], before, after
        )
        if gain + change_price(count) > 0.0:
            found = found[: max(number - 1, 0)] + fewer + found[number + 2 :]
            number = max(number - 2, 0)
        else:
            number += 1
    return found


def _total(evidence: SegmentEvidence, changes: list[int], before: int, after: int) -> float:
    """Return ln evidence of the segments between two samples."""
    known = np.array([before, *changes, after])
    return float(evidence.scores(known[:-1], known[1:]).sum())


def _placed(evidence: SegmentEvidence, changes: list[int], count: int, first: int = 0) -> list[int]:
    """Return the changes between two samples, each where it is most probable beside the others."""
    for _ in range(3):
        known = [first, *changes, count]
        moved: list[int] = []
        for number in range(1, len(known) - 1):
            places, scores = _between(evidence, moved[-1] if moved else first, known[number + 1])
            moved.append(int(places[np.argmax(scores)]) if len(places) else known[number])
        if moved == changes:
            break
        changes = moved
    return changes


def moment(evidence: SegmentEvidence, time: FloatArray, before: int, after: int) -> Moment:
    """Return when the change between two neighbouring ones (or ends) happened, with its 90 % interval."""
    places, scores = _between(evidence, before, after)
    weight = np.exp(scores - scores.max())
    weight /= weight.sum()
    # a change of the first sample `place` lies between this one and the one before, anywhere
    edges = np.concatenate((time[places - 1], time[places[-1:]]))
    share = np.concatenate((np.zeros(1), np.cumsum(weight)))
    value, low, high = np.interp((0.5, 0.05, 0.95), share, edges)
    return Moment(float(value), float(low), float(high))


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of a record.

    Attributes
    ----------
    first, last : int
        Its first sample, and the one after its last.
    begin : Moment or None
        When it began; None for the first of the record.
    holds : (C,) ndarray of bool
        Whether a channel holds a gap there.
    size : (C,) ndarray
        Root mean square of each channel's residual over its noise; nan without samples.
    """

    first: int
    last: int
    begin: Moment | None
    holds: BoolArray
    size: FloatArray


def segments_of(
    series: FloatArray, used: BoolArray, time: FloatArray, freedom: FloatArray
) -> tuple[Segment, ...]:
    """Return the segments of a record.

    Parameters
    ----------
    series : (N, C) ndarray
        Residuals in units of the noise, of unit variance where the model is right.
    used : (N, C) ndarray of bool
        Samples that count.
    time : (N,) ndarray
        [s], increasing.
    freedom : (C,) ndarray
        Degrees of freedom of the noise records; 0 without one.
    """
    count = len(series)
    evidence = SegmentEvidence(series, used, freedom)
    known = [0, *segmentation(evidence, count), count]
    found = []
    for number, (first, last) in enumerate(pairwise(known)):
        quiet, gap = evidence.quiet_and_gap(np.array([first]), np.array([last]))
        kept = used[first:last]
        samples = kept.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            square = np.sum(np.where(kept, series[first:last], 0.0) ** 2, axis=0) / samples
        odds = gap[0] - quiet[0] + np.log(GAP_SHARE / (1.0 - GAP_SHARE))
        holds = (odds > 0.0) & (square > 1.0)
        begin = moment(evidence, time, known[number - 1], last) if number else None
        found.append(Segment(first, last, begin, holds, np.sqrt(square)))
    return tuple(found)


def gap_windows(residuals: ResidualSet, *, seed: int = 0, with_effect: bool = False) -> tuple[GapWindow, ...]:
    """Return when there is a gap in the records in time: one window for each stretch of about one size.

    Parameters
    ----------
    residuals : ResidualSet
        Of a hypothesis.
    seed : int
        Of the draw that restores what the fit has absorbed.
    with_effect : bool
        Whether the hypothesis is the best one, not the model as it was.
    """
    found: list[GapWindow] = []
    white = residuals.white(np.random.default_rng((seed, 1)))
    for item, series in zip(residuals.trials, white, strict=True):
        if item.trial.kind is TrialKind.STATIC:
            continue
        freedom = np.array([residuals.degrees_of_freedom(name) for name in item.trial.channels])
        found += _windows(item, segments_of(series, item.used, item.trial.time, freedom), with_effect)
    return tuple(found)


def _windows(item: FittedTrial, segments: Sequence[Segment], with_effect: bool) -> list[GapWindow]:
    """Return the windows of a record: neighbouring segments with a gap, of about one size."""
    trial, found = item.trial, list[GapWindow]()
    runs: list[list[Segment]] = []
    last = 0.0
    for segment in segments:
        size = float(np.max(segment.size, where=segment.holds, initial=0.0))
        if size > 0.0:
            apart = last == 0.0 or max(size, last) > STEP * min(size, last)
            if apart:
                runs.append([])
            runs[-1].append(segment)
        last = size
    for run in runs:
        holds = np.any([segment.holds for segment in run], axis=0)
        weights = np.array([segment.last - segment.first for segment in run], dtype=float)
        square = np.nan_to_num(np.array([segment.size**2 for segment in run]))
        size = np.sqrt(weights @ square / weights.sum())
        following = next((segment for segment in segments if segment.first == run[-1].last), None)
        found.append(
            GapWindow(
                trial.name, tuple(name for name, flag in zip(trial.channels, holds, strict=True) if flag),
                run[0].begin, None if following is None else following.begin,
                float(trial.time[0]), float(trial.time[-1]), float(np.max(size, where=holds, initial=0.0)),
                with_effect,
            )
        )  # fmt: skip
    return found
