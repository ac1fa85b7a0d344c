"""A twin keeps all arrays of few steps only; what depends on the others is the same to the last bit."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from twin_master.network.estimator import CHECKPOINT_STEPS, RECENT_STEPS
from twin_master.network.graphical_model import GraphicalModel, worsening_table
from uav_twin import ExactFilter, GaussianSensorModel, Twin, WatchfulEstimator

Float = NDArray[np.float64]
LAG = 50
STEPS = LAG + 2 * CHECKPOINT_STEPS
MODEL = GraphicalModel.from_tables({"z": [0, 1, 2]}, {"u": {"z": worsening_table(3, 0.02)}})
VALUES = np.random.default_rng(1).normal(10.0, 3.0, size=(2, 3, 1, 3))
SENSORS = GaussianSensorModel(VALUES, 1.0)
READINGS = VALUES[0, 0, 0] + np.random.default_rng(2).normal(size=(STEPS, 3))


class KeepsAll(WatchfulEstimator):
    """Notices as ever, but no step may be kept without its arrays."""

    for_smoothing = None  # type: ignore[assignment]


def new_twin(estimator: Callable[..., WatchfulEstimator] = WatchfulEstimator) -> Twin:
    watchful = estimator(ExactFilter(MODEL, SENSORS), SENSORS, np.array([1.0, 2.0]))
    return Twin("t", MODEL, SENSORS, np.ones((3, 1)), lag=LAG, estimator=watchful)


def flown(twin: Twin, readings: Float) -> Twin:
    for reading in readings:
        twin.step(reading)
    return twin


def size(twin: Twin) -> int:
    return sum(array.nbytes for carried in twin.carried for array in carried.arrays.values())


@pytest.mark.parametrize("late_by", [0, 1, RECENT_STEPS, CHECKPOINT_STEPS, LAG])
def test_a_late_observation_gives_the_twin_that_had_it_in_time(late_by):
    steps = LAG + CHECKPOINT_STEPS + 5
    step = steps - 1 - late_by
    in_time = READINGS[:steps].copy()
    in_time[step] += 2.0
    revised = flown(new_twin(), READINGS[:steps])
    revised.revise(step, in_time[step])
    expected = flown(new_twin(), in_time)
    np.testing.assert_array_equal(revised.smoothed(), expected.smoothed())
    assert revised.save_state() == expected.save_state()
    assert (
        flown(revised, READINGS[steps : steps + 5]).settled()
        == flown(expected, READINGS[steps : steps + 5]).settled()
    )


def test_a_twin_that_keeps_less_has_the_states_of_one_that_keeps_all():
    twin, keeps_all = new_twin(), new_twin(KeepsAll)
    for reading in READINGS:
        ours, theirs = twin.step(reading), keeps_all.step(reading)
        np.testing.assert_array_equal(ours.filtered, theirs.filtered)
    np.testing.assert_array_equal(twin.smoothed(), keeps_all.smoothed())
    assert (twin.settled(), twin.save_state()) == (keeps_all.settled(), keeps_all.save_state())
    assert size(twin) < 0.3 * size(keeps_all)


def test_a_restored_state_is_continued_by_another_estimator():
    """Steps that an earlier model has filtered are never filtered again by the next one."""
    before = flown(new_twin(KeepsAll), READINGS[: LAG + 5])
    other_values = GaussianSensorModel(VALUES * 1.01, 1.0)
    states = []
    for estimator in (WatchfulEstimator, KeepsAll):
        watchful = estimator(ExactFilter(MODEL, other_values), other_values, np.array([1.0, 2.0]))
        twin = Twin("t", MODEL, other_values, np.ones((3, 1)), lag=LAG, estimator=watchful)
        twin.restore_state(before.save_state())
        flown(twin, READINGS[LAG + 5 : LAG + 15])
        states.append((twin.settled(), twin.save_state()))
    assert states[0] == states[1]
