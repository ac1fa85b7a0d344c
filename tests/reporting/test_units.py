"""Texts of units: any text is a unit or is refused in one way."""

from fractions import Fraction

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from reporting.units import BASE_UNITS, conversion_of, exact_conversion

SYMBOLS = (
    "m mm g kg s A ampere gram K degC degF °C rad N Nm V Qm % ° 1 statC dB Np blorp Hz turn G lb"
)
NAMES = st.sampled_from(SYMBOLS.split())
POWERS = st.sampled_from(
    ["", "", "0", "1", "2", "-1", "^1", "^0", "^", "**2", "²", "9", "-9", "+1", "⁰", "٣"]
)
FACTORS = st.builds(
    "".join,
    st.tuples(st.sampled_from(["", "", "("]), NAMES, POWERS, st.sampled_from(["", "", ")"])),
)
TEXTS = st.one_of(
    st.text(max_size=45),
    st.builds(
        lambda joint, factors: joint.join(factors),
        st.sampled_from(["/", ".", " "]),
        st.lists(FACTORS, max_size=5),
    ),
)


@settings(max_examples=300, deadline=None)
@given(text=TEXTS, gravity=st.booleans())
@example("A0", False)
@example("ampere0.m", False)
@example("g0", True)
@example("statC", False)
@example("Qm9.Qm9.m-9.m-8", False)
@example("ﷺ" * 40, False)
def test_any_text_is_a_unit_or_is_refused(text, gravity):
    try:
        exponents, factor, offset = exact_conversion(text, gravity=gravity)
    except ValueError:
        return

    assert [type(exponent) for exponent in exponents] == [int] * len(BASE_UNITS)
    assert float(factor) != 0.0
    assert abs(float(offset)) < float("inf")


@pytest.mark.parametrize(
    "text",
    [
        *("A0", "ampere0", "g0", "m0", "V0", "rad0", "m^0", "m-0"),
        *("N1", "m1", "mm1", "kN+1", "1/s1", "12", "10", "11"),
        *("m.1", "m/1", "1^2", "(1)", "m^", "N 1", "m 1", "1 m"),
    ],
)
def test_a_name_with_a_number_is_no_unit(text):
    with pytest.raises(ValueError, match="is not a unit"):
        exact_conversion(text)

    assert conversion_of(text) is None


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("m2", "m.m"),
        ("m^1", "m"),
        ("m**1", "m"),
        ("s-1", "1/s"),
        ("(1/s)", "1/s"),
        ("m.(1/s)", "m/s"),
        ("mm²", "mm2"),
    ],
)
def test_powers_and_reciprocals_are_units(text, same):
    assert exact_conversion(text) == exact_conversion(same)


def test_a_unit_with_a_half_power_of_length_is_none_of_si():
    """A statcoulomb is 1 g^(1/2) cm^(3/2) / s."""
    with pytest.raises(ValueError, match="not an SI unit"):
        exact_conversion("statC")


def test_a_unit_beyond_all_numbers_is_refused():
    with pytest.raises(ValueError, match="beyond the numbers"):
        exact_conversion("Qm9.Qm9.m-9.m-8")


def test_a_large_factor_is_exact():
    """A quettametre is 10^30 m."""
    _, factor, _ = exact_conversion("Qm2")

    assert factor == Fraction(10) ** 60
