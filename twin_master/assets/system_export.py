"""Writing the asset of a scenario, or a wing design, as an SSP file."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

from fe.wing.design import load_design
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import INPUT_ROLES, Binding, load_binding
from fmu_asset.client.blocks import Blocks
from fmu_asset.client.bound_variables import ParameterBinding
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SystemStructure,
)
from fmu_asset.coupling.system import system_description
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.folders import scratch_folder
from fmu_asset.instances.plan import InitialValue
from fmu_asset.packing.structure_fmu import pack_wing
from fmu_asset.ssp.writer import write_ssp
from reporting.progress import reporter
from scenarios import binding_files
from twin_master.assets.coupled_source import SeveralSource
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.resolution import resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.schema import Scenario

PackedKind = Literal["python", "compiled"]
"""What evaluates an FMU that is packed from a design: Python, or compiled C."""


def export_scenario(
    loaded_scenario: LoadedScenario,
    out: Path,
    *,
    seed: int | None = None,
    kind: PackedKind | None = None,
    replace_file: bool,
) -> Path:
    """Write the asset of a scenario as an SSP file.

    The file contains the FMUs, their connections, and a parameter set with the parameters of the
    scenario, the integers drawn for its seeds, and its constant loads.

    Parameters
    ----------
    seed : int, optional
        The seed of the run, from which the seeds of the FMUs are drawn; by default that of the
        scenario.
    kind : {"python", "compiled"}, optional
        What evaluates the FMUs that are packed from designs; by default as the scenario says.
    replace_file : bool
        Whether an existing file may be replaced.

    Raises
    ------
    MissionInputError
        If the scenario flies no FMU, or if `kind` is given and no FMU is packed from a design.
    FmuError
        If the FMUs do not fit.
    """
    scenario = resolve_scenario(loaded_scenario, {"seed": seed})
    if kind is not None:
        scenario = _with_packed_kind(scenario, kind)
    source = scenario.asset.source(scenario)
    if not isinstance(source, FmuSource):
        raise MissionInputError(
            f"the scenario {scenario.mission.name} flies no FMU (its kind is "
            f"`{scenario.asset.kind}`); only FMUs can be exported."
        )
    source.check()
    with scratch_folder() as scratch:
        source.prepare(scratch, reporter())
        binding = source.binding()
        parameters = source.parameters()
        if isinstance(source, SeveralSource):
            wiring = source.wiring()
        else:
            fmu = source.path(FMU_COPY)
            # Missing effects add parameters to an FMU, which the scenario names as the FMU does.
            description = read_fmu(fmu)
            bound_parameters = dict(binding.parameter)
            for name in parameters:
                if name in binding.parameter:
                    continue
                variable = description.variable(name)
                if variable is not None:
                    unit = variable.unit or "1"
                    bound_parameters[name] = ParameterBinding(variable=name, unit=unit)
            binding = binding.model_copy(update={"parameter": bound_parameters})
            wiring = system_of_one_fmu(scenario.mission.name, fmu, binding)
        names = _parameter_names(wiring, binding)
        wiring = _with_values(wiring, binding, parameters, scenario.asset.constant_load)
        stop_time = binding.binding.start_time + scenario.mission.steps * binding.interval
        return write_ssp(
            wiring,
            out,
            parameter_names=names,
            stop_time=stop_time,
            step_size=binding.step_size,
            replace=replace_file,
        )


def _with_packed_kind(scenario: Scenario, kind: PackedKind) -> Scenario:
    """Let a scenario pack FMUs from their designs as `kind`, Python or compiled.

    Raises
    ------
    MissionInputError
        If no FMU of the scenario is packed from a design.
    """
    asset = scenario.asset
    if "packed" in type(asset).model_fields:
        return scenario.with_changes("asset", packed=kind)
    components = []
    for component in getattr(asset, "component", ()):
        is_packed = component.design is not None
        components.append(component.model_copy(update={"packed": kind}) if is_packed else component)
    if not any(component.design is not None for component in components):
        raise MissionInputError(
            f"--kind {kind} says how FMUs are packed from a design, but the scenario "
            f"{scenario.mission.name} packs none (the kind of its asset is `{asset.kind}`): leave "
            "--kind out."
        )
    return scenario.with_changes("asset", component=tuple(components))


def export_design(
    design: Path | None, out: Path, *, kind: PackedKind = "python", replace_file: bool
) -> Path:
    """Write the wing of a design as an SSP file with one component.

    Parameters
    ----------
    design : Path, optional
        The file of the design; by default the shipped one.
    kind : {"python", "compiled"}
        What evaluates the FMU.
    replace_file : bool
        Whether an existing file may be replaced.
    """
    wing = load_design(design)
    binding = load_binding(binding_files()["uav_wing"])
    with scratch_folder() as scratch:
        fmu = pack_wing(wing, scratch / "wing.fmu", kind=kind).path
        wiring = system_of_one_fmu(wing.name, fmu, binding)
        names = _parameter_names(wiring, binding)
        wiring = _with_values(wiring, binding, {}, {})
        return write_ssp(
            wiring,
            out,
            parameter_names=names,
            step_size=binding.step_size,
            replace=replace_file,
        )


def system_of_one_fmu(name: str, fmu: Path, binding: Binding) -> Wiring:
    """Return a system of one FMU, whose connectors are the variables of its binding.

    Parameters
    ----------
    name : str
        The name of the system.
    binding : Binding
        The binding of the FMU. The component has its name, with `_` for characters that are no
        letters or digits.
    """
    component_name = re.sub(r"[^A-Za-z0-9_]", "_", binding.name)
    inputs = []
    for role in INPUT_ROLES:
        inputs += [scalar.variable for scalar in binding.inputs(role).values()]
    monitors = [scalar.variable for scalar in binding.monitor.values()]
    outputs = list(dict.fromkeys([*binding.observation_variables, *monitors]))  # each once
    parameters = [parameter.variable for parameter in binding.parameter.values()]

    connectors = [Connector(variable, "input") for variable in inputs]
    connectors += [Connector(variable, "output") for variable in outputs]
    connectors += [Connector(variable, "parameter") for variable in parameters]

    # Each connector of the system is connected to the variable of its name in the component.
    connections = []
    for variable in (*inputs, *parameters):
        system_end, component_end = Endpoint("", variable), Endpoint(component_name, variable)
        connections.append(Connection(system_end, component_end))
    for variable in outputs:
        system_end, component_end = Endpoint("", variable), Endpoint(component_name, variable)
        connections.append(Connection(component_end, system_end))

    component = Component(component_name, fmu)
    structure = SystemStructure(name, (component,), tuple(connectors), tuple(connections))
    return Wiring(structure)


def _with_values(
    wiring: Wiring, binding: Binding, parameters: Mapping[str, float], load: Mapping[str, float]
) -> Wiring:
    """Return the system with the start values of parameters and loads at its components."""
    # The values of the system's connectors, in the units of the system.
    system = system_description(wiring)
    blocks = Blocks(system, binding)
    initial_values = blocks.settings(parameters)
    for name, value in load.items():
        bound_input = blocks.bound_input("load", name)
        variable = bound_input.variable
        numbers = bound_input.numbers(value).tolist()
        initial_values.append(InitialValue(variable.kind, variable.reference, numbers))
    # The same values at the components to which the connectors lead.
    values_by_component = system.settings_of_components(initial_values)
    components = []
    for component in wiring.structure.components:
        settings = dict(component.settings)
        for variable_name, number in values_by_component.get(component.name, {}).items():
            settings[variable_name] = ComponentSetting(number)
        components.append(replace(component, settings=settings))
    start_time = binding.binding.start_time
    structure = replace(wiring.structure, components=tuple(components), span=(start_time, None))
    return Wiring(structure)


def _parameter_names(wiring: Wiring, binding: Binding) -> dict[Endpoint, str]:
    """Return the name in the binding of each parameter and load, by the component variable it sets.

    A parameter that sets variables of several components is left out: none of them is its own.
    """
    system = system_description(wiring)
    names = {}
    for bound_variables in (binding.parameter, binding.load):
        for name, bound_variable in bound_variables.items():
            ends = system.ends[bound_variable.variable]
            if len(ends) == 1:
                names[ends[0].end] = name
    return names
