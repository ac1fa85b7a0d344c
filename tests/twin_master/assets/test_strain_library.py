"""A wing that is a strain library, and a twin that believes another model than the one that flies."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fe.runtime.patch import ModelPatch, SensorGain
from fmu_asset.packing.patch_file import SCHEMA
from reporting.progress import SilentProgress
from scenarios import binding_files
from tests.refusals import Inputs, refused
from tests.twin_master.runs import edited, loaded_from, table_of, text_of, written
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.strain_library_source import StrainLibrary, load_strain_library
from twin_master.errors import MissionInputError, ScenarioError, TwinMasterError
from twin_master.fleet.store import in_credible_set
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.schema import Scenario
from uav_twin import load_scenario

TEXT = text_of("model_mismatch")
EFFECT = {"id": "gain", "primitives": ModelPatch((SensorGain("strain[9]", 0.1),)).to_list()}
PATCH = json.dumps({"schema": SCHEMA, "effects": [EFFECT]})


@pytest.mark.parametrize(("old", "new", "words"), Inputs(__file__).refused("mismatch"))
def test_combinations_that_mean_nothing_are_refused(old, new, words, tmp_path):
    with refused(ScenarioError, ".*".join(map(re.escape, words))):
        load_scenario(written(tmp_path, TEXT, (old, new)))


LEVELS = [[0, 20, 40], [0, 50]]


def strain(z1: float, z2: float, load: float, e: float = 1.0) -> np.ndarray:
    """What three gauges show, in microstrain."""
    return (100 + 0.5 * z1 + 0.1 * z2) * load / e * np.array([1.0, 2.0, 3.0])


def small_content(levels: list[list[int]] = LEVELS) -> dict[str, Any]:
    """A library in the published format."""
    draws = {"mean": 1.0, "0.99": 0.99, "1.01": 1.01}
    observations = {
        str(z1): {
            str(z2): {
                f"{load}g": {name: strain(z1, z2, load, e).tolist() for name, e in draws.items()}
                for load in (2, 3)
            }
            for z2 in levels[1]
        }
        for z1 in levels[0]
    }
    return {"states": levels, "controls": ["2g", "3g"], "observations": observations}


def loaded(folder: Path, content: object) -> StrainLibrary:
    text = content if isinstance(content, str) else json.dumps(content)
    return load_strain_library(written(folder, text, name="UAVconfig.json").parent)


def test_a_library_in_the_published_format_is_multilinear_between_its_levels(tmp_path):
    library = loaded(tmp_path, small_content())
    assert (library.controls, library.states.shape, library.gauge_count) == (("2g", "3g"), (3, 2), 3)
    np.testing.assert_array_equal(library.young_modulus_factor, [0.99, 1.01])
    state = library.states.index((0.4, 0.5))
    np.testing.assert_allclose(library.strain[state, 1], 1e-6 * strain(40, 50, 3))
    np.testing.assert_allclose(library.strain_per_draw[0, state, 1], 1e-6 * strain(40, 50, 3, 0.99))
    for z1, z2 in [(0.0, 0.0), (0.4, 0.5), (0.2, 0.0), (0.07, 0.21), (0.39, 0.5)]:
        expected = 1e-6 * strain(100 * z1, 100 * z2, 3)
        np.testing.assert_allclose(library.strain_at((z1, z2), 1), expected, rtol=1e-13)
    single = loaded(tmp_path, small_content([LEVELS[0], [0]]))  # of one region, as it were
    np.testing.assert_allclose(single.strain_at((0.07, 0.0), 1), 1e-6 * strain(7, 0, 3), rtol=1e-13)
    with pytest.raises(MissionInputError, match=r"covers z2 from 0 to 0, got 0\.1"):
        single.strain_at((0.07, 0.1), 1)
    for outside in (0.41, -0.01, np.nan):
        with pytest.raises(MissionInputError, match=r"covers z1 from 0 to 0\.4"):
            library.strain_at((outside, 0.0), 0)


def cell(content: dict[str, Any], draw: str) -> list[float]:
    return content["observations"]["20"]["0"]["3g"][draw]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda content: content.pop("observations"), "lacks the entry 'observations'"),
        (lambda content: content["observations"].pop("40"), "lacks the entry '40'"),
        (lambda content: cell(content, "0.99").pop(), r"\[20\]\[0\]\[3g\]\[0.99\] must hold 3 finite"),
        (lambda content: cell(content, "mean").__setitem__(1, float("nan")), "NaN is no number in JSON"),
        (lambda content: content.update(states=LEVELS[:1]), "levels of 2 regions"),
        (lambda _: '{"states": [[0', "not valid JSON"),
        (lambda _: "[1, 2]", "not in the published format"),
    ],
)
def test_an_incomplete_or_damaged_library_is_refused(tmp_path, change, sentence):
    content = small_content()
    damaged = change(content)
    with pytest.raises(MissionInputError, match=sentence):
        loaded(tmp_path, damaged if isinstance(damaged, str) else content)


def resolved(library: Path, path: Path | str = "model_mismatch") -> Scenario:
    return resolve_scenario(load_scenario(path), Overrides(strain_library=library))


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).refused("disagreeing"))
def test_what_asset_and_model_cannot_agree_on_is_refused(library_file, tmp_path, old, new, sentence):
    scenario = resolved(library_file, written(tmp_path, TEXT, (old, new)))
    with refused(TwinMasterError, sentence):
        asset_source(scenario).check()


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
    scenario = resolved(
        library_file,
        written(tmp_path, TEXT, ('kind = "design"\ndesign = "uav_wing"\n', 'kind = "asset"\n'), listed),
    )
    sensors = prepare_knowledge(scenario, asset_source(scenario), 1).sensor_model
    expected = np.hypot(125e-6, np.arange(24) / 100.0 * sensors.mean)
    np.testing.assert_allclose(sensors.total_standard_deviation, expected, rtol=1e-12)


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
