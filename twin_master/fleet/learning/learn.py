"""Learns from a fleet's store: growth of damage, noise of sensors, population of a parameter."""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from uuid import uuid4

import numpy as np

from reporting.arrays import Float
from reporting.files import atomic_write_text, hash_record
from reporting.json_file import JsonObject
from reporting.progress import Progress, SilentProgress
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import FleetError
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.engine import Engine, TaskPool, open_task_pool
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    reason_transitions_are_fixed,
)
from twin_master.fleet.learning.evidence_tasks import (
    EvidenceKit,
    FlightsOfScenario,
    GroupEvidence,
)
from twin_master.fleet.learning.grid_density import Axes, Distribution, logistic
from twin_master.fleet.learning.lessons import LESSONS_NAME, write_learnt
from twin_master.fleet.learning.noise import (
    ParameterNodes,
    noise_factor,
    parameter_nodes,
    with_noise_factor,
)
from twin_master.fleet.learning.posterior import (
    LikelihoodGrid,
    PopulationPosterior,
    likelihood_grid,
    population_posterior,
    shared_posterior,
)
from twin_master.fleet.learning.row_file import RowFile
from twin_master.fleet.members import RecordedMembers
from twin_master.fleet.reading import TwinsOfScenario, flown_twins, notice_counts
from twin_master.fleet.storage.store import check_installed, flown_rows, open_group
from twin_master.fleet.storage.store_layout import StoredObservations, row_blocks, stored_values
from twin_master.run_folder import to_json

if TYPE_CHECKING:
    import xarray as xr

_FIRST_TWINS = 512
_MOST_BLOCKS_APART = 16
"""All is learnt from 512 twins first, or from one in 16 if these are more."""
_FIRST_ROUNDS = 2
"""How often probabilities and population are learnt from the first twins, by turns.

The second time, the probabilities are off by less than a hundredth of their standard deviation.
"""
_TWINS_WORTH_WORKERS = 10_000
"""The smallest number of twins of a fleet that is worth worker processes."""
_MEMBERS_TOGETHER = 1024
"""Number of members of a population whose log evidence is in memory at the same time."""
_MOST_SHARED = 2
"""Largest number of probabilities of worsening for which groups share a distribution."""


def learn_from_fleet(
    folder: Path | str,
    out: Path | str = "learnt.toml",
    *,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> JsonObject:
    """Learn from all twins of a fleet, and write the results to a file.

    Learnt are the probabilities with which damage grows, the noise of the sensors, and the
    distribution of the calibrated parameter over the assets. The record of the results is also
    written to the fleet's folder.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet. Its twins may still be flying.
    out : Path or str
        The file to write. A mission reads it by the override ``learnt``, and a group of a fleet by
        the key of this name.
    engine : Engine, optional
        The processes that compute; by default this one. Their number does not change the results.

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
        explains the observations of any twin of a group, or if the cluster cannot be used.
    """
    record = learn_fleet(folder, engine=engine, progress=progress)
    write_learnt(Path(out), Path(folder), record)
    atomic_write_text(Path(folder) / LESSONS_NAME, to_json(record))
    return record


def is_worth_workers(folder: Path) -> bool:
    """Return whether it saves time to start worker processes to learn from a fleet.

    Raises
    ------
    RunFolderError
        If the folder holds no fleet.
    """
    records = fleet_config(folder)["fleet"]["groups"]
    return sum(len(RecordedMembers(record)) for record in records) >= _TWINS_WORTH_WORKERS


def learn_fleet(
    folder: Path | str, *, engine: Engine | None = None, progress: Progress | None = None
) -> JsonObject:
    """Return the record of everything that is learnt from a fleet; see `learn_from_fleet`.

    The prior of each probability is uniform; if there are several groups, it is a Beta distribution
    that they share.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet. Its twins may still be flying.
    engine : Engine, optional
        The processes that compute; by default this one.

    Raises
    ------
    RunFolderError, FleetError
        If the folder holds no fleet, if no twin has flown to its end, or if no course of states
        explains the observations of any twin of a group, or if the cluster cannot be used.
    """
    folder = Path(folder)
    config = fleet_config(folder)
    own_sensor_model = config["fleet"].get("parts", {}).get("sensor_model")
    if own_sensor_model is not None:
        raise FleetError(
            f"the fleet in {folder} flew with the sensor model {own_sensor_model}, and `fleet "
            "learn` knows only those of scenarios: fly it without `sensor_model` to learn from it."
        )
    progress = progress or SilentProgress()
    engine = engine or Engine()
    check_installed("zarr", *(["distributed"] if engine.needs_dask else []))
    with open_task_pool(engine, progress) as pool:
        lessons = _lessons_of_groups(folder, config, pool, progress)
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
    """What is learnt from the twins of a single group.

    Attributes
    ----------
    family : TransitionFamily
        The transitions as a function of the probabilities of worsening.
    grid : LikelihoodGrid or None
        The likelihood of the probabilities; None if the transitions are not learnt.
    flown_controls : set of str
        The controls under which a transition from one step to the next was flown.
    record : dict
        The record of the group without its probabilities of worsening.
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
        """Return the record of the group, completed by the probabilities with which damage grows.

        `posteriors` has a distribution for each probability; `flown_controls` are the controls
        about which the observations say something.
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
    folder: Path, config: JsonObject, pool: TaskPool, progress: Progress
) -> dict[str, _GroupLessons]:
    """Learn from each group of a fleet by itself; groups without a flown twin are left out."""
    lessons = {}
    for record in config["fleet"]["groups"]:
        group = open_group(folder, record["name"], names=False)
        twins_by_scenario = list(flown_twins(folder, record, group))
        if twins_by_scenario:
            flown_group = _FlownGroup(
                folder=folder,
                fleet_hash=hash_record(config),
                record=record,
                group=group,
                twins_by_scenario=twins_by_scenario,
                reading=uuid4().hex,
            )
            lessons[record["name"]] = flown_group.learn(pool, progress)
    return lessons


def _records(lessons: dict[str, _GroupLessons]) -> JsonObject:
    """Return the records of all groups, and of the distribution that their probabilities share.

    Groups share a distribution if several of them have learnt probabilities, if these have the same
    names in all groups, and if they are at most `_MOST_SHARED`.
    """
    grids = [lesson.grid for lesson in lessons.values() if lesson.grid is not None]
    distinct_names = {lesson.family.names for lesson in lessons.values()}
    names = distinct_names.pop()
    is_shared = not distinct_names and len(grids) > 1 and len(names) <= _MOST_SHARED
    records = {}
    if not is_shared:
        for name, lesson in lessons.items():
            records[name] = lesson.with_probabilities(lesson.marginals, lesson.flown_controls)
        return {"groups": records}
    posterior = shared_posterior(grids)
    # A control that was flown in any group counts as flown in all, because the shared distribution
    # transfers what was learnt to the other groups.
    flown_controls: set[str] = set()
    for lesson in lessons.values():
        flown_controls |= lesson.flown_controls
    for (name, lesson), probabilities in zip(lessons.items(), posterior.groups, strict=True):
        records[name] = lesson.with_probabilities(probabilities, flown_controls)
    shared_distribution = dict(zip(names, posterior.hyperparameters, strict=True))
    return {"groups": records, "shared": shared_distribution}


@dataclass(frozen=True)
class _FlownGroup:
    """A group of a fleet with its twins that have flown.

    Attributes
    ----------
    folder : Path
        The folder of the fleet.
    fleet_hash : str
        The hash of its `config.json`.
    record : dict
        The record of the group in `config.json`.
    twins_by_scenario : sequence of TwinsOfScenario
        The twins that have flown, by scenario.
    reading : str
        A key that differs from call to call; see `EvidenceKit`.
    """

    folder: Path
    fleet_hash: str
    record: JsonObject
    group: "xr.DataTree"
    twins_by_scenario: Sequence[TwinsOfScenario]
    reading: str

    def learn(self, pool: TaskPool, progress: Progress) -> _GroupLessons:
        """Learn from the twins of the group: noise, growth of damage, and population.

        The noise is learnt first, because the likelihoods for the other two need it. The population
        is the distribution of the calibrated parameter over the assets.
        """
        scenario = self.twins_by_scenario[0].knowledge.scenario
        reason_for_fixed = reason_transitions_are_fixed(scenario)
        if reason_for_fixed:
            family = TransitionFamily.fixed(scenario, reason_for_fixed)
        else:
            family = TransitionFamily.learnable(scenario)
        nodes = None
        if len(self.twins_by_scenario) == 1:  # otherwise each twin has a calibration of its own
            nodes = parameter_nodes(self.twins_by_scenario[0], is_real="recordings" in self.record)
        name = self.record["name"]
        with progress.stage(f"Learning the noise of {name}"):
            store = StoredObservations(self.group, scenario)
            noise = noise_factor(store, self.twins_by_scenario, family, nodes)
        population_evidence = self._evidence(family, noise.mean, nodes, pool, progress)
        growth_evidence = population_evidence
        if nodes is not None:  # growth depends so weakly on the parameter that half the nodes do
            growth_evidence = self._evidence(family, noise.mean, nodes.every_second, pool, progress)
        growth, population = self._growth_and_population(
            growth_evidence, population_evidence, family, nodes
        )
        if not growth.explained_count:
            raise FleetError(
                f"no state of the twins explains what was observed in group {name}: nothing can be "
                "learnt from it; check its model and its noise."
            )
        alarmed, flown_controls = _counts(self.group, scenario.control_names)
        lessons: JsonObject = {
            "twins": growth.explained_count,
            "left_out": growth_evidence.twin_count - growth.explained_count,
            "alarmed": alarmed,
            "noise_factor": noise.summary,
        }
        if family.reason_fixed:
            lessons["transitions_kept_because"] = family.reason_fixed
        if population is not None:
            lessons["population"] = {
                "parameter": self._draws.name,
                "mean": population.mean.summary,
                "spread": population.deviation.summary,
            }
        return _GroupLessons(family, growth.grid, flown_controls, lessons)

    @property
    def _draws(self) -> ParameterDraws:
        """The draws of the calibrated parameter."""
        return self.twins_by_scenario[0].knowledge.draws

    def _evidence(
        self,
        family: TransitionFamily,
        noise_factor: float,
        nodes: ParameterNodes | None,
        pool: TaskPool,
        progress: Progress,
    ) -> GroupEvidence:
        """Return the evidence of the twins, which the processes of a pool compute when it is asked.

        `noise_factor` multiplies the assumed noise. The calibrated parameter takes the values at
        the nodes; without nodes, it takes the draws of each twin's calibration.
        """
        readings_at_nodes = None if nodes is None else nodes.predicted
        flights = []
        for twins in self.twins_by_scenario:
            kit = EvidenceKit(
                folder=str(self.folder.absolute()),
                fleet_hash=self.fleet_hash,
                group=self.record["name"],
                reading=self.reading,
                family=family,
                sensor_model=with_noise_factor(
                    twins.knowledge.sensor_model, noise_factor, readings_at_nodes
                ),
            )
            packed_kit = pickle.dumps(kit, pickle.HIGHEST_PROTOCOL)
            flights.append(FlightsOfScenario(packed_kit, twins.rows))
        return GroupEvidence(pool, self.record["name"], flights, progress)

    def _growth_and_population(
        self,
        growth_evidence: GroupEvidence,
        population_evidence: GroupEvidence,
        family: TransitionFamily,
        nodes: ParameterNodes | None,
    ) -> tuple["_Growth", PopulationPosterior | None]:
        """Learn with which probabilities damage grows, and how the parameter varies over assets.

        Each of the two is learnt given the other, in rounds: first from some of the twins, finally
        from all. A round begins with the grid and the population of the last one. Without `nodes`
        of the parameter, there is no population.
        """
        first_axes = None
        population = None
        prior = None if nodes is None else nodes.every_second.prior
        for blocks_apart in _rounds(growth_evidence.twin_count, has_population=nodes is not None):
            some_twins = growth_evidence.of_some_twins(blocks_apart)
            growth = _growth(family, some_twins, prior, first_axes)
            if growth.grid is not None:
                first_axes = growth.grid.axes
            if nodes is not None and growth.explained_count:
                population = self._population(
                    population_evidence.of_some_twins(blocks_apart),
                    growth.mean_probability(family),
                    nodes,
                )
                prior = population.prior_of_member(nodes.every_second.values)
        return growth, population

    def _population(
        self,
        evidence: GroupEvidence,
        probability: Float,
        nodes: ParameterNodes,
    ) -> PopulationPosterior:
        """Return the population of the calibrated parameter, given probabilities of worsening (K,).

        The log evidence of the twins is read several times, from a temporary file, because that of
        many twins would not fit in memory.
        """
        with RowFile(
            self.folder, len(nodes.values), rows_together=_MEMBERS_TOGETHER
        ) as log_evidence:
            for rows in evidence.evidence_of_draws(probability):
                log_evidence.append(rows)
            return population_posterior(nodes.values, log_evidence, self._draws.standard_deviation)


def _counts(group: "xr.DataTree", control_names: Sequence[str]) -> tuple[int, set[str]]:
    """Count the flown twins with an alarm, and list the controls of which a growth can be learnt.

    These are the controls under which a twin has flown a step before its last one, because growth
    under a control shows in the step after it.
    """
    alarmed_count = 0
    followed_controls: set[str] = set()
    for rows in row_blocks(group):
        flown = flown_rows(stored_values(group, "status", rows))
        alarmed_count += int(np.sum(notice_counts(group, "alarm", rows)[flown] > 0))
        control = stored_values(group, "observed/control_index", rows)[flown]
        is_followed = control[:, 1:] >= 0
        control_indices = np.unique(control[:, :-1][is_followed]).tolist()
        followed_controls |= {control_names[index] for index in control_indices}
    return alarmed_count, followed_controls


def _rounds(twin_count: int, *, has_population: bool) -> list[int]:
    """Return the rounds of learning: in each round one block of twins in so many is read.

    Growth and population need several rounds to agree, because each is learnt given the other.
    """
    blocks_apart = min(max(twin_count // _FIRST_TWINS, 1), _MOST_BLOCKS_APART)
    rounds = [blocks_apart] * (_FIRST_ROUNDS if has_population else 1)
    if blocks_apart > 1:
        rounds.append(1)
    return rounds


class _Growth(NamedTuple):
    """The likelihood of the probabilities of worsening, given the observations of twins.

    Attributes
    ----------
    grid : LikelihoodGrid or None
        None if the transitions are not learnt.
    explained_count : int
        The number of twins whose observations are possible under the model; the others are left
        out.
    """

    grid: LikelihoodGrid | None
    explained_count: int

    def mean_probability(self, family: TransitionFamily) -> Float:
        """Return the posterior means of the probabilities (K,), or the assumed ones."""
        if self.grid is None:
            return family.assumed
        return np.array([marginal.mean for marginal in self.grid.marginals])


def _growth(
    family: TransitionFamily,
    evidence: GroupEvidence,
    prior: Float | None,
    first_axes: Axes | None,
) -> _Growth:
    """Return, on a grid, the likelihood of the probabilities with which damage grows.

    `prior` (E,) holds the probabilities of the calibrated parameter at its nodes; None if it has no
    nodes. The search for the grid begins with `first_axes`. All twins are read again for each grid,
    because the likelihoods of the states of many twins do not fit in memory.
    """
    if not family.names:
        return _Growth(None, evidence.grid_sum((), prior).twin_count)
    explained_count = 0

    def log_likelihood(axes: Axes) -> Float:
        """Return the log likelihood of the twins on a grid of log odds."""
        nonlocal explained_count
        probabilities = tuple(logistic(axis) for axis in axes)
        total = evidence.grid_sum(probabilities, prior)
        explained_count = total.twin_count
        return total.log_likelihood

    grid = likelihood_grid(log_likelihood, len(family.names), first_axes)
    return _Growth(grid, explained_count)
