"""Motions of nodes as weighted rows of the matrices, and loads as vectors over the rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray, IntArray
from fe.structure.matrix_files import FORCE_WEIGHTS, READ_WEIGHTS, RowWeights
from fe.structure.matrix_tables import Dof

from .linear_model import HeldMotion
from .loads import DeckLoad
from .shell_sides import ShellSide

_LAYERS = (1, 2, 3)
"""Numbers of rows that a shell has through its thickness; a single row is its middle."""


class WeightedRows(NamedTuple):
    """A motion as a weighted sum of rows of the matrices.

    Attributes
    ----------
    rows : (m,) array of int
        Indices of the rows.
    weights : (m,) array
        Their weights.
    """

    rows: IntArray
    weights: FloatArray

    def vector(self, count: int) -> FloatArray:
        """Return the weights of all rows (count,)."""
        vector = np.zeros(count)
        vector[self.rows] = self.weights
        return vector

    def times(self, factor: float) -> "WeightedRows":
        """Return the motion multiplied by a factor."""
        return WeightedRows(self.rows, factor * self.weights)


class MotionReader:
    """The rows of each degree of freedom.

    Parameters
    ----------
    dofs : sequence of Dof
        Degree of freedom of each row.
    """

    def __init__(self, dofs: Sequence[Dof]) -> None:
        self.rows: dict[Dof, list[int]] = {}
        for row, dof in enumerate(dofs):
            self.rows.setdefault(dof, []).append(row)

    def weighted(self, dof: Dof, table: RowWeights) -> WeightedRows | None:
        """Return a motion as weighted rows; None if their weights are not known."""
        rows = self.rows.get(dof, [])
        if len(rows) not in table:
            return None
        return WeightedRows(np.array(rows), np.array(table[len(rows)]))

    def displacement(self, solution: FloatArray, dof: Dof) -> float | None:
        """Return the displacement of a node in a solution (n,), as CalculiX prints it."""
        weighted = self.weighted(dof, READ_WEIGHTS)
        return None if weighted is None else float(solution[weighted.rows] @ weighted.weights)


@dataclass(frozen=True)
class MotionRows:
    """How motions of nodes follow from the rows of the matrices, and how loads act on them.

    Attributes
    ----------
    dofs : list of Dof
        Degree of freedom of each row.
    held : set of HeldMotion
        Held motions; loads on them have no effect.
    bound : dict of Dof to WeightedRows
        Motions without a row of their own: those of tied nodes, and rotations.
    """

    dofs: list[Dof]
    held: set[HeldMotion]
    bound: Mapping[Dof, WeightedRows] = field(default_factory=dict)

    @cached_property
    def _reader(self) -> MotionReader:
        """The rows of each motion."""
        return MotionReader(self.dofs)

    def is_held(self, dof: Dof) -> bool:
        """Return whether a motion is held."""
        node, direction = dof
        return HeldMotion(node, direction) in self.held

    def displacement(self, dof: Dof) -> WeightedRows | None:
        """Return the displacement of a node as weighted rows; None if it is not known.

        A held displacement has no rows.
        """
        if self.is_held(dof):
            return WeightedRows(np.empty(0, dtype=np.intp), np.empty(0))
        if dof in self.bound:
            return self.bound[dof]
        return self._reader.weighted(dof, READ_WEIGHTS)

    def has_only_nodal_forces(self, load: DeckLoad) -> bool:
        """Return whether a load consists of forces at nodes that have rows or are held."""
        has_others = bool(load.moments) or any(
            any(forces.values()) for forces in load.side_forces.values()
        )
        return not has_others and not self.missing(load, bound=False)

    def missing(self, load: DeckLoad, *, bound: bool = True) -> list[Dof]:
        """Return the translations at which a load acts and that have no rows and are not held.

        `bound` says whether bound motions count as having rows.
        """
        tables = [load.forces, *load.side_forces.values()]
        dofs = [dof for table in tables for dof, force in table.items() if force]
        return [
            dof
            for dof in dict.fromkeys(dofs)
            if not self.is_held(dof)
            and self._reader.weighted(dof, FORCE_WEIGHTS) is None
            and not (bound and dof in self.bound)
        ]

    def missing_rotations(self, load: DeckLoad) -> list[Dof]:
        """Return the rotations at which a load acts and that have no rows and are not held."""
        return [
            dof
            for dof, moment in load.moments.items()
            if moment and dof not in self.bound and not self.is_held(dof)
        ]

    def vector(self, load: DeckLoad) -> FloatArray:
        """Return the forces (n,) of a load on the rows, without its acceleration."""
        vector = np.zeros(len(self.dofs))
        for dof, force in (*load.forces.items(), *load.moments.items()):
            self._add(vector, self._rows_of(dof), force, dof)
        for side, forces in load.side_forces.items():
            for dof, force in forces.items():
                self._add(vector, self._rows_of_side(dof, side), force, dof)
        return vector

    def _add(
        self, vector: FloatArray, weighted: WeightedRows | None, force: float, dof: Dof
    ) -> None:
        """Add a force on a motion to a vector (n,)."""
        if weighted is not None and not self.is_held(dof):
            np.add.at(vector, weighted.rows, force * weighted.weights)

    def _rows_of(self, dof: Dof) -> WeightedRows | None:
        """Return the weighted rows on which a force at a node acts."""
        if dof in self.bound:
            return self.bound[dof]
        return self._reader.weighted(dof, FORCE_WEIGHTS)

    def _rows_of_side(self, dof: Dof, side: ShellSide) -> WeightedRows | None:
        """Return the row on which a force on one side of a shell acts.

        CalculiX expands a node of a shell from the bottom to the top, and stores the rows in this
        order.
        """
        rows = self._reader.rows.get(dof, [])
        if len(rows) not in _LAYERS:
            return self._rows_of(dof)
        row = rows[0] if side is ShellSide.BOTTOM else rows[-1]
        return WeightedRows(np.array([row]), np.ones(1))
