"""Errors that a mesh may cause in readings widen the intervals of a fit."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import fit
from discrepancy.fits.normal_equations import normal_equations
from discrepancy.search_settings import SEARCH
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import chosen, measured, simulated


@pytest.fixture(scope="module")
def problem(beam_model):
    return problem_of(simulated(beam_model, "laboratory", 3), beam_model)


def test_the_covariance_is_that_of_least_squares_with_correlated_readings(problem):
    """Readings with the covariance I + E E^T, weighted as if it were I: C + C J^T E E^T J C."""
    (effect,) = chosen("support_compliance")
    candidate = Candidate((EffectTerm(effect, effect.places(problem.setting)[0]),))
    start = replace(problem.prior_mean_point(candidate), effect=candidate.start_values())
    fitted = fit(problem, candidate, start, iterations=1)
    precision = problem.noise_precisions(fitted.squares_by_channel)
    equations = normal_equations(problem, fitted, candidate, precision)
    by_noise = np.linalg.inv(equations.matrix)
    expected = by_noise.copy()
    for data, (trial, indices) in zip(problem.trials, equations.trials, strict=True):
        for column, errors in enumerate(data.mesh_errors):
            for error in errors.T:
                readings = np.zeros(data.weight.shape)
                readings[:, column] = error * trial.precision_root[column]
                move = by_noise[:, indices] @ trial.jacobian @ readings.ravel()
                expected += np.outer(move, move)
    of_effect = slice(problem.shared.unknown_count, len(fitted.covariance))
    np.testing.assert_allclose(fitted.whole_effect_covariance, expected[of_effect, of_effect], rtol=1e-6)
    np.testing.assert_allclose(fitted.effect_covariance, by_noise[of_effect, of_effect], rtol=1e-6)


def test_errors_are_a_fraction_of_the_readings_of_each_channel_of_the_quantity(problem):
    for data in problem.trials:
        quantities = [problem.campaign.channels[name].quantity for name in data.trial.channels]
        standardised = data.trial.values / data.deviation
        for number, errors in enumerate(data.mesh_errors):
            assert errors.shape[1] == quantities.count(quantities[number])
            own = [other for other, quantity in enumerate(quantities) if quantity == quantities[number]]
            of_itself = errors[:, own.index(number)]
            np.testing.assert_allclose(of_itself, SEARCH.mesh_error * standardised[:, number])


def test_errors_do_not_grow_with_a_wider_noise(problem):
    wide = problem.with_wider_noise(np.full(len(problem.channel_names), 3.0))
    for data, wide_data in zip(problem.trials, wide.trials, strict=True):
        for column, errors in enumerate(data.mesh_errors):
            in_channel_units = wide_data.mesh_errors[column] * wide_data.deviation[column]
            np.testing.assert_allclose(in_channel_units, errors * data.deviation[column])


def test_models_without_a_mesh_have_none():
    assert all(data.mesh_errors == () for data in problem_of(*measured()).trials)
