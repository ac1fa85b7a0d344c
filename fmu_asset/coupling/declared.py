"""What coupling needs to know of an FMU beyond its variables: direct feedthrough and enumerations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fmpy import read_model_description

from fmu_asset.archive.fmu_file import FmuDescription, VariableInfo, read_fmu
from fmu_asset.errors import FmuFileError
from fmu_asset.instances.plan import Interface
from reporting.words import one_line

READABLE = ("output", "local", "calculatedParameter")
"""Causalities of what can be the source of a connection."""


@dataclass(frozen=True)
class DeclaredFmu:
    """An FMU as coupling sees it.

    Attributes
    ----------
    description : FmuDescription
        File and variables.
    variables : mapping of str to VariableInfo
        By name.
    feedthrough : mapping of str to frozenset of str
        For each variable that can be read, the inputs that it depends on directly. An output without declared
        dependencies depends on all inputs, as FMI says.
    items : mapping of str to mapping of str to int
        Items of the variables that are enumerations.
    """

    description: FmuDescription
    variables: Mapping[str, VariableInfo]
    feedthrough: Mapping[str, frozenset[str]]
    items: Mapping[str, Mapping[str, int]]


def read_declared(path: Path, interface: Interface | None = None) -> DeclaredFmu:
    """Check an FMU and return what it declares.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the file is missing, damaged, unsafe or of a kind that cannot be flown.
    """
    description = read_fmu(path, interface)
    variables = {variable.name: variable for variable in description.variables}
    inputs = frozenset(v.name for v in description.variables if v.causality == "input")
    feedthrough = {v.name: inputs for v in description.variables if v.causality in READABLE}
    try:
        declared = read_model_description(str(path), validate=False)
        for unknown in declared.outputs:
            if unknown.variable is not None and unknown.dependencies is not None:
                known = frozenset(str(variable.name) for variable in unknown.dependencies)
                feedthrough[str(unknown.variable.name)] = known & inputs
        items = {
            str(variable.name): {str(item.name): int(item.value) for item in variable.declaredType.items}
            for variable in declared.modelVariables
            if variable.declaredType is not None and getattr(variable.declaredType, "items", None)
        }
    except Exception as error:
        raise FmuFileError(f"The model structure of {path} cannot be read ({one_line(error)}).") from error
    return DeclaredFmu(description, variables, feedthrough, items)
