"""Inputs that move in straight lines: where they begin, what stays, what cannot follow; of systems, too."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Connection, Endpoint, Setting, SystemStructure
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError, FmuInputError
from tests.fmu_asset.door.kinds import KINDS
from tests.fmu_asset.making import bound, changed, linear, system, watch

LINES = KINDS["lines"].binding
LINE = [0.5, 2.0, -1.0, -1.0, 3.0, 3.5, 0.0]


@pytest.mark.parametrize(("state", "isolated"), [("serialised", True), ("replay", False)])
def test_an_input_may_jump_before_the_state_is_kept(foreign_fmu, state, isolated) -> None:
    """A worker is told the lines with each request."""
    with FmiAsset(
        foreign_fmu("follow2"), changed(LINES, header={"state": state}), isolated=isolated
    ) as asset:
        asset.simulate({"u": LINE[:3]})
        asset.hold({"u": 3.0})
        with pytest.raises(FmuInputError, match="outside the range"):
            asset.hold({"u": 1000.0})
        kept = asset.save_state()
        there = asset.simulate({"u": LINE[3:]})
        assert there.extra["seen"][0] == 3.0
        with asset.sibling() as other:
            other.restore_state(kept)
            assert other.simulate({"u": LINE[3:]}).values.tobytes() == there.values.tobytes()


@pytest.mark.parametrize("interface", ["co-simulation", "model-exchange"])
def test_an_input_that_stays_is_held_to_the_bit(foreign_fmu, interface) -> None:
    binding, seen = changed(LINES, header={"interface": interface, "step_size": 0.1, "decimation": 3}), []
    for kind in ("zero-order", "linear"):
        held = binding.with_header(interpolation=kind)
        with FmiAsset(foreign_fmu("follow2"), held, isolated=False) as asset:
            asset.reset(control={"u": 0.7})
            seen.append(asset.simulate(steps=5).values.tobytes())
    assert seen[0] == seen[1]


def test_a_line_that_goes_on_is_no_event(foreign_fmu) -> None:
    mode, record = {"mode": {"variable": "mode", "unit": "1"}}, {"variables": ["events"]}
    binding = changed(LINES, header={"interface": "model-exchange"}, load=mode, record=record)
    with FmiAsset(foreign_fmu("follow2"), binding, isolated=False) as asset:
        asset.reset({}, control={"u": 0.0}, load={"mode": 0})
        smooth = asset.simulate({"u": [0.3, 0.1, 0.4]}).extra["events"]
        assert len(set(smooth.tolist())) == 1
        assert asset.step({"u": 0.5}, load={"mode": 1}).extra["events"] == smooth[-1] + 1


@pytest.mark.parametrize(
    ("model", "taken", "given", "sentence"),
    [
        ("spring2", ("force", "N"), ("position", "m"), "of inputs: it does not declare `canInterpolate"),
        ("array3", ("u", "1"), ("y", "mm"), "takes no derivatives of inputs: FMI 3.0 has no"),
        ("follow2", ("mode", "1"), ("x", "1"), "none of them is a continuous real number"),
    ],
)
def test_what_cannot_follow_is_refused(foreign_fmu, model, taken, given, sentence) -> None:
    binding = bound(1.0, {"y": given}, load={"u": taken}, header={"interpolation": "linear"})
    with pytest.raises(BindingError, match=sentence):
        FmiAsset(foreign_fmu(model), binding)


# ---------------------------------------------------------------------- systems: of second order

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


def watched(step: float, kind: str) -> Any:
    """Return a binding of both states."""
    return watch("first.x", "second.x", step_size=step, interpolation=kind, tolerance=1e-10)


JACOBI = {"algorithm": "jacobi"}
COUPLED = [({}, {}), ({"exchange": True}, {}), ({"substeps": 3}, {}), ({"delayed": True}, {}), ({}, JACOBI),
           ({"exchange": True, "substeps": 3}, JACOBI)]  # fmt: skip


@pytest.mark.parametrize(("system_options", "asset_options"), COUPLED)
def test_the_error_of_a_system_falls_with_the_square_of_the_step(
    foreign_fmu, system_options, asset_options
) -> None:
    structure, errors = circle(foreign_fmu("follow2"), **system_options), {}
    for kind in ("zero-order", "linear"):
        for steps in (20, 40):
            binding = watched(END / steps, kind)
            with CoupledAsset(structure, binding, isolated=False, **asset_options) as asset:
                seen = asset.simulate(steps=steps).values[-1]
            errors[kind, steps] = np.abs(seen - EXACT).max()
    assert 1.7 < errors["zero-order", 20] / errors["zero-order", 40] < 2.4
    assert 3.3 < errors["linear", 20] / errors["linear", 40] < 4.8
    assert errors["linear", 40] < 0.3 * errors["zero-order", 40]


def test_iterations_make_lines_between_both_ends(foreign_fmu) -> None:
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


def test_a_system_with_lines_is_restored_or_refused(foreign_fmu, state_fmu) -> None:
    structure = circle(foreign_fmu("follow2"), exchange=True)
    with CoupledAsset(structure, watched(0.1, "linear"), isolated=False) as asset:
        asset.simulate(steps=3)
        kept = asset.save_state()
        there = [asset.step().values.tobytes() for _ in range(3)]
        asset.restore_state(kept)
        assert [asset.step().values.tobytes() for _ in range(3)] == there
        assert asset.describe()["linear"] == ["first", "second"]
    pair = [linear("a", state_fmu, c=np.eye(2)), linear("b", state_fmu, c=np.eye(2))]
    with pytest.raises(BindingError, match=r"no component of the system test has a continuous input and"):
        CoupledAsset(system(pair, [("a.y1", "b.u1")]), watch("b.y1", interpolation="linear"))
