"""Effects that act in a window of a record: closed forms, a general integrator, and nothing else changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import atan2, cos, hypot, pi, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    BoucWen,
    ChannelOffset,
    Line,
    ModelPatch,
    PointMass,
    PortLoad,
    PowerDamping,
    PowerStiffness,
    Primitive,
    SensorGain,
    Window,
)
from tests.discrepancy.rigs import one_mass

FloatArray = NDArray[np.float64]

MASS, STIFFNESS = 2.0, 200.0
OMEGA = (STIFFNESS / MASS) ** 0.5
MODEL = one_mass(stiffness=STIFFNESS, damping={"alpha": 0.0, "beta": 0.0})
TIME = np.linspace(0.0, 6.0, 301)
FORCE = 4.0 * np.sin(3.0 * TIME) + 2.0 * np.sin(7.7 * TIME)
OUTPUTS = (("x", Quantity.DISPLACEMENT), ("x", Quantity.ACCELERATION))


def trial(kind: TrialKind, name: str = "run", time: FloatArray = TIME) -> Trial:
    if kind is TrialKind.RINGDOWN:
        return Trial.plain(name, kind, ("x",), time, load_place="push", release=Release(0.05, mode_count=1))
    force = np.interp(time, TIME, FORCE)
    return Trial.plain(name, kind, ("x",), time, load_place="push", force=force, begins=Start.STILL)


def response(given: Trial, *items: Primitive) -> FloatArray:
    found = MODEL.respond(given, OUTPUTS, ModelPatch(items), Conditions(np.zeros(0), refinement=8))
    return found.values


def friction(force: float, *windows: Window) -> PowerDamping:
    return PowerDamping("slide", force, 0.0, 0.0, 1.0, 1.0, windows=windows)


def rubbed(begin: float, force: float) -> FloatArray:
    """Return a ring-down from 0.05 m with dry friction from `begin` on, half swing by half swing."""
    x = 0.05 * np.cos(OMEGA * TIME)
    start, offset = begin, force / STIFFNESS
    at, speed = 0.05 * cos(OMEGA * begin), -0.05 * OMEGA * sin(OMEGA * begin)
    while True:
        sign = np.sign(speed) if speed else -np.sign(at)
        if speed == 0.0 and abs(at) <= offset:
            x[start <= TIME] = at
            return x
        centre = -sign * offset
        size, phase = hypot(at - centre, speed / OMEGA), atan2(-speed / OMEGA, at - centre)
        inside = start <= TIME
        x[inside] = centre + size * np.cos(OMEGA * (TIME[inside] - start) + phase)
        left = ((pi if sign < 0.0 else 2.0 * pi) - phase) % (2.0 * pi) or pi  # to where it stands still
        start, at, speed = start + left / OMEGA, centre + sign * size, 0.0
        if start > TIME[-1]:
            return x


def pushed(law: Callable[[float, float, float], float], edges: tuple[float, float]) -> FloatArray:
    """Return the motion under the force with `law(t, x, v)` between two edges, piece by piece."""
    bounds = [0.0, *edges, float(TIME[-1])]
    state, found = np.zeros(2), np.zeros(len(TIME))
    for number, (begin, end) in enumerate(pairwise(bounds)):

        def slope(t: float, y: FloatArray, on: bool = number == 1) -> list[float]:
            own = law(t, *y) if on else 0.0
            return [y[1], (np.interp(t, TIME, FORCE) - STIFFNESS * y[0] - own) / MASS]

        solution = solve_ivp(
            slope, (begin, end), state, rtol=1e-9, atol=1e-12, dense_output=True, max_step=0.02
        )
        inside = (begin <= TIME) & (end >= TIME)
        found[inside] = solution.sol(TIME[inside])[0]
        state = solution.y[:, -1]
    return found


@pytest.mark.parametrize("begin", [1.2345, 2.0, 3.33])
@pytest.mark.parametrize("stamps", ["even", "uneven"])
def test_friction_from_a_moment_on_is_the_closed_form(begin: float, stamps: str) -> None:
    kept = np.ones(len(TIME), dtype=bool)
    if stamps == "uneven":
        kept[7::9] = False
    found = response(trial(TrialKind.RINGDOWN, time=TIME[kept]), friction(0.9, Window("run", begin)))
    np.testing.assert_allclose(found[:, 0], rubbed(begin, 0.9)[kept], atol=2e-6)


LAWS = {
    "drag": (PowerDamping("slide", 40.0, 2.0, 0.0, 1.0, 1.0), lambda t, x, v: 40.0 * v * abs(v)),
    "spring": (PowerStiffness("slide", 30.0, 3.0, 0, 0.05), lambda t, x, v: 30.0 * (x / 0.05) ** 3),
    "pull": (PortLoad("slide", "3 * max(0, time - 2.5)"), lambda t, x, v: -3.0 * max(0.0, t - 2.5)),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_law_between_two_moments_against_a_general_integrator(name: str) -> None:
    item, law = LAWS[name]
    edges = (1.507, 4.003)
    item = replace(item, windows=(Window("run", *edges),))
    found = response(trial(TrialKind.FORCED), item)[:, 0]
    expected = pushed(law, edges)
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_the_response_follows_the_moment_smoothly() -> None:
    given = trial(TrialKind.FORCED)

    def at(begin: float) -> FloatArray:
        return response(given, friction(0.9, Window("run", begin)))[:, 0]

    first, second = (at(2.003 + h) - at(2.003 - h) for h in (1e-3, 2e-3))
    assert np.abs(first).max() > 1e-5
    np.testing.assert_allclose(2.0 * first, second, atol=0.05 * np.abs(second).max())


@pytest.mark.parametrize("kind", [TrialKind.FORCED, TrialKind.RINGDOWN])
def test_without_edges_within_the_record_nothing_changes(kind: TrialKind) -> None:
    given = replace(trial(kind), begins=Start.SETTLED)
    law = BoucWen("slide", 60.0, 0.01, 1.5)
    for windows, same in (
        ((Window("run"),), (law,)),
        ((Window("another", 1.0, 2.0),), ()),
        ((Window("another", 1.0), Window("run")), (law,)),
    ):
        np.testing.assert_array_equal(response(given, replace(law, windows=windows)), response(given, *same))


def test_before_a_window_and_long_after_it_the_model_is_as_it_was() -> None:
    given, law = trial(TrialKind.FORCED), BoucWen("slide", 60.0, 0.01, 1.5)
    plain = MODEL.respond(given, OUTPUTS, ModelPatch(), Conditions(np.zeros(0))).values
    found = response(given, replace(law, windows=(Window("run", 3.0, 4.0),)))
    before = TIME < 3.0
    np.testing.assert_allclose(found[before], plain[before], atol=1e-9)
    assert np.abs(found[~before] - plain[~before]).max() > 1e-3


def seen(given: Trial, *items: Primitive) -> FloatArray:
    channel = Channel("x", Quantity.DISPLACEMENT, "x", None)
    campaign = Campaign("c", {"x": channel}, (given,), None, {}, "")
    return observe(MODEL, campaign, given, ModelPatch(items), Conditions(np.zeros(0))).values[:, 0]


def test_sensors_are_wrong_within_their_windows_only() -> None:
    given = trial(TrialKind.FORCED)
    right, inside = seen(given), (TIME >= 2.0) & (TIME < 3.5)
    for wrong in (SensorGain("x", 0.1), Line("x", 3.0, 0.01, 0.02), ChannelOffset("x", "0.01 * time")):
        found = seen(given, replace(wrong, windows=(Window("run", 2.0, 3.5), Window("other"))))
        np.testing.assert_array_equal(found, np.where(inside, seen(given, wrong), right))


def test_what_cannot_be_in_a_window_says_so() -> None:
    with pytest.raises(InvalidPatchError, match="'point_mass' cannot act in a window"):
        PointMass(0.1, 0.2, windows=(Window("run", 1.0),))
    with pytest.raises(InvalidPatchError, match="must begin before it ends"):
        friction(1.0, Window("run", 2.0, 1.0))
    with pytest.raises(InvalidPatchError, match="unknown name 'tme'"):
        PortLoad("slide", "3 * tme")
    with pytest.raises(ModelError, match="the port 'door', which"):
        response(trial(TrialKind.FORCED), PortLoad("door", "time"))
    with pytest.raises(ModelError, match="ring-down, which no force with a course in time"):
        response(trial(TrialKind.RINGDOWN), PortLoad("slide", "time"))
