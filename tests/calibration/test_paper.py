"""The procedure of the paper: its particle filter, its second step as a whole, its masses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import ExperimentDataError, PosteriorError
from calibration.joint.measured_modes import PUBLISHED_MODES
from calibration.joint.wing_table import TOTAL_MASS, weighed_mass
from calibration.paper.load_test import calibrate_static, particle_filter
from calibration.paper.procedure import fit_masses
from calibration.static.errors_in_variables import assess_fit, exact_posterior
from calibration.static.experiments import published_measurements
from calibration.static.posterior import PUBLISHED_LINE, GaussianPrior, stiffness_line
from tests.refusals import Inputs

LOAD_TEST = published_measurements()

# ---------------------------------------------------------------- the particle filter


@pytest.fixture(scope="module")
def published_particles():
    return particle_filter(LOAD_TEST, seed=0)


@pytest.fixture(scope="module")
def published_limit():
    """The filter of the paper without its sampling noise."""
    return exact_posterior(LOAD_TEST, measure="ratio")


def test_the_particle_filter_gives_table_1_of_the_paper(published_particles):
    assert published_particles.mean == pytest.approx(1.0073, abs=0.002)
    assert published_particles.standard_deviation == pytest.approx(0.0103, abs=0.001)


def test_the_filter_without_sampling_noise_gives_the_printed_digits_of_table_1(published_limit):
    assert f"{published_limit.mean:.4f}" == "1.0073"
    assert f"{published_limit.standard_deviation:.4f}" == "0.0103"


def test_the_particle_filter_is_close_to_its_limit(published_particles, published_limit):
    """Far closer than the digits of the paper require."""
    limit_deviation = published_limit.standard_deviation

    assert published_particles.mean == pytest.approx(published_limit.mean, abs=2e-4)
    assert published_particles.standard_deviation == pytest.approx(limit_deviation, abs=1e-4)


def test_the_tip_stiffness_of_particles_is_that_of_the_published_line(published_particles):
    stiffness = published_particles.stiffness
    deviation = 575.2 * published_particles.standard_deviation

    assert stiffness.mean == pytest.approx(575.2 * published_particles.mean + 101.8)
    assert stiffness.standard_deviation == pytest.approx(deviation)


def test_the_particle_filter_is_close_to_its_limit_for_vague_readings():
    """Their ratio has heavy tails."""
    vague = replace(LOAD_TEST, displacement_standard_deviation=2e-3)

    particles = particle_filter(vague, seed=0, particle_count=200_000)

    limit = exact_posterior(vague, measure="ratio")
    assert particles.mean == pytest.approx(limit.mean, abs=1e-3)
    assert particles.standard_deviation == pytest.approx(limit.standard_deviation, rel=0.02)


@pytest.fixture(scope="module")
def particles_of_seed_7():
    return particle_filter(LOAD_TEST, seed=7, particle_count=20_000)


def test_the_same_seed_gives_the_same_bits(particles_of_seed_7):
    again = particle_filter(LOAD_TEST, seed=7, particle_count=20_000)

    assert again.mean == particles_of_seed_7.mean
    assert np.array_equal(again.density, particles_of_seed_7.density)
    assert np.array_equal(again.likelihood, particles_of_seed_7.likelihood)


def test_another_seed_gives_another_mean(particles_of_seed_7):
    other = particle_filter(LOAD_TEST, seed=8, particle_count=20_000)

    assert other.mean != particles_of_seed_7.mean


def test_a_pair_that_no_particle_explains_is_refused():
    soft = replace(LOAD_TEST, displacement=LOAD_TEST.displacement * 0.5)

    with pytest.raises(PosteriorError, match="no particle explains pair"):
        particle_filter(soft, seed=0, prior=GaussianPrior(), particle_count=2000)


def test_too_few_particles_that_remain_are_refused():
    far_prior = GaussianPrior(0.93, 0.015)

    with pytest.raises(PosteriorError, match="effectively remain"):
        particle_filter(LOAD_TEST, seed=0, prior=far_prior, particle_count=100)


# ---------------------------------------------------------------- the second step as a whole


@pytest.fixture(scope="module")
def second_step():
    """Step 2 of the paper, with quality of fit and alternatives."""
    return calibrate_static(seed=3, particle_count=40_000)


def test_the_prior_of_the_tip_stiffness_is_that_of_fig_5(second_step):
    prior = second_step.tip_stiffness_prior

    assert prior.mean == pytest.approx(677.0, abs=0.01)
    assert prior.standard_deviation == pytest.approx(575.2 * 0.05 / 1.96, rel=1e-4)


def test_the_exact_tip_stiffness_is_that_of_the_published_line(second_step):
    stiffness = second_step.tip_stiffness_exact
    factor = second_step.exact
    deviation = 575.2 * factor.standard_deviation
    interval = PUBLISHED_LINE.stiffness(factor.interval())

    assert stiffness.mean == pytest.approx(575.2 * factor.mean + 101.8, abs=1e-6)
    assert stiffness.standard_deviation == pytest.approx(deviation, rel=1e-6)
    assert stiffness.interval() == pytest.approx(interval, abs=1e-3)


def test_the_tip_stiffness_of_particles_is_that_of_fig_5(second_step):
    assert second_step.particle.stiffness.mean == pytest.approx(681.2, abs=0.6)


def test_the_offset_between_the_published_runs_is_remarked_on(second_step):
    chi_square = float(np.sum(second_step.quality.standardised_residual**2))

    assert "differ by 0.47 mm" in second_step.quality.remarks[0]
    assert chi_square == pytest.approx(11.76, abs=0.05)


def test_a_perfect_load_test_has_no_remarks():
    perfect = replace(LOAD_TEST, displacement=LOAD_TEST.load / 680.0)

    quality = assess_fit(perfect, 680.0)

    assert quality.remarks == ()
    assert quality.standardised_residual == pytest.approx(np.zeros(8), abs=1e-10)


def test_other_assumptions_have_other_means(second_step):
    means = [posterior.mean for posterior in second_step.alternatives.values()]

    assert means == pytest.approx([1.00868, 1.00730, 1.01337], abs=1e-4)


def test_an_assumption_that_reaches_the_end_of_a_short_curve_is_left_out():
    """The assumption of a shared offset alone is wide enough to do so."""
    short_line = stiffness_line(575.2, 101.8, "short", 0.9, 1.06)

    result = calibrate_static(short_line, particle_count=20_000)

    assert list(result.alternatives) == ["flat in load", "ratio"]


# ---------------------------------------------------------------- masses

MASS_LIMITS = {"servo_mass": (0.05, 0.3), "pitot_mass": (0.0, 0.3)}
READINGS = (weighed_mass(), *PUBLISHED_MODES)


def line_model(states):
    """Return frequencies [Hz] of a wing whose logarithms are linear, with the published slopes."""
    factor, servo, pitot = states.T
    assert pitot == pytest.approx(TOTAL_MASS - 2.0 * servo)
    first = 5.632 * factor**0.4114 * np.exp(-0.5075 * (pitot - 0.1345))
    second = 28.544 * factor**0.3244 * np.exp(-0.2925 * (pitot - 0.1345))
    return np.column_stack([first, second])


@given(factor=st.floats(0.97, 1.05))
def test_masses_of_a_closed_solution(factor):
    """The first frequency answers more strongly than the second.

    So the error of (19), (20) is least where the first frequency is met exactly.
    """
    result = fit_masses(line_model, np.array([factor]), MASS_LIMITS, READINGS)

    ((_, servo, pitot, *_),) = result.samples
    expected_pitot = 0.1345 + math.log(5.632 * factor**0.4114 / 5.6492) / 0.5075
    assert pitot == pytest.approx(expected_pitot, abs=1e-6)
    assert 2.0 * servo + pitot == pytest.approx(0.472, abs=1e-15)
    assert result.frequency[0, 0] == pytest.approx(5.6492, rel=1e-6)


@pytest.mark.parametrize(("changed", "sentence"), Inputs(__file__).refused("masses"))
def test_readings_without_masses_are_refused(changed, sentence):
    readings = tuple(
        replace(reading, value=changed.get(reading.name, reading.value)) for reading in READINGS
    )

    with pytest.raises(ExperimentDataError, match=sentence):
        fit_masses(line_model, np.ones(1), MASS_LIMITS, readings)
