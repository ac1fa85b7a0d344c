"""Binding files: the role of each variable of an FMU, and the unit in which the caller states it.

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

The other roles are `health` (the state of damage), `load` (other inputs), `parameter` (set before
the first step, optionally with a `value` here), `monitor` (further scalars to be recorded) and
`port` (force, displacement and velocity where another FMU can be coupled). `[record]` names
variables to be recorded in the FMU's own units, and `[limits]` says what the FMU's worker may take.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Literal, get_args

from pydantic import Field, PrivateAttr

from fmu_asset.errors import BindingError
from fmu_asset.instances.plan import Interface
from fmu_asset.worker.client import WorkerLimits
from reporting.choices import require_one_of
from reporting.formats.toml_file import Check, Number, Positive, Section, read_toml, validate
from reporting.words import comma_list

from .bound_variables import (
    InputBinding,
    ParameterBinding,
    PortBinding,
    RecordBinding,
    ScalarBinding,
    VectorBinding,
)

INPUT_ROLES = ("control", "health", "load")
"""Roles of inputs that are sent at every step, in this order; ports follow."""

StandardVersion = Literal["1.0", "2.0", "3.0"]
"""Version of FMI that a binding asks for."""

StateChoice = Literal["auto", "serialised", "replay"]
"""How `save_state` saves the state; `auto` relies on the declarations of the FMU."""

Interpolation = Literal["zero-order", "linear"]
"""Course of inputs between communication points."""

_Text = Annotated[str, Field(min_length=1)]

_HEADER_WORDS: Mapping[str, tuple[str | None, ...]] = {
    "fmi_version": (*get_args(StandardVersion), None),
    "interface": (*get_args(Interface), None),
    "interpolation": get_args(Interpolation),
    "state": get_args(StateChoice),
}
"""Words that the table `[binding]` may hold, by key."""


class BindingHeader(Section):
    """The table `[binding]`."""

    name: _Text
    """Name of the binding."""
    step_size: Positive
    """Communication step of the FMU [s]."""
    decimation: int = Field(default=1, ge=1, le=10_000_000)
    """Number of communication steps from one observation to the next. The inputs are held in
    between. If the FMU refuses one of these steps, the instance is lost."""
    start_time: Number = 0.0
    """Start of the FMU [s]."""
    stop_time: Number | None = None
    """End of the experiment, which is passed to the FMU at its start [s]; some FMUs, such as those
    of EnergyPlus, do not start without one. The asset itself does not stop there. `fmu simulate`
    passes the end of what it simulates."""
    fmi_version: StandardVersion | None = None
    """Version of FMI that the FMU must have; without this key any version is allowed."""
    interface: Interface | None = None
    """Interface by which the FMU is run; co-simulation if the FMU offers it."""
    tolerance: Positive | None = None
    """Relative tolerance of the FMU's solver, and of ours in model exchange; if absent, the one
    that the FMU declares for its default experiment, and at most 1e-6 for ours [1]."""
    interpolation: Interpolation = "zero-order"
    """Course of inputs between communication points. They are held, or they move in a straight
    line to the value of a step and reach it at the end of the step, if the FMU supports it and
    both ends are continuous."""
    structural_parameters: dict[str, Number] = Field(default_factory=dict)
    """Structural parameters of FMI 3 for co-simulation, by their names in the FMU, such as
    `{ n = 5 }` [unit of the FMU]. Inputs whose size changes are given as a whole at the first
    step."""
    state: StateChoice = "auto"
    """How `save_state` saves the state: `serialised` by the FMU, or by `replay`, which starts a new
    instance and repeats its inputs. `auto` relies on the declarations of the FMU."""
    description: str = ""
    """A line for people."""

    def checks(self) -> Iterator[Check]:
        """Yield an end that does not come after the start."""
        if self.stop_time is not None:
            sentence = (
                f"stop_time {self.stop_time:g} s must come after start_time {self.start_time:g} s"
            )
            yield self.stop_time <= self.start_time, sentence


class Binding(Section):
    """A whole binding file."""

    binding: BindingHeader
    """Name, step size and interface."""
    control: dict[str, InputBinding] = Field(default_factory=dict)
    """Inputs that the twin may choose, by the caller's names; they are sent at every step."""
    health: dict[str, InputBinding] = Field(default_factory=dict)
    """Damage, by the caller's names. It is sent at every step, or set before the initialisation if
    the FMU accepts it only there."""
    load: dict[str, InputBinding] = Field(default_factory=dict)
    """Other inputs that are sent at every step, by the caller's names."""
    observation: dict[str, VectorBinding] = Field(default_factory=dict)
    """The measured quantities; several tables follow one another."""
    parameter: dict[str, ParameterBinding] = Field(default_factory=dict)
    """Parameters, by the caller's names; they are set before the first step."""
    monitor: dict[str, ScalarBinding] = Field(default_factory=dict)
    """Further scalars to be recorded, by the caller's names."""
    port: dict[str, PortBinding] = Field(default_factory=dict)
    """The ports at which other FMUs can be coupled."""
    record: RecordBinding = Field(default_factory=RecordBinding)
    """Further variables to be recorded, in the FMU's units."""
    limits: WorkerLimits = Field(default_factory=WorkerLimits)
    """The time and memory that the worker may take, and its permissions."""
    _file: str = PrivateAttr(default="")

    @property
    def name(self) -> str:
        """Name of the binding."""
        return self.binding.name

    @property
    def title(self) -> str:
        """Name of the binding, and the file that it was read from, for messages."""
        return f"{self.name} ({self._file})" if self._file else self.name

    def with_file(self, file: str) -> "Binding":
        """Return the binding with the file that it was read from, which messages name."""
        binding = self.model_copy()
        binding._file = file
        return binding

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
        """Return the slice of the array `Observation.values` that holds an observation.

        Parameters
        ----------
        name : str
            Name of the observation in the binding.

        Raises
        ------
        BindingError
            If the binding has no such observation.
        """
        begin = 0
        for key, vector in self.observation.items():
            end = begin + len(vector.variables)
            if key == name:
                return slice(begin, end)
            begin = end
        raise BindingError(
            f"The binding {self.name} has no observation {name!r}; it has "
            f"{comma_list(self.observation)}."
        )

    def with_header(self, **changes: object) -> "Binding":
        """Return the binding with other values in its table `[binding]`.

        Only keys with a fixed set of words are checked.

        Parameters
        ----------
        **changes : object
            New values by key.

        Raises
        ------
        InvalidChoiceError
            If a word is not one of those that the table may have.
        """
        for name, allowed_words in _HEADER_WORDS.items():
            if name in changes:
                require_one_of(changes[name], allowed_words, name)
        header = self.binding.model_copy(update=changes)
        return self.model_copy(update={"binding": header})

    def with_regions(self, regions: Sequence[str]) -> "Binding":
        """Return the binding with one health input for each damage region of a wing.

        An input that the binding has for a region stays as it is. A new input has the name of its
        region. Inputs for other regions are left out.

        Parameters
        ----------
        regions : sequence of str
            Names of the regions.
        """
        names_in_binding = {entry.variable: name for name, entry in self.health.items()}
        health = {}
        for region in regions:
            variable = f"health.{region}"
            name = names_in_binding.get(variable)
            if name is None:
                health[region] = InputBinding(variable=variable, unit="1")
            else:
                health[name] = self.health[name]
        return self.model_copy(update={"health": health})

    def with_arrays(self, element_names_of: Callable[[str], Sequence[str]]) -> "Binding":
        """Return the binding with every observed or recorded array replaced by its elements.

        Parameters
        ----------
        element_names_of : callable
            Returns the names of the elements of a variable, given its name. For a scalar it returns
            a sequence that contains this name only.
        """
        monitor = {}
        for key, scalar in self.monitor.items():
            names = element_names_of(scalar.variable)
            for number, name in enumerate(names, 1):
                label = key if len(names) == 1 else f"{key}[{number}]"
                monitor[label] = scalar.model_copy(update={"variable": name})
        recorded_names: list[str] = []
        for name in self.record.variables:
            recorded_names += element_names_of(name)
        observation = {
            key: vector.by_element(element_names_of) for key, vector in self.observation.items()
        }
        return self.model_copy(
            update={
                "observation": observation,
                "monitor": monitor,
                "port": {key: port.by_element(element_names_of) for key, port in self.port.items()},
                "record": self.record.model_copy(update={"variables": tuple(recorded_names)}),
            }
        )


def load_binding(path: str | os.PathLike[str]) -> Binding:
    """Read and check a binding file.

    Parameters
    ----------
    path : path-like
        The path of the file.

    Raises
    ------
    BindingError
        If the file is missing, not TOML, has an unknown or missing key or a wrong type, or maps one
        FMU variable to two inputs. The message states all such faults of the file.
    """
    content = read_toml(os.fspath(path), BindingError, what="binding file")
    return parse_binding(content, where=str(path)).with_file(str(path))


def parse_binding(content: Mapping[str, object], *, where: str = "the binding") -> Binding:
    """Return the checked binding that the content of a TOML file describes.

    Parameters
    ----------
    content : mapping of str to object
        The tables and keys of the file.
    where : str
        The origin of the content, which begins messages: the path of the file.

    Raises
    ------
    BindingError
        As `load_binding`.
    """
    binding = validate(
        Binding, dict(content), where, BindingError, what="a binding", all_faults=True
    )
    faults = []
    if not binding.observation:
        faults.append("there is no [observation.<name>] table; say what is measured")
    user_of_variable: dict[str, str] = {}
    for role in (*INPUT_ROLES, "parameter"):
        table: Mapping[str, ScalarBinding] = getattr(binding, role)
        for key, scalar in table.items():
            label = f"{role}.{key}"
            if scalar.variable in user_of_variable:
                faults.append(
                    f"the FMU variable {scalar.variable!r} is set by both "
                    f"{user_of_variable[scalar.variable]} and {label}; keep one"
                )
            user_of_variable[scalar.variable] = label
    if faults:
        raise BindingError(f"In {where}, {'; '.join(faults)}.")
    return binding
