"""What every primitive change of a model has in common.

NumPy and relative imports only: this file is copied into the FMU.
"""

import re
from dataclasses import asdict, dataclass, field, fields
from inspect import get_annotations
from math import inf, isfinite
from typing import Any, ClassVar, NamedTuple, dataclass_transform

import numpy as np

from .arrays import BoolArray, FloatArray
from .errors import InvalidPatchError
from .expression import Expression


class Window(NamedTuple):
    """A stretch of one trial, in its time [s]: from `begin` (None: from the first sample on) to `end`."""

    trial: str
    begin: float | None = None
    end: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """Begin and end, infinite where it is open."""
        return -inf if self.begin is None else self.begin, inf if self.end is None else self.end


def course_of(text: str, kind: str) -> Expression:
    """Return a formula in `time`; raises `InvalidPatchError`."""
    return Expression(text, ("time", "pi"), f"The formula of the primitive {kind!r}")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
@dataclass(frozen=True)
class Primitive:
    """One primitive change; `kind` names its class in a file. All values SI; zero magnitude is no change.

    A class of primitives is a frozen record of its annotated values, without a decorator of its own.

    With `windows` it acts within these only, and in no trial that they do not name; without, always.
    """

    kind: ClassVar[str]
    """Name of the class in a file: its own name in lower case, words apart by underscores."""
    units: ClassVar[dict[str, str]] = {}
    """Unit of each real number, which its type is annotated with; at a port, "of one that is displaced or one
    that turns"."""
    in_windows: ClassVar[bool] = False
    """Whether it can act in windows only."""
    courses: ClassVar[tuple[str, ...]] = ()
    """Which of its texts are formulas in `time`."""

    windows: tuple[Window, ...] = field(default=(), kw_only=True)

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)
        if "kind" not in cls.__dict__:
            cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        hints = get_annotations(cls).items()
        cls.units = {name: hint.__metadata__[0] for name, hint in hints if hasattr(hint, "__metadata__")}

    def __post_init__(self) -> None:
        if self.windows and not self.in_windows:
            raise InvalidPatchError(f"The primitive {self.kind!r} cannot act in a window only.")
        for window in self.windows:
            if not window.span[0] < window.span[1] or not all(
                value is None or isfinite(value) for value in window[1:]
            ):
                raise InvalidPatchError(
                    f"A window of the primitive {self.kind!r} must begin before it ends, but that in "
                    f"{window.trial!r} goes from {window.begin} s to {window.end} s."
                )
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float | int) and not isinstance(value, bool) and not isfinite(value):
                raise InvalidPatchError(
                    f"{item.name} of the primitive {self.kind!r} must be finite, but is {value!r}."
                )
        for name in self.courses:
            course_of(getattr(self, name), self.kind)

    def acts(self, time: FloatArray) -> BoolArray:
        """Return whether it acts at times (N,); its windows are those of their trial."""
        inside = np.full(len(time), not self.windows)
        for begin, end in (window.span for window in self.windows):
            inside |= (begin <= time) & (time < end)
        return inside

    def to_mapping(self) -> dict[str, Any]:
        """Return kind and values as plain data."""
        values = asdict(self)
        windows = [window._asdict() for window in values.pop("windows")]
        return {"kind": self.kind, **values, **({"windows": windows} if windows else {})}

    @classmethod
    def values(cls) -> dict[str, Any]:
        """Return the types of its values by name, all but `windows`."""
        return {
            item.name: getattr(item.type, "__origin__", item.type)
            for item in fields(cls)
            if item.name != "windows"
        }
