"""Modes of a record of accelerations, each with its covariance.

Ambient vibration: covariance-driven stochastic subspace identification (Peeters and De Roeck 1999). The
correlations of the record have the covariance that its blocks show, and it is propagated to first order
(Reynders, Pintelon and De Roeck 2008); blocks must be long beside the memory of the modes.
Free decay: the same identification as a start, then least squares with the modes common to all channels; its
covariance is that of the least squares, with white noise of its own on each channel.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import chdtri

from calibration.errors import ExperimentDataError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

RecordKind = Literal["ambient", "decay"]

LARGEST_ORDER = 24
"""States of the identified system at most. The least number is taken whose correlations are those of the
record within their scatter: with more, poles of noise come to lie beside those of modes and spoil them."""
BLOCKS = 50
"""Of a record, from whose differences the covariance follows."""
_FEWEST_BLOCKS = 10
_STEP = 1e-4
"""Share of the difference of a block by which correlations are changed: small, that no pole is mistaken."""
LARGEST_RATIO = 0.3
"""A mode with more damping is none of a structure."""
_MOST_LAGS = 40
_SMALLEST_SHARE = 1e-2  # of the strongest mode, from which one is fitted to a free decay
_FALSE_MODE = 1e-3
"""Probability that noise alone is taken for a mode, over all frequencies where one could have been found."""
_MOST_EVALUATIONS = 300  # of the least squares, for each unknown


@dataclass(frozen=True)
class IdentifiedModes:
    """M modes at A accelerometers; NaN where a band shows no mode that noise alone would not show.

    Attributes
    ----------
    value : (M, 1 + A)
        Natural frequency [Hz], damping ratio [1], and the shape at the accelerometers behind the first,
        divided by that at the first [1].
    covariance : (M, 1 + A, 1 + A)
        Of the values of each mode; modes are taken as independent of each other.
    """

    value: FloatArray
    covariance: FloatArray

    @property
    def frequency(self) -> FloatArray:
        """Natural frequencies (M,) [Hz]."""
        return self.value[:, 0]

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,)."""
        return self.value[:, 1]

    @property
    def shape(self) -> FloatArray:
        """Shapes (M, A - 1), divided by that at the first accelerometer."""
        return self.value[:, 2:]

    @property
    def standard_error(self) -> FloatArray:
        """Of the values, (M, 1 + A)."""
        return np.asarray(np.sqrt(np.einsum("mii->mi", self.covariance)))


def identify_modes(
    acceleration: ArrayLike,
    sampling_rate: float,
    bands: ArrayLike,
    kind: RecordKind = "ambient",
) -> IdentifiedModes:
    """Identify one mode in each band of frequency: the one that the record shows most of.

    Parameters
    ----------
    acceleration : (N, A)
        The record, in any unit. Its mean is taken out.
    sampling_rate : float
        Of the record [Hz].
    bands : (M, 2)
        Least and largest natural frequency of each mode [Hz].
    kind : {"ambient", "decay"}
        Vibration under forces that nobody knows, as even over the band as may be; or free decay.

    Raises
    ------
    ExperimentDataError
        If the record holds values that are not finite or is too short, a band is none, or above half the
        sampling rate, or overlaps another.
    """
    record, limits = _checked(acceleration, sampling_rate, bands)
    lags = int(
        np.clip(np.ceil(2.0 * sampling_rate / limits.min()), LARGEST_ORDER // record.shape[1] + 2, _MOST_LAGS)
    )
    if len(record) < (BLOCKS if kind == "ambient" else 4) * 2 * lags:
        raise ExperimentDataError(
            f"the record has {len(record)} samples; {(BLOCKS if kind == 'ambient' else 4) * 2 * lags} are "
            "needed to tell modes and their covariance: record longer, or take a smaller sampling rate."
        )
    if kind == "ambient":
        return _ambient(record, sampling_rate, limits, lags)
    return _decay(record, sampling_rate, limits, lags)


def _checked(acceleration: ArrayLike, rate: float, bands: ArrayLike) -> tuple[FloatArray, FloatArray]:
    record = np.array(acceleration, dtype=np.float64)
    record = record[:, None] if record.ndim == 1 else record
    limits = np.array(bands, dtype=np.float64)
    if record.ndim != 2 or not np.all(np.isfinite(record)):
        raise ExperimentDataError(
            "a record of accelerations must be finite numbers, one row for each sample; lost values must be "
            "cut out or filled before."
        )
    if (
        limits.ndim != 2
        or limits.shape[1] != 2
        or not np.all((limits[:, 0] > 0) & (limits[:, 1] > limits[:, 0]))
    ):
        raise ExperimentDataError("each band is its least and its largest frequency [Hz], above zero.")
    if limits.max() > 0.5 * rate:
        raise ExperimentDataError(
            f"a band ends at {limits.max():g} Hz, and a record at {rate:g} Hz shows nothing above "
            f"{0.5 * rate:g} Hz."
        )
    if 2 * len(limits) > LARGEST_ORDER:
        raise ExperimentDataError(
            f"{LARGEST_ORDER // 2} modes are identified at most, and {len(limits)} are asked for."
        )
    rising = limits[np.argsort(limits[:, 0])]
    if np.any(rising[1:, 0] < rising[:-1, 1]):
        raise ExperimentDataError("bands overlap, and one mode could be found in two: part them.")
    dead = np.flatnonzero(np.ptp(record, axis=0) == 0.0)
    if dead.size:
        raise ExperimentDataError(
            f"accelerometer {dead[0] + 1} of the record shows one value throughout: leave it out, or mend it."
        )
    return record - record.mean(axis=0), limits


@dataclass(frozen=True)
class _Poles:
    """Poles of an identified system with positive frequency: s [1/s] (P,), shapes (P, A), shares (P,).

    `seen` (P,) is what each takes off the sum of squares over the scatter, which is a chi-square of noise.
    """

    pole: ComplexArray
    shape: ComplexArray
    share: FloatArray
    seen: FloatArray

    def values(self, chosen: int) -> FloatArray:
        """Return frequency, damping ratio and relative shape of a pole."""
        s = self.pole[chosen]
        relative = (self.shape[chosen, 1:] / self.shape[chosen, 0]).real
        return np.array([abs(s) / (2.0 * np.pi), -s.real / abs(s), *relative])

    def strongest(self, low: float, high: float, places: int) -> int | None:
        """Return the pole in a band that the record shows most of; None without one beyond noise."""
        frequency, ratio = np.abs(self.pole) / (2.0 * np.pi), -self.pole.real / np.abs(self.pole)
        inside = (frequency >= low) & (frequency <= high) & (ratio > 0.0) & (ratio < LARGEST_RATIO)
        if not inside.any():
            return None
        best = int(np.argmax(np.where(inside, self.share, -1.0)))
        return best if self.beyond_noise(places)[best] else None

    def beyond_noise(self, places: int) -> NDArray[np.bool_]:
        """Return whether noise alone would hardly show so much at any of `places` frequencies (P,)."""
        freedom = 2 + 4 * self.shape.shape[1]
        return np.asarray(self.seen > chdtri(freedom, _FALSE_MODE / places))

    def nearest(self, pole: complex) -> int:
        """Return the pole that is nearest to a given one."""
        return int(np.argmin(np.abs(self.pole - pole)))


class _Subspace:
    """Singular vectors of the block Hankel matrix of correlations (2 L, C, C) from lag one on, C channels."""

    def __init__(self, correlation: FloatArray, rate: float) -> None:
        self._correlation, self._rate = correlation, rate
        self._left, self._singular, right = np.linalg.svd(self._hankel(correlation))
        self._right = right.T

    @staticmethod
    def _hankel(correlation: FloatArray) -> FloatArray:
        lags, count = len(correlation) // 2, correlation.shape[1]
        place = np.arange(lags)[:, None] + np.arange(lags)
        return np.asarray(correlation[place].transpose(0, 2, 1, 3).reshape(lags * count, lags * count))

    def _modal(self, left: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return eigenvalues (n,), their vectors (n, n) and shapes (C, n), of a basis (L C, n)."""
        count = self._correlation.shape[1]
        observability = left * np.sqrt(self._singular[: left.shape[1]])
        transition = np.linalg.lstsq(observability[:-count], observability[count:], rcond=None)[0]
        eigenvalue, vector = np.linalg.eig(transition.astype(np.complex128))
        return eigenvalue, vector, observability[:count] @ vector

    def poles(self, order: int, variance: FloatArray | None = None) -> tuple[_Poles, float]:
        """Return the poles of the system of an order, and its mean square misfit over the variance.

        `variance` (2 L, C, C) is that of the correlations; without it the misfit and what each pole takes
        off it are NaN.
        """
        eigenvalue, vector, shape = self._modal(self._left[:, :order])
        count = self._correlation.shape[1]
        control = np.sqrt(self._singular[:order])[:, None] * self._right[:count, :order].T
        part = np.linalg.solve(vector, control.astype(np.complex128))
        powers = eigenvalue ** np.arange(len(self._correlation))[:, None]
        model = np.asarray(np.einsum("cn,ln,nd->lcd", shape, powers, part).real)
        share = np.linalg.norm(shape, axis=0) * np.linalg.norm(part, axis=1) * np.linalg.norm(powers, axis=0)
        inside = eigenvalue.imag > 0.0
        seen, misfit = np.full(inside.sum(), np.nan), np.nan
        if variance is not None:
            left = self._correlation - model
            misfit = float(np.mean(left**2 / variance))
            alone = 2.0 * np.einsum("cn,ln,nd->nlcd", shape[:, inside], powers[:, inside], part[inside]).real
            seen = np.sum(((left + alone) ** 2 - left**2) / variance, axis=(1, 2, 3))
        pole = np.asarray(np.log(eigenvalue[inside]) * self._rate, dtype=np.complex128)
        return _Poles(pole, shape.T[inside], share[inside], seen), misfit

    def changed(self, change: FloatArray, order: int, step: float) -> _Poles:
        """Return the poles under a small change of the correlations; singular vectors to first order."""
        within, beyond = slice(None, order), slice(order, None)
        turned = self._left.T @ (step * self._hankel(change)) @ self._right
        s, rest = self._singular[within], self._singular[beyond, None]
        mixed = (turned[beyond, within] * s + rest * turned[within, beyond].T) / (s**2 - rest**2)
        eigenvalue, _, shape = self._modal(self._left[:, within] + self._left[:, beyond] @ mixed)
        inside = eigenvalue.imag > 0.0
        return _Poles(
            np.asarray(np.log(eigenvalue[inside]) * self._rate, dtype=np.complex128),
            shape.T[inside],
            *np.ones((2, inside.sum())),
        )


def _ambient(record: FloatArray, rate: float, bands: FloatArray, lags: int) -> IdentifiedModes:
    length = (len(record) - 2 * lags) // BLOCKS
    size = length * BLOCKS
    blocks = record[:size].reshape(BLOCKS, length, -1)
    each = np.stack(
        [
            record[lag : lag + size].reshape(BLOCKS, length, -1).transpose(0, 2, 1) @ blocks / length
            for lag in range(1, 2 * lags + 1)
        ],
        axis=1,
    )  # (B, 2 L, A, A)
    whole = each.mean(axis=0)
    variance = each.var(axis=0, ddof=1) / BLOCKS
    subspace = _Subspace(whole, rate)
    for order in range(2 * len(bands), LARGEST_ORDER + 1, 2):
        found, misfit = subspace.poles(order, variance)
        if misfit < 1.0:
            break
    width = 1 + record.shape[1]
    value = np.full((len(bands), width), np.nan)
    covariance = np.full((len(bands), width, width), np.nan)
    chosen = [found.strongest(low, high, 2 * lags) for low, high in bands]
    each = _long_blocks(each, length / rate, [found.pole[pole] for pole in chosen if pole is not None])
    changed = [subspace.changed(one - whole, order, _STEP) for one in each]
    for mode, pole in enumerate(chosen):
        if pole is None:
            continue
        value[mode] = found.values(pole)
        moved = np.array([other.values(other.nearest(found.pole[pole])) for other in changed])
        moved = (moved - value[mode]) / _STEP
        covariance[mode] = moved.T @ moved / (len(each) * (len(each) - 1))
    return IdentifiedModes(value, covariance)


def _long_blocks(each: FloatArray, duration: float, poles: list[complex]) -> FloatArray:
    """Return the correlations of blocks that last as long as the modes remember, by taking some together."""
    memory = max((-1.0 / pole.real for pole in poles), default=0.0)
    together = int(np.ceil(memory / duration)) or 1
    count = len(each) // together
    if count < _FEWEST_BLOCKS:
        raise ExperimentDataError(
            f"a mode dies away in {memory:.3g} s, and the record of {len(each) * duration:.3g} s holds that "
            f"less than {_FEWEST_BLOCKS} times, too few for a covariance: record longer."
        )
    return np.asarray(each[: count * together].reshape(count, together, *each.shape[1:]).mean(axis=1))


def _decay(record: FloatArray, rate: float, bands: FloatArray, lags: int) -> IdentifiedModes:
    size = len(record) - 2 * lags
    whole = np.stack([record[lag : lag + size].T @ record[:size] / size for lag in range(1, 2 * lags + 1)])
    start, _ = _Subspace(whole, rate).poles(LARGEST_ORDER)
    ratio = -start.pole.real / np.abs(start.pole)
    real = (ratio > 0.0) & (ratio < LARGEST_RATIO) & (start.share > _SMALLEST_SHARE * start.share.max())
    poles = start.pole[real]
    time = np.arange(len(record)) / rate
    # Most poles of noise are seen at once to be such; those that are left spoil the covariance of the others.
    poles = poles[_at_poles(record, time, poles)[0].beyond_noise(len(record))]
    while poles.size:
        found, basis, left = _at_poles(record, time, _moved(record, time, poles))
        ratio = -found.pole.real / np.abs(found.pole)
        real = (ratio > 0.0) & (ratio < LARGEST_RATIO) & found.beyond_noise(len(record))
        if real.all():
            covariance = _decay_covariance(time, basis, found.pole, found.shape, left)
            return _of_decay(found, covariance, bands, len(record))
        poles = found.pole[real]
    shape = (len(bands), 1 + record.shape[1])
    return IdentifiedModes(np.full(shape, np.nan), np.full((*shape, shape[1]), np.nan))


def _waves(pole: ComplexArray, time: FloatArray) -> FloatArray:
    """Return the real and imaginary waves of P poles and an offset, (N, 2 P + 1)."""
    wave = np.exp(np.minimum(pole.real, 0.0) * time[:, None] + 1j * pole.imag * time[:, None])
    return np.hstack([wave.real, -wave.imag, np.ones((len(time), 1))])


def _moved(record: FloatArray, time: FloatArray, poles: ComplexArray) -> ComplexArray:
    """Return the poles whose waves fit best, begun at `poles`."""
    scale = np.abs(poles)

    def pole_of(unknown: FloatArray) -> ComplexArray:
        return np.asarray(scale * (unknown[: poles.size] + 1j * unknown[poles.size :]))

    def residual(unknown: FloatArray) -> FloatArray:
        orthogonal = np.linalg.qr(_waves(pole_of(unknown), time))[0]
        return np.asarray(record - orthogonal @ (orthogonal.T @ record)).ravel()

    first = np.concatenate([poles.real / scale, poles.imag / scale])
    most = _MOST_EVALUATIONS * len(first)
    return pole_of(least_squares(residual, first, method="lm", xtol=1e-10, ftol=1e-10, max_nfev=most).x)


def _at_poles(
    record: FloatArray, time: FloatArray, poles: ComplexArray
) -> tuple[_Poles, FloatArray, FloatArray]:
    """Return poles with the amplitudes (P, A) that fit best, their waves, and what is left (N, A)."""
    basis = _waves(poles, time)
    coefficient = np.asarray(np.linalg.lstsq(basis, record, rcond=None)[0], dtype=np.float64)
    amplitude = coefficient[: poles.size] + 1j * coefficient[poles.size : -1]
    left = record - basis @ coefficient
    seen = _seen_in_decay(basis, coefficient, left)
    return _Poles(poles, amplitude, np.linalg.norm(amplitude, axis=1), seen), basis, left


def _seen_in_decay(basis: FloatArray, coefficient: FloatArray, left: FloatArray) -> FloatArray:
    """Return the squared amplitudes of each pole over their covariance, summed over the channels (P,)."""
    count = len(coefficient) // 2
    spread = np.linalg.pinv(basis.T @ basis)
    variance = np.sum(left**2, axis=0) / (len(left) - len(coefficient))
    seen = np.zeros(count)
    for pole in range(count):
        rows = [pole, count + pole]
        weight = np.linalg.pinv(spread[np.ix_(rows, rows)])
        seen[pole] = np.sum(np.einsum("ic,ij,jc->c", coefficient[rows], weight, coefficient[rows]) / variance)
    return seen


def _decay_covariance(
    time: FloatArray, basis: FloatArray, pole: ComplexArray, amplitude: ComplexArray, left: FloatArray
) -> FloatArray:
    """Covariance of Re s, Im s, then of Re and Im of the amplitudes and of the offset of each channel."""
    count, channels = amplitude.shape
    information = np.zeros((2 * count + channels * (2 * count + 1),) * 2)
    freedom = left.size - len(information)
    for channel in range(channels):
        wave = time[:, None] * (basis[:, :count] - 1j * basis[:, count:-1]) * amplitude[:, channel]
        own = np.hstack([wave.real, -wave.imag, basis])
        own = own / (np.sqrt(np.sum(left[:, channel] ** 2) * channels / freedom) or 1.0)
        begin = 2 * count + channel * (2 * count + 1)
        rows = np.r_[: 2 * count, begin : begin + 2 * count + 1]
        information[np.ix_(rows, rows)] += own.T @ own
    size = np.sqrt(np.diag(information))
    return np.asarray(np.linalg.pinv(information / np.outer(size, size)) / np.outer(size, size))


def _of_decay(found: _Poles, covariance: FloatArray, bands: FloatArray, samples: int) -> IdentifiedModes:
    count, channels = found.shape.shape
    value = np.full((len(bands), 1 + channels), np.nan)
    result = np.full((len(bands), 1 + channels, 1 + channels), np.nan)
    for mode, (low, high) in enumerate(bands):
        pole = found.strongest(low, high, samples)
        if pole is None:
            continue
        s, amplitude = found.pole[pole], found.shape[pole]
        value[mode] = found.values(pole)
        slope = np.zeros((1 + channels, len(covariance)))
        size = abs(s)
        slope[0, [pole, count + pole]] = np.array([s.real, s.imag]) / size / (2.0 * np.pi)
        slope[1, [pole, count + pole]] = np.array([-(s.imag**2), s.real * s.imag]) / size**3
        for channel in range(1, channels):
            ratio = amplitude[channel] / amplitude[0]
            for which, factor in ((channel, 1.0), (0, -ratio)):
                change = factor / amplitude[0]
                place = 2 * count + which * (2 * count + 1) + pole
                slope[1 + channel, [place, place + count]] = change.real, -change.imag
        result[mode] = slope @ covariance @ slope.T
    return IdentifiedModes(value, result)
