"""Effects in windows of a record against closed forms and a general integrator; clocks of its loggers."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import CatalogueError, ModelError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime import patch
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import LoggerClock, PortLoad, PowerDamping, Primitive, Window
from tests.discrepancy.asking import FloatArray, campaign, integrated, seen
from tests.discrepancy.asking import trial as asked
from tests.discrepancy.rigs import INPUTS, model_of, one_mass

MASS, STIFFNESS = 2.0, 200.0
OMEGA = (STIFFNESS / MASS) ** 0.5
MODEL = one_mass(stiffness=STIFFNESS, damping={"alpha": 0.0, "beta": 0.0})
TIME = np.linspace(0.0, 6.0, 301)
FORCE = 4.0 * np.sin(3.0 * TIME) + 2.0 * np.sin(7.7 * TIME)
OUTPUTS = (("x", Quantity.DISPLACEMENT), ("x", Quantity.ACCELERATION))


def trial(kind: TrialKind, time: FloatArray = TIME) -> Trial:
    said: dict[str, Any] = {"release": Release(0.05, mode_count=1)}
    if kind is not TrialKind.RINGDOWN:
        said = {"force": np.interp(time, TIME, FORCE), "begins": Start.STILL}
    return asked(kind, time, channels=("x",), load_place="push", **said)


def response(given: Trial, *items: Primitive, refinement: int = 8) -> FloatArray:
    return seen(MODEL, given, OUTPUTS, *items, refinement=refinement)


def friction(force: float, *edges: float) -> PowerDamping:
    return PowerDamping("slide", force, 0.0, 0.0, 1.0, 1.0, windows=(Window("a trial", *edges),))


DRAG = PowerDamping("slide", 40.0, 2.0, 0.0, 1.0, 1.0)


def moved(law: Callable[[float, float, float], float], edges: Any, kind: TrialKind) -> FloatArray:
    """Return the motion under the force, or let go, with `law(t, x, v)` between two edges, piece by piece."""
    time, pushed = np.union1d(TIME, edges), float(kind is TrialKind.FORCED)

    def slope(t: float, y: FloatArray, k: int) -> list[float]:
        own = law(t, *y) if edges[0] <= time[k] < edges[1] else 0.0
        return [y[1], (pushed * np.interp(t, TIME, FORCE) - STIFFNESS * y[0] - own) / MASS]

    start = np.array([0.0 if pushed else 0.05, 0.0])
    return integrated(slope, time, start, parts=True, rtol=1e-9)[np.isin(time, TIME), 0]


@pytest.mark.parametrize(
    ("kind", "item", "law"),
    [
        (TrialKind.RINGDOWN, DRAG, lambda t, x, v: 40.0 * v * abs(v)),
        (TrialKind.FORCED, DRAG, lambda t, x, v: 40.0 * v * abs(v)),
        (TrialKind.FORCED, patch.PowerStiffness("slide", 30.0, 3.0, 0, 0.05), lambda t, x, v: 2.4e5 * x**3),
        (
            TrialKind.FORCED,
            PortLoad("slide", "3 * max(0, time - 2.5)"),
            lambda t, *_: -3.0 * max(0.0, t - 2.5),
        ),
    ],
)
def test_a_law_between_two_moments_against_a_general_integrator(kind: TrialKind, item: Any, law: Any) -> None:
    """At uneven stamps where it is let go."""
    edges, kept = (1.507, 4.003), (np.arange(len(TIME)) % 9 != 7) | (kind is TrialKind.FORCED)
    windowed = replace(item, windows=(Window("a trial", *edges),))
    found = response(trial(kind, TIME[kept]), windowed)[:, 0]
    expected = moved(law, edges, kind)[kept]
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [TrialKind.FORCED, TrialKind.RINGDOWN])
def test_without_edges_within_the_record_nothing_changes(kind: TrialKind) -> None:
    given, law = replace(trial(kind), begins=Start.SETTLED), patch.BoucWen("slide", 60.0, 0.01, 1.5)
    own, other, open_ = Window("a trial"), Window("another", 1.0, 2.0), Window("another", 1.0)
    for windows, same in (((own,), (law,)), ((other,), ()), ((open_, own), (law,))):
        np.testing.assert_array_equal(response(given, replace(law, windows=windows)), response(given, *same))


def test_sensors_are_wrong_within_their_windows_only() -> None:
    given = trial(TrialKind.FORCED)
    measured = campaign(given, x=Channel("x", Quantity.DISPLACEMENT, "x", None))

    def read(*items: Primitive) -> FloatArray:
        return observe(MODEL, measured, given, patch.ModelPatch(items), Conditions(np.zeros(0))).values[:, 0]

    right, inside = read(), (TIME >= 2.0) & (TIME < 3.5)
    for wrong in (
        patch.SensorGain("x", 0.1),
        patch.Line("x", 3.0, 0.01, 0.02),
        patch.ChannelOffset("x", "0.01 * time"),
    ):
        found = read(replace(wrong, windows=(Window("a trial", 2.0, 3.5), Window("other"))))
        np.testing.assert_array_equal(found, np.where(inside, read(wrong), right))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: patch.PointMass(0.1, 0.2, windows=(Window("run", 1.0),)), "'point_mass' cannot act in"),
        (lambda: friction(1.0, 2.0, 1.0), "must begin before it ends"),
        (lambda: PortLoad("slide", "3 * tme"), "unknown name 'tme'"),
        (lambda: response(trial(TrialKind.FORCED), PortLoad("door", "time")), "the port 'door', which"),
        (lambda: response(trial(TrialKind.RINGDOWN), PortLoad("slide", "time")),
         "ring-down, which no force with a course in time"),
    ],
)  # fmt: skip
def test_what_cannot_be_in_a_window_says_so(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises((InvalidPatchError, ModelError), match=sentence):
        make()


# ---------------------------------------------------------------- clocks of loggers

SHAKEN = model_of(INPUTS.text("shaken_mass.toml"))
STAMPS = np.arange(0.0, 4.0, 0.01)
SWEEP = RecordedInput("shaker", Quantity.FORCE, np.sin(9 * STAMPS**1.3))
SEEN = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("laser", "camera")}
SWEPT = asked(TrialKind.DRIVEN, STAMPS, channels=tuple(SEEN), inputs=(SWEEP,), begins=Start.STILL)
LOGGED = replace(campaign(SWEPT, **SEEN), loggers={"rack": ("shaker", "laser"), "film": ("camera",)})
RATE = 4e-3


def shown(
    *changes: Primitive, given: Campaign = LOGGED, at: Any = (1.0, 1.0), what: Trial = SWEPT
) -> FloatArray:
    return observe(SHAKEN, given, what, patch.ModelPatch(changes), Conditions(np.array(at))).values


def test_each_logger_has_its_own_clock_and_one_alone_is_a_stiffer_rig_under_a_larger_load() -> None:
    one, square = shown(LoggerClock("*", RATE), given=replace(LOGGED, loggers={})), (1.0 + RATE) ** 2
    alias = shown(patch.LoadGain(square - 1.0, 0.0), at=(square, 1.0 + RATE))
    np.testing.assert_allclose(one, alias, atol=1e-9 * np.abs(alias).max())
    clocks = LoggerClock("film", RATE), LoggerClock("rack", RATE), patch.Clock(RATE, 0.0)
    film, rack, motion = map(shown, clocks)
    assert np.abs(one - motion).max() > 0.05 * np.abs(alias).max()
    np.testing.assert_array_equal(film[:, 0], shown()[:, 0])
    np.testing.assert_array_equal(film[:, 1], motion[:, 1])
    np.testing.assert_allclose(rack[:, 0], one[:, 0], atol=1e-12)
    # the camera sees the stretched motion at its own, right times
    stretched = replace(SWEPT, time=(1.0 + RATE) * STAMPS)
    true = shown(patch.Clock(1.0 / (1.0 + RATE) - 1.0, 0.0), what=stretched)
    np.testing.assert_allclose(rack[:, 1], true[:, 1], atol=1e-12)
    with pytest.raises(CatalogueError, match="no logger 'tape'; it has 'rack', 'film'"):
        shown(LoggerClock("tape", RATE))
