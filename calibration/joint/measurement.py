"""What the ring-down says of the two flapwise modes, with all that makes it uncertain."""

import math
from collections.abc import Sequence

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
from calibration.errors import ExperimentDataError, said
from calibration.result.record import Reading

MODAL = ("frequency_1", "frequency_2", "damping_ratio_1", "damping_ratio_2")
"""What a ring-down tells of a wing."""

_NAMES = ("frequency", "damping_ratio")
_SIGNIFICANT_SCATTER = 0.95
_SIGNIFICANT_DIFFERENCE = 2.0  # standard errors
_LATER_STARTS = (0.04, 0.08)  # s; one and two and a half periods of the second mode
_FEWEST_WINDOWS = 6
_SAME_MODE = 0.2  # relative change of its frequency beyond which a fit has found something else
_VISIBLE = 1.0  # amplitude of the second mode at the later start, over the residuals


def modal_readings(values: Sequence[float], deviations: Sequence[float]) -> tuple[Reading, ...]:
    """Return readings of f1, f2 [Hz], zeta1 and zeta2 [1].

    Raises
    ------
    ExperimentDataError
        If an uncertainty comes out as zero, as for a drawn record without noise.
    """
    for name, value, deviation in zip(MODAL, values, deviations, strict=True):
        if not deviation > 0.0:
            raise ExperimentDataError(said("joint.positive", name=name, value=value))
    return tuple(map(Reading, MODAL, ["ring-down"] * 4, values, deviations))


def measured_modes(trials: Fits) -> tuple[Reading, ...]:
    """Return mean frequencies and damping ratios of fitted trials, statistical and systematic uncertainty.

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
    trials : Fits
        Fitted records, by `calibration.dynamics.trials.fit_trials`.

    Raises
    ------
    ExperimentDataError
        As `modal_readings`.
    """
    means = [_mean_of([fit.modes[mode] for fit in trials], name) for name in _NAMES for mode in (0, 1)]
    softening = _amplitude_terms(trials)
    choice = _choice_terms(trials, means[1][0], means[3][0])
    systematic = softening[0], choice[0], softening[1], choice[1]
    deviations = [math.hypot(error, term) for (_, error), term in zip(means, systematic, strict=True)]
    return modal_readings([mean for mean, _ in means], deviations)


def _mean_of(modes: Sequence[RingDownMode], name: str) -> tuple[float, float]:
    """Return the mean of the trials and its standard error."""
    values, errors = [getattr(item, name) for item in modes], [item.standard_error[name] for item in modes]
    count = len(values)
    mean = math.fsum(values) / count
    expected = math.fsum(error**2 for error in errors) / count
    found = math.fsum((value - mean) ** 2 for value in values)  # (count - 1) times the variance
    if count > 1 and found > expected * float(chdtri(count - 1, 1.0 - _SIGNIFICANT_SCATTER)):
        # The variance of Student's t with n - 1 degrees; up to three trials it has none, take three's twice.
        widening = (count - 1) / (count - 3) if count > 3 else 4.0
        return mean, math.sqrt(widening * found / (count - 1) / count)
    return mean, math.sqrt(expected / count)


def _amplitude_terms(trials: Fits) -> tuple[float, float]:
    """Return what the amplitude does to frequency [Hz] and damping ratio [1] of the first mode."""
    points = [point for fit in trials for point in amplitude_dependence(fit)]
    if len(points) < _FEWEST_WINDOWS:
        return 0.0, 0.0
    logarithm = np.log([point.amplitude for point in points])
    logarithm -= logarithm.mean()
    spread = float(logarithm.std())
    if not spread > 0.0:
        return 0.0, 0.0
    terms = []
    for name in _NAMES:
        value = np.array([getattr(point, name) for point in points])
        slope = float(logarithm @ value / (logarithm @ logarithm))
        rest = value - value.mean() - slope * logarithm
        # Windows overlap by half: two of them count as one.
        error = math.sqrt(2.0 * float(rest @ rest) / (len(points) - 2) / float(logarithm @ logarithm))
        terms.append(_beyond_chance(slope * spread, error * spread))
    return terms[0], terms[1]


def _choice_terms(trials: Fits, frequency: float, ratio: float) -> tuple[float, float]:
    """Return what the choice of the fit does to frequency [Hz] and damping ratio [1] of the second mode."""
    delays = (*(() if trials[0].free else (0.0,)), *_LATER_STARTS)
    terms = []
    for delay in delays:
        found = [refitted for fit in trials if (refitted := _refit(fit, delay)) is not None]
        if len(found) < len(trials):
            continue  # the mode has died away by then
        others = [_mean_of(found, name) for name in _NAMES]
        pairs = zip(others, (frequency, ratio), strict=True)
        terms.append([_beyond_chance(other - first, error) for (other, error), first in pairs])
    if not terms:
        return 0.0, 0.0
    square = np.mean(np.square(terms), axis=0)
    return math.sqrt(float(square[0])), math.sqrt(float(square[1]))


def _beyond_chance(difference: float, error: float) -> float:
    if abs(difference) <= _SIGNIFICANT_DIFFERENCE * error:
        return 0.0
    return math.sqrt(difference**2 - error**2)


def _refit(fit: RingDownFit, delay: float) -> RingDownMode | None:
    """Return the second mode of a record begun later, or None where it is gone by then."""
    record = fit.record
    after = record.time >= record.time[0] + delay
    model = DampedCosines(record.time[after], record.signal[after], record.averaging_width)
    solution = model.fit(np.array([mode.pole for mode in fit.modes]))
    found, before = solution.modes[1], fit.modes[1]
    same = abs(found.damped_frequency / before.damped_frequency - 1.0) < _SAME_MODE
    decays = 0.0 < -found.pole.real < found.pole.imag
    return found if same and decays and found.amplitude >= _VISIBLE * float(solution.deviation[0]) else None


PUBLISHED_MODES = modal_readings(
    (*PUBLISHED_FREQUENCIES, *PUBLISHED_DAMPING_RATIOS), (0.062, 0.63, 0.0039, 0.0162)
)
"""The published means of the five trials, with the uncertainty that our records of them show.

The paper gives no uncertainty. These are the standard deviations that `measured_modes` finds in the same five
trials read off the published plots, frequencies from the spectral peaks as in the paper.
"""
