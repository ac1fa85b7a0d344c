"""What outputs show of a system: its unknowns, their derivatives, and what acts on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.excitation import Load


class Feedthrough(NamedTuple):
    """A load that an output shows directly, `factor` times its value."""

    factor: float
    load: Load


@dataclass(frozen=True, eq=False)
class OutputEquation:
    """What an output shows: sum_k rows[k] . d^k z / dt^k + constant + what acts directly.

    Attributes
    ----------
    rows : (4, N) ndarray
        Rows of z = (u, s) and its first three time derivatives; a state is x = s'.
    constant : float
        Constant [SI].
    feedthrough : sequence of Feedthrough, optional
        Loads in the output. None for all outputs but the force of a prescribed motion or of a
        controller.
    law_direction : (N,) ndarray, optional
        For the force of a prescribed motion: the direction along which it balances forces of laws.
    """

    rows: FloatArray
    constant: float = 0.0
    feedthrough: Sequence[Feedthrough] | None = None
    law_direction: FloatArray | None = None

    @classmethod
    def of_row(
        cls,
        row: FloatArray,
        displacement_derivative: int = 0,
        state_derivative: int = 0,
        state_count: int = 0,
    ) -> "OutputEquation":
        """Return the equation of an output that shows row . (u, x), or a time derivative of it.

        Parameters
        ----------
        row : (N,) array
            Row of displacements u and states x.
        displacement_derivative, state_derivative : int
            How many times u, and how many times x, are differentiated.
        state_count : int
            Number of states, at the end of the row.
        """
        displacement_count = len(row) - state_count
        rows = np.zeros((4, len(row)))
        rows[displacement_derivative, :displacement_count] = row[:displacement_count]
        rows[state_derivative + 1, displacement_count:] = row[displacement_count:]
        return cls(rows)


class RowsByDerivative(NamedTuple):
    """Rows (C, M) of C outputs for coordinates and for their first three time derivatives."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray


def rows_in_coordinates(
    equations: Sequence[OutputEquation], shapes: FloatArray
) -> RowsByDerivative:
    """Return the rows of outputs for modal coordinates, given the shapes (N, M)."""
    by_output = np.array([equation.rows for equation in equations]) @ shapes
    return RowsByDerivative(*np.moveaxis(by_output, 1, 0))
