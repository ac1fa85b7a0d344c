"""Units of a campaign's files as pint knows them, and their conversion to SI."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from discrepancy.campaign.records import Quantity
from reporting.units import exact_conversion
from reporting.words import listing

_TABLES = Path(__file__).with_suffix(".toml")
NEVER_CONVERTED = {"degC", "°C", "K"}
"""Units of temperature; all temperatures of a campaign are in degC, or all in K."""
FAHRENHEIT = "degF"
DEGREES = {"degC": (1.0, 0.0), "°C": (1.0, 0.0), "K": (1.0, 273.15), FAHRENHEIT: (5.0 / 9.0, 32.0)}
"""Units of temperature in tables: one degree of each in degC, and its reading at 0 degC."""
LETTERS_OF_DEGREES = {"F": FAHRENHEIT, "C": "degC"}
"""Letters that mean degrees where they stand beside a temperature; else C is a charge."""

_NAMES_OF_LOGGERS = {
    "microstrain": "uE µE μE ue uStrain ustrain 1e-6 1E-6 10^-6",
    "g": "G Gs",
    "lbf": "lb lbs Lbs LBS Lbf",
    "rpm": "RPM Rpm",
    "degC": "DegC Celsius celsius",
    "K": "Kelvin kelvin degK DegK °K",
    FAHRENHEIT: "DegF Fahrenheit fahrenheit °F",
    "s": "Sec sec SEC secs Seconds",
    "ms": "msec",
    "V": "Volts",
    "deg": "Deg",
    "N": "Newtons",
    "kN": "KN",
    "inch": "inches Inches",
}
_NAMES_WITH_BLANKS = {
    f"{degrees} {letter}": unit
    for letter, unit in (("C", "degC"), ("K", "K"), ("F", FAHRENHEIT))
    for degrees in ("deg", "Deg", "degrees")
}
LOGGER_NAMES = _NAMES_WITH_BLANKS | {
    name: unit for unit, names in _NAMES_OF_LOGGERS.items() for name in names.split()
}
"""Names of units that loggers write and pint does not know, or knows as something else."""


class Units(NamedTuple):
    """Units of a quantity.

    Attributes
    ----------
    usual : tuple of str
        The units that messages suggest; pint knows more.
    written : str
        The unit in which a campaign is written to files.
    si : str
        The unit of values in memory; nominal for a signal.
    drawn : tuple of float and str
        The factor from SI, and unit, in figures.
    foreign : mapping of str to float
        The further units that instruments show, and what one of each is in SI.
    """

    usual: Sequence[str]
    written: str
    si: str
    drawn: tuple[float, str]
    foreign: Mapping[str, float] = MappingProxyType({})


UNITS = {
    Quantity(name): Units(**row) for name, row in tomllib.loads(_TABLES.read_text("utf-8")).items()
}
"""The units of each quantity; a new kind of sensor is a further table in `units.toml`."""


def usual_name(unit: str) -> str:
    """Return a unit as pint calls it, such as degC for a logger's Celsius."""
    return LOGGER_NAMES.get(unit, unit)


@cache
def conversion_factor(unit: str, si: str) -> float:
    """Return the factor from a unit to a unit of SI: 0.001 from mm to m.

    Units of angle and plain numbers do not convert into each other, and neither do hertz and rad/s.
    The letter `g` is the standard gravity if the SI unit is that of acceleration, else a gram.

    Parameters
    ----------
    unit : str
        The unit, as a file or a logger writes it.
    si : str
        The SI unit of the quantity.

    Raises
    ------
    ValueError
        If pint does not know the unit, or it belongs to another quantity.
    """
    unit = usual_name(unit)
    if unit == si:
        return 1.0  # without pint, which takes a third of a second to load
    # acceleration is the only quantity for which `g` is the standard gravity, and not a gram
    gravity = si == UNITS[Quantity.ACCELERATION].si
    dimension, factor, _ = exact_conversion(unit, gravity=gravity)
    si_dimension, si_factor, _ = exact_conversion(si, gravity=gravity)
    if dimension != si_dimension:
        raise ValueError(f"{unit!r} cannot become {si}")
    return float(factor / si_factor)


def quantity_with_unit(quantity: Quantity) -> str:
    """Return a quantity with its SI unit for a sentence, such as "displacement in m"."""
    name = quantity.value.replace("_", " ")
    si = UNITS[quantity].si
    return f"{name} without a unit" if si == "1" else f"{name} in {si}"


@cache
def factor_to_si(quantity: Quantity, unit: str) -> float:
    """Return the factor from a unit to the SI unit of a quantity.

    The factor of a temperature is that of its differences, see `DEGREES`.

    Raises
    ------
    ValueError
        If the quantity is not measured in that unit; the message names its usual units.
    """
    try:
        return _factor_to_si(quantity, unit)
    except ValueError:
        usual = listing(UNITS[quantity].usual, "or")
        name = quantity.value.replace("_", " ")
        raise ValueError(
            f"{name} must have a unit such as {usual}, but {unit!r} was given"
        ) from None


def _factor_to_si(quantity: Quantity, unit: str) -> float:
    """Return the factor from a unit to the SI unit of a quantity.

    A signal may be a plain number. Raises `ValueError` if the quantity is not measured in that
    unit, with or without a message.
    """
    if quantity is Quantity.TEMPERATURE:
        if usual_name(unit) not in DEGREES:
            raise ValueError
        degree, _ = DEGREES[usual_name(unit)]
        return degree
    if quantity is Quantity.STRAIN and re.search(r"V|[Vv]olt", unit):
        raise ValueError  # the output of a bridge is not a strain before its gauge factor is known
    if quantity is Quantity.SIGNAL:
        with suppress(ValueError):
            return conversion_factor(unit, "1")
    return conversion_factor(unit, UNITS[quantity].si)


def amount_in_si(amount: str | float, factor: float) -> float:
    """Return an amount times a factor to SI as one would write it: 85 times 1e-6 is 8.5e-05.

    The product of the two binary numbers would be 8.499999999999999e-05.
    """
    return float(Decimal(str(amount)) * Decimal(str(factor)))


@cache
def quantities_of(unit: str) -> tuple[Quantity, ...]:
    """Return the quantities that are measured in a unit; none if pint does not know the unit."""
    quantities = []
    for quantity in Quantity:
        with suppress(ValueError):
            factor_to_si(quantity, unit)
            quantities.append(quantity)
    return tuple(quantities)
