"""The kinds of elements that a structure may be made of: nodes, faces, shape functions, integration.

Shape functions are the polynomials of scikit-fem's elements of the same name, made for many places at once;
nodes stand in the order of the mesh file, which is that of VTK and, for these kinds, of Abaqus and CalculiX.
All kinds are isoparametric: the mid-edge nodes of a file bend the edges and faces. Stiffness is integrated as
CalculiX integrates C3D4, C3D8, C3D10 and C3D20; mass is integrated exactly on straight cells, while CalculiX
takes the points of the stiffness for it.
"""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet, RefTri

from fe.runtime.arrays import BoolArray, FloatArray, IntArray

Rule = tuple[FloatArray, FloatArray]


_TET = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_TET_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
_TET_FACES = ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))
_HEX = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
_HEX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
_HEX_FACES = ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0))
_WEDGE = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1))
_WEDGE_EDGES = ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5))
_WEDGE_FACES = ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0))
_POWERS = tuple(itertools.product(range(3), repeat=3))
_LINEAR = tuple(power for power in _POWERS if sum(power) <= 1)
_QUADRATIC = tuple(power for power in _POWERS if sum(power) <= 2)
_TRILINEAR = tuple(power for power in _POWERS if max(power) <= 1)
# D. N. Arnold and G. Awanou (2011): degree at most two, factors of degree one not counted.
_SERENDIPITY = tuple(power for power in _POWERS if sum(p for p in power if p > 1) <= 2)
_PRISMATIC = tuple(power for power in _POWERS if power[0] + power[1] <= 1 and power[2] <= 1)
# Quadratic in the triangle and linear along it, or the other way round.
_PRISMATIC_QUADRATIC = tuple(power for power in _POWERS if power[0] + power[1] + power[2] // 2 <= 2)


def gauss_points(order: int, dimensions: int = 3) -> Rule:
    """Tensor Gauss rule on the unit cube: points (q, dimensions), weights (q,)."""
    line, weight = np.polynomial.legendre.leggauss(order)
    points, weights = (
        np.array([*itertools.product(0.5 * values, repeat=dimensions)]) for values in (line + 1.0, weight)
    )
    return points, weights.prod(axis=1)


def _simplex_rule(cell: type[RefTet] | type[RefTri], order: int) -> Rule:
    points, weights = get_quadrature(cell, order)
    return np.ascontiguousarray(points.T), np.asarray(weights)


def _wedge_rule(order: int, along: int) -> Rule:
    flat, line = _simplex_rule(RefTri, order), gauss_points(along, dimensions=1)
    points = [(*place, height) for height in line[0][:, 0] for place in flat[0]]
    return np.array(points), np.outer(line[1], flat[1]).ravel()


@dataclass(frozen=True)
class ElementKind:
    """A kind of element.

    Attributes
    ----------
    name : str
        What it is called in a sentence, in the plural.
    file_type, calculix : str
        Its names in meshio and in CalculiX.
    exponents : (k, 3)
        Monomials that span the shape functions.
    corners : (c, 3)
        Local places of the corners, in the order of the file.
    edges : tuple of pairs
        Corners of the edges whose middles bear the other nodes, in their order; empty for linear kinds.
    faces : tuple of tuples
        Corners of each face, in the order and with the numbers of Abaqus.
    stiffness_rule, mass_rule : points (q, 3) and weights (q,)
        Integration on the reference cell.
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
    def places(self) -> FloatArray:
        """Local places (k, 3) of the nodes in the order of the file."""
        corners = np.array(self.corners, dtype=np.float64)
        middles = [0.5 * (corners[a] + corners[b]) for a, b in self.edges]
        return np.vstack([corners, *middles])

    @property
    def node_count(self) -> int:
        """Number k of nodes of a cell."""
        return len(self.corners) + len(self.edges)

    @cached_property
    def _coefficients(self) -> FloatArray:
        """Coefficients (k, k) of the monomials in the shape functions, each one at its node alone."""
        at_nodes = np.prod(self.places[:, None, :] ** np.array(self.exponents), axis=2)
        return np.rint(np.linalg.inv(at_nodes))  # whole numbers on these reference cells

    @cached_property
    def face_nodes(self) -> tuple[tuple[int, ...], ...]:
        """Nodes of each face: its corners, then its mid-edge nodes."""
        sides = [{*edge} for edge in self.edges]
        first = len(self.corners)
        return tuple(
            (*face, *(first + number for number, side in enumerate(sides) if side <= {*face}))
            for face in self.faces
        )

    @property
    def mirrored(self) -> IntArray:
        """Places (k,) in the order of MED, whose cells are those of VTK in a mirror, of the nodes."""
        mirror = self.places[:, [1, 0, 2]]
        return np.asarray(np.abs(self.places[:, None] - mirror).sum(axis=2).argmin(axis=1))

    def inside(self, local: FloatArray, tolerance: float) -> BoolArray:
        """Whether local places (p, 3) lie in the reference cell, up to a tolerance."""
        corner, tangents = self.face_frames
        outwards = np.cross(tangents[:, 0], tangents[:, 1])
        return np.asarray((((local[:, None] - corner) * outwards).sum(axis=2) <= tolerance).all(axis=1))

    def shape_functions(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (q, k) and local gradients (q, k, 3) at local places (q, 3), nodes as in the file."""
        exponents = np.array(self.exponents)
        powers = np.stack((np.ones_like(local), local, local**2), axis=2)
        slopes = np.stack((np.zeros_like(local), np.ones_like(local), 2.0 * local), axis=2)
        x, y, z = (powers[:, axis, exponents[:, axis]] for axis in range(3))
        dx, dy, dz = (slopes[:, axis, exponents[:, axis]] for axis in range(3))
        gradients = [part @ self._coefficients for part in (dx * y * z, x * dy * z, x * y * dz)]
        return np.asarray(x * y * z @ self._coefficients), np.stack(gradients, axis=2)

    @cached_property
    def face_frames(self) -> tuple[FloatArray, FloatArray]:
        """First corner (f, 3) of each face and its two local tangents (f, 2, 3), to the corners beside it.

        Faces are the unit triangle or square between these; the tangents' cross product points outwards.
        """
        # Seen from outside, the corners of a face turn clockwise in Abaqus: the last one comes second here.
        corner, last, second = (
            np.array([self.corners[face[n]] for face in self.faces], dtype=np.float64) for n in (0, -1, 1)
        )
        return corner, np.stack((last - corner, second - corner), axis=1)

    def face_rule(self, face: int) -> Rule:
        """Integration points (q, 2) and weights (q,) on a face, exact for its shape functions' products."""
        if len(self.faces[face]) == 3:
            return _simplex_rule(RefTri, 4)
        return gauss_points(3, dimensions=2)


TETRAHEDRA_4 = ElementKind(
    "4-node tetrahedra", "tetra", "C3D4", _LINEAR, _TET, (), _TET_FACES,
    _simplex_rule(RefTet, 1), _simplex_rule(RefTet, 2),
)  # fmt: skip
TETRAHEDRA_10 = ElementKind(
    "10-node tetrahedra", "tetra10", "C3D10", _QUADRATIC, _TET, _TET_EDGES, _TET_FACES,
    _simplex_rule(RefTet, 2), _simplex_rule(RefTet, 5),
)  # fmt: skip
HEXAHEDRA_8 = ElementKind(
    "8-node hexahedra", "hexahedron", "C3D8", _TRILINEAR, _HEX, (), _HEX_FACES,
    gauss_points(2), gauss_points(3),
)  # fmt: skip
HEXAHEDRA_20 = ElementKind(
    "20-node hexahedra", "hexahedron20", "C3D20", _SERENDIPITY, _HEX, _HEX_EDGES, _HEX_FACES,
    gauss_points(3), gauss_points(3),
)  # fmt: skip
WEDGES_6 = ElementKind(
    "6-node wedges", "wedge", "C3D6", _PRISMATIC, _WEDGE, (), _WEDGE_FACES,
    _wedge_rule(2, 2), _wedge_rule(4, 3),
)  # fmt: skip
WEDGES_15 = ElementKind(
    "15-node wedges", "wedge15", "C3D15", _PRISMATIC_QUADRATIC, _WEDGE, _WEDGE_EDGES, _WEDGE_FACES,
    _wedge_rule(2, 3), _wedge_rule(4, 3),
)  # fmt: skip
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
"""The kinds that decks can ask for, by their names in a `Deck`; meshio knows cells, not their integration."""


def meshio_with_wedges() -> Any:
    """Return meshio, whose version 5.3 forgets of how many dimensions a wedge of 15 nodes is."""
    import meshio
    from meshio._mesh import topological_dimension

    topological_dimension.setdefault("wedge15", 3)
    return meshio
