import json
import tomllib

import numpy as np
import pytest

from fe.runtime.errors import DesignFileError, InvalidDesignError
from fe.wing.design import SHIPPED_DESIGN, load_design, parse_design, rib_interval


@pytest.fixture
def content():
    return tomllib.loads(SHIPPED_DESIGN.read_text(encoding="utf-8"))


def test_the_shipped_design_is_the_wing_as_built(shipped_design):
    assert (shipped_design.geometry.semi_span, shipped_design.geometry.root_chord) == (1.828, 0.433)
    assert len(shipped_design.gauges.positions) == 24
    assert [place.kind for place in shipped_design.point_masses] == ["servo", "servo", "pitot"]


def test_the_hash_covers_content_and_nothing_else(shipped_design, content, tmp_path):
    commented = tmp_path / "same.toml"
    commented.write_text("# another comment\n" + SHIPPED_DESIGN.read_text(encoding="utf-8"), encoding="utf-8")
    assert load_design(commented).hash == shipped_design.hash
    assert parse_design(dict(reversed(content.items()))).hash == shipped_design.hash
    assert shipped_design.changed(skin={"thickness": 0.00061}).hash != shipped_design.hash
    assert shipped_design.changed(mesh={"refinement": 2.0}).hash != shipped_design.hash
    assert len(shipped_design.hash) == 64


def test_a_design_survives_a_round_trip_through_json(shipped_design):
    assert parse_design(json.loads(shipped_design.model_dump_json())) == shipped_design


def _set(content, path, value):
    *parents, last = path
    for part in parents:
        content = content[part]
    content[last] = value


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        (("skin", "thicknes"), 0.001, r"'skin.thicknes' is not a key"),
        (("colour",), "red", r"'colour' is not a key"),
        (("skin", "thickness"), -0.0006, r"skin.thickness.*greater than 0"),
        (("skin", "thickness"), float("nan"), r"skin.thickness.*finite"),
        (("skin", "thickness"), 0.02, r"does not fit into the section"),
        (("skin", "thickness"), "thin", r"skin.thickness.*number"),
        (("skin", "thickness"), "0.0006", r"skin.thickness.*number"),
        (("skin", "density"), True, r"skin.density.*number"),
        (("skin", "density"), float("inf"), r"skin.density.*finite"),
        (("skin", "closed_leading_edge"), 1, r"skin.closed_leading_edge.*true or false"),
        (("gauges", "positions", 3), [0.4, True], r"gauges.positions\[3\]\[1\].*number"),
        (("planform", "semi_span"), 1828.0, r"planform.semi_span.*less than 60"),
        (("webs", 1, "young_modulus"), 0.911, r"webs\[1\].young_modulus.*1000000"),
        (("webs", 1, "chord"), 0.02, r"webs\[1\] at chord 0.02 must lie behind webs\[0\]"),
        (("ribs", 1, "station"), 1.2, r"ribs\[1\].station.*less than or equal to 1"),
        (("ribs", 1, "station"), 0.001, r"ribs\[0\] and ribs\[1\] overlap"),
        (("gauges", "positions", 16), [1.9, 0.3], r"gauges.positions\[16\] is 1.9 m from the root"),
        (("gauges", "positions", 3), [0.4, 0.95], r"gauges.positions\[3\] at chord 0.95"),
        (("defects", 0, "span_end"), 1.9, r"defects\[0\] ends 1.9 m from the root, off the wing"),
        (("defects", 0, "chord_start"), 0.01, r"defects\[0\].*outside the skin of the box"),
        (("defects", 0, "span_start"), 1.0, r"defects\[0\] must end behind its start"),
        (("defects", 1, "span_start"), 0.1, r"defects\[0\] and defects\[1\] overlap"),
        (("defects",), [], r"defects.*at least 1"),
        (("skin", "stations", 1, "station"), 0.9, r"the stations must rise from 0 to 1"),
        (("skin", "stations", -1, "station"), 0.98, r"the stations must rise from 0 to 1"),
        (("skin", "stations"), [], r"either in bands or at stations"),
        (("skin", "bands"), [{"end": 1.0, "young_modulus": 9e9}], r"either in bands or at stations"),
        (("lift", "chordwise_exponent"), -1.0, r"lift.chordwise_exponent"),
        (("gauges", "surface"), "inner", r"gauges.surface"),
        (("point_masses", 0, "kind"), "engine", r"point_masses\[0\].kind"),
        (("point_masses", 0, "chord"), 0.99, r"point_masses\[0\] at chord 0.99"),
        (("tip_load", "distance_from_tip"), 2.0, r"tip_load.distance_from_tip"),
        (("lift", "distribution"), "guess", r"lift.distribution"),
        (
            ("rods",),
            [{"web": 7, "reach": 0.2, "diameter": 0.01, "young_modulus": 1e11, "density": 1600}],
            "web 7",
        ),
    ],
)
def test_a_wrong_design_is_refused_with_one_sentence_that_names_the_place(content, path, value, sentence):
    if path == ("defects", 1, "span_start"):
        content["defects"][1]["chord_end"] = 0.3
    _set(content, path, value)
    with pytest.raises(InvalidDesignError, match=sentence) as caught:
        parse_design(content, source="wing.toml")
    message = str(caught.value)
    assert message.startswith("wing.toml: ")
    assert "\n" not in message
    assert message.endswith(".")


def test_the_modulus_runs_straight_between_stations_and_steps_between_bands(shipped_design):
    stations = [{"station": s, "young_modulus": m} for s, m in ((0.0, 8e9), (0.5, 10e9), (1.0, 6e9))]
    skin = shipped_design.changed(skin={"stations": stations}).skin
    assert skin.young_modulus(np.array([0.0, 0.25, 0.5, 0.75])) == pytest.approx([8e9, 9e9, 10e9, 8e9])
    bands = [{"end": 0.5, "young_modulus": 8e9}, {"end": 1.0, "young_modulus": 6e9}]
    skin = shipped_design.changed(skin={"stations": [], "bands": bands}).skin
    assert skin.young_modulus(np.array([0.1, 0.5, 0.51])).tolist() == [8e9, 8e9, 6e9]
    for ends in ((0.5, 0.4), (0.5, 0.9)):
        wrong = [{"end": end, "young_modulus": 8e9} for end in ends]
        with pytest.raises(InvalidDesignError, match="the ends of the bands must rise"):
            shipped_design.changed(skin={"stations": [], "bands": wrong})


def test_a_missing_section_is_named(content):
    del content["lift"]
    with pytest.raises(InvalidDesignError, match="'lift' is missing"):
        parse_design(content)


def test_an_unreadable_file_is_named(tmp_path):
    with pytest.raises(DesignFileError, match=r"none\.toml cannot be read: No such file"):
        load_design(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    nested = "x = " + "[" * 9000 + "]" * 9000
    for text, sentence in (("[planform\n", "not valid TOML"), (nested, "nested deeper than 32")):
        broken.write_text(text, encoding="utf-8")
        with pytest.raises(DesignFileError, match=sentence):
            load_design(broken)


def test_a_byte_order_mark_changes_nothing(shipped_design, tmp_path):
    marked = tmp_path / "marked.toml"
    marked.write_text(SHIPPED_DESIGN.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert load_design(marked) == shipped_design


def test_ribs_at_the_ends_lie_inside_the_span(shipped_design):
    span = shipped_design.planform.semi_span
    assert rib_interval(shipped_design, 0) == (0.0, pytest.approx(0.003))
    assert rib_interval(shipped_design, 2)[1] == pytest.approx(span)
