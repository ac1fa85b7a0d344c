"""Binding files: which variable of an FMU plays which role, and in which unit the caller speaks.

A binding knows roles, not wings. It is TOML:

```toml
[binding]
name = "uav_wing"
fmi_version = "2.0"
step_size = 1.0            # s

[control.load_factor]      # what a policy chooses
variable = "load_factor"
unit = "1"

[observation.strain]       # what is measured; a list, or a pattern
variables = "strain[{1..24}]"
unit = "1"
```

The other roles are `health` (the state of damage), `load` (other inputs), `parameter` (set before the first
step, optionally with a `value` here) and `monitor` (further scalars to be recorded).
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from .errors import BindingError

INPUT_ROLES = ("control", "health", "load")
"""Roles whose variables are sent at every step, in the order in which they are sent."""

_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
_LARGEST_PATTERN = 100_000

_Text = Annotated[str, Field(min_length=1)]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Scalar(_Record):
    """One variable: its name in the FMU and the unit in which the caller gives or takes it."""

    variable: _Text
    unit: _Text


class Parameter(Scalar):
    """A parameter; `value`, in `unit`, is set at every reset unless the caller gives another."""

    value: float | None = Field(default=None, allow_inf_nan=False)


class Vector(_Record):
    """Several variables in order; a text with `{a..b}` stands for all numbers from a to b.

    `unit` is one for all variables, or one for each.
    """

    variables: tuple[_Text, ...]
    unit: _Text | tuple[_Text, ...]

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each variable."""
        return (self.unit,) * len(self.variables) if isinstance(self.unit, str) else self.unit

    @field_validator("unit", mode="before")
    @classmethod
    def _listed(cls, given: object) -> object:
        return tuple(given) if isinstance(given, list) else given

    @model_validator(mode="after")
    def _one_or_each(self) -> Self:
        if len(self.units) != len(self.variables):
            raise ValueError(
                f"`unit` must be one text, or one for each of the {len(self.variables)} variables, and "
                f"{len(self.units)} came"
            )
        return self

    @field_validator("variables", mode="before")
    @classmethod
    def _expand(cls, given: object) -> object:
        if isinstance(given, str):
            return expand(given)
        if isinstance(given, list):
            return tuple(
                name for item in given for name in (expand(item) if isinstance(item, str) else (item,))
            )
        return given

    @field_validator("variables")
    @classmethod
    def _not_empty(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if not names:
            raise ValueError("at least one variable is needed")
        return names


class Header(_Record):
    """The table `[binding]`: name, FMI version, step size [s], start time [s], a line for people."""

    name: _Text
    fmi_version: Literal["2.0"] = "2.0"
    step_size: float = Field(gt=0.0, allow_inf_nan=False)
    start_time: float = Field(default=0.0, allow_inf_nan=False)
    description: str = ""


class Binding(_Record):
    """A whole binding file.

    Attributes
    ----------
    binding : Header
        Name, FMI version, step size.
    control, health, load : dict of str to Scalar
        Inputs by role and by the caller's name.
    observation : dict of str to Vector
        What is measured, in order.
    parameter : dict of str to Parameter
        Parameters by the caller's name.
    monitor : dict of str to Scalar
        Further scalars to be recorded.
    """

    binding: Header
    control: dict[str, Scalar] = Field(default_factory=dict)
    health: dict[str, Scalar] = Field(default_factory=dict)
    load: dict[str, Scalar] = Field(default_factory=dict)
    observation: dict[str, Vector] = Field(default_factory=dict)
    parameter: dict[str, Parameter] = Field(default_factory=dict)
    monitor: dict[str, Scalar] = Field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the binding."""
        return self.binding.name

    @property
    def step_size(self) -> float:
        """Communication step size [s]."""
        return self.binding.step_size

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
        raise BindingError(
            f"The binding {self.name} has no observation {name!r}; it has {_listed(self.observation)}."
        )

    def inputs(self, role: str) -> Mapping[str, Scalar]:
        """Return the variables of one of `INPUT_ROLES` by the caller's names."""
        table: Mapping[str, Scalar] = {"control": self.control, "health": self.health, "load": self.load}[
            role
        ]
        return table


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


def load_binding(path: str | os.PathLike[str]) -> Binding:
    """Read and check a binding file.

    Parameters
    ----------
    path : path-like
        The TOML file.

    Returns
    -------
    Binding
        The binding.

    Raises
    ------
    BindingError
        If the file is missing, not TOML, has an unknown or missing key or a wrong type, or maps one
        FMU variable to two inputs.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise BindingError(f"There is no binding file {file}.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BindingError(f"The binding file {file} cannot be read ({error}).") from error
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BindingError(f"The binding file {file} is not valid TOML: {error}.") from error
    return parse_binding(content, where=str(file))


def parse_binding(content: Mapping[str, Any], *, where: str = "the binding") -> Binding:
    """Check a binding that was read from elsewhere; see `load_binding`."""
    try:
        parsed = Binding.model_validate(dict(content))
    except ValidationError as error:
        raise BindingError(f"In {where}, {_first_problem(error)}.") from error
    if not parsed.observation:
        raise BindingError(f"In {where}, there is no [observation.<name>] table; say what is measured.")
    taken: dict[str, str] = {}
    for role in (*INPUT_ROLES, "parameter"):
        table: Mapping[str, Scalar] = getattr(parsed, role)
        for key, scalar in table.items():
            here = f"{role}.{key}"
            if scalar.variable in taken:
                raise BindingError(
                    f"In {where}, the FMU variable {scalar.variable!r} is set by both "
                    f"{taken[scalar.variable]} and {here}; keep one."
                )
            taken[scalar.variable] = here
    return parsed


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    place = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"the key {place!r} is unknown; remove it or correct its spelling"
    if problem["type"] == "missing":
        return f"the key {place!r} is missing"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{place} is wrong: {message[:1].lower()}{message[1:]} (it is {problem['input']!r})"


def _listed(names: Mapping[str, object]) -> str:
    return ", ".join(names) or "none"
