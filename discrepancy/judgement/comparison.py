"""Comparison of hypotheses if the residuals of none of them are noise alone.

Hypotheses are then compared by simulations under a noise that is wider than recorded, or by how
well their force agrees with the *missing force*, which is estimated from the readings without any
law. In both cases each hypothesis has evidence, and explains a share of the *gap* between the model
and the readings, in fitted and in held-out trials. The comparison decides which hypotheses may be
named in the verdict.
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
from discrepancy.fits.fitting import CandidateFit, try_fit
from discrepancy.fits.gates import ABSOLUTE_FIT_LEVEL, check_absolute_fit
from discrepancy.fits.predictive import residual_set
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.gap_share import GapShare
from discrepancy.proof_record import ClosedShare
from discrepancy.search.starts import changes_structure
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
    """A comparison of the hypotheses of a search; how it is made depends on the subclass.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.

    Attributes
    ----------
    least_low_end : float
        The least value that the lower end of the 90 % interval of the explained share must have for
        a hypothesis to be named.
    has_held_out : bool
        Whether there are trials that were not fitted.
    standing : H or None
        The hypothesis that the verdict is about, if there is one.
    """

    least_low_end: float

    def __init__(self, search: Search) -> None:
        self.search = search
        self.problem = search.problem
        self.has_held_out = bool(self.problem.campaign.held_out)
        self.standing: H | None = None
        self._subsets: dict[CandidateKey, H | None] = {}
        # the methods are cached, so that each result is computed once for a hypothesis
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
        """Return a sentence that describes the gap; empty if nothing is known of it."""

    @abstractmethod
    def _gap_share(self, hypothesis: H, *, held_out: bool) -> GapShare:
        """Return the share of the gap that a hypothesis explains, in fitted or held-out trials."""

    @abstractmethod
    def fit_followed(self, candidate: Candidate, effect: FloatArray) -> H | None:
        """Return the fit of a further candidate; None if it cannot be fitted.

        Parameters
        ----------
        candidate : Candidate
            The effects.
        effect : (E,) array
            The scaled effect parameters from which the fit begins.
        """

    @abstractmethod
    def with_free_shape(self, hypothesis: H) -> H | None:
        """Return the fit of a single law with its shape free; None if that was not compared."""

    @abstractmethod
    def start_point(self, hypothesis: H) -> Point:
        """Return the point from which the simulation of a hypothesis is fitted."""

    @abstractmethod
    def check_fit(self, hypothesis: H) -> Gate:
        """Test whether the residuals of the simulation of a hypothesis are noise alone."""

    @abstractmethod
    def failed_check(self, hypothesis: H) -> str:
        """Return the reason of a further test that a hypothesis fails; empty if it fails none."""

    @abstractmethod
    def _simulation(self, hypothesis: H) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    @abstractmethod
    def remaining_text(self, hypothesis: H, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis does not explain."""

    def score(self, hypothesis: H) -> float:
        """Return ln (evidence times prior) of a hypothesis [nat]."""
        return hypothesis.log_evidence + self.search.log_prior(hypothesis.candidate)

    def passes_absolute_fit(self, hypothesis: H) -> bool:
        """Return whether the residuals of a hypothesis agree with the noise records."""
        simulation = self.search.exact_fits.get(hypothesis.candidate.key)
        if simulation is None:
            start = self.start_point(hypothesis)
            simulation = try_fit(self.problem, hypothesis.candidate, start)
        if simulation is None:
            return False
        return check_absolute_fit(self.problem, simulation).passed is not False

    def _residuals(self, simulation: CandidateFit) -> ResidualSet:
        """Return the residuals of a simulation in the fitted and held-out trials."""
        return residual_set(self.problem, simulation, sensitivities=False)

    def _closed_share(self, hypothesis: H) -> tuple[ClosedShare | None, str]:
        """Return the share of the mean square error that a hypothesis removes.

        The errors are those of simulations without and with the hypothesis, even if hypotheses are
        compared by the missing force.

        Returns
        -------
        share : ClosedShare or None
            The share; None if none can be given.
        clause : str
            The share in words, or the reason why none can be given.
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
        """Return the share of the gap by which a hypothesis is judged.

        It is that in held-out trials if these can test the hypothesis, else that in fitted trials.
        """
        if self.has_held_out:
            held_out_share = self.share(hypothesis, held_out=True)
            if held_out_share.is_tested:
                return held_out_share
        return self.share(hypothesis, held_out=False)

    def acts_on_structure(self, term: EffectTerm) -> bool:
        """Return whether an effect changes the structure or its loads, and not only readings."""
        return changes_structure(term.effect, self.problem.setting)

    def objection(self, hypothesis: H) -> str:
        """Return the reason why a hypothesis may not be named; empty if it may be named."""
        candidate = hypothesis.candidate
        if not any(self.acts_on_structure(term) for term in candidate.terms):
            return "it describes readings, causes nothing and leaves more than noise"
        if candidate.has_free_shape and len(candidate.terms) > 1:
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
        """Return the kind of shared unknowns that a hypothesis moves far from their priors.

        It is empty if there is none. The test is that of χ² with prior deviations that are
        `SEARCH.widened` times the stated ones, since calibrated values take up errors that the
        hypothesis does not explain.
        """
        shared = self.problem.shared
        has_prior = shared.precision > 0.0
        indices_by_kind = {
            "calibrated parameters": slice(shared.parameter_count),
            "gains": slice(shared.parameter_count, None),
        }
        for kind, indices in indices_by_kind.items():
            u = hypothesis.shared[indices][has_prior[indices]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_FIT_LEVEL:
                return kind
        return ""

    def _survives_held_out(self, hypothesis: H, least_low_end: float) -> bool:
        """Return whether held-out trials confirm a hypothesis, or at least do not contradict it.

        Trials in which a law has hardly any force cannot test it. They contradict the law only if
        the gap is clearly larger with it.

        Parameters
        ----------
        hypothesis : H
            The hypothesis.
        least_low_end : float
            The least lower end of the interval of its share in held-out trials.
        """
        share = self.share(hypothesis, held_out=True)
        if share.is_tested:
            return not _is_small(share, least_low_end)
        return share.value > LEAST_CONTRADICTING

    @cached_property
    def contenders(self) -> list[H]:
        """The hypotheses that may be named, in descending order of score.

        Errors of readings are removed from sets that contain laws too, since together with a law
        they describe whatever the law does not explain. A set without them keeps the score of the
        whole set.
        """
        contenders: dict[CandidateKey, tuple[H, float]] = {}
        for hypothesis in self.ranked:
            terms = hypothesis.candidate.terms
            laws = [number for number, term in enumerate(terms) if self.acts_on_structure(term)]
            laws_only: H | None = hypothesis
            if 0 < len(laws) < len(terms):
                laws_only = self._subset(hypothesis, laws)
            if not terms or laws_only is None or laws_only.candidate.key in contenders:
                continue
            if not self.objection(laws_only):
                contenders[laws_only.candidate.key] = (laws_only, self.score(hypothesis))
        best_score = max((score for _, score in contenders.values()), default=0.0)
        least_score = best_score - SEARCH.contenders
        return [hypothesis for hypothesis, score in contenders.values() if score > least_score]

    def _subset(self, hypothesis: H, numbers: Sequence[int]) -> H | None:
        """Return the hypothesis of some terms of a hypothesis, given their indices.

        It is None if these terms cannot be fitted alone.
        """
        candidate, effect = hypothesis.candidate.subset_of_terms(numbers, hypothesis.effect)
        key = candidate.key
        for known in self.ranked:
            if known.candidate.key == key:
                return known
        if key not in self._subsets:
            self._subsets[key] = self.fit_followed(candidate, effect)
        return self._subsets[key]

    def simplest_equivalent(self, best: H) -> H:
        """Return the simplest hypothesis that explains nearly as much of the gap as the best one.

        The simplest has the fewest effects, then the fewest free shapes, then the highest score.
        """
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
        """Return whether a hypothesis may replace the best one because it is simpler.

        Its families must be among those of the best one, it must explain nearly the same share of
        the gap, and it must be one that may be named.
        """
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
        """Return the probability that at least one of some hypotheses is true.

        A hypothesis is also counted as true if a larger one is, that is one which contains all of
        its families at their places. Hypotheses that trials refute have no probability.
        """
        not_refuted = []
        for other in self.ranked:
            is_asked = any(other is hypothesis for hypothesis in hypotheses)
            if is_asked or not other.candidate.terms or not self._is_refuted(other):
                not_refuted.append(other)
        scores = np.array([self.score(other) for other in not_refuted])
        families_asked = [families_at_places(hypothesis) for hypothesis in hypotheses]
        includes_asked = []
        for other in not_refuted:
            families = families_at_places(other)
            includes_asked.append(
                any(asked_families <= families for asked_families in families_asked)
            )
        holds = np.array(includes_asked)
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _is_refuted(self, hypothesis: H) -> bool:
        """Return whether trials show that a hypothesis does not explain enough of the gap."""
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
            if (candidate.has_free_shape and is_same_family) or is_longer:
                continue
            if self.score(hypothesis) <= least_competing_score:
                continue
            if not best_share.is_larger_than(self.decisive_share(hypothesis)):
                by_effects.setdefault(effects_at_places(hypothesis), hypothesis)
        by_effects.pop(effects_at_places(best), None)
        return list(by_effects.values())


def _is_small(share: GapShare, least_low_end: float) -> bool:
    """Return whether the 90 % interval of a share is too low for a hypothesis to be named."""
    low, high = share.interval
    return high < SEARCH.least_share or low < least_low_end


def families_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the pairs (family, place) of the effects of a hypothesis."""
    return frozenset((term.effect.family, term.place) for term in hypothesis.candidate.terms)


def effects_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the pairs (identifier, place) of the effects of a hypothesis."""
    return frozenset((term.effect.identifier, term.place) for term in hypothesis.candidate.terms)


def _complexity(hypothesis: ComparedHypothesis) -> tuple[int, int]:
    """Return the number of effects of a hypothesis, and of those whose shape is free."""
    terms = hypothesis.candidate.terms
    return len(terms), sum(term.free_shape for term in terms)
