"""The shipped gear pump: its efficiencies and its temperature; its equations: `test_library_source.py`."""

import math

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


def test_a_new_pump_has_the_efficiencies_of_gear_pumps() -> None:
    speed, pressure = 1500.0 * math.pi / 30.0, 150e5
    flow, torque, drop, _ = pump.operation(50.0, speed, pressure, 0.0, 0.0, 1.0)
    assert flow / (16e-6 * 25.0) == pytest.approx(0.95, abs=0.005)
    assert 16e-6 * (pressure + drop) / (2.0 * math.pi) / torque == pytest.approx(0.93, abs=0.01)
    assert drop == pytest.approx(1e5, rel=0.05)
    assert pump.viscosity(40.0, 1.0) == pytest.approx(870.0 * 46e-6)
    assert pump.viscosity(100.0, 1.0) / 870.0 == pytest.approx(6.8e-6)


@given(SPEED, PRESSURE, WEAR, CLOGGING, FACTOR)
def test_the_temperature_is_the_root_that_another_solver_finds(
    speed: float, pressure: float, wear: float, clogging: float, factor: float
) -> None:
    given = (speed * math.pi / 30.0, pressure * 1e5, wear, clogging, factor)

    def surplus(temperature: float) -> float:
        loss = pump.operation(temperature, *given)[3]  # type: ignore[arg-type]
        return loss - pump.COOLING * (temperature - pump.AMBIENT)

    assert pump.steady_temperature(*given) == pytest.approx(
        brentq(surplus, 40.0, 120.0, xtol=1e-12), abs=1e-9
    )  # type: ignore[arg-type]
    assert math.isnan(pump.steady_temperature(2500.0 * math.pi / 30.0, 210e5, 1.0, 0.0, 1.0))  # none is found
