"""Tables of a scenario: how the state moves, the truth, actions, learning, notices, the watch."""

from collections.abc import Iterator, Mapping
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from reporting.toml_file import Fault, NotNegative, Number, Positive
from twin_master.errors import said
from twin_master.scenario.section import (
    Count,
    FileSection,
    Flag,
    Name,
    PerSensor,
    Probability,
    RecordSection,
    Section,
    Step,
    incomplete,
    one_or_each,
    short,
)

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of the sum of probabilities from one, as the graphical model has it."""


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


class Transition(Section):
    """How the state moves in one step under each control; factors move independently given the control."""

    kind: Literal["independent_worsening", "independent_tables"]
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`independent_worsening`: probability of one level up, for each control (or control and state)."""
    tables: dict[str, dict[str, tuple[tuple[Probability, ...], ...]]] = Field(default_factory=dict)
    """`independent_tables`: for each control and state a square table, rows from, columns to."""

    def faults_among(self, controls: tuple[str, ...], levels: Mapping[str, int]) -> Iterator[Fault]:
        """Yield what is missing or too much for the controls, and states with their numbers of levels."""
        worsening = self.kind == "independent_worsening"
        key, other, kind = "probability", "tables", "independent_tables"
        if not worsening:
            key, other, kind = other, key, "independent_worsening"
        yield getattr(self, other), f"`transition.{other}` belongs to the kind `{kind}`"
        given: dict[str, Any] = getattr(self, key)
        yield incomplete(given, controls, f"transition.{key}", "control")
        for name, entry in given.items():
            if isinstance(entry, dict):
                yield incomplete(entry, tuple(levels), f"transition.{key}.{name}", "state")
            for state, size in () if worsening else levels.items():
                told, wide = {"name": name, "state": state}, {size} != {len(row) for row in entry[state]}
                yield wide or len(entry[state]) != size, said("scenario.table_size", **told, size=size)
                worst = max(abs(sum(row) - 1.0) for row in entry[state])
                yield worst > ROW_SUM_TOLERANCE, said("scenario.table_sum", **told, worst=worst)


def probability_of(table: Mapping[str, float | Mapping[str, float]], control: str, state: str) -> float:
    """Return the probability of a factor of the state to worsen under a control."""
    entry = table[control]
    return entry[state] if isinstance(entry, Mapping) else entry


class Span(Section):
    """Steps of a mission, the last one included."""

    first_step: Step
    last_step: Step | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield an end before the beginning."""
        before = self.last_step is not None and self.last_step < self.first_step
        yield before, f"`last_step` {self.last_step} lies before `first_step` {self.first_step}"


class Gain(Span):
    """What one factor of the true state gains at each step from `first_step` to `last_step`."""

    units: ClassVar[Mapping[str, str]] = {"gain": "percent"}
    state: Name
    gain: Number


class Noise(Section):
    """Noise of the real sensors, Gaussian and independent."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain"}
    standard_deviation: NotNegative | tuple[NotNegative, ...]
    """One for all sensors or one for each."""


class SensorFault(Span):
    """A fault of some sensors (numbered from 1) between two steps, the last one included."""

    units: ClassVar[Mapping[str, str]] = {"rate": "microstrain_per_step"}
    kind: Literal["dropout", "drift"]
    sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)]
    rate: Number | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield what a span has, and a rate that the kind has not."""
        yield from super().faults()
        drifts = self.kind == "drift"
        yield drifts != (self.rate is not None), said("scenario.rate")

    def places(self, count: int) -> list[int]:
        """Return the places of its sensors among so many, from 0."""
        return list(range(count)) if self.sensors == "all" else [sensor - 1 for sensor in self.sensors]


class TruthSection(Section):
    """What really happens, unseen by the twin: damage, sensor noise and faults.

    With the kind `asset`, all of it happens inside the asset, and is read back for scoring only.
    """

    kind: Literal["scripted", "random_growth", "asset"]
    gains: tuple[Gain, ...] = ()
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`random_growth`: the true probabilities to worsen, as in `transition`; those of the twin if absent."""
    noise: Noise = Noise(standard_deviation=0.0)
    sensor_faults: tuple[SensorFault, ...] = ()
    state: dict[str, Name] = Field(default_factory=dict)
    """`asset`: for each state, the monitor of the binding that tells its true value."""
    observation: Name | None = None
    """`asset`: the observation of the binding that is free of noise; that of the scenario if absent."""
    received: Name | None = None
    """`asset`: the observation of the binding that is 0 where a sensor is lost."""

    record: RecordSection | None = None
    """Where modes are observed: the record of each step."""

    def faults(self) -> Iterator[Fault]:
        """Yield keys that do not go together."""
        faults, inside = self.sensor_faults or self.noise.standard_deviation, self.kind == "asset"
        if self.record is not None:
            yield inside or faults, said("scenario.record_noise")
        elif inside:
            yield self.gains or faults, said("scenario.asset_truth")
        else:
            yield self.state or self.observation or self.received, said("scenario.told_truth")
            yield "noise" not in self.model_fields_set, "`truth.noise` is missing"


class Action(Section):
    """One choice of a step beside the controls."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "percent"}
    name: Name
    title: str = ""
    control: Name
    """The control whose loads are on the asset in that step."""
    cost: NotNegative
    """What the reward of the step is less than under the control."""
    inspects: tuple[Name, ...] = ()
    """States that are read in that step, and only then."""
    standard_deviation: PerSensor | None = None
    """Of these readings, one for all or one for each."""
    repairs: tuple[Name, ...] = ()
    """States that are at their lowest level in the step after."""
    success: Probability = 1.0
    """Probability with which a repair succeeds, for each state."""
    ends: Flag = False
    """Whether the mission ends with that step."""

    def faults(self) -> Iterator[Fault]:
        """Yield what is not given together, and that it does nothing."""
        alone = bool(self.inspects) != (self.standard_deviation is not None)
        yield alone, said("scenario.inspects", name=self.name)
        yield one_or_each("action.standard_deviation", self.standard_deviation, len(self.inspects))
        idle = not (self.inspects or self.repairs or self.ends)
        yield idle, said("scenario.idle_action", name=self.name)

    @property
    def readings(self) -> tuple[tuple[str, str, float], ...]:
        """Name of each reading, the state that is read, and the standard deviation."""
        given = self.standard_deviation
        each = given if isinstance(given, tuple) else (given or 0.0,) * len(self.inspects)
        return tuple(
            (f"{self.name}_{state}", state, deviation)
            for state, deviation in zip(self.inspects, each, strict=True)
        )


class Planner(Section):
    """How the twin decides: value iteration, eq. (36), or planning on the belief."""

    gamma: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)]
    decide_on: Literal["filtered", "predicted"] = "filtered"
    """Which belief the next control is the most probable one of: D_t, or D_{t+1} as predicted."""
    safest: Name | None = None
    """Control where no state explains the sensors; by default the one with the least load."""
    policy: Literal["mode", "qmdp", "belief"] = "mode"
    """The mode of the control of each state; the best control in the mean over the states, taken as if they
    were known from the next step on; or what is planned on the belief."""
    limit_probability: Annotated[Probability, Field(gt=0.0)] | None = None
    """`belief`: share of the steps, discounted, in which a health limit may be exceeded."""

    inspections_per_step: Count | None = None
    """`belief` and `qmdp`: steps with an inspection that assets which fly side by side have among them."""

    def faults(self) -> Iterator[Fault]:
        """Yield keys of another policy."""
        limited = self.limit_probability is not None and self.policy != "belief"
        yield limited, "`planner.limit_probability` needs `planner.policy` `belief`"
        shared = self.inspections_per_step is not None and self.policy == "mode"
        yield shared, "`planner.inspections_per_step` needs `planner.policy` `belief` or `qmdp`"


def with_actions(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the table of a scenario with an entry for each action wherever there is one for each control.

    What is malformed stays as it is: the schema says what is wrong with it.
    """
    made = deepcopy(dict(table))
    try:
        controls, rewards, truth = made["control"], made["rewards"], made.get("truth", {})
        entries = [made["transition"].get(key) for key in ("probability", "tables")]
        weight = rewards.get("control_weight", 1.0) or 1.0
        for action in made["action"]:
            name, base = action["name"], action["control"]
            known = {control["name"]: control for control in controls}
            if name not in known:
                controls.append(known[base] | {"name": name, "title": action.get("title", "")})
            rewards["control"].setdefault(name, rewards["control"][base] - action["cost"] / weight)
            for entry in filter(None, [*entries, truth.get("probability")]):
                entry.setdefault(name, entry[base])
    except (KeyError, TypeError, ValueError, AttributeError):
        return table
    return made


class Learning(Section):
    """What is learnt, each with its prior; everything else stays as the scenario says it."""

    units: ClassVar[Mapping[str, str]] = {"gauge_gain": "percent", "gauge_offset": "microstrain"}
    parameter: Flag = True
    """The draws of the calibrated parameter keep their weights from step to step."""
    noise: Flag = True
    """The noise scale of each sensor, about the standard deviation that is assumed."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """How sure the assumed noise is: as if it came from so many observations, more than two."""
    gauge_gain: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the relative gain error of each sensor; 0 is not learnt."""
    gauge_offset: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the offset of each sensor, in the unit of the sensors; 0 is not learnt."""
    transition_factors: tuple[Positive, ...] = ()
    """Factors on the probabilities to leave a state, equally probable at first; none is not learnt."""

    def faults(self) -> Iterator[Fault]:
        """Yield factors that do not increase, or are no choice."""
        key, factors = "`learning.transition_factors`", self.transition_factors
        yield any(b <= a for a, b in pairwise(factors)), f"{key} must increase, and {short(factors)} came"
        yield len(factors) == 1, f"{key} needs two or more factors to choose from"

    @property
    def figures(self) -> list[tuple[str, object, list[dict[str, str]]]]:
        """Groups of figures on what is learnt beside the parameter, whether it is, and their words."""
        return [
            ("learnt", self.transition_factors, [{"quantity": "transition_factor"}]),
            ("learnt_of_sensors", self.noise, [{"quantity": "noise_scale"}]),
            ("learnt_of_sensors", _any(self.gauge_offset), [{"quantity": "gauge_offset"}]),
            ("learnt_of_sensors", _any(self.gauge_gain), [{"quantity": "gauge_gain"}]),
        ]


def _any(value: float | tuple[float, ...]) -> bool:
    return any(number > 0.0 for number in (value if isinstance(value, tuple) else (value,)))


GAINS = 4
"""Gain errors that are compared for each sensor."""
MOST_DRAWS = 15
"""Draws of the parameter that are kept apart: evidence is compared, and no fine posterior is needed."""
NUMBERS_BY_DEFAULT = 1_000_000
"""Numbers of the beliefs about sensors up to which a scenario gives notices by itself: 0.1 s a step."""
_LARGEST_GAIN = 0.4
"""The largest gain errors that are compared are two and a half times as large."""


class Noticing(Section):
    """When an alarm is raised; the belief is not touched, but by readings that are left out."""

    units: ClassVar[Mapping[str, str]] = {"gauge_gain": "percent", "all_gain": "percent"}
    threshold: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=1.0)] = 100.0
    """Evidence from which an alarm is raised: a false one is at most so improbable, for each of two kinds."""
    gauge_gain: Annotated[float, Field(strict=True, gt=0.0, le=_LARGEST_GAIN)] = 0.2
    """Gain error of a single sensor that is to be found; less than half of it raises no alarm."""
    all_gain: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] = 0.1
    """Prior standard deviation of the gains of sensors that have one, where no state explains all of them."""
    memory_steps: Positive = 20.0
    """Steps after which what was learnt of these gains has faded to 1 / e."""
    onset_steps: Positive = 50.0
    """Steps within which half of the faults begin that were not there from the start."""
    absurd_deviations: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=3.0)] = 8.0
    """A reading so many assumed standard deviations beyond what any state can show is left out."""
    prior: Annotated[float, Field(strict=True, gt=0.0, lt=0.5)] = 0.01
    """Prior probability of each of the two kinds of fault, for their posterior."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """How sure the assumed noise is: as if it came from so many observations, more than two."""


NoticingOrNot = Annotated[Noticing | None, BeforeValidator(lambda given: None if given is False else given)]
"""The table, or `notice = false`."""


class WatchSection(FileSection):
    """How a real asset is watched."""

    kept: ClassVar[Mapping[str, str]] = {"observations": ""}  # a run folder has no copy
    observations: str | None = None
    """A recorded file that is watched where nothing else is given, or the name of a shipped one."""
    lag: Count = 50
    """Steps back over which the twin smooths, and which a message may be late."""
    longest_gap: Count = 1000
    """Steps that a message may be ahead of the next one; those between are predicted through."""
    seconds_per_step: Positive | None = None
    """Of messages that have a time in the place of a step."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Of the times of messages."""
    allow_unknown: bool = False
    """Keys and columns that are no sensor are passed over, and not refused."""
    quiet_after_seconds: Positive | None = None
    """Without a step for so long, a notice says that the last decision grows old."""

    @property
    def recording(self) -> Path | None:
        """The recorded file."""
        return self.all_files().get("")
