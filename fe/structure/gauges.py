"""Strain gauges on the surface of a mesh, as rows on the nodal displacements."""

import numpy as np
from scipy import sparse

from fe.elements.cells import strain_weights
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidDesignError

from .design import Gauge, Rosette
from .location import on_surface
from .mesh import StructureMesh

STEEPEST = 30.0
"""Largest angle [degrees] between a gauge's direction and the surface; less is turned into the surface."""
_ALONG, _ACROSS = 20, 10  # points of a gauge that has a length, a width


def gauge_rows(mesh: StructureMesh, gauges: tuple[Gauge, ...]) -> tuple[sparse.csr_array, FloatArray]:
    """Strain rows (gauges, full) [1/m], positive in tension, and how far (gauges,) [m] each gauge was moved.

    A gauge without a length reads the strain at its point, the mean of the cells that meet there; one with
    a length reads the mean of 20 points along it, one with a width of 10 across, each put onto the surface.

    Raises
    ------
    InvalidDesignError
        If a gauge lies off the surface, reaches over its edge, or points out of it.
    """
    rows, moved = [sparse.csr_array((0, mesh.unknowns))], []
    for number, gauge in enumerate(gauges, start=1):
        where = f"gauge[{number}] ({gauge.name})"
        point = mesh.unit * np.asarray(gauge.point)
        found = on_surface(mesh, point, f"{where}: the point {mesh.place(point)}")
        direction = _in_surface(np.asarray(gauge.direction), found.normal, where)
        spots = [found]
        if gauge.length or gauge.width:
            inside, corners = _spots(mesh, gauge, direction, np.cross(found.normal, direction))
            wide = f" and {gauge.width:g} {mesh.unit_name} wide" if gauge.width else ""
            spots = [
                on_surface(
                    mesh,
                    point + off,
                    f"{where}: {gauge.length:g} {mesh.unit_name} long{wide}, the gauge reaches over the "
                    f"edge; its point {mesh.place(point + off)}",
                )
                for off in (*inside, *corners)
            ][: len(inside)]
        row = np.zeros(mesh.unknowns)
        for spot in spots:
            along = _in_surface(direction, spot.normal, where)
            weights = strain_weights(mesh.kind, mesh.nodes[spot.cell], spot.local, along)
            share = 1.0 / (len(spots) * len(spot.cell))  # the mean of the cells that meet there
            np.add.at(row.reshape(-1, 3), mesh.cells[spot.cell], share * weights)
        rows.append(sparse.csr_array(row[None]))
        moved.append(found.distance)
    return sparse.vstack(rows).tocsr(), np.array(moved)


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
    direction = direction / np.linalg.norm(direction)
    angle = float(np.degrees(np.arcsin(min(1.0, abs(float(direction @ normal))))))
    if angle > STEEPEST:
        raise InvalidDesignError(
            f"{where}: its direction points {angle:.0f} degrees out of the surface, whose normal there is "
            f"({', '.join(f'{value + 0.0:.3g}' for value in normal)}); at most {STEEPEST:g} degrees are "
            "allowed."
        )
    inside = direction - (direction @ normal) * normal
    return np.asarray(inside / np.linalg.norm(inside))


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
