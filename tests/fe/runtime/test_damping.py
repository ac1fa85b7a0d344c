import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.modal_system import rayleigh_coefficients, rayleigh_damping_ratio


def test_published_coefficients_give_the_measured_damping() -> None:
    # Kapteyn et al. 2021, Results: alpha and beta fitted to 2.81 % and 7.17 % at 5.65 and 29.97 Hz
    alpha, beta = rayleigh_coefficients((5.6492, 29.9699), (0.0281, 0.0717))
    ratio = rayleigh_damping_ratio(alpha, beta, (5.6492, 29.9699))
    np.testing.assert_allclose(ratio, (0.0281, 0.0717), rtol=1e-12)
    assert alpha > 0.0
    assert beta > 0.0


@given(
    alpha=st.floats(0.0, 100.0),
    beta=st.floats(0.0, 1.0),
    first=st.floats(0.1, 10.0),
    factor=st.floats(1.5, 100.0),
)
def test_coefficients_are_the_inverse_of_the_ratios(
    alpha: float, beta: float, first: float, factor: float
) -> None:
    frequency = (first, first * factor)
    low, high = rayleigh_damping_ratio(alpha, beta, frequency)
    found = rayleigh_coefficients(frequency, (float(low), float(high)))
    np.testing.assert_allclose(found, (alpha, beta), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("frequency", [(1.0, 1.0), (0.0, 1.0), (-1.0, 2.0)])
def test_two_different_positive_frequencies_are_needed(frequency: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="Two different positive frequencies"):
        rayleigh_coefficients(frequency, (0.1, 0.1))
