"""Element arrays of 20-node hexahedra, contracted in batches, and their assembly.

The element is scikit-fem's `ElementHexS2` on straight-edged cells; scikit-fem numbers the degrees of
freedom, the element arrays are contracted here for many cells at once, which is an order of magnitude
faster than one bilinear form after the other. Strains are in Voigt order 11, 22, 33, 23, 13, 12 with
engineering shear strains.
"""

import itertools
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skfem import ElementHexS2, ElementVector, MeshHex
from skfem.assembly.dofs import Dofs

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NODES = 20
_VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
_BATCH = 256


def gauss_points(order: int, dimensions: int = 3) -> tuple[FloatArray, FloatArray]:
    """Tensor Gauss rule on the unit cube: points (q, dimensions), weights (q,)."""
    line, weight = np.polynomial.legendre.leggauss(order)
    line, weight = 0.5 * (line + 1.0), 0.5 * weight
    grids = np.meshgrid(*([line] * dimensions), indexing="ij")
    weights = np.meshgrid(*([weight] * dimensions), indexing="ij")
    return np.stack([g.ravel() for g in grids], axis=1), np.asarray(
        np.prod([w.ravel() for w in weights], axis=0)
    )


@cache
def _monomials() -> tuple[IntArray, FloatArray]:
    """Exponents (20, 3) of the element's monomials and their coefficients (20, 20) in its shape functions.

    The space is that of D. N. Arnold and G. Awanou, "The serendipity family of finite elements" (2011):
    monomials whose degree, factors of degree one not counted, is at most two. Each shape function is one at
    its own node of scikit-fem's `ElementHexS2` and zero at the others.
    """
    every = np.array(list(itertools.product(range(3), repeat=3)))
    exponents = every[np.where(every > 1, every, 0).sum(axis=1) <= 2]
    nodes = np.asarray(ElementHexS2.doflocs, dtype=np.float64)
    coefficients = np.linalg.inv(np.prod(nodes[:, None, :] ** exponents, axis=2))
    return exponents, np.rint(coefficients)  # whole numbers on the unit cube


def shape_functions(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values (q, 20) and local gradients (q, 20, 3) of the shape functions at local points (q, 3)."""
    exponents, coefficients = _monomials()
    powers = np.stack((np.ones_like(local), local, local**2), axis=2)
    slopes = np.stack((np.zeros_like(local), np.ones_like(local), 2.0 * local), axis=2)
    factors = [powers[:, axis, exponents[:, axis]] for axis in range(3)]
    gradients = np.empty((len(local), NODES, 3))
    for axis in range(3):
        first, second = (factors[other] for other in range(3) if other != axis)
        gradients[:, :, axis] = (slopes[:, axis, exponents[:, axis]] * first * second) @ coefficients
    return factors[0] * factors[1] * factors[2] @ coefficients, gradients


def _corner_functions(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Trilinear functions (q, 8) and local gradients (q, 8, 3), in scikit-fem's corner order."""
    corner = MeshHex.elem.refdom.p.T
    factor = np.where(corner[None] > 0.5, local[:, None, :], 1.0 - local[:, None, :])
    sign = np.where(corner > 0.5, 1.0, -1.0)
    values = factor.prod(axis=2)
    gradients = np.empty((len(local), 8, 3))
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        gradients[:, :, axis] = sign[:, axis] * factor[:, :, others].prod(axis=2)
    return values, gradients


def positions(corners: FloatArray, local: FloatArray) -> FloatArray:
    """Places (n, q, 3) of local points (q, 3) in cells with corners (n, 8, 3)."""
    values, _ = _corner_functions(local)
    return np.asarray(np.einsum("qa,nai->nqi", values, corners))


def jacobians(corners: FloatArray, local: FloatArray) -> FloatArray:
    """Jacobians dx_i/dX_j (n, q, 3, 3) at local points (q, 3) in cells with corners (n, 8, 3)."""
    _, gradients = _corner_functions(local)
    return np.asarray(np.einsum("nai,qaj->nqij", corners, gradients))


def point_jacobians(corners: FloatArray, local: FloatArray) -> FloatArray:
    """Jacobians dx_i/dX_j (p, 3, 3) at one local point (p, 3) of each of p cells with corners (p, 8, 3)."""
    _, gradients = _corner_functions(local)
    return np.asarray(np.einsum("pai,paj->pij", corners, gradients))


def global_gradients(corners: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradients (n, q, 20, 3) of the shape functions in space and Jacobian determinants (n, q)."""
    jacobian = jacobians(corners, local)
    _, gradients = shape_functions(local)
    return np.asarray(gradients[None] @ np.linalg.inv(jacobian)), np.asarray(np.linalg.det(jacobian))


def strain_matrix(gradients: FloatArray) -> FloatArray:
    """Strain matrix B (..., 6, 3k) of gradients (..., k, 3); the unknowns of a node are consecutive."""
    nodes = gradients.shape[-2]
    B = np.zeros((*gradients.shape[:-2], 6, nodes, 3))
    for row, (i, j) in enumerate(_VOIGT):
        B[..., row, :, i] += gradients[..., j]
        if i != j:
            B[..., row, :, j] += gradients[..., i]
    return B.reshape(*B.shape[:-2], 3 * nodes)


def orthotropic_elasticity(
    young_modulus: float, poisson_ratio: float, shear_23: float, shear_13: float, shear_12: float
) -> FloatArray:
    """Elasticity (6, 6) [Pa] of a material with equal Young's moduli and free shear moduli."""
    compliance = np.zeros((6, 6))
    compliance[:3, :3] = -poisson_ratio / young_modulus
    compliance[range(3), range(3)] = 1.0 / young_modulus
    compliance[range(3, 6), range(3, 6)] = 1.0 / shear_23, 1.0 / shear_13, 1.0 / shear_12
    return np.asarray(np.linalg.inv(compliance), dtype=np.float64)


def isotropic_elasticity(young_modulus: float, poisson_ratio: float) -> FloatArray:
    """Elasticity (6, 6) [Pa] of an isotropic material."""
    shear = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return orthotropic_elasticity(young_modulus, poisson_ratio, shear, shear, shear)


def cell_axes(corners: FloatArray) -> FloatArray:
    """Local material axes (n, 3, 3): rows chordwise, spanwise and across the surface of the cell."""
    jacobian = jacobians(corners, np.array([[0.5, 0.5, 0.5]]))[:, 0]
    across = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = jacobian[:, :, 1] / np.linalg.norm(jacobian[:, :, 1], axis=1, keepdims=True)
    return np.stack([np.cross(along, across), along, across], axis=1)


def rotate_elasticity(elasticity: FloatArray, axes: FloatArray) -> FloatArray:
    """Elasticity (n, 6, 6) in space of local elasticity (n, 6, 6) in axes (n, 3, 3), rows the local axes."""
    unit = np.zeros((6, 3, 3))
    for row, (i, j) in enumerate(_VOIGT):
        unit[row, i, j] += 0.5 if i != j else 1.0
        unit[row, j, i] += 0.5 if i != j else 0.0
    turned = np.einsum("nai,kij,nbj->nkab", axes, unit, axes)
    transform = np.empty((len(axes), 6, 6))
    for row, (i, j) in enumerate(_VOIGT):
        transform[:, row, :] = turned[:, :, i, j] * (1.0 if i == j else 2.0)
    return np.asarray(np.swapaxes(transform, 1, 2) @ elasticity @ transform)


@dataclass(frozen=True)
class Discretisation:
    """Degrees of freedom of 20-node hexahedra on a mesh.

    Attributes
    ----------
    mesh : skfem.MeshHex
        Mesh with straight edges and positive Jacobians.
    """

    mesh: Any

    @cached_property
    def corners(self) -> FloatArray:
        """Corner coordinates (nc, 8, 3) [m]."""
        return np.asarray(self.mesh.p.T[self.mesh.t.T])

    @cached_property
    def _numbering(self) -> Any:
        return Dofs(self.mesh, ElementVector(ElementHexS2()))

    def moved(self, mesh: Any) -> "Discretisation":
        """Return the same degrees of freedom on a mesh with the same cells and other vertices."""
        other = Discretisation(mesh)
        other.__dict__["_numbering"] = self._numbering  # the cache of `cached_property`
        return other

    @property
    def unknowns(self) -> int:
        """Number of degrees of freedom, three for each node."""
        return int(self._numbering.N)

    @cached_property
    def cell_dofs(self) -> IntArray:
        """Degrees of freedom of each cell (nc, 60); 3 node + component."""
        return np.asarray(self._numbering.element_dofs.T, dtype=np.int64)

    @cached_property
    def cell_nodes(self) -> IntArray:
        """Nodes of each cell (nc, 20)."""
        return self.cell_dofs[:, ::3] // 3

    @cached_property
    def node_points(self) -> FloatArray:
        """Places of the nodes (nn, 3) [m]."""
        points = np.empty((self.unknowns // 3, 3))
        points[self.cell_nodes] = positions(self.corners, ElementHexS2().doflocs)
        return points

    def nodes_of(self, cells: IntArray) -> FloatArray:
        """Places (n, 20, 3) [m] of the nodes of cells (n,)."""
        return positions(self.corners[cells], ElementHexS2().doflocs)

    def stiffness_blocks(
        self, cells: IntArray, elasticity: FloatArray, factor: FloatArray | None = None
    ) -> FloatArray:
        """Element stiffness (n, 60, 60) [N/m] of cells (n,) with elasticity (n, 6, 6) [Pa] in space.

        `factor` (n, 27) scales the elasticity at the points of `gauss_points(3)`; without it, it is one.
        """
        local, weight = gauss_points(3)
        blocks = np.empty((len(cells), 3 * NODES, 3 * NODES))
        for start in range(0, len(cells), _BATCH):
            part = slice(start, start + _BATCH)
            gradients, determinant = global_gradients(self.corners[cells[part]], local)
            B = strain_matrix(gradients)
            measure = weight * determinant if factor is None else weight * determinant * factor[part]
            scaled = (elasticity[part, None] @ B) * measure[..., None, None]
            n, q = determinant.shape
            left = B.reshape(n, q * 6, 3 * NODES).swapaxes(1, 2)
            blocks[part] = left @ scaled.reshape(n, q * 6, 3 * NODES)
        return np.asarray(0.5 * (blocks + blocks.swapaxes(1, 2)))

    def stiffness(
        self, cells: IntArray, elasticity: FloatArray, factor: FloatArray | None = None
    ) -> sparse.csr_array:
        """Stiffness (ndof, ndof) [N/m] of cells (n,), see `stiffness_blocks`."""
        return self._assembled(self.stiffness_blocks(cells, elasticity, factor), self.cell_dofs[cells])

    def mass_blocks(self, cells: IntArray, density: FloatArray) -> FloatArray:
        """Element mass (n, 60, 60) [kg] of cells (n,) with density (n,) [kg/m^3]."""
        local, weight = gauss_points(3)
        values, _ = shape_functions(local)
        determinant = np.linalg.det(jacobians(self.corners[cells], local))
        factor = determinant * weight * density[:, None]
        scalar = np.einsum("nq,qa,qb->nab", factor, values, values, optimize=True)
        blocks = np.zeros((len(cells), NODES, 3, NODES, 3))
        for component in range(3):
            blocks[:, :, component, :, component] = scalar
        return blocks.reshape(len(cells), 3 * NODES, 3 * NODES)

    def mass(self, cells: IntArray, density: FloatArray) -> sparse.csr_array:
        """Consistent mass (ndof, ndof) [kg] of cells (n,) with density (n,) [kg/m^3]."""
        return self._assembled(self.mass_blocks(cells, density), self.cell_dofs[cells])

    def nodal_mass(self, density: FloatArray) -> FloatArray:
        """Share (nn,) [kg] of each node in the mass of all cells with density (nc,) [kg/m^3]: row sums."""
        local, weight = gauss_points(3)
        values, _ = shape_functions(local)
        factor = np.linalg.det(jacobians(self.corners, local)) * weight * density[:, None]
        shares = np.zeros(self.unknowns // 3)
        np.add.at(shares, self.cell_nodes, factor @ values)
        return shares

    def _assembled(self, blocks: FloatArray, dofs: IntArray) -> sparse.csr_array:
        shape = (self.unknowns, self.unknowns)
        rows = np.repeat(dofs.astype(np.int32), dofs.shape[1], axis=1).ravel()
        columns = np.tile(dofs.astype(np.int32), (1, dofs.shape[1])).ravel()
        matrix = sparse.coo_array((blocks.ravel(), (rows, columns)), shape=shape).tocsr()
        matrix.eliminate_zeros()
        return matrix

    def point_values(self, cell: int, local: FloatArray) -> tuple[IntArray, FloatArray]:
        """Nodes (20,) and shape function values (20,) at a local point (3,) of a cell."""
        values, _ = shape_functions(local[None])
        return self.cell_nodes[cell], values[0]

    def strain_along(
        self, cells: IntArray, local: FloatArray, direction: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Unknowns (p, 60) and weights (p, 60) [1/m] of the strain at one point of each of p cells.

        Parameters
        ----------
        cells : (p,)
            The cells.
        local : (p, 3)
            The point of each.
        direction : (p, 3)
            Unit direction of the strain at each.
        """
        _, gradients = shape_functions(local)
        inverse = np.linalg.inv(point_jacobians(self.corners[cells], local))
        slope = np.einsum("pai,pij,pj->pa", gradients, inverse, direction)
        return self.cell_dofs[cells], (slope[:, :, None] * direction[:, None, :]).reshape(len(cells), -1)
