"""Readings of a wing's two flapwise modes from ring-downs, with their whole uncertainty."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from calibration.dynamics.damped_cosine import DampedCosines, RingDownMode
from calibration.dynamics.trials import (
    PUBLISHED_DAMPING_RATIOS,
    PUBLISHED_FREQUENCIES,
    Fits,
    RingDownFit,
    amplitude_dependence,
)
from calibration.errors import ExperimentDataError
from calibration.result.record import QuantityReading
from reporting.arrays import Float

MODAL = ("frequency_1", "frequency_2", "damping_ratio_1", "damping_ratio_2")
"""Names of the readings that a ring-down gives."""

_SIGNIFICANT_SCATTER = 0.95
_SIGNIFICANT_DIFFERENCE = 2.0  # standard errors
_LATER_STARTS = (0.04, 0.08)  # s; one and two and a half periods of the second mode
_FEWEST_WINDOWS = 6
_SAME_MODE = 0.2  # relative change of frequency beyond which a fit has found another mode
_VISIBLE = 1.0  # amplitude of the second mode at the later start, over the residuals


def modal_readings(
    values: Sequence[float], deviations: Sequence[float]
) -> tuple[QuantityReading, ...]:
    """Return frequencies and damping ratios of two modes as readings with standard deviations.

    Parameters
    ----------
    values, deviations : sequence of 4 floats
        The values and standard deviations of f1, f2 [Hz], zeta1 and zeta2 [1].

    Raises
    ------
    ExperimentDataError
        If a standard deviation is zero, as for a simulated record without noise.
    """
    readings = []
    for name, value, deviation in zip(MODAL, values, deviations, strict=True):
        if not deviation > 0.0:
            raise ExperimentDataError(
                f"ring-down: {name} is estimated as {value:g} without any uncertainty; give the "
                "records as they were measured, with their noise."
            )
        readings.append(QuantityReading(name, "ring-down", value, deviation))
    return tuple(readings)


class _Estimate(NamedTuple):
    """A mean and its standard error."""

    mean: float
    standard_error: float


class _SystematicTerms(NamedTuple):
    """Systematic uncertainty of frequency [Hz] and damping ratio [1] of a mode."""

    frequency: float
    damping_ratio: float


def measured_modes(trials: Fits) -> tuple[QuantityReading, ...]:
    """Return mean frequencies and damping ratios of fitted trials, with their uncertainty.

    The statistical part is the standard error of the mean over the trials. It follows from the
    least-squares fits, or, if the trials scatter more than these explain (chi-square at 5 %), from
    their scatter, widened as Student's t.

    Systematic terms are added in quadrature. Each counts only if it exceeds twice its own standard
    error, so that a linear wing gets none by chance:

    - The first mode depends on the amplitude: a real wing softens, and no single amplitude is the
      right one for a linear model. Frequency and damping ratio in sliding windows are fitted by a
      line over the logarithm of the amplitude; the term is the slope times the standard deviation
      of this logarithm.
    - The second mode depends on the choice of the fit. Both modes are fitted again with free
      frequencies, from 40 and 80 ms later on and, if the frequencies had been taken from the
      spectrum, also from the start of the cropped record; the term is the root mean square of the
      differences.

    Raises
    ------
    ExperimentDataError
        If an uncertainty is zero, see `modal_readings`.
    """
    first_modes = [fit.modes[0] for fit in trials]
    second_modes = [fit.modes[1] for fit in trials]
    frequency_1 = _mean_frequency(first_modes)
    frequency_2 = _mean_frequency(second_modes)
    ratio_1 = _mean_damping_ratio(first_modes)
    ratio_2 = _mean_damping_ratio(second_modes)
    terms_of_amplitude = _terms_of_amplitude(trials)
    terms_of_fit = _terms_of_fit(trials, frequency_2.mean, ratio_2.mean)
    return modal_readings(
        [frequency_1.mean, frequency_2.mean, ratio_1.mean, ratio_2.mean],
        [
            math.hypot(frequency_1.standard_error, terms_of_amplitude.frequency),
            math.hypot(frequency_2.standard_error, terms_of_fit.frequency),
            math.hypot(ratio_1.standard_error, terms_of_amplitude.damping_ratio),
            math.hypot(ratio_2.standard_error, terms_of_fit.damping_ratio),
        ],
    )


def _mean_frequency(modes: Sequence[RingDownMode]) -> _Estimate:
    """Return the mean natural frequency [Hz] of a mode over trials, with its standard error."""
    return _mean(
        [mode.frequency for mode in modes], [mode.standard_error["frequency"] for mode in modes]
    )


def _mean_damping_ratio(modes: Sequence[RingDownMode]) -> _Estimate:
    """Return the mean damping ratio [1] of a mode over trials, with its standard error."""
    return _mean(
        [mode.damping_ratio for mode in modes],
        [mode.standard_error["damping_ratio"] for mode in modes],
    )


def _mean(values: Sequence[float], errors: Sequence[float]) -> _Estimate:
    """Return the mean over trials and its standard error.

    The standard error follows from the standard errors of the values or, if the values scatter
    significantly more than these explain, from the scatter.
    """
    count = len(values)
    mean = math.fsum(values) / count
    expected_variance = math.fsum(error**2 for error in errors) / count
    sum_of_squares = math.fsum((value - mean) ** 2 for value in values)
    if count > 1:
        # If the trials scatter only by their stated errors, the ratio of `sum_of_squares` to
        # `expected_variance` has a chi-square distribution.
        quantile = float(chdtri(count - 1, 1.0 - _SIGNIFICANT_SCATTER))
        if sum_of_squares > expected_variance * quantile:
            # Ratio of the variance of Student's t with n - 1 degrees of freedom to that of a
            # Gaussian. It is 3 for four trials and infinite for fewer, for which 4 is assumed.
            variance_ratio = (count - 1) / (count - 3) if count > 3 else 4.0
            variance_of_mean = variance_ratio * sum_of_squares / (count - 1) / count
            return _Estimate(mean, math.sqrt(variance_of_mean))
    return _Estimate(mean, math.sqrt(expected_variance / count))


def _terms_of_amplitude(trials: Fits) -> _SystematicTerms:
    """Return the systematic change of the first mode's frequency and damping with its amplitude.

    The change is zero if there are too few windows with different amplitudes.
    """
    windows = [window for fit in trials for window in amplitude_dependence(fit)]
    if len(windows) < _FEWEST_WINDOWS:
        return _SystematicTerms(0.0, 0.0)
    logarithm = np.log([window.amplitude for window in windows])
    logarithm -= logarithm.mean()
    if not float(logarithm.std()) > 0.0:
        return _SystematicTerms(0.0, 0.0)
    return _SystematicTerms(
        frequency=_term_of_slope(logarithm, np.array([window.frequency for window in windows])),
        damping_ratio=_term_of_slope(
            logarithm, np.array([window.damping_ratio for window in windows])
        ),
    )


def _term_of_slope(logarithm: Float, value: Float) -> float:
    """Return the systematic change of a modal value with the amplitude.

    A line is fitted to the values (N,) over the centred logarithm (N,) of the amplitude. The result
    is the change of the line over one standard deviation of the logarithm, reduced by its standard
    error (see `_beyond_chance`).
    """
    deviation = float(logarithm.std())
    slope = float(logarithm @ value / (logarithm @ logarithm))
    residual = value - value.mean() - slope * logarithm
    # Windows overlap by half, so two count as one, which doubles the variance.
    variance = 2.0 * float(residual @ residual) / (len(value) - 2)
    error = math.sqrt(variance / float(logarithm @ logarithm))
    return _beyond_chance(slope * deviation, error * deviation)


def _terms_of_fit(trials: Fits, frequency: float, ratio: float) -> _SystematicTerms:
    """Return the systematic uncertainty of the second mode from the choice of the fit.

    `frequency` [Hz] and `ratio` [1] are the means of the second mode in the original fits.
    """
    delays = _LATER_STARTS if trials[0].frequencies_fitted else (0.0, *_LATER_STARTS)
    changes = []
    for delay in delays:
        refitted = [_refit_second_mode(fit, delay) for fit in trials]
        modes = [mode for mode in refitted if mode is not None]
        if len(modes) < len(trials):
            continue  # the mode has died away by then
        other_frequency = _mean_frequency(modes)
        other_ratio = _mean_damping_ratio(modes)
        changes.append(
            [
                _beyond_chance(other_frequency.mean - frequency, other_frequency.standard_error),
                _beyond_chance(other_ratio.mean - ratio, other_ratio.standard_error),
            ]
        )
    if not changes:
        return _SystematicTerms(0.0, 0.0)
    frequency_rms, ratio_rms = np.sqrt(np.mean(np.square(changes), axis=0)).tolist()
    return _SystematicTerms(frequency=frequency_rms, damping_ratio=ratio_rms)


def _beyond_chance(difference: float, error: float) -> float:
    """Return the part of a difference that exceeds its standard error.

    This is the root of the squared difference minus the squared standard error. It is zero if the
    difference is not significant.
    """
    if abs(difference) <= _SIGNIFICANT_DIFFERENCE * error:
        return 0.0
    return math.sqrt(difference**2 - error**2)


def _refit_second_mode(fit: RingDownFit, delay: float) -> RingDownMode | None:
    """Fit the second mode of a record again, from a start that is later by `delay` [s].

    The result is None if the mode has died away by then.
    """
    record = fit.record
    is_after_start = record.time >= record.time[0] + delay
    model = DampedCosines(
        record.time[is_after_start], record.signal[is_after_start], record.averaging_width
    )
    refit = model.fit(np.array([mode.pole for mode in fit.modes]))
    mode = refit.modes[1]
    previous_mode = fit.modes[1]
    frequency_ratio = mode.damped_frequency / previous_mode.damped_frequency
    is_same_mode = abs(frequency_ratio - 1.0) < _SAME_MODE
    is_decaying = 0.0 < -mode.pole.real < mode.pole.imag
    is_visible = mode.amplitude >= _VISIBLE * float(refit.deviation[0])
    return mode if is_same_mode and is_decaying and is_visible else None


PUBLISHED_MODES = modal_readings(
    (*PUBLISHED_FREQUENCIES, *PUBLISHED_DAMPING_RATIOS), (0.062, 0.63, 0.0039, 0.0162)
)
"""The published means of the five trials, with an uncertainty of ours, as the paper gives none.

The standard deviations are those that `measured_modes` returns for the same five trials read off
the published plots, with frequencies from the spectral peaks as in the paper.
"""
