"""What unit texts mean, against their definitions."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.door.units import Meaning, contradictions, meaning_of, same_dimension


def si(**exponents: int) -> tuple[int, ...]:
    return tuple(exponents.get(symbol, 0) for symbol in ("kg", "m", "s", "A", "K", "mol", "cd", "rad"))


@pytest.mark.parametrize(
    ("text", "exponents", "factor", "offset"),
    [
        ("1", si(), 1.0, 0.0),
        ("microstrain", si(), 1e-6, 0.0),
        ("kN", si(kg=1, m=1, s=-2), 1e3, 0.0),
        ("N.m", si(kg=1, m=2, s=-2), 1.0, 0.0),
        ("N*mm", si(kg=1, m=2, s=-2), 1e-3, 0.0),
        ("kg/m3", si(kg=1, m=-3), 1.0, 0.0),
        ("g/cm3", si(kg=1, m=-3), 1e3, 0.0),
        ("kg.m2/s3", si(kg=1, m=2, s=-3), 1.0, 0.0),
        ("W/(m2.K)", si(kg=1, s=-3, K=-1), 1.0, 0.0),
        ("W/m2/K", si(kg=1, s=-3, K=-1), 1.0, 0.0),
        ("m2.K/W", si(kg=-1, s=3, K=1), 1.0, 0.0),
        ("s-1", si(s=-1), 1.0, 0.0),
        ("m^2", si(m=2), 1.0, 0.0),
        ("1/min", si(s=-1), 1.0 / 60.0, 0.0),
        ("km/h", si(m=1, s=-1), 1.0 / 3.6, 0.0),
        ("rad/s", si(s=-1, rad=1), 1.0, 0.0),
        ("deg", si(rad=1), math.pi / 180.0, 0.0),
        ("degC", si(K=1), 1.0, 273.15),
        ("mbar", si(kg=1, m=-1, s=-2), 100.0, 0.0),
        ("GPa", si(kg=1, m=-1, s=-2), 1e9, 0.0),
        ("µm", si(m=1), 1e-6, 0.0),
        ("min", si(s=1), 60.0, 0.0),
        ("mmin", None, 0.0, 0.0),
        ("bushel", None, 0.0, 0.0),
        ("degC/s", None, 0.0, 0.0),
        ("N..m", None, 0.0, 0.0),
        ("W/(m2", None, 0.0, 0.0),
        ("m)", None, 0.0, 0.0),
        ("", None, 0.0, 0.0),
        ("2", None, 0.0, 0.0),
        ("pm40", None, 0.0, 0.0),
        ("m/(pm40)", None, 0.0, 0.0),
        ("Gm40", None, 0.0, 0.0),
        pytest.param("(" * 3000 + "m" + ")" * 3000, None, 0.0, 0.0, id="nested"),
    ],
)
def test_unit_texts(text: str, exponents: tuple[int, ...] | None, factor: float, offset: float) -> None:
    wanted = None if exponents is None else Meaning(exponents, pytest.approx(factor, rel=1e-12), offset)
    assert meaning_of(text) == wanted


UNITS = st.sampled_from(["m", "kg", "s", "kN", "mm", "Pa", "K", "rad", "W", "1", "min", "%"])


@given(UNITS, UNITS, st.integers(1, 4))
def test_products_multiply_and_quotients_divide(one: str, two: str, power: int) -> None:
    first, second = meaning_of(one), meaning_of(two)
    for sign, factor, together in (
        (1, first.factor * second.factor, meaning_of(f"{one}.{two}")),
        (-1, first.factor / second.factor, meaning_of(f"{one}/{two}")),
    ):
        exponents = tuple(a + sign * b for a, b in zip(first.exponents, second.exponents, strict=True))
        assert together == Meaning(exponents, pytest.approx(factor, rel=1e-12))
    if one not in ("1",):
        raised = meaning_of(f"{one}{power}")
        assert raised == Meaning(
            tuple(power * e for e in first.exponents), pytest.approx(first.factor**power, rel=1e-12)
        )


@given(st.text(max_size=12))
def test_any_text_is_understood_or_not(text: str) -> None:
    found = meaning_of(text)
    assert found is None or (len(found.exponents) == 8 and math.isfinite(found.factor))


def test_dimensions_are_compared() -> None:
    assert same_dimension("kN", "lbf") is True
    assert same_dimension("N", "m") is False
    assert same_dimension("bushel", "m") is None


def test_definitions_that_contradict_what_is_usual() -> None:
    sound = UnitInfo("kN", si(kg=1, m=1, s=-2), 1e3, 0.0, ())
    unusual, open_one = UnitInfo("bushel", si(m=3), 0.035, 0.0, ()), UnitInfo("K", None, 1, 0, ())
    # Radians come and go in FMUs, and nobody means anything by it.
    turning = UnitInfo("rad/s", si(s=-1), 1.0, 0.0, ())
    assert contradictions([sound, unusual, open_one, turning]) == []
    lying = UnitInfo("kN", si(kg=1, m=1, s=-2), 1.0, 0.0, ())
    first, second = contradictions([lying, UnitInfo("m", si(kg=1), 1.0, 0.0, ())])
    assert ("usual are 1000" in first, "another dimension" in first) == (True, False)
    assert ("usual are 1000" in second, "another dimension" in second) == (False, True)
