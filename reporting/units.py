"""What the text of a unit means in SI, as pint knows it."""

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
"""In the order of `Meaning.exponents`."""
_ROOTS = ("gram", "meter", "second", "ampere", "kelvin", "mole", "candela", "radian")
"""The same in pint, which counts in grams."""
_ALIASES = {
    "kp": "kgf", "rev": "turn", "U": "turn", "%": "percent", "‰": "permille", "°": "degree", "°C": "degC",
    "-": "1",
}  # fmt: skip
"""Names of units that pint does not know, or reads as something else."""
_LONGEST = 40
"""Letters of a unit: pint takes long over more."""
_FACTOR = re.compile(
    r"(?P<opening>\(*)(?P<name>[^\W\d_]+|[%‰°]|1)(?P<caret>\^?)(?P<power>[+-]?[0-9])?(?P<closing>\)*)"
)
"""One factor of a unit: a name and its power, and parentheses that begin before and end after it."""
_SMALLEST_FACTOR, _LARGEST_FACTOR = Fraction(10) ** -150, Fraction(10) ** 150
"""Between them quotients of two units are numbers, too."""
_WORDS = {
    "chain", "chains", "dB", "decade", "hand", "hands", "link", "links", "octave", "point", "points", "rod",
    "rods",
}  # fmt: skip
"""What pint takes for lengths and ratios, and measuring programmes do not."""


_PLAIN = {
    "1": (1.0, {}), "%": (0.01, {}), "microstrain": (1e-6, {}), "m": (1.0, {"m": 1}), "mm": (1e-3, {"m": 1}),
    "kg": (1.0, {"kg": 1}), "g": (1e-3, {"kg": 1}), "s": (1.0, {"s": 1}), "Hz": (1.0, {"s": -1}),
    "1/s": (1.0, {"s": -1}), "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
}  # fmt: skip
"""Factors and exponents of units that nearly every FMU has: pint takes long to begin."""


class Meaning(NamedTuple):
    """SI value = `factor` * value + `offset`, in the SI unit with these exponents (of `BASE_UNITS`)."""

    exponents: tuple[int, ...]
    factor: float
    offset: float = 0.0


@cache
def _known_units() -> "UnitRegistry[Any]":
    """Return the units of pint in fractions of integers; pi is that of floats, and so are its multiples."""
    import pint

    known: UnitRegistry[Any] = pint.UnitRegistry(None, non_int_type=Fraction, on_redefinition="ignore")
    known.load_definitions(Path(pint.__file__).with_name("default_en.txt"))
    known.define(f"pi = {Decimal(pi)} = π")
    known.define("@alias ohm = Ohm")
    return known


def _expression(unit: str, *, gravity: bool) -> str:
    """Return a unit as pint reads it; raises ValueError if it is not made of names and powers."""
    text = unicodedata.normalize("NFKC", unit.strip()[:_LONGEST]).replace("**", "^")
    if len(unit) > _LONGEST or len(text) > _LONGEST:
        raise ValueError(f"{unit!r} is no unit")
    text = _ALIASES.get(text, text)
    if text == "1":
        return text
    parts = re.split(r"\s*([*/.·⋅]|\s)\s*", text)
    for at in range(0, len(parts), 2):
        factor = _FACTOR.fullmatch(parts[at])
        is_divided = parts[at + 1 : at + 2] == ["/"]
        if factor is None or not _is_unit_with_power(factor, is_first=at == 0, is_divided=is_divided):
            raise ValueError(f"{unit!r} is no unit")
        parts[at] = _factor_for_pint(factor, gravity=gravity)
        if at:
            parts[at - 1] = "/" if parts[at - 1] == "/" else "*"
    return "".join(parts)


def _is_unit_with_power(factor: re.Match[str], *, is_first: bool, is_divided: bool) -> bool:
    """Return whether a factor can be of a unit.

    A digit that makes no other unit of a name is the number of a pin, gauge or channel: `A0`, `N1`. One is a
    factor only where it is divided by others: `1/s`, `m.(1/s)`; `12` or `m 1` are no units.
    """
    name, caret, power = factor["name"], factor["caret"], factor["power"]
    if name == "1":
        return not caret and power is None and is_divided and (is_first or bool(factor["opening"]))
    if name in _WORDS or (caret and power is None):
        return False
    return power is None or int(power) not in (0, 1) or (bool(caret) and int(power) == 1)


def _factor_for_pint(factor: re.Match[str], *, gravity: bool) -> str:
    """Return a factor of a unit as pint reads it."""
    name = re.sub(r"^([kMm]?N)([cm]?m)$", r"\1*\2", _ALIASES.get(factor["name"], factor["name"]))
    name = re.sub(r"^([mμ]?)g$", r"\1g_0", name) if gravity else name
    power = "" if factor["power"] is None else f"({name})**{factor['power']}"
    return factor["opening"] + (power or name) + factor["closing"]


@cache
def exact_meaning(unit: str, *, gravity: bool = False) -> tuple[tuple[int, ...], Fraction, Fraction]:
    """Return what a unit means: its exponents, and factor and offset as fractions, see `Meaning`.

    Names with SI prefixes are joined by `.`, `*`, `/` or a blank; a power follows its name (`m2`, `m^2`,
    `s-1`, `m**2`) and is not 0, and 1 only behind a caret: `A0` and `N1` are names of pins and gauges. A `/`
    divides by the next name or parenthesis only, as in Modelica. An angle is no number here, and a hertz no
    rad/s.

    Parameters
    ----------
    unit : str
        Such as `kN`, `kg/m3`, `W/(m2.K)`, `1/s`, `degC`, `N mm`.
    gravity : bool
        Whether g is an acceleration, not a mass.

    Raises
    ------
    ValueError
        If it is no unit that pint knows, none of SI, or beyond the numbers of a computer.
    """
    text = _expression(unit, gravity=gravity)
    from pint.errors import PintError

    known = _known_units()
    try:
        parsed = known.parse_units(text)
        factor, roots = known.get_root_units(parsed)
        offset = known.Quantity(Fraction(0), parsed).to_root_units().magnitude
    except (PintError, TokenError, AttributeError, TypeError, ArithmeticError) as cause:
        raise ValueError(f"{unit!r} is no unit") from cause
    powers: dict[str, Any] = dict(roots._units)
    exponents = tuple(powers.pop(root, 0) for root in _ROOTS)
    if powers or any(exponent != int(exponent) for exponent in exponents):
        raise ValueError(f"{unit!r} is no unit of SI")
    kilograms = int(exponents[0])
    size = Fraction(str(factor)) / Fraction(1000) ** kilograms
    if not _SMALLEST_FACTOR < abs(size) < _LARGEST_FACTOR:
        raise ValueError(f"{unit!r} is beyond the numbers of a computer")
    return tuple(int(exponent) for exponent in exponents), size, Fraction(offset)


@lru_cache(maxsize=1024)
def meaning_of(unit: str) -> Meaning | None:
    """Return what a unit means, or None if it is not understood; see `exact_meaning`."""
    if unit in _PLAIN:
        size, powers = _PLAIN[unit]
        return Meaning(tuple(powers.get(base, 0) for base in BASE_UNITS), size)
    try:
        exponents, factor, offset = exact_meaning(unit)
        return Meaning(exponents, float(factor), float(offset))
    except (ValueError, OverflowError):
        return None
