"""A whole search: the fit without effect, then single effects, then sets of effects."""

from collections.abc import Callable, Sequence

from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.library import variants_in_events, with_prior_weights
from discrepancy.estimation.ported_problem import shows_all_missing_forces
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit, try_fit
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import OnProgress, ignore_progress
from .strategy import Search

OnSearch = Callable[[Search], None]
"""Called with a search when it begins, for example to display its state."""


def ignore_search(search: Search) -> None:
    """Do nothing when a search begins."""


def search(
    problem: Problem,
    effects: Sequence[Effect],
    on_progress: OnProgress = ignore_progress,
    on_search: OnSearch = ignore_search,
) -> Search:
    """Search the catalogue for the set of effects that explains a campaign.

    The model without effect is fitted first. If all trials show missing forces (see
    `shows_all_missing_forces`), sets of effects are compared by the force that they leave missing.
    Otherwise, or if that force cannot be estimated, single effects are fitted to the readings, then
    sets.

    Parameters
    ----------
    effects : sequence of Effect
        The catalogue. Effects that cannot act in the campaign are left out. If an event of the
        campaign may have begun or ended an effect, the effect is also tried in that form.
    on_progress : callable
        The function that receives a line for the progress display: the fit that runs, and how many
        remain.
    on_search : callable
        Called with the search after the fit without effect.

    Returns
    -------
    Search
        All candidates that were fitted, with their evidence.
    """
    on_progress("fitting the unchanged model")
    start = problem.prior_mean_point(Candidate())
    no_effect = fit(problem, Candidate(), start, iterations=SEARCH.no_effect_iterations)
    no_effect = refit_from_first_readings(
        problem, no_effect, iterations=SEARCH.no_effect_iterations
    )
    usable_catalogue = [effect for effect in effects if effect.unavailable(problem.setting) is None]
    variants = variants_in_events(usable_catalogue, problem.setting)
    usable_effects = with_prior_weights((*usable_catalogue, *variants))
    result = Search(problem, usable_effects, no_effect, on_progress=on_progress)
    _, laws_of_model = problem.model.without_laws()
    if len(laws_of_model) and result.force_search is not None and result.is_unexplained():
        # a nonlinear law of the model itself, such as dry friction that ends a motion, has many
        # optima: fit again from the unknowns of a fit that includes a missing force
        start = result.force_search.point(result.force_search.estimate_without_effects)
        second_fit = try_fit(problem, Candidate(), start)
        least_gain = SEARCH.least_gain_to_fit
        if second_fit is not None and second_fit.objective < no_effect.objective - least_gain:
            result = Search(problem, usable_effects, second_fit, on_progress=on_progress)
    on_search(result)
    if result.force_search is not None and shows_all_missing_forces(problem):
        result.search_by_missing_force(result.force_search)
    else:
        result.search_single_effects()
        result.search_sets()
    return result
