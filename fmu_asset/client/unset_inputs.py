"""Inputs of an FMU that nobody sets, so that they stay at the start values of the FMU."""

from collections.abc import Collection, Iterator, Mapping

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from reporting.words import counted, listing

from .binding import INPUT_ROLES, Binding

_MOST_NAMED = 8
"""Inputs that a sentence names; an FMU may have thousands."""


def unset_inputs_sentence(
    description: FmuDescription,
    binding: Binding,
    given_names: Mapping[str, Collection[str]] | None = None,
) -> str:
    """Return the warning about inputs of an FMU that stay at their start values.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    binding : Binding
        The binding.
    given_names : mapping of str to collection of str, optional
        The names of the binding that get values, by role; by default all of the binding.

    Returns
    -------
    str
        The sentence; empty if all inputs get values.
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
    """Yield the variables of the FMU that get values: inputs of roles, and of ports."""
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
