"""Evidence on grids and at draws, the search for a grid, and workers, against the filter and each other."""

import gc
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from reporting.progress import Progress
from tests.refusals import refused
from tests.twin_master.fleet.test_kills import KillingProgress, local_workers
from tests.twin_master.fleet.test_learning import tiny
from tests.twin_master.network.decision_oracles import precise_forward_backward
from twin_master.assets.resolution import Overrides
from twin_master.errors import FleetError
from twin_master.fleet import engine
from twin_master.fleet.engine import Engine, TaskPool, open_task_pool
from twin_master.fleet.learning import evidence_tasks
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    grid_evidence,
    transition_evidence,
)
from twin_master.fleet.learning.evidence_kernels import LEAST_EVIDENCE
from twin_master.fleet.learning.parameter_evidence import parameter_evidence
from twin_master.fleet.plan import ensemble
from twin_master.network.graphical_model import build_graphical_model
from uav_twin import GaussianSensorModel, fly_fleet, learn_from_fleet

EACH = {"2g": 0.07, "3g": 0.2}
OF_REGIONS = {"2g": {"z1": 0.07, "z2": 0.3}, "3g": {"z1": 0.2, "z2": 0.01}}
CONTROLS = {
    "one control": [0, 0, 0, 0, 0, 0],
    "one change": [1, 1, 1, 0, 0, 0],
    "there and back": [1, 0, 0, 1, 1, 0],
    "to and fro": [0, 1, 0, 1, 0, 1],
}


@pytest.mark.parametrize("control", CONTROLS.values(), ids=CONTROLS)
@pytest.mark.parametrize(
    ("probability", "name", "success"),
    [
        (EACH, "growing_damage", 1.0),
        (OF_REGIONS, "growing_damage", 1.0),
        (EACH, "inspected_wing", 0.7),
    ],
    ids=["of each control", "of each region", "with repairs"],
)
def test_evidence_on_a_grid_is_that_of_its_points(probability, name, success, control):
    scenario = tiny(probability, name=name, success=success)
    family = TransitionFamily.learnable(scenario)
    controls = np.array([control, [len(scenario.control) - 1 - number for number in control]])
    likelihood = np.random.default_rng(4).random((2, 6, 9))
    axes = tuple(np.linspace(0.02 + 0.01 * k, 0.6, 3) for k in range(len(family.names)))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    evidence = grid_evidence(family, axes, likelihood, controls)
    np.testing.assert_allclose(
        evidence, transition_evidence(family, points, np.log(likelihood), controls), rtol=1e-12
    )


def test_evidence_on_a_grid_is_right_where_its_products_underflow():
    """The steps say in turn that all is well and that all is damaged: e^-1500 in all, and impossible."""
    family = TransitionFamily.learnable(tiny(EACH))
    likelihood = np.full((2, 6, 9), math.exp(-300.0))
    likelihood[0, ::2, 0] = likelihood[0, 1::2, 8] = 1.0
    likelihood[1] = 0.0
    likelihood[1, :3, 8] = likelihood[1, 3:, 0] = 1.0
    control = np.array([[1, 1, 0, 0, 1, 0]] * 2)
    axes = (np.array([0.1, 0.2]), np.array([0.3]))
    points = np.array([[0.1, 0.3], [0.2, 0.3]])
    evidence = grid_evidence(family, axes, likelihood, control)
    with np.errstate(divide="ignore"):
        log_likelihood = np.log(likelihood)
    expected = transition_evidence(family, points, log_likelihood, control)
    assert (expected[0] < -700.0).all()
    np.testing.assert_allclose(evidence[0], expected[0], rtol=1e-12)
    assert (evidence[1] == -np.inf).all()


def test_evidence_of_a_draw_is_that_of_the_filter_where_products_underflow():
    scenario = tiny(EACH)
    model = build_graphical_model(scenario)
    family = TransitionFamily.learnable(scenario)
    generator = np.random.default_rng(5)
    values = 1e-3 * (1.0 + generator.random((3, 9, 2, 24)))
    control = generator.integers(0, 2, (2, 6))
    observed = values[1, generator.integers(0, 9, (2, 6)), control]
    sensors = GaussianSensorModel(values, 1e-4)
    evidence = parameter_evidence(family, family.assumed, sensors, observed, control)
    for twin in range(2):
        log_density = sensors.log_density_of_draws(observed[twin], control[twin])
        scaled_evidence = evidence[twin] - log_density.max(axis=1).sum(axis=0)
        assert (scaled_evidence < LEAST_EVIDENCE).any()
    for draw in range(3):
        alone = GaussianSensorModel(values[draw : draw + 1], 1e-4)
        for twin in range(2):
            rows = alone.log_likelihood_sequence(observed[twin], control[twin])
            *_, expected = precise_forward_backward(model, control[twin], rows)
            assert evidence[twin, draw] == pytest.approx(expected.sum(), rel=1e-12)


@pytest.fixture(scope="module")
def flown(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fleet of forty twins."""
    plan = ensemble("growing_damage", range(40), Overrides(strain_library=library_file))
    return fly_fleet(plan, tmp_path_factory.mktemp("flown") / "fleet").folder


@pytest.fixture
def small_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a task have fourteen twins: there are three tasks, and the last one is smaller."""
    monkeypatch.setattr(evidence_tasks, "TASK_TWINS", 14)


def lessons(flown: Path, folder: Path, **options: Any) -> bytes:
    """Return the file of what a fleet teaches."""
    learn_from_fleet(flown, folder / "learnt.toml", **options)
    return (folder / "learnt.toml").read_bytes()


@pytest.fixture(scope="module")
def alone(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What the fleet teaches if this process computes all tasks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evidence_tasks, "TASK_TWINS", 14)
        return lessons(flown, tmp_path_factory.mktemp("alone"))


def test_a_fleet_teaches_the_same_bytes_with_several_workers_that_die(flown, tmp_path, small_tasks, alone):
    progress = KillingProgress(local_workers)
    assert lessons(flown, tmp_path, engine=Engine(2), progress=progress) == alone
    assert len(progress.killed) == 2


def end_this_process(_task: int) -> int:
    """Kill the process that computes the task."""
    psutil.Process().kill()
    return 0


@pytest.fixture(scope="module")
def pool() -> Iterator[TaskPool]:
    """A pool with one worker process, in which a task may kill one worker."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "ALLOWED_DEATHS", 1)
        with open_task_pool(Engine(1), Progress()) as pool:
            yield pool


def test_twins_over_which_workers_die_again_and_again_end_the_command_with_a_sentence(pool):
    with refused(FleetError, "2 workers died over the same twins"):
        list(pool.results(end_this_process, [1]))


def variable_of_worker(name: str) -> str | None:
    """Return an environment variable of the process that computes the task."""
    return os.environ.get(name)


def test_local_workers_keep_memory_for_their_next_arrays(pool):
    """With this variable, which Dask sets, glibc would take fresh memory for each array."""
    assert list(pool.results(variable_of_worker, ["MALLOC_TRIM_THRESHOLD_"])) == [None]


class Load:
    """What a task carries."""


def nothing_of(_load: Load) -> None:
    """Compute nothing."""


def test_a_pool_forgets_the_tasks_that_are_done(pool):
    """Dask logs the last messages to a worker, with the tasks in them."""
    list(pool.results(nothing_of, (Load() for _ in range(200))))
    gc.collect()
    kept = sum(type(thing) is Load for thing in gc.get_objects())
    assert kept < 40


class DistantPool(TaskPool):
    """Computes in this process while it does not see the folder of the fleet, as a distant machine."""

    def __init__(self, folder: Path) -> None:
        super().__init__(None)
        self._folder = folder
        self.answers: list[bool] = []

    def results(self, function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        for task in tasks:
            evidence_tasks._stored_observations.cache_clear()
            hidden = self._folder.rename(self._folder.with_name("hidden"))
            result = function(task)
            hidden.rename(self._folder)
            evidence_tasks._stored_observations.cache_clear()
            self.answers.append(result is not None)
            yield result


def test_observations_are_sent_to_workers_that_do_not_see_the_fleet(
    flown, tmp_path, small_tasks, monkeypatch, alone
):
    pool = DistantPool(flown)
    monkeypatch.setattr("twin_master.fleet.learning.learn.open_task_pool", lambda *_: nullcontext(pool))
    assert lessons(flown, tmp_path) == alone
    # The first task comes back without an answer; then all tasks go with their observations.
    assert pool.answers[:2] == [False, True]
    assert sum(not answer for answer in pool.answers) == 1
