"""The records of what an FMU declares in its model description, alike for all versions of FMI.

`model_description` makes them from what fmpy has read of the XML. Everything else in the package,
from the binding to the coupling of FMUs, works on these records and not on fmpy's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu_asset.errors import BindingError, FmuInputError, visible
from fmu_asset.instances.plan import FmuIdentity
from reporting.json_file import JsonObject

NUMERIC_KINDS = frozenset(
    {"Real", "Integer", "Enumeration", "Boolean", "Float32", "Float64"}
    | {f"{sign}{bits}" for sign in ("Int", "UInt") for bits in (8, 16, 32, 64)}
)
"""Base types of FMI whose values are numbers."""

FLOAT_KINDS = frozenset({"Real", "Float32", "Float64"})
"""Base types of FMI whose values are real numbers."""

READABLE = ("output", "local", "calculatedParameter")
"""Causalities of variables that can be the source of a connection."""

_MOST_ARRAY_ELEMENTS = 10_000_000


@dataclass(frozen=True)
class VariableInfo:
    """A variable as the FMU declares it.

    Attributes
    ----------
    reference : int
        The value reference.
    kind : str
        The base type of FMI: Real, Integer, Enumeration, Boolean, String; in FMI 3 Float64, Int32,
        Binary, ...
    causality, variability : str
        As FMI defines them.
    unit, display_unit : str or None
        Those of the variable, or else of its declared type.
    minimum, maximum : float or None
        The declared range, in `unit`.
    start : str or None
        The declared start value; for an array those of all elements, separated by blanks.
    shape : tuple of int
        The lengths of an array of FMI 3, for the start values of its structural parameters; empty
        for a scalar.
    dimensions : tuple of str or None
        For each length of the shape the name of the structural parameter that sets it; None if it
        is fixed.
    clocked : bool
        Whether the variable changes with a clock of FMI 3 only.
    items : dict of str to int
        The values of an enumeration by the names of its items.
    dependencies : tuple of str or None
        The names of the variables that an output depends on directly; None if they are not
        declared.
    """

    name: str
    reference: int
    kind: str = "Real"
    causality: str = "local"
    variability: str = "continuous"
    description: str = ""
    unit: str | None = None
    display_unit: str | None = None
    minimum: float | None = None
    maximum: float | None = None
    start: str | None = None
    shape: tuple[int, ...] = ()
    dimensions: tuple[str | None, ...] = ()
    clocked: bool = False
    items: dict[str, int] = field(default_factory=dict, hash=False)
    dependencies: tuple[str, ...] | None = None

    @property
    def size(self) -> int:
        """The number of values: 1 for a scalar."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of an array's elements, row by row and from 1; for a scalar its own name."""
        if not self.shape:
            return (self.name,)
        ranges = [range(1, length + 1) for length in self.shape]
        names = []
        for index in product(*ranges):
            numbers = ",".join(str(number) for number in index)
            names.append(f"{self.name}[{numbers}]")
        return tuple(names)

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and largest value: the declared range within that of the type.

        In C, an integer beyond the range of its type would wrap around.
        """
        low, high = self._bounds_of_type()
        if self.minimum is not None:
            low = max(low, self.minimum)
        if self.maximum is not None:
            high = min(high, self.maximum)
        return low, high

    def _bounds_of_type(self) -> tuple[float, float]:
        """Return the smallest and largest value of the base type."""
        if self.kind == "Boolean":
            return 0.0, 1.0
        if self.base_type not in ("Integer", "Enumeration"):
            return -math.inf, math.inf
        has_declared_size = self.kind not in ("Integer", "Enumeration")
        limits = np.iinfo(self.kind.lower() if has_declared_size else "int32")
        return float(limits.min), float(limits.max)

    @property
    def in_unit(self) -> str:
        """The unit with a blank before it, for a message; empty if the variable has no unit."""
        return "" if self.unit in (None, "1") else f" {self.unit}"

    def with_lengths(self, value_of_parameter: Mapping[str, int]) -> "VariableInfo":
        """Return the variable with its shape for new values of structural parameters.

        If all start values are equal, `start` becomes this single value, which applies to all
        elements of an array of any size. Different start values are kept as they are, although
        their number may not fit the new shape.

        Parameters
        ----------
        value_of_parameter : mapping of str to int
            The new values of structural parameters by their names. Lengths that depend on none of
            them do not change.

        Raises
        ------
        FmuInputError
            If a length is negative, or the array would have too many elements.
        """
        shape = []
        for parameter, length in zip(self.dimensions, self.shape, strict=True):
            if parameter is not None:
                length = value_of_parameter.get(parameter, length)
            shape.append(length)
        start = self.start
        different_values = set((start or "").split())
        if len(different_values) == 1:
            start = different_values.pop()
        return replace(self, shape=checked_shape(self.name, shape), start=start)

    @property
    def numeric(self) -> bool:
        """Whether the values of the variable are numbers."""
        return self.kind in NUMERIC_KINDS

    @property
    def base_type(self) -> str:
        """The type as FMI 2 and SSP 1.0 call it: reals and integers have no size there."""
        if self.kind in FLOAT_KINDS:
            return "Real"
        return "Integer" if self.kind.lstrip("U").startswith("Int") else self.kind

    @property
    def single(self) -> bool:
        """Whether the variable is always one number: no text, array or clocked variable."""
        return self.numeric and not self.shape and not self.clocked

    @property
    def is_text_parameter(self) -> bool:
        """Whether the variable is a parameter with one text as its value."""
        is_one_value = not self.shape and not self.clocked
        return self.kind == "String" and self.causality == "parameter" and is_one_value

    @property
    def item_list(self) -> str:
        """The items of an enumeration with their values, for a message; empty for other types."""
        return ", ".join(f"{name} = {value}" for name, value in self.items.items())

    @property
    def startable(self) -> bool:
        """Whether the start value of an output or local variable can be set at initialisation."""
        is_result = self.causality in ("output", "local")
        return is_result and self.variability != "constant" and self.start is not None

    @property
    def continuous(self) -> bool:
        """Whether the variable is a real number that may change at any time."""
        return self.kind in FLOAT_KINDS and self.variability == "continuous"


class DisplayUnit(NamedTuple):
    """A display unit: displayed value = `factor` * value + `offset`."""

    name: str
    factor: float
    offset: float


@dataclass(frozen=True)
class UnitInfo:
    """A unit as the FMU defines it: value in SI = `factor` * value + `offset`.

    Attributes
    ----------
    name : str
        The text of the unit.
    exponents : tuple of int or None
        The exponents of `BASE_UNITS`; None if the FMU does not define the unit by them.
    factor, offset : float
        The conversion to SI.
    displays : tuple of DisplayUnit
        The display units of the unit.
    """

    name: str
    exponents: tuple[int, ...] | None
    factor: float
    offset: float
    displays: tuple[DisplayUnit | tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class FmuDescription(FmuIdentity):
    """The declarations of an FMU file, in plain values that can be sent to a process.

    Attributes
    ----------
    path : Path
        The FMU file.
    shown_as : str
        The name of the FMU in messages, if not its path. The FMU of an SSP file has one, because it
        lies in a temporary folder.
    sha256 : str
        The hash of the file.
    file_size : int
        The size of the file [bytes].
    model_name, description, generation_tool : str
        The texts that the model description declares.
    platforms : tuple of str
        The folders of binaries, such as linux64.
    can_get_and_set_state, can_serialise_state, can_vary_step : bool
        The declared capabilities of `interface`.
    variables : tuple of VariableInfo
        The variables, in the order of the model description.
    units : tuple of UnitInfo
        The unit definitions.
    interfaces : tuple of str
        All interfaces that the FMU offers.
    needs_tool : bool
        Whether the FMU needs its authoring tool.
    once_per_process : bool
        Whether a process can make only one instance.
    start_time, stop_time, step_size, tolerance : float or None
        The values of the default experiment; times in s.
    fixed_step : float or None
        The internal step size that FMI 3 declares [s].
    can_interpolate_inputs : bool
        Whether inputs can change linearly between communication points: in model exchange always,
        in co-simulation if the FMU declares `canInterpolateInputs` (FMI 1 and 2).
    """

    path: Path
    shown_as: str = ""
    sha256: str = ""
    file_size: int = 0
    model_name: str = ""
    description: str = ""
    generation_tool: str = ""
    platforms: tuple[str, ...] = ()
    can_get_and_set_state: bool = False
    can_serialise_state: bool = False
    can_vary_step: bool = True
    variables: tuple[VariableInfo, ...] = ()
    units: tuple[UnitInfo, ...] = ()
    interfaces: tuple[str, ...] = ("co-simulation",)
    needs_tool: bool = False
    once_per_process: bool = False
    start_time: float | None = None
    step_size: float | None = None
    tolerance: float | None = None
    stop_time: float | None = None
    fixed_step: float | None = None
    can_interpolate_inputs: bool = False

    @property
    def label(self) -> str:
        """The name of the FMU in messages."""
        return self.shown_as or str(self.path)

    @property
    def identity(self) -> FmuIdentity:
        """The values that an instance of the FMU needs."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(FmuIdentity)}
        return FmuIdentity(**values)

    @cached_property
    def _variable_by_name(self) -> dict[str, VariableInfo]:
        return {variable.name: variable for variable in self.variables}

    def variable(self, name: str) -> VariableInfo | None:
        """Return the variable of a name, or None."""
        return self._variable_by_name.get(name)

    def hint(self, name: str) -> str:
        """Return the end of a message about an unknown name, with a similar name if any."""
        similar = get_close_matches(name, [variable.name for variable in self.variables], 1)
        return f"; did you mean {similar[0]!r}?" if similar else "."

    @cached_property
    def feedthrough(self) -> dict[str, frozenset[str]]:
        """For each variable that can feed a connection, the inputs on which it depends directly.

        According to FMI, an output without declared dependencies depends on all inputs.
        """
        names = [variable.name for variable in self.variables if variable.causality == "input"]
        all_inputs = frozenset(names)
        direct_inputs: dict[str, frozenset[str]] = {}
        for variable in self.variables:
            if variable.causality not in READABLE:
                continue
            if variable.dependencies is None:
                direct_inputs[variable.name] = all_inputs
            else:
                direct_inputs[variable.name] = all_inputs.intersection(variable.dependencies)
        return direct_inputs

    def step_of(self, step_size: float | None) -> float | None:
        """Return the communication step size [s]: the given one, else the FMU's own, else None.

        Raises
        ------
        BindingError
            If the given step size is not a positive number.
        """
        if step_size is not None and not (math.isfinite(step_size) and step_size > 0.0):
            raise BindingError(
                f"The step size must be a positive number of seconds, but {step_size:g} was given."
            )
        return step_size or self.fixed_step or self.step_size

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the unit definitions for a variable: in one FMU, all of them."""
        return self.units

    def exchange_kind(self, variable: VariableInfo) -> str:
        """Return the base type in calls that set or read a variable; enumerations are integers."""
        if variable.kind != "Enumeration":
            return variable.kind
        return "Int64" if self.major_version == 3 else "Integer"


def checked_shape(name: str, shape: Sequence[int]) -> tuple[int, ...]:
    """Return the shape of an array; refuse negative lengths and too many elements."""
    if any(length < 0 for length in shape) or math.prod(shape) > _MOST_ARRAY_ELEMENTS:
        lengths = " x ".join(str(length) for length in shape)
        raise FmuInputError(
            f"{name!r} is an array of {lengths} elements; {_MOST_ARRAY_ELEMENTS} are the most."
        )
    return tuple(shape)


def describe_fmu(description: FmuDescription) -> JsonObject:
    """Return an FMU's description as a record for JSON, as `uav-twin fmu info` prints it."""
    record = _with_visible_texts(asdict(description))
    record["path"] = str(description.path)
    record["variables"] = [
        _with_visible_texts(asdict(variable)) for variable in description.variables
    ]
    return record


def _with_visible_texts(record: Mapping[str, object]) -> JsonObject:
    """Return a record with all control characters in its texts, which a terminal obeys, escaped."""
    visible_record = {}
    for name, value in record.items():
        visible_record[name] = visible(value) if isinstance(value, str) else value
    return visible_record
