"""Fits far from the truth: phases slip over a long record, so that its beginning is fitted first."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import product
from math import ceil

import numpy as np
from scipy.special import ndtri

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import CandidateFit, attempt, fit, objective
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Change, Screen, rescaled
from discrepancy.search_settings import SEARCH

from .hypotheses import Tell, each, in_silence, starts


def gap_row(residual: FloatArray) -> int:
    """Return the row of a residual (N, C) by which it has more than noise to tell; N where it has not."""
    excess = np.cumsum(np.sum(residual**2 - (residual != 0.0), axis=1))
    told = np.flatnonzero(excess > SEARCH.telling)
    return int(told[0]) if len(told) else len(residual)


class Beginnings:
    """A problem beside itself with the beginnings of its dynamic records only.

    Parameters
    ----------
    problem : Problem
        With whole records.
    tell : callable
        Takes a few words on what is fitted, and how much is left.
    residuals : sequence of (N, C) ndarray, optional
        Of the model as it is, by trial. A record whose gap begins late, or whose first rows are blank, is
        followed until so long after the gap has begun.
    """

    def __init__(
        self, problem: Problem, tell: Tell = in_silence, residuals: Sequence[FloatArray] = ()
    ) -> None:
        self.problem, self._tell, self.residuals = problem, tell, residuals

    @cached_property
    def short(self) -> Problem:
        """The problem with the beginnings of its dynamic records."""
        period = 2.0 * np.pi / self.problem.setting.scales.angular_frequency
        trials = []
        for number, data in enumerate(self.problem.trials):
            trial = data.trial
            count = len(trial.time)
            if trial.is_dynamic:
                least = max(SEARCH.least_samples, ceil(SEARCH.beginning * period / trial.interval))
                late = gap_row(self.residuals[number]) if self.residuals else 0
                count = min(count, least if late < least else late + least)
            trials.append(trial.rows(slice(count)))
        return self.problem.with_trials(tuple(trials))

    def scan(self, base: CandidateFit, effects: Iterable[Effect]) -> list[CandidateFit]:
        """Fit effects in addition to those of `base`, beginnings first; return the most promising ones."""
        screen = self.screen(base)
        if screen is None:
            return []
        ranked = [changes for effect in effects if (changes := starts(screen, effect, SEARCH.far_starts))]
        ranked.sort(key=lambda changes: -changes[0].gain)
        enough = SEARCH.promising * ranked[0][0].gain if ranked else 0.0
        first = max(SEARCH.least_promising, sum(changes[0].gain >= enough for changes in ranked))
        found = self._from_beginnings(base, screen.fit, ranked[:first])
        if not base.candidate.terms and not any(absolute_gate(self.problem, item).passed for item in found):
            found += self._from_beginnings(base, screen.fit, ranked[first:])
        return found

    def _from_beginnings(
        self, base: CandidateFit, near: CandidateFit, ranked: list[list[Change]]
    ) -> list[CandidateFit]:
        """Fit effects to the beginnings of the records, the best of them to whole records."""
        begun = []
        words = "fitting {0.identifier} to the beginnings of the records"
        for changes in each(self._tell, ranked, lambda row: words.format(row[0].term.effect)):
            best = None
            for change in changes:
                candidate = base.candidate.plus(change.term)
                item = self.shortly(
                    near, candidate, rescaled(change), None if best is None else best.objective
                )
                if item is not None and (best is None or item.objective < best.objective):
                    best = item
            if best is not None:
                begun.append(best)
        return self.whole(begun, base.objective)

    def screen(self, base: CandidateFit) -> Screen | None:
        """Fit the beginnings with the effects of a base, and screen there; None where they cannot be so.

        Shared unknowns are as expected before the data: the nuisances of a wrong model are far off and make a
        bad start.
        """
        expected = Point(
            np.zeros_like(base.point.shared),
            tuple(np.zeros_like(u) for u in base.point.local),
            base.point.effect,
        )
        try:
            return Screen(
                self.short, fit(self.short, base.candidate, expected, local_only=True, evidence=False)
            )
        except DiscrepancyError:
            return None

    def again(self, found: CandidateFit) -> CandidateFit | None:
        """Fit the effects of a fit once more, beginnings first; None where that leads nowhere better.

        A model that has a law of its own, as dry friction that ends a motion, has many optima.
        """
        screen = self.screen(found)
        begun = None if screen is None else self._fitted(found.candidate, screen.fit.point)
        whole = None if begun is None else attempt(self.problem, found.candidate, begun.point)
        better = whole is not None and whole.objective < found.objective - SEARCH.worth_fitting
        return whole if better else None

    def shortly(
        self, near: CandidateFit, candidate: Candidate, added: FloatArray, give_up: float | None = None
    ) -> CandidateFit | None:
        """Fit a candidate to the beginnings, or return None where the structure cannot follow."""
        start = Point(near.point.shared, near.point.local, np.concatenate((near.point.effect, added)))
        return self._fitted(candidate, start, give_up)

    def _fitted(
        self, candidate: Candidate, start: Point, give_up: float | None = None
    ) -> CandidateFit | None:
        return attempt(
            self.short, candidate, start, iterations=SEARCH.short_steps, evidence=False, give_up=give_up
        )

    def related(self, found: CandidateFit, effects: Iterable[Effect]) -> list[CandidateFit]:
        """Fit effects in place of the single one of a fit, from where that brought the nuisances.

        Phases that slip keep an effect from its optimum while the nuisances are those of no effect; one that
        does nearly the same has brought them close to where they belong.
        """
        (term,) = found.candidate.terms
        begun = []
        for effect in effects:
            places = tuple(effect.places(self.problem.setting))
            if term.place in places:
                places = (term.place,)
            candidates = [Candidate((Term(effect, place),)) for place in places]
            fits = (
                self._fitted(candidate, start)
                for candidate in (candidates if len(places) <= SEARCH.few_places else ())
                for start in self._tried(found, candidate)
            )
            able = [item for item in fits if item is not None]
            begun += [min(able, key=lambda item: item.objective)] if able else []
        return self.whole(begun, found.objective)

    def _tried(self, found: CandidateFit, candidate: Candidate) -> list[Point]:
        """Return the most promising points of a grid of a candidate's parameters, nuisances as fitted."""
        size, known = candidate.size, SEARCH.related_levels
        count = known[size] if size < len(known) else 0
        levels = ndtri((np.arange(count) + 0.5) / max(count, 1))
        tried = []
        for effect in product(levels, repeat=candidate.size):
            point = Point(found.point.shared, found.point.local, np.array(effect))
            try:
                tried.append((objective(self.short, candidate, point), point))
            except DiscrepancyError:  # more than the structure can carry
                continue
        return [point for _, point in sorted(tried, key=lambda item: item[0])[: SEARCH.related_starts]]

    def whole(self, begun: Sequence[CandidateFit], least: float) -> list[CandidateFit]:
        """Fit the most promising candidates to whole records from where the beginnings led."""
        found: list[CandidateFit] = []
        singles = all(len(item.candidate.terms) == 1 for item in begun)
        count = SEARCH.far_fits if singles else SEARCH.far_extensions
        ranked = sorted(begun, key=lambda start: start.objective)[:count]
        for item in each(self._tell, ranked, lambda one: f"fitting {one.candidate.words} to whole records"):
            whole = attempt(
                self.problem, item.candidate, item.point, iterations=SEARCH.far_steps, give_up=least
            )
            if whole is not None:
                least = min(least, whole.objective + SEARCH.close)
                found.append(whole)
        return found
