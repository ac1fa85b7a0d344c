"""The shipped wing, reduced (or found in the cache) and packed: what `uav-twin fmu build` gives a user."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.records import Quantity, Release, Trial, TrialKind
from discrepancy.models.interface import Conditions
from discrepancy.models.wing import WingModel
from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.patch import FreePlay, LocalStiffnessLoss, MicroSlip, ModelPatch
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.state import DigitalState
from fmu_asset.check import check_fmu
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.packing.patch_file import SCHEMA, parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.effects import output_channels

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]


def test_the_shipped_wing_as_an_fmu(binding: Binding, tmp_path: Path) -> None:
    model = reduced_model()
    path = build_fmu(model, tmp_path / "wing.fmu").path
    check = check_fmu(path)
    assert check.passed, check.problems
    assert "warning" not in {finding.verdict for finding in check.findings}
    with FmiAsset(path, binding, parameters={"young_modulus_factor": 1.0073}) as asset:
        for z1, z2 in ((0.0, 0.0), (0.6, 0.2), (0.8, 0.8)):
            seen = asset.step({"load_factor": 3.0}, {"z1": z1, "z2": z2})
            expected = model.static_response(
                young_modulus_factor=1.0073, stiffness_loss=(z1, z2), load_factor=3.0
            )
            np.testing.assert_array_equal(seen.values, expected.strain)
            assert 0.0 < seen.extra["strain_error_bound"] < 1e-3 * seen.values.max()


@pytest.mark.long
def test_the_shipped_wing_with_effects_is_that_of_the_naming_side(tmp_path: Path) -> None:
    model, arrays = reduced_model(), patch_arrays()
    joint = MicroSlip("root", 2.0, 300.0, -0.3, 8)
    patch = ModelPatch((LocalStiffnessLoss(0.4, 0.9, 0.3), joint, FreePlay("tip", 60.0, 3e-3)))
    record = {"schema": SCHEMA, "effects": [{"id": "joint", "primitives": patch.to_list()}]}
    packed = build_fmu(
        model, tmp_path / "wing.fmu", patch=parse_patch(json.dumps(record).encode()), arrays=arrays
    ).path
    channels = output_channels(model.gauge_count)
    door = parse_binding(
        {
            "binding": {"name": "all", "step_size": 0.01},
            "control": {"load_factor": {"variable": "load_factor", "unit": "1"}},
            "load": {"tip_force": {"variable": "tip_force", "unit": "N"}},
            "parameter": {
                "response": {"variable": "response", "unit": "1"},
                "release": {"variable": "initial_tip_displacement", "unit": "m"},
            },
            "observation": {
                "strain": {"variables": [name for name, _ in channels[:-2]], "unit": "1"},
                "displacement": {"variables": [name for name, _ in channels[-2:]], "unit": "m"},
            },
        }
    )
    naming = WingModel(arrays)
    outputs = tuple((name, Quantity(quantity)) for name, quantity in channels)
    state = DigitalState()
    conditions = Conditions(
        np.array([1.0, state.servo_mass, state.pitot_mass, state.damping_alpha, state.damping_beta])
    )

    def trial(kind: TrialKind, force: np.ndarray, release: Release | None = None) -> Trial:
        zero = np.zeros(len(force))
        return Trial(
            name="trial", kind=kind, channels=(), values=np.zeros((len(force), 0)),
            used=np.zeros((len(force), 0), dtype=bool), time=0.01 * np.arange(len(force)), force=force,
            load_factor=zero, load_place="tip_load", temperature=zero, start=0.0, run="",
            health=np.zeros((1, 2)), health_deviation=np.zeros((1, 2)), release=release,
        )  # fmt: skip

    def flown(forces: np.ndarray, **parameters: float) -> np.ndarray:
        with FmiAsset(packed, door, isolated=False, parameters=parameters) as asset:
            asset.reset(control={"load_factor": 0.0})
            first = asset.observe().values
            return np.array([first, *(asset.step(load={"tip_force": f}).values for f in forces)])

    structure = PatchedWing(arrays).structure(1.0, (0.0, 0.0), state.servo_mass, state.pitot_mass, patch)
    shape = structure.static(arrays.load_tip)
    tip = 0.03
    release = Release(tip * float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape))
    shown = flown(np.zeros(40), response=2.0, release=tip, **{"effect.joint.active": 1.0})
    expected = naming.respond(trial(TrialKind.RINGDOWN, np.zeros(41), release), outputs, patch, conditions)
    assert np.all(np.abs(shown - expected.values).max(axis=0) <= 1e-6 * np.abs(expected.values).max(axis=0))
    forces = np.array([3.0, 8.0, -6.0, 2.0])
    change = flown(forces, **{"effect.joint.active": 1.0})[1:] - flown(forces)[1:]
    static = trial(TrialKind.STATIC, forces)
    on = naming.respond(static, outputs, patch, conditions).values
    off = naming.respond(static, outputs, ModelPatch(), conditions).values
    assert np.all(np.abs(change - (on - off)).max(axis=0) <= 1e-6 * np.abs(on).max(axis=0))
