"""Faults of data: what is found, where, and what must not be mistaken for one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers, sample_outliers, wrong_ends
from discrepancy.checks.quality import check_data
from discrepancy.sources.examples import ExamplePlan, example_campaign
from fe.runtime.patch import HighPass, ModelPatch, SensorDrift, SensorGain

PLAN = ExamplePlan(
    (
        Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(5e-5, 200.0), 0.0, 1e-4),
        Channel("g0", Quantity.STRAIN, "strain[0]", NoiseRecord(2e-6, 200.0), 0.005, 2e-6),
        Channel("g1", Quantity.STRAIN, "strain[1]", NoiseRecord(1e-6, 200.0), 0.005, 1e-6),
        Channel("g2", Quantity.STRAIN, "strain[2]", NoiseRecord(5e-7, 200.0), 0.005, 1e-6),
    ),
    force=20.0,
    release=0.05,
    interval=0.005,
)


@pytest.fixture(scope="module")
def campaign(oscillator) -> Campaign:
    return example_campaign(oscillator, "complete", 7, PLAN)


def changed(campaign: Campaign, change: Callable[[Trial, np.ndarray], None], **only: object) -> Campaign:
    """Return the campaign with the readings of trials changed in place, of those that match `only`."""
    trials = []
    for trial in campaign.trials:
        values = trial.values.copy()
        if all(getattr(trial, key) == value for key, value in only.items()):
            change(trial, values)
        trials.append(replace(trial, values=values))
    return replace(campaign, trials=tuple(trials))


def scaled(campaign: Campaign, name: str, factor: float, **only: object) -> Campaign:
    def change(trial: Trial, values: np.ndarray) -> None:
        values[:, trial.channels.index(name)] *= factor

    return changed(campaign, change, **only)


def of_kind(campaign: Campaign, kind: TrialKind) -> Campaign:
    return replace(campaign, trials=tuple(trial for trial in campaign.trials if trial.kind is kind))


def found(faults) -> set[tuple[FaultKind, str]]:
    for fault in faults:
        assert fault.sentence.endswith(".")
        assert "\n" not in fault.sentence
    return {(fault.kind, fault.channel) for fault in faults}


@pytest.mark.parametrize("seed", range(5))
def test_sound_data_have_no_fault(oscillator, seed: int) -> None:
    for patch in (
        ModelPatch(),
        ModelPatch((SensorGain("g0", 0.15), SensorDrift("g1", 2e-5, 5000.0))),
        ModelPatch((SensorGain("*", -0.2, "strain"), HighPass("x", 2.0))),
    ):
        campaign = example_campaign(oscillator, "complete", seed, PLAN, patch)
        assert campaign.channels["g0"].noise.degrees_of_freedom == 399
        assert check_data(campaign) == ()
        assert check_against_model(campaign, oscillator) == ()
        marked = mark_outliers(campaign)
        assert all(trial.used.mean() > 0.999 for trial in marked.trials)


# ---------------------------------------------------------------- units, signs, exchanged channels


@pytest.mark.parametrize(
    ("name", "factor", "guess"),
    [
        ("g0", 1e6, "microstrain given as strain"),
        ("g1", 1e-6, "strain given as microstrain"),
        ("g0", 100.0, "percent given as strain"),
        ("x", 1e3, "mm given as m"),
        ("x", 1e-3, "m given as mm"),
        ("x", 100.0, "100 times"),
        ("x", 0.8e6, "1e\\+06 times"),
        ("g0", -1e6, "microstrain"),
    ],
)
def test_unit_slips(oscillator, campaign, name: str, factor: float, guess: str) -> None:
    slipped = scaled(campaign, name, factor)
    noise = replace(
        slipped.channels[name].noise,
        standard_deviation=slipped.channels[name].noise.standard_deviation * abs(factor),
    )
    # The noise record slips with the channel, or stays in the right unit.
    for record in (noise, slipped.channels[name].noise):
        if abs(factor) < 1.0 and record is not noise:
            continue  # what is left is below the noise then, and says nothing
        channels = {**slipped.channels, name: replace(slipped.channels[name], noise=record)}
        faults = check_against_model(replace(slipped, channels=channels), oscillator)
        assert (FaultKind.UNIT_SLIP, name) in found(faults)
        assert {fault.channel for fault in faults} == {name}
        assert re.search(guess, " ".join(fault.sentence for fault in faults if fault.fatal))


@pytest.mark.parametrize("factor", [0.7, 1.4, 3.0, 5.0, 9.80665, 30.0])
def test_other_factors_are_no_unit_slips(oscillator, campaign, factor: float) -> None:
    """Strain that is 9.81 times too large is no strain in g, and beside ring-downs alone no fault at all."""
    faults = found(check_against_model(scaled(campaign, "g0", factor), oscillator))
    assert FaultKind.UNIT_SLIP not in {kind for kind, _ in faults}
    if factor == 9.80665:
        released = scaled(of_kind(campaign, TrialKind.RINGDOWN), "g0", factor)
        assert not found(check_against_model(released, oscillator))


def test_input_slips(oscillator, campaign) -> None:
    def kilo(trial: Trial) -> Trial:
        return replace(trial, force=trial.force * 1e-3)

    one = replace(campaign, trials=tuple(kilo(t) if t.name == "loading" else t for t in campaign.trials))
    (fault,) = check_against_model(one, oscillator)
    assert (fault.kind, fault.trial) == (FaultKind.INPUT_SLIP, "loading")
    assert "about 1000 times" in fault.sentence
    loads = of_kind(campaign, TrialKind.STATIC)
    static = replace(loads, trials=tuple(map(kilo, loads.trials)))
    (fault,) = check_against_model(static, oscillator)
    assert fault.kind is FaultKind.INPUT_SLIP
    assert "check the units of forces" in fault.sentence


def test_slip_of_a_release(oscillator, campaign) -> None:
    def in_millimetres(trial: Trial) -> Trial:
        if trial.release is None:
            return trial
        return replace(trial, release=replace(trial.release, displacement=1e3 * trial.release.displacement))

    faults = check_against_model(
        replace(campaign, trials=tuple(map(in_millimetres, campaign.trials))), oscillator
    )
    assert {fault.kind for fault in faults} == {FaultKind.INPUT_SLIP}
    assert {fault.trial for fault in faults} == {f"release {number}" for number in range(1, 5)}
    assert all("about 0.001 times" in fault.sentence for fault in faults)


def test_signs(oscillator, campaign) -> None:
    assert found(check_against_model(scaled(campaign, "g1", -1.0), oscillator)) == {(FaultKind.SIGN, "g1")}
    static = of_kind(campaign, TrialKind.STATIC)
    turned = replace(static, trials=tuple(replace(t, force=-t.force) for t in static.trials))
    (fault,) = check_against_model(turned, oscillator)
    assert "sign of the forces" in fault.sentence


def test_readings_that_fall_with_the_load_and_keep_its_sign_are_not_reversed(oscillator, campaign) -> None:
    """A temperature that falls while the load factor rises turns the slope, not the readings."""

    def cool(trial: Trial, values: np.ndarray) -> None:
        column = trial.channels.index("g1")
        values[:, column] = 2.0 * np.sum(values[[0, -1], column]) - values[:, column]

    flight = of_kind(campaign, TrialKind.FLIGHT)
    assert not found(check_against_model(changed(flight, cool), oscillator))
    assert found(check_against_model(scaled(flight, "g1", -1.0), oscillator)) == {(FaultKind.SIGN, "g1")}


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FLIGHT, None])
@pytest.mark.parametrize("pair", [("g0", "g1"), ("g1", "g2")])
def test_swapped_channels(oscillator, campaign, kind: TrialKind | None, pair: tuple[str, str]) -> None:
    if kind is not None:
        campaign = of_kind(campaign, kind)

    def swap(trial: Trial, values: np.ndarray) -> None:
        columns = [trial.channels.index(name) for name in pair]
        values[:, columns] = values[:, columns[::-1]]

    faults = check_against_model(changed(campaign, swap), oscillator)
    kinds = {fault.kind for fault in faults}
    assert FaultKind.SWAPPED in kinds
    assert all(name in next(f for f in faults if f.kind is FaultKind.SWAPPED).sentence for name in pair)


def test_outputs_and_lengths(oscillator, campaign) -> None:
    def with_output(output: str, quantity: Quantity = Quantity.STRAIN) -> Campaign:
        channel = replace(campaign.channels["g0"], output=output, quantity=quantity)
        return replace(campaign, channels={**campaign.channels, "g0": channel})

    for output, kind in (("strain[9]", FaultKind.MISSING_OUTPUT), ("x", FaultKind.WRONG_QUANTITY)):
        assert found(check_against_model(with_output(output), oscillator)) == {(kind, "g0")}
    release = next(trial for trial in campaign.trials if trial.kind is TrialKind.RINGDOWN)

    def cut(count: int, step: int = 1) -> Campaign:
        rows = np.arange(len(release.time)) % step == 0
        rows[count:] = False
        return replace(campaign, trials=(release.rows(rows),))

    assert (FaultKind.TOO_SHORT, "") in found(check_against_model(cut(100), oscillator))
    assert found(check_against_model(cut(401), oscillator)) == set()
    assert (FaultKind.UNDERSAMPLED, "") in found(check_against_model(cut(401, 16), oscillator))
    slow = [fault.sentence for fault in check_against_model(cut(401, 16), oscillator)]
    assert not any("milliseconds" in sentence for sentence in slow)
    whole = cut(401)
    (trial,) = whole.trials
    in_milliseconds = replace(whole, trials=(replace(trial, time=1e3 * trial.time),))
    said = [
        fault.sentence
        for fault in check_against_model(in_milliseconds, oscillator)
        if fault.kind is FaultKind.UNDERSAMPLED
    ]
    assert len(said) == 1
    assert "looks like milliseconds" in said[0]
    assert "sample faster" not in said[0]


# ---------------------------------------------------------------- what needs no model


def test_clipped_and_dead_channels(campaign) -> None:
    def clip(trial: Trial, values: np.ndarray) -> None:
        values[:, 1] = np.clip(values[:, 1], -3e-4, 1.0)

    faults = check_data(changed(campaign, clip, name="release 1"))
    assert [(fault.kind, fault.channel, fault.trial) for fault in faults] == [
        (FaultKind.CLIPPED, "g0", "release 1")
    ]
    assert "smallest value -0.0003" in faults[0].sentence

    def saturate(trial: Trial, values: np.ndarray) -> None:
        values[:, 0] = np.minimum(values[:, 0], 0.02)

    assert (FaultKind.CLIPPED, "x") in found(check_data(changed(campaign, saturate, kind=TrialKind.STATIC)))

    def unplug(trial: Trial, values: np.ndarray) -> None:
        values[:, 2] = 1e-6

    assert found(check_data(changed(campaign, unplug, name="loading"))) == {(FaultKind.DEAD, "g1")}


@given(st.floats(1e-7, 3e-5), st.integers(0, 100))
@settings(max_examples=40, deadline=None)
def test_few_digits_are_not_clipping(oscillator, digit: float, seed: int) -> None:
    campaign = example_campaign(oscillator, "laboratory", seed, PLAN)

    def rounded(trial: Trial, values: np.ndarray) -> None:
        values[:, 1:] = np.round(values[:, 1:] / digit) * digit

    assert FaultKind.CLIPPED not in {kind for kind, _ in found(check_data(changed(campaign, rounded)))}


def test_noise_records(campaign) -> None:
    def with_noise(record: NoiseRecord | None) -> Campaign:
        return replace(
            campaign, channels={**campaign.channels, "g0": replace(campaign.channels["g0"], noise=record)}
        )

    (fault,) = check_data(with_noise(None))
    assert (fault.kind, fault.channel, fault.fatal) == (FaultKind.NO_NOISE_RECORD, "g0", False)
    (fault,) = check_data(with_noise(NoiseRecord(1e-5, 200.0)))
    assert fault.kind is FaultKind.NOISE_LABEL
    assert "says 1e-05" in fault.sentence


def test_noise_label_against_repeats() -> None:
    rng = np.random.default_rng(1)
    rows = 6

    def trial(number: int) -> Trial:
        values = (np.arange(rows) + rng.normal(size=rows))[:, None]
        force = np.arange(rows) * 1.0
        return Trial.plain(str(number), TrialKind.STATIC, ("x",), np.zeros(rows), values=values, force=force)

    def campaign(stated: float) -> Campaign:
        channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(stated, 100.0))
        return Campaign("", {"x": channel}, tuple(map(trial, range(5))), None, {}, "")

    assert check_data(campaign(1.0)) == ()
    for stated in (0.2, 5.0):
        (fault,) = check_data(campaign(stated))
        assert fault.kind is FaultKind.NOISE_LABEL
        assert "repeated trials scatter" in fault.sentence


# ---------------------------------------------------------------- outliers


def test_one_percent_of_outliers_is_found_and_left_out(campaign) -> None:
    rng = np.random.default_rng(5)
    places: dict[str, np.ndarray] = {}

    def spoil(trial: Trial, values: np.ndarray) -> None:
        rows = rng.choice(np.arange(3, len(values) - 3), len(values) // 100, replace=False)
        places[trial.name] = rows
        values[rows, 1] += rng.choice([-1.0, 1.0], len(rows)) * rng.uniform(10.0, 60.0, len(rows)) * 2e-6

    spoilt = changed(campaign, spoil, kind=TrialKind.RINGDOWN)
    assert check_data(spoilt) == ()
    marked = mark_outliers(spoilt)
    hit = sum((~trial.used[places[trial.name], 1]).sum() for trial in marked.trials if trial.name in places)
    left_out = sum((~trial.used).sum() for trial in marked.trials)
    total = sum(len(rows) for rows in places.values())
    assert hit >= 0.9 * total
    assert left_out - hit <= 1
    said = f"of {len(campaign.trials[3].time)} readings of 'g0' in the trial 'release 1' are outliers"
    assert said in " ".join(marked.remarks)
    assert mark_outliers(marked).trials[3].used.sum() >= marked.trials[3].used.sum() - 1


def test_too_many_outliers_are_a_fault(campaign) -> None:
    def spoil(trial: Trial, values: np.ndarray) -> None:
        values[10::17, 1] += 1e-4

    spoilt = changed(campaign, spoil, name="release 2")
    (fault,) = check_data(spoilt)
    assert (fault.kind, fault.channel, fault.trial) == (FaultKind.OUTLIERS, "g0", "release 2")
    assert all(trial.used.all() for trial in mark_outliers(spoilt).trials)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_friction_impacts_and_steps_are_no_outliers(noise: float) -> None:
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


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_white_noise_has_hardly_an_outlier(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert sample_outliers(rng.normal(size=600)).sum() <= 1
    assert not sample_outliers(np.zeros(50)).any()
    assert not sample_outliers(rng.normal(size=5)).any()


def test_rows_of_static_trials(campaign) -> None:
    def levels(count: int, spoilt: int | None, name: str = "t", curve: float = 0.0) -> Trial:
        load = np.arange(count, dtype=float)
        values = 1e-3 * load + curve * load**2 + 5e-6 * np.random.default_rng(count).normal(size=count)
        if spoilt is not None:
            values[spoilt] += 1e-3
        zeros, column = np.zeros(count), values[:, None]
        return Trial.plain(name, TrialKind.STATIC, ("x",), zeros, values=column, force=load, run="A")

    def left_out(*trials: Trial, noise: float | None = 5e-6) -> list[list[int]]:
        record = None if noise is None else NoiseRecord(noise, 100.0)
        channel = Channel("x", Quantity.DISPLACEMENT, "x", record)
        marked = mark_outliers(Campaign("", {"x": channel}, trials, None, {}, ""))
        return [np.flatnonzero(~trial.used[:, 0]).tolist() for trial in marked.trials]

    assert left_out(levels(10, 4)) == [[4]]
    assert left_out(levels(10, None)) == [[]]
    assert left_out(levels(10, None, curve=1e-4)) == [[]]
    assert left_out(levels(10, 4), noise=None) == [[]]
    assert left_out(levels(6, 3)) == [[]]  # six rows alone cannot tell
    trio = [levels(6, None, "a"), levels(6, None, "b"), levels(6, 3, "c")]
    assert left_out(*trio) == [[], [], [3]]
    # A trial that is off in many rows is not a matter of single readings.
    moved = replace(trio[2], values=trio[2].values + 1e-3)
    assert left_out(*trio[:2], moved) == [[], [], []]


# ---------------------------------------------------------------- beside what a model predicts


def ends(*columns: np.ndarray) -> list[tuple[int, int]]:
    residual = np.stack(columns, axis=1)
    return [(int(row), int(column)) for row, column in np.argwhere(wrong_ends(residual, residual < 1e5))]


@pytest.mark.parametrize("place", [0, 1, 2, 197, 198, 199])
def test_a_wrong_reading_is_found_at_the_ends(place: int) -> None:
    generator = np.random.default_rng(1)
    first, second = generator.standard_normal((2, 200))
    second[place] += 20.0
    assert ends(first, second) == [(place, 1)]
    # in several channels at once, or within the record, it is no single reading at an end
    first[place] += 20.0
    assert ends(first, second) == []
    second[100] += 20.0
    assert ends(second) == [(place, 0)]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_noise_has_no_wrong_ends(seed: int) -> None:
    """Eight robust deviations of a difference."""
    assert ends(*np.random.default_rng(seed).standard_normal((3, 500))) == []


@pytest.mark.parametrize("seed", range(10))
def test_what_a_wrong_model_leaves_has_no_wrong_ends(seed: int) -> None:
    """Waves of fast modes that decay, spikes of contact, steps."""
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


def test_a_record_too_short_to_judge_is_left_alone() -> None:
    assert ends(np.array([30.0, 0.1, -0.2, 0.1, 0.0, 0.2, -0.1])) == []
