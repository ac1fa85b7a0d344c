"""Every effect on a real model, over its whole prior; what lumped models are offered; its page."""

import json
import pickle
import struct
from dataclasses import replace
from itertools import product
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.cantilever import LENGTH
from benchmarks.effect_pages import FOLDER, pages
from benchmarks.effect_pictures import FLOWS, REGION_LOSSES, draw, picture_setting
from benchmarks.tank import tank_setting
from discrepancy.campaign.records import Channel, Quantity, Start, TrialKind
from discrepancy.catalogue.entry import LEAST_SHRINKAGE, Prior
from discrepancy.catalogue.library import library
from discrepancy.catalogue.places import mains_lines
from discrepancy.errors import CatalogueError
from discrepancy.sources.examples import example_campaign, plan_from_scales
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import ACROSS, Conditions
from discrepancy.system.sensing import observe
from fe.runtime import patch as patches
from fe.runtime.patch import FreePlay, LoadGain, ModelPatch, PointMass, PowerStiffness, SensorGain
from tests.discrepancy.rigs import INPUTS, asked, campaign, chosen, model_of, seen, setting_of

pytestmark = pytest.mark.xdist_group("compiling")

# flows need a store (test_outflow), losses of regions a structure with regions (test_regions_of_structures)
BEAM = [effect for effect in library() if effect.identifier not in (*FLOWS, *REGION_LOSSES)]
WARM = {"thermal_strain", "temperature_dependent_modulus"}
VANISHING = pytest.mark.parametrize(
    "effect",
    [effect for effect in BEAM if any(item.magnitude for item in effect.parameters)],
    ids=lambda effect: effect.identifier,
)
EFFECTS = pytest.mark.parametrize("effect", BEAM, ids=lambda effect: effect.identifier)


def medians(effect):
    """Prior medians; one deviation above zero where the median is not an effect."""
    return {item.name: item.prior.value(0.0) or item.prior.value(1.0) for item in effect.parameters}


def shown(setting, trial, patch):
    return observe(setting.model, setting.campaign, trial, patch, Conditions(np.ones(1))).values


def only(setting, effect, values, place=""):
    """Return the one primitive of an effect of the catalogue."""
    (effect,) = chosen(effect)
    (primitive,) = effect.patch(setting, values, place)
    return primitive


@VANISHING
def test_without_magnitude_nothing_changes(effect, setting):
    """Continuous at zero: no step between no effect and a small one."""
    places = effect.places(setting)
    for share, limit, where in ((0.0, 1e-12, places), (1e-7, 1e-4, places[:1])):
        values = medians(effect) | {
            item.name: share * medians(effect)[item.name] for item in effect.parameters if item.magnitude
        }
        for place in where:
            patch = effect.patch(setting, values, place)
            for trial in setting.campaign.trials:
                scale = np.max(np.abs(trial.values), axis=0)
                assert np.max(np.abs(shown(setting, trial, patch) - trial.values) / scale) < limit


@EFFECTS
def test_it_changes_the_trials_that_it_acts_on_and_no_other(effect, setting):
    assert effect.unavailable(setting) is None
    touched, places = set(), effect.places(setting)
    assert len(set(places)) == len(places) > 0
    for place in places:
        patch = effect.patch(setting, medians(effect), place)
        assert len(patch)
        for trial in setting.campaign.trials:
            change = shown(setting, trial, patch) - trial.values
            if np.max(np.abs(change) / np.max(np.abs(trial.values), axis=0)) > 1e-3:
                touched.add(trial.kind)
            if trial.kind not in effect.acts_on:
                assert not np.any(change)
    exempt = {TrialKind.DRIVEN}  # there is none
    if effect.identifier == "point_mass":
        exempt |= {TrialKind.FLIGHT}  # the cantilever has no weight
    if effect.identifier in WARM:
        exempt |= {TrialKind.FORCED, TrialKind.RINGDOWN, TrialKind.FLIGHT}  # one temperature in these trials
    assert touched | exempt == effect.acts_on | exempt


@EFFECTS
def test_it_builds_over_its_whole_prior_and_its_shape_is_free_around_the_canonical_one(effect, setting):
    """Priors are inverted; the effect can be sent to another process."""
    place, middle = effect.places(setting)[0], medians(effect)
    named = effect.patch(setting, middle, place)
    assert effect.patch(setting, {**middle, **effect.canonical_shape()}, place) == named
    assert pickle.loads(pickle.dumps(effect)).patch(setting, middle, place) == named
    for item in effect.shape:
        assert abs(item.prior.standard_normal(item.canonical)) < 2.0
        moved = {**middle, item.name: item.prior.value(item.prior.standard_normal(item.canonical) + 1.0)}
        assert effect.patch(setting, moved, place) != named
    for item in (*effect.parameters, *effect.shape):
        for u in (-2.0, -0.3, 0.0, 1.5):
            assert item.prior.standard_normal(item.prior.value(u)) == pytest.approx(u, abs=1e-9)
    for u, place in product((-6.0, 0.7, 6.0), effect.places(setting)):
        values = {item.name: item.prior.value(u) for item in (*effect.parameters, *effect.shape)}
        patch = effect.patch(setting, values, place)
        assert ModelPatch.from_list(json.loads(json.dumps(patch.to_list()))) == patch
        inside = [primitive for primitive in patch if not isinstance(primitive, patches.SENSORS)]
        assert all(setting.model.supports(type(primitive)) for primitive in inside)
        assert all(0.0 <= item.station <= LENGTH for item in inside if isinstance(item, PointMass))
        if not any(isinstance(item, PowerStiffness) for item in inside):  # a load may be too much for these
            assert np.all(np.isfinite(shown(setting, setting.campaign.trials[0], patch)))


def test_all_but_the_filter_vanish_with_a_magnitude(setting):
    """However low its corner is, a filter that had settled takes off the value before a release."""
    (other,) = [effect for effect in library() if not any(item.magnitude for item in effect.parameters)]
    assert other.identifier == "high_pass"
    assert len(other.patch(setting, {"corner_ratio": 0.0}, "tip")) == 0
    pushed = next(trial for trial in setting.campaign.trials if trial.name == "pushed")
    slow = other.patch(setting, {"corner_ratio": 1e-9}, "tip")
    np.testing.assert_allclose(shown(setting, pushed, slow), pushed.values, atol=1e-8)


def test_sizes_in_closed_form(setting):
    scales, root, span = setting.scales, setting.scales.ports["root"], setting.scales.ports["span"]
    k, A, w = span.stiffness, span.displacement, span.angular_frequency
    drag = only(setting, "quadratic_damping", {"equivalent_damping_ratio": 0.01}, "span")
    at_speed = drag.coefficient / drag.reference_velocity**2
    assert 4.0 * at_speed * A * w**2 / (3.0 * pi * k) == pytest.approx(0.01)
    hysteretic = only(setting, "structural_damping", {"loss_factor": 0.03}, "span")
    assert hysteretic.coefficient / hysteretic.reference_displacement == pytest.approx(0.03 * k)
    friction = only(setting, "coulomb_friction", {"friction_ratio": 0.02}, "span")
    assert friction.coefficient == pytest.approx(0.02 * k * A)
    most = 0.9 * root.static_stiffness * root.displacement
    strong = {"friction_ratio": 50.0}
    friction = only(setting, "coulomb_friction", strong, "root")
    assert friction.coefficient == pytest.approx(most)  # more would hold it still, which no drag does
    drag = only(setting, "coulomb_friction", {**strong, "velocity_exponent": 2.0}, "root")
    assert drag.coefficient > 10.0 * most
    coupling = only(setting, "high_pass", {"corner_ratio": 0.1}, patches.EVERY_CHANNEL)
    assert 1.0 / coupling.time_constant == pytest.approx(0.1 * scales.angular_frequency)
    for skin, side, loss, lost in (("upper", -1, 0.2, 0.2), ("lower", 1, 2.0, 0.9)):
        crack = only(setting, "breathing_crack", {"stiffness_loss": loss}, f"root, {skin} skin")
        force = -lost * root.static_stiffness * crack.reference_displacement
        assert (crack.side, crack.exponent, crack.coefficient) == (side, 1.0, pytest.approx(force))
    root_spring = only(setting, "root_compliance", {"compliance_share": 0.1})
    assert root_spring.compliance * LENGTH**2 * scales.tip_stiffness == pytest.approx(0.1)
    waves = {"frequency_ratio": 2.0, "damping_ratio": 0.01, "cosine_ratio": 0.1, "sine_ratio": 0.0}
    mode = only(setting, "unmodelled_mode", waves, "tip")
    assert mode.frequency == pytest.approx(2.0 * scales.angular_frequency / (2.0 * pi))
    assert mode.cosine == pytest.approx(0.1, rel=1e-3)  # the tip is released from its largest reading
    values = {"cosine_ratio": 0.01, "sine_ratio": 0.0, "frequency_error": 0.0}
    hum = only(setting, "mains_hum", values, "50 Hz, all strain")
    assert (hum.channel, hum.quantity, hum.frequency) == (patches.EVERY_CHANNEL, "strain", 50.0)
    largest = max(float(np.max(np.abs(trial.values[:, 2]))) for trial in setting.campaign.trials)
    gap = FreePlay("root", pytest.approx(0.9 * root.static_stiffness), pytest.approx(0.1 * root.displacement))
    for identifier, values, place, primitive in (
        ("point_mass", {"mass_ratio": 0.01, "station_ratio": 1.0}, "",
         PointMass(pytest.approx(0.01 * scales.modal_mass), LENGTH)),
        ("free_play", {"gap_ratio": 0.1, "stiffness_share": 5.0}, "root", gap),
        ("stiffness_drift", {"stiffness_change": 0.05}, "", patches.StiffnessDrift(0.05 / scales.duration)),
        ("load_cell", {"gain_error": 0.02, "tare_ratio": 0.01}, "", LoadGain(0.02, pytest.approx(0.3))),
        ("seating_offset", {"offset_ratio": 0.02}, "B",
         patches.RunOffset("B", pytest.approx(0.02 * 30.0 / scales.tip_stiffness))),
        ("gauge_zero_drift", {"drift_ratio": 0.1}, "g1",
         patches.SensorDrift("g1", pytest.approx(0.1 * largest), scales.campaign_time)),
        ("sensor_saturation", {"lost_share": 1.0 / 12.0}, "g1",
         patches.SensorSaturation("g1", pytest.approx(2.0 * largest))),
    ):  # fmt: skip
        assert only(setting, identifier, values, place) == primitive


def test_saturation_loses_its_share_and_all_channels_of_a_quantity_have_one_limit(setting):
    (saturation,) = chosen("sensor_saturation")
    assert saturation.places(setting) == ("all strain", "tip", "g0", "g1", "g2")
    every = only(setting, "sensor_saturation", {"lost_share": 0.01}, "all strain")
    strains = [trial.values[:, 1:] for trial in setting.campaign.trials]
    largest = max(float(np.abs(values).max()) for values in strains)
    assert (every.channel, every.quantity) == (patches.EVERY_CHANNEL, "strain")
    assert every.limit == pytest.approx(largest / np.sqrt(0.03))
    lost = 1.0 - every.limit * np.tanh(largest / every.limit) / largest
    assert lost == pytest.approx(0.01, rel=0.02)
    for trial in setting.campaign.trials:
        values = shown(setting, trial, ModelPatch((every,)))
        np.testing.assert_array_equal(values[:, 0], trial.values[:, 0])
        wanted = every.limit * np.tanh(trial.values[:, 1:] / every.limit)
        np.testing.assert_allclose(values[:, 1:], wanted, rtol=1e-12, atol=1e-18)
    assert saturation.patch(setting, {"lost_share": 0.0}, "g0") == ModelPatch()


def test_observations_are_responses_through_the_sensors_of_a_patch(setting):
    ring, pull = (
        next(item for item in setting.campaign.trials if item.kind is kind)
        for kind in (TrialKind.RINGDOWN, TrialKind.STATIC)
    )

    def seen(trial, *items, **conditions):
        given = Conditions(np.ones(1), **conditions)
        return observe(setting.model, setting.campaign, trial, ModelPatch(items), given).values

    # clocks of patch and conditions add up
    one = seen(ring, patches.Clock(0.004, 0.001), clock=(0.001, 0.002))
    assert one == pytest.approx(seen(ring, clock=(0.005, 0.003)), rel=1e-12)
    assert np.abs(one - seen(ring)).max() > 1e-5
    # a turned gauge asks for components
    c, s = np.cos(0.2), np.sin(0.2)
    output = setting.campaign.channels["g0"].output
    parts = tuple((f"{output}{part}", Quantity.STRAIN) for part in ("", *ACROSS))
    strains = setting.model.respond(pull, parts, ModelPatch(), Conditions(np.ones(1))).values
    assert np.abs(strains[-1]).min() > 1e-6
    turned = seen(pull, patches.SensorRotation("g0", 0.2))[:, pull.channels.index("g0")]
    assert turned == pytest.approx(strains @ [c**2, s**2, s * c])
    # a decaying line scales with the release
    for initial in (np.zeros((0, 2)), np.array([[0.1, 0.0]])):
        line, bare = (seen(ring, *items, initial=initial)[0] for items in ((LINE,), ()))
        size = 0.2 * ring.release.displacement * (1.0 + initial[:, 0].sum())
        assert (line - bare)[ring.channels.index("tip")] == pytest.approx(size)
    # a channel of another trial changes nothing, one of none is refused
    alone = replace(ring, channels=("tip",), values=ring.values[:, :1], used=ring.used[:, :1])
    assert np.array_equal(seen(alone), seen(alone, SensorGain("g0", 0.2)))
    with pytest.raises(CatalogueError, match="'g7', which does not exist; there are tip, g0, g1"):
        seen(ring, SensorGain("g7", 0.2))


LINE = patches.DecayingLine("tip", 7.0, 0.01, 0.2, 0.0)


# ---------------------------------------------------------------- mains and sampling


@pytest.mark.parametrize(
    ("rate", "lines"),
    [
        (1000.0, ("50 Hz", "60 Hz", "400 Hz")),
        (60.0, ("50 Hz", "400 Hz")),  # 60 Hz is a constant
        (110.0, ("50 or 60 Hz", "400 Hz")),
        (50.0, ("60 Hz",)),
        (50.001, ("60 Hz",)),  # 50 Hz shows at 0.001 Hz
        (20.0, ("50 Hz",)),  # at 10 Hz, every second sample of the other sign
        (10.0, ()),
    ],
)
def test_lines_that_a_sampling_rate_can_show(setting, rate, lines):
    trial = next(item for item in setting.campaign.trials if item.name == "release")
    resampled = replace(trial, time=5000.0 + np.arange(len(trial.time)) / rate)
    given = replace(setting, campaign=replace(setting.campaign, trials=(resampled,)))
    assert mains_lines(given) == lines
    (hum,) = chosen("mains_hum")
    assert (hum.unavailable(given) is None) == bool(lines)


# ---------------------------------------------------------------- what a campaign cannot carry


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_steps_of_sizes_are_straight_in_the_value(u, step):
    """What grows with a value is followed exactly; no step passes zero; other priors are straight already."""
    prior = Prior("log_normal", 0.01, 1.0)
    slope = (prior.value(u + 1e-6) - prior.value(u - 1e-6)) / 2e-6
    target = prior.value(u) + slope * step
    reached = prior.value(prior.step_within_prior(u, step))
    assert reached == pytest.approx(max(target, LEAST_SHRINKAGE * prior.value(u)), rel=1e-6)
    assert Prior("normal", -1.0, 1.0).step_within_prior(u, step) == u + step


# ---------------------------------------------------------------- on lumped models

WITHOUT_STATION = {"local_stiffness_loss", "gauge_misalignment", "washout", "inertia_relief"}
OF_STORES = {"outflow", "overflow"}


def test_a_chain_is_offered_what_it_can_carry_and_its_records_can_show():
    model = LumpedModel.load("three_mass_chain")
    plan = plan_from_scales(model, ("x3", "base_strain"), "end")
    setting = setting_of(example_campaign(model, "laboratory", 1, plan), model)
    reasons = {effect.identifier: effect.unavailable(setting) for effect in library()}
    absent = {name for name, reason in reasons.items() if reason is not None}
    assert absent == WITHOUT_STATION | OF_STORES | WARM | {"logger_clock", "sensor_lag", *REGION_LOSSES}
    assert (
        reasons["region_stiffness_loss"] == "The model 'Three-mass chain with a joint' has no damage region."
    )
    assert all(reasons[name].endswith(".") for name in absent)


def test_flows_are_offered_at_states_and_forces_are_not():
    setting = tank_setting()
    what = setting.campaign.trials[0]
    for effect in chosen("outflow", "overflow"):
        assert effect.unavailable(setting) is None
        assert effect.places(setting) == ("outlet",)
        middle = {item.name: item.prior.value(0.0) for item in effect.parameters}
        shown = seen(setting.model, what, {"level": Quantity.LEVEL}, *effect.patch(setting, middle, "outlet"))
        assert 0.02 < np.abs(shown - what.values).max() / what.values.max() < 0.9
    (friction,) = chosen("coulomb_friction")
    assert "are of states, where flows act and no forces" in str(friction.unavailable(setting))


def test_a_port_whose_motion_goes_one_way_shows_no_memory():
    """A body that falls shows drag and no hysteresis; one that is pushed to and fro may show both."""
    model = model_of(INPUTS.text("falling_body.toml"))
    falls = asked(TrialKind.DRIVEN, np.linspace(0.0, 1.0, 101), begins=Start.STILL)
    given = campaign(falls, height=Channel("height", Quantity.DISPLACEMENT, "height", None))
    setting = setting_of(given, model)
    assert not setting.scales.ports["air"].turns
    remember = "joint_micro_slip", "bouc_wen_hysteresis", "cubic_stiffness", "free_play", "breathing_crack"
    for effect in chosen(*remember):
        assert "moves back and forth" in (effect.unavailable(setting) or "")
    assert chosen("quadratic_damping")[0].unavailable(setting) is None
    still = replace(given, trials=(falls, replace(falls, name="load", kind=TrialKind.STATIC)))
    assert model.scales(still).ports["air"].turns


@pytest.mark.parametrize(
    ("other", "places"), [("root", ("tip",)), ("span", ("tip", "span")), ("joint", ("tip", "joint"))]
)
def test_a_port_stands_for_the_others_of_a_wing_alone(other, places):
    """A model with a port of another name is not a wing: at all of its ports an effect is tried."""
    ports = f"""
        port = [{{ name = "tip", vector = [0.0, 1.0] }}, {{ name = "{other}", vector = [1.0, 0.0] }}]
        """
    text = INPUTS.text("two_masses.toml", ("[damping]", f"{ports}\n[damping]"))
    model = model_of(text)
    load = asked(TrialKind.STATIC, np.zeros(3), force=np.array([0.0, 0.1, 0.2]), load_place="in")
    setting = setting_of(campaign(load, x=Channel("x", Quantity.DISPLACEMENT, "x", None)), model)
    assert chosen("cubic_stiffness")[0].places(setting) == places


ALL, BOTH = {"all": ("shaker", "laser", "camera")}, {"rack": ("shaker", "laser"), "film": ("camera",)}


@pytest.mark.parametrize(
    ("loggers", "places", "motion"), [({}, ("",), True), (ALL, ("",), False), (BOTH, ("rack", "film"), True)]
)
def test_each_logger_may_have_a_wrong_clock(loggers, places, motion):
    model = model_of(INPUTS.text("shaken_mass.toml"))
    read = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("laser", "camera")}
    what = asked(TrialKind.FORCED, 400, channels=tuple(read), force=np.ones(400), load_place="shaker")
    shared, own = chosen("logger_clock", "clock_error")
    given = replace(campaign(what, **read), loggers=loggers)
    setting = setting_of(given, model)
    assert shared.unavailable(setting) is None
    assert shared.places(setting) == places
    assert (own.unavailable(setting) is None) is motion
    patch = shared.patch(setting, {"rate_error": 4e-3}, places[0])
    assert patch == ModelPatch((patches.LoggerClock(places[0] or "*", 4e-3),))


# ---------------------------------------------------------------- pages


def test_the_pages_are_those_of_the_catalogue():
    """If this fails: python -m benchmarks.effect_pages."""
    made = pages()
    assert {path.name for path in FOLDER.glob("*.md")} == set(made)
    for name, text in made.items():
        assert (FOLDER / name).read_text(encoding="utf-8") == text, name


def test_every_effect_has_a_small_picture():
    pictures = {path.stem: path.read_bytes() for path in (FOLDER / "images").iterdir()}
    assert pictures.keys() == {effect.identifier for effect in library()}
    for name, data in pictures.items():
        width, height = struct.unpack(">II", data[16:24])
        assert len(data) <= 40 * 1024, name
        assert 500 <= width <= 700, name
        assert 150 <= height <= 300, name
    (effect,) = chosen("cubic_stiffness")
    assert draw(effect, picture_setting()).startswith(b"\x89PNG")  # again
