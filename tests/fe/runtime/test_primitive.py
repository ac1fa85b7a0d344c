"""What all primitives have in common."""

from __future__ import annotations

from typing import ClassVar

from fe.runtime.patch import PRIMITIVES
from fe.runtime.primitive import Primitive


def test_kinds_are_the_keys_of_patches_that_were_kept() -> None:
    assert list(PRIMITIVES) == [
        "point_mass", "root_compliance", "local_stiffness_loss", "modulus_temperature", "stiffness_drift",
        "bouc_wen", "free_play", "micro_slip", "overflow", "power_damping", "power_stiffness", "sine_force",
        "load_place", "load_gain", "washout", "inertia_relief", "port_load", "sensor_gain", "sensor_drift",
        "channel_offset", "sensor_rotation", "thermal_strain", "high_pass", "clock", "logger_clock", "line",
        "decaying_line", "run_offset",
    ]  # fmt: skip


def test_a_class_may_name_its_own_kind() -> None:
    class Renamed(Primitive):
        kind: ClassVar[str] = "first_name"

    assert Renamed.kind == "first_name"
