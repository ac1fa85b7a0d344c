"""Modes of a record of accelerations, each with its covariance.

Ambient vibration: covariance-driven stochastic subspace identification (Peeters and De Roeck 1999). The
correlations of the record have the covariance that its blocks show, and it is propagated to first order
(Reynders, Pintelon and De Roeck 2008); blocks must be long beside the memory of the modes.
Free decay: the same identification as a start, then least squares with the modes common to all channels; its
covariance is that of the least squares, with white noise of its own on each channel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from calibration.errors import ExperimentDataError, said
from reporting.arrays import Float
from reporting.choices import one_of

from .damped_cosine import ComplexArray, DampedCosines, Solution, modal_slopes

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

    value: Float
    covariance: Float

    @property
    def frequency(self) -> Float:
        """Natural frequencies (M,) [Hz]."""
        return self.value[:, 0]

    @property
    def damping_ratio(self) -> Float:
        """Damping ratios (M,)."""
        return self.value[:, 1]

    @property
    def shape(self) -> Float:
        """Shapes (M, A - 1), divided by that at the first accelerometer."""
        return self.value[:, 2:]

    @property
    def standard_error(self) -> Float:
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
    InvalidChoiceError
        If the kind is neither of the two.
    ExperimentDataError
        If the record holds values that are not finite or is too short, a band is none, or above half the
        sampling rate, or overlaps another.
    """
    one_of(kind, get_args(RecordKind), "kind")
    record, limits = _checked(acceleration, sampling_rate, bands)
    fewest = LARGEST_ORDER // record.shape[1] + 2
    lags = int(np.clip(np.ceil(2.0 * sampling_rate / limits.min()), fewest, _MOST_LAGS))
    needed = (BLOCKS if kind == "ambient" else 4) * 2 * lags
    if len(record) < needed:
        few = len(record), needed
        raise ExperimentDataError(said("record.short", few=few))
    way = partial(_ambient, modes=len(limits)) if kind == "ambient" else _decay
    found, covariances = way(record, sampling_rate, lags)
    strongest = [found.strongest(low, high) for low, high in limits]
    chosen = {mode: pole for mode, pole in enumerate(strongest) if pole is not None}
    shape = len(limits), 1 + record.shape[1]
    value, covariance = np.full(shape, np.nan), np.full((*shape, shape[1]), np.nan)
    if chosen:
        value[[*chosen]] = [found.values(pole) for pole in chosen.values()]
        covariance[[*chosen]] = covariances([*chosen.values()])
    return IdentifiedModes(value, covariance)


def _checked(acceleration: ArrayLike, rate: float, bands: ArrayLike) -> tuple[Float, Float]:
    record = np.array(acceleration, dtype=np.float64)
    record = record[:, None] if record.ndim == 1 else record
    limits = np.array(bands, dtype=np.float64)
    if record.ndim != 2 or not np.all(np.isfinite(record)):
        raise ExperimentDataError(said("record.finite"))
    if limits.ndim != 2 or limits.shape[1] != 2 or not np.all(np.diff(limits, prepend=0.0) > 0.0):
        raise ExperimentDataError("each band is its least and its largest frequency [Hz], above zero.")
    if limits.max() > 0.5 * rate:
        rates = limits.max(), rate, 0.5 * rate
        raise ExperimentDataError(said("record.band_end", rates=rates))
    if 2 * len(limits) > LARGEST_ORDER:
        raise ExperimentDataError(said("record.many_modes", most=LARGEST_ORDER // 2, asked=len(limits)))
    rising = limits[np.argsort(limits[:, 0])]
    if np.any(rising[1:, 0] < rising[:-1, 1]):
        raise ExperimentDataError("bands overlap, and one mode could be found in two: part them.")
    dead = np.flatnonzero(np.ptp(record, axis=0) == 0.0)
    if dead.size:
        raise ExperimentDataError(said("record.dead", number=dead[0] + 1))
    return record - record.mean(axis=0), limits


class _Poles(NamedTuple):
    """Poles with positive frequency: s [1/s] (P,), shapes (P, A), shares in the record (P,).

    `seen` (P,) is what each takes off the sum of squares over the scatter, a chi-square where there is noise
    alone, and `places` at how many frequencies noise could have shown as much.
    """

    pole: ComplexArray
    shape: ComplexArray
    share: Float
    seen: Float
    places: int

    @property
    def damped(self) -> NDArray[np.bool_]:
        """Whether each is one of a structure (P,)."""
        ratio = -self.pole.real / np.abs(self.pole)
        return np.asarray((ratio > 0.0) & (ratio < LARGEST_RATIO))

    @property
    def beyond_noise(self) -> NDArray[np.bool_]:
        """Whether noise alone would hardly show so much anywhere (P,)."""
        return np.asarray(self.seen > chdtri(2 + 4 * self.shape.shape[1], _FALSE_MODE / self.places))

    def values(self, chosen: int) -> Float:
        """Return frequency, damping ratio and relative shape of a pole."""
        s = self.pole[chosen]
        relative = (self.shape[chosen, 1:] / self.shape[chosen, 0]).real
        return np.array([abs(s) / (2.0 * np.pi), -s.real / abs(s), *relative])

    def strongest(self, low: float, high: float) -> int | None:
        """Return the pole in a band that the record shows most of; None without one beyond noise."""
        frequency = np.abs(self.pole) / (2.0 * np.pi)
        inside = (frequency >= low) & (frequency <= high) & self.damped
        if not inside.any():
            return None
        best = int(np.argmax(np.where(inside, self.share, -1.0)))
        return best if self.beyond_noise[best] else None


_Found = tuple[_Poles, Callable[[list[int]], list[Float]]]
"""Poles, and what gives the covariances of the values of some of them."""


def _hankel(correlation: Float) -> Float:
    """Return the block Hankel matrix (L C, L C) of correlations (2 L, C, C) from lag one on, C channels."""
    lags, count = len(correlation) // 2, correlation.shape[1]
    place = np.arange(lags)[:, None] + np.arange(lags)
    return np.asarray(correlation[place].transpose(0, 2, 1, 3).reshape(lags * count, lags * count))


class _Subspace:
    """What the correlations of a record (2 L, C, C) say of systems of any order."""

    def __init__(self, correlation: Float, rate: float) -> None:
        self._correlation, self._rate = correlation, rate
        _, self._singular, self._right = np.linalg.svd(_hankel(correlation))

    def _modal(self, correlation: Float, basis: Float) -> tuple[ComplexArray, ...]:
        """Return poles (n,) [1/s], eigenvectors (n, n) and shapes (C, n) as seen on a basis (L C, n)."""
        count = correlation.shape[1]
        observability = _hankel(correlation) @ basis
        transition = np.linalg.lstsq(observability[:-count], observability[count:], rcond=None)[0]
        eigenvalue, vector = np.linalg.eig(transition.astype(np.complex128))
        return np.log(eigenvalue) * self._rate, vector, observability[:count] @ vector

    def _basis(self, order: int) -> Float:
        """Return right singular vectors over the roots of their values (L C, order)."""
        return np.asarray(self._right[:order].T / np.sqrt(self._singular[:order]))

    def poles(self, order: int, variance: Float | float = 1.0) -> tuple[_Poles, float]:
        """Return the poles of the system of an order, and its mean square misfit over the variance.

        `variance` (2 L, C, C) is that of the correlations; without it nothing tells poles from noise.
        """
        basis, count = self._basis(order), self._correlation.shape[1]
        pole, vector, shape = self._modal(self._correlation, basis)
        part = np.linalg.solve(vector, (basis[:count] * self._singular[:order]).T.astype(np.complex128))
        powers = np.exp(np.multiply.outer(np.arange(len(self._correlation)) / self._rate, pole))
        each = np.einsum("cn,ln,nd->nlcd", shape, powers, part)
        inside = pole.imag > 0.0
        left, alone = self._correlation - each.sum(axis=0).real, 2.0 * each[inside].real
        seen = np.sum(((left + alone) ** 2 - left**2) / variance, axis=(1, 2, 3))
        share = np.sqrt(np.sum(np.abs(each[inside]) ** 2, axis=(1, 2, 3)))
        found = _Poles(pole[inside], shape.T[inside], share, seen, len(self._correlation))
        return found, float(np.mean(left**2 / variance))

    def moved(self, change: Float, order: int, poles: ComplexArray) -> _Poles:
        """Return poles under a small change of the correlations, seen on the same basis."""
        pole, _, shape = self._modal(self._correlation + change, self._basis(order))
        nearest = np.argmin(np.abs(pole - poles[:, None]), axis=1)
        ones = np.ones(len(poles))
        return _Poles(pole[nearest], shape.T[nearest], ones, ones, 1)


def _ambient(record: Float, rate: float, lags: int, modes: int) -> _Found:
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
    for order in range(2 * modes, LARGEST_ORDER + 1, 2):
        found, misfit = subspace.poles(order, variance)
        if misfit < 1.0:
            break

    def covariances(chosen: list[int]) -> list[Float]:
        poles = found.pole[chosen]
        # blocks that last as long as the modes remember, by taking some together
        memory = float(np.max(-1.0 / poles.real))
        together = int(np.ceil(memory * rate / length))
        count = BLOCKS // together
        if count < _FEWEST_BLOCKS:
            times = memory, size / rate, _FEWEST_BLOCKS
            raise ExperimentDataError(said("record.memory", times=times))
        long = each[: count * together].reshape(count, together, *whole.shape).mean(axis=1)
        moved = [subspace.moved(_STEP * (one - whole), order, poles) for one in long]
        changes = [
            (np.array([other.values(at) for other in moved]) - found.values(pole)) / _STEP
            for at, pole in enumerate(chosen)
        ]
        return [change.T @ change / (len(long) * (len(long) - 1)) for change in changes]

    return found, covariances


def _decay(record: Float, rate: float, lags: int) -> _Found:
    size = len(record) - 2 * lags
    whole = np.stack([record[lag : lag + size].T @ record[:size] / size for lag in range(1, 2 * lags + 1)])
    start, _ = _Subspace(whole, rate).poles(LARGEST_ORDER)
    waves = DampedCosines(np.arange(len(record)) / rate, record, drift=False)
    poles = start.pole[start.damped & (start.share > _SMALLEST_SHARE * start.share.max())]
    # Most poles of noise are seen at once to be such; those that are left spoil the covariance of the others.
    poles = poles[_of(waves.solve(poles)).beyond_noise]
    while True:
        solution = waves.fit(poles) if poles.size else waves.solve(poles)
        found = _of(solution)
        real = found.damped & found.beyond_noise
        if real.all():
            return found, partial(_decay_covariances, solution)
        poles = found.pole[real]


def _of(solution: Solution) -> _Poles:
    share = np.linalg.norm(solution.amplitude, axis=1)
    return _Poles(solution.pole, solution.amplitude, share, solution.seen, len(solution.fitted))


def _decay_covariances(solution: Solution, chosen: list[int]) -> list[Float]:
    count, channels = solution.amplitude.shape
    found = []
    for pole in chosen:
        first, *others = solution.amplitude[pole].tolist()
        slope = np.zeros((1 + channels, len(solution.covariance)))
        slope[:2, [pole, count + pole]] = modal_slopes(complex(solution.pole[pole]))
        for channel, other in enumerate(others, start=1):
            for which, change in ((channel, 1.0 / first), (0, -other / first**2)):
                place = 2 * count + which * (2 * count + 1) + pole
                slope[1 + channel, [place, place + count]] = change.real, -change.imag
        found.append(slope @ solution.covariance @ slope.T)
    return found
