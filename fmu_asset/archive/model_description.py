"""Converts a model description that fmpy has read to the records of `declared`."""

from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from fmpy.model_description import (
    CoSimulation,
    DefaultExperiment,
    ModelDescription,
    ModelExchange,
    ScalarVariable,
    Unit,
)

from fmu_asset.errors import FmuUnsupportedError
from fmu_asset.instances.plan import Interface
from reporting.units import BASE_UNITS
from reporting.words import comma_list

from .declared import DisplayUnit, FmuDescription, UnitInfo, VariableInfo, checked_shape

_XML_TRUE = ("true", "1")


class FmuFileFacts(NamedTuple):
    """What is known of an FMU file without its model description; see `FmuDescription`."""

    path: Path
    sha256: str
    file_size: int
    platforms: tuple[str, ...]


def read_declared(
    declared: ModelDescription, root: Element, file: FmuFileFacts, interface: Interface | None
) -> FmuDescription:
    """Return the declarations of an FMU, converted from those that fmpy has read.

    Parameters
    ----------
    declared : fmpy.model_description.ModelDescription
        What fmpy has read. It is changed: missing ranges are added and inverse display units
        removed.
    root : Element
        The XML, for declarations that fmpy does not read.
    interface : {"co-simulation", "model-exchange"} or None
        The interface to be used; None for co-simulation if the FMU offers it.

    Raises
    ------
    FmuUnsupportedError
        If the FMU does not offer the interface.
    """
    offered = _offered_interfaces(declared, file.path, interface)
    interface_name = next(iter(offered)) if interface is None else interface
    declared_interface = offered[interface_name]
    capabilities = _capabilities(declared, declared_interface, root, interface_name)
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
        interface=interface_name,
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
    declared: ModelDescription, file: Path, interface: Interface | None
) -> dict[Interface, CoSimulation | ModelExchange]:
    """Return fmpy's record of each interface that an FMU offers, co-simulation first.

    An error is raised if there is none, or not the requested one.
    """
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
    if interface is not None and interface not in offered:
        raise FmuUnsupportedError(
            f"{file} offers {comma_list(offered)} only, but the binding asks for {interface}; "
            "change `interface` there, or export the FMU anew."
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
    """Return the capabilities of an interface; those of FMI 1 are read here, not by fmpy."""
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
    """Add the ranges of unsigned integers, which fmpy 0.3.32 does not read, to its records."""
    elements = {}
    for element in root.iterfind("ModelVariables/*"):
        if element.tag.startswith("UInt"):
            elements[element.get("name")] = element
    for variable in declared.modelVariables:
        if variable.name in elements:
            variable.min = elements[variable.name].get("min")
            variable.max = elements[variable.name].get("max")


def _remove_inverse_display_units(declared: ModelDescription, root: Element) -> None:
    """Remove inverse display units of FMI 3 from fmpy's records.

    They display the reciprocal of a value, such as a frequency in Hz as a period in s. fmpy does
    not read this property, and its linear conversion would be wrong.
    """
    elements = root.iterfind(".//DisplayUnit[@inverse='true']")
    inverse_names = {element.get("name") for element in elements}
    for unit in declared.unitDefinitions:
        unit.displayUnits = [
            display for display in unit.displayUnits if display.name not in inverse_names
        ]


def _declared_dependencies(declared: ModelDescription) -> dict[str, tuple[str, ...]]:
    """Return the variables that each output depends on, as far as they are declared."""
    dependencies: dict[str, tuple[str, ...]] = {}
    for output in declared.outputs:
        if output.variable is not None and output.dependencies is not None:
            names = tuple(str(variable.name) for variable in output.dependencies)
            dependencies[output.variable.name] = names
    return dependencies


def _optional_number(record: object, attribute: str) -> float | None:
    """Return an attribute of a record of fmpy as a number; None if it is not declared."""
    value = getattr(record, attribute, None)
    return None if value is None else float(value)


def _variable_info(declared: ScalarVariable, dependencies: tuple[str, ...] | None) -> VariableInfo:
    """Return the record of a variable; units and limits that it lacks come from its type."""
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
        shape=checked_shape(declared.name, declared.shape or ()),
        dimensions=tuple(dimensions),
        clocked=bool(declared.clocks),
        items=items,
        dependencies=dependencies,
    )


def _unit_info(declared: Unit) -> UnitInfo:
    """Return the record of a unit definition."""
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
