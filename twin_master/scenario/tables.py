"""Tables of a scenario: transitions, the truth, actions, learning, notices and the watch."""

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import BeforeValidator, Field

from reporting.formats.toml_file import Check, NotNegative, Number, Positive, validate
from reporting.json_file import JsonRecord
from twin_master.errors import ScenarioError
from twin_master.scenario.kinds import FileSection
from twin_master.scenario.observation import RecordSection
from twin_master.scenario.section import (
    Count,
    Flag,
    Name,
    PerSensor,
    Probability,
    Section,
    Step,
    Table,
    incomplete_table_check,
    value_count_check,
)

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of a sum of probabilities from one."""


class SummaryKeys(NamedTuple):
    """Keys of the summary that belong together; their titles are in `figures.toml`.

    Attributes
    ----------
    name : str
        The name of the group's table in `figures.toml`.
    fields : dict of str to str
        The texts that replace the fields in braces in the keys.
    """

    name: str
    fields: dict[str, str]


class Rewards(Section):
    """The parameters of the rewards, eqs. (9)-(11), and their weights in planning."""

    units: ClassVar[Mapping[str, str]] = {
        "health_limit": "microstrain",
        "error_scale": "microstrain",
    }
    health_limit: PerSensor
    """Value at which the health reward is zero, one for all sensors that count for it or one for
    each [unit of the sensors]."""
    health_sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)] = "all"
    """The sensors, numbered from 1, that have a limit and so count for the health reward."""
    health_weight: Number = 1.0
    """Weight of the health reward in planning [1]."""
    control_weight: Number = 1.0
    """Weight of the control reward in planning [1]."""
    error_scale: PerSensor
    """Distance between observation and model that costs one, one for all sensors or for each [unit
    of the sensors]."""
    normalise_error_by: Name | None = None
    """A control input by which the error is divided, so that errors under different loads are
    comparable."""
    control: dict[str, Number]
    """Reward of each control, by its name [1]."""


class Transition(Section):
    """How the state moves in one step under each control.

    Given the control, the state factors move independently.
    """

    kind: Literal["independent_worsening", "independent_tables"]
    """Whether every factor worsens by one level with a probability, or changes by a table."""
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`independent_worsening`: probability of one level up, by control, or by control and state
    [1]."""
    tables: dict[str, dict[str, tuple[tuple[Probability, ...], ...]]] = Field(default_factory=dict)
    """`independent_tables`: a square table by control and state; a row is the level before the
    step, a column the level after it [1]."""

    def checks_beside(
        self, controls: tuple[str, ...], level_counts: Mapping[str, int]
    ) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on names and tables.

        Parameters
        ----------
        controls : tuple of str
            The names of the controls.
        level_counts : mapping of str to int
            The number of levels of each state factor, by its name.
        """
        if self.kind == "independent_worsening":
            yield self.tables, "`transition.tables` belongs to the kind `independent_tables`"
            key = "transition.probability"
            yield incomplete_table_check(self.probability, controls, key, "control")
            for control, probability in self.probability.items():
                if isinstance(probability, dict):
                    states = tuple(level_counts)
                    yield incomplete_table_check(probability, states, f"{key}.{control}", "state")
        else:
            yield (
                self.probability,
                "`transition.probability` belongs to the kind `independent_worsening`",
            )
            yield from self._table_checks(controls, level_counts)

    def _table_checks(
        self, controls: tuple[str, ...], level_counts: Mapping[str, int]
    ) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on names and rows of tables."""
        yield incomplete_table_check(self.tables, controls, "transition.tables", "control")
        for control, tables in self.tables.items():
            key = f"transition.tables.{control}"
            yield incomplete_table_check(tables, tuple(level_counts), key, "state")
            for state, size in level_counts.items():
                rows = tables[state]
                has_other_size = len(rows) != size or any(len(row) != size for row in rows)
                yield (
                    has_other_size,
                    f"`{key}.{state}` must be {size} rows of {size} probabilities",
                )
                # how far the worst row is from a sum of 1
                departure = max(abs(sum(row) - 1.0) for row in rows)
                yield (
                    departure > ROW_SUM_TOLERANCE,
                    f"each row of `{key}.{state}` must sum to 1, but one differs by "
                    f"{departure:.3g}",
                )


def probability_of(
    probabilities: Mapping[str, float | Mapping[str, float]], control: str, state: str
) -> float:
    """Return the probability that a state factor worsens by a level in a step under a control.

    Parameters
    ----------
    probabilities : mapping
        For each control one probability for all state factors, or one by state factor.
    control, state : str
        The names of the control and of the state factor.
    """
    probability = probabilities[control]
    return probability[state] if isinstance(probability, Mapping) else probability


class Span(Section):
    """Steps of a mission, the last one included."""

    first_step: Step
    """First step, counted from 0."""
    last_step: Step | None = None
    """Last step, which is included; by default only the first step, or for a fault of sensors all
    later steps."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for a last step before the first one."""
        ends_early = self.last_step is not None and self.last_step < self.first_step
        yield (
            ends_early,
            f"`last_step` {self.last_step} lies before `first_step` {self.first_step}",
        )


class Gain(Span):
    """The growth of one factor of the true state in each step of a span."""

    units: ClassVar[Mapping[str, str]] = {"gain": "percent"}
    state: Name
    """Name of the state factor."""
    gain: Number
    """Growth of the true factor in each step [unit of the factor]."""


class Noise(Section):
    """The noise of the real sensors, Gaussian and independent."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain"}
    standard_deviation: NotNegative | tuple[NotNegative, ...]
    """Standard deviation, one for all sensors or one for each [unit of the sensors]."""


class SensorFault(Span):
    """A fault of some sensors, numbered from 1, in a span of steps."""

    units: ClassVar[Mapping[str, str]] = {"rate": "microstrain_per_step"}
    kind: Literal["dropout", "drift", "stuck"]
    """Whether the sensors deliver nothing, drift, or repeat their last reading."""
    sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)]
    """The sensors, numbered from 1, or "all"."""
    rate: Number | None = None
    """Growth of the drift in each step [unit of the sensors]."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on span and rate."""
        yield from super().checks()
        needs_rate = self.kind == "drift"
        has_rate = self.rate is not None
        yield (
            needs_rate != has_rate,
            "a drift needs `rate_microstrain_per_step`, and other faults have none",
        )

    def sensor_indices(self, sensor_count: int) -> list[int]:
        """Return the indices, from 0, of the sensors that have the fault."""
        if self.sensors == "all":
            return list(range(sensor_count))
        return [sensor - 1 for sensor in self.sensors]


class TruthSection(Section):
    """The true damage, sensor noise and sensor faults, which the twin never sees.

    If the kind is `asset`, all of it happens inside the asset, and is read for scoring only.
    """

    kind: Literal["scripted", "random_growth", "asset"]
    """Whether the damage follows a script, grows at random, or happens inside the asset."""
    gains: tuple[Gain, ...] = ()
    """`scripted`: the growth of the true factors of the state."""
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`random_growth`: the true probabilities to worsen, as in `transition`; by default those that
    the twin assumes [1]."""
    noise: Noise = Noise(standard_deviation=0.0)
    """Noise of the real sensors."""
    sensor_faults: tuple[SensorFault, ...] = ()
    """Faults of sensors."""
    state: dict[str, Name] = Field(default_factory=dict)
    """`asset`: for each state factor, the monitor of the binding that holds its true value."""
    observation: Name | None = None
    """`asset`: the observation of the binding without noise; by default that of the scenario."""
    received: Name | None = None
    """`asset`: the observation of the binding that is 0 for a lost sensor."""

    record: RecordSection | None = None
    """How the record of each step is made, if modes are observed."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on keys that belong to another kind."""
        is_inside_asset = self.kind == "asset"
        has_sensor_errors = self.sensor_faults or self.noise.standard_deviation
        if self.record is not None:
            yield (
                is_inside_asset or has_sensor_errors,
                "with `truth.record` the noise is that of the record (`truth.record.noise`), and "
                "the truth the scenario's: leave out `truth.noise`, `truth.sensor_faults`, the "
                "kind `asset`",
            )
        elif is_inside_asset:
            yield (
                self.gains or has_sensor_errors,
                "the kind `asset` leaves damage, noise and faults to the asset: leave out "
                "`truth.gains`, `truth.noise` and `truth.sensor_faults`",
            )
        else:
            yield (
                self.state or self.observation or self.received,
                "`state`, `observation` and `received` of `truth` belong to the kind `asset`",
            )
            yield "noise" not in self.model_fields_set, "`truth.noise` is missing"


class Action(Section):
    """A choice in a step in addition to the controls, such as an inspection or a repair."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "percent"}
    name: Name
    """Name of the action."""
    title: str = ""
    """Name of the action in the report; by default the name."""
    control: Name
    """The control whose loads act on the asset in that step."""
    cost: NotNegative
    """Difference by which the reward of the step is lower than under the control alone [1]."""
    inspects: tuple[Name, ...] = ()
    """The state factors that are read in that step, and only then."""
    standard_deviation: PerSensor | None = None
    """Standard deviation of these readings, one for all or one for each [unit of the factor]."""
    repairs: tuple[Name, ...] = ()
    """The state factors that are at their lowest level in the next step."""
    success: Probability = 1.0
    """Probability with which a repair succeeds, for each state factor [1]."""
    ends: Flag = False
    """Whether the mission ends with that step."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on readings and effect."""
        inspects = bool(self.inspects)
        has_deviation = self.standard_deviation is not None
        yield (
            inspects != has_deviation,
            f"action `{self.name}`: `inspects` and `standard_deviation` go together: the states "
            "that are read, and how well",
        )
        yield value_count_check(
            "action.standard_deviation", self.standard_deviation, len(self.inspects)
        )
        has_effect = self.inspects or self.repairs or self.ends
        yield (
            not has_effect,
            f"action `{self.name}` does nothing that its control does not: give `inspects`, "
            "`repairs` or `ends`",
        )


_POLICY_NAME = re.compile(
    r"(?P<policy>mode|qmdp|belief|risk (?P<risk>[0-9.]+))?(?:(?:^|, )hold (?P<hold>[0-9]+))?"
)
"""The name of a policy, such as "qmdp" or "risk 0.05, hold 3"."""
POLICY_NAMES = "'mode', 'qmdp', 'belief' or 'risk 0.05', each also with ', hold 3'"
"""The names of policies, for messages."""


def is_policy_name(text: str) -> bool:
    """Return whether a text is the name of a policy that every scenario has."""
    return bool(text) and _POLICY_NAME.fullmatch(text) is not None


class Planner(Section):
    """The rule by which the twin decides: value iteration, eq. (36), or planning on the belief."""

    gamma: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)]
    """Discount factor of the rewards of later steps [1]."""
    decide_on: Literal["filtered", "predicted"] = "filtered"
    """The belief of which the next control is the most probable one: D_t, or D_{t+1} as
    predicted."""
    safest: Name | None = None
    """The control if no state explains the sensors; by default the one with the least load."""
    policy: Literal["mode", "qmdp", "belief", "risk"] = "mode"
    """`mode`: the most probable one of the best controls of each state; `qmdp`: the best control in
    the mean over the states, as if they were known from the next step on; `belief`: the control
    that is planned on the belief; `risk`: the hardest control whose risk is below `risk`."""
    risk: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] | None = None
    """`risk`: the probability to be beyond the limit below which a control is taken, over the
    hypotheses about states and sensors. A control is beyond the limit in a state whose best control
    is a gentler one [1]."""
    hold: Count = 1
    """How often in a row a harder control must be proposed before it is taken; gentler ones are
    taken at once."""
    limit_probability: Annotated[Probability, Field(gt=0.0)] | None = None
    """`belief`: the fraction of the steps, discounted, in which a health limit may be exceeded
    [1]."""

    inspections_per_step: Count | None = None
    """`belief` and `qmdp`: how many of the assets that fly side by side may inspect in one step."""

    @property
    def policy_name(self) -> str:
        """The name of the policy, such as "mode" or "risk 0.05, hold 3"."""
        name = self.policy if self.risk is None else f"risk {self.risk:g}"
        return name if self.hold == 1 else f"{name}, hold {self.hold}"

    def with_policy(self, name: str) -> "Planner":
        """Return the table with the named policy, see `policy_name`.

        A name without a policy, such as "hold 3", keeps the policy of the table.

        Raises
        ------
        ScenarioError
            If the name has a number that is out of range.
        """
        match = _POLICY_NAME.fullmatch(name)
        assert match is not None, name
        keys = self.model_dump()
        if match["policy"]:
            keys |= {"policy": match["policy"].split()[0], "risk": None}
            if match["policy"] not in ("belief", self.policy):
                keys["limit_probability"] = None
            if match["risk"]:
                keys["risk"] = float(match["risk"])
        keys["hold"] = int(match["hold"] or 1)
        return validate(Planner, keys, f"the policy {name!r}", ScenarioError, what="a policy")

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on keys that belong to another policy."""
        yield (
            self.limit_probability is not None and self.policy != "belief",
            "`planner.limit_probability` needs `planner.policy` `belief`",
        )
        yield (
            (self.risk is None) == (self.policy == "risk"),
            "`planner.policy` `risk` and the probability `planner.risk` need each other",
        )
        yield (
            self.inspections_per_step is not None and self.policy in ("mode", "risk"),
            "`planner.inspections_per_step` needs `planner.policy` `belief` or `qmdp`",
        )


def with_controls_of_actions(table: JsonRecord) -> JsonRecord:
    """Return the table of a scenario with a further control for each action.

    This control has the input values and probabilities of the action's base control. Its reward is
    lower by the cost of the action. A malformed table is returned unchanged, and the schema refuses
    it later.

    Parameters
    ----------
    table : mapping
        The table of a scenario with actions, as in the file; it is not changed.
    """
    extended = deepcopy(dict(table))
    try:
        for action in extended["action"]:
            _add_control_of_action(extended, action)
    except (KeyError, TypeError, ValueError, AttributeError):
        return table
    return extended


def _add_control_of_action(table: Table, action: Table) -> None:
    """Add a control, its reward and probabilities for an action to a scenario's table, in place.

    Entries of that name are kept: the user gave them, or the table was extended before.
    """
    name = action["name"]
    base_name = action["control"]
    controls = {control["name"]: control for control in table["control"]}
    if name not in controls:
        title = action.get("title", "")
        table["control"].append(controls[base_name] | {"name": name, "title": title})

    rewards = table["rewards"]
    # The planner multiplies the reward by the weight, so that the cost is divided by it. With a
    # weight of 0 a cost has no effect; the schema refuses it.
    weight = rewards.get("control_weight", 1.0) or 1.0
    rewards["control"].setdefault(name, rewards["control"][base_name] - action["cost"] / weight)

    transition = table["transition"]
    truth = table.get("truth", {})
    # the probabilities of the control on which the action is based
    for values_by_control in (
        transition.get("probability"),
        transition.get("tables"),
        truth.get("probability"),
    ):
        if values_by_control:
            values_by_control.setdefault(name, values_by_control[base_name])


class Learning(Section):
    """The learnt quantities, each with its prior; all others stay as the scenario states them."""

    units: ClassVar[Mapping[str, str]] = {
        "gauge_gain": "percent",
        "gauge_offset": "microstrain",
    }
    parameter: Flag = True
    """Whether the draws of the calibrated parameter keep their weights from step to step."""
    noise: Flag = True
    """Whether the noise scale of each sensor is learnt, about the assumed standard deviation."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """Certainty of the assumed noise, as a number of observations, which is more than two [1]."""
    gauge_gain: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the relative gain error of each sensor; 0 is not learnt [1]."""
    gauge_offset: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the offset of each sensor; 0 is not learnt [unit of the
    sensors]."""
    saturation: Annotated[Probability, Field(lt=1.0)] = 0.0
    """Prior probability that all sensors saturate softly, each with L tanh(x / L) of x; the limit L
    is learnt. 0 is not learnt [1]."""
    transition_factors: tuple[Positive, ...] = ()
    """Factors on the probabilities to leave a state, equally probable at first; by default they are
    not learnt [1]."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on transition factors."""
        factors = self.transition_factors
        does_not_increase = any(second <= first for first, second in pairwise(factors))
        listed = ", ".join(str(factor) for factor in factors)
        yield (
            does_not_increase,
            f"`learning.transition_factors` must increase, but {listed} was given",
        )
        yield (
            len(factors) == 1,
            "`learning.transition_factors` needs two or more factors to choose from",
        )

    def summary_groups(self) -> list[SummaryKeys]:
        """Return the keys of the summary about all learnt quantities except the parameter."""
        groups = []
        if self.saturation > 0.0:
            groups.append(SummaryKeys("learnt", {"quantity": "saturation"}))
        if self.transition_factors:
            groups.append(SummaryKeys("learnt", {"quantity": "transition_factor"}))
        if self.noise:
            groups.append(SummaryKeys("learnt_of_sensors", {"quantity": "noise_scale"}))
        if _has_positive(self.gauge_offset):
            groups.append(SummaryKeys("learnt_of_sensors", {"quantity": "gauge_offset"}))
        if _has_positive(self.gauge_gain):
            groups.append(SummaryKeys("learnt_of_sensors", {"quantity": "gauge_gain"}))
        return groups


def _has_positive(value: float | tuple[float, ...]) -> bool:
    """Return whether a number, or any of several, is above zero."""
    numbers = value if isinstance(value, tuple) else (value,)
    return any(number > 0.0 for number in numbers)


GAINS_PER_SENSOR = 4
"""Number of gain errors that notices compare for each sensor."""
MOST_DRAWS = 15
"""Largest number of draws of the parameter that notices distinguish: evidence is compared, and a
fine posterior is not needed."""
MOST_NUMBERS_BY_DEFAULT = 1_000_000
"""Most numbers in the beliefs about sensors with which a scenario gives notices by default; they
take 0.1 s a step."""
_LARGEST_GAIN = 0.4
"""Largest `gauge_gain`: two and a half times as much is also compared, and a gain error of -1 or
less makes no sense."""


class Noticing(Section):
    """When an alarm is raised.

    The belief stays as it is, except that implausible and stuck readings are left out.
    """

    units: ClassVar[Mapping[str, str]] = {"gauge_gain": "percent", "all_gain": "percent"}
    threshold: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=1.0)] = 100.0
    """Evidence that raises an alarm; the probability of a false alarm of each of the two kinds is
    at most its inverse [1]."""
    gauge_gain: Annotated[float, Field(strict=True, gt=0.0, le=_LARGEST_GAIN)] = 0.2
    """Gain error of a single sensor that is to be found; less than half of it raises no alarm
    [1]."""
    all_gain: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] = 0.1
    """Prior standard deviation of the gain error of each sensor under the hypothesis that no state
    explains all sensors [1]."""
    memory_steps: Positive = 20.0
    """Steps after which what was learnt of these gains has faded to 1 / e [steps]."""
    onset_steps: Positive = 50.0
    """Steps within which half of the faults begin that did not exist from the start [steps]."""
    absurd_deviations: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=3.0)] = 8.0
    """A reading is left out if it is so many assumed standard deviations beyond the readings of all
    states [1]."""
    still_deviations: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] = 0.001
    """A reading that moves by at most so many assumed standard deviations stands still [1]."""
    prior: Annotated[float, Field(strict=True, gt=0.0, lt=0.5)] = 0.01
    """Prior probability of each of the two kinds of fault, for their posterior [1]."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """Certainty of the assumed noise, as a number of observations, which is more than two [1]."""


def _none_for_false(value: object) -> object:
    """Return None for `false`; return anything else unchanged."""
    return None if value is False else value


NoticingOrNot = Annotated[
    Noticing | None,
    BeforeValidator(_none_for_false, json_schema_input_type=Noticing | Literal[False]),
]
"""The table, or `notice = false`."""


Between = Literal["steps", "rest"]
"""What happens between two messages of a watched asset."""


class WatchSection(FileSection):
    """How a real asset is watched."""

    copy_paths: ClassVar[Mapping[str, str]] = {"observations": ""}  # a run folder has no copy
    observations: str | None = None
    """A recorded file that is watched by default, or the name of a shipped one."""
    lag: Count = 50
    """Number of past steps over which the twin smooths; a message may be late by this number of
    steps.
    """
    between: Between | None = None
    """What happens between messages: "steps" go on, or the asset is at "rest", where nothing wears
    and no step is counted. By default it rests where messages have a time, and steps go on where
    they have a step.
    """
    longest_gap: Count = 1000
    """Steps that a message may be ahead of the next one; beyond them counting begins anew."""
    every: Count = 1
    """One in this number of messages is taken, where the logger sends so many in a step."""
    seconds_per_step: Positive | None = None
    """Length of a step, for messages that have a time and no step [s]."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the times of messages."""
    allow_unknown: bool = False
    """Whether keys and columns that name no sensor are passed over instead of refused."""
    quiet_after_seconds: Positive | None = None
    """Time without a step after which a notice says that the last decision grows old [s]."""

    @property
    def recording(self) -> Path | None:
        """The recorded file; None if the scenario names none."""
        return self.all_files().get(self.copy_paths["observations"])
