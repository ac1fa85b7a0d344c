"""A binding's units against those of an FMU."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from fmu_asset.archive.declared import UnitInfo, VariableInfo
from fmu_asset.errors import BindingError, said
from reporting.units import Meaning, meaning_of


def same_dimension(first: str, second: str) -> bool | None:
    """Return whether two unit texts have one dimension; None if one of them is not understood."""
    if first == second:
        return True  # pint takes a third of a second to load
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
