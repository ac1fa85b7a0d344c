"""What of the measurements the calibrated wing does not meet, a sentence each."""

import numpy as np

from calibration.dynamics.trials import PUBLISHED_DAMPING_RATIOS, amplitude_dependence, average
from calibration.errors import said
from calibration.result.record import Calibration
from calibration.static.errors_in_variables import FitQuality
from calibration.static.experiments import published_measurements
from reporting.words import capital, plus_minus

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
        both = (
            plus_minus(reading.value, reading.deviation),
            plus_minus(result.mean(name), result.standard_deviation(name)),
        )
        measured, model = (f"{text} {figure.shown_unit}".rstrip() for text in both)
        off = _percent(relative), abs(result.score(reading))
        told = {"title": capital(figure.title), "measured": measured, "model": model, "off": off}
        found.append(said("disagreements.figure", **told))
        if name == "frequency_2" and the_papers:
            found[-1] += said("disagreements.authors", frequency=AUTHORS_SECOND_FREQUENCY)
    return found + list(quality.remarks) + _of_the_ring_down(lab, the_papers=the_papers)


def _of_the_ring_down(lab: LabData, *, the_papers: bool) -> list[str]:
    trials = lab.trials
    if trials is None:
        return []
    found = []
    second = average(trials, "damping_ratio", 1).mean
    published = PUBLISHED_DAMPING_RATIOS[1]
    if the_papers and abs(second / published - 1.0) > 0.1:
        off = _percent(second / published - 1.0)
        found.append(said("disagreements.damping", second=100 * second, published=100 * published, off=off))
    points = sorted(
        (point for fit in trials for point in amplitude_dependence(fit)),
        key=lambda point: point.amplitude,
    )
    if len(points) >= 6:
        figures = np.array([(p.frequency, 100 * p.damping_ratio, 1e3 * p.amplitude) for p in points])
        third = len(points) // 3
        large, small = figures[-third:].mean(axis=0).tolist(), figures[:third].mean(axis=0).tolist()
        if abs(small[0] / large[0] - 1.0) > 0.003:
            found.append(said("disagreements.not_linear", large=large, small=small))
    return found


def _percent(value: float) -> str:
    return f"{100.0 * value:+.1f} %".replace("-", "−")
