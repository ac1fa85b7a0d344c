"""Units of a campaign's files as pint knows them, and their conversion to SI."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from discrepancy.campaign.records import Quantity
from reporting.units import exact_meaning
from reporting.words import listing

_TABLES = Path(__file__).with_suffix(".toml")
NEVER_CONVERTED = {"degC", "°C", "K"}
"""Temperatures: a campaign has one of the two for all."""

LOGGER_NAMES = {
    "uE": "microstrain", "µE": "microstrain", "μE": "microstrain", "ue": "microstrain",
    "uStrain": "microstrain", "ustrain": "microstrain", "1e-6": "microstrain", "1E-6": "microstrain",
    "10^-6": "microstrain", "G": "g", "Gs": "g", "lb": "lbf", "lbs": "lbf", "Lbs": "lbf", "LBS": "lbf",
    "Lbf": "lbf", "RPM": "rpm",
    "Rpm": "rpm", "deg C": "degC", "Deg C": "degC", "DegC": "degC", "degrees C": "degC", "Celsius": "degC",
    "Sec": "s", "sec": "s", "SEC": "s", "secs": "s", "Seconds": "s", "msec": "ms", "Volts": "V", "Deg": "deg",
    "Newtons": "N", "KN": "kN", "inches": "inch", "Inches": "inch",
}  # fmt: skip
"""Names of units that loggers write and pint does not know, or knows as something else."""


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
    foreign : mapping of str to float
        Units that instruments show besides, and what one of them is in SI.
    """

    usual: Sequence[str]
    written: str
    si: str
    drawn: tuple[float, str]
    foreign: Mapping[str, float] = MappingProxyType({})


UNITS = {Quantity(name): Units(**row) for name, row in tomllib.loads(_TABLES.read_text("utf-8")).items()}
"""Of each quantity: a new kind of sensor is one more table in `units.toml`."""


@cache
def conversion(unit: str, si: str) -> float:
    """Return what one of a unit is in a unit of SI; an angle is no number here, and a hertz no rad/s.

    Raises
    ------
    ValueError
        pint does not know the unit, or it is of another quantity.
    """
    unit = LOGGER_NAMES.get(unit, unit)
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
        if quantity is Quantity.TEMPERATURE and LOGGER_NAMES.get(unit, unit) in NEVER_CONVERTED:
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
