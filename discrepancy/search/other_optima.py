"""Other optima of what was fitted: another size of a single effect, another place of an effect of a set."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import LARGEST_EFFECT, objective
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.explained import Explained
from discrepancy.search_settings import SEARCH


def canonical_relatives(leading: Term, hypotheses: Iterable[Explained]) -> list[Explained]:
    """Return the single effects of canonical shape and of some size that are of a term's family and place."""
    relatives = []
    for hypothesis in hypotheses:
        if len(hypothesis.candidate.terms) != 1:
            continue
        (term,) = hypothesis.candidate.terms
        is_related = (term.effect.family, term.place) == (leading.effect.family, leading.place)
        has_size = any(item.magnitude for item in term.parameters)
        if is_related and has_size and not term.free_shape:
            relatives.append(hypothesis)
    return relatives


def restarts(problem: Problem, candidate: Candidate, start: Point) -> list[Point]:
    """Return points at which a single effect has another size than at a start, the most promising.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    candidate : Candidate
        Of one effect.
    start : Point
        Where the missing force has it; all other unknowns stay there.
    """
    (term,) = candidate.terms
    begun: list[tuple[float, Point]] = []
    for factor in SEARCH.restart_sizes:
        effect = term.sized(start.effect, factor, -LARGEST_EFFECT, LARGEST_EFFECT)
        point = replace(start, effect=effect)
        with suppress(DiscrepancyError):  # more than the structure can carry
            begun.append((objective(problem, candidate, point), point))
    begun.sort(key=lambda row: row[0])
    return [point for _, point in begun[: SEARCH.restarts]]


def sets_at_other_places(candidate: Candidate, setting: Setting) -> list[Candidate]:
    """Return the sets that have one effect of a set at another of its places."""
    moved_sets = []
    for number, term in enumerate(candidate.terms):
        for place in term.effect.places(setting):
            terms = list(candidate.terms)
            terms[number] = replace(term, place=place)
            moved_set = Candidate(tuple(terms))
            is_twice = len(set(moved_set.key)) < len(terms)
            if place != term.place and not is_twice:
                moved_sets.append(moved_set)
    return moved_sets
