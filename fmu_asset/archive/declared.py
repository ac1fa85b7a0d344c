"""The records of what an FMU declares in its model description, alike for all versions of FMI.

`read_declared` makes them from what fmpy has read of the XML; everything else in the package, from
the binding to the coupling of FMUs, works on these records and not on fmpy's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from fmpy.model_description import (
    CoSimulation,
    DefaultExperiment,
    ModelDescription,
    ModelExchange,
    ScalarVariable,
    Unit,
)

from fmu_asset.errors import BindingError, FmuInputError, FmuUnsupportedError, visible
from fmu_asset.instances.plan import FmuIdentity, Interface
from reporting.units import BASE_UNITS
from reporting.words import comma_list

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
_XML_TRUE = ("true", "1")


@dataclass(frozen=True)
class VariableInfo:
    """A variable as the FMU declares it.

    Attributes
    ----------
    name, description : str
        The name and the description in the model description.
    reference : int
        The value reference.
    kind : str
        The base type of FMI: Real, Integer, Enumeration, Boolean, String; in FMI 3 Float64, Int32,
        Binary, ...
    causality, variability : str
        The causality and variability in the words of FMI.
    unit, display_unit : str or None
        The units that the variable declares, or else its declared type.
    minimum, maximum : float or None
        The declared range, in `unit`.
    start : str or None
        The declared start value; the start values of all elements of an array, with blanks between.
    shape : tuple of int
        The lengths of an array of FMI 3, with the start values of its structural parameters; empty
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
        """The names of an array's elements, row by row and from 1; of a scalar its own name."""
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
        """The declared range, within the range of the type: C would wrap what does not fit."""
        low, high = self._bounds_of_type()
        if self.minimum is not None:
            low = max(low, self.minimum)
        if self.maximum is not None:
            high = min(high, self.maximum)
        return low, high

    def _bounds_of_type(self) -> tuple[float, float]:
        """Return the least and largest value that the base type can hold."""
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

    def resized(self, lengths: Mapping[str | None, int]) -> "VariableInfo":
        """Return the variable with the shape that other values of structural parameters give it.

        A start value that all elements share holds for the new elements too.

        Parameters
        ----------
        lengths : mapping of str to int
            The values of structural parameters, by name.

        Raises
        ------
        FmuInputError
            If the array would have too many elements.
        """
        shape = []
        for parameter, length in zip(self.dimensions, self.shape, strict=True):
            shape.append(lengths.get(parameter, length))
        start = self.start
        different_values = set((start or "").split())
        if len(different_values) == 1:
            start = different_values.pop()
        return replace(self, shape=_checked_shape(self.name, shape), start=start)

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        return self.kind in NUMERIC_KINDS

    @property
    def base_type(self) -> str:
        """The type in the words of FMI 2 and SSP 1.0, which know reals and integers of one size."""
        if self.kind in FLOAT_KINDS:
            return "Real"
        return "Integer" if self.kind.lstrip("U").startswith("Int") else self.kind

    @property
    def single(self) -> bool:
        """Whether it is a single number at any time: not a text, an array or a clocked variable."""
        return self.numeric and not self.shape and not self.clocked

    @property
    def is_text_parameter(self) -> bool:
        """Whether it is a parameter with one text as its value."""
        is_one_value = not self.shape and not self.clocked
        return self.kind == "String" and self.causality == "parameter" and is_one_value

    @property
    def item_list(self) -> str:
        """The items of an enumeration with their values, for a message; empty for other types."""
        return ", ".join(f"{name} = {value}" for name, value in self.items.items())

    @property
    def startable(self) -> bool:
        """Whether it is an output or local variable whose start value initialisation may set."""
        is_result = self.causality in ("output", "local")
        return is_result and self.variability != "constant" and self.start is not None

    @property
    def continuous(self) -> bool:
        """Whether it is a real number that may change at any time."""
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
    """What an FMU file is and declares, in plain values that a process can be sent.

    Attributes
    ----------
    path : Path
        The FMU file.
    shown_as : str
        The name of the FMU in messages, where that is not the path: the FMU of an SSP file lies in
        a temporary folder.
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
        Whether a process can make one instance only.
    start_time, stop_time, step_size, tolerance : float or None
        The values of the default experiment; times in s.
    fixed_step : float or None
        The internal step size that FMI 3 declares [s].
    can_interpolate_inputs : bool
        Whether inputs can move in straight lines between communication points: in model exchange,
        and where co-simulation declares `canInterpolateInputs` (FMI 1 and 2).
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
        """Return the variable of that name, or None."""
        return self._variable_by_name.get(name)

    def hint(self, name: str) -> str:
        """Return the end of a message on an unknown name: the most similar variable, if any."""
        similar = get_close_matches(name, [variable.name for variable in self.variables], 1)
        return f"; did you mean {similar[0]!r}?" if similar else "."

    @cached_property
    def feedthrough(self) -> dict[str, frozenset[str]]:
        """For each variable that can be read, the inputs that it depends on directly.

        An output without declared dependencies depends on all inputs, as FMI says.
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
        """Return the communication step size: the one asked for, or else the FMU's own.

        Parameters
        ----------
        step_size : float or None
            The step size that a user asks for [s].

        Returns
        -------
        float or None
            The step size [s]; None if neither the user nor the FMU says one.

        Raises
        ------
        BindingError
            If it is not a positive number.
        """
        if step_size is not None and not (math.isfinite(step_size) and step_size > 0.0):
            raise BindingError(
                f"The step size must be a positive number of seconds, and {step_size:g} came."
            )
        return step_size or self.fixed_step or self.step_size

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the definitions of units that hold for a variable."""
        return self.units

    def exchange_kind(self, variable: VariableInfo) -> str:
        """Return the base type in which a variable is set and read: enumerations are integers."""
        if variable.kind != "Enumeration":
            return variable.kind
        return "Int64" if self.major_version == 3 else "Integer"


class FmuFileFacts(NamedTuple):
    """What is known of an FMU file without its model description; see `FmuDescription`."""

    path: Path
    sha256: str
    file_size: int
    platforms: tuple[str, ...]


def read_declared(
    declared: ModelDescription, root: Element, file: FmuFileFacts, interface: Interface | None
) -> FmuDescription:
    """Return the description of an FMU from what fmpy has read of it.

    Parameters
    ----------
    declared : fmpy.model_description.ModelDescription
        The model description, read by fmpy; corrected here where fmpy misses something.
    root : Element
        The XML of the model description, for what fmpy leaves out.
    file : FmuFileFacts
        Path, hash, size and platforms of the file.
    interface : {"co-simulation", "model-exchange"} or None
        The interface to be used; by default co-simulation where the FMU offers it.

    Raises
    ------
    FmuUnsupportedError
        If the FMU does not offer the interface.
    """
    offered = _offered_interfaces(declared, file.path, interface)
    chosen = next(iter(offered)) if interface is None else interface
    declared_interface = offered[chosen]
    capabilities = _capabilities(declared, declared_interface, root, chosen)
    _read_missing_ranges(declared, root)
    _remove_inverse_display_units(declared, root)
    dependencies = _declared_dependencies(declared)
    variables = []
    for variable in declared.modelVariables:
        variables.append(_variable_info(variable, dependencies.get(variable.name)))
    experiment: DefaultExperiment | None = declared.defaultExperiment
    runs_in_tool = root.find("Implementation/CoSimulation_Tool") is not None
    once_per_process = getattr(declared_interface, "canBeInstantiatedOnlyOncePerProcess", False)
    return FmuDescription(
        path=file.path,
        sha256=file.sha256,
        file_size=file.file_size,
        platforms=file.platforms,
        fmi_version=str(declared.fmiVersion),
        model_name=str(declared.modelName),
        model_identifier=str(declared_interface.modelIdentifier),
        guid=str(declared.guid),
        description=str(declared.description or ""),
        generation_tool=str(declared.generationTool or ""),
        can_get_and_set_state=bool(declared_interface.canGetAndSetFMUstate),
        can_serialise_state=bool(declared_interface.canSerializeFMUstate),
        can_vary_step=capabilities.can_vary_step,
        can_interpolate_inputs=capabilities.can_interpolate_inputs,
        variables=tuple(variables),
        units=tuple(_unit_info(unit) for unit in declared.unitDefinitions),
        interface=chosen,
        interfaces=tuple(offered),
        needs_tool=bool(declared_interface.needsExecutionTool) or runs_in_tool,
        once_per_process=bool(once_per_process),
        start_time=_optional_number(experiment, "startTime"),
        stop_time=_optional_number(experiment, "stopTime"),
        step_size=_optional_number(experiment, "stepSize"),
        tolerance=_optional_number(experiment, "tolerance"),
        fixed_step=_optional_number(declared_interface, "fixedInternalStepSize"),
        states=int(declared.numberOfContinuousStates),
        event_indicators=int(declared.numberOfEventIndicators),
        completed_step=capabilities.needs_completed_step,
    )


def _offered_interfaces(
    declared: ModelDescription, file: Path, wanted: Interface | None
) -> dict[Interface, CoSimulation | ModelExchange]:
    """Return what an FMU declares of each interface that it offers, co-simulation first."""
    offered: dict[Interface, CoSimulation | ModelExchange] = {}
    if declared.coSimulation is not None:
        offered["co-simulation"] = declared.coSimulation
    if declared.modelExchange is not None:
        offered["model-exchange"] = declared.modelExchange
    if not offered:
        raise FmuUnsupportedError(
            f"{file} offers neither co-simulation nor model exchange (scheduled execution is not "
            "supported); export it for co-simulation."
        )
    if wanted is not None and wanted not in offered:
        raise FmuUnsupportedError(
            f"{file} offers {comma_list(offered)} only, but the binding asks for {wanted}; change "
            "`interface` there, or export the FMU anew."
        )
    return offered


class _Capabilities(NamedTuple):
    """Capabilities whose declaration differs between the versions of FMI."""

    can_vary_step: bool
    can_interpolate_inputs: bool
    needs_completed_step: bool


def _capabilities(
    declared: ModelDescription,
    declared_interface: CoSimulation | ModelExchange,
    root: Element,
    interface: Interface,
) -> _Capabilities:
    """Return the capabilities of an interface that fmpy does not read for FMI 1."""
    can_vary_step = getattr(declared_interface, "canHandleVariableCommunicationStepSize", True)
    declares_interpolation = getattr(declared_interface, "canInterpolateInputs", False)
    can_interpolate = interface == "model-exchange" or declares_interpolation
    fmi1_capabilities = root.find("Implementation//Capabilities")
    if fmi1_capabilities is not None:
        can_vary_step = fmi1_capabilities.get("canHandleVariableCommunicationStepSize") in _XML_TRUE
        if fmi1_capabilities.get("canInterpolateInputs") in _XML_TRUE:
            can_interpolate = True
    needs_completed_step = getattr(declared_interface, "needsCompletedIntegratorStep", False)
    if declared.fmiVersion == "1.0":  # FMI 1 always needs the call
        needs_completed_step = True
    return _Capabilities(bool(can_vary_step), bool(can_interpolate), bool(needs_completed_step))


def _read_missing_ranges(declared: ModelDescription, root: Element) -> None:
    """Add the ranges of unsigned integers, which fmpy 0.3.32 does not read."""
    elements = {}
    for element in root.iterfind("ModelVariables/*"):
        if element.tag.startswith("UInt"):
            elements[element.get("name")] = element
    for variable in declared.modelVariables:
        if variable.name in elements:
            variable.min = elements[variable.name].get("min")
            variable.max = elements[variable.name].get("max")


def _remove_inverse_display_units(declared: ModelDescription, root: Element) -> None:
    """Remove display units of FMI 3 that show one over the value, as s of Hz.

    fmpy does not read that they are inverse, and a linear conversion would be wrong.
    """
    elements = root.iterfind(".//DisplayUnit[@inverse='true']")
    inverse_names = {element.get("name") for element in elements}
    for unit in declared.unitDefinitions:
        unit.displayUnits = [
            display for display in unit.displayUnits if display.name not in inverse_names
        ]


def _declared_dependencies(declared: ModelDescription) -> dict[str, tuple[str, ...]]:
    """Return the declared names of the variables that each output depends on."""
    dependencies: dict[str, tuple[str, ...]] = {}
    for unknown in declared.outputs:
        if unknown.variable is not None and unknown.dependencies is not None:
            names = tuple(str(variable.name) for variable in unknown.dependencies)
            dependencies[unknown.variable.name] = names
    return dependencies


def _checked_shape(name: str, shape: Sequence[int]) -> tuple[int, ...]:
    """Return the shape of an array; refuse one that would fill the memory."""
    if any(length < 0 for length in shape) or math.prod(shape) > _MOST_ARRAY_ELEMENTS:
        lengths = " x ".join(str(length) for length in shape)
        raise FmuInputError(
            f"{name!r} is an array of {lengths} elements; {_MOST_ARRAY_ELEMENTS} are the most."
        )
    return tuple(shape)


def _optional_number(record: object, attribute: str) -> float | None:
    """Return an attribute of one of fmpy's records as a number; None if it is not declared."""
    value = getattr(record, attribute, None)
    return None if value is None else float(value)


def _variable_info(declared: ScalarVariable, dependencies: tuple[str, ...] | None) -> VariableInfo:
    """Return a variable that fmpy has read, completed by its declared type."""
    declared_type = declared.declaredType
    unit_owner = declared_type if declared.unit is None else declared
    display_owner = declared_type if declared.displayUnit is None else declared
    minimum_owner = declared_type if declared.min is None else declared
    maximum_owner = declared_type if declared.max is None else declared
    dimensions: list[str | None] = []
    for dimension in declared.dimensions or ():
        parameter = dimension.variable
        dimensions.append(str(parameter.name) if parameter else None)
    items = {}
    for item in getattr(declared_type, "items", None) or ():
        items[str(item.name)] = int(item.value)
    return VariableInfo(
        name=str(declared.name),
        reference=int(declared.valueReference),
        kind=str(declared.type),
        causality=str(declared.causality or "local"),
        variability=str(declared.variability or "continuous"),
        description=str(declared.description or ""),
        unit=getattr(unit_owner, "unit", None),
        display_unit=getattr(display_owner, "displayUnit", None),
        minimum=_optional_number(minimum_owner, "min"),
        maximum=_optional_number(maximum_owner, "max"),
        start=None if declared.start is None else str(declared.start),
        shape=_checked_shape(declared.name, declared.shape or ()),
        dimensions=tuple(dimensions),
        clocked=bool(declared.clocks),
        items=items,
        dependencies=dependencies,
    )


def _unit_info(declared: Unit) -> UnitInfo:
    """Return a unit definition that fmpy has read."""
    displays = []
    for display in declared.displayUnits:
        displays.append(
            DisplayUnit(str(display.name), float(display.factor), float(display.offset))
        )
    base = declared.baseUnit
    if base is None:
        return UnitInfo(str(declared.name), None, 1.0, 0.0, tuple(displays))
    return UnitInfo(
        name=str(declared.name),
        exponents=tuple(int(getattr(base, symbol)) for symbol in BASE_UNITS),
        factor=float(base.factor),
        offset=float(base.offset),
        displays=tuple(displays),
    )


def describe_fmu(description: FmuDescription) -> dict[str, Any]:
    """Return an FMU's description as a record for JSON, as `uav-twin fmu info` prints it."""
    record = _with_visible_texts(asdict(description))
    record["path"] = str(description.path)
    record["variables"] = [
        _with_visible_texts(asdict(variable)) for variable in description.variables
    ]
    return record


def _with_visible_texts(record: Mapping[str, object]) -> dict[str, Any]:
    """Return a record whose texts have no control characters that a terminal would obey."""
    visible_record = {}
    for name, value in record.items():
        visible_record[name] = visible(value) if isinstance(value, str) else value
    return visible_record
