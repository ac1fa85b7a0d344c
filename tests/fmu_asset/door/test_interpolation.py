"""Inputs that move in straight lines between communication points, against closed forms."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError, FmuInputError

from .conftest import bound

STEP = 0.25
COURSE = np.array([0.5, 2.0, -1.0, -1.0, 3.0, 3.5, 0.0])
QUARTERS = {"step_size": STEP / 4, "decimation": 4}
EXCHANGED = {"interface": "model-exchange", "tolerance": 1e-11}


def followed(**header: object) -> Binding:
    """Return a binding of x' = u - x with linear inputs."""
    roles = {"control": {"u": ("u", "1")}, "monitor": {"seen": ("seen", "1")}}
    return bound(STEP, {"x": ("x", "1")}, header={"interpolation": "linear", **header}, **roles)


def exact(course: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return x at the end of each step of x' = u - x, x(0) = 0, along straight lines."""
    x, values, lost = 0.0, [], 1.0 - np.exp(-STEP)
    for first, last in pairwise(course):
        x += lost * (first - x) + (last - first) / STEP * (STEP - lost)
        values.append(x)
    return np.array(values)


@pytest.mark.parametrize(
    ("model", "header", "tolerance"),
    [
        ("follow1", {}, 1e-13),
        ("follow2", {}, 1e-13),
        ("follow2", QUARTERS, 1e-13),
        ("follow2", EXCHANGED, 1e-8),
        ("follow2", EXCHANGED | QUARTERS, 1e-8),
    ],
)
def test_straight_lines_are_followed(
    foreign_fmu: Any, model: str, header: dict[str, object], tolerance: float
) -> None:
    with FmiAsset(foreign_fmu(model), followed(**header), isolated=False) as asset:
        asset.reset(control={"u": COURSE[0]})
        history = asset.simulate({"u": COURSE[1:]})
        np.testing.assert_allclose(history.values[:, 0], exact(COURSE), rtol=0.0, atol=tolerance)
        if model == "follow2" and "interface" not in header:
            quarter = 0.75 if "decimation" in header else 0.0
            begins = COURSE[:-1] + quarter * np.diff(COURSE)
            np.testing.assert_allclose(history.extra["seen"], begins, rtol=1e-15)
        stepped = asset.sibling()
        stepped.reset(control={"u": COURSE[0]})
        single = np.array([stepped.step({"u": value}).values for value in COURSE[1:].tolist()])
        stepped.close()
        assert single.tobytes() == history.values.tobytes()


@pytest.mark.parametrize(("state", "isolated"), [("serialised", True), ("replay", False)])
def test_a_restored_state_goes_on_along_the_same_lines(foreign_fmu: Any, state: str, isolated: bool) -> None:
    """A worker is told the lines with each request; an input may jump before the state is kept."""
    with FmiAsset(foreign_fmu("follow2"), followed(state=state), isolated=isolated) as asset:
        asset.simulate({"u": COURSE[:3]})
        asset.hold({"u": -2.0})
        kept = asset.save_state()
        there = asset.simulate({"u": COURSE[3:]})
        assert there.extra["seen"][0] == -2.0
        with asset.sibling() as other:
            other.restore_state(kept)
            assert other.simulate({"u": COURSE[3:]}).values.tobytes() == there.values.tobytes()


@pytest.mark.parametrize("interface", ["co-simulation", "model-exchange"])
def test_an_input_that_stays_is_held_to_the_bit(foreign_fmu: Any, interface: str) -> None:
    binding, seen = followed(interface=interface, step_size=0.1, decimation=3), []
    for kind in ("zero-order", "linear"):
        with FmiAsset(
            foreign_fmu("follow2"), binding.with_header(interpolation=kind), isolated=False
        ) as asset:
            asset.reset(control={"u": 0.7})
            seen.append(asset.simulate(steps=5).values.tobytes())
    assert seen[0] == seen[1]


def test_a_line_that_goes_on_is_no_event(foreign_fmu: Any) -> None:
    binding = followed(interface="model-exchange").model_dump(exclude_none=True)
    binding["load"] = {"mode": {"variable": "mode", "unit": "1"}}
    binding["record"] = {"variables": ["events"]}
    with FmiAsset(foreign_fmu("follow2"), parse_binding(binding), isolated=False) as asset:
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
def test_what_cannot_follow_is_refused(
    foreign_fmu: Any, model: str, taken: tuple[str, str], given: tuple[str, str], sentence: str
) -> None:
    binding = bound(1.0, {"y": given}, load={"u": taken}, header={"interpolation": "linear"})
    with pytest.raises(BindingError, match=sentence):
        FmiAsset(foreign_fmu(model), binding)


def test_what_is_held_is_checked(foreign_fmu: Any) -> None:
    with FmiAsset(foreign_fmu("follow2"), followed(), isolated=False) as asset:
        asset.hold({"u": 3.0})
        with pytest.raises(FmuInputError, match="outside the range"):
            asset.hold({"u": 1000.0})
        assert asset.step().extra["seen"] == 3.0
