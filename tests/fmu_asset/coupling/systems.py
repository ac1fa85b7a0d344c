"""Systems of FMUs that several files of tests fly."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fmu_asset.coupling.structure import Component, Setting, SystemStructure
from tests.fmu_asset.door.kinds import A1, A2, B1, B2, C2, D2, OSCILLATOR
from tests.fmu_asset.making import linear, system
from tests.fmu_asset.ours import OurFmus


def oscillator(
    state_fmu: Path, linear_fmu: Path, substeps: int = 1, *, pushed: bool = False
) -> SystemStructure:
    """Return two masses, the components in the wrong order: the right one follows from the dependencies."""
    first = linear("first", state_fmu, substeps, a=A1, b=B1, c=np.eye(2), initial=OSCILLATOR[:2])
    second = linear("second", linear_fmu, substeps, a=A2, b=B2, c=C2, d=D2, initial=OSCILLATOR[2:])
    ends = [("first.y1", "second.u1"), ("first.y2", "second.u2"), ("second.y1", "first.u1")]
    return system([second, first], [*ends, *([("push", "first.u2")] if pushed else [])])


def three(ours: OurFmus) -> SystemStructure:
    """Return damage growth, a wing in motion and its gauges."""
    damage = {"probability.z1": Setting(0.5), "probability.z2": Setting(0.4), "seed": Setting(7)}
    moving = {"response": Setting("transient"), "damping.alpha": Setting(1.0)}
    gauges = {"noise": Setting(150.0, "microstrain"), "dropout_probability": Setting(10.0, "%")}
    return system(
        [
            Component("damage", ours("damage_growth"), damage),
            Component("gauges", ours("strain_gauges"), gauges),
            Component("wing", ours("python"), moving),
        ],
        [
            ("load_factor", "wing.load_factor"),
            ("load_factor", "damage.load_factor"),
            ("damage.z1", "wing.health.z1"),
            ("damage.z2", "wing.health.z2"),
            ("wing.strain[{1..24}]", "gauges.strain[{1..24}]"),
        ],
    )
