"""Any FMU with a binding and a scenario can be flown: a heat exchanger, by the same code."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fmu_asset.errors import FmuError, FmuFileError
from twin_master import workflow
from twin_master.assets.resolution import Overrides
from twin_master.mission.loop import CheckpointFile
from twin_master.run_folder import read_config
from twin_master.scenario.reading import load_scenario
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

HERE = Path(__file__).with_name("heat_exchanger")


@pytest.fixture(scope="module")
def asset_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("heat_exchanger")
    for path in HERE.iterdir():
        if path.is_file():
            shutil.copy(path, folder)
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", "HeatExchanger.py"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return folder


@pytest.fixture(autouse=True)
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workflow, "_report", lambda folder: (folder / "report.html").touch())


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    text = (folder / "fouling.toml").read_text(encoding="utf-8")
    assert old in text
    path = folder / name
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_a_heat_exchanger_is_watched_and_steered(asset_folder: Path, tmp_path: Path) -> None:
    outcome = new_run(load_scenario(asset_folder / "fouling.toml"), tmp_path / "run")
    with xr.open_datatree(outcome.folder / "run.nc", engine="h5netcdf") as tree:
        tree.load()
    assert tree["observed"]["temperature"].shape == (30, 2)
    assert tree["observed"]["temperature"].attrs["units"] == "degC"
    assert tree["observed"]["mass_flow"].attrs["units"] == "kg/s"
    assert tree["truth"]["heat"].attrs["units"] == "W"
    assert tree["truth"]["state"].attrs["units"] == "m2.K/W"
    estimate = tree["smoothed"]["mean"].values[:, 0]
    np.testing.assert_allclose(estimate[[3, 12, 25]], [0.0, 1e-4, 2e-4], atol=3e-5)
    # The exact steady temperatures are those of the formula, not of a wing.
    flow = tree["observed"]["mass_flow"].values[0]
    outlet = 20.0 + 60.0 * (1.0 - np.exp(-6100.0 / (4186.0 * flow)))
    assert tree["truth"]["temperature"].values[0, 1] == pytest.approx(outlet, rel=1e-12)
    header = (outcome.folder / "csv" / "observed.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header == "step,temperature_1_degC,temperature_2_degC"
    header = (outcome.folder / "csv" / "health.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("step,fouling_true_m2.K/W")


def test_the_worker_and_this_process_fly_the_same_mission(asset_folder: Path, tmp_path: Path) -> None:
    loaded = load_scenario(asset_folder / "fouling.toml")
    runs = [
        new_run(loaded, tmp_path / str(here), Overrides(in_process=here)).folder / "csv" / "observed.csv"
        for here in (False, True)
    ]
    assert runs[0].read_bytes() == runs[1].read_bytes()


def test_a_resumed_flight_of_an_fmu_is_bit_identical(
    asset_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, die_after_turn: Callable[..., None]
) -> None:
    loaded = load_scenario(asset_folder / "fouling.toml")
    whole = new_run(loaded, tmp_path / "whole").folder
    with monkeypatch.context() as patch:
        die_after_turn(patch, 11)
        with pytest.raises(KeyboardInterrupt):
            new_run(loaded, tmp_path / "part")
    # What is flown lies in the run folder: the files that it came from may change or go.
    resume_run(tmp_path / "part")
    for name in ("run.nc", "config.json", "summary.json", "journal.jsonl", "csv/observed.csv"):
        assert (tmp_path / "part" / name).read_bytes() == (whole / name).read_bytes(), name


def test_nan_from_the_fmu_stops_the_run_which_stays_resumable(asset_folder: Path, tmp_path: Path) -> None:
    # A constant stands for the twin's table, so that only the flown asset misbehaves.
    path = changed(
        asset_folder, "nan.toml", "wall_temperature = 80.0 }", "wall_temperature = 80.0, misbehaviour = 1.0 }"
    )
    text = path.read_text(encoding="utf-8").replace(
        "levels = [0.0, 1e-4, 2e-4, 3e-4]", "levels = [0.0, 1e-4]"
    )
    path.write_text(text.replace("prior = [1, 0, 0, 0]", "prior = [1, 0]"), encoding="utf-8")
    with pytest.raises(FmuError, match=r"not finite.*outlet"):
        new_run(load_scenario(path), tmp_path / "run")
    config = read_config(tmp_path / "run")
    with CheckpointFile(tmp_path / "run", workflow.hash_record(config)) as kept:
        assert kept.turns == 16
    with pytest.raises(FmuError, match=r"not finite.*outlet"):
        resume_run(tmp_path / "run")


def test_what_does_not_fit_is_named(asset_folder: Path, tmp_path: Path) -> None:
    for name, old, new, words in (
        ("count", "count = 2", "count = 3", "2 values.*expects 3"),
        ("role", 'role = "temperature"', 'role = "strain"', "no observation 'strain'"),
        ("control", "mass_flow = 0.5", "flow = 0.5", "same inputs"),
        (
            "parameter",
            "conductance = 6100.0",
            "conduction = 6100.0",
            "the parameter conduction.*knows conductance",
        ),
    ):
        path = changed(asset_folder, f"{name}.toml", old, new)
        with pytest.raises(Exception, match=words) as caught:
            new_run(load_scenario(path), tmp_path / name)
        assert "Error" in type(caught.value).__name__
    path = changed(asset_folder, "missing.toml", "HeatExchanger.fmu", "Missing.fmu")
    with pytest.raises(Exception, match=r"Missing\.fmu cannot be read"):
        new_run(load_scenario(path), tmp_path / "missing")
    (asset_folder / "broken.fmu").write_bytes(b"PK no archive")
    path = changed(asset_folder, "damaged.toml", "HeatExchanger.fmu", "broken.fmu")
    with pytest.raises(FmuFileError):
        new_run(load_scenario(path), tmp_path / "damaged")
    assert not list(tmp_path.iterdir())  # what is wrong from the start costs no folder
