"""The shipped wing, reduced (or found in the cache) and packed: what `uav-twin fmu build` gives a user."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fe.reduction.model_cache import reduced_model
from fmu_asset.check import check_fmu
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.packing.structure_fmu import build_fmu

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]


def test_the_shipped_wing_as_an_fmu(binding: Binding, tmp_path: Path) -> None:
    model = reduced_model()
    path = build_fmu(model, tmp_path / "wing.fmu").path
    check = check_fmu(path)
    assert check.passed, check.problems
    assert not check.warnings
    with FmiAsset(path, binding, parameters={"young_modulus_factor": 1.0073}) as asset:
        for z1, z2 in ((0.0, 0.0), (0.6, 0.2), (0.8, 0.8)):
            seen = asset.step({"load_factor": 3.0}, {"z1": z1, "z2": z2})
            expected = model.static_response(
                young_modulus_factor=1.0073, stiffness_loss=(z1, z2), load_factor=3.0
            )
            np.testing.assert_array_equal(seen.values, expected.strain)
            assert 0.0 < seen.extra["strain_error_bound"] < 1e-3 * seen.values.max()
