"""Coupled components whose inputs move in straight lines: of second order, where held ones are of first."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Connection, Endpoint, Setting, SystemStructure
from fmu_asset.door.binding import Binding
from fmu_asset.errors import BindingError

from .conftest import linear, system, watch

END = 2.0
# x1' = -x1 - 2 x2, x2' = 1.5 x1 - x2: a circle.
EXACT = expm(np.array([[-1.0, -2.0], [1.5, -1.0]]) * END) @ [1.0, 0.0]


def circle(fmu: Any, *, exchange: bool = False, delayed: bool = False, substeps: int = 1) -> SystemStructure:
    """Return two followers x' = u - x that feed each other."""
    joined = (
        Connection(Endpoint("first", "x"), Endpoint("second", "u"), factor=1.5),
        Connection(Endpoint("second", "x"), Endpoint("first", "u"), factor=-2.0, delayed=delayed),
    )
    second = Component("second", fmu, {}, substeps, "model-exchange" if exchange else "co-simulation")
    first = Component("first", fmu, {"start": Setting(1.0)}, interface="co-simulation")
    return SystemStructure("circle", (first, second), (), joined)


def watched(step: float, kind: str) -> Binding:
    """Return a binding of both states."""
    binding = watch("first.x", "second.x", step_size=step).with_header(interpolation=kind)
    header = binding.binding.model_copy(update={"tolerance": 1e-10})
    return binding.model_copy(update={"binding": header})


@pytest.mark.parametrize(
    ("system_options", "asset_options"),
    [
        ({}, {}),
        ({"exchange": True}, {}),
        ({"substeps": 3}, {}),
        ({"exchange": True, "substeps": 3}, {"algorithm": "jacobi"}),
        ({"delayed": True}, {}),
        ({}, {"algorithm": "jacobi"}),
    ],
)
def test_the_error_falls_with_the_square_of_the_step(
    foreign_fmu: Any, system_options: dict[str, Any], asset_options: dict[str, Any]
) -> None:
    structure, errors = circle(foreign_fmu("follow2"), **system_options), {}
    for kind in ("zero-order", "linear"):
        for steps in (20, 40):
            binding = watched(END / steps, kind)
            with CoupledAsset(structure, binding, isolated=False, **asset_options) as asset:
                for _ in range(steps):
                    seen = asset.step()
            errors[kind, steps] = np.abs(seen.values - EXACT).max()
    assert 1.7 < errors["zero-order", 20] / errors["zero-order", 40] < 2.4
    assert 3.3 < errors["linear", 20] / errors["linear", 40] < 4.8
    assert errors["linear", 40] < 0.3 * errors["zero-order", 40]


def test_iterations_make_lines_between_both_ends(foreign_fmu: Any) -> None:
    """Settled, each input is the line between the other's states: no extrapolation is left in it."""
    options = {"isolated": False, "iterations": 50, "tolerance": 1e-13}
    with CoupledAsset(circle(foreign_fmu("follow2")), watched(0.1, "linear"), **options) as asset:
        seen = [asset.observe().values, *(asset.step().values for _ in range(3))]
    lost = 1.0 - np.exp(-0.1)
    for before, after in pairwise(seen):
        for own, factor in ((0, -2.0), (1, 1.5)):
            u, slope = factor * before[1 - own], factor * (after - before)[1 - own] / 0.1
            expected = before[own] + lost * (u - before[own]) + slope * (0.1 - lost)
            assert abs(after[own] - expected) < 1e-11


def test_a_restored_system_goes_on_to_the_bit(foreign_fmu: Any) -> None:
    structure = circle(foreign_fmu("follow2"), exchange=True)
    with CoupledAsset(structure, watched(0.1, "linear"), isolated=False) as asset:
        for _ in range(3):
            asset.step()
        kept = asset.save_state()
        there = [asset.step().values.tobytes() for _ in range(3)]
        asset.restore_state(kept)
        assert [asset.step().values.tobytes() for _ in range(3)] == there
        assert asset.describe()["linear"] == ["first", "second"]


def test_a_system_in_which_nothing_can_follow_is_refused(state_fmu: Any) -> None:
    pair = [linear("a", state_fmu, c=np.eye(2)), linear("b", state_fmu, c=np.eye(2))]
    with pytest.raises(BindingError, match=r"no component of the system test has a continuous input and"):
        CoupledAsset(system(pair, [("a.y1", "b.u1")]), watch("b.y1").with_header(interpolation="linear"))
