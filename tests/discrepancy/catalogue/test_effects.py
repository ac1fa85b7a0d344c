"""Every effect on a real model: what it changes, what it does not, over its whole prior."""

from __future__ import annotations

import json
import pickle
from collections.abc import Mapping
from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.cantilever import LENGTH, TIP, Cantilever, campaign
from benchmarks.effect_pictures import FLOWS
from discrepancy.campaign.noise import aliased
from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind
from discrepancy.catalogue.entry import LEAST_SHRINKAGE, Effect, Prior, Setting
from discrepancy.catalogue.library import library
from discrepancy.catalogue.places import mains_lines
from discrepancy.catalogue.scales import loss_integral
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import (
    EVERY_CHANNEL,
    SENSORS,
    DecayingLine,
    FreePlay,
    HighPass,
    Line,
    LoadGain,
    ModelPatch,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    RootCompliance,
    RunOffset,
    SensorDrift,
    StiffnessDrift,
)

BEAM = [effect for effect in library() if effect.identifier not in FLOWS]  # flows need a store: test_outflow
VANISHING = pytest.mark.parametrize(
    "effect",
    [effect for effect in BEAM if any(item.magnitude for item in effect.parameters)],
    ids=lambda effect: effect.identifier,
)
EFFECTS = pytest.mark.parametrize("effect", BEAM, ids=lambda effect: effect.identifier)


def medians(effect: Effect) -> dict[str, float]:
    """Prior medians; one deviation above zero where the median is no effect."""
    return {item.name: item.prior.value(0.0) or item.prior.value(1.0) for item in effect.parameters}


def shown(setting: Setting, trial: Trial, patch: ModelPatch, campaign: Campaign | None = None) -> np.ndarray:
    return observe(setting.model, campaign or setting.campaign, trial, patch, Conditions(np.ones(1))).values


def only(setting: Setting, effect: Effect, values: Mapping[str, float], place: str) -> Primitive:
    (primitive,) = effect.patch(setting, values, place)
    return primitive


@EFFECTS
def test_it_is_available_and_has_a_place(effect: Effect, setting: Setting) -> None:
    assert effect.unavailable(setting) is None
    places = effect.places(setting)
    assert places
    assert len(set(places)) == len(places)


@EFFECTS
def test_it_changes_the_trials_that_it_acts_on_and_no_other(effect: Effect, setting: Setting) -> None:
    touched = set()
    for place in effect.places(setting):
        patch = effect.patch(setting, medians(effect), place)
        assert len(patch)
        for trial in setting.campaign.trials:
            change = shown(setting, trial, patch) - trial.values
            if np.max(np.abs(change) / np.max(np.abs(trial.values), axis=0)) > 1e-3:
                touched.add(trial.kind)
            if trial.kind not in effect.acts_on:
                assert not np.any(change)
    exempt = (
        {TrialKind.FLIGHT} if effect.identifier == "point_mass" else set()
    )  # the cantilever has no weight
    exempt |= (
        {TrialKind.FORCED, TrialKind.RINGDOWN, TrialKind.FLIGHT}
        if effect.identifier in ("temperature_dependent_modulus", "thermal_strain")
        else set()  # one temperature in these trials
    )
    exempt |= {TrialKind.DRIVEN}  # there is none
    assert touched | exempt == effect.acts_on | exempt


@VANISHING
def test_without_magnitude_nothing_changes(effect: Effect, setting: Setting) -> None:
    values = {item.name: 0.0 if item.magnitude else medians(effect)[item.name] for item in effect.parameters}
    for place in effect.places(setting):
        patch = effect.patch(setting, values, place)
        for trial in setting.campaign.trials:
            scale = np.max(np.abs(trial.values), axis=0)
            np.testing.assert_allclose(shown(setting, trial, patch) / scale, trial.values / scale, atol=1e-12)


@VANISHING
def test_a_small_magnitude_changes_little(effect: Effect, setting: Setting) -> None:
    """Continuous at zero: no step between no effect and a small one."""
    middle = medians(effect)
    small = {item.name: middle[item.name] * (1e-7 if item.magnitude else 1.0) for item in effect.parameters}
    place = effect.places(setting)[0]
    for trial in setting.campaign.trials:
        scale = np.max(np.abs(trial.values), axis=0)
        change = (shown(setting, trial, effect.patch(setting, small, place)) - trial.values) / scale
        assert np.max(np.abs(change)) < 1e-4


@EFFECTS
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_it_builds_over_its_whole_prior(effect: Effect, setting: Setting, data: st.DataObject) -> None:
    items = (*effect.parameters, *effect.shape)
    values = {item.name: item.prior.value(data.draw(st.floats(-6.0, 6.0))) for item in items}
    place = data.draw(st.sampled_from(effect.places(setting)))
    patch = effect.patch(setting, values, place)
    assert ModelPatch.from_list(json.loads(json.dumps(patch.to_list()))) == patch
    for primitive in patch:
        assert isinstance(primitive, SENSORS) or setting.model.supports(type(primitive))
        if isinstance(primitive, PointMass):
            assert 0.0 <= primitive.station <= LENGTH
        if isinstance(primitive, PowerStiffness):
            continue  # softening without limit has no solution under every load
        if not isinstance(primitive, SENSORS):
            for trial in setting.campaign.trials[:1]:
                assert np.all(np.isfinite(shown(setting, trial, patch)))


@EFFECTS
def test_its_shape_is_free_around_the_canonical_one(effect: Effect, setting: Setting) -> None:
    place = effect.places(setting)[0]
    named = effect.patch(setting, medians(effect), place)
    assert effect.patch(setting, {**medians(effect), **effect.canonical_shape()}, place) == named
    for item in effect.shape:
        assert abs(item.prior.normal(item.canonical)) < 2.0
        moved = {**medians(effect), item.name: item.prior.value(item.prior.normal(item.canonical) + 1.0)}
        assert effect.patch(setting, moved, place) != named


@EFFECTS
def test_priors_are_inverted(effect: Effect) -> None:
    for item in (*effect.parameters, *effect.shape):
        for u in (-2.0, -0.3, 0.0, 1.5):
            assert item.prior.normal(item.prior.value(u)) == pytest.approx(u, abs=1e-9)


@EFFECTS
def test_it_can_be_sent_to_another_process(effect: Effect, setting: Setting) -> None:
    copy = pickle.loads(pickle.dumps(effect))
    place = effect.places(setting)[-1]
    assert copy.patch(setting, medians(effect), place) == effect.patch(setting, medians(effect), place)


def test_all_but_the_filter_vanish_with_a_magnitude(setting: Setting) -> None:
    """However low its corner is, a filter that had settled takes off the value before a release."""
    (other,) = [effect for effect in library() if not any(item.magnitude for item in effect.parameters)]
    assert other.identifier == "high_pass"
    assert len(other.patch(setting, {"corner_ratio": 0.0}, "tip")) == 0
    pushed = next(trial for trial in setting.campaign.trials if trial.name == "pushed")
    slow = other.patch(setting, {"corner_ratio": 1e-9}, "tip")
    np.testing.assert_allclose(shown(setting, pushed, slow), pushed.values, atol=1e-8)


# ---------------------------------------------------------------- the numbers mean what they say


def by_name(identifier: str) -> Effect:
    return next(effect for effect in library() if effect.identifier == identifier)


@pytest.mark.parametrize(("p", "a"), [(0.0, 0.0), (0.0, 1.0), (2.0, 0.0), (1.3, 0.7)])
def test_the_loss_of_a_cycle(p: float, a: float) -> None:
    angle = (np.arange(400_000) + 0.5) * 2.0 * pi / 400_000
    loss = np.mean(np.abs(np.cos(angle)) ** (p + 1.0) * np.abs(np.sin(angle)) ** a) * 2.0 * pi
    assert loss == pytest.approx(2.0 * loss_integral(p, a), rel=1e-5)


def test_damping_forces_in_closed_form(setting: Setting) -> None:
    port = setting.scales.ports["span"]
    k, A, w = port.stiffness, port.displacement, port.angular_frequency
    drag = only(setting, by_name("quadratic_damping"), {"equivalent_damping_ratio": 0.01}, "span")
    assert isinstance(drag, PowerDamping)
    c = drag.coefficient / drag.reference_velocity**2
    assert 4.0 * c * A * w**2 / (3.0 * pi * k) == pytest.approx(0.01)
    friction = only(setting, by_name("coulomb_friction"), {"friction_ratio": 0.02}, "span")
    assert isinstance(friction, PowerDamping)
    assert friction.coefficient == pytest.approx(0.02 * k * A)
    hysteretic = only(setting, by_name("structural_damping"), {"loss_factor": 0.03}, "span")
    assert isinstance(hysteretic, PowerDamping)
    assert hysteretic.coefficient / hysteretic.reference_displacement == pytest.approx(0.03 * k)


@pytest.mark.parametrize(
    ("identifier", "values", "port", "ratio"),
    [
        ("quadratic_damping", {"equivalent_damping_ratio": 0.005}, "tip", lambda share: 0.005 * share),
        ("coulomb_friction", {"friction_ratio": 0.003}, "tip", lambda share: 2.0 / pi * 0.003 / share),
        ("structural_damping", {"loss_factor": 0.01}, "tip", lambda share: 0.01 / pi),
    ],
)
def test_a_ringdown_is_damped_as_the_equivalent_ratio_says(
    setting: Setting, identifier: str, values: dict[str, float], port: str, ratio: object
) -> None:
    """The logarithmic decrement of the first cycles, less that of the model itself."""
    trial = next(item for item in setting.campaign.trials if item.name == "half")
    column = trial.channels.index("tip")
    effect = by_name(identifier)
    decrement = []
    for patch in (ModelPatch(), effect.patch(setting, values, port)):
        motion = shown(setting, trial, patch)[:, column]
        inner = (motion[1:-1] > motion[:-2]) & (motion[1:-1] >= motion[2:]) & (motion[1:-1] > 0.0)
        at = np.flatnonzero(inner) + 1
        before, middle, after = motion[at - 1], motion[at], motion[at + 1]
        peaks = middle + (after - before) ** 2 / (8.0 * (2.0 * middle - before - after))
        decrement.append((np.log(peaks[1] / peaks[5]) / (4 * 2.0 * pi), np.sqrt(peaks[1] * peaks[5])))
    (plain, _), (damped, size) = decrement
    share = size / setting.scales.ports[port].displacement
    assert damped - plain == pytest.approx(ratio(share), rel=0.08)  # type: ignore[operator]


def test_the_root_adds_its_share_to_the_tip_compliance(setting: Setting) -> None:
    spring = only(setting, by_name("root_compliance"), {"compliance_share": 0.1}, "")
    assert isinstance(spring, RootCompliance)
    assert spring.compliance * LENGTH**2 * setting.scales.tip_stiffness == pytest.approx(0.1)
    trial = replace(setting.campaign.trials[0], load_place=(LENGTH, 0.25))
    column = trial.channels.index("tip")
    ratio = shown(setting, trial, ModelPatch((spring,))) / shown(setting, trial, ModelPatch())
    np.testing.assert_allclose(ratio[:, column], 1.1, rtol=1e-9)
    np.testing.assert_allclose(np.delete(ratio, column, axis=1), 1.0, rtol=1e-9)  # strain as before


def test_a_mass_lowers_the_frequency_as_rayleigh_says(setting: Setting) -> None:
    model = Cantilever()
    mass = only(setting, by_name("point_mass"), {"mass_ratio": 0.01, "station_ratio": 1.0}, "")
    assert isinstance(mass, PointMass)
    trial = setting.campaign.trials[3]
    conditions = Conditions(np.ones(1))
    outputs = (("tip_displacement", Quantity.DISPLACEMENT),)
    peaks = []
    for patch in (ModelPatch(), ModelPatch((mass,))):
        motion = model.respond(trial, outputs, patch, conditions).values[:, 0]
        spectrum = np.abs(np.fft.rfft(motion * np.hanning(len(motion)), 64 * len(motion)))
        peaks.append(np.argmax(spectrum))
    assert peaks[1] / peaks[0] == pytest.approx(1.0 - 0.005, abs=2e-4)
    assert TIP @ TIP == 1.0


def test_other_scales(setting: Setting) -> None:
    scales = setting.scales
    gap = only(setting, by_name("free_play"), {"gap_ratio": 0.1, "stiffness_share": 5.0}, "root")
    assert isinstance(gap, FreePlay)
    assert gap.stiffness == pytest.approx(0.9 * (scales.ports["root"].static_stiffness or 0.0))
    assert gap.half_width == pytest.approx(0.1 * scales.ports["root"].displacement)
    most = 0.9 * (scales.ports["root"].static_stiffness or 0.0) * scales.ports["root"].displacement
    friction = only(setting, by_name("coulomb_friction"), {"friction_ratio": 50.0}, "root")
    assert isinstance(friction, PowerDamping)
    assert friction.coefficient == pytest.approx(most)  # more would hold it still, which no drag does
    drag = only(
        setting, by_name("coulomb_friction"), {"friction_ratio": 50.0, "velocity_exponent": 2.0}, "root"
    )
    assert isinstance(drag, PowerDamping)
    assert drag.coefficient > 10.0 * most
    drift = only(setting, by_name("stiffness_drift"), {"stiffness_change": 0.05}, "")
    assert drift == StiffnessDrift(0.05 / scales.duration)
    cell = only(setting, by_name("load_cell"), {"gain_error": 0.02, "tare_ratio": 0.01}, "")
    assert cell == LoadGain(0.02, pytest.approx(0.3))
    seat = only(setting, by_name("seating_offset"), {"offset_ratio": 0.02}, "B")
    assert seat == RunOffset("B", pytest.approx(0.02 * 30.0 / scales.tip_stiffness))
    zero = only(setting, by_name("gauge_zero_drift"), {"drift_ratio": 0.1}, "g1")
    largest = max(float(np.max(np.abs(trial.values[:, 2]))) for trial in setting.campaign.trials)
    assert zero == SensorDrift("g1", pytest.approx(0.1 * largest), scales.campaign_time)
    coupling = only(setting, by_name("high_pass"), {"corner_ratio": 0.1}, EVERY_CHANNEL)
    assert isinstance(coupling, HighPass)
    assert 1.0 / coupling.time_constant == pytest.approx(0.1 * scales.angular_frequency)
    crack = only(setting, by_name("breathing_crack"), {"stiffness_loss": 0.2}, "root, upper skin")
    assert isinstance(crack, PowerStiffness)
    assert (crack.side, crack.exponent) == (-1, 1.0)
    assert crack.coefficient < 0.0
    mode = only(
        setting, by_name("unmodelled_mode"),
        {"frequency_ratio": 2.0, "damping_ratio": 0.01, "cosine_ratio": 0.1, "sine_ratio": 0.0}, "tip",
    )  # fmt: skip
    assert isinstance(mode, DecayingLine)
    assert mode.frequency == pytest.approx(2.0 * scales.angular_frequency / (2.0 * pi))
    assert mode.cosine == pytest.approx(0.1, rel=1e-3)  # the tip is released from its largest reading


def test_a_crack_opens_on_one_side_only(setting: Setting) -> None:
    up, down = setting.campaign.trials[:2]
    for skin, open_in, closed_in in (("lower", up, down), ("upper", down, up)):
        patch = by_name("breathing_crack").patch(setting, {"stiffness_loss": 0.3}, f"root, {skin} skin")
        assert np.max(np.abs(shown(setting, open_in, patch) - open_in.values)) > 1e-4
        np.testing.assert_allclose(shown(setting, closed_in, patch), closed_in.values, rtol=1e-9, atol=1e-15)


# ---------------------------------------------------------------- mains and sampling


@pytest.mark.parametrize(
    ("rate", "lines"),
    [
        (1000.0, ("50 Hz", "60 Hz", "400 Hz")),
        (60.0, ("50 Hz", "400 Hz")),  # 60 Hz is a constant
        (110.0, ("50 or 60 Hz", "400 Hz")),
        (50.0, ("60 Hz",)),
        (20.0, ("50 Hz",)),  # at 10 Hz, every second sample of the other sign
        (10.0, ()),
    ],
)
def test_lines_that_a_sampling_rate_can_show(setting: Setting, rate: float, lines: tuple[str, ...]) -> None:
    trial = next(item for item in setting.campaign.trials if item.name == "release")
    resampled = replace(trial, time=np.arange(len(trial.time)) / rate)
    given = replace(setting, campaign=replace(setting.campaign, trials=(resampled,)))
    assert mains_lines(given) == lines
    hum = by_name("mains_hum")
    assert (hum.unavailable(given) is None) == bool(lines)


@given(st.floats(1.0, 500.0), st.floats(5.0, 2000.0))
def test_an_alias_has_the_same_samples(frequency: float, rate: float) -> None:
    time = np.arange(20) / rate
    seen = aliased(frequency, 1.0 / rate)
    assert 0.0 <= seen <= 0.5 * rate * (1.0 + 1e-12)
    np.testing.assert_allclose(
        np.cos(2.0 * pi * seen * time),
        np.cos(2.0 * pi * frequency * time),
        atol=1e-6 * (1 + frequency / rate),
    )


def test_hum_on_all_channels_of_a_quantity(setting: Setting) -> None:
    values = {"cosine_ratio": 0.01, "sine_ratio": 0.0, "frequency_error": 0.0}
    line = only(setting, by_name("mains_hum"), values, "50 Hz, all strain")
    assert isinstance(line, Line)
    assert (line.channel, line.quantity, line.frequency) == (EVERY_CHANNEL, "strain", 50.0)


# ---------------------------------------------------------------- what a campaign cannot carry


def without(setting: Setting, *kinds: TrialKind, **changes: object) -> Setting:
    trials = tuple(trial for trial in setting.campaign.trials if trial.kind not in kinds)
    return replace(setting, campaign=replace(setting.campaign, trials=trials, **changes))  # type: ignore[arg-type]


def names_available(setting: Setting) -> set[str]:
    reasons = {effect.identifier: effect.unavailable(setting) for effect in library()}
    for reason in reasons.values():
        assert reason is None or (reason.endswith(".") and reason[0].isupper())
    return {name for name, reason in reasons.items() if reason is None}


def test_a_static_campaign_has_no_dynamic_effects(setting: Setting) -> None:
    static = without(setting, TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.FLIGHT)
    assert names_available(static).isdisjoint(
        {
            "point_mass", "coulomb_friction", "structural_damping", "quadratic_damping", "stiffness_drift",
            "high_pass", "clock_error", "mains_hum", "unmodelled_mode", "washout", "inertia_relief",
        }
    )  # fmt: skip


def test_a_ringdown_alone_has_no_load_no_flight_no_seating(setting: Setting) -> None:
    free = without(setting, TrialKind.STATIC, TrialKind.FORCED, TrialKind.FLIGHT)
    assert names_available(free).isdisjoint(
        {"load_place", "load_cell", "seating_offset", "washout", "inertia_relief", "thermal_strain"}
    )


def test_temperatures_that_were_not_recorded_or_did_not_vary(setting: Setting) -> None:
    warm = {"thermal_strain", "temperature_dependent_modulus"}
    assert warm <= names_available(setting)
    assert names_available(without(setting, reference_temperature=None)).isdisjoint(warm)
    trials = tuple(trial for trial in setting.campaign.trials if trial.name != "warm")
    same = replace(setting, campaign=replace(setting.campaign, trials=trials))
    assert names_available(same).isdisjoint(warm)


def test_a_free_gain_absorbs_a_gain_error(setting: Setting) -> None:
    channels: dict[str, Channel] = {
        name: replace(channel, gain_deviation=np.inf) for name, channel in setting.campaign.channels.items()
    }
    assert "gauge_gain" not in names_available(without(setting, channels=channels))


class OutputsOnly(Cantilever):
    """The cantilever behind a door that shows neither its inside nor its ports."""

    def supports(self, primitive: type[Primitive]) -> bool:
        return False

    def ports(self) -> tuple[str, ...]:
        return ()

    def stations(self) -> None:  # type: ignore[override]
        return None


def test_a_model_that_carries_nothing_still_has_sensors(setting: Setting) -> None:
    bare = replace(setting, model=OutputsOnly())
    available = names_available(bare)
    assert {"gauge_gain", "gauge_zero_drift", "thermal_strain", "clock_error", "mains_hum"} <= available
    assert available.isdisjoint(
        {"point_mass", "coulomb_friction", "cubic_stiffness", "load_place", "washout"}
    )


def test_a_port_that_does_not_exist(setting: Setting) -> None:
    with pytest.raises(CatalogueError, match="has no port 'flap'; it has root, tip, span"):
        by_name("coulomb_friction").patch(setting, {"friction_ratio": 0.1}, "flap")


def test_the_campaign_of_these_tests_has_releases() -> None:
    assert [trial.release for trial in campaign().trials if trial.kind is TrialKind.RINGDOWN] == [
        Release(0.08), Release(0.04),
    ]  # fmt: skip


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_steps_of_sizes_are_straight_in_the_value(u: float, step: float) -> None:
    """What grows with a value is followed exactly; no step passes zero; other priors are straight already."""
    prior = Prior("log_normal", 0.01, 1.0)
    slope = (prior.value(u + 1e-6) - prior.value(u - 1e-6)) / 2e-6
    target = prior.value(u) + slope * step
    reached = prior.value(prior.stepped(u, step))
    assert reached == pytest.approx(max(target, LEAST_SHRINKAGE * prior.value(u)), rel=1e-6)
    assert Prior("normal", -1.0, 1.0).stepped(u, step) == u + step
