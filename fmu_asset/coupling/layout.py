"""The numbers behind the names of a system: who reads what from whom, and each component's own binding."""

from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector
from fmu_asset.door.units import IDENTITY, Conversion
from fmu_asset.errors import BindingError, CouplingError

from .roles import Roles
from .structure import Endpoint, listed
from .wiring import ConnectedVariable, Wiring


class Tap(NamedTuple):
    """An output as it is wanted elsewhere: factor * output + offset.

    Attributes
    ----------
    place : int
        Where the output stands among all that are read.
    conversion : Conversion
        Factor and offset.
    delayed : bool
        Whether the value of the beginning of the step is wanted.
    """

    place: int
    conversion: Conversion
    delayed: bool


class Pick:
    """Outputs that are wanted together.

    Parameters
    ----------
    taps : sequence of Tap
        The outputs, in order.

    Attributes
    ----------
    taps : tuple of Tap
        As given.
    places : tuple of int
        Where they stand.
    """

    def __init__(self, taps: Sequence[Tap]) -> None:
        self.taps = tuple(taps)
        self.places = tuple(tap.place for tap in taps)
        # With two places or more an item getter gives a tuple, at a fraction of the cost of a loop.
        self._get = itemgetter(*self.places, 0, 0)
        self._special = [
            (position, tap) for position, tap in enumerate(taps) if tap.delayed or tap.conversion != IDENTITY
        ]

    def of(self, now: Sequence[float], before: Sequence[float]) -> list[float]:
        """Return the values, from the outputs of this moment and of the beginning of the step."""
        values = list(self._get(now)[:-2])
        for position, tap in self._special:
            values[position] = tap.conversion.to_fmu((before if tap.delayed else now)[tap.place])
        return values


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
    linear : list of bool
        For each component, whether its inputs move in straight lines over a step.
    moving : list of tuple of bool
        For each component, which of the inputs that others feed do: those with a continuous real number at
        both ends.
    substeps : list of int
        Steps of each component in a step of the system, as calls of its asset.
    order : list of int
        The components in the order of evaluation.
    groups : list of (tuple of int, bool)
        The same, cut into groups; whether a group is connected in a circle.
    spans : list of slice
        For each component, where its outputs stand among all that are read.
    owner : list of int
        For each output that is read, the component.
    fed : list of (tuple of str, Pick)
        For each component, the inputs that others feed, and their values.
    observed : Pick
        The observations.
    monitored : (tuple of str, Pick)
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
        self.order = [self._number[name] for name in wiring.schedule.order]
        self.groups = [
            (tuple(self._number[name] for name in group), circular)
            for group, circular in zip(wiring.schedule.groups, wiring.schedule.circular, strict=True)
        ]
        ports = [ConnectedVariable(feed.source, feed.conversion, feed.delayed) for feed in wiring.feeds]
        self._outputs = self._read([*ports, *roles.observations, *roles.monitors.values()])
        self.spans: list[slice] = []
        self._place: dict[Endpoint, int] = {}
        for name, outputs in zip(self.names, self._outputs, strict=True):
            begin = len(self._place)
            self._place.update({Endpoint(name, o): begin + i for i, o in enumerate(outputs)})
            self.spans.append(slice(begin, len(self._place)))
        self.fed: list[tuple[tuple[str, ...], Pick]] = []
        for name in self.names:
            own = [
                (f.target.variable, p)
                for f, p in zip(wiring.feeds, ports, strict=True)
                if f.target.component == name
            ]
            self.fed.append((tuple(variable for variable, _ in own), self._pick(p for _, p in own)))
        self.owner = [self._number[end.component] for end in self._place]
        self.moving = [
            tuple(
                wiring.variable(f.source).continuous and wiring.variable(f.target).continuous
                for f in wiring.feeds
                if f.target.component == name
            )
            for name in self.names
        ]
        self.observed = self._pick(roles.observations)
        self.linear = self._linear()
        # Where inputs move over several steps, the door makes these.
        self.substeps = [
            1 if linear else c.substeps for linear, c in zip(self.linear, components, strict=True)
        ]
        self.monitored = (tuple(roles.monitors), self._pick(roles.monitors.values()))
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
            given = wiring.settings[name]
            inputs = {key for key in given if wiring.variable(Endpoint(name, key)).causality == "input"}
            self.settings.append({key: value for key, value in given.items() if key not in inputs})
            self.constants.append({key: value for key, value in given.items() if key in inputs})

    def _linear(self) -> list[bool]:
        """Return which components have inputs that move in straight lines.

        Raises
        ------
        BindingError
            If the binding asks for them, and there are none.
        """
        if self._binding.binding.interpolation == "zero-order":
            return [False] * len(self.names)
        wiring, linear = self._wiring, []
        given = {
            port.end for table in self._roles.inputs.values() for ports in table.values() for port in ports
        }
        for name, moving in zip(self.names, self.moving, strict=True):
            own = any(wiring.variable(end).continuous for end in given if end.component == name)
            linear.append(wiring.declared[name].can_interpolate_inputs and (own or any(moving)))
        if not any(linear):
            raise BindingError(
                f"The binding {self._binding.name} asks for linear interpolation of inputs, but no component "
                f"of the system {wiring.structure.name} has a continuous input and takes its derivatives "
                "(`canInterpolateInputs`, or model exchange); leave it out."
            )
        return linear

    def _read(self, ports: Iterable[ConnectedVariable]) -> list[list[str]]:
        """Return the outputs that are read of each component; at least one, to see that it is alive."""
        read: list[dict[str, None]] = [{} for _ in self.names]
        for port in ports:
            read[self._number[port.end.component]][port.end.variable] = None
        return [list(own) or [self._any_output(name)] for name, own in zip(self.names, read, strict=True)]

    def _pick(self, ports: Iterable[ConnectedVariable]) -> Pick:
        return Pick([Tap(self._place[port.end], port.conversion, port.delayed) for port in ports])

    @property
    def output_count(self) -> int:
        """Number of outputs that are read of all components."""
        return len(self._place)

    def output_name(self, place: int) -> str:
        """Return the name of an output for people."""
        return str(list(self._place)[place])

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
            *self.fed[index][0],
            *(variable for which, variable, _ in entries if which == index),
            *self.constants[index],
        ]
        ports = [port for ports in self._roles.parameters.values() for port in ports]
        parameters = [*self.settings[index], *(p.end.variable for p in ports if p.end.component == name)]
        linear = self.linear[index]
        header = Header(
            name=name,
            step_size=self._binding.step_size / wiring.structure.components[index].substeps,
            decimation=wiring.structure.components[index].substeps if linear else 1,
            interpolation="linear" if linear else "zero-order",
            start_time=self._binding.binding.start_time,
            interface=wiring.structure.component(name).interface,
            tolerance=self._binding.binding.tolerance,
        )
        return Binding(
            binding=header,
            limits=self._binding.limits,
            load={key: Input(variable=key, unit=unit(key)) for key in dict.fromkeys(inputs)},
            parameter={key: Parameter(variable=key, unit=unit(key)) for key in dict.fromkeys(parameters)},
            observation={key: Vector(variables=(key,), unit=unit(key)) for key in self._outputs[index]},
        )

    def _any_output(self, name: str) -> str:
        """Return an output to look at for a component of which nothing is asked."""
        for variable in self._wiring.declared[name].variables:
            if variable.causality == "output" and variable.single:
                return variable.name
        raise CouplingError(
            f"The component {name!r} has no output of a single number, so it takes no part; leave it out."
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
