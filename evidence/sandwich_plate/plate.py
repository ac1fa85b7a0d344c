"""A shear-flexible sandwich plate of 9-node quadrilaterals: faces at a height, a core between them.

The five fields are displacements u, v of the middle plane, rotations a, b and the deflection w; a point at
height z moves by (u + z a, v + z b, w). A face is a membrane on its true, inclined surface z(x, y). Its
strains in the plan's directions are those of E. Reissner and R. D. Mindlin with the terms of the slope,

    E_xx   = u_x + z a_x + z_x g_x,                 g_x = a + w_x,
    E_yy   = v_y + z b_y + z_y g_y,                 g_y = b + w_y,
    2 E_xy = u_y + v_x + z (a_y + b_x) + z_y g_x + z_x g_y,

turned into axes of its own. The slope terms are what lets inclined faces carry part of the shear force.
scikit-fem gives element, mapping and numbering; each field is one of its `ElementQuad2`.

References
----------
R. D. Mindlin, "Influence of rotatory inertia and shear on flexural motions of isotropic, elastic plates",
Journal of Applied Mechanics 18 (1951).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skfem import Basis, ElementQuad2, MeshQuad

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FIELDS: tuple[str, ...] = ("u", "v", "a", "b", "w")
NODES = 9
_ORDER = 7  # exact for polynomials of this degree; sections and metrics are no polynomials
U, V, A, B, W = range(5)


@dataclass(frozen=True)
class Surface:
    """A face's height and slopes at points of the plan, any common shape.

    Attributes
    ----------
    height : (...,)
        z [m].
    slope_x, slope_y : (...,)
        Derivatives of z [1].
    """

    height: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray

    @property
    def area_ratio(self) -> FloatArray:
        """Area (...,) of the surface over that of its plan."""
        return np.asarray(np.sqrt(1.0 + self.slope_x**2 + self.slope_y**2))

    def turned(self, strain: FloatArray) -> FloatArray:
        """Strains (..., 3, n) in the surface's axes, from those in the plan's (..., 3, n).

        The first axis lies in the plane y = constant.
        """
        along, across = np.sqrt(1.0 + self.slope_x**2), self.area_ratio
        first, mixed, second = 1.0 / along, -self.slope_x * self.slope_y / (along * across), along / across
        turn = np.zeros((*along.shape, 3, 3))
        turn[..., 0, 0] = first**2
        turn[..., 1, 0], turn[..., 1, 1], turn[..., 1, 2] = mixed**2, second**2, mixed * second
        turn[..., 2, 0], turn[..., 2, 2] = 2.0 * first * mixed, first * second
        return np.asarray(turn @ strain)


def plane_stress(young_modulus: FloatArray, poisson_ratio: float, shear_modulus: FloatArray) -> FloatArray:
    """Elasticity (..., 3, 3) [Pa] of a sheet with equal Young's moduli, from moduli (...,) [Pa]."""
    factor = np.asarray(young_modulus) / (1.0 - poisson_ratio**2)
    found = np.zeros((*factor.shape, 3, 3))
    found[..., 0, 0] = found[..., 1, 1] = factor
    found[..., 0, 1] = found[..., 1, 0] = poisson_ratio * factor
    found[..., 2, 2] = shear_modulus
    return found


@dataclass(frozen=True)
class Plate:
    """Five fields of 9-node quadrilaterals on a mesh of the plan; field f of node n is unknown f N + n.

    Attributes
    ----------
    mesh : skfem.MeshQuad
        Mesh of the plan.
    """

    mesh: Any

    @cached_property
    def _basis(self) -> Any:
        return Basis(self.mesh, ElementQuad2(), intorder=_ORDER)

    @property
    def nodes(self) -> int:
        """Number N of nodes."""
        return int(self._basis.N)

    @property
    def unknowns(self) -> int:
        """Number 5 N of unknowns."""
        return len(FIELDS) * self.nodes

    @property
    def node_points(self) -> FloatArray:
        """Places (N, 2) of the nodes [m]."""
        return np.asarray(self._basis.doflocs.T)

    @cached_property
    def points(self) -> FloatArray:
        """Places (cells, q, 2) of the integration points [m]."""
        return np.moveaxis(np.asarray(self._basis.global_coordinates()), 0, -1)

    @cached_property
    def weights(self) -> FloatArray:
        """Areas (cells, q) that the integration points stand for [m^2]."""
        return np.asarray(self._basis.dx)

    @cached_property
    def _cell_dofs(self) -> IntArray:
        nodes = np.asarray(self._basis.element_dofs.T, dtype=np.int64)
        return np.concatenate([nodes + field * self.nodes for field in range(len(FIELDS))], axis=1)

    @cached_property
    def _shapes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values and x- and y-derivatives (cells, q, 9) of the shape functions at the integration points."""
        shape = self.weights.shape
        values = [np.broadcast_to(np.asarray(self._basis.basis[n][0]), shape) for n in range(NODES)]
        slopes = [self._basis.basis[n][0].grad for n in range(NODES)]
        return (
            np.stack(values, axis=-1),
            np.stack([slope[0] for slope in slopes], axis=-1),
            np.stack([slope[1] for slope in slopes], axis=-1),
        )

    def _assembled(self, blocks: FloatArray, cells: IntArray) -> sparse.csr_array:
        dofs = self._cell_dofs[cells]
        rows = np.repeat(dofs, dofs.shape[1], axis=1).ravel()
        columns = np.tile(dofs, (1, dofs.shape[1])).ravel()
        blocks = 0.5 * (blocks + np.swapaxes(blocks, 1, 2))
        return sparse.coo_array((blocks.ravel(), (rows, columns)), shape=(self.unknowns,) * 2).tocsr()

    def _contracted(
        self, cells: IntArray, strain: FloatArray, elasticity: FloatArray, weights: FloatArray
    ) -> sparse.csr_array:
        """Stiffness of strains (c, q, s, 45) with elasticity (c, q, s, s) and weights (c, q)."""
        count, points, rows, columns = strain.shape
        stress = (elasticity @ strain) * weights[..., None, None]
        left = strain.reshape(count, points * rows, columns).swapaxes(1, 2)
        return self._assembled(left @ stress.reshape(count, points * rows, columns), cells)

    def face_stiffness(
        self, cells: IntArray, surface: Surface, thickness: float, elasticity: FloatArray
    ) -> sparse.csr_array:
        """Stiffness (5 N, 5 N) of a face.

        Parameters
        ----------
        cells : (c,)
            Cells that have the face.
        surface : Surface
            Its middle surface at their integration points (c, q).
        thickness : float
            Across the surface [m].
        elasticity : (c, q, 3, 3)
            In the surface's axes [Pa].
        """
        strain = surface.turned(surface_strain(surface, *(part[cells] for part in self._shapes)))
        weights = self.weights[cells] * surface.area_ratio * thickness
        return self._contracted(cells, strain, elasticity, weights)

    def core_stiffness(
        self, cells: IntArray, half_height: FloatArray, elasticity: FloatArray, shear: FloatArray
    ) -> sparse.csr_array:
        """Stiffness (5 N, 5 N) of a solid core.

        Parameters
        ----------
        cells : (c,)
            Cells that have the core.
        half_height : (c, q)
            It reaches from minus to plus this height [m].
        elasticity : (c, q, 3, 3)
            In the plan, in plane stress [Pa].
        shear : (c, q, 2)
            Shear moduli x-z and y-z [Pa].
        """
        values, slope_x, slope_y = (part[cells] for part in self._shapes)
        flat = np.zeros_like(half_height)
        membrane = surface_strain(Surface(flat, flat, flat), values, slope_x, slope_y)
        bending = surface_strain(Surface(flat + 1.0, flat, flat), values, slope_x, slope_y) - membrane
        sliding = shear_strain(values, slope_x, slope_y)
        weights = self.weights[cells] * 2.0 * half_height
        diagonal = shear[..., None] * np.eye(2)
        return (
            self._contracted(cells, membrane, elasticity, weights)
            + self._contracted(cells, bending, elasticity, weights * half_height**2 / 3.0)
            + self._contracted(cells, sliding, diagonal, weights)
        ).tocsr()

    def mass(self, cells: IntArray, translation: FloatArray, rotation: FloatArray) -> sparse.csr_array:
        """Mass (5 N, 5 N) of cells with mass (c, q) [kg/m^2] and rotary inertia (c, q) [kg] per area."""
        values = self._shapes[0][cells]
        blocks = np.zeros((len(cells), len(FIELDS), NODES, len(FIELDS), NODES))
        for fields, density in (((U, V, W), translation), ((A, B), rotation)):
            scaled = values * (self.weights[cells] * density)[..., None]
            product = values.swapaxes(1, 2) @ scaled
            for field in fields:
                blocks[:, field, :, field, :] = product
        side = len(FIELDS) * NODES
        return self._assembled(blocks.reshape(len(cells), side, side), cells)

    def load(self, field: int, pressure: FloatArray) -> FloatArray:
        """Load (5 N,) [N] of a pressure (cells, q) [Pa] in the direction of a field."""
        found = np.zeros(self.unknowns)
        shares = np.einsum("cq,cqn->cn", pressure * self.weights, self._shapes[0])
        np.add.at(found, self._cell_dofs[:, field * NODES : (field + 1) * NODES], shares)
        return found

    def at(self, places: FloatArray) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Unknowns (p, 45), shape functions and their x- and y-derivatives (p, 9) at places (p, 2)."""
        mesh, mapping = self.mesh, self._basis.mapping
        cells = mesh.element_finder(mapping=mapping)(*places.T)
        local = mapping.invF(places.T[:, :, None], tind=cells)
        parts = [ElementQuad2().gbasis(mapping, local, n, tind=cells)[0] for n in range(NODES)]
        values = np.stack(
            [np.broadcast_to(np.asarray(part), (len(places), 1))[:, 0] for part in parts], axis=-1
        )
        slopes = [np.stack([part.grad[k][:, 0] for part in parts], axis=-1) for k in range(2)]
        return self._cell_dofs[cells], values, slopes[0], slopes[1]


def surface_strain(
    surface: Surface, values: FloatArray, slope_x: FloatArray, slope_y: FloatArray
) -> FloatArray:
    """Strains (..., 3, 45) E_xx, E_yy, 2 E_xy of a surface (...,), from shape functions (..., 9)."""
    strain = np.zeros((*values.shape[:-1], 3, len(FIELDS), NODES))
    z, z_x, z_y = (part[..., None] for part in (surface.height, surface.slope_x, surface.slope_y))
    strain[..., 0, U, :] = strain[..., 2, V, :] = slope_x
    strain[..., 1, V, :] = strain[..., 2, U, :] = slope_y
    strain[..., 0, A, :] = z * slope_x + z_x * values
    strain[..., 1, B, :] = z * slope_y + z_y * values
    strain[..., 2, A, :] = z * slope_y + z_y * values
    strain[..., 2, B, :] = z * slope_x + z_x * values
    strain[..., 0, W, :] = z_x * slope_x
    strain[..., 1, W, :] = z_y * slope_y
    strain[..., 2, W, :] = z_y * slope_x + z_x * slope_y
    return strain.reshape(*values.shape[:-1], 3, len(FIELDS) * NODES)


def shear_strain(values: FloatArray, slope_x: FloatArray, slope_y: FloatArray) -> FloatArray:
    """Transverse shear strains (..., 2, 45) g_x, g_y, from shape functions (..., 9)."""
    strain = np.zeros((*values.shape[:-1], 2, len(FIELDS), NODES))
    strain[..., 0, A, :] = strain[..., 1, B, :] = values
    strain[..., 0, W, :], strain[..., 1, W, :] = slope_x, slope_y
    return strain.reshape(*values.shape[:-1], 2, len(FIELDS) * NODES)


def tensor_mesh(columns: int, rows: int) -> Any:
    """Mesh of unit squares, (columns, rows) of them: cell and node places are indices of the grid."""
    return MeshQuad.init_tensor(np.arange(columns + 1.0), np.arange(rows + 1.0))
