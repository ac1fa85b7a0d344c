"""The table of an FMU's variables, which model description, slave and documentation are made from.

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
"""Value of `response`: the steady turn, without inertia and damping."""
TRANSIENT = 2
"""Value of `response`: the modes are integrated in time."""


class Status(IntEnum):
    """Values of `status`: how the last call went."""

    OK = 0
    OUTSIDE_RANGE = 1
    NOT_FINITE = 2
    BAD_STEP = 3
    BAD_CALL = 4
    BAD_STATE = 5
    INTERNAL = 6


@dataclass(frozen=True)
class EnumerationType:
    """An enumeration of FMI.

    Attributes
    ----------
    name, description : str
        The type's name.
    items : tuple of (str, int, str)
        Name, value and description of each item.
    """

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
        "What became of the last call; "
        "other than ok, the call was refused and state and outputs stay",
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
    """A variable of an FMU: one row of the table.

    Attributes
    ----------
    name : str
        Name in FMI's structured naming convention.
    reference : int
        FMI value reference; also the index of the row.
    kind : {"Real", "Integer", "Boolean", "Enumeration"}
        FMI base type; enumerations are read and set as integers.
    causality, variability : str
        As FMI 2.0 defines them.
    description : str
        One line for people.
    unit, display_unit : str or None
        As FMI spells them.
    minimum, maximum : float or None
        Range that is enforced for inputs and parameters; None where there is no limit.
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
    """A table of variables that is built row by row.

    Parameters
    ----------
    start : mapping of str to float
        Start values by variable name that replace the defaults.
    first : int
        Value reference of the first row.
    """

    def __init__(self, start: Mapping[str, float], first: int = 0) -> None:
        self._start = dict(start)
        self._first = first
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
        limits: tuple[float | None, float | None] = (None, None),
        default: float = 0.0,
        tunable: bool = False,
        enumeration: str | None = None,
    ) -> None:
        """Append a row.

        Parameters
        ----------
        name, causality, description, kind, unit, enumeration
            As in `FmuVariable`.
        display : str or None
            Display unit.
        limits : (float or None, float or None)
            Range; None where it has no limit.
        default : float
            Start value of an input or parameter, unless the table has another.
        tunable : bool
            Whether a parameter can change between steps.
        """
        low, high = limits
        row = FmuVariable(
            name,
            reference=self._first + len(self._rows),
            kind=kind,
            causality=causality,
            variability=_variability(kind, causality, tunable=tunable),
            description=description,
            unit=unit,
            display_unit=display,
            minimum=low,
            maximum=high,
            start=None if causality == "output" else float(self._start.pop(name, default)),
            enumeration=enumeration,
        )
        self._rows.append(row)

    def add_status(self) -> None:
        """Append the output that says how the last call went."""
        description = "What became of the last call"
        self.add("status", "output", description, kind="Enumeration", enumeration="Status")

    def rows(self) -> tuple[FmuVariable, ...]:
        """Return the table.

        Raises
        ------
        ValueError
            If a start value was given for a name that is not an input or parameter.
        """
        if self._start:
            unused = sorted(self._start)
            raise ValueError(f"there is no input or parameter {unused[0]!r}")
        return tuple(self._rows)


def _variability(kind: Kind, causality: Causality, *, tunable: bool) -> Variability:
    """Return the variability in FMI: tunable or fixed for parameters, else by type."""
    if tunable:
        return "tunable"
    if causality == "parameter":
        return "fixed"
    return "continuous" if kind == "Real" else "discrete"
