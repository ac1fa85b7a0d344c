"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset.

A key of the file may carry its unit (`levels_percent`, `gain_percent`,
`standard_deviation_microstrain`); the records, and `config.json` of a run, are in SI. The schema
does not depend on the asset: another asset is another scenario file.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, SerializeAsAny, model_validator

from reporting.arrays import Float
from reporting.toml_file import Fault
from reporting.words import comma_list
from twin_master.scenario.kinds import AssetSection, BeliefSection, FileSection
from twin_master.scenario.mission import Calibration, Control, Mission, Reference, StateFactor
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.section import (
    Section,
    incomplete_table_fault,
    repeated_name_fault,
    unknown_name_fault,
    value_count_fault,
)
from twin_master.scenario.tables import (
    Action,
    FigureGroup,
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
"""Standard deviation of a strain gauge above which a unit was forgotten [1]."""
_GAIN_DECIMALS = 12
"""Decimals to which sums of scripted gains are rounded, so that ten times 2 % and 40 % are 60 %;
if a state is small in its unit, to as many significant digits."""
REWARD_NAMES = ("health", "control", "error")
"""The rewards of eqs. (9)-(11)."""
FIGURES: dict[str, dict[str, tuple[str, str]]] = tomllib.loads(
    Path(__file__).with_name("figures.toml").read_text(encoding="utf-8")
)
"""Title and unit of each figure of the summary, by group and key."""
WATCHED_KIND = "watched"
"""Kind of the asset of a scenario without `[asset]`."""


class InspectionReading(NamedTuple):
    """A reading of an inspection.

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


class Scenario(Section):
    """A whole scenario, in SI."""

    format: Literal[2]
    mission: Mission
    state: Annotated[tuple[StateFactor, ...], Field(min_length=1)]
    control: Annotated[tuple[Control, ...], Field(min_length=1)]
    """The controls of the file, followed by one for each action."""
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
    """When alarms are raised; `reading.load_scenario` says when a scenario has them by default."""
    watch: WatchSection = WatchSection()
    reference: tuple[Reference, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, table: object) -> object:
        """Return the table with actions as controls, and with the asset of a watched scenario.

        A scenario without `[asset]` and `[truth]` is of a real asset, which is watched.
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
    def searchable(self) -> bool:
        """Whether `discrepancy run --from-run` reads its runs.

        It reads strains of a wing with two damage regions.
        """
        has_two_regions = set(self.state_names) == {"z1", "z2"}
        return self.observation.role == "strain" and has_two_regions

    @property
    def state_names(self) -> tuple[str, ...]:
        """The names of the state factors; the last one varies fastest over the joint states."""
        return tuple(factor.name for factor in self.state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """The names of the controls in their order."""
        return tuple(control.name for control in self.control)

    @property
    def readings(self) -> tuple[InspectionReading, ...]:
        """The readings of all inspections.

        They follow the values of the sensors in the row of a step, and are NaN in a step without
        the inspection.
        """
        readings = []
        for action in self.action:
            control_index = self.control_names.index(action.name)
            for inspected in action.readings:
                state_index = self.state_names.index(inspected.state)
                reading = InspectionReading(
                    control_index, state_index, inspected.name, inspected.standard_deviation
                )
                readings.append(reading)
        return tuple(readings)

    @property
    def row_width(self) -> int:
        """The length of the row of observations of a step."""
        return self.observation.width + len(self.readings)

    def ends(self, control_index: int) -> bool:
        """Return whether the mission ends with a step under a control."""
        name = self.control_names[control_index]
        return any(action.ends for action in self.action if action.name == name)

    @property
    def figure_names(self) -> tuple[str, ...]:
        """The names of all figures that the summary can contain, and a reference can name."""
        names = []
        for group in self._figure_groups():
            for name in FIGURES[group.name]:
                names.append(name.format(**group.fields))
        return tuple(names)

    def _figure_groups(self) -> list[FigureGroup]:
        """Return the groups of figures that the summary of this scenario can contain."""
        groups = [FigureGroup("fallback", {})]
        groups += [FigureGroup("error", {"state": name}) for name in self.state_names]
        groups += [FigureGroup("reward", {"reward": name}) for name in REWARD_NAMES]
        groups += self._parameter_figure_groups()
        groups.append(FigureGroup("evidence", {}))
        if self.learning is not None:
            groups += self.learning.figure_groups()
        has_dropout = any(fault.kind == "dropout" for fault in self.truth.sensor_faults)
        if has_dropout or self.truth.received:
            groups += [FigureGroup("lost", {}), FigureGroup("blind", {})]
        if self.another_model:
            groups.append(FigureGroup("misfit", {}))
        if set(self.observation.sensor_units) == {"1"}:
            groups.append(FigureGroup("bound", {}))
        if self.notice is not None:
            groups.append(FigureGroup("notice", {}))
        return groups

    def _parameter_figure_groups(self) -> list[FigureGroup]:
        """Return the groups of figures on the calibrated parameter."""
        fields = {"parameter": self.calibration.parameter}
        if self.learning is None or not self.learning.parameter:
            return [FigureGroup("parameter", fields)]
        groups = [FigureGroup("parameter_learnt", fields)]
        if self.calibration.parameter in self.asset.true_parameters:
            groups.append(FigureGroup("parameter_true", fields))
        return groups

    def scripted_history(self) -> Float:
        """Return the scripted true state of each step; the gain of a step is in its own state.

        Returns
        -------
        (T, F) array
            One row for each of T steps, one column for each of F state factors, SI.
        """
        gain = np.zeros((self.mission.steps, len(self.state)))
        gain[0] = [factor.start for factor in self.state]
        for entry in self.truth.gains:
            last_step = entry.first_step if entry.last_step is None else entry.last_step
            column = self.state_names.index(entry.state)
            gain[entry.first_step : last_step + 1, column] += entry.gain
        history = np.cumsum(gain, axis=0)
        for factor_history in history.T:
            largest = np.abs(factor_history).max()
            # The power of ten of the largest value, which is negative or zero below 1.
            exponent = math.ceil(math.log10(largest)) if 0.0 < largest < 1.0 else 0
            factor_history[:] = np.round(factor_history, _GAIN_DECIMALS - exponent)
        return history

    @property
    def another_model(self) -> bool:
        """Whether the model that flies is known to differ from the one that the twin believes."""
        believes_asset = self.belief.kind == "asset"
        departs = self.asset.departs_from_others or self.belief.departs_from_others
        return departs and not believes_asset

    def with_paths_from(self, folder: Path) -> Self:
        """Return the scenario with its relative paths joined to a folder."""
        tables: dict[str, Section] = {
            name: table.with_paths_from(folder) for name, table in self._file_tables().items()
        }
        tables["watch"] = self.watch.with_paths_from(folder)
        return self.model_copy(update=tables)

    def portable(self) -> Self:
        """Return the scenario with the paths of the copies inside a run folder."""
        tables = {name: table.portable() for name, table in self._file_tables().items()}
        return self.model_copy(update=tables)

    def with_seed(self, seed: int) -> Self:
        """Return the scenario with another seed of the run."""
        return self.with_changes("mission", seed=seed)

    def with_changes(self, table: str, **changes: Any) -> Self:
        """Return the scenario with other values in one of its tables; they are not checked.

        Parameters
        ----------
        table : str
            The name of the table: "mission".
        **changes : object
            The new values by key.
        """
        changed = getattr(self, table).model_copy(update=changes)
        return self.model_copy(update={table: changed})

    def _file_tables(self) -> dict[str, FileSection]:
        """Return the tables whose files a run folder has copies of, by name."""
        return {"asset": self.asset, "belief": self.belief, "calibration": self.calibration}

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data in SI; `Scenario.model_validate` reads it back."""
        return self.model_dump(mode="json")

    def faults(self) -> Iterator[Fault]:
        """Yield the faults of the tables beside each other."""
        yield from self._control_faults()
        yield from self._action_faults()
        yield from self._truth_faults()
        yield from self._reward_faults()
        yield from self._sensor_faults()
        yield from self._mode_faults()

    def _control_faults(self) -> Iterator[Fault]:
        """Yield the faults of states and controls, and of what names them."""
        controls = self.control_names
        yield repeated_name_fault("state", self.state_names)
        yield repeated_name_fault("control", controls)
        inputs = tuple(sorted(self.control[0].values))
        for control in self.control:
            yield (
                set(control.values) != set(inputs),
                f"every control must give a value to the same inputs: `{controls[0]}` gives "
                f"{comma_list(inputs)} and `{control.name}` gives {comma_list(control.values)}",
            )
        first_control = self.mission.first_control
        yield unknown_name_fault(first_control, controls, "mission.first_control", "control")
        yield self._several_incomplete_tables_fault()
        yield incomplete_table_fault(self.rewards.control, controls, "rewards.control", "control")
        safest = self.planner.safest or controls[0]
        yield unknown_name_fault(safest, controls, "planner.safest", "control")
        normaliser = self.rewards.normalise_error_by
        if normaliser is not None:
            key = "rewards.normalise_error_by"
            yield unknown_name_fault(normaliser, inputs, key, "control input")
            divisors = [control.values[normaliser] for control in self.control]
            yield (
                min(divisors) <= 0.0,
                f"`{key}` divides by `{normaliser}`, which must be positive in every control",
            )
        level_counts = {factor.name: len(factor.levels) for factor in self.state}
        yield from self.transition.faults_beside(controls, level_counts)

    def _several_incomplete_tables_fault(self) -> Fault:
        """Return the fault that two or more tables lack an entry for a control, in one message."""
        tables: dict[str, Mapping[str, object]] = {"rewards.control": self.rewards.control}
        if self.transition.kind == "independent_worsening":
            tables["transition.probability"] = self.transition.probability
        else:
            tables["transition.tables"] = self.transition.tables
        if self.truth.probability:
            tables["truth.probability"] = self.truth.probability
        messages = []
        for key, table in tables.items():
            is_incomplete, message = incomplete_table_fault(
                table, self.control_names, key, "control"
            )
            if is_incomplete:
                messages.append(message)
        return len(messages) > 1, "; ".join(messages)

    def _action_faults(self) -> Iterator[Fault]:
        """Yield the faults of actions beside the controls, states and rewards."""
        controls = self.control_names
        # `with_controls_of_actions` added the controls of the actions at the end.
        controls_of_file = controls[: -len(self.action)] if self.action else controls
        loads = {control.name: control.values for control in self.control}
        for action in self.action:
            yield unknown_name_fault(action.control, controls, "action.control", "control")
            base_loads = loads[action.control]
            has_other_loads = loads.get(action.name, base_loads) != base_loads
            has_name_of_control = action.name in (action.control, *controls_of_file)
            yield (
                has_other_loads or has_name_of_control,
                f"action `{action.name}` needs a name of its own, and a control has it",
            )
            yield (
                action.cost > 0.0 and self.rewards.control_weight == 0.0,
                f"action `{action.name}` has a cost, and `rewards.control_weight` 0 takes no cost "
                "of controls into account: give it none, or a weight above 0",
            )
            for state in (*action.inspects, *action.repairs):
                key = f"action.{action.name}"
                yield unknown_name_fault(state, self.state_names, key, "state")

    def _truth_faults(self) -> Iterator[Fault]:
        """Yield the faults of the truth beside the states, the actions and the asset."""
        truth = self.truth
        is_random = truth.kind == "random_growth"
        if truth.probability:
            worsens = self.transition.kind == "independent_worsening"
            yield (
                not (is_random and worsens),
                "`truth.probability` belongs to the kind `random_growth`, and to transitions of "
                "the kind `independent_worsening`",
            )
            yield incomplete_table_fault(
                truth.probability, self.control_names, "truth.probability", "control"
            )
        for action in self.action:
            follows_repairs = is_random or self.asset.kind == WATCHED_KIND
            yield (
                bool(action.repairs) and not follows_repairs,
                f"action `{action.name}` repairs, which a truth of the kind `random_growth` "
                f"follows, and the kind is `{truth.kind}`",
            )
        yield from self._reference_faults()
        if truth.kind == "asset":
            yield (
                not self.asset.is_fmu,
                "`truth.kind` `asset` needs an FMU, and the kind of the asset is "
                f"`{self.asset.kind}`",
            )
            yield incomplete_table_fault(truth.state, self.state_names, "truth.state", "state")
        yield (
            is_random and truth.gains,
            "`truth.gains` belongs to the kind `scripted`, and the kind is `random_growth`",
        )
        for gain in truth.gains:
            yield unknown_name_fault(gain.state, self.state_names, "truth.gains.state", "state")

    def _reference_faults(self) -> Iterator[Fault]:
        """Yield references to no figure, or to the same one."""
        names = [entry.figure for entry in self.reference]
        for name in names:
            yield unknown_name_fault(
                name, self.figure_names, "reference.figure", "figure of the summary"
            )
            yield (
                names.count(name) > 1,
                f"`reference` gives `{name}` more than once: keep one of them",
            )

    def _reward_faults(self) -> Iterator[Fault]:
        """Yield the faults of the rewards beside the sensors."""
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
                f"and {comma_list(sensors)} came",
            )
        yield value_count_fault("rewards.health_limit", rewards.health_limit, limited_count)
        yield value_count_fault("rewards.error_scale", rewards.error_scale, sensor_count)

    def _sensor_faults(self) -> Iterator[Fault]:
        """Yield the faults of learning, notices, noise and sensor faults beside the sensors."""
        sensor_count = self.observation.count
        for key in ("gauge_gain", "gauge_offset"):
            yield value_count_fault(
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
        yield value_count_fault("truth.noise.standard_deviation", true_noise, sensor_count)
        yield self._strain_noise_fault(
            "observation.standard_deviation", self.observation.standard_deviation
        )
        yield self._strain_noise_fault("truth.noise.standard_deviation", true_noise)
        for fault in self.truth.sensor_faults:
            largest = max(fault.sensor_indices(sensor_count)) + 1
            yield (
                largest > sensor_count,
                f"`truth.sensor_faults.sensors` counts from 1 to {sensor_count}, and {largest} "
                "came",
            )

    def _strain_noise_fault(self, key: str, noise: float | tuple[float, ...]) -> Fault:
        """Return the fault that noise of strains is in microstrain, and its key does not say so.

        Smaller mistakes show when the predictions are there.
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

    def _mode_faults(self) -> Iterator[Fault]:
        """Yield the keys that do not go together with the observation of modes."""
        modes = self.observation.modes
        record = self.truth.record
        if modes is None:
            yield (
                record is not None,
                "`truth.record` belongs to the role `modes` of `observation`",
            )
            return
        yield (
            bool(self.readings),
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
        yield unknown_name_fault(record.input, inputs, "truth.record.input", "control input")
        highest_frequency = 0.5 * record.sampling_rate  # Nyquist
        _low, highest_of_bands = modes.bands[-1]
        yield (
            highest_of_bands > highest_frequency,
            f"`truth.record.sampling_rate` {record.sampling_rate:g} shows nothing above "
            f"{highest_frequency:g} Hz, and a band ends at {highest_of_bands:g} Hz",
        )
