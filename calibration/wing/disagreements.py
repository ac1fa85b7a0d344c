"""What of the measurements the calibrated wing does not meet, a sentence each."""

import numpy as np

from calibration.dynamics.trials import PUBLISHED_DAMPING_RATIOS, amplitude_dependence, average
from calibration.result.record import Calibration
from calibration.static.errors_in_variables import FitQuality
from calibration.static.experiments import published_measurements
from reporting.words import plus_minus

from .lab_data import LabData

NOTICEABLE = 2.0
"""Standard deviations from which a difference is pointed out."""

NOTICEABLE_FREQUENCY = 0.02
"""Relative difference from which that of a frequency is pointed out, whatever its standard deviation."""

AUTHORS_SECOND_FREQUENCY = 28.613
"""Mean of the authors' model's second flapwise frequency after their calibration [Hz] (step 3)."""


def disagreements(result: Calibration, lab: LabData, quality: FitQuality) -> list[str]:
    """Return sentences on what disagrees with the data; empty where nothing does."""
    found = []
    the_papers = lab.pairs.sha256 == published_measurements().sha256
    figures = {figure.name: figure for figure in result.figures}
    for reading in result.readings:
        name, figure = reading.name, figures[reading.name]
        relative = result.mean(name) / reading.value - 1.0
        far = name.startswith("frequency") and abs(relative) > NOTICEABLE_FREQUENCY
        if not far and abs(result.score(reading)) <= NOTICEABLE:
            continue
        unit = "" if figure.unit == "1" else f" {figure.unit}"
        model = plus_minus(result.mean(name), result.standard_deviation(name))
        found.append(
            f"{figure.title[0].upper()}{figure.title[1:]}: measured "
            f"{plus_minus(reading.value, reading.deviation)}{unit}, calibrated model {model}{unit}, "
            f"{_percent(relative)} off ({abs(result.score(reading)):.1f} standard deviations)."
        )
        if name == "frequency_2" and the_papers:
            found[-1] += (
                f" The authors' own model, too, has {AUTHORS_SECOND_FREQUENCY:.2f} Hz after its calibration, "
                "4.5 % below what they measured."
            )
    return found + list(quality.remarks) + _of_the_ring_down(lab, the_papers=the_papers)


def _of_the_ring_down(lab: LabData, *, the_papers: bool) -> list[str]:
    trials = lab.trials
    if trials is None:
        return []
    found = []
    second = average(trials, "damping_ratio", 1).mean
    published = PUBLISHED_DAMPING_RATIOS[1]
    if the_papers and abs(second / published - 1.0) > 0.1:
        found.append(
            f"The damping ratio of the second mode is {100 * second:.2f} % in these records and "
            f"{100 * published:.2f} % in the paper ({_percent(second / published - 1.0)}); it depends on "
            "where a record begins, see the documentation."
        )
    points = sorted(
        (point for fit in trials for point in amplitude_dependence(fit)),
        key=lambda point: point.amplitude,
    )
    if len(points) >= 6:
        figures = np.array([(p.frequency, 100 * p.damping_ratio, 1e3 * p.amplitude) for p in points])
        third = len(points) // 3
        large, small = figures[-third:].mean(axis=0).tolist(), figures[:third].mean(axis=0).tolist()
        if abs(small[0] / large[0] - 1.0) > 0.003:
            found.append(
                f"The wing is not linear: in windows of 0.8 s the first mode has {large[0]:.3f} Hz and "
                f"{large[1]:.1f} % damping at {large[2]:.2g} mV, and {small[0]:.3f} Hz and {small[1]:.1f} % "
                f"at {small[2]:.2g} mV. The linear model has one frequency."
            )
    return found


def _percent(value: float) -> str:
    return f"{100.0 * value:+.1f} %".replace("-", "−")
