"""What a campaign can tell: trials that are held out, and what records say of parameters."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.campaign.held_out import choose_held_out, level
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model, prior_left, unobservable
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


def campaign(*trials):
    channels = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("x", "y")}
    return Campaign("", channels, trials, None, {}, "")


def held(*trials):
    return [item.name for item in choose_held_out(campaign(*trials)).held_out]


def releases(*levels):
    return [trial(f"r{n}", TrialKind.RINGDOWN, value) for n, value in enumerate(levels)]


def test_amplitudes_inside_come_first():
    assert held(*releases(1.0, 0.5, 0.2)) == ["r1"]
    assert held(*releases(0.2, 1.0, 0.3, 0.6)) == ["r3"]
    assert held(*releases(1.0, 0.9, 0.6, 0.5, 0.3, 0.2)) == ["r2", "r3"]
    # The extremes stay: with three trials at two levels the one that repeats can go.
    assert held(*releases(1.0, 1.0, 0.2)) == ["r1"]
    assert held(*releases(1.0, 1.0, 1.0, 1.0, 1.0)) == ["r4"]


def test_marked_trials_are_respected():
    trials = releases(1.0, 0.5, 0.2)
    given_campaign = campaign(
        trials[0], replace(trials[1], held_out=False), replace(trials[2], held_out=True)
    )
    assert choose_held_out(given_campaign) is given_campaign


def test_what_only_one_trial_has_stays():
    trials = releases(1.0, 0.5, 0.2)
    assert held(trials[0], replace(trials[1], run="B"), trials[2]) == []
    two = trial("r1", TrialKind.RINGDOWN, 0.5, channels=("x", "y"))
    assert held(trials[0], two, trials[2]) == []


def test_too_few_trials_are_said():
    chosen = choose_held_out(campaign(*releases(1.0, 0.5)))
    assert not chosen.held_out
    assert "Nothing is held out" in chosen.remarks[-1]
    assert [item.name for item in chosen.trials] == ["r0", "r1"]


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT])
def test_load_levels_of_a_single_trial(kind):
    single = trial("s", kind, 8.0, count=9)
    chosen = choose_held_out(campaign(single))
    fitted, proof = chosen.fitted[0], chosen.held_out[0]
    load = "force" if kind is TrialKind.STATIC else "load_factor"
    assert getattr(proof, load).tolist() == [2.0, 5.0]
    assert getattr(fitted, load).tolist() == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0]
    assert proof.values.tolist() == [[2.0], [5.0]]
    assert proof.name == "s, levels held out"
    assert held(trial("s", kind, 8.0, count=5)) == []
    path = np.concatenate([np.arange(5.0), np.arange(3.0, -1.0, -1.0)])
    assert held(replace(single, force=path, load_factor=0 * path)) == []  # a path that turns stays whole


@given(
    st.lists(
        st.tuples(st.sampled_from(TrialKind), st.sampled_from([0.1, 0.2, 0.5, 1.0]), st.sampled_from("AB")),
        min_size=1,
        max_size=9,
    )
)
@settings(max_examples=100, deadline=None)
def test_what_is_left_covers_what_is_held_out(rows):
    trials = [trial(str(n), kind, top, 8, run) for n, (kind, top, run) in enumerate(rows)]
    before = campaign(*trials)
    chosen = choose_held_out(before)
    assert [item.name for item in choose_held_out(before).held_out] == [item.name for item in chosen.held_out]
    assert sum(len(item.time) for item in chosen.trials) == sum(len(item.time) for item in trials)
    for item in chosen.held_out:
        left = [other for other in chosen.fitted if other.kind is item.kind]
        assert left
        lowest = 0.0 if "levels held out" in item.name else min(map(level, left))
        assert lowest <= level(item) <= max(map(level, left))
        assert any(other.run == item.run for other in chosen.fitted)


# ---------------------------------------------------------------- what records tell of parameters


INPUTS = Inputs(__file__)
MODEL = INPUTS.text("cart.toml")
TOML = INPUTS.text("cart_campaign.toml")


@pytest.fixture
def model():
    return model_of(MODEL)


def campaign_of(folder, scale=1.0):
    time = np.linspace(0.0, 2.0, 81)
    rows = [f"{t!r},1.0,{scale * 250.0 * t * t!r}" for t in time.tolist()]
    (folder / "push.csv").write_text("\n".join(["time,motor,x", *rows]))
    (folder / "campaign.toml").write_text(TOML)
    return read_campaign(folder)


def test_what_is_left_of_each_prior(tmp_path, model):
    campaign = campaign_of(tmp_path)
    left = prior_left(campaign, model)
    # by hand: least squares of x by the two parameters, beside their priors
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
    assert left["mass_factor"] == pytest.approx(expected[0], rel=2e-3)
    assert left["damping_factor"] == pytest.approx(expected[1], rel=2e-3)
    assert left["mass_factor"] < 0.1


def test_a_short_push_of_a_cart_is_no_short_record(tmp_path, model):
    assert not [fault for fault in check_against_model(campaign_of(tmp_path), model) if fault.fatal]


def test_what_cannot_be_observed_is_said(tmp_path):
    text = MODEL.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }")
    model = model_of(text)
    campaign = campaign_of(tmp_path)
    (found,) = unobservable(campaign, model)
    assert "do not tell the calibrated parameter 'damping_factor' (100%)" in found.sentence
    faults = check_against_model(campaign, model)
    assert [fault.kind for fault in faults] == [FaultKind.UNOBSERVABLE]
    assert not faults[0].fatal


def test_only_plausible_unit_slips_are_looked_for(tmp_path, model):
    def slips(scale):
        folder = tmp_path / f"{scale:g}"
        folder.mkdir()
        return [fault.kind for fault in check_against_model(campaign_of(folder, scale), model) if fault.fatal]

    assert slips(1000.0)  # mm for m, or kN for N
    assert not slips(100.0)
    assert not slips(9.81)


@pytest.mark.parametrize("hold", ["", 'hold = "linear"', 'hold = "smooth"'])
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(tmp_path, model, samples, forced, hold):
    time = np.arange(12 * samples) / samples
    rows = [f"{t!r},{float(1.0 * np.sin(2.0 * np.pi * t))!r},{10.0 * t!r}" for t in time.tolist()]
    (tmp_path / "push.csv").write_text("\n".join([f"time,{'force' if forced else 'motor'},x", *rows]))
    before, _, after = TOML.partition("[[input]]")
    section, _, last = after.partition("[[trial]]")
    toml = f"{before}[[input]]{section}{hold}\n[[trial]]{last}"
    if forced:
        toml = f"{before}[[trial]]{last.replace('driven', 'forced')}{hold}\n"
    (tmp_path / "campaign.toml").write_text(toml)
    faults = check_against_model(read_campaign(tmp_path), model)
    found = [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]
    assert bool(found) is (samples == 9 and not hold)
    name, where = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    for fault in found:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {where}' in fault.sentence
