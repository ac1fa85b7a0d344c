"""Structural parameters of FMI 3: what an FMU is when they are set, before anything else."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from fmu_asset.archive.declared import LARGEST_ARRAY, FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuInputError

from .slots import Slot, put, value_range
from .units import IDENTITY


def configured(
    description: FmuDescription, structural: Mapping[str, float | Sequence[float]]
) -> FmuDescription:
    """Return what an FMU declares once structural parameters are set: arrays have other sizes.

    An array that changes its size keeps its start value if all its elements have the same.

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter, or is one of model exchange with states.
    FmuInputError
        If a value is no whole number or out of range, or makes an array too large.
    """
    if not structural:
        return description
    lengths = {name: _length(description, name, value) for name, value in structural.items()}
    if description.interface == "model-exchange" and description.states:
        raise BindingError(
            f"{description.path} is run by model exchange and has states; structural parameters are set in "
            "co-simulation only."
        )
    return replace(description, variables=tuple(_resized(v, lengths) for v in description.variables))


def _length(description: FmuDescription, name: str, value: float | Sequence[float]) -> int:
    variable = description.variable(name)
    if variable is None or variable.causality != "structuralParameter":
        known = [v.name for v in description.variables if v.causality == "structuralParameter"]
        raise BindingError(
            f"{description.path} has no structural parameter {name!r}; it has {', '.join(known) or 'none'}."
        )
    found = [0.0]
    label = f"The structural parameter {name}"
    put(found, Slot(0, (0,), *value_range(variable), IDENTITY, label, True, False, variable), value)
    return int(found[0])


def _resized(variable: VariableInfo, lengths: Mapping[str, int]) -> VariableInfo:
    if variable.name in lengths:
        return replace(variable, start=str(lengths[variable.name]))
    shape = tuple(
        lengths.get(str(dimension), length)
        for dimension, length in zip(variable.dimensions, variable.shape, strict=True)
    )
    if shape == variable.shape:
        return variable
    if math.prod(shape) > LARGEST_ARRAY:
        raise FmuInputError(
            f"The array {variable.name!r} would have {' x '.join(map(str, shape))} elements, more than "
            f"{LARGEST_ARRAY}; set its structural parameters to less."
        )
    values = {*(variable.start or "0").split()}
    return replace(variable, shape=shape, start=values.pop() if len(values) == 1 else "")
