"""The design of a wing: its file, its section, its lift."""

import json
import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.errors import DesignFileError, InvalidDesignError
from fe.wing.design import SHIPPED_DESIGN, load_design, parse_design, rib_interval
from fe.wing.parts import Planform, four_digit_half_thickness, four_digit_slope
from fe.wing.turn_load import DISTRIBUTIONS, lifting_line, schrenk
from tests.refusals import Inputs

TEXT = SHIPPED_DESIGN.read_text(encoding="utf-8")


@pytest.fixture
def content():
    return tomllib.loads(TEXT)


def test_the_shipped_design_is_the_wing_as_built(shipped_design):
    assert (shipped_design.geometry.semi_span, shipped_design.geometry.root_chord) == (1.828, 0.433)
    assert len(shipped_design.gauges.positions) == 24
    assert [place.kind for place in shipped_design.point_masses] == ["servo", "servo", "pitot"]


def test_the_hash_covers_content_and_nothing_else(shipped_design, content, tmp_path):
    other = tmp_path / "same.toml"
    for text, encoding in (("# another comment\n" + TEXT, "utf-8"), (TEXT, "utf-8-sig")):
        other.write_text(text, encoding=encoding)
        assert load_design(other) == shipped_design
        assert load_design(other).hash == shipped_design.hash
    assert parse_design(dict(reversed(content.items()))).hash == shipped_design.hash
    for changes in ({"skin": {"thickness": 0.00061}}, {"mesh": {"refinement": 2.0}}):
        assert shipped_design.changed(**changes).hash != shipped_design.hash
    assert len(shipped_design.hash) == 64
    assert parse_design(json.loads(shipped_design.model_dump_json())) == shipped_design


@pytest.mark.parametrize(("path", "value", "sentence"), Inputs(__file__).refused("wing"))
def test_a_wrong_design_is_refused_with_one_sentence_that_names_the_place(content, path, value, sentence):
    if path == ["defects", 1, "span_start"]:
        content["defects"][1]["chord_end"] = 0.3
    place = content
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    with pytest.raises(InvalidDesignError, match=sentence) as caught:
        parse_design(content, source="wing.toml")
    message = str(caught.value)
    assert (message[:11], message[-1]) == ("wing.toml: ", ".")
    assert "\n" not in message


def test_the_modulus_runs_straight_between_stations_and_steps_between_bands(shipped_design):
    stations = [{"station": s, "young_modulus": m} for s, m in ((0.0, 8e9), (0.5, 10e9), (1.0, 6e9))]
    skin = shipped_design.changed(skin={"stations": stations}).skin
    assert skin.young_modulus(np.array([0.0, 0.25, 0.5, 0.75])) == pytest.approx([8e9, 9e9, 10e9, 8e9])

    def banded(*ends, moduli=(8e9, 6e9)):
        bands = [{"end": end, "young_modulus": own} for end, own in zip(ends, moduli, strict=True)]
        return shipped_design.changed(skin={"stations": [], "bands": bands}).skin

    assert banded(0.5, 1.0).young_modulus(np.array([0.1, 0.5, 0.51])).tolist() == [8e9, 8e9, 6e9]
    for last in (0.4, 0.9):
        with pytest.raises(InvalidDesignError, match="the ends of the bands must rise"):
            banded(0.5, last)


def test_what_is_missing_or_unreadable_is_named(content, tmp_path):
    del content["lift"]
    with pytest.raises(InvalidDesignError, match="'lift' is missing"):
        parse_design(content)
    with pytest.raises(DesignFileError, match=r"none\.toml cannot be read: No such file"):
        load_design(tmp_path / "none.toml")


def test_ribs_at_the_ends_lie_inside_the_span(shipped_design):
    assert rib_interval(shipped_design, 0) == (0.0, pytest.approx(0.003))
    assert rib_interval(shipped_design, 2)[1] == pytest.approx(shipped_design.planform.semi_span)


# ---------------------------------------------------------------- lift


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
