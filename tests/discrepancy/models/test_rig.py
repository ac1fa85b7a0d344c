"""Rigs of all kinds against closed forms, matrix exponentials and a general integrator."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    Quantity,
    RecordedInput,
    Release,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.natural_scales import FORCES
from fe.runtime.patch import ModelPatch, ModulusTemperature, PowerDamping, PowerStiffness, Primitive
from tests.discrepancy.rigs import model_of

FloatArray = NDArray[np.float64]

FALL = """
format = 1
name = "Falling body"
mass = 2.0
free = true
load = [{ name = "gravity", vector = -9.81, through = "mass" }]
output = [
  { name = "height", vector = 1.0 },
  { name = "accelerometer", vector = 1.0, quantity = "acceleration", constant = 9.81 },
]
port = [{ name = "air", vector = 1.0 }]
parameter = [{ name = "mass_factor", terms = "mass", deviation = 0.1, low = 0.2, high = 5.0 }]
"""

TANKS = """
format = 1
name = "Two tanks"
capacity = [2.0, 3.0]
conductance = [[0.1, 0.0], [-0.1, 0.08]]
input = [{ name = "pump", vector = [0.5, 0.0], quantity = "voltage" }]
output = [{ name = "lower", vector = [0.0, 1.0], quantity = "level" }]
port = [{ name = "outlet", vector = [0.0, 1.0] }]
"""

MOTOR = """
format = 1
name = "Motor with a load on a shaft"
mass = [0.02, 0.5]
stiffness = [[3.0, -3.0], [-3.0, 3.0]]
free = true
capacity = 0.01
conductance = 2.0
damping = { matrix = [0.01, 0.02] }
coupling = { force_of_states = [[0.3], [0.0]], flow_of_speeds = [[-0.3, 0.0]] }
input = [
  { name = "voltage", vector = [0.0, 0.0, 1.0], quantity = "voltage" },
  { name = "brake", vector = [0.0, -1.0, 0.0], quantity = "torque" },
]
output = [
  { name = "speed", vector = [0.0, 1.0, 0.0], quantity = "angular_velocity" },
  { name = "current", vector = [0.0, 0.0, 1.0], quantity = "current" },
]
"""

DAMPER = """
format = 1
name = "Damper between actuator and load cell"
mass = 0.4
stiffness = 300.0
damping = { matrix = 25.0 }
input = [{ name = "actuator", vector = 1.0, quantity = "displacement" }]
output = [{ name = "cell", reaction = "actuator", quantity = "force" }]
port = [{ name = "piston", vector = 1.0 }]
"""

BASE = """
format = 1
name = "Mass on a shaken base"
mass = [1.0, 2.0]
stiffness = [[400.0, -400.0], [-400.0, 400.0]]
free = true
damping = { matrix = [[1.5, -1.5], [-1.5, 1.5]] }
input = [
  { name = "base", vector = [1.0, 0.0], quantity = "acceleration" },
  { name = "hand", vector = [0.0, 1.0] },
]
output = [
  { name = "mass", vector = [0.0, 1.0] },
  { name = "drive", reaction = "base", quantity = "force" },
]
port = [{ name = "guide", vector = [-1.0, 1.0] }]
"""


def trial(time: FloatArray, *inputs: RecordedInput, **changes: Any) -> Trial:
    said: dict[str, Any] = {"kind": TrialKind.DRIVEN, "begins": Start.STILL, "inputs": inputs, **changes}
    return Trial.plain("a trial", said.pop("kind"), said.pop("channels", ()), time, **said)


def shown(
    model: LumpedModel, what: Trial, outputs: dict[str, Quantity], *laws: Primitive,
    refinement: int = 1, **conditions: Any,
) -> FloatArray:  # fmt: skip
    given = {"parameters": np.ones(len(model.parameters)), **conditions}
    return model.respond(
        what, tuple(outputs.items()), ModelPatch(laws), Conditions(**given, refinement=refinement)
    ).values


def uneven(count: int, interval: float, seed: int = 0) -> FloatArray:
    steps = interval * np.random.default_rng(seed).uniform(0.6, 1.4, count - 1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def exact(
    matrix: FloatArray, into: FloatArray, time: FloatArray, inputs: FloatArray, held: bool
) -> FloatArray:
    """States (N, n) of y' = A y + B u from zero, u (N, I) linear or held between the samples."""
    n, wide = into.shape
    block = np.zeros((n + 2 * wide, n + 2 * wide))
    block[:n, :n], block[:n, n : n + wide] = matrix, into
    block[n : n + wide, n + wide :] = np.eye(wide)
    state, states = np.zeros(n), [np.zeros(n)]
    for k, h in enumerate(np.diff(time)):
        slope = 0.0 * inputs[k] if held else (inputs[k + 1] - inputs[k]) / h
        state = (expm(h * block) @ np.concatenate((state, inputs[k], slope)))[:n]
        states.append(state)
    return np.array(states)


def test_a_body_falls_as_galilei_says() -> None:
    time = uneven(60, 0.01)
    found = shown(
        model_of(FALL), trial(time),
        {"height": Quantity.DISPLACEMENT, "accelerometer": Quantity.ACCELERATION},
    )  # fmt: skip
    np.testing.assert_allclose(found[:, 0], -0.5 * 9.81 * time**2, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-12)


def test_drag_on_a_fall_is_the_hyperbolic_tangent() -> None:
    time = uneven(200, 0.01)
    drag = PowerDamping("air", 0.5, 2.0, 0.0, 1.0, 1.0)  # 0.5 v^2
    found = shown(
        model_of(FALL), trial(time),
        {"height": Quantity.VELOCITY, "accelerometer": Quantity.ACCELERATION}, drag, refinement=4,
    )  # fmt: skip
    terminal = np.sqrt(2.0 * 9.81 / 0.5)
    speed = terminal * np.tanh(9.81 * time / terminal)
    np.testing.assert_allclose(found[:, 0], -speed, atol=1e-5)
    np.testing.assert_allclose(found[:, 1], 0.5 * speed**2 / 2.0, atol=1e-4)


@pytest.mark.parametrize("hold", [Hold.LINEAR, Hold.ZERO_ORDER])
def test_first_order_states_are_exact_at_uneven_stamps(hold: Hold) -> None:
    time = uneven(120, 4.0)
    voltage = np.random.default_rng(4).uniform(0.0, 5.0, len(time))
    what = trial(time, RecordedInput("pump", Quantity.VOLTAGE, voltage, hold))
    found = shown(model_of(TANKS), what, {"lower": Quantity.LEVEL})
    matrix = -np.array([[0.1, 0.0], [-0.1, 0.08]]) / np.array([[2.0], [3.0]])
    expected = exact(matrix, np.array([[0.25], [0.0]]), time, voltage[:, None], hold is Hold.ZERO_ORDER)
    np.testing.assert_allclose(found[:, 0], expected[:, 1], atol=1e-9)


def test_tanks_begin_settled_and_stay_so() -> None:
    time = uneven(20, 4.0)
    what = trial(time, RecordedInput("pump", Quantity.VOLTAGE, np.full(20, 2.0)), begins=Start.SETTLED)
    found = shown(model_of(TANKS), what, {"lower": Quantity.LEVEL})
    np.testing.assert_allclose(found[:, 0], 2.0 * 0.5 / 0.08, rtol=1e-10)
    shifted = shown(model_of(TANKS), what, {"lower": Quantity.LEVEL}, offset=(0.4,))
    np.testing.assert_allclose(shifted[:, 0], 2.4 * 0.5 / 0.08, rtol=1e-10)


def test_an_outlet_by_a_root_of_the_level() -> None:
    time = 4.0 * np.arange(100.0)
    voltage = 2.0 + np.sin(0.05 * time)
    what = trial(time, RecordedInput("pump", Quantity.VOLTAGE, voltage))
    law = PowerDamping("outlet", 0.3, 0.5, 0.0, 1.0, 1.0)
    found = shown(model_of(TANKS), what, {"lower": Quantity.LEVEL}, law, refinement=8)

    def slope(t: float, x: FloatArray) -> FloatArray:
        u = np.interp(t, time, voltage)
        first = (0.5 * u - 0.1 * x[0]) / 2.0
        return np.array([first, (0.1 * x[0] - 0.08 * x[1] - 0.3 * np.sqrt(max(x[1], 0.0))) / 3.0])

    solution = solve_ivp(
        slope, (0.0, time[-1]), np.zeros(2), t_eval=time, rtol=1e-9, atol=1e-11, max_step=1.0
    )
    np.testing.assert_allclose(found[:, 0], solution.y[1], atol=5e-4 * solution.y[1].max())


def test_a_motor_couples_displacements_and_states() -> None:
    time = uneven(150, 0.02)
    generator = np.random.default_rng(7)
    voltage, brake = generator.normal(size=150), 0.1 * generator.normal(size=150)
    what = trial(
        time,
        RecordedInput("voltage", Quantity.VOLTAGE, voltage),
        RecordedInput("brake", Quantity.TORQUE, brake),
    )
    found = shown(model_of(MOTOR), what, {"speed": Quantity.ANGULAR_VELOCITY, "current": Quantity.CURRENT})
    matrix, into = np.zeros((5, 5)), np.zeros((5, 2))
    matrix[:2, 2:4] = np.eye(2)
    matrix[2], matrix[3] = np.array([-3, 3, -0.01, 0, 0.3]) / 0.02, np.array([3, -3, 0, -0.02, 0]) / 0.5
    matrix[4] = np.array([0, 0, -0.3, 0, -2.0]) / 0.01
    into[4, 0], into[3, 1] = 100.0, -2.0
    expected = exact(matrix, into, time, np.stack((voltage, brake), axis=1), held=False)
    np.testing.assert_allclose(found, expected[:, 3:], atol=1e-8 * np.abs(expected).max())


def test_a_driven_damper_shows_its_forces_and_those_of_laws() -> None:
    time = uneven(400, 0.005)
    motion = 0.02 * np.sin(9.0 * time)
    spline = CubicSpline(time, motion)
    what = trial(
        time, RecordedInput("actuator", Quantity.DISPLACEMENT, motion, Hold.SMOOTH), begins=Start.SETTLED
    )
    model = model_of(DAMPER)
    found = shown(model, what, {"cell": Quantity.FORCE})[:, 0]
    linear = 0.4 * spline(time, 2) + 25.0 * spline(time, 1) + 300.0 * motion
    np.testing.assert_allclose(found, linear, rtol=1e-9, atol=1e-9)
    inside = slice(5, -5)
    analytic = 300.0 * motion + 25.0 * 0.18 * np.cos(9.0 * time) - 0.4 * 1.62 * np.sin(9.0 * time)
    np.testing.assert_allclose(found[inside], analytic[inside], atol=2e-3)
    friction = PowerDamping("piston", 3.0, 0.0, 0.0, 1.0, 1.0)
    cubic = PowerStiffness("piston", 5.0, 3.0, 0, 0.02)
    rest = shown(model, what, {"cell": Quantity.FORCE}, friction, cubic)[:, 0] - linear
    speed = spline(time, 1)
    moving = np.abs(speed) > 0.02
    expected = 3.0 * np.sign(speed) + 5.0 * (motion / 0.02) ** 3
    np.testing.assert_allclose(rest[moving], expected[moving], atol=1e-6)


def test_friction_is_nothing_where_a_drive_begins_at_rest() -> None:
    """The spline's slope there is not quite zero, and dry friction takes its sign."""
    time, model, cell = 0.025 * np.arange(100.0), model_of(DAMPER), {"cell": Quantity.FORCE}
    friction = PowerDamping("piston", 3.0, 0.0, 0.0, 1.0, 1.0)
    for motion, begin in ((-0.02 * np.cos(9.0 * time), 0.0), (0.02 * np.sin(9.0 * time), 3.0)):
        drive = RecordedInput("actuator", Quantity.DISPLACEMENT, motion - motion[0], Hold.SMOOTH)
        what = trial(time, drive)
        rest = (shown(model, what, cell, friction) - shown(model, what, cell))[:, 0]
        assert rest[0] == pytest.approx(begin, abs=1e-6)


def test_a_port_that_a_drive_moves_is_measured_by_its_motion_and_the_force() -> None:
    """Not by the frequency that it would have if it were let go."""
    time = 0.01 * np.arange(300.0)
    motion = 0.02 * np.sin(2.0 * time)
    drive = RecordedInput("actuator", Quantity.DISPLACEMENT, motion, Hold.SMOOTH)
    readings = np.linspace(-50.0, 40.0, 300)[:, None]
    what = trial(time, drive, channels=("cell",), values=readings, used=np.ones((300, 1), bool))
    cell = Channel("cell", Quantity.FORCE, "cell", None)
    model = model_of(DAMPER)
    found = model.scales(Campaign("Damper", {"cell": cell}, (what,), None, {}, "")).ports["piston"]
    assert found.displacement * found.angular_frequency == pytest.approx(0.04, rel=1e-3)
    assert found.displacement * found.stiffness == pytest.approx(50.0)
    assert found.static_stiffness == pytest.approx(300.0)
    assert found.driven
    assert not found.free


def test_a_shaken_base_and_a_hand_on_the_mass() -> None:
    time = uneven(300, 0.01)
    shake = 3.0 * np.sin(12.0 * time) + np.cos(5.0 * time)
    hand = np.random.default_rng(9).normal(size=300)
    spline = CubicSpline(time, shake)
    w1, w0 = spline.antiderivative(1), spline.antiderivative(2)
    what = trial(
        time,
        RecordedInput("base", Quantity.ACCELERATION, shake, Hold.SMOOTH),
        RecordedInput("hand", Quantity.FORCE, hand),
    )
    model = model_of(BASE)
    law = PowerDamping("guide", 4.0, 2.0, 0.0, 1.0, 1.0)

    def slope(t: float, y: FloatArray) -> FloatArray:
        x, v = y[0] - w0(t), y[1] - w1(t)
        force = np.interp(t, time, hand) - 400.0 * x - 1.5 * v - 4.0 * abs(v) * v
        return np.array([y[1], force / 2.0])

    solution = solve_ivp(
        slope, (0.0, time[-1]), np.array([0.0, w1(0.0)]), t_eval=time, rtol=1e-10, atol=1e-12, max_step=0.004
    ).y
    outputs = {"mass": Quantity.DISPLACEMENT, "drive": Quantity.FORCE}
    found = shown(model, what, outputs, law, refinement=4)
    np.testing.assert_allclose(found[:, 0], solution[0], atol=2e-5)
    x, v = solution[0] - w0(time), solution[1] - w1(time)
    reaction = shake - 400.0 * x - 1.5 * v - 4.0 * np.abs(v) * v
    np.testing.assert_allclose(found[:, 1], reaction, atol=5e-3)


def test_a_smooth_force_at_nine_samples_a_period_is_read_as_a_curve() -> None:
    text = TANKS.replace("[2.0, 3.0]", "[0.02, 3.0]")  # so quick that the first state is the force itself
    time = np.arange(200.0) * (2.0 * np.pi / 0.9 / 9.0)
    wave = np.sin(0.9 * time)
    results = {}
    for hold in (Hold.LINEAR, Hold.SMOOTH):
        what = trial(time, RecordedInput("pump", Quantity.VOLTAGE, wave, hold))
        results[hold] = shown(model_of(text), what, {"lower": Quantity.LEVEL})[:, 0]
    fine = np.linspace(0.0, time[-1], 199 * 64 + 1)
    what = trial(fine, RecordedInput("pump", Quantity.VOLTAGE, np.sin(0.9 * fine)))
    truth = shown(model_of(text), what, {"lower": Quantity.LEVEL})[::64, 0]
    errors = {hold: np.abs(found - truth)[20:].max() for hold, found in results.items()}
    assert errors[Hold.SMOOTH] < 0.1 * errors[Hold.LINEAR]


def test_an_unknown_begin_takes_any_state() -> None:
    time = uneven(50, 0.01)
    model = model_of(FALL)
    what = trial(time, begins=Start.UNKNOWN, channels=("h",), values=(3.0 - 2.0 * time)[:, None],
                 used=np.ones((50, 1), bool))  # fmt: skip
    campaign = Campaign(
        "c", {"h": Channel("h", Quantity.DISPLACEMENT, "height", None)}, (what,), None, {}, ""
    )
    sizes = model.initial_sizes(campaign, what)
    assert sizes.shape == (2,)
    assert sizes[0] > 2.0
    root = np.sqrt(2.0)  # mass-normalised
    found = shown(model, what, {"height": Quantity.DISPLACEMENT}, initial=root * np.array([[3.0, -2.0]]))
    np.testing.assert_allclose(found[:, 0], 3.0 - 2.0 * time - 0.5 * 9.81 * time**2, atol=1e-12)


def test_plain_models_take_driven_trials_and_other_begins() -> None:
    model = LumpedModel.load("three_mass_chain")
    time = 0.01 * np.arange(300)
    force = np.cos(7.0 * time)
    outputs = {"x1": Quantity.DISPLACEMENT, "x3": Quantity.ACCELERATION}
    forced = trial(time, kind=TrialKind.FORCED, force=force, load_place="end", begins=Start.SETTLED)
    friction = PowerDamping("joint", 0.3, 0.0, 0.0, 1.0, 1.0)
    for hold, laws in itertools.product((None, *Hold), ((), (friction,))):
        driven = trial(time, RecordedInput("end", Quantity.FORCE, force, hold), begins=Start.SETTLED)
        one, other = (shown(model, what, outputs, *laws) for what in (replace(forced, hold=hold), driven))
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(one).max())
    still = shown(model, replace(forced, begins=Start.STILL), outputs)
    assert still[0, 0] == 0.0
    zero = replace(forced, time=np.r_[0.0, time + 1e-9], force=np.r_[0.0, force])
    blank = trial(zero.time, kind=TrialKind.FORCED, force=zero.force, load_place="end", begins=Start.SETTLED)
    np.testing.assert_allclose(still, shown(model, blank, outputs)[1:], atol=1e-6 * np.abs(still).max())


def test_a_rig_that_nothing_holds_has_no_rest() -> None:
    what = trial(uneven(20, 0.01), begins=Start.SETTLED)
    with pytest.raises(ModelError, match='say `begins` = "still" or "unknown"'):
        shown(model_of(FALL), what, {"height": Quantity.DISPLACEMENT})


def test_scales_come_from_what_acts_and_moves() -> None:
    time = uneven(60, 0.01)
    campaign = Campaign("c", {}, (trial(time),), None, {}, "")
    scales = model_of(FALL).scales(campaign)
    port = scales.ports["air"]
    assert port.displacement == pytest.approx(0.5 * 9.81 * time[-1] ** 2)
    assert port.stiffness * port.displacement == pytest.approx(FORCES * 2.0 * 9.81)
    assert port.angular_frequency * port.displacement == pytest.approx(9.81 * time[-1])


@pytest.mark.parametrize(
    ("text", "unit", "rate", "largest"),
    [
        ("capacity = 1.0\nconductance = 3e-4\n", Quantity.TEMPERATURE, 0.0, (75.0 / 3e-4, 75.0)),
        ("mass = 2.0\nstiffness = 8.0\ndamping = { ratios = [0.01] }\n", Quantity.DISPLACEMENT, 2.0,
         (75.0, 150.0)),
    ],
)  # fmt: skip
def test_scales_of_what_nothing_drives_come_from_its_readings(
    text: str, unit: Quantity, rate: float, largest: tuple[float, float]
) -> None:
    """A mug that cools and a mass that rings down: from rest, neither model would move at all."""
    shows = f'[[output]]\nname = "shown"\nvector = 1.0\nquantity = "{unit.value}"\nconstant = 20.0\n'
    model = model_of(
        'format = 1\nname = "Left alone"\n' + text + shows + '[[port]]\nname = "it"\nvector = 1.0\n'
    )
    time = np.linspace(0.0, 3e4 if rate == 0.0 else 30.0, 400)
    values = 20.0 + 75.0 * np.exp(-time * 3e-4) * np.cos(rate * time)
    read = {"values": values[:, None], "used": np.ones((400, 1), dtype=bool)}
    what = replace(trial(time, channels=("shown",), begins=Start.UNKNOWN), **read)
    channel = Channel("shown", unit, "shown", None)
    port = model.scales(Campaign("c", {"shown": channel}, (what,), None, {}, "")).ports["it"]
    shown = (port.displacement, port.angular_frequency * port.displacement)
    assert shown == pytest.approx(largest, rel=0.5)


def test_states_may_be_given_by_parts_alone() -> None:
    parts = """conductance_part = [
  { name = "first", matrix = [[0.1, 0.0], [-0.1, 0.0]] },
  { name = "second", matrix = [[0.0, 0.0], [0.0, 0.08]] }
]
"""
    whole = "conductance = [[0.1, 0.0], [-0.1, 0.08]]\n"
    text = TANKS.replace(whole, parts)
    one, other = (model_of(item).description.whole("conductance") for item in (TANKS, text))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(ModelError, match="conductance must be a 2 x 2 matrix"):
        model_of(TANKS.replace(whole, ""))


@pytest.mark.parametrize(
    ("text", "old", "new", "sentence"),
    [
        (FALL, "free = true\n", "stiffness = 0.0\ndamping = { alpha = 0.0 }\n",
         "say `free = true` if it can"),
        (FALL, 'through = "mass"', 'through = "wing"', "acts through 'wing', but there are mass"),
        (TANKS, "[2.0, 3.0]", "[2.0, 0.0]", "capacity .* must be positive definite"),
        (TANKS, "capacity = [2.0, 3.0]\n", "", "mass is missing .or capacity"),
        (MOTOR, "[[0.3], [0.0]]", "[[0.3]]", "coupling.force_of_states must be a 2 x 1 matrix"),
        (DAMPER, 'reaction = "actuator"', 'reaction = "hand"',
         "is the reaction of the prescribed motion 'hand', but there are actuator"),
        (DAMPER, 'quantity = "force"', 'quantity = "level"', "is a reaction: give it quantity"),
        (DAMPER, 'reaction = "actuator", ', "", "needs one of a vector, a reaction and a controller"),
        (BASE, "vector = [-1.0, 1.0]", "vector = [1.0]", "has 1 entry, but the model has 2 unknowns"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_sentence(text: str, old: str, new: str, sentence: str) -> None:
    assert old in text
    with pytest.raises(ModelError, match=sentence) as caught:
        model_of(text.replace(old, new))
    assert "\n" not in str(caught.value)


def test_wrong_inputs_are_named() -> None:
    time = uneven(20, 0.01)
    model = model_of(TANKS)
    with pytest.raises(ModelError, match=r"records the input 'hose', which .* does not have; it has pump"):
        shown(model, trial(time, RecordedInput("hose", Quantity.VOLTAGE, time)), {"lower": Quantity.LEVEL})
    with pytest.raises(ModelError, match=r"'pump' .* is voltage, but the trial .* records flow"):
        shown(model, trial(time, RecordedInput("pump", Quantity.FLOW, time)), {"lower": Quantity.LEVEL})


def test_a_port_whose_motion_goes_one_way_shows_no_memory() -> None:
    """A body that falls shows drag and no hysteresis; one that is pushed to and fro may show both."""
    model, time = model_of(FALL), np.linspace(0.0, 1.0, 101)
    channel = Channel("height", Quantity.DISPLACEMENT, "height", None)
    falls = trial(time)
    given = Campaign("", {"height": channel}, (falls,), None, {}, "")
    setting = Setting(given, model, model.scales(given))
    assert not setting.scales.ports["air"].turns
    for name in (
        "joint_micro_slip", "bouc_wen_hysteresis", "cubic_stiffness", "free_play", "breathing_crack",
    ):  # fmt: skip
        assert "motion that turns" in (effect_by_identifier(name, library()).unavailable(setting) or "")
    assert effect_by_identifier("quadratic_damping", library()).unavailable(setting) is None
    still = replace(given, trials=(falls, replace(falls, name="load", kind=TrialKind.STATIC)))
    assert model.scales(still).ports["air"].turns


def test_the_same_record_is_one_course_to_the_last_bit() -> None:
    time = np.sort(np.random.default_rng(5).uniform(0.0, 3.0, 40))
    between = np.linspace(time[0], time[-1], 91)
    for values in (np.sin(time), np.cos(time), np.sin(time)):  # computed, then kept
        for order in range(3):
            kept = Course.of(time.copy(), values.copy(), Hold.SMOOTH, 1)
            fresh = Course(time, values, Hold.SMOOTH, 1)
            assert np.array_equal(kept.at(between, order), fresh.at(between, order))
        for hold in (Hold.LINEAR, Hold.SMOOTH):
            course, fresh = Course.of(time.copy(), values.copy(), hold), Course(time, values, hold)
            assert np.array_equal(course.at(between), fresh.at(between))
            assert np.array_equal(course.ends(between), fresh.ends(between))


WHEEL = """
format = 1
name = "Wheel on a spring"
mass = 1.0
stiffness = 100.0
damping = { alpha = 0.0 }
input = [{ name = "twist", vector = 1.0, quantity = "torque" }]
output = [
  { name = "turn", vector = 1.0, quantity = "angle" },
]
"""
HELD = """  { name = "given", controller = "hold", quantity = "torque" },
]
controller = [{ name = "hold", vector = 1.0, acts = 1.0, quantity = "angle", proportional = 50.0 }]
"""


def test_an_angle_that_is_let_go_shows_its_speed() -> None:
    time = 0.01 * np.arange(100)
    what = trial(time, kind=TrialKind.RINGDOWN, begins=Start.SETTLED, release=Release(0.02))
    found = shown(model_of(WHEEL), what, {"turn": Quantity.ANGULAR_VELOCITY})[:, 0]
    np.testing.assert_allclose(found, -0.2 * np.sin(10.0 * time), atol=1e-12)


def test_a_rig_at_rest_has_the_temperature_of_each_level_and_what_holds_it() -> None:
    warm = {"force": np.full(3, 3.0), "temperature": np.array([0.0, 40.0, 0.0])}
    what = trial(np.arange(3.0), kind=TrialKind.STATIC, begins=Start.SETTLED, **warm)
    outputs = {"turn": Quantity.ANGLE, "given": Quantity.TORQUE}
    found = shown(model_of(WHEEL.removesuffix("]\n") + HELD), what, outputs, ModulusTemperature(0.01))
    turn = 3.0 / (np.array([100.0, 60.0, 100.0]) + 50.0)
    np.testing.assert_allclose(found, np.stack((turn, -50.0 * turn), axis=1), rtol=1e-12)
