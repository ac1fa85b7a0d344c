"""Writing a companion's table of variables row by row. Copied into the FMU: standard library only."""

from __future__ import annotations

from collections.abc import Mapping

from ..slaves.variables import Causality, FmuVariable, Kind, Variability


class Table:
    """A table of variables that grows by rows.

    Parameters
    ----------
    start : mapping of str to float
        Start values by variable name that take the place of the defaults.
    """

    def __init__(self, start: Mapping[str, float]) -> None:
        self._start = dict(start)
        self._rows: list[FmuVariable] = []

    def add(
        self,
        name: str,
        causality: Causality,
        description: str,
        *,
        kind: Kind = "Real",
        unit: str | None = None,
        display: str | None = None,
        box: tuple[float | None, float | None] = (None, None),
        default: float = 0.0,
        enumeration: str | None = None,
    ) -> None:
        """Append a row; `box` is the range, `default` the start value of an input or parameter."""
        variability: Variability = "fixed" if causality == "parameter" else "continuous"
        if kind != "Real" and causality != "parameter":
            variability = "discrete"
        self._rows.append(
            FmuVariable(
                name=name,
                reference=len(self._rows),
                kind=kind,
                causality=causality,
                variability=variability,
                description=description,
                unit=unit,
                display_unit=display,
                minimum=box[0],
                maximum=box[1],
                start=None if causality == "output" else float(self._start.pop(name, default)),
                enumeration=enumeration,
            )
        )

    def rows(self) -> tuple[FmuVariable, ...]:
        """Return the table.

        Raises
        ------
        ValueError
            If a start value was given for something that is no input or parameter.
        """
        if self._start:
            raise ValueError(f"there is no input or parameter {sorted(self._start)[0]!r}")
        return tuple(self._rows)
