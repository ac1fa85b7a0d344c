"""What every primitive change of a model has in common.

Standard library and relative imports only: this file is copied into the FMU.
"""

from dataclasses import asdict, dataclass, fields
from math import isfinite
from typing import Any, ClassVar

from .errors import InvalidPatchError


@dataclass(frozen=True, slots=True)
class Primitive:
    """One primitive change; `kind` names its class in a file. All values SI; zero magnitude is no change."""

    kind: ClassVar[str] = ""
    units: ClassVar[dict[str, str]] = {}
    """Unit of each real number; at a port, "of one that is displaced or one that turns"."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float | int) and not isinstance(value, bool) and not isfinite(value):
                raise InvalidPatchError(
                    f"{item.name} of the primitive {self.kind!r} must be finite, but is {value!r}."
                )

    def to_mapping(self) -> dict[str, Any]:
        """Return kind and values as plain data."""
        return {"kind": self.kind, **asdict(self)}
