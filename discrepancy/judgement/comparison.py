"""Comparison of the hypotheses of a search: evidence, explained share of the gap, objections.

Hypotheses on a model with ports are estimated with the force that they leave missing, but for
missions and load steps on a mesh. Others are compared by simulations, under the recorded noise or
under a noise as large as their residuals. In both cases each hypothesis has evidence, and explains
a share of the *gap* between the model and the readings, in fitted and in held-out trials. `decide`
draws the verdict from them.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from typing import Generic, TypeVar

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.force_curve import curve_families_of
from discrepancy.fits.candidate import Candidate, CandidateKey, EffectTerm
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import ABSOLUTE_FIT_LEVEL, check_absolute_fit
from discrepancy.missing_force.gap_share import GapShare
from discrepancy.proof_record import ErrorComparison
from discrepancy.search.fitted_candidates import ComparedHypothesis
from discrepancy.search.starts import changes_structure
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate
from reporting.probabilities import normalised_probabilities, probability_of_some

from .closed_share import closed_share_text
from .proof import errors_of_fit

CONTRADICTING_SHARE = -0.1
"""Share of the gap below which held-out trials contradict a law that has hardly any force in
them."""

HypothesisT = TypeVar("HypothesisT", bound=ComparedHypothesis)
EffectSet = tuple[str, ...]
"""The sorted identifiers of a set of effects."""
EffectPlacePairs = frozenset[tuple[str, str]]
"""Pairs of an effect, or a family of effects, and its place."""


class Comparison(ABC, Generic[HypothesisT]):
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
    """

    least_low_end: float

    def __init__(self, search: Search) -> None:
        self.search = search
        self.problem = search.problem
        self.has_held_out = bool(self.problem.campaign.held_out)
        self._subsets: dict[CandidateKey, HypothesisT | None] = {}
        # the methods are cached, so that each result is computed once for a hypothesis
        self.gap_share = cache(self._compute_gap_share)
        self.simulation = cache(self._compute_simulation)

    # ---------------------------------------------------------------- how they are compared

    @property
    @abstractmethod
    def no_effect(self) -> HypothesisT:
        """The hypothesis without an effect."""

    @property
    @abstractmethod
    def log_evidence_of_nothing(self) -> float:
        """The log evidence of the model as it is, which lacks neither effect nor force [nat]."""

    @property
    @abstractmethod
    def ranked_hypotheses(self) -> Sequence[HypothesisT]:
        """All hypotheses, the most probable first."""

    @abstractmethod
    def _compute_gap_share(self, hypothesis: HypothesisT, *, held_out: bool) -> GapShare:
        """Return the share of the gap that a hypothesis explains, in fitted or held-out trials."""

    @abstractmethod
    def fit_candidate(self, candidate: Candidate, effect_values: FloatArray) -> HypothesisT | None:
        """Return the fit of a further candidate, from scaled effect parameters (E,).

        None if it cannot be fitted.
        """

    @abstractmethod
    def fit_with_free_shape(self, hypothesis: HypothesisT) -> HypothesisT | None:
        """Return the fit of a single law with its shape free; None if that was not compared."""

    @abstractmethod
    def simulation_of_best_fit(self, hypothesis: HypothesisT) -> CandidateFit:
        """Return the simulation of a hypothesis, fitted to the readings until it converges.

        It is the fit without effect if the hypothesis cannot be simulated.
        """

    @abstractmethod
    def failed_check_reason(self, hypothesis: HypothesisT) -> str:
        """Return the reason of a further test that a hypothesis fails; empty if it fails none."""

    @abstractmethod
    def _compute_simulation(self, hypothesis: HypothesisT) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    @abstractmethod
    def unexplained_text(self, hypothesis: HypothesisT, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis does not explain."""

    def subsets(self, hypothesis: HypothesisT) -> list[HypothesisT]:
        """Return the compared hypotheses that have some of the effects of one, the fewest first."""
        full_key = set(hypothesis.candidate.key)
        subsets = []
        for ranked_hypothesis in self.ranked_hypotheses:
            key = set(ranked_hypothesis.candidate.key)
            if key and key < full_key:
                subsets.append(ranked_hypothesis)
        return sorted(subsets, key=lambda subset: len(subset.candidate.terms))

    def score(self, hypothesis: HypothesisT) -> float:
        """Return ln (evidence times prior) of a hypothesis [nat]."""
        return self.search.score(hypothesis)

    def log_bayes_factor(self, hypothesis: HypothesisT) -> float:
        """Return ln of the evidence of a hypothesis over that of the model as it is [nat].

        The evidence is divided by the number of places from which those of the effects were chosen.
        """
        setting = self.problem.setting
        place_counts = [len(term.effect.places(setting)) for term in hypothesis.candidate.terms]
        log_places = float(np.log(place_counts).sum()) if place_counts else 0.0
        return hypothesis.log_evidence - log_places - self.log_evidence_of_nothing

    def set_probabilities(self) -> Mapping[EffectSet, float]:
        """Return the probability of each set of effects over all places, in descending order.

        Sets that can imitate nearly anything are left out: they do not compete for a name.
        """
        scores_by_set: dict[EffectSet, list[float]] = {}
        for hypothesis in self.ranked_hypotheses:
            candidate = hypothesis.candidate
            if not candidate.can_imitate_nearly_anything:
                scores_by_set.setdefault(candidate.identifiers, []).append(self.score(hypothesis))
        log_weights = {names: float(logsumexp(scores)) for names, scores in scores_by_set.items()}
        sets_in_order = sorted(log_weights, key=lambda names: -log_weights[names])
        probabilities = normalised_probabilities([log_weights[names] for names in sets_in_order])
        return dict(zip(sets_in_order, probabilities.tolist(), strict=True))

    def best_of_set(self, identifiers: EffectSet) -> HypothesisT:
        """Return the most probable hypothesis of a set of effects, whatever their places."""
        return next(
            hypothesis
            for hypothesis in self.ranked_hypotheses
            if hypothesis.candidate.identifiers == identifiers
        )

    def hypothesis_of(self, candidate: Candidate) -> HypothesisT | None:
        """Return the hypothesis of a candidate; None if it was not compared."""
        for hypothesis in self.ranked_hypotheses:
            if hypothesis.candidate.key == candidate.key:
                return hypothesis
        return None

    def open_hypotheses(self, count: int = 5) -> list[tuple[CandidateFit, float]]:
        """Return the simulations of the most probable sets of effects, with their probabilities."""
        probabilities = list(self.set_probabilities().items())[:count]
        return [
            (self.simulation_of_best_fit(self.best_of_set(identifiers)), probability)
            for identifiers, probability in probabilities
        ]

    def absolute_fit(self, hypothesis: HypothesisT) -> Gate:
        """Test whether the residuals of the simulation of a hypothesis are noise as recorded."""
        return check_absolute_fit(self.problem, self.simulation_of_best_fit(hypothesis))

    def fit_probable_sets(self) -> None:
        """Fit the most probable sets until they converge, if the comparison has others."""

    def admit_remainder(self) -> None:
        """Compare the hypotheses with what each leaves unexplained, if they are not yet."""

    def admit_no_remainder(self) -> None:
        """Compare the hypotheses again as before `admit_remainder`."""

    def record_values(self, hypothesis: HypothesisT) -> ComparedHypothesis:
        """Return the hypothesis with the values that a verdict lists of it."""
        return hypothesis

    def errors(self, hypothesis: HypothesisT) -> ErrorComparison:
        """Return the errors of simulations without and with a hypothesis.

        Simulations are taken even if the hypotheses are compared by the missing force.
        """
        return errors_of_fit(self.search, self.simulation(hypothesis))

    def closed_share_clause(self, hypothesis: HypothesisT) -> str:
        """Return the share of the mean square error that a hypothesis removes, as a clause.

        If there is no share, the clause states the reason.
        """
        errors = self.errors(hypothesis)
        if errors.closed is None:
            # the reason is a sentence; a clause has neither its capital letter nor its full stop
            return f"{errors.closed_reason[0].lower()}{errors.closed_reason[1:-1]}"
        return closed_share_text(self.problem.campaign.channels, errors)

    def enlarges_error(self, hypothesis: HypothesisT) -> bool:
        """Return whether a hypothesis makes the error larger, or cannot be simulated."""
        if self.simulation(hypothesis) is self.search.no_effect:
            # the simulation without effect stands for a hypothesis that cannot be simulated
            return True
        return self.errors(hypothesis).has_grown

    def reason_of_remaining_error(self, hypothesis: HypothesisT) -> str:
        """Return the reason if most of the error of held-out trials remains with a hypothesis.

        It is empty if at least `SEARCH.least_gap_share` of their mean square error is removed, and
        if nothing is held out.
        """
        closed = self.errors(hypothesis).closed
        if closed is None or closed.trials != "held-out" or closed.value >= SEARCH.least_gap_share:
            return ""
        return (
            "a name must remove at least "
            f"{100 * SEARCH.least_gap_share:g} % of the mean square error there"
        )

    def is_proved_curve(self, hypothesis: HypothesisT) -> bool:
        """Return whether held-out trials prove a force of free shape.

        Fitted to other trials, it explains at least `SEARCH.proving_share` of their missing force
        and of their mean square error. A missing force without any law has a course of its own in
        each trial: before a trial was measured it explains nothing of it.
        """
        terms = hypothesis.candidate.terms
        if not self.has_held_out or len(terms) != 1 or terms[0].effect.table is None:
            return False
        share = self.gap_share(hypothesis, held_out=True)
        closed = self.errors(hypothesis).closed
        return bool(
            share.is_tested
            and share.interval[0] >= SEARCH.proving_share
            and closed is not None
            and closed.trials == "held-out"
            and closed.value >= SEARCH.proving_share
        )

    # ---------------------------------------------------------------- which may be named

    def held_out_or_fitted_share(self, hypothesis: HypothesisT) -> GapShare:
        """Return the explained share of the gap that decides about a hypothesis.

        The share in held-out trials is taken if these trials can test the hypothesis, else the
        share in fitted trials.
        """
        if self.has_held_out:
            held_out_share = self.gap_share(hypothesis, held_out=True)
            if held_out_share.is_tested:
                return held_out_share
        return self.gap_share(hypothesis, held_out=False)

    def acts_on_structure(self, term: EffectTerm) -> bool:
        """Return whether an effect changes the structure or its loads, and not only readings."""
        return changes_structure(term.effect, self.problem.setting)

    def objection_to_naming(self, hypothesis: HypothesisT) -> str:
        """Return the reason why a hypothesis may not be named; empty if it may be named.

        The reason is the first of these: no effect acts on the structure; a free shape beside
        another law; an explained share of the gap that is too low in fitted trials
        (`_is_share_too_small`) or held-out trials (`_survives_held_out`); shared unknowns far from
        their priors; a further test of the subclass.
        """
        candidate = hypothesis.candidate
        if not any(self.acts_on_structure(term) for term in candidate.terms):
            return "it describes readings but no physical cause, and leaves more than noise"
        if candidate.can_imitate_nearly_anything:
            return "beside another law, a law with a free shape can imitate nearly anything"
        fitted_share = self.gap_share(hypothesis, held_out=False)
        if _is_share_too_small(fitted_share, self.least_low_end):
            return (
                f"where it was fitted it leaves {self.unexplained_text(hypothesis, fitted_share)}"
            )
        if self.has_held_out and not self._survives_held_out(hypothesis, self.least_low_end):
            held_out_share = self.gap_share(hypothesis, held_out=True)
            unexplained_text = self.unexplained_text(hypothesis, held_out_share)
            return f"in trials that were not fitted it leaves {unexplained_text}"
        implausible = self._implausible_unknowns(hypothesis)
        if implausible:
            return f"it needs {implausible} far outside their priors: check these priors"
        return self.failed_check_reason(hypothesis)

    def _implausible_unknowns(self, hypothesis: HypothesisT) -> str:
        """Return the kind of shared unknowns that a hypothesis moves far from their priors.

        It is empty if there is none. The test is that of χ² with prior deviations that are
        `SEARCH.prior_widening` times the stated ones, since calibrated values also compensate
        errors that the hypothesis does not explain.
        """
        layout = self.problem.shared
        has_prior = layout.precision > 0.0
        indices_by_kind = {
            "calibrated parameters": slice(layout.parameter_count),
            "gains": slice(layout.parameter_count, None),
        }
        for kind, indices in indices_by_kind.items():
            scaled_values = hypothesis.shared[indices][has_prior[indices]]
            if (
                scaled_values.size
                and chi2.sf(
                    scaled_values @ scaled_values / SEARCH.prior_widening**2, scaled_values.size
                )
                < ABSOLUTE_FIT_LEVEL
            ):
                return kind
        return ""

    def _survives_held_out(self, hypothesis: HypothesisT, least_low_end: float) -> bool:
        """Return whether held-out trials confirm a hypothesis, or at least do not contradict it.

        They confirm it if the 90 % interval of its share reaches `SEARCH.least_gap_share` and does
        not begin below `least_low_end`. Trials in which a law has hardly any force cannot test it:
        they contradict it only if the gap is at least a tenth larger with it
        (`CONTRADICTING_SHARE`).
        """
        share = self.gap_share(hypothesis, held_out=True)
        if share.is_tested:
            return not _is_share_too_small(share, least_low_end)
        return share.value > CONTRADICTING_SHARE

    @cached_property
    def nameable_hypotheses(self) -> list[HypothesisT]:
        """The hypotheses that may be named, in descending order of score.

        Nothing speaks against naming them (`objection_to_naming`), and their scores are within
        `SEARCH.contender_range` of the best one of them. A set of both laws and errors of readings
        is replaced by its laws alone, fitted again, as errors of readings can hide what a law
        leaves. The laws keep the score of the set that they come from; if they come from several,
        the highest.
        """
        nameable_with_scores: dict[CandidateKey, tuple[HypothesisT, float]] = {}
        for hypothesis in self.ranked_hypotheses:
            terms = hypothesis.candidate.terms
            law_indices = [
                index for index, term in enumerate(terms) if self.acts_on_structure(term)
            ]
            laws_only: HypothesisT | None = hypothesis
            if 0 < len(law_indices) < len(terms):
                laws_only = self._hypothesis_with_terms(hypothesis, law_indices)
            if not terms or laws_only is None or laws_only.candidate.key in nameable_with_scores:
                continue
            if not self.objection_to_naming(laws_only):
                nameable_with_scores[laws_only.candidate.key] = (
                    laws_only,
                    self.score(hypothesis),
                )
        best_score = max((score for _, score in nameable_with_scores.values()), default=0.0)
        least_score = best_score - SEARCH.contender_range
        return [
            hypothesis for hypothesis, score in nameable_with_scores.values() if score > least_score
        ]

    def _hypothesis_with_terms(
        self, hypothesis: HypothesisT, term_indices: Sequence[int]
    ) -> HypothesisT | None:
        """Return the hypothesis that has only some of the effects of a given hypothesis.

        The effects are given by their indices in the candidate. The hypothesis is fitted unless it
        has been before. None is returned if the effects cannot be fitted without the others.
        """
        candidate, effect_values = hypothesis.candidate.subset_of_terms(
            term_indices, hypothesis.effect
        )
        # it may be one of the hypotheses that are compared
        compared_hypothesis = self.hypothesis_of(candidate)
        if compared_hypothesis is not None:
            return compared_hypothesis
        # otherwise it is fitted once and not compared; None marks a fit that failed
        key = candidate.key
        if key not in self._subsets:
            self._subsets[key] = self.fit_candidate(candidate, effect_values)
        return self._subsets[key]

    def simplest_equivalent_hypothesis(self, best_hypothesis: HypothesisT) -> HypothesisT:
        """Return the simplest hypothesis that explains nearly as much of the gap as the best one.

        The simplest has the fewest effects, then the fewest free shapes, then the highest score.
        """
        effect_count = len(best_hypothesis.candidate.terms)
        options: dict[CandidateKey, HypothesisT] = {}
        for hypothesis in self.ranked_hypotheses:
            options[hypothesis.candidate.key] = hypothesis
        if effect_count > 1:
            for term_index in range(effect_count):
                single_effect = self._hypothesis_with_terms(best_hypothesis, [term_index])
                if single_effect is not None:
                    options[single_effect.candidate.key] = single_effect
        simpler_options = [
            option for option in options.values() if self._is_simpler(option, best_hypothesis)
        ]
        return min(
            simpler_options,
            key=lambda hypothesis: (*_complexity(hypothesis), -self.score(hypothesis)),
            default=best_hypothesis,
        )

    def _is_simpler(self, option: HypothesisT, best_hypothesis: HypothesisT) -> bool:
        """Return whether a hypothesis may replace the best one because it is simpler.

        Its families must be among those of the best one, it must explain nearly the same share of
        the gap, and nothing must speak against naming it.
        """
        if not option.candidate.terms or _complexity(option) >= _complexity(best_hypothesis):
            return False
        if not family_place_pairs(option) <= family_place_pairs(best_hypothesis):
            return False
        # Any further parameter explains a little more of the fitted trials, by fitting noise. So
        # the simpler hypothesis may explain less there, by three times the tolerance.
        best_fitted_share = self.gap_share(best_hypothesis, held_out=False).value
        least_fitted_share = best_fitted_share - 3.0 * SEARCH.least_added_share
        if self.gap_share(option, held_out=False).value <= least_fitted_share:
            return False
        best_share = self.held_out_or_fitted_share(best_hypothesis).value
        least_share = best_share - SEARCH.least_added_share
        if self.held_out_or_fitted_share(option).value <= least_share:
            return False
        return not self.objection_to_naming(option)

    def probability(self, *hypotheses: HypothesisT) -> float:
        """Return the probability that at least one of the given hypotheses is true.

        - A ranked hypothesis counts for a given one if it contains all families of the given one at
          the same places, possibly beside further effects. It counts for a force of free shape if a
          law of it follows the same variable at the same port: two laws of one variable are a curve
          over it, too.
        - A ranked hypothesis that trials refute has no probability. Two kinds are kept in any case:
          the given ones, whose probability is asked for, and those without effects, which by
          definition explain nothing of the gap. The latter are dropped beside a force of free shape
          that held-out trials prove.
        """
        is_proved = any(self.is_proved_curve(hypothesis) for hypothesis in hypotheses)
        not_refuted = []
        for ranked_hypothesis in self.ranked_hypotheses:
            # the same object: another fit of the same effects is another hypothesis
            is_asked_about = any(ranked_hypothesis is hypothesis for hypothesis in hypotheses)
            has_effects = bool(ranked_hypothesis.candidate.terms)
            if has_effects:
                is_kept = not self._is_refuted_by_trials(ranked_hypothesis)
            else:
                is_kept = not is_proved
            if is_asked_about or is_kept:
                not_refuted.append(ranked_hypothesis)
        scores = np.array([self.score(hypothesis) for hypothesis in not_refuted])
        # a hypothesis counts if it contains all families of one of those asked about
        families_asked_about = [family_place_pairs(hypothesis) for hypothesis in hypotheses]
        is_counted = np.zeros(len(not_refuted), dtype=bool)
        for index, hypothesis in enumerate(not_refuted):
            families = family_place_pairs(hypothesis) | self._curves_of_laws(hypothesis)
            is_counted[index] = any(
                asked_families <= families for asked_families in families_asked_about
            )
        if not is_counted.any():
            return 0.0
        return probability_of_some(scores, is_counted)

    def _curves_of_laws(self, hypothesis: HypothesisT) -> EffectPlacePairs:
        """Return the families of free shape that the laws of a hypothesis belong to, with ports."""
        setting = self.problem.setting
        patch = hypothesis.candidate.patch(setting, hypothesis.effect)
        return frozenset(curve_families_of(setting, patch))

    def more_probable_rival(self, hypothesis: HypothesisT) -> HypothesisT | None:
        """Return the most probable hypothesis with effects if it is not refuted by trials.

        None if it is the given hypothesis or less probable than that.
        """
        for rival in self.ranked_hypotheses:
            if rival is hypothesis:
                break
            if rival.candidate.terms and not self._is_refuted_by_trials(rival):
                return rival
        return None

    def _is_refuted_by_trials(self, hypothesis: HypothesisT) -> bool:
        """Return whether trials show that a hypothesis does not explain enough of the gap."""
        _, high = self.gap_share(hypothesis, held_out=False).interval
        if high < SEARCH.least_gap_share:
            return True
        return self.has_held_out and not self._survives_held_out(hypothesis, 0.0)

    def probability_of_family(self, family: str) -> float:
        """Return the probability that one effect of a family, with any shape, is missing alone."""
        scores = np.array([self.score(hypothesis) for hypothesis in self.ranked_hypotheses])
        is_member = []
        for hypothesis in self.ranked_hypotheses:
            terms = hypothesis.candidate.terms
            is_member.append(len(terms) == 1 and terms[0].effect.family == family)
        return probability_of_some(scores, np.array(is_member))

    def competing_hypotheses(self, best_hypothesis: HypothesisT) -> list[HypothesisT]:
        """Return the hypotheses that could be named instead of the best one.

        The data do not separate them from the best one: their scores are at most
        `SEARCH.force_rival_range` lower, and their shares of the gap are not significantly smaller.
        Hypotheses with more effects do not compete, nor does the same law with a free shape.
        """
        best_share = self.held_out_or_fitted_share(best_hypothesis)
        least_competing_score = self.score(best_hypothesis) - SEARCH.force_rival_range
        by_effects: dict[EffectPlacePairs, HypothesisT] = {}
        for hypothesis in self.nameable_hypotheses:
            candidate = hypothesis.candidate
            is_same_family = family_place_pairs(hypothesis) == family_place_pairs(best_hypothesis)
            is_longer = len(candidate.terms) > len(best_hypothesis.candidate.terms)
            if (candidate.has_free_shape and is_same_family) or is_longer:
                continue
            if self.score(hypothesis) <= least_competing_score:
                continue
            if not best_share.is_larger_than(self.held_out_or_fitted_share(hypothesis)):
                by_effects.setdefault(effect_place_pairs(hypothesis), hypothesis)
        by_effects.pop(effect_place_pairs(best_hypothesis), None)
        return list(by_effects.values())


def _is_share_too_small(share: GapShare, least_low_end: float) -> bool:
    """Return whether the 90 % interval of a share is too low for a hypothesis to be named.

    It is too low if it ends below `SEARCH.least_gap_share`, or begins below `least_low_end`.
    """
    low, high = share.interval
    return high < SEARCH.least_gap_share or low < least_low_end


def family_place_pairs(hypothesis: ComparedHypothesis) -> EffectPlacePairs:
    """Return the pairs (family, place) of the effects of a hypothesis."""
    return frozenset((term.effect.family, term.place) for term in hypothesis.candidate.terms)


def effect_place_pairs(hypothesis: ComparedHypothesis) -> EffectPlacePairs:
    """Return the pairs (identifier, place) of the effects of a hypothesis."""
    return frozenset((term.effect.identifier, term.place) for term in hypothesis.candidate.terms)


def _complexity(hypothesis: ComparedHypothesis) -> tuple[int, int]:
    """Return how many effects a hypothesis has, and how many of them have a free shape."""
    terms = hypothesis.candidate.terms
    return len(terms), sum(term.free_shape for term in terms)


def most_probable_sets(probabilities: Mapping[EffectSet, float]) -> list[EffectSet]:
    """Return the most probable sets whose probabilities add up to that which a name needs.

    Parameters
    ----------
    probabilities : mapping of tuple of str to float
        The probability of each set of effects, in descending order.
    """
    cumulative_probabilities = np.cumsum(list(probabilities.values()))
    last_set = int(np.searchsorted(cumulative_probabilities, SEARCH.name_probability))
    return list(probabilities)[: last_set + 1]
