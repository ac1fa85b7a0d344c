"""A gauge that repeats its reading under known noise is stuck, and is believed again when it moves."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.stats import norm

from tests.twin_master.runs import changed_scenario, of_wing
from twin_master.gauges.stuck_gauges import StandstillTest, StuckGauges
from twin_master.mission.flights import fly
from twin_master.mission.steps import History
from twin_master.scenario.tables import Noticing

Float = NDArray[np.float64]

GAUGES = 24
STEPS = 40
STUCK_FROM = 10
STUCK_GAUGE = 16
"""Index of gauge 17, which is strained most."""


def stuck_steps(readings: Float) -> NDArray[np.bool_]:
    """Return in which steps each gauge is found to be stuck (T, G), given readings (T, G) of noise one."""
    test = StandstillTest.of(np.ones(readings.shape[1]), Noticing())
    gauges = StuckGauges.initial(1, readings.shape[1])
    rows = []
    for step, row in enumerate(readings):
        gauges = test.update(gauges, row[None], np.array([float(step)]), np.array([0.01]))
        rows.append(gauges.is_stuck[0] > 0.0)
    return np.array(rows)


@pytest.fixture
def noisy_readings() -> Float:
    return np.random.default_rng(1).normal(size=(STEPS, GAUGES))


def test_the_first_repeat_has_the_odds_of_two_readings_that_agree_by_chance():
    settings = Noticing()
    width = settings.still_deviations
    by_chance, _ = quad(lambda x: norm.pdf(x) * (norm.cdf(x + width) - norm.cdf(x - width)), -8.0, 8.0)
    test = StandstillTest.of(np.ones(1000), settings)
    moved = np.arange(1000.0)
    first = test.update(StuckGauges.initial(1, 1000), moved[None], np.zeros(1), np.full(1, 1e-30))
    readings = np.where(moved < 1.0, moved, moved + 1.0)  # all but the first gauge move

    second = test.update(first, readings[None], np.ones(1), np.full(1, 1e-30))

    odds = np.exp(second.log_evidence[0, 0] - first.log_evidence[0, 0])
    assert odds == pytest.approx(1.0 / by_chance, rel=0.01)  # one pair of a thousand does not move


@pytest.mark.parametrize("stuck_from", [1, 5, STUCK_FROM, 35])
def test_a_gauge_that_stands_still_is_found_in_four_steps(noisy_readings, stuck_from):
    noisy_readings[stuck_from:, 3] = noisy_readings[stuck_from - 1, 3]

    is_stuck = stuck_steps(noisy_readings)

    assert np.flatnonzero(is_stuck[:, 3])[0] <= stuck_from + 3
    assert not is_stuck[:, np.arange(GAUGES) != 3].any()


def test_a_gauge_that_flickers_within_the_resolution_of_its_logger_is_found(noisy_readings):
    flicker = 0.0008 * (np.arange(STEPS - STUCK_FROM) % 2)
    noisy_readings[STUCK_FROM:, 3] = noisy_readings[STUCK_FROM - 1, 3] + flicker

    assert stuck_steps(noisy_readings)[STUCK_FROM + 3 :, 3].all()


def test_a_stuck_gauge_without_readings_stays_stuck(noisy_readings):
    noisy_readings[STUCK_FROM:, 3] = noisy_readings[STUCK_FROM - 1, 3]
    noisy_readings[20:25, 3] = np.nan

    assert stuck_steps(noisy_readings)[STUCK_FROM + 3 :, 3].all()


def test_a_gauge_that_moves_again_is_right_at_once_and_may_become_stuck_again(noisy_readings):
    for first, last in ((10, 20), (30, 40)):
        noisy_readings[first:last, 3] = noisy_readings[first - 1, 3]

    is_stuck = stuck_steps(noisy_readings)[:, 3]

    assert is_stuck[13:20].all()
    assert not is_stuck[20:30].any()
    assert is_stuck[37:].all()


def test_a_logger_that_repeats_whole_rows_is_found(noisy_readings):
    """Later than a single gauge: the noise of all may have ended."""
    noisy_readings[STUCK_FROM:] = noisy_readings[STUCK_FROM - 1]

    assert stuck_steps(noisy_readings)[STUCK_FROM + 12 :].all()


def test_where_no_reading_has_ever_moved_no_gauge_is_stuck():
    """Readings without noise, as a simulation gives them."""
    readings = np.where(np.arange(STEPS)[:, None] < 20, 1.0, 2.0) * np.ones(GAUGES)

    assert not stuck_steps(readings).any()


def test_a_slow_channel_is_mistaken_a_few_times_and_then_known(noisy_readings):
    """One that is sampled in every tenth step, beside gauges that are sampled in each."""
    readings = np.tile(noisy_readings, (10, 1)) + np.arange(10.0).repeat(STEPS)[:, None]
    readings[:, 3] = np.repeat(np.random.default_rng(2).normal(size=STEPS), 10)

    is_stuck = stuck_steps(readings)[:, 3]

    assert not is_stuck[80:].any()


def test_a_coarse_logger_is_seldom_mistaken():
    """Its digits are half the noise: one reading in seven repeats the one before."""
    random = np.random.default_rng(3)
    mistaken = 0
    for _ in range(20):
        readings = np.round(random.normal(size=(STEPS, GAUGES)) / 0.5) * 0.5
        mistaken += stuck_steps(readings).any(axis=0).sum()
    assert mistaken / (20 * GAUGES) < 0.02


def fly_with_fault(kind: str, seed: int, last_step: int) -> History:
    """Return a flight of level_turns in which gauge 17 has a fault from step 10 on."""
    fault = {
        "kind": kind,
        "sensors": [STUCK_GAUGE + 1],
        "first_step": STUCK_FROM,
        "last_step": last_step,
    }
    changes = {"truth": {"sensor_faults": [fault]}, "notice": {}}
    loaded = changed_scenario("level_turns", changes)
    knowledge, source = of_wing(loaded.scenario)
    plant = knowledge.plant(knowledge.truth(seed), source.open())
    return fly(knowledge.scenario, knowledge.twin(), plant)


@pytest.fixture(scope="module", params=range(3))
def stuck_flight(request: pytest.FixtureRequest) -> History:
    return fly_with_fault("stuck", request.param, 29)


def test_a_stuck_gauge_is_named_and_believed_again_in_flight(stuck_flight):
    (found_in, left_out), (back_in, back) = stuck_flight.notices
    assert (left_out.kind, back.kind) == ("gauge_left_out", "gauge_back")
    assert left_out.sensors == back.sensors == (STUCK_GAUGE + 1,)
    assert found_in <= STUCK_FROM + 3
    assert back_in == 30


def test_the_notice_says_since_when_the_gauge_is_stuck(stuck_flight):
    _, notice = stuck_flight.notices[0]
    reading = 1e6 * stuck_flight.observed[STUCK_FROM - 1, STUCK_GAUGE]
    assert f"gauge 17 is stuck: since step 10 it shows {reading:.4g} microstrain" in notice.sentence
    assert notice.since == STUCK_FROM
