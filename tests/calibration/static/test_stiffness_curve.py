"""Stiffness curves: the published line, and tables of a model."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import PosteriorError
from calibration.static.stiffness_curve import (
    PUBLISHED_LINE,
    TABLE_TOLERANCE,
    stiffness_curve_of,
    stiffness_line,
)

RANGE = (0.9, 1.1)


class Springs:
    """A skin spring in parallel with another, both on a root spring: a smooth curve that is no line."""

    def __init__(self):
        self.calls = 0

    def tip_stiffness(self, young_modulus_factor):
        self.calls += 1
        return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8000.0)


def test_published_line():
    assert PUBLISHED_LINE.stiffness(1.0) == pytest.approx(677.0)
    assert PUBLISHED_LINE.stiffness([0.9, 1.1]) == pytest.approx([619.48, 734.52])
    assert PUBLISHED_LINE.young_modulus_factor(677.0) == pytest.approx(1.0)
    assert PUBLISHED_LINE.slope([0.9, 1.1]) == pytest.approx(575.2)


def test_a_table_meets_its_model_within_the_stated_error():
    model = Springs()
    curve = stiffness_curve_of(model.tip_stiffness, RANGE)
    assert (curve.lower, curve.upper) == (0.9, 1.1)
    assert model.calls < 600
    factor = np.linspace(0.9, 1.1, 997)
    exact = np.array([model.tip_stiffness(value) for value in factor])
    assert np.abs(curve.stiffness(factor) / exact - 1.0).max() < 3.0 * TABLE_TOLERANCE
    slope = (curve.stiffness(factor + 1e-6) - curve.stiffness(factor - 1e-6)) / 2e-6
    assert curve.slope(factor[1:-1]) == pytest.approx(slope[1:-1], rel=1e-4)


@given(factor=st.floats(0.3, 1.9))
def test_the_inverse_inverts_also_beyond_the_table(factor):
    curve = stiffness_curve_of(Springs().tip_stiffness, RANGE)
    assert float(curve.young_modulus_factor(curve.stiffness(factor))) == pytest.approx(factor, abs=1e-7)


def test_a_curve_continues_smoothly_beyond_its_table():
    curve = stiffness_curve_of(Springs().tip_stiffness, RANGE)
    for end in (curve.lower, curve.upper):
        below, at, above = curve.stiffness([end - 1e-6, end, end + 1e-6])
        assert at - below == pytest.approx(above - at, rel=1e-3)


def test_bad_curves_are_refused():
    with pytest.raises(PosteriorError, match="rise with e"):
        stiffness_line(-1.0, 700.0)
    with pytest.raises(PosteriorError, match="positive"):
        stiffness_line(1.0, -5.0)
    with pytest.raises(PosteriorError, match="rise with e"):
        stiffness_curve_of(lambda factor: 700.0 - factor, RANGE)


def test_a_model_too_rough_to_tabulate_is_refused():
    def stairs(young_modulus_factor):
        return 600.0 + 100.0 * young_modulus_factor + 5.0 * math.floor(70.0 * young_modulus_factor)

    with pytest.raises(PosteriorError, match="too rough"):
        stiffness_curve_of(stairs, RANGE, "stairs")
