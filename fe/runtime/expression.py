"""Arithmetic in a text, evaluated without executing code: for one value of each name, or for many times.

NumPy and relative imports only: this file is copied into the FMU.
"""

import ast
import operator
from collections.abc import Callable, Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from math import cos, exp, isfinite, log, sin, sqrt, tan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidPatchError

LONGEST = 600
"""Longest expression [characters]."""


def step(value: float) -> float:
    """Return 1 from zero on, 0 before."""
    return 1.0 if value >= 0.0 else 0.0


_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
_FUNCTIONS: dict[str, Callable[..., float]] = {
    "sqrt": sqrt,
    "exp": exp,
    "log": log,
    "sin": sin,
    "cos": cos,
    "tan": tan,
    "abs": abs,
    "min": min,
    "max": max,
    "step": step,
}
RESERVED = frozenset({*_FUNCTIONS, "pi", "place", "time"})
"""What names in an expression mean already: no event and no parameter can have one of them."""
_OF_ARRAYS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "abs")},
    "min": lambda *given: reduce(np.minimum, given),
    "max": lambda *given: reduce(np.maximum, given),
    "step": lambda value: np.where(np.asarray(value) >= 0.0, 1.0, 0.0),
}


@lru_cache(maxsize=1024)  # an expression is evaluated at every step of a fit
def _parsed(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


@dataclass(frozen=True)
class Expression:
    """An arithmetic expression such as "0.1 * mass_ratio * modal_mass".

    Numbers, names, + - * / **, brackets, and the functions sqrt, exp, log, sin, cos, tan, abs, min, max,
    step (0 below zero, 1 from zero on).

    Attributes
    ----------
    text : str
        As written.
    names : collection of str
        Names that it may use.
    where : str
        Where it stands, for error messages.

    Raises
    ------
    InvalidPatchError
        If it holds anything else.
    """

    text: str
    names: Collection[str] = field(repr=False)
    where: str = field(repr=False)

    def __post_init__(self) -> None:
        self._check(self._tree())

    def _tree(self) -> ast.expr:
        if len(self.text) > LONGEST:
            raise InvalidPatchError(
                f"{self.where} must have at most {LONGEST} characters, but has {len(self.text)}."
            )
        try:
            return _parsed(self.text.strip())
        except (SyntaxError, ValueError, RecursionError, MemoryError) as cause:
            raise InvalidPatchError(
                f"{self.where} is not an arithmetic expression: {self.text!r}."
            ) from cause

    def _check(self, node: ast.expr) -> None:
        match node:
            case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
                return
            case ast.Name(id=name):
                if name not in self.names:
                    known = ", ".join(sorted(self.names))
                    raise InvalidPatchError(
                        f"{self.where} uses the unknown name {name!r}; known are {known}."
                    )
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
                self._check(left)
                self._check(right)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
                self._check(operand)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS and args:
                if name not in ("min", "max") and len(args) != 1:
                    raise InvalidPatchError(f"{self.where}: {name} takes one argument, but has {len(args)}.")
                for argument in args:
                    self._check(argument)
            case _:
                raise InvalidPatchError(
                    f"{self.where} may hold numbers, names, + - * / **, brackets and "
                    f"{', '.join(_FUNCTIONS)}, but holds {ast.unparse(node)!r}."
                )

    def value(self, values: Mapping[str, float]) -> float:
        """Return the value for values of the names.

        Raises
        ------
        InvalidPatchError
            If a name has no value, or the result is not a finite real number.
        """
        result = self._result(values, _FUNCTIONS)
        if isinstance(result, complex) or not isfinite(result):
            raise InvalidPatchError(f"{self.where}: {self.text!r} is not a finite number.")
        return float(result)

    def course(self, time: NDArray[np.float64], values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the values (N,) at times (N,), which are the name `time`; raises as `value`."""
        with np.errstate(all="ignore"):
            result = np.asarray(self._result({**values, "time": time}, _OF_ARRAYS))
        if np.iscomplexobj(result) or not np.all(np.isfinite(result)):
            raise InvalidPatchError(f"{self.where}: {self.text!r} is not a finite number at every time.")
        return np.array(np.broadcast_to(result, time.shape), dtype=np.float64)

    def _result(self, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> Any:
        try:
            return _evaluate(self._tree(), values, functions)
        except KeyError as cause:
            raise InvalidPatchError(
                f"{self.where}: {self.text!r} needs {cause.args[0]!r}, which has no value at this place."
            ) from cause
        except (ArithmeticError, ValueError, TypeError) as cause:
            raise InvalidPatchError(f"{self.where}: {self.text!r} cannot be evaluated ({cause}).") from cause

    def used(self) -> frozenset[str]:
        """Return the names that it uses."""
        return frozenset(
            node.id
            for node in ast.walk(self._tree())
            if isinstance(node, ast.Name) and node.id not in _FUNCTIONS
        )

    def with_numbers(self, values: Mapping[str, float]) -> str:
        """Return the text with numbers in the place of names."""
        return ast.unparse(_Numbers(values).visit(deepcopy(self._tree())))


class _Numbers(ast.NodeTransformer):
    """Puts numbers in the place of names."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self.values = values

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the number of a name, with a sign of its own, so that powers of it stay what they are."""
        if node.id not in self.values:
            return node
        value = float(self.values[node.id])
        number = ast.Constant(abs(value))
        return ast.UnaryOp(ast.USub(), number) if value < 0.0 else number


def _evaluate(node: ast.expr, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> Any:
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)  # so that no integer grows beyond the range of a float
        case ast.Name(id=name):
            return values[name]
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_evaluate(left, values, functions), _evaluate(right, values, functions))
        case ast.UnaryOp(op=unary, operand=operand):
            return _UNARY[type(unary)](_evaluate(operand, values, functions))
        case ast.Call(func=ast.Name(id=name), args=args):
            return functions[name](*(_evaluate(argument, values, functions) for argument in args))
    raise TypeError(f"{ast.unparse(node)} is no arithmetic")
