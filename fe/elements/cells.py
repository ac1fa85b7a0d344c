"""Element arrays of cells of one kind, and their sums.

Element arrays are contracted for many cells at once, an order of magnitude faster than one bilinear
form after the other. Strains are in the order of `fe.elements.elasticity`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from fe.runtime.arrays import FloatArray, IntArray

from .elasticity import VOIGT
from .kinds import HEXAHEDRA_20, ElementKind, Rule

BATCH = 512
"""Number of cells whose arrays are contracted at once."""
AXES = 3
STRAINS = len(VOIGT)
_MOST_FACE_CORNERS = 4
_SUMMED_ENTRIES = 4_000_000  # entries of element arrays that are summed at once, of 16 bytes each


def jacobians(kind: ElementKind, nodes: FloatArray, local_positions: FloatArray) -> FloatArray:
    """Return the Jacobians dx_i/dX_j (n, q, 3, 3) of cells.

    Parameters
    ----------
    nodes : (n, k, 3) array
        Positions of the nodes of each cell [m].
    local_positions : (q, 3) array
        Positions in the reference cell.
    """
    _, local_gradients = kind.shape_functions(local_positions)
    return np.asarray(np.einsum("nai,qaj->nqij", nodes, local_gradients, optimize=True))


def gradients(
    kind: ElementKind, nodes: FloatArray, local_positions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the spatial gradients of the shape functions, and the Jacobian determinants.

    Parameters
    ----------
    nodes : (n, k, 3) array
        Positions of the nodes of each cell [m].
    local_positions : (q, 3) array
        Positions in the reference cell.

    Returns
    -------
    gradients : (n, q, k, 3) array
        The gradients [1/m].
    determinants : (n, q) array
        The determinants [m^3].
    """
    jacobian = jacobians(kind, nodes, local_positions)
    _, local_gradients = kind.shape_functions(local_positions)
    inverse_jacobian = np.linalg.inv(jacobian)
    spatial_gradients = local_gradients[np.newaxis] @ inverse_jacobian
    determinants = np.linalg.det(jacobian)
    return np.asarray(spatial_gradients), np.asarray(determinants)


def strain_matrix(gradients: FloatArray) -> FloatArray:
    """Return the strain matrix B (..., 6, 3 k) [1/m] from gradients (..., k, 3) [1/m].

    The three displacements of a node are consecutive columns.
    """
    *points_shape, node_count, _ = gradients.shape
    B = np.zeros((*points_shape, STRAINS, node_count, AXES))
    for strain, (i, j) in enumerate(VOIGT):
        B[..., strain, :, i] += gradients[..., j]
        if i != j:
            B[..., strain, :, j] += gradients[..., i]
    return B.reshape((*points_shape, STRAINS, AXES * node_count))


def stiffness_blocks(
    kind: ElementKind,
    nodes: FloatArray,
    elasticity: FloatArray,
    factor: FloatArray | float = 1.0,
) -> FloatArray:
    """Return the element stiffness matrices of n cells: sum over q of w_q det J_q B_q^T C B_q.

    Parameters
    ----------
    kind : ElementKind
        The kind of the cells, with k nodes and a stiffness rule of q points.
    nodes : (n, k, 3) array
        Positions of the nodes of each cell [m].
    elasticity : (6, 6) or (n, 6, 6) array
        Elasticity in global axes [Pa].
    factor : (n, q) array, optional
        Factor on the elasticity at the points of the stiffness rule.

    Returns
    -------
    (n, 3 k, 3 k) array
        The matrices [N/m].
    """
    rule = kind.stiffness_rule
    spatial_gradients, determinant = gradients(kind, nodes, rule.points)
    B = strain_matrix(spatial_gradients)
    measure = rule.weights * determinant * factor  # (n, q), volume at each point times the factor
    cell_count, point_count = measure.shape
    row_count = point_count * STRAINS
    unknown_count = AXES * kind.node_count
    # the sum over integration points and strains as one matrix product
    stress_matrix = elasticity.reshape(-1, 1, STRAINS, STRAINS) @ B
    stress_matrix = stress_matrix * measure[..., np.newaxis, np.newaxis]
    stress_rows = stress_matrix.reshape(cell_count, row_count, unknown_count)
    strain_rows = B.reshape(cell_count, row_count, unknown_count)
    blocks = strain_rows.swapaxes(1, 2) @ stress_rows
    # symmetric but for rounding errors, which this removes
    return np.asarray(0.5 * (blocks + blocks.swapaxes(1, 2)))


def mass_blocks(kind: ElementKind, nodes: FloatArray, density: ArrayLike, rule: Rule) -> FloatArray:
    """Return the element mass matrices of n cells, for one displacement component.

    Parameters
    ----------
    nodes : (n, k, 3) array
        Positions of the nodes of each cell [m].
    density : (n,) array
        Density of each cell [kg/m^3].
    rule : Rule
        The integration rule in the reference cell.

    Returns
    -------
    (n, k, k) array
        The matrices [kg].
    """
    values, _ = kind.shape_functions(rule.points)
    jacobian = jacobians(kind, nodes, rule.points)
    determinant = np.linalg.det(jacobian)
    volume = determinant * rule.weights
    density_of_cell = np.reshape(density, (-1, 1))
    mass = volume * density_of_cell
    return np.asarray(np.einsum("nq,qa,qb->nab", mass, values, values, optimize=True))


class OuterFaces(NamedTuple):
    """The m faces that belong to one cell only.

    Attributes
    ----------
    cell : (m,) array of int
        The cell of each face.
    number : (m,) array of int
        The index of the face in its cell.
    corners : (m, 4) array of int
        The corner nodes, ascending; the first one of a triangle is -1.
    """

    cell: IntArray
    number: IntArray
    corners: IntArray


@dataclass(frozen=True)
class CellMesh:
    """Nodes and cells of one kind.

    Attributes
    ----------
    points : (nn, 3) array
        Positions of the nodes [m].
    cells : (nc, k) array of int
        Nodes of each cell, by their index in `points`.
    """

    kind: ElementKind
    points: FloatArray
    cells: IntArray

    @property
    def unknowns(self) -> int:
        """Number of displacements; that of a node along an axis has the index 3 node + axis."""
        return AXES * len(self.points)

    @cached_property
    def nodes(self) -> FloatArray:
        """Positions (nc, k, 3) [m] of the nodes of each cell."""
        return self.points[self.cells]

    @property
    def corners(self) -> FloatArray:
        """Positions (nc, c, 3) [m] of the corners of each cell."""
        return self.nodes[:, : len(self.kind.corners)]

    @cached_property
    def centres(self) -> FloatArray:
        """Mean (nc, 3) [m] of the corners of each cell."""
        return np.asarray(self.corners.mean(axis=1))

    @cached_property
    def outer_faces(self) -> OuterFaces:
        """The faces that belong to one cell only."""
        faces = []
        for face in self.kind.faces:
            corners_of_cells = self.cells[:, list(face)]
            corners = np.sort(corners_of_cells, axis=1)
            missing_corners = _MOST_FACE_CORNERS - len(face)  # one for a triangle
            no_rows = (0, 0)
            columns_before = (missing_corners, 0)
            faces.append(np.pad(corners, (no_rows, columns_before), constant_values=-1))
        all_faces = np.vstack(faces)
        _, first_index, cell_count = np.unique(
            all_faces,
            axis=0,
            return_index=True,
            return_counts=True,
        )
        is_outer = cell_count == 1
        outer_index = np.sort(first_index[is_outer])
        # `all_faces` holds face 0 of all cells, then face 1 of all cells, ...
        number, cell = np.divmod(outer_index, len(self.cells))
        return OuterFaces(cell, number, all_faces[outer_index])

    def unknowns_of(self, cells: IntArray, components: int = 3) -> IntArray:
        """Return the unknowns (n, components k) of cells (n,), for one or three components."""
        first_unknown = components * self.cells[cells]
        component = np.arange(components)
        unknowns = first_unknown[..., np.newaxis] + component
        return np.asarray(unknowns.reshape(len(cells), -1))

    def positions(self, cells: IntArray, local_positions: FloatArray) -> FloatArray:
        """Return the positions (n, q, 3) [m] of local positions (q, 3) in cells (n,)."""
        values, _ = self.kind.shape_functions(local_positions)
        return np.asarray(np.einsum("qa,nai->nqi", values, self.nodes[cells]))

    def jacobians_at(self, cells: IntArray, local_positions: FloatArray) -> FloatArray:
        """Return the Jacobians (p, 3, 3) at one local position (p, 3) of each of p cells."""
        _, local_gradients = self.kind.shape_functions(local_positions)
        return np.asarray(np.einsum("pai,paj->pij", self.nodes[cells], local_gradients))

    def strains(
        self, displacement: FloatArray, local_positions: FloatArray | None = None
    ) -> FloatArray:
        """Return the strains (nc, q, 6) of all cells: xx, yy, zz, yz, xz, xy.

        Shear strains are engineering strains.

        Parameters
        ----------
        displacement : (nn, 3) array
            Displacements of all nodes [m].
        local_positions : (q, 3) array, optional
            Positions in the reference cell; by default its centre.
        """
        if local_positions is None:
            local_positions = self.kind.centre[np.newaxis]
        spatial_gradients, _ = gradients(self.kind, self.nodes, local_positions)
        cell_displacement = displacement[self.cells].reshape(len(self.cells), -1)
        B = strain_matrix(spatial_gradients)
        return np.asarray(np.einsum("nqij,nj->nqi", B, cell_displacement))

    def strain_rows(
        self,
        row: ArrayLike,
        weight: ArrayLike,
        cells: IntArray,
        local_positions: FloatArray,
        direction: FloatArray,
    ) -> sparse.csr_array:
        """Return the matrix (rows, 3 nn) that gives weighted sums of normal strains at points.

        It is multiplied by the displacements of all nodes. The normal strain in the direction d is
        d . grad(u . d): the sum over the nodes a of the point's cell of (grad N_a . d) (d . u_a),
        with the spatial gradient grad N_a = dN_a/dX dX/dx.

        Parameters
        ----------
        row : (p,) array of int
            The row of the result to which each of p strains is added; all rows from 0 to the
            largest one occur.
        weight : (p,) array
            The weight of each strain in the sum.
        cells : (p,) array of int
            The cell that contains each point.
        local_positions : (p, 3) array
            The position of each point in the reference cell.
        direction : (p, 3) array
            The direction of each normal strain, a unit vector.
        """
        _, local_gradients = self.kind.shape_functions(local_positions)
        jacobians_at_points = self.jacobians_at(cells, local_positions)
        inverse_jacobians = np.linalg.inv(jacobians_at_points)
        # dN_a/dX_i dX_i/dx_j d_j, for the node a of the cell at the point p
        gradient_along_direction = np.einsum(
            "pai,pij,pj->pa", local_gradients, inverse_jacobians, direction
        )
        weight_column = np.asarray(weight)[:, np.newaxis]
        weighted_gradient = weight_column * gradient_along_direction
        values = weighted_gradient[..., np.newaxis] * direction[:, np.newaxis]
        unknowns_per_cell = AXES * self.kind.node_count
        row_of_entry = np.repeat(row, unknowns_per_cell)
        column_of_entry = self.unknowns_of(cells).ravel()
        last_row = int(row_of_entry.max(initial=-1))
        shape = (last_row + 1, self.unknowns)
        entries = (values.ravel(), (row_of_entry, column_of_entry))
        return sparse.coo_array(entries, shape).tocsr()

    def stiffness(
        self, cells: IntArray, elasticity: FloatArray, factor: FloatArray | float = 1.0
    ) -> sparse.csr_array:
        """Return the stiffness (3 nn, 3 nn) [N/m] of cells (n,), on all unknowns.

        Parameters
        ----------
        elasticity : (6, 6) or (n, 6, 6) array
            Elasticity in global axes [Pa].
        factor : (n, q) array, optional
            Factor on the elasticity at the points of the stiffness rule.
        """
        point_count = len(self.kind.stiffness_rule.weights)
        elasticities = np.broadcast_to(elasticity, (len(cells), STRAINS, STRAINS))
        factors = np.broadcast_to(factor, (len(cells), point_count))

        def blocks(batch: slice) -> FloatArray:
            nodes = self.nodes[cells[batch]]
            return stiffness_blocks(self.kind, nodes, elasticities[batch], factors[batch])

        return self._assembled(cells, blocks, components=AXES)

    def mass(
        self, cells: IntArray, density: ArrayLike, rule: Rule | None = None
    ) -> sparse.csr_array:
        """Return the mass matrix (nn, nn) [kg] of cells (n,), for one displacement component.

        Parameters
        ----------
        density : (n,) array or float
            The density of the cells [kg/m^3].
        rule : Rule, optional
            Integration rule; by default the mass rule of the kind.
        """
        densities = np.broadcast_to(density, len(cells))
        mass_rule = rule or self.kind.mass_rule

        def blocks(batch: slice) -> FloatArray:
            nodes = self.nodes[cells[batch]]
            return mass_blocks(self.kind, nodes, densities[batch], mass_rule)

        return self._assembled(cells, blocks, components=1)

    def _assembled(
        self, cells: IntArray, blocks: Callable[[slice], FloatArray], components: int
    ) -> sparse.csr_array:
        """Assemble element matrices of cells (n,), in batches that limit the memory.

        `blocks` returns the element matrices of a slice of the cells; a node has 1 or 3 components.
        """
        unknown_count = components * len(self.points)
        total = sparse.csr_array((unknown_count, unknown_count))
        width = components * self.kind.node_count
        cells_at_once = max(BATCH, _SUMMED_ENTRIES // width**2)
        for start in range(0, len(cells), cells_at_once):
            end = min(start + cells_at_once, len(cells))
            # element matrices
            element_matrices = []
            for batch_start in range(start, end, BATCH):
                batch_end = min(batch_start + BATCH, end)
                batch = slice(batch_start, batch_end)
                element_matrices.append(blocks(batch))
            values = np.concatenate(element_matrices).ravel()
            # row and column of each entry
            unknowns = self.unknowns_of(cells[start:end], components)
            unknowns = unknowns.astype(np.int32)
            rows = np.repeat(unknowns, width, axis=1).ravel()
            columns = np.tile(unknowns, (1, width)).ravel()
            # entries of one row and column are added
            entries = (values, (rows, columns))
            assembled = sparse.coo_array(entries, shape=total.shape)
            total = total + assembled.tocsr()
        return total


def hexahedra_20(points: FloatArray, cells: IntArray) -> CellMesh:
    """Return a mesh of 20-node hexahedra with straight edges.

    The mid-edge nodes follow the vertices.

    Parameters
    ----------
    points : (nv, 3) array
        Positions of the vertices [m].
    cells : (nc, 8) array of int
        Vertices of each cell.
    """
    ends_in_cell = np.array(HEXAHEDRA_20.edges)
    edge_ends = np.sort(cells[:, ends_in_cell], axis=2)
    # cells share edges: each edge gets one node
    edges, edge_of_cell = np.unique(
        edge_ends.reshape(-1, 2),
        axis=0,
        return_inverse=True,
    )
    edge_numbers = edge_of_cell.reshape(len(cells), -1)
    mid_edge_nodes = len(points) + edge_numbers
    mid_edge_points = points[edges].mean(axis=1)
    return CellMesh(
        kind=HEXAHEDRA_20,
        points=np.vstack((points, mid_edge_points)),
        cells=np.hstack((cells, mid_edge_nodes)),
    )
