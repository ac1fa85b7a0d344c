"""Modes of a record of accelerations, each with its covariance.

Ambient vibration: covariance-driven stochastic subspace identification (Peeters and De Roeck 1999).
The covariance of the correlations of the record follows from the differences between its blocks,
and is propagated to first order (Reynders, Pintelon and De Roeck 2008); blocks must be long
compared with the memory of the modes. Free decay: the same identification as a start, then least
squares with the modes common to all channels; the covariance is that of the least squares, with
white noise of its own on each channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from calibration.errors import ExperimentDataError
from reporting.arrays import Float, nan_where_masked
from reporting.choices import require_one_of

from .damped_cosine import ComplexArray, DampedCosineFit, DampedCosines, modal_gradients
from .subspace import IdentifiedPoles, Subspace

RecordKind = Literal["ambient", "decay"]

LARGEST_ORDER = 24
"""Largest number of states of the identified system. The smallest number is used that reproduces
the correlations of the record within their scatter: with more states, poles of noise appear next to
those of modes and disturb them."""
BLOCKS = 50
"""Number of blocks of a record whose differences give the covariance."""
_FEWEST_BLOCKS = 10
_DIFFERENCE_STEP = 1e-4
"""Step of the numerical derivative of poles, as a fraction of a block's difference from the mean
correlations. It is small, so that changed poles can be assigned to the original ones."""
_MOST_LAGS = 40
_SMALLEST_CONTRIBUTION = 1e-2  # of a mode that is fitted to a free decay, over the strongest mode


_FREQUENCY = 0
_DAMPING_RATIO = 1
_SHAPE = slice(2, None)
"""Columns of the values of modes, see `IdentifiedModes`."""


@dataclass(frozen=True)
class IdentifiedModes:
    """M modes at A accelerometers; the values of a mode are NaN if its band shows none.

    Attributes
    ----------
    value : (M, 1 + A) array
        The natural frequency [Hz], the damping ratio [1], and the shape at the accelerometers after
        the first, divided by that at the first [1].
    covariance : (M, 1 + A, 1 + A) array
        The covariance of the values of each mode. Different modes are treated as independent.
    """

    value: Float
    covariance: Float

    @property
    def frequency(self) -> Float:
        """Natural frequencies (M,) [Hz]."""
        return self.value[:, _FREQUENCY]

    @property
    def damping_ratio(self) -> Float:
        """Damping ratios (M,) [1]."""
        return self.value[:, _DAMPING_RATIO]

    @property
    def shape(self) -> Float:
        """Shapes (M, A - 1), divided by that at the first accelerometer [1]."""
        return self.value[:, _SHAPE]

    @property
    def standard_error(self) -> Float:
        """Standard errors of the values, (M, 1 + A)."""
        return np.asarray(np.sqrt(np.einsum("mii->mi", self.covariance)))


def identify_modes(
    acceleration: ArrayLike,
    sampling_rate: float,
    bands: ArrayLike,
    kind: RecordKind = "ambient",
) -> IdentifiedModes:
    """Return the strongest mode of a record in each frequency band.

    Parameters
    ----------
    acceleration : (N, A) array
        The record, in any unit. Its mean is removed.
    sampling_rate : float
        The sampling rate of the record [Hz].
    bands : (M, 2) array
        The smallest and the largest natural frequency of each mode [Hz].
    kind : {"ambient", "decay"}
        Vibration under unknown forces, whose spectrum is about flat in the bands; or free decay.

    Raises
    ------
    InvalidChoiceError
        If the kind is neither of the two.
    ExperimentDataError
        If the record holds values that are not finite or is too short, or a band is empty, reaches
        above half the sampling rate, or overlaps another.
    """
    require_one_of(kind, get_args(RecordKind), "kind")
    record = _centred_record(acceleration)
    limits = np.array(nan_where_masked(bands))
    _check_bands(limits, sampling_rate)
    _refuse_dead_accelerometers(record)
    lags = _number_of_lags(limits, sampling_rate, channels=record.shape[1])
    _refuse_short_record(record, lags, kind)
    identification: _Identification
    if kind == "ambient":
        identification = _AmbientIdentification(record, sampling_rate, lags, len(limits))
    else:
        identification = _DecayIdentification(record, sampling_rate, lags)
    return _modes_in_bands(identification, limits, values_per_mode=1 + record.shape[1])


def _centred_record(acceleration: ArrayLike) -> Float:
    """Check a record of N samples of A accelerometers, and remove the mean of each."""
    record = np.array(nan_where_masked(acceleration))
    if record.ndim == 1:
        record = record[:, None]
    if record.ndim != 2 or not np.all(np.isfinite(record)):
        raise ExperimentDataError(
            "a record of accelerations must be finite numbers, one row for each sample; remove or "
            "fill lost values first."
        )
    return np.asarray(record - record.mean(axis=0))


def _check_bands(limits: Float, sampling_rate: float) -> None:
    """Raise `ExperimentDataError` if bands (M, 2) [Hz] are empty, overlap or end too high."""
    if limits.ndim != 2 or limits.shape[1] != 2 or not np.all(np.diff(limits, prepend=0.0) > 0.0):
        raise ExperimentDataError(
            "each band must be two positive frequencies [Hz], the lower one first."
        )
    highest = 0.5 * sampling_rate
    if limits.max() > highest:
        raise ExperimentDataError(
            f"a band ends at {limits.max():g} Hz, and a record at {sampling_rate:g} Hz "
            f"shows nothing above {highest:g} Hz."
        )
    if 2 * len(limits) > LARGEST_ORDER:
        raise ExperimentDataError(
            f"{LARGEST_ORDER // 2} modes are identified at most, but {len(limits)} were asked for."
        )
    starts, ends = limits.T
    ascending = np.argsort(starts)
    next_starts = starts[ascending][1:]
    previous_ends = ends[ascending][:-1]
    if np.any(next_starts < previous_ends):
        raise ExperimentDataError(
            "bands overlap, so that one mode could be found in two of them: give bands that do not "
            "overlap."
        )


def _refuse_dead_accelerometers(record: Float) -> None:
    """Raise `ExperimentDataError` if an accelerometer shows a constant value."""
    dead = np.flatnonzero(np.ptp(record, axis=0) == 0.0)
    if dead.size:
        raise ExperimentDataError(
            f"accelerometer {dead[0] + 1} of the record shows the same value throughout: leave it "
            "out, or repair it."
        )


def _number_of_lags(limits: Float, sampling_rate: float, channels: int) -> int:
    """Return half the number of lags of the correlations.

    They should last two periods of the lowest mode. The Hankel matrix must have at least as many
    rows as the largest system has states.
    """
    smallest_number = LARGEST_ORDER // channels + 2
    samples_of_two_periods = np.ceil(2.0 * sampling_rate / limits.min())
    return int(np.clip(samples_of_two_periods, smallest_number, _MOST_LAGS))


def _refuse_short_record(record: Float, lags: int, kind: RecordKind) -> None:
    """Raise `ExperimentDataError` if a record (N, A) is too short for its correlations."""
    # The correlations of a block have 2 `lags` lags. A decay is not divided into blocks, but must
    # be longer than its correlations.
    blocks = BLOCKS if kind == "ambient" else 4
    samples_needed = blocks * 2 * lags
    if len(record) < samples_needed:
        raise ExperimentDataError(
            f"the record has {len(record)} samples; {samples_needed} are needed to estimate modes "
            "and their covariance: record longer, or sample more slowly."
        )


class _Identification(Protocol):
    """The poles of a record, with the covariance of their modal values."""

    poles: IdentifiedPoles

    def covariances(self, numbers: Sequence[int]) -> list[Float]:
        """Return the covariances (1 + A, 1 + A) of the modal values of some poles."""


def _modes_in_bands(
    identification: _Identification, limits: Float, values_per_mode: int
) -> IdentifiedModes:
    """Return the strongest pole in each frequency band (M, 2) [Hz] as a mode.

    A mode has 1 + A values.
    """
    poles = identification.poles
    pole_of_mode: dict[int, int] = {}
    for mode, (low, high) in enumerate(limits):
        pole = poles.strongest(low, high)
        if pole is not None:
            pole_of_mode[mode] = pole
    value = np.full((len(limits), values_per_mode), np.nan)
    covariance = np.full((len(limits), values_per_mode, values_per_mode), np.nan)
    if pole_of_mode:
        covariances = identification.covariances(list(pole_of_mode.values()))
        for (mode, pole), mode_covariance in zip(pole_of_mode.items(), covariances, strict=True):
            value[mode] = poles.modal_values(pole)
            covariance[mode] = mode_covariance
    return IdentifiedModes(value, covariance)


class _AmbientIdentification:
    """Poles of a record of ambient vibration, by stochastic subspace identification.

    Parameters
    ----------
    record : (N, A) array
        The record, without its mean.
    sampling_rate : float
        The sampling rate [Hz].
    lags : int
        Half the number of lags of the correlations.
    mode_count : int
        The number of wanted modes.
    """

    poles: IdentifiedPoles

    def __init__(self, record: Float, sampling_rate: float, lags: int, mode_count: int) -> None:
        self._sampling_rate = sampling_rate
        self._block_length = (len(record) - 2 * lags) // BLOCKS
        self._block_correlations = self._correlate_blocks(record, lags)
        self._correlation = self._block_correlations.mean(axis=0)
        # Variance of the mean of the blocks
        variance = self._block_correlations.var(axis=0, ddof=1) / BLOCKS
        self._subspace = Subspace(self._correlation, sampling_rate)
        # Two states for each mode; stop when the misfit is that of scatter alone.
        for order in range(2 * mode_count, LARGEST_ORDER + 1, 2):
            self._order = order
            self.poles, misfit = self._subspace.poles(order, variance)
            if misfit < 1.0:
                break

    def _correlate_blocks(self, record: Float, lags: int) -> Float:
        """Return the correlations (B, 2 L, A, A) of each block at the lags 1 to 2 L."""
        length = self._block_length
        sample_count = length * BLOCKS
        blocks = record[:sample_count].reshape(BLOCKS, length, -1)
        correlations = []
        for lag in range(1, 2 * lags + 1):
            later_blocks = record[lag : lag + sample_count].reshape(BLOCKS, length, -1)
            correlations.append(later_blocks.transpose(0, 2, 1) @ blocks / length)
        return np.stack(correlations, axis=1)

    def covariances(self, numbers: Sequence[int]) -> list[Float]:
        """Return the covariances (1 + A, 1 + A) of the modal values of some poles.

        Raises
        ------
        ExperimentDataError
            If the record is too short compared with the decay times of the modes.
        """
        poles = self.poles.pole[numbers]
        correlations = self._correlate_long_blocks(poles)
        block_count = len(correlations)

        # The derivative of the modal values along the difference of a block from the mean is the
        # deviation of its values from their mean, to first order. The sum of squared deviations
        # over n (n - 1) is the covariance of a mean of n blocks.
        changed_values = [
            self._subspace.modal_values_after_change(
                _DIFFERENCE_STEP * (block_correlation - self._correlation), self._order, poles
            )
            for block_correlation in correlations
        ]
        covariances = []
        for position, number in enumerate(numbers):
            changed_modal_values = np.array(
                [values_of_poles[position] for values_of_poles in changed_values]
            )
            derivative = (changed_modal_values - self.poles.modal_values(number)) / _DIFFERENCE_STEP
            covariances.append(derivative.T @ derivative / (block_count * (block_count - 1)))
        return covariances

    def _correlate_long_blocks(self, poles: ComplexArray) -> Float:
        """Return the correlations (B', 2 L, A, A) of long, nearly independent blocks.

        Consecutive blocks are joined until they last as long as the slowest mode decays. Raises
        `ExperimentDataError` if there are too few such blocks.
        """
        decay_time = float(np.max(-1.0 / poles.real))
        blocks_per_group = int(np.ceil(decay_time * self._sampling_rate / self._block_length))
        group_count = BLOCKS // blocks_per_group
        if group_count < _FEWEST_BLOCKS:
            duration = self._block_length * BLOCKS / self._sampling_rate
            raise ExperimentDataError(
                f"a mode decays within {decay_time:.3g} s, and the record of {duration:.3g} s is "
                f"less than {_FEWEST_BLOCKS} times as long, too short for a covariance: record "
                "longer."
            )
        used_correlations = self._block_correlations[: group_count * blocks_per_group]
        groups = used_correlations.reshape(group_count, blocks_per_group, *self._correlation.shape)
        return np.asarray(groups.mean(axis=1))


class _DecayIdentification:
    """Poles of a record of free decay, by least squares.

    Parameters
    ----------
    record : (N, A) array
        The record, without its mean.
    sampling_rate : float
        The sampling rate [Hz].
    lags : int
        Half the number of lags of the correlations, which give the starting poles.
    """

    poles: IdentifiedPoles

    def __init__(self, record: Float, sampling_rate: float, lags: int) -> None:
        time = np.arange(len(record)) / sampling_rate
        model = DampedCosines(time, record, drift=False)
        start = _starting_poles(record, sampling_rate, lags)
        # Most poles of noise are recognised before the fit. Those that remain are removed after it
        # and the fit is repeated, since they would spoil the covariance.
        poles = start[_poles_of_fit(model.solve(start)).is_beyond_noise]
        while True:
            self._fit = model.fit(poles) if poles.size else model.solve(poles)
            self.poles = _poles_of_fit(self._fit)
            is_mode = self.poles.is_structural & self.poles.is_beyond_noise
            if is_mode.all():
                return
            poles = self.poles.pole[is_mode]

    def covariances(self, numbers: Sequence[int]) -> list[Float]:
        """Return the covariances (1 + A, 1 + A) of the modal values of some poles."""
        return [_decay_covariance(self._fit, number) for number in numbers]


def _starting_poles(record: Float, sampling_rate: float, lags: int) -> ComplexArray:
    """Return the structural poles (P,) [1/s] in the correlations of a decay.

    Poles whose contribution is below 1 % of the strongest one are left out.
    """
    sample_count = len(record) - 2 * lags
    earlier_samples = record[:sample_count]
    correlations = [
        record[lag : lag + sample_count].T @ earlier_samples / sample_count
        for lag in range(1, 2 * lags + 1)
    ]
    poles, _ = Subspace(np.stack(correlations), sampling_rate).poles(LARGEST_ORDER)
    is_strong = poles.contribution > _SMALLEST_CONTRIBUTION * poles.contribution.max()
    return np.asarray(poles.pole[poles.is_structural & is_strong])


def _poles_of_fit(fit: DampedCosineFit) -> IdentifiedPoles:
    """Return the poles of a fit of damped cosines; their shapes are the amplitudes."""
    return IdentifiedPoles(
        pole=fit.pole,
        shape=fit.amplitude,
        contribution=np.linalg.norm(fit.amplitude, axis=1),
        chi_square=fit.chi_square,
        frequency_count=len(fit.fitted),
    )


def _decay_covariance(fit: DampedCosineFit, number: int) -> Float:
    """Return the covariance (1 + A, 1 + A) of a damped cosine's modal values, to first order."""
    count, channels = fit.amplitude.shape
    first_amplitude, *other_amplitudes = fit.amplitude[number].tolist()
    gradient = np.zeros((1 + channels, len(fit.covariance)))
    # the order of the unknowns begins with the poles: K Re s, K Im s
    parts_of_pole = [number, count + number]
    gradient[:2, parts_of_pole] = modal_gradients(complex(fit.pole[number]))
    for channel, amplitude in enumerate(other_amplitudes, start=1):
        # Relative shape A_c / A_0: derivatives with respect to A_c and to A_0
        by_amplitude = 1.0 / first_amplitude
        by_first_amplitude = -amplitude / first_amplitude**2
        for of_channel, derivative in ((channel, by_amplitude), (0, by_first_amplitude)):
            # After the poles come for each channel K Re A, K Im A and the offset. For an analytic
            # w(A), dRe w = Re w' dRe A - Im w' dIm A.
            real_part = 2 * count + of_channel * (2 * count + 1) + number
            imaginary_part = real_part + count
            gradient[1 + channel, real_part] = derivative.real
            gradient[1 + channel, imaginary_part] = -derivative.imag
    return np.asarray(gradient @ fit.covariance @ gradient.T)
