"""Units of a campaign's files as pint knows them, and their conversion to SI."""

import re
from contextlib import suppress
from functools import cache
from typing import NamedTuple

from discrepancy.campaign.records import Quantity
from reporting.units import exact_meaning
from reporting.words import listing

STANDARD_GRAVITY = 9.80665
"""m/s^2 in one g, exact by definition."""
_NEVER_CONVERTED = {"degC", "°C", "K"}
"""Temperatures: a campaign has one of the two for all."""


class Units(NamedTuple):
    """Units of a quantity.

    Attributes
    ----------
    usual : tuple of str
        Those of files that a user is told of; pint knows more.
    written : str
        The one in which a campaign is written.
    si : str
        That of values in memory; of a signal it is nominal.
    drawn : tuple of float and str
        Factor from SI, and unit, in figures.
    """

    usual: tuple[str, ...]
    written: str
    si: str
    drawn: tuple[float, str]


UNITS = {
    Quantity.STRAIN: Units(("1", "microstrain", "percent"), "microstrain", "1", (1e6, "µε")),
    Quantity.DISPLACEMENT: Units(("m", "mm", "um"), "mm", "m", (1e3, "mm")),
    Quantity.VELOCITY: Units(("m/s", "mm/s", "km/h"), "m/s", "m/s", (1.0, "m/s")),
    Quantity.ACCELERATION: Units(("m/s2", "mm/s2", "g"), "m/s2", "m/s2", (1.0, "m/s²")),
    Quantity.SIGNAL: Units(("V", "mV", "1"), "V", "V", (1.0, "signal")),
    Quantity.ANGLE: Units(("rad", "mrad", "deg"), "rad", "rad", (1.0, "rad")),
    Quantity.ANGULAR_VELOCITY: Units(("rad/s", "deg/s", "rpm"), "rad/s", "rad/s", (1.0, "rad/s")),
    Quantity.ANGULAR_ACCELERATION: Units(("rad/s2", "deg/s2"), "rad/s2", "rad/s2", (1.0, "rad/s²")),
    Quantity.FORCE: Units(("N", "mN", "kN"), "N", "N", (1.0, "N")),
    Quantity.TORQUE: Units(("N m", "mN m", "kN m"), "N m", "N m", (1.0, "N m")),
    Quantity.PRESSURE: Units(("Pa", "hPa", "kPa", "bar", "mbar", "MPa"), "Pa", "Pa", (1e-3, "kPa")),
    Quantity.LEVEL: Units(("m", "cm", "mm"), "m", "m", (1.0, "m")),
    Quantity.FLOW: Units(("m3/s", "l/s", "l/min", "m3/h"), "m3/s", "m3/s", (1.0, "m³/s")),
    Quantity.TEMPERATURE: Units(("degC", "K"), "degC", "degC", (1.0, "°C")),
    Quantity.HEAT: Units(("W", "mW", "kW"), "W", "W", (1.0, "W")),
    Quantity.VOLTAGE: Units(("V", "mV", "kV"), "V", "V", (1.0, "V")),
    Quantity.CURRENT: Units(("A", "mA"), "A", "A", (1.0, "A")),
    Quantity.CHARGE: Units(("C", "mC", "A h"), "C", "C", (1.0, "C")),
}
"""All that files, tables and figures know of a quantity: a new kind of sensor is one more row."""


@cache
def conversion(unit: str, si: str) -> float:
    """Return what one of a unit is in a unit of SI; an angle is no number here, and a hertz no rad/s.

    Raises
    ------
    ValueError
        pint does not know the unit, or it is of another quantity.
    """
    if unit == si:
        return 1.0  # pint takes a third of a second to load
    gravity = si == UNITS[Quantity.ACCELERATION].si
    (dimension, one, _), (wanted, other, _) = (exact_meaning(text, gravity=gravity) for text in (unit, si))
    if dimension != wanted:
        raise ValueError(f"{unit!r} cannot become {si}")
    return float(one / other)


@cache
def conversion_of(quantity: Quantity, unit: str) -> float:
    """Return what one of a quantity's unit is in SI; raises ValueError with what is expected."""
    try:
        if quantity is Quantity.TEMPERATURE and unit in _NEVER_CONVERTED:
            return 1.0
        if quantity is Quantity.TEMPERATURE:
            raise ValueError
        if quantity is Quantity.STRAIN and re.search(r"V|[Vv]olt", unit):
            raise ValueError  # a bridge's output is no strain before its gauge factor is known
        if quantity is Quantity.SIGNAL:
            with suppress(ValueError):
                return conversion(unit, "1")
        return conversion(unit, UNITS[quantity].si)
    except ValueError:
        usual = listing(UNITS[quantity].usual, "or")
        what = quantity.value.replace("_", " ")
        raise ValueError(f"{what} must have a unit such as {usual}, and {unit!r} came") from None


@cache
def quantities_of(unit: str) -> tuple[Quantity, ...]:
    """Return the quantities that a unit can be of; none where pint does not know it."""
    found = []
    for quantity in Quantity:
        with suppress(ValueError):
            conversion_of(quantity, unit)
            found.append(quantity)
    return tuple(found)
