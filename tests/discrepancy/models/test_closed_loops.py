"""Controllers, own laws and flows between stores against a general integrator."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.tank import tank_setting
from discrepancy.campaign.records import Hold, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions
from fe.runtime.patch import ModelPatch, Overflow, PowerDamping
from tests.discrepancy.rigs import model_of

FloatArray = NDArray[np.float64]

MOTOR = """
format = 1
name = "Pendulum on a motor"
mass = 0.14
free = true
damping = { matrix = 0.1 }
output = [
  { name = "angle", vector = 1.0, quantity = "angle" },
  { name = "torque", controller = "position", quantity = "torque" },
]
port = [{ name = "pivot", vector = 1.0 }]
"""
PENDULUM = (
    MOTOR
    + """
parameter = [
  { name = "weight", terms = "gravity", deviation = 0.1, low = 0.2, high = 3.0 },
  { name = "servo", terms = "position.proportional", deviation = 0.1, low = 0.2, high = 3.0 },
]
[[law]]
name = "gravity"
kind = "sine_force"
port = "pivot"
coefficient = 2.7
wave_number = 1.0
phase = 0.0
[[controller]]
name = "position"
quantity = "angle"
reference = "target"
vector = 1.0
acts = 1.0
proportional = 40.0
derivative = 2.0
integral = 30.0
"""
)

TANKS = """
format = 1
name = "Two tanks"
capacity = [2.0, 3.0]
conductance = [[0.02, 0.0], [-0.02, 0.03]]
input = [{ name = "pump", vector = [1.0, 0.0], quantity = "flow" }]
output = [
  { name = "upper", vector = [1.0, 0.0], quantity = "level" },
  { name = "lower", vector = [0.0, 1.0], quantity = "level" },
]
port = [
  { name = "first", vector = [1.0, 0.0], acts = [1.0, -1.0] },
  { name = "second", vector = [0.0, 1.0] },
]
"""


def driven(time: FloatArray, item: RecordedInput, begins: Start = Start.STILL) -> Trial:
    return Trial.plain("driven", TrialKind.DRIVEN, ("a", "b"), time, begins=begins, inputs=(item,))


def integrated(rate: Any, time: FloatArray, first: FloatArray) -> FloatArray:
    """Return states at stamps; `rate` (t, state, number of the interval)."""
    state, found = first, [first]
    for k in range(len(time) - 1):
        state = solve_ivp(rate, (time[k], time[k + 1]), state, rtol=1e-9, atol=1e-11, args=(k,)).y[:, -1]
        found.append(state)
    return np.array(found)


@pytest.mark.parametrize(("hold", "measured"), [("linear", False), ("zero_order", True)])
def test_a_pendulum_follows_its_target_as_integrated(hold: str, measured: bool) -> None:
    text = PENDULUM + ('derivative_of = "measurement"\n' if measured else "")
    time = np.linspace(0.0, 1.5, 90) ** 1.1  # uneven
    target = 1.5 * np.sin(2.0 * time) + 0.3
    item = RecordedInput("target", Quantity.ANGLE, target, Hold(hold))
    weight, servo = 1.1, 0.9
    outputs = (("angle", Quantity.ANGLE), ("torque", Quantity.TORQUE))
    response = model_of(text).respond(
        driven(time, item), outputs, ModelPatch(), Conditions(np.array([weight, servo]), refinement=4)
    )

    def torque(t: float, state: FloatArray, k: int) -> float:
        slope = (target[k + 1] - target[k]) / (time[k + 1] - time[k])
        wanted = target[k] + (0.0 if measured else slope * (t - time[k]))
        speed = 0.0 if measured else slope
        return float(servo * 40.0 * (wanted - state[0]) + 2.0 * (speed - state[1]) + 30.0 * state[2])

    def rate(t: float, state: FloatArray, k: int) -> list[float]:
        slope = (target[k + 1] - target[k]) / (time[k + 1] - time[k])
        wanted = target[k] + (0.0 if measured else slope * (t - time[k]))
        push = torque(t, state, k) - 0.1 * state[1] - weight * 2.7 * np.sin(state[0])
        return [state[1], push / 0.14, wanted - state[0]]

    true = integrated(rate, time, np.zeros(3))
    np.testing.assert_allclose(response.values[:, 0], true[:, 0], atol=1e-4)
    given = [torque(time[k + 1], true[k + 1], k) for k in range(len(time) - 1)]
    np.testing.assert_allclose(response.values[1:, 1], given, atol=6e-3)


def test_a_speed_is_held_with_a_proportional_and_an_integral_gain() -> None:
    loop = 'name = "position", quantity = "angular_velocity", reference = "target", vector = 1.0, acts = 1.0'
    text = f"{MOTOR}controller = [{{ {loop}, proportional = 0.5, integral = 2.0 }}]"
    time = np.linspace(0.0, 2.0, 60)
    item = RecordedInput("target", Quantity.ANGULAR_VELOCITY, np.full(60, 3.0), Hold.ZERO_ORDER)
    outputs = (("angle", Quantity.ANGULAR_VELOCITY), ("torque", Quantity.TORQUE))
    response = model_of(text).respond(driven(time, item), outputs, ModelPatch(), Conditions(np.zeros(0)))

    def rate(t: float, state: FloatArray, k: int) -> list[float]:
        return [(0.5 * (3.0 - state[0]) + 2.0 * state[1] - 0.1 * state[0]) / 0.14, 3.0 - state[0]]

    true = integrated(rate, time, np.zeros(2))
    np.testing.assert_allclose(response.values[:, 0], true[:, 0], atol=1e-8)
    np.testing.assert_allclose(response.values[:, 1], 0.5 * (3.0 - true[:, 0]) + 2.0 * true[:, 1], atol=1e-8)


def test_what_leaves_one_store_enters_the_next_and_flows_over_when_full() -> None:
    time = np.arange(0.0, 160.0, 2.0)
    pump = 0.3 * (1.0 + np.sin(0.05 * time) * np.sign(np.sin(0.02 * time + 1.0)))
    trial = driven(time, RecordedInput("pump", Quantity.FLOW, pump, Hold.ZERO_ORDER), Start.UNKNOWN)
    laws = ModelPatch((
        PowerDamping("first", 0.1, 0.5, 0.0, 1.0, 1.0), PowerDamping("second", 0.12, 0.5, 0.0, 1.0, 1.0),
        Overflow("first", 0.3, 1.5, 2.0, 1.0),
    ))  # fmt: skip
    outputs = (("upper", Quantity.LEVEL), ("lower", Quantity.LEVEL))
    begin = np.array([[np.sqrt(2.0)], [0.5 * np.sqrt(3.0)]])

    def rate(t: float, level: FloatArray, k: int) -> list[float]:
        first = 0.1 * np.sqrt(max(level[0], 0.0)) + 0.3 * max(level[0] - 2.0, 0.0) ** 1.5 + 0.02 * level[0]
        second = 0.12 * np.sqrt(max(level[1], 0.0)) + 0.03 * level[1]
        return [(pump[k] - first) / 2.0, (first - second) / 3.0]

    true = integrated(rate, time, np.array([1.0, 0.5]))
    errors = []
    for refinement in (2, 4):
        conditions = Conditions(np.zeros(0), initial=begin, refinement=refinement)
        found = model_of(TANKS).respond(trial, outputs, laws, conditions).values
        errors.append(float(np.abs(found - true).max()))
    assert errors[1] < 2e-3
    assert errors[0] > 3.0 * errors[1]  # of second order


def test_flows_are_offered_at_states_and_forces_are_not() -> None:
    setting = tank_setting()
    for effect in (effect_by_identifier(name, library()) for name in ("outflow", "overflow")):
        assert effect.unavailable(setting) is None
        assert effect.places(setting) == ("outlet",)
        middle = {item.name: item.prior.value(0.0) for item in effect.parameters}
        (law,) = effect.patch(setting, middle, "outlet")
        trial = setting.campaign.trials[0]
        outputs = (("level", Quantity.LEVEL),)
        shown = setting.model.respond(trial, outputs, ModelPatch((law,)), Conditions(np.ones(1))).values
        assert 0.02 < np.abs(shown - trial.values).max() / trial.values.max() < 0.9
    friction = effect_by_identifier("coulomb_friction", library())
    assert "are of states, where flows act and no forces" in str(friction.unavailable(setting))


@pytest.mark.parametrize(
    ("text", "old", "new", "sentence"),
    [
        (PENDULUM, "sine_force", "sine", "the law 'gravity' has the kind 'sine', but"),
        (PENDULUM, "wave_number = 1.0\n", "", "lacks wave_number"),
        (PENDULUM, 'port = "pivot"', 'port = "axle"', "acts on the port 'axle', but there are pivot"),
        (PENDULUM, 'controller = "position"', 'controller = "pd"', "a controller gives, 'pd', but there are"),
        (PENDULUM, '"angle"\nreference', '"angular_velocity"\nreference', "leave `derivative` out"),
        (PENDULUM, '"position.proportional"', '"position.gain"', "scales 'position.gain', but there are"),
        (TANKS, "acts = [1.0, -1.0]", "acts = [-1.0, 1.0]", "must take from what its vector sees"),
        (TANKS, "acts = [1.0, -1.0]", "acts = [1.0]", "acts of port 'first' has 1 entry, but"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_sentence(text: str, old: str, new: str, sentence: str) -> None:
    assert old in text
    with pytest.raises(ModelError) as caught:
        model_of(text.replace(old, new, 1))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_steps_are_not_differentiated() -> None:
    time = np.linspace(0.0, 1.0, 20)
    item = RecordedInput("target", Quantity.ANGLE, time, Hold.ZERO_ORDER)
    with pytest.raises(
        ModelError, match="goes in steps, which the controller 'position' cannot differentiate"
    ):
        model_of(PENDULUM).respond(
            driven(time, item), (("angle", Quantity.ANGLE),), ModelPatch(), Conditions(np.ones(2))
        )
