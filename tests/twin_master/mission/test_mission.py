"""The mission loop: timing, resuming at every turn, and what stops it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from benchmarks.seeds import fly_seeds
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.assets.strain_library_source import StrainLibrarySource, load_strain_library
from twin_master.errors import AssetOutputError, NotResumableError
from twin_master.mission.loop import Checkpoint, fly
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.turns import History, Turn
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario


@pytest.fixture(params=["level_turns", "growing_damage", "failing_gauges"])
def source(request: pytest.FixtureRequest, library_file: Path) -> StrainLibrarySource:
    scenario = load_scenario(request.param).scenario
    return StrainLibrarySource(scenario, load_strain_library(library_file), "h")


def knowledge_of(source: StrainLibrarySource) -> Knowledge:
    return prepare_knowledge(source._scenario, source, 3)


def of_the_paper(library: Path, seed: int = 1) -> tuple[Scenario, StrainLibrarySource, Knowledge]:
    scenario = load_scenario("paper_level_turns").scenario
    source = StrainLibrarySource(scenario, load_strain_library(library), "h")
    return scenario, source, prepare_knowledge(scenario, source, seed)


def flown(source: StrainLibrarySource, knowledge: Knowledge, seed: int = 3, **options: object) -> History:
    plant = knowledge.plant(knowledge.truth(seed), source.open())
    return fly(knowledge.scenario, knowledge.twin(), plant, **options)  # type: ignore[arg-type]


ARRAYS = (
    "observed", "control_index", "filtered", "log_evidence", "smoothed", "predicted", "decision_probability",
    "state",
)  # fmt: skip


def same(first: History, second: History) -> bool:
    pairs = [(getattr(first, name), getattr(second, name)) for name in ARRAYS]
    return all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


def stopped(kept: list[tuple[Turn, bytes]]) -> Checkpoint:
    turns = [turn for turn, _ in kept]
    decided = [turn.concluded.next_control for turn in turns]
    return Checkpoint([turn.reading for turn in turns], decided, kept[-1][1])


def test_resuming_after_any_turn_is_bit_identical(source: StrainLibrarySource) -> None:
    knowledge = knowledge_of(source)
    kept: list[tuple[Turn, bytes]] = []
    whole = flown(source, knowledge, keep=lambda *told: kept.append(told))
    assert len(kept) == 50
    for turns in (1, 2, 17, 49, 50):
        rest = flown(source, knowledge, checkpoint=stopped(kept[:turns]))
        assert rest.resumed_at == turns
        assert np.all((rest.seconds > 0.0).any(axis=1) == (np.arange(50) >= turns))
        assert same(whole, rest)


def test_timing_of_a_turn(library_file: Path) -> None:
    """Control u_t is in force while d_t, the gain of step t included, is observed."""
    scenario, source, knowledge = of_the_paper(library_file)
    asked: list[tuple[float, float, float]] = []
    inner = source.open()

    def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        asked.append((control["load_factor"], health["z1"], health["z2"]))
        return inner.step(control, health)

    plant = knowledge.plant(knowledge.truth(1), StatelessAsset(observe))
    flight = fly(scenario, knowledge.twin(), plant)
    assert asked[0] == (3.0, 0.0, 0.0)
    assert asked[5][1:] == (0.0, 0.22)
    assert asked[30][1:] == (0.6, 0.6)
    assert [load for load, _, _ in asked] == [(2.0, 3.0)[index] for index in flight.control_index]
    for step in range(49):  # u_{t+1} is the mode of the policy at the state as observed at t
        assert flight.control_index[step + 1] == np.argmax(flight.filtered[step] @ knowledge.plan.policy)


def test_the_observation_is_the_truth_with_noise_and_nothing_else_reaches_the_twin(
    library_file: Path,
) -> None:
    _, source, knowledge = of_the_paper(library_file)
    flight = flown(source, knowledge, 1)
    residual = flight.observed - flight.observation
    np.testing.assert_allclose(residual, knowledge.truth(1).noise, atol=1e-12)
    twin = knowledge.twin()
    again = [twin.turn(row, int(u)) for row, u in zip(flight.observed, flight.control_index, strict=True)]
    np.testing.assert_array_equal([turn.filtered for turn in again], flight.filtered)
    np.testing.assert_array_equal(twin.smoothed(), flight.smoothed)


def test_an_asset_that_returns_nan_or_the_wrong_number_stops_the_mission(library_file: Path) -> None:
    scenario, source, knowledge = of_the_paper(library_file)
    inner = source.open()
    count = 0

    def broken(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        nonlocal count
        count += 1
        values = inner.step(control, health).values
        if count == 4:
            values[7] = np.nan
        return AssetReading(values)

    kept: list[Turn] = []
    plant = knowledge.plant(knowledge.truth(1), StatelessAsset(broken))
    with pytest.raises(AssetOutputError, match=r"step 3: .*NaN.*`strain` 8 under the control `3g`"):
        fly(scenario, knowledge.twin(), plant, keep=lambda turn, _state: kept.append(turn))
    assert len(kept) == 3
    short = knowledge.plant(
        knowledge.truth(1), StatelessAsset(lambda _control, _health: AssetReading(np.zeros(3)))
    )
    with pytest.raises(AssetOutputError, match="expects 24 values"):
        fly(scenario, knowledge.twin(), short)


def test_a_checkpoint_whose_decisions_do_not_follow_is_refused(library_file: Path) -> None:
    _, source, knowledge = of_the_paper(library_file)
    kept: list[tuple[Turn, bytes]] = []
    flown(source, knowledge, keep=lambda *told: kept.append(told))
    altered = stopped(kept[:10])
    altered.decided[4] = 1 - altered.decided[4]
    with pytest.raises(NotResumableError, match="after turn 4"):
        flown(source, knowledge, checkpoint=altered)


def test_study_on_the_published_library(published_library: Path) -> None:
    """Policy and reliability of the reference twin; the bars are those of 300 missions, widened for 60."""
    scenario, source, knowledge = of_the_paper(published_library, 0)
    z1 = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(z1 < 0.59, 1, 0))
    margin = (knowledge.plan.action_value[:, 1] - knowledge.plan.action_value[:, 0]).reshape(5, 5)
    np.testing.assert_allclose(margin[2:4, 0], [0.007, -0.059], atol=1e-3)
    study = fly_seeds(scenario, source, range(60))
    assert study.within(2).value >= 0.95
    assert study.early_fallback.value <= 0.2
    assert np.all([study.rms(0).value <= 0.045, study.rms(1).value <= 0.13])
