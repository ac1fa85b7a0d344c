"""Inference of the remainder: size, time and frequency of each channel, with what they cost the evidence.

Given the residuals of a hypothesis, the remainder of each channel is at the maximum of its posterior, by the
exact likelihood of the innovations; size, time and frequency are integrated out by Laplace's method. Half of
the prior of a remainder's kind is on processes that swing. A channel has a remainder only where that pays
against the prior odds: with a model that leaves noise there is none, and nothing changes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, isinf, log, pi

import numpy as np
from numpy.typing import NDArray

from .fitting import CandidateFit, attempt
from .linearisation import Point
from .problem import Problem, misfits
from .remainder import Remainder, innovations

FloatArray = NDArray[np.float64]

LOG_ODDS = -3.0
"""Prior log odds of a remainder in a channel: a right model leaves noise until the data say otherwise."""
ROUNDS = 6
"""Largest number of times that remainder and hypothesis are fitted in turn."""
SETTLED = 0.3
"""Change of the log evidence [nat] below which they are."""
STEPS = 12
"""Steps of a hypothesis at one remainder."""
TIMES = (3.0, 12.0, 50.0, 200.0)
"""Times [samples] at which the search for a remainder begins."""
LARGEST_TIME = 10.0
"""Longest time, over that of the record: beyond it a remainder is a drift."""
CYCLES = (3.0, 30.0)
"""Periods over which one that swings forgets, where the search for it begins."""
PEAKS = 2
LEAST_SIZE, LARGEST_SIZE = 1e-2, 1e5
"""Sizes over the noise that are searched."""
NOISE_SIZES = (0.1, 30.0)
"""The same of the noise's own colour, over its white part."""
NOISE_TIMES = 5.0
"""Times of the noise's own colour that its record lasts at least: else it can neither show nor deny it."""
DIFFERENCE_STEP = 2e-2
"""Of the derivatives of the posterior, in logarithms."""
DESCENTS, CONVERGED, LONGEST_STEP, LEAST_CURVATURE = 12, 0.02, 1.0, 0.3
"""Of Newton's method: steps at most, gain [nat] that ends it, longest step, least curvature believed."""


@dataclass(frozen=True, eq=False)
class RemainderPrior:
    """What is known of remainders before a hypothesis is looked at.

    Attributes
    ----------
    scale : (channels,) ndarray
        Scale of the half-normal prior of the size, over the noise: what *nothing missing* leaves in the
        trials in motion, and no more.
    """

    scale: FloatArray

    @classmethod
    def of(cls, problem: Problem, none: CandidateFit) -> "RemainderPrior":
        """Return the prior from the fit without effect."""
        squares, counts = (np.zeros(len(problem.channel_names)) for _ in range(2))
        quick = np.zeros(len(problem.channel_names))
        for number, data in enumerate(problem.trials):
            if not data.trial.is_dynamic:
                continue
            residual = _plain_residual(problem, number, none)
            np.add.at(squares, data.groups, np.einsum("nc,nc->c", residual, residual))
            np.add.at(counts, data.groups, data.weight.sum(axis=0))
            second = np.diff(residual, 2, axis=0)
            np.add.at(quick, data.groups, np.einsum("nc,nc->c", second, second) / 6.0)
        counts = np.maximum(counts, 1.0)
        noise = np.where(problem.freedom > 0.0, 1.0, quick / counts)  # of which nothing is recorded
        scale = np.sqrt(squares / counts / np.maximum(noise, 1e-12 * squares / counts + 1e-300))
        return cls(np.clip(scale, 10.0 * LEAST_SIZE, LARGEST_SIZE))


@dataclass(frozen=True, eq=False)
class Inferred:
    """Remainders at the maximum of their posterior.

    Attributes
    ----------
    remainder : Remainder
        Of all channels.
    log_factor : float
        What prior and width of their posterior add to the log evidence [nat], beside the likelihood.
    gain : float
        By how much they raise the log evidence at the residuals given [nat], `log_factor` included.
    """

    remainder: Remainder
    log_factor: float
    gain: float


def infer(problem: Problem, found: CandidateFit, prior: RemainderPrior) -> Inferred:
    """Return the remainders that the residuals of a fit ask for.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    found : CandidateFit
        With or without remainders; its residuals are taken as they are before these are filtered out.
    prior : RemainderPrior
        Of the sizes.
    """
    channels = len(problem.channel_names)
    size, time, frequency = np.zeros(channels), np.ones(channels), np.zeros(channels)
    of_noise = np.zeros(channels, dtype=bool)
    log_factor = gain = 0.0
    residuals = [_plain_residual(problem, number, found) for number in range(len(problem.trials))]
    for channel in range(channels):
        series = _Series.of(problem, residuals, channel)
        if series is None:
            continue
        best = _best(series, float(prior.scale[channel]), found.point.remainder, channel)
        if best is not None:
            size[channel], time[channel], frequency[channel] = best.values
            of_noise[channel] = best.of_noise
            log_factor += best.log_factor
            gain += best.gain
    return Inferred(Remainder(size, time, frequency, of_noise), log_factor, gain)


def with_remainder(
    problem: Problem, found: CandidateFit, prior: RemainderPrior, *, rounds: int = ROUNDS
) -> CandidateFit | None:
    """Return a hypothesis fitted together with its remainders, from where it was fitted without.

    Its log evidence counts them: the likelihood of the innovations, prior and width of size, time and
    frequency. None where the structure cannot carry what the fit comes to.
    """
    best: CandidateFit | None = None
    current = found
    for _ in range(rounds):
        inferred = infer(problem, current, prior)
        if not inferred.remainder.acts:
            if current.point.remainder is None:  # white as it was
                return current if best is None else max(best, current, key=_evidence)
            start = replace(current.point, remainder=None)
        else:
            start = replace(current.point, remainder=inferred.remainder)
        again = attempt(problem, found.candidate, start, iterations=STEPS)
        if again is None:
            break
        again = replace(again, log_evidence=again.log_evidence + inferred.log_factor)
        gained = inf if best is None else again.log_evidence - best.log_evidence
        if best is None or gained > 0.0:
            best = again
        current = again
        if gained < SETTLED:
            break
    return best


def plain_point(point: Point) -> Point:
    """Return a point without remainder."""
    return replace(point, remainder=None)


def _evidence(found: CandidateFit) -> float:
    return found.log_evidence


def _plain_residual(problem: Problem, number: int, found: CandidateFit) -> FloatArray:
    """Return the standardised residuals (N, C) of a trial, its remainder not filtered out."""
    if found.point.remainder is None:
        return found.residuals[number]
    return problem.residual(number, plain_point(found.point), found.responses[number])


@dataclass(frozen=True, eq=False)
class _Record:
    """What one trial says of a channel."""

    values: FloatArray
    steps: FloatArray
    used: NDArray[np.bool_]


def _recorded(problem: Problem, name: str) -> _Record | None:
    """Return what was recorded of a channel's noise, over its deviation and whitened as trials are."""
    record, model = problem.campaign.channels[name].noise, problem.noise[name]
    if record is None or record.samples is None or record.interval is None or not np.any(record.samples):
        return None
    values = np.ascontiguousarray(model.whiten(record.samples, record.interval) / model.standard_deviation)
    return _Record(values, np.full(len(values), record.interval), np.ones(len(values), dtype=bool))


@dataclass(frozen=True, eq=False)
class _Series:
    """The records of a channel in motion, and what it shows at rest."""

    records: tuple[_Record, ...]
    at_rest: float  # sum of squares
    count: float
    freedom: float
    noise: _Record | None  # what was recorded of the noise alone, over its own deviation

    @classmethod
    def of(cls, problem: Problem, residuals: list[FloatArray], channel: int) -> "_Series | None":
        """Return the series of a channel, None where it was not in motion."""
        records, at_rest = [], 0.0
        for data, residual in zip(problem.trials, residuals, strict=True):
            for column in np.flatnonzero(data.groups == channel):
                values = np.ascontiguousarray(residual[:, column])
                if data.trial.is_dynamic and data.weight[:, column].sum() > 2.0:
                    records.append(_Record(values, data.steps, data.weight[:, column] > 0.0))
                else:
                    at_rest += float(values @ values)
        count, freedom = float(problem.counts[channel]), float(problem.freedom[channel])
        noise = _recorded(problem, problem.channel_names[channel])
        return cls(tuple(records), at_rest, count, freedom, noise) if records else None

    def misfit(self, size: float, time: float, frequency: float, *, of_noise: bool = False) -> float:
        """Return -ln L [nat] with a remainder; of the noise record too where it is the noise's colour."""
        square, half = self.at_rest, 0.0
        variance = 1.0 + size**2 if of_noise else 1.0
        for record in self.records:
            if size > 0.0:
                more, log_determinant = innovations(
                    record.values, record.steps, record.used, size, time, frequency
                )
                half += log_determinant - 0.5 * float(record.used.sum()) * log(variance)
                more *= variance
            else:
                more = float(record.values @ record.values)
            square += more
        if of_noise and self.noise is not None:
            alone, log_determinant = innovations(
                self.noise.values, self.noise.steps, self.noise.used, size, time, frequency
            )
            white = float(self.noise.values @ self.noise.values)
            half += log_determinant + 0.5 * len(self.noise.values) * log(alone / white)
        if isinf(self.freedom):
            return 0.5 * square + half
        terms = misfits(np.array([self.freedom]), np.array([self.count]), np.array([square]))
        return float(terms[0]) + half

    @property
    def longest(self) -> _Record:
        """The record of most samples."""
        return max(self.records, key=lambda record: len(record.values))


@dataclass(frozen=True)
class _Found:
    values: tuple[float, float, float]
    of_noise: bool
    log_factor: float
    gain: float


def _best(series: _Series, scale: float, known: Remainder | None, channel: int) -> _Found | None:
    """Return the remainder of a channel, or None where it does not pay."""
    longest = series.longest
    interval = float(np.median(longest.steps[1:]))
    duration = max(float(record.steps.sum()) for record in series.records)
    white = series.misfit(0.0, 1.0, 0.0)
    power = sum(float(record.values @ record.values) for record in series.records)
    count = sum(float(record.used.sum()) for record in series.records)
    left = float(np.sqrt(max(power / count - 1.0, 0.05))) if series.freedom > 0.0 else scale
    times = (0.5 * interval, LARGEST_TIME * duration)
    frequencies = (2.0 * pi / duration, pi / interval)
    known_one = None if known is None or known.size[channel] <= 0.0 else known.of(channel)
    sizes = sorted({min(max(value, LEAST_SIZE), LARGEST_SIZE) for value in (left, 0.3 * left, scale)})
    plain = [(size, item * interval) for size in sizes for item in TIMES]
    swinging = [
        (left, cycles * 2.0 * pi / peak, peak)
        for peak in _peaks(longest, interval, frequencies)
        for cycles in CYCLES
    ]
    found = []
    kinds: list[tuple[list[tuple[float, ...]], tuple[tuple[float, float], ...], bool]]
    kinds = [
        (list[tuple[float, ...]](plain), (times,), False),
        (list[tuple[float, ...]](swinging), (times, frequencies), False),
    ]
    if series.noise is not None:
        short = (times[0], float(series.noise.steps.sum()) / NOISE_TIMES)
        own = [(size, item * interval) for size in (0.5, 2.0) for item in TIMES[:2]]
        kinds.append((list[tuple[float, ...]](own), (short,), True))
    for starts, bounds, of_noise in kinds:
        if known_one is not None and (known_one[2] > 0.0) is (len(bounds) == 2):
            starts = [known_one[: 1 + len(bounds)], *starts]
        item = _kind(series, None if of_noise else scale, [np.array(start) for start in starts], bounds)
        if item is not None:
            found.append((*item, of_noise))
    if not found:
        return None
    best = min(found, key=lambda item: item[1] - item[2])
    values, likelihood, log_factor, of_noise = best
    gain = white - likelihood + log_factor
    return _Found(values, of_noise, log_factor, gain) if gain > 0.0 else None


def _kind(
    series: _Series, scale: float | None, starts: list[FloatArray], bounds: tuple[tuple[float, float], ...]
) -> tuple[tuple[float, float, float], float, float] | None:
    """Return values, misfit and log factor of the best remainder that swings (two bounds) or does not.

    Without a scale of its size it is the colour of the noise.
    """
    if not starts or any(low >= high for low, high in bounds):
        return None
    # a half-normal size, times and frequencies flat in their logarithms, half of either kind
    ranges = sum(log(log(high / low)) for low, high in bounds)
    constant = ranges + log(2.0) - LOG_ODDS
    if scale is None:
        constant += log(log(NOISE_SIZES[1] / NOISE_SIZES[0]))
    else:
        constant += log(scale) + 0.5 * log(pi / 2.0)

    def likelihood_of(values: FloatArray) -> float:
        swing = float(values[2]) if len(values) == 3 else 0.0
        return series.misfit(float(values[0]), float(values[1]), swing, of_noise=scale is None)

    def energy(logarithms: FloatArray) -> float:
        values = np.exp(logarithms)
        prior = 0.0 if scale is None else 0.5 * float(values[0] / scale) ** 2 - float(logarithms[0])
        return likelihood_of(values) + prior + constant

    sizes = NOISE_SIZES if scale is None else (LEAST_SIZE, LARGEST_SIZE)
    limits = [(log(low), log(high)) for low, high in (sizes, *bounds)]
    low, high = np.array(limits).T
    points = [np.clip(np.log(start), low, high) for start in starts]
    begin = min(points, key=energy)
    place, least, curvature = _descended(energy, begin, low, high)
    # no direction is wider than a factor e: a size on its lower bound has no curvature
    eigenvalues = np.maximum(np.linalg.eigvalsh(curvature), 1.0)
    width = 0.5 * float(len(place) * log(2.0 * pi) - np.log(eigenvalues).sum())
    values = np.exp(place)
    whole = (float(values[0]), float(values[1]), float(values[2]) if len(values) == 3 else 0.0)
    likelihood = likelihood_of(values)
    return whole, likelihood, width - (least - likelihood)


def _descended(
    energy: Callable[[FloatArray], float], place: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Return the minimum within bounds, its value and the second derivatives, by Newton's method.

    Two or three logarithms need no more, and the second derivatives are those that Laplace's method needs.
    """
    value = energy(place)
    for _ in range(DESCENTS):
        gradient, curvature = _derivatives(energy, place, value)
        eigenvalues, directions = np.linalg.eigh(curvature)
        step = -directions @ ((directions.T @ gradient) / np.maximum(np.abs(eigenvalues), LEAST_CURVATURE))
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max(initial=1e-12)))
        ahead, following = place, value
        for share in (1.0, 0.4, 0.1):
            tried = np.clip(place + share * step, low, high)
            following = energy(tried)
            if following < value:
                ahead = tried
                break
        gained, place, value = value - following, ahead, min(value, following)
        if gained < CONVERGED:
            break
    return place, value, _derivatives(energy, place, value)[1]


def _derivatives(
    energy: Callable[[FloatArray], float], place: FloatArray, value: float
) -> tuple[FloatArray, FloatArray]:
    """Return gradient and second derivatives by central differences."""
    axes = DIFFERENCE_STEP * np.eye(len(place))
    ends = np.array([[energy(place + axis), energy(place - axis)] for axis in axes])
    gradient = (ends[:, 0] - ends[:, 1]) / (2.0 * DIFFERENCE_STEP)
    curvature = np.diag(ends.sum(axis=1) - 2.0 * value)
    for i in range(len(place)):
        for j in range(i):
            mixed = energy(place + axes[i] + axes[j]) + energy(place - axes[i] - axes[j])
            mixed += 2.0 * value - ends[i].sum() - ends[j].sum()
            curvature[i, j] = curvature[j, i] = 0.5 * mixed
    return gradient, curvature / DIFFERENCE_STEP**2


def _peaks(record: _Record, interval: float, limits: tuple[float, float]) -> list[float]:
    """Return the angular frequencies [rad/s] of the largest peaks of a record's smoothed spectrum."""
    count = len(record.values)
    power = np.abs(np.fft.rfft(record.values)) ** 2
    power = np.convolve(power, np.full(3, 1.0 / 3.0), mode="same")
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    best = inner[np.argsort(power[inner])[::-1][:PEAKS]]
    found = 2.0 * pi * best / (count * interval)
    return [float(value) for value in found if limits[0] < value < limits[1]]
