"""Comparison of hypotheses where none leaves noise alone.

Which may be named, and what objects to others.

Where no simulation leaves noise alone, hypotheses are compared by their simulations under a wider
noise, or by the missing force that they follow. In both ways each hypothesis has evidence, and
explains a share of the gap, in the trials that were fitted and in those that were held out.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache, cached_property
from typing import Generic, TypeVar

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, CandidateKey, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.gates import ABSOLUTE_LEVEL, check_absolute_fit
from discrepancy.fits.predictive import residual_set
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.gap_share import GapShare
from discrepancy.proof_record import ClosedShare
from discrepancy.search.starts import acts_within
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate

from .closed_share import closed_text
from .conclusion import ComparedHypothesis
from .proof import closed_share_or_reason

LEAST_CONTRADICTING = -0.1
"""Share of the gap below which held-out trials in which a law has hardly any force contradict
it."""

H = TypeVar("H", bound=ComparedHypothesis)
EffectsAtPlaces = frozenset[tuple[str, str]]
"""Pairs of an effect, or a family of effects, and its place."""


class Comparison(ABC, Generic[H]):
    """Hypotheses of a search that are compared with each other.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.

    Attributes
    ----------
    least_low_end : float
        The least lower end of the interval of the share that a name needs.
    has_held_out : bool
        Whether there are trials that were not fitted.
    standing : H or None
        The hypothesis that the verdict is about, once there is one.
    """

    least_low_end: float

    def __init__(self, search: Search) -> None:
        self.search = search
        self.problem = search.problem
        self.has_held_out = bool(self.problem.campaign.held_out)
        self.standing: H | None = None
        self._subsets: dict[CandidateKey, H | None] = {}
        # each is computed once for a hypothesis
        self.share = cache(self._gap_share)
        self.simulation = cache(self._simulation)
        self.closed_share = cache(self._closed_share)
        self.residuals = cache(self._residuals)

    # ---------------------------------------------------------------- how they are compared

    @property
    @abstractmethod
    def no_effect(self) -> H:
        """The hypothesis without an effect."""

    @property
    @abstractmethod
    def ranked(self) -> Sequence[H]:
        """All hypotheses, the most probable first."""

    @abstractmethod
    def gap_sentence(self) -> str:
        """Return a sentence on what is known of the gap; empty if nothing is."""

    @abstractmethod
    def _gap_share(self, hypothesis: H, *, held_out: bool) -> GapShare:
        """Return the share of the gap that a hypothesis explains, in fitted or held-out trials."""

    @abstractmethod
    def fit_followed(self, candidate: Candidate, effect: FloatArray) -> H | None:
        """Return a further hypothesis, begun at scaled effect parameters (E,).

        None if it cannot be fitted.
        """

    @abstractmethod
    def with_free_shape(self, hypothesis: H) -> H | None:
        """Return a hypothesis of one law with its shape free, if that was compared."""

    @abstractmethod
    def start_point(self, hypothesis: H) -> Point:
        """Return the point from which the simulation of a hypothesis is fitted."""

    @abstractmethod
    def check_fit(self, hypothesis: H) -> Gate:
        """Test whether the simulation that a hypothesis rests on leaves noise alone."""

    @abstractmethod
    def failed_check(self, hypothesis: H) -> str:
        """Return what a hypothesis that leaves noise alone fails nevertheless; empty if nothing."""

    @abstractmethod
    def _simulation(self, hypothesis: H) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    @abstractmethod
    def remaining_text(self, hypothesis: H, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis leaves, of how much there is."""

    def score(self, hypothesis: H) -> float:
        """Return ln (evidence times prior) of a hypothesis [nat]."""
        return hypothesis.log_evidence + self.search.log_prior(hypothesis.candidate)

    def passes_absolute_fit(self, hypothesis: H) -> bool:
        """Return whether the simulation of a hypothesis leaves no more than the recorded noise."""
        simulation = self.search.exact_fits.get(hypothesis.candidate.key)
        if simulation is None:
            start = self.start_point(hypothesis)
            simulation = attempt(self.problem, hypothesis.candidate, start)
        if simulation is None:
            return False
        return check_absolute_fit(self.problem, simulation).passed is not False

    def _residuals(self, simulation: CandidateFit) -> ResidualSet:
        """Return the fitted and held-out trials beside the predictions of a simulation."""
        return residual_set(self.problem, simulation, sensitivities=False)

    def _closed_share(self, hypothesis: H) -> tuple[ClosedShare | None, str]:
        """Return the share of the mean square error that a hypothesis removes, and it in words.

        It is that of simulations without and with the hypothesis, whatever hypotheses are compared
        by. Where no share can be given it is None with the reason.
        """
        before = self.residuals(self.search.no_effect)
        after = self.residuals(self.simulation(hypothesis))
        closed, reason = closed_share_or_reason(before, after)
        if closed is None:
            clause = f"{reason[0].lower()}{reason[1:-1]}"
            return None, clause
        return closed, closed_text(before, after, closed)

    def enlarges_error(self, hypothesis: H) -> bool:
        """Return whether a hypothesis makes the error larger, or cannot be simulated."""
        closed, _ = self.closed_share(hypothesis)
        if self.simulation(hypothesis) is self.search.no_effect:
            return True
        return closed is not None and closed.grew

    # ---------------------------------------------------------------- which may be named

    def decisive_share(self, hypothesis: H) -> GapShare:
        """Return the share of the gap that counts.

        In held-out trials if any can test the hypothesis.
        """
        if self.has_held_out:
            held_out_share = self.share(hypothesis, held_out=True)
            if held_out_share.tested:
                return held_out_share
        return self.share(hypothesis, held_out=False)

    def acts_on_structure(self, term: EffectTerm) -> bool:
        """Return whether a term acts on the structure, and does not only describe readings."""
        return acts_within(term.effect, self.problem.setting)

    def objection(self, hypothesis: H) -> str:
        """Return why a hypothesis cannot be a name; empty if nothing objects to it."""
        candidate = hypothesis.candidate
        if not any(self.acts_on_structure(term) for term in candidate.terms):
            return "it describes readings, causes nothing and leaves more than noise"
        if candidate.is_family and len(candidate.terms) > 1:
            return "beside another law a shape of its own imitates nearly anything"
        fitted_share = self.share(hypothesis, held_out=False)
        if _is_small(fitted_share, self.least_low_end):
            return f"where it was fitted it leaves {self.remaining_text(hypothesis, fitted_share)}"
        if self.has_held_out and not self._survives_held_out(hypothesis, self.least_low_end):
            held_out_share = self.share(hypothesis, held_out=True)
            remaining = self.remaining_text(hypothesis, held_out_share)
            return f"in trials that were not fitted it leaves {remaining}"
        strained = self._strained_unknowns(hypothesis)
        if strained:
            return f"it needs {strained} far beside their priors: are these what you would bet on?"
        return self.failed_check(hypothesis)

    def _strained_unknowns(self, hypothesis: H) -> str:
        """Return which kind of shared unknowns a hypothesis moves far from their priors.

        Empty if none.

        The priors count as wider than stated, since calibrated values take up what the hypothesis
        leaves.
        """
        shared = self.problem.shared
        has_prior = shared.precision > 0.0
        kinds = {
            "calibrated parameters": slice(shared.count),
            "gains": slice(shared.count, None),
        }
        for kind, numbers in kinds.items():
            u = hypothesis.shared[numbers][has_prior[numbers]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_LEVEL:
                return kind
        return ""

    def _survives_held_out(self, hypothesis: H, least_low_end: float) -> bool:
        """Return whether held-out trials confirm a hypothesis, or cannot test it.

        Trials that cannot test it must not contradict it either.
        """
        share = self.share(hypothesis, held_out=True)
        if share.tested:
            return not _is_small(share, least_low_end)
        return share.value > LEAST_CONTRADICTING

    @cached_property
    def contenders(self) -> list[H]:
        """The hypotheses that may be named, as data do not exclude them, the most probable first.

        Errors of readings are no part of a name: beside a law they take up whatever it leaves.
        """
        contenders: dict[CandidateKey, tuple[H, float]] = {}
        for hypothesis in self.ranked:
            terms = hypothesis.candidate.terms
            laws = [number for number, term in enumerate(terms) if self.acts_on_structure(term)]
            core: H | None = hypothesis
            if 0 < len(laws) < len(terms):
                core = self._subset(hypothesis, laws)
            if not terms or core is None or core.candidate.key in contenders:
                continue
            if not self.objection(core):
                contenders[core.candidate.key] = (core, self.score(hypothesis))
        best_score = max((score for _, score in contenders.values()), default=0.0)
        least_score = best_score - SEARCH.contenders
        return [hypothesis for hypothesis, score in contenders.values() if score > least_score]

    def _subset(self, hypothesis: H, numbers: Sequence[int]) -> H | None:
        """Return the hypothesis of some of the terms of a hypothesis, given their indices."""
        candidate, effect = hypothesis.candidate.subset(numbers, hypothesis.effect)
        key = candidate.key
        for known in self.ranked:
            if known.candidate.key == key:
                return known
        if key not in self._subsets:
            self._subsets[key] = self.fit_followed(candidate, effect)
        return self._subsets[key]

    def simplest_equivalent(self, best: H) -> H:
        """Return the simplest hypothesis that explains as much of the gap as a given one."""
        count = len(best.candidate.terms)
        options: dict[CandidateKey, H] = {}
        for hypothesis in self.ranked:
            options[hypothesis.candidate.key] = hypothesis
        if count > 1:
            for number in range(count):
                single = self._subset(best, [number])
                if single is not None:
                    options[single.candidate.key] = single
        simpler = [option for option in options.values() if self._is_simpler(option, best)]
        return min(
            simpler,
            key=lambda hypothesis: (*_complexity(hypothesis), -self.score(hypothesis)),
            default=best,
        )

    def _is_simpler(self, option: H, best: H) -> bool:
        """Return whether a hypothesis is simpler than the best one and may replace it."""
        if not option.candidate.terms or _complexity(option) >= _complexity(best):
            return False
        if not families_at_places(option) <= families_at_places(best):
            return False
        fitted_share = self.share(option, held_out=False).value
        if fitted_share <= self.share(best, held_out=False).value - 3.0 * SEARCH.slim:
            return False
        if self.decisive_share(option).value <= self.decisive_share(best).value - SEARCH.slim:
            return False
        return not self.objection(option)

    def probability(self, *hypotheses: H) -> float:
        """Return the probability that one of some hypotheses holds.

        A hypothesis holds, too, where another one has all of its families at its places. Refuted
        hypotheses have no probability.
        """
        remaining = []
        for other in self.ranked:
            is_asked = any(other is hypothesis for hypothesis in hypotheses)
            if is_asked or not other.candidate.terms or not self._is_refuted(other):
                remaining.append(other)
        scores = np.array([self.score(other) for other in remaining])
        asked = [families_at_places(hypothesis) for hypothesis in hypotheses]
        includes_asked = []
        for other in remaining:
            families = families_at_places(other)
            includes_asked.append(any(asked_families <= families for asked_families in asked))
        holds = np.array(includes_asked)
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _is_refuted(self, hypothesis: H) -> bool:
        """Return whether trials show that a hypothesis does not explain the gap."""
        _, high = self.share(hypothesis, held_out=False).interval
        if high < SEARCH.least_share:
            return True
        return self.has_held_out and not self._survives_held_out(hypothesis, 0.0)

    def competitors(self, best: H) -> list[H]:
        """Return the hypotheses that could be named instead of the best one.

        The data do not separate them from it: their score is within `SEARCH.force_rival` of that of
        the best one, and their share of the gap is not smaller beyond chance.

        Parameters
        ----------
        best : H
            The hypothesis that would be named.
        """
        best_share = self.decisive_share(best)
        least_competing_score = self.score(best) - SEARCH.force_rival
        by_effects: dict[EffectsAtPlaces, H] = {}
        for hypothesis in self.contenders:
            candidate = hypothesis.candidate
            is_same_family = families_at_places(hypothesis) == families_at_places(best)
            is_longer = len(candidate.terms) > len(best.candidate.terms)
            # the same law with a free shape is no other cause, and more effects are no simpler one
            if (candidate.is_family and is_same_family) or is_longer:
                continue
            if self.score(hypothesis) <= least_competing_score:
                continue
            if not best_share.is_larger_than(self.decisive_share(hypothesis)):
                by_effects.setdefault(effects_at_places(hypothesis), hypothesis)
        by_effects.pop(effects_at_places(best), None)
        return list(by_effects.values())


def _is_small(share: GapShare, least_low_end: float) -> bool:
    """Return whether the interval of a share is too low for a name."""
    low, high = share.interval
    return high < SEARCH.least_share or low < least_low_end


def families_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the families of a hypothesis with their places."""
    return frozenset((term.effect.family, term.place) for term in hypothesis.candidate.terms)


def effects_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the effects of a hypothesis with their places."""
    return frozenset((term.effect.identifier, term.place) for term in hypothesis.candidate.terms)


def _complexity(hypothesis: ComparedHypothesis) -> tuple[int, int]:
    """Return the number of effects of a hypothesis, and of those whose shape is free."""
    terms = hypothesis.candidate.terms
    return len(terms), sum(term.free_shape for term in terms)
