"""The control that tells the hypotheses of an ambiguous alarm apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_master.gauges.hypothesis_weights import HypothesisWeights
from twin_master.gauges.telling_control import PredictedReadings, separation_of_hypotheses
from uav_twin import ExactFilter, GaussianSensorModel, GraphicalModel, Twin, WatchfulEstimator

NOISE = np.array([2.0, 4.0])


def predicted(name: str, probability: float, *readings: tuple[float, float]) -> PredictedReadings:
    return PredictedReadings(name, probability, np.array(readings))


def test_the_separation_is_the_distance_of_the_readings_in_noise():
    hypotheses = [
        predicted("model", 0.6, (10.0, 0.0), (10.0, 0.0)),
        predicted("gauge 1 off", 0.4, (16.0, 0.0), (16.0, 16.0)),
    ]
    separation = separation_of_hypotheses(hypotheses, NOISE)
    assert separation is not None
    assert separation.names == ("model", "gauge 1 off")
    assert separation.by_control == pytest.approx([3.0, 5.0])


@given(st.floats(0.0, 0.0999))
def test_an_alarm_with_one_probable_hypothesis_needs_no_advice(probability):
    hypotheses = [
        predicted("gauge 1 off", 1.0 - probability, (1.0, 0.0)),
        predicted("none of these", probability, (2.0, 0.0)),
    ]
    assert separation_of_hypotheses(hypotheses, NOISE) is None


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
    assert "a step at hard tells" in sentence
    assert "apart best, if it is safe" in sentence


def test_a_fault_that_certainly_shows_is_not_hidden_after_a_change_of_control():
    """Pytest makes an error of a warning."""
    log_begin = np.log(np.array([1.0, 1.0, 0.5, 0.5]))
    weights = HypothesisWeights.initial(0.1, log_begin, control_index=0, control_count=2)
    weights.showing[:, 1] = 1.0
    newly_hidden = weights.change_control(0, 1)
    assert np.array_equal(weights.hidden, [-np.inf, -np.inf])
    assert np.array_equal(newly_hidden, [0.0, 0.0])
