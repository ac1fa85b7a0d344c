"""Units of a campaign's files, and their conversion to SI without a rounding of its own.

A power of ten is applied to the decimal text of a number before it becomes binary, so a value that is written
in microstrain comes back to the last bit.
"""

from __future__ import annotations

from decimal import Decimal, localcontext
from math import isfinite
from typing import NamedTuple

from discrepancy.campaign.records import Quantity


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
    """

    powers: dict[str, int]
    written: str
    si: str
    drawn: tuple[float, str]


UNITS = {
    Quantity.STRAIN: Units({"1": 0, "microstrain": -6, "percent": -2}, "microstrain", "1", (1e6, "µε")),
    Quantity.DISPLACEMENT: Units({"m": 0, "mm": -3, "um": -6}, "mm", "m", (1e3, "mm")),
    Quantity.VELOCITY: Units({"m/s": 0, "mm/s": -3}, "m/s", "m/s", (1.0, "m/s")),
    Quantity.ACCELERATION: Units({"m/s2": 0}, "m/s2", "m/s2", (1.0, "m/s²")),
    Quantity.SIGNAL: Units({"V": 0, "mV": -3, "1": 0}, "V", "V", (1.0, "signal")),
}
"""All that files, tables and figures know of a quantity: a new kind of sensor is one more row."""
STANDARD_GRAVITY = 9.80665
"""m/s^2 in one g, exact by definition."""


def units_of(quantity: Quantity) -> tuple[str, ...]:
    """Return the units that a quantity may be given in."""
    return (*UNITS[quantity].powers, *(("g",) if quantity is Quantity.ACCELERATION else ()))


def power_of_ten(quantity: Quantity, unit: str) -> int | None:
    """Return the power of ten from a unit to SI; None for g, which is no power of ten."""
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
        return float(text) * STANDARD_GRAVITY
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
    """Return the text of an SI value in a unit; `si_value` gives the value back exactly (not for g)."""
    power = power_of_ten(quantity, unit)
    if power is None:
        return repr(value / STANDARD_GRAVITY)
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
