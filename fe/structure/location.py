"""Where a point lies in a mesh: in which cell, or on which face of the surface, at which local place.

Also what follows from places: nodal loads (nodes, 3) [N] of forces and pressures, and gauges as rows on the
nodal displacements.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.elements.cells import CellMesh, unit_vector
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError
from fe.sentences import said

from .design import Gauge, Load, Port, Rosette
from .mesh import StructureMesh, Surface

FARTHEST = 0.1
"""A point may lie so far off the surface, in sizes of the nearest face: coordinates are rounded, and the
faces of a mesh lie beside the curved surface that they stand for."""
STEEPEST = 30.0
"""Largest angle [degrees] between a gauge's direction and the surface; less is turned into the surface."""
_ALONG, _ACROSS = 20, 10  # points of a gauge that has a length, a width
_INSIDE = 1e-9
_STEPS = 25
_SAME_PLACE = 1e-6
_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
_TRIANGLE = _SQUARE[[0, 1, 3, 3]]
_SAME_SIDE = 0.9  # cosine between the normals of faces that are one surface


class SurfacePoint(NamedTuple):
    """Point of the surface, on each of the faces that meet there.

    Attributes
    ----------
    cell : (f,)
        Cells of the faces.
    local : (f, 3)
        Local place in each cell.
    normal : (3,)
        Outward unit normal.
    distance : float
        How far the point asked for lies off the surface [m].
    """

    cell: IntArray
    local: FloatArray
    normal: FloatArray
    distance: float


def attach(mesh: StructureMesh, point: FloatArray, where: str) -> tuple[int, FloatArray]:
    """Find the cell and the local place (3,) of a point [m] in the structure or close to its surface.

    Raises
    ------
    InvalidDesignError
        If it lies outside; the sentence begins with `where`.
    """
    near = np.linalg.norm(mesh.centres - point, axis=1) <= 1.001 * mesh.cell_radius
    kind, cells = mesh.kind, np.flatnonzero(near)
    start = np.tile(np.mean(kind.corners, axis=0), (len(cells), 1))
    axes = np.tile(np.eye(3), (len(cells), 1, 1))
    local, residual, _ = _nearest(
        mesh, cells, point, start, 0.0, axes, lambda place, _: np.clip(place, -2.0, 3.0)
    )
    inside = kind.inside(local, _INSIDE) & (np.linalg.norm(residual, axis=1) <= 1e-9 * mesh.size)
    if inside.any():
        first = int(inside.argmax())
        return int(cells[first]), local[first]
    found = on_surface(mesh, point, where)
    return int(found.cell[0]), found.local[0]


def _nearest(
    mesh: StructureMesh,
    cells: IntArray,
    point: FloatArray,
    along: FloatArray,
    corner: FloatArray | float,
    tangents: FloatArray,
    kept: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find the places in cells (n,) that are nearest to a point, by Gauss and Newton.

    Parameters
    ----------
    mesh : StructureMesh
        The mesh.
    cells : (n,)
        The cells.
    point : (3,) m
        The point.
    along : (n, t)
        Coordinates to start from.
    corner, tangents : (n, 3), (n, t, 3)
        Local places where the coordinates are zero, and how they go on along each.
    kept : callable
        Returns the nearest coordinates that are allowed, by a metric (n, t, t) of theirs.

    Returns
    -------
    local, residual, edges : (n, 3), (n, 3) m, (n, t, 3) m
        The places, what is left to the point, and the derivatives of the places in space.
    """
    nodes, moved = mesh.nodes[cells], np.inf
    for step in range(_STEPS + 1):
        local = corner + np.einsum("nt,ntj->nj", along, tangents)
        values, slopes = mesh.kind.shape_functions(local)
        residual = point - np.einsum("na,nai->ni", values, nodes)
        edges = np.einsum("nai,naj,ntj->nti", nodes, slopes, tangents)
        if step == _STEPS or moved < 1e-14:
            break
        gram = edges @ edges.swapaxes(1, 2)
        # outside its cell the map may fold: no solution, wherever the next step leads
        if along.shape[1] == 3:
            gram[np.linalg.det(gram) == 0.0] = np.eye(3)
        move = np.linalg.solve(gram, edges @ residual[..., None])[..., 0]
        before, along = along, kept(along + move, gram)
        moved = float(np.abs(along - before).max(initial=0.0))
    return local, residual, edges


def on_surface(mesh: StructureMesh, point: FloatArray, where: str) -> SurfacePoint:
    """Find the point of the surface that is nearest to a point (3,) [m].

    Raises
    ------
    InvalidDesignError
        If it lies farther off than `FARTHEST`; the sentence begins with `where`.
    """
    kind, surface, (centre, radius) = mesh.kind, mesh.boundary, mesh.face_spheres
    away = np.linalg.norm(centre - point, axis=1)
    near = np.flatnonzero(away - 1.1 * radius <= away.min())
    cells, (corner, tangents) = surface.cell[near], (part[surface.face[near]] for part in kind.face_frames)
    triangle = np.array([len(face) == 3 for face in kind.faces])[surface.face[near]]

    corners = np.where(triangle[:, None, None], _TRIANGLE, _SQUARE)
    start = np.where(triangle[:, None], 1.0 / 3.0, [0.5, 0.5])
    local, residual, edges = _nearest(mesh, cells, point, start, corner, tangents, partial(_on_face, corners))
    distance, normal = np.linalg.norm(residual, axis=1), unit_vector(np.cross(edges[:, 0], edges[:, 1]))
    best = int(distance.argmin())
    size = float(radius[near[best]])
    if distance[best] > FARTHEST * size:
        inside = ", inside" if float(residual[best] @ normal[best]) < 0.0 else ""
        far, place = distance[best] / mesh.unit, mesh.place(point - residual[best])
        raise InvalidDesignError(
            said("mesh.off", where=where, distance=far, mesh=mesh, inside=inside, place=place)
        )
    same = (distance <= distance[best] + _SAME_PLACE * size) & (normal @ normal[best] > _SAME_SIDE)
    mean = unit_vector(normal[same].mean(axis=0))
    return SurfacePoint(cells[same], local[same], mean, float(distance[best]))


def _on_face(corners: FloatArray, along: FloatArray, metric: FloatArray) -> FloatArray:
    """Nearest places (n, 2) of faces with corners (n, 4, 2), by a metric (n, 2, 2): inside, or on an edge."""
    edge = np.roll(corners, -1, axis=1) - corners
    aside = along[:, None] - corners
    inside = np.all(edge[..., 0] * aside[..., 1] >= edge[..., 1] * aside[..., 0], axis=1)
    squares = np.sum(edge @ metric * edge, axis=2)
    share = np.sum(edge @ metric * aside, axis=2) / np.where(squares > 0.0, squares, 1.0)
    places = corners + np.clip(share, 0.0, 1.0)[..., None] * edge
    left = along[:, None] - places
    best = np.sum(left @ metric * left, axis=2).argmin(axis=1)
    return np.where(inside[:, None], along, places[np.arange(len(places)), best])


def face_areas(mesh: CellMesh, surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Integrals over faces of each node's shape function: with the outward normal, and alone.

    Returns
    -------
    vectors, shares : (nodes, 3) m^2, (nodes,) m^2
        The shares together are the area.
    """
    kind, vectors, shares = mesh.kind, np.zeros((len(mesh.points), 3)), np.zeros(len(mesh.points))
    for number in np.unique(surface.face).tolist():
        cells = surface.cell[surface.face == number]
        along, weight = kind.face_rule(number)
        corner, tangents = (part[number] for part in kind.face_frames)
        local = corner + along @ tangents
        values, slopes = kind.shape_functions(local)
        edges = np.einsum("nai,qaj,tj->nqti", mesh.nodes[cells], slopes, tangents, optimize=True)
        normals = np.cross(edges[:, :, 0], edges[:, :, 1]) * weight[:, None]
        # A node off the face has a shape function of zero on it, up to rounding.
        values[:, [n for n in range(kind.node_count) if n not in kind.face_nodes[number]]] = 0.0
        np.add.at(vectors, mesh.cells[cells], np.einsum("nqi,qa->nai", normals, values))
        np.add.at(shares, mesh.cells[cells], np.linalg.norm(normals, axis=2) @ values)
    return vectors, shares


def nodal_load(mesh: StructureMesh, load: Load, where: str) -> FloatArray:
    """Return forces (nodes, 3) [N], or an acceleration [m/s^2]; `where` names the load in sentences.

    Raises
    ------
    MeshError
        If its set is missing, empty or holds no face.
    InvalidDesignError
        If its point lies outside.
    """
    if load.acceleration is not None:
        return np.tile(load.acceleration, (len(mesh.points), 1))
    if load.pressure is not None:
        return -load.pressure * face_areas(mesh, mesh.faces_of(str(load.set), where))[0]
    return np.outer(_force_shares(mesh, load, where), np.asarray(load.force))


def port_row(mesh: StructureMesh, port: Port, where: str) -> FloatArray:
    """Return the row (nodes, 3) that reads the displacement of a port.

    Transposed, the row is a force of 1 N at the port.

    Parameters
    ----------
    mesh : StructureMesh
        The mesh.
    port : Port
        The port.
    where : str
        What names the port in sentences.

    Raises
    ------
    MeshError
        If its set is missing or empty.
    InvalidDesignError
        If its point lies outside.
    """
    return np.outer(_force_shares(mesh, port, where), unit_vector(port.direction))


def _force_shares(mesh: StructureMesh, part: Load | Port, where: str) -> FloatArray:
    """Return the share (nodes,) of each node in a force at a point or on a set, which together are one."""
    if part.point is not None:
        return point_shares(mesh, part.point, where)
    nodes = mesh.nodes_of(str(part.set), where)
    surface = mesh.faces_between(str(part.set), nodes)
    shares = np.zeros(len(mesh.points))
    shares[nodes] = 1.0
    if len(surface):
        _, shares = face_areas(mesh, surface)
    return np.asarray(shares / shares.sum())


def point_shares(mesh: StructureMesh, point: tuple[float, float, float], where: str) -> FloatArray:
    """Share (nodes,) of each node in the displacement of a point [unit of length of the mesh].

    Raises
    ------
    InvalidDesignError
        If it lies outside.
    """
    place = f"{where}: the point {mesh.place(mesh.unit * np.asarray(point))}"
    cell, local = attach(mesh, mesh.unit * np.asarray(point), place)
    shares = np.zeros(len(mesh.points))
    shares[mesh.cells[cell]] = mesh.kind.shape_functions(local[None])[0][0]
    return shares


def gauge_rows(mesh: StructureMesh, gauges: tuple[Gauge, ...]) -> tuple[sparse.csr_array, FloatArray]:
    """Strain rows (gauges, full) [1/m], positive in tension, and how far (gauges,) [m] each gauge was moved.

    A gauge without a length reads the strain at its point, the mean of the cells that meet there; one with
    a length reads the mean of 20 points along it, one with a width of 10 across, each put onto the surface.

    Raises
    ------
    InvalidDesignError
        If a gauge lies off the surface, reaches over its edge, or points out of it.
    """
    if not gauges:
        return sparse.csr_array((0, mesh.unknowns)), np.empty(0)
    strains, moved = [], []
    for number, gauge in enumerate(gauges):
        where = f"gauge[{number + 1}] ({gauge.name})"
        point = mesh.unit * np.asarray(gauge.point)
        found = on_surface(mesh, point, f"{where}: the point {mesh.place(point)}")
        direction = _in_surface(np.asarray(gauge.direction), found.normal, where)
        spots = [found]
        if gauge.length or gauge.width:
            inside, corners = _spots(mesh, gauge, direction, np.cross(found.normal, direction))
            wide = f" and {gauge.width:g} {mesh.unit_name} wide" if gauge.width else ""
            over = said("mesh.edge", where=where, gauge=gauge, mesh=mesh, wide=wide)
            places = [point + off for off in (*inside, *corners)]
            every = [on_surface(mesh, place, f"{over} {mesh.place(place)}") for place in places]
            spots = every[: len(inside)]
        for spot in spots:
            along = _in_surface(direction, spot.normal, where)
            share = 1.0 / (len(spots) * len(spot.cell))  # the mean of the cells that meet there
            strains += [(number, share, *place, along) for place in zip(spot.cell, spot.local, strict=True)]
        moved.append(found.distance)
    return mesh.strain_rows(*map(np.array, zip(*strains, strict=True))), np.array(moved)


def _spots(
    mesh: StructureMesh, gauge: Gauge, direction: FloatArray, across: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return where strains are averaged from the middle of a gauge (3,) [m], and its corners."""
    sizes = mesh.unit * np.array([gauge.length, gauge.width])
    middles = [(np.arange(count) + 0.5) / count - 0.5 for count in (_ALONG, _ACROSS)]
    ends = [np.array([-0.5, 0.5])] * 2

    def spots(shares: list[FloatArray]) -> list[FloatArray]:
        along, over = (part if size else np.zeros(1) for part, size in zip(shares, sizes, strict=True))
        return [a * sizes[0] * direction + b * sizes[1] * across for b in over for a in along]

    return spots(middles), spots(ends)


def _in_surface(direction: FloatArray, normal: FloatArray, where: str) -> FloatArray:
    """Return a direction (3,) turned into the surface, of length one."""
    direction = unit_vector(direction)
    angle = float(np.degrees(np.arcsin(min(1.0, abs(float(direction @ normal))))))
    if angle > STEEPEST:
        towards = ", ".join(f"{value + 0.0:.3g}" for value in normal)
        raise InvalidDesignError(
            said("mesh.direction", where=where, angle=angle, normal=towards, most=STEEPEST)
        )
    return unit_vector(direction - (direction @ normal) * normal)


def spread_rosettes(mesh: StructureMesh, count: int) -> list[Rosette]:
    """Return rosettes spread evenly over the faces of the surface, `spread_1` and on.

    Parameters
    ----------
    mesh : StructureMesh
        The mesh.
    count : int
        At most how many rosettes; fewer where several would come to lie on one face.
    """
    from scipy.cluster.vq import kmeans2, vq

    centre, _ = mesh.face_spheres
    near, _ = kmeans2(centre, min(count, len(centre)), minit="++", rng=0)
    found = []
    for number, face in enumerate(np.unique(vq(near, centre)[0]).tolist(), start=1):
        normal = on_surface(mesh, centre[face], "a face").normal
        first = np.eye(3)[np.argmin(np.abs(normal))]
        first -= (first @ normal) * normal
        axes = tuple(first.tolist()), tuple(np.cross(normal, first).tolist())
        point = tuple((centre[face] / mesh.unit).tolist())
        found.append(Rosette(name=f"spread_{number}", point=point, axes=axes))
    return found
