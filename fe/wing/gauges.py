"""Strain gauges of the wing, as rows that give strains from nodal displacements."""

from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.elements.elasticity import unit_vector
from fe.runtime.arrays import FloatArray, IntArray

from .mesh import WingMesh


class LinePoints(NamedTuple):
    """Points on a line with the weights of a mean.

    Attributes
    ----------
    positions : (p,) array
        Positions on the line [m].
    weights : (p,) array
        Weights; they sum to one.
    """

    positions: FloatArray
    weights: FloatArray


def averaging_points(middle: float, length: float, lines: FloatArray) -> LinePoints:
    """Return Gauss points and weights for a mean over a length, which mesh lines divide.

    Each interval between mesh lines has Gauss points of its own, because strain jumps at the edge
    of a defect, which is a mesh line: other points would misjudge how much of a gauge lies beyond
    the edge.

    Parameters
    ----------
    middle : float
        The middle of the length [m].
    length : float
        The length [m]; zero for a point.
    lines : (k,) array
        Positions of the mesh lines [m], ascending.
    """
    if length == 0.0:
        return LinePoints(np.array([middle]), np.array([1.0]))
    start = middle - 0.5 * length
    end = middle + 0.5 * length
    is_inside = (lines > start) & (lines < end)
    breaks = np.array([start, *lines[is_inside], end])
    roots, root_weights = np.polynomial.legendre.leggauss(3)
    intervals = np.diff(breaks)[:, np.newaxis]
    starts = breaks[:-1, np.newaxis]
    fractions = 0.5 * (1.0 + roots)
    positions = starts + fractions * intervals
    weights = 0.5 * root_weights * intervals / length
    return LinePoints(positions.ravel(), weights.ravel())


class _SkinPoint(NamedTuple):
    """A point of the skin at which a gauge reads the strain.

    Attributes
    ----------
    weight : float
        Weight of the strain in the mean of the gauge.
    local : (3,) array
        The position of the point in the reference cell.
    """

    gauge: int
    weight: float
    cell: int
    local: FloatArray


def gauge_output(mesh: WingMesh, angle: float = 0.0) -> sparse.csr_array:
    """Return the matrix (gauges, full) [1/m] that gives strains from nodal displacements.

    Kapteyn et al. 2021, eq. (15). The strain is that of the upper skin, on its outer surface or in
    the middle of its thickness, positive in compression. It is averaged over the area of the gauge,
    separately in each interval between mesh lines.

    Parameters
    ----------
    angle : float
        Direction of the gauges in the plane of the skin: the angle [rad] from the spanwise
        direction, positive towards the trailing edge.
    """
    points: list[_SkinPoint] = []
    for gauge in range(len(mesh.design.gauges.positions)):
        points += _gauge_points(mesh, gauge)
    cells = np.array([point.cell for point in points])
    local_positions = np.array([point.local for point in points])
    weights = np.array([point.weight for point in points])
    if mesh.design.gauges.surface == "middle":
        local_positions[:, -1] = 0.5
    along, aft = _directions_in_skin(mesh, cells, local_positions)
    return mesh.strain_rows(
        row=np.array([point.gauge for point in points]),
        weight=-weights,  # positive in compression
        cells=cells,
        local_positions=local_positions,
        direction=np.cos(angle) * along + np.sin(angle) * aft,
    )


def _gauge_points(mesh: WingMesh, gauge: int) -> list[_SkinPoint]:
    """Return the integration points of a gauge, which averages over a rectangle.

    Along the span, the middle of the rectangle keeps its distance to the straight chord line.
    """
    gauges = mesh.design.gauges
    planform = mesh.design.planform
    distance, chord_fraction = gauges.positions[gauge]
    local_chord = planform.chord(distance / planform.semi_span)
    aft_of_straight_line = (chord_fraction - planform.straight_chord_line) * local_chord
    points = []
    span_points = averaging_points(distance, gauges.averaging_spanwise, mesh.span_lines)
    stations = zip(span_points.positions, span_points.weights, strict=True)
    for station, station_weight in stations:
        chord = planform.chord(station / planform.semi_span)
        straight_line = planform.straight_chord_line * chord
        chord_points = averaging_points(
            aft_of_straight_line + straight_line,
            gauges.averaging_chordwise,
            mesh.chord_positions(station),
        )
        positions = zip(chord_points.positions, chord_points.weights, strict=True)
        for distance_aft, chord_weight in positions:
            cell, local_position = mesh.skin_point(station, distance_aft)
            weight = station_weight * chord_weight
            points.append(_SkinPoint(gauge, weight, cell, local_position))
    return points


def _directions_in_skin(
    mesh: WingMesh, cells: IntArray, local_positions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (p, 3) in the skin, along the span and aft, at positions in cells."""
    along_chord, along_span, _ = np.moveaxis(mesh.jacobians_at(cells, local_positions), 2, 0)
    normal = unit_vector(np.cross(along_chord, along_span))
    _, span_component, _ = np.split(normal, 3, axis=1)
    span_direction = np.array([0.0, 1.0, 0.0])
    along = unit_vector(span_direction - span_component * normal)
    return along, np.cross(along, normal)
