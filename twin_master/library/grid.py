"""The grid of points at which an FMU is sampled, from a user's values or from a scenario."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fmu_asset.client.binding import Binding, load_binding
from reporting.progress import reporter
from reporting.words import comma_list
from twin_master.assets.asset_source import BINDING_COPY, AssetBelief, PairedSource
from twin_master.assets.coupled_source import SeveralSource
from twin_master.assets.design_source import DesignBelief
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.library_source import LibraryBelief
from twin_master.assets.parameter import read_calibration
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.section import LARGEST_COUNT

STEP_TIMEOUT = 60.0
"""Limit of the wall-clock time of a step [s], if neither scenario nor binding has one."""

_LONGEST_BLOCK = 4096
"""Largest number of points in a block."""
_LEAST_BLOCKS = 64
"""Least number of blocks of a grid with enough points, so that several workers share them."""


@dataclass(frozen=True)
class SamplingGrid:
    """The points at which an FMU is sampled: all combinations of draw, state and control.

    Attributes
    ----------
    fmu, binding : str
        The paths of the FMU and of its binding.
    role : str
        The observed quantity, by its name in the binding.
    parameter : str
        The uncertain parameter; empty without one.
    draws : tuple of float
        The values of the parameter; without a parameter one value that is not used.
    states : dict of str to tuple of float
        The levels of each state factor; the last factor varies fastest.
    controls : dict of str to dict of str to float
        The value of each control input under each control.
    load : dict of str to float
        The load inputs, the same at every point.
    parameters : dict of str to float
        The other parameters that are the same at every point.
    others : dict of str to tuple of float
        For each other calibrated parameter, its value at each draw.
    settling_steps : int
        The number of steps from a fresh start at every point; 0 for an FMU without memory.
    step_timeout : float
        The limit of the wall-clock time of a step [s].
    """

    fmu: str
    binding: str
    role: str
    parameter: str
    draws: tuple[float, ...]
    states: Mapping[str, tuple[float, ...]]
    controls: Mapping[str, Mapping[str, float]]
    load: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    others: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    settling_steps: int = 0
    step_timeout: float = STEP_TIMEOUT

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of draws, of levels of each state factor, and of controls."""
        level_counts = [len(levels) for levels in self.states.values()]
        return (len(self.draws), *level_counts, len(self.controls))

    @property
    def size(self) -> int:
        """The number of points."""
        return math.prod(self.shape)

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """The blocks of points that are sampled together: first point, and point after the last.

        They depend on the grid alone, so that an interrupted sampling continues with the same ones.
        """
        length = min(_LONGEST_BLOCK, max(1, math.ceil(self.size / _LEAST_BLOCKS)))
        firsts = range(0, self.size, length)
        return tuple((first, min(first + length, self.size)) for first in firsts)

    def point(self, index: int) -> tuple[int, dict[str, float], str]:
        """Return the index of the draw, the state, and the name of the control of a grid point."""
        draw, *levels, control = np.unravel_index(index, self.shape)
        state = {}
        for (name, values), level in zip(self.states.items(), levels, strict=True):
            state[name] = float(values[level])
        return int(draw), state, list(self.controls)[control]


_ROLES = ("health", "control", "load", "parameter")
"""The roles of the inputs of a binding."""


def parse_grid(texts: Sequence[str], binding: Binding) -> dict[str, dict[str, tuple[float, ...]]]:
    """Read the values of FMU inputs and parameters from texts of the form `NAME=VALUES`.

    NAME is the name of an input or parameter in the binding; if several roles have the name, it is
    written ROLE.NAME. VALUES are numbers separated by commas, or FIRST:LAST:COUNT for equally
    spaced numbers.

    Parameters
    ----------
    texts : sequence of str
        The texts that the user gave, one for each axis.

    Returns
    -------
    dict of str to dict of str to tuple of float
        The values by role and name. A role without values has an empty entry.

    Raises
    ------
    MissionInputError
        If a text has another form, or the binding has no such name.
    """
    values_by_role: dict[str, dict[str, tuple[float, ...]]] = {role: {} for role in _ROLES}
    for text in texts:
        name, equals_sign, values_text = text.partition("=")
        # NAME, or ROLE.NAME
        role, _, inner_name = name.partition(".")
        if role in _ROLES and inner_name in getattr(binding, role):
            matches = [(role, inner_name)]
        else:
            matches = [(role, name) for role in _ROLES if name in getattr(binding, role)]
        if not equals_sign or not matches:
            known_names = [f"{role}.{key}" for role in _ROLES for key in getattr(binding, role)]
            raise MissionInputError(
                f"--grid must be NAME=VALUES with a name of the binding {binding.name} "
                f"({comma_list(known_names)}), but {text} was given."
            )
        if len(matches) > 1:
            full_names = " or ".join(f"{role}.{key}" for role, key in matches)
            raise MissionInputError(f"{name} is a name of several roles: write {full_names}.")
        role, key = matches[0]
        values_by_role[role][key] = _parse_values(values_text, text)
    return values_by_role


def _parse_values(values_text: str, text: str) -> tuple[float, ...]:
    """Return the numbers of VALUES in the text `NAME=VALUES` that a user gave."""
    try:
        if ":" in values_text:
            first, last, count = values_text.split(":")
            if not 1 <= int(count) <= LARGEST_COUNT:
                raise ValueError
            numbers = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            numbers = [float(part) for part in values_text.split(",")]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError
    except ValueError:
        raise MissionInputError(
            "--grid must give numbers, as 0,0.2,0.4 or as FIRST:LAST:COUNT with a count of 1 to "
            f"{LARGEST_COUNT}, but {text} was given."
        ) from None
    return tuple(numbers)


def grid_of_fmu(
    fmu: Path,
    binding_file: Path,
    texts: Sequence[str],
    *,
    role: str | None = None,
    settling_steps: int = 0,
) -> SamplingGrid:
    """Return the grid over a user's values of an FMU's inputs.

    The controls are all combinations of the values of the control inputs; an FMU without control
    inputs has a single control.

    Parameters
    ----------
    fmu, binding_file : Path
        The paths of the FMU and of its binding.
    texts : sequence of str
        The values, as `parse_grid` reads them.
    role : str, optional
        The observed quantity, by its name in the binding; by default the only one of the binding.
    settling_steps : int
        The number of steps from a fresh start at every point; 0 for an FMU without memory.

    Raises
    ------
    MissionInputError
        If a text cannot be read, a load or more than one parameter has several values, or the
        binding has several observed quantities and no role is given.
    """
    binding = load_binding(binding_file)
    values_by_role = parse_grid(texts, binding)
    if role is None:
        if len(binding.observation) != 1:
            raise MissionInputError(
                f"the binding {binding.name} observes {comma_list(binding.observation)}: choose "
                "one with --role."
            )
        role = next(iter(binding.observation))
    for name, values in values_by_role["load"].items():
        if len(values) > 1:
            raise MissionInputError(
                f"the load {name} can have one value, but {len(values)} were given."
            )
    parameters = values_by_role["parameter"]
    swept_parameters = [name for name, values in parameters.items() if len(values) > 1]
    if len(swept_parameters) > 1:
        raise MissionInputError(
            f"a library has one uncertain parameter, but {', '.join(swept_parameters)} were given "
            "with several values."
        )
    parameter = swept_parameters[0] if swept_parameters else ""
    draws = parameters.pop(parameter, (0.0,))
    return SamplingGrid(
        fmu=str(fmu),
        binding=str(binding_file),
        role=role,
        parameter=parameter,
        draws=draws,
        states=values_by_role["health"],
        controls=(
            _combined_controls(values_by_role["control"]) if binding.control else {"none": {}}
        ),
        load={name: values[0] for name, values in values_by_role["load"].items()},
        parameters={name: values[0] for name, values in parameters.items()},
        settling_steps=settling_steps,
        step_timeout=binding.limits.step_time or STEP_TIMEOUT,
    )


def _combined_controls(
    inputs: Mapping[str, tuple[float, ...]],
) -> dict[str, dict[str, float]]:
    """Return all combinations of the values of control inputs, by names such as "load = 2"."""
    if not inputs:
        return {}
    control_count = math.prod(len(values) for values in inputs.values())
    if control_count > LARGEST_COUNT:
        raise MissionInputError(
            f"the values of {comma_list(inputs)} make {control_count} controls, and a library "
            f"holds at most {LARGEST_COUNT}: give fewer values."
        )
    controls = {}
    for values in itertools.product(*inputs.values()):
        control = dict(zip(inputs, values, strict=True))
        name = ", ".join(f"{key} = {value:g}" for key, value in control.items())
        controls[name] = control
    return controls


def grid_of_scenario(
    loaded_scenario: LoadedScenario,
    folder: Path,
    texts: Sequence[str] = (),
    *,
    overrides: Overrides | None = None,
    settling_steps: int = 0,
) -> SamplingGrid:
    """Return the grid of the points at which the twin of a scenario needs observations.

    The draws are those of the scenario's calibration and seed. The FMU of the scenario is prepared,
    which may pack it.

    Parameters
    ----------
    folder : Path
        The folder into which the FMU and its binding are copied.
    texts : sequence of str
        Other levels of the states and values of the uncertain parameter, as `parse_grid` reads
        them.
    overrides : Overrides, optional
        The values of the command line that replace those of the scenario.
    settling_steps : int
        The number of steps from a fresh start at every point; 0 for an FMU without memory.

    Raises
    ------
    MissionInputError
        If the scenario does not fly a single FMU, or a text gives values of a control input, a
        load, or a parameter other than the uncertain one.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        If the asset of the scenario cannot be prepared.
    """
    # the FMU that flies
    scenario = resolve_scenario(_without_library(loaded_scenario), overrides)
    flown_source = scenario.asset.source(scenario)
    if not isinstance(flown_source, FmuSource) or isinstance(flown_source, SeveralSource):
        raise MissionInputError(
            f"the scenario {scenario.mission.name} flies an asset of the kind "
            f"`{scenario.asset.kind}`, and one FMU can be sampled."
        )
    believed_source = scenario.belief.source(scenario, flown_source)
    source = (
        flown_source
        if believed_source is flown_source
        else PairedSource(flown_source, believed_source)
    )
    source.check()
    source.prepare(folder, reporter())

    # the values that the user gives instead of those of the scenario
    binding = load_binding(folder / BINDING_COPY)
    values_by_role = parse_grid(texts, binding)
    draws = source.draws(scenario.mission.seed)
    parameters = values_by_role["parameter"]
    gives_other_parameter = any(name != draws.name for name in parameters)
    if gives_other_parameter or values_by_role["control"] or values_by_role["load"]:
        raise MissionInputError(
            f"with a scenario, --grid may name only states and the uncertain parameter "
            f"{draws.name}: controls, loads and other parameters come from the scenario."
        )
    levels = {factor.name: factor.levels for factor in scenario.state}
    values = parameters.get(draws.name, tuple(draws.values.tolist()))
    # Other calibrated parameters are correlated with the uncertain one, and have their conditional
    # expectation at each of its values.
    calibration = read_calibration(scenario.calibration)
    dependent_parameters = {}
    if calibration is not None:
        expectations = calibration.conditional_means(draws.name, np.array(values))
        dependent_parameters = {
            name: tuple(expectations[name].tolist())
            for name in expectations
            if name in binding.parameter
        }
    fixed_parameters = flown_source.parameters()
    fixed_parameters.pop(draws.name, None)
    return SamplingGrid(
        fmu=str(folder / FMU_COPY),
        binding=str(folder / BINDING_COPY),
        role=scenario.observation.role,
        parameter=draws.name,
        draws=values,
        states=levels | values_by_role["health"],
        controls={control.name: dict(control.values) for control in scenario.control},
        load=dict(scenario.asset.constant_load),
        parameters=fixed_parameters,
        others=dependent_parameters,
        settling_steps=settling_steps,
        step_timeout=flown_source.section.step_timeout or binding.limits.step_time or STEP_TIMEOUT,
    )


def _without_library(loaded_scenario: LoadedScenario) -> LoadedScenario:
    """Return the scenario with another belief if its twin believes an observation library.

    The library is yet to be sampled. In its place the twin believes the wing design that the table
    `belief` names, or else the asset itself.
    """
    belief = loaded_scenario.scenario.belief
    if not isinstance(belief, LibraryBelief):
        return loaded_scenario
    if belief.design is None:
        model: AssetBelief | DesignBelief = AssetBelief()
    else:
        model = DesignBelief(design=belief.design)
    scenario = loaded_scenario.scenario.model_copy(update={"belief": model})
    return replace(loaded_scenario, scenario=scenario)
