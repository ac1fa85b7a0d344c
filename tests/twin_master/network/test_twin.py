"""The twin: the model that a scenario describes, and what it concludes from step to step."""

import pickle
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from fe.runtime.arrays import arrays_to_bytes
from tests.twin_master.runs import of_library, table_of
from twin_master.errors import ImpossibleObservation, InvalidModelError
from twin_master.mission.preparation import Knowledge
from twin_master.network.estimator import Learnt
from twin_master.network.graphical_model import build_graphical_model
from twin_master.network.inference import smooth
from twin_master.network.twin import TwinStep
from twin_master.scenario.reading import parse_scenario
from uav_twin import Carried, Estimate, ExactFilter, Twin, filter_sequence


@pytest.fixture
def knowledge(library_file: Path) -> Knowledge:
    return of_library("paper_level_turns", library_file)[0]


def test_the_published_transitions_of_a_scenario_are_multiplied_by_a_factor():
    model = build_graphical_model(parse_scenario(table_of("level_turns"), "x"), 3.0)
    assert model.transition.matrix[1, 0, 1] == pytest.approx(0.3 * 0.7)


def worsening_by_one_level(probability: float) -> list[list[float]]:
    """Return the transitions of a factor of five levels; the last one goes on to the first."""
    to_next_level = np.roll(np.eye(5), 1, axis=1)
    transition: list[list[float]] = (probability * to_next_level + (1 - probability) * np.eye(5)).tolist()
    return transition


def test_the_transitions_of_a_scenario_are_those_of_its_tables():
    """See the pump for those of each state."""
    scenario = table_of("level_turns")
    tables = {"z1": worsening_by_one_level(0.25), "z2": worsening_by_one_level(0.5)}
    by_control = dict.fromkeys(("2g", "3g"), tables)
    scenario["transition"] = {"kind": "independent_tables", "tables": by_control}
    model = build_graphical_model(parse_scenario(scenario, "x"))
    before = model.states.index((0.8, 0.0))
    after = model.states.index((0.0, 0.2))
    assert model.transition.matrix[0, before, after] == pytest.approx(0.25 * 0.5)


def decided(knowledge: Knowledge, rule: str, steps: int) -> TwinStep:
    """Return the last of some steps that follow the dynamics alone at 3g, decided by a rule."""
    planner = knowledge.scenario.planner.model_copy(update={"decide_on": rule})
    scenario = knowledge.scenario.model_copy(update={"planner": planner})
    twin = replace(knowledge, scenario=scenario).twin()
    blind = np.full(knowledge.sensor_model.sensor_count, np.nan)
    return [twin.step(blind, 1) for _ in range(steps)][-1]


RULES_AND_STEPS = pytest.mark.parametrize(
    ("rule", "step_count"), list(product(("filtered", "predicted"), (26, 27, 28)))
)


def test_the_policy_is_gentle_from_the_third_level_on(knowledge):
    """2g from z1 = 60 %, three levels up."""
    controls = knowledge.plan.control_index.reshape(5, 5)[:, 0]
    np.testing.assert_array_equal(controls, [1, 1, 1, 0, 0])


@RULES_AND_STEPS
def test_the_two_rules_of_decision_differ_where_the_belief_tips_within_one_step(knowledge, rule, step_count):
    """Nothing is seen, so z1 is binomial with p = 0.1.

    After 26 transitions p(z1 >= 60 %) = 0.489, after 27 it is 0.515.
    """
    step = decided(knowledge, rule, step_count)
    transition_count = step_count - 1 if rule == "filtered" else step_count
    gentle = binom.sf(2, transition_count, 0.1)
    np.testing.assert_allclose(step.decision_probability, [gentle, 1.0 - gentle], atol=1e-12)
    assert step.next_control == int(transition_count <= 26)


@RULES_AND_STEPS
def test_what_is_predicted_does_not_depend_on_the_rule_of_decision(knowledge, rule, step_count):
    gentle = decided(knowledge, rule, step_count).prediction.control_probability[0, 0]
    assert gentle == pytest.approx(binom.sf(2, step_count, 0.1), abs=1e-12)


@pytest.fixture
def possible(knowledge: Knowledge) -> np.ndarray:
    """What a healthy wing shows at 3g."""
    return knowledge.sensor_model.mean[0, 1].copy()


@pytest.fixture
def impossible(possible: np.ndarray) -> np.ndarray:
    """The same, with a gauge that shows what no state can show."""
    observation = possible.copy()
    observation[4] += 1e200
    return observation


def test_an_impossible_observation_names_twin_step_and_sensors(knowledge, possible, impossible):
    """Also where the error was handed on by the worker of a fleet."""
    twin = knowledge.twin()
    twin.step(possible, 1)
    sentence = r"'paper_level_turns', step 1: .* sensor 5: \+8e\+203 sd"
    with pytest.raises(ImpossibleObservation, match=sentence) as caught:
        twin.step(impossible, 1)
    error = pickle.loads(pickle.dumps(caught.value))
    assert (str(error), error.twin, error.step) == (str(caught.value), "paper_level_turns", 1)
    assert next(iter(error.worst_residuals)) == "sensor 5"


def test_a_twin_goes_on_after_an_impossible_observation(knowledge, possible, impossible):
    twin = knowledge.twin()
    twin.step(possible, 1)
    with pytest.raises(ImpossibleObservation):
        twin.step(impossible, 1)
    assert twin.steps == 1
    twin.step(possible, 1)
    assert twin.smoothed().shape == (2, 25)


@pytest.fixture
def seen(knowledge: Knowledge) -> np.ndarray:
    """Forty steps (40, 24) of a wing that is getting worse, as 3g shows it."""
    noise = np.random.default_rng(1).standard_normal((40, 24))
    return knowledge.sensor_model.mean[np.arange(40) // 9 * 6, 1] + 150e-6 * noise


def told(step: TwinStep) -> tuple[object, ...]:
    """Return what two steps that are the same to the last bit have in common."""
    arrays = step.filtered.tobytes(), step.decision_probability.tobytes()
    return step.step, step.next_control, step.log_evidence, *arrays


@pytest.fixture
def observation_with_a_gap(seen):
    seen[17] = np.nan
    return seen


FORTY_CONTROLS = np.arange(40) % 3 % 2


def test_a_twin_smooths_over_its_lag(knowledge, observation_with_a_gap):
    """The smoother of a lag is that of the whole history: it needs no likelihood from before."""
    bounded = knowledge.twin(lag=5)
    unbounded = knowledge.twin()
    for count, (row, control) in enumerate(
        zip(observation_with_a_gap, FORTY_CONTROLS.tolist(), strict=True), start=1
    ):
        first = max(0, count - 6)
        step = unbounded.step(row, control)
        assert told(bounded.step(row, knowledge.model.controls[control])) == told(step)
        assert bounded.first_kept == first
        np.testing.assert_array_equal(bounded.smoothed(), unbounded.smoothed()[first:])


def test_a_twin_concludes_step_by_step_what_filter_and_smoother_find_in_the_whole(
    knowledge, observation_with_a_gap
):
    twin = knowledge.twin()
    steps = [
        twin.step(row, control)
        for row, control in zip(observation_with_a_gap, FORTY_CONTROLS.tolist(), strict=True)
    ]
    log_likelihood = knowledge.sensor_model.log_likelihood_sequence(observation_with_a_gap, FORTY_CONTROLS)
    whole = filter_sequence(knowledge.model, FORTY_CONTROLS, log_likelihood)
    smoothed = smooth(knowledge.model, FORTY_CONTROLS, whole.log_filtered)
    np.testing.assert_allclose([step.filtered for step in steps], whole.filtered, atol=1e-14)
    np.testing.assert_allclose([step.log_evidence for step in steps], whole.log_evidence, atol=1e-12)
    np.testing.assert_allclose(twin.smoothed(), smoothed, atol=1e-14)


def test_a_twin_begins_with_the_first_control_of_the_scenario(knowledge, observation_with_a_gap):
    assert knowledge.twin(lag=0).step(observation_with_a_gap[0]).control_index == 1


@pytest.fixture
def twin_of_ten_steps(knowledge: Knowledge, seen: np.ndarray) -> Twin:
    """A twin with a lag of four steps that has seen ten."""
    twin = knowledge.twin(lag=4)
    for row in seen[:10]:
        twin.step(row)
    return twin


@pytest.mark.parametrize("step", [4, 10, -1])
def test_of_steps_from_before_its_lag_nothing_can_be_revised(twin_of_ten_steps, seen, step):
    state = twin_of_ten_steps.save_state()
    with pytest.raises(IndexError, match=rf"step {step} .*from 5 on.*seen 10"):
        twin_of_ten_steps.revise(step, seen[0])
    assert twin_of_ten_steps.save_state() == state


def test_an_impossible_revision_leaves_a_twin_as_it_was(twin_of_ten_steps):
    state = twin_of_ten_steps.save_state()
    with pytest.raises(ImpossibleObservation):
        twin_of_ten_steps.revise(7, np.full(24, 1e300))
    assert twin_of_ten_steps.save_state() == state


def test_a_twin_is_kept_and_goes_on_to_the_last_bit(knowledge, twin_of_ten_steps, seen):
    twin, other = twin_of_ten_steps, knowledge.twin(lag=4)
    other.restore_state(twin.save_state())
    assert other.proposed_control == twin.proposed_control
    for row in seen[10:]:
        assert told(twin.step(row)) == told(other.step(row))
    assert other.save_state() == twin.save_state()


def test_a_revision_to_what_was_shown_already_changes_nothing(twin_of_ten_steps, seen):
    """The first step that is kept may be revised."""
    twin = twin_of_ten_steps
    for row in seen[10:]:
        last = twin.step(row)
    first = twin.first_kept
    assert told(twin.revise(first, seen[first])) == told(last)


def test_a_damaged_state_is_refused(knowledge, twin_of_ten_steps):
    state = twin_of_ten_steps.save_state()
    for damaged in (b"", state[:-7], arrays_to_bytes({"a": np.zeros(2)})):
        with pytest.raises(InvalidModelError):
            knowledge.twin(lag=4).restore_state(damaged)


class LikelihoodAlone:
    """A sensor model of a user's own: it has no residuals, only a likelihood."""

    def __init__(self, sensor_model: Any) -> None:
        self.sensor_model = sensor_model

    def log_likelihood(self, observation: Any, control_index: int, /) -> np.ndarray:
        likelihood: np.ndarray = self.sensor_model.log_likelihood(observation, control_index)
        return likelihood


class Counting(ExactFilter):
    """An estimator that learns: it carries the number of steps from step to step beside the belief."""

    def step(
        self, before: Carried | None, observation: np.ndarray, control_index: int, step: int
    ) -> Estimate:
        estimate = super().step(before, observation, control_index, step)
        count = 1.0 if before is None else float(before.arrays["count"]) + 1.0
        carried = Carried(control_index, {**estimate.carried.arrays, "count": np.array(count)})
        return replace(estimate, carried=carried, learnt={"count": Learnt(count, 0.0, count, count)})


@pytest.fixture
def own_twin(knowledge: Knowledge) -> Twin:
    """A twin with a policy, sensor model and estimator of a user's own; the policy is always gentle."""
    model = knowledge.model
    sensors = LikelihoodAlone(knowledge.sensor_model)
    gentle = np.eye(2)[np.zeros(25, dtype=int)]
    return Twin("own", model, sensors, lambda _: gentle, estimator=Counting(model, sensors), lag=3)


def test_own_policy_sensor_model_and_estimator_are_used(own_twin, knowledge, seen):
    plain = knowledge.twin()
    for number, row in enumerate(seen[:8], start=1):
        own_step, plain_step = own_twin.step(row, 1), plain.step(row, 1)
        np.testing.assert_array_equal(own_step.filtered, plain_step.filtered)
        assert own_step.next_control == 0
        assert own_step.learnt["count"].mean == number


def test_what_an_own_estimator_learns_is_revised(own_twin, seen):
    for row in seen[:8]:
        own_twin.step(row, 1)
    assert own_twin.revise(6, seen[6]).learnt["count"].mean == 8


def test_a_twin_of_an_own_sensor_model_predicts_and_refuses_what_is_impossible(own_twin, seen):
    step = own_twin.step(seen[0], 1)
    assert np.isfinite(own_twin.predict(step.filtered, "2g", 4).predicted).all()
    with pytest.raises(ImpossibleObservation):
        own_twin.step(np.full(24, 1e300))


@pytest.mark.parametrize(("control", "sentence"), [("4g", "no control is named '4g'"), (2, "from 0 to 1")])
def test_a_control_that_a_twin_does_not_have_is_refused(own_twin, seen, control, sentence):
    with pytest.raises(InvalidModelError, match=sentence):
        own_twin.step(seen[0], control)
