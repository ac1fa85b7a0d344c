"""Units: what a text such as `W/(m2.K)` means in SI, and a binding's units against those of an FMU."""

import math
import re
import tomllib
from collections import deque
from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from fmu_asset.archive.declared import BASE_UNITS, UnitInfo, VariableInfo
from fmu_asset.errors import BindingError
from fmu_asset.sentences import said

Exponents = tuple[int, ...]
"""Of kg, m, s, A, K, mol, cd, rad, as FMI orders them."""
_TOKEN = re.compile(r"\s*(?:([A-Za-zµμΩ°%]+)\^?([+-]?\d+)?|(1)|([().*/]))")


class Meaning(NamedTuple):
    """SI value = `factor` * value + `offset`, in the SI unit with these exponents."""

    exponents: Exponents
    factor: float
    offset: float = 0.0


_BASE = {
    symbol.replace("kg", "g"): Meaning(
        tuple(int(s == symbol) for s in BASE_UNITS), 1e-3 if symbol == "kg" else 1.0
    )
    for symbol in BASE_UNITS
}
_BASE["1"] = Meaning((0,) * len(BASE_UNITS), 1.0)


@cache
def _definitions() -> dict[str, Any]:
    """Return the tables of `units.toml`."""
    return tomllib.loads(Path(__file__).with_name("units.toml").read_text(encoding="utf-8"))


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
    found = list(_TOKEN.finditer(text))
    if "".join(item[0] for item in found) != text:
        return None
    tokens = deque(item.groups(default="") for item in found)
    try:
        meaning = _product(tokens)
    except (ValueError, IndexError, ArithmeticError, RecursionError):
        return None
    return None if tokens or not 0.0 < meaning.factor < math.inf else meaning


def _symbol(text: str) -> Meaning | None:
    tables = _definitions()
    defined = tables["prefixed"].get(text) or tables["plain"].get(text)
    if defined is not None:
        factor, product, *offset = (1.0, defined) if isinstance(defined, str) else defined
        same = meaning_of(product)
        assert same is not None  # the file is ours
        return Meaning(same.exponents, factor * same.factor, *offset or [same.offset])
    if text in _BASE:
        return _BASE[text]
    for prefix, factor in tables["prefixes"].items():
        rest = text.removeprefix(prefix)
        if rest != text and (rest in tables["prefixed"] or rest in _BASE) and rest != "1":
            meaning = meaning_of(rest)
            return meaning and Meaning(meaning.exponents, factor * meaning.factor)
    return None


def _product(tokens: deque[tuple[str, ...]]) -> Meaning:
    """Take a product from the beginning of the tokens; raises `ValueError` or `IndexError` if it is none."""
    exponents, factor, power = _BASE["1"].exponents, 1.0, 1
    while True:
        symbol, exponent, one, mark = tokens.popleft()
        if mark == "(":
            meaning: Meaning | None = _product(tokens)
            if tokens.popleft()[3] != ")":
                raise ValueError(mark)
        else:
            meaning = _symbol(symbol or one)
        # A temperature with an offset has no powers and takes part in no product.
        if meaning is None or meaning.offset:
            raise ValueError(symbol)
        own = power * int(exponent or 1)
        exponents = tuple(a + own * b for a, b in zip(exponents, meaning.exponents, strict=True))
        factor *= meaning.factor**own
        if not tokens or tokens[0][3] not in (".", "*", "/"):
            return Meaning(exponents, factor)
        power = -1 if tokens.popleft()[3] == "/" else 1


def same_dimension(first: str, second: str) -> bool | None:
    """Return whether two unit texts have one dimension; None if one of them is not understood."""
    one, two = meaning_of(first), meaning_of(second)
    return None if one is None or two is None else one.exponents == two.exponents


class Conversion(NamedTuple):
    """fmu value = `factor` * binding value + `offset`."""

    factor: float
    offset: float

    def to_fmu(self, value: float) -> float:
        """Return a value of the binding in the FMU's unit."""
        return value if self == IDENTITY else self.factor * value + self.offset

    def from_fmu(self, value: float) -> float:
        """Return a value of the FMU in the binding's unit."""
        return value if self == IDENTITY else (value - self.offset) / self.factor

    def then(self, second: "Conversion") -> "Conversion":
        """Return one conversion for this one and another after it."""
        return Conversion(second.factor * self.factor, second.factor * self.offset + second.offset)


IDENTITY = Conversion(1.0, 0.0)


def conversion(
    unit: str, variable: VariableInfo, definitions: Sequence[UnitInfo], *, where: str
) -> Conversion:
    """Return the conversion from a binding's unit to the unit of an FMU variable.

    Display units of the FMU come first, then its other unit definitions, then common units. A variable
    without declared unit is taken in the binding's unit.

    Parameters
    ----------
    unit : str
        Unit that the binding states.
    variable : VariableInfo
        The FMU's variable.
    definitions : sequence of UnitInfo
        The FMU's unit definitions.
    where : str
        Place in the binding, for the error.

    Raises
    ------
    BindingError
        If the unit is unknown or of another dimension.
    """
    if variable.unit is None or unit == variable.unit:
        return IDENTITY
    own = next((definition for definition in definitions if definition.name == variable.unit), None)
    if own is not None:
        for name, factor, offset in own.displays:
            if name == unit and factor:  # display = factor * value + offset
                return Conversion(1.0 / factor, -offset / factor)
    found = between(unit, definitions, variable.unit, definitions)
    if found is None:
        raise BindingError(said("binding.no_conversion", where=where, unit=unit, variable=variable))
    return found


def contradictions(definitions: Sequence[UnitInfo]) -> list[str]:
    """Return a sentence for every unit that an FMU defines otherwise than everybody else does."""
    found = []
    for definition in definitions:
        common = meaning_of(definition.name)
        if common is None or definition.exponents is None:
            continue
        # Radians are a dimension in FMI, but not in SI; "1/s" and "rad/s" are mixed up everywhere.
        if definition.exponents[:-1] != common.exponents[:-1]:
            found.append(f"The unit {definition.name!r} is defined with another dimension than usual.")
        elif not (
            math.isclose(definition.factor, common.factor, rel_tol=1e-6)
            and math.isclose(definition.offset, common.offset, rel_tol=1e-6, abs_tol=1e-9)
        ):
            found.append(
                f"The unit {definition.name!r} is defined with the factor {definition.factor:g} and the "
                f"offset {definition.offset:g}; usual are {common.factor:g} and {common.offset:g}."
            )
    return found


def between(
    source: str | None,
    source_definitions: Sequence[UnitInfo],
    target: str | None,
    target_definitions: Sequence[UnitInfo],
) -> Conversion | None:
    """Return the conversion of a value from one unit to another; None if there is none.

    A value without a declared unit is taken in the other's.

    Parameters
    ----------
    source, target : str or None
        The units.
    source_definitions, target_definitions : sequence of UnitInfo
        Where each of the two is defined; common units need no definition.
    """
    if source is None or target is None:
        return IDENTITY
    begin, end = meaning(source, source_definitions), meaning(target, target_definitions)
    if begin is None or end is None:
        return IDENTITY if source == target else None
    if begin == end:
        return IDENTITY
    if begin.exponents != end.exponents:
        return None
    return Conversion(begin.factor / end.factor, (begin.offset - end.offset) / end.factor)


def meaning(unit: str, definitions: Sequence[UnitInfo]) -> Meaning | None:
    """Return what a unit means in SI; None if it is not known. Units that are defined come first."""
    for definition in definitions:
        if definition.name == unit and definition.exponents is not None and definition.factor:
            return Meaning(definition.exponents, definition.factor, definition.offset)
    return meaning_of(unit)
