"""Rewards of the steps against closed forms."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.wing.steps import (
    CalibrationStep,
    StepReward,
    Update,
    error_reward,
    gaussian_reward,
    moment_reward,
)
from reporting.record_json import record_of


def quantity(prior: float, posterior: float, measured: float | None, spread: float | None = 0.5) -> Update:
    return Update("q", "quantity", "1", prior, 1.0, posterior, 0.5, measured, spread)


def test_the_error_is_in_half_widths() -> None:
    updates = (quantity(0.0, 0.9, 1.96), quantity(0.0, 3.0, 0.98), quantity(5.0, 5.0, None))
    assert error_reward(updates, "prior") == pytest.approx(-(2.0 + 1.0) / 2.0)
    assert error_reward(updates, "posterior") == pytest.approx(-(1.06 / 0.98 + 2.02 / 0.98) / 2.0)
    assert error_reward((quantity(0.0, 0.0, None),), "prior") is None


@given(
    mean=st.floats(-3.0, 3.0),
    spread=st.floats(0.05, 0.95),
    scale=st.sampled_from([1e-6, 1.0, 1e5]),
)
def test_information_of_a_gaussian(mean: float, spread: float, scale: float) -> None:
    """KL(N(m, s²) | N(0, 1)) = (s² + m² - 1) / 2 - ln s, in any unit."""
    reward = moment_reward(
        (),
        (np.zeros(1), scale**2 * np.eye(1)),
        (np.array([mean * scale]), np.array([[(spread * scale) ** 2]])),
    )
    expected = 0.5 * (spread**2 + mean**2 - 1.0) - math.log(spread)
    assert reward.information_gain == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert reward.uncertainty_reduction == pytest.approx(1.0 - spread)
    assert reward.prior_error is None


def test_independent_figures_add_up_and_correlation_is_information() -> None:
    prior = np.zeros(2), np.diag([1.0, 4.0])
    apart = moment_reward((), prior, (np.zeros(2), np.diag([0.25, 0.04])))
    assert apart.information_gain is not None
    assert apart.information_gain == pytest.approx(
        0.5 * (0.25 - 1.0) - math.log(0.5) + 0.5 * (0.01 - 1.0) - math.log(0.1)
    )
    assert apart.uncertainty_reduction == pytest.approx(1.0 - math.sqrt(0.5 * 0.1))
    together = moment_reward((), prior, (np.zeros(2), np.array([[0.25, 0.08], [0.08, 0.04]])))
    assert together.information_gain is not None
    # the mutual information of the two, -ln(1 - r^2) / 2 with r = 0.8
    assert together.information_gain - apart.information_gain == pytest.approx(-0.5 * math.log(1.0 - 0.64))


def test_samples_that_follow_one_another_have_no_information_gain() -> None:
    generator = np.random.default_rng(1)
    prior = generator.normal(size=(500, 2))
    line = 0.1 * generator.normal(size=(200, 1))
    reward = gaussian_reward((), prior, np.hstack([line, 0.472 - 2.0 * line]))
    assert reward.information_gain is None
    assert 0.8 < reward.uncertainty_reduction < 0.95
    free = gaussian_reward((), prior, 0.1 * generator.normal(size=(200, 2)))
    assert free.information_gain == pytest.approx(2.0 * (0.5 * (0.01 - 1.0) - math.log(0.1)), rel=0.1)


def test_a_step_is_plain_data() -> None:
    step = CalibrationStep(
        2, "Load test", "exact", "pairs", (quantity(0.0, 1.0, None, None),), (quantity(0.0, 1.0, 1.2),),
        StepReward(-1.0, None, 0.5, None),
    )  # fmt: skip
    assert record_of(CalibrationStep, asdict(step)) == step
