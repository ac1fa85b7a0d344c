"""Patches: expressions, kinds, the digital state; sensors against closed forms, as a whole or by samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import hyp1f1

from fe.high_pass import filtered_record, high_pass
from fe.runtime import patch
from fe.runtime.errors import InvalidPatchError, InvalidStateError
from fe.runtime.expression import Expression
from fe.runtime.patch import (
    PRIMITIVES,
    Clock,
    HighPass,
    ModelPatch,
    RunOffset,
    SensorDrift,
    SensorGain,
    SensorRotation,
)
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, check_channels
from fe.runtime.state import DigitalState, Geometry, default_region_names, losses_of
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
numbers = st.floats(-1e3, 1e3)


def expression(text: str) -> Expression:
    return Expression(text, frozenset({"a", "b", "c"}), "Here")


@given(numbers, numbers, st.floats(1e-3, 1e3))
def test_arithmetic_is_that_of_python(a, b, c):
    """Also with numbers in the place of some names."""
    formula = expression("(a + 2*b)/c - -a**2 + sqrt(c)*min(a, b, 0) + abs(b)*exp(-c)")
    wanted = (a + 2 * b) / c - -(a**2) + math.sqrt(c) * min(a, b, 0) + abs(b) * float(np.exp(-c))
    assert formula.value({"a": a, "b": b, "c": c}) == wanted
    filled = Expression(formula.with_numbers({"a": a, "b": b}), {"c"}, "Here")
    assert filled.used_names() == {"c"}
    assert filled.value({"c": c}) == wanted
    with refused(InvalidPatchError, "needs 'c', which has no value"):
        filled.value({})


NO_EXPRESSIONS = [text for (text,) in INPUTS.refused("expressions")]


@pytest.mark.parametrize("text", [*NO_EXPRESSIONS, "a" + "+a" * 400, "9" * 5000])
def test_anything_else_is_refused_with_a_sentence(text):
    with refused(InvalidPatchError, r"^Here\b"):
        expression(text).value({"a": 1.0, "b": 1.0, "c": 1.0})


@given(numbers, st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=5))
def test_a_course_has_the_values_of_its_times(a, times):
    text = "a*max(0, time - 1, b) + step(time - 2)*sin(time)/(1 + abs(a))"
    formula, given = Expression(text, {"a", "b", "time"}, "Here"), {"a": a, "b": -2.0}
    single = [formula.value({**given, "time": time}) for time in times]
    np.testing.assert_allclose(
        formula.values_over_time(np.array(times), given), single, rtol=1e-14, atol=1e-14
    )


def test_kinds_are_the_keys_of_patches_that_were_kept():
    assert list(PRIMITIVES) == INPUTS.text("kinds.txt").split()


# ---------------------------------------------------------------- the digital state


@pytest.mark.parametrize(("changes", "place"), INPUTS.refused("states"))
def test_impossible_states_are_refused_with_the_place(changes, place):
    with refused(InvalidStateError, place):
        (Geometry if place.startswith("geometry") else DigitalState)(**changes)


def test_losses_stand_in_the_order_of_the_regions():
    regions = ("root", "z2", "tip")
    assert default_region_names(3) == ("z1", "z2", "z3")
    for losses, wanted in (
        ({"tip": 0.4, "root": 0.1}, (0.1, 0.0, 0.4)),
        ([0.1, 0.2, 0.3],) * 2,
        ((), (0.0,) * 3),
    ):
        assert losses_of(losses, regions) == tuple(wanted)
    for losses, sentence in (
        ({"z1": 0.1}, "no damage region 'z1'; the regions are root, z2, tip"),
        ((0.1, 0.2), "3 fractions, one for each of root, z2, tip, but 2"),
    ):
        with pytest.raises(InvalidStateError, match=sentence):
            losses_of(losses, regions)


CHANNELS_SEEN = INPUTS.table("channels.toml")["row"]
CHANNELS = (("tip", "displacement"), ("g0", "strain"), ("g1", "strain"))
TIME = np.arange(200) * 0.01
RECORD = SensorRecord(CHANNELS, "ringdown", TIME, 100.0, np.full(200, 5.0), "A", 0.05)
STATIC, FORCED = (replace(RECORD, kind=kind) for kind in ("static", "forced"))
VALUES = np.stack([np.cos(3 * TIME), 1e-3 * np.cos(5 * TIME), 2e-3 * np.sin(4 * TIME)], axis=1)
RATES = np.stack([-3 * np.sin(3 * TIME), -5e-3 * np.sin(5 * TIME), 8e-3 * np.cos(4 * TIME)], axis=1)


def applied(items: ModelPatch, *given, high_pass=filtered_record, **more):
    return apply_sensors(items, *given, high_pass=high_pass, **more)


def shown(*primitives, record=RECORD, **more):
    return applied(ModelPatch(primitives), record, VALUES, RATES, **more)


def test_order_of_sensors_matters():
    gain, drift = SensorGain("g0", 0.5), SensorDrift("g0", 2e-3, 100.0)
    added, (first, _), (last, rates) = 2e-3 * (100.0 + TIME) / 100.0, shown(gain, drift), shown(drift, gain)
    assert first[:, 1] == pytest.approx(1.5 * VALUES[:, 1] + added)
    assert last[:, 1] == pytest.approx(1.5 * (VALUES[:, 1] + added))
    assert np.array_equal(first[:, [0, 2]], VALUES[:, [0, 2]])
    assert rates[:, 1] == pytest.approx(1.5 * (RATES[:, 1] + 2e-5))


@pytest.mark.parametrize(("kind", "given", "trial", "changed"), CHANNELS_SEEN)
def test_channels_are_chosen_by_name_quantity_and_kind_of_trial(kind, given, trial, changed):
    item = patch.PRIMITIVES[kind](*given)
    values = shown(item, record=replace(RECORD, kind=trial))[0]
    assert np.flatnonzero(np.any(values != VALUES, axis=0)).tolist() == changed
    if isinstance(item, RunOffset):
        assert values[:, changed] == pytest.approx(VALUES[:, changed] + 1e-3)


def test_a_saturating_sensor_shows_the_formula_and_its_derivative():
    """Rates are those by finite differences; far below the limit nothing changes; windows leave the rest."""
    item = patch.SensorSaturation("*", 2e-3, "strain")
    values, rates = shown(item)
    assert values[:, 1:] == pytest.approx(2e-3 * np.tanh(VALUES[:, 1:] / 2e-3), rel=1e-14)
    step = 1e-6
    ahead, behind = (
        applied(ModelPatch((item,)), RECORD, VALUES + side * step * RATES, RATES)[0] for side in (1.0, -1.0)
    )
    assert rates == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-9 * np.abs(RATES).max())
    far, _ = shown(replace(item, limit=1e6))
    assert far == pytest.approx(VALUES, rel=1e-12)
    late, _ = shown(replace(item, windows=(patch.Window("a", 1.0, None),)))
    assert np.array_equal(late, np.where(TIME[:, np.newaxis] < 1.0, VALUES, values))


def test_a_lagging_channel_shows_a_cubic_course_exactly_later():
    course, rate = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5]), np.polynomial.Polynomial([-2.0, 6.0, 1.5])
    record = replace(FORCED, settled=False)
    values, rates = applied(
        ModelPatch((patch.SensorLag("tip", 0.0137),)),
        record,
        np.tile(course(TIME)[:, np.newaxis], 3),
        np.tile(rate(TIME)[:, np.newaxis], 3),
    )
    later = TIME >= 0.0137
    assert values[later, 0] == pytest.approx(course(TIME[later] - 0.0137), rel=1e-12)
    assert rates[later, 0] == pytest.approx(rate(TIME[later] - 0.0137), rel=1e-11)
    assert values[~later, 0] == pytest.approx(1.0 - 2.0 * (TIME[~later] - 0.0137))
    assert np.array_equal(values[:, 1], course(TIME))


def test_a_lagging_channel_of_a_settled_record_stood_still_before():
    values, rates = shown(patch.SensorLag("g0", 0.0137), record=FORCED)
    assert np.array_equal(values[:2, 1], VALUES[[0, 0], 1])
    assert np.array_equal(rates[:2, 1], [0.0, 0.0])


def test_a_channel_ahead_of_its_record_goes_on_with_its_last_rate():
    values, _ = shown(patch.SensorLag("tip", -0.015), record=FORCED)
    assert values[:-2, 0] == pytest.approx(np.cos(3 * (TIME[:-2] + 0.015)), abs=1e-8)
    assert values[-1, 0] == pytest.approx(VALUES[-1, 0] + 0.015 * RATES[-1, 0])


def test_drift_by_kind_of_trial_and_exponent():
    drifted = shown(SensorDrift("tip", 1.0, 50.0), record=replace(STATIC, time=100.0 * TIME))[0][:, 0]
    assert drifted == pytest.approx(VALUES[:, 0] + 2.0 * TIME)
    values, rates = shown(SensorDrift("tip", 1.0, 2.0, 0.5), record=replace(RECORD, start=0.0))
    assert values[:, 0] == pytest.approx(VALUES[:, 0] + np.sqrt(TIME / 2.0))
    assert np.all(np.isfinite(rates))


@given(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@settings(max_examples=60)
def test_rotation_is_that_of_the_strain_tensor(angle, across, gamma):
    """Two rotations of one gauge add up, and a gain acts on what the turned gauge shows."""
    tensor = np.array([[1.0, gamma / 2.0], [gamma / 2.0, across]])
    direction = np.array([np.cos(angle), np.sin(angle)])
    items = SensorGain("g0", 1.0), SensorRotation("g0", angle / 3), SensorRotation("g0", angle * 2 / 3)
    values, rates = shown(*items, transverse=across * VALUES, shear=gamma * VALUES)
    factor = 2.0 * direction @ tensor @ direction
    assert values[:, 1] == pytest.approx(factor * VALUES[:, 1], abs=1e-15)
    assert rates[1:-1, 1] == pytest.approx(factor * RATES[1:-1, 1], abs=8e-6)


def test_lines_run_with_the_trial():
    wave = (0.3 + 0.4j) * np.exp(100j * np.pi * TIME)
    assert shown(patch.Line("tip", 50.0, 0.3, -0.4))[0][:, 0] - VALUES[:, 0] == pytest.approx(
        wave.real, abs=1e-12
    )
    values, rates = shown(patch.DecayingLine("g1", 2.0, 0.05, 0.1, 0.2))
    w = 4 * np.pi
    root = complex(-0.05 * w, w * np.sqrt(1 - 0.05**2))
    wave = 0.05 * (0.1 - 0.2j) * np.exp(root * TIME)
    assert values[:, 2] - VALUES[:, 2] == pytest.approx(wave.real, abs=1e-14)
    assert rates[:, 2] - RATES[:, 2] == pytest.approx((root * wave).real, abs=1e-13)


@pytest.mark.parametrize(("kind", "given", "sentence"), INPUTS.refused("sensors"))
def test_what_cannot_be_is_refused_in_one_sentence(kind, given, sentence):
    item = ModelPatch((patch.PRIMITIVES[kind](*given),))
    with refused(InvalidPatchError, sentence):
        check_channels(item, CHANNELS)
        applied(item, RECORD, VALUES, RATES, high_pass=FilterMemory(None, 0.1).filter_row)
    check_channels(ModelPatch((SensorGain("*", 0.1), SensorGain("g1", 0.1), Clock(0.0, 0.1))), CHANNELS)


# ---------------------------------------------------------------- high-pass


@given(st.floats(0.0, 4.0), st.floats(1e-4, 50.0))
@settings(max_examples=80, deadline=None)
def test_step_response_of_any_order(order, ratio):
    expected, shown = (
        hyp1f1(order, 1.0, -ratio * np.arange(80)),
        high_pass(np.ones(80), ratio, 1.0, order, 0.0),
    )
    told = np.isfinite(expected)  # SciPy's is infinite between 1417.8 and 1418.1
    assert shown[told] == pytest.approx(expected[told], abs=2e-9)
    far, before = high_pass(np.ones(3), 1417.9, 1.0, 0.01, 0.0)[1], hyp1f1(0.01, 1.0, -1417.0)
    assert far == pytest.approx(before * (1417.0 / 1417.9) ** 0.01, rel=1e-8)  # there it falls by a power


def test_limits_of_the_high_pass():
    signal = np.random.default_rng(3).normal(size=(50, 2))
    assert high_pass(np.full((50, 2), 3.0), 0.01, 0.3) == pytest.approx(0.0, abs=1e-12)
    assert high_pass(np.zeros((0, 2)), 0.01, 0.3).shape == (0, 2)
    near, whole = high_pass(signal, 0.01, 0.3, 2.0 + 1e-9), high_pass(signal, 0.01, 0.3, 2.0)
    assert near == pytest.approx(whole, abs=1e-7)
    for bad in ((0.0, 0.1, 1.0), (0.1, -1.0, 1.0), (0.1, 0.1, 4.5), (0.1, 0.1, -0.5)):
        with pytest.raises(InvalidPatchError, match="high-pass"):
            high_pass(signal, *bad)


@pytest.mark.parametrize("order", [1.0, 1.5, 2.0])
def test_rates_through_the_high_pass(order):
    item = HighPass("*", 0.4, order)
    values, rates = shown(item)
    assert rates[1:-1] == pytest.approx((values[2:] - values[:-2]) / 0.02, abs=2e-3 if order != 1.5 else 2e-2)
    assert values[0] == pytest.approx(0.0, abs=1e-12)  # released: it had been held
    # settled under what acts at the first sample
    np.testing.assert_array_equal(shown(item, record=FORCED)[0], values)
    moving = replace(FORCED, settled=False)  # about zero, which the filter had followed
    assert shown(item, record=moving)[0][0] == pytest.approx(VALUES[0])
    quick = tuple((name, "acceleration") for name, _ in CHANNELS)  # which is none at rest: a step
    for record in (RECORD, FORCED):
        assert shown(item, record=replace(record, channels=quick))[0][0] == pytest.approx(VALUES[0])
        before = FilterMemory(None, 0.0).filter_row(
            HighPass("*", 0.4), replace(record, channels=quick), VALUES[:1], RATES
        )
        assert before[0] == pytest.approx(VALUES[:1])
    settled, _ = applied(ModelPatch((item,)), replace(RECORD, kind="flight"), VALUES, None)
    assert np.array_equal(settled, VALUES)


def test_a_high_pass_follows_uneven_stamps():
    time = 0.01 * (np.arange(400) + 0.6 * np.random.default_rng(1).uniform(-0.5, 0.5, 400))
    time = np.delete(time - time[0], slice(133, 140))  # and a gap
    wave = 2.0 * np.pi * 1.3
    record = SensorRecord((("x", "velocity"),), "forced", time, 0.0, np.zeros(len(time)))
    signal, rates = np.sin(wave * time)[:, None], wave * np.cos(wave * time)[:, None]
    found, _ = applied(ModelPatch((HighPass("x", 0.3),)), record, signal, rates)
    # y' = x' - y / tau from rest: steady part and what the begin leaves
    steady = np.imag(1j * wave * 0.3 / (1.0 + 1j * wave * 0.3) * np.exp(1j * wave * time))
    # the gap of eight intervals is bridged by a straight line
    np.testing.assert_allclose(found[:, 0], steady - steady[0] * np.exp(-time / 0.3), atol=8e-3)
