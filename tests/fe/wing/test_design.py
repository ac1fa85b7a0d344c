"""The design of a wing: shipped files, refusals, moduli, distributions of the lift."""

import tomllib
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.errors import InvalidDesignError
from fe.wing.design import SHIPPED_DESIGN, parse_design
from fe.wing.parts import DISTRIBUTIONS, Planform, lifting_line
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)


def read_design(name):
    """Return the content of a shipped design."""
    return tomllib.loads(SHIPPED_DESIGN.with_name(name).read_text(encoding="utf-8"))


def test_the_wing_with_a_third_region_is_the_shipped_one_with_a_third_region():
    shipped = read_design("uav_wing.toml")
    three_regions = read_design("uav_wing_three_regions.toml")
    third_region = three_regions["defects"].pop()

    assert set(third_region) == {"span_start", "span_end", "chord_start", "chord_end"}
    assert three_regions == shipped | {"name": "UAV wing, three regions"}
    assert shipped["name"] == "UAV wing"


@pytest.mark.parametrize(("path", "value", "sentence"), INPUTS.refused("wing"))
def test_a_wrong_design_is_refused_with_one_sentence_that_names_the_place(path, value, sentence):
    content = read_design(SHIPPED_DESIGN.name)
    if path == ["defects", 1, "span_start"]:  # regions overlap if their chords do, too
        content["defects"][1]["chord_end"] = 0.3
    *parents, key = path
    reduce(getitem, parents, content)[key] = value

    with refused(InvalidDesignError, rf"^wing\.toml: .*({sentence}).*\.$"):
        parse_design(content, source="wing.toml")


# ---------------------------------------------------------------- modulus along the span


def test_the_modulus_runs_straight_between_stations(shipped_design):
    stations = [
        {"station": 0.0, "young_modulus": 8e9},
        {"station": 0.5, "young_modulus": 10e9},
        {"station": 1.0, "young_modulus": 6e9},
    ]

    skin = shipped_design.changed(skin={"stations": stations}).skin

    moduli = skin.young_modulus(np.array([0.0, 0.25, 0.5, 0.75]))
    assert moduli == pytest.approx([8e9, 9e9, 10e9, 8e9])


def skin_in_bands(design, *ends):
    """Return the skin with a modulus of 8 GPa up to the first end, and of 6 GPa to the second."""
    bands = [
        {"end": end, "young_modulus": modulus}
        for end, modulus in zip(ends, (8e9, 6e9), strict=True)
    ]
    return design.changed(skin={"stations": [], "bands": bands}).skin


def test_the_modulus_steps_between_bands(shipped_design):
    skin = skin_in_bands(shipped_design, 0.5, 1.0)

    assert skin.young_modulus(np.array([0.1, 0.5, 0.51])).tolist() == [8e9, 8e9, 6e9]


@pytest.mark.parametrize("last_end", [0.4, 0.9])
def test_bands_that_do_not_rise_to_the_tip_are_refused(shipped_design, last_end):
    with pytest.raises(InvalidDesignError, match="the ends of the bands must rise"):
        skin_in_bands(shipped_design, 0.5, last_end)


# ---------------------------------------------------------------- lift


@pytest.mark.parametrize("name", sorted(DISTRIBUTIONS))
@given(span=st.floats(0.5, 10.0), root=st.floats(0.1, 1.0), taper=st.floats(0.3, 1.0))
def test_a_distribution_integrates_to_one_over_the_half_wing(name, span, root, taper):
    planform = Planform(
        semi_span=span, root_chord=root, tip_chord=root * taper, straight_chord_line=0.25
    )
    station = np.sin(np.linspace(0.0, 0.5 * np.pi, 2001))

    lift = DISTRIBUTIONS[name](planform, station)

    assert np.trapezoid(lift * span, station) == pytest.approx(1.0, rel=1e-4)
    assert np.all(lift[:-1] > 0.0)


@pytest.mark.parametrize(
    ("aspect_ratio", "excess_drag"),
    [(0.75, 0.034), (1.0, 0.049), (1.25, 0.063), (1.5, 0.076), (1.75, 0.088)],
)
def test_the_lifting_line_has_the_induced_drag_of_glauerts_table(aspect_ratio, excess_drag):
    """Glauert 1926, four terms: what rectangular wings have beyond an ellipse.

    The aspect ratio is over the slope of the lift.
    """
    planform = Planform(
        semi_span=np.pi * aspect_ratio, root_chord=1.0, tip_chord=1.0, straight_chord_line=0.25
    )
    angle = (np.arange(400) + 0.5) * np.pi / 800.0
    order = np.arange(1, 20, 2)

    lift = lifting_line(planform, np.cos(angle), 4)

    first, *higher = np.sin(np.outer(order, angle)) @ lift
    assert order[1:] @ (higher / first) ** 2 == pytest.approx(excess_drag, abs=5e-4)
