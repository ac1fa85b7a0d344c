"""Arithmetic in a text, evaluated without executing code."""

import ast
import operator
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from math import cos, exp, isfinite, log, sin, sqrt, tan

from discrepancy.errors import CatalogueError

LONGEST = 300
"""Longest expression [characters]."""

_BINARY: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type[ast.unaryop], Callable[[float], float]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
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
}


@dataclass(frozen=True)
class Expression:
    """An arithmetic expression such as "0.1 * mass_ratio * modal_mass".

    Numbers, names, + - * / **, brackets, and the functions sqrt, exp, log, sin, cos, tan, abs, min, max.

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
    CatalogueError
        If it holds anything else.
    """

    text: str
    names: Collection[str] = field(repr=False)
    where: str = field(repr=False)

    def __post_init__(self) -> None:
        self._check(self._tree())

    def _tree(self) -> ast.expr:
        if len(self.text) > LONGEST:
            raise CatalogueError(
                f"{self.where} must have at most {LONGEST} characters, but has {len(self.text)}."
            )
        try:
            return ast.parse(self.text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as cause:
            raise CatalogueError(f"{self.where} is not an arithmetic expression: {self.text!r}.") from cause

    def _check(self, node: ast.expr) -> None:
        match node:
            case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
                return
            case ast.Name(id=name):
                if name not in self.names:
                    known = ", ".join(sorted(self.names))
                    raise CatalogueError(f"{self.where} uses the unknown name {name!r}; known are {known}.")
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
                self._check(left)
                self._check(right)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
                self._check(operand)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS and args:
                if name not in ("min", "max") and len(args) != 1:
                    raise CatalogueError(f"{self.where}: {name} takes one argument, but has {len(args)}.")
                for argument in args:
                    self._check(argument)
            case _:
                raise CatalogueError(
                    f"{self.where} may hold numbers, names, + - * / **, brackets and "
                    f"{', '.join(_FUNCTIONS)}, but holds {ast.unparse(node)!r}."
                )

    def value(self, values: Mapping[str, float]) -> float:
        """Return the value for values of the names.

        Raises
        ------
        CatalogueError
            If a name has no value, or the result is not a finite real number.
        """
        try:
            result = _evaluate(self._tree(), values)
        except KeyError as cause:
            raise CatalogueError(
                f"{self.where}: {self.text!r} needs {cause.args[0]!r}, which has no value at this place."
            ) from cause
        except (ArithmeticError, ValueError, TypeError) as cause:
            raise CatalogueError(f"{self.where}: {self.text!r} cannot be evaluated ({cause}).") from cause
        if isinstance(result, complex) or not isfinite(result):
            raise CatalogueError(f"{self.where}: {self.text!r} is not a finite number.")
        return result


def _evaluate(node: ast.expr, values: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)  # so that no integer grows beyond the range of a float
        case ast.Name(id=name):
            return float(values[name])
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_evaluate(left, values), _evaluate(right, values))
        case ast.UnaryOp(op=unary, operand=operand):
            return _UNARY[type(unary)](_evaluate(operand, values))
        case ast.Call(func=ast.Name(id=name), args=args):
            return _FUNCTIONS[name](*(_evaluate(argument, values) for argument in args))
    raise TypeError(f"{ast.unparse(node)} is no arithmetic")
