"""The base class of all primitive changes of a model, and the time windows in which they act.

NumPy and relative imports only: this file is copied into the FMU.
"""

import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from inspect import get_annotations
from math import inf, isfinite
from typing import Any, ClassVar, NamedTuple, dataclass_transform, get_origin

import numpy as np

from .arrays import BoolArray, FloatArray
from .errors import InvalidPatchError
from .expression import Expression


class Window(NamedTuple):
    """A time interval in one trial, from `begin` to `end` in the trial's time [s].

    Without a beginning it starts at the first sample; without an end it lasts to the last sample.
    """

    trial: str
    begin: float | None = None
    end: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """Beginning and end [s]; infinite if the window has none."""
        begin = -inf if self.begin is None else self.begin
        end = inf if self.end is None else self.end
        return begin, end


def time_formula(text: str, kind: str) -> Expression:
    """Parse a primitive's formula in `time` and `pi`; `kind` is for the error message.

    Raises
    ------
    InvalidPatchError
        If the text is not such a formula.
    """
    return Expression(text, ("time", "pi"), f"The formula of the primitive {kind!r}")


def _type_of_value(declared_type: Any) -> type:
    """Return the plain type of a value, without its unit and the types of elements."""
    plain_type = getattr(declared_type, "__origin__", declared_type)
    value_type: type = get_origin(plain_type) or plain_type
    return value_type


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
@dataclass(frozen=True)
class Primitive:
    """One primitive change of a model, such as a point mass, a law at a port or a sensor's gain.

    A subclass is a frozen record of its annotated values, without a decorator of its own. All
    values are in SI units; a primitive whose magnitude is zero changes nothing.

    Attributes
    ----------
    windows : tuple of Window
        Time intervals in which the primitive acts. It does not act in trials without a window.
        If the tuple is empty, it acts always, in all trials.

    Raises
    ------
    InvalidPatchError
        If a number is not finite, a formula is invalid, or a window is empty or not possible.
    """

    kind: ClassVar[str]
    """Name of the class in a file: the class name in lower case with underscores (`point_mass`)."""
    units: ClassVar[dict[str, str]] = {}
    """Unit of each real number, from the annotation of its type. At a port "N or N m" and the like:
    the unit for a port that is displaced, then the unit for one that turns."""
    can_act_in_windows: ClassVar[bool] = False
    """Whether the primitive may be restricted to windows."""
    formula_fields: ClassVar[tuple[str, ...]] = ()
    """Names of the texts that are formulas in `time`."""
    _types_of_values: ClassVar[Mapping[str, type]] = {}
    _names_of_required: ClassVar[tuple[str, ...]] = ()

    windows: tuple[Window, ...] = field(default=(), kw_only=True)

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)
        if "kind" not in cls.__dict__:
            cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        cls.units = {
            name: hint.__metadata__[0]
            for name, hint in get_annotations(cls).items()
            if hasattr(hint, "__metadata__")
        }
        # found once for each class, because primitives are built at every step of a fit
        values = [item for item in fields(cls) if item.name != "windows"]
        cls._types_of_values = {item.name: _type_of_value(item.type) for item in values}
        cls._names_of_required = tuple(item.name for item in values if item.default is MISSING)

    def __post_init__(self) -> None:
        self._check_windows()
        for name in self._types_of_values:
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float | int) and not isfinite(number) for number in numbers):
                raise InvalidPatchError(
                    f"{name} of the primitive {self.kind!r} must be finite, but is {value!r}."
                )
        for name in self.formula_fields:
            time_formula(getattr(self, name), self.kind)

    def _check_windows(self) -> None:
        """Raise `InvalidPatchError` if windows are not allowed, or one is empty."""
        if self.windows and not self.can_act_in_windows:
            raise InvalidPatchError(f"The primitive {self.kind!r} cannot act in a window only.")
        for window in self.windows:
            begin, end = window.span
            limits = [limit for limit in (window.begin, window.end) if limit is not None]
            if not begin < end or not all(map(isfinite, limits)):
                raise InvalidPatchError(
                    f"A window of the primitive {self.kind!r} must begin before it ends, but that "
                    f"in {window.trial!r} goes from {window.begin} s to {window.end} s."
                )

    def acts_at(self, time: FloatArray) -> BoolArray:
        """Return whether the primitive acts at each time (N,) [s] of its windows' trial."""
        acts = np.full(len(time), not self.windows)
        for window in self.windows:
            begin, end = window.span
            acts |= (begin <= time) & (time < end)
        return acts

    def to_mapping(self) -> dict[str, object]:
        """Return the kind and the values as plain data, for a file."""
        values = asdict(self)
        windows = [window._asdict() for window in values.pop("windows")]
        mapping = {"kind": self.kind, **values}
        if windows:
            mapping["windows"] = windows
        return mapping

    @classmethod
    def value_types(cls) -> dict[str, type]:
        """Return the type of each value by its name, without the windows."""
        return dict(cls._types_of_values)

    @classmethod
    def required_values(cls) -> tuple[str, ...]:
        """Return the names of the values without a default."""
        return cls._names_of_required
