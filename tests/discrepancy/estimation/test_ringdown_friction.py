"""Ring-downs that dry friction ends: its law leaves no force, in fitted and in held-out trials."""

from dataclasses import replace

import pytest

from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.estimator import WINDOW_AT_REST
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.gauss_newton import start_from_estimate
from discrepancy.estimation.ranking import rank_hypotheses
from discrepancy.missing_force.shares import ForceShares
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.workflow import check_and_prepare
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import MODEL, chosen, simulated

RATIO = 0.01
"""The friction ratio that is hidden."""


@pytest.fixture(scope="module")
def ranked() -> tuple[ForceSearch, list[Estimate]]:
    """Return the search for the missing force of the single mass, and the ranked hypotheses."""
    model = LumpedModel.load(MODEL)
    hidden = "coulomb_friction", {"friction_ratio": RATIO}, "slide"
    campaign, _ = check_and_prepare(simulated(model, "ringdown", 0, hidden), model)
    search = ForceSearch(problem_of(campaign, model))
    return search, rank_hypotheses(search, chosen("coulomb_friction", "structural_damping"))


def test_friction_leads_alone(ranked):
    _, (best, *_) = ranked
    assert best.candidate.identifiers == ("coulomb_friction",)
    assert not best.candidate.has_free_shape


def test_no_force_is_missing_beside_it(ranked):
    _, (best, *_) = ranked
    assert best.follows_laws
    assert best.leaves_no_force


@pytest.mark.parametrize("held_out", [False, True], ids=["fitted", "held out"])
def test_little_of_the_force_is_left(ranked, held_out):
    search, (best, *_) = ranked
    share = ForceShares(search).gap_share(best, held_out=held_out)
    assert share.remaining_rms < 0.2 * share.total_rms


def test_the_size_of_friction_is_that_of_the_truth(ranked):
    search, (best, *_) = ranked
    (law,) = best.candidate.patch(search.ported.problem.setting, best.effect)
    (true_law,) = chosen("coulomb_friction")[0].patch(
        search.ported.problem.setting, {"friction_ratio": RATIO}, "slide"
    )
    assert law.coefficient == pytest.approx(true_law.coefficient, rel=0.01)


def test_the_hypothesis_without_effects_leaves_a_force(ranked):
    search, _ = ranked
    assert not search.estimate_without_effects.leaves_no_force


def test_an_estimate_that_did_not_converge_goes_on_where_its_evidence_was_found(ranked):
    """The whole step from there may lead to a lower evidence, so it is no beginning."""
    search, (best, *_) = ranked
    laws = search.ported.laws(best.candidate, best.ported_trials)
    gauss_newton = search.estimator(best.ported_trials).gauss_newton
    start = replace(start_from_estimate(best), effect=best.effect + 0.05)
    unfinished = gauss_newton.iterate_along_laws(laws, start, WINDOW_AT_REST, most_iterations=1)
    again = gauss_newton.iterate_along_laws(
        laws, start_from_estimate(unfinished), WINDOW_AT_REST, most_iterations=1
    )
    assert not unfinished.converged
    assert unfinished.effect == pytest.approx(start.effect)
    assert again.log_evidence == pytest.approx(unfinished.log_evidence, abs=1.0)
