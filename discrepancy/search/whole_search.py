"""A whole search: the fit without effect, then single effects, then sets of effects."""

from collections.abc import Callable, Sequence

from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.library import in_events
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import attempt, fit
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import OnProgress, no_progress
from .strategy import Search

OnSearch = Callable[[Search], None]
"""Takes a search at its begin, to look at it while it goes on."""


def ignore_search(search: Search) -> None:
    """Ignore a search that begins."""


def search(
    problem: Problem,
    effects: Sequence[Effect],
    on_progress: OnProgress = no_progress,
    on_search: OnSearch = ignore_search,
) -> Search:
    """Fit the model without effect, then search the catalogue for what explains the campaign.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    effects : sequence of Effect
        The catalogue. Effects that cannot act here are left out; those that an event of the
        campaign may have begun or ended are tried in that form too.
    on_progress : callable
        Takes a line that says what is fitted, and how much is still to come.
    on_search : callable
        Takes the search once it has the fit without effect.

    Returns
    -------
    Search
        All candidates that were fitted, with their evidence.
    """
    on_progress("fitting the model as it is")
    start = problem.start(Candidate())
    no_effect = fit(problem, Candidate(), start, iterations=SEARCH.none_steps)
    no_effect = refit_from_first_readings(problem, no_effect, iterations=SEARCH.none_steps)
    usable = [effect for effect in effects if effect.unavailable(problem.setting) is None]
    usable_effects = (*usable, *in_events(tuple(usable), problem.setting))
    result = Search(problem, usable_effects, no_effect, on_progress=on_progress)
    _, own_laws = problem.model.apart()
    if len(own_laws) and result.force_search is not None and result.is_unexplained():
        # a law of the model itself, such as dry friction that ends a motion, has many optima: begin
        # again where the unknowns are beside a missing force
        start = result.force_search.whole_point(result.force_search.whole)
        second_fit = attempt(problem, Candidate(), start)
        least_gain = SEARCH.worth_fitting
        if second_fit is not None and second_fit.objective < no_effect.objective - least_gain:
            result = Search(problem, usable_effects, second_fit, on_progress=on_progress)
    on_search(result)
    force_search = result.force_search if result.is_all_in_motion else None
    # free forces at several ports take up nearly any law at one of them
    if force_search is not None and len(force_search.ports) <= 1:
        result.search_along_force(force_search)
        return result
    result.search_single_effects()
    if force_search is not None and result.is_unexplained():
        result.search_along_force(force_search)
    else:
        result.search_sets()
    return result
