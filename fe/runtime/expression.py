"""Formulas that users write, checked to contain only arithmetic, and evaluated.

An expression is evaluated for one value of each name, or at many times at once. NumPy and relative
imports only: this file is copied into the FMU.
"""

import ast
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from math import isfinite
from types import CodeType
from typing import NamedTuple, TypeAlias

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError

LONGEST = 600
"""Longest expression [characters]."""


NumberOrArray: TypeAlias = float | FloatArray
"""The value of an expression at one time, or at each of many times."""


def _smallest(*values: NumberOrArray) -> NumberOrArray:
    """Return the elementwise minimum of numbers or arrays."""
    return reduce(np.minimum, values)


def _largest(*values: NumberOrArray) -> NumberOrArray:
    """Return the elementwise maximum of numbers or arrays."""
    return reduce(np.maximum, values)


def _step(value: NumberOrArray) -> NumberOrArray:
    """Return 0 below zero and 1 from zero on."""
    return np.where(np.asarray(value) >= 0.0, 1.0, 0.0)


_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.UAdd, ast.USub)
_FUNCTIONS: dict[str, Callable[..., NumberOrArray]] = {
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "abs": np.abs,
    "min": _smallest,
    "max": _largest,
    "step": _step,
}
_GLOBALS = {"__builtins__": {}, **_FUNCTIONS}

RESERVED = frozenset({*_FUNCTIONS, "pi", "place", "time"})
"""Names with a meaning of their own in expressions: no event and no parameter may have one."""


def _is_finite_and_real(value: NumberOrArray) -> bool:
    """Return whether a number, or each element of an array, is finite and not complex."""
    if isinstance(
        value, float
    ):  # most values of a fit; the functions of NumPy take ten times as long
        return isfinite(value)
    return not np.iscomplexobj(value) and bool(np.isfinite(value).all())


class _ParsedExpression(NamedTuple):
    """The syntax tree of an expression, and the code that evaluates it."""

    tree: ast.expr
    code: CodeType


@lru_cache(maxsize=1024)  # an expression is evaluated at every step of a fit
def _parse(text: str) -> _ParsedExpression:
    """Parse and compile an expression; raises what `ast.parse` and `compile` raise."""
    tree = ast.parse(text, mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and type(node.value) is int:
            node.value = float(node.value)  # no integer grows beyond a float's range
    return _ParsedExpression(tree.body, compile(tree, "an expression", "eval"))


@dataclass(frozen=True)
class Expression:
    """An arithmetic expression such as "0.1 * mass_ratio * modal_mass".

    It consists of numbers, names, + - * / **, brackets, and the functions sqrt, exp, log, sin, cos,
    tan, abs, min, max and step, which is 0 below zero and 1 from zero on.

    Attributes
    ----------
    names : collection of str
        The names that the expression may use.
    where : str
        The source of the text, as the beginning of error messages.

    Raises
    ------
    InvalidPatchError
        If the text is anything else.
    """

    text: str
    names: Collection[str] = field(repr=False)
    where: str = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.text) > LONGEST:
            raise self._error(f" must have at most {LONGEST} characters, but has {len(self.text)}")
        try:
            parsed = _parse(self.text.strip())
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as cause:
            raise self._error(f" is not an arithmetic expression: {self.text!r}") from cause
        self._check(parsed.tree)

    def _check(self, node: ast.expr) -> None:
        """Raise `InvalidPatchError` if a node of the syntax tree is not plain arithmetic."""
        match node:
            case ast.Constant(value=value) if type(value) in (int, float):
                return
            case ast.Name(id=name):
                self._check_name(name)
            case ast.BinOp(left=left, op=operator, right=right) if isinstance(operator, _OPERATORS):
                self._check(left)
                self._check(right)
            case ast.UnaryOp(op=operator, operand=operand) if isinstance(operator, _OPERATORS):
                self._check(operand)
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if (
                name in _FUNCTIONS and arguments
            ):
                self._check_call(name, arguments)
            case _:
                raise self._error(
                    f" may hold numbers, names, + - * / **, brackets and {', '.join(_FUNCTIONS)}, "
                    f"but holds {ast.get_source_segment(self.text.strip(), node)!r}"
                )

    def _check_name(self, name: str) -> None:
        """Raise `InvalidPatchError` for a name that the expression may not use."""
        if name not in self.names:
            raise self._error(
                f" uses the unknown name {name!r}; the known names are "
                f"{', '.join(sorted(self.names))}"
            )

    def _check_call(self, function: str, arguments: list[ast.expr]) -> None:
        """Raise `InvalidPatchError` if a call has too many arguments, or invalid ones."""
        if function not in ("min", "max") and len(arguments) != 1:
            raise self._error(f": {function} takes one argument, but has {len(arguments)}")
        for argument in arguments:
            self._check(argument)

    def _error(self, fault: str) -> InvalidPatchError:
        """Return the error for an invalid expression; `fault` completes the sentence."""
        return InvalidPatchError(f"{self.where}{fault}.")

    def value(self, values: Mapping[str, float]) -> float:
        """Evaluate the expression for values of its names.

        Raises
        ------
        InvalidPatchError
            If a name has no value, or the result is not a finite real number.
        """
        return float(self._evaluate(values))

    def values_over_time(self, time: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Evaluate the expression at times (N,), which it calls `time`.

        Raises
        ------
        InvalidPatchError
            If another name has no value, or a result is not a finite real number.
        """
        result = self._evaluate({**values, "time": time}, " at every time")
        result_over_time = np.broadcast_to(result, time.shape)
        return np.array(result_over_time, dtype=np.float64)

    def _evaluate(self, values: Mapping[str, NumberOrArray], when: str = "") -> NumberOrArray:
        """Evaluate the expression and check the result; `when` ends the error message."""
        try:
            with np.errstate(all="ignore"):
                # `_check` has found nothing but numbers, known names, functions and operators
                code = _parse(self.text.strip()).code
                result: NumberOrArray = eval(code, _GLOBALS, dict(values))
        except NameError as cause:
            raise self._error(
                f": {self.text!r} needs {cause.name!r}, which has no value at this place"
            ) from cause
        except (ArithmeticError, ValueError, TypeError) as cause:
            raise self._error(f": {self.text!r} cannot be evaluated ({cause})") from cause
        if not _is_finite_and_real(result):
            raise self._error(f": {self.text!r} is not a finite number{when}")
        return result

    def used_names(self) -> frozenset[str]:
        """Return the names in the expression, without its functions."""
        return frozenset(_parse(self.text.strip()).code.co_names) - _FUNCTIONS.keys()

    def with_numbers(self, values: Mapping[str, float]) -> str:
        """Return the text with names replaced by their values.

        A negative number is put in brackets: -2 ** 2 would be -(2 ** 2).
        """

        def number_for(match: re.Match[str]) -> str:
            name = match[0]
            if name not in values:
                return name
            value = float(values[name])
            return f"({value!r})" if value < 0.0 else repr(value)

        return re.sub(r"\b[A-Za-z_]\w*", number_for, self.text)
