"""A scenario's asset, or a wing design, as an SSP file."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from fe.wing.design import load_design
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import INPUT_ROLES, Binding, load_binding
from fmu_asset.client.bound_variables import ParameterBinding
from fmu_asset.client.exchange import Exchange
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
from twin_master.errors import MissionInputError, said
from twin_master.scenario.reading import LoadedScenario


def export_scenario(
    loaded: LoadedScenario, out: Path, *, seed: int | None = None, replace_file: bool
) -> Path:
    """Write the asset of a scenario as an SSP file.

    The parameters of the scenario, its seeds drawn, and its constant loads stand in the parameter set.

    Parameters
    ----------
    loaded : LoadedScenario
        The scenario.
    out : Path
        The file to write.
    seed : int, optional
        Seed of the run, from which the seeds of the FMUs are drawn; that of the scenario by default.
    replace_file : bool
        Whether an existing file may be replaced.

    Raises
    ------
    MissionInputError
        The scenario flies no FMU.
    FmuError
        The FMUs do not fit.
    """
    scenario = resolve_scenario(loaded, {"seed": seed})
    source = scenario.asset.source(scenario)
    if not isinstance(source, FmuSource):
        raise MissionInputError(said("assets.no_fmu", name=scenario.mission.name, kind=scenario.asset.kind))
    source.check()
    with scratch_folder() as scratch:
        source.prepare(scratch, reporter())
        binding = source.binding()
        if isinstance(source, SeveralSource):
            wiring = source.wiring()
        else:
            binding = _with_own_names(binding, source.path(FMU_COPY), source.parameters())
            wiring = single_system(scenario.mission.name, source.path(FMU_COPY), binding)
        wiring, names = _with_values(wiring, binding, source.parameters(), scenario.asset.constant_load)
        stop = binding.binding.start_time + scenario.mission.steps * binding.interval
        return write_ssp(wiring, out, parameter_names=names, stop_time=stop, replace=replace_file)


def export_design(design: Path | None, out: Path, *, replace_file: bool) -> Path:
    """Write the wing of a design, the shipped one if absent, as an SSP file with one component."""
    wing = load_design(design)
    binding = load_binding(binding_files()["uav_wing"])
    with scratch_folder() as scratch:
        fmu = pack_wing(wing, scratch / "wing.fmu").path
        wiring, names = _with_values(single_system(wing.name, fmu, binding), binding, {}, {})
        return write_ssp(wiring, out, parameter_names=names, replace=replace_file)


def single_system(name: str, fmu: Path, binding: Binding) -> Wiring:
    """Return a system of one FMU, named as its binding, whose connectors are the variables of the binding."""
    own = re.sub(r"[^A-Za-z0-9_]", "_", binding.name)
    inputs = [scalar.variable for role in INPUT_ROLES for scalar in binding.inputs(role).values()]
    outputs = dict.fromkeys(
        [*binding.observation_variables, *(scalar.variable for scalar in binding.monitor.values())]
    )
    parameters = [parameter.variable for parameter in binding.parameter.values()]
    connectors = [
        *(Connector(variable, "input") for variable in inputs),
        *(Connector(variable, "output") for variable in outputs),
        *(Connector(variable, "parameter") for variable in parameters),
    ]
    connections = [
        *(Connection(Endpoint("", v), Endpoint(own, v)) for v in (*inputs, *parameters)),
        *(Connection(Endpoint(own, v), Endpoint("", v)) for v in outputs),
    ]
    component = Component(own, fmu)
    return Wiring(SystemStructure(name, (component,), tuple(connectors), tuple(connections)))


def _with_own_names(binding: Binding, fmu: Path, parameters: Mapping[str, float]) -> Binding:
    """Return a binding that also has the parameters which go by their own names in the FMU."""
    description = read_fmu(fmu)
    added = {
        name: ParameterBinding(variable=name, unit=variable.unit or "1")
        for name in parameters
        if name not in binding.parameter and (variable := description.variable(name)) is not None
    }
    return binding.model_copy(update={"parameter": {**binding.parameter, **added}})


def _with_values(
    wiring: Wiring, binding: Binding, parameters: Mapping[str, float], load: Mapping[str, float]
) -> tuple[Wiring, dict[Endpoint, str]]:
    """Return the system with the values of a scenario, and the binding's names for its parameters."""
    system = system_description(wiring)
    exchange = Exchange(system, binding)
    settings = exchange.settings(parameters)
    for name, value in load.items():
        slot = exchange.slot("load", name)
        settings.append(
            InitialValue(slot.variable.kind, slot.variable.reference, slot.numbers(value).tolist())
        )
    given: dict[str, dict[str, ComponentSetting]] = {
        name: {key: ComponentSetting(number) for key, number in values.items()}
        for name, values in system.settings_of_components(settings).items()
    }
    components = tuple(
        replace(part, settings={**part.settings, **given.get(part.name, {})})
        for part in wiring.structure.components
    )
    names = {
        system.ends[item.variable][0].end: name
        for table in (binding.parameter, binding.load)
        for name, item in table.items()
        if len(system.ends[item.variable]) == 1
    }
    span = binding.binding.start_time, None
    return Wiring(replace(wiring.structure, components=components, span=span)), names
