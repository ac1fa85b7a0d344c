"""Units of a campaign's files, and their conversion to SI without a rounding of its own.

A power of ten is applied to the decimal text of a number before it becomes binary, so a value that is written
in microstrain comes back to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal, localcontext
from math import isfinite, pi
from types import MappingProxyType
from typing import NamedTuple

from discrepancy.campaign.records import Quantity

STANDARD_GRAVITY = 9.80665
"""m/s^2 in one g, exact by definition."""


class Units(NamedTuple):
    """Units of a quantity.

    Attributes
    ----------
    powers : mapping of str to int
        Those of files, and their powers of ten over SI.
    written : str
        The one in which a campaign is written.
    si : str
        That of values in memory; of a signal it is nominal.
    drawn : tuple of float and str
        Factor from SI, and unit, in figures.
    factors : mapping of str to float
        Those of files that are no powers of ten, and what one of them is in SI.
    """

    powers: dict[str, int]
    written: str
    si: str
    drawn: tuple[float, str]
    factors: Mapping[str, float] = MappingProxyType({})


_DEGREE = pi / 180.0
_TURN = 2.0 * pi / 60.0
UNITS = {
    Quantity.STRAIN: Units({"1": 0, "microstrain": -6, "percent": -2}, "microstrain", "1", (1e6, "µε")),
    Quantity.DISPLACEMENT: Units({"m": 0, "mm": -3, "um": -6}, "mm", "m", (1e3, "mm")),
    Quantity.VELOCITY: Units({"m/s": 0, "mm/s": -3}, "m/s", "m/s", (1.0, "m/s"), {"km/h": 1.0 / 3.6}),
    Quantity.ACCELERATION: Units(
        {"m/s2": 0, "mm/s2": -3}, "m/s2", "m/s2", (1.0, "m/s²"), {"g": STANDARD_GRAVITY}
    ),
    Quantity.SIGNAL: Units({"V": 0, "mV": -3, "1": 0}, "V", "V", (1.0, "signal")),
    Quantity.ANGLE: Units({"rad": 0, "mrad": -3}, "rad", "rad", (1.0, "rad"), {"deg": _DEGREE}),
    Quantity.ANGULAR_VELOCITY: Units(
        {"rad/s": 0}, "rad/s", "rad/s", (1.0, "rad/s"), {"deg/s": _DEGREE, "rpm": _TURN}
    ),
    Quantity.ANGULAR_ACCELERATION: Units(
        {"rad/s2": 0}, "rad/s2", "rad/s2", (1.0, "rad/s²"), {"deg/s2": _DEGREE}
    ),
    Quantity.FORCE: Units({"N": 0, "mN": -3, "kN": 3}, "N", "N", (1.0, "N")),
    Quantity.TORQUE: Units({"N m": 0, "mN m": -3, "kN m": 3}, "N m", "N m", (1.0, "N m")),
    Quantity.PRESSURE: Units(
        {"Pa": 0, "hPa": 2, "kPa": 3, "bar": 5, "mbar": 2, "MPa": 6}, "Pa", "Pa", (1e-3, "kPa")
    ),
    Quantity.LEVEL: Units({"m": 0, "cm": -2, "mm": -3}, "m", "m", (1.0, "m")),
    Quantity.FLOW: Units(
        {"m3/s": 0, "l/s": -3}, "m3/s", "m3/s", (1.0, "m³/s"),
        {"l/min": 1e-3 / 60.0, "m3/h": 1.0 / 3600.0},
    ),
    Quantity.TEMPERATURE: Units({"degC": 0, "K": 0}, "degC", "degC", (1.0, "°C")),
    Quantity.HEAT: Units({"W": 0, "mW": -3, "kW": 3}, "W", "W", (1.0, "W")),
    Quantity.VOLTAGE: Units({"V": 0, "mV": -3, "kV": 3}, "V", "V", (1.0, "V")),
    Quantity.CURRENT: Units({"A": 0, "mA": -3}, "A", "A", (1.0, "A")),
    Quantity.CHARGE: Units({"C": 0, "mC": -3}, "C", "C", (1.0, "C"), {"A h": 3600.0}),
}  # fmt: skip
"""All that files, tables and figures know of a quantity: a new kind of sensor is one more row."""


def units_of(quantity: Quantity) -> tuple[str, ...]:
    """Return the units that a quantity may be given in."""
    return (*UNITS[quantity].powers, *UNITS[quantity].factors)


def power_of_ten(quantity: Quantity, unit: str) -> int | None:
    """Return the power of ten from a unit to SI; None for those that are no power of ten, such as g."""
    return UNITS[quantity].powers.get(unit)


def si_value(text: str, quantity: Quantity, unit: str) -> float:
    """Return the SI value of a number's text in a unit, correctly rounded.

    Raises
    ------
    ValueError
        The text is no number.
    """
    power = power_of_ten(quantity, unit)
    if power is None:
        return float(text) * UNITS[quantity].factors[unit]
    return shifted(text, power)


def shifted(text: str, power: int) -> float:
    """Return the float nearest to text times ten to a power; raises ValueError if it is no number."""
    if power == 0:
        return float(text)
    mantissa, letter, exponent = text.lower().partition("e")
    if not letter:
        return float(f"{text}e{power}")
    return float(f"{mantissa}e{int(exponent) + power}")


def in_unit(value: float, quantity: Quantity, unit: str) -> str:
    """Return the text of an SI value in a unit; `si_value` gives it back, exactly for a power of ten."""
    power = power_of_ten(quantity, unit)
    if power is None:
        return repr(value / UNITS[quantity].factors[unit])
    if not isfinite(value) or power == 0:
        return repr(float(value))
    return _text(Decimal(repr(float(value))).scaleb(-power))


def sum_text(first: float, second: float) -> str:
    """Return the exact decimal sum of two numbers as written; `difference` undoes it."""
    with localcontext(prec=1200):
        return _text(Decimal(repr(float(first))) + Decimal(repr(float(second))))


def difference(text: str, second: float) -> float:
    """Return a number's text less a number, rounded once; raises ValueError if the text is no number."""
    with localcontext(prec=1200):
        return float(Decimal(text.strip()) - Decimal(repr(float(second))))


def _text(value: Decimal) -> str:
    text = str(value)
    return text if "." in text or "E" in text else f"{text}.0"
