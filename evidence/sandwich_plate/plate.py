"""A shear-flexible sandwich plate of 9-node quadrilaterals: faces at a height, a core between them.

The five fields are displacements u, v of the middle plane, rotations a, b and the deflection w. A
point at height z moves by (u + z a, v + z b, w). A face is a membrane on its true, inclined surface
z(x, y). Its strains in the directions of the plan are those of E. Reissner and R. D. Mindlin with
terms of the slope,

    E_xx   = u_x + z a_x + z_x g_x,                 g_x = a + w_x,
    E_yy   = v_y + z b_y + z_y g_y,                 g_y = b + w_y,
    2 E_xy = u_y + v_x + z (a_y + b_x) + z_y g_x + z_x g_y,

turned into axes of the surface. Through the terms of the slope, inclined faces carry a fraction of
the shear force. scikit-fem gives element, mapping and numbering; each field is one of its
`ElementQuad2`.

References
----------
R. D. Mindlin, "Influence of rotatory inertia and shear on flexural motions of isotropic, elastic
plates", Journal of Applied Mechanics 18 (1951).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skfem import Basis, ElementQuad2, MeshQuad

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FIELDS: tuple[str, ...] = ("u", "v", "a", "b", "w")
U, V, A, B, W = range(len(FIELDS))
NODES = 9
CELL_UNKNOWNS = len(FIELDS) * NODES
_ORDER = 7  # exact for polynomials of this degree; sections and metrics are no polynomials


class Shapes(NamedTuple):
    """Shape functions of an element at some points; arrays (..., 9).

    Attributes
    ----------
    values : (..., 9) array
        Values of the shape functions.
    slope_x, slope_y : (..., 9) arrays
        Derivatives of the shape functions along x and y [1/m].
    """

    values: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray

    def in_cells(self, cells: IntArray) -> "Shapes":
        """Return the shape functions in chosen cells (c,); the first axis is that of cells."""
        return Shapes(self.values[cells], self.slope_x[cells], self.slope_y[cells])


class PointShapes(NamedTuple):
    """Unknowns and shape functions of the cells in which points lie.

    Attributes
    ----------
    unknowns : (p, 45) array
        Numbers of the unknowns of the cell of each point, field by field.
    shapes : Shapes
        Shape functions at the points, arrays (p, 9).
    """

    unknowns: IntArray
    shapes: Shapes


@dataclass(frozen=True)
class Surface:
    """Height and slopes of a face at points of the plan, arrays of one shape.

    Attributes
    ----------
    height : (...,) array
        Height z [m].
    slope_x, slope_y : (...,) arrays
        Derivatives of z along x and y [1].
    """

    height: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray

    @property
    def area_ratio(self) -> FloatArray:
        """Area (...,) of the surface over that of its plan."""
        return np.asarray(np.sqrt(1.0 + self.slope_x**2 + self.slope_y**2))

    def strain_on_surface(self, strain: FloatArray) -> FloatArray:
        """Return strains (..., 3, n) in the axes of the surface.

        The first axis lies in the plane y = constant.

        Parameters
        ----------
        strain : (..., 3, n) array
            Strains E_xx, E_yy, 2 E_xy in the directions of the plan.
        """
        along = np.sqrt(1.0 + self.slope_x**2)
        across = self.area_ratio
        # Unit vectors of the surface in the plan: (first, 0) and (mixed, second)
        first = 1.0 / along
        mixed = -self.slope_x * self.slope_y / (along * across)
        second = along / across
        zero = np.zeros_like(first)
        rotation = _matrices(
            [
                [first**2, zero, zero],
                [mixed**2, second**2, mixed * second],
                [2.0 * first * mixed, zero, first * second],
            ]
        )
        return np.asarray(rotation @ strain)


def _matrices(rows: Sequence[Sequence[FloatArray]]) -> FloatArray:
    """Return matrices (..., r, c) from their entries (...,), given row by row."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def plane_stress(
    young_modulus: FloatArray, poisson_ratio: float, shear_modulus: FloatArray
) -> FloatArray:
    """Return the elasticity (..., 3, 3) [Pa] of a sheet in plane stress.

    Parameters
    ----------
    young_modulus : (...,) array
        Young's modulus [Pa], equal in both directions.
    poisson_ratio : float
        Poisson's ratio.
    shear_modulus : (...,) array
        Shear modulus [Pa].
    """
    direct = np.asarray(young_modulus) / (1.0 - poisson_ratio**2)
    coupling = poisson_ratio * direct
    zero = np.zeros_like(direct)
    shear = zero + shear_modulus
    return _matrices([[direct, coupling, zero], [coupling, direct, zero], [zero, zero, shear]])


@dataclass(frozen=True)
class Plate:
    """Five fields of 9-node quadrilaterals on a mesh of the plan, with N nodes.

    Field f of node n is unknown f N + n.

    Attributes
    ----------
    mesh : skfem.MeshQuad
        Mesh of the plan.
    """

    mesh: MeshQuad

    @cached_property
    def _basis(self) -> Basis:
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
    def every_cell(self) -> IntArray:
        """Numbers of all cells."""
        return np.arange(self.mesh.nelements)

    @property
    def node_points(self) -> FloatArray:
        """Positions (N, 2) of the nodes [m]."""
        return np.asarray(self._basis.doflocs.T)

    @cached_property
    def points(self) -> FloatArray:
        """Positions (cells, q, 2) of the integration points [m]."""
        return np.moveaxis(np.asarray(self._basis.global_coordinates()), 0, -1)

    @property
    def span_distance(self) -> FloatArray:
        """Distances y (cells, q) of the integration points along the span [m]."""
        _, distance = np.moveaxis(self.points, -1, 0)
        return np.asarray(distance)

    @cached_property
    def weights(self) -> FloatArray:
        """Areas (cells, q) of the integration points [m^2]."""
        return np.asarray(self._basis.dx)

    def no_stiffness(self) -> sparse.csr_array:
        """Return a zero matrix (5 N, 5 N)."""
        return sparse.csr_array((self.unknowns, self.unknowns))

    @cached_property
    def _cell_unknowns(self) -> IntArray:
        """Numbers (cells, 45) of the unknowns of each cell, field by field."""
        nodes = np.asarray(self._basis.element_dofs.T, dtype=np.int64)
        return np.concatenate([nodes + field * self.nodes for field in range(len(FIELDS))], axis=1)

    @cached_property
    def _shapes(self) -> Shapes:
        """Shape functions at the integration points, arrays (cells, q, 9)."""
        values = []
        slopes_x = []
        slopes_y = []
        for functions in self._basis.basis:
            (shape_function,) = functions
            slope_x, slope_y = shape_function.grad
            values.append(np.broadcast_to(np.asarray(shape_function), self.weights.shape))
            slopes_x.append(slope_x)
            slopes_y.append(slope_y)
        return Shapes(
            np.stack(values, axis=-1), np.stack(slopes_x, axis=-1), np.stack(slopes_y, axis=-1)
        )

    def _assembled(self, blocks: FloatArray, cells: IntArray) -> sparse.csr_array:
        """Return the sum (5 N, 5 N) of the blocks (c, 45, 45) of cells (c,), made symmetric."""
        unknowns = self._cell_unknowns[cells]
        rows = np.repeat(unknowns, CELL_UNKNOWNS, axis=1).ravel()
        columns = np.tile(unknowns, (1, CELL_UNKNOWNS)).ravel()
        symmetric = 0.5 * (blocks + np.swapaxes(blocks, 1, 2))
        return sparse.coo_array(
            (symmetric.ravel(), (rows, columns)), shape=(self.unknowns, self.unknowns)
        ).tocsr()

    def _strain_stiffness(
        self, cells: IntArray, strain: FloatArray, elasticity: FloatArray, weights: FloatArray
    ) -> sparse.csr_array:
        """Return the stiffness (5 N, 5 N) of s strains.

        Parameters
        ----------
        cells : (c,) array
            Numbers of the cells.
        strain : (c, q, s, 45) array
            Strains at the integration points.
        elasticity : (c, q, s, s) array
            Elasticity that belongs to the strains.
        weights : (c, q) array
            Weights of the integration points.
        """
        cell_count, point_count, strain_count, unknown_count = strain.shape
        row_count = point_count * strain_count
        stress = (elasticity @ strain) * weights[..., np.newaxis, np.newaxis]
        stress_rows = stress.reshape(cell_count, row_count, unknown_count)
        strain_rows = strain.reshape(cell_count, row_count, unknown_count)
        return self._assembled(strain_rows.swapaxes(1, 2) @ stress_rows, cells)

    def face_stiffness(
        self, cells: IntArray, surface: Surface, thickness: float, elasticity: FloatArray
    ) -> sparse.csr_array:
        """Return the stiffness (5 N, 5 N) of a face.

        Parameters
        ----------
        cells : (c,) array
            Cells that have the face.
        surface : Surface
            Middle surface of the face at the integration points (c, q).
        thickness : float
            Thickness across the surface [m].
        elasticity : (c, q, 3, 3) array
            Elasticity in the axes of the surface [Pa].
        """
        strain = surface.strain_on_surface(surface_strain(surface, self._shapes.in_cells(cells)))
        weights = self.weights[cells] * surface.area_ratio * thickness
        return self._strain_stiffness(cells, strain, elasticity, weights)

    def core_stiffness(
        self, cells: IntArray, half_height: FloatArray, elasticity: FloatArray, shear: FloatArray
    ) -> sparse.csr_array:
        """Return the stiffness (5 N, 5 N) of a solid core.

        Parameters
        ----------
        cells : (c,) array
            Cells that have the core.
        half_height : (c, q) array
            Height of the core above and below the middle plane [m].
        elasticity : (c, q, 3, 3) array
            Elasticity in the plan, in plane stress [Pa].
        shear : (c, q, 2) array
            Shear moduli x-z and y-z [Pa].
        """
        shapes = self._shapes.in_cells(cells)
        zero = np.zeros_like(half_height)
        middle_plane = Surface(zero, zero, zero)
        plane_at_one = Surface(zero + 1.0, zero, zero)
        membrane = surface_strain(middle_plane, shapes)
        bending = surface_strain(plane_at_one, shapes) - membrane
        sliding = shear_strain(shapes)
        shear_elasticity = shear[..., np.newaxis] * np.eye(2)
        weights = self.weights[cells] * 2.0 * half_height
        bending_weights = weights * half_height**2 / 3.0
        return (
            self._strain_stiffness(cells, membrane, elasticity, weights)
            + self._strain_stiffness(cells, bending, elasticity, bending_weights)
            + self._strain_stiffness(cells, sliding, shear_elasticity, weights)
        ).tocsr()

    def mass(
        self, cells: IntArray, translation: FloatArray, rotation: FloatArray
    ) -> sparse.csr_array:
        """Return the mass (5 N, 5 N) of cells.

        Parameters
        ----------
        cells : (c,) array
            Numbers of the cells.
        translation : (c, q) array
            Mass per area of the plan [kg/m^2].
        rotation : (c, q) array
            Rotary inertia per area of the plan [kg].
        """
        values = self._shapes.values[cells]
        density_of_field: Mapping[int, FloatArray] = {
            U: translation,
            V: translation,
            A: rotation,
            B: rotation,
            W: translation,
        }
        blocks = np.zeros((len(cells), len(FIELDS), NODES, len(FIELDS), NODES))
        for field, density in density_of_field.items():
            scaled = values * (self.weights[cells] * density)[..., np.newaxis]
            blocks[:, field, :, field, :] = values.swapaxes(1, 2) @ scaled
        return self._assembled(blocks.reshape(len(cells), CELL_UNKNOWNS, CELL_UNKNOWNS), cells)

    def load(self, field: int, pressure: FloatArray) -> FloatArray:
        """Return the load (5 N,) [N] of a pressure (cells, q) [Pa] in the direction of a field."""
        load = np.zeros(self.unknowns)
        node_loads = np.einsum("cq,cqn->cn", pressure * self.weights, self._shapes.values)
        unknowns = self._cell_unknowns[:, field * NODES : (field + 1) * NODES]
        np.add.at(load, unknowns, node_loads)
        return load

    def at(self, positions: FloatArray) -> PointShapes:
        """Return unknowns and shape functions at positions (p, 2) [m]."""
        mapping = self._basis.mapping
        x, y = positions.T
        cells = self.mesh.element_finder(mapping=mapping)(x, y)
        local = mapping.invF(positions.T[..., np.newaxis], tind=cells)
        values = []
        slopes_x = []
        slopes_y = []
        for node in range(NODES):
            (shape_function,) = ElementQuad2().gbasis(mapping, local, node, tind=cells)
            slope_x, slope_y = shape_function.grad
            value = np.broadcast_to(np.asarray(shape_function), (len(positions), 1))
            values.append(value.ravel())
            slopes_x.append(slope_x.ravel())
            slopes_y.append(slope_y.ravel())
        shapes = Shapes(
            np.stack(values, axis=-1), np.stack(slopes_x, axis=-1), np.stack(slopes_y, axis=-1)
        )
        return PointShapes(self._cell_unknowns[cells], shapes)


def surface_strain(surface: Surface, shapes: Shapes) -> FloatArray:
    """Return the strains E_xx, E_yy, 2 E_xy (..., 3, 45) of a surface (...,) in the plan.

    Parameters
    ----------
    surface : Surface
        Height and slopes at some points.
    shapes : Shapes
        Shape functions at the same points.
    """
    values, d_x, d_y = shapes
    z = surface.height[..., np.newaxis]
    z_x = surface.slope_x[..., np.newaxis]
    z_y = surface.slope_y[..., np.newaxis]
    zero = np.zeros_like(values)
    strain_of_field: Mapping[int, Sequence[FloatArray]] = {
        U: (d_x, zero, d_y),
        V: (zero, d_y, d_x),
        A: (z * d_x + z_x * values, zero, z * d_y + z_y * values),
        B: (zero, z * d_y + z_y * values, z * d_x + z_x * values),
        W: (z_x * d_x, z_y * d_y, z_y * d_x + z_x * d_y),
    }
    return _strain_matrix(strain_of_field)


def shear_strain(shapes: Shapes) -> FloatArray:
    """Return the transverse shear strains g_x, g_y (..., 2, 45) from shape functions (..., 9)."""
    values, d_x, d_y = shapes
    zero = np.zeros_like(values)
    strain_of_field: Mapping[int, Sequence[FloatArray]] = {
        U: (zero, zero),
        V: (zero, zero),
        A: (values, zero),
        B: (zero, values),
        W: (d_x, d_y),
    }
    return _strain_matrix(strain_of_field)


def _strain_matrix(strain_of_field: Mapping[int, Sequence[FloatArray]]) -> FloatArray:
    """Return strains (..., s, 45) from the contributions of each field, s arrays (..., 9)."""
    in_order = [strain_of_field[field] for field in range(len(FIELDS))]
    return np.concatenate([np.stack(rows, axis=-2) for rows in in_order], axis=-1)


def tensor_mesh(columns: int, rows: int) -> MeshQuad:
    """Return a mesh of unit squares, whose positions are indices of the grid.

    Parameters
    ----------
    columns, rows : int
        Number of squares along x and along y.
    """
    return MeshQuad.init_tensor(np.arange(columns + 1.0), np.arange(rows + 1.0))
