import math

import pytest

from fe.runtime.errors import InvalidStateError
from fe.runtime.state import DigitalState, Geometry, losses_of, region_names


def test_the_default_state_is_the_healthy_wing_as_built():
    state = DigitalState()
    assert state.geometry == Geometry(1.828, 0.433, 0.260)
    assert state.young_modulus_factor == 1.0
    assert losses_of(state.stiffness_loss, region_names(2)) == (0.0, 0.0)


def test_the_default_damping_gives_the_measured_ratios():
    state = DigitalState()
    for frequency, measured in ((5.6492, 0.0281), (29.9699, 0.0717)):  # Kapteyn et al. 2021, step 3
        omega = 2.0 * math.pi * frequency
        ratio = 0.5 * (state.damping_alpha / omega + state.damping_beta * omega)
        assert ratio == pytest.approx(measured, rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"young_modulus_factor": 0.0}, "young_modulus_factor"),
        ({"young_modulus_factor": math.nan}, "young_modulus_factor"),
        ({"servo_mass": -0.1}, "servo_mass"),
        ({"pitot_mass": math.inf}, "pitot_mass"),
        ({"damping_beta": -1e-9}, "damping_beta"),
        ({"stiffness_loss": (0.2, 1.0)}, "stiffness_loss 2"),
        ({"stiffness_loss": (40.0, 0.0)}, "not percent"),
        ({"stiffness_loss": (math.nan, 0.0)}, "stiffness_loss 1"),
        ({"stiffness_loss": (0.1,) * 9}, "at most 8 fractions"),
    ],
)
def test_impossible_states_are_refused_with_the_place(changes, place):
    with pytest.raises(InvalidStateError, match=place):
        DigitalState(**changes)


@pytest.mark.parametrize("name", ["semi_span", "root_chord", "tip_chord"])
def test_impossible_lengths_are_refused(name):
    with pytest.raises(InvalidStateError, match=f"geometry.{name}"):
        Geometry(**{name: -1.0})


def test_losses_stand_in_the_order_of_the_regions():
    regions = ("root", "z2", "tip")
    assert region_names(3) == ("z1", "z2", "z3")
    assert losses_of({"tip": 0.4, "root": 0.1}, regions) == (0.1, 0.0, 0.4)
    assert losses_of([0.1, 0.2, 0.3], regions) == (0.1, 0.2, 0.3)
    assert losses_of((), regions) == (0.0, 0.0, 0.0)
    with pytest.raises(InvalidStateError, match="no damage region 'z1'; the regions are root, z2, tip"):
        losses_of({"z1": 0.1}, regions)
    with pytest.raises(InvalidStateError, match="3 fractions, one for each of root, z2, tip, but 2"):
        losses_of((0.1, 0.2), regions)
