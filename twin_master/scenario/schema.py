"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset, checked strictly.

A key of the file may carry its unit (`levels_percent`, `gain_percent`, `standard_deviation_microstrain`);
what is kept here, and in `config.json` of a run, is in SI. Nothing here knows a wing: another asset is
another scenario file.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, model_validator

from reporting.toml_file import Fault, NotNegative, Number
from twin_master.errors import said
from twin_master.scenario.section import (
    AssetSection,
    BeliefSection,
    Count,
    FileSection,
    Name,
    ObservationSection,
    Probability,
    Section,
    Seed,
    incomplete,
    named_once,
    one_or_each,
    short,
    unknown,
)
from twin_master.scenario.tables import (
    ROW_SUM_TOLERANCE,
    Action,
    Learning,
    NoticingOrNot,
    Planner,
    Rewards,
    Transition,
    TruthSection,
    WatchSection,
    with_actions,
)

LARGEST_STRAIN_NOISE = 0.1
"""Standard deviation of a strain gauge beyond which a unit was forgotten [1]."""
_DECIMALS = 12
"""Sums of scripted gains are rounded to this many digits, so that ten times 2 % and 40 % are 60 %; to more
where a state is small in its unit."""
REWARD_NAMES = ("health", "control", "error")
"""The rewards (9)-(11)."""
FIGURES: dict[str, dict[str, tuple[str, str]]] = tomllib.loads(
    Path(__file__).with_name("figures.toml").read_text(encoding="utf-8")
)
"""Title and unit of each figure of the summary, by group and key."""


class Mission(Section):
    """What is flown, and for how long."""

    name: Name
    title: str = ""
    description: str = ""
    steps: Count
    prediction_steps: Count = 10
    first_control: Name
    seed: Seed = 0
    step_name: Name = "step"
    """What a step of the mission is called in the report."""


class StateFactor(Section):
    """One factor of the hidden state with its levels and the belief before the first observation."""

    units: ClassVar[Mapping[str, str]] = {"levels": "percent"}
    name: Name
    title: str = ""
    unit: str = "1"
    """Unit of the levels; a dimensionless level is a fraction, printed in percent."""
    levels: Annotated[tuple[Number, ...], Field(min_length=1)]
    prior: Annotated[tuple[Probability, ...], Field(min_length=1)]

    def faults(self) -> Iterator[Fault]:
        """Yield levels that do not increase, and a prior that is none of them."""
        name, levels, prior = self.name, len(self.levels), len(self.prior)
        falls = any(b <= a for a, b in pairwise(self.levels))
        yield falls, f"`levels` of state `{name}` must increase, and {short(self.levels)} came"
        yield prior != levels, said("scenario.prior", name=name, levels=levels, prior=prior)
        total = sum(self.prior)
        yield abs(total - 1.0) > ROW_SUM_TOLERANCE, said("scenario.prior_sum", name=name, total=total)

    @property
    def start(self) -> float:
        """The most probable level before the first observation."""
        return self.levels[self.prior.index(max(self.prior))]


class Control(Section):
    """One choice that the twin has, and the value of each control input of the asset under it (SI)."""

    name: Name
    title: str = ""
    values: Annotated[dict[str, Number], Field(min_length=1)]


class Reference(Section):
    """What a figure of the summary is printed beside, and where that comes from."""

    figure: Name
    value: Number | str
    source: str


CALIBRATION_COPY = "asset/calibration.nc"
"""The calibration file inside a run folder."""


class Calibration(FileSection):
    """The uncertain parameter of the model and where its distribution comes from."""

    parameter: Name
    source: Literal["static_test", "normal", "fixed", "file"]
    file: str | None = None
    """A calibration (`calibration.nc`): beside `mean` and `standard_deviation` for all else that it tells."""
    method: Literal["particle_filter", "exact"] = "exact"
    curve: Literal["published", "design"] = "published"
    draws: Count = 100
    mean: Number | None = None
    standard_deviation: NotNegative | None = None

    kept: ClassVar[Mapping[str, str]] = {"file": CALIBRATION_COPY}

    def faults(self) -> Iterator[Fault]:
        """Yield what a source needs, or does not take."""
        source, given = self.source, bool(self.file)
        yield source == "file" and not given, said("scenario.calibration_file")
        yield source not in ("file", "normal") and given, said("scenario.no_calibration_file", source=source)
        for key, sources in (("mean", ("normal", "fixed")), ("standard_deviation", ("normal",))):
            missing = source in sources and getattr(self, key) is None
            yield missing, f"calibration source `{source}` needs `{key}`"


WATCHED_KIND = "watched"
"""Kind of the asset of a scenario without `[asset]`."""


class Scenario(Section):
    """A whole scenario, in SI."""

    format: Literal[2]
    mission: Mission
    state: Annotated[tuple[StateFactor, ...], Field(min_length=1)]
    control: Annotated[tuple[Control, ...], Field(min_length=1)]
    """With one for each action behind those of the file."""
    action: tuple[Action, ...] = ()
    observation: ObservationSection
    transition: Transition
    rewards: Rewards
    planner: Planner
    asset: SerializeAsAny[AssetSection]
    belief: SerializeAsAny[BeliefSection]
    calibration: Calibration
    truth: TruthSection
    learning: Learning | None = None
    notice: NoticingOrNot = None
    """Of a scenario file on unless it says `notice = false`, see `reading.load_scenario`."""
    watch: WatchSection = WatchSection()
    reference: tuple[Reference, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _of_a_real_asset(cls, table: object) -> object:
        """Let a scenario without `[asset]` and `[truth]` be one of a real asset, and actions be controls."""
        if isinstance(table, Mapping) and table.get("action"):
            table = with_actions(table)
        if not isinstance(table, Mapping) or "asset" in table or "truth" in table:
            return table
        untold = {"kind": "scripted", "noise": {"standard_deviation": 0.0}}
        return {**table, "asset": {"kind": WATCHED_KIND}, "truth": untold}

    @property
    def searchable(self) -> bool:
        """Whether `discrepancy run --from-run` reads its runs: strains of a wing with two regions."""
        return self.observation.role == "strain" and {*self.state_names} == {"z1", "z2"}

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state factors, the outermost first."""
        return tuple(factor.name for factor in self.state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls in their order."""
        return tuple(control.name for control in self.control)

    @property
    def readings(self) -> tuple[tuple[int, int, str, float], ...]:
        """Of each reading of an inspection the places of its control and state, its name, and its deviation.

        They stand in a row behind the values of the sensors, NaN where they were not asked for.
        """
        return tuple(
            (self.control_names.index(action.name), self.state_names.index(state), name, deviation)
            for action in self.action
            for name, state, deviation in action.readings
        )

    @property
    def row_width(self) -> int:
        """Length of the row that comes of a step."""
        return self.observation.width + len(self.readings)

    def ends(self, control_index: int) -> bool:
        """Return whether the mission ends with a step under a control."""
        name = self.control_names[control_index]
        return any(action.ends for action in self.action if action.name == name)

    @property
    def figure_names(self) -> tuple[str, ...]:
        """Names of all figures that the summary of this scenario can give, and a reference can name."""
        parameter, learning = self.calibration.parameter, self.learning
        learns, told = learning is not None and learning.parameter, parameter in self.asset.true_parameters
        lost = self.truth.received or any(fault.kind == "dropout" for fault in self.truth.sensor_faults)
        given: list[tuple[str, object, list[dict[str, str]]]] = [
            ("fallback", True, [{}]),
            ("error", True, [{"state": name} for name in self.state_names]),
            ("reward", True, [{"reward": name} for name in REWARD_NAMES]),
            ("parameter_learnt" if learns else "parameter", True, [{"parameter": parameter}]),
            ("parameter_true", learns and told, [{"parameter": parameter}]),
            ("evidence", True, [{}]),
            *(learning.figures if learning is not None else ()),
            ("lost", lost, [{}]),
            ("blind", lost, [{}]),
            ("misfit", self.another_model, [{}]),
            ("bound", {*self.observation.sensor_units} == {"1"}, [{}]),
            ("notice", self.notice, [{}]),
        ]
        groups = ((FIGURES[group], words) for group, there, each in given if there for words in each)
        return tuple(key.format(**words) for group, words in groups for key in group)

    def scripted_history(self) -> NDArray[np.float64]:
        """Return the scripted true state (T, F), SI: the gain of a step is in the state of that step."""
        gain = np.zeros((self.mission.steps, len(self.state)))
        gain[0] = [factor.start for factor in self.state]
        for entry in self.truth.gains:
            last = entry.first_step if entry.last_step is None else entry.last_step
            gain[entry.first_step : last + 1, self.state_names.index(entry.state)] += entry.gain
        history = np.cumsum(gain, axis=0)
        for state in history.T:
            largest = np.abs(state).max()
            above = math.ceil(math.log10(largest)) if 0.0 < largest < 1.0 else 0
            state[:] = np.round(state, _DECIMALS - above)
        return history

    @property
    def another_model(self) -> bool:
        """Whether what is flown is known to be another model than the one that the twin believes."""
        return self.belief.kind != "asset" and (self.asset.departs or self.belief.departs)

    def moved(self, folder: Path) -> Self:
        """Return the scenario with its relative paths from a folder."""
        parts: dict[str, Section] = {name: part.moved(folder) for name, part in self._files().items()}
        return self.model_copy(update=parts | {"watch": self.watch.moved(folder)})

    def portable(self) -> Self:
        """Return the scenario with the paths of the copies inside a run folder."""
        return self.model_copy(update={name: part.portable() for name, part in self._files().items()})

    def under(self, seed: int) -> Self:
        """Return the scenario under another seed of the run."""
        return self.having("mission", seed=seed)

    def having(self, table: str, **changes: Any) -> Self:
        """Return the scenario with other values in one of its tables, which nobody checks."""
        return self.model_copy(update={table: getattr(self, table).model_copy(update=changes)})

    def _files(self) -> dict[str, FileSection]:
        return {"asset": self.asset, "belief": self.belief, "calibration": self.calibration}

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data in SI; `Scenario.model_validate` reads it back."""
        return self.model_dump(mode="json")

    def faults(self) -> Iterator[Fault]:
        """Yield what the tables have wrong beside each other."""
        yield from self._faults_of_controls()
        yield from self._faults_of_truth()
        yield from self._faults_of_sensors()
        yield from self._faults_of_modes()

    def _faults_of_controls(self) -> Iterator[Fault]:
        states, controls, rewards = self.state_names, self.control_names, self.rewards
        for what, names in (("state", states), ("control", controls)):
            yield named_once(what, names)
        inputs, norm = tuple(sorted(self.control[0].values)), rewards.normalise_error_by
        for control in self.control:
            told = said("scenario.inputs", first=controls[0], roles=inputs, control=control)
            yield {*control.values} != {*inputs}, told
        yield unknown(self.mission.first_control, controls, "mission.first_control", "control")
        yield self._incomplete_tables(controls)
        yield incomplete(rewards.control, controls, "rewards.control", "control")
        yield unknown(self.planner.safest or controls[0], controls, "planner.safest", "control")
        if norm is not None:
            yield unknown(norm, inputs, "rewards.normalise_error_by", "control input")
            divisors = [control.values[norm] for control in self.control]
            yield min(divisors) <= 0.0, said("scenario.normaliser", norm=norm)
        levels = {factor.name: len(factor.levels) for factor in self.state}
        yield from self.transition.faults_among(controls, levels)
        loads = {control.name: control.values for control in self.control}
        for action in self.action:
            yield unknown(action.control, controls, "action.control", "control")
            same = loads.get(action.name, loads[action.control]) == loads[action.control]
            taken = not same or action.name in (action.control, *controls[: -len(self.action)])
            yield taken, f"action `{action.name}` needs a name of its own, and a control has it"
            free = action.cost > 0.0 and rewards.control_weight == 0.0
            yield free, said("scenario.free_action", name=action.name)
            for state in (*action.inspects, *action.repairs):
                yield unknown(state, states, f"action.{action.name}", "state")

    def _incomplete_tables(self, controls: tuple[str, ...]) -> Fault:
        """Return the fault that several tables have not one entry for each control."""
        tables: list[tuple[str, Mapping[str, object]]] = [("rewards.control", self.rewards.control)]
        key = "probability" if self.transition.kind == "independent_worsening" else "tables"
        tables.append((f"transition.{key}", getattr(self.transition, key)))
        if self.truth.probability:
            tables.append(("truth.probability", self.truth.probability))
        faults = [incomplete(table, controls, name, "control") for name, table in tables]
        sentences = [sentence for is_incomplete, sentence in faults if is_incomplete]
        return len(sentences) > 1, "; ".join(sentences)

    def _faults_of_truth(self) -> Iterator[Fault]:
        truth, states, asset = self.truth, self.state_names, self.asset
        grows = truth.kind == "random_growth"
        if truth.probability:
            worsens = self.transition.kind == "independent_worsening"
            yield not (grows and worsens), said("scenario.true_probability")
            yield incomplete(truth.probability, self.control_names, "truth.probability", "control")
        for action in self.action:
            follows = not action.repairs or grows or asset.kind == WATCHED_KIND
            yield not follows, said("scenario.repairs", name=action.name, kind=truth.kind)
        referred = [entry.figure for entry in self.reference]
        for name in referred:
            yield unknown(name, self.figure_names, "reference.figure", "figure of the summary")
            yield referred.count(name) > 1, f"`reference` gives `{name}` more than once: keep one of them"
        if truth.kind == "asset":
            yield not asset.is_fmu, said("scenario.needs_fmu", kind=asset.kind)
            yield incomplete(truth.state, states, "truth.state", "state")
        yield grows and truth.gains, said("scenario.grown_gains")
        for gain in truth.gains:
            yield unknown(gain.state, states, "truth.gains.state", "state")

    def _faults_of_sensors(self) -> Iterator[Fault]:
        observation, rewards, truth = self.observation, self.rewards, self.truth
        count, chosen = observation.count, rewards.health_sensors
        limited = count if chosen == "all" else len(chosen)
        if chosen != "all":
            wrong = max(chosen) > count or len({*chosen}) != limited
            yield wrong, said("scenario.health_sensors", count=count, chosen=chosen)
        yield one_or_each("rewards.health_limit", rewards.health_limit, limited)
        yield one_or_each("rewards.error_scale", rewards.error_scale, count)
        for key in ("gauge_gain", "gauge_offset"):
            yield one_or_each(f"learning.{key}", getattr(self.learning, key, 0.0), count)
        for table in ("learning", "notice"):
            inside = getattr(self, table) and observation.average_over_draws == "inside"
            yield inside, said("scenario.inside", table=table)
        shared = self.planner.inspections_per_step is not None
        yield shared and (self.learning or self.notice), said("scenario.inspections")
        yield one_or_each("truth.noise.standard_deviation", truth.noise.standard_deviation, count)
        # Noise in microstrain without its suffix; finer slips are seen when predictions are there.
        for key, noise in (("observation", observation), ("truth.noise", truth.noise)):
            each, units = np.broadcast_to(noise.standard_deviation, count), observation.sensor_units
            given = max((own for own, unit in zip(each, units, strict=True) if unit == "1"), default=0.0)
            absurd = observation.role == "strain" and given > LARGEST_STRAIN_NOISE
            told = {"key": f"{key}.standard_deviation", "given": given, "most": LARGEST_STRAIN_NOISE}
            yield absurd, said("scenario.strain_noise", **told)
        for fault in truth.sensor_faults:
            last = max(fault.places(count)) + 1
            yield last > count, said("scenario.faults", count=count, came=last)

    def _faults_of_modes(self) -> Iterator[Fault]:
        observation, record = self.observation, self.truth.record
        if observation.modes is None:
            yield record is not None, said("scenario.record_of_modes")
            return
        yield bool(self.readings), said("scenario.modes_inspected")
        for name in ("learning", "notice"):
            yield getattr(self, name) is not None, said("scenario.covariance", name=name)
        yield observation.average_over_draws == "inside", said("scenario.modes_inside")
        if self.asset.kind != WATCHED_KIND:
            yield record is None, said("scenario.record")
        if record is not None and self.asset.kind != WATCHED_KIND:
            inputs, band = tuple(sorted(self.control[0].values)), observation.modes.bands[-1][1]
            yield unknown(record.input, inputs, "truth.record.input", "control input")
            rate = {"rate": record.sampling_rate, "highest": 0.5 * record.sampling_rate}
            yield band > rate["highest"], said("scenario.sampling_rate", **rate, band=band)
