"""The model without effects: it is estimated about its own parameters, as each hypothesis is."""

import pytest

from discrepancy.estimation.estimate import NO_EFFECTS
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from tests.discrepancy.core import kit


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Return releases of the chain that lack nothing, with parameters beside their prior means."""
    bench = kit.chain_bench(samples=300, dynamic_channels=("x3", "g1"))
    whole = bench.problem(5)
    in_motion = tuple(data.trial for data in whole.trials if data.trial.is_dynamic)
    return whole.with_trials(in_motion, whole.model)


def test_no_force_is_missing_along_the_simulation_of_a_right_model(problem):
    search = ForceSearch(problem)
    first_evidence = search.estimate_without_effects.log_evidence
    simulation = fit(problem, NO_EFFECTS, problem.prior_mean_point(NO_EFFECTS))
    search.begin_along_simulation(simulation.point)
    estimate = search.estimate_without_effects
    assert estimate.leaves_no_force
    # about the prior means, an error of the parameters looks like a force
    assert estimate.log_evidence > first_evidence + 10.0


def test_the_estimate_along_the_simulation_has_the_parameters_of_the_fit(problem):
    search = ForceSearch(problem)
    simulation = fit(problem, NO_EFFECTS, problem.prior_mean_point(NO_EFFECTS))
    search.begin_along_simulation(simulation.point)
    assert search.estimate_without_effects.shared == pytest.approx(simulation.shared, abs=0.05)
