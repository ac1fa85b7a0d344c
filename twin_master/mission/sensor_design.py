"""The choice of sensors with the most expected information about the state.

The information of a set of sensors is the expected logarithm of the posterior probability of the
true state over its prior probability. The expectation is over simulated readings, with all states
equally probable. Effects that move all sensors together (a damage between two levels, the
calibrated parameter) count as common, not as independent noise. A structure may have candidate
gauges in addition to those of its file. Scenarios count sensors from 1.

The axes of arrays are N drawn readings, S states, G sensors and F common effects.
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from fe.runtime.errors import InvalidDesignError
from fe.structure.design import Gauge, Gauged, MeshDesign, load_structure, parse_structure
from fe.structure.gauges import evenly_placed_rosettes, gauge_rows
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from reporting.arrays import Float, Index
from reporting.files import write_members
from reporting.formats.toml_file import read_toml, validate
from twin_master.assets.asset_source import read_files
from twin_master.assets.structure_source import MODEL_COPY, StructureBelief
from twin_master.errors import MissionInputError
from twin_master.mission.preparation import Knowledge
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

SAMPLES = 300
"""Approximate number of readings that are drawn for each control.

They are spread evenly over the states; if there are more states, this number of them is drawn.
"""
_LEAST_GAIN = 1e-9
"""Least gain of information for which two sensors are exchanged, in bits."""


class _LikelihoodTerms(NamedTuple):
    """For each sensor, the terms of the likelihood, which are summed over a set of sensors.

    Attributes
    ----------
    squared_residual : (G, N, S) array
        The squared residual of each reading and state.
    loading_residual : (G, S, N, F) array
        The product of loading and residual.
    loading_product : (G, S, F, F) array
        The product of the loadings of two common effects.
    """

    squared_residual: Float
    loading_residual: Float
    loading_product: Float


@dataclass(frozen=True)
class DrawnReadings:
    """N readings of all G sensors, drawn under one control in S possible states.

    Attributes
    ----------
    state : (N,) array
        The index of the state in which each reading was drawn.
    residual : (N, S, G) array
        The difference to the mean in each state, in standard deviations of the sensor.
    loadings : (S, G, F) array
        The change of each sensor if one of F common effects moves by its standard deviation, in
        standard deviations of the sensor.
    log_deviation : (S, G) array
        The logarithm of the standard deviation of each sensor.
    """

    state: Index
    residual: Float
    loadings: Float
    log_deviation: Float

    @cached_property
    def _terms(self) -> _LikelihoodTerms:
        """The terms of each sensor's likelihood; the terms of a set of sensors are their sum."""
        residual = self.residual.transpose(2, 0, 1)  # (G, N, S)
        loadings = self.loadings.transpose(1, 0, 2)  # (G, S, F)
        return _LikelihoodTerms(
            squared_residual=residual**2,
            loading_residual=residual.swapaxes(1, 2)[..., None] * loadings[:, :, None],
            loading_product=loadings[..., None] * loadings[..., None, :],
        )

    def information(self, sensors: Sequence[int]) -> float:
        """Return the expected information of a set of sensors about the state, in bits.

        It is the mean over the drawn readings of log2 of posterior over prior probability of the
        state in which the reading was drawn. The prior is uniform over the S states.
        """
        log_density = self._log_density(sensors)
        states = log_density.shape[1]
        true_log_density = log_density[np.arange(len(self.state)), self.state]
        log_mean_density = logsumexp(log_density, axis=1) - np.log(states)
        return float((true_log_density - log_mean_density).mean() / np.log(2.0))

    def _log_density(self, sensors: Sequence[int]) -> Float:
        """Return the log density (N, S) of each drawn reading of a set of sensors, in each state.

        The standardised readings of the set have the covariance I + L Lᵀ in each state, where L
        (sensors, F) are the loadings. Its inverse and determinant follow from the small matrix
        C = I + Lᵀ L (F, F), by the Woodbury identity and the determinant lemma, for residuals r:
        rᵀ (I + L Lᵀ)⁻¹ r = rᵀ r - (Lᵀ r)ᵀ C⁻¹ (Lᵀ r), and det(I + L Lᵀ) = det C.

        The constant -log(2 pi) / 2 of each sensor is left out: it is the same in all states, so
        that it cancels in the ratio of posterior to prior.
        """
        chosen_sensors = list(sensors)
        # The sums over the chosen sensors. The first axis of the terms is that of the sensors.
        terms = self._terms
        squared_residual = terms.squared_residual[chosen_sensors].sum(axis=0)  # rᵀ r, (N, S)
        loading_residual = terms.loading_residual[chosen_sensors].sum(axis=0)  # Lᵀ r, (S, N, F)
        loading_product = terms.loading_product[chosen_sensors].sum(axis=0)  # Lᵀ L, (S, F, F)

        # Squared distance rᵀ (I + L Lᵀ)⁻¹ r of each reading from each state, and log determinant.
        small_matrix = loading_product + np.eye(loading_product.shape[-1])  # C, (S, F, F)
        inverse = np.linalg.inv(small_matrix)
        weighted = np.matmul(loading_residual, inverse)  # (Lᵀ r)ᵀ C⁻¹, (S, N, F)
        explained_by_effects = np.sum(weighted * loading_residual, axis=-1)  # (S, N)
        squared_distance = squared_residual - explained_by_effects.T  # (N, S)
        log_determinant = np.linalg.slogdet(small_matrix)[1]  # (S,)

        # The log deviations convert the density of standardised readings to SI.
        log_scale = self.log_deviation[:, chosen_sensors].sum(axis=1)  # (S,)
        return np.asarray(-0.5 * (squared_distance + log_determinant) - log_scale)


def draw_readings(knowledge: Knowledge) -> tuple[DrawnReadings, ...]:
    """Draw readings for each control that is not an action of the twin on its asset."""
    random_numbers = generator(knowledge.scenario.mission.seed, "planning")
    # The actions stand after the other controls.
    controls = len(knowledge.scenario.control) - len(knowledge.scenario.action)
    states = knowledge.model.states.size
    readings = []
    for control in range(controls):
        readings.append(
            _draw_under_control(knowledge.sensor_model, states, control, random_numbers)
        )
    return tuple(readings)


def _draw_under_control(
    sensors: GaussianSensorModel,
    states: int,
    control: int,
    random_numbers: np.random.Generator,
) -> DrawnReadings:
    """Draw about `SAMPLES` readings under a control, spread over the states.

    If there are more states than this, they are drawn in some of the states only.
    """
    if states <= SAMPLES:
        drawn_states = np.arange(states)
    else:
        drawn_states = random_numbers.permutation(states)[:SAMPLES]
    state = np.tile(drawn_states, round(SAMPLES / len(drawn_states)))
    values = sensors.draw_observations(state, control, random_numbers)[:, : sensors.sensor_count]
    # common errors of the sensors: within the interval of a state, and by the parameter
    deviation = sensors.independent_standard_deviation[:, control]
    loadings = np.concatenate(
        (sensors.interval[:, control], _loading_of_parameter(sensors, control)), axis=-1
    )
    return DrawnReadings(
        state,
        residual=(values[:, None] - sensors.mean[:, control]) / deviation,
        loadings=loadings / deviation[..., None],
        log_deviation=np.log(deviation),
    )


def _loading_of_parameter(sensors: GaussianSensorModel, control: int) -> Float:
    """Return the change of sensors by one deviation of the calibrated parameter, (S, G, 1), SI.

    If the sensors depend on the parameter linearly, its draws move them along one direction: the
    first singular vector of the deviations of the draws, times its singular value.
    """
    deviation_of_draws = sensors.value_per_draw - sensors.mean
    weight = np.sqrt(sensors.draw_weight)[:, None, None]
    weighted = weight * deviation_of_draws[:, :, control]  # (E, S, G)
    _, singular_values, directions = np.linalg.svd(weighted.swapaxes(0, 1), full_matrices=False)
    loading = singular_values[:, :1, None] * directions[:, :1]
    return np.asarray(loading.swapaxes(1, 2))


@dataclass(frozen=True)
class SensorDesign:
    """A choice of sensors.

    Attributes
    ----------
    sensors : tuple of int
        The indices of the chosen sensors. Each adds the most information to those before it.
    information : tuple of float
        The information of the first sensor, of the first two, and so on, in bits.
    information_of_all : float
        The information of all candidate sensors together, in bits.
    """

    sensors: tuple[int, ...]
    information: tuple[float, ...]
    information_of_all: float


def choose_sensors(
    readings: Sequence[DrawnReadings], candidates: Sequence[int], count: int
) -> SensorDesign:
    """Choose the sensors with the most information about the state.

    First they are chosen one by one, each time the one that adds most information. Then a chosen
    sensor is exchanged for another candidate as long as this gains information.

    Parameters
    ----------
    readings : sequence of DrawnReadings
        The readings under each control; the information is averaged over the controls.
    candidates : sequence of int
        The indices of the sensors to choose from.
    count : int
        How many sensors to choose.

    Raises
    ------
    MissionInputError
        If `count` is less than one or more than the number of candidates.
    """
    if not 1 <= count <= len(candidates):
        raise MissionInputError(
            f"--sensors must be from 1 to {len(candidates)}, the number of candidates, but {count} "
            "was given."
        )
    chosen_sensors = _add_greedily(readings, candidates, count)
    chosen_sensors = _exchange(readings, candidates, chosen_sensors)
    ordered_sensors = _add_greedily(readings, chosen_sensors, count)
    information = []
    for number in range(1, count + 1):
        information.append(_mean_information(readings, ordered_sensors[:number]))
    return SensorDesign(
        tuple(ordered_sensors), tuple(information), _mean_information(readings, list(candidates))
    )


def _mean_information(readings: Sequence[DrawnReadings], sensors: Sequence[int]) -> float:
    """Return the information of a set of sensors, averaged over the controls, in bits."""
    return float(
        np.mean([readings_of_control.information(sensors) for readings_of_control in readings])
    )


def _best_set(readings: Sequence[DrawnReadings], sets: Sequence[list[int]]) -> list[int]:
    """Return the set of sensors with the most information, the first of equals."""
    return max(sets, key=lambda sensors: _mean_information(readings, sensors))


def _add_greedily(
    readings: Sequence[DrawnReadings], candidates: Sequence[int], count: int
) -> list[int]:
    """Return `count` sensors; each adds the most information to the sensors chosen before it."""
    chosen_sensors: list[int] = []
    while len(chosen_sensors) < count:
        extended_sets = [
            [*chosen_sensors, sensor] for sensor in candidates if sensor not in chosen_sensors
        ]
        chosen_sensors = _best_set(readings, extended_sets)
    return chosen_sensors


def _exchange(
    readings: Sequence[DrawnReadings], candidates: Sequence[int], chosen_sensors: list[int]
) -> list[int]:
    """Improve the choice by exchanging one sensor at a time until no exchange gains information."""
    information = _mean_information(readings, chosen_sensors)
    while len(candidates) > len(chosen_sensors):
        other_sensors = [sensor for sensor in candidates if sensor not in chosen_sensors]
        exchanged_sets = []
        for position in range(len(chosen_sensors)):
            for sensor in other_sensors:
                exchanged_sets.append(
                    [*chosen_sensors[:position], sensor, *chosen_sensors[position + 1 :]]
                )
        best_set = _best_set(readings, exchanged_sets)
        information_of_best = _mean_information(readings, best_set)
        if information_of_best <= information + _LEAST_GAIN:
            break
        information = information_of_best
        chosen_sensors = best_set
    return chosen_sensors


def level_separations(
    knowledge: Knowledge, readings: Sequence[DrawnReadings], sensors: Sequence[int]
) -> dict[tuple[str, int], float]:
    """Return how well a set of sensors separates each level of a state factor from the next one.

    A separation is in standard deviations of the readings, under the control that separates most,
    with the other factors at their lowest levels.

    Parameters
    ----------
    readings : sequence of DrawnReadings
        The readings under each control.
    sensors : sequence of int
        The indices of the sensors.

    Returns
    -------
    dict of (str, int) to float
        By the name of the factor and the index of the lower level.
    """
    states = knowledge.model.states
    state_indices = np.arange(states.size).reshape(states.shape)
    separations = {}
    for axis, factor in enumerate(states.factors):
        # (levels, states of the other factors): the first column has those at their lowest levels
        states_by_level = np.moveaxis(state_indices, axis, 0).reshape(len(factor.levels), -1)
        others_at_lowest = states_by_level[:, 0]
        for level, (low, high) in enumerate(itertools.pairwise(others_at_lowest)):
            squared_distances = []
            for control, readings_of_control in enumerate(readings):
                mean = knowledge.sensor_model.mean[:, control]
                difference = mean[high] - mean[low]
                squared_distances.append(
                    _squared_distance(readings_of_control, int(low), difference, list(sensors))
                )
            separations[factor.name, level] = max(squared_distances) ** 0.5
    return separations


def _squared_distance(
    readings: DrawnReadings, state: int, difference: Float, sensors: list[int]
) -> float:
    """Return the squared Mahalanobis distance of a difference of means (G,), SI, in a state.

    The covariance is that of the standardised readings, I + L Lᵀ with their loadings L.
    """
    standardised = difference[sensors] * np.exp(-readings.log_deviation[state, sensors])
    loadings = readings.loadings[state, sensors]
    covariance = np.eye(len(sensors)) + loadings @ loadings.T
    return float(standardised @ np.linalg.solve(covariance, standardised))


def add_candidate_gauges(scenario: Scenario, candidates: str, folder: Path) -> Scenario:
    """Return the scenario with candidate gauges on its structure, and all gauges as sensors.

    The new gauges stand after the gauges of the structure file and before those of its rosettes.

    Parameters
    ----------
    candidates : str
        The largest number of rosettes to place evenly on the surface, or a TOML file with tables
        `gauge` and `rosette`, as in a structure file.
    folder : Path
        The folder into which the structure file with the new gauges is written.

    Raises
    ------
    MissionInputError
        If the twin does not believe a structure with a mesh, if the sensors are not strain gauges
        of one kind, if no rosette is asked for, or if the structure file has its gauges in a list.
    InvalidDesignError
        If a new gauge does not lie on the structure; the message names the gauge.
    """
    belief, design = _extensible_structure(scenario)
    if candidates.isdecimal() and int(candidates) == 0:
        raise MissionInputError("--candidates needs at least one place.")
    structure_file = Path(belief.all_files()[MODEL_COPY])
    write_members(folder, read_files(belief.all_files()))
    extended_file = folder / MODEL_COPY
    mesh_file = structure_file.parent / design.mesh  # it is read where it is, and not copied
    mesh = read_mesh(mesh_file, design.unit, design.length_unit)
    gauges = _candidate_gauges(candidates, mesh)
    with extended_file.open("a", encoding="utf-8") as text:
        for gauge in gauges:
            text.write("\n[[gauge]]\n")
            for key, value in gauge.model_dump().items():
                text.write(f"{key} = {json.dumps(value)}\n")
    try:
        content = read_toml(extended_file, InvalidDesignError)
    except InvalidDesignError as error:
        # The file could be read before the tables were appended: a key `gauge` is there already.
        raise MissionInputError(
            "--candidates needs the gauges of the structure file as tables [[gauge]], not in a "
            "list."
        ) from error
    # Errors name the option, and not the copied file.
    extended_design = parse_structure(content, f"--candidates {candidates}")
    assert isinstance(extended_design, MeshDesign)
    try:
        gauge_rows(mesh, gauges)
    except InvalidDesignError as error:
        raise InvalidDesignError(f"--candidates {candidates}: {error}") from error
    extended_belief = belief.model_copy(update={"structure": str(extended_file)})
    return _with_all_gauges(
        scenario.model_copy(update={"belief": extended_belief}),
        declared_gauges=[gauge.name for gauge in design.gauge],
        all_gauges=[gauge.name for gauge in extended_design.gauge],
    )


def _extensible_structure(scenario: Scenario) -> tuple[StructureBelief, MeshDesign]:
    """Return the believed structure and its design, or refuse a scenario that has none."""
    observation = scenario.observation
    belief = scenario.belief
    settings = (
        observation.standard_deviation,
        observation.model_error,
        scenario.rewards.error_scale,
    )
    differs_by_sensor = any(isinstance(setting, tuple) for setting in settings)
    if differs_by_sensor or observation.role != "strain":
        raise MissionInputError(
            "--candidates needs strain gauges of one standard deviation and error scale."
        )
    if isinstance(belief, StructureBelief):
        design = load_structure(belief.all_files()[MODEL_COPY])
        if isinstance(design, MeshDesign):
            return belief, design
    raise MissionInputError("--candidates needs a twin that believes a structure from a mesh.")


def _with_all_gauges(
    scenario: Scenario, declared_gauges: Sequence[str], all_gauges: Sequence[str]
) -> Scenario:
    """Return the scenario with all gauges of its structure as sensors.

    The reward for health still uses the same gauges. The tables `learning` and `notice` are
    removed, because their settings hold for the declared gauges alone.

    Parameters
    ----------
    declared_gauges : sequence of str
        The names of the gauges of the user's structure, in the order of the sensors.
    all_gauges : sequence of str
        The names of these and of the candidates, in the new order.
    """
    observation = scenario.observation
    titles = dict(zip(declared_gauges, observation.titles or declared_gauges, strict=True))

    # The scenario names the sensors of the reward by their numbers from 1. A candidate may stand
    # before a declared gauge, so that a gauge may have another number now.
    health_sensors = scenario.rewards.health_sensors
    if health_sensors == "all":
        health_sensors = tuple(range(1, len(declared_gauges) + 1))
    new_health_sensors = []
    for number in health_sensors:
        gauge = declared_gauges[number - 1]
        new_health_sensors.append(all_gauges.index(gauge) + 1)

    new_observation = {
        "count": len(all_gauges),
        "titles": tuple(titles.get(gauge, gauge) for gauge in all_gauges),
    }
    return scenario.model_copy(
        update={
            "observation": observation.model_copy(update=new_observation),
            "rewards": scenario.rewards.model_copy(
                update={"health_sensors": tuple(new_health_sensors)}
            ),
            "learning": None,
            "notice": None,
        }
    )


def _candidate_gauges(candidates: str, mesh: StructureMesh) -> tuple[Gauge, ...]:
    """Return candidate gauges: evenly placed rosettes, given their number, or those of a file."""
    if candidates.isdecimal():
        rosettes = evenly_placed_rosettes(mesh, int(candidates))
        return tuple(gauge for rosette in rosettes for gauge in rosette.gauges())
    content = read_toml(candidates, InvalidDesignError)
    gauges = validate(
        Gauged, content, candidates, InvalidDesignError, what="a file of gauges"
    ).gauge
    if not gauges:
        raise InvalidDesignError(f"{candidates}: a table [[gauge]] or [[rosette]] is expected.")
    return gauges
