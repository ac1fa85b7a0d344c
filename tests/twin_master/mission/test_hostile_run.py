"""A run whose FMU hangs or ends stops with one sentence, and goes on when the cause is gone."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import xarray as xr

from fmu_asset.errors import FmuTimeoutError
from tests.refusals import Inputs
from tests.twin_master.runs import check_same, written
from twin_master.fleet.plan import ensemble
from twin_master.fleet.report import write_fleet_report
from twin_master.fleet.store import ENDED
from twin_master.store.writing import open_run
from uav_twin import ScenarioEnvironment, fly, fly_fleet, load_scenario, open_fleet, resume

pytestmark = pytest.mark.usefixtures("no_report")


INPUTS = Inputs(__file__)
BINDING = INPUTS.text("hostile_binding.toml")


def scenario(folder: Path, fmu: Path, *changes: tuple[str, str], binding: str = BINDING) -> Any:
    written(folder, binding, name="binding.toml")
    return load_scenario(
        written(folder, INPUTS.text("hostile.toml"), ("FMU", str(fmu)), *changes, name="scenario.toml")
    )


def test_a_run_is_resumed_once_the_cause_is_gone(foreign_fmu, tmp_path, monkeypatch):
    fmu, flag = foreign_fmu("hostile2", "HANG", "STATELESS", "AFTER=20"), tmp_path / "flag"
    monkeypatch.setenv("HOSTILE_FLAG", str(flag))
    loaded = scenario(tmp_path, fmu, binding=f"{BINDING}limits = {{ step_time = 1.0 }}\n")
    whole = fly(loaded, tmp_path / "whole").folder
    flag.touch()
    sentence = r"step 20 from t = 20 s: .*longer than 1 s for the step"
    with pytest.raises(FmuTimeoutError, match=sentence):
        fly(loaded, tmp_path / "part")
    with pytest.raises(FmuTimeoutError, match=sentence):
        resume(tmp_path / "part")
    flag.unlink()
    resume(tmp_path / "part")
    check_same(tmp_path / "part", whole, "run.nc", "config.json", "summary.json", "csv/observed.csv")


def test_an_fmu_that_ends_its_simulation_ends_the_mission_with_what_was_flown(
    foreign_fmu, tmp_path, monkeypatch
):
    """In a run, a fleet and an environment."""
    fmu, flag = foreign_fmu("hostile2", "ENDS", "STATELESS", "AFTER=20"), tmp_path / "flag"
    monkeypatch.setenv("HOSTILE_FLAG", str(flag))
    loaded = scenario(tmp_path, fmu)
    whole = fly(loaded, tmp_path / "whole")
    assert whole.notices == ()
    flag.touch()
    part = fly(loaded, tmp_path / "part")
    (said,) = part.notices
    assert said.startswith("The asset ended the mission after 20 of 30 turns: ")
    assert "The FMU asked to end the simulation in the step from t = 20 s" in said
    with xr.open_datatree(whole.folder / "run.nc") as long, xr.open_datatree(part.folder / "run.nc") as short:
        for name in ("observed/y", "truth/y", "truth/state", "truth/sensor_status", "filtered/belief"):
            if name in long:
                np.testing.assert_array_equal(short[name].values, long[name].values[:20])
        assert short["truth/sensor_status"].shape == (20, 1)
    assert resume(part.folder).notices == part.notices
    fleet = fly_fleet(ensemble(str(tmp_path / "scenario.toml"), range(4, 5)), tmp_path / "fleet")
    assert fleet.failures == {}
    assert [*fleet.ended.values()] == [said.replace(f"{part.folder}/", "")]
    (group,) = open_fleet(fleet.folder).values()
    assert group["status"].values.tolist() == [ENDED]
    assert (group["control_index"].values >= 0).sum() == 20
    assert "1 of 1 assets ended their simulation" in write_fleet_report(fleet.folder).read_text()
    with ScenarioEnvironment(loaded) as environment:
        environment.reset(seed=4)
        seen = [environment.step(0) for _ in range(20)]
        assert [terminated for _, _, terminated, _, _ in seen] == [False] * 19 + [True]
        assert "asked to end" in seen[-1][4]["ended"]
        with pytest.raises(gymnasium.error.ResetNeeded):
            environment.step(0)


def test_an_fmi_3_asset_with_an_array_is_watched(foreign_fmu, tmp_path):
    """Its outputs grow with every step, so that only the way through twin, store and names is looked at."""
    fmu = foreign_fmu.changed("array3", "names", ('name="calls"', 'name="state/calls"'))
    changes = ("steps = 30", "steps = 3"), *[("standard_deviation = 0.1", "standard_deviation = 0.05")] * 2
    binding = INPUTS.text("array_binding.toml")
    two, three = (
        scenario(tmp_path, fmu, *changes, ("count = 1", f"count = {count}"), binding=binding)
        for count in (2, 3)
    )
    truth = open_run(fly(two, tmp_path / "run").folder)["truth"]
    assert truth["state_calls"].values.tolist() == [1.0, 2.0, 3.0]
    assert (truth["y[1]"].attrs["units"], truth["y"].attrs["units"]) == ("mm", "m")
    np.testing.assert_allclose(truth["y"].values[:, 1], 1e-3 * truth["y[2]"].values, rtol=1e-6)
    with pytest.raises(Exception, match=r"observes 2 values of `y`, and the scenario expects 3"):
        fly(three, tmp_path / "other")
    assert not (tmp_path / "other").exists()
