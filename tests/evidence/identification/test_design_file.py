import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evidence.identification.comparison import _row
from evidence.identification.design_file import DIGITS, HEADER, _number, design_toml, rounded
from fe.wing.design import SHIPPED_DESIGN, load_design, parse_design


def test_a_written_design_is_read_back():
    design = load_design()
    text = design_toml(design, {"skin.stations.0.young_modulus": "identified", "webs.*.shear_modulus": "too"})
    again = parse_design(tomllib.loads(text))
    assert again == parse_design(rounded(design))
    assert sum(line.endswith("# too") for line in text.splitlines()) == len(design.webs)
    assert design_toml(again, {}) == design_toml(design, {})
    assert "row A is gauges 1-16, row B gauges 17-24" in text


def test_the_shipped_file_is_such_a_file():
    shipped = load_design()
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    assert text.startswith("".join(f"# {line}".rstrip() + "\n" for line in HEADER))
    assert parse_design(rounded(shipped)) == shipped


@given(st.floats(1e-9, 1e13))
def test_numbers_keep_their_digits(value):
    text = _number(float(f"{value:.{DIGITS}g}"))
    assert tomllib.loads(f"x = {text}")["x"] == pytest.approx(value, rel=10.0 ** (1 - DIGITS))


def test_text_is_quoted():
    design = load_design().changed(name='a "wing" \\ of mine')
    assert tomllib.loads(design_toml(design, {}))["name"] == design.name


def test_the_first_gauge_is_gauge_1():
    difference = np.zeros((3, 24))
    difference[2, 0] = 1.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 1"
    difference[1, 23] = -2.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 24"
