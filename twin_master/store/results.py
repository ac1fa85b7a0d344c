"""A flown mission as labelled arrays: what was observed, believed, predicted, decided, and true."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.groups import Group, Variable
from twin_master.learning.expectation import Expected
from twin_master.mission.truth import SensorStatus, Truth
from twin_master.network.inference import known_control
from twin_master.network.rewards import REWARD_NAMES
from twin_master.store.learnt import MOMENTS
from twin_master.store.mission_result import SEVERAL_UNITS, MissionResult

Float = NDArray[np.float64]


def groups_of(result: MissionResult) -> dict[str, Group]:
    """Return the groups of `run.nc` for a mission; every variable carries its unit and a description."""
    labels = _Labels(result)
    groups = {
        "observed": _observed(result, labels),
        "filtered": _filtered(result, labels),
        "smoothed": _smoothed(result, labels),
        "predicted": _predicted(result, labels),
        "policy": _policy(result, labels),
        "calibration": labels.group(
            {
                "draw_value": (
                    ("draw",),
                    result.draws,
                    result.parameter_unit,
                    "draws of the uncertain parameter, equally weighted",
                )
            },
            {"parameter": result.scenario.calibration.parameter},
        ),
    }
    if result.learnt:
        groups["learnt"] = _learnt(result, labels)
    if result.flight.suspicion:
        groups["notice"] = _notice(result, labels)
    if result.truth is not None:
        groups["truth"] = _truth(result, labels, result.truth)
    return groups


Described = tuple[tuple[str, ...], NDArray[Any], str, str]
"""Axes, values, unit and description."""


class _Labels:
    """Coordinates of every dimension, and groups that carry those which they use."""

    def __init__(self, result: MissionResult) -> None:
        scenario, model = result.scenario, result.model
        names = scenario.state_names
        self.coordinates: dict[str, Variable] = {
            "step": Variable(
                ("step",),
                result.flight.first_turn + np.arange(len(result.flight.observed)),
                {"long_name": "step", "units": "1"},
            ),
            "sensor": Variable(
                ("sensor",),
                np.arange(1, scenario.observation.count + 1),
                {"long_name": "sensor", "units": "1"},
            ),
            "region": Variable(("region",), np.array(names), {"long_name": "factor of the state"}),
            "control": Variable(("control",), np.array(scenario.control_names), {"long_name": "control"}),
            "horizon": Variable(
                ("horizon",),
                np.arange(1, scenario.mission.prediction_steps + 1),
                {"long_name": "steps ahead", "units": "1"},
            ),
            "reward": Variable(("reward",), np.array(REWARD_NAMES), {"long_name": "reward"}),
            "draw": Variable(
                ("draw",), np.arange(len(result.draws)), {"long_name": "draw of the parameter", "units": "1"}
            ),
        }
        observation = scenario.observation
        self.sensors: dict[str, Variable] = {}
        if result.observation_unit == SEVERAL_UNITS:
            unit = np.array(observation.sensor_units)
            self.sensors["sensor_unit"] = Variable(("sensor",), unit, {"long_name": "unit of each sensor"})
        if observation.titles:
            title = np.array(observation.titles)
            self.sensors["sensor_title"] = Variable(("sensor",), title, {"long_name": "name of each sensor"})
        self.states = {
            factor.name: Variable(
                ("state",),
                model.states.coordinates[:, index],
                {"long_name": factor.name, "units": factor.unit},
            )
            for index, factor in enumerate(scenario.state)
        }

    def group(self, variables: Mapping[str, Described], attrs: Mapping[str, str] | None = None) -> Group:
        dimensions = {name for variable in variables.values() for name in variable[0]}
        coordinates: dict[str, Variable] = {
            name: variable for name, variable in self.coordinates.items() if name in dimensions
        }
        if "state" in dimensions:
            coordinates |= self.states
        if "sensor" in dimensions:
            coordinates |= self.sensors
        return Group(
            {
                name: Variable(dims, np.asarray(values), {"units": unit, "long_name": text})
                for name, (dims, values, unit, text) in variables.items()
            },
            coordinates,
            attrs or {},
        )


def _observed(result: MissionResult, labels: _Labels) -> Group:
    flight, scenario = result.flight, result.scenario
    role, unit = scenario.observation.role, result.observation_unit
    variables: dict[str, Described] = {
        role: (("step", "sensor"), flight.observed, unit, f"{role} as received; NaN where a sensor is lost"),
        "control_index": (("step",), flight.control_index, "1", "control in force"),
    }
    for place, (_, state, name, _) in enumerate(scenario.readings[: flight.readings.shape[1]]):
        read, text = flight.readings[:, place], "reading of an inspection; NaN where none was asked for"
        variables[name] = (("step",), read, scenario.state[state].unit, text)
    for name in sorted(scenario.control[0].values):  # config.json does not keep their order
        values = np.array([control.values[name] for control in scenario.control])[flight.control_index]
        variables[name] = (("step",), values, result.units.get(name, "1"), f"{name} in force")
    return labels.group(variables)


def _expected(result: MissionResult, joint: Float, observed: Float | None) -> Expected:
    """Return what beliefs (..., S, U) say of sensors and rewards where nothing is learnt."""
    mean, deviation = result.sensor_model.moments(joint)
    quantiles = result.sensor_model.quantiles(joint, (0.025, 0.975))
    rewards = result.rewards.expectation(joint, observed)
    return Expected(
        mean, deviation, quantiles[..., 0, :], quantiles[..., 1, :], result.sensor_model.noise(joint),
        rewards.mean, rewards.standard_deviation,
    )  # fmt: skip


def _belief(
    result: MissionResult, lead: tuple[str, ...], probability: Float, expected: Expected, given: str
) -> dict[str, Described]:
    """Return belief, moments, quantities of interest and rewards; `given` says what the belief is given."""
    states = result.model.states
    role, unit = result.scenario.observation.role, result.observation_unit
    sensor = (*lead, "sensor")
    return {
        "probability": ((*lead, "state"), probability, "1", f"p(state | {given})"),
        "mean": (
            (*lead, "region"),
            states.mean(probability),
            result.state_unit,
            f"mean of each factor given {given}",
        ),
        "standard_deviation": (
            (*lead, "region"),
            states.standard_deviation(probability),
            result.state_unit,
            f"standard deviation of each factor given {given}",
        ),
        "quantity_mean": (sensor, expected.mean, unit, f"mean of the noise-free {role} given {given}"),
        "quantity_standard_deviation": (
            sensor,
            expected.standard_deviation,
            unit,
            f"standard deviation of the noise-free {role} given {given}",
        ),
        "quantity_lower": (sensor, expected.lower, unit, f"2.5 % quantile of the noise-free {role}"),
        "quantity_upper": (sensor, expected.upper, unit, f"97.5 % quantile of the noise-free {role}"),
        "reward_mean": ((*lead, "reward"), expected.reward_mean, "1", "mean of each reward, eqs. (9)-(11)"),
        "reward_standard_deviation": (
            (*lead, "reward"),
            expected.reward_standard_deviation,
            "1",
            "standard deviation of each reward",
        ),
    }


_DECIDED_ON = {
    "filtered": "the filtered belief of the step",
    "predicted": "the belief predicted for the next step",
}


def _filtered(result: MissionResult, labels: _Labels) -> Group:
    flight = result.flight
    if result.expectation is None:
        joint = known_control(flight.filtered, flight.control_index, len(result.model.controls))
        expected, how = _expected(result, joint, flight.observed), "that the twin assumes"
    else:
        expected = result.expectation.filtered(flight.carried, flight.observed)
        how = "that the twin has learnt"
    variables = _belief(result, ("step",), flight.filtered, expected, "observations up to the step")
    if result.expectation is not None:
        variables["noise_standard_deviation"] = (
            ("step", "sensor"),
            expected.noise,
            result.observation_unit,
            "standard deviation of noise and model error of each sensor as learnt",
        )
    variables |= {
        "decision_probability": (
            ("step", "control"),
            flight.decision_probability,
            "1",
            f"policy averaged over {_DECIDED_ON[result.scenario.planner.decide_on]}; "
            "its mode is the control of the next step",
        ),
        "log_evidence": (("step",), flight.log_evidence, "1", "log p(observation | earlier observations)"),
        "residual": (
            ("step", "sensor"),
            (flight.observed - expected.mean) / expected.noise,
            "1",
            f"observation less its filtered mean, in the standard deviations {how}",
        ),
        "sensors_received": (
            ("step",),
            np.isfinite(flight.observed).sum(axis=1),
            "1",
            "sensors received; with none the belief follows the dynamics",
        ),
    }
    return labels.group(variables)


def _smoothed(result: MissionResult, labels: _Labels) -> Group:
    flight = result.flight
    if result.expectation is None:
        joint = known_control(flight.smoothed, flight.control_index, len(result.model.controls))
        expected = _expected(result, joint, flight.observed)
    else:
        expected = result.expectation.smoothed(flight.carried, flight.observed)
    return labels.group(_belief(result, ("step",), flight.smoothed, expected, "all observations"))


def _predicted(result: MissionResult, labels: _Labels) -> Group:
    flight = result.flight
    lead = ("step", "horizon")
    joint = flight.predicted[..., :, None] * result.plan.policy  # (T, H, S, U), eqs. (37)-(39)
    given = "observations up to the step, through the policy"
    if result.expectation is None:
        expected = _expected(result, joint, None)
    else:
        expected = result.expectation.predicted(flight.carried, flight.predicted.shape[1])
    variables = _belief(result, lead, flight.predicted, expected, given)
    variables["control_probability"] = (
        (*lead, "control"),
        joint.sum(axis=-2),
        "1",
        "p(control | observations up to the step): what the policy asks for in the state predicted",
    )
    return labels.group(variables)


def _policy(result: MissionResult, labels: _Labels) -> Group:
    plan = result.plan
    return labels.group(
        {
            "control_index": (("state",), plan.control_index, "1", "control of the policy in each state"),
            "action_value": (("state", "control"), plan.action_value, "1", "Q of value iteration, eq. (36)"),
            "value": (("state",), plan.value, "1", "value of each state"),
        }
    )


_MOMENT_TITLES = dict(
    zip(MOMENTS, ("mean", "standard deviation", "5 % quantile", "95 % quantile"), strict=True)
)


def _learnt(result: MissionResult, labels: _Labels) -> Group:
    variables: dict[str, Described] = {}
    for quantity in result.learnt:
        sensor = ("sensor",) if quantity.of_sensors else ()
        for index, (moment, text) in enumerate(_MOMENT_TITLES.items()):
            variables[f"{quantity.name}_{moment}"] = (
                ("step", *sensor),
                quantity.course[..., index],
                quantity.unit,
                f"{quantity.title}: {text} given observations up to the step",
            )
            variables[f"{quantity.name}_prior_{moment}"] = (
                sensor,
                quantity.prior[..., index],
                quantity.unit,
                f"{quantity.title}: {text} before the first step",
            )
    return labels.group(variables)


def _notice(result: MissionResult, labels: _Labels) -> Group:
    turns = result.flight.suspicion
    described = {
        "none_of_these": "p(no state of the model explains the sensors | observations up to the step)",
        "gauge_off": "p(a single sensor does not show what is there | observations up to the step)",
        "log_evidence_none": "log e-value of the first: evidence for it over that for the model",
        "log_evidence_any_gauge": "log e-value of the second",
        "log_evidence_gauge": "log e-value of each sensor",
        "left_out": "1 where the readings of a sensor are absurd and left out",
    }
    variables: dict[str, Described] = {}
    for name, text in described.items():
        values = np.array([getattr(turn, name) for turn in turns])
        values = values.astype(np.int8) if values.dtype == bool else values
        variables[name] = (("step", "sensor")[: values.ndim], values, "1", text)
    return labels.group(variables)


def _truth(result: MissionResult, labels: _Labels, truth: Truth) -> Group:
    record, role = result.flight.happened, result.scenario.observation.role
    status = truth.status[: len(record.state)]  # the asset may have ended the mission
    if truth.in_asset:
        status = np.where(np.isnan(result.flight.observed), SensorStatus.LOST, status).astype(status.dtype)
    variables: dict[str, Described] = {
        "state": (
            ("step", "region"),
            record.state,
            result.state_unit,
            "true value of each factor of the state",
        ),
        role: (
            ("step", "sensor"),
            record.observation,
            result.observation_unit,
            f"true {role}, without noise and faults",
        ),
        "sensor_status": (
            ("step", "sensor"),
            status,
            "1",
            "what each sensor really does: 0 healthy, 1 lost, 2 drifting",
        ),
    }
    for quantity in result.learnt:
        if quantity.truth is not None:
            variables[quantity.name] = (
                ("sensor",) if quantity.of_sensors else (),
                quantity.truth,
                quantity.unit,
                f"true {quantity.title}",
            )
    for name, values in sorted(record.monitors.items()):  # a checkpoint does not keep their order
        variables[name] = (("step",), values, result.units.get(name, "1"), f"{name}, as the asset reports it")
    return labels.group(variables)
