"""What a user asks to be sampled, the grid that comes of it, and one worker's way through a block of it."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path

import numpy as np

from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuEndedError, FmuError, FmuInputError, FmuOutputError
from reporting.arrays import Float
from reporting.progress import reporter
from twin_master.assets.asset_source import BINDING_COPY, AssetBelief, PairedSource
from twin_master.assets.coupled_source import SeveralSource
from twin_master.assets.design_source import DesignBelief
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.library_source import LibraryBelief
from twin_master.assets.parameter import read_calibration
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import MissionInputError, said
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.section import LARGEST_COUNT

STEP_TIMEOUT = 60.0
"""Wall-clock limit of a step where nothing else is said [s]."""
MEMORY_TOLERANCE = 1e-8
"""Two visits of a point that differ by more than this share of the value show that the FMU remembers."""
SETTLED_TOLERANCE = 1e-3
"""What may still change, as a share of the value, when a point is given as many steps again to settle."""

_LONGEST_BLOCK = 4096
_BLOCKS = 64


@dataclass(frozen=True)
class SamplingGrid:
    """What is sampled; plain values.

    Attributes
    ----------
    fmu, binding : str
        The files.
    role : str
        Observation of the binding.
    parameter : str
        The uncertain parameter; empty without one.
    draws : tuple of float
        Its values; one, of no meaning, without a parameter.
    states : dict of str to tuple of float
        Levels of each state factor, the outermost first.
    controls : dict of str to dict of str to float
        Value of each control input under each control.
    load, parameters : dict of str to float
        What else is set; parameters but the uncertain one.
    others : dict of str to tuple of float
        Parameters that are others at each draw.
    settling_steps : int
        Steps from a fresh start at every point; 0 for an FMU without memory.
    step_timeout : float
        Wall-clock limit of a step [s].
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
        """Number of draws, levels of each factor, and controls."""
        return (len(self.draws), *(len(levels) for levels in self.states.values()), len(self.controls))

    @property
    def size(self) -> int:
        """Number of points."""
        return prod(self.shape)

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """First and last point (excluded) of each block; they depend on nothing but the grid."""
        length = min(_LONGEST_BLOCK, max(1, -(-self.size // _BLOCKS)))
        return tuple((first, min(first + length, self.size)) for first in range(0, self.size, length))

    def point(self, index: int) -> tuple[int, dict[str, float], str]:
        """Return draw, state and name of the control of a point."""
        draw, *levels, control = (int(part) for part in np.unravel_index(index, self.shape))
        state = {
            name: float(values[level])
            for (name, values), level in zip(self.states.items(), levels, strict=True)
        }
        return draw, state, list(self.controls)[control]


class GridSampler:
    """An FMU that is asked for the observations of blocks of a grid.

    Every block begins with a reset, so that what it gives does not depend on the blocks before it.

    Parameters
    ----------
    grid : SamplingGrid
        What is sampled.

    Raises
    ------
    FmuError
        The FMU cannot be opened, or binding or grid do not fit it.
    """

    def __init__(self, grid: SamplingGrid) -> None:
        self._grid = grid
        self._asset = FmiAsset(grid.fmu, grid.binding, step_timeout=grid.step_timeout)
        self._chosen = self._asset.binding.observation_slice(grid.role)

    def close(self) -> None:
        """End the FMU."""
        self._asset.close()

    def block(self, first: int, last: int) -> Float:
        """Return the observations (last - first, G).

        Raises
        ------
        MissionInputError
            The FMU has a memory, or does not settle.
        FmuError
            The FMU failed; the sentence names the point.
        """
        length = 1 if self._grid.settling_steps else self._grid.size // len(self._grid.draws)
        parts, end = [], first
        while end < last:
            begin, end = end, min(end - end % length + length, last)
            self._start(begin)
            parts.append(self._ask(begin, end))
        values = np.concatenate(parts)
        again = last - 1 if self._grid.settling_steps else begin  # with other points in between
        self._check_again(again, values[again - first])
        return values

    def _start(self, index: int) -> None:
        grid = self._grid
        draw, state, control = grid.point(index)
        setting = dict(grid.parameters) | {name: values[draw] for name, values in grid.others.items()}
        if grid.parameter:
            setting[grid.parameter] = grid.draws[draw]
        try:
            if grid.settling_steps:
                self._asset.reset(setting, control=grid.controls[control], health=state, load=grid.load)
            else:
                self._asset.reset(setting)
        except FmuError as error:
            raise self._located(error, index) from error

    def _ask(self, first: int, last: int) -> Float:
        """Return the observations of points of one draw, of which each may have its steps to settle."""
        grid, before = self._grid, self._asset.step_index
        steps = max(grid.settling_steps, 1)
        points = [point for point in map(grid.point, range(first, last)) for _ in range(steps)]
        controls = [grid.controls[control] for _, _, control in points]
        try:
            seen = self._asset.simulate(
                {name: [control[name] for control in controls] for name in controls[0]},
                {name: [state[name] for _, state, _ in points] for name in grid.states},
                grid.load,
                steps=len(points),
            )
            if seen.ended:
                raise FmuEndedError(seen.ended)
        except FmuInputError:
            raise  # before the first step; it names the value
        except FmuError as error:
            made = self._asset.step_index - before - isinstance(error, FmuOutputError)
            raise self._located(error, first + min(made // steps, last - first - 1)) from error
        return seen.values[steps - 1 :: steps, self._chosen]

    def _located(self, error: FmuError, index: int) -> FmuError:
        # What ends a worker is located by its last report only.
        later = not isinstance(error, FmuCallError | FmuInputError | FmuOutputError)
        where = "at or soon after" if later else "at"
        return type(error)(f"{where} {self._name(index)}: {error.sentence}", error.messages)

    def _name(self, index: int) -> str:
        grid = self._grid
        draw, state, control = grid.point(index)
        parts = [f"{name} = {value:g}" for name, value in state.items()] + [f"control {control}"]
        if grid.parameter:
            parts.append(f"{grid.parameter} = {grid.draws[draw]:g}")
        return ", ".join(parts)

    def _check_again(self, index: int, before: Float) -> None:
        """Ask for a point once more: an FMU without memory shows the same, one that has settled nearly so."""
        steps = self._grid.settling_steps
        again = self._ask(index, index + 1)[0]
        change = np.abs(again - before)
        tolerance = SETTLED_TOLERANCE if steps else MEMORY_TOLERANCE
        if not np.any(change > tolerance * np.maximum(np.abs(before), np.abs(again))):
            return
        worst = int(np.argmax(change))
        sensor = self._asset.binding.observation[self._grid.role].variables[worst]
        shown = f"{sensor} = {before[worst]:.9g}"
        of = {"grid": self._grid, "place": self._name(index), "shown": shown, "later": again[worst]}
        why = said("library.unsettled" if steps else "library.remembers", **of)
        raise MissionInputError(why)


_ROLES = ("health", "control", "load", "parameter")


def parse_grid(texts: Sequence[str], binding: Binding) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return the values of `NAME=VALUES` texts by role and name.

    NAME is a name of the binding, or ROLE.NAME where two roles share it; VALUES are numbers with commas, or
    FIRST:LAST:COUNT.

    Raises
    ------
    MissionInputError
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
            raise MissionInputError(why)
        if len(places) > 1:
            full = " or ".join(f"{role}.{key}" for role, key in places)
            raise MissionInputError(f"{name} is a name of several roles: write {full}.")
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
        raise MissionInputError(said("library.numbers", most=LARGEST_COUNT, text=text)) from None
    return tuple(numbers)


def grid_of_fmu(
    fmu: Path,
    binding_file: Path,
    texts: Sequence[str],
    *,
    role: str | None = None,
    settling_steps: int = 0,
) -> SamplingGrid:
    """Return the grid over the values of the inputs; controls are all their combinations.

    Raises
    ------
    MissionInputError
        A text is wrong, something has several values that can have one, or the role is not told.
    """
    binding = load_binding(binding_file)
    given = parse_grid(texts, binding)
    if role is None:
        if len(binding.observation) != 1:
            raise MissionInputError(said("library.role", binding=binding))
        role = next(iter(binding.observation))
    swept = [name for name, values in given["parameter"].items() if len(values) > 1]
    if len(swept) > 1:
        raise MissionInputError(said("library.one_parameter", names=", ".join(swept)))
    parameter = swept[0] if swept else ""
    inputs = given["control"]
    controls = {}
    combinations = math.prod(len(values) for values in inputs.values())
    if combinations > LARGEST_COUNT:
        numbers = {"combinations": combinations, "most": LARGEST_COUNT}
        raise MissionInputError(said("library.controls", inputs=inputs, **numbers))
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
        step_timeout=binding.limits.step_time or STEP_TIMEOUT,
    )


def _single(role: str, given: dict[str, tuple[float, ...]]) -> dict[str, float]:
    for name, values in given.items():
        if len(values) > 1:
            what = f"{role} {name}"
            raise MissionInputError(said("library.single", what=what, number=len(values)))
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
    MissionInputError
        The scenario flies no FMU, or a text gives something else.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        The asset of the scenario cannot be prepared.
    """
    belief = loaded.scenario.belief
    if isinstance(belief, LibraryBelief):  # which is to be sampled
        plain = AssetBelief() if belief.design is None else DesignBelief(design=belief.design)
        loaded = replace(loaded, scenario=loaded.scenario.model_copy(update={"belief": plain}))
    scenario = resolve_scenario(loaded, overrides)
    flown = scenario.asset.source(scenario)
    if not isinstance(flown, FmuSource) or isinstance(flown, SeveralSource):
        raise MissionInputError(said("library.kind", scenario=scenario))
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
        raise MissionInputError(said("library.scenario", name=draws.name))
    fixed = {name: value for name, value in flown.parameters().items() if name != draws.name}
    values = swept.get(draws.name, tuple(draws.values.tolist()))
    found = read_calibration(scenario.calibration)
    others = {} if found is None else found.given(draws.name, np.array(values))
    return SamplingGrid(
        fmu=str(folder / FMU_COPY),
        binding=str(folder / BINDING_COPY),
        role=scenario.observation.role,
        parameter=draws.name,
        draws=values,
        states=states,
        controls={control.name: dict(control.values) for control in scenario.control},
        load=dict(scenario.asset.constant_load),
        parameters=fixed,
        others={name: tuple(at.tolist()) for name, at in others.items() if name in binding.parameter},
        settling_steps=settling_steps,
        step_timeout=flown.section.step_timeout or binding.limits.step_time or STEP_TIMEOUT,
    )
