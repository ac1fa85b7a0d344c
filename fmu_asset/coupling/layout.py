"""The numbers behind the names of a system: who reads what from whom, and each component's own binding."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ..binding import Binding, Header, Parameter, Scalar, Vector
from ..errors import BindingError, CouplingError
from ..units import IDENTITY, Conversion
from .roles import Roles
from .structure import Endpoint, listed
from .wiring import Port, Wiring


class Tap(NamedTuple):
    """An output of a component as it is wanted elsewhere: factor * output + offset.

    Attributes
    ----------
    component, output : int
        Numbers of the component, and of the output among those that are read of it.
    plain : bool
        Whether factor and offset are one and zero.
    factor, offset : float
        The conversion.
    delayed : bool
        Whether the value of the beginning of the step is wanted.
    """

    component: int
    output: int
    plain: bool
    factor: float
    offset: float
    delayed: bool

    def of(self, now: list[list[float]], before: list[list[float]]) -> float:
        """Return the value, from the outputs of this moment and of the beginning of the step."""
        value = (before if self.delayed else now)[self.component][self.output]
        return value if self.plain else self.factor * value + self.offset


class Layout:
    """A system and a binding, laid out in numbers.

    Parameters
    ----------
    wiring : Wiring
        The system.
    binding : Binding
        The binding.
    roles : Roles
        What its names stand for.

    Attributes
    ----------
    names : list of str
        The components; a component's number is its place here.
    substeps : list of int
        Steps of each component in a step of the system.
    order : list of int
        The components in the order of evaluation.
    groups : list of (tuple of int, bool)
        The same, cut into groups; whether a group is connected in a circle.
    feeds : list of list of (str, Tap)
        For each component, the inputs that others feed.
    observed : list of Tap
        The observations.
    monitored : dict of str to Tap
        The monitors.
    entries : dict of str to dict of str to list of (int, str, Conversion)
        For each role, for each name of the binding, the inputs that it sets.
    settings, constants : list of dict of str to float
        For each component, parameters, and inputs that have a value from the start.
    """

    def __init__(self, wiring: Wiring, binding: Binding, roles: Roles) -> None:
        self._wiring, self._binding, self._roles = wiring, binding, roles
        components = wiring.structure.components
        self.names = [component.name for component in components]
        self._number = {name: index for index, name in enumerate(self.names)}
        self.substeps = [component.substeps for component in components]
        self.order = [self._number[name] for name in wiring.schedule.order]
        self.groups = [
            (tuple(self._number[name] for name in group), circular)
            for group, circular in zip(wiring.schedule.groups, wiring.schedule.circular, strict=True)
        ]
        self._read: list[dict[str, int]] = [{} for _ in components]
        self.feeds: list[list[tuple[str, Tap]]] = [[] for _ in components]
        for feed in wiring.feeds:
            tap = self._tap(Port(feed.source, feed.conversion, feed.delayed))
            self.feeds[self._number[feed.target.component]].append((feed.target.variable, tap))
        self.observed = [self._tap(port) for port in roles.observations]
        self.monitored = {name: self._tap(port) for name, port in roles.monitors.items()}
        self.entries = {
            role: {
                name: [(self._number[p.end.component], p.end.variable, p.conversion) for p in ports]
                for name, ports in table.items()
            }
            for role, table in roles.inputs.items()
        }
        self.settings: list[dict[str, float]] = []
        self.constants: list[dict[str, float]] = []
        for name in self.names:
            own = wiring.settings[name]
            inputs = {key for key in own if wiring.variable(Endpoint(name, key)).causality == "input"}
            self.settings.append({key: value for key, value in own.items() if key not in inputs})
            self.constants.append({key: value for key, value in own.items() if key in inputs})

    def _tap(self, port: Port) -> Tap:
        index = self._number[port.end.component]
        output = self._read[index].setdefault(port.end.variable, len(self._read[index]))
        return Tap(index, output, port.conversion == IDENTITY, *port.conversion, port.delayed)

    def output_name(self, component: int, output: int) -> str:
        """Return the name of an output for people."""
        return f"{self.names[component]}.{list(self._read[component])[output]}"

    def component_binding(self, index: int) -> Binding:
        """Return the binding of one component: its own names and units.

        Raises
        ------
        CouplingError
            If it has no output.
        """
        wiring, name = self._wiring, self.names[index]

        def unit(variable: str) -> str:
            return wiring.variable(Endpoint(name, variable)).unit or "1"

        entries: list[tuple[int, str, Conversion]] = [
            entry for table in self.entries.values() for ports in table.values() for entry in ports
        ]
        inputs = [
            *(variable for variable, _ in self.feeds[index]),
            *(variable for which, variable, _ in entries if which == index),
            *self.constants[index],
        ]
        ports = [port for ports in self._roles.parameters.values() for port in ports]
        parameters = [*self.settings[index], *(p.end.variable for p in ports if p.end.component == name)]
        outputs = list(self._read[index]) or [self._any_output(name)]
        header = Header(
            name=name,
            step_size=self._binding.step_size / self.substeps[index],
            start_time=self._binding.binding.start_time,
        )
        return Binding(
            binding=header,
            load={key: Scalar(variable=key, unit=unit(key)) for key in dict.fromkeys(inputs)},
            parameter={key: Parameter(variable=key, unit=unit(key)) for key in dict.fromkeys(parameters)},
            observation={key: Vector(variables=(key,), unit=unit(key)) for key in outputs},
        )

    def _any_output(self, name: str) -> str:
        """Return an output to look at for a component of which nothing is asked."""
        for variable in self._wiring.declared[name].variables.values():
            if variable.causality == "output" and variable.kind != "String":
                return variable.name
        raise CouplingError(
            f"The component {name!r} has no numeric output, so it takes no part; leave it out."
        )

    def parameters(self, given: Mapping[str, float]) -> list[dict[str, float]]:
        """Return the parameters of each component that the binding and the caller set, in the FMU's units.

        Raises
        ------
        BindingError
            If the binding has no such parameter.
        """
        known = self._roles.parameters
        for name in given:
            if name not in known:
                raise BindingError(
                    f"The binding {self._binding.name} has no parameter {name!r}; it has {listed(known)}."
                )
        fixed = {key: item.value for key, item in self._binding.parameter.items() if item.value is not None}
        values: list[dict[str, float]] = [{} for _ in self.names]
        for key, value in {**fixed, **given}.items():
            for port in known[key]:
                number = port.conversion.to_fmu(float(value))
                values[self._number[port.end.component]][port.end.variable] = number
        return values
