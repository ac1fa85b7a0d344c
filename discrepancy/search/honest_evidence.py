"""Hypotheses weighed again under what the best of them leaves: evidence of independent samples.

The search itself goes by the noise as recorded: how far a fit is from the truth shows best there. Where no
hypothesis leaves noise, thousands of nats separate what a model of a real thing cannot separate.
"""

from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.wider_noise import left_by, refitted, widened
from discrepancy.missing_force.hypotheses import Key, key_of
from discrepancy.search_settings import SEARCH

from .strategy import Search

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
        if key_of(leading.candidate) == key_of(best.candidate):
            break
        best = leading
    found.judge(judged)


def _judged(found: Search, wide: Problem, chosen: list[CandidateFit]) -> dict[Key, CandidateFit]:
    """Return the most promising hypotheses under a noise."""
    ranked = sorted(chosen, key=lambda item: _promised(found, wide, item), reverse=True)
    least = _promised(found, wide, ranked[0]) - SEARCH.weighed_within if ranked else 0.0
    able = [item for item in ranked[: SEARCH.weighed_fits] if _promised(found, wide, item) > least]
    judged: dict[Key, CandidateFit] = {}
    _add(judged, found, wide, found.none)
    for number, item in enumerate(able):
        words = " and ".join(item.candidate.identifiers)
        found.tell(f"weighing {words} with its remainder, {len(able) - number - 1} more")
        _add(judged, found, wide, found.exactly(item))
    leading = max(judged.values(), key=found.score).candidate.identifiers
    for item in list(found.all().values()):  # what the leading set holds is asked for by itself
        key, names = key_of(item.candidate), item.candidate.identifiers
        if names and set(names) < set(leading) and key not in judged:
            _add(judged, found, wide, found.exactly(item))
    return judged


def _add(judged: dict[Key, CandidateFit], found: Search, wide: Problem, item: CandidateFit) -> None:
    """Add a hypothesis under a wider noise, if it can be fitted so; no effect at all as it stands if not."""
    again = refitted(found.problem, wide, item)
    if again is None and not item.candidate.terms:
        again = refitted(found.problem, wide, item, steps=0)
    if again is not None:
        judged[key_of(item.candidate)] = again


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
