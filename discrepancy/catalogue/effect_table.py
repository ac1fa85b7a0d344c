"""A table of a file of effects: its values are asked for by kind, and refused with where they stand."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal, cast, get_args

from discrepancy.catalogue.entry import Prior
from discrepancy.errors import CatalogueError


@dataclass(frozen=True)
class Table:
    """A table of a TOML file that knows where it stands."""

    row: Any
    where: str

    def __post_init__(self) -> None:
        if not isinstance(self.row, Mapping):
            raise CatalogueError(f"{self.where} must be a table, but is {self.row!r}.")

    def only(self, *keys: str) -> None:
        """Refuse keys that are not among `keys`."""
        for key in self.row:
            if key not in keys:
                raise CatalogueError(
                    f"{self.where} has the unknown key {key!r}; known are {', '.join(keys)}."
                )

    def text(self, key: str) -> str:
        """Return a text that must be there."""
        value = self.row.get(key)
        if not isinstance(value, str) or not value.strip():
            raise CatalogueError(f"{self.where}: {key!r} must be a text, but is {value!r}.")
        return value

    def number(self, key: str) -> float:
        """Return a finite number that must be there."""
        value = self.row.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise CatalogueError(f"{self.where}: {key!r} must be a finite number, but is {value!r}.")
        return float(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts, empty if it is not there."""
        value = self.row.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise CatalogueError(f"{self.where}: {key!r} must be a list of texts, but is {value!r}.")
        return tuple(value)

    def tables(self, key: str) -> tuple["Table", ...]:
        """Return an array of tables, empty if it is not there."""
        value = self.row.get(key, [])
        if not isinstance(value, list):
            raise CatalogueError(f"{self.where}: {key!r} must be an array of tables ([[{key}]]).")
        return tuple(Table(row, f"{self.where}, {key} {n}") for n, row in enumerate(value, start=1))

    def prior(self) -> Prior:
        """Return the table `prior`."""
        prior = Table(self.row.get("prior"), f"{self.where}: 'prior'")
        prior.only("shape", "low", "high")
        shape = prior.text("shape")
        known = get_args(Literal["log_normal", "normal", "uniform"])
        if shape not in known:
            raise CatalogueError(
                f"{prior.where}: 'shape' must be one of {', '.join(known)}, but is {shape!r}."
            )
        return Prior(
            cast("Literal['log_normal', 'normal', 'uniform']", shape),
            prior.number("low"),
            prior.number("high"),
        )
