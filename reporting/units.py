"""Conversion of units to SI, from their text, as pint knows them."""

import re
import unicodedata
from decimal import Decimal
from fractions import Fraction
from functools import cache, lru_cache
from math import pi
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pint import UnitRegistry

BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""Base units of SI and the radian, in the order of `SiConversion.exponents`."""
_PINT_MASS_UNIT = "gram"
"""Pint's base unit of mass, in place of the kilogram."""
_OTHER_PINT_BASE_UNITS = ("meter", "second", "ampere", "kelvin", "mole", "candela", "radian")
"""Pint's names of the base units after the kilogram, in the order of `BASE_UNITS`."""
_PINT_NAMES = {
    "kp": "kgf",
    "rev": "turn",
    "U": "turn",
    "%": "percent",
    "‰": "permille",
    "°": "degree",
    "°C": "degC",
    "-": "1",
}
"""Pint's names of units that pint does not know, or reads as something else."""
_LONGEST_UNIT = 40
"""Longest text of a unit, in characters; pint takes long to parse more."""
_FACTOR = re.compile(
    r"(?P<opening>\(*)"
    r"(?P<name>[^\W\d_]+|[%‰°]|1)"
    r"(?P<caret>\^?)"
    r"(?P<power>[+-]?[0-9])?"
    r"(?P<closing>\)*)"
)
"""One factor of a unit: a name and its power, with parentheses before and after it."""
_SMALLEST_FACTOR = Fraction(10) ** -150
_LARGEST_FACTOR = Fraction(10) ** 150
"""Between these factors the quotient of two units is a finite number, too."""
_WORDS_THAT_ARE_NO_UNITS = {
    "chain",
    "chains",
    "dB",
    "decade",
    "hand",
    "hands",
    "link",
    "links",
    "octave",
    "point",
    "points",
    "rod",
    "rods",
}
"""Names that pint takes for lengths and ratios, and measuring software does not."""

_ERRORS_OF_THE_PARSER = (AssertionError, AttributeError, TypeError, ArithmeticError)
"""What pint raises of texts that are not units, beside errors of its own."""


class SiConversion(NamedTuple):
    """The conversion of a unit to SI: SI value = `factor` * value + `offset`.

    Attributes
    ----------
    exponents : tuple of int
        The exponents of `BASE_UNITS` in the SI unit.
    factor, offset : float
        The factor and the offset, in this SI unit.
    """

    exponents: tuple[int, ...]
    factor: float
    offset: float = 0.0


class ExactSiConversion(NamedTuple):
    """The conversion of a unit in fractions, see `SiConversion`."""

    exponents: tuple[int, ...]
    factor: Fraction
    offset: Fraction


def _conversion(factor: float, **exponents: int) -> SiConversion:
    """Return the conversion of a unit from its factor and the exponents of its base units."""
    return SiConversion(tuple(exponents.get(base, 0) for base in BASE_UNITS), factor)


_COMMON_UNITS = {
    "1": _conversion(1.0),
    "%": _conversion(0.01),
    "microstrain": _conversion(1e-6),
    "m": _conversion(1.0, m=1),
    "mm": _conversion(1e-3, m=1),
    "kg": _conversion(1.0, kg=1),
    "g": _conversion(1e-3, kg=1),
    "s": _conversion(1.0, s=1),
    "Hz": _conversion(1.0, s=-1),
    "1/s": _conversion(1.0, s=-1),
    "N": _conversion(1.0, kg=1, m=1, s=-2),
}
"""Units of nearly every FMU; pint takes long to import."""


@cache
def _known_units() -> "UnitRegistry[float]":
    """Return pint's registry of units, with factors as fractions.

    Pi is the fraction that the floating-point number has.
    """
    import pint

    known_units: UnitRegistry[float] = pint.UnitRegistry(
        None, non_int_type=Fraction, on_redefinition="ignore"
    )
    known_units.load_definitions(Path(pint.__file__).with_name("default_en.txt"))
    known_units.define(f"pi = {Decimal(pi)} = π")
    known_units.define("@alias ohm = Ohm")
    return known_units


def _pint_expression(unit: str, *, gravity: bool) -> str:
    """Return a unit in the notation of pint.

    Names with SI prefixes are joined by `.`, `*`, `/` or a blank. A power follows its name (`m2`,
    `m^2`, `s-1`, `m**2`). A power of 0 is refused, and a power of 1 is accepted as `^1` only,
    because `A0` and `N1` are usually names of pins and gauges. A `/` divides by the next name or
    parenthesis only, as in Modelica.

    Parameters
    ----------
    unit : str
        The name of the unit.
    gravity : bool
        Whether g is an acceleration, not a mass.

    Raises
    ------
    ValueError
        If the unit is not a product of names and powers.
    """
    text = unicodedata.normalize("NFKC", unit.strip()[:_LONGEST_UNIT]).replace("**", "^")
    if len(unit) > _LONGEST_UNIT or len(text) > _LONGEST_UNIT:
        raise ValueError(f"{unit!r} is not a unit")
    text = _PINT_NAMES.get(text, text)
    if text == "1":
        return text
    # The group keeps the operators: factors have even indices, operators odd ones.
    tokens = re.split(r"\s*([*/.·⋅]|\s)\s*", text)
    factors = tokens[0::2]
    operators = tokens[1::2]
    expression = ""
    for index, factor_text in enumerate(factors):
        factor = _FACTOR.fullmatch(factor_text)
        is_dividend = operators[index : index + 1] == ["/"]
        if factor is None:
            raise ValueError(f"{unit!r} is not a unit")
        if not _is_unit_with_power(factor, is_first=index == 0, is_dividend=is_dividend):
            raise ValueError(f"{unit!r} is not a unit")
        if index > 0:
            expression += "/" if operators[index - 1] == "/" else "*"
        expression += _pint_factor(factor, gravity=gravity)
    return expression


def _is_unit_with_power(factor: re.Match[str], *, is_first: bool, is_dividend: bool) -> bool:
    """Return whether a factor can belong to a unit.

    A power of 0 or 1 without a caret is the number of a pin, gauge or channel: `A0`, `N1`. The
    number 1 is a factor only if it begins a quotient: `1/s`, `m.(1/s)`; `12` or `m 1` are no units.

    Parameters
    ----------
    factor : re.Match
        The factor, as a match of `_FACTOR`.
    is_first : bool
        Whether the factor is the first of the unit.
    is_dividend : bool
        Whether the next operator divides the factor.
    """
    has_caret = bool(factor["caret"])
    if factor["name"] == "1":
        has_power = has_caret or factor["power"] is not None
        begins_quotient = is_first or bool(factor["opening"])
        return not has_power and is_dividend and begins_quotient
    if factor["name"] in _WORDS_THAT_ARE_NO_UNITS:
        return False
    if factor["power"] is None:
        return not has_caret
    power = int(factor["power"])
    if power == 1:
        return has_caret
    return power != 0


def _pint_factor(factor: re.Match[str], *, gravity: bool) -> str:
    """Return a factor of a unit in the notation of pint."""
    name = _PINT_NAMES.get(factor["name"], factor["name"])
    # Nm and Nmm are products; pint would look for a unit of this name.
    name = re.sub(r"^([kMm]?N)([cm]?m)$", r"\1*\2", name)
    if gravity:
        name = re.sub(r"^([mμ]?)g$", r"\1g_0", name)
    if factor["power"] is not None:
        name = f"({name})**{factor['power']}"
    return factor["opening"] + name + factor["closing"]


@cache
def exact_conversion(unit: str, *, gravity: bool = False) -> ExactSiConversion:
    """Return the conversion of a unit to SI, with exact fractions.

    `_pint_expression` describes how a unit may be written. The angle has a base unit of its own,
    rad, and a hertz is not taken for 1 rad/s.

    Parameters
    ----------
    unit : str
        The unit, such as `kN`, `kg/m3`, `W/(m2.K)`, `1/s`, `degC`, `N mm`.
    gravity : bool
        Whether g is an acceleration, not a mass.

    Raises
    ------
    ValueError
        If pint does not know the unit, it cannot be expressed in SI, or its factor exceeds the
        range of floating-point numbers.
    """
    text = _pint_expression(unit, gravity=gravity)
    from pint.errors import PintError

    known_units = _known_units()
    try:
        parsed = known_units.parse_units(text)
        # pint's root units are the base units of SI, but for the gram in place of the kilogram
        factor_to_root_units, root_units = known_units.get_root_units(parsed)
        offset = known_units.Quantity(Fraction(0), parsed).to_root_units().magnitude
    except (PintError, TokenError, *_ERRORS_OF_THE_PARSER) as cause:
        raise ValueError(f"{unit!r} is not a unit") from cause
    exponent_of_unit: dict[str, Any] = dict(root_units._units)
    mass_exponent = exponent_of_unit.pop(_PINT_MASS_UNIT, 0)
    other_exponents = [exponent_of_unit.pop(name, 0) for name in _OTHER_PINT_BASE_UNITS]
    exponents = (mass_exponent, *other_exponents)
    has_other_units = bool(exponent_of_unit)  # such as bit or currency
    if has_other_units or any(exponent != int(exponent) for exponent in exponents):
        raise ValueError(f"{unit!r} is not an SI unit")
    kilograms_per_root_unit = 1 / Fraction(1000) ** int(mass_exponent)
    factor = Fraction(str(factor_to_root_units)) * kilograms_per_root_unit
    if not _SMALLEST_FACTOR < abs(factor) < _LARGEST_FACTOR:
        raise ValueError(f"{unit!r} is beyond the numbers of a computer")
    return ExactSiConversion(
        tuple(int(exponent) for exponent in exponents), factor, Fraction(offset)
    )


@lru_cache(maxsize=1024)
def conversion_of(unit: str) -> SiConversion | None:
    """Return the conversion of a unit to SI, or None if `exact_conversion` refuses it."""
    if unit in _COMMON_UNITS:
        return _COMMON_UNITS[unit]
    try:
        exponents, factor, offset = exact_conversion(unit)
        return SiConversion(exponents, float(factor), float(offset))
    except (ValueError, OverflowError):
        return None
