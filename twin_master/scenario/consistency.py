"""All tables of a scenario, with the checks that two or more tables agree with each other."""

from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field, SerializeAsAny, model_validator

from reporting.formats.toml_file import Check
from reporting.words import comma_list
from twin_master.scenario.kinds import WATCHED_KIND, AssetSection, BeliefSection
from twin_master.scenario.mission import Calibration, Control, Mission, Reference, StateFactor
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.section import (
    Section,
    incomplete_table_check,
    repeated_name_check,
    unknown_name_check,
    value_count_check,
)
from twin_master.scenario.tables import (
    Action,
    Learning,
    NoticingOrNot,
    Planner,
    Rewards,
    Transition,
    TruthSection,
    WatchSection,
    with_controls_of_actions,
)

LARGEST_STRAIN_NOISE = 0.1
"""A larger standard deviation of a strain gauge was meant in microstrain [1]. Usual gauges break at
a strain of a few percent."""


class InspectionReading(NamedTuple):
    """The reading of one state factor in an inspection.

    Attributes
    ----------
    control_index : int
        The index of the control that inspects.
    state_index : int
        The index of the state factor that is read.
    name : str
        The name of the reading.
    standard_deviation : float
        The standard deviation of the reading.
    """

    control_index: int
    state_index: int
    name: str
    standard_deviation: float


class ScenarioTables(Section):
    """All tables of a scenario, in SI; each table is checked alone, and against the others."""

    filled_in: ClassVar[tuple[str, ...]] = ("asset", "truth")

    format: Literal[2]
    """Version of the format; files of format 1 are still read."""
    mission: Mission
    """Name, length, first control and seed of the mission."""
    state: Annotated[tuple[StateFactor, ...], Field(min_length=1)]
    """The factors of the hidden state, the outermost first."""
    control: Annotated[tuple[Control, ...], Field(min_length=1)]
    """The controls that the twin chooses from."""
    action: tuple[Action, ...] = ()
    """Inspections, repairs and the end of the mission, in addition to the controls."""
    observation: ObservationSection
    """The observed quantity, the sensors, and their assumed noise."""
    transition: Transition
    """How the state changes in a step."""
    rewards: Rewards
    """The rewards that the policy maximises."""
    planner: Planner
    """How the twin decides."""
    asset: SerializeAsAny[AssetSection]
    """The asset that flies; left out if a real asset is watched."""
    belief: SerializeAsAny[BeliefSection]
    """The model that predicts the observations of the twin."""
    calibration: Calibration
    """The uncertain parameter of the model, and its distribution."""
    truth: TruthSection
    """True damage, noise and sensor faults, which the twin never sees; left out if a real asset is
    watched."""
    learning: Learning | None = None
    """Quantities that the twin learns during the mission; none without the table."""
    notice: NoticingOrNot = None
    """When an alarm is raised; `notice = false` switches alarms off."""
    watch: WatchSection = WatchSection()
    """How a real asset is watched."""
    reference: tuple[Reference, ...] = ()
    """Published values that are printed beside figures of the summary."""

    @model_validator(mode="before")
    @classmethod
    def _complete_table(cls, table: object) -> object:
        """Add a control for each action, and the missing tables of an asset that is only watched.

        A scenario without `[asset]` and `[truth]` is for a real asset. It gets an asset of the kind
        `watched` and a truth that is not used.
        """
        if not isinstance(table, Mapping):
            return table
        if table.get("action"):
            table = with_controls_of_actions(table)
        if "asset" in table or "truth" in table:
            return table
        unknown_truth = {"kind": "scripted", "noise": {"standard_deviation": 0.0}}
        return {**table, "asset": {"kind": WATCHED_KIND}, "truth": unknown_truth}

    @property
    def state_names(self) -> tuple[str, ...]:
        """The names of the state factors; the last one varies fastest over the joint states."""
        return tuple(factor.name for factor in self.state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """The names of the controls in their order."""
        return tuple(control.name for control in self.control)

    @property
    def inspection_readings(self) -> tuple[InspectionReading, ...]:
        """The readings of all inspections, in the order of the actions of the scenario.

        The row of a step has the values of the sensors and then one value for each of these
        readings, which is NaN in a step without the inspection.
        """
        all_readings = []
        # `self.action` holds all tables `[[action]]`; each action is also a control of its name.
        for action in self.action:
            control_index = self.control_names.index(action.name)
            deviations = action.standard_deviation
            if not isinstance(deviations, tuple):
                deviations = (deviations or 0.0,) * len(action.inspects)
            for state, deviation in zip(action.inspects, deviations, strict=True):
                all_readings.append(
                    InspectionReading(
                        control_index=control_index,
                        state_index=self.state_names.index(state),
                        name=f"{action.name}_{state}",
                        standard_deviation=deviation,
                    )
                )
        return tuple(all_readings)

    def _control_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on states and controls."""
        controls = self.control_names
        yield repeated_name_check("state", self.state_names)
        yield repeated_name_check("control", controls)
        # names, and the inputs of the controls
        inputs = tuple(sorted(self.control[0].values))
        for control in self.control:
            yield (
                set(control.values) != set(inputs),
                f"every control must give a value to the same inputs: `{controls[0]}` gives "
                f"{comma_list(inputs)} and `{control.name}` gives {comma_list(control.values)}",
            )
        first_control = self.mission.first_control
        yield unknown_name_check(first_control, controls, "mission.first_control", "control")
        yield self._several_incomplete_tables_check()
        yield incomplete_table_check(self.rewards.control, controls, "rewards.control", "control")
        safest = self.planner.safest or controls[0]
        yield unknown_name_check(safest, controls, "planner.safest", "control")
        normaliser = self.rewards.normalise_error_by
        if normaliser is not None:
            key = "rewards.normalise_error_by"
            yield unknown_name_check(normaliser, inputs, key, "control input")
            divisors = [control.values[normaliser] for control in self.control]
            yield (
                min(divisors) <= 0.0,
                f"`{key}` divides by `{normaliser}`, which must be positive in every control",
            )
        level_counts = {factor.name: len(factor.levels) for factor in self.state}
        yield from self.transition.checks_beside(controls, level_counts)

    def _several_incomplete_tables_check(self) -> Check:
        """Return the fault that several tables lack an entry for a control, in one message.

        The separate checks would report only the first of these tables.
        """
        tables: dict[str, Mapping[str, object]] = {"rewards.control": self.rewards.control}
        if self.transition.kind == "independent_worsening":
            tables["transition.probability"] = self.transition.probability
        else:
            tables["transition.tables"] = self.transition.tables
        if self.truth.probability:
            tables["truth.probability"] = self.truth.probability
        messages = []
        for key, table in tables.items():
            is_incomplete, message = incomplete_table_check(
                table, self.control_names, key, "control"
            )
            if is_incomplete:
                messages.append(message)
        return len(messages) > 1, "; ".join(messages)

    def _action_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on names and costs of actions."""
        controls = self.control_names
        # `with_controls_of_actions` added the controls of the actions at the end.
        controls_of_file = controls[: -len(self.action)] if self.action else controls
        loads = {control.name: control.values for control in self.control}
        for action in self.action:
            yield unknown_name_check(action.control, controls, "action.control", "control")
            base_loads = loads[action.control]
            has_other_loads = loads.get(action.name, base_loads) != base_loads
            has_name_of_control = action.name in (action.control, *controls_of_file)
            yield (
                has_other_loads or has_name_of_control,
                f"action `{action.name}` needs a name of its own, and a control has it",
            )
            yield (
                action.cost > 0.0 and self.rewards.control_weight == 0.0,
                f"action `{action.name}` has a cost, which has no effect with "
                "`rewards.control_weight` 0: leave out the cost, or give a weight above 0",
            )
            for state in (*action.inspects, *action.repairs):
                key = f"action.{action.name}"
                yield unknown_name_check(state, self.state_names, key, "state")

    def _growth_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on random growth and repairs."""
        truth = self.truth
        is_random = truth.kind == "random_growth"
        if truth.probability:
            worsens = self.transition.kind == "independent_worsening"
            yield (
                not (is_random and worsens),
                "`truth.probability` belongs to the kind `random_growth`, and to transitions of "
                "the kind `independent_worsening`",
            )
            yield incomplete_table_check(
                truth.probability, self.control_names, "truth.probability", "control"
            )
        for action in self.action:
            follows_repairs = is_random or self.asset.kind == WATCHED_KIND
            yield (
                bool(action.repairs) and not follows_repairs,
                f"action `{action.name}` repairs the state, which needs `truth.kind` "
                f"`random_growth`, but it is `{truth.kind}`",
            )

    def _truth_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on the origin of the true state."""
        truth = self.truth
        if truth.kind == "asset":
            yield (
                not self.asset.is_fmu,
                "`truth.kind` `asset` needs an FMU, but the kind of the asset is "
                f"`{self.asset.kind}`",
            )
            yield incomplete_table_check(truth.state, self.state_names, "truth.state", "state")
        yield (
            truth.kind == "random_growth" and truth.gains,
            "`truth.gains` belongs to the kind `scripted`, but the kind is `random_growth`",
        )
        for gain in truth.gains:
            yield unknown_name_check(gain.state, self.state_names, "truth.gains.state", "state")

    def _reward_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on the sensors that rewards name."""
        rewards = self.rewards
        sensor_count = self.observation.count
        limited_count = sensor_count
        if rewards.health_sensors != "all":
            sensors = rewards.health_sensors
            limited_count = len(sensors)
            is_repeated = len(set(sensors)) != len(sensors)
            yield (
                max(sensors) > sensor_count or is_repeated,
                f"`rewards.health_sensors` must name different sensors from 1 to {sensor_count}, "
                f"but {comma_list(sensors)} was given",
            )
        yield value_count_check("rewards.health_limit", rewards.health_limit, limited_count)
        yield value_count_check("rewards.error_scale", rewards.error_scale, sensor_count)

    def _sensor_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on values stated by sensor."""
        sensor_count = self.observation.count
        for key in ("gauge_gain", "gauge_offset"):
            yield value_count_check(
                f"learning.{key}", getattr(self.learning, key, 0.0), sensor_count
            )
        averages_inside = self.observation.average_over_draws == "inside"
        for table in ("learning", "notice"):
            yield (
                averages_inside and getattr(self, table),
                f"`{table}` needs `observation.average_over_draws` `outside`: inside, each sensor "
                "has a parameter of its own",
            )
        yield (
            self.planner.inspections_per_step is not None and (self.learning or self.notice),
            "`planner.inspections_per_step` is for assets that fly side by side, and twins with "
            "`learning` or `notice` fly alone: leave one of them out",
        )
        true_noise = self.truth.noise.standard_deviation
        yield value_count_check("truth.noise.standard_deviation", true_noise, sensor_count)
        yield self._strain_noise_check(
            "observation.standard_deviation", self.observation.standard_deviation
        )
        yield self._strain_noise_check("truth.noise.standard_deviation", true_noise)
        for fault in self.truth.sensor_faults:
            largest = max(fault.sensor_indices(sensor_count)) + 1
            yield (
                largest > sensor_count,
                f"`truth.sensor_faults.sensors` counts from 1 to {sensor_count}, but {largest} was "
                "given",
            )

    def _strain_noise_check(self, key: str, noise: float | tuple[float, ...]) -> Check:
        """Return the fault that a noise of strains seems to be in microstrain without that unit.

        A standard deviation above `LARGEST_STRAIN_NOISE` as a strain can only be a number in
        microstrain. Smaller mistakes are found later, when the predicted strains are known.

        Parameters
        ----------
        noise : float or (G,) tuple of float
            The standard deviation of all G sensors, or of each sensor, SI.
        """
        deviations = np.broadcast_to(noise, self.observation.count)
        largest = 0.0
        for deviation, unit in zip(deviations, self.observation.sensor_units, strict=True):
            if unit == "1":
                largest = max(largest, deviation)
        is_absurd = self.observation.role == "strain" and largest > LARGEST_STRAIN_NOISE
        message = (
            f"`{key}` is {largest:g} as a strain, and no gauge is off by "
            f"{LARGEST_STRAIN_NOISE:g}: for microstrain write `{key}_microstrain = {largest:g}`"
        )
        return is_absurd, message

    def _mode_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on the observation of modes."""
        modes = self.observation.modes
        record = self.truth.record
        if modes is None:
            yield (
                record is not None,
                "`truth.record` belongs to the role `modes` of `observation`",
            )
            return
        yield (
            bool(self.inspection_readings),
            "`observation.modes` does not go together with actions that inspect: leave one of "
            "them out",
        )
        for table in ("learning", "notice"):
            yield (
                getattr(self, table) is not None,
                f"`{table}` does not take observations with a covariance of their own: leave it "
                "out",
            )
        yield (
            self.observation.average_over_draws == "inside",
            "modes are averaged over the draws `outside`: leave out `average_over_draws`",
        )
        if self.asset.kind == WATCHED_KIND:
            return
        if record is None:
            yield (
                True,
                "the role `modes` needs `truth.record`, which says how the record of a step is "
                "made",
            )
            return
        inputs = tuple(sorted(self.control[0].values))
        yield unknown_name_check(record.input, inputs, "truth.record.input", "control input")
        highest_frequency = 0.5 * record.sampling_rate  # the Nyquist frequency
        _low, highest_of_bands = modes.bands[-1]
        yield (
            highest_of_bands > highest_frequency,
            f"`truth.record.sampling_rate` {record.sampling_rate:g} shows nothing above "
            f"{highest_frequency:g} Hz, and a band ends at {highest_of_bands:g} Hz",
        )
