"""Steps of an oscillator against the matrix exponential, and the damping of Rayleigh."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from fe.runtime.modal_system import ModalSystem, rayleigh_coefficients, rayleigh_damping_ratio


def transition(omega: float, damping: float, duration: float, unit: float) -> np.ndarray:
    """Of displacements times a unit, such that all entries are of order one."""
    found, *_ = ModalSystem(np.array([omega]), np.array([[damping]])).exact_steps(np.array([duration]))
    return np.asarray(found[0]) * np.array([unit, 1.0])[:, None] / [unit, 1.0]


def is_the_exponential(omega: float, damping: float, duration: float) -> None:
    unit = max(omega, 1.0)
    wanted = expm(np.array([[0.0, unit], [-omega * omega / unit, -damping]]) * duration)
    np.testing.assert_allclose(transition(omega, damping, duration, unit), wanted, rtol=1e-7, atol=9e-10)


@given(omega=st.floats(0.0, 500.0), damping=st.floats(0.0, 2000.0), duration=st.floats(1e-6, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_step_of_any_oscillator_is_the_exponential(omega: float, damping: float, duration: float) -> None:
    is_the_exponential(omega, damping, duration)


@pytest.mark.parametrize("zeta", [0.0, 0.03, 0.7, 1 - 1e-9, 1.0, 1 + 1e-9, 1 + 1e-4, 1.5, 20.0, 1e4])
def test_a_step_near_critical_damping_is_the_exponential(zeta: float) -> None:
    for duration in (1e-5, 0.01, 0.3, 2.0):
        is_the_exponential(9.0, 18.0 * zeta, duration)


@given(
    alpha=st.floats(0.0, 100.0),
    beta=st.floats(0.0, 1.0),
    first=st.floats(0.1, 10.0),
    factor=st.floats(1.5, 100.0),
)
@example(alpha=1.0735, beta=7.3124e-4, first=5.6492, factor=29.9699 / 5.6492)
def test_rayleigh_coefficients_are_the_inverse_of_the_ratios(alpha, beta, first, factor) -> None:
    frequency = (first, first * factor)
    low, high = rayleigh_damping_ratio(alpha, beta, frequency)
    found = rayleigh_coefficients(frequency, (float(low), float(high)))
    np.testing.assert_allclose(found, (alpha, beta), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("frequency", [(1.0, 1.0), (0.0, 1.0), (-1.0, 2.0)])
def test_two_different_positive_frequencies_are_needed(frequency: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="Two different positive frequencies"):
        rayleigh_coefficients(frequency, (0.1, 0.1))
