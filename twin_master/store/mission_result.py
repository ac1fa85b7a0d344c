"""Everything that a mission made, before it is stored, and what its twin has learnt."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from reporting.arrays import Float
from reporting.json_file import plain
from reporting.words import capital, parameter_title
from twin_master.mission.loop import BelievedModel, spans_of
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import History, Truth
from twin_master.network.estimator import Learnt
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import probability_of

MOMENTS = ("mean", "standard_deviation", "lower", "upper")
"""What is kept of each posterior; the last two bound the central 90 % interval."""

_OF_A_SENSOR = re.compile(r"(\w+)\[(\d+)\]")
SCHEMA: dict[str, dict[str, list[str]]] = tomllib.loads(
    Path(__file__).with_name("run.toml").read_text(encoding="utf-8")
)
"""Axes, unit and meaning of every variable of `run.nc`, by its group; and what is learnt, see `titles_of`."""


def paths_of(role: str) -> list[str]:
    """Return the variables that every run has, such as "filtered/mean"."""
    found = [f"observed/{role}"]
    for group in ("observed", "filtered", "smoothed", "predicted", "policy", "calibration"):
        belief = SCHEMA["belief"] if group in ("filtered", "smoothed", "predicted") else {}
        found += [f"{group}/{name}" for name in belief | SCHEMA[group] if "{" not in name]
    return found


def titles_of(name: str) -> list[str]:
    """Return what a learnt quantity is called: in `run.nc`, as a heading, and in short."""
    title = parameter_title(name)
    return SCHEMA["quantities"].get(name, [title, capital(title), title])


@dataclass(frozen=True)
class LearntQuantity:
    """A quantity that is learnt, of the whole asset or of each of its G sensors.

    Attributes
    ----------
    name, title, unit : str
        In `run.nc`, for people, and of all numbers.
    course : (T, 4) or (T, G, 4)
        The figures of `MOMENTS` after each step; NaN for sensors of which it is not learnt.
    prior : (4,) or (G, 4)
        Before the first step.
    truth : () or (G,), or None
        Of a simulated asset, as far as the scenario tells it; NaN for sensors of which it does not.
    """

    name: str
    title: str
    unit: str
    course: Float
    prior: Float
    truth: Float | None

    @property
    def of_sensors(self) -> bool:
        """Whether each sensor has its own."""
        return self.course.ndim == 3

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    @property
    def words(self) -> dict[str, str]:
        """What names it in the schema of `run.nc`."""
        of = "sensor" if self.of_sensors else ""
        return {"quantity": self.name, "title": self.title, "unit": self.unit, "of": of}


def _learnt(result: "MissionResult", prior: Mapping[str, Learnt]) -> tuple[LearntQuantity, ...]:
    """Return what was learnt; names are as the estimator gives them, such as `noise_scale[3]` of sensor 3."""
    scenario, names, values = result.scenario, result.flight.learnt_names, result.flight.learnt
    units = {scenario.calibration.parameter: result.parameter_unit, "gauge_offset": result.observation_unit}
    parts: dict[str, Float] = {}  # the prior and then the course of each: (1 + T, 4), or (1 + T, G, 4)
    for name, course in zip(names, values.swapaxes(0, 1), strict=True):
        figures, match = np.vstack((prior[name].figures, course)), _OF_A_SENSOR.fullmatch(name)
        if match is None:
            parts[name] = figures
            continue
        if match[1] not in parts:
            parts[match[1]] = np.full((len(figures), scenario.observation.count, 4), np.nan)
        parts[match[1]][:, int(match[2]) - 1] = figures
    found = []
    for name, figures in parts.items():
        truth, unit = None if result.truth is None else _truth(scenario, name), units.get(name, "1")
        found.append(LearntQuantity(name, titles_of(name)[0], unit, figures[1:], figures[0], truth))
    return tuple(found)


def _truth(scenario: Scenario, name: str) -> Float | None:
    """Return what the scenario tells of a quantity that the twin learns."""
    truth, observation, known = scenario.truth, scenario.observation, scenario.asset.true_parameters.get(name)
    if known is not None:
        return np.asarray(known, dtype=np.float64)
    if name == "transition_factor" and truth.kind == "random_growth":
        return _true_factor(scenario)
    if truth.kind == "asset" or name not in ("noise_scale", "gauge_gain", "gauge_offset"):
        return None
    if name == "noise_scale":
        if np.any(np.asarray(observation.model_error) > 0.0):
            return None  # noise and model error have one scale, and the error is no noise
        scale = np.asarray(truth.noise.standard_deviation) / np.asarray(observation.standard_deviation)
        return np.broadcast_to(scale, (observation.count,)).copy()
    if scenario.models_differ:
        return None
    healthy = np.zeros(observation.count)
    for fault in truth.sensor_faults:
        if fault.kind == "drift":
            healthy[fault.sensor_indices(observation.count)] = np.nan
    return healthy


def _true_factor(scenario: Scenario) -> Float | None:
    """Return the one factor between the true and the assumed probabilities to worsen; None without one."""
    if not scenario.truth.probability:
        return np.asarray(1.0)
    names = [*product(scenario.control_names, scenario.state_names)]
    tables = scenario.truth.probability, scenario.transition.probability
    true, assumed = (np.array([probability_of(table, *name) for name in names]) for table in tables)
    factor = true.sum() / max(assumed.sum(), np.finfo(float).tiny)
    return np.asarray(factor) if np.allclose(true, factor * assumed, rtol=1e-9, atol=0.0) else None


def printed_learnt(name: str, unit: str, scenario: Scenario) -> tuple[float, str]:
    """Return the factor from the stored unit of a learnt quantity to the printed one, and its name."""
    factor, units = scenario.observation.printed if name == "gauge_offset" else (1.0, (unit,))
    if name == "gauge_gain":
        return 100.0, "%"
    unit = units[0] if len({*units}) == 1 else "unit of each sensor"
    return factor, "" if unit == "1" else unit


def learnt_record(quantities: Sequence[LearntQuantity], sensor_units: Sequence[str]) -> dict[str, Any]:
    """Return what was learnt for the summary, a list where each sensor has its own; nothing without any."""
    told = {
        quantity.name: {
            "title": quantity.title,
            "unit": sensor_units if quantity.unit == SEVERAL_UNITS else quantity.unit,
            "prior": {name: quantity.prior[..., k] for k, name in enumerate(MOMENTS)},
            "posterior": {name: quantity.course[-1, ..., k] for k, name in enumerate(MOMENTS)},
            "truth": quantity.truth,
        }
        for quantity in quantities
    }
    return {"learnt": plain(told)} if told else {}


SEVERAL_UNITS = "see sensor_unit"
"""Unit of a variable over sensors of different units."""


@dataclass(frozen=True)
class MissionResult:
    """Everything that a mission made, before it is stored.

    Attributes
    ----------
    scenario : Scenario
        What was flown.
    knowledge : Knowledge
        What the twin knew before.
    flight : History
        The steps.
    truth : Truth or None
        What the sensors really did; None where nobody knows.
    units : dict of str to str
        Units of control inputs, monitors and parameters; those that are missing are dimensionless.
    models : sequence of BelievedModel
        What the twin believed one after the other, where it was taught; the last is that of `knowledge`.
    """

    scenario: Scenario
    knowledge: Knowledge
    flight: History
    truth: Truth | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    models: Sequence[BelievedModel] = ()

    @property
    def spans(self) -> list[tuple[Knowledge, slice]]:
        """What the twin knew, and in which of the steps."""
        return spans_of(self.flight, self.models or [BelievedModel(0, self.knowledge)])

    @property
    def state_unit(self) -> str:
        """Unit of the state factors; a list where they have several."""
        return ", ".join(dict.fromkeys(factor.unit for factor in self.scenario.state))

    @property
    def observation_unit(self) -> str:
        """Unit of the observed values; where they have several, each sensor has its own, `sensor_unit`."""
        units = dict.fromkeys(self.scenario.observation.sensor_units)
        return next(iter(units)) if len(units) == 1 else SEVERAL_UNITS

    @property
    def parameter_unit(self) -> str:
        """Unit of the uncertain parameter."""
        return self.units.get(self.scenario.calibration.parameter, "1")

    @cached_property
    def learnt(self) -> tuple[LearntQuantity, ...]:
        """What was learnt; empty where nothing is."""
        learning = self.knowledge.learning
        return () if learning is None or not self.flight.steps else _learnt(self, learning.prior)
