"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset, checked strictly.

A key of the file may carry its unit (`levels_percent`, `gain_percent`, `standard_deviation_microstrain`);
what is kept here, and in `config.json` of a run, is in SI. Nothing here knows a wing: another asset is
another scenario file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of the sum of probabilities from one, as the graphical model has it."""
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
UNIT_DIVISOR = {"percent": 100.0, "microstrain": 1.0e6, "microstrain_per_step": 1.0e6}

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
Probability = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1.0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Step = Annotated[int, Field(strict=True, ge=0)]
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")]


def _in_si(value: object, divisor: float) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | list | tuple):
        return value
    if isinstance(value, list | tuple):
        return [_in_si(item, divisor) for item in value]
    return value / divisor


def _check_percent(key: object, value: object) -> None:
    for item in value if isinstance(value, list | tuple) else [value]:
        if isinstance(item, int | float) and not isinstance(item, bool) and not -100 <= item <= 100:
            raise ValueError(f"`{key}` is in percent, at most 100, and {item} came")


class Section(BaseModel):
    """A table of the file: unknown keys are refused, and a unit in a key's name is honoured."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    units: ClassVar[Mapping[str, str]] = {}
    """The unit that each key may carry in its name."""

    @model_validator(mode="before")
    @classmethod
    def _convert_units(cls, table: object) -> object:
        if not isinstance(table, Mapping):
            return table
        converted: dict[object, object] = {}
        for key, value in table.items():
            base, unit = cls.split_unit(str(key))
            if base in table and unit:
                raise ValueError(f"`{base}` and `{key}` were both given: keep one of them")
            if unit == "percent":
                _check_percent(key, value)
            converted[base] = _in_si(value, UNIT_DIVISOR[unit]) if unit else value
        return converted

    @classmethod
    def split_unit(cls, key: str) -> tuple[str, str]:
        """Return the key without its unit, and the unit (empty without one)."""
        for base, unit in cls.units.items():
            if key == f"{base}_{unit}":
                return base, unit
        return key, ""


class Mission(Section):
    """What is flown, and for how long."""

    name: Name
    title: str = ""
    description: str = ""
    steps: Count
    prediction_steps: Count = 10
    first_control: Name
    seed: Step = 0


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
            raise ValueError(f"`levels` of state `{self.name}` must increase, and {_short(self.levels)} came")
        if len(self.prior) != len(self.levels):
            raise ValueError(
                f"`prior` of state `{self.name}` must hold one probability for each of its "
                f"{len(self.levels)} levels, and {len(self.prior)} came"
            )
        if abs(sum(self.prior) - 1.0) > ROW_SUM_TOLERANCE:
            raise ValueError(
                f"`prior` of state `{self.name}` must sum to 1, and sums to {sum(self.prior):.12g}"
            )
        return self


class Control(Section):
    """One choice that the twin has, and the value of each control input of the asset under it (SI)."""

    name: Name
    title: str = ""
    values: Annotated[dict[str, Number], Field(min_length=1)]


class ObservationSection(Section):
    """What is observed (a role of the binding) and the sensor noise that the twin assumes."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain"}
    role: Name = "strain"
    count: Count
    unit: str = "1"
    """Unit of the observed values; a dimensionless one is a strain, printed in microstrain."""
    standard_deviation: Positive
    average_over_draws: Literal["outside", "inside"] = "outside"
    """Where the average over the draws of the parameter stands: outside the product over the sensors as in
    the integral (30), or inside it as eq. (32) is printed."""


class Transition(Section):
    """How the state moves in one step under each control; factors move independently given the control."""

    kind: Literal["independent_worsening", "independent_tables"]
    probability: dict[str, Probability | dict[str, Probability]] = {}
    """`independent_worsening`: probability of one level up, for each control (or control and state)."""
    tables: dict[str, dict[str, tuple[tuple[Probability, ...], ...]]] = {}
    """`independent_tables`: for each control and state a square table, rows from, columns to."""


class Rewards(Section):
    """Figures of the rewards, eqs. (9)-(11), and their weights in planning."""

    units: ClassVar[Mapping[str, str]] = {"health_limit": "microstrain", "error_scale": "microstrain"}
    health_limit: Positive
    health_weight: Number = 1.0
    control_weight: Number = 1.0
    error_scale: Positive
    normalise_error_by: Name | None = None
    control: dict[str, Number]


class Planner(Section):
    """Value iteration, eq. (36)."""

    gamma: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)]
    decide_on: Literal["filtered", "predicted"] = "filtered"
    """Which belief the next control is the most probable one of: D_t, or D_{t+1} as predicted."""


class Reference(Section):
    """What a figure of the summary is printed beside, and where that comes from."""

    figure: Name
    value: Number | str
    source: str


class AssetSection(Section):
    """What is flown: an FMU (packed from a wing design, or a file), or a strain library."""

    kind: Literal["fmu", "strain_library"] = "fmu"
    design: str | None = None
    file: str | None = None
    binding: str | None = None
    isolated: Flag = True
    step_timeout: Positive | None = None
    parameters: dict[str, Number] = {}
    load: dict[str, Number] = {}
    observation_model: Literal["design", "asset"] | None = None
    """Where the twin's predicted observations come from: the model of the design, or the asset itself."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind == "strain_library" and not self.file:
            raise ValueError("a strain library needs `file`, the library's path")
        if self.kind == "fmu" and (not self.binding or not (self.design or self.file)):
            raise ValueError("an FMU asset needs `binding` and one of `design` and `file`")
        return self


class Calibration(Section):
    """The uncertain parameter of the model and where its distribution comes from."""

    parameter: Name
    source: Literal["static_test", "normal", "fixed"]
    method: Literal["particle_filter", "exact"] = "exact"
    curve: Literal["published", "design"] = "published"
    draws: Count = 100
    mean: Number | None = None
    standard_deviation: Annotated[float, Field(strict=True, ge=0.0)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.source != "static_test" and self.mean is None:
            raise ValueError(f"calibration source `{self.source}` needs `mean`")
        if self.source == "normal" and self.standard_deviation is None:
            raise ValueError("calibration source `normal` needs `standard_deviation`")
        return self


class Gain(Section):
    """What one factor of the true state gains at each step from `first_step` to `last_step`."""

    units: ClassVar[Mapping[str, str]] = {"gain": "percent"}
    state: Name
    first_step: Step
    last_step: Step | None = None
    gain: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.last_step is not None and self.last_step < self.first_step:
            raise ValueError(f"`last_step` {self.last_step} lies before `first_step` {self.first_step}")
        return self


class Noise(Section):
    """Noise of the real sensors, Gaussian and independent."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain"}
    standard_deviation: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]


class SensorFault(Section):
    """A fault of some sensors (numbered from 1) between two steps, the last one included."""

    units: ClassVar[Mapping[str, str]] = {"rate": "microstrain_per_step"}
    kind: Literal["dropout", "drift"]
    sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)]
    first_step: Step
    last_step: Step | None = None
    rate: Number | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.kind == "drift") != (self.rate is not None):
            raise ValueError("a drift needs `rate_microstrain_per_step`, and a dropout has none")
        if self.last_step is not None and self.last_step < self.first_step:
            raise ValueError(f"`last_step` {self.last_step} lies before `first_step` {self.first_step}")
        return self


class Truth(Section):
    """What really happens, unseen by the twin: damage, sensor noise and faults."""

    kind: Literal["scripted", "random_growth"]
    gains: tuple[Gain, ...] = ()
    noise: Noise
    sensor_faults: tuple[SensorFault, ...] = ()


class Scenario(Section):
    """A whole scenario, in SI."""

    format: Literal[1]
    mission: Mission
    state: Annotated[tuple[StateFactor, ...], Field(min_length=1)]
    control: Annotated[tuple[Control, ...], Field(min_length=1)]
    observation: ObservationSection
    transition: Transition
    rewards: Rewards
    planner: Planner
    asset: AssetSection
    calibration: Calibration
    truth: Truth
    reference: tuple[Reference, ...] = ()

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state factors, the outermost first."""
        return tuple(factor.name for factor in self.state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls in their order."""
        return tuple(control.name for control in self.control)

    @property
    def figure_names(self) -> tuple[str, ...]:
        """Names of all figures that the summary of this scenario can give, and a reference can name."""
        names = [*FALLBACK_FIGURES]
        names += [f"filtered_rms_error_{name}" for name in self.state_names]
        names += [f"mean_reward_{name}" for name in REWARD_NAMES]
        names += [f"{self.calibration.parameter}_{moment}" for moment in ("mean", "standard_deviation")]
        names += ["log_evidence"]
        if any(fault.kind == "dropout" for fault in self.truth.sensor_faults):
            names += ["lost_observations", "blind_steps"]
        if self.observation.unit == "1":
            names += ["strain_error_bound"]
        return tuple(names)

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data in SI; `Scenario.model_validate` reads it back."""
        return self.model_dump(mode="json")

    @model_validator(mode="after")
    def _check(self) -> Self:
        states, controls = self.state_names, self.control_names
        for what, names in (("state", states), ("control", controls)):
            if len(set(names)) != len(names):
                raise ValueError(f"each {what} needs a name of its own, and the names are {_short(names)}")
        roles = set(self.control[0].values)
        for control in self.control:
            if set(control.values) != roles:
                raise ValueError(
                    f"every control must give a value to the same inputs: `{controls[0]}` gives "
                    f"{_short(sorted(roles))} and `{control.name}` gives {_short(sorted(control.values))}"
                )
        _known(self.mission.first_control, controls, "mission.first_control", "control")
        _same(self.rewards.control, controls, "rewards.control", "control")
        norm = self.rewards.normalise_error_by
        if norm is not None:
            _known(norm, tuple(sorted(roles)), "rewards.normalise_error_by", "control input")
            if any(control.values[norm] <= 0.0 for control in self.control):
                raise ValueError(
                    f"`rewards.normalise_error_by` divides by `{norm}`, which must be positive in every "
                    "control"
                )
        self._check_transition()
        referred = [entry.figure for entry in self.reference]
        for name in referred:
            _known(name, self.figure_names, "reference.figure", "figure of the summary")
            if referred.count(name) > 1:
                raise ValueError(f"`reference` gives `{name}` more than once: keep one of them")
        if self.truth.kind == "random_growth" and self.truth.gains:
            raise ValueError("`truth.gains` belongs to the kind `scripted`, and the kind is `random_growth`")
        for gain in self.truth.gains:
            _known(gain.state, states, "truth.gains.state", "state")
        for fault in self.truth.sensor_faults:
            if fault.sensors != "all" and max(fault.sensors) > self.observation.count:
                raise ValueError(
                    f"`truth.sensor_faults.sensors` counts from 1 to {self.observation.count}, "
                    f"and {max(fault.sensors)} came"
                )
        return self

    def _check_transition(self) -> None:
        transition = self.transition
        if transition.kind == "independent_worsening":
            if transition.tables:
                raise ValueError("`transition.tables` belongs to the kind `independent_tables`")
            _same(transition.probability, self.control_names, "transition.probability", "control")
            for name, entry in transition.probability.items():
                if isinstance(entry, dict):
                    _same(entry, self.state_names, f"transition.probability.{name}", "state")
            return
        if transition.probability:
            raise ValueError("`transition.probability` belongs to the kind `independent_worsening`")
        _same(transition.tables, self.control_names, "transition.tables", "control")
        for name, tables in transition.tables.items():
            _same(tables, self.state_names, f"transition.tables.{name}", "state")
            for factor in self.state:
                size = len(factor.levels)
                table = tables[factor.name]
                if len(table) != size or any(len(row) != size for row in table):
                    raise ValueError(
                        f"`transition.tables.{name}.{factor.name}` must be {size} rows of {size} "
                        "probabilities"
                    )
                worst = max(abs(sum(row) - 1.0) for row in table)
                if worst > ROW_SUM_TOLERANCE:
                    raise ValueError(
                        f"each row of `transition.tables.{name}.{factor.name}` must sum to 1, "
                        f"one misses it by {worst:.3g}"
                    )


def _short(values: object) -> str:
    if isinstance(values, list | tuple):
        return ", ".join(str(value) for value in values)
    return str(values)


def _known(name: str, names: tuple[str, ...], where: str, what: str) -> None:
    if name not in names:
        raise ValueError(f"`{where}` must name a {what} ({_short(names)}), and `{name}` came")


def _same(table: Mapping[str, object], names: tuple[str, ...], where: str, what: str) -> None:
    if set(table) != set(names):
        came = _short(list(table)) or "none"
        raise ValueError(f"`{where}` must have one entry for each {what} ({_short(names)}), and has {came}")
