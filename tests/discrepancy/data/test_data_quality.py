"""Faults of data: what is found, where, and what must not be mistaken for one."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.cantilever import Cantilever
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data, clipped_run
from discrepancy.checks.rest import _effective_sample_count
from discrepancy.errors import ModelError
from discrepancy.sources.examples import ExamplePlan, example_campaign, plan_from_scales, write_example
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


@pytest.mark.parametrize("seed", range(3))
def test_sound_data_have_no_fault(seed):
    for patch in (
        ModelPatch(),
        ModelPatch((SensorGain("g0", 0.15), patches.SensorDrift("g1", 2e-5, 5000.0))),
        ModelPatch((SensorGain("*", -0.2, "strain"), patches.HighPass("x", 2.0))),
    ):
        campaign = example_campaign(CANTILEVER, "complete", seed, PLAN, patch)
        assert campaign.channels["g0"].noise.degrees_of_freedom == 399
        assert check_data(campaign) == ()
        assert check_against_model(campaign, CANTILEVER) == ()
        marked = mark_outliers(campaign)
        assert all(trial.used.mean() > 0.999 for trial in marked.trials)


@pytest.mark.parametrize("seed", [1, 2])
def test_examples_are_sound_and_repeat_whatever_effect_they_hide(tmp_path, seed):
    """And say what is held out."""
    chain = LumpedModel.load("three_mass_chain")
    with pytest.raises(ModelError, match="has no output 'x9'"):
        plan_from_scales(chain, ("x9",), "end")
    plan = plan_from_scales(chain, ("x3", "x1", "base_strain", "joint_strain"), "end")
    one, two = (write_example(chain, tmp_path / name, "laboratory", seed, plan) for name in "ab")
    assert one.data_hash == two.data_hash
    assert one.data_hash != write_example(chain, tmp_path / "c", "laboratory", 4, plan).data_hash
    assert [trial.name for trial in one.held_out] == ["loading again", "release 3"]
    scales = chain.scales(one)
    force = 0.05 * scales.ports["joint"].stiffness * scales.ports["joint"].displacement
    for items in (
        (),
        (patches.PointMass(0.3 * scales.modal_mass, 0.6),),
        (patches.RootCompliance(0.3 / scales.tip_stiffness / 0.36),),
        (patches.PowerDamping("joint", force, 0.0, 0.0, 1.0, 1.0),),
        (SensorGain("base_strain", -0.15), patches.HighPass("x3", 0.5)),
    ):
        campaign = example_campaign(chain, "laboratory", seed, plan, ModelPatch(items))
        assert [fault for fault in check_data(campaign) if fault.fatal or not items] == []
        assert check_against_model(campaign, chain) == ()
        assert sum(int((~trial.used).sum()) for trial in mark_outliers(campaign).trials) <= 2


# ---------------------------------------------------------------- units, signs, exchanged channels


@pytest.mark.parametrize(("name", "factor", "guess"), Inputs(__file__).table("faults.toml")["scaled"])
def test_unit_slips(campaign, name, factor, guess):
    """The noise record slips with the channel, or stays in the right unit."""
    slipped = scaled(campaign, name, factor)
    channel = slipped.channels[name]
    noise = replace(channel.noise, standard_deviation=channel.noise.standard_deviation * abs(factor))
    # where the unit is too small what is left is below the noise, and says nothing
    for record in (noise, channel.noise) if abs(factor) > 1.0 else (noise,):
        channels = {**slipped.channels, name: replace(channel, noise=record)}
        faults = check_against_model(replace(slipped, channels=channels), CANTILEVER)
        assert (FaultKind.UNIT_SLIP, name) in kinds_of(faults)
        assert {fault.channel for fault in faults} == {name}
        assert re.search(guess, " ".join(fault.sentence for fault in faults if fault.fatal))
    if abs(factor) > 1.0:  # at one load factor, too
        flown = every(slipped, lambda trial: trial.rows(slice(2, 3)), TrialKind.FLIGHT)
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


def test_slips_of_inputs(campaign):
    """What four and a half times the load would do, a structure may do as well: no fault, but a limit."""

    def over(size):
        return lambda trial: replace(trial, force=trial.force / size)

    (fault,) = check_against_model(every(campaign, over(1e3), name="loading"), CANTILEVER)
    assert (fault.kind, fault.trial) == (FaultKind.INPUT_SLIP, "loading")
    assert "about 1000 times" in fault.sentence
    (fault,) = check_against_model(every(campaign, over(1e3), TrialKind.STATIC), CANTILEVER)
    assert fault.kind is FaultKind.INPUT_SLIP
    assert "check the units of forces" in fault.sentence
    static = [trial.name for trial in campaign.trials if trial.kind is TrialKind.STATIC]
    for size, kind, unit in (
        (9.80665, FaultKind.INPUT_SLIP, "kgf"), (4.448, FaultKind.UNIT_DOUBT, "lbf"),
    ):  # fmt: skip
        faults = check_against_model(every(campaign, over(size), kind=TrialKind.STATIC), CANTILEVER)
        assert [(fault.kind, fault.trial) for fault in faults] == [(kind, name) for name in static]
        assert f"({unit} given as N?)" in faults[0].sentence
        assert faults[0].fatal is (unit == "kgf")
    stated = {**campaign.channels, "x": replace(campaign.channels["x"], unit="mm")}
    inches = replace(scaled(campaign, "x", 1.0 / 25.4), channels=stated)
    (fault,) = check_against_model(inches, CANTILEVER)
    assert "'x' shows about 0.0393701 times what the model predicts (inch given as mm?)" in fault.sentence
    assert fault.fatal

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
    def swap(trial, values):
        columns = [trial.channels.index(name) for name in pair]
        values[:, columns] = values[:, columns[::-1]]
        return values

    faults = check_against_model(shown(campaign, swap, *([kind] if kind else [])), CANTILEVER)
    fault = next(fault for fault in faults if fault.kind is FaultKind.SWAPPED)
    assert all(name in fault.sentence for name in pair)


def test_outputs_and_lengths(campaign):
    for output, quantity, kind in (
        ("strain[9]", Quantity.STRAIN, FaultKind.MISSING_OUTPUT),
        ("tip_displacement", Quantity.STRAIN, FaultKind.WRONG_QUANTITY),
    ):
        channel = replace(campaign.channels["g0"], output=output, quantity=quantity)
        other = replace(campaign, channels={**campaign.channels, "g0": channel})
        assert kinds_of(check_against_model(other, CANTILEVER)) == {(kind, "g0")}
    release = next(trial for trial in campaign.trials if trial.kind is TrialKind.RINGDOWN)

    def cut(count, step=1, unit=1.0):
        part = release.rows(slice(0, count, step))
        return check_against_model(
            replace(campaign, trials=(replace(part, time=unit * part.time),)), CANTILEVER
        )

    assert (FaultKind.TOO_SHORT, "") in kinds_of(cut(100))
    assert kinds_of(cut(401)) == set()
    assert (FaultKind.UNDERSAMPLED, "") in kinds_of(cut(401, 16))
    assert not any("milliseconds" in fault.sentence for fault in cut(401, 16))
    (said,) = (item.sentence for item in cut(401, unit=1e3) if item.kind is FaultKind.UNDERSAMPLED)
    assert "looks like milliseconds" in said
    assert "sample faster" not in said


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


def test_clipped_and_dead_channels(campaign):
    def limited(low, high, column):
        def change(_, values):
            values[:, column] = np.clip(values[:, column], low, high)
            return values

        return change

    faults = check_data(shown(campaign, limited(-3e-4, 1.0, 1), name="release 1"))
    assert [(fault.kind, fault.channel, fault.trial) for fault in faults] == [
        (FaultKind.CLIPPED, "g0", "release 1")
    ]
    assert "smallest value -0.0003" in faults[0].sentence
    saturated = check_data(shown(campaign, limited(-1.0, 0.01, 0), kind=TrialKind.STATIC))
    assert (FaultKind.CLIPPED, "x") in kinds_of(saturated)
    for values, load, run in (
        ((0, 1, 2, 3, 3, 3), (0, 1, 2, 3, 4, 5), 3),
        ((0, 1, 2, 3, 3, 3), (0, 1, 2, 3, 3, 3), 0),  # repeats
        ((1, 1, 2, 3, 3, 3), (0, 1, 2, 3, 4, 5), 0),  # few digits
    ):
        assert clipped_run(np.array(values), 3.0, np.array(load)) == run
    unplugged = shown(campaign, limited(1e-6, 1e-6, 2), name="loading")
    assert check_data(unplugged) == ()  # a load may do nothing there
    assert kinds_of(check_against_model(unplugged, CANTILEVER)) == {(FaultKind.DEAD, "g1")}


def test_slow_records_of_few_digits_are_not_clipped():
    time, rng = np.arange(600.0), np.random.default_rng(0)
    for slow in lfilter([0.2], [1.0, -0.98], rng.normal(size=(100, 600))):
        values = np.round(0.5 * slow + 0.75 * np.sin(0.1 * time) * np.exp(-time / 200.0))
        assert clipped_run(values, values.max()) == 0
    for size in (5.2, 10.4, 20.7):
        values = np.round(size * np.sin(0.3 * time))  # flat where it turns, as a parabola would be
        assert clipped_run(values, values.max()) == 0


def test_noise_records_against_their_label_and_repeats(campaign):
    for record, kind, words in (
        (None, FaultKind.NO_NOISE_RECORD, "g0"),
        (NoiseRecord(1e-5, 200.0), FaultKind.NOISE_LABEL, "says 1e-05"),
    ):
        channels = {**campaign.channels, "g0": replace(campaign.channels["g0"], noise=record)}
        (fault,) = check_data(replace(campaign, channels=channels))
        assert (fault.kind, fault.channel, fault.fatal) == (kind, "g0", False)
        assert words in fault.sentence

    rng, rows = np.random.default_rng(1), np.arange(6.0)
    trials = tuple(
        Trial.plain(str(number), TrialKind.STATIC, ("x",), np.zeros(6), force=rows,
                    values=(rows + rng.normal(size=6))[:, None])
        for number in range(5)
    )  # fmt: skip
    for stated in (1.0, 0.2, 5.0):
        channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(stated, 100.0))
        faults = check_data(Campaign("", {"x": channel}, trials, None, {}, ""))
        assert [fault.kind for fault in faults] == [FaultKind.NOISE_LABEL] * (stated != 1.0)
        assert all("repeated trials scatter" in fault.sentence for fault in faults)
    # slow noise is smooth, and so is its record
    time, (slow, rest) = 0.01 * np.arange(600), lfilter([1.0], [1.0, -0.9], rng.normal(size=(2, 600)))
    values = (30.0 * np.cos(12.0 * time) * np.exp(-time) + slow)[:, None]
    trials = (Trial.plain("ring", TrialKind.RINGDOWN, ("x",), time, values=values),)
    for samples, faulty in ((rest, False), (3.0 * rest, True), (None, True)):
        record = NoiseRecord(float(np.std(rest if samples is None else samples)), 599.0, samples, 0.01)
        channel = Channel("x", Quantity.DISPLACEMENT, "x", record)
        faults = check_data(Campaign("", {"x": channel}, trials, None, {}, ""))
        assert [fault.kind for fault in faults] == [FaultKind.NOISE_LABEL] * faulty


def test_outliers_are_found_and_left_out_unless_they_are_too_many(campaign):
    rng = np.random.default_rng(5)
    places = {}

    def spoil(trial, values):
        rows = rng.choice(np.arange(3, len(values) - 3), len(values) // 100, replace=False)
        places[trial.name] = rows
        values[rows, 1] += rng.choice([-1.0, 1.0], len(rows)) * rng.uniform(10.0, 60.0, len(rows)) * 2e-6
        return values

    spoilt = shown(campaign, spoil, kind=TrialKind.RINGDOWN)
    assert check_data(spoilt) == ()
    marked = mark_outliers(spoilt)
    hit = sum((~trial.used[places[trial.name], 1]).sum() for trial in marked.trials if trial.name in places)
    left_out = sum((~trial.used).sum() for trial in marked.trials)
    assert hit >= 0.9 * sum(len(rows) for rows in places.values())
    assert left_out - hit <= 1
    said = f"of {len(campaign.trials[3].time)} readings of 'g0' in the trial 'release 1' are outliers"
    assert said in " ".join(marked.remarks)
    assert mark_outliers(marked).trials[3].used.sum() >= marked.trials[3].used.sum() - 1

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
