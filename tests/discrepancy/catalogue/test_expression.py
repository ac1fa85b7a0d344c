from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from discrepancy.catalogue.expression import Expression
from discrepancy.errors import CatalogueError

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
    ],
)
def test_anything_else_is_refused_with_a_sentence(text: str) -> None:
    with pytest.raises(CatalogueError, match=r"^Here\b"):
        expression(text).value({"a": 1.0, "b": 1.0, "c": 1.0})


@pytest.mark.parametrize(
    "text", ["1/(a - a)", "log(a - a)", "9**9**9**9", "(-a)**0.5", "exp(1e6)", "1e308*10", "sqrt(-a)"]
)
def test_no_value_but_a_finite_real_number(text: str) -> None:
    with pytest.raises(CatalogueError, match="Here"):
        expression(text).value({"a": 1.0})


def test_a_name_without_a_value() -> None:
    with pytest.raises(CatalogueError, match="needs 'c', which has no value"):
        expression("a + c").value({"a": 1.0})
