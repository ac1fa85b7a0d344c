"""The evidence of the twins of a group, computed task by task in any process of any machine.

A task has the twins of successive rows of the store. Its results do not depend on the process, and
those of all tasks are added in the order of the tasks, so that sums do not depend on the number of
workers.
"""

import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.files import hash_record
from reporting.progress import Progress
from twin_master.errors import FleetError, RunFolderError
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.engine import TaskPool
from twin_master.fleet.evidence import (
    TransitionFamily,
    grid_evidence,
    parameter_evidence,
    scaled_likelihood,
    transition_evidence,
)
from twin_master.fleet.posterior import Axes
from twin_master.fleet.store import open_group
from twin_master.fleet.store_layout import BLOCK_TWINS
from twin_master.fleet.stored_observations import ObservedTwins, StoredObservations
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario

_Answer = TypeVar("_Answer")

TASK_TWINS = 4096
"""The number of rows of the store that belong to a task."""
_LEAST_PROBABILITY = 1e-3
_LARGEST_PROBABILITY = 0.9
"""Probabilities of worsening under which damage may grow or stay in any step."""


def with_all_transitions_possible(probability: Float) -> Float:
    """Return probabilities of worsening that are neither near 0 nor near 1.

    So any course of the damage is possible, and observations that are impossible with these
    probabilities contradict the sensor model.
    """
    return probability.clip(_LEAST_PROBABILITY, _LARGEST_PROBABILITY)


class EvidenceKit(NamedTuple):
    """All that the evidence of twins of one scenario needs beside their observations.

    Attributes
    ----------
    folder : str
        The folder of the fleet, an absolute path.
    fleet_hash : str
        The hash of the fleet's `config.json`.
    group : str
        The name of the group.
    reading : str
        Differs from call to call, so that no process takes what it has read before for what is in a
        store that has grown since.
    family : TransitionFamily
        The transitions.
    sensor_model : GaussianSensorModel
        The model of the sensors.
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
    """Twins of one scenario in successive rows, and what is asked of them.

    Attributes
    ----------
    kit : bytes
        The pickled `EvidenceKit`.
    rows : (B,) array
        Their rows in the store.
    observed : sequence of ObservedTwins or None
        Their observations; None if the process that computes reads them itself.
    grids : tuple of Axes or None
        Grids of the K probabilities to worsen on which the log likelihood is asked for.
    probability : (K,) array or None
        Probabilities at which the log evidence of each draw of the sensor model is asked for.
    """

    kit: bytes
    rows: Index
    observed: Sequence[ObservedTwins] | None = None
    grids: tuple[Axes, ...] | None = None
    probability: Float | None = None


class GridSums(NamedTuple):
    """The log likelihood of twins on grids.

    Attributes
    ----------
    log_likelihood : list of (N, ..., N) array
        The sum over the twins whose observations are possible, on each grid.
    explained : int
        The number of these twins.
    """

    log_likelihood: list[Float]
    explained: int


@lru_cache(maxsize=2)
def _unpacked_kit(packed_kit: bytes) -> EvidenceKit:
    """Return a kit; the last ones are kept, because successive tasks share them."""
    kit: EvidenceKit = pickle.loads(packed_kit)
    return kit


@lru_cache(maxsize=2)
def _stored_observations(
    folder: str, fleet_hash: str, group: str, _reading: str
) -> StoredObservations | None:
    """Return the observations of a group; None if this machine does not have that fleet.

    They are kept for tasks of the same reading.
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
    """Return the observations of the twins of a task, block by block; None if they are missing."""
    if task.observed is not None:
        return task.observed
    kit = _unpacked_kit(task.kit)
    stored = _stored_observations(kit.folder, kit.fleet_hash, kit.group, kit.reading)
    return None if stored is None else stored.blocks(task.rows)


def _grid_sums(task: _Task) -> GridSums | None:
    """Return the log likelihood of the twins of a task; None if their observations are missing."""
    blocks = _observed_twins(task)
    if blocks is None:
        return None
    kit = _unpacked_kit(task.kit)
    point = with_all_transitions_possible(kit.family.assumed)[None]
    totals = [np.zeros([len(axis) for axis in axes]) for axes in task.grids or ()]
    explained = 0
    for observed, control in blocks:
        likelihood = scaled_likelihood(kit.sensor_model, observed, control).values
        at_point = transition_evidence(kit.family, point, likelihood, control)  # (twins, 1)
        is_explained: NDArray[np.bool_] = np.isfinite(at_point[:, 0])
        explained += int(is_explained.sum())
        for total, axes in zip(totals, task.grids or (), strict=True):
            log_evidence = grid_evidence(
                kit.family, axes, likelihood[is_explained], control[is_explained]
            )
            total += log_evidence.sum(axis=0).reshape(total.shape)
    return GridSums(totals, explained)


def _evidence_of_draws(task: _Task) -> Float | None:
    """Return the log evidence (B, E) of the twins of a task; None without their observations."""
    blocks = _observed_twins(task)
    if blocks is None or task.probability is None:
        return None
    kit = _unpacked_kit(task.kit)
    rows = []
    for observed, control in blocks:
        rows.append(
            parameter_evidence(kit.family, task.probability, kit.sensor_model, observed, control)
        )
    return np.concatenate(rows)


class GroupEvidence:
    """The evidence of the twins of a group, summed up by the processes of a pool.

    Parameters
    ----------
    pool : TaskPool
        The processes.
    group : str
        The name of the group.
    flights : sequence of FlightsOfScenario
        The flights of the twins, by scenario.
    progress : Progress
        Shows how far a reading of all twins has come.
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

    def grid_sums(self, grids: tuple[Axes, ...], blocks_apart: int = 1) -> GridSums:
        """Return the log likelihood of the probabilities to worsen on grids, in one reading.

        Parameters
        ----------
        grids : tuple of Axes
            The grids, axes of probabilities.
        blocks_apart : int
            With a number above 1 the sum is over one block of twins in so many.
        """
        total = GridSums([np.zeros([len(axis) for axis in axes]) for axes in grids], 0)
        questions = self._tasks(blocks_apart, grids=grids)
        twin_count = sum(len(_some_blocks(rows, blocks_apart)) for _, rows in self._flights)
        for sums in self._answers(_grid_sums, questions, twin_count):
            for total_on_grid, sum_on_grid in zip(
                total.log_likelihood, sums.log_likelihood, strict=True
            ):
                total_on_grid += sum_on_grid
            total = total._replace(explained=total.explained + sums.explained)
        return total

    def evidence_of_draws(self, probability: Float) -> Iterator[Float]:
        """Yield the log evidence (B, E) of all twins for each draw, some twins at a time.

        Parameters
        ----------
        probability : (K,) array
            The probabilities to worsen.
        """
        tasks = self._tasks(1, probability=probability)
        twin_count = sum(len(rows) for _, rows in self._flights)
        yield from self._answers(_evidence_of_draws, tasks, twin_count)

    def _tasks(
        self,
        blocks_apart: int,
        *,
        grids: tuple[Axes, ...] | None = None,
        probability: Float | None = None,
    ) -> Iterator[_Task]:
        """Yield the tasks of all twins, or of those in one block of the store in so many."""
        for kit, rows in self._flights:
            chosen_rows = _some_blocks(rows, blocks_apart)
            number = chosen_rows // TASK_TWINS
            for rows_of_task in np.split(chosen_rows, np.flatnonzero(np.diff(number)) + 1):
                if len(rows_of_task):
                    yield _Task(kit, rows_of_task, grids=grids, probability=probability)

    def _answers(
        self,
        function: Callable[[_Task], _Answer | None],
        tasks: Iterator[_Task],
        twin_count: int,
    ) -> Iterator[_Answer]:
        """Yield the results of tasks, in their order; they have so many twins in all.

        Workers read the observations themselves if they see the folder of the fleet. From the first
        one on that does not, this process sends the observations with the tasks.
        """
        unanswered: deque[_Task] = deque()

        def tasks_to_send() -> Iterator[_Task]:
            for task in tasks:
                unanswered.append(task)
                yield _with_observations(task) if self._sends_observations else task

        title = f"Learning from {self._group}"
        with self._progress.stage(title, total=twin_count, unit="twins") as stage:
            for answer in self._pool.results(function, tasks_to_send()):
                task = unanswered.popleft()
                if answer is None:
                    self._sends_observations = True
                    (answer,) = self._pool.results(function, [_with_observations(task)])
                if answer is not None:
                    yield answer
                stage.advance(len(task.rows))


def _some_blocks(rows: Index, blocks_apart: int) -> Index:
    """Return the rows (B,) that are in one block of the store in so many."""
    chosen: Index = rows[(rows // BLOCK_TWINS) % blocks_apart == 0]
    return chosen


def _with_observations(task: _Task) -> _Task:
    """Return a task with the observations of its twins, which are read here.

    Raises
    ------
    FleetError
        If the fleet was replaced in the meantime.
    """
    blocks = _observed_twins(task)
    if blocks is None:
        raise FleetError(
            f"the fleet in {_unpacked_kit(task.kit).folder} was removed or replaced while it was "
            "read: repeat the command."
        )
    return task._replace(observed=list(blocks))
