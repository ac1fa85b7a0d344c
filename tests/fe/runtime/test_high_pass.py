"""Filters of records, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import hyp1f1

from fe.high_pass import filtered_record, high_pass
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import HighPass, LowPass, ModelPatch
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors
from tests.fe.runtime.sensor_records import CHANNELS, FORCED, RATES, RINGDOWN, VALUES, show

SIGNAL = np.random.default_rng(3).normal(size=(50, 2))
ORDERS = (1.0, 1.5, 2.0)
ACCELERATIONS = tuple((name, "acceleration") for name, _ in CHANNELS)


# ---------------------------------------------------------------- step response


@given(st.floats(0.0, 4.0), st.floats(1e-4, 50.0))
@settings(max_examples=80, deadline=None)
def test_step_response_of_any_order(order, ratio):
    response = high_pass(np.ones(80), ratio, 1.0, order, 0.0)

    expected = hyp1f1(order, 1.0, -ratio * np.arange(80))
    is_finite = np.isfinite(expected)  # SciPy's is infinite between 1417.8 and 1418.1
    assert response[is_finite] == pytest.approx(expected[is_finite], abs=2e-9)


def test_the_step_response_falls_by_a_power_where_scipy_has_no_value():
    response = high_pass(np.ones(3), 1417.9, 1.0, 0.01, 0.0)

    shortly_before = hyp1f1(0.01, 1.0, -1417.0)
    assert response[1] == pytest.approx(shortly_before * (1417.0 / 1417.9) ** 0.01, rel=1e-8)


def test_a_constant_signal_is_filtered_away():
    assert high_pass(np.full((50, 2), 3.0), 0.01, 0.3) == pytest.approx(0.0, abs=1e-12)


def test_an_empty_record_stays_empty():
    assert high_pass(np.zeros((0, 2)), 0.01, 0.3).shape == (0, 2)


def test_a_whole_order_is_the_limit_of_broken_orders():
    nearly_whole = high_pass(SIGNAL, 0.01, 0.3, 2.0 + 1e-9)
    whole = high_pass(SIGNAL, 0.01, 0.3, 2.0)

    assert nearly_whole == pytest.approx(whole, abs=1e-7)


@pytest.mark.parametrize(
    ("interval", "time_constant", "order"),
    [(0.0, 0.1, 1.0), (0.1, -1.0, 1.0), (0.1, 0.1, 4.5), (0.1, 0.1, -0.5)],
)
def test_an_impossible_filter_is_refused(interval, time_constant, order):
    with pytest.raises(InvalidPatchError, match=r"high-pass|filter"):
        high_pass(SIGNAL, interval, time_constant, order)


# ---------------------------------------------------------------- begin of a record


@pytest.mark.parametrize(("order", "tolerance"), [(1.0, 2e-3), (1.5, 2e-2), (2.0, 2e-3)])
def test_rates_through_the_high_pass_are_those_of_its_values(order, tolerance):
    values, rates = show(HighPass("*", 0.4, order))

    slope = (values[2:] - values[:-2]) / 0.02
    assert rates[1:-1] == pytest.approx(slope, abs=tolerance)


@pytest.mark.parametrize("order", ORDERS)
def test_a_filter_had_followed_what_was_held_before_a_release(order):
    values, _ = show(HighPass("*", 0.4, order))

    assert values[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_a_filter_of_a_settled_record_had_followed_its_first_sample(order):
    """A settled record was at rest under what acts at its first sample, as before a release."""
    released, _ = show(HighPass("*", 0.4, order))

    settled, _ = show(HighPass("*", 0.4, order), record=FORCED)

    np.testing.assert_array_equal(settled, released)


@pytest.mark.parametrize("order", ORDERS)
def test_a_filter_of_a_moving_record_had_followed_zero(order):
    values, _ = show(HighPass("*", 0.4, order), record=replace(FORCED, settled=False))

    assert values[0] == pytest.approx(VALUES[0])


@pytest.mark.parametrize("record", [RINGDOWN, FORCED], ids=lambda record: record.kind)
@pytest.mark.parametrize("order", ORDERS)
def test_a_filtered_acceleration_begins_with_a_step(order, record):
    """There is no acceleration at rest, so that the filter had followed zero."""
    values, _ = show(HighPass("*", 0.4, order), record=replace(record, channels=ACCELERATIONS))

    assert values[0] == pytest.approx(VALUES[0])


@pytest.mark.parametrize("record", [RINGDOWN, FORCED], ids=lambda record: record.kind)
def test_a_filter_of_single_samples_begins_with_the_step_of_an_acceleration(record):
    memory = FilterMemory(None, 0.0)
    accelerations = replace(record, channels=ACCELERATIONS)

    first_row = memory.filter_row(HighPass("*", 0.4), accelerations, VALUES[:1], RATES)

    assert first_row[0] == pytest.approx(VALUES[:1])


def test_a_high_pass_follows_uneven_stamps():
    jitter = 0.6 * np.random.default_rng(1).uniform(-0.5, 0.5, 400)
    time = 0.01 * (np.arange(400) + jitter)
    time = np.delete(time - time[0], slice(133, 140))  # and a gap
    omega = 2.0 * np.pi * 1.3
    time_constant = 0.3
    record = SensorRecord((("x", "velocity"),), "forced", time, 0.0, np.zeros(len(time)))
    signal = np.sin(omega * time)[:, None]
    rates = omega * np.cos(omega * time)[:, None]

    values, _ = apply_sensors(
        ModelPatch((HighPass("x", time_constant),)),
        record,
        signal,
        rates,
        high_pass=filtered_record,
    )

    # y' = x' - y / tau from rest: the steady part, and what the begin leaves
    transfer = 1j * omega * time_constant / (1.0 + 1j * omega * time_constant)
    steady = np.imag(transfer * np.exp(1j * omega * time))
    expected = steady - steady[0] * np.exp(-time / time_constant)
    (filtered,) = values.T
    # the gap of eight intervals is bridged by a straight line
    np.testing.assert_allclose(filtered, expected, atol=8e-3)


# ---------------------------------------------------------------- slow sensors


def test_a_slow_sensor_follows_a_step_by_its_time_constant():
    step = np.ones_like(VALUES)
    settled_at_zero = replace(FORCED, channels=ACCELERATIONS)

    values, _ = show(LowPass("*", 0.4), record=settled_at_zero, values=step, rates=0.0 * step)

    expected = 1.0 - np.exp(-FORCED.time / 0.4)
    np.testing.assert_allclose(values, np.tile(expected[:, None], 3), atol=1e-12)


def test_a_slow_sensor_shows_a_sine_smaller_and_later():
    omega, time_constant = 7.0, 0.1
    signal = np.sin(omega * FORCED.time)[:, None] * np.ones(3)
    rates = omega * np.cos(omega * FORCED.time)[:, None] * np.ones(3)

    values, _ = show(LowPass("*", time_constant), record=FORCED, values=signal, rates=rates)

    transfer = 1.0 / (1.0 + 1j * omega * time_constant)
    steady = np.imag(transfer * np.exp(1j * omega * FORCED.time))
    expected = steady - steady[0] * np.exp(-FORCED.time / time_constant)
    # the sine is taken as linear between samples
    np.testing.assert_allclose(values[:, 0], expected, atol=1e-3)


def test_rates_of_a_slow_sensor_are_those_of_its_values():
    values, rates = show(LowPass("*", 0.4))

    slope = (values[2:] - values[:-2]) / 0.02
    assert rates[1:-1] == pytest.approx(slope, abs=2e-3)


@pytest.mark.parametrize("is_settled", [True, False])
def test_a_slow_sensor_shows_the_first_value_as_it_is(is_settled):
    values, _ = show(LowPass("*", 0.4), record=replace(FORCED, settled=is_settled))

    assert values[0] == pytest.approx(VALUES[0])


def test_a_slow_sensor_shows_settled_readings_as_they_are():
    values, _ = show(LowPass("*", 0.4), record=replace(FORCED, kind="static"))

    np.testing.assert_array_equal(values, VALUES)
