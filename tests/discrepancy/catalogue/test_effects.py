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
from benchmarks.effect_pictures import EFFECTS_OF_PARTS, FLOWS, draw, picture_setting
from benchmarks.tank import tank_setting
from discrepancy.campaign.records import Channel, Quantity, Start, TrialKind
from discrepancy.catalogue.entry import LEAST_SHRINKAGE, Prior, Setting
from discrepancy.catalogue.library import library
from discrepancy.catalogue.places import mains_lines
from discrepancy.errors import CatalogueError
from discrepancy.model_choice import load_model
from discrepancy.sources.examples import example_campaign, plan_from_scales, usual_plan
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import ACROSS, Conditions
from discrepancy.system.sensing import observe
from fe.runtime import patch as patches
from fe.runtime.patch import FreePlay, LoadGain, ModelPatch, PointMass, PowerStiffness, SensorGain
from tests.discrepancy.rigs import INPUTS, asked, campaign, chosen, model_of, seen, setting_of

pytestmark = pytest.mark.xdist_group("compiling")

# flows need a store (test_outflow), losses of regions a structure with regions (test_regions_of_structures)
BEAM = [effect for effect in library() if effect.identifier not in (*FLOWS, *EFFECTS_OF_PARTS)]
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
def test_it_is_offered_at_places_that_differ(effect, setting):
    places = effect.places(setting)
    assert effect.unavailable(setting) is None
    assert len(set(places)) == len(places) > 0


def relative_changes(effect, setting):
    """Return the kind of each trial and its largest relative change by the effect at each of its places."""
    changes = []
    for place in effect.places(setting):
        patch = effect.patch(setting, medians(effect), place)
        for trial in setting.campaign.trials:
            change = shown(setting, trial, patch) - trial.values
            scale = np.max(np.abs(trial.values), axis=0)
            changes.append((trial.kind, float(np.max(np.abs(change) / scale))))
    return changes


def unchanged_kinds(effect):
    """Return kinds of trials on which an effect acts, and in which the cantilever does not show it."""
    kinds = {TrialKind.DRIVEN}  # there is none
    if effect.identifier == "point_mass":
        kinds |= {TrialKind.FLIGHT}  # the cantilever has no weight
    if effect.identifier == "added_mass":
        kinds |= {TrialKind.STATIC, TrialKind.FLIGHT}
    if effect.identifier in ("load_offset", "load_direction"):
        kinds |= {TrialKind.RINGDOWN}  # it is released from its one place
    if effect.identifier in WARM:
        kinds |= {TrialKind.FORCED, TrialKind.RINGDOWN, TrialKind.FLIGHT}  # one temperature in these trials
    return kinds


@EFFECTS
def test_it_changes_the_trials_that_it_acts_on_and_no_other(effect, setting):
    changes = relative_changes(effect, setting)
    changed_kinds = {kind for kind, change in changes if change > 1e-3}
    exempt = unchanged_kinds(effect)
    assert changed_kinds | exempt == effect.acts_on | exempt
    assert all(change == 0.0 for kind, change in changes if kind not in effect.acts_on)


@EFFECTS
def test_it_has_a_patch_at_each_place(effect, setting):
    for place in effect.places(setting):
        assert len(effect.patch(setting, medians(effect), place))


@EFFECTS
def test_it_can_be_sent_to_another_process(effect, setting):
    place, values = effect.places(setting)[0], medians(effect)
    copy = pickle.loads(pickle.dumps(effect))
    assert copy.patch(setting, values, place) == effect.patch(setting, values, place)


@EFFECTS
def test_its_shape_is_free_around_the_canonical_one(effect, setting):
    place, values = effect.places(setting)[0], medians(effect)
    canonical = effect.patch(setting, values, place)
    assert effect.patch(setting, {**values, **effect.canonical_shape()}, place) == canonical
    for parameter in effect.shape:
        u = parameter.prior.standard_normal(parameter.canonical)
        other = {**values, parameter.name: parameter.prior.value(u + 1.0)}
        assert abs(u) < 2.0
        assert effect.patch(setting, other, place) != canonical


@EFFECTS
def test_its_priors_are_inverted(effect):
    for parameter in (*effect.parameters, *effect.shape):
        for u in (-2.0, -0.3, 0.0, 1.5):
            value = parameter.prior.value(u)
            assert parameter.prior.standard_normal(value) == pytest.approx(u, abs=1e-9)


def patches_over_prior(effect, setting):
    """Return the patches of an effect at each place, at the ends of its priors and within them."""
    parameters = (*effect.parameters, *effect.shape)
    return [
        effect.patch(setting, {parameter.name: parameter.prior.value(u) for parameter in parameters}, place)
        for u, place in product((-6.0, 0.7, 6.0), effect.places(setting))
    ]


def primitives_of_model(patch):
    return [primitive for primitive in patch if not isinstance(primitive, patches.SENSORS)]


@EFFECTS
def test_it_is_written_over_its_whole_prior(effect, setting):
    for patch in patches_over_prior(effect, setting):
        text = json.dumps(patch.to_list())
        assert ModelPatch.from_list(json.loads(text)) == patch


@EFFECTS
def test_it_is_supported_by_the_model_over_its_whole_prior(effect, setting):
    for patch in patches_over_prior(effect, setting):
        primitives = primitives_of_model(patch)
        masses = [primitive for primitive in primitives if isinstance(primitive, PointMass)]
        assert all(setting.model.supports(type(primitive)) for primitive in primitives)
        assert all(0.0 <= mass.station <= LENGTH for mass in masses)


@EFFECTS
def test_it_has_finite_readings_over_its_whole_prior(effect, setting):
    """A load may be too much for a stiffness that grows with the displacement."""
    for patch in patches_over_prior(effect, setting):
        if not any(isinstance(primitive, PowerStiffness) for primitive in primitives_of_model(patch)):
            assert np.all(np.isfinite(shown(setting, setting.campaign.trials[0], patch)))


def test_all_but_the_filter_vanish_with_a_magnitude(setting):
    """However low its corner is, a filter that had settled takes off the value before a release."""
    (other,) = [effect for effect in library() if not any(item.magnitude for item in effect.parameters)]
    assert other.identifier == "high_pass"
    assert len(other.patch(setting, {"corner_ratio": 0.0}, "tip")) == 0
    pushed = next(trial for trial in setting.campaign.trials if trial.name == "pushed")
    slow = other.patch(setting, {"corner_ratio": 1e-9}, "tip")
    np.testing.assert_allclose(shown(setting, pushed, slow), pushed.values, atol=1e-8)


@pytest.fixture
def span(setting):
    """The scales of the port at the span: stiffness, amplitude and angular frequency."""
    return setting.scales.ports["span"]


@pytest.fixture
def root(setting):
    return setting.scales.ports["root"]


def test_quadratic_damping_has_its_equivalent_damping_ratio(setting, span):
    """zeta = 4 c A w² / (3 pi k)."""
    drag = only(setting, "quadratic_damping", {"equivalent_damping_ratio": 0.01}, "span")
    coefficient = drag.coefficient / drag.reference_velocity**2
    ratio = 4.0 * coefficient * span.displacement * span.angular_frequency**2 / (3.0 * pi * span.stiffness)
    assert ratio == pytest.approx(0.01)


def test_structural_damping_has_its_loss_factor(setting, span):
    damping = only(setting, "structural_damping", {"loss_factor": 0.03}, "span")
    coefficient = damping.coefficient / damping.reference_displacement
    assert coefficient == pytest.approx(0.03 * span.stiffness)


def test_friction_is_a_fraction_of_the_elastic_force(setting, span):
    friction = only(setting, "coulomb_friction", {"friction_ratio": 0.02}, "span")
    assert friction.coefficient == pytest.approx(0.02 * span.stiffness * span.displacement)


def test_friction_is_limited_to_what_does_not_hold_a_port_still_and_drag_is_not(setting, root):
    largest = 0.9 * root.static_stiffness * root.displacement
    strong = {"friction_ratio": 50.0}
    friction = only(setting, "coulomb_friction", strong, "root")
    drag = only(setting, "coulomb_friction", {**strong, "velocity_exponent": 2.0}, "root")
    assert friction.coefficient == pytest.approx(largest)
    assert drag.coefficient > 10.0 * largest


def test_a_high_pass_has_its_corner_as_a_fraction_of_the_first_mode(setting):
    coupling = only(setting, "high_pass", {"corner_ratio": 0.1}, patches.EVERY_CHANNEL)
    assert 1.0 / coupling.time_constant == pytest.approx(0.1 * setting.scales.angular_frequency)


@pytest.mark.parametrize(("skin", "side"), [("upper", -1), ("lower", 1)])
@pytest.mark.parametrize(("stiffness_loss", "limited_loss"), [(0.2, 0.2), (2.0, 0.9)])
def test_a_breathing_crack_takes_at_most_nine_tenths_of_a_stiffness(
    setting, root, skin, side, stiffness_loss, limited_loss
):
    crack = only(setting, "breathing_crack", {"stiffness_loss": stiffness_loss}, f"root, {skin} skin")
    force = -limited_loss * root.static_stiffness * crack.reference_displacement
    assert (crack.side, crack.exponent, crack.coefficient) == (side, 1.0, pytest.approx(force))


def test_a_support_compliance_has_its_fraction_of_the_tip_compliance(setting):
    spring = only(setting, "support_compliance", {"compliance_share": 0.1})
    assert spring.compliance * LENGTH**2 * setting.scales.tip_stiffness == pytest.approx(0.1)


def test_an_unmodelled_mode_has_its_frequency_and_amplitude_by_the_first_mode(setting):
    """The tip is released from its largest reading."""
    values = {"frequency_ratio": 2.0, "damping_ratio": 0.01, "cosine_ratio": 0.1, "sine_ratio": 0.0}
    mode = only(setting, "unmodelled_mode", values, "tip")
    frequency = 2.0 * setting.scales.angular_frequency / (2.0 * pi)
    assert mode.frequency == pytest.approx(frequency)
    assert mode.cosine == pytest.approx(0.1, rel=1e-3)


def test_a_hum_is_in_all_channels_of_a_quantity(setting):
    values = {"cosine_ratio": 0.01, "sine_ratio": 0.0, "frequency_error": 0.0}
    hum = only(setting, "mains_hum", values, "50 Hz, all strain")
    assert (hum.channel, hum.quantity, hum.frequency) == (patches.EVERY_CHANNEL, "strain", 50.0)


def test_sizes_of_single_primitives_are_fractions_of_scales(setting, root):
    scales = setting.scales
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


@pytest.fixture
def saturation(setting):
    """Saturation of all strains that loses a hundredth of the largest."""
    return only(setting, "sensor_saturation", {"lost_share": 0.01}, "all strain")


def test_saturation_is_offered_at_all_strains_and_at_each_channel(setting):
    (effect,) = chosen("sensor_saturation")
    assert effect.places(setting) == ("all strain", "tip", "g0", "g1", "g2")
    assert effect.patch(setting, {"lost_share": 0.0}, "g0") == ModelPatch()


def test_saturation_loses_its_share_of_the_largest_reading(setting, saturation):
    strains = [trial.values[:, 1:] for trial in setting.campaign.trials]
    largest = max(float(np.abs(values).max()) for values in strains)
    lost = 1.0 - saturation.limit * np.tanh(largest / saturation.limit) / largest
    assert saturation.limit == pytest.approx(largest / np.sqrt(0.03))
    assert lost == pytest.approx(0.01, rel=0.02)


def test_all_channels_of_a_quantity_saturate_at_one_limit(setting, saturation):
    assert (saturation.channel, saturation.quantity) == (patches.EVERY_CHANNEL, "strain")
    for trial in setting.campaign.trials:
        values = shown(setting, trial, ModelPatch((saturation,)))
        expected = saturation.limit * np.tanh(trial.values[:, 1:] / saturation.limit)
        np.testing.assert_array_equal(values[:, 0], trial.values[:, 0])
        np.testing.assert_allclose(values[:, 1:], expected, rtol=1e-12, atol=1e-18)


def observed(setting, trial, *primitives, **conditions):
    """Return the readings of a trial under primitives and conditions."""
    patch, given_conditions = ModelPatch(primitives), Conditions(np.ones(1), **conditions)
    return observe(setting.model, setting.campaign, trial, patch, given_conditions).values


@pytest.fixture
def ring(setting):
    return next(trial for trial in setting.campaign.trials if trial.kind is TrialKind.RINGDOWN)


def test_clocks_of_patch_and_conditions_add_up(setting, ring):
    by_both = observed(setting, ring, patches.Clock(0.004, 0.001), clock=(0.001, 0.002))
    by_conditions = observed(setting, ring, clock=(0.005, 0.003))
    assert by_both == pytest.approx(by_conditions, rel=1e-12)
    assert np.abs(by_both - observed(setting, ring)).max() > 1e-5


def test_a_turned_gauge_reads_components_across(setting):
    pull = next(trial for trial in setting.campaign.trials if trial.kind is TrialKind.STATIC)
    output = setting.campaign.channels["g0"].output
    components = tuple((f"{output}{part}", Quantity.STRAIN) for part in ("", *ACROSS))
    strains = setting.model.respond(pull, components, ModelPatch(), Conditions(np.ones(1))).values
    turned = observed(setting, pull, patches.SensorRotation("g0", 0.2))[:, pull.channels.index("g0")]
    c, s = np.cos(0.2), np.sin(0.2)
    assert np.abs(strains[-1]).min() > 1e-6
    assert turned == pytest.approx(strains @ [c**2, s**2, s * c])


@pytest.mark.parametrize("initial", [np.zeros((0, 2)), np.array([[0.1, 0.0]])], ids=["still", "moved"])
def test_a_decaying_line_scales_with_the_release(setting, ring, initial):
    with_line = observed(setting, ring, LINE, initial=initial)[0]
    without = observed(setting, ring, initial=initial)[0]
    amplitude = 0.2 * ring.release.displacement * (1.0 + initial[:, 0].sum())
    assert (with_line - without)[ring.channels.index("tip")] == pytest.approx(amplitude)


def test_a_channel_of_another_trial_changes_nothing(setting, ring):
    alone = replace(ring, channels=("tip",), values=ring.values[:, :1], used=ring.used[:, :1])
    with_gain = observed(setting, alone, SensorGain("g0", 0.2))
    assert np.array_equal(observed(setting, alone), with_gain)


def test_a_channel_of_no_trial_is_refused(setting, ring):
    with pytest.raises(CatalogueError, match="'g7', which does not exist; there are tip, g0, g1"):
        observed(setting, ring, SensorGain("g7", 0.2))


LINE = patches.DecayingLine("tip", 7.0, 0.01, 0.2, 0.0)


# ---------------------------------------------------------------- mains and sampling


@pytest.mark.parametrize(
    ("rate", "lines"),
    [
        (1000.0, ("50 Hz", "60 Hz", "400 Hz")),
        (60.0, ("50 Hz (seen at 10 Hz)", "400 Hz (seen at 20 Hz)")),  # 60 Hz is a constant
        (110.0, ("50 or 60 Hz", "400 Hz (seen at 40 Hz)")),
        (50.0, ("60 Hz (seen at 10 Hz)",)),
        (50.001, ("60 Hz (seen at 10 Hz)",)),  # 50 Hz shows at 0.001 Hz
        (20.0, ("50 Hz (seen at 10 Hz)",)),  # every second sample of the other sign
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


def test_a_crack_of_a_model_without_skins_has_a_sign_of_the_motion_as_its_place():
    rig = load_model("single_mass_rig")
    releases = example_campaign(rig, "ringdown", 3, usual_plan(rig))
    (crack,) = chosen("breathing_crack")
    places = crack.places(Setting(releases, rig, rig.scales(releases)))
    assert places == ("slide, open at positive x", "slide, open at negative x")


# ---------------------------------------------------------------- what a campaign cannot carry


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_steps_of_sizes_are_straight_in_the_value(u, step):
    """What grows with a value is followed exactly; no step passes zero; other priors are straight already."""
    prior = Prior("log_normal", 0.01, 1.0)
    slope = (prior.value(u + 1e-6) - prior.value(u - 1e-6)) / 2e-6
    target = prior.value(u) + slope * step
    reached = prior.value(prior.step_along_tangent(u, step))
    assert reached == pytest.approx(max(target, LEAST_SHRINKAGE * prior.value(u)), rel=1e-6)
    assert Prior("normal", -1.0, 1.0).step_along_tangent(u, step) == u + step


# ---------------------------------------------------------------- on lumped models

WITHOUT_STATION = {"local_stiffness_loss", "gauge_misalignment", "washout", "inertia_relief", "added_mass"}
OF_OTHERS = WITHOUT_STATION | {"load_offset", "load_direction", "gauge_offset"}
OF_STORES = {"outflow", "overflow"}


def test_a_chain_is_offered_what_it_can_carry_and_its_records_can_show():
    model = LumpedModel.load("three_mass_chain")
    plan = plan_from_scales(model, ("x3", "base_strain"), "end")
    setting = setting_of(example_campaign(model, "laboratory", 1, plan), model)
    reasons = {effect.identifier: effect.unavailable(setting) for effect in library()}
    absent = {name for name, reason in reasons.items() if reason is not None}
    assert absent == OF_OTHERS | OF_STORES | WARM | {
        "logger_clock",
        "sensor_lag",
        *EFFECTS_OF_PARTS,
    }
    assert (
        reasons["region_stiffness_loss"] == "The model 'Three-mass chain with a joint' has no damage region."
    )
    assert all(reasons[name].endswith(".") for name in absent)


@pytest.mark.parametrize("name", ["outflow", "overflow"])
def test_flows_are_offered_at_states_and_change_the_level(name):
    setting = tank_setting()
    trial = setting.campaign.trials[0]
    (effect,) = chosen(name)
    values = {parameter.name: parameter.prior.value(0.0) for parameter in effect.parameters}
    patch = effect.patch(setting, values, "outlet")
    readings = seen(setting.model, trial, {"level": Quantity.LEVEL}, *patch)
    relative_change = np.abs(readings - trial.values).max() / trial.values.max()
    assert effect.unavailable(setting) is None
    assert effect.places(setting) == ("outlet",)
    assert 0.02 < relative_change < 0.9


def test_forces_are_not_offered_at_states():
    (friction,) = chosen("coulomb_friction")
    reason = str(friction.unavailable(tank_setting()))
    assert "are of states, where flows act and no forces" in reason


@pytest.fixture
def falling_body():
    """The model of a body that falls, and the campaign of its fall."""
    model = model_of(INPUTS.text("falling_body.toml"))
    fall = asked(TrialKind.DRIVEN, np.linspace(0.0, 1.0, 101), begins=Start.STILL)
    height = Channel("height", Quantity.DISPLACEMENT, "height", None)
    return model, campaign(fall, height=height)


@pytest.mark.parametrize(
    "name",
    ["joint_micro_slip", "bouc_wen_hysteresis", "cubic_stiffness", "free_play", "breathing_crack"],
)
def test_a_port_whose_motion_goes_one_way_shows_no_memory(falling_body, name):
    model, fall = falling_body
    (effect,) = chosen(name)
    assert "moves back and forth" in (effect.unavailable(setting_of(fall, model)) or "")


def test_a_port_whose_motion_goes_one_way_shows_drag(falling_body):
    model, fall = falling_body
    setting = setting_of(fall, model)
    assert not setting.scales.ports["air"].turns
    assert chosen("quadratic_damping")[0].unavailable(setting) is None


def test_a_port_that_is_pushed_may_turn(falling_body):
    model, fall = falling_body
    (trial,) = fall.trials
    pushed = replace(fall, trials=(trial, replace(trial, name="load", kind=TrialKind.STATIC)))
    assert model.scales(pushed).ports["air"].turns


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


def shaken_mass(loggers):
    """Return the setting of a shaken mass that a laser and a camera measure."""
    model = model_of(INPUTS.text("shaken_mass.toml"))
    channels = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("laser", "camera")}
    shake = asked(TrialKind.FORCED, 400, channels=tuple(channels), force=np.ones(400), load_place="shaker")
    return setting_of(replace(campaign(shake, **channels), loggers=loggers), model)


LOGGERS = pytest.mark.parametrize(
    ("loggers", "places", "has_own_clock"),
    [({}, ("",), True), (ALL, ("",), False), (BOTH, ("rack", "film"), True)],
    ids=["none", "one", "two"],
)


@LOGGERS
def test_each_logger_may_have_a_wrong_clock(loggers, places, has_own_clock):
    setting = shaken_mass(loggers)
    (clock,) = chosen("logger_clock")
    patch = clock.patch(setting, {"rate_error": 4e-3}, places[0])
    assert clock.unavailable(setting) is None
    assert clock.places(setting) == places
    assert patch == ModelPatch((patches.LoggerClock(places[0] or "*", 4e-3),))


@LOGGERS
def test_the_force_may_have_a_clock_of_its_own_unless_one_logger_reads_all(loggers, places, has_own_clock):
    (clock_error,) = chosen("clock_error")
    assert (clock_error.unavailable(shaken_mass(loggers)) is None) is has_own_clock


# ---------------------------------------------------------------- pages


def test_the_pages_are_those_of_the_catalogue():
    """If this fails: python -m benchmarks.effect_pages."""
    made = pages()
    assert {path.name for path in FOLDER.glob("*.md")} == set(made)
    for name, text in made.items():
        assert (FOLDER / name).read_text(encoding="utf-8") == text, name


PICTURES = {path.stem: path for path in (FOLDER / "images").iterdir()}


def test_every_effect_has_a_picture():
    assert PICTURES.keys() == {effect.identifier for effect in library()}


@pytest.mark.parametrize("name", sorted(PICTURES))
def test_pictures_of_effects_are_small(name):
    data = PICTURES[name].read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    assert len(data) <= 40 * 1024
    assert 500 <= width <= 700
    assert 150 <= height <= 300


def test_pictures_of_effects_are_drawn_again():
    (effect,) = chosen("cubic_stiffness")
    assert draw(effect, picture_setting()).startswith(b"\x89PNG")
