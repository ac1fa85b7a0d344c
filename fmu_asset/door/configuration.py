"""Structural parameters of FMI 3: what an FMU is once they are set, before everything else."""

from dataclasses import replace

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.errors import BindingError
from fmu_asset.instances.plan import Settings

from .binding import Binding
from .layout import find
from .slots import Slot, put, value_range
from .units import IDENTITY


def configured(description: FmuDescription, binding: Binding) -> tuple[FmuDescription, Settings]:
    """Return what an FMU declares with the structural parameters of a binding, and what is set for them.

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter, or is run by model exchange.
    FmuInputError
        If a value is no whole number or out of range, or makes an array too large.
    """
    found: Settings = []
    lengths: dict[str | None, int] = {}
    for name, value in binding.binding.structural_parameters.items():
        label = f"structural_parameters.{name}"
        where = f"{label} of the binding {binding.name}"
        variable = find(description, name, where, "structuralParameter").variable
        number = [0.0]
        put(number, Slot(0, (0,), *value_range(variable), IDENTITY, label, True, False, variable), value)
        found.append((variable.kind, variable.reference, number))
        lengths[name] = int(number[0])
    if not lengths:
        return description, found
    if description.interface == "model-exchange":
        raise BindingError(
            f"{description.path} is run by model exchange; structural parameters are set in co-simulation "
            "only."
        )
    return replace(description, variables=tuple(v.resized(lengths) for v in description.variables)), found
