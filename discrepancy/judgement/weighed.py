"""Hypotheses weighed with their remainders: what each explains of the gap, and which may be named."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import SHAPE_GAIN
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.fits.wider_noise import noise_levels, refitted
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.hypotheses import Key, key_of
from discrepancy.search.starting_points import acts_within, are_related
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import DecayingLine, Line

from .conclusion import family_words, named_effects
from .explained_share import Shares

LEAST_SHOWN = 0.1
"""Share of the gap from which a hypothesis is shown as the best one where none is named."""


@dataclass
class Weighed:
    """Hypotheses with their remainders, and what each explains of the gap."""

    problem: Problem
    found: Search
    left_out: list[CandidateFit] = field(default_factory=list)
    _residuals: dict[Key, ResidualSet] = field(default_factory=dict)
    _shares: dict[Key, Shares] = field(default_factory=dict)
    _free: dict[Key, CandidateFit | None] = field(default_factory=dict)

    def residuals(self, item: CandidateFit) -> ResidualSet:
        """Return fitted and held-out trials beside their predictions."""
        return residual_set(self.problem, item, sensitivities=False)

    def shares(self, item: CandidateFit) -> Shares:
        """Return what a hypothesis explains of the gap."""
        key = key_of(item.candidate)
        if key not in self._shares:
            if () not in self._residuals:
                self._residuals[()] = self.residuals(self.found.none)
            noise = noise_levels(self.problem, self.found.best())
            named: Mapping[str, float] = dict(zip(self.problem.channel_names, noise.tolist(), strict=True))
            self._shares[key] = Shares.of(self._residuals[()], self.residuals(item), named)
        return self._shares[key]

    def better_description(self, best: CandidateFit) -> CandidateFit | None:
        """Return a stand-in as long as a set of laws that was left out, and is more probable by far."""
        found = (
            item
            for item in self.left_out
            if len(item.candidate.terms) == len(best.candidate.terms)
            and item.log_evidence > best.log_evidence + SEARCH.rival
        )
        return next(found, None)

    def shown(self, best: CandidateFit) -> CandidateFit:
        """Return the best set if it closes a part of the gap, else the most probable one that does."""
        if best.candidate.terms and self.shares(best).value > LEAST_SHOWN:
            return best
        return self.leading()

    def leading(self) -> CandidateFit:
        """Return the most probable set that closes a part of the gap, else the fit without effect."""
        ranked = sorted(self.found.judged.values(), key=lambda item: -self.found.score(item))
        closing = (item for item in ranked if item.candidate.terms and self.shares(item).value > LEAST_SHOWN)
        return next(closing, self.found.none)

    def little(self) -> str:
        """Return the sentence on how little of the gap is closed where no set closes a part that counts."""
        closing = [
            (self.shares(item).summary(), item)
            for item in (*self.found.judged.values(), *self.left_out)
            if item.candidate.terms
        ]
        if not closing:
            return ""
        share, most = max(closing, key=lambda pair: pair[0].value)
        words = " and ".join(effect.name for effect in named_effects(self.problem, most))
        closed = (
            f"{words} closes most, {100.0 * share.value:.0f} %" if share.value > 0.005 else "none closes any"
        )
        return f" Of the hypotheses that were weighed, {closed} of the gap on {share.trials} trials."

    def leave_out_stand_ins(self) -> None:
        """Take sets with a stand-in out of the comparison where a law explains as much, or it may not be.

        Clocks, gains, zeros, drifts and lines describe readings; they do not cause. They never stand before a
        law of the structure that explains the same share.
        """
        kept = dict(self.found.judged)
        laws = {key: item for key, item in kept.items() if key and not self._stands_in(item)}
        for key, item in self.found.judged.items():
            if not key or key in laws:
                continue
            share = self.shares(item).value
            beaten = any(
                len(law.candidate.terms) <= len(item.candidate.terms)
                and self.shares(law).value > share - SEARCH.rival_share
                for law in laws.values()
            )
            if not self._may_stand_in(item):
                del kept[key]
            elif beaten:
                del kept[key]
                self.left_out.append(item)
        self.found.judge(kept)

    def join_relatives(self) -> None:
        """Compare the families of laws that are easily taken for the best one, where that leaves much.

        A law of another family may explain the rest with a shape of its own where its usual one does not; so
        it may where the best one has left the shape that gives it its name.
        """
        best = self.found.best()
        if len(best.candidate.terms) != 1 or self._stands_in(best):
            return
        closed = self.shares(best).summary().low > 1.0 - 0.5 * SEARCH.rival_share
        if closed and self._is_of_usual_shape(best):
            return
        (own,) = best.candidate.terms
        singles: dict[tuple[str, str], CandidateFit] = {}
        for item in (*self.found.rough.values(), *self.found.exact.values()):
            terms = item.candidate.terms
            if len(terms) != 1 or terms[0].effect.family == own.effect.family or not terms[0].effect.shape:
                continue
            key = (terms[0].effect.family, terms[0].place)
            if are_related(terms[0].effect, own.effect) and not self._stands_in(item):
                singles[key] = max(singles.get(key, item), item, key=self.found.score)
        joined = dict(self.found.judged)
        for item in singles.values():
            free = self.free(item)
            if free is not None and self.found.score(free) > self.found.score(best):
                joined[key_of(free.candidate)] = free
        self.found.judge(joined)

    def _is_of_usual_shape(self, item: CandidateFit) -> bool:
        """Whether the shape of a single law, if it is free, may be the one that the law is named for."""
        free = self.free(item)
        if free is None:
            return True
        (named,), (term,) = named_effects(self.problem, free), free.candidate.terms
        usual = {shape.name: shape.canonical for shape in term.effect.shape}
        return all(shape.low <= usual[shape.name] <= shape.high for shape in named.shape)

    def laws_of(self, item: CandidateFit) -> tuple[str, ...]:
        """Return the identifiers of a set without its stand-ins."""
        terms = item.candidate.terms
        return tuple(
            name for name, term in zip(plain(item), terms, strict=True)
            if acts_within(term.effect, self.problem.setting)
        )  # fmt: skip

    def _stands_in(self, item: CandidateFit) -> bool:
        return any(not acts_within(term.effect, self.problem.setting) for term in item.candidate.terms)

    def is_mixed(self, item: CandidateFit) -> bool:
        """Whether a set holds a stand-in beside others."""
        return len(item.candidate.terms) > 1 and self._stands_in(item)

    def _may_stand_in(self, item: CandidateFit) -> bool:
        """Whether stand-ins are within their range, and lines have periods enough in the longest record."""
        longest = max(
            (float(np.ptp(data.trial.time)) for data in self.problem.trials if data.trial.is_dynamic),
            default=0.0,
        )
        parts = item.candidate.parts(item.point.effect)
        for term, part in zip(item.candidate.terms, parts, strict=True):
            if acts_within(term.effect, self.problem.setting):
                continue
            if np.abs(part).max(initial=0.0) > SEARCH.stand_in_range:
                return False
            patch = Candidate((term,)).patch(self.problem.setting, part)
            lines = [item.frequency for item in patch if isinstance(item, Line | DecayingLine)]
            if lines and min(lines) * longest < SEARCH.least_periods:
                return False
        return True

    def probability(self, item: CandidateFit) -> float:
        """Return the probability of a set with all that hold it."""
        names = set(plain(item))
        found = self.found.all().values()
        scores = np.array([self.found.score(other) for other in found])
        holds = np.array([names <= set(plain(other)) for other in found])
        weights = np.exp(scores - scores.max())
        return float(weights[holds].sum() / weights.sum())

    def nameable(self, best: CandidateFit) -> tuple[CandidateFit, float, str]:
        """Return the set that may be named, its probability, and its family where its shape is its own.

        The best set, or one within it that explains as much but for a little. Stand-ins beside laws take up
        what is left, whatever it is: they are no part of a name.
        """
        names = set(plain(best))
        share = self.shares(best).value
        mixed = self.is_mixed(best)
        for item in sorted(self.found.judged.values(), key=lambda other: len(other.candidate.terms)):
            if not item.candidate.terms or not set(plain(item)) < names:
                continue
            close = self.shares(item).value > share - 0.5 * SEARCH.rival_share
            if close or (mixed and not self._stands_in(item)):
                best = item
                break
        probability = self.probability(best)
        terms = best.candidate.terms
        if len(terms) == 1 and self.shares(best).value > SEARCH.least_share and terms[0].effect.shape:
            free = best if best.candidate.is_family else self.freed(best)
            if free is not None:
                family, _ = family_words(named_effects(self.problem, free))
                return free, probability, family
        return best, probability, ""

    def slimmer(self, best: CandidateFit, kept: set[str] | None = None) -> CandidateFit:
        """Return the set without effects that explain next to nothing and have no evidence of their own.

        `kept`: the effects that are large enough to be names, if not all are.
        """
        names, share = set(plain(best)), self.shares(best).value
        for item in sorted(self.found.judged.values(), key=lambda other: len(other.candidate.terms)):
            own = set(plain(item))
            if not own or not own < names:
                continue
            sliver = self.shares(item).value > share - SEARCH.sliver
            if kept is not None and kept == own and sliver:
                return item
            if sliver and self.found.score(item) > self.found.score(best) - SEARCH.sliver_gain:
                return item
        return best

    def free(self, best: CandidateFit) -> CandidateFit | None:
        """Return a single law with a shape of its own, fitted with its remainder."""
        if len(best.candidate.terms) != 1:
            return None
        key = key_of(best.candidate)
        if key not in self._free:
            free = free_shape(self.problem, best, 0)
            wide = self.found.wide or self.problem
            self._free[key] = None if free is None else refitted(self.problem, wide, free)
        return self._free[key]

    def freed(self, best: CandidateFit) -> CandidateFit | None:
        """Return the family of a single law where a shape of its own gains enough."""
        free = self.free(best)
        if free is None or free.log_evidence - best.log_evidence <= SHAPE_GAIN:
            return None
        return free if self.shares(free).value >= self.shares(best).value - 0.02 else None

    def rivals(self, best: CandidateFit) -> list[CandidateFit]:
        """Return other sets of the same length that data or held-out trials do not tell from it."""
        own, found = self.shares(best), []
        for item in self.found.judged.values():
            same = len(item.candidate.terms) == len(best.candidate.terms)
            if not same or set(plain(item)) == set(plain(best)):
                continue
            share = self.shares(item)
            close = item.log_evidence > best.log_evidence - SEARCH.rival
            alike = share.value > own.value - SEARCH.rival_share and not own.told_from(share)
            if (close or alike) and share.value > SEARCH.least_share:
                found.append(item)
        return found


def plain(item: CandidateFit) -> tuple[str, ...]:
    """Return the identifiers of a fit's effects, in its order, whether their shapes are free or not."""
    return tuple(term.effect.identifier for term in item.candidate.terms)
