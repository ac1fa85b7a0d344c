"""Units of campaigns: those of old have kept their meaning, and pint knows the others."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS, conversion, conversion_of, quantities_of
from tests.refusals import Inputs


def rows(table):
    """Return quantity, unit and its power or factor, of a part of `units.toml`."""
    known = Inputs(__file__).table("units.toml")[table]
    return [(Quantity(name), unit, size) for name, row in known.items() for unit, size in row.items()]


def test_the_units_of_old_mean_the_same():
    """What they were before pint is written down, for their meaning must not change."""
    for quantity, unit, power in rows("powers"):
        assert conversion_of(quantity, unit).factor == float(f"1e{power}"), unit
    usual = {(quantity, unit) for quantity, row in UNITS.items() for unit in row.usual}
    assert usual == {row[:2] for table in ("powers", "factors") for row in rows(table)}


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e150, max_value=1e150))
def test_a_unit_and_back_is_the_same_to_rounding(value):
    for quantity, unit, power in rows("powers"):
        known = conversion_of(quantity, unit)
        assert known.to_si(value) == pytest.approx(value * 10.0**power, rel=1e-15)
        assert known.from_si(known.to_si(value)) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(("quantity", "unit", "factor"), rows("factors") + rows("others"))
def test_units_as_laboratories_write_them(quantity, unit, factor):
    assert quantity in quantities_of(unit)
    assert conversion_of(quantity, unit).factor == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    "unit",
    ["", "kg", "t", "1/min", "Hz", "links", "dB", "2 mm", "9**9**9", "kN/m", "i.O.", "degF", "x", "m" * 9999],
)
def test_what_is_no_unit_of_ours_is_of_no_quantity(unit):
    assert quantities_of(unit) == ()


@pytest.mark.parametrize("unit", ["mV/V", "V/V", "µV/V", "mV/volt"])
def test_a_ratio_of_volts_is_a_signal_and_no_strain(unit):
    assert quantities_of(unit) == (Quantity.SIGNAL,)
    with pytest.raises(ValueError, match=f"strain must have a unit such as .*, and '{unit}' came"):
        conversion_of(Quantity.STRAIN, unit)


def test_a_time_is_converted_and_a_length_is_no_time():
    assert conversion("ms", "s").factor == 1e-3
    with pytest.raises(ValueError, match="cannot become s"):
        conversion("mm", "s")
