"""Twins side by side beside twins one by one, what storing adds, and what learning costs."""

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement
from fe.reduction.model_cache import reduced_model
from reporting.arrays import AnyArray
from reporting.files import atomic_write_text
from scenarios import scenario_files
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.fleet.flight import fly_fleet
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    transition_evidence,
)
from twin_master.fleet.plan import Fleet, ensemble
from twin_master.fleet.storage.store import stored_variables
from twin_master.fleet.storage.store_address import StoreAddress
from twin_master.fleet.storage.store_writing import GroupWriter, create_store
from twin_master.mission.flights import fly_one_by_one, fly_side_by_side
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario

TWINS = 256
ALONE = 8
POINTS = 49
SCENARIO = "growing_damage"


def run() -> list[Measurement]:
    scenario = load_scenario(SCENARIO).scenario.model_copy(update={"notice": None})
    source = ReducedModelSource(scenario, reduced_model())
    knowledge, asset = prepare_knowledge(scenario, source, 0), source.open()
    truths = [knowledge.truth(seed) for seed in range(TWINS)]
    steps = TWINS * scenario.mission.steps
    fly_one_by_one(knowledge, truths[:1], lambda *_: asset)  # compiles
    flown = fly_side_by_side(knowledge, truths, [asset] * TWINS)
    together = cpu_seconds(lambda: fly_side_by_side(knowledge, truths, [asset] * TWINS)) / steps
    alone = cpu_seconds(lambda: fly_one_by_one(knowledge, truths[:ALONE], lambda *_: asset))
    alone /= ALONE * scenario.mission.steps
    rows = flown.observation_rows.reshape(steps, -1)
    controls = flown.control_index.ravel()
    sensors = knowledge.sensor_model
    likelihood = cpu_seconds(lambda: sensors.log_likelihood_sequence(rows, controls)) / steps
    worsening = TransitionFamily.learnable(scenario)
    of_states = sensors.log_likelihood_sequence(rows, controls).reshape(flown.filtered.shape)
    points = np.full((POINTS, 2), 0.1)
    transition_evidence(worsening, points[:1], of_states[:1], flown.control_index[:1])
    learning = cpu_seconds(
        lambda: transition_evidence(worsening, points, of_states, flown.control_index)
    )
    with tempfile.TemporaryDirectory() as place:
        folder, text = Path(place), scenario_files()[SCENARIO].read_text(encoding="utf-8")
        quiet = str(atomic_write_text(folder / "quiet.toml", f"notice = false\n{text}"))
        fly_fleet(ensemble(quiet, range(1)), folder / "start")
        start = cpu_seconds(lambda: fly_fleet(ensemble(quiet, range(1)), folder / "one"))
        fleet = ensemble(quiet, range(4 * TWINS))
        written = seconds_of_writing(
            fleet, stored_variables(knowledge, flown, fleet.groups[0].members[:TWINS])
        )
        stored_seconds = cpu_seconds(lambda: fly_fleet(fleet, folder / "many")) - start
    to_ten_thousand = 10_000 / (4 * TWINS)
    together_with_notices, alone_with_notices = seconds_with_notices()
    return [
        Measurement(
            "twin of 50 steps with notices, side by side",
            1e3 * together_with_notices,
            "ms",
            2.0,
            "alone",
            1e3 * alone_with_notices,
        ),
        Measurement(
            "step of a twin, side by side", 1e6 * together, "us", None, "alone", 1e6 * alone
        ),
        Measurement(
            "likelihood of a step in it", 1e6 * likelihood, "us", None, "all", 1e6 * together
        ),
        Measurement(
            "10,000 twins stored, beside start-up (from 1,024)",
            to_ten_thousand * stored_seconds,
            "s",
            8.0,
            "likelihoods alone",
            likelihood * 500_000,
        ),
        Measurement(
            "twin of 50 steps written into the store",
            1e3 * written,
            "ms",
            None,
            "flown side by side",
            1e3 * 50 * together,
        ),
        Measurement(
            "evidence of a step at a point of a grid",
            1e6 * learning / (steps * POINTS),
            "us",
            None,
            "likelihood of a step",
            1e6 * likelihood,
        ),
    ]


def seconds_with_notices() -> tuple[float, float]:
    """Return the processor time of a twin of 50 steps with notices: side by side, and alone."""
    scenario = load_scenario(SCENARIO).scenario
    source = ReducedModelSource(scenario, reduced_model())
    knowledge, asset = prepare_knowledge(scenario, source, 0), source.open()
    truths = [knowledge.truth(seed) for seed in range(TWINS)]
    fly_side_by_side(knowledge, truths[:2], [asset] * 2)  # compiles
    fly_one_by_one(knowledge, truths[:1], lambda *_: asset)  # compiles
    together = cpu_seconds(lambda: fly_side_by_side(knowledge, truths, [asset] * TWINS))
    alone = cpu_seconds(lambda: fly_one_by_one(knowledge, truths[:ALONE], lambda *_: asset))
    to_fifty_steps = 50 / scenario.mission.steps
    return to_fifty_steps * together / TWINS, to_fifty_steps * alone / ALONE


def seconds_of_writing(fleet: Fleet, variables: Mapping[str, AnyArray]) -> float:
    """Return the processor time of writing a twin of a shard into the store of a fleet."""
    with tempfile.TemporaryDirectory() as place:
        create_store(Path(place), fleet)
        writer = GroupWriter(StoreAddress(Path(place)), fleet, fleet.groups[0])
        writer.write(variables, 0)
        later_shards = range(TWINS, 4 * TWINS, TWINS)

        def write_shards() -> None:
            for first_row in later_shards:
                writer.write(variables, first_row)

        return cpu_seconds(write_shards) / (TWINS * len(later_shards))


def cpu_seconds(function: Callable[[], object]) -> float:
    """Return the processor time of a call in seconds."""
    begin = time.process_time()
    function()
    return time.process_time() - begin
