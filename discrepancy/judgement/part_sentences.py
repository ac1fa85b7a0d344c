"""Sentences that are added to a name in part: the shape of its law, and what may be beside it."""

import numpy as np

from discrepancy.search_settings import SEARCH
from reporting.words import capital

from .comparison import Comparison, H, families_at_places
from .conclusion import (
    effects_text,
    named_effects,
)


def shape_sentence(comparison: Comparison[H], best: H) -> str:
    """Return the sentence on the free shape of a single law.

    Empty if held-out trials speak against it.
    """
    if len(best.candidate.terms) != 1:
        return ""
    (term,) = best.candidate.terms
    free = comparison.with_free_shape(best)
    if free is None:
        return ""
    least_share = comparison.decisive_share(best).value - SEARCH.slim
    if comparison.decisive_share(free).value < least_share:
        return ""
    first_shape = len(free.shared) + len(term.effect.parameters)
    deviations = np.sqrt(np.diag(free.covariance))[first_shape:]
    (effect,) = named_effects(comparison.problem, free)
    texts = []
    for parameter, deviation in zip(effect.shape, deviations, strict=True):
        if deviation < SEARCH.told_by_data:
            description = parameter.description.split(" (")[0]
            interval = f"{parameter.low:.2g} to {parameter.high:.2g}"
            texts.append(f"{description} {parameter.value:.2g} ({interval})")
    return f" With a shape of its own: {', '.join(texts)}." if texts else ""


def unproved_addition_sentence(comparison: Comparison[H], best: H) -> str:
    """Return the sentence on a further law that gains too little evidence for a name.

    Empty if there is none.
    """
    families = families_at_places(best)
    least_score = comparison.score(best) - SEARCH.contenders
    addition = None
    for other in comparison.ranked:
        has_more_laws = families_at_places(other) > families
        only_laws = all(comparison.acts_on_structure(term) for term in other.candidate.terms)
        if has_more_laws and only_laws and comparison.score(other) > least_score:
            addition = other
            break
    if addition is None:
        return ""
    least_share = comparison.decisive_share(best).value + SEARCH.sliver
    if comparison.decisive_share(addition).value < least_share:
        return ""
    added = []
    for effect in named_effects(comparison.problem, addition):
        if (effect.family, effect.place) not in families:
            added.append(effect)
    return (
        f" {capital(effects_text(added))} may be there beside it, but is not proved: it gains less "
        "evidence than it costs."
    )
