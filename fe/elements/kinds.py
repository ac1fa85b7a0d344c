"""Kinds of finite elements: nodes, faces, shape functions, integration.

Shape functions are the polynomials of scikit-fem's elements of the same name, evaluated at many
points at once. The order of nodes is that of the mesh file, VTK and, for these kinds, Abaqus and
CalculiX. All kinds are isoparametric: the mid-edge nodes of a file bend the edges and faces.
Stiffness is integrated as CalculiX integrates C3D4, C3D8, C3D10 and C3D20. Mass is integrated
exactly on straight cells, while CalculiX integrates it at the points of the stiffness.
"""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import NamedTuple, cast

import numpy as np
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet, RefTri

from fe.runtime.arrays import BoolArray, FloatArray, IntArray


class Rule(NamedTuple):
    """An integration rule of q points on a reference cell or face of d dimensions.

    Attributes
    ----------
    points : (q, d) array
        Local positions of the points.
    weights : (q,) array
        Weights of the points.
    """

    points: FloatArray
    weights: FloatArray


class FaceFrames(NamedTuple):
    """Local frames of the f faces of a reference cell.

    A face is the unit triangle or the unit square between its tangents.

    Attributes
    ----------
    corner : (f, 3) array
        The first corner of each face.
    tangents : (f, 2, 3) array
        From this corner to its two neighbours; their cross product points outwards.
    """

    corner: FloatArray
    tangents: FloatArray


_TETRAHEDRON_CORNERS = (
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
)
_TETRAHEDRON_EDGES = (
    (0, 1),
    (1, 2),
    (2, 0),
    (0, 3),
    (1, 3),
    (2, 3),
)
_TETRAHEDRON_FACES = (
    (0, 1, 2),
    (0, 3, 1),
    (1, 3, 2),
    (2, 3, 0),
)
_HEXAHEDRON_CORNERS = (
    (0, 0, 0),
    (1, 0, 0),
    (1, 1, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 0, 1),
    (1, 1, 1),
    (0, 1, 1),
)
_LOWER_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0))
_UPPER_EDGES = ((4, 5), (5, 6), (6, 7), (7, 4))
_UPRIGHT_EDGES = ((0, 4), (1, 5), (2, 6), (3, 7))
_HEXAHEDRON_EDGES = (*_LOWER_EDGES, *_UPPER_EDGES, *_UPRIGHT_EDGES)
_HEXAHEDRON_FACES = (
    (0, 1, 2, 3),
    (4, 7, 6, 5),
    (0, 4, 5, 1),
    (1, 5, 6, 2),
    (2, 6, 7, 3),
    (3, 7, 4, 0),
)
_WEDGE_CORNERS = (
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 0, 1),
    (0, 1, 1),
)
_WEDGE_EDGES = (
    (0, 1),
    (1, 2),
    (2, 0),
    (3, 4),
    (4, 5),
    (5, 3),
    (0, 3),
    (1, 4),
    (2, 5),
)
_WEDGE_FACES = (
    (0, 1, 2),
    (3, 5, 4),
    (0, 3, 4, 1),
    (1, 4, 5, 2),
    (2, 5, 3, 0),
)

# Exponents of the monomials x^i y^j z^k that span the shape functions.
_POWERS = tuple(itertools.product(range(3), repeat=3))
_LINEAR = tuple(power for power in _POWERS if sum(power) <= 1)
_QUADRATIC = tuple(power for power in _POWERS if sum(power) <= 2)
_TRILINEAR = tuple(power for power in _POWERS if max(power) <= 1)
# D. N. Arnold and G. Awanou (2011): degree at most two, factors of degree one not counted.
_SERENDIPITY = tuple(power for power in _POWERS if sum(p for p in power if p > 1) <= 2)
_PRISMATIC = tuple((i, j, k) for i, j, k in _POWERS if i + j <= 1 and k <= 1)
# Quadratic in the triangle and linear along the prism, or the other way round.
_PRISMATIC_QUADRATIC = tuple((i, j, k) for i, j, k in _POWERS if i + j + k // 2 <= 2)


def gauss_points(order: int, dimensions: int = 3) -> Rule:
    """Return the tensor-product Gauss rule on the unit cube, `order` points along each axis."""
    roots, root_weights = np.polynomial.legendre.leggauss(order)
    line_points = 0.5 * (roots + 1.0)
    line_weights = 0.5 * root_weights
    points = list(itertools.product(line_points, repeat=dimensions))
    factors = list(itertools.product(line_weights, repeat=dimensions))
    weights = np.array(factors).prod(axis=1)
    return Rule(np.array(points), weights)


def _simplex_rule(cell: type[RefTet] | type[RefTri], order: int) -> Rule:
    """Return scikit-fem's rule on a simplex that is exact for polynomials of an order."""
    points, weights = get_quadrature(cell, order)
    return Rule(np.ascontiguousarray(points.T), np.asarray(weights))


def _wedge_rule(triangle_order: int, line_order: int) -> Rule:
    """Return the product of a rule on the triangle and a Gauss rule along the wedge."""
    triangle = _simplex_rule(RefTri, triangle_order)
    line = gauss_points(line_order, dimensions=1)
    points = []
    for (height,), position in itertools.product(line.points, triangle.points):
        points.append((*position, height))
    weights = np.outer(line.weights, triangle.weights)
    return Rule(np.array(points), weights.ravel())


def _powers_and_slopes(
    coordinate: FloatArray, exponents: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return powers (q, k) of a coordinate (q,), and their derivatives.

    The exponents (k,) are at most two.
    """
    zero = np.zeros_like(coordinate)
    one = np.ones_like(coordinate)
    powers = np.stack((one, coordinate, coordinate**2), axis=1)
    slopes = np.stack((zero, one, 2.0 * coordinate), axis=1)
    return powers[:, exponents], slopes[:, exponents]


@dataclass(frozen=True)
class ElementKind:
    """A kind of element with k nodes.

    Attributes
    ----------
    name : str
        The name of the kind in sentences, in the plural.
    file_type, calculix : str
        The names of the kind in meshio and in CalculiX.
    exponents : (k, 3) tuples
        Exponents of the monomials that span the shape functions.
    corners : (c, 3) tuples
        Local positions of the corners, in the order of the file.
    edges : tuple of pairs
        The two corners of each edge that has a mid-edge node, in the order of these nodes; empty
        for linear kinds.
    faces : tuple of tuples
        The corners of each face, in the order and with the numbers of Abaqus.
    stiffness_rule, mass_rule : Rule
        Integration of stiffness and of mass on the reference cell.
    """

    name: str
    file_type: str
    calculix: str
    exponents: tuple[tuple[int, ...], ...]
    corners: tuple[tuple[int, int, int], ...]
    edges: tuple[tuple[int, int], ...]
    faces: tuple[tuple[int, ...], ...]
    stiffness_rule: Rule
    mass_rule: Rule

    @cached_property
    def node_positions(self) -> FloatArray:
        """Local positions (k, 3) of the nodes in the order of the file."""
        corners = np.array(self.corners, dtype=np.float64)
        positions = list(corners)
        for start, end in self.edges:
            mid_edge = 0.5 * (corners[start] + corners[end])
            positions.append(mid_edge)
        return np.vstack(positions)

    @property
    def node_count(self) -> int:
        """Number k of nodes of a cell."""
        return len(self.corners) + len(self.edges)

    @cached_property
    def centre(self) -> FloatArray:
        """Mean (3,) of the local positions of the corners."""
        return np.asarray(np.mean(self.corners, axis=0))

    @cached_property
    def _coefficients(self) -> FloatArray:
        """Coefficients (k, k) of the monomials in the shape functions.

        Each function is one at its own node and zero at the others, so that the coefficients are
        the inverse of the matrix of the monomials at the nodes.
        """
        powers = self.node_positions[:, np.newaxis] ** np.array(self.exponents)
        monomials = np.prod(powers, axis=2)
        # they are integers on these reference cells: rounding removes the error of the inverse
        return np.rint(np.linalg.inv(monomials))

    @cached_property
    def face_nodes(self) -> tuple[tuple[int, ...], ...]:
        """Nodes of each face: its corners, then its mid-edge nodes."""
        nodes_of_faces = []
        for face in self.faces:
            mid_edge_nodes = self._mid_edge_nodes(face)
            nodes_of_faces.append((*face, *mid_edge_nodes))
        return tuple(nodes_of_faces)

    def _mid_edge_nodes(self, face: tuple[int, ...]) -> list[int]:
        """Return the mid-edge nodes of the face with some corners."""
        corners_of_face = set(face)
        nodes = []
        for node, edge in enumerate(self.edges, start=len(self.corners)):
            if corners_of_face.issuperset(edge):
                nodes.append(node)
        return nodes

    @property
    def med_order(self) -> IntArray:
        """Number (k,) of the node that MED has at each position; its cells are mirrored."""
        x, y, z = self.node_positions.T
        mirrored = np.column_stack((y, x, z))
        difference = self.node_positions[:, np.newaxis] - mirrored
        distance = np.abs(difference).sum(axis=2)
        return np.asarray(distance.argmin(axis=1))

    def contains(self, local_positions: FloatArray, tolerance: float) -> BoolArray:
        """Return whether local positions (p, 3) lie in the reference cell, up to a tolerance."""
        frames = self.face_frames
        along_first, along_second = np.moveaxis(frames.tangents, 1, 0)
        outward = np.cross(along_first, along_second)
        from_corner = local_positions[:, np.newaxis] - frames.corner
        distance = (from_corner * outward).sum(axis=2)
        return np.asarray((distance <= tolerance).all(axis=1))

    def shape_functions(self, local_positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate the shape functions at positions (q, 3) in the reference cell.

        Returns
        -------
        values : (q, k) array
            Values of the shape functions.
        gradients : (q, k, 3) array
            Their gradients by the local coordinates.
        """
        # the monomials x^i y^j z^k are products of a power of each coordinate
        coordinates = np.transpose(local_positions)
        exponents = np.transpose(self.exponents)
        (x, dx), (y, dy), (z, dz) = map(_powers_and_slopes, coordinates, exponents)
        # monomials and their derivatives, combined
        values = x * y * z @ self._coefficients
        slope_x = dx * y * z @ self._coefficients
        slope_y = x * dy * z @ self._coefficients
        slope_z = x * y * dz @ self._coefficients
        gradients = np.stack((slope_x, slope_y, slope_z), axis=2)
        return np.asarray(values), gradients

    @cached_property
    def face_frames(self) -> FaceFrames:
        """Local frames of the faces."""

        def corner_positions(number_in_face: int) -> FloatArray:
            positions = []
            for face in self.faces:
                corner = face[number_in_face]
                positions.append(self.corners[corner])
            return np.array(positions, dtype=np.float64)

        # Seen from outside, the corners of a face turn clockwise in Abaqus, so that the tangent to
        # the last corner is the first one.
        first_corner = corner_positions(0)
        to_last = corner_positions(-1) - first_corner
        to_second = corner_positions(1) - first_corner
        return FaceFrames(corner=first_corner, tangents=np.stack((to_last, to_second), axis=1))

    def face_rule(self, face: int) -> Rule:
        """Return an integration rule on a face, exact for products of two shape functions."""
        if len(self.faces[face]) == 3:
            return _simplex_rule(RefTri, 4)
        return gauss_points(3, dimensions=2)


TETRAHEDRA_4 = ElementKind(
    name="4-node tetrahedra",
    file_type="tetra",
    calculix="C3D4",
    exponents=_LINEAR,
    corners=_TETRAHEDRON_CORNERS,
    edges=(),
    faces=_TETRAHEDRON_FACES,
    stiffness_rule=_simplex_rule(RefTet, 1),
    mass_rule=_simplex_rule(RefTet, 2),
)
TETRAHEDRA_10 = ElementKind(
    name="10-node tetrahedra",
    file_type="tetra10",
    calculix="C3D10",
    exponents=_QUADRATIC,
    corners=_TETRAHEDRON_CORNERS,
    edges=_TETRAHEDRON_EDGES,
    faces=_TETRAHEDRON_FACES,
    stiffness_rule=_simplex_rule(RefTet, 2),
    mass_rule=_simplex_rule(RefTet, 5),
)
HEXAHEDRA_8 = ElementKind(
    name="8-node hexahedra",
    file_type="hexahedron",
    calculix="C3D8",
    exponents=_TRILINEAR,
    corners=_HEXAHEDRON_CORNERS,
    edges=(),
    faces=_HEXAHEDRON_FACES,
    stiffness_rule=gauss_points(2),
    mass_rule=gauss_points(3),
)
HEXAHEDRA_20 = ElementKind(
    name="20-node hexahedra",
    file_type="hexahedron20",
    calculix="C3D20",
    exponents=_SERENDIPITY,
    corners=_HEXAHEDRON_CORNERS,
    edges=_HEXAHEDRON_EDGES,
    faces=_HEXAHEDRON_FACES,
    stiffness_rule=gauss_points(3),
    mass_rule=gauss_points(3),
)
WEDGES_6 = ElementKind(
    name="6-node wedges",
    file_type="wedge",
    calculix="C3D6",
    exponents=_PRISMATIC,
    corners=_WEDGE_CORNERS,
    edges=(),
    faces=_WEDGE_FACES,
    stiffness_rule=_wedge_rule(2, 2),
    mass_rule=_wedge_rule(4, 3),
)
WEDGES_15 = ElementKind(
    name="15-node wedges",
    file_type="wedge15",
    calculix="C3D15",
    exponents=_PRISMATIC_QUADRATIC,
    corners=_WEDGE_CORNERS,
    edges=_WEDGE_EDGES,
    faces=_WEDGE_FACES,
    stiffness_rule=_wedge_rule(2, 3),
    mass_rule=_wedge_rule(4, 3),
)
KINDS = {
    kind.file_type: kind
    for kind in (TETRAHEDRA_4, TETRAHEDRA_10, HEXAHEDRA_8, HEXAHEDRA_20, WEDGES_6, WEDGES_15)
}
"""The kinds by their names in meshio."""

HEXAHEDRA_20_REDUCED = replace(
    HEXAHEDRA_20,
    name="20-node hexahedra of reduced integration",
    calculix="C3D20R",
    stiffness_rule=gauss_points(2),
)
REDUCED = "hexahedron20 reduced"
DECK_KINDS = KINDS | {REDUCED: HEXAHEDRA_20_REDUCED}
"""The kinds that decks can ask for, by their names in a `Deck`.

The names of meshio are of cells only, not of their integration.
"""


def meshio_with_wedges() -> ModuleType:
    """Return meshio with the dimension of 15-node wedges, which version 5.3 lacks."""
    import meshio
    from meshio._mesh import topological_dimension

    topological_dimension.setdefault("wedge15", 3)
    return cast(ModuleType, meshio)
