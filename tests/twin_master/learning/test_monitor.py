"""What is noticed, against direct sums, an exact bound on false alarms, and faults that are put in."""

import numpy as np
import pytest
from numpy.typing import NDArray

from twin_master.learning.monitor import MonitorSettings, WatchfulEstimator
from twin_master.mission.preparation import Knowledge, prepare_twin
from twin_master.network.estimator import Carried, Estimate, ExactFilter
from twin_master.network.graphical_model import GraphicalModel, worsening_table
from twin_master.network.sensor_model import GaussianSensorModel

Float = NDArray[np.float64]

SETTINGS = MonitorSettings()


def small(gauges: int = 3) -> tuple[GraphicalModel, GaussianSensorModel, Float]:
    model = GraphicalModel.from_tables({"z": [0, 1, 2]}, {"u": {"z": worsening_table(3, 0.2)}})
    value = np.random.default_rng(1).normal(10.0, 3.0, size=(2, 3, 1, gauges))
    return model, GaussianSensorModel(value, 1.0), np.array([1.0, 2.0])


def run(watchful: WatchfulEstimator, seen: Float) -> list[Estimate]:
    estimates: list[Estimate] = []
    before: Carried | None = None
    for turn, row in enumerate(seen):
        estimates.append(watchful.turn(before, row, 0, turn))
        before = estimates[-1].carried
    return estimates


def drawn(
    random: np.random.Generator, sensors: GaussianSensorModel, model: GraphicalModel, turns: int
) -> Float:
    """Return observations of the model itself, with noise scales drawn from their prior."""
    scale = np.sqrt(0.5 * SETTINGS.noise_degrees / random.gamma(0.5 * SETTINGS.noise_degrees, size=3))
    draw, state, rows = random.integers(2), 0, []
    for _ in range(turns):
        rows.append(sensors.value_per_draw[draw, state, 0] + scale * random.normal(size=3))
        state = random.choice(3, p=model.transition.matrix[0, state])
    return np.array(rows)


def test_the_belief_is_that_of_the_filter_to_the_last_bit() -> None:
    model, sensors, draws = small()
    inner = ExactFilter(model, sensors)
    seen = drawn(np.random.default_rng(3), sensors, model, 12)
    watched = run(WatchfulEstimator(inner, sensors, draws, SETTINGS), seen)
    before: Carried | None = None
    for turn, row in enumerate(seen):
        plain = inner.turn(before, row, 0, turn)
        before = plain.carried
        np.testing.assert_array_equal(watched[turn].filtered, plain.filtered)
    carried = [estimate.carried for estimate in watched]
    np.testing.assert_array_equal(
        WatchfulEstimator(inner, sensors, draws, SETTINGS).smoothed(carried), inner.smoothed(carried)
    )


def test_the_first_e_value_is_the_ratio_of_two_sums_over_states_and_draws() -> None:
    from scipy.stats import t as student

    model, sensors, draws = small()
    row = sensors.value_per_draw[0, 0, 0] * [1.0, 1.3, 1.0]
    arrays = run(WatchfulEstimator(ExactFilter(model, sensors), sensors, draws, SETTINGS), row[None])[0]
    evidence = np.zeros(5)
    for draw in range(2):  # the first state is certain
        value = sensors.value_per_draw[draw, 0, 0]
        narrow = student.pdf(row, SETTINGS.noise_degrees, value)
        free = [
            student.pdf(row, SETTINGS.noise_degrees, value, np.sqrt(1.0 + (gain * value) ** 2))
            for gain in (SETTINGS.gain, SETTINGS.all_gain)
        ]
        evidence[0] += narrow.prod()
        evidence[1:4] += narrow.prod() / narrow * free[0]
        evidence[4] += free[1].prod()
    found = arrays.carried.arrays["notice/always"]
    np.testing.assert_allclose(found, np.log(evidence[1:] / evidence[0]), rtol=1e-10)


def test_the_mean_of_the_e_values_is_one_at_every_turn_where_the_model_holds() -> None:
    """The first turn exactly so; later the sums of the noise are expected ones, which costs little."""
    model, sensors, draws = small()
    watchful = WatchfulEstimator(ExactFilter(model, sensors), sensors, draws, SETTINGS)
    random = np.random.default_rng(5)
    largest = []
    for _ in range(150):
        estimates = run(watchful, drawn(random, sensors, model, 15))
        logs = [watchful._log_evidence(_own(estimate)) for estimate in estimates]
        largest.append([[np.logaddexp.reduce(gauge), none] for gauge, none in logs])
    values = np.exp(np.array(largest))  # (missions, turns, 2)
    assert np.all(values.mean(axis=0) < 1.6)
    assert np.mean(values.max(axis=1) >= 20.0) <= 0.06  # Ville: at most 0.05


def _own(estimate: Estimate) -> dict[str, Float]:
    arrays = estimate.carried.arrays
    return {
        name.removeprefix("notice/"): value for name, value in arrays.items() if name.startswith("notice/")
    }


@pytest.fixture(scope="module")
def wing() -> Knowledge:
    return prepare_twin("level_turns")


def fly(
    wing: Knowledge, turns: int, spoil: dict[int, float], begin: int = 0, state: int = 0
) -> list[Estimate]:
    """Return 3g turns of the wing with gauges whose gain is off from a turn on."""
    watchful = WatchfulEstimator(wing.twin().estimator, wing.sensor_model, wing.draws.values, SETTINGS)
    random, before, estimates = np.random.default_rng(1), None, []
    for turn in range(turns):
        shown = wing.sensor_model.mean[state, 1].copy()
        if turn >= begin:
            for gauge, gain in spoil.items():
                shown[gauge - 1] *= 1.0 + gain
        seen = shown + 150e-6 * random.normal(size=24)
        estimates.append(watchful.turn(before, seen, 1, turn))
        before = estimates[-1].carried
    return estimates


@pytest.mark.parametrize(("gauge", "gain", "begin"), [(5, 0.2, 0), (17, -0.2, 0), (10, 0.2, 25)])
def test_a_gauge_that_is_off_is_named(wing: Knowledge, gauge: int, gain: float, begin: int) -> None:
    estimates = fly(wing, begin + 20, {gauge: gain}, begin)
    alarms = [notice for estimate in estimates for notice in estimate.notices if len(notice.sensors) == 1]
    assert alarms[0].sensors == (gauge,)
    assert alarms[0].kind == "alarm"
    assert f"gauge {gauge} does not show" in alarms[0].sentence
    assert alarms[0].sentence.endswith("uav-twin discrepancy run --from-run DIR")
    assert not any(estimate.notices for estimate in estimates[:begin])
    assert estimates[-1].learnt["gauge_off"].mean > 0.5


def test_what_no_state_explains_is_not_taken_for_a_gauge(wing: Knowledge) -> None:
    """Several gauges about a place show more: as where a third region softens."""
    estimates = fly(wing, 20, {9: 0.15, 10: 0.25, 11: 0.25, 12: 0.15, 22: 0.2})
    assert estimates[-1].learnt["none_of_these"].mean > 0.9
    sentences = [notice.sentence for estimate in estimates for notice in estimate.notices]
    assert any("no state of the model explains" in sentence for sentence in sentences)


def test_a_healthy_wing_raises_no_alarm(wing: Knowledge) -> None:
    estimates = fly(wing, 60, {})
    assert not any(estimate.notices for estimate in estimates)
    assert estimates[-1].learnt["none_of_these"].mean < 0.05


def test_an_absurd_gauge_is_left_out_with_a_word(wing: Knowledge) -> None:
    watchful = WatchfulEstimator(wing.twin().estimator, wing.sensor_model, wing.draws.values, SETTINGS)
    random, before, estimates = np.random.default_rng(1), None, []
    for turn in range(12):
        seen = wing.sensor_model.mean[0, 1] + 150e-6 * random.normal(size=24)
        if 3 <= turn < 10:
            seen[11] += 1e8 * (turn - 2)  # 1e14 microstrain a turn
        estimates.append(watchful.turn(before, seen, 1, turn))
        before = estimates[-1].carried
    assert [(turn, n.kind) for turn, e in enumerate(estimates) for n in e.notices] == [
        (3, "gauge_left_out"), (10, "gauge_back"),
    ]  # fmt: skip
    assert estimates[-1].filtered[0] > 0.3  # today's twin: 80 % damage, with certainty
