"""Learning from the store of a fleet: growth of damage, noise of sensors, spread of a parameter.

The results are a record for the report, and `learnt.toml`, which replaces values of a scenario.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fe.runtime.errors import OutsideModelError
from reporting.arrays import Float, Index
from reporting.files import atomic_write_text, hash_record
from reporting.json_file import JsonObject
from reporting.progress import Progress, SilentProgress
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import FleetError
from twin_master.fleet.checks import source_of
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.evidence import (
    TransitionFamily,
    parameter_evidence,
    reason_transitions_are_fixed,
    scaled_likelihood,
    transition_evidence,
)
from twin_master.fleet.lessons import LESSONS_NAME, write_learnt
from twin_master.fleet.posterior import (
    Axes,
    Distribution,
    LikelihoodGrid,
    cell_probabilities,
    likelihood_grid,
    population_posterior,
    resolve_density,
    shared_posterior,
)
from twin_master.fleet.reading import TwinsOfScenario, flown_twins, notice_counts
from twin_master.fleet.row_file import RowFile
from twin_master.fleet.store import flown_rows, open_group
from twin_master.fleet.store_layout import (
    row_blocks,
    stored_values,
)
from twin_master.fleet.stored_observations import ObservedTwins, StoredObservations
from twin_master.mission.preparation import Knowledge
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.run_folder import to_json
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr

NOISE_TWINS = 100
"""Largest number of twins of a group from which the noise is learnt.

They determine the factor on the noise to a few parts in a thousand.
"""
LARGEST_NOISE = 3.0
"""Largest factor on the assumed noise that is considered; the smallest is its inverse."""
NOISE_POINTS = 13
"""Number of points of the grid of the factor on the noise."""
NODES = 61
"""Number of values of the calibrated parameter at which the evidence is computed."""
NODE_DEVIATIONS = 6.0
"""Distance of the first and the last of these values from the calibrated mean.

The unit is the standard deviation of the calibration.
"""
_MEMBERS_TOGETHER = 4096
"""Number of members of a population whose log evidence is in memory at the same time."""
_LEAST_PROBABILITY = 1e-3
_LARGEST_PROBABILITY = 0.9
"""Probabilities of worsening under which damage may grow or stay in any step."""
_MOST_SHARED = 2
"""Largest number of probabilities to worsen for which groups share a distribution."""


def learn_from_fleet(
    folder: Path | str, out: Path | str = "learnt.toml", *, progress: Progress | None = None
) -> JsonObject:
    """Learn from all twins of a fleet, and write what was learnt to a file.

    Learnt are the probabilities that damage grows, the noise of the sensors, and the distribution
    of the calibrated parameter over the assets. The record is also written to the fleet's folder.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet, which may still fly.
    out : Path or str
        The file to write, for the override ``learnt`` of a mission or the key of that name of a
        group.
    progress : Progress, optional
        Shows how far the work has come.

    Returns
    -------
    dict
        The learnt and the assumed values. `groups` holds for each group by name `probability` (by
        control), `noise_factor` and, if it was learnt, `population`; `transitions_kept_because` is
        the reason if no probability is learnt. `shared` is the distribution of the probabilities
        over groups, if groups share one; `source` identifies the fleet and the program.

    Raises
    ------
    RunFolderError, FleetError
        If the folder holds no fleet, if no twin has flown to its end, or if no course of states
        explains the observations of any twin of a group.
    """
    record = learn_fleet(folder, progress=progress)
    write_learnt(Path(out), Path(folder), record)
    atomic_write_text(Path(folder) / LESSONS_NAME, to_json(record))
    return record


def learn_fleet(folder: Path | str, *, progress: Progress | None = None) -> JsonObject:
    """Return the record of all that is learnt from a fleet; see `learn_from_fleet`.

    The prior of each probability is uniform; if there are several groups, it is a Beta
    distribution that they share.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet, which may still fly.
    progress : Progress, optional
        Shows how far the work has come.

    Raises
    ------
    RunFolderError, FleetError
        If the folder holds no fleet, if no twin has flown to its end, or if no course of states
        explains the observations of any twin of a group.
    """
    folder = Path(folder)
    config = fleet_config(folder)
    own_sensor_model = config["fleet"].get("parts", {}).get("sensor_model")
    if own_sensor_model is not None:
        raise FleetError(
            f"the fleet in {folder} flew with the sensor model {own_sensor_model}, and `fleet "
            "learn` knows only those of scenarios: fly it without `sensor_model` to learn from it."
        )
    lessons = _lessons_of_groups(folder, config["fleet"]["groups"], progress or SilentProgress())
    if not lessons:
        raise FleetError(f"{folder} holds no twin that has flown to its end: fly the fleet first.")
    record = _records(lessons)
    source = {
        "fleet": config["fleet"]["name"],
        "seed": config["fleet"]["seed"],
        "twins": sum(group["twins"] for group in record["groups"].values()),
        "config": hash_record({key: config[key] for key in ("kind", "format", "fleet")}),
        "program": config["provenance"]["versions"].get("uav-twin", ""),
    }
    return {"source": source, **record}


@dataclass(frozen=True)
class _GroupLessons:
    """What is learnt from the twins of one group alone.

    Attributes
    ----------
    family : TransitionFamily
        The transitions as a function of the probabilities to worsen.
    grid : LikelihoodGrid or None
        The likelihood of the probabilities; None if the transitions are not learnt.
    flown_controls : set of str
        The controls under which a transition from one step to the next was flown.
    record : dict
        The record of the group without its probabilities to worsen.
    """

    family: TransitionFamily
    grid: LikelihoodGrid | None
    flown_controls: set[str]
    record: JsonObject

    @property
    def marginals(self) -> tuple[Distribution, ...]:
        """The posterior of each probability under a uniform prior."""
        return () if self.grid is None else self.grid.marginals

    def with_probabilities(
        self, posteriors: Sequence[Distribution], flown_controls: set[str]
    ) -> JsonObject:
        """Return the record of the group with its probabilities to worsen.

        Parameters
        ----------
        posteriors : sequence of Distribution
            The posterior of each probability.
        flown_controls : set of str
            The controls for which observations contribute to the posterior.
        """
        probabilities = {}
        for name, assumed, posterior in zip(
            self.family.names, self.family.assumed.tolist(), posteriors, strict=True
        ):
            control = name.partition(", ")[0]
            probabilities[name] = {
                "assumed": assumed,
                "flown": control in flown_controls,
                **posterior.summary,
            }
        return {**self.record, "probability": probabilities}


def _lessons_of_groups(
    folder: Path, records: Sequence[JsonObject], progress: Progress
) -> dict[str, _GroupLessons]:
    """Learn from each group by itself; groups without a flown twin are left out."""
    lessons = {}
    with progress.stage("Learning", total=len(records), unit="groups") as stage:
        for record in records:
            group = open_group(folder, record["name"], names=False)
            twins_by_scenario = list(flown_twins(folder, record, group))
            if twins_by_scenario:
                lessons[record["name"]] = _learn_group(folder, record, group, twins_by_scenario)
            stage.advance()
    return lessons


def _records(lessons: dict[str, _GroupLessons]) -> JsonObject:
    """Return the records of all groups, and of the distribution of probabilities common to them.

    They share one in this case: all groups have the same probabilities to worsen, these are at most
    `_MOST_SHARED`, and several groups have learnt them.
    """
    grids = [lesson.grid for lesson in lessons.values() if lesson.grid is not None]
    distinct_names = {lesson.family.names for lesson in lessons.values()}
    have_same_probabilities = len(distinct_names) == 1
    if have_same_probabilities and len(grids) > 1:
        (names,) = distinct_names
        if len(names) <= _MOST_SHARED:
            return _records_with_shared_distribution(lessons, grids, names)
    records = {}
    for name, lesson in lessons.items():
        records[name] = lesson.with_probabilities(lesson.marginals, lesson.flown_controls)
    return {"groups": records}


def _records_with_shared_distribution(
    lessons: dict[str, _GroupLessons], grids: Sequence[LikelihoodGrid], names: Sequence[str]
) -> JsonObject:
    """Return the records of groups whose probabilities share a distribution.

    A control that was flown in any group counts as flown in all, because the shared distribution
    carries what was learnt of it to the other groups.
    """
    posterior = shared_posterior(grids)
    flown_controls: set[str] = set()
    for lesson in lessons.values():
        flown_controls |= lesson.flown_controls
    records = {}
    for (name, lesson), probabilities in zip(lessons.items(), posterior.groups, strict=True):
        records[name] = lesson.with_probabilities(probabilities, flown_controls)
    shared_distribution = dict(zip(names, posterior.hyperparameters, strict=True))
    return {"groups": records, "shared": shared_distribution}


class _Flights(NamedTuple):
    """The flights of B twins of one scenario, whose observations are in the store.

    Attributes
    ----------
    knowledge : Knowledge
        The knowledge that the twins share: model, policy and calibration draws.
    store : StoredObservations
        The observations of their group.
    rows : (B,) array
        The rows of the twins in the store, in ascending order.
    """

    knowledge: Knowledge
    store: StoredObservations
    rows: Index

    def first_twins(self, count: int) -> "_Flights":
        """Return the flights of the first twins."""
        return self._replace(rows=self.rows[:count])

    def blocks(self) -> Iterator[ObservedTwins]:
        """Yield the observations of the twins, some twins at a time."""
        return self.store.blocks(self.rows)


def _learn_group(
    folder: Path,
    record: JsonObject,
    group: "xr.DataTree",
    twins_by_scenario: Sequence[TwinsOfScenario],
) -> _GroupLessons:
    """Learn from the twins of one group.

    The noise is learnt first, because the likelihoods for the other two need it; then the
    probabilities to worsen, and then the distribution of the calibrated parameter.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    record : dict
        The record of the group in `config.json`.
    group : DataTree
        The stored results of the group.
    twins_by_scenario : sequence of TwinsOfScenario
        The twins that have flown, by scenario.
    """
    scenario = twins_by_scenario[0].knowledge.scenario
    family = _transition_family(scenario)
    flights_by_scenario = _flights_by_scenario(group, twins_by_scenario)
    # With several scenarios each twin has its own calibration, and no common distribution of the
    # parameter is learnt.
    nodes = None
    if len(twins_by_scenario) == 1:
        nodes = _parameter_nodes(twins_by_scenario[0], is_real="recordings" in record)
    noise = _noise_factor(flights_by_scenario, family, nodes)
    explained = _explained_flights(flights_by_scenario, family, noise.mean)
    twin_count = sum(len(flights.rows) for flights in explained)
    if not twin_count:
        raise FleetError(
            f"no state of the twins explains what was observed in group {record['name']}: nothing "
            "can be learnt from it; check its model and its noise."
        )
    grid = _probability_grid(family, explained, noise.mean) if family.names else None
    counts = _counts(group, scenario.control_names)
    flown_count = sum(len(twins.rows) for twins in twins_by_scenario)
    lessons: JsonObject = {
        "twins": twin_count,
        "left_out": flown_count - twin_count,
        "alarmed": counts.alarmed,
        "noise_factor": noise.summary,
    }
    if family.reason_fixed:
        lessons["transitions_kept_because"] = family.reason_fixed
    if nodes is not None:
        lessons["population"] = _population(
            folder, flights_by_scenario[0], family, grid, nodes, noise.mean
        )
    return _GroupLessons(family, grid, counts.followed_controls, lessons)


def _transition_family(scenario: Scenario) -> TransitionFamily:
    """Return the transitions of a scenario, as a function of the probabilities that are learnt."""
    reason = reason_transitions_are_fixed(scenario)
    if reason:
        return TransitionFamily.fixed(scenario, reason)
    return TransitionFamily.learnable(scenario)


def _flights_by_scenario(
    group: "xr.DataTree", twins_by_scenario: Sequence[TwinsOfScenario]
) -> list[_Flights]:
    """Return the flights of the twins of a group that have flown, for each scenario."""
    store = StoredObservations(group, twins_by_scenario[0].knowledge.scenario)
    return [_Flights(twins.knowledge, store, twins.rows) for twins in twins_by_scenario]


class _GroupCounts(NamedTuple):
    """What is counted of the twins of a group beside what is learnt from them.

    Attributes
    ----------
    alarmed : int
        The number of flown twins that raised an alarm.
    followed_controls : set of str
        The controls under which a flown twin has flown a step before its last one.
    """

    alarmed: int
    followed_controls: set[str]


def _counts(group: "xr.DataTree", control_names: Sequence[str]) -> _GroupCounts:
    """Count alarms and controls of the flown twins of a group, block by block."""
    alarmed = 0
    followed_controls: set[str] = set()
    for rows in row_blocks(group):
        flown = flown_rows(stored_values(group, "status", rows))
        alarmed += int(np.sum(notice_counts(group, "alarm", rows)[flown] > 0))
        control = stored_values(group, "observed/control_index", rows)[flown]
        is_followed = control[:, 1:] >= 0
        followed = np.unique(control[:, :-1][is_followed]).tolist()
        followed_controls |= {control_names[index] for index in followed}
    return _GroupCounts(alarmed, followed_controls)


def _explained_flights(
    flights_by_scenario: Sequence[_Flights], family: TransitionFamily, noise_factor: float
) -> list[_Flights]:
    """Return the flights without the twins whose observations are impossible under the model.

    The likelihoods are computed with a factor on the assumed noise.
    """
    point = _with_all_transitions_possible(family.assumed)[None]
    explained = []
    for flights in flights_by_scenario:
        sensor_model = with_noise_factor(flights.knowledge.sensor_model, noise_factor)
        is_explained = []
        for observed, control in flights.blocks():
            likelihood = scaled_likelihood(sensor_model, observed, control).values
            log_evidence = transition_evidence(family, point, likelihood, control)  # (twins, 1)
            is_explained.append(np.isfinite(log_evidence[:, 0]))
        explained.append(flights._replace(rows=flights.rows[np.concatenate(is_explained)]))
    return explained


def _with_all_transitions_possible(probability: Float) -> Float:
    """Return probabilities of worsening that are neither near 0 nor near 1.

    So any course of the damage is possible, and observations that are impossible with these
    probabilities contradict the sensor model.
    """
    return probability.clip(_LEAST_PROBABILITY, _LARGEST_PROBABILITY)


def _probability_grid(
    family: TransitionFamily, flights_by_scenario: Sequence[_Flights], noise_factor: float
) -> LikelihoodGrid:
    """Return, on a grid, the likelihood of the probabilities with which a state worsens.

    It is the likelihood given the observations of all twins of a group. `likelihood_grid` narrows
    the grid and so calls `log_likelihood` several times. Each call reads the observations again and
    computes the likelihoods of the states anew, because those of many twins do not fit in memory.
    """
    sensor_models = [
        with_noise_factor(flights.knowledge.sensor_model, noise_factor)
        for flights in flights_by_scenario
    ]

    def log_likelihood(points: Float) -> Float:
        """Return the log likelihood (P,) at P points (P, K) of K probabilities to worsen."""
        total = np.zeros(len(points))
        for flights, sensor_model in zip(flights_by_scenario, sensor_models, strict=True):
            for observed, control in flights.blocks():
                likelihood = scaled_likelihood(sensor_model, observed, control).values
                log_evidence = transition_evidence(family, points, likelihood, control)
                total += log_evidence.sum(axis=0)  # over the twins; the other axis is the points
        return total

    return likelihood_grid(log_likelihood, len(family.names))


@dataclass(frozen=True)
class _ParameterNodes:
    """Values of the calibrated parameter at which the evidence of twins is computed.

    Attributes
    ----------
    values : (E,) array
        The equally spaced values.
    prior : (E,) array
        Their probabilities by the calibration, a normal distribution.
    predicted : (E, S, U, G) array
        The noise-free readings of the sensors for each value, state and control, in SI units.
    """

    values: Float
    prior: Float
    predicted: Float


def _parameter_nodes(twins: TwinsOfScenario, *, is_real: bool) -> _ParameterNodes | None:
    """Return values of the calibrated parameter, with the readings that a model predicts for each.

    Return None if the calibration has no uncertainty, or if the source of the readings cannot
    compute them at chosen values of the parameter.

    Raises
    ------
    FleetError
        If some of the values are outside the range of the model.
    """
    knowledge = twins.knowledge
    draws = knowledge.draws
    if draws.standard_deviation <= 0.0:
        return None
    deviations = np.linspace(-NODE_DEVIATIONS, NODE_DEVIATIONS, NODES)
    values = draws.mean + draws.standard_deviation * deviations
    prior = np.exp(-0.5 * deviations**2)
    source = source_of(knowledge.scenario, is_real=is_real)
    source.prepare(twins.folder, SilentProgress())
    nodes = ParameterDraws(draws.name, values, draws.mean, draws.standard_deviation, "nodes")
    try:
        predicted_readings = source.observation_table(nodes, knowledge.model)
    except OutsideModelError as error:
        raise FleetError(
            f"{error} `fleet learn` computes the readings at values of {draws.name} up to "
            f"{NODE_DEVIATIONS:g} standard deviations from the mean of the calibration, which is "
            f"{draws.mean:.4g} ± {draws.standard_deviation:.2g} here: give `[calibration]` a "
            "smaller standard deviation, or a model with a wider range, and fly the fleet again."
        ) from error
    if len(predicted_readings) != NODES:  # a stored library of observations has fixed draws
        return None
    return _ParameterNodes(values, prior / prior.sum(), predicted_readings)


def with_noise_factor(
    model: GaussianSensorModel, factor: float, value_per_draw: Float | None = None
) -> GaussianSensorModel:
    """Return a copy of a sensor model with its noise multiplied by a factor.

    Parameters
    ----------
    model : GaussianSensorModel
        The model.
    factor : float
        The factor on the standard deviation of the noise.
    value_per_draw : (E, S, U, G) array, optional
        The noise-free readings at other values of the parameter; by default those of the model.
    """
    return type(model)(
        model.value_per_draw if value_per_draw is None else value_per_draw,
        model.standard_deviation * factor,
        average="inside" if model.averages_inside else "outside",
        model_error=model.model_error,
        interval=model.interval,
        **model.extra_arguments,
    )


def _noise_factor(
    flights_by_scenario: Sequence[_Flights],
    family: TransitionFamily,
    nodes: _ParameterNodes | None,
) -> Distribution:
    """Return the posterior of the factor on the assumed noise, given a uniform prior of its log.

    The calibrated parameter of an asset is the same in all steps. A likelihood that averages over
    it in each step separately would attribute a part of the noise to the parameter. With nodes, the
    evidence of all steps is computed at each value first and averaged over the values then.
    """
    flights_of_first_twins = [
        flights.first_twins(NOISE_TWINS) for flights in flights_by_scenario[:NOISE_TWINS]
    ]

    def log_likelihood(axes: Axes) -> Float:
        log_evidence = [
            _evidence_of_noise(flights_of_first_twins, family, nodes, factor)
            for factor in np.exp(axes[0]).tolist()
        ]
        return np.array(log_evidence)

    largest_log_factor = np.log(LARGEST_NOISE)
    widest_axis = np.linspace(-largest_log_factor, largest_log_factor, NOISE_POINTS)
    (axis,), values = resolve_density(log_likelihood, (widest_axis,))
    return Distribution(axis, cell_probabilities(values), np.exp)


def _evidence_of_noise(
    flights_by_scenario: Sequence[_Flights],
    family: TransitionFamily,
    nodes: _ParameterNodes | None,
    factor: float,
) -> float:
    """Return the log evidence of twins for a factor on the noise.

    Twins whose observations no course of states explains are left out.
    """
    probability = _with_all_transitions_possible(family.assumed)
    total_log_evidence = 0.0
    for flights in flights_by_scenario:
        value_per_draw = None if nodes is None else nodes.predicted
        model = with_noise_factor(flights.knowledge.sensor_model, factor, value_per_draw)
        for observed, control in flights.blocks():
            if nodes is None:
                likelihood = scaled_likelihood(model, observed, control)
                at_point = transition_evidence(
                    family, probability[None], likelihood.values, control
                )
                log_evidence = at_point[:, 0] + likelihood.log_scale
            else:
                at_nodes = parameter_evidence(family, probability, model, observed, control)
                log_evidence = _average_over_nodes(at_nodes, nodes.prior)
            total_log_evidence += float(log_evidence[np.isfinite(log_evidence)].sum())
    return total_log_evidence


def _average_over_nodes(log_evidence: Float, prior: Float) -> Float:
    """Return the log evidence of B twins averaged over E nodes, whose prior is given."""
    largest = log_evidence.max(axis=1, keepdims=True)  # keeps the exponential from underflowing
    return np.asarray(largest[:, 0] + np.log(np.exp(log_evidence - largest) @ prior))


def _population(
    folder: Path,
    flights: _Flights,
    family: TransitionFamily,
    grid: LikelihoodGrid | None,
    nodes: _ParameterNodes,
    noise_factor: float,
) -> JsonObject:
    """Return the record of the population of the calibrated parameter in a group.

    The log evidence of the twins is read several times. It is kept in a temporary file, because
    that of many twins would not fit in memory.

    Parameters
    ----------
    folder : Path
        The folder of the fleet, which has room for the temporary file.
    flights : _Flights
        The flights of the group, which has one scenario.
    family : TransitionFamily
        The transitions.
    grid : LikelihoodGrid or None
        The likelihood of the probabilities to worsen, whose posterior means are used; the assumed
        ones if it is None.
    nodes : _ParameterNodes
        The values of the parameter.
    noise_factor : float
        The factor on the assumed noise.
    """
    probability = family.assumed
    if grid is not None:
        probability = np.array([marginal.mean for marginal in grid.marginals])
    draws = flights.knowledge.draws
    model = with_noise_factor(flights.knowledge.sensor_model, noise_factor, nodes.predicted)
    with RowFile(folder, len(nodes.values), rows_together=_MEMBERS_TOGETHER) as log_evidence:
        for observed, control in flights.blocks():
            log_evidence.append(parameter_evidence(family, probability, model, observed, control))
        population = population_posterior(nodes.values, log_evidence, draws.standard_deviation)
    return {
        "parameter": draws.name,
        "mean": population.mean.summary,
        "spread": population.deviation.summary,
    }
