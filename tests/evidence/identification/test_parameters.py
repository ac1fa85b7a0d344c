"""Free numbers of a design, where they stand in it, and the file of a design."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evidence.identification.comparison import _row
from evidence.identification.design_file import HEADER, design_toml, rounded
from evidence.identification.errors import IdentificationError
from evidence.identification.parameters import (
    fixed_parameters,
    values_of,
    wing_parameters,
    with_values,
)
from fe.wing.design import SHIPPED_DESIGN, WingDesign, load_design, parse_design

DESIGN = load_design()
PARAMETERS = wing_parameters(DESIGN)


def test_every_parameter_is_documented_and_bounded():
    names = [parameter.name for parameter in (*PARAMETERS, *fixed_parameters())]
    assert len(names) == len(set(names))
    for parameter, value in zip(PARAMETERS, values_of(DESIGN, PARAMETERS), strict=True):
        assert parameter.why
        assert parameter.lower < parameter.mean < parameter.upper or parameter.lower == 0.0
        assert parameter.standard_deviation > 0.0
        assert parameter.lower <= value <= parameter.upper


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-0.4, 0.4), min_size=len(PARAMETERS), max_size=len(PARAMETERS)))
def test_what_is_written_is_read_back(steps):
    values = values_of(DESIGN, PARAMETERS)
    width = np.array([parameter.standard_deviation for parameter in PARAMETERS])
    lower = np.array([parameter.lower for parameter in PARAMETERS])
    upper = np.array([parameter.upper for parameter in PARAMETERS])
    wanted = np.clip(values + width * np.array(steps), lower, upper)
    found = values_of(with_values(DESIGN, PARAMETERS, wanted), PARAMETERS)
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_a_start_laid_out_otherwise_is_refused():
    webs = [web.model_dump() for web in DESIGN.webs]
    webs[1]["shear_modulus"] *= 2.0
    with pytest.raises(
        IdentificationError, match=r"'web shear modulus' stands at webs\.\*\.shear_modulus .*differ"
    ):
        values_of(DESIGN.changed(webs=webs), PARAMETERS)
    bare: WingDesign = DESIGN.changed(added_density=[])
    with pytest.raises(IdentificationError, match="has nothing there"):
        values_of(bare, PARAMETERS)
    with pytest.raises(IdentificationError, match="24 gauges"):
        values_of(DESIGN.changed(gauges={"positions": DESIGN.gauges.positions[:8]}), PARAMETERS)


def test_a_written_design_is_read_back_and_the_shipped_file_is_such_a_one():
    design = DESIGN.changed(name='a "wing" \\ of mine')
    text = design_toml(design, {"skin.stations.0.young_modulus": "identified", "webs.*.shear_modulus": "too"})
    again = parse_design(tomllib.loads(text))
    assert again == parse_design(rounded(design))
    assert sum(line.endswith("# too") for line in text.splitlines()) == len(design.webs)
    assert design_toml(again, {}) == design_toml(design, {})
    assert "row A is gauges 1-16, row B gauges 17-24" in text
    shipped = SHIPPED_DESIGN.read_text(encoding="utf-8")
    assert shipped.startswith("".join(f"# {line}".rstrip() + "\n" for line in HEADER))
    assert parse_design(rounded(DESIGN)) == DESIGN


def test_the_first_gauge_is_gauge_1():
    difference = np.zeros((3, 24))
    difference[2, 0] = 1.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 1"
    difference[1, 23] = -2.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 24"
