"""Matrices and vectors from files, with rows named by node and component."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError

from .matrix_tables import Dof, read_matrix, read_vector
from .tables import Vector

RowWeights = Mapping[int, tuple[float, ...]]
"""Weights of rows with the same node and component, by the number of such rows."""

READ_WEIGHTS: RowWeights = {
    1: (1.0,),
    2: (0.5, 0.5),
    3: (1 / 6, 2 / 3, 1 / 6),
    4: (0.25, 0.25, 0.25, 0.25),
    8: (0.25, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0, 0.0),
}
"""Weights of such rows in the displacement of the node. CalculiX expands a node of a shell into two
or three nodes through the thickness, and one of a beam into four or eight; the weights follow from
what version 2.20 prints."""
FORCE_WEIGHTS: RowWeights = {**READ_WEIGHTS, 3: (-0.5, 2.0, -0.5)}
"""Weights of such rows in a force on the node, as CalculiX distributes it."""

_UNSYMMETRIC = 1e-9
"""Largest asymmetry of a matrix, relative to its largest entry."""


def describe_dof(dof: Dof) -> str:
    """Format a node and its component for a message."""
    node, component = dof
    return f"node {node}, component {component}"


@dataclass(frozen=True)
class MatrixFiles:
    """The matrix files of a structure, with n rows.

    Attributes
    ----------
    dofs : list of (int, int)
        Node and component of each row.
    unit : float
        Unit of length of the matrices [m].
    """

    folder: Path
    dofs: list[Dof]
    unit: float

    @cached_property
    def rows(self) -> dict[Dof, list[int]]:
        """Indices of the rows of each node and component."""
        rows: dict[Dof, list[int]] = {}
        for row, dof in enumerate(self.dofs):
            rows.setdefault(dof, []).append(row)
        return rows

    def rows_of(self, dof: Dof, where: str) -> list[int]:
        """Return the rows of the matrices for a component of a node.

        There may be several: CalculiX expands a node of a shell or a beam into two to eight nodes,
        whose rows have the same node and component. `where` is the key of the design that names the
        node, for the error message.

        Raises
        ------
        MeshError
            If the matrices have no such row.
        """
        if dof in self.rows:
            return self.rows[dof]
        node, component = dof
        components = [
            str(known_component)
            for known_node, known_component in sorted(self.rows)
            if known_node == node
        ]
        known_rows = f"its components {', '.join(components)}" if components else "no such node"
        raise MeshError(
            f"{where}: node {node} has no component {component} in the matrices, which have "
            f"{known_rows}; components that were held or tied when the matrices were written are "
            "missing: name another node."
        )

    def unit_vector_at(
        self, dof: Dof, where: str, weights: RowWeights = READ_WEIGHTS
    ) -> FloatArray:
        """Return the vector (n,) with 1 at a component of a node.

        Where several rows have the same node and component, `weights` distributes the 1 over them.

        Raises
        ------
        MeshError
            If the matrices have no such row, or so many that their weights are not known.
        """
        rows = self.rows_of(dof, where)
        if len(rows) not in weights:
            node, component = dof
            raise MeshError(
                f"{where}: node {node} has {len(rows)} rows of component {component}, and how "
                "these share what acts on the node is not known; name another node, or give a "
                "vector."
            )
        vector = np.zeros(len(self.dofs))
        vector[rows] = weights[len(rows)]
        return vector

    def direction_at(
        self, node: int, direction: Vector, where: str, weights: RowWeights = READ_WEIGHTS
    ) -> FloatArray:
        """Return the vector (n,) of a direction (3,) at a node, see `unit_vector_at`."""
        components = [
            value * self.unit_vector_at((node, axis), where, weights)
            for axis, value in enumerate(direction, start=1)
            if value
        ]
        return np.asarray(np.sum(components, axis=0))

    def uniform_field(self, field: Vector, where: str) -> FloatArray:
        """Return the vector (n,) of a field that is equal at all nodes, such as an acceleration.

        Parameters
        ----------
        field : (3,) tuple
            The components along the axes; rotations are zero.
        where : str
            The key of the design that needs the field, for the error message.

        Raises
        ------
        MeshError
            If rows of rotations cannot be distinguished from rows of translations.
        """
        if len(self.rows) < len(self.dofs):
            raise MeshError(
                f"{where}: several rows of the matrices have the same name, as for shells and "
                "beams that were expanded to solids, so that rotations cannot be distinguished "
                "from displacements; give the load as a vector."
            )
        no_rotations = (0.0, 0.0, 0.0)
        values = (*field, *no_rotations)
        return np.array([values[component - 1] for _, component in self.dofs])

    def vector(self, name: str, where: str, weights: RowWeights = READ_WEIGHTS) -> FloatArray:
        """Read a vector (n,); raise `MeshError` if it cannot be read or has another length."""

        def unit_vector_at(dof: Dof) -> FloatArray:
            return self.unit_vector_at(dof, where, weights)

        return read_vector(self.folder, name, unit_vector_at, len(self.dofs))

    def matrix(self, name: str, where: str, *, partial: bool = False) -> sparse.csr_array:
        """Read a symmetric matrix (n, n) [N/m or kg], with rows in the order of `dofs`.

        Parameters
        ----------
        name : str
            `FILE` or `FILE:MATRIX`.
        where : str
            The key of the design that names it, for error messages.
        partial : bool
            Whether the matrix may have fewer rows, as a table does whose last rows are zero.

        Raises
        ------
        MeshError
            If the matrix cannot be read, has other rows, is not finite or not symmetric.
        """
        matrix, dofs_in_file = read_matrix(self.folder, name)
        size = len(self.dofs)
        label = f"{where}: {self.folder / name}"
        if dofs_in_file is not None:
            rows = [self.rows_of(dof, label)[0] for dof in dofs_in_file]
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
                f"{label} is not symmetric: its entries between {describe_dof(self.dofs[row])} "
                f"and {describe_dof(self.dofs[column])} differ by {asymmetry.data[worst]:.3g}; "
                "friction, follower loads and gyroscopic terms cannot be taken."
            )
