"""The paper: its particle filter and its closed-form limit, masses with a closed solution, its figures."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import ExperimentDataError, PosteriorError
from calibration.joint.posterior import PUBLISHED_MODES
from calibration.joint.wing_table import TOTAL_MASS, weighed
from calibration.paper.load_test import (
    calibrate_static,
    particle_filter,
)
from calibration.paper.procedure import fit_masses, read_published_results
from calibration.static.errors_in_variables import assess_fit, exact_posterior, pair_log_likelihoods
from calibration.static.experiments import published_measurements
from calibration.static.posterior import PUBLISHED_LINE, GaussianPrior, stiffness_curve_of, stiffness_line
from tests.refusals import Inputs

DATA = published_measurements()


def test_table_1_of_the_paper():
    posterior = particle_filter(DATA, seed=0)
    assert posterior.mean == pytest.approx(1.0073, abs=0.002)
    assert posterior.standard_deviation == pytest.approx(0.0103, abs=0.001)
    # Far closer than the paper's digits require: the filter without its sampling noise is known.
    limit = exact_posterior(DATA, measure="ratio")
    assert posterior.mean == pytest.approx(limit.mean, abs=2e-4)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, abs=1e-4)
    assert posterior.stiffness.mean == pytest.approx(575.2 * posterior.mean + 101.8)
    assert posterior.stiffness.standard_deviation == pytest.approx(575.2 * posterior.standard_deviation)
    # readings whose ratio has heavy tails
    vague = dataclasses.replace(DATA, displacement_standard_deviation=2e-3)
    posterior = particle_filter(vague, seed=0, particle_count=200_000)
    limit = exact_posterior(vague, measure="ratio")
    assert posterior.mean == pytest.approx(limit.mean, abs=1e-3)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, rel=0.02)


def test_filters_repeat_bit_for_bit_and_with_a_tabulated_curve():
    curve = stiffness_curve_of(lambda factor: float(PUBLISHED_LINE.stiffness(factor)), (0.85, 1.15))
    first, again, other = (particle_filter(DATA, seed=seed, particle_count=20_000) for seed in (7, 7, 8))
    assert first.mean == again.mean != other.mean
    assert np.array_equal(first.density, again.density)
    assert np.array_equal(first.likelihood, again.likelihood)
    table = particle_filter(DATA, seed=7, curve=curve, particle_count=20_000)
    assert table.mean == pytest.approx(first.mean, abs=1e-9)
    assert table.standard_deviation == pytest.approx(first.standard_deviation, abs=1e-9)


def test_kernel_densities_are_those_of_the_ratio_and_of_the_particles():
    filtered = particle_filter(DATA, seed=3, particle_count=300_000)
    places = np.linspace(0.93, 1.09, 33)
    exact = np.exp(pair_log_likelihoods(PUBLISHED_LINE, DATA, places, "ratio"))
    for found, expected in zip(filtered.likelihood, exact, strict=True):
        error = np.interp(places, filtered.likelihood_grid, found) - expected
        assert np.abs(error).max() < 0.03 * expected.max()
    density, grid = filtered.density, filtered.grid
    mean = np.trapezoid(density * grid, grid)
    assert mean == pytest.approx(filtered.mean, abs=1e-5)
    deviation = np.sqrt(np.trapezoid(density * (grid - mean) ** 2, grid))
    assert deviation == pytest.approx(filtered.standard_deviation, rel=0.01)


@pytest.mark.parametrize(
    ("change", "count", "prior", "words"),
    [
        ({"displacement": DATA.displacement * 0.5}, 2000, GaussianPrior(), "no particle explains pair"),
        ({}, 100, GaussianPrior(0.93, 0.015), "effectively remain"),
    ],
)
def test_refusals_of_the_filter(change, count, prior, words):
    with pytest.raises(PosteriorError, match=words):
        particle_filter(dataclasses.replace(DATA, **change), seed=0, prior=prior, particle_count=count)


# -------------------------------- calibration step 2 as a whole: record, quality of fit, report, files


COUNT = 40_000


def test_step_2_of_the_paper():
    """Tip stiffness of Fig. 5, the offset between its runs, and what other assumptions would give."""
    result = calibrate_static(seed=3, particle_count=COUNT)
    exact, prior = result.tip_stiffness_exact, result.tip_stiffness_prior
    assert prior.mean == pytest.approx(677.0, abs=0.01)
    assert prior.standard_deviation == pytest.approx(575.2 * 0.05 / 1.96, rel=1e-4)
    assert exact.mean == pytest.approx(575.2 * result.exact.mean + 101.8, abs=1e-6)
    assert exact.standard_deviation == pytest.approx(575.2 * result.exact.standard_deviation, rel=1e-6)
    assert exact.interval() == pytest.approx(PUBLISHED_LINE.stiffness(result.exact.interval()), abs=1e-3)
    assert result.particle.stiffness.mean == pytest.approx(681.2, abs=0.6)
    assert "differ by 0.47 mm" in result.quality.remarks[0]
    chi_square = float(np.sum(result.quality.standardised_residual**2))
    assert chi_square == pytest.approx(11.76, abs=0.05)
    perfect = assess_fit(dataclasses.replace(DATA, displacement=DATA.load / 680.0), 680.0)
    assert perfect.remarks == ()
    assert perfect.standardised_residual == pytest.approx(np.zeros(8), abs=1e-10)
    means = [posterior.mean for posterior in result.alternatives.values()]
    assert means == pytest.approx([1.00868, 1.00730, 1.01337], abs=1e-4)
    # the assumption of a shared offset alone is wide enough to reach the end of a short curve
    line = stiffness_line(575.2, 101.8, "short", 0.9, 1.06)
    assert [*calibrate_static(line, particle_count=20_000).alternatives] == ["flat in load", "ratio"]


MASSES = {"servo_mass": (0.05, 0.3), "pitot_mass": (0.0, 0.3)}
READ = (weighed(), *PUBLISHED_MODES)


def read(**changed):
    """What is published, some of it changed."""
    return tuple(replace(item, value=changed.get(item.name, item.value)) for item in READ)


def line_model(states):
    """Frequencies of a wing whose logarithms are linear, with the reference model's slopes [Hz]."""
    factor, servo, pitot = states.T
    assert pitot == pytest.approx(TOTAL_MASS - 2.0 * servo)
    first = 5.632 * factor**0.4114 * np.exp(-0.5075 * (pitot - 0.1345))
    second = 28.544 * factor**0.3244 * np.exp(-0.2925 * (pitot - 0.1345))
    return np.column_stack([first, second])


@given(factor=st.floats(0.97, 1.05))
def test_masses_of_a_closed_solution(factor):
    result = fit_masses(line_model, np.array([factor]), MASSES, READ)
    # The first frequency answers more strongly, so the error of (19), (20) is least where it is met exactly.
    pitot = 0.1345 + math.log(5.632 * factor**0.4114 / 5.6492) / 0.5075
    assert result.samples[0, 2] == pytest.approx(pitot, abs=1e-6)
    assert 2.0 * result.samples[0, 1] + result.samples[0, 2] == pytest.approx(0.472, abs=1e-15)
    assert result.frequency[0, 0] == pytest.approx(5.6492, rel=1e-6)


def test_the_authors_table_gives_their_figures(reference):
    result = read_published_results(reference)
    assert result.samples.shape == (100, 5)
    mean, deviation = result.samples.mean(axis=0), result.samples.std(axis=0, ddof=1)
    assert mean[1:3] == pytest.approx([0.1691, 0.1337], abs=5e-5)
    assert deviation[1:3] == pytest.approx([0.0039, 0.0077], abs=5e-5)
    assert mean[3] == pytest.approx(1.030, abs=5e-4)
    assert mean[4] == pytest.approx(7.66e-4, abs=5e-7)


@pytest.mark.parametrize(("changed", "words"), Inputs(__file__).refused("masses"))
def test_refusals_of_masses(changed, words):
    with pytest.raises(ExperimentDataError, match=words):
        fit_masses(line_model, np.ones(1), MASSES, read(**changed))
