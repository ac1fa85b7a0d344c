"""Calibration step 2 as a whole: record, quality of fit, report, files."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from calibration.paper.figures import calibration_figure
from calibration.paper.load_test import calibrate_static
from calibration.static.errors_in_variables import assess_fit
from calibration.static.experiments import published_measurements
from calibration.static.stiffness_curve import PUBLISHED_LINE, stiffness_curve_of, stiffness_line

COUNT = 40_000


@pytest.fixture(scope="module")
def result():
    return calibrate_static(seed=3, particle_count=COUNT)


def model(young_modulus_factor):
    """A structural model near the published line."""
    return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8500.0)


def test_tip_stiffness_of_figure_5(result):
    exact, prior = result.tip_stiffness_exact, result.tip_stiffness_prior
    assert prior.mean == pytest.approx(677.0, abs=0.01)
    assert prior.standard_deviation == pytest.approx(575.2 * 0.05 / 1.96, rel=1e-4)
    assert exact.mean == pytest.approx(575.2 * result.exact.mean + 101.8, abs=1e-6)
    assert exact.standard_deviation == pytest.approx(575.2 * result.exact.standard_deviation, rel=1e-6)
    assert exact.interval() == pytest.approx(PUBLISHED_LINE.stiffness(result.exact.interval()), abs=1e-3)
    assert result.particle.stiffness.mean == pytest.approx(681.2, abs=0.6)


def test_the_offset_between_the_runs_is_noticed(result):
    assert "differ by 0.47 mm" in result.quality.remarks[0]
    chi_square = float(np.sum(result.quality.standardised_residual**2))
    assert chi_square == pytest.approx(11.76, abs=0.05)
    assert chi2.sf(chi_square, 7) == pytest.approx(0.109, abs=0.002)


def test_a_perfect_fit_has_no_remarks():
    data = published_measurements()
    data = dataclasses.replace(data, displacement=data.load / 680.0)
    quality = assess_fit(data, 680.0)
    assert quality.remarks == ()
    assert quality.standardised_residual == pytest.approx(np.zeros(8), abs=1e-10)


def test_an_alternative_that_leaves_the_model_is_left_out():
    """Only the assumption of a shared offset is wide enough to reach the end of this curve."""
    line = stiffness_line(575.2, 101.8, "short", 0.9, 1.06)
    found = calibrate_static(line, particle_count=20_000)
    assert [*found.alternatives] == ["flat in load", "ratio"]
    assert len(calibrate_static(particle_count=20_000).alternatives) == 3


def test_alternatives_stay_near(result):
    means = [posterior.mean for posterior in result.alternatives.values()]
    assert means == pytest.approx([1.00868, 1.00730, 1.01337], abs=1e-4)


def test_our_own_model_as_curve():
    curve = stiffness_curve_of(model, (0.9, 1.1))
    calibrated = calibrate_static(curve, seed=1, particle_count=COUNT)
    # The same stiffness from another curve: e differs, what was measured does not.
    assert calibrated.tip_stiffness_exact.mean == pytest.approx(681.6, abs=2.0)


def test_a_single_pair_will_do():
    data = published_measurements()
    one = dataclasses.replace(data, load=data.load[:1], displacement=data.displacement[:1], run=data.run[:1])
    calibrated = calibrate_static(data=one, particle_count=COUNT)
    assert 0.02 < calibrated.exact.standard_deviation < 0.0256
    assert len(calibration_figure(calibrated).axes) == 3
