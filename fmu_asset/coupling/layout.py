"""A system and a binding as its components see them: what each is fed, and its own binding."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector
from fmu_asset.door.units import IDENTITY
from fmu_asset.errors import BindingError, CouplingError, FmuError

from .roles import Roles
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


class Taps:
    """Outputs that are wanted together, in the units of who wants them.

    Parameters
    ----------
    ports : iterable of ConnectedVariable
        The outputs, in order.
    place : mapping of Endpoint to int
        Where each output stands among all that are read.
    """

    def __init__(self, ports: Iterable[ConnectedVariable], place: Mapping[Endpoint, int]) -> None:
        wanted = list(ports)
        self._index = np.array([place[port.end] for port in wanted], dtype=np.intp)
        self._delayed = np.flatnonzero([port.delayed for port in wanted])
        scales = np.array([port.conversion for port in wanted]).reshape(-1, 2)
        self._scale = None if (scales == IDENTITY).all() else (scales[:, 0], scales[:, 1])

    def of(self, now: FloatArray, before: FloatArray) -> FloatArray:
        """Return the values, from all outputs of this moment and of the beginning of the step."""
        values = now[self._index]
        if self._delayed.size:
            values[self._delayed] = before[self._index[self._delayed]]
        if self._scale is not None:
            values = self._scale[0] * values + self._scale[1]
        return values


def parts_of(wiring: Wiring, binding: Binding, roles: Roles) -> dict[str, Part]:
    """Return the components of a system as they are stepped, by name.

    Parameters
    ----------
    wiring : Wiring
        The system.
    binding : Binding
        The binding.
    roles : Roles
        What its names stand for.

    Raises
    ------
    CouplingError
        If a component has no output.
    BindingError
        If the binding asks for lines, and no input can follow them.
    """
    parts = {c.name: _part(wiring, binding, roles, c) for c in wiring.structure.components}
    if binding.binding.interpolation == "linear" and not any(part.linear for part in parts.values()):
        raise BindingError(
            f"The binding {binding.name} asks for linear interpolation of inputs, but no component of the "
            f"system {wiring.structure.name} has a continuous input and takes its derivatives "
            "(`canInterpolateInputs`, or model exchange); leave it out."
        )
    return parts


def _part(wiring: Wiring, binding: Binding, roles: Roles, component: Component) -> Part:
    name = component.name
    fed = {target.variable: port for target, port in wiring.feeds.items() if target.component == name}
    read = [*wiring.feeds.values(), *roles.observations, *roles.monitors.values()]
    ends = tuple(dict.fromkeys(port.end for port in read if port.end.component == name))
    ends = ends or (_any_output(wiring, name),)
    ports = [port for table in roles.inputs.values() for ports in table.values() for port in ports]
    given = [port.end for port in ports if port.end.component == name]
    moving = frozenset(
        variable
        for variable, port in fed.items()
        if wiring.variable(port.end).continuous and wiring.variable(Endpoint(name, variable)).continuous
    )
    linear = (
        binding.binding.interpolation == "linear"
        and wiring.declared[name].can_interpolate_inputs
        and (bool(moving) or any(wiring.variable(end).continuous for end in given))
    )
    starts: dict[str, dict[str, float]] = {"input": {}, "parameter": {}}
    for variable, number in wiring.settings[name].items():
        is_input = wiring.variable(Endpoint(name, variable)).causality == "input"
        starts["input" if is_input else "parameter"][variable] = number
    tuned = [port.end for ports in roles.parameters.values() for port in ports if port.end.component == name]

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


class naming:  # noqa: N801 - cheaper than one made of a generator
    """A block in which an error of an FMU gets the name of its component."""

    def __init__(self, component: str) -> None:
        self._component = component

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, FmuError):
            sentence = f"component {self._component}: {error.sentence}"
            raise type(error)(sentence, error.messages, error.time) from error
