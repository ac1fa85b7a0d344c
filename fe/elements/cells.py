"""Cells of one kind between nodes: elasticity, element arrays and their sums.

Element arrays are contracted for many cells at once, an order of magnitude faster than one bilinear form
after the other. Strains are in Voigt order 11, 22, 33, 23, 13, 12 with engineering shear strains.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from fe.runtime.arrays import FloatArray, IntArray

from .kinds import HEXAHEDRA_20, ElementKind, Rule

BATCH = 512
"""Cells whose arrays are contracted at once."""
_TRIPLETS = 4_000_000  # entries of element arrays that are summed at once, of 16 bytes each
_VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def jacobians(kind: ElementKind, nodes: FloatArray, local: FloatArray) -> FloatArray:
    """Jacobians dx_i/dX_j (n, q, 3, 3) at local places (q, 3) of cells with nodes (n, k, 3)."""
    _, slopes = kind.shape_functions(local)
    return np.asarray(np.einsum("nai,qaj->nqij", nodes, slopes, optimize=True))


def gradients(kind: ElementKind, nodes: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradients (n, q, k, 3) of the shape functions in space and Jacobian determinants (n, q)."""
    jacobian = jacobians(kind, nodes, local)
    _, slopes = kind.shape_functions(local)
    return np.asarray(slopes[None] @ np.linalg.inv(jacobian)), np.asarray(np.linalg.det(jacobian))


def strain_matrix(gradients: FloatArray) -> FloatArray:
    """Strain matrix B (..., 6, 3k) of gradients (..., k, 3); the unknowns of a node are consecutive."""
    nodes = gradients.shape[-2]
    B = np.zeros((*gradients.shape[:-2], 6, nodes, 3))
    for row, (i, j) in enumerate(_VOIGT):
        B[..., row, :, i] += gradients[..., j]
        if i != j:
            B[..., row, :, j] += gradients[..., i]
    return B.reshape(*B.shape[:-2], 3 * nodes)


def stiffness_blocks(
    kind: ElementKind, nodes: FloatArray, elasticity: FloatArray, factor: FloatArray | float = 1.0
) -> FloatArray:
    """Element stiffness (n, 3k, 3k) [N/m] of cells with nodes (n, k, 3).

    Parameters
    ----------
    kind : ElementKind
        Of the cells.
    nodes : (n, k, 3) m
        Their nodes.
    elasticity : (6, 6) or (n, 6, 6) Pa
        In space.
    factor : (n, q), optional
        On the elasticity at the points of the rule of the kind.
    """
    local, weight = kind.stiffness_rule
    slopes, determinant = gradients(kind, nodes, local)
    B = strain_matrix(slopes)
    measure = weight * determinant * factor
    n, q = measure.shape
    width = 3 * kind.node_count
    left = B.reshape(n, q * 6, width).swapaxes(1, 2)
    scaled = (elasticity.reshape(-1, 1, 6, 6) @ B) * measure[..., None, None]
    blocks = left @ scaled.reshape(n, q * 6, width)
    return np.asarray(0.5 * (blocks + blocks.swapaxes(1, 2)))


def mass_blocks(kind: ElementKind, nodes: FloatArray, density: ArrayLike, rule: Rule) -> FloatArray:
    """Element mass (n, k, k) [kg] of one component: nodes (n, k, 3) of the cells, density (n,) [kg/m^3]."""
    local, weight = rule
    values, _ = kind.shape_functions(local)
    factor = np.linalg.det(jacobians(kind, nodes, local)) * weight * np.reshape(density, (-1, 1))
    return np.asarray(np.einsum("nq,qa,qb->nab", factor, values, values, optimize=True))


def orthotropic_compliance(moduli: ArrayLike, ratios: ArrayLike, shear_moduli: ArrayLike) -> FloatArray:
    """Compliance (6, 6) [1/Pa] of Young's moduli, ratios 12, 13, 23 and shear moduli 12, 13, 23 along axes.

    Each is (3,), or one number for all three; ratio ij is the contraction along j under tension along i.
    """
    young, ratio, shear = (np.broadcast_to(values, 3) for values in (moduli, ratios, shear_moduli))
    compliance = np.diag(1.0 / np.concatenate((young, shear[::-1])))
    for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), ratio, strict=True):
        compliance[i, j] = compliance[j, i] = -value / young[i]
    return compliance


def isotropic_compliance(young_modulus: float, poisson_ratio: float) -> FloatArray:
    """Compliance (6, 6) [1/Pa] of an isotropic material."""
    shear = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return orthotropic_compliance(young_modulus, poisson_ratio, shear)


def unit_vector(vectors: ArrayLike) -> FloatArray:
    """Vectors (..., 3) of length one along vectors (..., 3)."""
    given = np.asarray(vectors, dtype=np.float64)
    return np.asarray(given / np.linalg.norm(given, axis=-1, keepdims=True))


def axes_of(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Axes (3, 3), rows of length one: along a vector, in the plane of both at right angles to it, across."""
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    across = np.cross(one, other)
    return unit_vector([one, np.cross(across, one), across])


def rotate_elasticity(elasticity: FloatArray, axes: FloatArray) -> FloatArray:
    """Elasticity (n, 6, 6) in space of local elasticity (n, 6, 6) in axes (n, 3, 3), rows the local axes."""
    place = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
    tensor = elasticity[:, place[:, :, None, None], place]
    turned = np.einsum("nabcd,nai,nbj,nck,ndl->nijkl", tensor, *[axes] * 4, optimize=True)
    rows, columns = np.transpose(_VOIGT)
    return np.asarray(turned[:, rows, columns][:, :, rows, columns])


@dataclass(frozen=True)
class CellMesh:
    """Nodes and cells of one kind.

    Attributes
    ----------
    kind : ElementKind
        Kind of the cells.
    points : (nn, 3)
        Places of the nodes.
    cells : (nc, k)
        Nodes of each cell, by their places in `points`.
    """

    kind: ElementKind
    points: FloatArray
    cells: IntArray

    @property
    def unknowns(self) -> int:
        """Number of displacements, three for each node; that of a component is 3 node + component."""
        return 3 * len(self.points)

    @cached_property
    def nodes(self) -> FloatArray:
        """Places (nc, k, 3) [m] of the nodes of each cell."""
        return self.points[self.cells]

    @property
    def corners(self) -> FloatArray:
        """Places (nc, c, 3) [m] of the corners of each cell."""
        return self.nodes[:, : len(self.kind.corners)]

    @cached_property
    def centres(self) -> FloatArray:
        """Mean (nc, 3) [m] of the corners of each cell."""
        return np.asarray(self.corners.mean(axis=1))

    @cached_property
    def outer_faces(self) -> tuple[IntArray, IntArray, IntArray]:
        """Faces (m,) of one cell alone, as cell and number in it, and their corners (m, 4).

        The corners rise; -1 stands before those of a triangle.
        """
        faces = []
        for face in self.kind.faces:
            corners = np.sort(self.cells[:, list(face)], axis=1)
            faces.append(np.pad(corners, ((0, 0), (4 - len(face), 0)), constant_values=-1))
        every = np.vstack(faces)
        _, first, count = np.unique(every, axis=0, return_index=True, return_counts=True)
        chosen = np.sort(first[count == 1])
        number, cell = np.divmod(chosen, len(self.cells))
        return cell, number, every[chosen]

    def unknowns_of(self, cells: IntArray, components: int = 3) -> IntArray:
        """Unknowns (n, components k) of cells (n,)."""
        own = components * self.cells[cells][:, :, None] + np.arange(components)
        return np.asarray(own.reshape(len(cells), -1))

    def positions(self, cells: IntArray, local: FloatArray) -> FloatArray:
        """Places (n, q, 3) of local places (q, 3) in cells (n,)."""
        values, _ = self.kind.shape_functions(local)
        return np.asarray(np.einsum("qa,nai->nqi", values, self.nodes[cells]))

    def jacobians_at(self, cells: IntArray, local: FloatArray) -> FloatArray:
        """Jacobians dx_i/dX_j (p, 3, 3) at one local place (p, 3) of each of p cells (p,)."""
        return np.asarray(np.einsum("pai,paj->pij", self.nodes[cells], self.kind.shape_functions(local)[1]))

    def strains(self, displacement: FloatArray, local: FloatArray | None = None) -> FloatArray:
        """Strains (nc, q, 6) xx, yy, zz, yz, xz, xy, shear as engineering strain.

        Parameters
        ----------
        displacement : (nodes, 3) m
            Of all nodes.
        local : (q, 3), optional
            Local places in the cells; by default their centre.
        """
        places = np.mean(self.kind.corners, axis=0)[None] if local is None else local
        slopes, _ = gradients(self.kind, self.nodes, places)
        moved = displacement[self.cells].reshape(len(slopes), -1)
        return np.asarray(np.einsum("nqij,nj->nqi", strain_matrix(slopes), moved))

    def strain_rows(
        self, owner: ArrayLike, share: ArrayLike, cells: IntArray, local: FloatArray, direction: FloatArray
    ) -> sparse.csr_array:
        """Strains as rows on the displacements, csr (rows, unknowns) [1/m]: sums of p strains at places.

        Parameters
        ----------
        owner, share : (p,)
            Row that each strain is part of, all rows from 0 on, and times what.
        cells, local : (p,), (p, 3)
            A cell, and a local place in it.
        direction : (p, 3)
            Unit vectors along which the strain is.
        """
        _, slopes = self.kind.shape_functions(local)
        inverse = np.linalg.inv(self.jacobians_at(cells, local))
        slope = np.asarray(share)[:, None] * np.einsum("pai,pij,pj->pa", slopes, inverse, direction)
        values = slope[:, :, None] * direction[:, None, :]
        rows = np.repeat(owner, 3 * self.kind.node_count)
        places = (rows, self.unknowns_of(cells).ravel())
        shape = (int(rows.max(initial=-1)) + 1, self.unknowns)
        return sparse.coo_array((values.ravel(), places), shape).tocsr()

    def stiffness(
        self, cells: IntArray, elasticity: FloatArray, factor: FloatArray | float = 1.0
    ) -> sparse.csr_array:
        """Stiffness, csr (unknowns, unknowns) [N/m], of cells (n,); the rest as of `stiffness_blocks`."""
        points = len(self.kind.stiffness_rule[1])
        moduli = np.broadcast_to(elasticity, (len(cells), 6, 6))
        factors = np.broadcast_to(factor, (len(cells), points))
        return self._assembled(3, partial(stiffness_blocks, self.kind), cells, moduli, factors)

    def mass(self, cells: IntArray, density: ArrayLike, rule: Rule | None = None) -> sparse.csr_array:
        """Mass, csr (nodes, nodes) [kg], of one component of cells (n,) with density (n,) [kg/m^3]."""
        blocks = partial(mass_blocks, self.kind, rule=rule or self.kind.mass_rule)
        return self._assembled(1, blocks, cells, np.broadcast_to(density, len(cells)))

    def _assembled(
        self, components: int, blocks: Callable[..., FloatArray], cells: IntArray, *values: FloatArray
    ) -> sparse.csr_array:
        """Sum the arrays that `blocks` makes of the nodes of cells (n,), and of values (n, ...) of each."""
        size = components * len(self.points)
        total = sparse.csr_array((size, size))
        together = max(BATCH, _TRIPLETS // (components * self.kind.node_count) ** 2)
        for start in range(0, len(cells), together):
            last = min(start + together, len(cells))
            unknowns = self.unknowns_of(cells[start:last], components).astype(np.int32)
            width = unknowns.shape[1]
            parts = (slice(first, min(first + BATCH, last)) for first in range(start, last, BATCH))
            entries = [blocks(self.nodes[cells[part]], *(own[part] for own in values)) for part in parts]
            places = (np.repeat(unknowns, width, axis=1).ravel(), np.tile(unknowns, (1, width)).ravel())
            summed = sparse.coo_array((np.concatenate(entries).ravel(), places), shape=total.shape)
            total = total + summed.tocsr()
        return total


def hexahedra_20(points: FloatArray, cells: IntArray) -> CellMesh:
    """20-node hexahedra of vertices (nv, 3) and cells (nc, 8); the middles of edges follow the vertices."""
    ends = np.sort(cells[:, np.array(HEXAHEDRA_20.edges)], axis=2)
    edges, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middles = len(points) + number.reshape(len(cells), -1)
    return CellMesh(
        HEXAHEDRA_20, np.vstack((points, points[edges].mean(axis=1))), np.hstack((cells, middles))
    )
