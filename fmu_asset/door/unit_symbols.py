"""What unit texts such as `N.m`, `kg/m3` or `W/(m2.K)` mean in SI."""

import math
import re
from functools import lru_cache
from typing import NamedTuple

Exponents = tuple[int, ...]
"""Of kg, m, s, A, K, mol, cd, rad, as FMI orders them."""


class Meaning(NamedTuple):
    """SI value = `factor` * value + `offset`, in the SI unit with these exponents."""

    exponents: Exponents
    factor: float
    offset: float = 0.0


def _of(**exponents: int) -> Exponents:
    return tuple(exponents.get(symbol, 0) for symbol in ("kg", "m", "s", "A", "K", "mol", "cd", "rad"))


_ONE = _of()
_FORCE, _PRESSURE, _ENERGY = _of(kg=1, m=1, s=-2), _of(kg=1, m=-1, s=-2), _of(kg=1, m=2, s=-2)
_POWER, _VOLTAGE = _of(kg=1, m=2, s=-3), _of(kg=1, m=2, s=-3, A=-1)
_PREFIXED: dict[str, Meaning] = {
    "g": Meaning(_of(kg=1), 1e-3),
    "m": Meaning(_of(m=1), 1.0),
    "s": Meaning(_of(s=1), 1.0),
    "A": Meaning(_of(A=1), 1.0),
    "K": Meaning(_of(K=1), 1.0),
    "mol": Meaning(_of(mol=1), 1.0),
    "cd": Meaning(_of(cd=1), 1.0),
    "rad": Meaning(_of(rad=1), 1.0),
    "Hz": Meaning(_of(s=-1), 1.0),
    "N": Meaning(_FORCE, 1.0),
    "Pa": Meaning(_PRESSURE, 1.0),
    "bar": Meaning(_PRESSURE, 1e5),
    "J": Meaning(_ENERGY, 1.0),
    "W": Meaning(_POWER, 1.0),
    "V": Meaning(_VOLTAGE, 1.0),
    "C": Meaning(_of(A=1, s=1), 1.0),
    "F": Meaning(_of(kg=-1, m=-2, s=4, A=2), 1.0),
    "Ohm": Meaning(_of(kg=1, m=2, s=-3, A=-2), 1.0),
    "H": Meaning(_of(kg=1, m=2, s=-2, A=-2), 1.0),
    "T": Meaning(_of(kg=1, s=-2, A=-1), 1.0),
    "Wb": Meaning(_of(kg=1, m=2, s=-2, A=-1), 1.0),
    "l": Meaning(_of(m=3), 1e-3),
    "L": Meaning(_of(m=3), 1e-3),
    "strain": Meaning(_ONE, 1.0),
}
_PLAIN: dict[str, Meaning] = {
    "-": Meaning(_ONE, 1.0),
    "%": Meaning(_ONE, 1e-2),
    "percent": Meaning(_ONE, 1e-2),
    "ppm": Meaning(_ONE, 1e-6),
    "microstrain": Meaning(_ONE, 1e-6),
    "min": Meaning(_of(s=1), 60.0),
    "h": Meaning(_of(s=1), 3600.0),
    "d": Meaning(_of(s=1), 86400.0),
    "t": Meaning(_of(kg=1), 1e3),
    "deg": Meaning(_of(rad=1), math.pi / 180.0),
    "rpm": Meaning(_of(rad=1, s=-1), math.pi / 30.0),
    "degC": Meaning(_of(K=1), 1.0, 273.15),
    "degF": Meaning(_of(K=1), 5.0 / 9.0, 459.67 * 5.0 / 9.0),
    "in": Meaning(_of(m=1), 0.0254),
    "ft": Meaning(_of(m=1), 0.3048),
    "kn": Meaning(_of(m=1, s=-1), 1852.0 / 3600.0),
    "lb": Meaning(_of(kg=1), 0.45359237),
    "lbf": Meaning(_FORCE, 4.4482216152605),
    "psi": Meaning(_PRESSURE, 6894.757293168361),
    "ohm": Meaning(_of(kg=1, m=2, s=-3, A=-2), 1.0),
    "Ω": Meaning(_of(kg=1, m=2, s=-3, A=-2), 1.0),
    "°C": Meaning(_of(K=1), 1.0, 273.15),
    "°": Meaning(_of(rad=1), math.pi / 180.0),
}
_PREFIXES = {
    "T": 1e12, "G": 1e9, "M": 1e6, "k": 1e3, "h": 1e2, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6,
    "µ": 1e-6, "μ": 1e-6, "micro": 1e-6, "n": 1e-9, "p": 1e-12,
}  # fmt: skip
_TOKEN = re.compile(r"\s*(?:([A-Za-zµμΩ°%]+)\^?([+-]?\d+)?|(1)|([().*/])|$)")


@lru_cache(maxsize=1024)
def meaning_of(text: str) -> Meaning | None:
    """Return what a unit text means, or None if it is not understood.

    Symbols with SI prefixes are joined by `.`, `*` or `/`; an exponent follows its symbol (`m2`, `m^2`,
    `s-1`); a `/` divides by the next symbol or parenthesis only, as in Modelica.

    Parameters
    ----------
    text : str
        Such as `kN`, `kg/m3`, `1/s`, `degC`.
    """
    single = _symbol(text)
    if single is not None:
        return single
    tokens: list[tuple[str, str, str, str]] = []
    position = 0
    while position < len(text):
        found = _TOKEN.match(text, position)
        if found is None or found.end() == position:
            return None
        symbol, exponent, one, mark = found.groups(default="")
        tokens.append((symbol, exponent, one, mark))
        position = found.end()
    meaning, rest = _product(tokens)
    return None if meaning is None or rest else meaning


def _symbol(text: str) -> Meaning | None:
    known = _PREFIXED.get(text) or _PLAIN.get(text)
    if known is not None:
        return known
    if text == "1":
        return Meaning(_ONE, 1.0)
    for prefix, factor in _PREFIXES.items():
        base = _PREFIXED.get(text.removeprefix(prefix)) if text.startswith(prefix) else None
        if base is not None:
            return Meaning(base.exponents, factor * base.factor)
    return None


_Tokens = list[tuple[str, str, str, str]]


def _product(tokens: _Tokens) -> tuple[Meaning | None, _Tokens]:
    """Return the meaning of the product at the beginning, and what follows it."""
    exponents, factor = _ONE, 1.0
    power = 1
    while True:
        meaning, tokens = _factor(tokens)
        if meaning is None:
            return None, tokens
        exponents = tuple(a + power * b for a, b in zip(exponents, meaning.exponents, strict=True))
        factor *= meaning.factor**power
        if not tokens or tokens[0][3] not in (".", "*", "/"):
            return Meaning(exponents, factor), tokens
        power = -1 if tokens[0][3] == "/" else 1
        tokens = tokens[1:]


def _factor(tokens: _Tokens) -> tuple[Meaning | None, _Tokens]:
    if not tokens:
        return None, tokens
    symbol, exponent, one, mark = tokens[0]
    if one:
        return Meaning(_ONE, 1.0), tokens[1:]
    if mark == "(":
        meaning, tokens = _product(tokens[1:])
        if meaning is None or not tokens or tokens[0][3] != ")":
            return None, tokens
        return meaning, tokens[1:]
    known = _symbol(symbol) if symbol else None
    # A temperature with an offset has no powers and takes part in no product.
    if known is None or known.offset:
        return None, tokens
    power = int(exponent or 1)
    return Meaning(tuple(power * e for e in known.exponents), known.factor**power), tokens[1:]


def same_dimension(first: str, second: str) -> bool | None:
    """Return whether two unit texts have one dimension; None if one of them is not understood."""
    one, two = meaning_of(first), meaning_of(second)
    return None if one is None or two is None else one.exponents == two.exponents
