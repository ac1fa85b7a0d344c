"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset, checked strictly.

A key of the file may carry its unit (`levels_percent`, `gain_percent`, `standard_deviation_microstrain`);
what is kept here, and in `config.json` of a run, is in SI. Nothing here knows a wing: another asset is
another scenario file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from twin_master.scenario_section import (
    Count,
    Flag,
    Name,
    NotNegative,
    Number,
    PerSensor,
    Positive,
    Probability,
    Section,
    Step,
    check_one_or_each,
)

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
MISFIT_FIGURES = ("model_misfit_rms", "model_misfit_largest")
"""Figures of the summary that say by how much asset and twin's model differ."""


class Mission(Section):
    """What is flown, and for how long."""

    name: Name
    title: str = ""
    description: str = ""
    steps: Count
    prediction_steps: Count = 10
    first_control: Name
    seed: Step = 0
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

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain", "model_error": "percent"}
    role: Name = "strain"
    count: Count
    titles: tuple[str, ...] = ()
    """What each sensor is called in the report; without them they have numbers."""
    unit: str | tuple[str, ...] = "1"
    """Unit of the observed values, one for all sensors or one for each; a strain without unit is printed in
    microstrain."""
    standard_deviation: PerSensor
    """Of the noise that the twin assumes, one for all sensors or one for each."""
    model_error: NotNegative | tuple[NotNegative, ...] = 0.0
    """Standard deviation of the predicted value as a share of it, one for all sensors or one for each; added
    to the noise in quadrature."""
    average_over_draws: Literal["outside", "inside"] = "outside"
    """Where the average over the draws of the parameter stands: outside the product over the sensors as in
    the integral (30), or inside it as eq. (32) is printed."""

    @property
    def sensor_units(self) -> tuple[str, ...]:
        """Unit of each sensor."""
        return (self.unit,) * self.count if isinstance(self.unit, str) else self.unit

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key, value in (("unit", self.unit), ("standard_deviation", self.standard_deviation)):
            check_one_or_each(f"observation.{key}", value, self.count)
        if self.titles:
            check_one_or_each("observation.titles", self.titles, self.count)
        return self


class Transition(Section):
    """How the state moves in one step under each control; factors move independently given the control."""

    kind: Literal["independent_worsening", "independent_tables"]
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`independent_worsening`: probability of one level up, for each control (or control and state)."""
    tables: dict[str, dict[str, tuple[tuple[Probability, ...], ...]]] = Field(default_factory=dict)
    """`independent_tables`: for each control and state a square table, rows from, columns to."""


class Rewards(Section):
    """Figures of the rewards, eqs. (9)-(11), and their weights in planning."""

    units: ClassVar[Mapping[str, str]] = {"health_limit": "microstrain", "error_scale": "microstrain"}
    health_limit: PerSensor
    """Value at which the health reward is zero, one for all sensors that count for it or one for each."""
    health_sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)] = "all"
    """Sensors, numbered from 1, that have a limit and so count for the health reward."""
    health_weight: Number = 1.0
    control_weight: Number = 1.0
    error_scale: PerSensor
    """Distance of observation and model that costs one, one for all sensors or one for each."""
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


class ComponentSection(Section):
    """One FMU of a coupled asset: a file, a companion by its name, or packed from a wing design."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$")]
    fmu: str | None = None
    design: str | None = None
    substeps: Count = 1
    """Steps that it makes in one step of the system."""
    parameters: dict[str, Flag | Number | str] = Field(default_factory=dict)
    """By the FMU's names and in its units; `gain[{1..4}]` stands for four of them."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.fmu is None) == (self.design is None):
            raise ValueError(f"the component `{self.name}` needs one of `fmu` and `design`")
        return self


class ConnectionSection(Section):
    """What flows from one FMU of a coupled asset to another, or to and from the asset itself."""

    source: Annotated[str, Field(min_length=1)]
    target: Annotated[str, Field(min_length=1)]
    factor: Number = 1.0
    offset: Number = 0.0
    delayed: Flag = False


class AssetSection(Section):
    """What is flown: an FMU (packed from a wing design, or a file), several of them, or a strain library."""

    kind: Literal["fmu", "coupled", "strain_library"] = "fmu"
    design: str | None = None
    file: str | None = None
    script: str | None = None
    """A pythonfmu script that is packed as the FMU: a shipped one, or a file."""
    binding: str | None = None
    isolated: Flag = True
    step_timeout: Positive | None = None
    parameters: dict[str, Number] = Field(default_factory=dict)
    load: dict[str, Number] = Field(default_factory=dict)
    observation_model: Literal["design", "asset", "library"] | None = None
    """Where the twin's predicted observations come from: the model of the design (the default where there is
    one), the asset itself, or the observation library `library`."""
    library: str | None = None
    """An observation library, as `uav-twin library sample` writes it."""
    seeds: tuple[Name, ...] = ()
    """Parameters of the binding that are given a number drawn from the seed of the run."""
    component: tuple[ComponentSection, ...] = ()
    connection: tuple[ConnectionSection, ...] = ()
    algorithm: Literal["gauss_seidel", "jacobi"] = "gauss_seidel"
    iterations: Count = 1
    tolerance: Positive = 1e-9

    @property
    def model_of_the_design(self) -> bool:
        """Whether the twin believes the model of the design."""
        return self.design is not None and self.observation_model in (None, "design")

    @property
    def another_model(self) -> bool:
        """Whether what is flown is known to be another model than the one that the twin believes."""
        return self.kind == "strain_library" and self.model_of_the_design

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind != "coupled" and (self.component or self.connection):
            raise ValueError("`component` and `connection` belong to the kind `coupled`")
        if self.kind == "coupled" and (not self.binding or bool(self.file) == bool(self.component)):
            raise ValueError("a coupled asset needs `binding` and either `file`, an SSP file, or `component`")
        if self.kind == "coupled" and self.file and self.connection:
            raise ValueError("the connections of an SSP file stand in it: leave out `connection`")
        names = [component.name for component in self.component]
        if len(set(names)) != len(names):
            raise ValueError(f"each component needs a name of its own, and the names are {_short(names)}")
        for name in self.seeds:
            if name in self.parameters:
                raise ValueError(f"`{name}` is both in `parameters` and in `seeds`: keep one of them")
        if self.kind == "fmu" and (not self.binding or not (self.design or self.file or self.script)):
            raise ValueError("an FMU asset needs `binding` and one of `design`, `file` and `script`")
        if self.script and self.kind != "fmu":
            raise ValueError("`script` is packed as one FMU, and belongs to the kind `fmu`")
        if self.script and (self.file or self.design):
            raise ValueError(
                f"`script` is packed as the FMU that is flown, and `{'file' if self.file else 'design'}` "
                "names another: keep one of them"
            )
        if (self.observation_model == "library") != (self.library is not None):
            raise ValueError(
                '`observation_model = "library"` and `library`, the file of an observation library, go '
                f"together, and only {'the second' if self.library else 'the first'} was given"
            )
        if self.observation_model == "design" and self.design is None:
            raise ValueError(
                '`observation_model = "design"` needs `design`, the wing whose model the twin believes'
            )
        if self.kind == "strain_library":
            self._check_library()
        return self

    def _check_library(self) -> None:
        for key in ("binding", "parameters", "load", "script", "library"):
            if getattr(self, key):
                raise ValueError(
                    f"`{key}` belongs to an FMU, and the asset is a strain library, which is what it is: "
                    f"leave `{key}` out"
                )
        if self.design is not None and self.observation_model == "asset":
            raise ValueError(
                "a strain library that is both asset and model leaves nothing to do for `design`: leave it "
                'out, or set `observation_model = "design"`'
            )


class Calibration(Section):
    """The uncertain parameter of the model and where its distribution comes from."""

    parameter: Name
    source: Literal["static_test", "normal", "fixed", "file"]
    file: str | None = None
    """The calibration of a wing (`calibration.nc`), for the source `file`."""
    method: Literal["particle_filter", "exact"] = "exact"
    curve: Literal["published", "design"] = "published"
    draws: Count = 100
    mean: Number | None = None
    standard_deviation: Annotated[float, Field(strict=True, ge=0.0)] | None = None

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
    standard_deviation: NotNegative | tuple[NotNegative, ...]
    """One for all sensors or one for each."""


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
    """What really happens, unseen by the twin: damage, sensor noise and faults.

    With the kind `asset`, all of it happens inside the asset, and is read back for scoring only.
    """

    kind: Literal["scripted", "random_growth", "asset"]
    gains: tuple[Gain, ...] = ()
    noise: Noise = Noise(standard_deviation=0.0)
    sensor_faults: tuple[SensorFault, ...] = ()
    state: dict[str, Name] = Field(default_factory=dict)
    """`asset`: for each state, the monitor of the binding that tells its true value."""
    observation: Name | None = None
    """`asset`: the observation of the binding that is free of noise; that of the scenario if absent."""
    received: Name | None = None
    """`asset`: the observation of the binding that is 0 where a sensor is lost."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind == "asset":
            if self.gains or self.sensor_faults or self.noise.standard_deviation:
                raise ValueError(
                    "the kind `asset` leaves damage, noise and faults to the asset: leave out `truth.gains`, "
                    "`truth.noise` and `truth.sensor_faults`"
                )
        elif self.state or self.observation or self.received:
            raise ValueError("`state`, `observation` and `received` of `truth` belong to the kind `asset`")
        elif "noise" not in self.model_fields_set:
            raise ValueError("`truth.noise` is missing")
        return self


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
        if self.truth.received or any(fault.kind == "dropout" for fault in self.truth.sensor_faults):
            names += ["lost_observations", "blind_steps"]
        if self.asset.another_model:
            names += [*MISFIT_FIGURES]
        if set(self.observation.sensor_units) == {"1"}:
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
        if self.truth.kind == "asset":
            if self.asset.kind == "strain_library":
                raise ValueError("`truth.kind` `asset` needs an FMU, and the asset is a strain library")
            _same(self.truth.state, states, "truth.state", "state")
        if self.truth.kind == "random_growth" and self.truth.gains:
            raise ValueError("`truth.gains` belongs to the kind `scripted`, and the kind is `random_growth`")
        for gain in self.truth.gains:
            _known(gain.state, states, "truth.gains.state", "state")
        self._check_model_error()
        self._check_sensors()
        for fault in self.truth.sensor_faults:
            if fault.sensors != "all" and max(fault.sensors) > self.observation.count:
                raise ValueError(
                    f"`truth.sensor_faults.sensors` counts from 1 to {self.observation.count}, "
                    f"and {max(fault.sensors)} came"
                )
        return self

    def _check_model_error(self) -> None:
        error = self.observation.model_error
        if isinstance(error, tuple) and len(error) != self.observation.count:
            raise ValueError(
                f"`observation.model_error_percent` must be one number or one for each of the "
                f"{self.observation.count} sensors, and {len(error)} came"
            )

    def _check_sensors(self) -> None:
        count, chosen = self.observation.count, self.rewards.health_sensors
        if chosen != "all" and (max(chosen) > count or len(set(chosen)) != len(chosen)):
            raise ValueError(
                f"`rewards.health_sensors` must name different sensors from 1 to {count}, and "
                f"{_short(chosen)} came"
            )
        limited = count if chosen == "all" else len(chosen)
        check_one_or_each("rewards.health_limit", self.rewards.health_limit, limited)
        check_one_or_each("rewards.error_scale", self.rewards.error_scale, count)
        check_one_or_each("truth.noise.standard_deviation", self.truth.noise.standard_deviation, count)

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
