"""A whole search: the fit without effect, then single effects, then sets of them."""

from collections.abc import Callable, Sequence

from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.library import in_events
from discrepancy.fits.beginnings import refitted_from_beginnings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import attempt, fit
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import Tell, in_silence
from .strategy import Search

OnSearch = Callable[[Search], None]
"""Takes a search that begins, to look at while it goes on."""


def nobody_looks(search: Search) -> None:
    """Take a search that begins, and leave it alone."""


def search(
    problem: Problem,
    effects: Sequence[Effect],
    tell: Tell = in_silence,
    on_search: OnSearch = nobody_looks,
) -> Search:
    """Fit the model without effect, then search the catalogue.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    effects : sequence of Effect
        The catalogue; what is unavailable here is left out, and what an event of the campaign may have begun
        or ended is tried so too.
    tell : callable
        Takes a few words on what is fitted, and how much is left.
    on_search : callable
        Takes the search once it has the fit without effect.

    Returns
    -------
    Search
        All candidates with their evidence.
    """
    tell("fitting the model as it is")
    none = fit(problem, Candidate(), problem.start(Candidate()), iterations=SEARCH.none_steps)
    none = refitted_from_beginnings(problem, none, iterations=SEARCH.none_steps)
    usable = tuple(effect for effect in effects if effect.unavailable(problem.setting) is None)
    usable = (*usable, *in_events(usable, problem.setting))
    found = Search(problem, usable, none, tell=tell)
    if len(problem.model.apart()[1]) and found.force is not None and found.unexplained():
        # a law of its own, as dry friction that ends a motion, has many optima
        again = attempt(problem, Candidate(), found.force.whole_point(found.force.whole))
        if again is not None and again.objective < none.objective - SEARCH.worth_fitting:
            found = Search(problem, usable, again, tell=tell)
    on_search(found)
    force = found.force if found.moves else None
    if force is None or len(force.ports) > 1:  # forces at several ports take up nearly any law at one
        found.singles()
        if force is None or not found.unexplained():
            found.sets()
            return found
    found.by_force(force)
    return found
