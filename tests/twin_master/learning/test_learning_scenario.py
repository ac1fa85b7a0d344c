"""`[learning]` in a scenario: what is read and refused, and the shipped wing that was never calibrated."""

from pathlib import Path

import pytest

from scenarios import scenario_files
from twin_master.errors import TwinMasterError
from twin_master.mission.preparation import Knowledge, prepare_twin
from twin_master.network.estimator import ExactFilter
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import load_scenario

TEXT = scenario_files()["level_turns_learning"].read_text()


@pytest.fixture(scope="module")
def knowledge() -> Knowledge:
    return prepare_twin("level_turns_learning")


def test_a_twin_learns_a_soft_wing_and_the_noise_of_its_gauges(knowledge: Knowledge) -> None:
    from numpy.random import default_rng

    soft = int(knowledge.draws.values.argmin())
    shown = knowledge.sensor_model.value_per_draw[soft, 0, 1]
    random, twin = default_rng(0), knowledge.twin()
    for _ in range(30):
        turn = twin.turn(shown + 150e-6 * random.normal(size=24), "3g")
    e = turn.learnt["young_modulus_factor"]
    assert abs(e.mean - knowledge.draws.values[soft]) < 0.01
    assert e.standard_deviation < 0.25 * knowledge.draws.standard_deviation
    scales = [turn.learnt[f"noise_scale[{gauge}]"] for gauge in range(1, 25)]
    assert sum(scale.mean for scale in scales) / 24 == pytest.approx(1.2, abs=0.06)  # 150 of 125 microstrain
    assert sum(scale.lower < 1.2 < scale.upper for scale in scales) >= 18


def test_without_the_table_the_filter_is_the_exact_one() -> None:
    loaded = load_scenario("level_turns")
    assert "learning" not in loaded.scenario.to_dict()
    assert isinstance(prepare_twin("paper_level_turns").twin().estimator, ExactFilter)


def test_a_factor_on_the_transitions_multiplies_the_probability_to_leave() -> None:
    scenario = load_scenario("level_turns").scenario
    once, thrice = (build_graphical_model(scenario, factor).transition.matrix for factor in (1.0, 3.0))
    assert thrice[1, 0, 1] == pytest.approx(0.3 * 0.7)
    assert once[1, 0, 1] == pytest.approx(0.1 * 0.9)
    assert thrice.sum(axis=-1) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("transition_factors = [1.0]", "two or more factors"),
        ("transition_factors = [2.0, 1.0]", "must increase"),
        ("gauge_gain_percent = [1.0, 2.0]", "one for each of the 24 sensors"),
        ("noise_degrees = 2.0", "greater than 2"),
        ("colour = true", "colour"),
    ],
)
def test_what_cannot_be_learnt_is_refused_in_a_sentence(tmp_path: Path, line: str, sentence: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(TEXT.replace("noise_degrees = 10 ", line + " "))
    with pytest.raises(TwinMasterError, match=sentence):
        load_scenario(file)


def test_more_transitions_than_there_can_be_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(TEXT.replace("noise_degrees = 10 ", "transition_factors = [1.0, 11.0] "))
    knowledge = prepare_twin(load_scenario(file))
    with pytest.raises(TwinMasterError, match=r"smaller `learning.transition_factors`"):
        knowledge.twin()
