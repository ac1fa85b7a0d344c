"""Sentences that are added to a verdict in part: the shape of a law, and a possible further law."""

import numpy as np

from discrepancy.search_settings import SEARCH
from reporting.words import capital

from .comparison import Comparison, HypothesisT, family_place_pairs
from .conclusion import (
    effects_text,
    named_effects,
)


def shape_sentence(comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT) -> str:
    """Return the sentence on the shape parameters of a single law that the data determine.

    It is empty if there are none, or if the law explains less with a free shape in the decisive
    trials.
    """
    if len(best_hypothesis.candidate.terms) != 1:
        return ""
    (term,) = best_hypothesis.candidate.terms
    free_shape_hypothesis = comparison.fit_with_free_shape(best_hypothesis)
    if free_shape_hypothesis is None:
        return ""
    least_share = (
        comparison.held_out_or_fitted_share(best_hypothesis).value - SEARCH.least_added_share
    )
    if comparison.held_out_or_fitted_share(free_shape_hypothesis).value < least_share:
        return ""
    first_shape = len(free_shape_hypothesis.shared) + len(term.effect.parameters)
    deviations = np.sqrt(np.diag(free_shape_hypothesis.covariance))[first_shape:]
    (effect,) = named_effects(comparison.problem, free_shape_hypothesis)
    texts = []
    for parameter, deviation in zip(effect.shape, deviations, strict=True):
        if deviation < SEARCH.determined_shape_deviation:
            description = parameter.description.split(" (")[0]
            interval = f"{parameter.low:.2g} to {parameter.high:.2g}"
            texts.append(f"{description} {parameter.value:.2g} ({interval})")
    return f" With a fitted shape: {', '.join(texts)}." if texts else ""


def unproved_addition_sentence(
    comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT
) -> str:
    """Return the sentence on a further law that may act too, but has too little evidence.

    It is empty if there is none.
    """
    # the most probable set of laws that contains all families of the best hypothesis and more
    families = family_place_pairs(best_hypothesis)
    least_score = comparison.score(best_hypothesis) - SEARCH.contender_range
    larger_hypothesis = None
    for hypothesis in comparison.ranked_hypotheses:
        has_more_laws = family_place_pairs(hypothesis) > families
        only_laws = all(comparison.acts_on_structure(term) for term in hypothesis.candidate.terms)
        if has_more_laws and only_laws and comparison.score(hypothesis) > least_score:
            larger_hypothesis = hypothesis
            break
    if larger_hypothesis is None:
        return ""
    # it must explain notably more of the gap
    least_share = (
        comparison.held_out_or_fitted_share(best_hypothesis).value + SEARCH.negligible_share
    )
    if comparison.held_out_or_fitted_share(larger_hypothesis).value < least_share:
        return ""
    added_effects = []
    for effect in named_effects(comparison.problem, larger_hypothesis):
        if (effect.family, effect.place) not in families:
            added_effects.append(effect)
    return (
        f" {capital(effects_text(added_effects))} may be missing, too, but this is not proved: it "
        "gains less evidence than it costs."
    )
