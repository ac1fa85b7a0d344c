"""Any FMU with a binding and a scenario can be flown: a heat exchanger, by the same code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_asset.errors import FmuError, FmuFileError
from twin_master import workflow
from twin_master.mission.loop import CheckpointFile
from twin_master.run_folder import read_config
from twin_master.scenario.reading import load_scenario
from twin_master.store.writing import read_run
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

pytestmark = pytest.mark.usefixtures("no_report")


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    text = (folder / "fouling.toml").read_text(encoding="utf-8")
    assert old in text
    path = folder / name
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_a_heat_exchanger_is_watched_and_steered(heat_exchanger: Path, tmp_path: Path) -> None:
    outcome = new_run(load_scenario(heat_exchanger / "fouling.toml"), tmp_path / "run")
    tree = read_run(outcome.folder)
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


def test_nan_from_the_fmu_stops_the_run_which_stays_resumable(heat_exchanger: Path, tmp_path: Path) -> None:
    # A constant stands for the twin's table, so that only the flown asset misbehaves.
    load = "wall_temperature = 80.0"
    path = changed(heat_exchanger, "nan.toml", f"{load} }}", f"{load}, misbehaviour = 1.0 }}")
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


def test_what_does_not_fit_is_named(heat_exchanger: Path, tmp_path: Path) -> None:
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
        path = changed(heat_exchanger, f"{name}.toml", old, new)
        with pytest.raises(Exception, match=words) as caught:
            new_run(load_scenario(path), tmp_path / name)
        assert "Error" in type(caught.value).__name__
    path = changed(heat_exchanger, "missing.toml", "HeatExchanger.fmu", "Missing.fmu")
    with pytest.raises(Exception, match=r"Missing\.fmu cannot be read"):
        new_run(load_scenario(path), tmp_path / "missing")
    (heat_exchanger / "broken.fmu").write_bytes(b"PK no archive")
    path = changed(heat_exchanger, "damaged.toml", "HeatExchanger.fmu", "broken.fmu")
    with pytest.raises(FmuFileError):
        new_run(load_scenario(path), tmp_path / "damaged")
    assert not list(tmp_path.iterdir())  # what is wrong from the start costs no folder
