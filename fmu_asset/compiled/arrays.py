"""Which rows of a table of variables are elements of one array in FMI 3."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from fmu_asset.slaves.variables import FmuVariable

_ELEMENT = re.compile(r"(?P<stem>.+)(?:\[(?P<index>[0-9]+)\]|\.(?P<label>[^.]+))")


@dataclass(frozen=True)
class ArrayVariable:
    """Rows that follow one another, as one array; its value reference is that of the first row.

    Attributes
    ----------
    name : str
        What the names of the rows have in common: `strain` of `strain[1]`, ...; `health` of `health.z1`, ...
    rows : tuple of FmuVariable
        The elements in order, alike but for name, description and start value.
    """

    name: str
    rows: tuple[FmuVariable, ...]

    @property
    def description(self) -> str:
        """Return that of the first element with i in the place of its index or name, and all names."""
        labels = [_label(row.name) for row in self.rows]
        text = re.sub(rf"\b{re.escape(labels[0])}\b|\b1\b", "i", self.rows[0].description, count=1)
        return text if labels[0] == "1" else f"{text}; i is one of {', '.join(labels)}"


def arrays_of(table: Sequence[FmuVariable]) -> tuple[ArrayVariable, ...]:
    """Return the arrays of a table: numbered variables, and inputs and outputs such as `health.z1`.

    Rows of one stem that differ in unit or range stay scalars.
    """
    found = []
    for stem, group in groupby(table, _stem):
        rows = tuple(group)
        plain = {replace(row, name="", reference=0, description="", start=None) for row in rows}
        if stem is not None and len(plain) == 1:
            found.append(ArrayVariable(stem, rows))
    return tuple(found)


def _stem(row: FmuVariable) -> str | None:
    match = _ELEMENT.fullmatch(row.name)
    return None if match is None or row.causality == "parameter" or row.kind != "Real" else match["stem"]


def _label(name: str) -> str:
    match = _ELEMENT.fullmatch(name)
    assert match is not None
    return match["index"] or match["label"]
