"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset, checked strictly.

A key of the file may carry its unit (`levels_percent`, `gain_percent`, `standard_deviation_microstrain`);
what is kept here, and in `config.json` of a run, is in SI. Nothing here knows a wing: another asset is
another scenario file.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, model_validator

from twin_master.scenario.asset import AssetSection, BeliefSection, FileSection
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.section import (
    Count,
    Name,
    NotNegative,
    Number,
    Probability,
    Section,
    Seed,
    check_known,
    check_one_or_each,
    check_same,
    short,
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
from twin_master.sentences import said

LARGEST_STRAIN_NOISE = 0.1
"""Standard deviation of a strain gauge beyond which a unit was forgotten [1]."""
_DECIMALS = 12
"""Sums of scripted gains are rounded to this many digits, so that ten times 2 % and 40 % are 60 %."""
REWARD_NAMES = ("health", "control", "error")
"""The rewards (9)-(11)."""
FALLBACK_FIGURES = (
    "policy_switch_damage",
    "damage_step",
    "fallback_step",
    "fallback_delay",
    "early_fallback_step",
)
"""Figures of the summary that say when the control left that of the first turn."""
MISFIT_FIGURES = ("model_misfit_rms", "model_misfit_largest")
"""Figures of the summary that say by how much asset and twin's model differ."""


NOTICE_FIGURES = ("alarm_step", "none_of_these", "gauge_off", "decided_by")
"""Figures of the summary that say what was noticed."""


class Mission(Section):
    """What is flown, and for how long."""

    name: Name
    title: str = ""
    description: str = ""
    steps: Count
    prediction_steps: Count = 10
    first_control: Name
    seed: Seed = 0
    step_name: Name = "turn"
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

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(b <= a for a, b in zip(self.levels, self.levels[1:], strict=False)):
            raise ValueError(f"`levels` of state `{self.name}` must increase, and {short(self.levels)} came")
        if len(self.prior) != len(self.levels):
            raise ValueError(said("scenario.prior", self=self, counts=(len(self.levels), len(self.prior))))
        if abs(sum(self.prior) - 1.0) > ROW_SUM_TOLERANCE:
            raise ValueError(said("scenario.prior_sum", name=self.name, total=sum(self.prior)))
        return self

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


OPTIONAL_TABLES = ("learning", "notice")
"""Tables without which a scenario says what it said before there were any."""
CALIBRATION_COPY = "asset/calibration.nc"
"""The calibration file inside a run folder."""


class Calibration(FileSection):
    """The uncertain parameter of the model and where its distribution comes from."""

    parameter: Name
    source: Literal["static_test", "normal", "fixed", "file"]
    file: str | None = None
    """The calibration of a wing (`calibration.nc`), for the source `file`."""
    method: Literal["particle_filter", "exact"] = "exact"
    curve: Literal["published", "design"] = "published"
    draws: Count = 100
    mean: Number | None = None
    standard_deviation: NotNegative | None = None

    def copies(self) -> Mapping[str, str]:
        """Return where the copy of the calibration file stands in a run folder."""
        return {"file": CALIBRATION_COPY}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.source == "file") != bool(self.file):
            raise ValueError(
                "calibration source `file` needs `file`, the path of a calibration.nc"
                if self.source == "file"
                else f"`file` belongs to the calibration source `file`, and the source is `{self.source}`"
            )
        if self.source in ("normal", "fixed") and self.mean is None:
            raise ValueError(f"calibration source `{self.source}` needs `mean`")
        if self.source == "normal" and self.standard_deviation is None:
            raise ValueError("calibration source `normal` needs `standard_deviation`")
        return self


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
        """Length of the row that comes of a turn."""
        return self.observation.width + len(self.readings)

    def ends(self, control_index: int) -> bool:
        """Return whether the mission ends with a turn under a control."""
        name = self.control_names[control_index]
        return any(action.ends for action in self.action if action.name == name)

    @property
    def figure_names(self) -> tuple[str, ...]:
        """Names of all figures that the summary of this scenario can give, and a reference can name."""
        names = [*FALLBACK_FIGURES]
        names += [f"filtered_rms_error_{name}" for name in self.state_names]
        names += [f"mean_reward_{name}" for name in REWARD_NAMES]
        names += [f"{self.calibration.parameter}_{moment}" for moment in ("mean", "standard_deviation")]
        if self.learning is not None and self.learning.parameter:
            moments = ["prior_mean", "prior_standard_deviation"]
            moments += ["true"] * (self.calibration.parameter in self.asset.true_parameters)
            names += [f"{self.calibration.parameter}_{moment}" for moment in moments]
        names += ["log_evidence"]
        if self.learning is not None:
            names += self.learning.figure_names
        if self.truth.received or any(fault.kind == "dropout" for fault in self.truth.sensor_faults):
            names += ["lost_observations", "blind_steps"]
        if self.another_model:
            names += [*MISFIT_FIGURES]
        if set(self.observation.sensor_units) == {"1"}:
            names += ["strain_error_bound"]
        if self.notice is not None:
            names += [*NOTICE_FIGURES]
        return tuple(names)

    def scripted_history(self) -> NDArray[np.float64]:
        """Return the scripted true state (T, F), SI: the gain of a step is in the state of that step."""
        gain = np.zeros((self.mission.steps, len(self.state)))
        gain[0] = [factor.start for factor in self.state]
        for entry in self.truth.gains:
            last = entry.first_step if entry.last_step is None else entry.last_step
            gain[entry.first_step : last + 1, self.state_names.index(entry.state)] += entry.gain
        return np.asarray(np.round(np.cumsum(gain, axis=0), _DECIMALS))

    @property
    def another_model(self) -> bool:
        """Whether what is flown is known to be another model than the one that the twin believes."""
        return self.asset.differs_from(self.belief)

    def moved(self, folder: Path) -> Self:
        """Return the scenario with its relative paths from a folder."""
        parts: dict[str, Section] = {name: part.moved(folder) for name, part in self._files().items()}
        return self.model_copy(update=parts | {"watch": self.watch.moved(folder)})

    def portable(self) -> Self:
        """Return the scenario with the paths of the copies inside a run folder."""
        return self.model_copy(update={name: part.portable() for name, part in self._files().items()})

    def _files(self) -> dict[str, FileSection]:
        return {"asset": self.asset, "belief": self.belief, "calibration": self.calibration}

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data in SI; `Scenario.model_validate` reads it back."""
        absent: dict[str, Any] = {name: True for name in OPTIONAL_TABLES if getattr(self, name) is None}
        absent["truth"] = {name for name in ("probability", "record") if not getattr(self.truth, name)}
        if self.observation.modes is None:
            absent["observation"] = {"modes"}
        if not self.action:
            absent |= {"action": True}
        if self.planner.policy == "mode":
            absent |= {"planner": {"policy", "limit_probability", "inspections_a_turn"}}
        return self.model_dump(mode="json", exclude=absent)

    @model_validator(mode="after")
    def _check(self) -> Self:
        states, controls = self.state_names, self.control_names
        for what, names in (("state", states), ("control", controls)):
            if len(set(names)) != len(names):
                raise ValueError(f"each {what} needs a name of its own, and the names are {short(names)}")
        roles = set(self.control[0].values)
        for control in self.control:
            if set(control.values) != roles:
                names = controls[0], control.name
                given = short(sorted(roles)), short(sorted(control.values))
                raise ValueError(said("scenario.inputs", names=names, given=given))
        check_known(self.mission.first_control, controls, "mission.first_control", "control")
        check_same(self.rewards.control, controls, "rewards.control", "control")
        check_known(self.planner.safest or controls[0], controls, "planner.safest", "control")
        norm = self.rewards.normalise_error_by
        if norm is not None:
            check_known(norm, tuple(sorted(roles)), "rewards.normalise_error_by", "control input")
            if any(control.values[norm] <= 0.0 for control in self.control):
                raise ValueError(said("scenario.normaliser", norm=norm))
        self.transition.check(self.control_names, {factor.name: len(factor.levels) for factor in self.state})
        true = self.truth.probability
        if true and (self.truth.kind, self.transition.kind) != ("random_growth", "independent_worsening"):
            raise ValueError(said("scenario.true_probability"))
        if true:
            check_same(true, controls, "truth.probability", "control")
        self._check_actions()
        referred = [entry.figure for entry in self.reference]
        for name in referred:
            check_known(name, self.figure_names, "reference.figure", "figure of the summary")
            if referred.count(name) > 1:
                raise ValueError(f"`reference` gives `{name}` more than once: keep one of them")
        if self.truth.kind == "asset":
            if not self.asset.is_fmu:
                raise ValueError(said("scenario.needs_fmu", kind=self.asset.kind))
            check_same(self.truth.state, states, "truth.state", "state")
        if self.truth.kind == "random_growth" and self.truth.gains:
            raise ValueError("`truth.gains` belongs to the kind `scripted`, and the kind is `random_growth`")
        for gain in self.truth.gains:
            check_known(gain.state, states, "truth.gains.state", "state")
        self._check_sensors()
        self._check_modes()
        for fault in self.truth.sensor_faults:
            if fault.sensors != "all" and max(fault.sensors) > self.observation.count:
                counts = self.observation.count, max(fault.sensors)
                raise ValueError(said("scenario.faults", counts=counts))
        return self

    def _check_actions(self) -> None:
        for action in self.action:
            check_known(action.control, self.control_names, "action.control", "control")
            for state in (*action.inspects, *action.repairs):
                check_known(state, self.state_names, f"action.{action.name}", "state")
            if action.repairs and self.truth.kind != "random_growth" and self.asset.kind != WATCHED_KIND:
                raise ValueError(said("scenario.repairs", name=action.name, kind=self.truth.kind))
        if self.readings and self.observation.modes is not None:
            raise ValueError(said("scenario.modes_inspected"))
        if self.planner.inspections_a_turn is not None and (self.learning or self.notice):
            raise ValueError(said("scenario.inspections"))

    def _check_modes(self) -> None:
        modes, record = self.observation.modes, self.truth.record
        if modes is None:
            if record is not None:
                raise ValueError("`truth.record` belongs to the role `modes` of `observation`")
            return
        for name in ("learning", "notice"):
            if getattr(self, name) is not None:
                raise ValueError(said("scenario.covariance", name=name))
        if self.observation.average_over_draws == "inside":
            raise ValueError("modes are averaged over the draws `outside`: leave out `average_over_draws`")
        if self.asset.kind == WATCHED_KIND:
            return
        if record is None:
            raise ValueError(said("scenario.record"))
        check_known(
            record.input, tuple(sorted(self.control[0].values)), "truth.record.input", "control input"
        )
        if modes.bands[-1][1] > 0.5 * record.sampling_rate:
            rates = record.sampling_rate, 0.5 * record.sampling_rate, modes.bands[-1][1]
            raise ValueError(said("scenario.sampling_rate", rates=rates))

    def _check_sensors(self) -> None:
        count, chosen = self.observation.count, self.rewards.health_sensors
        if chosen != "all" and (max(chosen) > count or len(set(chosen)) != len(chosen)):
            raise ValueError(said("scenario.health_sensors", count=count, chosen=short(chosen)))
        limited = count if chosen == "all" else len(chosen)
        check_one_or_each("rewards.health_limit", self.rewards.health_limit, limited)
        check_one_or_each("rewards.error_scale", self.rewards.error_scale, count)
        if self.learning is not None:
            self.learning.check_sensors(count)
        for table in ("learning", "notice"):
            if getattr(self, table) is not None and self.observation.average_over_draws == "inside":
                raise ValueError(said("scenario.inside", table=table))
        check_one_or_each("truth.noise.standard_deviation", self.truth.noise.standard_deviation, count)
        for key, noise in (("observation", self.observation), ("truth.noise", self.truth.noise)):
            self._check_strain_noise(f"{key}.standard_deviation", noise.standard_deviation)

    def _check_strain_noise(self, key: str, deviation: float | tuple[float, ...]) -> None:
        """Refuse noise in microstrain without its suffix; finer slips are seen when predictions are there."""
        if self.observation.role != "strain":
            return
        units = self.observation.sensor_units
        each = deviation if isinstance(deviation, tuple) else (deviation,) * len(units)
        for unit, given in zip(units, each, strict=True):
            if unit == "1" and given > LARGEST_STRAIN_NOISE:
                most = LARGEST_STRAIN_NOISE
                raise ValueError(said("scenario.strain_noise", key=key, given=given, most=most))
