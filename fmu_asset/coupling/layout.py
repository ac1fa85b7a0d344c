"""A system and a binding as its components see them: what each is fed, and its own binding."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector
from fmu_asset.door.exchange import Exchange
from fmu_asset.errors import BindingError, CouplingError

from .structure import Component, Endpoint
from .wiring import ConnectedVariable, Wiring

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """A component as it is stepped.

    Attributes
    ----------
    name : str
        The component.
    ends : tuple of Endpoint
        Its outputs that are read, in the order of its binding; at least one, to see that it is alive.
    fed : dict of str to ConnectedVariable
        What feeds its inputs, by their names.
    moving : frozenset of str
        Those of them with a continuous real number at both ends.
    linear : bool
        Whether its inputs move in straight lines over a step.
    substeps : int
        Its steps in a step of the system, as calls of its asset: of several with lines, the door makes these.
    settings, constants : dict of str to float
        Parameters, and inputs that have a value from the start.
    binding : Binding
        Its own names and units.
    """

    name: str
    ends: tuple[Endpoint, ...]
    fed: dict[str, ConnectedVariable]
    moving: frozenset[str]
    linear: bool
    substeps: int
    settings: dict[str, float]
    constants: dict[str, float]
    binding: Binding


def parts_of(wiring: Wiring, exchange: Exchange, *, linear: bool = False) -> dict[str, Part]:
    """Return the components of a system as they are stepped, by name.

    Parameters
    ----------
    wiring : Wiring
        The system.
    exchange : Exchange
        A binding of its description.
    linear : bool
        Whether inputs move in straight lines where they can.

    Raises
    ------
    CouplingError
        If a component has no output.
    BindingError
        If lines are wanted, and no input can follow them.
    """
    parts = {c.name: _part(wiring, exchange, c, linear=linear) for c in wiring.structure.components}
    if linear and not any(part.linear for part in parts.values()):
        raise BindingError(
            f"The binding {exchange.binding.name} asks for linear interpolation of inputs, but no component "
            f"of the system {wiring.structure.name} has a continuous input and takes its derivatives "
            "(`canInterpolateInputs`, or model exchange); leave it out."
        )
    return parts


def _part(wiring: Wiring, exchange: Exchange, component: Component, *, linear: bool) -> Part:
    name, binding = component.name, exchange.binding

    def bound(variables: Iterable[str]) -> list[Endpoint]:
        """Return the ends at this component of variables of the system."""
        ports = [port for variable in variables for port in exchange.description.ends[variable]]  # type: ignore[attr-defined]
        return [port.end for port in ports if port.end.component == name]

    fed = {target.variable: port for target, port in wiring.feeds.items() if target.component == name}
    sources = [port.end for port in wiring.feeds.values() if port.end.component == name]
    ends = tuple(dict.fromkeys([*sources, *bound(variable.name for variable in exchange.read)]))
    ends = ends or (_any_output(wiring, name),)
    given = bound(variable.name for variable in exchange.sent)
    moving = frozenset(
        variable
        for variable, port in fed.items()
        if wiring.variable(port.end).continuous and wiring.variable(Endpoint(name, variable)).continuous
    )
    linear = (
        linear
        and wiring.declared[name].can_interpolate_inputs
        and (bool(moving) or any(wiring.variable(end).continuous for end in given))
    )
    starts: dict[str, dict[str, float]] = {"input": {}, "parameter": {}}
    for variable, number in wiring.settings[name].items():
        is_input = wiring.variable(Endpoint(name, variable)).causality == "input"
        starts["input" if is_input else "parameter"][variable] = number
    tuned = bound(item.variable for item in binding.parameter.values())

    def unit(variable: str) -> str:
        return wiring.variable(Endpoint(name, variable)).unit or "1"

    inputs = dict.fromkeys([*fed, *(end.variable for end in given), *starts["input"]])
    parameters = dict.fromkeys([*starts["parameter"], *(end.variable for end in tuned)])
    own = Binding(
        binding=Header(
            name=name,
            step_size=binding.step_size / component.substeps,
            decimation=component.substeps if linear else 1,
            interpolation="linear" if linear else "zero-order",
            start_time=binding.binding.start_time,
            interface=component.interface,
            tolerance=binding.binding.tolerance,
        ),
        limits=binding.limits,
        load={key: Input(variable=key, unit=unit(key)) for key in inputs},
        parameter={key: Parameter(variable=key, unit=unit(key)) for key in parameters},
        observation={key: Vector(variables=(key,), unit=unit(key)) for _, key in ends},
    )
    substeps = 1 if linear else component.substeps
    return Part(name, ends, fed, moving, linear, substeps, starts["parameter"], starts["input"], own)


def _any_output(wiring: Wiring, name: str) -> Endpoint:
    """Return an output to look at for a component of which nothing is asked."""
    for variable in wiring.declared[name].variables:
        if variable.causality == "output" and variable.single:
            return Endpoint(name, variable.name)
    raise CouplingError(
        f"The component {name!r} has no output of a single number, so it takes no part; leave it out."
    )
