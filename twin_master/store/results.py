"""A flown mission as labelled arrays for `run.nc`, and as tables in CSV."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import AnyArray, Float
from reporting.formats.netcdf import NetcdfGroup, Variable
from reporting.formats.table_file import table_text
from twin_master.learning.expectation import Expectation
from twin_master.mission.plant import SensorStatus, Truth
from twin_master.mission.residuals import expected_ahead, expected_in_steps
from twin_master.network.estimator import MOMENTS
from twin_master.network.planner import BeliefPolicy
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import MissionResult
from twin_master.store.schema import (
    SCHEMA,
    Entry,
    coordinate_variables,
    described_variables,
    in_groups,
    observed_entries,
    scenario_fields,
)

_BELIEF_OF_DECISION = {
    "filtered": "the filtered belief of the step",
    "predicted": "the belief predicted for the next step",
}
"""The words for each value of `planner.decide_on`."""
_MOMENT_TITLES = ("mean", "standard deviation", "5 % quantile", "95 % quantile")


def run_groups(result: MissionResult) -> dict[str, NetcdfGroup]:
    """Return the contents of `run.nc` by group; each variable has its unit and a description."""
    scenario = result.scenario
    flight = result.flight
    plan = result.knowledge.plan
    smoothed = expected_in_steps(flight, result.spans, flight.smoothed, is_smoothed=True)
    entries: dict[str, Iterable[Entry]] = {
        "observed": _observed_entries(result),
        "filtered": _plain_entries(_filtered_variables(result)),
        "smoothed": _plain_entries(_belief_variables(result, flight.smoothed, smoothed)),
        "predicted": _plain_entries(_predicted_variables(result)),
        "earned": _plain_entries({**vars(result.earned), "return": result.discounted_return}),
        "policy": _plain_entries(
            {
                "control_index": plan.control_index,
                "action_value": plan.action_value,
                "value": plan.value,
            }
        ),
        "calibration": _plain_entries({"draw_value": result.knowledge.draws.values}),
    }
    if result.learnt:
        entries["learnt"] = _learnt_entries(result)
    if flight.suspicion:
        entries["notice"] = _plain_entries(_notice_variables(result))
    if result.truth is not None:
        entries["truth"] = _truth_entries(result, result.truth)
    fields = scenario_fields(scenario) | _fields_of_decisions(result)
    fields["parameter_unit"] = result.parameter_unit
    variables: dict[str, Variable] = {}
    for group, entries_of_group in entries.items():
        variables |= described_variables(group, entries_of_group, fields)
    labels: dict[str, ArrayLike] = {
        "control": scenario.control_names,
        "horizon": np.arange(1, scenario.mission.prediction_steps + 1),
        "reward": REWARD_NAMES,
        "draw": np.arange(len(result.knowledge.draws.values)),
    }
    steps = flight.first_step + np.arange(len(flight.steps))
    groups = in_groups(variables, coordinate_variables(scenario, steps, labels))
    parameter = {"parameter": scenario.calibration.parameter}
    groups["calibration"] = replace(groups["calibration"], attrs=parameter)
    return groups


def _fields_of_decisions(result: MissionResult) -> dict[str, str]:
    """Return the words for `decided_on` and `how` in descriptions of the filtered group.

    They are "policy averaged over {decided_on}; its mode is the control of the next step", and
    "observation minus its filtered mean, in the standard deviations {how}".
    """
    belief_of_decision = result.scenario.planner.decide_on
    if isinstance(result.knowledge.plan.on_belief, BeliefPolicy):
        belief_of_decision = "predicted"  # such a plan always decides by the predicted belief
    learns = result.knowledge.learning is not None
    return {
        "decided_on": _BELIEF_OF_DECISION[belief_of_decision],
        "how": "that the twin has learnt" if learns else "that the twin assumes",
    }


def _plain_entries(values: Mapping[str, ArrayLike]) -> list[Entry]:
    """Return an entry for each variable whose name in the schema has no fields in braces."""
    return [Entry(name, np.asarray(array)) for name, array in values.items()]


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


def _filtered_variables(result: MissionResult) -> dict[str, ArrayLike]:
    """Return the filtered belief with decisions, evidence and residuals."""
    flight = result.flight
    expectation = expected_in_steps(flight, result.spans, flight.filtered, is_smoothed=False)
    residual = flight.observed - expectation.mean
    return {
        **_belief_variables(result, flight.filtered, expectation),
        "noise_standard_deviation": expectation.noise_standard_deviation,
        "decision_probability": flight.decision_probability,
        "log_evidence": flight.log_evidence,
        "residual": residual / expectation.noise_standard_deviation,
        "sensors_received": np.isfinite(flight.observed).sum(axis=1),
    }


def _predicted_variables(result: MissionResult) -> dict[str, ArrayLike]:
    """Return the variables of the group `predicted`, whose leading axes are step and horizon."""
    belief = result.flight.predicted
    expectation, control_probability = expected_ahead(result.flight, result.spans, belief)
    values = _belief_variables(result, belief, expectation)
    values["control_probability"] = control_probability
    return values


def _belief_variables(
    result: MissionResult, belief: Float, expectation: Expectation
) -> dict[str, ArrayLike]:
    """Return the variables that the filtered, smoothed and predicted groups share.

    Parameters
    ----------
    belief : (..., states) array
        The probability of each state.
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


def _notice_variables(result: MissionResult) -> Mapping[str, ArrayLike]:
    """Return the suspicion of each step: how well the model explained the sensors."""
    suspicions = result.flight.suspicion
    values = {}
    for name in SCHEMA["notice"]:
        values[name] = np.array([getattr(suspicion, name) for suspicion in suspicions])
    values["left_out"] = values["left_out"].astype(np.int8)
    return values


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
