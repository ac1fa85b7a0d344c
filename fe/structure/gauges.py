"""Strain gauges on the surface of a mesh, as rows that give strains from nodal displacements."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from fe.elements.elasticity import unit_vector
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError
from fe.runtime.patch import RegionStiffnessLoss

from .design import Gauge, MeshDesign, Rosette
from .location import SurfacePoint, on_surface
from .mesh import StructureMesh

STEEPEST = 30.0
"""Largest angle between a gauge's direction and the surface, on which the direction is projected
[degrees]."""
_POINTS_ALONG = 20
"""Points along a gauge that has a length."""
_POINTS_ACROSS = 10
"""Points across a gauge that has a width."""


class _GaugeStrain(NamedTuple):
    """A strain at one point in one cell, which a gauge averages with others.

    Attributes
    ----------
    weight : float
        Weight of the strain in the mean of the gauge.
    local : (3,) array
        The local position in the cell.
    direction : (3,) array
        Unit vector of the normal strain.
    """

    gauge: int
    weight: float
    cell: int
    local: FloatArray
    direction: FloatArray


def cells_at_gauges(mesh: StructureMesh, gauges: Sequence[Gauge]) -> IntArray:
    """Return the cell (G,) whose centre is nearest to each gauge."""
    points = [mesh.unit * np.asarray(gauge.point) for gauge in gauges]
    if not points:
        return np.empty(0, dtype=np.int64)
    _, cells = KDTree(mesh.centres).query(points)
    return np.asarray(cells, dtype=np.int64)


def strain_factors(mesh: StructureMesh, design: MeshDesign) -> FloatArray:
    """Return the strain (G,) under each gauge over the mean strain of the cells about it.

    They differ where these cells lost stiffness over another length than their own.
    """
    factors = np.ones(len(design.gauge))
    cells = cells_at_gauges(mesh, design.gauge)
    for label, loss in design.numbered("stiffness_loss"):
        is_on_set = np.isin(cells, mesh.cells_of(loss.set, label))
        change = RegionStiffnessLoss(loss.set, loss.fraction, loss.extent)
        factors[is_on_set] *= change.strain_over_mean
    return factors


def gauge_rows(
    mesh: StructureMesh,
    gauges: tuple[Gauge, ...],
    turn: float = 0.0,
    offset: tuple[float, float] = (0.0, 0.0),
    factors: FloatArray | None = None,
) -> tuple[sparse.csr_array, FloatArray]:
    """Return rows that give the strains of gauges from nodal displacements.

    A gauge without a length reads the strain at its point, the mean of the cells that meet there.
    A length is averaged over 20 points along the gauge and a width over 10 points across it, each
    projected on the surface.

    Parameters
    ----------
    turn : float
        Angle from the gauge's direction to that of the strain, about the outward normal [rad].
    offset : tuple of float
        Distance by which each gauge is moved on the surface, along itself and across [m].
    factors : (gauges,) array, optional
        Strain that each gauge reads over that of the mesh, see `strain_factors`; one by default.

    Returns
    -------
    rows : csr (gauges, full)
        The rows, positive in tension [1/m].
    moved : (gauges,) array
        The distance of each point from the surface, on which it is projected [m].

    Raises
    ------
    InvalidDesignError
        If a gauge lies off the surface, reaches over its edge, or points out of it.
    """
    if not gauges:
        return sparse.csr_array((0, mesh.unknowns)), np.empty(0)
    strains: list[_GaugeStrain] = []
    moved = []
    for number, gauge in enumerate(gauges):
        where = f"gauge[{number + 1}] ({gauge.name})"
        factor = 1.0 if factors is None else float(factors[number])
        point = mesh.unit * np.asarray(gauge.point)
        if any(offset):
            along, across = gauge_axes(mesh, gauge, where)
            point = point + offset[0] * along + offset[1] * across
        middle = on_surface(mesh, point, f"{where}: the point {mesh.describe_point(point)}")
        direction = _projected_direction(np.asarray(gauge.direction), middle.normal, where)
        surface_points = [middle]
        if gauge.length or gauge.width:
            surface_points = _averaging_points(mesh, gauge, point, direction, middle.normal, where)
        for surface_point in surface_points:
            along = _projected_direction(direction, surface_point.normal, where)
            across = np.cross(surface_point.normal, along)
            local_direction = np.cos(turn) * along + np.sin(turn) * across
            # the mean of the points, and of the cells that meet at each of them
            cell_count = len(surface_point.cell)
            weight = factor / (len(surface_points) * cell_count)
            for cell, local_position in zip(surface_point.cell, surface_point.local, strict=True):
                strain = _GaugeStrain(
                    gauge=number,
                    weight=weight,
                    cell=cell,
                    local=local_position,
                    direction=local_direction,
                )
                strains.append(strain)
        moved.append(middle.distance)
    rows = mesh.strain_rows(
        row=np.array([strain.gauge for strain in strains]),
        weight=np.array([strain.weight for strain in strains]),
        cells=np.array([strain.cell for strain in strains]),
        local_positions=np.array([strain.local for strain in strains]),
        direction=np.array([strain.direction for strain in strains]),
    )
    return rows, np.array(moved)


def gauge_axes(mesh: StructureMesh, gauge: Gauge, where: str) -> tuple[FloatArray, FloatArray]:
    """Return tangential unit vectors (3,) along a gauge and across it.

    The second is the cross product of the outward normal of the surface and the first. `where` is
    the name of the gauge, for error messages.

    Raises
    ------
    InvalidDesignError
        If the gauge lies off the surface, or points out of it.
    """
    point = mesh.unit * np.asarray(gauge.point)
    middle = on_surface(mesh, point, f"{where}: the point {mesh.describe_point(point)}")
    along = _projected_direction(np.asarray(gauge.direction), middle.normal, where)
    return along, np.cross(middle.normal, along)


def _averaging_points(
    mesh: StructureMesh,
    gauge: Gauge,
    point: FloatArray,
    direction: FloatArray,
    normal: FloatArray,
    where: str,
) -> list[SurfacePoint]:
    """Return the points of the surface over which a gauge averages, on a grid of its area.

    `point` is the middle of the gauge [m]; `direction` and `normal` are unit vectors along it and
    out of the surface. Raises `InvalidDesignError` if the gauge reaches over the edge of the
    surface.
    """
    length = mesh.unit * gauge.length
    width = mesh.unit * gauge.width
    across = np.cross(normal, direction)
    width_words = f" and {gauge.width:g} {mesh.unit_name} wide" if gauge.width else ""
    over_edge = (
        f"{where}: {gauge.length:g} {mesh.unit_name} long{width_words}, the gauge reaches over the "
        "edge; its point"
    )

    def project_grid(
        along_fractions: FloatArray, across_fractions: FloatArray
    ) -> list[SurfacePoint]:
        points = []
        for across_fraction, along_fraction in product(
            across_fractions if width else np.zeros(1), along_fractions if length else np.zeros(1)
        ):
            offset = along_fraction * length * direction + across_fraction * width * across
            position = point + offset
            points.append(
                on_surface(mesh, position, f"{over_edge} {mesh.describe_point(position)}")
            )
        return points

    averaging_points = project_grid(_middles(_POINTS_ALONG), _middles(_POINTS_ACROSS))
    ends = np.array([-0.5, 0.5])
    project_grid(ends, ends)  # refuses corners that lie over the edge
    return averaging_points


def _middles(count: int) -> FloatArray:
    """Return the midpoints (count,) of equal intervals of -0.5 to 0.5."""
    return (np.arange(count) + 0.5) / count - 0.5


def _projected_direction(direction: FloatArray, normal: FloatArray, where: str) -> FloatArray:
    """Project a direction (3,) on the surface with a unit normal (3,), and normalise it.

    Raises `InvalidDesignError` if it points out of the surface by more than `STEEPEST`.
    """
    direction = unit_vector(direction)
    sine = min(1.0, abs(float(direction @ normal)))
    angle = float(np.degrees(np.arcsin(sine)))
    if angle > STEEPEST:
        normal_words = ", ".join(f"{value + 0.0:.3g}" for value in normal)
        raise InvalidDesignError(
            f"{where}: its direction points {angle:.0f} degrees out of the surface, whose normal "
            f"there is ({normal_words}); at most {STEEPEST:g} degrees are allowed."
        )
    return unit_vector(direction - (direction @ normal) * normal)


def evenly_placed_rosettes(mesh: StructureMesh, count: int) -> list[Rosette]:
    """Return up to `count` rosettes, distributed evenly over the faces of the surface.

    Their positions are the faces nearest to the centres of k-means clusters; there are fewer
    rosettes if several would lie on one face. They are named `spread_1`, `spread_2` and so on.
    """
    from scipy.cluster.vq import kmeans2, vq

    face_centres = mesh.face_spheres.centre
    cluster_count = min(count, len(face_centres))
    cluster_centres, _ = kmeans2(face_centres, cluster_count, minit="++", rng=0)
    nearest_faces, _ = vq(cluster_centres, face_centres)
    rosettes = []
    for number, face in enumerate(np.unique(nearest_faces).tolist(), start=1):
        centre = face_centres[face]
        normal = on_surface(mesh, centre, "a face").normal
        # the coordinate axis that is most tangential, projected on the surface
        most_tangential = np.argmin(np.abs(normal))
        first_axis = np.eye(3)[most_tangential]
        first_axis -= (first_axis @ normal) * normal
        second_axis = np.cross(normal, first_axis)
        point = centre / mesh.unit
        rosette = Rosette(
            name=f"spread_{number}",
            point=tuple(point.tolist()),
            axes=(tuple(first_axis.tolist()), tuple(second_axis.tolist())),
        )
        rosettes.append(rosette)
    return rosettes
