"""Single wrong readings: outliers of a record, and of what a model leaves."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import Channel, NoiseRecord, Quantity, TrialKind
from discrepancy.checks.outliers import mark_outliers, sample_outliers, wrong_end_readings
from tests.discrepancy.rigs import asked, campaign


@pytest.mark.parametrize(
    ("share", "rate", "noise", "digit"), [(0.8, 50.0, 0.001, 0.0), (1.0, 17.0, 0.003, 4.0)]
)
def test_sound_samples_of_records_with_gaps_or_few_digits_stay(share, rate, noise, digit):
    rng, counts = np.random.default_rng(3), np.zeros(3, dtype=int)
    for _ in range(10):
        time = np.sort(rng.permutation(1000)[: int(1000 * share)]) / rate
        values = np.exp(-0.4 * time) * np.cos(2.0 * np.pi * time) + noise * rng.normal(size=len(time))
        values = np.round(values / (digit * noise)) * digit * noise if digit else values
        spoilt, places = values.copy(), np.arange(20, len(time) - 20, 120)
        spoilt[places] += 40.0 * noise * rng.choice([-1.0, 1.0], len(places))
        records = {"a": values, "b": spoilt}.items()
        trials = (
            asked(TrialKind.RINGDOWN, time, name=name, channels=("x",), values=column[:, None])
            for name, column in records
        )
        sound, other = mark_outliers(campaign(*trials, x=Channel("x", Quantity.DISPLACEMENT, "x"))).trials
        counts += (~sound.used).sum(), (~other.used[places]).sum(), len(places)
    assert counts[0] <= 1
    assert counts[1] >= 0.65 * counts[2]


def _ring_with_two_wrong_readings(noise):
    """Return a campaign of a smooth ring in which two readings are 1e-3 off, and what is left out of it."""
    time = np.arange(1000) * 0.002
    values = np.cos(30.0 * time) + 1e-6 * np.random.default_rng(4).normal(size=1000)
    values[[300, 700]] += 1e-3
    trial = asked(TrialKind.RINGDOWN, time, channels=("x",), values=values[:, None])
    return campaign(trial, x=Channel("x", Quantity.DISPLACEMENT, "x", noise and NoiseRecord(noise)))


@pytest.mark.parametrize(("noise", "left_out"), [(None, 2), (1e-4, 2), (2.1e-4, 0), (2e-3, 0)])
def test_an_outlier_is_also_beyond_five_deviations_of_the_stated_noise(noise, left_out):
    (trial,) = mark_outliers(_ring_with_two_wrong_readings(noise)).trials
    assert np.count_nonzero(~trial.used) == left_out


def test_outliers_that_a_campaign_accepts_stay():
    (trial,) = mark_outliers(replace(_ring_with_two_wrong_readings(None), accept=("outliers",))).trials
    assert trial.used.all()


@pytest.mark.parametrize(("noise", "found"), [(0.0, [(0, 0)]), (3.0, [])])
def test_a_wrong_end_is_also_beyond_the_stated_noise(noise, found):
    residual = np.random.default_rng(1).standard_normal((200, 1))
    residual[0] += 20.0
    wrong = wrong_end_readings(residual, residual < 1e5, np.array([noise]))
    assert [tuple(place) for place in np.argwhere(wrong).tolist()] == found


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_friction_impacts_and_steps_are_no_outliers(noise):
    rng = np.random.default_rng(6)
    time = np.arange(1000) * 0.002
    w, friction = 10 * np.pi, 0.05
    # Coulomb friction in closed form: half cosines about an alternating centre until it stops.
    half = np.floor(time * w / np.pi)
    amplitude = np.maximum(1.0 - friction - 2.0 * friction * half, 0.0)
    sign = np.where(half % 2 == 0, 1.0, -1.0)
    free = sign * friction + amplitude * np.cos(w * time)
    stop = np.argmax(amplitude == 0.0) if (amplitude == 0.0).any() else len(time)
    displacement = np.where(np.arange(1000) < stop, free, free[min(stop, 999) - 1])
    records = {
        "friction": displacement,
        "velocity under friction": -amplitude * np.sin(w * time),
        "impacts": np.abs(np.cos(w / 2 * time)) * np.exp(-time),
        "step": np.cos(w * time) + (time > 0.7),
        "release at the middle": np.where(time > 0.5, np.cos(w * (time - 0.5)) * np.exp(-(time - 0.5)), 1.0),
    }
    for name, record in records.items():
        flagged = [int(sample_outliers(record + noise * rng.normal(size=1000)).sum()) for _ in range(10)]
        assert sum(flagged) <= 3, name


def test_rows_of_static_trials():
    def levels(count, spoilt=None, name="t", curve=0.0, shift=0.0, by=1e-3):
        load = np.arange(count, dtype=float)
        values = (
            1e-3 * load + curve * load**2 + 5e-6 * np.random.default_rng(count).normal(size=count) + shift
        )
        if spoilt is not None:
            values[spoilt] += by
        given = {"channels": ("x",), "values": values[:, None], "force": load, "run": "A"}
        return asked(TrialKind.STATIC, np.zeros(count), name=name, **given)

    pair = (levels(6, name="a"), levels(6, name="b"))
    for trials, noise, left_out in (
        ((levels(10, 4),), 5e-6, [[4]]),
        ((levels(10),), 5e-6, [[]]),
        ((levels(10, 9, by=9e-5),), 5e-6, [[9]]),  # at the end, where a parabola follows it
        ((levels(10, curve=1e-4),), 5e-6, [[]]),
        ((levels(10, 4),), None, [[]]),
        ((levels(6, 3),), 5e-6, [[]]),  # six rows alone cannot tell
        ((*pair, levels(6, 3, "c")), 5e-6, [[], [], [3]]),
        # A trial that is off in many rows is not a matter of single readings.
        ((*pair, levels(6, 3, "c", shift=1e-3)), 5e-6, [[], [], []]),
    ):
        channel = Channel("x", Quantity.DISPLACEMENT, "x", noise and NoiseRecord(noise, 100.0))
        marked = mark_outliers(campaign(*trials, x=channel))
        assert [np.flatnonzero(~trial.used[:, 0]).tolist() for trial in marked.trials] == left_out


# ---------------------------------------------------------------- beside what a model predicts


def ends(*columns):
    residual = np.stack(columns, axis=1)
    return [
        (int(row), int(column)) for row, column in np.argwhere(wrong_end_readings(residual, residual < 1e5))
    ]


@pytest.mark.parametrize("place", [0, 1, 2, 197, 198, 199])
def test_a_wrong_reading_is_found_at_the_ends(place):
    first, second = np.random.default_rng(1).standard_normal((2, 200))
    second[place] += 20.0
    assert ends(first, second) == [(place, 1)]
    # in several channels at once, or within the record, it is not a single reading at an end
    first[place] += 20.0
    assert ends(first, second) == []
    second[100] += 20.0
    assert ends(second) == [(place, 0)]
    second[100:] *= 30.0 if place < 100 else 1.0  # the roughness at its own end counts
    second[:100] *= 30.0 if place > 100 else 1.0
    assert ends(second) == [(place, 0)]


@pytest.mark.parametrize("seed", range(10))
def test_what_a_wrong_model_leaves_has_no_wrong_ends(seed):
    """Noise, waves of fast modes that decay, spikes of contact, steps; a record too short to judge."""
    generator = np.random.default_rng(seed)
    time = np.arange(1000) / 200.0
    wave = sum(
        generator.uniform(10.0, 60.0) * np.exp(-0.02 * 2.0 * np.pi * f * time)
        * np.cos(2.0 * np.pi * f * time + generator.uniform(0.0, 6.0))
        for f in (5.6, 20.0, 35.0, 60.0)
    )  # fmt: skip
    spikes = np.where(np.arange(1000) % 18 == 4, 30.0 * np.exp(-time), 0.0)
    step = np.where(time > 0.01, 40.0, 0.0)
    for signal in (wave, spikes, step):
        assert ends(signal + generator.standard_normal(1000)) == []
    for _ in range(5):
        noise = generator.standard_normal((3, 600))
        assert ends(*noise) == []
        assert sample_outliers(noise[0]).sum() <= 1
        assert not sample_outliers(noise[0, :5]).any()
    assert not sample_outliers(np.zeros(50)).any()
    assert ends(np.array([30.0, 0.1, -0.2, 0.1, 0.0, 0.2, -0.1])) == []
