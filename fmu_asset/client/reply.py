"""The reply block: all outputs of the FMU that a binding observes, monitors or records."""

from collections.abc import Sequence
from typing import NamedTuple

from .layout import BlockLayout
from .observations import OutputTable
from .resolver import BindingResolver, PortQuantity
from .units import Conversion, conversion


class _RequestedOutput(NamedTuple):
    """An output that the binding asks for.

    Attributes
    ----------
    name : str
        Name of its value for the caller.
    variable : str
        Variable of the FMU, or element of an array.
    unit : str
        Unit for the caller; empty for the FMU's own.
    label : str
        Place in the binding, for messages.
    """

    name: str
    variable: str
    unit: str
    label: str


class _ResolvedOutput(NamedTuple):
    """Position of an output in the reply block, and its unit for the caller.

    Attributes
    ----------
    position : int
        Position in the reply block.
    unit : str
        Unit for the caller.
    conversion : Conversion
        Conversion from that unit to the FMU's.
    """

    position: int
    unit: str
    conversion: Conversion


class ReplyBlock:
    """The layout of the reply block, and the outputs that are read from it.

    Parameters
    ----------
    resolver : BindingResolver
        The binding and the FMU.
    ports : sequence of PortQuantity
        Quantities of the ports.

    Attributes
    ----------
    layout : BlockLayout
        Order of the outputs.
    table : OutputTable
        Reads observations from a block.
    extra_units : dict of str to str
        Units of the extras by name.

    Raises
    ------
    BindingError
        If an output does not fit the FMU.
    """

    def __init__(self, resolver: BindingResolver, ports: Sequence[PortQuantity]) -> None:
        observations = _observations(resolver)
        extras = _extras(resolver, ports)
        requested = observations + extras
        # lay out the block
        selections = [
            resolver.find(request.variable, request.label, "output") for request in requested
        ]
        variables = [selection.variable for selection in selections]
        self.layout = BlockLayout(resolver.description, variables, begin=0)
        # units and positions of the outputs
        outputs = []
        for request, selection in zip(requested, selections, strict=True):
            unit = request.unit or selection.variable.unit or "1"
            definitions = resolver.description.units_of(selection.variable)
            place = resolver.place_in_binding(request.label)
            to_fmu = conversion(unit, selection.variable, definitions, where=place)
            outputs.append(_ResolvedOutput(self.layout.positions(selection)[0], unit, to_fmu))
        # of several extra outputs with the same name, the last one is kept
        observed_outputs = outputs[: len(observations)]
        extra_outputs: dict[str, _ResolvedOutput] = {}
        for request, output in zip(extras, outputs[len(observations) :], strict=True):
            extra_outputs[request.name] = output
        reply_outputs = [*observed_outputs, *extra_outputs.values()]
        self.table = OutputTable(
            observation_count=len(observed_outputs),
            extra_names=[*extra_outputs],
            positions=[output.position for output in reply_outputs],
            conversions=[output.conversion for output in reply_outputs],
        )
        self.extra_units = {name: output.unit for name, output in extra_outputs.items()}


def _observations(resolver: BindingResolver) -> list[_RequestedOutput]:
    """Return the outputs that are observed, in the order of the binding."""
    requested = []
    for key, vector in resolver.binding.observation.items():
        for name, unit in zip(vector.variables, vector.units, strict=True):
            requested.append(_RequestedOutput(name, name, unit, f"observation.{key}"))
    return requested


def _extras(resolver: BindingResolver, ports: Sequence[PortQuantity]) -> list[_RequestedOutput]:
    """Return the outputs that are read in addition to the observations.

    These are monitors, recorded variables and outputs of ports.
    """
    requested = []
    for name, scalar in resolver.binding.monitor.items():
        requested.append(_RequestedOutput(name, scalar.variable, scalar.unit, f"monitor.{name}"))
    for name in resolver.binding.record.variables:
        requested.append(_RequestedOutput(name, name, "", "record.variables"))
    for quantity in ports:
        if not quantity.is_read:
            continue
        names = quantity.vector.variables
        for number, variable in enumerate(names, 1):
            name = f"{quantity.name}[{number}]" if len(names) > 1 else quantity.name
            unit = quantity.vector.units[0]
            requested.append(_RequestedOutput(name, variable, unit, quantity.label))
    return requested
