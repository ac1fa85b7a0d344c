"""Units of a binding against the units that an FMU declares: checked, and converted where they differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .archive import UnitInfo, VariableInfo
from .errors import BindingError

Exponents = tuple[int, ...]
_ONE: Exponents = (0, 0, 0, 0, 0, 0, 0, 0)
# kg, m, s, A, K, mol, cd, rad
_COMMON: dict[str, tuple[Exponents, float]] = {
    "1": (_ONE, 1.0),
    "%": (_ONE, 1e-2),
    "percent": (_ONE, 1e-2),
    "microstrain": (_ONE, 1e-6),
    "m": ((0, 1, 0, 0, 0, 0, 0, 0), 1.0),
    "mm": ((0, 1, 0, 0, 0, 0, 0, 0), 1e-3),
    "m/s": ((0, 1, -1, 0, 0, 0, 0, 0), 1.0),
    "m/s2": ((0, 1, -2, 0, 0, 0, 0, 0), 1.0),
    "kg": ((1, 0, 0, 0, 0, 0, 0, 0), 1.0),
    "g": ((1, 0, 0, 0, 0, 0, 0, 0), 1e-3),
    "s": ((0, 0, 1, 0, 0, 0, 0, 0), 1.0),
    "ms": ((0, 0, 1, 0, 0, 0, 0, 0), 1e-3),
    "1/s": ((0, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "Hz": ((0, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "N": ((1, 1, -2, 0, 0, 0, 0, 0), 1.0),
    "kN": ((1, 1, -2, 0, 0, 0, 0, 0), 1e3),
    "N/m": ((1, 0, -2, 0, 0, 0, 0, 0), 1.0),
    "Pa": ((1, -1, -2, 0, 0, 0, 0, 0), 1.0),
    "MPa": ((1, -1, -2, 0, 0, 0, 0, 0), 1e6),
    "K": ((0, 0, 0, 0, 1, 0, 0, 0), 1.0),
    "rad": ((0, 0, 0, 0, 0, 0, 0, 1), 1.0),
    "V": ((1, 2, -3, -1, 0, 0, 0, 0), 1.0),
    "A": ((0, 0, 0, 1, 0, 0, 0, 0), 1.0),
}


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

    Returns
    -------
    Conversion
        Factor and offset.

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
    target = meaning(variable.unit, definitions)
    source = meaning(unit, definitions)
    if source is None or target is None or source[0] != target[0]:
        raise BindingError(
            f"{where} is in {unit!r}, but the FMU has {variable.name!r} in {variable.unit!r}, and there is "
            f"no conversion between the two; state the value in {variable.unit!r}."
        )
    # SI = factor * value + offset, for both
    return Conversion(source[1] / target[1], (source[2] - target[2]) / target[1])


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
    if begin[0] != end[0]:
        return None
    return Conversion(begin[1] / end[1], (begin[2] - end[2]) / end[1])


def meaning(unit: str, definitions: Sequence[UnitInfo]) -> tuple[Exponents, float, float] | None:
    """Return what a unit means: SI exponents, factor and offset to SI; None if it is not known.

    Units that are defined come first, then common ones.
    """
    for definition in definitions:
        if definition.name == unit and definition.exponents is not None and definition.factor:
            return definition.exponents, definition.factor, definition.offset
    if unit in _COMMON:
        exponents, factor = _COMMON[unit]
        return exponents, factor, 0.0
    return None
