"""Patches: expressions, kinds, the digital state; sensors against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fe.high_pass import filtered_record
from fe.runtime import patch
from fe.runtime.errors import InvalidPatchError, InvalidStateError
from fe.runtime.expression import Expression
from fe.runtime.patch import (
    PRIMITIVES,
    Clock,
    ModelPatch,
    RunOffset,
    SensorDrift,
    SensorGain,
    SensorRotation,
)
from fe.runtime.sensors import FilterMemory, apply_sensors, check_channels
from fe.runtime.state import DigitalState, Geometry, default_region_names, losses_of
from tests.fe.runtime.sensor_records import (
    CHANNELS,
    FLIGHT,
    FORCED,
    RATES,
    RINGDOWN,
    STATIC,
    TIME,
    VALUES,
    reading_of,
    show,
)
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
numbers = st.floats(-1e3, 1e3)

# ---------------------------------------------------------------- expressions

FORMULA = "(a + 2*b)/c - -a**2 + sqrt(c)*min(a, b, 0) + abs(b)*exp(-c)"


def parse(text: str) -> Expression:
    """Return an expression of a, b and c."""
    return Expression(text, frozenset({"a", "b", "c"}), "Here")


def formula_in_python(a: float, b: float, c: float) -> float:
    """Return the value of `FORMULA` by Python."""
    root = math.sqrt(c) * min(a, b, 0)
    return (a + 2 * b) / c - -(a**2) + root + abs(b) * float(np.exp(-c))


@given(numbers, numbers, st.floats(1e-3, 1e3))
def test_arithmetic_is_that_of_python(a, b, c):
    value = parse(FORMULA).value({"a": a, "b": b, "c": c})

    assert value == formula_in_python(a, b, c)


@given(numbers, numbers, st.floats(1e-3, 1e3))
def test_numbers_can_take_the_place_of_names(a, b, c):
    filled = Expression(parse(FORMULA).with_numbers({"a": a, "b": b}), {"c"}, "Here")

    assert filled.used_names() == {"c"}
    assert filled.value({"c": c}) == formula_in_python(a, b, c)


def test_an_expression_needs_the_values_of_its_names():
    filled = Expression(parse(FORMULA).with_numbers({"a": 1.0, "b": 2.0}), {"c"}, "Here")

    with refused(InvalidPatchError, "needs 'c', which has no value"):
        filled.value({})


NO_EXPRESSIONS = [text for (text,) in INPUTS.refused("expressions")]


@pytest.mark.parametrize("text", [*NO_EXPRESSIONS, "a" + "+a" * 400, "9" * 5000])
def test_anything_else_is_refused_with_a_sentence(text):
    with refused(InvalidPatchError, r"^Here\b"):
        parse(text).value({"a": 1.0, "b": 1.0, "c": 1.0})


@given(numbers, st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=5))
def test_a_course_has_the_values_of_its_times(a, times):
    text = "a*max(0, time - 1, b) + step(time - 2)*sin(time)/(1 + abs(a))"
    formula = Expression(text, {"a", "b", "time"}, "Here")
    values = {"a": a, "b": -2.0}

    course = formula.values_over_time(np.array(times), values)

    single = [formula.value({**values, "time": time}) for time in times]
    np.testing.assert_allclose(course, single, rtol=1e-14, atol=1e-14)


def test_kinds_are_the_keys_of_patches_that_were_kept():
    assert list(PRIMITIVES) == INPUTS.text("kinds.txt").split()


# ---------------------------------------------------------------- the digital state

REGIONS = ("root", "z2", "tip")


@pytest.mark.parametrize(("changes", "place"), INPUTS.refused("states"))
def test_impossible_states_are_refused_with_the_place(changes, place):
    record = Geometry if place.startswith("geometry") else DigitalState

    with refused(InvalidStateError, place):
        record(**changes)


def test_regions_without_names_are_numbered():
    assert default_region_names(3) == ("z1", "z2", "z3")


@pytest.mark.parametrize(
    ("losses", "in_order"),
    [
        ({"tip": 0.4, "root": 0.1}, (0.1, 0.0, 0.4)),
        ([0.1, 0.2, 0.3], (0.1, 0.2, 0.3)),
        ((), (0.0, 0.0, 0.0)),
    ],
)
def test_losses_stand_in_the_order_of_the_regions(losses, in_order):
    assert losses_of(losses, REGIONS) == in_order


@pytest.mark.parametrize(
    ("losses", "sentence"),
    [
        ({"z1": 0.1}, "no damage region 'z1'; the regions are root, z2, tip"),
        ((0.1, 0.2), "3 fractions, one for each of root, z2, tip, but 2"),
    ],
)
def test_losses_of_other_regions_are_refused(losses, sentence):
    with pytest.raises(InvalidStateError, match=sentence):
        losses_of(losses, REGIONS)


# ---------------------------------------------------------------- gain, drift, choice of channels


def test_a_drift_after_a_gain_is_not_amplified():
    values, _ = show(SensorGain("g0", 0.5), SensorDrift("g0", 2e-3, 100.0))

    drift = 2e-3 * (100.0 + TIME) / 100.0
    assert reading_of("g0", values) == pytest.approx(1.5 * reading_of("g0", VALUES) + drift)


def test_a_gain_after_a_drift_amplifies_the_drift():
    values, rates = show(SensorDrift("g0", 2e-3, 100.0), SensorGain("g0", 0.5))

    drift = 2e-3 * (100.0 + TIME) / 100.0
    assert reading_of("g0", values) == pytest.approx(1.5 * (reading_of("g0", VALUES) + drift))
    assert reading_of("g0", rates) == pytest.approx(1.5 * (reading_of("g0", RATES) + 2e-5))


def test_a_gain_of_one_channel_leaves_the_others():
    values, _ = show(SensorGain("g0", 0.5), SensorDrift("g0", 2e-3, 100.0))

    for name in ("tip", "g1"):
        assert np.array_equal(reading_of(name, values), reading_of(name, VALUES))


@pytest.mark.parametrize(
    ("kind", "arguments", "trial", "changed"), INPUTS.table("channels.toml")["row"]
)
def test_channels_are_chosen_by_name_quantity_and_kind_of_trial(kind, arguments, trial, changed):
    primitive = patch.PRIMITIVES[kind](*arguments)

    values, _ = show(primitive, record=replace(RINGDOWN, kind=trial))

    differs = np.any(values != VALUES, axis=0)
    assert np.flatnonzero(differs).tolist() == changed
    if isinstance(primitive, RunOffset):
        assert values[:, changed] == pytest.approx(VALUES[:, changed] + 1e-3)


def test_a_drift_of_a_static_trial_follows_its_own_time():
    values, _ = show(SensorDrift("tip", 1.0, 50.0), record=replace(STATIC, time=100.0 * TIME))

    assert reading_of("tip", values) == pytest.approx(reading_of("tip", VALUES) + 2.0 * TIME)


def test_a_drift_by_the_root_of_time_has_finite_rates_from_its_begin():
    values, rates = show(SensorDrift("tip", 1.0, 2.0, 0.5), record=replace(RINGDOWN, start=0.0))

    drift = np.sqrt(TIME / 2.0)
    assert reading_of("tip", values) == pytest.approx(reading_of("tip", VALUES) + drift)
    assert np.all(np.isfinite(rates))


# ---------------------------------------------------------------- saturation

SATURATION = patch.SensorSaturation("*", 2e-3, "strain")


def test_a_saturating_sensor_shows_the_formula():
    values, _ = show(SATURATION)

    for name in ("g0", "g1"):
        saturated = 2e-3 * np.tanh(reading_of(name, VALUES) / 2e-3)
        assert reading_of(name, values) == pytest.approx(saturated, rel=1e-14)


def test_rates_of_a_saturating_sensor_are_those_by_finite_differences():
    step = 1e-6
    _, rates = show(SATURATION)

    ahead, _ = show(SATURATION, values=VALUES + step * RATES)
    behind, _ = show(SATURATION, values=VALUES - step * RATES)

    slope = (ahead - behind) / (2.0 * step)
    assert rates == pytest.approx(slope, abs=1e-9 * np.abs(RATES).max())


def test_far_below_the_limit_saturation_changes_nothing():
    values, _ = show(replace(SATURATION, limit=1e6))

    assert values == pytest.approx(VALUES, rel=1e-12)


def test_saturation_in_a_window_leaves_what_is_before():
    always, _ = show(SATURATION)
    is_before = TIME[:, np.newaxis] < 1.0

    values, _ = show(replace(SATURATION, windows=(patch.Window("a", 1.0, None),)))

    assert np.array_equal(values, np.where(is_before, VALUES, always))


# ---------------------------------------------------------------- lag

LAG = 0.0137


def test_a_lagging_channel_shows_a_cubic_course_exactly_later():
    course = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5])
    rate = course.deriv()
    is_later = TIME >= LAG

    values, rates = show(
        patch.SensorLag("tip", LAG),
        record=replace(FORCED, settled=False),
        values=np.tile(course(TIME)[:, np.newaxis], 3),
        rates=np.tile(rate(TIME)[:, np.newaxis], 3),
    )

    lagging = reading_of("tip", values)
    lagging_rate = reading_of("tip", rates)
    before_first_sample = 1.0 - 2.0 * (TIME[~is_later] - LAG)
    assert lagging[is_later] == pytest.approx(course(TIME[is_later] - LAG), rel=1e-12)
    assert lagging_rate[is_later] == pytest.approx(rate(TIME[is_later] - LAG), rel=1e-11)
    assert lagging[~is_later] == pytest.approx(before_first_sample)


def test_a_lag_of_one_channel_leaves_the_others():
    values, _ = show(patch.SensorLag("tip", LAG), record=replace(FORCED, settled=False))

    assert np.array_equal(reading_of("g0", values), reading_of("g0", VALUES))


def test_a_lagging_channel_of_a_settled_record_stood_still_before():
    values, rates = show(patch.SensorLag("g0", LAG), record=FORCED)

    first_value = reading_of("g0", VALUES)[0]
    assert reading_of("g0", values)[:2].tolist() == [first_value, first_value]
    assert reading_of("g0", rates)[:2].tolist() == [0.0, 0.0]


def test_a_channel_ahead_of_its_record_goes_on_with_its_last_rate():
    values, _ = show(patch.SensorLag("tip", -0.015), record=FORCED)

    ahead = reading_of("tip", values)
    goes_on = reading_of("tip", VALUES)[-1] + 0.015 * reading_of("tip", RATES)[-1]
    assert ahead[:-2] == pytest.approx(np.cos(3 * (TIME[:-2] + 0.015)), abs=1e-8)
    assert ahead[-1] == pytest.approx(goes_on)


# ---------------------------------------------------------------- rotation, lines


@given(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@settings(max_examples=60)
def test_rotation_is_that_of_the_strain_tensor(angle, transverse, shear):
    """Two rotations of one gauge add up, and a gain acts on what the turned gauge shows."""
    tensor = np.array([[1.0, shear / 2.0], [shear / 2.0, transverse]])
    direction = np.array([np.cos(angle), np.sin(angle)])
    factor = 2.0 * direction @ tensor @ direction

    values, rates = show(
        SensorGain("g0", 1.0),
        SensorRotation("g0", angle / 3),
        SensorRotation("g0", angle * 2 / 3),
        transverse=transverse * VALUES,
        shear=shear * VALUES,
    )

    rate = reading_of("g0", rates)[1:-1]
    expected_rate = factor * reading_of("g0", RATES)[1:-1]
    assert reading_of("g0", values) == pytest.approx(factor * reading_of("g0", VALUES), abs=1e-15)
    assert rate == pytest.approx(expected_rate, abs=8e-6)


def test_a_line_is_a_wave_over_the_time_of_the_trial():
    values, _ = show(patch.Line("tip", 50.0, 0.3, -0.4))

    wave = (0.3 + 0.4j) * np.exp(100j * np.pi * TIME)
    added = reading_of("tip", values) - reading_of("tip", VALUES)
    assert added == pytest.approx(wave.real, abs=1e-12)


def test_a_decaying_line_is_a_damped_wave_with_its_rate():
    values, rates = show(patch.DecayingLine("g1", 2.0, 0.05, 0.1, 0.2))

    omega = 4 * np.pi
    root = complex(-0.05 * omega, omega * np.sqrt(1 - 0.05**2))
    wave = 0.05 * (0.1 - 0.2j) * np.exp(root * TIME)
    added = reading_of("g1", values) - reading_of("g1", VALUES)
    added_rate = reading_of("g1", rates) - reading_of("g1", RATES)
    assert added == pytest.approx(wave.real, abs=1e-14)
    assert added_rate == pytest.approx((root * wave).real, abs=1e-13)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(("kind", "arguments", "sentence"), INPUTS.refused("sensors"))
def test_impossible_sensors_are_refused_in_one_sentence(kind, arguments, sentence):
    sensors = ModelPatch((patch.PRIMITIVES[kind](*arguments),))
    row_by_row = FilterMemory(None, 0.1).filter_row

    with refused(InvalidPatchError, sentence):
        check_channels(sensors, CHANNELS)
        apply_sensors(sensors, RINGDOWN, VALUES, RATES, high_pass=row_by_row)


def test_sensors_of_any_of_the_channels_are_accepted():
    sensors = ModelPatch((SensorGain("*", 0.1), SensorGain("g1", 0.1), Clock(0.0, 0.1)))

    check_channels(sensors, CHANNELS)


def test_a_settled_flight_needs_no_rates():
    filtered = ModelPatch((patch.HighPass("*", 0.4, 1.0),))

    values, _ = apply_sensors(filtered, FLIGHT, VALUES, None, high_pass=filtered_record)

    assert np.array_equal(values, VALUES)
