"""The paper's mission on our own wing: the policy, the reliability over many seeds, and the whole chain."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from benchmarks.seeds import fly_seeds
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.errors import FmuBuildError
from tests.twin_master.runs import check_same, cut_off_after
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.resolution import Overrides
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing"), pytest.mark.usefixtures("no_report")]


def test_the_papers_policy(wing):
    scenario = load_scenario("paper_level_turns").scenario
    knowledge = prepare_knowledge(scenario, ReducedModelSource(scenario, wing), 0)
    z1 = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(z1 < 0.59, 1, 0))
    assert knowledge.draws.mean == pytest.approx(1.0073, abs=0.002)
    assert knowledge.draws.standard_deviation == pytest.approx(0.0103, abs=0.001)


def test_reliability(wing):
    """Bars of 300 missions, widened for 80; `benchmarks/study_level_turns.py` flies as many as wanted."""
    scenario = load_scenario("paper_level_turns").scenario
    study = fly_seeds(scenario, ReducedModelSource(scenario, wing), range(80))
    assert study.within.value >= 0.95
    assert study.early.value <= 0.2
    assert np.all([study.rms[0].value <= 0.045, study.rms[1].value <= 0.13])


def test_the_whole_chain_and_its_resumption(wing, tmp_path):
    loaded = load_scenario("paper_level_turns")
    outcome = new_run(loaded, tmp_path / "whole")
    figures = {figure.key: figure for figure in outcome.figures}
    assert figures["policy_switch_damage"].value == pytest.approx(60.0)
    assert float(figures["strain_error_bound"].value or 0.0) < 3.0
    with xr.open_datatree(outcome.folder / "run.nc", engine="h5netcdf") as tree:
        assert tree["truth"]["tip_displacement"].attrs["units"] == "m"
        assert tree["truth"]["strain_error_bound"].attrs["units"] == "1"
    config = json.loads((outcome.folder / "config.json").read_text(encoding="utf-8"))
    assert config["inputs"]["design"] == wing.design_hash
    assert (outcome.folder / "wing.vtu").stat().st_size > 10_000
    with cut_off_after(23):
        new_run(loaded, tmp_path / "part")
    resume_run(tmp_path / "part")
    names = "run.nc config.json summary.json calibration.json wing.vtu asset/asset.fmu"
    check_same(tmp_path / "part", outcome.folder, *names.split())


@pytest.mark.long
def test_the_mission_is_the_same_with_the_compiled_wing_and_without_a_worker(wing, tmp_path):
    loaded = load_scenario("paper_level_turns")

    def arrays(name: str, overrides: Overrides, packed: str = "python") -> dict[str, np.ndarray]:
        table = loaded.scenario.to_dict()
        table["asset"]["packed"] = packed
        scenario = parse_scenario(table, "level_turns")
        folder = new_run(replace(loaded, scenario=scenario), tmp_path / name, overrides).folder
        with xr.open_datatree(folder / "run.nc", engine="h5netcdf") as tree:
            return {
                f"{group}/{variable}": tree[group][variable].values
                for group in ("observed", "filtered", "smoothed", "predicted", "truth")
                for variable in tree[group].data_vars
                if tree[group][variable].dtype.kind == "f"
            }

    worker, inside = arrays("worker", Overrides()), arrays("inside", Overrides(in_process=True))
    assert len(worker) > 8
    for name, values in worker.items():
        np.testing.assert_array_equal(inside[name], values, err_msg=name)
    try:
        find_compiler()
    except FmuBuildError as error:
        pytest.skip(f"no C compiler: {error}")
    compiled = arrays("compiled", Overrides(), "compiled")
    with zipfile.ZipFile(tmp_path / "compiled" / "asset" / "asset.fmu") as archive:
        assert not any(name.endswith(".py") for name in archive.namelist())
    assert {*compiled} == {*worker}
    for name, values in worker.items():
        np.testing.assert_allclose(compiled[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
