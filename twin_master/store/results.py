"""A flown mission as labelled arrays, and as tables for people."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.netcdf import NetcdfGroup, Variable
from reporting.table_file import table_text
from twin_master.learning.expectation import concatenate_expectations
from twin_master.mission.loop import expected_in
from twin_master.mission.steps import SensorStatus, Truth
from twin_master.scenario.observation import ObservationSection
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import MOMENTS, SCHEMA, SEVERAL_UNITS, MissionResult

Words = Mapping[str, str]
_NONE: Words = MappingProxyType({})
Entry = tuple[str, NDArray[Any], Words]
"""A name in the schema, the values, and the words that stand in its braces."""

_DECIDED_ON = {
    "filtered": "the filtered belief of the step",
    "predicted": "the belief predicted for the next step",
}
_MOMENT_TITLES = ("mean", "standard deviation", "5 % quantile", "95 % quantile")


def groups_of(result: MissionResult) -> dict[str, NetcdfGroup]:
    """Return the groups of `run.nc` for a mission; every variable carries its unit and a description."""
    made, plan = _Groups(result), result.knowledge.plan
    policy = {"control_index": plan.control_index, "action_value": plan.action_value, "value": plan.value}
    groups = {
        "observed": made.group("observed", _observed(result)),
        **dict(_beliefs(result, made)),
        "policy": made.group("policy", _plain(policy)),
        "calibration": made.group(
            "calibration",
            _plain({"draw_value": result.knowledge.draws.values}),
            attrs={"parameter": result.scenario.calibration.parameter},
        ),
    }
    if result.learnt:
        groups["learnt"] = made.group("learnt", _learnt(result))
    if steps := result.flight.suspicion:
        told = {name: np.array([getattr(step, name) for step in steps]) for name in SCHEMA["notice"]}
        told["left_out"] = told["left_out"].astype(np.int8)
        groups["notice"] = made.group("notice", _plain(told))
    if result.truth is not None:
        groups["truth"] = made.group("truth", _truth(result, result.truth))
    return groups


def _plain(values: Mapping[str, Any]) -> list[Entry]:
    return [(name, np.asarray(array), {}) for name, array in values.items()]


class _Groups:
    """Makes groups by the schema, each with the coordinates of its axes."""

    def __init__(self, result: MissionResult) -> None:
        scenario, flight = result.scenario, result.flight
        observation = scenario.observation
        self._words = {
            "role": observation.role,
            "sensor_unit": result.observation_unit,
            "state_unit": result.state_unit,
            "parameter_unit": result.parameter_unit,
        }
        labels: dict[str, Any] = {
            "step": flight.first_step + np.arange(len(flight.steps)),
            "sensor": np.arange(1, observation.count + 1),
            "region": scenario.state_names,
            "control": scenario.control_names,
            "horizon": np.arange(1, scenario.mission.prediction_steps + 1),
            "reward": REWARD_NAMES,
            "draw": np.arange(len(result.knowledge.draws.values)),
        }
        if result.observation_unit == SEVERAL_UNITS:
            labels["sensor_unit"] = observation.sensor_units
        if observation.titles:
            labels["sensor_title"] = observation.titles
        entries = _plain(labels)
        for values, factor in zip(result.knowledge.model.states.coordinates.T, scenario.state, strict=True):
            entries.append(("{factor}", values, {"factor": factor.name, "factor_unit": factor.unit}))
        self._coordinates = dict(self._variables("coordinates", entries, {}))

    def _variables(
        self, group: str, entries: Iterable[Entry], words: Mapping[str, str]
    ) -> Iterator[tuple[str, Variable]]:
        known = SCHEMA["belief"] | SCHEMA["noise"] | SCHEMA[group] if "given" in words else SCHEMA[group]
        for name, values, own in entries:
            told = {**self._words, **words, **own}
            axes, unit, text = (part.format(**told) for part in known[name])
            attrs = {"units": unit, "long_name": text} if unit else {"long_name": text}
            yield name.format(**told), Variable(tuple(axes.split()), values, attrs)

    def group(
        self, name: str, entries: Iterable[Entry], words: Words = _NONE, attrs: Words = _NONE
    ) -> NetcdfGroup:
        """Return a group of the schema; `words` stand in braces of all its entries."""
        variables = dict(self._variables(name, entries, words))
        axes = {axis for variable in variables.values() for axis in variable.dims}
        coordinates = {
            name: label for name, label in self._coordinates.items() if axes.issuperset(label.dims)
        }
        return NetcdfGroup(variables, coordinates, attrs)


def _observed(result: MissionResult) -> Iterator[Entry]:
    flight, scenario = result.flight, result.scenario
    yield "{role}", flight.observed, {}
    yield "control_index", flight.control_index, {}
    if scenario.observation.modes is not None:
        yield "{role}_covariance", flight.readings, {}
    for place, (_, state, name, _) in enumerate(scenario.readings):
        words = {"reading": name, "unit": scenario.state[state].unit}
        yield "{reading}", flight.readings[:, place], words
    for name in sorted(scenario.control[0].values):  # config.json does not keep their order
        values = np.array([control.values[name] for control in scenario.control])[flight.control_index]
        yield "{input}", values, {"input": name, "unit": result.units.get(name, "1")}


def _beliefs(result: MissionResult, made: _Groups) -> Iterator[tuple[str, NetcdfGroup]]:
    """Yield the groups of the beliefs filtered, smoothed and predicted."""
    flight, known = result.flight, result.knowledge
    states, observed, so_far = known.model.states, flight.observed, "observations up to the step"
    for name, belief, given in (
        ("filtered", flight.filtered, so_far),
        ("smoothed", flight.smoothed, "all observations"),
        ("predicted", flight.predicted, f"{so_far}, through the policy"),
    ):
        flown = name != "predicted"
        parts = [
            expected_in(replace(flight, steps=flight.steps[part]), own, name, belief[part])
            for own, part in result.spans
        ]
        expected = concatenate_expectations([part for part, _ in parts])
        values = {
            "probability": belief,
            "mean": states.mean(belief),
            "standard_deviation": states.standard_deviation(belief),
            "quantity_mean": expected.mean,
            "quantity_standard_deviation": expected.standard_deviation,
            "quantity_lower": expected.lower,
            "quantity_upper": expected.upper,
            "reward_mean": expected.reward_mean,
            "reward_standard_deviation": expected.reward_standard_deviation,
        }
        words = {"lead": "step" if flown else "step horizon", "given": given}
        if name == "filtered":
            values |= {
                "noise_standard_deviation": expected.noise,
                "decision_probability": flight.decision_probability,
                "log_evidence": flight.log_evidence,
                "residual": (observed - expected.mean) / expected.noise,
                "sensors_received": np.isfinite(observed).sum(axis=1),
            }
            told = "predicted" if known.plan.on_belief is not None else result.scenario.planner.decide_on
            words["decided_on"] = _DECIDED_ON[told]
            words["how"] = "that the twin assumes" if known.learning is None else "that the twin has learnt"
        elif name == "predicted":
            values["control_probability"] = np.concatenate([asked for _, asked in parts])
        yield name, made.group(name, _plain(values), words)


def _learnt(result: MissionResult) -> Iterator[Entry]:
    for quantity in result.learnt:
        for index, (moment, title) in enumerate(zip(MOMENTS, _MOMENT_TITLES, strict=True)):
            words = {**quantity.words, "moment": moment, "moment_title": title}
            yield "{quantity}_{moment}", quantity.course[..., index], words
            yield "{quantity}_prior_{moment}", quantity.prior[..., index], words


def _truth(result: MissionResult, truth: Truth) -> Iterator[Entry]:
    flight = result.flight
    status = truth.status[: len(flight.steps)]  # the asset may have ended the mission
    if truth.in_asset:
        status = np.where(np.isnan(flight.observed), SensorStatus.LOST, status).astype(status.dtype)
    yield "state", flight.state, {}
    yield "{role}", flight.observation, {}
    yield "sensor_status", status, {}
    for quantity in result.learnt:
        if quantity.truth is not None:
            yield "{quantity}", quantity.truth, quantity.words
    for name, values in sorted(flight.monitors.items()):  # a journal does not keep their order
        yield "{monitor}", values, {"monitor": name, "unit": result.units.get(name, "1")}


Columns = dict[str, Any]
"""Numbers or texts of each column, by its heading."""


def tables_of(groups: Mapping[str, NetcdfGroup], observation: ObservationSection) -> dict[str, str]:
    """Return the text of each CSV file by its name.

    Parameters
    ----------
    groups
        As `groups_of` returns them.
    observation
        How sensors are printed.
    """
    observed, filtered, policy = (groups[name] for name in ("observed", "filtered", "policy"))
    controls, asked = policy["control"].values, filtered["decision_probability"].values
    role = observation.role
    steps: Columns = {"step": [str(step) for step in observed["step"].values]}
    known = {"true": groups["truth"]["state"]} if "truth" in groups else {}
    for kind in ("filtered", "smoothed"):
        known |= {f"{kind}_{name}": groups[kind][name] for name in ("mean", "standard_deviation")}
    health, states = dict(steps), Columns()
    for place, region in enumerate(filtered["region"].values):
        factor, unit = printed_state(policy[region].attrs["units"], "percent")
        states[f"{region}_{unit}"] = factor * policy[region].values
        for name, variable in known.items():
            health[f"{region}_{name}_{unit}"] = factor * variable.values[:, place]
    tables = {
        "observed": steps | _observations(observed, role, observation),
        "estimated": steps | _observations(filtered, "quantity_mean", observation),
        **({"true": steps | _observations(groups["truth"], role, observation)} if "truth" in groups else {}),
        "health": health,
        "decisions": steps
        | {"control": controls[observed["control_index"].values]}
        | _each("{}_reward", filtered["reward"].values, filtered["reward_mean"].values)
        | _each("decision_probability_{}", controls, asked)
        | {"next_control": controls[asked.argmax(axis=1)]},
        "policy": states
        | {"control": controls[policy["control_index"].values]}
        | _each("action_value_{}", controls, policy["action_value"].values),
    }
    return {
        name: table_text({title: _cells(values) for title, values in columns.items()})
        for name, columns in tables.items()
    }


def _observations(group: NetcdfGroup, variable: str, observation: ObservationSection) -> Columns:
    factor, units = observation.printed
    names = (f"{observation.role}_{number}_{unit}" for number, unit in enumerate(units, start=1))
    return dict(zip(names, factor * group[variable].values.T, strict=True))


def _each(title: str, names: Iterable[str], values: NDArray[Any]) -> Columns:
    """Return a column for each of some names, of values (T, N)."""
    return {title.format(name): column for name, column in zip(names, values.T, strict=True)}


def _cells(values: Any) -> list[str]:
    """Return the cells of a column, for people; empty where nothing was received."""
    if isinstance(values[0], str):
        return [str(value) for value in values]
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]
