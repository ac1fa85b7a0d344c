"""Trials at rest in an estimate: laws, derivatives, covariance under missing forces, what they add."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import TrialKind
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.force_states import Process
from discrepancy.estimation.gauss_newton import linearise_along_laws, start_from_estimate
from discrepancy.estimation.linearised_rest import LinearisedRest, RestUnderForces
from discrepancy.estimation.ported_problem import shows_all_missing_forces, shows_missing_force
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.workflow import check_and_prepare
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import MODEL, chosen, simulated

HARDENING = "cubic_stiffness", {"stiffening": 0.2}, "slide"
CUBIC = Candidate((EffectTerm(chosen("cubic_stiffness")[0], "slide"),))


@pytest.fixture(scope="module")
def search() -> ForceSearch:
    """Return the search in ring-downs and load steps of the single mass with a hardening spring."""
    model = LumpedModel.load(MODEL)
    campaign, _ = check_and_prepare(simulated(model, "laboratory", 4, HARDENING), model)
    return ForceSearch(problem_of(campaign, model))


@pytest.fixture(scope="module")
def start(search):
    """Return unknowns that are not at their means, with the positions of the null."""
    start = start_from_estimate(search.estimate_without_effects)
    local = tuple(values + 0.3 for values in start.local)
    return replace(start, effect=np.array([0.4]), shared=start.shared + 0.3, local=local)


@pytest.fixture(scope="module")
def trials(search, start):
    """Return the trials, linear about these unknowns."""
    return search.ported.trial_set.trials_about(Point(start.shared, start.local, np.zeros(0)))


def along_laws(search, trials, start) -> LinearisedRest:
    """Return the first trial at rest, linear along the positions under the cubic spring."""
    laws = search.ported.laws(CUBIC, trials)
    linearisation = linearise_along_laws(laws, trials, start, 0.1, search.ported.shared_priors)
    (trial, *_) = [trial for trial in linearisation.trials if isinstance(trial, LinearisedRest)]
    return trial


def unknowns_of(trials, start, trial) -> np.ndarray:
    """Return one, the shared unknowns, those of effects and those of a trial."""
    local = start.local[[item.name for item in trials].index(trial.trial.name)]
    return np.concatenate(([1.0], start.shared, start.effect, local))


def test_the_laws_along_the_positions_are_those_of_a_simulation(search, trials, start):
    trial = along_laws(search, trials, start)
    without_simulation = replace(trial, simulation=None)
    residual = without_simulation.columns @ unknowns_of(trials, start, trial)
    np.testing.assert_allclose(residual, trial.simulation.residual, atol=1e-8)


def test_derivatives_are_those_of_simulations(search, trials, start):
    trial = along_laws(search, trials, start)
    values = unknowns_of(trials, start, trial)
    shared_count = len(start.shared)
    for number in range(1, 1 + shared_count + len(start.effect)):
        step = np.zeros(len(values))
        step[number] = 0.01
        stepped = values + step
        moved = replace(
            start,
            shared=stepped[1 : 1 + shared_count],
            effect=stepped[1 + shared_count : 2 + shared_count],
        )
        change = along_laws(search, trials, moved).simulation.residual - trial.simulation.residual
        predicted = trial.columns @ step
        assert np.abs(change - predicted).max() < 0.04 * np.abs(change).max() + 1e-9


def test_readings_have_the_covariance_of_noise_and_independent_forces(search, trials, start):
    trial = along_laws(search, trials, start)
    processes = {0: Process(0.7, 1.0)}
    products, half_log_determinant = RestUnderForces(trial, processes).whitened_products
    # all readings together: the force of one step is common to its channels alone
    steps, channels, count = trial.columns.shape
    shape = np.zeros((steps * channels, steps))
    own_force = 1.0 / (1.0 + trial.forces[0].law_force.by_position * trial.trial.response.compliance[:, 0, 0])
    for step in range(steps):
        by_force = trial.trial.response.outputs_by_force[step, 0] * own_force[step]
        shape[channels * step : channels * (step + 1), step] = 0.7 * by_force
    covariance = np.eye(steps * channels) + shape @ shape.T
    columns = trial.columns.reshape(-1, count) * np.r_[1.0, -np.ones(count - 1)]
    np.testing.assert_allclose(
        products, columns.T @ np.linalg.solve(covariance, columns), rtol=1e-9, atol=1e-7
    )
    assert half_log_determinant == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])


def test_a_smoothed_force_is_the_mean_of_its_posterior(search, trials, start):
    trial = along_laws(search, trials, start)
    deviation = 0.7
    under_forces = RestUnderForces(trial, {0: Process(deviation, 1.0)})
    smoothed = under_forces.smooth(unknowns_of(trials, start, trial)[1:])
    residual = trial.columns @ unknowns_of(trials, start, trial)
    own_force = 1.0 / (1.0 + trial.forces[0].law_force.by_position * trial.trial.response.compliance[:, 0, 0])
    by_force = trial.trial.response.outputs_by_force[:, 0] * own_force[:, None]
    precision = 1.0 / deviation**2 + np.sum(by_force**2, axis=1)
    np.testing.assert_allclose(smoothed.missing_forces[0], np.sum(by_force * residual, axis=1) / precision)
    np.testing.assert_allclose(under_forces.missing_force_deviations[0], precision**-0.5)


def test_a_unit_force_moves_a_spring_by_its_compliance(search):
    stiffness = search.ported.problem.setting.scales.ports["slide"].stiffness
    (rest, *_) = [trial for trial in search.estimate_without_effects.ported_trials if trial.is_at_rest]
    # the calibrated stiffness differs from the stated one by some per cent
    np.testing.assert_allclose(rest.response.compliance[:, 0, 0], 1.0 / stiffness, rtol=0.1)


def test_load_steps_narrow_the_parameters(search):
    estimate = search.estimate_without_effects
    in_motion = replace(estimate.linearisation, trials=estimate.linearisation.in_motion)
    widths_in_motion = np.diag(in_motion.solve(estimate.processes).covariance)
    widths = np.diag(estimate.linearisation.solve(estimate.processes).covariance)
    assert np.all(widths <= widths_in_motion * (1.0 + 1e-9))
    assert np.min(widths / widths_in_motion) < 0.9


def test_load_steps_of_a_model_that_tells_nothing_of_its_ports_at_rest_are_left_out(search, monkeypatch):
    monkeypatch.setattr(LumpedModel, "shows_ports_at_rest", False)
    problem = search.ported.problem_with_laws
    in_motion = ForceSearch(problem)
    assert not shows_all_missing_forces(problem)
    assert not any(trial.is_at_rest for trial in in_motion.estimate_without_effects.ported_trials)
    # the unknowns of the load steps stay at their prior means
    local = in_motion.point(in_motion.estimate_without_effects).local
    assert [len(values) for values in local] == [data.unknowns.unknown_count for data in problem.trials]


def test_missing_forces_are_estimated_in_motion_and_load_steps_but_not_in_missions(search):
    model = search.ported.model
    trials = {data.trial.kind: data.trial for data in search.ported.problem.trials}
    assert all(shows_missing_force(model, trial) for trial in trials.values())
    assert not shows_missing_force(model, replace(trials[TrialKind.STATIC], kind=TrialKind.FLIGHT))
