"""What patches and states are made of: expressions, kinds of primitives, the digital state."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.errors import InvalidPatchError, InvalidStateError
from fe.runtime.expression import Expression
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.patch import PRIMITIVES
from fe.runtime.state import DigitalState, Geometry, losses_of, region_names
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
numbers = st.floats(-1e3, 1e3)


def expression(text: str) -> Expression:
    return Expression(text, frozenset({"a", "b", "c"}), "Here")


@given(numbers, numbers, st.floats(1e-3, 1e3))
def test_arithmetic_is_that_of_python(a, b, c):
    formula = expression("(a + 2*b)/c - -a**2 + sqrt(c)*min(a, b, 0) + abs(b)*exp(-c)")
    wanted = (a + 2 * b) / c - -(a**2) + math.sqrt(c) * min(a, b, 0) + abs(b) * float(np.exp(-c))
    assert formula.value({"a": a, "b": b, "c": c}) == wanted


NO_EXPRESSIONS = [text for (text,) in INPUTS.refused("expressions")]


@pytest.mark.parametrize("text", [*NO_EXPRESSIONS, "a" + "+a" * 400, "9" * 5000])
def test_anything_else_is_refused_with_a_sentence(text):
    with refused(InvalidPatchError, r"^Here\b"):
        expression(text).value({"a": 1.0, "b": 1.0, "c": 1.0})


@given(numbers, st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=5))
def test_a_course_has_the_values_of_its_times(a, times):
    text = "a*max(0, time - 1, b) + step(time - 2)*sin(time)/(1 + abs(a))"
    formula, given = Expression(text, {"a", "b", "time"}, "Here"), {"a": a, "b": -2.0}
    single = [formula.value({**given, "time": time}) for time in times]
    np.testing.assert_allclose(formula.course(np.array(times), given), single, rtol=1e-14, atol=1e-14)


@given(numbers, numbers)
def test_numbers_in_the_place_of_names_change_no_value(a, b):
    formula = expression("a**2 - b**3 + c*a - -b")
    filled = Expression(formula.with_numbers({"a": a, "b": b}), {"c"}, "Here")
    assert filled.used() == {"c"}
    with refused(InvalidPatchError, "needs 'c', which has no value"):
        filled.value({})
    assert filled.value({"c": 0.3}) == formula.value({"a": a, "b": b, "c": 0.3})


def test_kinds_are_the_keys_of_patches_that_were_kept():
    assert list(PRIMITIVES) == INPUTS.text("kinds.txt").split()


# ---------------------------------------------------------------- the digital state


def test_the_default_state_is_the_healthy_wing_as_built():
    state = DigitalState()
    assert (state.geometry, state.young_modulus_factor) == (Geometry(1.828, 0.433, 0.260), 1.0)
    assert losses_of(state.stiffness_loss, region_names(2)) == (0.0, 0.0)
    # Kapteyn et al. 2021, step 3
    ratio = rayleigh_damping_ratio(state.damping_alpha, state.damping_beta, (5.6492, 29.9699))
    assert ratio == pytest.approx((0.0281, 0.0717), rel=1e-3)


@pytest.mark.parametrize(("changes", "place"), INPUTS.refused("states"))
def test_impossible_states_are_refused_with_the_place(changes, place):
    with refused(InvalidStateError, place):
        (Geometry if place.startswith("geometry") else DigitalState)(**changes)


def test_losses_stand_in_the_order_of_the_regions():
    regions = ("root", "z2", "tip")
    assert region_names(3) == ("z1", "z2", "z3")
    for losses, wanted in (
        ({"tip": 0.4, "root": 0.1}, (0.1, 0.0, 0.4)),
        ([0.1, 0.2, 0.3],) * 2,
        ((), (0.0,) * 3),
    ):
        assert losses_of(losses, regions) == tuple(wanted)
    for losses, sentence in (
        ({"z1": 0.1}, "no damage region 'z1'; the regions are root, z2, tip"),
        ((0.1, 0.2), "3 fractions, one for each of root, z2, tip, but 2"),
    ):
        with pytest.raises(InvalidStateError, match=sentence):
            losses_of(losses, regions)
