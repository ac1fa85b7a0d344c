"""Missing effects in a mission: hidden in the asset, known to the twin, refused where they cannot be."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.patch import (
    BoucWen,
    LocalStiffnessLoss,
    ModelPatch,
    Primitive,
    SensorDrift,
    SensorGain,
    Washout,
)
from fmu_asset.packing.patch_file import SCHEMA, parse_patch
from reporting.progress import SilentProgress
from scenarios import scenario_files
from twin_master.assets.design_source import check_model_patch
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.system_export import export_scenario
from twin_master.errors import MissionInputError, ScenarioError
from twin_master.scenario.reading import load_scenario
from twin_master.store.writing import RunOutcome, read_run
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run
from uav_twin import cli

TEXT = (
    scenario_files()["level_turns"]
    .read_text(encoding="utf-8")
    .replace("steps = 50", "steps = 7")
    .replace("draws = 100", "draws = 6")
)
ASSET = 'binding = "uav_wing"\n'
DRIFT: tuple[Primitive, ...] = (SensorDrift("g5", 3e-5, 1.0), SensorGain("strain[9]", 0.1))
STRUCTURE: tuple[Primitive, ...] = (
    LocalStiffnessLoss(0.3, 0.9, 0.3),
    Washout(0.05, 2.0),
    SensorGain("g5", -0.05),
)


def write_patch(path: Path, *primitives: Primitive) -> Path:
    record = {
        "schema": SCHEMA,
        "effects": [{"id": "hidden", "primitives": ModelPatch(primitives).to_list()}],
        "channels": {"g5": "strain[5]"},
    }
    path.write_text(json.dumps(record), encoding="utf-8")
    return path


def write_scenario(folder: Path, lines: str = "", parameters: str = "", belief: str = "") -> Path:
    text = TEXT.replace(ASSET, ASSET + lines, 1).replace("[belief]\n", f"[belief]\n{belief}", 1)
    if parameters:
        text = text.replace(
            "young_modulus_factor = 1.0073 }", f"young_modulus_factor = 1.0073, {parameters} }}", 1
        )
    folder.mkdir(exist_ok=True)
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


REFUSED = {
    "a patch for a file": ('kind = "design"\ndesign = "uav_wing"', 'kind = "fmu"\nfile = "w.fmu"',
                           'patch = "p.json"\n', "unknown key `asset.patch`"),
    "the asset as model": ('[belief]\nkind = "design"\ndesign = "uav_wing"',
                           '[belief]\nkind = "asset"\npatch = "p.json"', "", "unknown key `belief.patch`"),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_combinations_that_mean_nothing_are_refused(case: str, tmp_path: Path) -> None:
    old, new, lines, words = REFUSED[case]
    path = write_scenario(tmp_path, lines)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ScenarioError, match=words):
        load_scenario(path)


def test_a_patch_is_not_dropped_where_another_fmu_is_flown(tmp_path: Path) -> None:
    loaded = load_scenario(write_scenario(tmp_path, 'patch = "p.json"\n'))
    with pytest.raises(MissionInputError, match=r"`asset\.patch` goes into the FMU"):
        resolve_scenario(loaded, Overrides(fmu=tmp_path / "other.fmu"))


@pytest.mark.parametrize(
    ("primitive", "words"),
    [
        (SensorDrift("strain[1]", 1e-5, 1.0), "depends on time"),
        (BoucWen("tip", 1.0, 1e-3, 1.0), "loads before"),
    ],
)
def test_what_changes_within_a_mission_is_no_model_of_the_twin(
    primitive: Primitive, words: str, tmp_path: Path
) -> None:
    path = write_patch(tmp_path / "p.json", primitive)
    with pytest.raises(MissionInputError, match=words):
        check_model_patch(parse_patch(path.read_bytes()), 24)
    offset = SensorDrift("strain[1]", 1e-5, 1.0, 0.0)
    check_model_patch(parse_patch(write_patch(path, offset).read_bytes()), 24)


def test_wrong_names_and_files_are_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_patch(tmp_path / "p.json", *DRIFT)
    cases = (
        ('patch = "p.json"\n', '"effect.hiden.active" = 0', "", "effect.hiden.active"),
        ('patch = "q.json"\n', "", "", "q.json cannot be read"),
        ("", "", 'patch = "p.json"\n', "depends on time"),
    )
    for lines, parameters, belief, words in cases:
        scenario = write_scenario(tmp_path, lines, parameters, belief)
        monkeypatch.setattr(sys, "argv", ["uav-twin", "run", str(scenario), "--out", str(tmp_path / "run")])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        assert caught.value.code == 1
        assert words in capsys.readouterr().err
        assert not (tmp_path / "run").exists()


def test_what_is_flown_and_what_is_believed_has_its_name(tmp_path: Path) -> None:
    write_patch(tmp_path / "p.json", *STRUCTURE)
    patch = 'patch = "p.json"\n'
    loaded = load_scenario(write_scenario(tmp_path, patch, belief=patch))
    source = asset_source(resolve_scenario(loaded, Overrides()))
    source.check()
    assert source.origin.asset.endswith("with hidden effects")
    assert source.origin.model.endswith("with effects")
    assert source.origin.differ
    assert {"asset/patch.json", "asset/model_patch.json"} <= {*source.files()}


@pytest.fixture
def mission(tmp_path: Path, no_report: None) -> Any:
    def fly(
        name: str, lines: str = "", parameters: str = "", belief: str = ""
    ) -> tuple[RunOutcome, dict[str, np.ndarray]]:
        loaded = load_scenario(write_scenario(tmp_path / "scenario", lines, parameters, belief))
        outcome = new_run(loaded, tmp_path / name, Overrides(in_process=True))
        tree = read_run(outcome.folder)
        shown = {
            "observed": tree["observed"]["strain"].values,
            "truth": tree["truth"]["strain"].values if "strain" in tree["truth"] else np.zeros(0),
            "predicted": tree["filtered"]["z1"].values if "z1" in tree["filtered"] else np.zeros(0),
        }
        return outcome, shown

    return fly


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_a_mission_with_a_hidden_drift(mission: Any, tmp_path: Path) -> None:
    (tmp_path / "scenario").mkdir()
    write_patch(tmp_path / "scenario" / "p.json", *DRIFT)
    _, plain = mission("plain")
    outcome, hidden = mission("hidden", 'patch = "p.json"\n')
    _, off = mission("off", 'patch = "p.json"\n', '"effect.hidden.active" = 0')
    np.testing.assert_array_equal(off["observed"], plain["observed"])
    # the control of later turns may differ, since the twin is misled; that of the first ones does not
    gained = hidden["observed"][:2, 4] - plain["observed"][:2, 4]
    np.testing.assert_allclose(gained, [3e-5, 6e-5], rtol=1e-6)
    assert np.all(hidden["observed"][0, [0, 1, 20]] == plain["observed"][0, [0, 1, 20]])
    figures = {figure.key: figure.value for figure in outcome.figures}
    assert figures["model_misfit_rms"] > 1.0  # percent
    summary = json.loads((outcome.folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["asset_and_model_differ"] is True
    config = json.loads((outcome.folder / "config.json").read_text(encoding="utf-8"))
    assert (outcome.folder / "asset" / "patch.json").read_bytes() == (
        tmp_path / "scenario" / "p.json"
    ).read_bytes()
    assert config["scenario"]["asset"]["patch"] == "asset/patch.json"
    assert "patch" in config["inputs"]
    before = (outcome.folder / "run.nc").read_bytes()
    resume_run(outcome.folder)
    assert (outcome.folder / "run.nc").read_bytes() == before


@pytest.mark.long
@pytest.mark.xdist_group("wing")
def test_a_twin_that_knows_the_effect_has_no_misfit(mission: Any, tmp_path: Path) -> None:
    (tmp_path / "scenario").mkdir()
    write_patch(tmp_path / "scenario" / "p.json", *STRUCTURE)
    misfit = {}
    patch = 'patch = "p.json"\n'
    for name, lines, belief in (("ignorant", patch, ""), ("knowing", patch, patch), ("mistaken", "", patch)):
        outcome, _ = mission(name, lines, belief=belief)
        misfit[name] = {figure.key: figure.value for figure in outcome.figures}["model_misfit_rms"]
    # percent; what is left where the twin knows the effect is the mean of the draws of e against the true e
    assert misfit["knowing"] < 0.1
    assert min(misfit["ignorant"], misfit["mistaken"]) > 20.0 * misfit["knowing"]


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_asset_with_its_effects_can_be_exported(tmp_path: Path) -> None:
    write_patch(tmp_path / "p.json", *DRIFT)
    scenario = write_scenario(tmp_path, 'patch = "p.json"\n', '"effect.hidden.gain" = 0.2')
    system = export_scenario(
        load_scenario(scenario), tmp_path / "wing.ssp", seed=1, replace_file=False, progress=SilentProgress()
    )
    with zipfile.ZipFile(system) as archive:
        names = [name for name in archive.namelist() if name.endswith((".ssd", ".ssv"))]
        text = "".join(archive.read(name).decode() for name in names)
    assert "effect.hidden.gain" in text
    assert "0.2" in text
