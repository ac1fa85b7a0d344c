"""Conversion between the units of a binding and those of an FMU."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from fmu_asset.archive.declared import UnitInfo, VariableInfo
from fmu_asset.errors import BindingError
from reporting.units import SiConversion, conversion_of


def same_dimension(first: str, second: str) -> bool | None:
    """Return whether two units have the same dimension; None if one is not understood."""
    # without loading pint, which takes a third of a second
    if first == second:
        return True
    first_meaning = conversion_of(first)
    second_meaning = conversion_of(second)
    if first_meaning is None or second_meaning is None:
        return None
    return first_meaning.exponents == second_meaning.exponents


class Conversion(NamedTuple):
    """A conversion of units: value in the FMU = `factor` * value in the binding + `offset`."""

    factor: float
    offset: float

    def to_fmu(self, value: float) -> float:
        """Return a value of the binding in the FMU's unit."""
        return value if self == IDENTITY else self.factor * value + self.offset

    def from_fmu(self, value: float) -> float:
        """Return a value of the FMU in the binding's unit."""
        return value if self == IDENTITY else (value - self.offset) / self.factor

    def then(self, second: "Conversion") -> "Conversion":
        """Return the conversion that applies this one and then a second one."""
        offset = second.factor * self.offset + second.offset
        return Conversion(second.factor * self.factor, offset)


IDENTITY = Conversion(1.0, 0.0)


def conversion(
    unit: str, variable: VariableInfo, definitions: Sequence[UnitInfo], *, where: str
) -> Conversion:
    """Return the conversion from a binding's unit to the unit of an FMU variable.

    The binding's unit may be a display unit of the FMU, another unit that the FMU defines, or a
    common unit; they are tried in this order. A variable without a declared unit is taken to be in
    the binding's unit.

    Parameters
    ----------
    where : str
        The entry of the binding, for the message.

    Raises
    ------
    BindingError
        If the unit is unknown or of another dimension.
    """
    if variable.unit is None or unit == variable.unit:
        return IDENTITY
    display_conversion = _conversion_from_display_unit(unit, variable.unit, definitions)
    if display_conversion is not None:
        return display_conversion
    unit_conversion = between(unit, definitions, variable.unit, definitions)
    if unit_conversion is None:
        raise BindingError(
            f"{where} is in {unit!r}, but the FMU has {variable.name!r} in {variable.unit!r}, and "
            "there is no conversion between the two; state the value in "
            f"{variable.unit!r}."
        )
    return unit_conversion


def _conversion_from_display_unit(
    display_unit: str, unit: str, definitions: Sequence[UnitInfo]
) -> Conversion | None:
    """Return the conversion from a display unit to its unit, or None if it is not one."""
    definition = next(
        (unit_definition for unit_definition in definitions if unit_definition.name == unit), None
    )
    if definition is None:
        return None
    # the FMU states: displayed value = factor * value + offset
    for name, factor, offset in definition.displays:
        if name == display_unit and factor:
            return Conversion(1.0 / factor, -offset / factor)
    return None


def contradictions(definitions: Sequence[UnitInfo]) -> list[str]:
    """Return a sentence for every unit that an FMU defines otherwise than usual."""
    sentences = []
    for definition in definitions:
        common_meaning = conversion_of(definition.name)
        if common_meaning is None or definition.exponents is None:
            continue
        # Radians are a dimension in FMI, but not in SI; "1/s" and "rad/s" are mixed up everywhere.
        if definition.exponents[:-1] != common_meaning.exponents[:-1]:
            sentences.append(
                f"The unit {definition.name!r} is defined with another dimension than usual."
            )
            continue
        same_factor = math.isclose(definition.factor, common_meaning.factor, rel_tol=1e-6)
        same_offset = math.isclose(
            definition.offset, common_meaning.offset, rel_tol=1e-6, abs_tol=1e-9
        )
        if not (same_factor and same_offset):
            sentences.append(
                f"The unit {definition.name!r} is defined with the factor {definition.factor:g} "
                f"and the offset {definition.offset:g}; usual are {common_meaning.factor:g} and "
                f"{common_meaning.offset:g}."
            )
    return sentences


def between(
    source: str | None,
    source_definitions: Sequence[UnitInfo],
    target: str | None,
    target_definitions: Sequence[UnitInfo],
) -> Conversion | None:
    """Return the conversion of a value from one unit to another; None if there is none.

    A value without a declared unit is taken to be in the other unit. Each side has its own
    definitions of units; common units need none.
    """
    if source is None or target is None:
        return IDENTITY
    source_meaning = meaning(source, source_definitions)
    target_meaning = meaning(target, target_definitions)
    if source_meaning is None or target_meaning is None:
        return IDENTITY if source == target else None
    if source_meaning == target_meaning:
        return IDENTITY
    if source_meaning.exponents != target_meaning.exponents:
        return None
    offset = (source_meaning.offset - target_meaning.offset) / target_meaning.factor
    return Conversion(source_meaning.factor / target_meaning.factor, offset)


def meaning(unit: str, definitions: Sequence[UnitInfo]) -> SiConversion | None:
    """Return the meaning of a unit in SI, as the FMU or else common use defines it.

    None if the unit is unknown.
    """
    for definition in definitions:
        if definition.name == unit and definition.exponents is not None and definition.factor:
            return SiConversion(definition.exponents, definition.factor, definition.offset)
    return conversion_of(unit)
