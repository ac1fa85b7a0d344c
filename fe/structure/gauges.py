"""Strain gauges on the surface of a mesh, as rows on the nodal displacements."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.cells import strain_weights
from fe.runtime.errors import InvalidDesignError

from .design import Gauge, Rosette
from .location import Locator, SurfacePoint
from .mesh import StructureMesh

FloatArray = NDArray[np.float64]

STEEPEST = 30.0
"""Largest angle [degrees] between a gauge's direction and the surface; less is turned into the surface."""
_ALONG, _ACROSS = 20, 10  # points of a gauge that has a length, a width


class GaugePlace(NamedTuple):
    """Where a gauge came to lie.

    Attributes
    ----------
    point, direction, normal : (3,)
        Its place on the surface [m], its direction in the surface, and the outward normal there.
    moved : float
        Distance [m] from the place that was asked for.
    """

    point: FloatArray
    direction: FloatArray
    normal: FloatArray
    moved: float


def gauge_rows(
    mesh: StructureMesh, locator: Locator, gauges: tuple[Gauge, ...]
) -> tuple[sparse.csr_array, tuple[GaugePlace, ...]]:
    """Strain rows (gauges, full) [1/m], positive in tension, and where the gauges lie.

    A gauge without a length reads the strain at its point, the mean of the cells that meet there; one with
    a length reads the mean of 20 points along it, one with a width of 10 across, each put onto the surface.

    Raises
    ------
    InvalidDesignError
        If a gauge lies off the surface, reaches over its edge, or points out of it.
    """
    rows, places = [sparse.csr_array((0, mesh.unknowns))], []
    for number, gauge in enumerate(gauges, start=1):
        where = f"gauge[{number}] ({gauge.name})"
        point = mesh.unit * np.asarray(gauge.point)
        found = locator.on_surface(point, f"{where}: the point {mesh.place(point)}")
        direction = _in_surface(np.asarray(gauge.direction), found.normal, where)
        spots = [found]
        if gauge.length or gauge.width:
            inside, corners = _spots(mesh, gauge, direction, np.cross(found.normal, direction))
            wide = f" and {gauge.width:g} {mesh.unit_name} wide" if gauge.width else ""
            spots = [
                locator.on_surface(
                    point + off,
                    f"{where}: {gauge.length:g} {mesh.unit_name} long{wide}, the gauge reaches over the "
                    f"edge; its point {mesh.place(point + off)}",
                )
                for off in (*inside, *corners)
            ][: len(inside)]
        row = np.zeros(mesh.unknowns)
        for spot in spots:
            _add_strain(mesh, spot, _in_surface(direction, spot.normal, where), 1.0 / len(spots), row)
        rows.append(sparse.csr_array(row[None]))
        values, _ = mesh.kind.shape_functions(found.local[:1])
        places.append(
            GaugePlace(values[0] @ mesh.nodes[found.cell[0]], direction, found.normal, found.distance)
        )
    return sparse.vstack(rows).tocsr(), tuple(places)


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


def _add_strain(
    mesh: StructureMesh, spot: SurfacePoint, direction: FloatArray, share: float, row: FloatArray
) -> None:
    """Add the strain along a direction, the mean of the cells at a spot, to a row (full,)."""
    weights = strain_weights(mesh.kind, mesh.nodes[spot.cell], spot.local, direction)
    np.add.at(row.reshape(-1, 3), mesh.cells[spot.cell], share / len(spot.cell) * weights)


def spread_rosettes(locator: Locator, count: int) -> list[Rosette]:
    """Return rosettes spread evenly over the faces of the surface, `spread_1` and on.

    Parameters
    ----------
    locator : Locator
        Of the mesh.
    count : int
        At most how many rosettes; fewer where several would come to lie on one face.
    """
    from scipy.cluster.vq import kmeans2, vq

    centre, _ = locator.faces
    near, _ = kmeans2(centre, min(count, len(centre)), minit="++", rng=0)
    found = []
    for number, face in enumerate(np.unique(vq(near, centre)[0]).tolist(), start=1):
        normal = locator.on_surface(centre[face], "a face").normal
        first = np.eye(3)[np.argmin(np.abs(normal))]
        first -= (first @ normal) * normal
        axes = tuple(first.tolist()), tuple(np.cross(normal, first).tolist())
        point = tuple((centre[face] / locator.mesh.unit).tolist())
        found.append(Rosette(name=f"spread_{number}", point=point, axes=axes))
    return found
