"""A twin that believes another model than the one that flies: sources, misfit, refusals, runs."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.misfit import find_misfit
from fe.runtime.patch import ModelPatch, SensorGain
from fmu_asset.packing.patch_file import SCHEMA
from reporting.progress import SilentProgress
from scenarios import binding_files
from tests.refusals import Inputs
from tests.refusals import refused as in_one_sentence
from tests.twin_master.runs import edited, loaded_from, table_of, text_of, written
from twin_master.assets.asset_source import AssetReading, PairedSource, StatelessAsset
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError, ScenarioError, TwinMasterError
from twin_master.fleet.store import in_credible_set
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.schema import Scenario
from uav_twin import GaussianSensorModel, load_scenario

ROOT = Path(__file__).parents[3]
TEXT = text_of("model_mismatch")


FILE = '# file = "UAVconfig.json" # here, or by --strain-library\n'
DESIGN = 'design = "uav_wing"\n'
MODEL = '[belief]\nkind = "design"\n'
EFFECT = {"id": "gain", "primitives": ModelPatch((SensorGain("strain[9]", 0.1),)).to_list()}
PATCH = json.dumps({"schema": SCHEMA, "effects": [EFFECT]})
ITSELF = '[belief]\nkind = "asset"\n'


@pytest.mark.parametrize(("old", "new", "words"), Inputs(__file__).refused("mismatch"))
def test_combinations_that_mean_nothing_are_refused_in_one_sentence(old, new, words, tmp_path):
    with in_one_sentence(ScenarioError, ".*".join(map(re.escape, words))):
        load_scenario(written(tmp_path, TEXT, (old, new)))


def resolved(library: Path, path: Path | str = "model_mismatch") -> Scenario:
    return resolve_scenario(load_scenario(path), Overrides(strain_library=library))


def test_the_option_names_the_file_and_keeps_the_model(library_file, tmp_path):
    scenario = resolved(library_file)
    assert scenario.asset.file == str(library_file)
    assert scenario.another_model
    own = resolved(library_file, "level_turns")
    assert own.belief.kind == "asset"
    assert not own.another_model
    assert not asset_source(own).origin.differ
    source = asset_source(scenario)
    assert isinstance(source, PairedSource)
    assert source.origin.differ
    assert source.origin.asset == "strain library"
    source.check()
    assert set(source.files()) == {"asset/UAVconfig.json", "asset/design.toml"}
    named = written(tmp_path, TEXT, (FILE, f'file = "{library_file}"\n'))
    assert asset_source(resolve_scenario(load_scenario(named), Overrides())).origin.differ
    with pytest.raises(ScenarioError, match="binding"):
        resolve_scenario(load_scenario("model_mismatch"), Overrides(fmu=tmp_path / "x.fmu"))


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).refused("disagreeing"))
def test_what_asset_and_model_cannot_agree_on_is_refused(library_file, tmp_path, old, new, sentence):
    scenario = resolved(library_file, written(tmp_path, TEXT, (old, new)))
    with in_one_sentence(TwinMasterError, sentence):
        asset_source(scenario).check()


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.0, 30e-6]))
def test_the_bias_of_a_linear_model_is_that_of_least_squares(seed, spread):
    """Where everything is linear the bias is exact: whiten by the covariance, and solve by lstsq."""
    scenario, random = load_scenario("level_turns").scenario, np.random.default_rng(seed)
    model = build_graphical_model(scenario)
    base, slopes = random.uniform(500e-6, 3000e-6, 24), random.uniform(0.0, 2000e-6, (2, 24))
    offsets, wrong = spread * random.standard_normal((4, 24)), 60e-6 * random.standard_normal(24)
    offsets -= offsets.mean(axis=0)
    factor = np.array([control.values["load_factor"] for control in scenario.control]) / 3.0
    table = (base + model.states.coordinates @ slopes)[None, :, None, :] + offsets[:, None, None, :]
    sensors = GaussianSensorModel(table * factor[:, None], 125e-6)

    def observe(control: Any, health: Any) -> AssetReading:
        scale = control["load_factor"] / 3.0
        return AssetReading(scale * (base + np.array([health["z1"], health["z2"]]) @ slopes - wrong))

    misfit = find_misfit(scenario, model, sensors, StatelessAsset(observe))
    np.testing.assert_allclose(misfit.difference, np.broadcast_to(wrong * factor[:, None], (25, 2, 24)))
    for control, scale in enumerate(factor):
        covariance = 125e-6**2 * np.eye(24) + scale**2 * offsets.T @ offsets / 4
        root = np.linalg.cholesky(covariance)
        expected, *_ = np.linalg.lstsq(
            np.linalg.solve(root, scale * slopes.T), np.linalg.solve(root, -scale * wrong), rcond=None
        )
        np.testing.assert_allclose(misfit.bias[7, control], expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(misfit.relative[0, 1], wrong / (base - wrong))
    largest, sensor = misfit.largest
    assert largest == pytest.approx(np.abs(misfit.relative).max())
    assert np.abs(misfit.relative[..., sensor]).max() == pytest.approx(largest)


@settings(deadline=None)
@given(
    weights=st.lists(st.integers(0, 5), min_size=25, max_size=25).filter(any),
    truth=st.tuples(st.integers(0, 80), st.integers(0, 80)),
)
def test_the_credible_set_by_enumeration(weights, truth):
    """The set of all states at least as probable as p, for the largest p at which it holds 90 %."""
    model = build_graphical_model(load_scenario("level_turns").scenario)
    probability = np.array(weights) / sum(weights)
    sets = [[s for s in range(25) if weights[s] >= least] for least in (5, 4, 3, 2, 1)]
    smallest = next(s for s in sets if 10 * sum(weights[i] for i in s) >= 9 * sum(weights))
    levels = np.arange(0, 81, 20)
    near = [
        {int(level) for level in levels if abs(level - z) == np.abs(levels - z).min()} for z in truth
    ]  # fmt: skip
    expected = any(
        round(100 * model.states.coordinates[s, 0]) in near[0]
        and round(100 * model.states.coordinates[s, 1]) in near[1]
        for s in smallest
    )
    found = in_credible_set(model, probability[None], np.array([truth]) / 100.0)
    assert found.tolist() == [expected]


def test_a_model_error_reaches_the_twin(library_file, tmp_path):
    """A twin that doubts its model trusts each sensor less, by a share of what it predicts."""
    percent = [float(value) for value in range(24)]
    listed = ("# model_error_percent = 3", f"model_error_percent = {percent}\nbetween_levels = false")
    scenario = resolved(library_file, written(tmp_path, TEXT, (MODEL + DESIGN, ITSELF), listed))
    sensors = prepare_knowledge(scenario, asset_source(scenario), 1).sensor_model
    expected = np.hypot(125e-6, np.arange(24) / 100.0 * sensors.mean)
    np.testing.assert_allclose(sensors.total_standard_deviation, expected, rtol=1e-12)
    assert Scenario.model_validate(scenario.to_dict()) == scenario
    one = load_scenario(written(tmp_path, TEXT, ("# model_error_percent", "model_error_percent"))).scenario
    assert one.observation.model_error == pytest.approx(0.03)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_a_belief_of_some_regions_and_of_each_role_is_the_wing_itself(wing, tmp_path):
    """A region that is not named is healthy, for the twin, the FMU that flies and the field."""
    strains = '[observation.strain]\nvariables = "strain[{1..24}]"\nunit = "1"'
    for role, variables, changes in (
        ("strain", "", {}),
        ("displacement", '["tip_displacement"]', {"count": 1, "unit": "m", "standard_deviation": 0.1}),
        ("frequency", '"frequency[{1..3}]"', {"count": 3, "unit": "Hz", "standard_deviation": 0.1}),
    ):
        table = table_of("level_turns") | {"reference": []}
        table["state"], table["calibration"]["draws"] = table["state"][:1], 3
        table["truth"]["gains"] = table["truth"]["gains"][:3]
        if changes:
            table["observation"] = {"role": role, **changes}
            table["rewards"] |= {"health_limit": 100.0, "error_scale": 1.0}
            del table["rewards"]["health_limit_microstrain"], table["rewards"]["error_scale_microstrain"]
            table["truth"]["noise"] = {"standard_deviation": 0.1}
            own = f'[observation.{role}]\nvariables = {variables}\nunit = "{changes["unit"]}"'
            bound = edited(binding_files()["uav_wing"].read_text(), (strains, own))
            table["asset"] |= {"binding": str(written(tmp_path, bound, name=f"{role}.toml"))}
        table["asset"]["isolated"] = False
        scenario = resolve_scenario(loaded_from(table, "level_turns"), Overrides())
        source, model = asset_source(scenario), build_graphical_model(scenario)
        source.check()
        source.prepare(tmp_path / role, SilentProgress())
        draws = source.draws(0)
        found = source.observation_table(draws, model)
        flown, health, control = source.open(), {"z1": 0.4}, {"load_factor": 3.0}
        shown, state = flown.step(control, health).values, model.states.index((0.4,))
        flown.close()
        for e, row in zip((*draws.values, 1.0073), (*found[:, state, 1], shown), strict=True):
            losses = {"young_modulus_factor": e, "stiffness_loss": (0.4, 0.0)}
            static, modes = wing.static_response(load_factor=3.0, **losses), wing.modes(**losses)
            full = {"strain": static.strain, "displacement": static.displacement}
            np.testing.assert_allclose(row, full.get(role, modes.frequency[:3]), rtol=1e-9)
        assert source.write_field(tmp_path / "wing.vtu", health, control)
    table["belief"]["patch"] = str(written(tmp_path, PATCH, name="patch.json"))
    patched = resolve_scenario(loaded_from(table, "level_turns"), Overrides())
    with pytest.raises(MissionInputError, match="predicts strains, and `frequency`"):
        asset_source(patched).check()
