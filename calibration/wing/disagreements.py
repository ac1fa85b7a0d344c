"""Sentences on measurements that disagree with the calibrated model or with each other."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibration.dynamics.damped_cosine import RingDownMode
from calibration.dynamics.trials import (
    PUBLISHED_DAMPING_RATIOS,
    Fits,
    amplitude_dependence,
    average,
)
from calibration.result.record import (
    Calibration,
)
from calibration.static.errors_in_variables import FitQuality
from calibration.static.experiments import published_measurements
from calibration.wing.lab_data import LabData
from reporting.words import capital

NOTICEABLE = 2.0
"""Score above which a difference is reported [standard deviations]."""

NOTICEABLE_FREQUENCY = 0.02
"""Relative difference above which a frequency is reported, whatever its score."""

_NOTICEABLE_DAMPING = 0.1  # relative difference from the published damping ratio
_NOTICEABLE_SOFTENING = 0.003  # relative difference of frequencies at large and small amplitudes
_FEWEST_WINDOWS = 6

AUTHORS_SECOND_FREQUENCY = 28.613
"""Mean second flapwise frequency of the authors' model after their calibration [Hz] (step 3)."""


def disagreements(result: Calibration, lab: LabData, quality: FitQuality) -> list[str]:
    """Return sentences on measurements that disagree with the calibrated model or with each other.

    Parameters
    ----------
    quality : FitQuality
        The residuals of the load test.
    """
    is_published = lab.pairs.sha256 == published_measurements().sha256
    return [
        *_reading_disagreements(result, is_published=is_published),
        *quality.remarks,
        *_ring_down_disagreements(lab.trials, is_published=is_published),
    ]


def _reading_disagreements(result: Calibration, *, is_published: bool) -> list[str]:
    """Return sentences on readings that differ noticeably from the calibrated model."""
    quantities = {quantity.name: quantity for quantity in result.all_quantities}
    sentences = []
    for reading in result.readings:
        name = reading.name
        quantity = quantities[name]
        difference = result.mean(name) / reading.value - 1.0
        score = abs(result.score(reading))
        is_frequency = name.startswith("frequency")
        is_noticeable = is_frequency and abs(difference) > NOTICEABLE_FREQUENCY
        if not is_noticeable and score <= NOTICEABLE:
            continue
        measured_text = quantity.printed(reading.value, reading.deviation)
        model = quantity.printed(result.mean(name), result.standard_deviation(name))
        sentence = (
            f"{capital(quantity.title)}: measured {measured_text}, calibrated model {model}, "
            f"{_percent(difference)} off ({score:.1f} standard deviations)."
        )
        if name == "frequency_2" and is_published:
            sentence += (
                f" The authors' own model, too, has {AUTHORS_SECOND_FREQUENCY:.2f} Hz after its "
                "calibration, 4.5 % below what they measured."
            )
        sentences.append(sentence)
    return sentences


def _ring_down_disagreements(trials: Fits | None, *, is_published: bool) -> list[str]:
    """Return sentences on the damping of the second mode, and on the change of the first mode."""
    if trials is None:
        return []
    sentences = []
    damping = average(trials, "damping_ratio", 1).mean
    published_damping = PUBLISHED_DAMPING_RATIOS[1]
    difference = damping / published_damping - 1.0
    if is_published and abs(difference) > _NOTICEABLE_DAMPING:
        sentences.append(
            f"The damping ratio of the second mode is {100 * damping:.2f} % in these records and "
            f"{100 * published_damping:.2f} % in the paper ({_percent(difference)}); "
            "it depends on where a record begins, see the documentation."
        )
    windows = [window for fit in trials for window in amplitude_dependence(fit)]
    if len(windows) >= _FEWEST_WINDOWS:
        sentences += _softening_sentences(windows)
    return sentences


class _MeanMode(NamedTuple):
    """Mean frequency [Hz], damping [%] and amplitude [mV] of the first mode in some windows."""

    frequency: float
    damping: float
    amplitude: float


def _mean_mode(windows: Sequence[RingDownMode]) -> _MeanMode:
    """Return the mean of the first mode over windows."""
    rows = [
        (window.frequency, 100 * window.damping_ratio, 1e3 * window.amplitude) for window in windows
    ]
    return _MeanMode(*np.array(rows).mean(axis=0).tolist())


def _softening_sentences(windows: Sequence[RingDownMode]) -> list[str]:
    """Return a sentence on the dependence of the first frequency on the amplitude, if there is one.

    The third of the windows with the smallest amplitudes is compared with the third with the
    largest.
    """
    by_amplitude = sorted(windows, key=lambda window: window.amplitude)
    third = len(windows) // 3
    small = _mean_mode(by_amplitude[:third])
    large = _mean_mode(by_amplitude[-third:])
    if abs(small.frequency / large.frequency - 1.0) <= _NOTICEABLE_SOFTENING:
        return []
    return [
        f"The wing is not linear: in windows of 0.8 s the first mode has {large.frequency:.3f} Hz "
        f"and {large.damping:.1f} % damping at {large.amplitude:.2g} mV, "
        f"and {small.frequency:.3f} Hz and {small.damping:.1f} % at {small.amplitude:.2g} mV. "
        "The linear model has one frequency."
    ]


def _percent(value: float) -> str:
    """Return a fraction as a signed percentage."""
    return f"{100.0 * value:+.1f} %".replace("-", "−")
