"""What the naming side says of a patched wing, for FMUs to be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from discrepancy.campaign.records import Quantity, Release, Trial, TrialKind
from discrepancy.models.interface import Conditions
from discrepancy.models.wing import WingModel
from fe.runtime.patch import STRUCTURE, ModelPatch, SensorRotation
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.state import DigitalState
from tests.fmu_asset.door.kinds import CHANNELS, INTERVAL, OUTPUTS

_START = DigitalState()
STATE = np.array([1.0, *(getattr(_START, name) for name in ("servo_mass", "pitot_mass")),
                  _START.damping_alpha, _START.damping_beta])  # fmt: skip


def trial(kind: TrialKind, count: int, **given: Any) -> Trial:
    """Return a trial of many moments under no load but what is given."""
    zero, empty = np.zeros(count), np.zeros((count, 0))
    values: dict[str, Any] = {
        "name": "trial", "kind": kind, "channels": (), "values": empty, "used": empty.astype(bool),
        "time": INTERVAL * np.arange(count), "force": zero, "load_factor": zero, "load_place": "tip_load",
        "temperature": zero, "start": 0.0, "run": "", "health": np.zeros((count, 2)),
        "health_deviation": np.zeros((count, 2)), "release": None,
    }  # fmt: skip
    return Trial(**(values | given))


def release(arrays: PatchArrays, patch: ModelPatch, tip: float, z1: float = 0.0) -> Release:
    """Return the force near the tip that moves it so far."""
    structure = PatchedWing(arrays).structure(1.0, (z1, 0.0), STATE[1], STATE[2], patch.of(*STRUCTURE))
    shape = structure.static(arrays.load_tip)
    return Release(tip * float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape))


def expected(
    model: WingModel, given: Trial, patch: ModelPatch, health: Sequence[Any] = ((0.0, 0.0),)
) -> np.ndarray:
    """Return all outputs of the naming side; a rotated gauge is turned here."""
    bare = ModelPatch(tuple(item for item in patch if not isinstance(item, SensorRotation)))
    conditions = Conditions(STATE, health=np.array(health))
    outputs = tuple((name, Quantity(quantity)) for name, quantity in CHANNELS)
    found = model.respond(given, outputs, bare, replace(conditions, components=len(bare) < len(patch)))
    values = found.values.copy()
    for item in patch.of(SensorRotation):
        c, s, gauge = np.cos(item.angle), np.sin(item.angle), OUTPUTS.index(item.channel)
        across, sheared = found.transverse[:, gauge], found.shear[:, gauge]
        values[:, gauge] = c**2 * values[:, gauge] + s**2 * across + s * c * sheared
    return values


def close(shown: Any, wanted: np.ndarray, tolerance: float = 1e-6) -> None:
    """Compare with the largest strain and the largest displacement."""
    for part in (slice(24), slice(24, None)):
        apart = np.abs(np.asarray(shown)[:, part] - wanted[:, part]).max()
        assert apart <= tolerance * np.abs(wanted[:, part]).max()
