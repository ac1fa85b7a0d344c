import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.wing.parts import Planform, four_digit_half_thickness, four_digit_slope
from fe.wing.turn_load import DISTRIBUTIONS, lifting_line, schrenk

UAV = Planform(semi_span=1.828, root_chord=0.433, tip_chord=0.260, straight_chord_line=0.3)


def _integral(values, station):
    return float(np.trapezoid(values, station))


@pytest.mark.parametrize("name", sorted(DISTRIBUTIONS))
@given(span=st.floats(0.5, 10.0), root=st.floats(0.1, 1.0), taper=st.floats(0.3, 1.0))
def test_a_distribution_integrates_to_one_over_the_half_wing(name, span, root, taper):
    plan = Planform(semi_span=span, root_chord=root, tip_chord=root * taper, straight_chord_line=0.25)
    angle = np.linspace(0.0, 0.5 * np.pi, 2001)
    station = np.sin(angle)
    lift = DISTRIBUTIONS[name](plan)(station)
    assert _integral(lift * span, station) == pytest.approx(1.0, rel=1e-4)
    assert np.all(lift[:-1] > 0.0)


def test_schrenk_and_the_lifting_line_bend_the_wing_alike():
    angle = np.linspace(0.0, 0.5 * np.pi, 2001)
    station = np.sin(angle)
    one, other = schrenk(UAV)(station), lifting_line(UAV)(station)
    for power in (1, 2):  # bending moment at the root, and its spread
        assert _integral(one * station**power, station) == pytest.approx(
            _integral(other * station**power, station), rel=0.02
        )
    inner = station < 0.8
    assert np.abs(one[inner] / other[inner] - 1.0).max() < 0.04


def test_the_lifting_line_has_converged_and_vanishes_at_the_tip():
    station = np.linspace(0.0, 0.99, 50)
    assert lifting_line(UAV)(station) == pytest.approx(lifting_line(UAV, terms=120)(station), rel=2e-3)
    assert lifting_line(UAV)(1.0) == pytest.approx(0.0, abs=1e-12)


def test_the_lifting_line_of_an_infinitely_slender_wing_follows_its_chord():
    plan = Planform(semi_span=50.0, root_chord=0.1, tip_chord=0.05, straight_chord_line=0.25)
    station = np.linspace(0.1, 0.9, 9)
    chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * station
    shape = lifting_line(plan, terms=200)(station) / chord
    assert shape == pytest.approx(shape.mean(), rel=0.01)


def test_the_section_has_its_thickness_at_three_tenths_of_the_chord():
    assert four_digit_half_thickness(0.3, 0.125) == pytest.approx(0.0625, rel=2e-3)
    xi = np.linspace(0.02, 0.98, 40)
    step = 1e-6
    difference = (four_digit_half_thickness(xi + step, 0.12) - four_digit_half_thickness(xi - step, 0.12)) / (
        2.0 * step
    )
    assert four_digit_slope(xi, 0.12) == pytest.approx(difference, abs=1e-7)
