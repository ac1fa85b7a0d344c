"""Laws of free shape: the best single effects are fitted again together with their shapes."""

from discrepancy.fits.fitting import CandidateFit, fit_free_shape
from discrepancy.fits.gates import LEAST_SHAPE_GAIN, check_absolute_fit
from discrepancy.search_settings import SEARCH

from .fitted_candidates import FittedCandidates


def fits_of_free_shape(candidates: FittedCandidates) -> list[CandidateFit]:
    """Return fits of the best single effects with free shapes, where the shape gains evidence.

    A fit is returned if the free shape gains more than `LEAST_SHAPE_GAIN` and the test of absolute
    fit does not fail. Effects of one family at one place become the same law when their shape is
    free, so only the fit with the highest score is returned for each family and place.
    """
    problem = candidates.problem
    best_by_family: dict[tuple[str, str], CandidateFit] = {}
    for single_fit in _single_fits_to_free(candidates):
        free_fit = fit_free_shape(problem, single_fit, term_index=0)
        if free_fit is None:
            continue
        evidence_gain = free_fit.log_evidence - single_fit.log_evidence
        if evidence_gain <= LEAST_SHAPE_GAIN:
            continue
        (term,) = free_fit.candidate.terms
        key = (term.effect.family, term.place)
        previous_best = best_by_family.get(key)
        is_best = previous_best is None or candidates.score(previous_best) < candidates.score(
            free_fit
        )
        if is_best and _is_not_refuted(candidates, free_fit):
            best_by_family[key] = free_fit
    return list(best_by_family.values())


def _is_not_refuted(candidates: FittedCandidates, fit: CandidateFit) -> bool:
    """Return whether a fit passes the test of absolute fit, or cannot be tested.

    It cannot be tested if there is no noise record (`passed` is then None).
    """
    return check_absolute_fit(candidates.problem, fit).passed is not False


def _single_fits_to_free(candidates: FittedCandidates) -> list[CandidateFit]:
    """Return the best single effects, at most `SEARCH.most_exact_fits`, the best first.

    None is returned if the model without effect explains the data, or cannot be tested. If a single
    effect explains the data, a free shape is still tried: the right law may be of the same family,
    but not in the catalogue.
    """
    if _is_not_refuted(candidates, candidates.no_effect):
        return []
    single_fits = []
    for fit in candidates.exact_fits.values():
        if len(fit.candidate.terms) == 1 and not fit.candidate.has_free_shape:
            single_fits.append(fit)
    return sorted(single_fits, key=candidates.score, reverse=True)[: SEARCH.most_exact_fits]
