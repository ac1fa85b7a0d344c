"""What an FMU declares in its model description, as plain records for all FMI versions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from fmu_asset.errors import BindingError, FmuInputError, FmuUnsupportedError, said, visible
from fmu_asset.instances.plan import FmuIdentity, Interface
from reporting.units import BASE_UNITS

NUMERIC_KINDS = frozenset(
    {"Real", "Integer", "Enumeration", "Boolean", "Float32", "Float64"}
    | {f"{sign}{bits}" for sign in ("Int", "UInt") for bits in (8, 16, 32, 64)}
)
_LARGEST_ARRAY = 10_000_000
FLOAT_KINDS = frozenset({"Real", "Float32", "Float64"})
READABLE = ("output", "local", "calculatedParameter")
"""Causalities of what can be the source of a connection."""


@dataclass(frozen=True)
class VariableInfo:
    """A variable as the FMU declares it.

    Attributes
    ----------
    name, description : str
        As declared.
    reference : int
        Value reference.
    kind : str
        FMI base type: Real, Integer, Enumeration, Boolean, String; in FMI 3 Float64, Int32, Binary, ...
    causality, variability : str
        As declared.
    unit, display_unit : str or None
        As declared, or by the declared type.
    minimum, maximum : float or None
        Declared range in `unit`.
    start : str or None
        Declared start value; of an array, its elements.
    shape : tuple of int
        Of an array of FMI 3, with the start values of its structural parameters; empty for a scalar.
    dimensions : tuple of str or None
        For each number of the shape the name of the structural parameter that it is, if it is one.
    clocked : bool
        Whether it changes with a clock of FMI 3 only.
    items : dict of str to int
        Of an enumeration.
    dependencies : tuple of str or None
        Names of the variables that an output depends on directly; None if that is not declared.
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
        """Number of values."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elements of an array, row by row and from 1; the name itself of a scalar."""
        if not self.shape:
            return (self.name,)
        ranges = [range(1, length + 1) for length in self.shape]
        return tuple(f"{self.name}[{','.join(map(str, index))}]" for index in product(*ranges))

    @property
    def bounds(self) -> tuple[float, float]:
        """Declared range, within that of the type: C would wrap what does not fit."""
        low, high = (0.0, 1.0) if self.kind == "Boolean" else (-math.inf, math.inf)
        if self.base_type in ("Integer", "Enumeration"):
            sized = self.kind not in ("Integer", "Enumeration")
            limits = np.iinfo(self.kind.lower() if sized else "int32")
            low, high = float(limits.min), float(limits.max)
        return (
            low if self.minimum is None else max(low, self.minimum),
            high if self.maximum is None else min(high, self.maximum),
        )

    @property
    def in_unit(self) -> str:
        """Unit with a blank before it, for a sentence; nothing if it has none."""
        return "" if self.unit in (None, "1") else f" {self.unit}"

    def resized(self, lengths: Mapping[str | None, int]) -> "VariableInfo":
        """Return the variable with other values of structural parameters; one start value stands for all.

        Raises
        ------
        FmuInputError
            If it would be an array of too many elements.
        """
        shape = [lengths.get(name, length) for name, length in zip(self.dimensions, self.shape, strict=True)]
        start = {*(self.start or "").split()}
        alike = start.pop() if len(start) == 1 else self.start
        return replace(self, shape=_checked(self.name, shape), start=alike)

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        return self.kind in NUMERIC_KINDS

    @property
    def base_type(self) -> str:
        """Its type in the words of FMI 2 and SSP 1.0, which have one size of reals and one of integers."""
        if self.kind in FLOAT_KINDS:
            return "Real"
        return "Integer" if self.kind.lstrip("U").startswith("Int") else self.kind

    @property
    def single(self) -> bool:
        """Whether it is one number that is there at any time: no text, array or clocked variable."""
        return self.numeric and not self.shape and not self.clocked

    @property
    def is_text_parameter(self) -> bool:
        """Whether it is a parameter that is one text."""
        return self.kind == "String" and self.causality == "parameter" and not (self.shape or self.clocked)

    @property
    def item_list(self) -> str:
        """The items of an enumeration with their values, for a sentence or a table; empty for other types."""
        return ", ".join(f"{name} = {value}" for name, value in self.items.items())

    @property
    def startable(self) -> bool:
        """Whether it is an output or local variable with a start value, to be set before initialisation."""
        free = self.causality in ("output", "local") and self.variability != "constant"
        return free and self.start is not None

    @property
    def continuous(self) -> bool:
        """Whether it is a real number that changes at any time."""
        return self.kind in FLOAT_KINDS and self.variability == "continuous"


@dataclass(frozen=True)
class UnitInfo:
    """A unit as the FMU defines it: exponents of `BASE_UNITS` (or None), factor, offset, display units."""

    name: str
    exponents: tuple[int, ...] | None
    factor: float
    offset: float
    displays: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class FmuDescription(FmuIdentity):
    """What an FMU file is and declares; plain values only, so that it can be listed or sent.

    Attributes
    ----------
    path : Path
        The file.
    shown_as : str
        What sentences call it, where that is not the path: the FMU of an SSP file lies in a folder of ours.
    sha256 : str
        Hash of the file.
    file_size : int
        Bytes.
    model_name, description, generation_tool : str
        As declared.
    platforms : tuple of str
        Folders of binaries, such as linux64.
    can_get_and_set_state, can_serialise_state, can_vary_step : bool
        Declared capabilities of `interface`.
    variables : tuple of VariableInfo
        In the order of the model description.
    units : tuple of UnitInfo
        The unit definitions.
    interfaces : tuple of str
        All that it offers.
    needs_tool : bool
        Whether it needs its authoring tool.
    once_per_process : bool
        Whether a process can make one instance only.
    start_time, stop_time, step_size, tolerance : float or None
        Of the default experiment.
    fixed_step : float or None
        Internal step size that FMI 3 declares [s].
    can_interpolate_inputs : bool
        Whether inputs can move in straight lines between communication points: in model exchange, and where
        co-simulation declares `canInterpolateInputs` (FMI 1 and 2).
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
        """What sentences call it."""
        return self.shown_as or str(self.path)

    @property
    def identity(self) -> FmuIdentity:
        """What of it an instance has to know."""
        return FmuIdentity(**{item.name: getattr(self, item.name) for item in fields(FmuIdentity)})

    @cached_property
    def _by_name(self) -> dict[str, VariableInfo]:
        return {variable.name: variable for variable in self.variables}

    def variable(self, name: str) -> VariableInfo | None:
        """Return the variable of that name, or None."""
        return self._by_name.get(name)

    def hint(self, name: str) -> str:
        """Return the end of a sentence on a name that is none: the nearest of its variables, if any is."""
        near = get_close_matches(name, [variable.name for variable in self.variables], 1)
        return f"; did you mean {near[0]!r}?" if near else "."

    @cached_property
    def feedthrough(self) -> dict[str, frozenset[str]]:
        """For each variable that can be read, the inputs that it depends on directly.

        An output without declared dependencies depends on all inputs, as FMI says.
        """
        inputs = frozenset(v.name for v in self.variables if v.causality == "input")
        return {
            v.name: inputs if v.dependencies is None else inputs & {*v.dependencies}
            for v in self.variables
            if v.causality in READABLE
        }

    def step_of(self, given: float | None) -> float | None:
        """Return a communication step size that is given, or the FMU's own; None where nothing says one.

        Raises
        ------
        BindingError
            If it is no positive number.
        """
        if given is not None and not (math.isfinite(given) and given > 0.0):
            raise BindingError(f"The step size must be a positive number of seconds, and {given:g} came.")
        return given or self.fixed_step or self.step_size

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the definitions of units that hold for a variable."""
        return self.units

    def exchange_kind(self, variable: VariableInfo) -> str:
        """Return the base type in which a variable is set and read: enumerations are integers."""
        if variable.kind != "Enumeration":
            return variable.kind
        return "Int64" if self.major_version == 3 else "Integer"


def read_declared(
    declared: Any, root: Element, archive: Mapping[str, Any], wanted: Interface | None
) -> FmuDescription:
    """Return the description of an FMU from what fmpy has read.

    Parameters
    ----------
    declared : fmpy.model_description.ModelDescription
        As fmpy reads it.
    root : Element
        The XML itself, for what fmpy leaves out.
    archive : mapping
        `path`, `sha256`, `file_size` and `platforms`.
    wanted : {"co-simulation", "model-exchange"} or None
        How it is to be run; co-simulation if it has that.

    Raises
    ------
    FmuUnsupportedError
        If it does not offer that.
    """
    offered = _offered(declared, archive["path"], wanted)
    interface = next(iter(offered)) if wanted is None else wanted
    chosen = offered[interface]
    experiment = declared.defaultExperiment
    # fmpy does not read the capabilities of FMI 1.
    capabilities = root.find("Implementation//Capabilities")
    vary = getattr(chosen, "canHandleVariableCommunicationStepSize", True)
    lines = interface == "model-exchange" or getattr(chosen, "canInterpolateInputs", False)
    if capabilities is not None:
        vary = capabilities.get("canHandleVariableCommunicationStepSize") in ("true", "1")
        lines = lines or capabilities.get("canInterpolateInputs") in ("true", "1")
    # FMI 1 always wants it.
    completed = bool(getattr(chosen, "needsCompletedIntegratorStep", False)) or declared.fmiVersion == "1.0"

    # fmpy 0.3.32 passes over the range of unsigned integers.
    unsigned = {e.get("name"): e for e in root.iterfind("ModelVariables/*") if e.tag.startswith("UInt")}
    for variable in declared.modelVariables:
        if (element := unsigned.get(variable.name)) is not None:
            variable.min, variable.max = element.get("min"), element.get("max")
    # And takes a display unit of FMI 3 that is one over the value, as s of Hz, for one that is not.
    inverse = {shown.get("name") for shown in root.iterfind(".//DisplayUnit[@inverse='true']")}
    for unit in declared.unitDefinitions:
        unit.displayUnits = [shown for shown in unit.displayUnits if shown.name not in inverse]
    known = {
        unknown.variable.name: tuple(str(variable.name) for variable in unknown.dependencies)
        for unknown in declared.outputs
        if unknown.variable is not None and unknown.dependencies is not None
    }
    return FmuDescription(
        **archive,
        fmi_version=str(declared.fmiVersion),
        model_name=str(declared.modelName),
        model_identifier=str(chosen.modelIdentifier),
        guid=str(declared.guid),
        description=str(declared.description or ""),
        generation_tool=str(declared.generationTool or ""),
        can_get_and_set_state=bool(chosen.canGetAndSetFMUstate),
        can_serialise_state=bool(chosen.canSerializeFMUstate),
        can_vary_step=bool(vary),
        can_interpolate_inputs=bool(lines),
        variables=tuple(_variable(each, known.get(each.name)) for each in declared.modelVariables),
        units=tuple(_unit(unit) for unit in declared.unitDefinitions),
        interface=interface,
        interfaces=tuple(offered),
        needs_tool=bool(chosen.needsExecutionTool)
        or root.find("Implementation/CoSimulation_Tool") is not None,
        once_per_process=bool(getattr(chosen, "canBeInstantiatedOnlyOncePerProcess", False)),
        start_time=_number(experiment, "startTime"),
        stop_time=_number(experiment, "stopTime"),
        step_size=_number(experiment, "stepSize"),
        tolerance=_number(experiment, "tolerance"),
        fixed_step=_number(chosen, "fixedInternalStepSize"),
        states=int(declared.numberOfContinuousStates),
        event_indicators=int(declared.numberOfEventIndicators),
        completed_step=completed,
    )


def _checked(name: str, shape: Sequence[int]) -> tuple[int, ...]:
    if any(length < 0 for length in shape) or math.prod(shape) > _LARGEST_ARRAY:
        came = " x ".join(map(str, shape))
        raise FmuInputError(said("archive.array_too_large", name=name, shape=came, most=_LARGEST_ARRAY))
    return tuple(shape)


def _offered(declared: Any, file: Path, wanted: Interface | None) -> dict[Interface, Any]:
    """Return what an FMU says of the interfaces that it offers, the one that is wanted among them."""
    there: dict[Interface, Any] = {
        "co-simulation": declared.coSimulation, "model-exchange": declared.modelExchange
    }  # fmt: skip
    there = {name: given for name, given in there.items() if given is not None}
    if not there:
        raise FmuUnsupportedError(said("archive.no_interface", file=file))
    if wanted is not None and wanted not in there:
        raise FmuUnsupportedError(said("archive.other_interface", file=file, there=there, wanted=wanted))
    return there


def _number(owner: Any, attribute: str) -> float | None:
    value = getattr(owner, attribute, None)
    return None if value is None else float(value)


def _variable(declared: Any, dependencies: tuple[str, ...] | None) -> VariableInfo:
    declared_type = declared.declaredType

    def owner(attribute: str) -> Any:
        """Return who says something: the variable, or else its type."""
        return declared_type if getattr(declared, attribute) is None else declared

    return VariableInfo(
        name=str(declared.name),
        reference=int(declared.valueReference),
        kind=str(declared.type),
        causality=str(declared.causality or "local"),
        variability=str(declared.variability or "continuous"),
        description=str(declared.description or ""),
        unit=getattr(owner("unit"), "unit", None),
        display_unit=getattr(owner("displayUnit"), "displayUnit", None),
        minimum=_number(owner("min"), "min"),
        maximum=_number(owner("max"), "max"),
        start=None if declared.start is None else str(declared.start),
        shape=_checked(declared.name, declared.shape or ()),
        dimensions=tuple(d.variable and str(d.variable.name) for d in declared.dimensions or ()),
        clocked=bool(declared.clocks),
        items={str(item.name): int(item.value) for item in getattr(declared_type, "items", None) or ()},
        dependencies=dependencies,
    )


def _unit(declared: Any) -> UnitInfo:
    base = declared.baseUnit
    exponents = None if base is None else tuple(int(getattr(base, symbol)) for symbol in BASE_UNITS)
    return UnitInfo(
        name=str(declared.name),
        exponents=exponents,
        factor=1.0 if base is None else float(base.factor),
        offset=0.0 if base is None else float(base.offset),
        displays=tuple((str(d.name), float(d.factor), float(d.offset)) for d in declared.displayUnits),
    )


def _visible(record: dict[str, Any]) -> dict[str, Any]:
    return {name: visible(value) if isinstance(value, str) else value for name, value in record.items()}


def describe_fmu(description: FmuDescription) -> dict[str, Any]:
    """Return an FMU's description as plain records, JSON-serialisable."""
    record: dict[str, Any] = _visible(asdict(description))
    record["path"] = str(description.path)
    record["variables"] = [_visible(variable) for variable in record["variables"]]
    return record
