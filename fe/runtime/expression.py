"""Arithmetic in a text, for one value of each name or for many times; it is checked to be nothing else.

NumPy and relative imports only: this file is copied into the FMU.
"""

import ast
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from types import CodeType
from typing import Any, NoReturn

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError

LONGEST = 600
"""Longest expression [characters]."""

_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.UAdd, ast.USub)
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "abs")},
    "min": lambda *given: reduce(np.minimum, given),
    "max": lambda *given: reduce(np.maximum, given),
    "step": lambda value: np.where(np.asarray(value) >= 0.0, 1.0, 0.0),
}
_KNOWN = {"__builtins__": {}, **_FUNCTIONS}
RESERVED = frozenset({*_FUNCTIONS, "pi", "place", "time"})
"""What names in an expression mean already: no event and no parameter can have one of them."""


@lru_cache(maxsize=1024)  # an expression is evaluated at every step of a fit
def _read(text: str) -> tuple[ast.expr, CodeType]:
    tree = ast.parse(text, mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and type(node.value) is int:
            node.value = float(node.value)  # no integer grows beyond a float's range
    return tree.body, compile(tree, "an expression", "eval")


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
        if len(self.text) > LONGEST:
            self._refuse(f" must have at most {LONGEST} characters, but has {len(self.text)}")
        try:
            tree, _ = _read(self.text.strip())
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError):
            self._refuse(f" is not an arithmetic expression: {self.text!r}")
        self._check(tree)

    def _check(self, node: ast.expr) -> None:
        match node:
            case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
                return
            case ast.Name(id=name):
                if name not in self.names:
                    self._refuse(
                        f" uses the unknown name {name!r}; known are {', '.join(sorted(self.names))}"
                    )
            case ast.BinOp(left=left, op=op, right=right) if isinstance(op, _OPERATORS):
                self._check(left)
                self._check(right)
            case ast.UnaryOp(op=op, operand=operand) if isinstance(op, _OPERATORS):
                self._check(operand)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS and args:
                if name not in ("min", "max") and len(args) != 1:
                    self._refuse(f": {name} takes one argument, but has {len(args)}")
                for argument in args:
                    self._check(argument)
            case _:
                self._refuse(
                    f" may hold numbers, names, + - * / **, brackets and {', '.join(_FUNCTIONS)}, but holds "
                    f"{ast.get_source_segment(self.text.strip(), node)!r}"
                )

    def _refuse(self, fault: str) -> NoReturn:
        raise InvalidPatchError(f"{self.where}{fault}.")

    def value(self, values: Mapping[str, float]) -> float:
        """Return the value for values of the names.

        Raises
        ------
        InvalidPatchError
            If a name has no value, or the result is not a finite real number.
        """
        return float(self._result(values))

    def course(self, time: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the values (N,) at times (N,), which are the name `time`; raises as `value`."""
        result = self._result({**values, "time": time}, " at every time")
        return np.array(np.broadcast_to(result, time.shape), dtype=np.float64)

    def _result(self, values: Mapping[str, Any], when: str = "") -> Any:
        try:
            with np.errstate(all="ignore"):
                # `_check` lets pass nothing but numbers, the known names and functions, and operators
                result = eval(_read(self.text.strip())[1], _KNOWN, dict(values))
        except NameError as cause:
            self._refuse(f": {self.text!r} needs {cause.name!r}, which has no value at this place")
        except (ArithmeticError, ValueError, TypeError) as cause:
            self._refuse(f": {self.text!r} cannot be evaluated ({cause})")
        if np.iscomplexobj(result) or not np.isfinite(result).all():
            self._refuse(f": {self.text!r} is not a finite number{when}")
        return result

    def used(self) -> frozenset[str]:
        """Return the names that it uses."""
        return frozenset(_read(self.text.strip())[1].co_names) - _FUNCTIONS.keys()

    def with_numbers(self, values: Mapping[str, float]) -> str:
        """Return the text with numbers in the place of names; powers of negative ones stay what they are."""

        def number(name: re.Match[str]) -> str:
            if name[0] not in values:
                return name[0]
            value = float(values[name[0]])
            return f"({value!r})" if value < 0.0 else repr(value)

        return re.sub(r"\b[A-Za-z_]\w*", number, self.text)
