"""The paper's mission on our own wing: the policy, the reliability over many seeds, and the whole chain."""

import shutil
import zipfile

import numpy as np
import pytest
import xarray as xr

from benchmarks.seeds import fly_seeds
from tests.twin_master.runs import changed_scenario, of_wing
from twin_master.store.writing import open_run
from uav_twin import fly

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing"), pytest.mark.usefixtures("no_report")]


def test_the_papers_policy_and_its_reliability():
    """Bars of 300 missions, widened for 80; `benchmarks/study_level_turns.py` flies as many as wanted."""
    knowledge, source = of_wing("paper_level_turns", 0)
    z1 = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(z1 < 0.59, 1, 0))
    assert knowledge.draws.mean == pytest.approx(1.0073, abs=0.002)
    assert knowledge.draws.standard_deviation == pytest.approx(0.0103, abs=0.001)
    study = fly_seeds(knowledge.scenario, source, range(80))
    assert study.within.value >= 0.95
    assert study.early.value <= 0.2
    assert np.all([study.rms[0].value <= 0.045, study.rms[1].value <= 0.13])


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_mission_is_the_same_with_the_compiled_wing_and_without_a_worker(tmp_path):
    trees = []
    for packed in ("python", "compiled"):
        loaded = changed_scenario("paper_level_turns", {"asset": {"packed": packed}})
        trees.append(open_run(fly(loaded, tmp_path / packed, {"in_process": packed == "python"}).folder))
    with zipfile.ZipFile(tmp_path / "compiled" / "asset" / "asset.fmu") as archive:
        assert not any(name.endswith(".py") for name in archive.namelist())
    for group in ("observed", "filtered", "smoothed", "predicted", "truth"):
        plain, compiled = (tree[group].to_dataset() for tree in trees)
        xr.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-12)
