from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.errors import InvalidPatchError
from fe.runtime.expression import Expression

NAMES = frozenset({"a", "b", "c"})
numbers = st.floats(-1e3, 1e3)


def expression(text: str) -> Expression:
    return Expression(text, NAMES, "Here")


@given(numbers, numbers, st.floats(1e-3, 1e3))
def test_arithmetic_is_that_of_python(a: float, b: float, c: float) -> None:
    got = expression("(a + 2*b)/c - -a**2 + sqrt(c)*min(a, b, 0) + abs(b)*exp(-c)").value(
        {"a": a, "b": b, "c": c}
    )
    assert got == (a + 2 * b) / c - -(a**2) + math.sqrt(c) * min(a, b, 0) + abs(b) * math.exp(-c)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "a.real",
        "[a for a in (1,)]",
        "lambda: 1",
        "a if b else c",
        "'x'",
        "True",
        "1j",
        "a // b",
        "a @ b",
        "sqrt(a, b)",
        "min(a, key=b)",
        "print(a)",
        "f(a)",
        "d + 1",
        "a +",
        "",
        "(a := 1)",
        "a" + "+a" * 400,
        "9" * 5000,
        # no finite real number
        *("1/(a - a)", "log(a - a)", "9**9**9**9", "(-a)**0.5", "exp(1e6)", "1e308*10", "sqrt(-a)"),
    ],
)
def test_anything_else_is_refused_with_a_sentence(text: str) -> None:
    with pytest.raises(InvalidPatchError, match=r"^Here\b"):
        expression(text).value({"a": 1.0, "b": 1.0, "c": 1.0})


def test_a_name_without_a_value() -> None:
    with pytest.raises(InvalidPatchError, match="needs 'c', which has no value"):
        expression("a + c").value({"a": 1.0})


@given(numbers, st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=5))
def test_a_course_has_the_values_of_its_times(a: float, times: list[float]) -> None:
    formula = Expression(
        "a*max(0, time - 1, b) + step(time - 2)*sin(time)/(1 + abs(a))", {"a", "b", "time"}, "Here"
    )
    given = {"a": a, "b": -2.0}
    course = formula.course(np.array(times), given)
    single = [formula.value({**given, "time": time}) for time in times]
    np.testing.assert_allclose(course, single, rtol=1e-14, atol=1e-14)


@given(numbers, numbers)
def test_numbers_in_the_place_of_names_change_no_value(a: float, b: float) -> None:
    formula = expression("a**2 - b**3 + c*a - -b")
    filled = Expression(formula.with_numbers({"a": a, "b": b}), {"c"}, "Here")
    assert filled.used() == {"c"}
    assert filled.value({"c": 0.3}) == formula.value({"a": a, "b": b, "c": 0.3})
