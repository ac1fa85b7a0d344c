"""The prior probability of a set of effects."""

from math import comb, log

from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.gates import LEAST_SHAPE_GAIN
from discrepancy.search_settings import SEARCH


def log_prior(candidate: Candidate, effect_count: int, setting: Setting) -> float:
    """Return the log prior probability of a candidate [nat].

    The prior of a set of effects is proportional to the product of their prior weights, and the
    same at all places of an effect. For each free shape it is smaller by `LEAST_SHAPE_GAIN`, the
    gain that the test of shape requires.

    Parameters
    ----------
    effect_count : int
        The number of effects that are compared.
    setting : Setting
        The setting of the problem, which says at which places an effect may act.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    # The number of effects has a prior probability, which the sets of this number share by their
    # weights, and the places of each effect equally. As the mean weight is 1, the priors of single
    # effects add up to that of their number, and those of larger sets nearly do.
    log_weights = sum(log(term.effect.prior_weight) for term in terms)
    log_places = sum(log(len(term.effect.places(setting))) for term in terms)
    shape_penalty = sum(LEAST_SHAPE_GAIN for term in terms if term.free_shape)
    probability_of_length = (1.0 - SEARCH.prior_none) * SEARCH.set_probabilities[len(terms) - 1]
    set_count = comb(max(effect_count, len(terms)), len(terms))
    return log(probability_of_length / set_count) + log_weights - log_places - shape_penalty
