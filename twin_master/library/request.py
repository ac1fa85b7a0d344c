"""What a user asks to be sampled: a scenario, or an FMU with values for its inputs."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fmu_asset.door.binding import Binding, load_binding
from reporting.progress import reporter
from twin_master.assets.asset_source import BINDING_COPY, AssetBelief, PairedSource
from twin_master.assets.coupled_source import SeveralSource
from twin_master.assets.design_source import DesignBelief
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.library_source import LibraryBelief
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import InvalidObservationLibraryError
from twin_master.library.grid import STEP_TIMEOUT, SamplingGrid
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.section import LARGEST_COUNT
from twin_master.sentences import said

_ROLES = ("health", "control", "load", "parameter")


def parse_grid(texts: Sequence[str], binding: Binding) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return the values of `NAME=VALUES` texts by role and name.

    NAME is a name of the binding, or ROLE.NAME where two roles share it; VALUES are numbers with commas, or
    FIRST:LAST:COUNT.

    Raises
    ------
    InvalidObservationLibraryError
        A text is no such thing, or the binding has no such name.
    """
    found: dict[str, dict[str, tuple[float, ...]]] = {role: {} for role in _ROLES}
    tables = {role: getattr(binding, role) for role in _ROLES}
    for text in texts:
        name, equals, values = text.partition("=")
        role, dot, inner = name.partition(".")
        if dot and role in tables and inner in tables[role]:
            places = [(role, inner)]
        else:
            places = [(role, name) for role in _ROLES if name in tables[role]]
        if not equals or not places:
            known = [f"{role}.{key}" for role in _ROLES for key in tables[role]]
            why = said("library.grid", binding=binding, known=known, text=text)
            raise InvalidObservationLibraryError(why)
        if len(places) > 1:
            full = " or ".join(f"{role}.{key}" for role, key in places)
            raise InvalidObservationLibraryError(f"{name} is a name of several roles: write {full}.")
        role, key = places[0]
        found[role][key] = _values(text, values)
    return found


def _values(text: str, values: str) -> tuple[float, ...]:
    try:
        if ":" in values:
            first, last, count = values.split(":")
            if not 1 <= int(count) <= LARGEST_COUNT:
                raise ValueError
            numbers = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            numbers = [float(part) for part in values.split(",")]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError
    except ValueError:
        raise InvalidObservationLibraryError(said("library.numbers", most=LARGEST_COUNT, text=text)) from None
    return tuple(numbers)


def grid_of_fmu(
    fmu: Path,
    binding_file: Path,
    texts: Sequence[str],
    *,
    role: str | None = None,
    settling_steps: int = 0,
    step_timeout: float | None = None,
) -> SamplingGrid:
    """Return the grid over the values of the inputs; controls are all their combinations.

    Raises
    ------
    InvalidObservationLibraryError
        A text is wrong, something has several values that can have one, or the role is not told.
    """
    binding = load_binding(binding_file)
    given = parse_grid(texts, binding)
    if role is None:
        if len(binding.observation) != 1:
            raise InvalidObservationLibraryError(said("library.role", binding=binding))
        role = next(iter(binding.observation))
    swept = [name for name, values in given["parameter"].items() if len(values) > 1]
    if len(swept) > 1:
        raise InvalidObservationLibraryError(said("library.one_parameter", names=", ".join(swept)))
    parameter = swept[0] if swept else ""
    inputs = given["control"]
    controls = {}
    combinations = math.prod(len(values) for values in inputs.values())
    if combinations > LARGEST_COUNT:
        numbers = {"combinations": combinations, "most": LARGEST_COUNT}
        raise InvalidObservationLibraryError(said("library.controls", inputs=inputs, **numbers))
    for values in itertools.product(*inputs.values()):
        setting = dict(zip(inputs, values, strict=True))
        controls[", ".join(f"{name} = {value:g}" for name, value in setting.items())] = setting
    return SamplingGrid(
        fmu=str(fmu),
        binding=str(binding_file),
        role=role,
        parameter=parameter,
        draws=given["parameter"].get(parameter, (0.0,)),
        states=given["health"],
        controls=controls if inputs else {},
        load=_single("load", given["load"]),
        parameters={k: v[0] for k, v in given["parameter"].items() if k != parameter},
        settling_steps=settling_steps,
        step_timeout=step_timeout or binding.limits.step_time or STEP_TIMEOUT,
    )


def _single(role: str, given: dict[str, tuple[float, ...]]) -> dict[str, float]:
    for name, values in given.items():
        if len(values) > 1:
            what = f"{role} {name}"
            raise InvalidObservationLibraryError(said("library.single", what=what, number=len(values)))
    return {name: values[0] for name, values in given.items()}


def grid_of_scenario(
    loaded: LoadedScenario,
    folder: Path,
    texts: Sequence[str] = (),
    *,
    overrides: Overrides | None = None,
    settling_steps: int = 0,
) -> SamplingGrid:
    """Return the grid that a scenario asks for, with its FMU and binding copied into a folder.

    Levels of the states and values of the uncertain parameter may be given otherwise by `texts`; the draws
    are those of the scenario's calibration and seed.

    Raises
    ------
    InvalidObservationLibraryError
        The scenario flies no FMU, or a text gives something else.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        The asset of the scenario cannot be prepared.
    """
    scenario = resolve_scenario(_without_library(loaded), overrides or Overrides())
    flown = scenario.asset.source(scenario)
    if not isinstance(flown, FmuSource) or isinstance(flown, SeveralSource):
        raise InvalidObservationLibraryError(said("library.kind", scenario=scenario))
    believed = scenario.belief.source(scenario, flown)
    source = flown if believed is flown else PairedSource(flown, believed)
    source.check()
    source.prepare(folder, reporter())
    binding = load_binding(folder / BINDING_COPY)
    given = parse_grid(texts, binding)
    draws = source.draws(scenario.mission.seed)
    states = {factor.name: factor.levels for factor in scenario.state} | given.pop("health")
    swept = given.pop("parameter")
    if any(given.values()) or {*swept} - {draws.name}:
        raise InvalidObservationLibraryError(said("library.scenario", name=draws.name))
    fixed = {name: value for name, value in flown.parameters().items() if name != draws.name}
    return SamplingGrid(
        fmu=str(folder / FMU_COPY),
        binding=str(folder / BINDING_COPY),
        role=scenario.observation.role,
        parameter=draws.name,
        draws=swept.get(draws.name, tuple(draws.values.tolist())),
        states=states,
        controls={control.name: dict(control.values) for control in scenario.control},
        load=dict(scenario.asset.constant_load),
        parameters=fixed,
        settling_steps=settling_steps,
        step_timeout=flown.section.step_timeout or binding.limits.step_time or STEP_TIMEOUT,
    )


def _without_library(loaded: LoadedScenario) -> LoadedScenario:
    """Return the scenario as it is where its twin does not believe the library that is to be sampled."""
    belief = loaded.scenario.belief
    if not isinstance(belief, LibraryBelief):
        return loaded
    plain = AssetBelief() if belief.design is None else DesignBelief(design=belief.design)
    return replace(loaded, scenario=loaded.scenario.model_copy(update={"belief": plain}))
