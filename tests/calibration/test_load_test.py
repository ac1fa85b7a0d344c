"""Calibration step 2 as a whole: factor and tip stiffness, quality of fit, other assumptions."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.static.errors_in_variables import assess_fit
from calibration.static.experiments import published_measurements
from calibration.static.figure import load_test_figure
from calibration.static.load_test import calibrate_static
from calibration.static.posterior import PUBLISHED_LINE, stiffness_line

LOAD_TEST = published_measurements()


@pytest.fixture(scope="module")
def second_step():
    """Step 2 of the paper, with quality of fit and alternatives."""
    return calibrate_static()


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

    result = calibrate_static(short_line)

    assert list(result.alternatives) == ["flat in load", "ratio"]


def test_the_likelihoods_of_single_pairs_are_densities_about_their_own_stiffness(second_step):
    stiffness = LOAD_TEST.load / LOAD_TEST.displacement
    factors = PUBLISHED_LINE.young_modulus_factor(stiffness)
    within_grid = np.abs(factors - 1.0) < 0.1

    modes = [density.grid[np.argmax(density.density)] for density in second_step.by_pair]
    assert np.array(modes)[within_grid] == pytest.approx(factors[within_grid], abs=0.01)


def test_the_figure_of_a_load_test_has_a_likelihood_for_each_pair(second_step):
    loads, factor, stiffness = load_test_figure(second_step).axes

    labels = [axes.get_legend_handles_labels()[1] for axes in (loads, factor, stiffness)]
    assert "measured, run 2" in labels[0]
    assert labels[1] == ["likelihood of one pair", "95 % interval", "prior", "posterior"]
    assert labels[2] == ["95 % interval", "prior", "posterior"]
    assert len(factor.lines) == LOAD_TEST.count + 2
