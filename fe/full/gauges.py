"""Gauge strains as weights of nodal displacements: Kapteyn et al. 2021, eq. (15)."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.wing.mesh import SurfacePoint, WingMesh

from .assembly import Discretisation, point_jacobians

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def patch_pieces(middle: float, length: float, lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p,) and weights (p,) of the mean over a length, piece by piece between mesh lines.

    Strain jumps at the edge of a defect, which is a mesh line: points that do not know of it misjudge how
    much of a patch lies beyond.
    """
    if length == 0.0:
        return np.array([middle]), np.array([1.0])
    start, end = middle - 0.5 * length, middle + 0.5 * length
    breaks = np.array([start, *lines[(lines > start) & (lines < end)], end])
    line, weight = np.polynomial.legendre.leggauss(3)
    pieces = np.diff(breaks)[:, None]
    points = breaks[:-1, None] + 0.5 * (1.0 + line) * pieces
    return points.ravel(), (0.5 * weight * pieces / length).ravel()


def gauge_output(mesh: WingMesh, discretisation: Discretisation) -> sparse.csr_array:
    """Strain of each gauge, csr (gauges, full) [1/m]: eq. (15) at the true gauge points.

    The strain along the span of the upper skin, on its outer surface or in the middle of its thickness,
    averaged over the gauge's patch piece by piece between the mesh lines, positive in compression.
    """
    design = mesh.design
    gauges, plan = design.gauges, design.planform
    owner: list[int] = []
    share: list[float] = []
    points: list[SurfacePoint] = []
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        # The patch is a rectangle: the same distances fore and aft of the gauge's own chord line.
        middle = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
        for place, span_weight in zip(
            *patch_pieces(distance, gauges.averaging_spanwise, mesh.span_lines), strict=True
        ):
            lead = plan.straight_chord_line * plan.chord(place / plan.semi_span)
            _, _, lines = mesh.upper_skin_lines(place)
            behind = patch_pieces(middle + lead, gauges.averaging_chordwise, lines)
            for chordwise, chord_weight in zip(*behind, strict=True):
                owner.append(gauge)
                share.append(span_weight * chord_weight)
                points.append(mesh.skin_point(place, chordwise))
    cells = np.array([point.cell for point in points])
    local = np.array([point.local for point in points])
    if gauges.surface == "middle":
        local[:, 2] = 0.5
    dofs, weights = discretisation.strain_along(cells, local, _span_direction(mesh, cells, local))
    weights = -np.array(share)[:, None] * weights
    rows = np.repeat(owner, dofs.shape[1])
    return sparse.coo_array(
        (weights.ravel(), (rows, dofs.ravel())), shape=(len(gauges.positions), discretisation.unknowns)
    ).tocsr()


def _span_direction(mesh: WingMesh, cells: IntArray, local: FloatArray) -> FloatArray:
    """Find the unit direction (p, 3) along the span in the surface, at one point of each of p cells."""
    jacobian = point_jacobians(mesh.corners[cells], local)
    normal = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = np.array([0.0, 1.0, 0.0]) - normal[:, 1:2] * normal
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))
