"""Twins flown side by side against the same twins flown alone: equal to the last bit."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.errors import FmuEndedError
from tests.twin_master.runs import of_library
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.errors import MissionInputError
from twin_master.fleet.plan import Member
from twin_master.fleet.store import ENDED, FLOWN, in_credible_set, outcomes_of
from twin_master.mission.loop import fly
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.turns import DamageGrowth
from twin_master.network.transition import TransitionModel
from uav_twin import GraphicalModel, load_scenario

ARRAYS = ("row", "control_index", "state", "filtered", "log_evidence")


def known(name: str, library_file: Path, decide_on: str = "filtered") -> tuple[Knowledge, StatelessAsset]:
    scenario = load_scenario(name).scenario
    planner = scenario.planner.model_copy(update={"decide_on": decide_on, "policy": "mode"})
    mission = scenario.mission.model_copy(update={"steps": 35})
    knowledge, source = of_library(name, library_file, planner=planner, mission=mission, notice=None)
    asset = source.open()
    assert isinstance(asset, StatelessAsset)
    return knowledge, asset


def same(first: Flights, second: Flights) -> bool:
    pairs = ((getattr(first, name), getattr(second, name)) for name in ARRAYS)
    told = (first.failure, first.ended) == (second.failure, second.ended)
    return told and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.parametrize(
    ("name", "decide_on"),
    [
        ("level_turns", "filtered"),
        ("growing_damage", "predicted"),
        ("failing_gauges", "filtered"),
        ("inspected_wing", "predicted"),
    ],
)
def test_each_twin_flies_what_it_flies_alone(name, decide_on, library_file):
    knowledge, asset = known(name, library_file, decide_on)
    truths = [knowledge.truth(seed) for seed in range(5)]
    together = fly_side_by_side(knowledge, truths, [asset] * 5)
    assert same(together, fly_one_by_one(knowledge, truths, lambda *_: asset))
    for cut in (1, 2):
        parts = truths[:cut], truths[cut:]
        halves = [fly_side_by_side(knowledge, some, [asset] * len(some)) for some in parts]
        for array in ARRAYS:
            joined = np.concatenate([getattr(half, array) for half in halves])
            np.testing.assert_array_equal(getattr(together, array), joined)
    alone = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(truths[4], asset))
    assert np.array_equal(alone.control_index, together.control_index[4])
    assert len(np.unique(together.state[:, -1], axis=0)) > 1 or name != "growing_damage"
    if name == "inspected_wing":  # a region is sound behind its repair
        places = knowledge.scenario.control_names.index("repair_1"), together.control_index[:, :-1]
        assert (together.state[:, 1:, 0] == 0.0)[places[1] == places[0]].all()
        assert (places[1] == places[0]).any()


class Remembering:
    """An asset that is none of `StatelessAsset`, so that it is driven by a plant of its own."""

    def __init__(self, asset: StatelessAsset) -> None:
        self.step, self.units = asset.step, dict[str, str]()
        self.restore_state, self.close = (lambda _state: None), (lambda: None)

    def save_state(self) -> bytes:
        return b""


def until_soft(asset: StatelessAsset, error: Exception) -> StatelessAsset:
    """An asset that raises an error once its first region has lost 40 %."""

    def step(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        if health["z1"] >= 0.4:
            raise error
        return asset.step(control, health)

    return StatelessAsset(step)


@pytest.mark.parametrize(
    ("driven", "error"),
    [
        (lambda asset: asset, MissionInputError("too soft")),
        (Remembering, MissionInputError("too soft")),
        (Remembering, FmuEndedError("It is over.", time=1.0)),
    ],
)
def test_an_asset_that_fails_or_ends_keeps_what_it_has_flown_and_does_not_touch_the_others(
    driven, error, library_file
):
    knowledge, asset = known("growing_damage", library_file)
    truths, soft = [knowledge.truth(seed) for seed in range(6)], until_soft(asset, error)
    whole = fly_side_by_side(knowledge, truths, [asset] * 6)
    assert same(whole, fly_side_by_side(knowledge, truths, [driven(asset) for _ in truths]))
    found = fly_side_by_side(knowledge, truths, [driven(soft) for _ in truths])
    assert same(found, fly_one_by_one(knowledge, truths, lambda *_: driven(soft)))
    softened = whole.state[:, :, 0] >= 0.4 - 1e-9
    flown = np.where(softened.any(axis=1), softened.argmax(axis=1), 35)
    assert 0 < np.sum(flown < 35) < 6
    ends, over = (
        isinstance(error, FmuEndedError),
        "The asset ended the mission after {} of 35 turns: It is over.",
    )
    assert found.ended == [over.format(n) if ends and n < 35 else "" for n in flown]
    assert [text != "" for text in found.failure] == [not ends and n < 35 for n in flown]
    for twin, end in enumerate(flown):
        assert np.array_equal(found.filtered[twin, :end], whole.filtered[twin, :end])
        assert np.isnan(found.filtered[twin, end:]).all()
        assert (found.control_index[twin, end:] == -1).all()
    kept = outcomes_of(knowledge, found, [Member(row, "", row, {}) for row in range(6)])
    for row, turns in enumerate(flown):
        if ends or turns == 35:
            assert kept["status"][row] == (ENDED if found.ended[row] else FLOWN)
            np.testing.assert_array_equal(kept["belief"][row], found.filtered[row, turns - 1].astype("f4"))
            inside = in_credible_set(knowledge.model, found.filtered[row, :turns], found.state[row, :turns])
            assert kept["credible"][row] == np.float32(inside.mean())


def test_an_impossible_observation_ends_one_flight_only(library_file):
    knowledge, asset = known("level_turns", library_file)
    truths = [knowledge.truth(seed) for seed in range(2)]
    truths[1].noise[4] = 1e200
    with np.errstate(over="ignore"):
        found = fly_side_by_side(knowledge, truths, [asset] * 2)
        single = fly_one_by_one(knowledge, truths, lambda *_: asset)
    assert found.failure == single.failure
    assert found.failure[0] == ""
    assert "step 4" in found.failure[1]


def test_a_product_of_tables_flies_the_same_and_damage_grows_as_the_model_says(library_file):
    knowledge, asset = known("growing_damage", library_file)
    model = knowledge.model
    tables = model.transition.blocks[0].reshape(2, 5, 5, 5, 5)
    moves = TransitionModel((tables[:, :, 0].sum(axis=-1), tables[:, 0].sum(axis=2)))
    graph = GraphicalModel(model.states, model.controls, model.prior, moves)
    product = replace(knowledge, model=graph)
    assert product.model.transition.is_product
    truths = [product.truth(seed) for seed in range(2)]
    together = fly_side_by_side(product, truths, [asset] * 2)
    assert same(together, fly_one_by_one(product, truths, lambda *_: asset))
    growth, uniform = DamageGrowth(model), (np.arange(2000) + 0.5) / 2000
    for control in (0, 1):
        row = model.transition.row(control, 6)
        found = growth.following(np.full(len(uniform), control), np.full(len(uniform), 6), uniform)
        np.testing.assert_allclose(np.bincount(found, minlength=25) / 2000, row, atol=1.5 / 2000)
