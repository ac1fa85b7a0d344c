"""The physics of the shipped gear pump against balances and limits that it does not compute with."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from scenarios.assets import gear_pump as pump

SPEED = st.floats(600.0, 1800.0)
PRESSURE = st.floats(20.0, 160.0)
WEAR = st.floats(0.0, 0.5)
CLOGGING = st.floats(0.0, 0.8)
FACTOR = st.floats(0.9, 1.1)


def inputs(speed: float, pressure: float, *rest: float) -> tuple[float, ...]:
    return (speed * math.pi / 30.0, pressure * 1e5, *rest)


def test_a_new_pump_has_the_efficiencies_of_gear_pumps() -> None:
    speed, pressure = 1500.0 * math.pi / 30.0, 150e5
    flow, torque, drop, _ = pump.operation(50.0, speed, pressure, 0.0, 0.0, 1.0)
    assert flow / (16e-6 * 25.0) == pytest.approx(0.95, abs=0.005)
    assert 16e-6 * (pressure + drop) / (2.0 * math.pi) / torque == pytest.approx(0.93, abs=0.01)
    assert drop == pytest.approx(1e5, rel=0.05)
    assert pump.viscosity(40.0, 1.0) == pytest.approx(870.0 * 46e-6)
    assert pump.viscosity(100.0, 1.0) / 870.0 == pytest.approx(6.8e-6)


@given(SPEED, PRESSURE, WEAR, CLOGGING, FACTOR)
def test_what_the_shaft_gives_goes_into_load_and_heat(
    speed: float, pressure: float, wear: float, clogging: float, factor: float
) -> None:
    given = inputs(speed, pressure, wear, clogging, factor)
    temperature = pump.steady_temperature(*given)  # type: ignore[arg-type]
    flow, torque, drop, loss = pump.operation(temperature, *given)  # type: ignore[arg-type]
    # Heat piece by piece: slip and filter throttle oil, and friction of both kinds brakes the shaft.
    displacement, mu = 16e-6 / (2.0 * math.pi), pump.viscosity(temperature, factor)
    slip = displacement * given[0] - flow
    total = given[1] + drop
    friction = displacement * (pump.FRICTION * total + pump.VISCOUS_DRAG * mu * given[0]) * given[0]
    assert slip * total + drop * flow + friction == pytest.approx(loss, rel=1e-9)
    assert pump.COOLING * (temperature - pump.AMBIENT) == pytest.approx(loss, rel=1e-9)
    assert torque * given[0] == pytest.approx(given[1] * flow + loss, rel=1e-12)


@given(SPEED, PRESSURE, FACTOR)
def test_slip_grows_with_the_cube_of_the_clearance(speed: float, pressure: float, factor: float) -> None:
    def slip(wear: float) -> float:
        flow, _, drop, _ = pump.operation(50.0, *inputs(speed, pressure, wear, 0.2, factor))  # type: ignore[arg-type]
        return (16e-6 * speed / 60.0 - flow) / (pressure * 1e5 + drop)

    assert slip(0.4) / slip(0.0) == pytest.approx(1.4**3, rel=1e-6)


@given(SPEED, PRESSURE, WEAR, CLOGGING, FACTOR)
def test_the_temperature_is_the_root_that_another_solver_finds(
    speed: float, pressure: float, wear: float, clogging: float, factor: float
) -> None:
    given = inputs(speed, pressure, wear, clogging, factor)

    def surplus(temperature: float) -> float:
        loss = pump.operation(temperature, *given)[3]  # type: ignore[arg-type]
        return loss - pump.COOLING * (temperature - pump.AMBIENT)

    assert pump.steady_temperature(*given) == pytest.approx(
        brentq(surplus, 40.0, 120.0, xtol=1e-12), abs=1e-9
    )  # type: ignore[arg-type]


def test_each_sensor_answers_to_its_state() -> None:
    def shown(wear: float, clogging: float) -> np.ndarray:
        given = inputs(1500.0, 140.0, wear, clogging, 1.0)
        temperature = pump.steady_temperature(*given)  # type: ignore[arg-type]
        flow, _, drop, _ = pump.operation(temperature, *given)  # type: ignore[arg-type]
        return np.array([6e4 * flow, temperature, 1e-5 * drop])

    new, worn, clogged = shown(0.0, 0.0), shown(0.45, 0.0), shown(0.0, 0.6)
    assert worn[0] < new[0] - 1.5
    assert worn[1] > new[1] + 1.5
    assert clogged[2] == pytest.approx(2.5 * new[2], rel=0.02)
    assert math.isnan(pump.steady_temperature(*inputs(2500.0, 210.0, 1.0, 0.0, 1.0)))  # type: ignore[arg-type]
