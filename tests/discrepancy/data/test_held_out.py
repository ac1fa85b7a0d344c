"""What a campaign can tell: trials that are held out, and what records say of parameters."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model, prior_left, unobservable
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data
from discrepancy.errors import ModelError
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for, write_example
from fe.runtime.patch import HighPass, ModelPatch, PointMass, PowerDamping, RootCompliance, SensorGain
from tests.discrepancy.rigs import model_of
from tests.refusals import Inputs


def trial(name, kind, top, count=4, run="A", channels=("x",)):
    rows = np.linspace(0.0, top, count)
    drive = {
        TrialKind.RINGDOWN: {"release": Release(top)},
        TrialKind.STATIC: {"force": rows},
        TrialKind.FLIGHT: {"load_factor": rows},
    }.get(kind, {})
    values = np.arange(float(count * len(channels))).reshape(count, len(channels))
    return Trial.plain(name, kind, tuple(channels), rows, values=values, load_place="x", run=run, **drive)


def chosen_of(*trials):
    channels = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("x", "y")}
    return choose_held_out(Campaign("", channels, trials, None, {}, ""))


def held(*trials):
    return [item.name for item in chosen_of(*trials).held_out]


def releases(*levels):
    return [trial(f"r{n}", TrialKind.RINGDOWN, value) for n, value in enumerate(levels)]


def test_what_only_one_trial_has_stays_and_what_is_marked_is_respected():
    first, second, third = releases(1.0, 0.5, 0.2)
    assert held(first, replace(second, run="B"), third) == []
    assert held(first, trial("r1", TrialKind.RINGDOWN, 0.5, channels=("x", "y")), third) == []
    marked = chosen_of(first, second, replace(third, held_out=True))
    assert [item.name for item in marked.held_out] == ["r2"]
    assert choose_held_out(marked) is marked
    few = chosen_of(first, second)
    assert not few.held_out
    assert "Nothing is held out" in few.remarks[-1]
    assert [item.name for item in few.trials] == ["r0", "r1"]


def test_amplitudes_inside_come_first():
    assert held(*releases(1.0, 0.5, 0.2)) == ["r1"]
    assert held(*releases(0.2, 1.0, 0.3, 0.6)) == ["r3"]
    assert held(*releases(1.0, 0.9, 0.6, 0.5, 0.3, 0.2)) == ["r2", "r3"]
    # The extremes stay: with three trials at two levels the one that repeats can go.
    assert held(*releases(1.0, 1.0, 0.2)) == ["r1"]
    assert held(*releases(1.0, 1.0, 1.0, 1.0, 1.0)) == ["r4"]


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT])
def test_load_levels_of_a_single_trial(kind):
    single = trial("s", kind, 8.0, count=9)
    chosen = chosen_of(single)
    (fitted,), (proof,) = chosen.fitted, chosen.held_out
    load = "force" if kind is TrialKind.STATIC else "load_factor"
    assert getattr(proof, load).tolist() == [2.0, 5.0]
    assert getattr(fitted, load).tolist() == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0]
    assert proof.values.tolist() == [[2.0], [5.0]]
    assert proof.name == "s, levels held out"
    assert held(trial("s", kind, 8.0, count=5)) == []
    path = np.concatenate([np.arange(5.0), np.arange(3.0, -1.0, -1.0)])
    assert held(replace(single, force=path, load_factor=0 * path)) == []  # a path that turns stays whole


TRIALS = st.tuples(st.sampled_from(TrialKind), st.sampled_from([0.1, 0.2, 0.5, 1.0]), st.sampled_from("AB"))


MODEL = Inputs(__file__).text("cart.toml")
CART = model_of(MODEL)


def of_cart(time, values, drive, hold=None, forced=False):
    """Return the campaign of a cart that begins at rest, its place [m] beside what its motor did [N]."""
    given = {"force": drive, "hold": hold}
    if not forced:
        given = {"inputs": (RecordedInput("motor", Quantity.FORCE, values=drive, hold=hold),)}
    kind, values = TrialKind.FORCED if forced else TrialKind.DRIVEN, values[:, None]
    push = Trial.plain("push", kind, ("x",), time, values=values, begins=Start.STILL, **given)
    channel = Channel("x", Quantity.DISPLACEMENT, "cart", NoiseRecord(5e-4))
    return Campaign("Cart", {"x": channel}, (push,), None, {}, "")


def pushed(scale=1.0):
    time = np.linspace(0.0, 2.0, 81)
    return of_cart(time, scale * 0.25 * time**2, np.ones(81))


def fatal(campaign):
    return [fault.kind for fault in check_against_model(campaign, CART) if fault.fatal]


def test_what_is_left_of_each_prior():
    """Beside least squares of x by the two parameters, by hand; a short push of a cart is no short record."""
    campaign = pushed()
    left = prior_left(campaign, CART)
    time = campaign.trials[0].time

    def x(mass, damping):
        tau = mass / damping
        return (time - tau * (1.0 - np.exp(-time / tau))) / damping

    step = 1e-5
    columns = np.stack((
        (x(2.0 * (1 + step), 0.5) - x(2.0 * (1 - step), 0.5)) / (2 * step) * 0.2,
        (x(2.0, 0.5 * (1 + step)) - x(2.0, 0.5 * (1 - step))) / (2 * step) * 0.01,
    ), axis=1) / 5e-4  # fmt: skip
    expected = np.sqrt(np.diag(np.linalg.inv(np.eye(2) + columns.T @ columns)))
    assert [left["mass_factor"], left["damping_factor"]] == pytest.approx(expected, rel=2e-3)
    assert left["mass_factor"] < 0.1
    assert not fatal(campaign)
    assert fatal(pushed(1000.0))  # mm for m, or kN for N
    for scale in (100.0, 9.81):  # no plausible slip
        assert not fatal(pushed(scale))
    slippery = model_of(MODEL.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }"))
    (found,) = unobservable(campaign, slippery)
    assert "do not tell the calibrated parameter 'damping_factor' (100%)" in found.sentence
    (fault,) = check_against_model(campaign, slippery)
    assert (fault.kind, fault.fatal) == (FaultKind.UNOBSERVABLE, False)


@pytest.mark.parametrize("hold", [None, Hold.LINEAR, Hold.SMOOTH])
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(samples, forced, hold):
    time = np.arange(12 * samples) / samples
    campaign = of_cart(time, 0.01 * time, np.sin(2.0 * np.pi * time), hold, forced)
    faults = check_against_model(campaign, CART)
    found = [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]
    assert bool(found) is (samples == 9 and hold is None)
    name, where = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    for fault in found:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {where}' in fault.sentence


# ---------------------------------------------------------------- examples as a user makes them


@pytest.mark.parametrize("seed", [1, 2])
def test_examples_are_sound_and_repeat_whatever_effect_they_hide(tmp_path, seed):
    """And say what is held out."""
    chain = LumpedModel.load("three_mass_chain")
    plan = plan_for(chain, ("x3", "x1", "base_strain", "joint_strain"), "end")
    one, two = (write_example(chain, tmp_path / name, "laboratory", seed, plan) for name in "ab")
    assert one.data_hash == two.data_hash
    assert one.data_hash != write_example(chain, tmp_path / "c", "laboratory", 4, plan).data_hash
    assert [trial.name for trial in one.held_out] == ["loading again", "release 3"]
    assert choose_held_out(one) is one
    scales = chain.scales(one)
    force = 0.05 * scales.ports["joint"].stiffness * scales.ports["joint"].displacement
    for items in (
        (),
        (PointMass(0.3 * scales.modal_mass, 0.6),),
        (RootCompliance(0.3 / scales.tip_stiffness / 0.36),),
        (PowerDamping("joint", force, 0.0, 0.0, 1.0, 1.0),),
        (SensorGain("base_strain", -0.15), HighPass("x3", 0.5)),
    ):
        campaign = example_campaign(chain, "laboratory", seed, plan, ModelPatch(items))
        assert [fault for fault in check_data(campaign) if fault.fatal or not items] == []
        assert check_against_model(campaign, chain) == ()
        assert sum(int((~trial.used).sum()) for trial in mark_outliers(campaign).trials) <= 2


def test_an_example_of_an_output_that_is_none_is_refused():
    with pytest.raises(ModelError, match="has no output 'x9'"):
        plan_for(LumpedModel.load("three_mass_chain"), ("x9",), "end")


def test_the_documented_campaign_is_read(tmp_path):
    """That of docs/campaign.md, which shows how its tables begin; a record is longer."""
    text = (Path(__file__).parents[3] / "docs" / "campaign.md").read_text(encoding="utf-8")
    toml = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    tables = re.search(r"begin with\n\n```\n(.*?)```", text, re.DOTALL)
    (tmp_path / "campaign.toml").write_text(toml.group(1), encoding="utf-8")
    record = "\n".join(f"{0.002 * k:.3f},{(-1) ** k}" for k in range(3, 50))
    for table in tables.group(1).split("\n\n"):
        name, columns, *_ = table.removeprefix("# ").splitlines()
        more = f"\n{record}" if columns == "time,g17" else ""
        (tmp_path / name).write_text(f"{table.rstrip()}{more}\n", encoding="utf-8")
    campaign = read_campaign(tmp_path)
    up, release, turns = campaign.trials
    assert [trial.kind.value for trial in campaign.trials] == ["static", "ringdown", "flight"]
    assert up.values[1].tolist() == [54.1e-6, 2.98e-3]
    assert up.temperature.tolist() == [1.5] * 3
    assert release.release.displacement == 0.015
    assert turns.health[2].tolist() == [0.2, 0.0]
    assert campaign.channels["g17"].noise.source == "pre-trigger"
    assert campaign.remarks == ()
