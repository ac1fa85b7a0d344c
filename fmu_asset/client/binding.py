"""Binding files: which variable of an FMU plays which role, and in which unit the caller speaks.

A binding knows roles, not wings. It is TOML:

```toml
[binding]
name = "uav_wing"
step_size = 1.0            # s

[control.load_factor]      # what a policy chooses
variable = "load_factor"
unit = "1"

[observation.strain]       # what is measured; a list, or a pattern
variables = "strain[{1..24}]"
unit = "1"
```

The other roles are `health` (the state of damage), `load` (other inputs), `parameter` (set before the first
step, optionally with a `value` here), `monitor` (further scalars to be recorded) and `port` (force,
displacement and velocity where another FMU can be coupled). `[record]` names variables to be recorded in the
FMU's own units, and `[limits]` says what the FMU's worker may take.
"""

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field

from fmu_asset.errors import BindingError, said
from fmu_asset.instances.plan import Interface
from fmu_asset.worker.client import WorkerLimits
from reporting.choices import require_one_of
from reporting.toml_file import Fault, Number, Positive, Section, read_toml, validate

from .units import same_dimension

INPUT_ROLES = ("control", "health", "load")
"""Roles whose variables are sent at every step, in the order in which they are sent; ports follow."""

PORT_QUANTITIES = {
    "force": ("N", "N.m"),
    "displacement": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
}
"""What a mechanical port consists of, with its units where it is one of translation or of rotation."""

StandardVersion = Literal["1.0", "2.0", "3.0"]
"""Version of FMI that an FMU must be of."""

StateChoice = Literal["auto", "serialised", "replay"]
"""How a state is to be kept; auto trusts what the FMU declares."""

Interpolation = Literal["zero-order", "linear"]
"""How inputs go on between communication points."""

_HEADER_WORDS: Mapping[str, tuple[str | None, ...]] = {
    "fmi_version": (*get_args(StandardVersion), None),
    "interface": (*get_args(Interface), None),
    "interpolation": get_args(Interpolation),
    "state": get_args(StateChoice),
}
"""Words that the table `[binding]` may hold, by key."""

_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
_LARGEST_PATTERN = 100_000

_Text = Annotated[str, Field(min_length=1)]
_Texts = Annotated[tuple[_Text, ...], Field(strict=False)]


def _expanded(given: object) -> object:
    """Expand the patterns of a text or of a list of texts."""
    if isinstance(given, str):
        return expand(given)
    if isinstance(given, list):
        return tuple(
            name for item in given for name in (expand(item) if isinstance(item, str) else (item,))
        )
    return given


def expand(pattern: str) -> tuple[str, ...]:
    """Return the names that a pattern stands for: `a[{1..3}]` is a[1], a[2], a[3].

    Raises
    ------
    ValueError
        If a range is empty or too long, or there is more than one.
    """
    ranges = _RANGE.findall(pattern)
    if not ranges:
        return (pattern,)
    if len(ranges) > 1:
        raise ValueError(f"the pattern {pattern!r} has more than one range")
    first, last = int(ranges[0][0]), int(ranges[0][1])
    if not first <= last or last - first >= _LARGEST_PATTERN:
        raise ValueError(f"the range of {pattern!r} is empty or longer than {_LARGEST_PATTERN}")
    return tuple(_RANGE.sub(str(number), pattern) for number in range(first, last + 1))


_Names = Annotated[tuple[_Text, ...], BeforeValidator(_expanded)]


class ScalarBinding(Section):
    """One variable: its name in the FMU and the unit in which the caller gives or takes it.

    The name is that of a scalar, of one element of an FMI 3 array (`p[3]`, `a[2,1]`; from 1), or of a whole
    array, which takes as many values.
    """

    variable: _Text
    unit: _Text


class InputBinding(ScalarBinding):
    """An input with a range of its own, in `unit`, within that of the FMU."""

    minimum: Number | None = None
    maximum: Number | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield limits that are exchanged."""
        if self.minimum is not None and self.maximum is not None:
            told = f"minimum {self.minimum:g} is larger than maximum {self.maximum:g}"
            yield self.minimum > self.maximum, told

    @property
    def ends(self) -> tuple[float, float]:
        """The range in `unit`, infinite where it has no end."""
        return (
            -math.inf if self.minimum is None else self.minimum,
            math.inf if self.maximum is None else self.maximum,
        )


class ParameterBinding(InputBinding):
    """A parameter; `value`, in `unit`, is set at every reset unless the caller gives another.

    It is a text for a parameter that is one (of the unit "1"), and may be the name of an enumeration's item.
    """

    value: Number | str | None = None


class VectorBinding(Section):
    """Several variables in order; a text with `{a..b}` stands for all numbers from a to b.

    `unit` is one for all variables, or one for each.
    """

    variables: Annotated[_Names, Field(min_length=1)]
    unit: _Text | _Texts

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each variable."""
        return (self.unit,) * len(self.variables) if isinstance(self.unit, str) else self.unit

    def by_element(self, elements: Callable[[str], Sequence[str]]) -> Self:
        """Return the vector with its arrays as their elements."""
        parts = zip(self.variables, self.units, strict=True)
        pairs = [(element, unit) for name, unit in parts for element in elements(name)]
        unit = self.unit if isinstance(self.unit, str) else tuple(unit for _, unit in pairs)
        return self.model_copy(update={"variables": tuple(name for name, _ in pairs), "unit": unit})

    def faults(self) -> Iterator[Fault]:
        """Yield units that are neither one nor as many as variables."""
        count, came = len(self.variables), len(self.units)
        yield came != count, said("binding.unit_count", count=count, came=came)


class PortBinding(Section):
    """A mechanical port: where another FMU can be coupled.

    Force goes one way and motion the other: an FMU takes the force and gives displacement or velocity, or the
    other way round. Inputs are given to `FmiAsset.step` as `port={"<name>.force": ...}`, outputs are in
    `Observation.extra` under the same names.
    """

    force: VectorBinding
    displacement: VectorBinding | None = None
    velocity: VectorBinding | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield a port without motion, and units that it cannot have."""
        still = self.displacement is None and self.velocity is None
        yield still, "a port needs a displacement or a velocity beside its force"
        for name, vector in self.quantities.items():
            unit, wanted = vector.unit, " or ".join(PORT_QUANTITIES[name])
            if isinstance(unit, tuple):
                yield True, f"{name} must have one unit, and {len(unit)} came"
            else:
                wrong = [same_dimension(unit, able) for able in PORT_QUANTITIES[name]] == [
                    False,
                    False,
                ]
                yield wrong, said("binding.port_unit", name=name, vector=vector, wanted=wanted)

    @property
    def quantities(self) -> dict[str, VectorBinding]:
        """What the port has, in the order of `PORT_QUANTITIES`."""
        given = {name: getattr(self, name) for name in PORT_QUANTITIES}
        return {name: vector for name, vector in given.items() if vector is not None}

    def by_element(self, elements: Callable[[str], Sequence[str]]) -> Self:
        """Return the port with its arrays as their elements."""
        changed = {name: vector.by_element(elements) for name, vector in self.quantities.items()}
        return self.model_copy(update=changed)


class RecordBinding(Section):
    """The table `[record]`: further variables to be recorded, in the FMU's own units."""

    variables: _Names = ()


class BindingHeader(Section):
    """The table `[binding]`.

    Attributes
    ----------
    name : str
        Name of the binding.
    step_size : float
        Communication step of the FMU [s].
    decimation : int
        Communication steps between two observations; the inputs are held meanwhile.
    start_time : float
        Where the FMU begins [s].
    stop_time : float, optional
        End of the experiment that the FMU is told at its start [s]; some do not start without one. The asset
        itself does not stop there.
    fmi_version : {"1.0", "2.0", "3.0"}, optional
        What the FMU must be; any of them if absent.
    interface : {"co-simulation", "model-exchange"}, optional
        How it is run; co-simulation where it offers that.
    tolerance : float, optional
        Relative tolerance of the FMU's solver, and of ours in model exchange; if absent, what the FMU
        declares for its default experiment (ours is never looser than 1e-6 then).
    interpolation : {"zero-order", "linear"}
        How inputs go on between communication points: held, or, where the FMU can follow and both ends are
        continuous, in a straight line to the value given for a step, which they reach at its end.
    structural_parameters : dict of str to float
        Structural parameters (FMI 3) by their names in the FMU; arrays have the sizes that follow.
    state : {"auto", "serialised", "replay"}
        How `save_state` keeps the state; auto trusts what the FMU declares.
    description : str
        A line for people.
    """

    name: _Text
    step_size: Positive
    decimation: int = Field(default=1, ge=1, le=10_000_000)
    start_time: Number = 0.0
    stop_time: Number | None = None
    fmi_version: StandardVersion | None = None
    interface: Interface | None = None
    tolerance: Positive | None = None
    interpolation: Interpolation = "zero-order"
    structural_parameters: dict[str, Number] = Field(default_factory=dict)
    state: StateChoice = "auto"
    description: str = ""

    def faults(self) -> Iterator[Fault]:
        """Yield an end that does not come after the start."""
        if self.stop_time is not None:
            sentence = (
                f"stop_time {self.stop_time:g} s must come after start_time {self.start_time:g} s"
            )
            yield self.stop_time <= self.start_time, sentence


class Binding(Section):
    """A whole binding file.

    Attributes
    ----------
    binding : BindingHeader
        Name, FMI version, step size.
    control, health, load : dict of str to InputBinding
        Inputs by role and by the caller's name.
    observation : dict of str to VectorBinding
        What is measured, in order.
    parameter : dict of str to ParameterBinding
        Parameters by the caller's name.
    monitor : dict of str to ScalarBinding
        Further scalars to be recorded.
    port : dict of str to PortBinding
        Where other FMUs can be coupled.
    record : RecordBinding
        Further variables to be recorded, in the FMU's units.
    limits : WorkerLimits
        What the worker may take.
    """

    binding: BindingHeader
    control: dict[str, InputBinding] = Field(default_factory=dict)
    health: dict[str, InputBinding] = Field(default_factory=dict)
    load: dict[str, InputBinding] = Field(default_factory=dict)
    observation: dict[str, VectorBinding] = Field(default_factory=dict)
    parameter: dict[str, ParameterBinding] = Field(default_factory=dict)
    monitor: dict[str, ScalarBinding] = Field(default_factory=dict)
    port: dict[str, PortBinding] = Field(default_factory=dict)
    record: RecordBinding = Field(default_factory=RecordBinding)
    limits: WorkerLimits = Field(default_factory=WorkerLimits)

    @property
    def name(self) -> str:
        """Name of the binding."""
        return self.binding.name

    @property
    def step_size(self) -> float:
        """Communication step size [s]."""
        return self.binding.step_size

    @property
    def interval(self) -> float:
        """Time between two observations [s]."""
        return self.binding.step_size * self.binding.decimation

    def inputs(self, role: str) -> Mapping[str, InputBinding]:
        """Return the variables of one of `INPUT_ROLES` by the caller's names."""
        table: Mapping[str, InputBinding] = getattr(self, role)
        return table

    @property
    def observation_variables(self) -> tuple[str, ...]:
        """FMU variables of all observations, in the order of `Observation.values`."""
        return tuple(name for vector in self.observation.values() for name in vector.variables)

    def observation_slice(self, name: str) -> slice:
        """Return where the observation of that name stands in `Observation.values`.

        Raises
        ------
        BindingError
            If the binding has no such observation.
        """
        begin = 0
        for key, vector in self.observation.items():
            if key == name:
                return slice(begin, begin + len(vector.variables))
            begin += len(vector.variables)
        raise BindingError(said("binding.no_observation", self=self, name=name))

    def with_header(self, **changes: Any) -> "Binding":
        """Return the binding with other values in its table `[binding]`; only words are checked.

        Raises
        ------
        InvalidChoiceError
            If a word is none of those that the table may hold.
        """
        for name, allowed in _HEADER_WORDS.items():
            if name in changes:
                require_one_of(changes[name], allowed, name)
        return self.model_copy(update={"binding": self.binding.model_copy(update=changes)})

    def with_regions(self, regions: Sequence[str]) -> "Binding":
        """Return the binding for a wing with these damage regions: their health inputs, and no others.

        An input that the binding has for a region stays as it is; the others have the names of their regions.
        """
        bound = {entry.variable: (name, entry) for name, entry in self.health.items()}
        own = {region: InputBinding(variable=f"health.{region}", unit="1") for region in regions}
        health = dict(bound.get(entry.variable, (region, entry)) for region, entry in own.items())
        return self.model_copy(update={"health": health})

    def with_arrays(self, elements: Callable[[str], Sequence[str]]) -> "Binding":
        """Return the binding with every array that is observed or recorded as its elements.

        Parameters
        ----------
        elements : callable
            Names of the elements of a variable; the name itself for a scalar.
        """
        monitor = {}
        for key, scalar in self.monitor.items():
            names = elements(scalar.variable)
            for number, name in enumerate(names, 1):
                label = key if len(names) == 1 else f"{key}[{number}]"
                monitor[label] = scalar.model_copy(update={"variable": name})
        recorded = tuple(element for name in self.record.variables for element in elements(name))
        changed = {
            "observation": {
                key: vector.by_element(elements) for key, vector in self.observation.items()
            },
            "monitor": monitor,
            "port": {key: port.by_element(elements) for key, port in self.port.items()},
            "record": self.record.model_copy(update={"variables": recorded}),
        }
        return self.model_copy(update=changed)


def load_binding(path: str | os.PathLike[str]) -> Binding:
    """Read and check a binding file.

    Raises
    ------
    BindingError
        If the file is missing, not TOML, has an unknown or missing key or a wrong type, or maps one
        FMU variable to two inputs.
    """
    content = read_toml(os.fspath(path), BindingError, what="binding file")
    return parse_binding(content, where=str(path))


def parse_binding(content: Mapping[str, Any], *, where: str = "the binding") -> Binding:
    """Check a binding that was read from elsewhere; see `load_binding`."""
    parsed = validate(Binding, dict(content), where, BindingError, what="a binding")
    if not parsed.observation:
        raise BindingError(
            f"In {where}, there is no [observation.<name>] table; say what is measured."
        )
    taken: dict[str, str] = {}
    for role in (*INPUT_ROLES, "parameter"):
        table: Mapping[str, ScalarBinding] = getattr(parsed, role)
        for key, scalar in table.items():
            here = f"{role}.{key}"
            if scalar.variable in taken:
                both = f"{taken[scalar.variable]} and {here}"
                raise BindingError(said("binding.set_twice", where=where, scalar=scalar, both=both))
            taken[scalar.variable] = here
    return parsed
