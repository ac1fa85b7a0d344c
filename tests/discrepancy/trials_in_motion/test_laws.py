"""The tangents of laws along a motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from discrepancy.trials_in_motion.laws import PortMotion, force_and_tangents, mean_force
from fe.runtime.laws.speed import Overflow, TableDamping, steady_force
from fe.runtime.patch import PowerDamping, PowerStiffness

TIME = np.linspace(0.0, 2.0, 401)
POSITIONS, SPEEDS = np.cos(7.0 * TIME), -7.0 * np.sin(7.0 * TIME)
CUBIC = PowerStiffness(port="p", coefficient=3.0, exponent=3.0, side=0, reference_displacement=0.8)


def damping(velocity_exponent, displacement_exponent=0.0):
    return PowerDamping(
        port="p",
        coefficient=2.0,
        velocity_exponent=velocity_exponent,
        displacement_exponent=displacement_exponent,
        reference_velocity=5.0,
        reference_displacement=0.6,
    )


@pytest.mark.parametrize("law", [CUBIC, damping(2.0), damping(1.0, 1.0)], ids=["cubic", "drag", "by both"])
def test_tangents_are_the_derivatives_of_the_force(law):
    step = 1e-6
    along = force_and_tangents(law, TIME, PortMotion(POSITIONS, SPEEDS), 1e-4)
    changes = []
    for by_position, by_speed in ((1.0, 0.0), (0.0, 1.0)):
        ends = [
            force_and_tangents(
                law,
                TIME,
                PortMotion(POSITIONS + side * step * by_position, SPEEDS + side * step * by_speed),
                1e-4,
            )
            for side in (1.0, -1.0)
        ]
        changes.append((ends[0].force - ends[1].force) / (2.0 * step))
    moving = (np.abs(SPEEDS) > 0.1) & (np.abs(POSITIONS) > 0.01)
    np.testing.assert_allclose(along.by_position[moving], changes[0][moving], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(along.by_speed[moving], changes[1][moving], rtol=1e-3, atol=1e-3)


def test_dry_friction_has_a_tangent_where_the_motion_turns():
    half_window = 0.05 * float(np.sqrt(np.mean(SPEEDS**2)))
    along = force_and_tangents(damping(0.0), TIME, PortMotion(POSITIONS, SPEEDS), 0.05)
    turning = np.abs(SPEEDS) < 0.5 * half_window
    np.testing.assert_allclose(along.by_speed[turning], 2.0 / half_window)
    assert np.all(along.by_speed[np.abs(SPEEDS) > half_window] == 0.0)


@given(
    exponent=st.floats(0.0, 3.0),
    speed=st.floats(-2.0, 2.0),
    half_width=st.floats(1e-3, 1.0),
    level=st.sampled_from([None, 0.0, 0.4]),
)
def test_the_mean_over_a_window_is_the_integral_of_the_law(exponent, speed, half_width, level):
    if level is None:
        law = damping(exponent).parameter_row
    else:
        law = Overflow("p", 2.0, max(exponent, 0.1), level, 5.0).parameter_row
    ends = speed - half_width, speed + half_width
    kinks = [point for point in (0.0, level or 0.0) if ends[0] < point < ends[1]]
    integral, _ = quad(lambda v: steady_force(law, 0.3, v), *ends, points=kinks or None, epsabs=1e-12)
    mean = integral / (2.0 * half_width)
    assert mean_force(law, 0.3, speed, half_width) == pytest.approx(mean, rel=1e-6, abs=1e-8)


@given(speed=st.floats(-2.0, 2.0), half_width=st.floats(1e-3, 1.0))
def test_the_mean_of_a_table_over_a_window_is_its_integral(speed, half_width):
    speeds = (-1.0, -0.1, 0.2, 0.9)
    law = TableDamping("p", speeds, (-3.0, -2.0, 2.5, 1.0)).parameter_row
    ends = speed - half_width, speed + half_width
    kinks = [point for point in speeds if ends[0] < point < ends[1]]
    integral, _ = quad(lambda v: steady_force(law, 0.3, v), *ends, points=kinks or None, epsabs=1e-12)
    mean = integral / (2.0 * half_width)
    assert mean_force(law, 0.3, speed, half_width) == pytest.approx(mean, rel=1e-6, abs=1e-8)


def test_friction_that_changes_its_sign_within_a_substep_has_the_right_impulse():
    """A speed that rises evenly through zero, at any time between two stamps: -1 before and +1 after it."""
    time = np.arange(9.0)
    for crossing in np.linspace(3.0, 4.0, 7):
        along = force_and_tangents(damping(0.0), time, PortMotion(np.ones(9), time - crossing), 1e-6)
        assert np.trapezoid(along.force, time) == pytest.approx(2.0 * (8.0 - 2.0 * crossing), abs=1e-4)
