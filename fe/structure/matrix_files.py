"""Matrices and vectors of files, whose rows have the names of nodes and components."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError

from .matrix_tables import Place, read_matrix, read_vector
from .tables import Vector

RowWeights = Mapping[int, tuple[float, ...]]
"""Weights of the rows that carry one name, by the number of these rows."""

READ_WEIGHTS: RowWeights = {
    1: (1.0,),
    2: (0.5, 0.5),
    3: (1 / 6, 2 / 3, 1 / 6),
    4: (0.25, 0.25, 0.25, 0.25),
    8: (0.25, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0, 0.0),
}
"""Weights of the rows of a name in its displacement. CalculiX expands a node of a shell into two or
three nodes through the thickness, and one of a beam into four or eight; the weights follow from
what version 2.20 prints."""
FORCE_WEIGHTS: RowWeights = {**READ_WEIGHTS, 3: (-0.5, 2.0, -0.5)}
"""Weights of these rows in a force on the node, as CalculiX distributes it."""

_UNSYMMETRIC = 1e-9
"""Largest asymmetry of a matrix, relative to its largest entry."""


def place_in_words(place: Place) -> str:
    """Return a node and its component as they stand in a sentence."""
    node, component = place
    return f"node {node}, component {component}"


@dataclass(frozen=True)
class MatrixFiles:
    """Matrices and vectors of files, with n rows.

    Attributes
    ----------
    places : list of (int, int)
        Node and component of each row.
    unit : float
        Metres in the unit of length of the matrices.
    """

    folder: Path
    places: list[Place]
    unit: float

    @cached_property
    def rows(self) -> dict[Place, list[int]]:
        """Rows of each node's component."""
        rows: dict[Place, list[int]] = {}
        for row, place in enumerate(self.places):
            rows.setdefault(place, []).append(row)
        return rows

    def rows_of(self, place: Place, where: str) -> list[int]:
        """Return the rows of a node's component.

        Parameters
        ----------
        place : (int, int)
            Node and component.
        where : str
            The key of the design that names the node, for sentences.

        Raises
        ------
        MeshError
            If the matrices have no such row.
        """
        if place in self.rows:
            return self.rows[place]
        node, component = place
        components = [str(other) for number, other in sorted(self.rows) if number == node]
        known_rows = f"its components {', '.join(components)}" if components else "no such node"
        raise MeshError(
            f"{where}: node {node} has no component {component} in the matrices, which have "
            f"{known_rows}; components that were held or tied when the matrices were written are "
            "missing: name another node."
        )

    def unit_vector_at(
        self, place: Place, where: str, weights: RowWeights = READ_WEIGHTS
    ) -> FloatArray:
        """Return the vector (n,) of 1 at a node's component, spread over the rows of that name.

        Parameters
        ----------
        place : (int, int)
            Node and component.
        where : str
            What names them, for sentences.
        weights : RowWeights
            Weights of rows that carry one name.

        Raises
        ------
        MeshError
            If the matrices have no such row, or so many that their weights are not known.
        """
        rows = self.rows_of(place, where)
        if len(rows) not in weights:
            node, component = place
            raise MeshError(
                f"{where}: node {node} has {len(rows)} rows of component {component}, and how "
                "these share what acts on the node is not known; name another node, or give a "
                "vector."
            )
        vector = np.zeros(len(self.places))
        vector[rows] = weights[len(rows)]
        return vector

    def direction_at(
        self, node: int, direction: Vector, where: str, weights: RowWeights = READ_WEIGHTS
    ) -> FloatArray:
        """Return the vector (n,) of a direction (3,) at a node; the rest as in `unit_vector_at`."""
        components = [
            value * self.unit_vector_at((node, axis), where, weights)
            for axis, value in enumerate(direction, start=1)
            if value
        ]
        return np.asarray(np.sum(components, axis=0))

    def uniform_field(self, field: Vector, where: str) -> FloatArray:
        """Return the values (n,) of a vector field, such as an acceleration, equal at all nodes.

        Parameters
        ----------
        field : (3,) tuple
            The components of the field along the axes; rotations are zero.
        where : str
            The key that needs the field, for messages.

        Raises
        ------
        MeshError
            If rows that rotate cannot be distinguished from rows that shift.
        """
        if len(self.rows) < len(self.places):
            raise MeshError(
                f"{where}: several rows of the matrices have the same name, as for shells and "
                "beams that were expanded to solids, so that rotations cannot be distinguished "
                "from displacements; give the load as a vector."
            )
        no_rotations = (0.0, 0.0, 0.0)
        values = (*field, *no_rotations)
        return np.array([values[component - 1] for _, component in self.places])

    def vector(self, name: str, where: str, weights: RowWeights = READ_WEIGHTS) -> FloatArray:
        """Return the vector (n,) of a file; raises `MeshError` if it cannot be read or used."""

        def unit_vector_at(place: Place) -> FloatArray:
            return self.unit_vector_at(place, where, weights)

        return read_vector(self.folder, name, unit_vector_at, len(self.places))

    def matrix(self, name: str, where: str, *, partial: bool = False) -> sparse.csr_array:
        """Return the symmetric matrix (n, n) of a file [N/m or kg], its rows in our order.

        Parameters
        ----------
        name : str
            The file, and the matrix in it.
        where : str
            The key that names it, for sentences.
        partial : bool
            Whether the matrix may have fewer rows, as a table whose last rows are zero.

        Raises
        ------
        MeshError
            If the matrix cannot be read, has other rows, is not finite or not symmetric.
        """
        matrix, places_in_file = read_matrix(self.folder, name)
        size = len(self.places)
        label = f"{where}: {self.folder / name}"
        if places_in_file is not None:
            rows = [self.rows_of(place, label)[0] for place in places_in_file]
            selection = sparse.eye_array(size, format="csc")[:, rows].tocsr()
            matrix = (selection @ matrix @ selection.T).tocsr()
        if partial and matrix.shape[0] < size:
            matrix.resize((size, size))
        if matrix.shape[0] != size:
            raise MeshError(
                f"{label} has {matrix.shape[0]} rows, but there are {size} unknowns; matrices and "
                "unknowns must be of the same run."
            )
        self._check_finite_and_symmetric(matrix, label)
        return sparse.csr_array(0.5 * (matrix + matrix.T) / self.unit)

    def _check_finite_and_symmetric(self, matrix: sparse.csr_array, label: str) -> None:
        """Raise `MeshError` if a matrix (n, n) is not finite or not symmetric."""
        largest = abs(matrix).max() if matrix.nnz else 0.0
        if not np.isfinite(largest):
            raise MeshError(f"{label} holds a number that is not finite.")
        asymmetry = abs(matrix - matrix.T).tocoo()
        if asymmetry.nnz and asymmetry.max() > _UNSYMMETRIC * largest:
            worst = int(asymmetry.data.argmax())
            row, column = (int(indices[worst]) for indices in asymmetry.coords)
            raise MeshError(
                f"{label} is not symmetric: its entries between {place_in_words(self.places[row])} "
                f"and {place_in_words(self.places[column])} differ by {asymmetry.data[worst]:.3g}; "
                "friction, follower loads and gyroscopic terms cannot be taken."
            )
