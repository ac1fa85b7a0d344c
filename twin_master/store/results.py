"""A flown mission as labelled arrays for `run.nc`, and as tables in CSV."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import AnyArray, Float
from reporting.netcdf import NetcdfGroup, Variable
from reporting.table_file import table_text
from twin_master.learning.expectation import Expectation, concatenate_expectations
from twin_master.mission.plant import SensorStatus, Truth
from twin_master.mission.residuals import expected_ahead, expected_in_steps
from twin_master.network.planner import BeliefPolicy
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import MOMENTS, MissionResult
from twin_master.store.schema import (
    FIELDS_OF_BELIEFS,
    SCHEMA,
    Entry,
    coordinate_variables,
    coordinates_of_axes,
    described_variable,
    observed_entries,
    rows_of_group,
    scenario_fields,
)

SchemaFields = Mapping[str, str]
"""The words that take the place of the fields in braces of the schema, the file `run.toml`."""
_NO_FIELDS: SchemaFields = MappingProxyType({})


_BELIEF_OF_DECISION = {
    "filtered": "the filtered belief of the step",
    "predicted": "the belief predicted for the next step",
}
"""The words for each value of `planner.decide_on`."""
_MOMENT_TITLES = ("mean", "standard deviation", "5 % quantile", "95 % quantile")


def run_groups(result: MissionResult) -> dict[str, NetcdfGroup]:
    """Return the groups of `run.nc` of a mission; every variable has its unit and a description."""
    builder = _GroupBuilder(result)
    plan = result.knowledge.plan
    groups = {"observed": builder.group("observed", _observed_entries(result))}
    groups["filtered"] = _filtered_group(result, builder)
    groups["smoothed"] = _smoothed_group(result, builder)
    groups["predicted"] = _predicted_group(result, builder)
    earned = {**vars(result.earned), "return": result.discounted_return}
    groups["earned"] = builder.group("earned", _plain_entries(earned))
    policy = {
        "control_index": plan.control_index,
        "action_value": plan.action_value,
        "value": plan.value,
    }
    groups["policy"] = builder.group("policy", _plain_entries(policy))
    groups["calibration"] = builder.group(
        "calibration",
        _plain_entries({"draw_value": result.knowledge.draws.values}),
        attributes={"parameter": result.scenario.calibration.parameter},
    )
    if result.learnt:
        groups["learnt"] = builder.group("learnt", _learnt_entries(result))
    if result.flight.suspicion:
        # The variables of the group `notice`: the suspicion of each step
        suspicions = result.flight.suspicion
        values = {}
        for name in SCHEMA["notice"]:
            values[name] = np.array([getattr(suspicion, name) for suspicion in suspicions])
        values["left_out"] = values["left_out"].astype(np.int8)
        notice_entries = _plain_entries(values)
        groups["notice"] = builder.group("notice", notice_entries)
    if result.truth is not None:
        groups["truth"] = builder.group("truth", _truth_entries(result, result.truth))
    return groups


def _plain_entries(values: Mapping[str, ArrayLike]) -> list[Entry]:
    """Return an entry for each variable whose name in the schema has no fields in braces."""
    return [Entry(name, np.asarray(array)) for name, array in values.items()]


class _GroupBuilder:
    """Builds groups by the schema, each with the coordinates of its axes."""

    def __init__(self, result: MissionResult) -> None:
        scenario = result.scenario
        self._fields = scenario_fields(scenario) | {"parameter_unit": result.parameter_unit}
        steps = result.flight.first_step + np.arange(len(result.flight.steps))
        labels: dict[str, ArrayLike] = {
            "control": scenario.control_names,
            "horizon": np.arange(1, scenario.mission.prediction_steps + 1),
            "reward": REWARD_NAMES,
            "draw": np.arange(len(result.knowledge.draws.values)),
        }
        self._coordinates = coordinate_variables(scenario, steps, labels)

    def _variables(
        self, group: str, entries: Iterable[Entry], fields: SchemaFields
    ) -> Iterator[tuple[str, Variable]]:
        """Yield the name and the variable of each entry.

        The schema gives axes, unit and description of an entry as templates. Their fields are
        filled with those of the mission, of the group, and of the entry; a later one replaces an
        earlier one of the same name.
        """
        rows = rows_of_group(group)
        fields_of_group = {**self._fields, **FIELDS_OF_BELIEFS.get(group, {}), **fields}
        for entry in entries:
            all_fields = {**fields_of_group, **entry.fields}
            variable = described_variable(rows[entry.name], entry.values, all_fields)
            yield entry.name.format(**all_fields), variable

    def group(
        self,
        name: str,
        entries: Iterable[Entry],
        fields: SchemaFields = _NO_FIELDS,
        attributes: SchemaFields = _NO_FIELDS,
    ) -> NetcdfGroup:
        """Return a group of variables, with the coordinates whose axes they have.

        Parameters
        ----------
        name : str
            The name of the group.
        entries : iterable of Entry
            Its variables.
        fields : mapping of str to str
            The values of fields that all entries share.
        attributes : mapping of str to str
            The attributes of the group.
        """
        variables = dict(self._variables(name, entries, fields))
        axes: set[str] = set()
        for variable in variables.values():
            axes.update(variable.dims)
        return NetcdfGroup(variables, coordinates_of_axes(self._coordinates, axes), attributes)


def _observed_entries(result: MissionResult) -> Iterator[Entry]:
    """Yield the variables of the group `observed`: readings, controls and control inputs."""
    scenario = result.scenario
    control_index = result.flight.control_index
    yield from observed_entries(scenario, result.flight.observation_rows)
    yield Entry("control_index", control_index)
    for name in sorted(scenario.control[0].values):  # config.json does not preserve their order
        value_of_control = np.array([control.values[name] for control in scenario.control])
        fields = {"input": name, "unit": result.units.get(name, "1")}
        yield Entry("{input}", value_of_control[control_index], fields)


def _filtered_group(result: MissionResult, builder: _GroupBuilder) -> NetcdfGroup:
    """Return the group of the filtered belief, with decisions, evidence and residuals."""
    flight = result.flight
    expectation = _expected_in_flight(result, flight.filtered, is_smoothed=False)
    values = _belief_variables(result, flight.filtered, expectation)
    values["noise_standard_deviation"] = expectation.noise_standard_deviation
    values["decision_probability"] = flight.decision_probability
    values["log_evidence"] = flight.log_evidence
    residual = flight.observed - expectation.mean
    values["residual"] = residual / expectation.noise_standard_deviation
    values["sensors_received"] = np.isfinite(flight.observed).sum(axis=1)
    # The fields complete descriptions of the schema, such as
    #   "policy averaged over {decided_on}; its mode is the control of the next step",
    #   "observation minus its filtered mean, in the standard deviations {how}".
    belief_of_decision = result.scenario.planner.decide_on
    if isinstance(
        result.knowledge.plan.on_belief, BeliefPolicy
    ):  # such a plan always decides by the predicted belief
        belief_of_decision = "predicted"
    learns = result.knowledge.learning is not None
    fields = {
        "decided_on": _BELIEF_OF_DECISION[belief_of_decision],
        "how": "that the twin has learnt" if learns else "that the twin assumes",
    }
    return builder.group("filtered", _plain_entries(values), fields)


def _smoothed_group(result: MissionResult, builder: _GroupBuilder) -> NetcdfGroup:
    """Return the group of the smoothed belief."""
    smoothed_belief = result.flight.smoothed
    expectation = _expected_in_flight(result, smoothed_belief, is_smoothed=True)
    values = _belief_variables(result, smoothed_belief, expectation)
    return builder.group("smoothed", _plain_entries(values))


def _predicted_group(result: MissionResult, builder: _GroupBuilder) -> NetcdfGroup:
    """Return the group of the predicted belief, whose leading axes are step and horizon.

    A twin that adopts a patched model has different knowledge in different spans of its steps: the
    expectations are computed for each span and concatenated.
    """
    flight = result.flight
    predicted_belief = flight.predicted
    expected_parts = []
    control_probabilities = []
    for knowledge, span in result.spans:
        history_of_span = replace(flight, steps=flight.steps[span])
        expected_in_span, control_probability = expected_ahead(
            history_of_span, knowledge, predicted_belief[span]
        )
        expected_parts.append(expected_in_span)
        control_probabilities.append(control_probability)
    values = _belief_variables(result, predicted_belief, concatenate_expectations(expected_parts))
    values["control_probability"] = np.concatenate(control_probabilities)
    return builder.group("predicted", _plain_entries(values))


def _expected_in_flight(result: MissionResult, belief: Float, *, is_smoothed: bool) -> Expectation:
    """Return the sensors and rewards expected in each step of a flight.

    Each step is evaluated with the model that the twin believed in it.

    Parameters
    ----------
    result : MissionResult
        The mission, of T steps.
    belief : (T, states) array
        The belief over states in each step.
    is_smoothed : bool
        Whether the belief is smoothed, and not filtered.
    """
    flight = result.flight
    expected_parts = []
    for knowledge, span in result.spans:
        history_of_span = replace(flight, steps=flight.steps[span])
        expected_parts.append(
            expected_in_steps(history_of_span, knowledge, belief[span], is_smoothed=is_smoothed)
        )
    return concatenate_expectations(expected_parts)


def _belief_variables(
    result: MissionResult, belief: Float, expectation: Expectation
) -> dict[str, ArrayLike]:
    """Return the variables that the filtered, smoothed and predicted groups share.

    Parameters
    ----------
    result : MissionResult
        The results of the mission.
    belief : (..., states) array
        The probability of each state.
    expectation : Expectation
        The sensors and rewards expected under this belief.
    """
    states = result.knowledge.model.states
    return {
        "probability": belief,
        "mean": states.mean(belief),
        "standard_deviation": states.standard_deviation(belief),
        "quantity_mean": expectation.mean,
        "quantity_standard_deviation": expectation.standard_deviation,
        "quantity_lower": expectation.lower,
        "quantity_upper": expectation.upper,
        "reward_mean": expectation.reward_mean,
        "reward_standard_deviation": expectation.reward_standard_deviation,
    }


def _learnt_entries(result: MissionResult) -> Iterator[Entry]:
    """Yield the moments of each learnt quantity, posterior and prior, for the group `learnt`."""
    for quantity in result.learnt:
        for index, (moment, title) in enumerate(zip(MOMENTS, _MOMENT_TITLES, strict=True)):
            fields = {**quantity.schema_fields, "moment": moment, "moment_title": title}
            yield Entry("{quantity}_{moment}", quantity.posterior[..., index], fields)
            yield Entry("{quantity}_prior_{moment}", quantity.prior[..., index], fields)


def _truth_entries(result: MissionResult, truth: Truth) -> Iterator[Entry]:
    """Yield the variables of the group `truth`: states, sensors, learnt quantities, monitors."""
    flight = result.flight
    status = truth.status[: len(flight.steps)]  # the asset may have ended the mission early
    if truth.in_asset:  # then only the missing readings show which sensors are lost
        is_lost = np.isnan(flight.observed)
        status = np.where(is_lost, SensorStatus.LOST, status).astype(status.dtype)
    yield Entry("state", flight.state)
    yield Entry("{role}", flight.observation)
    yield Entry("sensor_status", status)
    for quantity in result.learnt:
        if quantity.truth is not None:
            yield Entry("{quantity}", quantity.truth, quantity.schema_fields)
    for name, values in sorted(flight.monitors.items()):  # a journal does not preserve their order
        fields = {"monitor": name, "unit": result.units.get(name, "1")}
        yield Entry("{monitor}", values, fields)


Columns = dict[str, AnyArray]
"""The numbers or texts of each column of a table, by its heading."""


@dataclass(frozen=True)
class _TableMaker:
    """Makes the tables of a run.

    Attributes
    ----------
    groups : mapping of str to NetcdfGroup
        The groups of `run.nc`.
    observation : ObservationSection
        How sensors are printed.
    """

    groups: Mapping[str, NetcdfGroup]
    observation: ObservationSection

    @property
    def steps(self) -> Columns:
        """The column of the step, with which most tables begin."""
        return {"step": np.array([str(step) for step in self.groups["observed"]["step"].values])}

    @property
    def controls(self) -> AnyArray:
        """The names of the controls."""
        return self.groups["policy"]["control"].values

    def sensors(self, group: str, variable: str) -> Columns:
        """Return a table of the values of each sensor, in printed units."""
        factor, units = self.observation.printed
        values_by_sensor = factor * self.groups[group][variable].values.T
        columns = dict(self.steps)
        for number, (unit, values) in enumerate(zip(units, values_by_sensor, strict=True), start=1):
            columns[f"{self.observation.role}_{number}_{unit}"] = values
        return columns

    def health(self) -> Columns:
        """Return the columns of `health.csv`: the state of the asset in each step.

        For each state factor, such as the stiffness loss of a region, these are the true value, if
        the run knows the truth, and mean and standard deviation of filtered and smoothed belief.
        """
        variables = {}
        if "truth" in self.groups:
            variables["true"] = self.groups["truth"]["state"]
        for belief in ("filtered", "smoothed"):
            for moment in ("mean", "standard_deviation"):
                variables[f"{belief}_{moment}"] = self.groups[belief][moment]
        columns = dict(self.steps)
        for index, region in enumerate(self.groups["filtered"]["region"].values):
            factor, unit = self._printed_state(region)
            for name, variable in variables.items():
                columns[f"{region}_{name}_{unit}"] = factor * variable.values[:, index]
        return columns

    def _printed_state(self, region: str) -> tuple[float, str]:
        """Return the factor from the stored to the printed unit of a state, and that unit."""
        return printed_state(self.groups["policy"][region].attrs["units"], "percent")

    def decisions(self) -> Columns:
        """Return the table of controls, rewards and decisions."""
        observed_group = self.groups["observed"]
        filtered_group = self.groups["filtered"]
        probability = filtered_group["decision_probability"].values
        columns = dict(self.steps)
        columns["control"] = self.controls[observed_group["control_index"].values]
        reward_names = filtered_group["reward"].values
        reward_means = filtered_group["reward_mean"].values
        columns |= _named_columns("{}_reward", reward_names, reward_means)
        columns |= _named_columns("decision_probability_{}", self.controls, probability)
        columns["next_control"] = self.controls[probability.argmax(axis=1)]
        return columns

    def policy(self) -> Columns:
        """Return the table of the policy: the control in each state, and the action values."""
        policy = self.groups["policy"]
        columns: Columns = {}
        for region in self.groups["filtered"]["region"].values:
            factor, unit = self._printed_state(region)
            columns[f"{region}_{unit}"] = factor * policy[region].values
        columns["control"] = self.controls[policy["control_index"].values]
        action_value = policy["action_value"].values
        columns |= _named_columns("action_value_{}", self.controls, action_value)
        return columns


def csv_tables(
    groups: Mapping[str, NetcdfGroup], observation: ObservationSection
) -> dict[str, str]:
    """Return the text of each CSV file by its name.

    Parameters
    ----------
    groups : mapping of str to NetcdfGroup
        The groups of `run.nc`, as `run_groups` returns them.
    observation : ObservationSection
        How sensors are printed.
    """
    maker = _TableMaker(groups, observation)
    tables = {
        "observed": maker.sensors("observed", observation.role),
        "estimated": maker.sensors("filtered", "quantity_mean"),
    }
    if "truth" in groups:
        tables["true"] = maker.sensors("truth", observation.role)
    tables["health"] = maker.health()
    tables["decisions"] = maker.decisions()
    tables["policy"] = maker.policy()
    texts = {}
    for name, columns in tables.items():
        cells = {heading: _cells(values) for heading, values in columns.items()}
        texts[name] = table_text(cells)
    return texts


def _named_columns(heading_template: str, names: Iterable[str], values: AnyArray) -> Columns:
    """Return the N columns of an array of R rows, each under its heading.

    Parameters
    ----------
    heading_template : str
        The heading of every column, with `{}` in the place of its name: "action_value_{}".
    names : iterable of str
        The N names.
    values : (R, N) array
        The values of the columns.
    """
    columns = {}
    for name, column in zip(names, values.T, strict=True):
        heading = heading_template.format(name)
        columns[heading] = column
    return columns


def _cells(values: AnyArray) -> list[str]:
    """Return the cells of a column, with six digits; empty if the value is NaN."""
    if isinstance(values[0], str):
        return [str(value) for value in values]
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]
