"""Derivatives by difference quotients: exact for parabolas, and at readings that jump."""

import numpy as np
import pytest

from discrepancy.fits.difference_quotients import largest_jumps, one_sided_quotient, two_sided_quotient

TIME = np.linspace(0.0, 3.0, 400)[:, None]
STEP = 1e-3
JUMPING = (200, 0)
"""The reading, of 400 in one channel, that jumps."""


def parabola(unknown):
    return np.sin(7.0 * TIME) + 3.0 * np.cos(5.0 * TIME) * unknown + 200.0 * TIME * unknown**2


def at_jump(values, jump):
    values = values.copy()
    values[JUMPING] += jump
    return values


@pytest.fixture
def above_jumps():
    """The quotient of a parabola about 0.2, one of whose readings jumps by 4 just above 0.2."""
    return two_sided_quotient(parabola(0.2 - STEP), parabola(0.2), at_jump(parabola(0.2 + STEP), 4.0), STEP)


def test_two_sided_quotient_of_a_parabola_is_its_derivative():
    quotient = two_sided_quotient(parabola(0.2 - STEP), parabola(0.2), parabola(0.2 + STEP), STEP)
    exact = 3.0 * np.cos(5.0 * TIME) + 400.0 * TIME * 0.2
    assert np.allclose(quotient.slope, exact, rtol=0.0, atol=1e-9)
    assert not np.any(quotient.jumps)


@pytest.mark.parametrize("step", [STEP, -STEP])
def test_one_sided_quotient_of_a_parabola_is_its_derivative(step):
    slope = one_sided_quotient(parabola(0.2), parabola(0.2 + step), parabola(0.2 + 2.0 * step), step)
    assert np.allclose(slope, 3.0 * np.cos(5.0 * TIME) + 400.0 * TIME * 0.2, rtol=0.0, atol=1e-9)


def test_slope_at_a_jump_is_that_of_the_branch_without_it(above_jumps):
    curvature = 400.0 * TIME[200, 0]
    exact = 3.0 * np.cos(5.0 * TIME[200, 0]) + curvature * 0.2
    assert above_jumps.slope[JUMPING] == pytest.approx(exact, abs=curvature * STEP)


def test_a_jump_on_one_side_is_measured(above_jumps):
    assert above_jumps.jumps[JUMPING] == pytest.approx(4.0, abs=400.0 * 3.0 * STEP**2)
    assert np.count_nonzero(above_jumps.jumps) == 1


def test_a_jump_below_is_measured_from_the_present_branch():
    quotient = two_sided_quotient(
        at_jump(parabola(0.2 - STEP), 4.0), parabola(0.2), parabola(0.2 + STEP), STEP
    )
    assert quotient.jumps[JUMPING] == pytest.approx(4.0, abs=400.0 * 3.0 * STEP**2)


def test_a_kink_of_all_readings_is_not_a_jump():
    # a magnitude that counts as zero below zero
    response = np.zeros_like(TIME)
    quotient = two_sided_quotient(response, response, STEP * np.sin(7.0 * TIME), STEP)
    assert np.allclose(quotient.slope, 0.5 * np.sin(7.0 * TIME))
    assert not np.any(quotient.jumps)


def test_of_the_jumps_by_several_unknowns_the_largest_counts():
    by_unknown = [np.array([[0.0], [-3.0]]), np.array([[1.0], [2.0]])]
    assert largest_jumps(by_unknown, (2, 1)).tolist() == [[1.0], [-3.0]]


def test_without_unknowns_nothing_jumps():
    assert not np.any(largest_jumps([], (2, 1)))
