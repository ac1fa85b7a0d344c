"""Run folders as campaigns: what is read, what is held out, what is refused; health beside an effect."""

import json
import shutil

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.studies.hidden_effects import fly_mission
from discrepancy.campaign.records import Quantity
from discrepancy.errors import CampaignDataError, CampaignFileError
from discrepancy.model_choice import choice_of_run
from discrepancy.sources.from_run import held_out_steps, run_campaign, run_model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PointMass, SensorDrift, SensorGain, SensorRotation
from tests.discrepancy.rigs import chosen

pytestmark = pytest.mark.xdist_group("wing")

STEPS = 24
DRIFT = SensorDrift("strain[17]", -1.2e-3, float(STEPS))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "drifting"
    fly_mission(folder, 7, (DRIFT,), steps=STEPS)
    return folder


def tree_of(folder):
    with xr.open_datatree(folder / "run.nc", engine="h5netcdf") as tree:
        return tree.load()


def without(folder, part):
    """Take a group or a variable out of the record of a run."""
    with h5py.File(folder / "run.nc", "a") as file:
        del file[part]


def flown(model, tree):
    """Return the outputs of all gauges, and the conditions under which the FMU flew."""
    values = [1.0073 if item.name == "young_modulus_factor" else item.mean for item in model.parameters]
    outputs = tuple((f"strain[{number}]", Quantity.STRAIN) for number in range(1, 25))
    return outputs, Conditions(np.array(values), health=np.asarray(tree["truth"]["state"].values))


def test_every_step_is_in_one_trial_and_the_model_has_the_strains_of_the_fmu(run, tmp_path):
    tree, campaign = tree_of(run), run_campaign(run)
    assert [trial.held_out for trial in campaign.trials] == [False, True]
    time = np.concatenate([trial.time for trial in campaign.trials])
    order = np.argsort(time)
    np.testing.assert_array_equal(time[order], np.arange(1.0, STEPS + 1.0))
    for name, field in (("strain", "values"), ("load_factor", "load_factor")):
        rows = np.concatenate([getattr(trial, field) for trial in campaign.trials])[order]
        np.testing.assert_array_equal(rows, tree["observed"][name].values)
    assert all(np.all(trial.health_deviation >= 0.25) for trial in campaign.trials)
    draws = np.asarray(tree["calibration"]["draw_value"].values)
    assert campaign.parameters["young_modulus_factor"][0] == pytest.approx(draws.mean())
    # some steps alone
    some = run_campaign(run, first_step=5, last_step=18)
    time = np.sort(np.concatenate([trial.time for trial in some.trials]))
    np.testing.assert_array_equal(time, np.arange(6.0, 20.0))
    with pytest.raises(CampaignDataError, match=r"^drifting has the steps 0 to 23, and none from 30 on\."):
        run_campaign(run, first_step=30)
    # the truth is not read
    without(shutil.copytree(run, tmp_path / "bare"), "truth")
    for one, other in zip(campaign.trials, run_campaign(tmp_path / "bare").trials, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.health, other.health)
    # steps of several steps, behind a start
    binding, header = tmp_path / "bare/asset/binding.toml", "step_size = 1.0"
    several = binding.read_text().replace(header, "step_size = 0.5\ndecimation = 4\nstart_time = 30.0")
    binding.write_text(several)
    (trial,) = run_campaign(tmp_path / "bare", held_out_share=0.0).trials
    np.testing.assert_array_equal(trial.time, 32.0 + 2.0 * np.arange(STEPS))
    # the model gives what the FMU had
    trial, model = run_campaign(run, held_out_share=0.0).trials[0], run_model(run)[0]
    outputs, conditions = flown(model, tree)
    response = model.respond(trial, outputs, ModelPatch(), conditions).values.copy()
    response[:, 16] += DRIFT.amplitude * trial.time / DRIFT.time
    truth = np.asarray(tree["truth"]["strain"].values)
    np.testing.assert_allclose(response, truth, atol=2e-4 * np.abs(truth).max())


@pytest.mark.long
def test_sensors_that_the_twin_knew_are_in_the_model_of_the_run(tmp_path):
    known = (
        SensorGain("strain[3]", -0.3), SensorRotation("strain[9]", 0.4),
        SensorDrift("strain[17]", 4e-4, 1.0, exponent=0.0), SensorGain("*", 0.05, "strain"),
    )  # fmt: skip
    folder = tmp_path / "known"
    fly_mission(folder, 7, known, known, steps=4, draws=10)
    tree, model = tree_of(folder), run_model(folder)[0]
    campaign = run_campaign(folder, held_out_share=0.0)
    outputs, conditions = flown(model, tree)
    truth = np.asarray(tree["truth"]["strain"].values)  # of the FMU, which has the effects too
    shown = observe(model, campaign, campaign.trials[0], ModelPatch(), conditions).values
    np.testing.assert_allclose(shown, truth, atol=2e-4 * np.abs(truth).max())
    # those of a question come after them: a gauge that was turned back reads as the others do
    back = ModelPatch((SensorRotation("g9", -0.4),))
    again = observe(model.with_response_cache(), campaign, campaign.trials[0], back, conditions).values
    plain = model.respond(campaign.trials[0], outputs, ModelPatch(), conditions).values
    np.testing.assert_allclose(again[:, 8], 1.05 * plain[:, 8], rtol=1e-12)
    np.testing.assert_array_equal(np.delete(again, 8, axis=1), np.delete(shown, 8, axis=1))
    patched = choice_of_run(folder).source_hash
    (folder / "asset" / "model_patch.json").rename(folder / "asset" / "model_patch_1.json")
    assert choice_of_run(folder).source_hash != patched
    # A watch whose twin adopted the patch on the way: the steps before were believed with another model.
    with h5py.File(folder / "run.nc", "a") as file:
        file.attrs["model_patch"], file.attrs["model_patch_from_step"] = "asset/model_patch_1.json", 3
    assert choice_of_run(folder).source_hash == patched
    (trial,) = run_campaign(folder, held_out_share=0.0).trials
    np.testing.assert_array_equal(trial.values, campaign.trials[0].values[3:])
    np.testing.assert_array_equal(trial.time, [4.0])


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.2, 0.0])
def test_a_mass_that_the_twin_does_not_know_is_found_in_the_run(tmp_path, mass):
    folder = tmp_path / "heavy"
    fly_mission(folder, 7, (PointMass(mass, 2.0),) if mass else (), steps=12)
    effects = chosen("point_mass", "inertia_relief")
    found = investigate(run_campaign(folder), run_model(folder)[0], effects, thorough=False)
    if not mass:
        assert found.verdict.kind is VerdictKind.NOTHING_MISSING
        return
    assert found.verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP)
    members = {effect.identifier: effect for effect in found.verdict.effects}
    ratio = {item.name: item for item in members["point_mass"].parameters}["mass_ratio"]
    assert ratio.low < mass / found.problem.setting.scales.modal_mass < ratio.high


BLOCKS = (st.integers(1, 200), st.integers(1, 12), st.floats(0.0, 0.9))
"""The number of steps, the length of a block, and the fraction that is held out at most."""


@given(*BLOCKS)
def test_whole_blocks_are_held_out(count, block, share):
    held = held_out_steps(count, block, share)
    blocks = held[: count // block * block].reshape(-1, block)
    assert np.all(blocks.all(axis=1) == blocks.any(axis=1))
    assert not held[len(blocks) * block :].any()


@given(*BLOCKS)
def test_the_first_block_is_never_held_out_and_not_too_much_is(count, block, share):
    held = held_out_steps(count, block, share)
    assert held.shape == (count,)
    assert not held[:block].any()
    assert held.sum() <= share * count + block


def test_what_is_no_run_of_a_wing_is_refused_in_one_sentence(run, tmp_path):
    with pytest.raises(CampaignFileError, match="is not a run folder"):
        run_campaign(tmp_path)
    copy = shutil.copytree(run, tmp_path / "copy")
    config = (copy / "config.json").read_text(encoding="utf-8")
    for section, key, value, error, words in (
        ("observation", "role", "flow", CampaignFileError, "is not a run of the wing: strains"),
        ("asset", "load", {"tip_force": 5.0}, CampaignDataError, "5 N at the tip"),
    ):
        changed = json.loads(config)
        changed["scenario"][section][key] = value
        (copy / "config.json").write_text(json.dumps(changed), encoding="utf-8")
        with pytest.raises(error, match=words):
            run_campaign(copy)
    (copy / "config.json").write_text(config, encoding="utf-8")
    without(copy, "smoothed/mean")
    with pytest.raises(CampaignFileError, match=r"does not have the layout of a run.*mean.*fly the run"):
        run_campaign(copy)
    (copy / "run.nc").write_bytes((run / "run.nc").read_bytes()[:5000])
    with pytest.raises(CampaignFileError, match="not a whole run"):
        run_campaign(copy)
    (copy / "asset" / "design.toml").unlink()
    with pytest.raises(CampaignFileError, match="no design"):
        run_model(copy)
