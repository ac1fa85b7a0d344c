"""Sensors that freeze, and what rests, sticks or is slow and is not held."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from discrepancy.campaign.sampling import quantum_of
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.held import stuck_spans
from discrepancy.checks.quality import check_data, clipped_run
from tests.discrepancy.data.rings import TIME, campaign_of, only


@pytest.mark.parametrize(
    ("digit", "start", "stop"),
    [(1e-6, 310, 410), (0.1, 310, 410), (1e-6, 777, 877), (0.1, 777, 877), (1e-6, 1000, 1600)],
)
def test_a_sensor_that_freezes_while_another_goes_on(digit, start, stop):
    def freeze(values):
        values[start:stop, 0] = values[start, 0]

    fault = only(check_data(campaign_of(freeze, digit=digit, trials=1)), FaultKind.FROZEN)
    assert (fault.channel, fault.trial, fault.fatal) == ("x", "ring 0", True)
    assert "'x [mm]' of 0.csv" in fault.sentence
    assert f"{TIME[start]:.6g} to {TIME[stop - 1]:.6g} s" in fault.sentence


def _backlash(motion, gap):
    seen = motion.copy()
    for k in range(1, len(seen)):
        seen[k] = min(max(seen[k - 1], motion[k] - gap), motion[k] + gap)
    return seen


def _sound(digit, pace, generator):
    """Return records that stand still at times, each for a reason of its own."""
    wave = np.sin(2.0 * np.pi * pace * TIME + 0.7)
    ring = np.exp(-0.5 * pace * TIME) * wave
    square = np.sign(wave)
    pause = np.interp(TIME, [0.0, 1.0, 1.0 + 1 / pace, 2.0 + 1 / pace, 2.0 + 2 / pace], [0, 0, 1, 1, 0])
    found = {
        "ring": ring,
        "noisy ring": ring + 0.5 * digit * generator.standard_normal(len(TIME)),
        "warming": 5.0 * (1.0 - np.exp(-TIME * pace)),
        "day": 3.0 * np.sin(0.3 * pace * TIME),
        "rest": 0.4 * digit * generator.standard_normal(len(TIME)),
        "square": square,
        "filtered square": lfilter([0.05], [1.0, -0.95], square),
        "telegraph": np.repeat(generator.choice([-1.0, 1.0], 40), 40),
        "stairs": np.repeat(generator.standard_normal(40), 40),
        "pauses": pause,
        "backlash": _backlash(wave, 0.3),
        "dead zone": np.sign(ring) * np.maximum(np.abs(ring) - 0.2, 0.0),
        "bursts": np.where(TIME % 4.0 < 1.0, wave, 0.0),
        "contact": np.maximum(wave - 0.9, 0.0),
    }
    return {name: np.round(values / digit) * digit for name, values in found.items()}


@pytest.mark.parametrize("digit", [1e-3, 0.02, 0.2])
@pytest.mark.parametrize("pace", [0.4, 1.3, 6.0])
def test_what_rests_is_not_frozen(digit, pace):
    """Where encoders show no noise, what the others do meanwhile tells a pause from a fault."""
    used = np.ones(len(TIME), dtype=bool)
    other = np.cos(5.0 * TIME)[:, np.newaxis]
    for name, values in _sound(digit, pace, np.random.default_rng(2)).items():
        assert stuck_spans(values, used, np.zeros((len(TIME), 0))) == [], name
        if name in ("ring", "warming", "day", "backlash", "dead zone"):
            assert stuck_spans(values, used, other) == [], name
    clock = np.interp(TIME, [0.0, 3.0, 4.0, 8.0], [0.0, 3.0, 3.0, 7.0])
    motion = clock + 0.1 * clock**2
    for beside, spans in ((np.round(motion, 2), []), (np.round(np.sin(3.0 * TIME), 3), [(600, 801)])):
        assert stuck_spans(np.round(motion, 3), used, beside[:, np.newaxis]) == spans


STEP = 2.0 * np.pi / 1024.0
"""Of an encoder of ten bits [rad]."""


def _swing_with_friction(interval=0.002, seconds=8.0):
    """Return angles [rad] of a pendulum under dry friction, which sticks for a moment where it turns."""
    steps_of_each, angle, speed = 10, 0.6, 0.0
    step, angles = interval / steps_of_each, []
    for _ in range(round(seconds / interval)):
        angles.append(angle)
        for _ in range(steps_of_each):
            pull = -40.0 * np.sin(angle) - 0.05 * speed
            if speed == 0.0 and abs(pull) <= 0.35:
                continue
            friction = 0.35 * np.sign(speed or pull)
            next_speed = speed + step * (pull - friction)
            speed = 0.0 if next_speed * speed < 0.0 else next_speed
            angle += step * speed
    return np.array(angles)


@pytest.mark.parametrize("noise", [0.0, STEP / 3.0, STEP])
def test_an_encoder_that_sticks_at_the_end_of_a_swing_is_not_held(noise):
    """Printed with six decimals: its steps differ by the last of them."""
    angles = np.round(np.round(_swing_with_friction() / STEP) * STEP, 6)
    other = np.cos(5.0 * np.arange(len(angles)))[:, np.newaxis]
    assert stuck_spans(angles, np.ones(len(angles), bool), other, noise) == []


@pytest.mark.parametrize("noise", [0.0, STEP / 3.0, STEP])
def test_encoder_steps_that_were_resampled_by_straight_lines_are_not_held(noise):
    time = np.arange(0.0, 4.0, 0.0013)
    steps = np.round(0.5 * np.exp(-0.3 * time) * np.cos(6.0 * time) / STEP) * STEP
    resampled = np.round(np.interp(np.arange(0.0, 3.99, 0.001), time, steps), 6)
    other = np.cos(5.0 * np.arange(len(resampled)))[:, np.newaxis]
    assert stuck_spans(resampled, np.ones(len(resampled), bool), other, noise) == []


def _logged_faster_than_updated(updates=400, samples_of_each=10):
    readings = np.sin(0.07 * np.arange(updates)) + 0.02 * np.random.default_rng(1).standard_normal(updates)
    return np.round(np.repeat(readings, samples_of_each), 4)


def test_a_sensor_that_is_slower_than_its_logger_is_neither_held_nor_clipped():
    values = _logged_faster_than_updated()
    assert stuck_spans(values, np.ones(len(values), bool), np.zeros((len(values), 0)), 0.02) == []
    assert clipped_run(values, values.max()) == 0


def test_a_sensor_that_is_slower_than_its_logger_can_be_held():
    values = _logged_faster_than_updated()
    values[1000:1100] = values[1000]
    assert stuck_spans(values, np.ones(len(values), bool), np.zeros((len(values), 0)), 0.02) == [(1000, 1100)]


@pytest.mark.parametrize(
    ("values", "quantum"),
    [
        ([0.0, 1.0, 2.0, 3.0, 3.0, 3.0], 1.0),
        (np.round(np.repeat(np.arange(20), 2) * STEP, 6), STEP),
        (np.round(np.arange(0, 60, 3) * STEP, 6), 3.0 * STEP),
        (np.zeros(9), 0.0),
    ],
)
def test_the_quantum_of_a_sensor_is_what_its_readings_repeat(values, quantum):
    assert quantum_of(np.array(values)) == pytest.approx(quantum, abs=2e-6)


@pytest.mark.parametrize("place", ["top", "channel", "trial"])
def test_a_campaign_accepts_readings_that_look_held(place):
    def freeze(values):
        values[310:410, 0] = values[310, 0]

    campaign = campaign_of(freeze, trials=1)
    fault = only(check_data(campaign), FaultKind.FROZEN)
    assert fault.sentence.endswith(
        """if the data are right, set accept = ["held"] in the [[trial]] 'ring 0' or the [[channel]] 'x'."""
    )
    if place == "top":
        campaign = replace(campaign, accept=("held",))
    if place == "channel":
        accepting = replace(campaign.channels["x"], accept=("held",))
        campaign = replace(campaign, channels={**campaign.channels, "x": accepting})
    if place == "trial":
        campaign = replace(campaign, trials=(replace(campaign.trials[0], accept=("held",)),))
    fault = only(check_data(campaign), FaultKind.FROZEN)
    assert (fault.accepted, fault.fatal) == (True, False)
    assert fault.sentence.startswith("Accepted by the campaign (held): The channel 'x' holds one value")
