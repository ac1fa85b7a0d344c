"""Locate points in a mesh: in a cell, or on a face of its surface."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np

from fe.elements.elasticity import unit_vector
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError

from .mesh import StructureMesh

FARTHEST = 0.1
"""Largest distance of a point from the surface, relative to the radius of the nearest face.

Coordinates are rounded, and the faces of a mesh only approximate a curved surface.
"""
_INSIDE = 1e-9
_MOST_STEPS = 25
_SAME_PLACE = 1e-6
_UNIT_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
_UNIT_TRIANGLE = _UNIT_SQUARE[[0, 1, 3, 3]]
_SAME_SIDE = 0.9  # cosine between the normals of faces that form one smooth surface


class SurfacePoint(NamedTuple):
    """A point of the surface, located on each of the f faces that meet there.

    Attributes
    ----------
    cell : (f,) array of int
        Cells of the faces.
    local : (f, 3) array
        Local position in each cell.
    normal : (3,) array
        Outward unit normal.
    distance : float
        Distance of the requested point from the surface [m].
    """

    cell: IntArray
    local: FloatArray
    normal: FloatArray
    distance: float


class _Parametrisation(NamedTuple):
    """Local positions in n cells as linear functions of t coordinates.

    Attributes
    ----------
    cells : (n,) array of int
        Indices of the cells.
    origin : (n, 3) array
        Local positions where the coordinates are zero.
    tangents : (n, t, 3) array
        Derivatives of the local positions by the coordinates.
    """

    cells: IntArray
    origin: FloatArray
    tangents: FloatArray


class _NearestPoints(NamedTuple):
    """The points of n cells that are nearest to a given point.

    Attributes
    ----------
    local : (n, 3) array
        Local positions.
    residual : (n, 3) array
        Vector from each of them to the given point [m].
    edges : (n, t, 3) array
        Derivatives of the positions in space by the coordinates [m].
    """

    local: FloatArray
    residual: FloatArray
    edges: FloatArray


Restriction = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the nearest allowed coordinates (n, t) of coordinates (n, t), in a metric (n, t, t)."""


def attach(mesh: StructureMesh, point: FloatArray, where: str) -> tuple[int, FloatArray]:
    """Return the cell that contains a point, and the point's local position (3,) in it.

    For a point that lies slightly outside, they are those of the nearest point of the surface.

    Parameters
    ----------
    point : (3,) array
        The position of the point [m].
    where : str
        The beginning of the error message, which names the point.

    Raises
    ------
    InvalidDesignError
        If the point lies farther outside than `FARTHEST` allows.
    """
    # cells that may hold the point: those whose bounding spheres do
    distance = np.linalg.norm(mesh.centres - point, axis=1)
    cells = np.flatnonzero(distance <= 1.001 * mesh.cell_radius)
    # the nearest local position in each of them: the cell holds the point if nothing remains
    whole_cells = _Parametrisation(
        cells,
        origin=np.zeros((len(cells), 3)),
        tangents=np.tile(np.eye(3), (len(cells), 1, 1)),
    )
    centres = np.tile(mesh.kind.centre, (len(cells), 1))
    nearest_points = _nearest_points(mesh, point, whole_cells, centres, _clip_near_cell)
    distance_from_nearest = np.linalg.norm(nearest_points.residual, axis=1)
    coincides = distance_from_nearest <= 1e-9 * mesh.size
    is_inside = mesh.kind.contains(nearest_points.local, _INSIDE) & coincides
    if is_inside.any():
        first_inside = int(is_inside.argmax())
        return int(cells[first_inside]), nearest_points.local[first_inside]
    # outside: the nearest point of the surface, if it is near enough
    surface_point = on_surface(mesh, point, where)
    return int(surface_point.cell[0]), surface_point.local[0]


def _clip_near_cell(coordinates: FloatArray, _: FloatArray) -> FloatArray:
    """Clip local positions (n, 3) to a box around the reference cell."""
    return np.clip(coordinates, -2.0, 3.0)


def _nearest_points(
    mesh: StructureMesh,
    point: FloatArray,
    parametrisation: _Parametrisation,
    start: FloatArray,
    restrict: Restriction,
) -> _NearestPoints:
    """Find the points of cells that are nearest to a point, by Gauss-Newton iteration.

    Parameters
    ----------
    point : (3,) array
        The position of the point [m].
    parametrisation : _Parametrisation
        The allowed positions in n cells, by t coordinates.
    start : (n, t) array
        Initial coordinates.
    restrict : Restriction
        Projects the coordinates on the allowed ones after each step.
    """
    cells, origin, tangents = parametrisation
    nodes = mesh.nodes[cells]
    coordinates = start
    largest_change = np.inf
    for step in range(_MOST_STEPS + 1):
        # local positions, residuals and derivatives at the present coordinates
        local_positions = origin + np.einsum("nt,ntj->nj", coordinates, tangents)
        values, gradients = mesh.kind.shape_functions(local_positions)
        residual = point - np.einsum("na,nai->ni", values, nodes)
        edges = np.einsum("nai,naj,ntj->nti", nodes, gradients, tangents)
        if step == _MOST_STEPS or largest_change < 1e-14:
            break
        # Gauss-Newton step
        metric = edges @ edges.swapaxes(1, 2)
        if coordinates.shape[1] == 3:
            # Outside its cell the map may fold. Then there is no solution, wherever the step leads.
            metric[np.linalg.det(metric) == 0.0] = np.eye(3)
        change = np.linalg.solve(metric, edges @ residual[..., None]).squeeze(axis=-1)
        previous_coordinates = coordinates
        coordinates = restrict(coordinates + change, metric)
        largest_change = float(np.abs(coordinates - previous_coordinates).max(initial=0.0))
    return _NearestPoints(local_positions, residual, edges)


def on_surface(mesh: StructureMesh, point: FloatArray, where: str) -> SurfacePoint:
    """Find the point of the surface that is nearest to a point.

    Parameters
    ----------
    point : (3,) array
        The position of the point [m].
    where : str
        The beginning of the error message, which names the point.

    Raises
    ------
    InvalidDesignError
        If the point lies farther from the surface than `FARTHEST` times the radius of a face.
    """
    faces = _faces_near(mesh, point)
    cells = mesh.boundary.cell[faces]
    nearest_points = _nearest_on_faces(mesh, point, cells, mesh.boundary.face[faces])
    # the nearest of all faces
    along_first, along_second = np.moveaxis(nearest_points.edges, 1, 0)
    normal = unit_vector(np.cross(along_first, along_second))
    distance = np.linalg.norm(nearest_points.residual, axis=1)
    nearest_face = int(distance.argmin())
    size = float(mesh.face_spheres.radius[faces[nearest_face]])
    if distance[nearest_face] > FARTHEST * size:
        height = float(nearest_points.residual[nearest_face] @ normal[nearest_face])
        side = ", inside" if height < 0.0 else ""
        raise InvalidDesignError(
            f"{where} lies {distance[nearest_face] / mesh.unit:.3g} {mesh.unit_name} off the "
            f"surface of {mesh.source}{side}; the nearest point of the surface is "
            f"{mesh.describe_point(point - nearest_points.residual[nearest_face])}."
        )
    # all faces of one smooth surface that meet there
    meets = distance <= distance[nearest_face] + _SAME_PLACE * size
    is_same_side = normal @ normal[nearest_face] > _SAME_SIDE
    meeting_faces = meets & is_same_side
    return SurfacePoint(
        cell=cells[meeting_faces],
        local=nearest_points.local[meeting_faces],
        normal=unit_vector(normal[meeting_faces].mean(axis=0)),
        distance=float(distance[nearest_face]),
    )


def nearest_point(mesh: StructureMesh, point: FloatArray) -> FloatArray:
    """Return the point (3,) of the structure that is nearest to a point, itself if it is inside."""
    with suppress(InvalidDesignError):
        attach(mesh, point, "the point")
        return point
    faces = _faces_near(mesh, point)
    cells = mesh.boundary.cell[faces]
    residuals = _nearest_on_faces(mesh, point, cells, mesh.boundary.face[faces]).residual
    return np.asarray(point - residuals[np.linalg.norm(residuals, axis=1).argmin()])


def _faces_near(mesh: StructureMesh, point: FloatArray) -> IntArray:
    """Return the faces (f,) of the surface among which the nearest one to a point is."""
    spheres = mesh.face_spheres
    centre_distance = np.linalg.norm(spheres.centre - point, axis=1)
    # A face can be the nearest one only if its sphere comes as near as the nearest centre of a
    # face, which itself lies on or close to the surface. A tenth is added, since a curved face may
    # reach beyond its sphere.
    return np.flatnonzero(centre_distance - 1.1 * spheres.radius <= centre_distance.min())


def _nearest_on_faces(
    mesh: StructureMesh, point: FloatArray, cells: IntArray, face_numbers: IntArray
) -> _NearestPoints:
    """Find on each of n faces the point that is nearest to a point (3,).

    A face is given by its cell, in `cells` (n,), and its number in the cell.
    """
    frames = mesh.kind.face_frames
    is_triangular = np.array([len(face) == 3 for face in mesh.kind.faces])
    is_triangle = is_triangular[face_numbers]
    corners = np.where(is_triangle[:, None, None], _UNIT_TRIANGLE, _UNIT_SQUARE)
    centres = np.where(is_triangle[:, None], 1.0 / 3.0, [0.5, 0.5])
    on_faces = _Parametrisation(
        cells,
        origin=frames.corner[face_numbers],
        tangents=frames.tangents[face_numbers],
    )
    nearest_on_face = partial(_nearest_on_face, corners)
    return _nearest_points(mesh, point, on_faces, centres, nearest_on_face)


def _nearest_on_face(
    corners: FloatArray, coordinates: FloatArray, metric: FloatArray
) -> FloatArray:
    """Move n points in planes to the nearest point of a convex face in their plane.

    Parameters
    ----------
    corners : (n, 4, 2) array
        Corners of each face, in coordinates of its plane; a triangle has its last corner twice.
    coordinates : (n, 2) array
        The points, in the same coordinates.
    metric : (n, 2, 2) array
        The metric of each plane's coordinates.

    Returns
    -------
    (n, 2) array
        A point itself if it lies inside, else the nearest point of an edge.
    """
    edge = np.roll(corners, -1, axis=1) - corners
    point = coordinates[:, None]
    from_corner = point - corners
    # a point inside lies left of all edges
    edge_x, edge_y = np.moveaxis(edge, 2, 0)
    point_x, point_y = np.moveaxis(from_corner, 2, 0)
    is_left_of_edge = edge_x * point_y >= edge_y * point_x
    is_inside = np.all(is_left_of_edge, axis=1)
    # nearest point of each edge; a triangle has an edge without length
    edge_covector = edge @ metric
    squared_length = np.sum(edge_covector * edge, axis=2)
    divisor = np.where(squared_length > 0.0, squared_length, 1.0)
    fraction = np.sum(edge_covector * from_corner, axis=2) / divisor
    fraction_on_edge = np.clip(fraction, 0.0, 1.0)[..., None]
    on_edges = corners + fraction_on_edge * edge
    # nearest edge
    residual = point - on_edges
    squared_distance = np.sum(residual @ metric * residual, axis=2)
    nearest_edge = squared_distance.argmin(axis=1)
    faces = np.arange(len(on_edges))
    on_nearest_edge = on_edges[faces, nearest_edge]
    return np.where(is_inside[:, None], coordinates, on_nearest_edge)
