"""Missing effects in a mission: hidden in the asset, known to the twin, refused where they cannot be."""

import json
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.patch import (
    BoucWen,
    LoadPlace,
    LocalStiffnessLoss,
    ModelPatch,
    PointMass,
    Primitive,
    SensorDrift,
    SensorGain,
    Washout,
)
from fmu_asset.packing.patch_file import SCHEMA
from tests.command_line import refused
from tests.refusals import refused as refused_by
from tests.twin_master.runs import figures_of, text_of, written
from twin_master.assets.resolution import Overrides
from twin_master.assets.system_export import export_scenario
from twin_master.errors import MissionInputError
from twin_master.store.writing import open_run
from twin_master.workflow import check_scenario
from uav_twin import fly as new_run
from uav_twin import load_scenario, resume

TEXT = text_of("level_turns", ("steps = 50", "steps = 7"), ("draws = 100", "draws = 6"))
DRIFT: tuple[Primitive, ...] = (SensorDrift("g5", 3e-5, 1.0), SensorGain("strain[9]", 0.1))
STRUCTURE: tuple[Primitive, ...] = (
    LocalStiffnessLoss(0.3, 0.9, 0.3),
    Washout(0.05, 2.0),
    SensorGain("g5", -0.05),
)
PATCH = 'patch = "p.json"\n'


def write_patch(folder: Path, *primitives: Primitive) -> Path:
    effects = [{"id": "hidden", "primitives": ModelPatch(primitives).to_list()}]
    record = {"schema": SCHEMA, "effects": effects, "channels": {"g5": "strain[5]"}}
    return written(folder, json.dumps(record), name="p.json")


def scenario_of(folder: Path, lines: str = "", parameters: str = "", belief: str = "") -> Path:
    """The mission with lines in the tables of asset and belief and with further parameters."""
    more = f", {parameters}" if parameters else ""
    return written(
        folder,
        TEXT,
        ('binding = "uav_wing"\n', f'binding = "uav_wing"\n{lines}'),
        ("[belief]\n", f"[belief]\n{belief}"),
        ("factor = 1.0073 }", f"factor = 1.0073{more} }}"),
    )


@pytest.mark.parametrize(
    ("primitive", "words"),
    [(LocalStiffnessLoss(0.3, end, 0.3), "m from the root, and the wing is 1.828 m long") for end in (5, -1)]
    + [(PointMass(1, 2.2), "a point_mass at 2.2 m"), (LoadPlace(-2, 0), "a load_place at -0.222 m")]
    + [(SensorDrift("strain[1]", 1e-5, 1.0), "on time"), (BoucWen("tip", 1.0, 1e-3, 1.0), "loads before")]
    + [(SensorDrift("strain[1]", 1e-5, 1.0, 0.0), "")],
)
def test_places_beside_the_wing_are_refused_and_what_changes_in_a_mission_is_no_model(
    primitive, words, tmp_path
):
    write_patch(tmp_path, primitive)
    for lines, belief in (("", PATCH), *[(PATCH, "")] * ("m" in words.split())):
        loaded = load_scenario(scenario_of(tmp_path, lines, belief=belief))
        with refused_by(MissionInputError, words) if words else nullcontext():
            check_scenario(loaded)


def test_wrong_names_and_files_are_refused_before_anything_is_made(tmp_path):
    write_patch(tmp_path, *DRIFT)
    for lines, parameters, belief, words in (
        (PATCH, '"effect.hiden.active" = 0', "", "effect.hiden.active"),
        ('patch = "q.json"\n', "", "", "q.json cannot be read"),
        ("", "", PATCH, "depends on time"),
    ):
        scenario = scenario_of(tmp_path, lines, parameters, belief)
        assert words in refused("run", scenario, "--out", tmp_path / "run")
        assert not (tmp_path / "run").exists()


@pytest.fixture
def mission(tmp_path: Path, no_report: None) -> Callable[..., Path]:
    def fly(name: str, lines: str = "", parameters: str = "", belief: str = "") -> Path:
        loaded = load_scenario(scenario_of(tmp_path, lines, parameters, belief))
        return new_run(loaded, tmp_path / name, Overrides(in_process=True)).folder

    return fly


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_a_mission_with_a_hidden_drift(mission, tmp_path):
    write_patch(tmp_path, *DRIFT)
    folder = mission("hidden", PATCH)
    folders = mission("plain"), folder, mission("off", PATCH, '"effect.hidden.active" = 0')
    plain, hidden, off = (open_run(place)["observed"]["strain"].values for place in folders)
    np.testing.assert_array_equal(off, plain)
    # the control of later turns may differ, since the twin is misled; that of the first ones does not
    np.testing.assert_allclose(hidden[:2, 4] - plain[:2, 4], [3e-5, 6e-5], rtol=1e-6)
    assert np.all(hidden[0, [0, 1, 20]] == plain[0, [0, 1, 20]])
    assert figures_of(folder)["model_misfit_rms"] > 1.0  # percent
    summary, config = (
        json.loads((folder / f"{name}.json").read_text("utf-8")) for name in ("summary", "config")
    )
    assert summary["asset_and_model_differ"] is True
    assert (folder / "asset" / "patch.json").read_bytes() == (tmp_path / "p.json").read_bytes()
    assert config["scenario"]["asset"]["patch"] == "asset/patch.json"
    assert "patch" in config["inputs"]
    before = (folder / "run.nc").read_bytes()
    resume(folder)
    assert (folder / "run.nc").read_bytes() == before


@pytest.mark.long
@pytest.mark.xdist_group("wing")
def test_a_twin_that_knows_the_effect_has_no_misfit(mission, tmp_path):
    write_patch(tmp_path, *STRUCTURE)
    ways = {"ignorant": (PATCH, ""), "knowing": (PATCH, PATCH), "mistaken": ("", PATCH)}
    misfit = {
        name: figures_of(mission(name, lines, belief=belief))["model_misfit_rms"]
        for name, (lines, belief) in ways.items()
    }
    # percent; what is left where the twin knows the effect is the mean of the draws of e against the true e
    assert misfit["knowing"] < 0.1
    assert min(misfit["ignorant"], misfit["mistaken"]) > 20.0 * misfit["knowing"]


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_asset_with_its_effects_can_be_exported(tmp_path):
    write_patch(tmp_path, *DRIFT)
    loaded = load_scenario(scenario_of(tmp_path, PATCH, '"effect.hidden.gain" = 0.2'))
    ssp = tmp_path / "wing.ssp"
    system = export_scenario(loaded, ssp, seed=1, replace_file=False)
    with zipfile.ZipFile(system) as archive:
        names = [name for name in archive.namelist() if name.endswith((".ssd", ".ssv"))]
        text = "".join(archive.read(name).decode() for name in names)
    assert "effect.hidden.gain" in text
    assert "0.2" in text
