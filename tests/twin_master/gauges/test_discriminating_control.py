"""The control that tells the hypotheses of an ambiguous alarm apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from twin_master.gauges.discriminating_control import GaugeHypothesis, discriminating_controls
from twin_master.gauges.hypothesis_weights import HypothesisWeights
from twin_master.network.identified import InspectedSensorModel
from uav_twin import ExactFilter, GaussianSensorModel, GraphicalModel, Twin, WatchfulEstimator

ONE_STATE = np.ones(1)


def under_controls(*values: float) -> GaussianSensorModel:
    """Return a gauge with noise of one that shows a value under each control, in one state."""
    return GaussianSensorModel(np.array(values).reshape(1, 1, -1, 1), 1.0)


@pytest.mark.parametrize("probability", [0.5, 0.7])
def test_the_probability_to_tell_is_that_of_the_closed_form(probability):
    """The log ratio of two normal densities at a distance d is N(d^2 / 2, d^2) under the true one."""
    gain = 0.2
    hypotheses = [
        GaugeHypothesis("model", probability, ONE_STATE, np.ones(1)),
        GaugeHypothesis("gauge 1 off", 1.0 - probability, ONE_STATE, np.array([1.0 + gain])),
    ]
    values = np.array([2.0, 10.0, 18.0])
    telling = discriminating_controls(hypotheses, under_controls(*values))
    assert telling is not None
    assert telling.names == ("model", "gauge 1 off")
    distance = gain * values
    expected = sum(
        weight * norm.sf((np.log(19.0 * other / weight) - distance**2 / 2) / distance)
        for weight, other in ((probability, 1.0 - probability), (1.0 - probability, probability))
    )
    assert telling.steps == 1
    assert telling.by_control == pytest.approx(expected, abs=0.05)


def test_where_one_step_does_not_tell_ten_steps_are_tried():
    hypotheses = [
        GaugeHypothesis("model", 0.5, ONE_STATE, np.ones(1)),
        GaugeHypothesis("gauge 1 off", 0.5, ONE_STATE, np.array([1.1])),
    ]
    telling = discriminating_controls(hypotheses, under_controls(10.0))
    assert telling is not None
    distance = np.sqrt(10.0)
    assert telling.steps == 10
    expected = norm.sf((np.log(19.0) - distance**2 / 2) / distance)
    assert telling.by_control == pytest.approx([expected], abs=0.05)


def test_a_state_that_may_explain_the_gauge_makes_it_hard_to_tell():
    sensors = GaussianSensorModel(np.array([10.0, 12.0]).reshape(1, 2, 1, 1), 0.1)
    off = GaugeHypothesis("gauge 1 off", 0.5, np.array([1.0, 0.0]), np.array([1.2]))
    for belief, told in (([1.0, 0.0], 1.0), ([0.0, 1.0], 0.0)):
        model = GaugeHypothesis("model", 0.5, np.array(belief), np.ones(1))
        telling = discriminating_controls([model, off], sensors)
        assert telling is not None
        assert telling.by_control == pytest.approx([told])


def test_an_inspection_tells_what_no_gauge_can():
    """The second control asks for a reading of the state, which differs between the hypotheses."""
    sensors = InspectedSensorModel(
        np.array([10.0, 12.0]).reshape(1, 2, 1, 1).repeat(2, axis=2),
        0.1,
        expected_reading=np.array([[0.0], [0.4]]),
        reading_deviation=np.full((2, 1), 0.05),
        asked_by=np.array([1]),
    )
    hypotheses = [
        GaugeHypothesis("model", 0.5, np.array([0.0, 1.0]), np.ones(1)),
        GaugeHypothesis("gauge 1 off", 0.5, np.array([1.0, 0.0]), np.array([1.2])),
    ]
    telling = discriminating_controls(hypotheses, sensors)
    assert telling is not None
    assert telling.by_control == pytest.approx([0.0, 1.0])


@given(st.floats(0.0, 0.0999))
def test_an_alarm_with_one_probable_hypothesis_needs_no_advice(probability):
    hypotheses = [
        GaugeHypothesis("gauge 1 off", 1.0 - probability, ONE_STATE, np.array([1.2])),
        GaugeHypothesis("none of these", probability, ONE_STATE, np.array([1.4])),
    ]
    assert discriminating_controls(hypotheses, under_controls(1.0)) is None


def advice_of(shown: np.ndarray, gain: float) -> list[str]:
    """Return the advice of a twin whose second gauge of three has a wrong gain."""
    keep = [[0.95, 0.05], [0.0, 1.0]]
    model = GraphicalModel.from_tables(
        levels={"loss": (0.0, 0.3)}, tables={"soft": {"loss": keep}, "hard": {"loss": keep}}
    )
    sensors = GaussianSensorModel(shown[None], standard_deviation=0.1)
    estimator = WatchfulEstimator(ExactFilter(model, sensors), sensors, np.array([1.0]))
    twin = Twin("mine", model, sensors, np.full((2, 2), 0.5), estimator=estimator)
    noise = np.random.default_rng(1)
    notices = []
    for _ in range(30):
        reading = shown[0, 0] * [1.0, gain, 1.0] + noise.normal(0.0, 0.1, 3)
        notices += twin.step(reading, "soft").notices
    assert any(notice.kind == "alarm" for notice in notices)
    return [notice.sentence for notice in notices if notice.kind == "advice"]


def test_the_control_with_the_larger_readings_tells_a_wrong_gain():
    soft = np.array([[1.0, 2.0, 0.5], [1.3, 2.0, 0.8]])  # (S, G)
    (sentence,) = advice_of(np.stack([soft, 3.0 * soft], axis=1), 1.15)
    assert "10 steps under hard tell" in sentence
    assert "apart best, if it is safe: with a probability of " in sentence


def test_a_fault_that_certainly_shows_is_not_hidden_after_a_change_of_control():
    """Pytest makes an error of a warning."""
    log_begin = np.log(np.array([1.0, 1.0, 0.5, 0.5]))
    weights = HypothesisWeights.initial(0.1, log_begin, control_index=0, control_count=2)
    weights.showing[:, 1] = 1.0
    newly_hidden = weights.change_control(0, 1)
    assert np.array_equal(weights.hidden, [-np.inf, -np.inf])
    assert np.array_equal(newly_hidden, [0.0, 0.0])
