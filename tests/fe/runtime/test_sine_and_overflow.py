"""Laws that are a sine of position, and that begin at a level: closed forms and what they must not do."""

import numpy as np
import pytest

from fe.runtime.errors import InvalidPatchError
from fe.runtime.flexible_ports import settle_port
from fe.runtime.laws import overflow, sine_force
from fe.runtime.motion import laws_of, static_solution
from fe.runtime.motion_arrays import State
from fe.runtime.patch import ModelPatch, Overflow, SineForce


@pytest.mark.parametrize("y", [-2.0, 0.3, 5.0])
def test_a_sine_rests_where_flexibility_and_force_meet(y: float) -> None:
    laws = laws_of(ModelPatch((SineForce("p", 2.0, 3.0, 0.4),)), ("p",))
    found = static_solution(laws, np.array([[y]]), np.array([[0.1]]))
    x, own = found.positions[0, 0], found.forces[0, 0]
    assert x + 0.1 * own == pytest.approx(y, abs=1e-12)
    assert own == pytest.approx(2.0 * np.sin(3.0 * x + 0.4), abs=1e-12)
    step, memory = 1e-6, np.zeros(5)
    less, more = (
        sine_force.pull(laws.values[0], np.zeros(1), memory, x + way, 1.0, 1)[0] for way in (-step, step)
    )
    slope = sine_force.pull(laws.values[0], np.zeros(1), memory, x, 1.0, 1)[1]
    assert slope == pytest.approx((more - less) / (2.0 * step), rel=1e-6)


@pytest.mark.parametrize("flexibility", [0.1, 0.16])  # from 1/6 m/N on there is more than one root
def test_a_sine_on_flexibility_is_settled(flexibility: float) -> None:
    laws = laws_of(ModelPatch((SineForce("p", 2.0, 3.0, 0.4),)), ("p",))
    ports = laws.at(np.zeros((1, 0)), np.array([flexibility]), 0.0, np.zeros((2, 1)))
    for y in np.linspace(-9.0, 9.0, 91):
        state = State(np.zeros(0), np.zeros(0), laws.memory(), np.zeros(1))
        x = settle_port(0, np.zeros(1, dtype=np.int64), ports, state, y, flexibility, 1.0, 1)
        near = 1e-11 * (abs(x) + abs(y))
        assert abs(x + flexibility * state.current[0] - y) <= near
        assert flexibility * abs(state.current[0] - 2.0 * np.sin(3.0 * x + 0.4)) <= near


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_an_overflow_empties_to_its_level_as_its_equation_says(exponent: float) -> None:
    law = np.array([*Overflow("p", 0.7, exponent, 2.0, 1.3).row, 0.0])
    strength = overflow.strength(law, 0.4)
    level, count = 3.5, 20000
    whole = overflow.kick(law, level, strength, 2.0, False)
    for _ in range(count):
        half = level - 0.5 * (2.0 / count) * 0.4 * overflow.steady(law, 0.0, level)
        level -= (2.0 / count) * 0.4 * overflow.steady(law, 0.0, half)
    assert whole == pytest.approx(level, abs=1e-6)
    assert overflow.kick(law, 1.9, strength, 2.0, False) == 1.9
    assert overflow.steady(law, 0.0, 1.9) == 0.0
    assert overflow.kick(law, 3.5, strength, 1e3, False) == pytest.approx(2.0, abs=1e-2)


def test_numbers_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidPatchError, match="level of 'overflow' must not be negative"):
        laws_of(ModelPatch((Overflow("p", 1.0, 1.0, -1.0, 1.0),)), ("p",))
