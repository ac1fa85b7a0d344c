"""Warnings about what a binding and its FMU leave open: unset inputs, missing units."""

from collections.abc import Collection, Iterator, Mapping

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from reporting.units import conversion_of
from reporting.words import counted, listing

from .binding import INPUT_ROLES, Binding

_MOST_NAMED = 8
"""Inputs or variables that a sentence names; an FMU may have thousands."""


def unset_inputs_sentence(
    description: FmuDescription,
    binding: Binding,
    given_names: Mapping[str, Collection[str]] | None = None,
) -> str:
    """Return the warning about inputs of an FMU that stay at their start values.

    Parameters
    ----------
    given_names : mapping of str to collection of str, optional
        The binding's names of the inputs that get values, by role; by default all of the binding.

    Returns
    -------
    str
        Empty if all inputs get values.
    """
    set_variables = set(_set_variables(binding, given_names))
    unset = []
    for variable in description.variables:
        is_set = not set_variables.isdisjoint({variable.name, *variable.elements})
        if variable.causality == "input" and variable.numeric and not is_set:
            unset.append(_with_start_value(variable))
    if not unset:
        return ""
    is_one = len(unset) == 1
    stay = "stays at its start value" if is_one else "stay at their start values"
    them = "it" if is_one else "them"
    return (
        f"{description.label}: {counted(len(unset), 'input')} {stay}, because nobody sets {them}: "
        f"{listing(unset, most=_MOST_NAMED)}. If that is not meant, name {them} in [control], "
        f"[health] or [load] of the binding {binding.title} and give values."
    )


def _set_variables(
    binding: Binding, given_names: Mapping[str, Collection[str]] | None
) -> Iterator[str]:
    """Yield the FMU's variables that get values, through roles and ports."""
    for role in INPUT_ROLES:
        for name, entry in binding.inputs(role).items():
            if given_names is None or name in given_names.get(role, ()):
                yield entry.variable
    for port in binding.port.values():
        for vector in port.quantities.values():
            yield from vector.variables


def _with_start_value(variable: VariableInfo) -> str:
    """Return an input with its start value and unit, such as "pressure (150 bar)"."""
    start = variable.start if variable.start is not None else "0"
    return f"{variable.name} ({start}{variable.in_unit})"


def undeclared_units_sentence(description: FmuDescription, binding: Binding) -> str:
    """Return the warning about variables whose unit only the binding states.

    Their numbers are taken to be in the binding's unit. In an SI unit that is most likely right; in
    degC, mm or % they may be wrong by an offset or a factor.

    Returns
    -------
    str
        Empty if there is no such variable.
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
    """Yield each variable that a binding names, with its unit in the binding."""
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
    """Return whether a unit is an SI unit without prefix, or unknown."""
    meaning = conversion_of(unit)
    return meaning is None or (meaning.factor, meaning.offset) == (1.0, 0.0)
