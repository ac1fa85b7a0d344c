"""Rigs of all kinds against closed forms and general integrators; effects in windows; clocks of loggers."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Channel, Hold, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import CatalogueError, ModelError
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.port_scales import FORCE_PER_RMS
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime import patch
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import PowerDamping, PowerStiffness, Primitive, StiffnessDrift, Window
from tests.discrepancy.rigs import INPUTS, FloatArray, asked, campaign, integrated, model_of, one_mass, seen
from tests.fe.runtime.stepping import exact

HEIGHT, LOWER, CELL = {"height": Quantity.DISPLACEMENT}, {"lower": Quantity.LEVEL}, {"cell": Quantity.FORCE}
FRICTION = PowerDamping("piston", 3.0, 0.0, 0.0, 1.0, 1.0)
GUIDE_FRICTION = PowerDamping("guide", 5.0, 0.0, 0.0, 1.0, 1.0)


def rig(name: str, *changes: tuple[str, str]) -> LumpedModel:
    return model_of(INPUTS.text(f"{name}.toml", *changes))


def trial(time: Any, *inputs: RecordedInput, kind: TrialKind = TrialKind.DRIVEN, **said: Any) -> Any:
    return asked(kind, time, **{"begins": Start.STILL, "inputs": inputs, **said})


def pump(values: FloatArray, hold: Hold | None = Hold.LINEAR) -> RecordedInput:
    return RecordedInput("pump", Quantity.VOLTAGE, values, hold)


def actuator(values: FloatArray) -> RecordedInput:
    return RecordedInput("actuator", Quantity.DISPLACEMENT, values, Hold.SMOOTH)


def uneven(count: int, interval: float) -> FloatArray:
    steps = interval * np.random.default_rng(0).uniform(0.6, 1.4, count - 1)
    return np.concatenate(([0.0], np.cumsum(steps)))


# ---------------------------------------------------------------- bodies, tanks, motors


FALL = asked(TrialKind.DRIVEN, uneven(200, 0.01), begins=Start.STILL)
ACCELEROMETER = {"accelerometer": Quantity.ACCELERATION}
GRAVITY = 9.81


def test_a_body_falls_as_galilei_says() -> None:
    found = seen(rig("falling_body"), FALL, HEIGHT | ACCELEROMETER)
    height, acceleration = found.T
    np.testing.assert_allclose(height, -0.5 * GRAVITY * FALL.time**2, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-12)


def test_drag_makes_the_speed_of_a_fall_a_hyperbolic_tangent() -> None:
    drag = PowerDamping("air", 0.5, 2.0, 0.0, 1.0, 1.0)  # 0.5 v^2
    outputs = {"height": Quantity.VELOCITY} | ACCELEROMETER
    velocity, acceleration = seen(rig("falling_body"), FALL, outputs, drag, refinement=4).T
    terminal = np.sqrt(2.0 * GRAVITY / 0.5)
    speed = terminal * np.tanh(GRAVITY * FALL.time / terminal)
    np.testing.assert_allclose(velocity, -speed, atol=1e-5)
    np.testing.assert_allclose(acceleration, 0.5 * speed**2 / 2.0, atol=1e-4)


def test_the_scales_of_a_fall_come_from_what_acts_and_moves() -> None:
    duration = FALL.time[-1]
    port = rig("falling_body").scales(campaign(FALL)).ports["air"]
    assert port.displacement == pytest.approx(0.5 * GRAVITY * duration**2)
    assert port.stiffness * port.displacement == pytest.approx(FORCE_PER_RMS * 2.0 * GRAVITY)
    assert port.angular_frequency * port.displacement == pytest.approx(GRAVITY * duration)


OUTLET = 0.08
"""Outflow of the lower tank over its level [per unit of level]; 0.5 is what the pump gives per volt."""


@pytest.mark.parametrize("offset", [0.0, 0.4])
def test_tanks_begin_settled_and_stay_so(offset: float) -> None:
    constant = trial(uneven(20, 4.0), pump(np.full(20, 2.0)), begins=Start.SETTLED)
    level = seen(rig("tanks"), constant, LOWER, offset=(offset,) if offset else ())[:, 0]
    np.testing.assert_allclose(level, (2.0 + offset) * 0.5 / OUTLET, rtol=1e-10)


def test_a_force_at_a_state_at_rest_is_held_by_the_outflow() -> None:
    tanks = rig("tanks", (', quantity = "voltage"', ""))
    still = trial(
        np.arange(3.0),
        force=np.array([0.0, 2.0, -1.0]),
        kind=TrialKind.STATIC,
        begins=Start.SETTLED,
        load_place="pump",
    )
    level = seen(tanks, still, LOWER)[:, 0]
    np.testing.assert_allclose(level, still.force * 0.5 / OUTLET, rtol=1e-10)


def test_a_motor_couples_displacements_and_states() -> None:
    time = uneven(150, 0.02)
    generator = np.random.default_rng(7)
    voltage = generator.normal(size=150)
    torque = 0.1 * generator.normal(size=150)
    driven = trial(
        time,
        RecordedInput("voltage", Quantity.VOLTAGE, voltage),
        RecordedInput("brake", Quantity.TORQUE, torque),
    )
    outputs = {"speed": Quantity.ANGULAR_VELOCITY, "current": Quantity.CURRENT}

    response = seen(rig("motor"), driven, outputs)

    # states: two angles, their speeds, the current; inputs: voltage, torque of the brake
    rate_of_angle = [[0.0, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0]]
    rate_of_rotor_speed = np.array([-3.0, 3.0, -0.01, 0.0, 0.3]) / 0.02
    rate_of_load_speed = np.array([3.0, -3.0, 0.0, -0.02, 0.0]) / 0.5
    rate_of_current = np.array([0.0, 0.0, -0.3, 0.0, -2.0]) / 0.01
    system = np.array([*rate_of_angle, rate_of_rotor_speed, rate_of_load_speed, rate_of_current])
    effect_of_voltage = [0.0, 0.0, 0.0, 0.0, 100.0]
    effect_of_torque = [0.0, 0.0, 0.0, -2.0, 0.0]
    effect_of_inputs = np.column_stack((effect_of_voltage, effect_of_torque))
    states = exact(system, effect_of_inputs, time, np.column_stack((voltage, torque)))
    speed_and_current = states[:, 3:]
    np.testing.assert_allclose(response, speed_and_current, atol=1e-8 * np.abs(states).max())


FALL_OF_UNKNOWN_BEGIN = replace(
    trial(uneven(50, 0.01), begins=Start.UNKNOWN),
    channels=("h",),
    values=(3.0 - 2.0 * uneven(50, 0.01))[:, None],
    used=np.ones((50, 1), dtype=bool),
)


@pytest.mark.parametrize(
    ("quantity", "largest_height"),
    [(Quantity.DISPLACEMENT, 3.0), (Quantity.VELOCITY, 3.0 * FALL_OF_UNKNOWN_BEGIN.time[-1])],
)
def test_an_unknown_begin_may_be_as_large_as_the_readings(quantity: Quantity, largest_height: float) -> None:
    duration = FALL_OF_UNKNOWN_BEGIN.time[-1]
    readings = campaign(FALL_OF_UNKNOWN_BEGIN, h=Channel("h", quantity, "height", None))
    largest_speed = max(largest_height / duration, GRAVITY * duration)
    mass_normalised = np.sqrt(2.0) * np.array([largest_height, largest_speed])
    magnitudes = rig("falling_body").initial_state_magnitudes(readings, FALL_OF_UNKNOWN_BEGIN)
    assert magnitudes == pytest.approx(mass_normalised, rel=1e-9)


def test_an_unknown_begin_takes_any_state() -> None:
    time = FALL_OF_UNKNOWN_BEGIN.time
    mass_normalised = np.sqrt(2.0) * np.array([[3.0, -2.0]])
    height = seen(rig("falling_body"), FALL_OF_UNKNOWN_BEGIN, HEIGHT, initial=mass_normalised)[:, 0]
    np.testing.assert_allclose(height, 3.0 - 2.0 * time - 0.5 * GRAVITY * time**2, atol=1e-12)


def test_what_leaves_one_store_enters_the_next_and_flows_over_when_full() -> None:
    time = np.arange(0.0, 160.0, 2.0)
    flow = 0.3 * (1.0 + np.sin(0.05 * time) * np.sign(np.sin(0.02 * time + 1.0)))
    what = trial(time, RecordedInput("pump", Quantity.FLOW, flow, Hold.ZERO_ORDER), begins=Start.UNKNOWN)
    laws = (
        PowerDamping("first", 0.1, 0.5, 0.0, 1.0, 1.0), PowerDamping("second", 0.12, 0.5, 0.0, 1.0, 1.0),
        patch.Overflow("first", 0.3, 1.5, 2.0, 1.0),
    )  # fmt: skip

    def rate(t: float, level: FloatArray, k: int) -> list[float]:
        first = 0.1 * np.sqrt(max(level[0], 0.0)) + 0.3 * max(level[0] - 2.0, 0.0) ** 1.5 + 0.02 * level[0]
        second = 0.12 * np.sqrt(max(level[1], 0.0)) + 0.03 * level[1]
        return [(flow[k] - first) / 2.0, (first - second) / 3.0]

    true = integrated(rate, time, [1.0, 0.5], parts=True, rtol=1e-9, atol=1e-11)
    begin = {"initial": np.array([[np.sqrt(2.0)], [0.5 * np.sqrt(3.0)]])}
    levels = {"upper": Quantity.LEVEL} | LOWER
    found = (seen(rig("stores"), what, levels, *laws, **begin, refinement=n) for n in (2, 4))
    coarse, fine = (np.abs(item - true).max() for item in found)
    assert fine < 2e-3
    assert coarse > 3.0 * fine  # of second order


# ---------------------------------------------------------------- drives


@dataclass(frozen=True)
class DrivenDamper:
    """A damper whose motion is recorded, with the derivatives of the spline through it."""

    trial: Trial
    motion: FloatArray
    speed: FloatArray
    acceleration: FloatArray

    @property
    def linear_force(self) -> FloatArray:
        """Return the force of mass, damper and spring."""
        return 0.4 * self.acceleration + 25.0 * self.speed + 300.0 * self.motion


@pytest.fixture(scope="module")
def driven_damper() -> DrivenDamper:
    time = uneven(400, 0.005)
    motion = 0.02 * np.sin(9.0 * time)
    settled = trial(time, actuator(motion), begins=Start.SETTLED)
    spline = CubicSpline(time, motion)
    return DrivenDamper(settled, motion, speed=spline(time, 1), acceleration=spline(time, 2))


def test_a_driven_damper_shows_its_forces(driven_damper: DrivenDamper) -> None:
    """Those of the spline of its motion, and but at the ends those of the motion itself."""
    time = driven_damper.trial.time
    force = seen(rig("damper"), driven_damper.trial, CELL)[:, 0]
    analytic = 300.0 * driven_damper.motion
    analytic += 25.0 * 0.18 * np.cos(9.0 * time)
    analytic -= 0.4 * 1.62 * np.sin(9.0 * time)
    np.testing.assert_allclose(force, driven_damper.linear_force, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(force[5:-5], analytic[5:-5], atol=2e-3)


def test_a_driven_damper_shows_the_forces_of_laws(driven_damper: DrivenDamper) -> None:
    stiffening = PowerStiffness("piston", 5.0, 3.0, 0, 0.02)
    force = seen(rig("damper"), driven_damper.trial, CELL, FRICTION, stiffening)[:, 0]
    force_of_laws = force - driven_damper.linear_force
    moving = np.abs(driven_damper.speed) > 0.02
    expected = 3.0 * np.sign(driven_damper.speed) + 5.0 * (driven_damper.motion / 0.02) ** 3
    np.testing.assert_allclose(force_of_laws[moving], expected[moving], atol=1e-6)


SLOW_TIME = 0.025 * np.arange(100.0)


@pytest.mark.parametrize(
    ("motion", "first_force"),
    [(-0.02 * np.cos(9.0 * SLOW_TIME), 0.0), (0.02 * np.sin(9.0 * SLOW_TIME), 3.0)],
    ids=["from rest", "moving"],
)
def test_friction_at_the_begin_of_a_drive_is_none_from_rest(motion: FloatArray, first_force: float) -> None:
    """Though the slope of the drive's spline is not quite zero there, and friction has its sign."""
    driven = trial(SLOW_TIME, actuator(motion - motion[0]))
    model = rig("damper")
    force_of_friction = (seen(model, driven, CELL, FRICTION) - seen(model, driven, CELL))[:, 0]
    assert force_of_friction[0] == pytest.approx(first_force, abs=1e-6)


@pytest.fixture
def driven_port() -> Any:
    """The scales of a port whose motion and force are recorded."""
    time, readings = 0.01 * np.arange(300.0), np.linspace(-50.0, 40.0, 300)[:, None]
    drive = trial(time, actuator(0.02 * np.sin(2.0 * time)), channels=("cell",), values=readings)
    driven = campaign(drive, cell=Channel("cell", Quantity.FORCE, "cell", None))
    return rig("damper").scales(driven).ports["piston"]


def test_a_port_that_a_drive_moves_is_measured_by_its_motion_and_the_force(driven_port) -> None:
    assert driven_port.displacement * driven_port.stiffness == pytest.approx(50.0)
    assert driven_port.static_stiffness == pytest.approx(300.0)
    assert (driven_port.driven, driven_port.free) == (True, False)


def test_a_port_that_a_drive_moves_has_the_speed_of_its_motion(driven_port) -> None:
    """It does not have the frequency that it would have if it were let go."""
    speed = driven_port.displacement * driven_port.angular_frequency
    assert speed == pytest.approx(0.04, rel=1e-3)


def test_a_shaken_base_and_a_hand_on_the_mass() -> None:
    time = uneven(300, 0.01)
    shake, hand = 3.0 * np.sin(12.0 * time) + np.cos(5.0 * time), np.random.default_rng(9).normal(size=300)
    spline = CubicSpline(time, shake)
    w1, w0 = spline.antiderivative(1), spline.antiderivative(2)
    base = RecordedInput("base", Quantity.ACCELERATION, shake, Hold.SMOOTH)
    what = trial(time, base, RecordedInput("hand", Quantity.FORCE, hand))

    def slope(t: float, y: FloatArray) -> list[float]:
        x, v = y[0] - w0(t), y[1] - w1(t)
        return [y[1], (np.interp(t, time, hand) - 400.0 * x - 1.5 * v - 4.0 * abs(v) * v) / 2.0]

    solution = integrated(slope, time, [0.0, float(w1(0.0))], max_step=0.004).T
    outputs = {"mass": Quantity.DISPLACEMENT, "drive": Quantity.FORCE}
    law = PowerDamping("guide", 4.0, 2.0, 0.0, 1.0, 1.0)
    found = seen(rig("base"), what, outputs, law, refinement=4)
    np.testing.assert_allclose(found[:, 0], solution[0], atol=2e-5)
    x, v = solution[0] - w0(time), solution[1] - w1(time)
    drive = shake - 400.0 * x - 1.5 * v - 4.0 * np.abs(v) * v - 0.5 * hand
    np.testing.assert_allclose(found[:, 1], drive, atol=5e-3)


@pytest.fixture
def travelling_base() -> Any:
    """A record of a base that is shaken while it travels by ten metres, and its position."""
    time = np.linspace(0.0, 3.0, 601)
    shake = 2.0 + 3.0 * np.sin(12.0 * time)
    base = RecordedInput("base", Quantity.ACCELERATION, shake, Hold.SMOOTH)
    return trial(time, base), CubicSpline(time, shake).antiderivative(2)(time)


def test_a_stiffness_drifts_in_the_stretch_of_a_spring_not_in_the_way_of_its_base(travelling_base) -> None:
    what, way = travelling_base

    def slope(t: float, y: FloatArray) -> list[float]:
        inertia = 2.0 * (2.0 + 3.0 * np.sin(12.0 * t))
        return [y[1], (-400.0 * (1.0 + 0.1 * t) * y[0] - 1.5 * y[1] - inertia) / 2.0]

    stretch = integrated(slope, what.time, [0.0, 0.0], max_step=0.004).T[0]
    outputs = {"mass": Quantity.DISPLACEMENT}
    found = seen(rig("base"), what, outputs, StiffnessDrift(0.1), refinement=4)[:, 0]
    np.testing.assert_allclose(found - way, stretch, atol=2e-5)


def test_friction_at_a_travelling_base_acts_as_on_a_base_at_rest_under_the_force_of_inertia(
    travelling_base,
) -> None:
    what, way = travelling_base
    found = seen(rig("base"), what, {"mass": Quantity.DISPLACEMENT}, GUIDE_FRICTION)[:, 0]
    inertia = RecordedInput("hand", Quantity.FORCE, -2.0 * what.inputs[0].values, Hold.SMOOTH)
    at_rest = RecordedInput("base", Quantity.ACCELERATION, np.zeros(len(way)), Hold.SMOOTH)
    pushed = replace(what, inputs=(at_rest, inertia))
    stretch = seen(rig("base"), pushed, {"mass": Quantity.DISPLACEMENT}, GUIDE_FRICTION)[:, 0]
    np.testing.assert_allclose(found - way, stretch, rtol=0.0, atol=1e-10)


CHAIN = LumpedModel.load("three_mass_chain")
CHAIN_OUTPUTS = {"x1": Quantity.DISPLACEMENT, "x3": Quantity.ACCELERATION}
CHAIN_TIME = 0.01 * np.arange(300)
CHAIN_FORCE = np.cos(7.0 * CHAIN_TIME)


def forced_chain(time: FloatArray, force: FloatArray) -> Trial:
    """Return a trial of the chain under a force at its end, which it has settled under."""
    settled = {"kind": TrialKind.FORCED, "load_place": "end", "begins": Start.SETTLED}
    return trial(time, force=force, **settled)


@pytest.mark.parametrize("hold", [None, *Hold])
@pytest.mark.parametrize("laws", [(), (PowerDamping("joint", 0.3, 0.0, 0.0, 1.0, 1.0),)])
def test_a_driven_trial_of_a_plain_model_is_one_under_a_force(
    hold: Hold | None, laws: tuple[PowerDamping, ...]
) -> None:
    forced = replace(forced_chain(CHAIN_TIME, CHAIN_FORCE), hold=hold)
    recorded = RecordedInput("end", Quantity.FORCE, CHAIN_FORCE, hold)
    driven = trial(CHAIN_TIME, recorded, begins=Start.SETTLED)
    response = seen(CHAIN, forced, CHAIN_OUTPUTS, *laws)
    tolerance = 1e-9 * np.abs(response).max()
    np.testing.assert_allclose(response, seen(CHAIN, driven, CHAIN_OUTPUTS, *laws), atol=tolerance)


def test_a_motion_from_rest_is_one_that_had_settled_without_a_force() -> None:
    forced = forced_chain(CHAIN_TIME, CHAIN_FORCE)
    from_rest = seen(CHAIN, replace(forced, begins=Start.STILL), CHAIN_OUTPUTS)
    unloaded_first = forced_chain(np.r_[0.0, CHAIN_TIME + 1e-9], np.r_[0.0, CHAIN_FORCE])
    settled = seen(CHAIN, unloaded_first, CHAIN_OUTPUTS)[1:]
    assert from_rest[0, 0] == 0.0
    np.testing.assert_allclose(from_rest, settled, atol=1e-6 * np.abs(from_rest).max())


# ---------------------------------------------------------------- controllers and own laws


@pytest.mark.parametrize(("hold", "measured"), [("linear", False), ("zero_order", True)])
def test_a_pendulum_follows_its_target_as_integrated(hold: str, measured: bool) -> None:
    """The controller takes the derivative of the error, or of the measurement alone."""
    text = INPUTS.text("pendulum.toml")
    model = model_of(text + 'derivative_of = "measurement"\n' if measured else text)
    time = np.linspace(0.0, 1.5, 90) ** 1.1  # uneven
    target = 1.5 * np.sin(2.0 * time) + 0.3
    slopes = np.zeros(89) if measured else np.diff(target) / np.diff(time)
    weight, servo, gain = 1.1, 0.9, 1.3  # the factors of the model's parameters

    def target_at(t: float, k: int) -> float:
        return float(target[k] + slopes[k] * (t - time[k]))

    def torque_at(t: float, state: FloatArray, k: int) -> float:
        """Return the torque that the controller gives; states are angle, speed and integral of the error."""
        angle, speed, integral = state
        proportional_and_integral = 40.0 * (target_at(t, k) - angle) + 30.0 * integral
        return float(gain * (servo * proportional_and_integral + 2.0 * (slopes[k] - speed)))

    def rate(t: float, state: FloatArray, k: int) -> list[float]:
        angle, speed, _ = state
        moment = torque_at(t, state, k) - 0.1 * speed - weight * 2.7 * np.sin(angle)
        return [speed, moment / 0.14, target_at(t, k) - angle]

    driven = trial(time, RecordedInput("target", Quantity.ANGLE, target, Hold(hold)))
    outputs = {"angle": Quantity.ANGLE, "torque": Quantity.TORQUE}
    response = seen(model, driven, outputs, parameters=np.array([weight, servo, gain]), refinement=4)

    states = integrated(rate, time, np.zeros(3), parts=True, rtol=1e-9, atol=1e-11)
    torques = [torque_at(time[k + 1], states[k + 1], k) for k in range(len(time) - 1)]
    np.testing.assert_allclose(response[:, 0], states[:, 0], atol=1e-4)
    np.testing.assert_allclose(response[1:, 1], torques, atol=6e-3)


def test_a_speed_is_held_with_a_proportional_and_an_integral_gain() -> None:
    """The target of 2.6 is recorded with an offset of 0.4."""
    loop = 'name = "position", quantity = "angular_velocity", reference = "target", vector = 1.0, acts = 1.0'
    servo = INPUTS.text("servo.toml")
    model = model_of(f"{servo}controller = [{{ {loop}, proportional = 0.5, integral = 2.0 }}]")
    time = np.linspace(0.0, 2.0, 60)
    target = RecordedInput("target", Quantity.ANGULAR_VELOCITY, np.full(60, 2.6), Hold.ZERO_ORDER)
    outputs = {"angle": Quantity.ANGULAR_VELOCITY, "torque": Quantity.TORQUE}

    def torque(speed: Any, integral: Any) -> Any:
        return 0.5 * (3.0 - speed) + 2.0 * integral

    def rate(t: float, state: FloatArray) -> list[float]:
        speed, integral = state
        return [(torque(speed, integral) - 0.1 * speed) / 0.14, 3.0 - speed]

    response = seen(model, trial(time, target), outputs, offset=(0.4,))

    speed, integral = integrated(rate, time, np.zeros(2)).T
    expected = np.column_stack((speed, torque(speed, integral)))
    np.testing.assert_allclose(response, expected, atol=1e-8)


def test_a_rig_at_rest_has_the_temperature_of_each_level_and_what_holds_it() -> None:
    warm = {"force": np.full(3, 3.0), "temperature": np.array([0.0, 40.0, 0.0])}
    what = trial(np.arange(3.0), kind=TrialKind.STATIC, begins=Start.SETTLED, **warm)
    held = INPUTS.text("wheel.toml").removesuffix("]\n") + INPUTS.text("held.toml")
    outputs = {"turn": Quantity.ANGLE, "given": Quantity.TORQUE}
    found = seen(model_of(held), what, outputs, patch.ModulusTemperature(0.01))
    turn = 3.0 / (np.array([100.0, 60.0, 100.0]) + 50.0)
    np.testing.assert_allclose(found, np.stack((turn, -50.0 * turn), axis=1), rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "unit", "rate", "largest"),
    [
        ("capacity = 1.0\nconductance = 3e-4\n", Quantity.TEMPERATURE, 0.0, (75.0 / 3e-4, 75.0)),
        ("mass = 2.0\nstiffness = 8.0\ndamping.ratios = 0.01\n", Quantity.DISPLACEMENT, 2.0, (75.0, 150.0)),
    ],
)
def test_scales_of_what_nothing_drives_come_from_its_readings(text, unit, rate: float, largest) -> None:
    """A mug that cools and a mass that rings down: from rest, neither model would move at all."""
    model = model_of(INPUTS.text("left_alone.toml", ("UNIT", unit.value)) + text)
    time = np.linspace(0.0, 3e4 if rate == 0.0 else 30.0, 400)
    values = 20.0 + 75.0 * np.exp(-time * 3e-4) * np.cos(rate * time)
    read = {"values": values[:, None], "channels": ("shown",)}
    given = campaign(trial(time, begins=Start.UNKNOWN, **read), shown=Channel("shown", unit, "shown", None))
    port = model.scales(given).ports["it"]
    assert (port.displacement, port.angular_frequency * port.displacement) == pytest.approx(largest, rel=0.5)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(("name", "begins", "item", "sentence"), INPUTS.refused("records"))
def test_wrong_records_are_named(name: str, begins: str, item: list[str], sentence: str) -> None:
    time, model = uneven(20, 0.01), rig(name)
    inputs = [RecordedInput(own, Quantity(kind), time, Hold.ZERO_ORDER) for own, kind in item]
    output = model.description.output[0]
    with pytest.raises(ModelError, match=sentence):
        seen(model, trial(time, *inputs, begins=Start(begins)), {output.name: output.quantity})


# ---------------------------------------------------------------- effects in windows of a record


MASS, STIFFNESS = 2.0, 200.0
MODEL = one_mass(stiffness=STIFFNESS, damping={"alpha": 0.0, "beta": 0.0})
TIME = np.linspace(0.0, 6.0, 301)
FORCE = 4.0 * np.sin(3.0 * TIME) + 2.0 * np.sin(7.7 * TIME)
OUTPUTS = (("x", Quantity.DISPLACEMENT), ("x", Quantity.ACCELERATION))


def of_mass(kind: TrialKind, time: FloatArray = TIME) -> Trial:
    said: dict[str, Any] = {"release": Release(0.05, mode_count=1)}
    if kind is not TrialKind.RINGDOWN:
        said = {"force": np.interp(time, TIME, FORCE), "begins": Start.STILL}
    return asked(kind, time, channels=("x",), load_place="push", **said)


def response(given: Trial, *items: Primitive, refinement: int = 8) -> FloatArray:
    return seen(MODEL, given, OUTPUTS, *items, refinement=refinement)


DRAG = PowerDamping("slide", 40.0, 2.0, 0.0, 1.0, 1.0)


def moved(law: Callable[[float, float, float], float], edges: Any, kind: TrialKind) -> FloatArray:
    """Return the motion under the force, or let go, with `law(t, x, v)` between two edges, piece by piece."""
    time = np.union1d(TIME, edges)
    is_forced = kind is TrialKind.FORCED
    begin, end = edges

    def rate(t: float, state: FloatArray, k: int) -> list[float]:
        displacement, speed = state
        force_of_law = law(t, displacement, speed) if begin <= time[k] < end else 0.0
        force = np.interp(t, TIME, FORCE) if is_forced else 0.0
        return [speed, (force - STIFFNESS * displacement - force_of_law) / MASS]

    initial = np.array([0.0 if is_forced else 0.05, 0.0])
    states = integrated(rate, time, initial, parts=True, rtol=1e-9)
    return states[np.isin(time, TIME), 0]


@pytest.mark.parametrize(
    ("kind", "item", "law"),
    [
        (TrialKind.RINGDOWN, DRAG, lambda t, x, v: 40.0 * v * abs(v)),
        (TrialKind.FORCED, DRAG, lambda t, x, v: 40.0 * v * abs(v)),
        (TrialKind.FORCED, patch.PowerStiffness("slide", 30.0, 3.0, 0, 0.05), lambda t, x, v: 2.4e5 * x**3),
        (
            TrialKind.FORCED,
            patch.PortLoad("slide", "3 * max(0, time - 2.5)"),
            lambda t, *_: -3.0 * max(0.0, t - 2.5),
        ),
    ],
)
def test_a_law_between_two_moments_against_a_general_integrator(kind: TrialKind, item: Any, law: Any) -> None:
    """At uneven stamps where it is let go."""
    edges, kept = (1.507, 4.003), (np.arange(len(TIME)) % 9 != 7) | (kind is TrialKind.FORCED)
    windowed = replace(item, windows=(Window("a trial", *edges),))
    found = response(of_mass(kind, TIME[kept]), windowed)[:, 0]
    expected = moved(law, edges, kind)[kept]
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [TrialKind.FORCED, TrialKind.RINGDOWN])
def test_without_edges_within_the_record_nothing_changes(kind: TrialKind) -> None:
    given, law = replace(of_mass(kind), begins=Start.SETTLED), patch.BoucWen("slide", 60.0, 0.01, 1.5)
    own, other, open_ = Window("a trial"), Window("another", 1.0, 2.0), Window("another", 1.0)
    for windows, same in (((own,), (law,)), ((other,), ()), ((open_, own), (law,))):
        np.testing.assert_array_equal(response(given, replace(law, windows=windows)), response(given, *same))


def test_sensors_are_wrong_within_their_windows_only() -> None:
    given = of_mass(TrialKind.FORCED)
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
        (lambda: replace(DRAG, windows=(Window("a trial", 2.0, 1.0),)), "must begin before it ends"),
        (lambda: patch.PortLoad("slide", "3 * tme"), "unknown name 'tme'"),
        (lambda: response(of_mass(TrialKind.FORCED), patch.PortLoad("door", "time")), "port 'door', which"),
        (lambda: response(of_mass(TrialKind.RINGDOWN), patch.PortLoad("slide", "time")),
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


def shown(*changes: Primitive, given: Any = LOGGED, at: Any = (1.0, 1.0), what: Trial = SWEPT) -> FloatArray:
    return observe(SHAKEN, given, what, patch.ModelPatch(changes), Conditions(np.array(at))).values


@pytest.fixture(scope="module")
def alias() -> FloatArray:
    """The response of a stiffer rig under a larger load, which a fast clock of all loggers resembles."""
    square = (1.0 + RATE) ** 2
    return shown(patch.LoadGain(square - 1.0, 0.0), at=(square, 1.0 + RATE))


@pytest.fixture(scope="module")
def one_logger() -> FloatArray:
    """The response where the only logger has a fast clock."""
    return shown(patch.LoggerClock("*", RATE), given=replace(LOGGED, loggers={}))


def test_the_clock_of_one_logger_alone_is_a_stiffer_rig_under_a_larger_load(
    one_logger: FloatArray, alias: FloatArray
) -> None:
    np.testing.assert_allclose(one_logger, alias, atol=1e-9 * np.abs(alias).max())


def test_the_clock_of_a_logger_is_not_that_of_the_motion(one_logger: FloatArray, alias: FloatArray) -> None:
    motion = shown(patch.Clock(RATE, 0.0))
    assert np.abs(one_logger - motion).max() > 0.05 * np.abs(alias).max()


@pytest.mark.parametrize(
    "change",
    [
        patch.LoggerClock("film", RATE),
        patch.LoggerClock("rack", RATE),
        patch.Clock(RATE, 0.0),
        patch.StiffnessDrift(0.05),
    ],
    ids=["film", "rack", "motion", "drift"],
)
def test_a_clock_counts_from_the_begin_of_a_trial(change: Primitive, alias: FloatArray) -> None:
    later = replace(SWEPT, time=1e5 + STAMPS)  # of the day
    np.testing.assert_allclose(shown(change, what=later), shown(change), atol=1e-5 * np.abs(alias).max())


def test_each_logger_has_its_own_clock(one_logger: FloatArray) -> None:
    """The rack logs the first channel and the load, the film the second one."""
    film = shown(patch.LoggerClock("film", RATE))
    rack = shown(patch.LoggerClock("rack", RATE))
    np.testing.assert_array_equal(film[:, 0], shown()[:, 0])
    np.testing.assert_array_equal(film[:, 1], shown(patch.Clock(RATE, 0.0))[:, 1])
    np.testing.assert_allclose(rack[:, 0], one_logger[:, 0], atol=1e-12)


def test_a_camera_sees_a_stretched_motion_at_its_own_right_times() -> None:
    rack = shown(patch.LoggerClock("rack", RATE))
    stretched = replace(SWEPT, time=(1.0 + RATE) * STAMPS)
    true = shown(patch.Clock(1.0 / (1.0 + RATE) - 1.0, 0.0), what=stretched)
    np.testing.assert_allclose(rack[:, 1], true[:, 1], atol=1e-12)


def test_the_clock_of_an_unknown_logger_is_refused() -> None:
    with pytest.raises(CatalogueError, match="no logger 'tape'; it has 'rack', 'film'"):
        shown(patch.LoggerClock("tape", RATE))
