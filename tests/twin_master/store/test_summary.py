"""The figures of a mission."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twin_master.assets.strain_library import load_strain_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Reference
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import control_changes, filtered_rms_error, find_fallback, summarise

MODEL = build_graphical_model(load_scenario("level_turns").scenario)
Z1 = MODEL.states.coordinates[:, 0]
POLICY = np.where(Z1 > 0.59, 0, 1)
TRUTH = np.zeros((50, 2))
TRUTH[20:, 0], TRUTH[30:, 0] = 0.4, 0.6


def controls(*gentle: int) -> np.ndarray:
    flown = np.ones(50, dtype=np.int64)
    flown[list(gentle)] = 0
    return flown


@pytest.mark.parametrize(
    ("gentle", "delay", "early"),
    [
        (range(31, 50), 1, None),
        (range(33, 50), 3, None),
        ([*range(25, 27), *range(32, 50)], 2, 25),
        (range(29, 50), 0, 29),
        ([], None, None),
    ],
)
def test_fallback(gentle: range | list[int], delay: int | None, early: int | None) -> None:
    found = find_fallback(MODEL.states, POLICY, 1, controls(*gentle), TRUTH)
    assert (found.switch_state, found.switch_level) == ("z1", 0.6)
    assert found.called_for_step == 30
    assert found.delay == delay
    assert found.early_step == early


def test_a_policy_of_several_states_or_none_has_no_switch() -> None:
    both = np.where(MODEL.states.coordinates.sum(axis=1) > 0.59, 0, 1)
    for policy in (both, np.ones(25, dtype=np.int64)):
        found = find_fallback(MODEL.states, policy, 1, controls(31), TRUTH)
        assert found.switch_state is None
        assert found.delay is None


def test_no_damage_calls_for_no_fallback() -> None:
    found = find_fallback(MODEL.states, POLICY, 1, controls(12), np.zeros((50, 2)))
    assert found.called_for_step is None
    assert found.early_step == 12
    assert found.delay is None


def test_rms_error_of_a_certain_belief() -> None:
    belief = np.tile(MODEL.states.certain((0.2, 0.4)), (50, 1))
    error = filtered_rms_error(MODEL, belief, TRUTH)
    expected = np.sqrt([np.mean((0.2 - TRUTH[:, 0]) ** 2), 0.4**2])
    np.testing.assert_allclose(error, expected)


@pytest.fixture(scope="module", params=["level_turns", "failing_gauges", "growing_damage"])
def result(request: pytest.FixtureRequest, library_file: Path) -> MissionResult:
    scenario = load_scenario(request.param).scenario
    source = StrainLibrarySource(scenario, load_strain_library(library_file), "h")
    knowledge = prepare_knowledge(scenario, source, 3)
    truth = knowledge.truth(3)
    flight = fly(scenario, knowledge.twin(), knowledge.plant(truth, source.open()))
    return MissionResult(scenario, knowledge, flight, truth)


def test_every_figure_is_one_that_a_reference_can_name(result: MissionResult) -> None:
    turns = []
    for turn in result.flight.turns:
        happened = turn.reading.happened._replace(monitors={"strain_error_bound": 2e-6})
        turns.append(replace(turn, reading=replace(turn.reading, happened=happened)))
    complete = replace(result, flight=replace(result.flight, turns=turns))
    figures = summarise(complete, np.zeros((50, 3)))
    assert tuple(figure.key for figure in figures) == result.scenario.figure_names


def test_figures_stand_beside_the_references_of_the_scenario(
    result: MissionResult,
) -> None:
    references = (
        Reference(figure="fallback_delay", value="1 or 2", source="somewhere"),
        Reference(figure="mean_reward_error", value=-0.4, source="elsewhere"),
    )
    scenario = result.scenario.model_copy(update={"reference": references})
    figures = summarise(replace(result, scenario=scenario), np.zeros((50, 3)))
    found = {f.key: (f.reference, f.reference_source) for f in figures if f.reference is not None}
    assert found == {"fallback_delay": ("1 or 2", "somewhere"), "mean_reward_error": (-0.4, "elsewhere")}


def test_a_change_of_control_is_said_in_words() -> None:
    names = ("2g", "3g", "rest")
    assert control_changes(names, np.array([1, 1, 1]), "turn") == "flew 3g at every turn"
    assert control_changes(names, np.array([1, 1, 0, 0]), "turn") == "left 3g for 2g at turn 2"
    several = control_changes(names, np.array([1, 0, 1, 2, 0, 1]), "shift")
    assert several == (
        "left 3g for 2g at shift 1, left 2g for 3g at shift 2, left 3g for rest at shift 3, "
        "and 2 more changes"
    )
