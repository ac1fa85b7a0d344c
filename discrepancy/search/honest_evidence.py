"""Hypotheses weighed again, each with the remainder that it leaves: evidence of independent samples.

The search itself goes by the noise as recorded: how far a fit is from the truth shows best there. Where no
hypothesis leaves noise, thousands of nats separate what a model of a real thing cannot separate.
"""

from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.remainder_inference import RemainderPrior, infer, with_remainder
from discrepancy.missing_force.hypotheses import key_of
from discrepancy.search_settings import SEARCH

from .strategy import Search


def weigh_with_remainders(found: Search) -> None:
    """Fit the hypotheses that matter together with their remainders; from then on these are compared.

    Notes
    -----
    *Nothing missing* is always one of them. Which others matter is told by the remainder that their residuals
    ask for as they are, before anything is fitted again.
    """
    problem = found.problem
    prior = RemainderPrior.of(problem, found.none)
    chosen = _chosen(found)
    promised = {
        key_of(item.candidate): found.score(item) + infer(problem, item, prior).gain for item in chosen
    }
    chosen.sort(key=lambda item: -promised[key_of(item.candidate)])
    best = promised[key_of(chosen[0].candidate)] if chosen else 0.0
    judged = {}
    for number, item in enumerate([found.none, *chosen[: SEARCH.weighed_fits]]):
        words = " and ".join(item.candidate.identifiers) or "nothing missing"
        found.tell(f"weighing {words} with its remainder, {len(chosen[: SEARCH.weighed_fits]) - number} more")
        key = key_of(item.candidate)
        if item is not found.none and promised[key] < best - SEARCH.weighed_within:
            continue
        judged[key] = _weighed(found, item, prior)
    leading = max(judged.values(), key=found.score).candidate.identifiers
    for item in list(found.all().values()):  # what the leading set holds is asked for by itself
        key, names = key_of(item.candidate), item.candidate.identifiers
        if names and set(names) < set(leading) and key not in judged:
            judged[key] = _weighed(found, item, prior)
    found.judge(judged)


def _weighed(found: Search, item: CandidateFit, prior: RemainderPrior) -> CandidateFit:
    """Return a hypothesis fitted exactly with its remainders."""
    exact = found.exactly(item) if item.candidate.terms else item
    again = with_remainder(found.problem, exact, prior)
    return exact if again is None else again


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
