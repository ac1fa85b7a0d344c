"""The results of a mission before they are stored, and what its twin has learnt."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonObject, plain
from reporting.words import capital, parameter_title
from twin_master.mission.earnings import Earnings, discounted_return, earnings
from twin_master.mission.plant import Truth
from twin_master.mission.preparation import Knowledge
from twin_master.mission.replay import BelievedModel, spans_of_models
from twin_master.mission.steps import History
from twin_master.network.estimator import MOMENTS, Learnt
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import probability_of
from twin_master.store.schema import SCHEMA, SEVERAL_UNITS, scenario_fields

MEAN = MOMENTS.index("mean")
STANDARD_DEVIATION = MOMENTS.index("standard_deviation")

_NAME_WITH_SENSOR = re.compile(r"(?P<quantity>\w+)\[(?P<sensor>\d+)\]")
"""The name of a quantity of one sensor, such as `noise_scale[3]`."""


class QuantityTitles(NamedTuple):
    """The titles of a learnt quantity.

    Attributes
    ----------
    stored : str
        Its title in `run.nc`.
    heading : str
        The heading of its table in the report.
    short : str
        The title of its figures in the summary.
    """

    stored: str
    heading: str
    short: str


def quantity_titles(name: str) -> QuantityTitles:
    """Return the titles of a learnt quantity.

    They are those of the schema if it lists the quantity, and else follow from the name of the
    parameter.
    """
    if name in SCHEMA["quantities"]:
        stored_title, heading, short_title = SCHEMA["quantities"][name]
        return QuantityTitles(stored_title, heading, short_title)
    title = parameter_title(name)
    return QuantityTitles(title, capital(title), title)


@dataclass(frozen=True)
class LearntQuantity:
    """The posterior of a learnt quantity after each of T steps.

    The quantity belongs to the whole asset, or has a value for each of its G sensors.

    Attributes
    ----------
    name : str
        Its name in `run.nc`.
    title : str
        Its title.
    unit : str
        The unit of all its numbers.
    posterior : (T, 4) or (T, G, 4) array
        The `MOMENTS` after each step; NaN for a sensor whose quantity is not learnt.
    prior : (4,) or (G, 4) array
        The moments before the first step.
    truth : () or (G,) array, or None
        The true value, as far as the scenario gives one; NaN for a sensor without one.
    """

    name: str
    title: str
    unit: str
    posterior: Float
    prior: Float
    truth: Float | None

    @property
    def is_per_sensor(self) -> bool:
        """Whether each sensor has a value of its own."""
        return self.posterior.ndim == 3

    @property
    def most_departed_sensor(self) -> int:
        """The index of the sensor whose last mean is furthest from its prior mean.

        The distance is measured in standard deviations of the last posterior.
        """
        last_moments = self.posterior[-1]  # (G, 4)
        departure = np.abs(last_moments[:, MEAN] - self.prior[:, MEAN])
        return int(np.nanargmax(departure / last_moments[:, STANDARD_DEVIATION]))

    @property
    def label(self) -> str:
        """The title with the unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    @property
    def schema_fields(self) -> dict[str, str]:
        """The values of the fields in the schema of `run.nc`."""
        axis = "sensor" if self.is_per_sensor else ""
        return {"quantity": self.name, "title": self.title, "unit": self.unit, "of": axis}


def _learnt_quantities(
    result: "MissionResult", prior: Mapping[str, Learnt]
) -> tuple[LearntQuantity, ...]:
    """Return the learnt quantities of a mission.

    The estimator has a separate quantity for each sensor, such as `noise_scale[3]`. Those that
    differ only in the number of the sensor are joined into one quantity.

    Parameters
    ----------
    result : MissionResult
        The results of the mission.
    prior : mapping of str to Learnt
        The prior of each quantity, by the name that the estimator gives it.
    """
    scenario = result.scenario
    units = {
        scenario.calibration.parameter: result.parameter_unit,
        "gauge_offset": scenario_fields(scenario)["sensor_unit"],
    }
    # The four moments of each quantity, before the first and after each of T steps:
    # (1 + T, 4) for the whole asset, (1 + T, G, 4) for G sensors
    moments_of: dict[str, Float] = {}
    posteriors = result.flight.learnt.swapaxes(0, 1)  # (quantities of the estimator, T, 4)
    for full_name, posterior in zip(result.flight.learnt_names, posteriors, strict=True):
        moments = np.vstack((prior[full_name].moments_and_bounds, posterior))
        match = _NAME_WITH_SENSOR.fullmatch(full_name)
        if match is None:
            moments_of[full_name] = moments
            continue
        name = match["quantity"]
        if name not in moments_of:
            moments_of[name] = np.full((len(moments), scenario.observation.count, 4), np.nan)
        sensor = int(match["sensor"]) - 1
        moments_of[name][:, sensor] = moments
    quantities = []
    for name, moments in moments_of.items():
        quantities.append(
            LearntQuantity(
                name,
                title=quantity_titles(name).stored,
                unit=units.get(name, "1"),
                posterior=moments[1:],
                prior=moments[0],
                truth=None if result.truth is None else _true_value(scenario, name),
            )
        )
    return tuple(quantities)


def _true_value(scenario: Scenario, name: str) -> Float | None:
    """Return the true value of a learnt quantity, of shape () or (G,) for G sensors.

    None is returned if the scenario does not determine it.
    """
    parameter = scenario.asset.true_parameters.get(name)
    if parameter is not None:
        return np.asarray(parameter, dtype=np.float64)
    if name == "transition_factor" and scenario.truth.kind == "random_growth":
        return _true_transition_factor(scenario)
    if scenario.truth.kind == "asset":  # noise and faults are those of the asset itself
        return None
    if name == "noise_scale":
        return _true_noise_scale(scenario)
    if name in ("gauge_gain", "gauge_offset") and not scenario.models_differ:
        return _true_gauge_error(scenario)
    return None


def _true_noise_scale(scenario: Scenario) -> Float | None:
    """Return the true over the assumed standard deviation of the noise of each of G sensors.

    None is returned if the scenario has a model error: noise and model error are learnt as one
    scale, which then has no true value.
    """
    observation = scenario.observation
    if np.any(np.asarray(observation.model_error) > 0.0):
        return None
    true_deviation = np.asarray(scenario.truth.noise.standard_deviation)
    scale = true_deviation / np.asarray(observation.standard_deviation)
    return np.broadcast_to(scale, (observation.count,)).copy()


def _true_gauge_error(scenario: Scenario) -> Float:
    """Return the true gain error or offset of each of G sensors.

    Both are zero, because asset and model agree; those of a sensor that drifts are NaN, because
    they change during the flight.
    """
    sensors = scenario.observation.count
    error = np.zeros(sensors)
    for fault in scenario.truth.sensor_faults:
        if fault.kind == "drift":
            error[fault.sensor_indices(sensors)] = np.nan
    return error


def _true_transition_factor(scenario: Scenario) -> Float | None:
    """Return the true over the assumed probability of a state to worsen.

    None is returned if this factor is not the same for all controls and state factors.
    """
    if not scenario.truth.probability:
        return np.asarray(1.0)
    true_probabilities = _worsening_probabilities(scenario, scenario.truth.probability)
    assumed_probabilities = _worsening_probabilities(scenario, scenario.transition.probability)
    factor = true_probabilities.sum() / max(assumed_probabilities.sum(), np.finfo(float).tiny)
    if np.allclose(true_probabilities, factor * assumed_probabilities, rtol=1e-9, atol=0.0):
        return np.asarray(factor)
    return None


def _worsening_probabilities(
    scenario: Scenario, table: Mapping[str, float | Mapping[str, float]]
) -> Float:
    """Return the probability that each state factor worsens under each control, in a vector.

    The state factors of the first control come first, then those of the second one.
    """
    probabilities = []
    for control in scenario.control_names:
        for state in scenario.state_names:
            probabilities.append(probability_of(table, control, state))
    return np.array(probabilities)


def printed_unit_of_quantity(name: str, unit: str, scenario: Scenario) -> tuple[float, str]:
    """Return the printed unit of a learnt quantity, and the factor from its stored unit.

    Parameters
    ----------
    name : str
        The name of the quantity.
    unit : str
        Its stored unit.
    scenario : Scenario
        The scenario, which says how sensors are printed.

    Returns
    -------
    float
        The factor from the stored to the printed unit.
    str
        The printed unit; empty for a number without one.
    """
    if name == "gauge_gain":
        return 100.0, "%"
    factor = 1.0
    if name == "gauge_offset":
        factor, units = scenario.observation.printed
        unit = units[0] if len({*units}) == 1 else "unit of each sensor"
    return factor, "" if unit == "1" else unit


def learnt_record(quantities: Sequence[LearntQuantity], sensor_units: Sequence[str]) -> JsonObject:
    """Return the entry `learnt` of the summary; an empty record if nothing was learnt.

    Parameters
    ----------
    quantities : sequence of LearntQuantity
        The learnt quantities. One with a value for each sensor is written as lists.
    sensor_units : sequence of str
        The unit of each sensor.
    """
    if not quantities:
        return {}
    record = {}
    for quantity in quantities:
        record[quantity.name] = {
            "title": quantity.title,
            "unit": sensor_units if quantity.unit == SEVERAL_UNITS else quantity.unit,
            "prior": _by_moment(quantity.prior),
            "posterior": _by_moment(quantity.posterior[-1]),
            "truth": quantity.truth,
        }
    return {"learnt": plain(record)}


def _by_moment(moments: Float) -> dict[str, Float]:
    """Return the moments on the last axis of an array by their names in `MOMENTS`."""
    return {name: moments[..., index] for index, name in enumerate(MOMENTS)}


@dataclass(frozen=True)
class MissionResult:
    """The results of a mission before they are stored.

    Attributes
    ----------
    knowledge : Knowledge
        The knowledge of the twin before its flight.
    truth : Truth or None
        Noise, drift and faults of the sensors; None for a real asset.
    units : mapping of str to str
        The units of control inputs, monitors and parameters; those that are not named are
        dimensionless.
    models : sequence of BelievedModel
        The models that the twin believed one after the other, if it was taught; the last one is
        that of `knowledge`.
    """

    scenario: Scenario
    knowledge: Knowledge
    flight: History
    truth: Truth | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    models: Sequence[BelievedModel] = ()

    @property
    def spans(self) -> list[tuple[Knowledge, slice]]:
        """The knowledge of the twin in successive spans of steps."""
        models = self.models or [BelievedModel(0, self.knowledge)]
        return spans_of_models(self.flight, models)

    @cached_property
    def earned(self) -> Earnings:
        """The earnings in each step, by the model that the twin believed then."""
        flight = self.flight
        step_count = len(flight.steps)
        state = np.full((step_count, len(self.scenario.state)), np.nan)
        if flight.simulated:
            state = flight.state
        earned_in_spans = []
        for knowledge, span in self.spans:
            earned_in_spans.append(
                earnings(knowledge, flight.control_index[span], flight.filtered[span], state[span])
            )
        return Earnings.concatenate(earned_in_spans)

    @property
    def discounted_return(self) -> float:
        """The sum of the rewards of the steps, discounted."""
        control = self.flight.control_index
        return float(discounted_return(self.scenario, self.earned.reward, control))

    @property
    def parameter_unit(self) -> str:
        """The unit of the calibrated parameter."""
        return self.units.get(self.scenario.calibration.parameter, "1")

    @cached_property
    def learnt(self) -> tuple[LearntQuantity, ...]:
        """The learnt quantities; empty if nothing was learnt."""
        learning = self.knowledge.learning
        if learning is None or not self.flight.steps:
            return ()
        return _learnt_quantities(self, learning.prior)
