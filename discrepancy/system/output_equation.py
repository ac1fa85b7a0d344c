"""Equations of outputs: what they read of the unknowns, their derivatives, and the loads."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.excitation import Load


class Feedthrough(NamedTuple):
    """A load whose value, times `factor`, is part of an output."""

    factor: float
    load: Load


@dataclass(frozen=True, eq=False)
class OutputEquation:
    """The equation of an output y = sum_k rows[k] . d^k z / dt^k + constant + direct loads.

    Attributes
    ----------
    rows : (4, N) ndarray
        The coefficients of the unknowns z = (u, s), displacements and integrals of states, and of
        their first three time derivatives; a state is x = s'.
    constant : float
        The constant part of the output [SI].
    feedthrough : sequence of Feedthrough, optional
        The loads that the output contains directly. None unless the output is the force of a
        prescribed motion or of a controller.
    law_direction : (N,) ndarray, optional
        For the force of a prescribed motion: the direction of that motion, in which the force
        balances those of laws.
    """

    rows: FloatArray
    constant: float = 0.0
    feedthrough: Sequence[Feedthrough] | None = None
    law_direction: FloatArray | None = None

    @classmethod
    def from_row(
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
            The row of displacements u and states x.
        displacement_derivative, state_derivative : int
            How many times u, and how many times x, are differentiated.
        state_count : int
            The number of states, at the end of the row.
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
    """Return the rows (C, M) of C outputs for modal coordinates, given the shapes (N, M)."""
    by_output = np.array([equation.rows for equation in equations]) @ shapes  # (C, 4, M)
    return RowsByDerivative(*np.moveaxis(by_output, 1, 0))
