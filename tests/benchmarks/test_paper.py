"""The procedure of the paper: its particle filter, its masses, its Table 1 and its figures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.studies.paper.__main__ import masses_figure
from benchmarks.studies.paper.calibration import calibrate_as_in_the_paper
from benchmarks.studies.paper.figure_5 import figure_5
from benchmarks.studies.paper.masses import authors_samples, fit_masses
from benchmarks.studies.paper.particle_filter import particle_filter
from benchmarks.studies.paper.table_1 import PAPER, printed_table_1, table_1, write_table_1
from calibration.errors import ExperimentDataError, PosteriorError
from calibration.joint.measured_modes import PUBLISHED_MODES
from calibration.joint.wing_table import TOTAL_MASS, weighed_mass
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import published_measurements
from calibration.static.posterior import GaussianPrior
from calibration.wing.calibrate import calibrate
from evidence.identification.published_results import read_published_results
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


def test_the_tip_stiffness_of_particles_is_that_of_fig_5(published_particles):
    assert published_particles.stiffness.mean == pytest.approx(681.2, abs=0.6)


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
    readings = tuple(replace(reading, value=changed.get(reading.name, reading.value)) for reading in READINGS)

    with pytest.raises(ExperimentDataError, match=sentence):
        fit_masses(line_model, np.ones(1), MASS_LIMITS, readings)


# ---------------------------------------------------------------- Table 1 and the figures


@pytest.fixture(scope="module")
def published_wing():
    return calibrate()


@pytest.fixture(scope="module")
def as_in_the_paper(published_wing):
    return calibrate_as_in_the_paper(published_wing)


@pytest.fixture(scope="module")
def rows(published_wing, as_in_the_paper):
    """The rows of Table 1 by name."""
    return {row.name: row for row in table_1(published_wing.result, as_in_the_paper.moments)}


def test_the_factor_of_table_1_is_that_of_the_paper(rows):
    row = rows["young_modulus_factor"]

    assert row.paper.printed(*row.paper_procedure) == "1.0073 ± 0.0103"
    assert row.paper.printed(row.paper.mean, row.paper.standard_deviation) == "1.0073 ± 0.0103"


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("servo_mass", 1e-3), ("pitot_mass", 2e-3), ("damping_alpha", 0.01), ("damping_beta", 1e-5)],
)
def test_masses_and_damping_of_table_1_are_those_of_the_paper(rows, name, tolerance):
    assert rows[name].paper_procedure_difference == pytest.approx(0.0, abs=tolerance)


def test_the_lengths_of_table_1_are_those_of_the_paper(rows):
    lengths = {"semi_span": "1828.00", "root_chord": "433.00", "tip_chord": "260.00"}

    assert {name: rows[name].paper.printed(rows[name].paper.mean) for name in lengths} == lengths
    for name in lengths:
        assert rows[name].difference == pytest.approx(0.0, abs=5e-5)


def test_table_1_is_printed_with_a_row_for_each_quantity(rows):
    printed = printed_table_1(list(rows.values()))

    assert len(printed.rows) == len(PAPER) == 8


def test_table_1_is_written_in_si(rows, tmp_path):
    lines = write_table_1(tuple(rows.values()), tmp_path / "table_1.csv").read_text().splitlines()

    assert lines[0].startswith("figure,prior_mean,prior_standard_deviation,mean,")
    assert lines[1].startswith("semi_span,1.8288,")


def test_the_particles_of_fig_5_are_drawn_on_the_exact_densities(as_in_the_paper):
    _, factor, stiffness = figure_5(as_in_the_paper.static, as_in_the_paper.particle).axes

    for axes in (factor, stiffness):
        _, labels = axes.get_legend_handles_labels()
        assert {"prior", "posterior", "posterior, particles"} <= set(labels)


def test_the_figure_of_the_masses_has_the_samples_of_both_procedures(published_wing, as_in_the_paper):
    drawn = masses_figure(published_wing, as_in_the_paper, None)

    (legend,) = drawn.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "joint posterior",
        "the paper's procedure",
    ]


def test_samples_of_the_authors_have_the_published_moments(reference):
    samples = authors_samples(read_published_results(reference)).samples
    _, servo_mean, pitot_mean, alpha_mean, beta_mean = samples.mean(axis=0)
    _, servo_deviation, pitot_deviation, _, _ = samples.std(axis=0, ddof=1)

    assert len(samples) == 100
    moments = (servo_mean, pitot_mean, servo_deviation, pitot_deviation)
    assert moments == pytest.approx((0.1691, 0.1337, 0.0039, 0.0077), abs=5e-5)
    assert (alpha_mean, beta_mean) == pytest.approx((1.030, 7.66e-4), rel=7e-4)
