"""Sensor primitives on arrays, against closed forms and against an independent integration."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import freqs
from scipy.special import hyp1f1

from discrepancy.models.high_pass import filtered_record, high_pass
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    Clock,
    DecayingLine,
    HighPass,
    Line,
    ModelPatch,
    PointMass,
    RunOffset,
    SensorDrift,
    SensorGain,
    SensorRotation,
    ThermalStrain,
)
from fe.runtime.sensors import (
    SensorRecord,
    apply_sensors,
    check_channels,
    clock_of,
)

CHANNELS = (("tip", "displacement"), ("g0", "strain"), ("g1", "strain"))
TIME = np.arange(200) * 0.01
RECORD = SensorRecord(CHANNELS, "ringdown", TIME, 100.0, np.full(200, 5.0), "A", 0.05)
VALUES = np.stack([np.cos(3 * TIME), 1e-3 * np.cos(5 * TIME), 2e-3 * np.sin(4 * TIME)], axis=1)
RATES = np.stack([-3 * np.sin(3 * TIME), -5e-3 * np.sin(5 * TIME), 8e-3 * np.cos(4 * TIME)], axis=1)


def shown(*primitives, record=RECORD, **more):
    return apply_sensors(ModelPatch(primitives), record, VALUES, RATES, filtered=filtered_record, **more)


def test_nothing_without_sensors_touches_the_input() -> None:
    values, rates = shown(PointMass(0.1, 0.2), Clock(0.1, 0.0))
    assert values is VALUES
    assert rates is RATES
    assert clock_of(ModelPatch((Clock(0.1, 0.5), Clock(0.2, -0.1)))) == pytest.approx((0.3, 0.4))


def test_order_of_the_patch_matters() -> None:
    gain, drift = SensorGain("g0", 0.5), SensorDrift("g0", 2e-3, 100.0)
    added = 2e-3 * (100.0 + TIME) / 100.0
    assert shown(gain, drift)[0][:, 1] == pytest.approx(1.5 * VALUES[:, 1] + added)
    assert shown(drift, gain)[0][:, 1] == pytest.approx(1.5 * (VALUES[:, 1] + added))
    assert np.array_equal(shown(gain, drift)[0][:, [0, 2]], VALUES[:, [0, 2]])
    assert shown(drift, gain)[1][:, 1] == pytest.approx(1.5 * (RATES[:, 1] + 2e-5))


def test_channels_are_chosen_by_name_or_by_quantity() -> None:
    for item, changed in (
        (SensorGain("*", 0.1), [0, 1, 2]),
        (SensorGain("*", 0.1, "strain"), [1, 2]),
        (SensorGain("tip", 0.1, "strain"), [0]),
        (ThermalStrain("*", 1e-5), [1, 2]),
        (SensorGain("elsewhere", 0.1), []),
    ):
        difference = np.any(shown(item)[0] != VALUES, axis=0)
        assert np.flatnonzero(difference).tolist() == changed


def test_drift_by_kind_of_trial_and_exponent() -> None:
    static = replace(RECORD, kind="static", time=100.0 * TIME)
    drifted = shown(SensorDrift("tip", 1.0, 50.0), record=static)[0][:, 0]
    assert drifted == pytest.approx(VALUES[:, 0] + 2.0 * TIME)
    early = replace(RECORD, start=0.0)
    values, rates = shown(SensorDrift("tip", 1.0, 2.0, 0.5), record=early)
    assert values[:, 0] == pytest.approx(VALUES[:, 0] + np.sqrt(TIME / 2.0))
    assert np.all(np.isfinite(rates))
    with pytest.raises(InvalidPatchError, match="must be positive, but is 0"):
        shown(SensorDrift("tip", 1.0, 0.0))


@given(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@settings(max_examples=60)
def test_rotation_is_that_of_the_strain_tensor(
    angle: float, along: float, across: float, gamma: float
) -> None:
    tensor = np.array([[along, gamma / 2.0], [gamma / 2.0, across]])
    direction = np.array([np.cos(angle), np.sin(angle)])
    record = SensorRecord((("g", "strain"),), "static", np.zeros(1), 0.0, np.zeros(1))
    # Two rotations of one gauge add up, and a gain acts on what the turned gauge shows.
    turns = SensorRotation("g", angle / 3), SensorRotation("g", angle * 2 / 3)
    one, two, three = (np.array([[value]]) for value in (along, across, gamma))
    values, _ = apply_sensors(
        ModelPatch((SensorGain("g", 1.0), *turns)), record, one, None, two, three, filtered=filtered_record
    )
    assert values[0, 0] == pytest.approx(2.0 * direction @ tensor @ direction, abs=1e-12)


def test_rotation_without_components_and_rates_with_them() -> None:
    turn = SensorRotation("g0", 0.2)
    with pytest.raises(InvalidPatchError, match="transverse and shear"):
        shown(turn)
    values, rates = shown(turn, transverse=-0.3 * VALUES, shear=0.1 * VALUES)
    factor = np.cos(0.2) ** 2 - 0.3 * np.sin(0.2) ** 2 + 0.1 * np.sin(0.2) * np.cos(0.2)
    assert values[:, 1] == pytest.approx(factor * VALUES[:, 1])
    assert rates[1:-1, 1] == pytest.approx(factor * RATES[1:-1, 1], abs=1e-6)


def test_lines_run_with_the_trial_and_only_where_time_does() -> None:
    line = Line("tip", 50.0, 0.3, -0.4)
    values, _ = shown(line)
    expected = 0.3 * np.cos(100 * np.pi * TIME) - 0.4 * np.sin(100 * np.pi * TIME)
    assert values[:, 0] - VALUES[:, 0] == pytest.approx(expected, abs=1e-12)
    assert np.array_equal(shown(line, record=replace(RECORD, kind="static"))[0], VALUES)
    decaying = DecayingLine("g1", 2.0, 0.05, 0.1, 0.2)
    values, rates = shown(decaying)
    w = 4 * np.pi
    root = complex(-0.05 * w, w * np.sqrt(1 - 0.05**2))
    wave = 0.05 * (0.1 - 0.2j) * np.exp(root * TIME)
    assert values[:, 2] - VALUES[:, 2] == pytest.approx(wave.real, abs=1e-14)
    assert rates[:, 2] - RATES[:, 2] == pytest.approx((root * wave).real, abs=1e-13)
    assert np.array_equal(shown(decaying, record=replace(RECORD, kind="forced"))[0], VALUES)
    with pytest.raises(InvalidPatchError, match="below one, but is 1"):
        shown(DecayingLine("g1", 2.0, 1.0, 0.1, 0.2))


def test_offset_of_a_run_is_for_its_static_displacements() -> None:
    static = replace(RECORD, kind="static")
    values, _ = shown(RunOffset("A", 1e-3), record=static)
    assert values[:, 0] == pytest.approx(VALUES[:, 0] + 1e-3)
    assert np.array_equal(values[:, 1:], VALUES[:, 1:])
    assert np.array_equal(shown(RunOffset("B", 1e-3), record=static)[0], VALUES)
    assert np.array_equal(shown(RunOffset("A", 1e-3))[0], VALUES)
    assert shown(RunOffset("A", 1e-3, "g1"), record=static)[0][:, 2] == pytest.approx(VALUES[:, 2] + 1e-3)


def test_names_that_exist_nowhere_are_refused_in_one_sentence() -> None:
    for item, sentence in (
        (SensorGain("g9", 0.1), r"'sensor_gain' names the channel 'g9'.*tip, g0, g1\."),
        (ThermalStrain("tip", 0.1), "'tip' measures displacement"),
    ):
        with pytest.raises(InvalidPatchError, match=sentence):
            check_channels(ModelPatch((item,)), CHANNELS)
    check_channels(ModelPatch((SensorGain("*", 0.1), SensorGain("g1", 0.1), Clock(0.0, 0.1))), CHANNELS)


# ---------------------------------------------------------------- high-pass


@pytest.mark.parametrize("order", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("held", [None, 0.0])
def test_high_pass_against_an_integrator(order: float, held: float | None) -> None:
    times = np.arange(60) * 0.02
    signal = np.random.default_rng(2).normal(size=60)
    tau, stages = 0.11, int(order)
    first = signal[0] if held is None else held

    def slope(t: float, low: np.ndarray) -> np.ndarray:
        # each stage is given what the one before leaves of the signal
        given = np.interp(t, times, signal) - np.concatenate(([0.0], np.cumsum(low)[:-1]))
        return (given - low) / tau

    start = np.zeros(stages)
    start[0] = first
    low = [start]
    for begin, end in pairwise(times):
        low.append(solve_ivp(slope, (begin, end), low[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    expected = signal - np.sum(low, axis=1)
    assert high_pass(signal, 0.02, tau, order, held) == pytest.approx(expected, abs=1e-8)


@given(st.floats(0.0, 4.0), st.floats(1e-4, 50.0))
@settings(max_examples=80, deadline=None)
def test_step_response_of_any_order(order: float, ratio: float) -> None:
    signal = np.ones(80)
    expected = hyp1f1(order, 1.0, -ratio * np.arange(80))
    assert high_pass(signal, ratio, 1.0, order, 0.0) == pytest.approx(expected, abs=2e-9)


@pytest.mark.parametrize("order", [0.5, 1.0, 1.4, 2.0])
def test_frequency_response_of_any_order(order: float) -> None:
    h, tau, omega = 0.002, 0.3, 9.0
    times = np.arange(20000) * h
    output = high_pass(np.cos(omega * times), h, tau, order)[-4000:]
    # The tail of a fractional order dies off like a power of time: a line in time by the record's end.
    basis = np.stack([np.cos(omega * times), -np.sin(omega * times), 1 + 0 * times, times], axis=1)[-4000:]
    real, imaginary = np.linalg.lstsq(basis, output, rcond=None)[0][:2]
    _, transfer = freqs([tau, 0.0], [tau, 1.0], [omega])
    assert complex(real, imaginary) == pytest.approx(transfer[0] ** order, abs=1e-4)


def test_limits_of_the_high_pass() -> None:
    signal = np.random.default_rng(3).normal(size=(50, 2))
    assert high_pass(signal, 0.01, 0.3, 0.0, 0.0) == pytest.approx(signal, abs=1e-12)
    assert high_pass(signal, 1e-3, 1e9, 1.0, 0.0) == pytest.approx(signal, abs=1e-9)
    assert high_pass(np.full((50, 2), 3.0), 0.01, 0.3) == pytest.approx(0.0, abs=1e-12)
    assert high_pass(np.zeros((0, 2)), 0.01, 0.3).shape == (0, 2)
    near, whole = high_pass(signal, 0.01, 0.3, 2.0 + 1e-9), high_pass(signal, 0.01, 0.3, 2.0)
    assert near == pytest.approx(whole, abs=1e-7)
    for bad in ((0.0, 0.1, 1.0), (0.1, -1.0, 1.0), (0.1, 0.1, 4.5), (0.1, 0.1, -0.5)):
        with pytest.raises(InvalidPatchError, match="high-pass"):
            high_pass(signal, *bad)


@pytest.mark.parametrize("order", [1.0, 1.5, 2.0])
def test_rates_through_the_high_pass(order: float) -> None:
    patch = ModelPatch((HighPass("*", 0.4, order),))
    values, rates = apply_sensors(patch, RECORD, VALUES, RATES, filtered=filtered_record)
    difference = (values[2:] - values[:-2]) / 0.02
    assert rates[1:-1] == pytest.approx(difference, abs=2e-3 if order != 1.5 else 2e-2)
    forced, _ = apply_sensors(patch, replace(RECORD, kind="forced"), VALUES, RATES, filtered=filtered_record)
    assert forced[0] == pytest.approx(VALUES[0])  # from rest: the first sample is a step
    assert values[0] == pytest.approx(0.0, abs=1e-12)  # released: it had been held
    settled, _ = apply_sensors(patch, replace(RECORD, kind="flight"), VALUES, None, filtered=filtered_record)
    assert np.array_equal(settled, VALUES)
