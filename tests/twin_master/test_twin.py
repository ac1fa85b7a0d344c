"""The twin: the model that a scenario describes, and what it concludes from turn to turn."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from scenarios import scenario_files
from twin_master.asset_source import StrainLibrarySource
from twin_master.crew import Knowledge, prepare_knowledge
from twin_master.errors import ImpossibleObservation
from twin_master.inference import filter_sequence, smooth
from twin_master.scenario_file import load_scenario, parse_scenario
from twin_master.strain_library import load_strain_library
from twin_master.twin import build_graphical_model


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
        turns[-1].smoothed, smooth(knowledge.model, controls, whole.log_filtered).smoothed, atol=1e-14
    )
    # A step without any observation follows the dynamics and says nothing.
    np.testing.assert_allclose(
        turns[3].filtered, turns[2].filtered @ knowledge.model.transition.matrix[0], atol=1e-15
    )
    assert turns[3].log_evidence == pytest.approx(0.0, abs=1e-14)


def test_the_decision_is_the_mode_of_the_control_node(knowledge: Knowledge) -> None:
    turn = knowledge.twin().turn(knowledge.sensor_model.mean[0, 1], 1)
    joint = turn.prediction.predicted[0][:, None] * knowledge.plan.policy
    assert turn.next_control == int(np.argmax(joint.sum(axis=0)))


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
    assert twin.turn(good, 1).smoothed.shape == (2, 25)
