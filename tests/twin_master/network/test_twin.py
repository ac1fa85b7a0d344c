"""The twin: the model that a scenario describes, and what it concludes from turn to turn."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.stats import binom

from scenarios import scenario_files
from twin_master.assets.strain_library import load_strain_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.errors import ImpossibleObservation
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.network.inference import filter_sequence, smooth
from twin_master.network.twin import TwinTurn, build_graphical_model
from twin_master.scenario.reading import load_scenario, parse_scenario


@pytest.fixture
def knowledge(library_file: Path) -> Knowledge:
    scenario = load_scenario("level_turns").scenario
    return prepare_knowledge(
        scenario, StrainLibrarySource(scenario, load_strain_library(library_file), "h"), 0
    )


def test_the_model_of_the_paper() -> None:
    model = build_graphical_model(load_scenario("level_turns").scenario)
    assert model.states.names == ("z1", "z2")
    assert model.prior[0] == 1.0
    matrix = model.transition.matrix
    start, index = model.states.index((0.2, 0.4)), model.states.index
    for control, p in enumerate((0.05, 0.10)):
        row = matrix[control, start]
        assert row[start] == pytest.approx((1 - p) ** 2)
        assert row[index((0.4, 0.4))] == pytest.approx(p * (1 - p))
        assert row[index((0.4, 0.6))] == pytest.approx(p * p)
        assert matrix[control, index((0.8, 0.8)), index((0.8, 0.8))] == 1.0


def test_probabilities_may_differ_between_states_and_tables_may_be_given() -> None:
    table = tomllib.loads(scenario_files()["level_turns"].read_text(encoding="utf-8"))
    table["transition"]["probability"]["3g"] = {"z1": 0.3, "z2": 0.0}
    model = build_graphical_model(parse_scenario(table, "x"))
    at = model.states.index
    assert model.transition.matrix[1, at((0.0, 0.0)), at((0.2, 0.0))] == pytest.approx(0.3)
    assert model.transition.matrix[1, at((0.0, 0.0)), at((0.0, 0.2))] == 0.0
    tables = {
        control: {
            name: [
                [1.0 - p if i == j else p if j == (i + 1) % 5 else 0.0 for j in range(5)] for i in range(5)
            ]
            for name, p in (("z1", 0.25), ("z2", 0.5))
        }
        for control in ("2g", "3g")
    }
    table["transition"] = {"kind": "independent_tables", "tables": tables}
    model = build_graphical_model(parse_scenario(table, "x"))
    assert model.transition.matrix[0, at((0.8, 0.0)), at((0.0, 0.2))] == pytest.approx(0.125)


def test_turn_by_turn_equals_the_whole_sequence(knowledge: Knowledge) -> None:
    generator = np.random.default_rng(0)
    controls = np.array([1, 1, 0, 1, 0, 0])
    observed = knowledge.sensor_model.mean[[0, 0, 5, 6, 6, 12], controls]
    observed = observed + 150e-6 * generator.standard_normal(observed.shape)
    observed[3] = np.nan
    twin = knowledge.twin()
    turns = [twin.turn(row, int(control)) for row, control in zip(observed, controls, strict=True)]
    likelihood = knowledge.sensor_model.log_likelihood_sequence(observed, controls)
    whole = filter_sequence(knowledge.model, controls, likelihood)
    np.testing.assert_allclose([turn.filtered for turn in turns], whole.filtered, atol=1e-14)
    np.testing.assert_allclose([turn.log_evidence for turn in turns], whole.log_evidence, atol=1e-12)
    np.testing.assert_allclose(
        twin.smoothed(), smooth(knowledge.model, controls, whole.log_filtered).smoothed, atol=1e-14
    )
    # A step without any observation follows the dynamics and says nothing.
    np.testing.assert_allclose(
        turns[3].filtered, turns[2].filtered @ knowledge.model.transition.matrix[0], atol=1e-15
    )
    assert turns[3].log_evidence == pytest.approx(0.0, abs=1e-14)


def decided(knowledge: Knowledge, rule: Literal["filtered", "predicted"], turns: int) -> TwinTurn:
    """Return the last of some turns that follow the dynamics alone at 3g, decided by a rule."""
    planner = knowledge.scenario.planner.model_copy(update={"decide_on": rule})
    scenario = knowledge.scenario.model_copy(update={"planner": planner})
    twin = replace(knowledge, scenario=scenario).twin()
    blind = np.full(knowledge.sensor_model.sensor_count, np.nan)
    return [twin.turn(blind, 1) for _ in range(turns)][-1]


def test_the_two_rules_of_decision_differ_where_the_belief_tips_within_one_turn(knowledge: Knowledge) -> None:
    """The policy is 2g from z1 = 60 %, three levels up; nothing is seen, so z1 is binomial with p = 0.1.

    After 26 transitions p(z1 >= 60 %) = 0.489, after 27 it is 0.515.
    """
    np.testing.assert_array_equal(knowledge.plan.control_index.reshape(5, 5)[:, 0], [1, 1, 1, 0, 0])
    gentle = [float(binom.sf(2, count, 0.1)) for count in (25, 26, 27)]
    assert gentle[1] < 0.5 < gentle[2]
    for turns, rule, probability, control in (
        (26, "filtered", gentle[0], 1),
        (26, "predicted", gentle[1], 1),
        (27, "filtered", gentle[1], 1),
        (27, "predicted", gentle[2], 0),
        (28, "filtered", gentle[2], 0),
    ):
        turn = decided(knowledge, rule, turns)
        np.testing.assert_allclose(turn.decision_probability, [probability, 1.0 - probability], atol=1e-12)
        assert turn.next_control == control, (turns, rule)
        # What is predicted does not depend on the rule.
        np.testing.assert_allclose(
            turn.prediction.control_probability[0, 0], binom.sf(2, turns, 0.1), atol=1e-12
        )


def test_an_impossible_observation_names_twin_step_and_sensors(knowledge: Knowledge) -> None:
    twin = knowledge.twin()
    good = knowledge.sensor_model.mean[0, 1].copy()
    twin.turn(good, 1)
    bad = good.copy()
    bad[4] = 1e300
    with pytest.raises(ImpossibleObservation, match=r"level_turns.*step 1.*sensor 5") as caught:
        twin.turn(bad, 1)
    assert caught.value.step == 1
    assert twin.turns == 1
    twin.turn(good, 1)
    assert twin.smoothed().shape == (2, 25)
