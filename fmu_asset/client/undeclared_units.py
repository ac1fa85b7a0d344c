"""Variables of an FMU without a unit, which a binding states in a unit other than that of SI."""

from collections.abc import Iterator

from fmu_asset.archive.declared import FmuDescription
from reporting.units import meaning_of
from reporting.words import counted, listing

from .binding import INPUT_ROLES, Binding

_MOST_NAMED = 8
"""Variables that a sentence names; an FMU may have thousands."""


def undeclared_units_sentence(description: FmuDescription, binding: Binding) -> str:
    """Return the warning about variables whose unit only the binding states.

    The numbers of such a variable are taken as they are, in the unit of the binding. If this is the
    unit of SI, it is most likely meant; degC, mm or % may be wrong by an offset or a factor.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    binding : Binding
        The binding.

    Returns
    -------
    str
        The sentence; empty if there is no such variable.
    """
    without_unit = set()
    for variable in description.variables:
        if variable.numeric and variable.unit is None:
            without_unit |= {variable.name, *variable.elements}
    doubtful = [
        f"{name} ({unit})"
        for name, unit in dict.fromkeys(_bound_units(binding))
        if name in without_unit and not _is_unit_of_si(unit)
    ]
    if not doubtful:
        return ""
    is_one = len(doubtful) == 1
    has = "has" if is_one else "have"
    its = "its" if is_one else "their"
    return (
        f"{description.label}: {counted(len(doubtful), 'variable')} {has} no unit in the FMU, so "
        f"that {its} numbers are taken to be in the unit of the binding {binding.title}: "
        f"{listing(doubtful, most=_MOST_NAMED)}. If that is wrong, correct `unit` there."
    )


def _bound_units(binding: Binding) -> Iterator[tuple[str, str]]:
    """Yield the variables of the FMU that a binding names, each with its unit in the binding."""
    for role in INPUT_ROLES:
        for entry in binding.inputs(role).values():
            yield entry.variable, entry.unit
    for parameter in binding.parameter.values():
        yield parameter.variable, parameter.unit
    for monitor in binding.monitor.values():
        yield monitor.variable, monitor.unit
    for vector in binding.observation.values():
        yield from zip(vector.variables, vector.units, strict=True)


def _is_unit_of_si(unit: str) -> bool:
    """Return whether a unit is one of SI without prefix, or is not understood."""
    meaning = meaning_of(unit)
    return meaning is None or (meaning.factor, meaning.offset) == (1.0, 0.0)
