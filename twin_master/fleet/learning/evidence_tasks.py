"""The evidence of the twins of a group, computed task by task in any process of any machine.

A task has the twins of successive rows of the store. Its results do not depend on the process, and
those of all tasks are added in the order of the tasks, so that sums do not depend on the number of
workers.
"""

import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from reporting.arrays import Float, Index
from reporting.files import hash_record
from reporting.progress import Progress
from twin_master.errors import FleetError, RunFolderError
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.engine import TaskPool
from twin_master.fleet.learning.evidence import TransitionFamily
from twin_master.fleet.learning.grid_density import Axes
from twin_master.fleet.learning.parameter_evidence import likelihood_at_nodes, parameter_evidence
from twin_master.fleet.storage.store import open_group
from twin_master.fleet.storage.store_layout import BLOCK_TWINS, ObservedTwins, StoredObservations
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario

_Answer = TypeVar("_Answer")

TASK_TWINS = 4096
"""The number of rows of the store that belong to a task."""
_LEAST_PROBABILITY = 1e-3
_LARGEST_PROBABILITY = 0.9
"""Probabilities of worsening under which damage may grow or stay in any step."""


def with_all_transitions_possible(probability: Float) -> Float:
    """Return probabilities of worsening (K,), moved away from 0 and 1.

    Then any course of the damage is possible, so observations that are impossible with these
    probabilities contradict the sensor model.
    """
    return probability.clip(_LEAST_PROBABILITY, _LARGEST_PROBABILITY)


class EvidenceKit(NamedTuple):
    """Everything that the evidence of a scenario's twins needs besides their observations.

    Attributes
    ----------
    folder : str
        The folder of the fleet, an absolute path.
    fleet_hash : str
        The hash of the fleet's `config.json`.
    reading : str
        A key that differs from call to call, so that no process reuses what it has read from a
        store that has grown since.
    """

    folder: str
    fleet_hash: str
    group: str
    reading: str
    family: TransitionFamily
    sensor_model: GaussianSensorModel


class FlightsOfScenario(NamedTuple):
    """The flights of B twins of one scenario, whose observations are in the store.

    Attributes
    ----------
    kit : bytes
        The pickled `EvidenceKit`.
    rows : (B,) array
        The rows of the twins in the store, in ascending order.
    """

    kit: bytes
    rows: Index


class _Task(NamedTuple):
    """Twins of one scenario in successive rows.

    Attributes
    ----------
    kit : bytes
        The pickled `EvidenceKit`.
    rows : (B,) array
        Their rows in the store.
    observed : sequence of ObservedTwins or None
        Their observations; None if the process that computes reads them itself.
    """

    kit: bytes
    rows: Index
    observed: Sequence[ObservedTwins] | None = None


class GridSum(NamedTuple):
    """The log likelihood of the probabilities of worsening on a grid.

    Attributes
    ----------
    log_likelihood : (N, ..., N) array
        The sum of the twins' log evidence, for those whose observations are possible.
    twin_count : int
        The number of these twins.
    """

    log_likelihood: Float
    twin_count: int


@lru_cache(maxsize=2)
def _unpacked_kit(packed_kit: bytes) -> EvidenceKit:
    """Return a kit; the last ones are cached, because successive tasks share them."""
    kit: EvidenceKit = pickle.loads(packed_kit)
    return kit


@lru_cache(maxsize=2)
def _stored_observations(
    folder: str, fleet_hash: str, group: str, _reading: str
) -> StoredObservations | None:
    """Return the observations of a group; None if this machine does not have that fleet.

    They are cached for tasks of the same reading.
    """
    try:
        config = fleet_config(Path(folder))
    except RunFolderError:
        return None
    if hash_record(config) != fleet_hash:
        return None
    (record,) = [record for record in config["fleet"]["groups"] if record["name"] == group]
    scenario = Scenario.model_validate(record["scenarios"][0])
    return StoredObservations(open_group(Path(folder), group, names=False), scenario)


def _observed_twins(task: _Task) -> Sequence[ObservedTwins] | Iterator[ObservedTwins] | None:
    """Return the observations of a task's twins, block by block; None if they are missing."""
    if task.observed is not None:
        return task.observed
    kit = _unpacked_kit(task.kit)
    stored = _stored_observations(kit.folder, kit.fleet_hash, kit.group, kit.reading)
    return None if stored is None else stored.blocks(task.rows)


def _grid_sum(task: _Task, axes: Axes, prior: Float | None) -> GridSum | None:
    """Return the log evidence of a task's twins on a grid, summed; see `GroupEvidence.grid_sum`.

    None if this process cannot read their observations. A twin's evidence is a sum over the draws
    of the model's parameter. Those that are improbable at the centre of the grid are left out of
    the sum at all its points.
    """
    observation_blocks = _observed_twins(task)
    if observation_blocks is None:
        return None
    kit = _unpacked_kit(task.kit)
    if prior is None:
        prior = kit.sensor_model.draw_weight
    centre = np.array([axis[len(axis) // 2] for axis in axes])
    probability_at_centre = with_all_transitions_possible(centre)
    log_likelihood = np.zeros([len(axis) for axis in axes])
    twin_count = 0
    for observed, control in observation_blocks:
        likelihood = likelihood_at_nodes(
            kit.family, probability_at_centre, prior, kit.sensor_model, observed, control
        )
        log_evidence = likelihood.evidence_on_grid(kit.family, axes)  # (B, N^K)
        log_likelihood += log_evidence.sum(axis=0).reshape(log_likelihood.shape)
        # twins whose observations are impossible have no row
        twin_count += len(log_evidence)
    return GridSum(log_likelihood, twin_count)


def _evidence_of_draws(task: _Task, probability: Float) -> Float | None:
    """Return the log evidence (B, E) of a task's twins for each of the E draws.

    None if this process cannot read their observations.
    """
    observation_blocks = _observed_twins(task)
    if observation_blocks is None:
        return None
    kit = _unpacked_kit(task.kit)
    evidence_by_block = []
    for observed, control in observation_blocks:
        evidence_by_block.append(
            parameter_evidence(kit.family, probability, kit.sensor_model, observed, control)
        )
    return np.concatenate(evidence_by_block)


class GroupEvidence:
    """The evidence of a group's twins, summed by the processes of a pool.

    Parameters
    ----------
    flights : sequence of FlightsOfScenario
        The flights of the twins, by scenario.
    """

    def __init__(
        self,
        pool: TaskPool,
        group: str,
        flights: Sequence[FlightsOfScenario],
        progress: Progress,
    ) -> None:
        self._pool = pool
        self._group = group
        self._flights = flights
        self._progress = progress
        self._sends_observations = False

    @property
    def twin_count(self) -> int:
        """The number of twins."""
        return sum(len(rows) for _, rows in self._flights)

    def of_some_twins(self, blocks_apart: int) -> "GroupEvidence":
        """Return the evidence of the twins in one block of `BLOCK_TWINS` in so many."""
        flights = []
        for kit, rows in self._flights:
            block = np.arange(len(rows)) // BLOCK_TWINS
            is_chosen = block % blocks_apart == 0
            flights.append(FlightsOfScenario(kit, rows[is_chosen]))
        return GroupEvidence(self._pool, self._group, flights, self._progress)

    def grid_sum(self, axes: Axes, prior: Float | None) -> GridSum:
        """Return the log likelihood of the probabilities of worsening on a grid, of all twins.

        Parameters
        ----------
        axes : tuple of (N,) array
            The values of each probability.
        prior : (E,) array or None
            The probability of each draw of the sensor model, which holds in all steps; None for the
            weight of the draw in the calibration.
        """
        log_likelihood = np.zeros([len(axis) for axis in axes])
        twin_count = 0
        for sum_of_task in self._answers(partial(_grid_sum, axes=axes, prior=prior)):
            log_likelihood += sum_of_task.log_likelihood
            twin_count += sum_of_task.twin_count
        return GridSum(log_likelihood, twin_count)

    def evidence_of_draws(self, probability: Float) -> Iterator[Float]:
        """Yield the log evidence (B, E) of all twins for each draw, some twins at a time.

        Parameters
        ----------
        probability : (K,) array
            The probabilities of worsening.
        """
        yield from self._answers(partial(_evidence_of_draws, probability=probability))

    def _tasks(self) -> Iterator[_Task]:
        """Yield the tasks of all twins."""
        for kit, rows in self._flights:
            number = rows // TASK_TWINS
            for rows_of_task in np.split(rows, np.flatnonzero(np.diff(number)) + 1):
                if len(rows_of_task):
                    yield _Task(kit, rows_of_task)

    def _answers(self, function: Callable[[_Task], _Answer | None]) -> Iterator[_Answer]:
        """Yield the results of all tasks, in order.

        A worker that cannot read the fleet's folder returns None. Its task, and all later ones, are
        then sent with the observations, which this process reads.
        """
        unanswered: deque[_Task] = deque()

        def tasks_to_send() -> Iterator[_Task]:
            for task in self._tasks():
                unanswered.append(task)
                yield _with_observations(task) if self._sends_observations else task

        title = f"Learning from {self._group}"
        with self._progress.stage(title, total=self.twin_count, unit="twins") as stage:
            # The pool keeps the order of the tasks, and takes some before it has the first answer.
            for answer in self._pool.results(function, tasks_to_send()):
                task = unanswered.popleft()
                if answer is None:
                    self._sends_observations = True
                    (answer,) = self._pool.results(function, [_with_observations(task)])
                if answer is not None:
                    yield answer
                stage.advance(len(task.rows))


def _with_observations(task: _Task) -> _Task:
    """Return a task with the observations of its twins."""
    blocks = _observed_twins(task)
    if blocks is None:
        raise FleetError(
            f"the fleet in {_unpacked_kit(task.kit).folder} was removed or replaced while it was "
            "read: repeat the command."
        )
    return task._replace(observed=list(blocks))
