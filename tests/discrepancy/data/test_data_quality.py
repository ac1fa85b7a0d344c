"""Faults of data: what is found, where, and what must not be mistaken for one."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.cantilever import Cantilever
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.frequency import dominant_frequency
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data, clipped_run
from discrepancy.checks.rest import _effective_sample_count
from discrepancy.errors import ModelError
from discrepancy.sources.examples import (
    ExamplePlan,
    example_campaign,
    plan_from_scales,
    usual_plan,
    write_example,
)
from discrepancy.system.lumped_model import LumpedModel
from fe.runtime import patch as patches
from fe.runtime.patch import ModelPatch, SensorGain
from tests.discrepancy.core import kit
from tests.discrepancy.rigs import model_of
from tests.refusals import Inputs

PLAN = ExamplePlan(
    (
        Channel("x", Quantity.DISPLACEMENT, "tip_displacement", NoiseRecord(5e-5, 200.0), 0.0, 1e-4),
        Channel("g0", Quantity.STRAIN, "strain[0]", NoiseRecord(2e-6, 200.0), 0.005, 2e-6),
        Channel("g1", Quantity.STRAIN, "strain[1]", NoiseRecord(1e-6, 200.0), 0.005, 1e-6),
        Channel("g2", Quantity.STRAIN, "strain[2]", NoiseRecord(5e-7, 200.0), 0.005, 1e-6),
    ),
    force=20.0,
    release=0.05,
    interval=0.005,
)


def every(campaign, change, *kinds, **only):
    """Return the campaign with its trials changed, those of some kinds alone, that match `only`."""
    trials = [trial for trial in campaign.trials if not kinds or trial.kind in kinds]
    return replace(
        campaign,
        trials=tuple(
            change(trial) if all(getattr(trial, key) == value for key, value in only.items()) else trial
            for trial in trials
        ),
    )


def shown(campaign, change, *kinds, **only):
    """Return the campaign with readings that a function of trial and values gives back."""
    return every(campaign, lambda t: replace(t, values=change(t, t.values.copy())), *kinds, **only)


def scaled(campaign, name, factor, *kinds):
    return shown(
        campaign, lambda trial, x: x * np.where(np.array(trial.channels) == name, factor, 1.0), *kinds
    )


def kinds_of(faults):
    for fault in faults:
        assert fault.sentence.endswith(".")
        assert "\n" not in fault.sentence
    return {(fault.kind, fault.channel) for fault in faults}


CANTILEVER = Cantilever()
"""It flies, is pulled and is let go."""


@pytest.fixture(scope="module")
def campaign():
    return example_campaign(CANTILEVER, "complete", 7, PLAN)


@pytest.fixture(
    scope="module",
    params=[
        ModelPatch(),
        ModelPatch((SensorGain("g0", 0.15), patches.SensorDrift("g1", 2e-5, 5000.0))),
        ModelPatch((SensorGain("*", -0.2, "strain"), patches.HighPass("x", 2.0))),
    ],
    ids=["no effect", "gain and drift", "gains and filter"],
)
def sound_campaigns(request):
    """Three sound campaigns of an object with an effect, which is no fault of the data."""
    return [example_campaign(CANTILEVER, "complete", seed, PLAN, request.param) for seed in range(3)]


def test_sound_data_have_no_fault(sound_campaigns):
    for campaign in sound_campaigns:
        assert check_data(campaign) == ()
        assert check_against_model(campaign, CANTILEVER) == ()


def test_sound_data_have_a_long_noise_record_and_hardly_an_outlier(sound_campaigns):
    for campaign in sound_campaigns:
        marked = mark_outliers(campaign)
        assert campaign.channels["g0"].noise.degrees_of_freedom == 399
        assert all(trial.used.mean() > 0.999 for trial in marked.trials)


CHAIN = LumpedModel.load("three_mass_chain")


@pytest.fixture(scope="module")
def chain_plan():
    """A plan of measurements of a chain of three masses."""
    return plan_from_scales(CHAIN, ("x3", "x1", "base_strain", "joint_strain"), "end")


def test_an_output_that_the_model_does_not_have_is_refused():
    with pytest.raises(ModelError, match="has no output 'x9'"):
        plan_from_scales(CHAIN, ("x9",), "end")


@pytest.mark.parametrize("seed", [1, 2])
def test_examples_repeat_with_their_seed(tmp_path, chain_plan, seed):
    hashes = [
        write_example(CHAIN, tmp_path / name, "laboratory", seed_of_file, chain_plan).data_hash
        for name, seed_of_file in (("a", seed), ("b", seed), ("c", 4))
    ]
    first, second, other = hashes
    assert first == second
    assert first != other


def test_examples_say_what_is_held_out(chain_plan):
    example = example_campaign(CHAIN, "laboratory", 1, chain_plan)
    assert [trial.name for trial in example.held_out] == ["loading again", "release 3"]


def hidden_effects(campaign):
    """Return patches of effects of a usual size, of which the first has none."""
    scales = CHAIN.scales(campaign)
    force = 0.05 * scales.ports["joint"].stiffness * scales.ports["joint"].displacement
    return [
        ModelPatch(()),
        ModelPatch((patches.PointMass(0.3 * scales.modal_mass, 0.6),)),
        ModelPatch((patches.SupportCompliance("root", "rx", 0.3 / scales.tip_stiffness / 0.36),)),
        ModelPatch((patches.PowerDamping("joint", force, 0.0, 0.0, 1.0, 1.0),)),
        ModelPatch((SensorGain("base_strain", -0.15), patches.HighPass("x3", 0.5))),
    ]


@pytest.mark.parametrize("seed", [1, 2])
def test_examples_are_sound_whatever_effect_they_hide(chain_plan, seed):
    """An effect may be doubted, and is no fatal fault."""
    example = example_campaign(CHAIN, "laboratory", seed, chain_plan)
    for effect, patch in enumerate(hidden_effects(example)):
        campaign = example_campaign(CHAIN, "laboratory", seed, chain_plan, patch)
        left_out = sum(int((~trial.used).sum()) for trial in mark_outliers(campaign).trials)
        assert [fault for fault in check_data(campaign) if fault.fatal or effect == 0] == []
        assert check_against_model(campaign, CHAIN) == ()
        assert left_out <= 2


# ---------------------------------------------------------------- units, signs, exchanged channels


SLIPS = Inputs(__file__).table("faults.toml")["scaled"]


def faults_with_noise(campaign, name, noise):
    """Return the faults of a campaign in which a channel has a noise record."""
    channels = {**campaign.channels, name: replace(campaign.channels[name], noise=noise)}
    return check_against_model(replace(campaign, channels=channels), CANTILEVER)


def check_slip_of(faults, name, guess):
    """Check that a channel alone has a slip of its unit, with the guess of what it is."""
    assert (FaultKind.UNIT_SLIP, name) in kinds_of(faults)
    assert {fault.channel for fault in faults} == {name}
    assert re.search(guess, " ".join(fault.sentence for fault in faults if fault.fatal))


@pytest.mark.parametrize(("name", "factor", "guess"), SLIPS)
def test_unit_slips_are_found_where_the_noise_record_slips_with_the_channel(campaign, name, factor, guess):
    slipped = scaled(campaign, name, factor)
    noise = slipped.channels[name].noise
    noise = replace(noise, standard_deviation=noise.standard_deviation * abs(factor))
    check_slip_of(faults_with_noise(slipped, name, noise), name, guess)


@pytest.mark.parametrize(("name", "factor", "guess"), [row for row in SLIPS if abs(row[1]) > 1.0])
def test_unit_slips_are_found_where_the_noise_record_stays_in_the_right_unit(campaign, name, factor, guess):
    """Where the unit is too small what remains is below the noise, and says nothing."""
    slipped = scaled(campaign, name, factor)
    check_slip_of(faults_with_noise(slipped, name, slipped.channels[name].noise), name, guess)


@pytest.mark.parametrize(("name", "factor", "guess"), [row for row in SLIPS if abs(row[1]) > 1.0])
def test_unit_slips_are_found_at_one_load_factor(campaign, name, factor, guess):
    flown = every(scaled(campaign, name, factor), lambda trial: trial.rows(slice(2, 3)), TrialKind.FLIGHT)
    assert (FaultKind.UNIT_SLIP, name) in kinds_of(check_against_model(flown, CANTILEVER))


@pytest.mark.parametrize("factor", [0.7, 1.4, 3.0, 5.0, 9.80665, 30.0])
def test_other_factors_are_no_unit_slips(campaign, factor):
    """Strain that is 9.81 times too large is not a strain in g, and beside ring-downs alone no fault at
    all.
    """
    faults = kinds_of(check_against_model(scaled(campaign, "g0", factor), CANTILEVER))
    assert FaultKind.UNIT_SLIP not in {kind for kind, _ in faults}
    if factor == 9.80665:
        released = scaled(campaign, "g0", factor, TrialKind.RINGDOWN)
        assert not kinds_of(check_against_model(released, CANTILEVER))


def force_divided_by(size):
    """Return what makes the force of a trial so many times smaller."""
    return lambda trial: replace(trial, force=trial.force / size)


def test_a_slip_of_the_force_of_one_trial_is_a_slip_of_its_input(campaign):
    (fault,) = check_against_model(every(campaign, force_divided_by(1e3), name="loading"), CANTILEVER)
    assert (fault.kind, fault.trial) == (FaultKind.INPUT_SLIP, "loading")
    assert "about 1000 times" in fault.sentence


def test_a_slip_of_all_forces_asks_for_their_units(campaign):
    (fault,) = check_against_model(every(campaign, force_divided_by(1e3), TrialKind.STATIC), CANTILEVER)
    assert fault.kind is FaultKind.INPUT_SLIP
    assert "check the units of forces" in fault.sentence


@pytest.mark.parametrize(
    ("size", "kind", "unit"),
    [(9.80665, FaultKind.INPUT_SLIP, "kgf"), (4.448, FaultKind.UNIT_DOUBT, "lbf")],
)
def test_forces_in_another_unit_are_found_in_each_static_trial(campaign, size, kind, unit):
    """What four and a half times the load would do, a structure may do as well: no fault, but a limit."""
    static = [trial.name for trial in campaign.trials if trial.kind is TrialKind.STATIC]
    slipped = every(campaign, force_divided_by(size), kind=TrialKind.STATIC)
    faults = check_against_model(slipped, CANTILEVER)
    assert [(fault.kind, fault.trial) for fault in faults] == [(kind, name) for name in static]
    assert f"({unit} given as N?)" in faults[0].sentence
    assert faults[0].fatal is (kind is FaultKind.INPUT_SLIP)


def test_inches_that_are_given_as_millimetres_are_a_fault(campaign):
    in_millimetres = {**campaign.channels, "x": replace(campaign.channels["x"], unit="mm")}
    inches = replace(scaled(campaign, "x", 1.0 / 25.4), channels=in_millimetres)
    (fault,) = check_against_model(inches, CANTILEVER)
    sentence = "'x' shows about 0.0393701 times what the model predicts (inch given as mm?)"
    assert sentence in fault.sentence
    assert fault.fatal


def test_releases_in_millimetres_are_a_slip_of_each_release(campaign):
    def in_millimetres(trial):
        return replace(trial, release=replace(trial.release, displacement=1e3 * trial.release.displacement))

    faults = check_against_model(every(campaign, in_millimetres, kind=TrialKind.RINGDOWN), CANTILEVER)
    assert {fault.kind for fault in faults} == {FaultKind.INPUT_SLIP}
    assert {fault.trial for fault in faults} == {f"release {number}" for number in range(1, 5)}
    assert all("about 0.001 times" in fault.sentence for fault in faults)


def test_signs(campaign):
    """A temperature that falls while the load factor rises turns the slope, not the readings."""
    turned = {(FaultKind.SIGN, "g1")}
    for kinds in ((), (TrialKind.FLIGHT,)):
        faults = check_against_model(scaled(campaign, "g1", -1.0, *kinds), CANTILEVER)
        assert kinds_of(faults) == turned
    backwards = every(campaign, lambda t: replace(t, force=-t.force), TrialKind.STATIC)
    (fault,) = check_against_model(backwards, CANTILEVER)
    assert "sign of the forces" in fault.sentence

    def cool(trial, values):
        column = trial.channels.index("g1")
        values[:, column] = 2.0 * np.sum(values[[0, -1], column]) - values[:, column]
        return values

    assert not check_against_model(shown(campaign, cool, TrialKind.FLIGHT), CANTILEVER)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reading_that_passes_zero_at_once_has_a_sign(sign):
    """In its second sample: y2 begins at a tenth of its amplitude, where two modes nearly cancel."""
    problem = kit.closed_problem(seed=2, kinds=("ringdown",), samples=300)
    faults = check_against_model(scaled(problem.campaign, "y2", sign), problem.model)
    assert kinds_of(faults) == ({(FaultKind.SIGN, "y2")} if sign < 0.0 else set())


@pytest.mark.parametrize("seed", range(5))
def test_what_tells_no_scale_and_no_sign_is_no_fault(campaign, seed):
    """Noise over the little by which turns and loads differ, about a free zero; what begins with a zero."""
    rng = np.random.default_rng(seed)

    def gentle(trial):
        rows = trial.rows(np.repeat([trial.load_factor.argmax(), trial.load_factor.argmin()], [1, 19]))
        load = rows.load_factor * (1.0 + 1e-4 * np.arange(20))
        noise = rng.normal(0.0, [5e-5, 2e-6, 1e-6, 5e-7], (20, 4))
        return replace(rows, load_factor=load, values=rows.values + noise)

    def near(trial, spread):
        rows = trial.rows([np.argmax(trial.force)] * 12)
        load = rows.force * (1.0 - spread * rng.random(12))
        values = rows.values * (load / rows.force)[:, None] - [0.1, 0.0, 0.0, 0.0]
        return replace(rows, force=load, values=values + rng.normal(0.0, [3e-3, 2e-6, 1e-6, 5e-7], (12, 4)))

    def late(trial):  # its first samples have no sign
        values = trial.values * [1.0, 0.5, 1.5, 1.0] - [0.0, 0.0, 3.0 * trial.values[0, 2], 0.0]
        return replace(trial, release=replace(trial.release, at_rest=False), values=values)

    free = replace(campaign.channels["x"], offset_deviation=np.inf, noise=NoiseRecord(3e-3, 99.0))
    loose = replace(campaign, channels={**campaign.channels, "x": free})
    loading = next(trial for trial in campaign.trials if trial.kind is TrialKind.STATIC)
    for sound in (
        every(campaign, gentle, TrialKind.FLIGHT),
        *(replace(loose, trials=(near(loading, spread),)) for spread in (0.02, 0.21)),
        every(campaign, late, TrialKind.RINGDOWN),
    ):
        assert not check_against_model(sound, CANTILEVER)


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FLIGHT, None])
@pytest.mark.parametrize("pair", [("g0", "g1"), ("g1", "g2")])
def test_swapped_channels(campaign, kind, pair):
    """In the trials of one kind, or in all of them."""

    def swap(trial, values):
        first, second = (trial.channels.index(name) for name in pair)
        values[:, [first, second]] = values[:, [second, first]]
        return values

    kinds = [] if kind is None else [kind]
    faults = check_against_model(shown(campaign, swap, *kinds), CANTILEVER)
    swapped = next(fault for fault in faults if fault.kind is FaultKind.SWAPPED)
    assert all(name in swapped.sentence for name in pair)


@pytest.mark.parametrize(
    ("output", "kind"),
    [("strain[9]", FaultKind.MISSING_OUTPUT), ("tip_displacement", FaultKind.WRONG_QUANTITY)],
)
def test_an_output_that_is_not_there_or_is_no_strain_is_a_fault(campaign, output, kind):
    channel = replace(campaign.channels["g0"], output=output, quantity=Quantity.STRAIN)
    other = replace(campaign, channels={**campaign.channels, "g0": channel})
    assert kinds_of(check_against_model(other, CANTILEVER)) == {(kind, "g0")}


def faults_of_release(campaign, count, step=1, unit=1.0):
    """Return the faults of a release of which every so-many-th sample of some is read, in a unit of time."""
    release = next(trial for trial in campaign.trials if trial.kind is TrialKind.RINGDOWN)
    samples = release.rows(slice(0, count, step))
    trials = (replace(samples, time=unit * samples.time),)
    return check_against_model(replace(campaign, trials=trials), CANTILEVER)


def test_a_short_record_is_a_fault(campaign):
    assert (FaultKind.TOO_SHORT, "") in kinds_of(faults_of_release(campaign, 100))
    assert kinds_of(faults_of_release(campaign, 401)) == set()


def test_a_record_of_few_samples_is_a_fault(campaign):
    faults = faults_of_release(campaign, 401, step=16)
    assert (FaultKind.UNDERSAMPLED, "") in kinds_of(faults)
    assert not any("milliseconds" in fault.sentence for fault in faults)


def test_times_in_milliseconds_are_recognised(campaign):
    faults = faults_of_release(campaign, 401, unit=1e3)
    (sentence,) = (fault.sentence for fault in faults if fault.kind is FaultKind.UNDERSAMPLED)
    assert "looks like milliseconds" in sentence
    assert "sample faster" not in sentence


def single_mass_releases():
    """Return releases of a mass of 2 kg on a spring of 800 N/m, which is 3.18 Hz."""
    rig = model_of(Inputs(__file__).text("mass_on_a_spring.toml"))
    return example_campaign(rig, "ringdown", 3, usual_plan(rig))


@pytest.mark.parametrize(("stiffness", "model_frequency"), [("800e-3", "0.101 Hz"), ("800e3", "101 Hz")])
def test_a_stiffness_in_another_unit_is_told_by_both_frequencies(stiffness, model_frequency):
    rig = Inputs(__file__).text("mass_on_a_spring.toml", ("800.0", stiffness))
    fault, *others = check_against_model(single_mass_releases(), model_of(rig))
    assert (fault.kind, others) == (FaultKind.FREQUENCY, [])
    assert "oscillate at 3.1" in fault.sentence
    assert f"is {model_frequency}" in fault.sentence


def test_a_frequency_that_the_campaign_accepts_leaves_the_other_checks():
    rig = model_of(Inputs(__file__).text("mass_on_a_spring.toml", ("800.0", "800e-3")))
    accepting = replace(single_mass_releases(), accept=("frequency",))
    kinds = {(fault.kind, fault.accepted) for fault in check_against_model(accepting, rig)}
    assert {(FaultKind.FREQUENCY, True), (FaultKind.TOO_SHORT, False)} <= kinds


def test_the_frequency_of_a_decaying_record_with_a_drift_is_that_of_its_oscillation():
    time = 0.004 * np.arange(700)
    record = np.exp(-time) * np.cos(2.0 * np.pi * 5.0 * time) + 0.05 * time
    assert dominant_frequency(time, record) == pytest.approx(5.0, rel=0.02)


def test_noise_has_no_frequency():
    time = 0.004 * np.arange(700)
    noise = np.random.default_rng(1).standard_normal(700)
    assert dominant_frequency(time, noise) is None


@pytest.mark.parametrize(
    ("output", "quantity", "kinds"),
    [
        ("turn", Quantity.ANGULAR_VELOCITY, set()),
        ("turn", Quantity.ANGULAR_ACCELERATION, set()),
        ("speed", Quantity.ANGLE, {(FaultKind.WRONG_QUANTITY, "w")}),
    ],
)
def test_a_rate_of_an_angle_is_measured_and_no_integral(output, quantity, kinds):
    wheel = model_of(Inputs(__file__).text("wheel.toml"))
    time = 0.02 * np.arange(400)
    trial = Trial.plain("t", TrialKind.FORCED, ("w",), time, load_place="torque", force=np.sin(time))
    channels = {"w": Channel("w", quantity, output, NoiseRecord(1e-4))}
    assert kinds_of(check_against_model(Campaign("", channels, (trial,), None, {}, ""), wheel)) == kinds


def limited(low, high, column):
    """Return what clips the readings of a channel."""

    def change(_, values):
        values[:, column] = np.clip(values[:, column], low, high)
        return values

    return change


def test_a_clipped_channel_is_a_fault_of_its_trial(campaign):
    (fault,) = check_data(shown(campaign, limited(-3e-4, 1.0, 1), name="release 1"))
    assert (fault.kind, fault.channel, fault.trial) == (FaultKind.CLIPPED, "g0", "release 1")
    assert "smallest value -0.0003" in fault.sentence


def test_a_channel_that_is_clipped_in_static_trials_is_a_fault(campaign):
    saturated = check_data(shown(campaign, limited(-1.0, 0.01, 0), kind=TrialKind.STATIC))
    assert (FaultKind.CLIPPED, "x") in kinds_of(saturated)


@pytest.mark.parametrize(
    ("values", "load", "run"),
    [
        ((0, 1, 2, 3, 3, 3), (0, 1, 2, 3, 4, 5), 3),
        ((0, 1, 2, 3, 3, 3), (0, 1, 2, 3, 3, 3), 0),
        ((1, 1, 2, 3, 3, 3), (0, 1, 2, 3, 4, 5), 0),
    ],
    ids=["clipped", "repeats", "few digits"],
)
def test_a_clipped_run_is_longer_than_repeats_and_few_digits_explain(values, load, run):
    assert clipped_run(np.array(values), 3.0, np.array(load)) == run


def test_a_dead_channel_is_a_fault_beside_the_model_alone(campaign):
    """A load may do nothing at the place of a channel."""
    unplugged = shown(campaign, limited(1e-6, 1e-6, 2), name="loading")
    assert check_data(unplugged) == ()
    assert kinds_of(check_against_model(unplugged, CANTILEVER)) == {(FaultKind.DEAD, "g1")}


def test_slow_records_of_few_digits_are_not_clipped():
    time, rng = np.arange(600.0), np.random.default_rng(0)
    for slow in lfilter([0.2], [1.0, -0.98], rng.normal(size=(100, 600))):
        values = np.round(0.5 * slow + 0.75 * np.sin(0.1 * time) * np.exp(-time / 200.0))
        assert clipped_run(values, values.max()) == 0
    for size in (5.2, 10.4, 20.7):
        values = np.round(size * np.sin(0.3 * time))  # flat where it turns, as a parabola would be
        assert clipped_run(values, values.max()) == 0


@pytest.mark.parametrize(
    ("record", "kind", "words"),
    [
        (None, FaultKind.NO_NOISE_RECORD, "g0"),
        (NoiseRecord(1e-4, 200.0), FaultKind.NOISE_LABEL, "says 0.0001"),
    ],
)
def test_a_noise_record_that_is_missing_or_wrong_is_a_limit(campaign, record, kind, words):
    channels = {**campaign.channels, "g0": replace(campaign.channels["g0"], noise=record)}
    (fault,) = check_data(replace(campaign, channels=channels))
    assert (fault.kind, fault.channel, fault.fatal) == (kind, "g0", False)
    assert words in fault.sentence


def faults_of_channel(trials, record):
    """Return the faults of trials of one displacement with a noise record."""
    channel = Channel("x", Quantity.DISPLACEMENT, "x", record)
    return check_data(Campaign("", {"x": channel}, tuple(trials), None, {}, ""))


@pytest.mark.parametrize("stated", [1.0, 0.2, 5.0])
def test_a_noise_record_is_compared_with_the_scatter_of_repeats(stated):
    """The repeats have a standard deviation of one."""
    rng, rows = np.random.default_rng(1), np.arange(6.0)
    trials = []
    for number in range(5):
        values = (rows + rng.normal(size=6))[:, None]
        trial = Trial.plain(str(number), TrialKind.STATIC, ("x",), np.zeros(6), force=rows, values=values)
        trials.append(trial)
    faults = faults_of_channel(trials, NoiseRecord(stated, 100.0))
    assert [fault.kind for fault in faults] == ([] if stated == 1.0 else [FaultKind.NOISE_LABEL])
    assert all("repeated trials scatter" in fault.sentence for fault in faults)


def slow_noise(count, correlation=0.9, seed=2):
    """Return noise that is an autoregression of first order, (count,)."""
    innovation = np.random.default_rng(seed).normal(size=count + 200)
    return lfilter([1.0], [1.0, -correlation], innovation)[200:]


def ring_in_noise(noise, interval=0.01):
    """Return a ring-down of one displacement under noise (N,)."""
    time = interval * np.arange(len(noise))
    values = (30.0 * np.cos(12.0 * time) * np.exp(-time) + noise)[:, None]
    return Trial.plain("ring", TrialKind.RINGDOWN, ("x",), time, values=values)


@pytest.mark.parametrize(
    ("has_samples", "factor", "is_faulty"),
    [(True, 1.0, False), (True, 3.0, True), (False, 1.0, False), (False, 10.0, True)],
)
def test_slow_noise_is_no_contradiction_of_its_record(has_samples, factor, is_faulty):
    """Slow noise is smooth, and so is its record; a standard deviation alone does not say so."""
    samples = factor * slow_noise(600, seed=3)
    record = NoiseRecord(float(np.std(samples)), 599.0, samples if has_samples else None, 0.01)
    faults = faults_of_channel([ring_in_noise(slow_noise(600))], record)
    assert [fault.kind for fault in faults] == ([FaultKind.NOISE_LABEL] if is_faulty else [])


def test_slow_noise_is_no_contradiction_of_a_record_at_a_longer_interval():
    samples = slow_noise(6000, seed=3)[::10]
    record = NoiseRecord(float(np.std(samples)), 599.0, samples, 0.01)
    assert faults_of_channel([ring_in_noise(slow_noise(6000), interval=0.001)], record) == ()


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.9])
def test_a_stated_deviation_is_not_contradicted_by_the_correlation_of_the_noise(correlation):
    """None of 25 sound records, of noise as white or as slow as a sensor's, is doubted."""
    deviation = 1.0 / np.sqrt(1.0 - correlation**2)
    record = NoiseRecord(deviation, 599.0)
    faults = [
        fault
        for seed in range(25)
        for fault in faults_of_channel([ring_in_noise(slow_noise(600, correlation, seed))], record)
    ]
    assert faults == []


class SpoiltReadings:
    """The campaign with outliers in one of a hundred readings of a gauge in all ring-downs."""

    def __init__(self, campaign):
        self.campaign = campaign
        self.rng = np.random.default_rng(5)
        self.rows_by_trial = {}
        self.spoilt = shown(campaign, self.spoil, kind=TrialKind.RINGDOWN)
        self.marked = mark_outliers(self.spoilt)

    def spoil(self, trial, values):
        inner = np.arange(3, len(values) - 3)
        rows = self.rng.choice(inner, len(values) // 100, replace=False)
        signs = self.rng.choice([-1.0, 1.0], len(rows))
        values[rows, 1] += signs * self.rng.uniform(10.0, 60.0, len(rows)) * 2e-6
        self.rows_by_trial[trial.name] = rows
        return values

    def hits(self):
        """Return how many of the outliers are left out."""
        return sum(
            (~trial.used[self.rows_by_trial[trial.name], 1]).sum()
            for trial in self.marked.trials
            if trial.name in self.rows_by_trial
        )


@pytest.fixture(scope="module")
def spoilt_readings(campaign):
    return SpoiltReadings(campaign)


def test_few_outliers_are_found_and_left_out(spoilt_readings):
    left_out = sum((~trial.used).sum() for trial in spoilt_readings.marked.trials)
    count = sum(len(rows) for rows in spoilt_readings.rows_by_trial.values())
    assert spoilt_readings.hits() >= 0.9 * count
    assert left_out - spoilt_readings.hits() <= 1


def test_few_outliers_are_no_fault_and_remarked_on(spoilt_readings):
    count = len(spoilt_readings.campaign.trials[3].time)
    marked_trial = spoilt_readings.marked.trials[3]
    first_row = 1 + int(np.flatnonzero(~marked_trial.used[:, marked_trial.channels.index("g0")])[0])
    remark = f"of {count} readings of 'g0' in the trial 'release 1' (rows {first_row}"
    assert check_data(spoilt_readings.spoilt) == ()
    assert remark in " ".join(spoilt_readings.marked.remarks)


def test_outliers_are_looked_for_once(spoilt_readings):
    marked = spoilt_readings.marked
    assert mark_outliers(marked).trials[3].used.sum() >= marked.trials[3].used.sum() - 1


def test_many_outliers_are_a_fault_and_not_left_out(campaign):
    def spoil_many(_, values):
        values[10::17, 1] += 1e-4
        return values

    spoilt = shown(campaign, spoil_many, name="release 2")
    (fault,) = check_data(spoilt)
    assert (fault.kind, fault.channel, fault.trial) == (FaultKind.OUTLIERS, "g0", "release 2")
    assert all(trial.used.all() for trial in mark_outliers(spoilt).trials)


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.8])
def test_a_series_that_is_correlated_has_bartletts_freedom(kept):
    """n (1 - r^2) / (1 + r^2) of a first-order autoregression."""
    noise = np.random.default_rng(3).standard_normal((20, 4000))
    found = np.mean([_effective_sample_count(series) for series in lfilter([1.0], [1.0, -kept], noise)])
    assert found == pytest.approx(4000.0 * (1.0 - kept**2) / (1.0 + kept**2), rel=0.06)
