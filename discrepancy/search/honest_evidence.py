"""Hypotheses weighed again under what the best of them leaves: evidence of independent samples.

The search itself goes by the noise as recorded: how far a fit is from the truth shows best there. Where no
hypothesis leaves noise, thousands of nats separate what a model of a real thing cannot separate.

No model of a real thing leaves white noise (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63, 425-464). Where
none does, hypotheses are compared under a noise that is as wide as what the best of them leaves, and that
counts as many samples as are independent: the sum of squares of N samples of autocorrelation rho_k is as
sure as that of N / (1 + 2 sum rho_k^2) (Bartlett 1946, Suppl. J. R. Stat. Soc. 8, 27-41). Trials at rest
have none.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Key, Remainder
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.gates import records_of, whiteness
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import each
from .strategy import Search

LEVEL = 1e-3
"""p-value below which what is left is more than noise, or no white noise."""
NEAR = 0.25
"""Share of an interval by which that of a noise record may be another."""
SWINGS = -0.25
"""Autocorrelation at its first minimum below which a process swings."""
LIKE_RECORD = 3.0
"""Deviations within which the correlation of a noise record is that of what is left."""
LEAST_WHITE = 1e-12
"""Least share of what is left that is taken for noise where none is recorded."""


def left_by(problem: Problem, found: CandidateFit) -> Remainder:
    """Return what a fit to the recorded noise leaves."""
    count = len(problem.channel_names)
    size, time, frequency = np.zeros((3, count))
    factor, of_noise = np.ones(count), np.zeros(count, dtype=bool)
    noise_of = noise_levels(problem, found)
    for channel, name in enumerate(problem.channel_names):
        series, used, steps = records_of(problem, found, channel)
        counted = sum(float(item.sum()) for item in used)
        if not series:
            continue
        freedom, known = max(counted - found.spent[channel], 1.0), problem.freedom[channel]
        left = sum(float(item @ item) for item in series) / freedom
        interval = max(float(np.median(item)) for item in steps)
        colour, doubt, fewer = _recorded_colour(problem, name, steps, interval)
        larger = known > 0.0 and noise_tests.variance_p_value(left, freedom / fewer, known / fewer) < LEVEL
        if not larger and whiteness(series, used) > LEVEL:
            continue
        rho, chance = noise_tests.autocorrelation(series)
        of_noise[channel] = not larger and abs(rho[0] - colour) < LIKE_RECORD * np.sqrt(1.0 / counted + doubt)
        level = 1.0 if of_noise[channel] else max(left, 1.0) if known > 0.0 else left
        factor[channel] = np.sqrt(level * noise_tests.times_fewer(rho, chance))
        beside = left / noise_of[channel] - 1.0
        if of_noise[channel] or beside <= 0.0:
            continue
        ratio = (1.0 + beside) / beside
        own = rho * ratio
        size[channel] = np.sqrt(beside)
        time[channel] = interval * noise_tests.times_fewer(rho, chance, ratio)
        first = int(np.argmax(np.diff(own) > 0.0))  # the first minimum
        if own[first] < SWINGS:
            frequency[channel] = 0.5 / ((first + 1) * interval)
            time[channel] *= 2.0  # the mean of a squared cosine is a half
    return Remainder(size, factor, time, frequency, of_noise)


def noise_levels(problem: Problem, found: CandidateFit) -> FloatArray:
    """Return the mean square (channels,) of the noise over its recorded one: of the quick part where none is.

    Second differences of white noise have six times its variance, and hardly any of what is slow.
    """
    levels = np.ones(len(problem.channel_names))
    for channel in np.flatnonzero(problem.freedom == 0.0):
        series, _, _ = records_of(problem, found, int(channel))
        total = sum(float(item @ item) for item in series) / max(sum(len(item) for item in series), 1)
        quick = [np.diff(item, 2) for item in series]
        white = sum(float(item @ item) for item in quick) / 6.0 / max(sum(len(item) for item in quick), 1)
        at_rest = 1.0 / problem.precisions(found.sums)[channel]
        levels[channel] = min(max(white, LEAST_WHITE * total), total) if total > 0.0 else at_rest
    return levels


def widened(problem: Problem, remainder: Remainder) -> Problem:
    """Return a problem under the noise that a remainder makes."""
    return problem.widened(remainder.factor) if remainder.acts else problem


def refitted(problem: Problem, wide: Problem, found: CandidateFit, **options: Any) -> CandidateFit | None:
    """Return a hypothesis at its maximum under a wider noise, with evidence and covariance of that.

    All else of it is told against the recorded noise, with what it leaves. None where it cannot be fitted so:
    evidence under two noises is not compared.
    """
    if wide is problem:
        return found
    again = attempt(wide, found.candidate, found.point, **options)
    here = None if again is None else attempt(problem, found.candidate, again.point, iterations=0)
    if again is None or here is None:
        return None
    left = left_by(problem, here)
    return replace(
        here, log_evidence=again.log_evidence, covariance=again.covariance, converged=again.converged,
        remainder=left if left.acts else None,
    )  # fmt: skip


def _recorded_colour(
    problem: Problem, name: str, steps: list[FloatArray], interval: float
) -> tuple[float, float, float]:
    """Return what noise as in a channel's record leaves in records: their correlation at one sample.

    And its variance, and how many times fewer independent samples they have. NaN where nothing is recorded,
    or at another pace. What is whitened leaves what the filter leaves of the record.
    """
    record, noise = problem.campaign.channels[name].noise, problem.noise[name]
    if record is None or record.samples is None or record.interval is None or not np.any(record.samples):
        return np.nan, 0.0, 1.0
    raw = record.samples - record.samples.mean()
    if abs(record.interval - interval) > NEAR * interval:
        return np.nan, 0.0, 1.0
    found = []
    for item in steps:
        white = len(item) == 1
        values = noise.whiten(raw, record.interval) if white else raw
        rho, chance = noise_tests.autocorrelation([values])
        at = np.interp(item / record.interval, np.arange(1 + len(rho)), np.r_[1.0, rho])
        fewer = 1.0 if white else noise_tests.times_fewer(rho, chance)
        found.append((float(rho[0] if white else np.mean(at)), 1.0 / len(raw), fewer))
    colour, doubt, fewer = np.mean(found, axis=0).tolist()
    return colour, doubt, fewer


TURNS = 3
"""Times that another hypothesis may turn out to be the best one."""


def weigh_with_remainders(found: Search) -> None:
    """Fit the hypotheses that matter under the noise that the best of them leaves; compare these from now on.

    Notes
    -----
    *Nothing missing* is always one of them. Which others matter is told by their residuals as they are,
    before anything is fitted again.
    """
    best, chosen = found.best(), _chosen(found)
    for _ in range(TURNS):
        found.wide = widened(found.problem, left_by(found.problem, best))
        found.judged = {}
        judged = _judged(found, found.wide, chosen)
        leading = max(judged.values(), key=found.score)
        if leading.candidate.key == best.candidate.key:
            break
        best = leading
    found.judged = judged


def _judged(found: Search, wide: Problem, chosen: list[CandidateFit]) -> dict[Key, CandidateFit]:
    """Return the most promising hypotheses under a noise."""
    ranked = sorted(chosen, key=lambda item: _promised(found, wide, item), reverse=True)
    least = _promised(found, wide, ranked[0]) - SEARCH.weighed_within if ranked else 0.0
    able = [item for item in ranked[: SEARCH.weighed_fits] if _promised(found, wide, item) > least]
    judged: dict[Key, CandidateFit] = {}
    _add(judged, found, wide, found.none)
    for item in each(found.tell, able, lambda one: f"weighing {one.candidate.words} with its remainder"):
        _add(judged, found, wide, found.exactly(item))
    leading = max(judged.values(), key=found.score).candidate.identifiers
    for item in list(found.all().values()):  # what the leading set holds is asked for by itself
        key, names = item.candidate.key, item.candidate.identifiers
        if names and set(names) < set(leading) and key not in judged:
            _add(judged, found, wide, found.exactly(item))
    return judged


def _add(judged: dict[Key, CandidateFit], found: Search, wide: Problem, item: CandidateFit) -> None:
    """Add a hypothesis under a wider noise, if it can be fitted so; no effect at all as it stands if not."""
    again = refitted(found.problem, wide, item)
    if again is None and not item.candidate.terms:
        again = refitted(found.problem, wide, item, iterations=0)
    if again is not None:
        judged[item.candidate.key] = again


def _promised(found: Search, wide: Problem, item: CandidateFit) -> float:
    """Return the score that a fit has under a wider noise as it is."""
    problem = found.problem
    ratios = zip(problem.trials, wide.trials, strict=True)
    scale = [data.deviation / wider.deviation for data, wider in ratios]
    sums = problem.group_sums([one * row for one, row in zip(item.residuals, scale, strict=True)])
    return found.score(item) + problem.misfit(item.sums) - wide.misfit(sums)


def _chosen(found: Search) -> list[CandidateFit]:
    """Return the best fit of each set of effects, the most probable sets of each length."""
    best: dict[tuple[str, ...], CandidateFit] = {}
    for item in found.all().values():
        names = item.candidate.identifiers
        if names and (names not in best or found.score(item) > found.score(best[names])):
            best[names] = item
    chosen: list[CandidateFit] = []
    for length, count in enumerate(SEARCH.weighed_sets, start=1):
        of_length = [item for item in best.values() if len(item.candidate.terms) == length]
        chosen += sorted(of_length, key=lambda item: -found.score(item))[:count]
    return chosen
