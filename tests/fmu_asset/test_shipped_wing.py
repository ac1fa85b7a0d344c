"""The shipped wing, reduced (or found in the cache) and packed: what `uav-twin fmu build` gives a user."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.records import TrialKind
from discrepancy.models.wing import WingModel
from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.patch import FreePlay, LocalStiffnessLoss, MicroSlip, ModelPatch
from fmu_asset.check import check_fmu
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.packing.patch_file import SCHEMA, parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from tests.fmu_asset.door.kinds import on, watching
from tests.fmu_asset.packing.naming import expected, release, trial

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]


def test_the_shipped_wing_as_an_fmu(binding: Binding, tmp_path: Path) -> None:
    model = reduced_model()
    path = build_fmu(model, tmp_path / "wing.fmu").path
    check = check_fmu(path)
    assert check.passed, check.problems
    assert "warning" not in {finding.verdict for finding in check.findings}
    with FmiAsset(path, binding, parameters={"young_modulus_factor": 1.0073}) as asset:
        for loss in ((0.0, 0.0), (0.6, 0.2), (0.8, 0.8)):
            seen = asset.step({"load_factor": 3.0}, dict(zip(("z1", "z2"), loss, strict=True)))
            given = {"young_modulus_factor": 1.0073, "stiffness_loss": loss, "load_factor": 3.0}
            np.testing.assert_array_equal(seen.values, model.static_response(**given).strain)
            assert 0.0 < seen.extra["strain_error_bound"] < 1e-3 * seen.values.max()


@pytest.mark.long
def test_the_shipped_wing_with_effects_is_that_of_the_naming_side(tmp_path: Path) -> None:
    model, arrays = reduced_model(), patch_arrays()
    joint = MicroSlip("root", 2.0, 300.0, -0.3, 8)
    patch = ModelPatch((LocalStiffnessLoss(0.4, 0.9, 0.3), joint, FreePlay("tip", 60.0, 3e-3)))
    record = {"schema": SCHEMA, "effects": [{"id": "joint", "primitives": patch.to_list()}]}
    content = parse_patch(json.dumps(record).encode())
    packed = build_fmu(model, tmp_path / "wing.fmu", patch=content, arrays=arrays).path
    naming, tip = WingModel(arrays), 0.03

    def flown(forces: np.ndarray, **parameters: float) -> np.ndarray:
        with FmiAsset(packed, watching(), isolated=False, parameters=parameters) as asset:
            asset.reset(control={"load_factor": 0.0})
            return np.vstack((asset.observe().values, asset.simulate(load={"tip_force": forces}).values))

    shown = flown(np.zeros(40), response=2.0, release=tip, **on("joint"))
    wanted = expected(naming, trial(TrialKind.RINGDOWN, 41, release=release(arrays, patch, tip)), patch)
    assert np.all(np.abs(shown - wanted).max(axis=0) <= 1e-6 * np.abs(wanted).max(axis=0))
    forces = np.array([3.0, 8.0, -6.0, 2.0])
    change = flown(forces, **on("joint"))[1:] - flown(forces)[1:]
    with_it, without = (
        expected(naming, trial(TrialKind.STATIC, 4, force=forces), p) for p in (patch, ModelPatch())
    )
    apart = np.abs(change - (with_it - without)).max(axis=0)
    assert np.all(apart <= 1e-6 * np.abs(with_it).max(axis=0))
