"""Rows of a table of variables, which model description, slave and documentation follow; enumerations.

Standard library only: the file is copied into the FMU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

Kind = Literal["Real", "Integer", "Boolean", "Enumeration"]
Causality = Literal["input", "parameter", "output", "local", "independent"]
Variability = Literal["continuous", "discrete", "fixed", "tunable"]

QUASI_STATIC = 1
"""Value of `response`: the steady turn, inertia and damping left out."""
TRANSIENT = 2
"""Value of `response`: the modes are integrated in time."""


class Status(IntEnum):
    """Values of `status`."""

    OK, OUTSIDE_RANGE, NOT_FINITE, BAD_STEP, BAD_CALL, BAD_STATE, INTERNAL = range(7)


@dataclass(frozen=True)
class EnumerationType:
    """Names and values of an enumeration: `items` maps a name to its value and description."""

    name: str
    description: str
    items: tuple[tuple[str, int, str], ...]


ENUMERATIONS = (
    EnumerationType(
        "Response",
        "How the structure answers its loads",
        (
            (
                "quasi_static",
                QUASI_STATIC,
                "The steady turn: static equilibrium with the inputs of the step",
            ),
            ("transient", TRANSIENT, "The modes are integrated exactly, inputs held over the step"),
        ),
    ),
    EnumerationType(
        "Status",
        "What became of the last call; other than ok, the call was refused and state and outputs stay",
        (
            ("ok", Status.OK, "The outputs belong to the inputs of the last step"),
            (
                "outside_range",
                Status.OUTSIDE_RANGE,
                "An input or parameter lies outside its min and max",
            ),
            ("not_finite", Status.NOT_FINITE, "An input or parameter is NaN or infinite"),
            ("bad_step", Status.BAD_STEP, "Step size or communication point is not acceptable"),
            (
                "bad_call",
                Status.BAD_CALL,
                "A call in the wrong phase, such as a step before initialisation",
            ),
            ("bad_state", Status.BAD_STATE, "A restored state does not belong to this FMU"),
            ("internal", Status.INTERNAL, "The computation failed; the log says how"),
        ),
    ),
)


@dataclass(frozen=True)
class FmuVariable:
    """One row of the table.

    Attributes
    ----------
    name : str
        Name in the structured naming convention.
    reference : int
        FMI value reference; also the index of the row.
    kind : {"Real", "Integer", "Boolean", "Enumeration"}
        FMI base type; enumerations are read and set as integers.
    causality, variability : str
        As FMI 2.0 defines them.
    description : str
        One line for people.
    unit, display_unit : str or None
        In the spelling of FMI.
    minimum, maximum : float or None
        The range that is enforced for inputs and parameters; None where there is none.
    start : float or None
        Start value of inputs and parameters.
    enumeration : str or None
        Name in `ENUMERATIONS`.
    """

    name: str
    reference: int
    kind: Kind
    causality: Causality
    variability: Variability
    description: str
    unit: str | None = None
    display_unit: str | None = None
    minimum: float | None = None
    maximum: float | None = None
    start: float | None = None
    enumeration: str | None = None


class VariableTable:
    """A table of variables that grows by rows.

    Parameters
    ----------
    start : mapping of str to float
        Start values by variable name that take the place of the defaults.
    first : int
        Value reference of the first row.
    """

    def __init__(self, start: Mapping[str, float], first: int = 0) -> None:
        self._start, self._first = dict(start), first
        self._rows: list[FmuVariable] = []

    def add(
        self,
        name: str,
        causality: Causality,
        description: str,
        *,
        kind: Kind = "Real",
        box: tuple[float | None, float | None] = (None, None),
        default: float = 0.0,
        tunable: bool = False,
        display: str | None = None,
        **own: str | None,
    ) -> None:
        """Append a row; `box` is the range, `default` the start value of an input or parameter.

        `own` are further fields of `FmuVariable`: its unit, its enumeration.
        """
        variability: Variability = "fixed" if causality == "parameter" else "continuous"
        if tunable:
            variability = "tunable"
        elif kind != "Real" and causality != "parameter":
            variability = "discrete"
        start = None if causality == "output" else float(self._start.pop(name, default))
        reference = self._first + len(self._rows)
        row = FmuVariable(
            name, reference, kind, causality, variability, description,
            display_unit=display, minimum=box[0], maximum=box[1], start=start, **own,
        )  # fmt: skip
        self._rows.append(row)

    def add_status(self) -> None:
        """Append the row that says what became of the last call."""
        text = "What became of the last call"
        self.add("status", "output", text, kind="Enumeration", enumeration="Status")

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
