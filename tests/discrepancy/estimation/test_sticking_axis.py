"""An axis that is pushed through dry friction: its law is estimated with the motion, in long records too."""

import numpy as np
import pytest

from benchmarks.pushed_axis import DAMPING, FRICTION, MASS, axis_model, pushed_axis
from discrepancy.campaign.records import FloatArray
from discrepancy.estimation import force_search, ranking
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.workflow import problem_without_wrong_ends
from tests.discrepancy.rigs import chosen

TRUE_UNKNOWNS = np.array([(MASS / 10.0 - 1.0) / 0.05, (DAMPING / 20.0 - 1.0) / 0.3])
"""Mass and damping of the true axis, in prior standard deviations from those of the model."""


@pytest.fixture(scope="module")
def search() -> ForceSearch:
    """Return the search for the missing force of the axis."""
    return ForceSearch(problem_without_wrong_ends(pushed_axis(600), axis_model()))


def friction_of(search: ForceSearch, estimate: Estimate) -> float:
    """Return the force of the dry friction of a hypothesis [N]."""
    (term,) = estimate.candidate.terms
    (law,) = term.patch(search.ported.problem.setting, estimate.effect)
    return float(law.coefficient)


def shared_values_of_linearisation(estimate: Estimate) -> FloatArray:
    """Return mass and damping about which the trials of an estimate are linear."""
    return estimate.trials[0].trial.linearisation_point[:2]


def assert_values_of_the_truth(search: ForceSearch, estimate: Estimate) -> None:
    """Check friction, mass and damping, the last two as shared unknowns."""
    assert friction_of(search, estimate) == pytest.approx(FRICTION, rel=5e-3)
    # in trials that are linear about the unknowns without friction, the damping is off by 0.35
    np.testing.assert_allclose(estimate.shared, TRUE_UNKNOWNS, atol=0.08)


@pytest.fixture(scope="module")
def estimated(search: ForceSearch) -> Estimate:
    """Return the estimate of dry friction, which begins at the estimate without effects."""
    (effect,) = chosen("coulomb_friction")
    candidate = Candidate((EffectTerm(effect, "slide"),))
    estimate = search.estimate_effects(search.estimate_without_effects, candidate, np.array([2.0]))
    assert estimate is not None
    return estimate


def test_values_are_true_though_the_search_is_linear_about_others(
    search: ForceSearch, estimated: Estimate
) -> None:
    """Without friction the mass and the damping come out wrong, and the trials are linear about that."""
    first_values = shared_values_of_linearisation(search.estimate_without_effects)
    assert np.abs(first_values - TRUE_UNKNOWNS).max() > 0.5
    assert_values_of_the_truth(search, estimated)


def test_the_trials_of_an_estimate_are_linear_about_its_own_values(estimated: Estimate) -> None:
    about = shared_values_of_linearisation(estimated)
    assert np.all(np.abs(about - estimated.shared) < 0.1)


def test_a_thinned_trial_has_every_third_sample_and_stamp(search: ForceSearch) -> None:
    trial = search.estimate_without_effects.trials[0].trial
    thinned = trial.thinned(3, trial.substeps)
    np.testing.assert_array_equal(thinned.residual, trial.residual[::3])
    count = len(thinned.fine_time)
    np.testing.assert_allclose(thinned.fine_time, trial.fine_time[::3][:count], rtol=1e-12)
    slow_force = np.sin(5.0 * trial.fine_time)
    state = trial.state_under_force(0, slow_force)[::3][:count]
    # both take the force as linear between their stamps
    np.testing.assert_allclose(
        thinned.state_under_force(0, slow_force[::3][:count]), state, atol=1e-4 * np.abs(state).max()
    )


@pytest.fixture
def search_from_thinned(search: ForceSearch, monkeypatch: pytest.MonkeyPatch) -> ForceSearch:
    monkeypatch.setattr(force_search, "MOST_THINNED_SAMPLES", 400)
    return ForceSearch(search.ported.problem_with_laws)


def test_long_records_are_thinned_at_first(search_from_thinned: ForceSearch) -> None:
    thinned = search_from_thinned.thinned
    assert thinned is not None
    assert [trial.trial.stride for trial in thinned.estimate_without_effects.trials] == [3, 3]


def test_a_search_that_begins_in_thinned_records_ends_near_the_same_missing_force(
    search: ForceSearch, search_from_thinned: ForceSearch
) -> None:
    # both are linear about other parameters, whose influence is not linear while the axis sticks
    assert search_from_thinned.force_deviation(0) == pytest.approx(search.force_deviation(0), rel=0.2)


def test_effects_of_long_records_are_estimated_in_all_samples(
    search_from_thinned: ForceSearch,
) -> None:
    search = search_from_thinned
    estimates = ranking.rank_by_missing_force(search, chosen("coulomb_friction"))
    assert estimates[0].candidate.identifiers == ("coulomb_friction",)
    for estimate in estimates:
        assert {trial.trial.stride for trial in estimate.trials} == {1}
    assert_values_of_the_truth(search, estimates[0])


@pytest.mark.long
def test_the_leading_estimate_has_settled_before_effects_are_added() -> None:
    """In the thinned record the first estimate of friction lies 450 nat below the one that lasts."""
    campaign = pushed_axis(12_500)
    thinned = ForceSearch(problem_without_wrong_ends(campaign, axis_model())).thinned
    assert thinned is not None
    best, *_ = ranking.rank_hypotheses(thinned, chosen("coulomb_friction"), largest_set=1)
    repeated = thinned.estimate_about_own_values(best)
    assert best.candidate.identifiers == ("coulomb_friction",)
    assert repeated.log_evidence < best.log_evidence + ranking.LEAST_SETTLING_RISE
