"""What the ring-down says of the two flapwise modes, with all that makes it uncertain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from calibration.dynamics.damped_cosine import DampedCosines, NaturalMode, natural_mode
from calibration.dynamics.ringdown import Frequencies, RingDownFit
from calibration.dynamics.trials import (
    PUBLISHED_DAMPING_RATIOS,
    PUBLISHED_FREQUENCIES,
    RingDownTrials,
    amplitude_dependence,
)
from calibration.errors import ExperimentDataError

PUBLISHED_STANDARD_DEVIATIONS = (0.062, 0.63, 0.0039, 0.0162)
"""Of f1, f2 [Hz], zeta1 and zeta2 [1]; see `published_modal_measurement`."""

_SIGNIFICANT_SCATTER = 0.95
_SIGNIFICANT_DIFFERENCE = 2.0  # standard errors
_LATER_STARTS = (0.04, 0.08)  # s; one and two and a half periods of the second mode
_FEWEST_WINDOWS = 6
_SAME_MODE = 0.2  # relative change of its frequency beyond which a fit has found something else
_VISIBLE = 1.0  # amplitude of the second mode at the later start, over the residuals


@dataclass(frozen=True)
class ModalMeasurement:
    """Measured frequencies and damping ratios of the first two flapwise modes.

    Attributes
    ----------
    frequency : (float, float)
        Natural frequencies [Hz].
    frequency_standard_deviation : (float, float)
        Their standard deviations, statistical and systematic parts together [Hz].
    damping_ratio : (float, float)
        Damping ratios [1].
    damping_ratio_standard_deviation : (float, float)
        Their standard deviations, statistical and systematic parts together [1].
    source : str
        Where the figures come from.

    Raises
    ------
    ExperimentDataError
        If a frequency, a damping ratio or a standard deviation is not positive and finite, a damping ratio is
        1 or more, or the first frequency is not the lower one.
    """

    frequency: tuple[float, float]
    frequency_standard_deviation: tuple[float, float]
    damping_ratio: tuple[float, float]
    damping_ratio_standard_deviation: tuple[float, float]
    source: str

    def __post_init__(self) -> None:
        for name, unit in (
            ("frequency", " Hz"),
            ("frequency_standard_deviation", " Hz"),
            ("damping_ratio", ""),
            ("damping_ratio_standard_deviation", ""),
        ):
            values = getattr(self, name)
            if len(values) != 2 or not all(math.isfinite(value) and value > 0.0 for value in values):
                raise ExperimentDataError(
                    f"{self.source}: {name} must hold two positive finite numbers, one for each flapwise "
                    f"mode, but {', '.join(f'{value:g}{unit}' for value in values)} came."
                )
            object.__setattr__(self, name, tuple(float(value) for value in values))
        if not max(self.damping_ratio) < 1.0:
            raise ExperimentDataError(
                f"{self.source}: a damping ratio of {max(self.damping_ratio):.4g} lets nothing swing; give "
                "fractions of critical damping, 0.05 for 5 %."
            )
        if not self.frequency[0] < self.frequency[1]:
            raise ExperimentDataError(
                f"{self.source}: the first flapwise frequency, {self.frequency[0]:.4g} Hz, must lie below "
                f"the second, {self.frequency[1]:.4g} Hz."
            )


def modal_measurement(trials: RingDownTrials) -> ModalMeasurement:
    """Return mean modal data of fitted trials with statistical and systematic uncertainty.

    *Statistical*: the standard error of the mean over the trials, from the least-squares fits; where the
    trials scatter more than these explain (chi-square at 5 %), from their scatter, widened as Student's t.

    *Systematic*, added in quadrature. Each term counts only where it exceeds twice its own standard error,
    so that a linear wing is given none by chance:

    - the first mode over the amplitude: frequency and damping ratio of sliding windows against the logarithm
      of the amplitude, the slope times the spread of the amplitude. The linear model stands for a wing that
      softens, and no single amplitude is the right one;
    - the second mode over the choice of the fit: both modes fitted anew with free frequencies, from where the
      record was cropped (only if the frequencies had been taken from the spectrum) and from 40 and 80 ms
      later; root mean square of what these differ by.

    Parameters
    ----------
    trials : RingDownTrials
        Fitted records, by `calibration.dynamics.trials.fit_trials`.

    Raises
    ------
    ExperimentDataError
        If an uncertainty comes out as zero, as for a drawn record without noise.
    """
    frequency, ratio = [], []
    for mode in (0, 1):
        fitted = [fit.modes[mode] for fit in trials.fits]
        frequency.append(_mean([m.frequency for m in fitted], [m.frequency_standard_error for m in fitted]))
        ratio.append(
            _mean([m.damping_ratio for m in fitted], [m.damping_ratio_standard_error for m in fitted])
        )
    softening = _amplitude_terms(trials)
    choice = _choice_terms(trials, frequency[1][0], ratio[1][0])
    return ModalMeasurement(
        frequency=(frequency[0][0], frequency[1][0]),
        frequency_standard_deviation=(
            math.hypot(frequency[0][1], softening[0]),
            math.hypot(frequency[1][1], choice[0]),
        ),
        damping_ratio=(ratio[0][0], ratio[1][0]),
        damping_ratio_standard_deviation=(
            math.hypot(ratio[0][1], softening[1]),
            math.hypot(ratio[1][1], choice[1]),
        ),
        source=f"{len(trials.fits)} ring-down records ({trials.fits[0].record.source}, ...), frequencies "
        f"{'fitted' if trials.procedure is Frequencies.FITTED else 'of spectral peaks'}",
    )


def _mean(values: Sequence[float], errors: Sequence[float]) -> tuple[float, float]:
    """Return the mean of the trials and its standard error."""
    count = len(values)
    mean = math.fsum(values) / count
    expected = math.fsum(error**2 for error in errors) / count
    found = math.fsum((value - mean) ** 2 for value in values)  # (count - 1) times the variance
    if count > 1 and found > expected * float(chdtri(count - 1, 1.0 - _SIGNIFICANT_SCATTER)):
        # The variance of Student's t with n - 1 degrees; up to three trials it has none, take three's twice.
        widening = (count - 1) / (count - 3) if count > 3 else 4.0
        return mean, math.sqrt(widening * found / (count - 1) / count)
    return mean, math.sqrt(expected / count)


def _amplitude_terms(trials: RingDownTrials) -> tuple[float, float]:
    """Return what the amplitude does to frequency [Hz] and damping ratio [1] of the first mode."""
    points = [point for fit in trials.fits for point in amplitude_dependence(fit)]
    if len(points) < _FEWEST_WINDOWS:
        return 0.0, 0.0
    logarithm = np.log([point.amplitude for point in points])
    logarithm -= logarithm.mean()
    spread = float(logarithm.std())
    if not spread > 0.0:
        return 0.0, 0.0
    terms = []
    for name in ("frequency", "damping_ratio"):
        value = np.array([getattr(point, name) for point in points])
        slope = float(logarithm @ value / (logarithm @ logarithm))
        rest = value - value.mean() - slope * logarithm
        # Windows overlap by half: two of them count as one.
        error = math.sqrt(2.0 * float(rest @ rest) / (len(points) - 2) / float(logarithm @ logarithm))
        terms.append(_beyond_chance(slope * spread, error * spread))
    return terms[0], terms[1]


def _choice_terms(trials: RingDownTrials, frequency: float, ratio: float) -> tuple[float, float]:
    """Return what the choice of the fit does to frequency [Hz] and damping ratio [1] of the second mode."""
    delays = (*((0.0,) if trials.procedure is Frequencies.PEAKS else ()), *_LATER_STARTS)
    terms = []
    for delay in delays:
        found = [refitted for fit in trials.fits if (refitted := _refit(fit, delay)) is not None]
        if len(found) < len(trials.fits):
            continue  # the mode has died away by then
        frequencies, errors, ratios, ratio_errors = zip(*found, strict=True)
        other, error = _mean(frequencies, errors)
        other_ratio, ratio_error = _mean(ratios, ratio_errors)
        terms.append(
            (_beyond_chance(other - frequency, error), _beyond_chance(other_ratio - ratio, ratio_error))
        )
    if not terms:
        return 0.0, 0.0
    square = np.mean(np.square(terms), axis=0)
    return math.sqrt(float(square[0])), math.sqrt(float(square[1]))


def _beyond_chance(difference: float, error: float) -> float:
    if abs(difference) <= _SIGNIFICANT_DIFFERENCE * error:
        return 0.0
    return math.sqrt(difference**2 - error**2)


def _refit(fit: RingDownFit, delay: float) -> NaturalMode | None:
    """Return the second mode of a record begun later, or None where it is gone by then."""
    record = fit.record
    after = record.time >= record.time[0] + delay
    model = DampedCosines(record.time[after], record.signal[after], record.averaging_width)
    omega = 2.0 * math.pi * np.array([mode.damped_frequency for mode in fit.modes])
    found = model.fitted(np.array([mode.decay_rate for mode in fit.modes]), omega)
    decay, damped = float(found.decay[1]), float(found.omega[1])
    if not (0.0 < decay < damped and abs(damped / omega[1] - 1.0) < _SAME_MODE):
        return None
    solution = model.solve(found.decay, found.omega, frequencies_fitted=True)
    if abs(solution.amplitude[1]) < _VISIBLE * solution.residual_deviation:
        return None
    return natural_mode(decay, damped, solution.covariance[np.ix_([1, 3], [1, 3])])


def published_modal_measurement() -> ModalMeasurement:
    """Return the published means of the five trials, with the uncertainty that our records of them show.

    The paper gives no uncertainty. These are the standard deviations that `modal_measurement` finds in the
    same five trials read off the published plots, frequencies from the spectral peaks as in the paper.
    """
    return ModalMeasurement(
        frequency=PUBLISHED_FREQUENCIES,
        frequency_standard_deviation=PUBLISHED_STANDARD_DEVIATIONS[:2],
        damping_ratio=PUBLISHED_DAMPING_RATIOS,
        damping_ratio_standard_deviation=PUBLISHED_STANDARD_DEVIATIONS[2:],
        source="published targets (Kapteyn et al. 2021, step 3)",
    )
