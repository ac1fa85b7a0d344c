"""A set of effects that is considered for a name, with the tests that only noise may remain."""

from collections.abc import Mapping
from functools import cached_property
from typing import Generic, NamedTuple

from discrepancy.fits.fitting import CandidateFit, fit_free_shape
from discrepancy.fits.gates import LEAST_SHAPE_GAIN, check_absolute_fit, check_shape
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES

from .comparison import Comparison, EffectSet, HypothesisT, most_probable_sets
from .consistency_gate import check_consistency
from .hypotheses import (
    VerdictOutcome,
    WeightedHypothesis,
    names_without_free_shape,
    outcome_with_hypotheses,
)


class CheckedFit(NamedTuple):
    """A fit with the outcomes of the tests of absolute fit and consistency."""

    fit: CandidateFit
    absolute_fit: Gate
    consistency: Gate

    @property
    def fails(self) -> bool:
        """Whether a test fails; a test that could not be made has not failed."""
        return self.absolute_fit.has_failed or self.consistency.has_failed


class NoiseCase(Generic[HypothesisT]):
    """A comparison of hypotheses, of which one set of effects is considered for a name.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    probabilities : mapping of tuple of str to float, optional
        The probability of each set of effects, the most probable first; those of the comparison if
        left out.
    leading_set : tuple of str, optional
        The set that is considered for a name; the most probable one if left out.
    noise : str
        A clause that describes the noise, such as "which is coloured as its records admit".
    """

    def __init__(
        self,
        comparison: Comparison[HypothesisT],
        probabilities: Mapping[EffectSet, float] | None = None,
        leading_set: EffectSet | None = None,
        noise: str = "",
    ) -> None:
        self.comparison = comparison
        self.problem = comparison.problem
        self.noise = noise
        self.probabilities = probabilities or comparison.set_probabilities()
        self.leading_set = next(iter(self.probabilities)) if leading_set is None else leading_set
        self.leading_hypothesis = comparison.best_of_set(self.leading_set)
        self.leading_fit = comparison.simulation_of_best_fit(self.leading_hypothesis)
        self.no_effect_probability = self.probabilities.get((), 0.0)
        self.no_effect_gate = check_absolute_fit(self.problem, self.no_effect_fit)

    @property
    def no_effect_fit(self) -> CandidateFit:
        """The simulation of the model without effect."""
        return self.comparison.search.compared_no_effect

    # ---------------------------------------------------------------- how probable

    @property
    def log_bayes_factor(self) -> float:
        """Ln of the evidence of the leading set over that of the model as it is [nat]."""
        return self.comparison.log_bayes_factor(self.leading_hypothesis)

    @property
    def has_enough_evidence(self) -> bool:
        """Whether the leading set has the evidence that a name needs."""
        return self.log_bayes_factor >= SEARCH.least_log_bayes_factor

    @property
    def is_better_than_no_effect(self) -> bool:
        """Whether a set of effects is preferred to the model without effect.

        That is so if the most probable set is not the empty one, and either its Bayes factor is
        large enough or the model without effect fails the test of absolute fit.
        """
        return bool(self.leading_fit.candidate.terms) and (
            self.has_enough_evidence or self.no_effect_gate.has_failed
        )

    @cached_property
    def probability(self) -> float:
        """The probability that the effects of the leading set are missing in the model.

        It is the sum over all sets that contain them. The exponents of a law of free shape are
        fitted, so that all effects of its family, such as all dampings, can become the same law. If
        the set has such a law, the probability of its family is taken if that is larger.
        """
        leading_names = set(names_without_free_shape(self.leading_set))
        set_probability = sum(
            probability
            for names, probability in self.probabilities.items()
            if leading_names <= set(names_without_free_shape(names))
        )
        # the same law of free shape is counted under several effects and at several places
        if self.leading_fit.candidate.has_free_shape:
            family = self.leading_fit.candidate.terms[0].effect.family
            set_probability = max(set_probability, self.comparison.probability_of_family(family))
        return min(set_probability, 1.0)

    @property
    def is_sure_enough_to_name(self) -> bool:
        """Whether the leading set is probable enough and has enough evidence to be named."""
        return self.probability >= SEARCH.name_probability and self.has_enough_evidence

    @cached_property
    def probable_sets(self) -> list[EffectSet]:
        """The most probable sets whose probabilities add up to that which a name needs."""
        return most_probable_sets(self.probabilities)

    # ---------------------------------------------------------------- tests

    def check(self, fit: CandidateFit) -> CheckedFit:
        """Return a fit with its tests of absolute fit and consistency."""
        return CheckedFit(
            fit, check_absolute_fit(self.problem, fit), check_consistency(self.problem, fit)
        )

    @cached_property
    def tested_set(self) -> CheckedFit:
        """The leading set with its tests."""
        return self.check(self.leading_fit)

    @cached_property
    def _best_free_shape(self) -> CandidateFit | None:
        """The fit with the most evidence in which one effect of the set has a free shape.

        None if no effect of the set has a shape parameter, if one is free already, or if the noise
        is coloured.
        """
        if self.leading_fit.candidate.has_free_shape or self.noise:
            return None
        fits_with_free_shape = []
        for term_index in range(len(self.leading_fit.candidate.terms)):
            free_fit = fit_free_shape(self.problem, self.leading_fit, term_index)
            if free_fit is not None:
                fits_with_free_shape.append(free_fit)
        return max(fits_with_free_shape, key=lambda fit: fit.log_evidence, default=None)

    @cached_property
    def shape_gate(self) -> Gate:
        """The test whether a free shape explains more than the effects as they are."""
        return check_shape(self.leading_fit, self._best_free_shape)

    @property
    def needs_free_shape(self) -> bool:
        """Whether a free shape explains so much more that the family is named instead."""
        return self.shape_gate.statistic > LEAST_SHAPE_GAIN

    @cached_property
    def tested_family_set(self) -> CheckedFit | None:
        """The leading set with a free shape, and its tests; None if it may not be named.

        A free shape counts as one more effect, so the set must not have the largest size already.
        A law of free shape together with a second law could fit nearly anything.
        """
        family_fit = self._best_free_shape
        if family_fit is None or not self.needs_free_shape:
            return None
        patches = self.leading_fit.candidate.patches(self.problem.setting, self.leading_fit.effect)
        law_count = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        if law_count > 1 or len(patches) == SEARCH.largest_set:
            return None
        return self.check(family_fit)

    # ---------------------------------------------------------------- verdicts

    def outcome(
        self,
        kind: VerdictKind,
        sentence: str,
        probability: float,
        fit: CandidateFit | None = None,
        *,
        effects: tuple[NamedEffect, ...] = (),
        group: tuple[str, ...] = (),
        family: str = "",
        gates: tuple[Gate, ...] = (),
        resembles: tuple[str, ...] = (),
        reasons: str = "",
    ) -> VerdictOutcome:
        """Return a verdict together with all sets of effects and their probabilities.

        Each set is represented by its most probable hypothesis, that is by the effects at their
        most probable places.

        Parameters
        ----------
        kind, sentence, probability
            The kind of conclusion, the sentence that the user reads, and its probability.
        fit : CandidateFit, optional
            The fit that represents the verdict. Without it, the fit without any effect is taken.
        effects, group, family, gates, resembles, reasons
            The named effects; the effects that the data cannot tell apart; the family of a law of
            free shape; the tests; the effects that an unexplained remainder resembles; further
            sentences. See `Verdict`.
        """
        verdict = Verdict(
            kind,
            sentence,
            probability,
            self.log_bayes_factor,
            effects=effects,
            group=group,
            family=family,
            gates=gates,
            resembles=resembles,
            reasons=reasons,
        )
        weighted_hypotheses = []
        for names, set_probability in self.probabilities.items():
            hypothesis = self.comparison.record_values(self.comparison.best_of_set(names))
            weighted_hypotheses.append(WeightedHypothesis(hypothesis, set_probability))
        fit = self.no_effect_fit if fit is None else fit
        return outcome_with_hypotheses(verdict, self.comparison.search, fit, weighted_hypotheses)

    def unexplained(
        self,
        sentence: str,
        reasons: str,
        probability: float,
        gates: tuple[Gate, ...],
        names: EffectSet,
    ) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, which resembles a set of effects."""
        return self.outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            probability,
            gates=gates,
            resembles=names_without_free_shape(names),
            reasons=reasons,
        )
