"""Changes of a structure that a search may propose: masses, softer patches, loads and gauges.

None of them is part of the structure file. They are proposed at the named sets of the mesh and on a
grid that is fine enough to tell an engineer where to look.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError
from fe.runtime.structural_changes import FITTED_REACH, taylor_factors

from .affine import AffineStructure
from .design import Gauge, MeshLoad
from .gauges import cells_at_gauges, evenly_placed_rosettes, gauge_rows, strain_factors
from .matrices import MatrixStructure
from .matrix_design import MatrixLoad, MatrixMass, NodeOutput
from .mesh import StructureMesh
from .nodal_loads import force_weights, point_weights, set_weights
from .operators import Structure

GRID_POINTS = 36
"""Largest number of points of the grid at which a mass may be."""
GRID_PATCHES = 12
"""Largest number of patches of the grid that may lose stiffness."""
GAUGE_POINTS = 12
"""Largest number of points of the surface at which a gauge may be added."""
ROUNDING_OF_POINTS = 1e-3
"""Rounding of the points in the names of these gauges, relative to the size of the mesh."""
LEAST_DISTANCE = 0.1
"""Least distance between the centres of two patches, relative to the size of the mesh."""
LEAST_DISTANCE_OF_POINTS = 0.07
"""Least distance between two candidate points of a mass, relative to the size of the mesh."""
LARGEST_RADIUS = 0.12
"""Largest radius of a named set of cells that is a patch, relative to the size of the mesh."""
LARGEST_NODE_SHARE = 0.5
"""A named set with this share of all nodes or more is no candidate: it is the structure itself."""
LEAST_SINGULAR_VALUE = 1e-3
"""Relative singular value below which nodes do not determine a derivative of the displacement."""
DERIVATIVES = 5
"""Number of derivatives of a displacement: two first and three second ones along two axes."""
AXES = ("x", "y", "z")
"""Names of the axes."""
LEAST_SINE = 0.1
"""Sine of the angle between a force and an axis below which it is not tilted towards the axis."""
OFFSET_STEP = 0.03
"""Step by which a force is moved for finite differences, relative to the size of the mesh: about as
large as the error of its position."""
GAUGE_STEP = 0.03
"""Step by which a gauge is moved for a finite difference, relative to the size of the mesh.

It is about as large as the error of a gauge's position, and larger than an ordinary cell, since
strains jump from cell to cell.
"""
GAUGE_AXES = {"along": (1.0, 0.0), "across": (0.0, 1.0)}
"""Directions in the surface in which a gauge may lie beside its point, as seen from the gauge."""
SETS_OF_THE_MESHER = "gmsh:"
"""Prefix of the names of sets that the mesher makes, and not an engineer."""
NO_POINTS: IntArray = np.zeros(0, dtype=np.int64)


class MassCandidate(NamedTuple):
    """A location where a mass may be added or missing.

    Attributes
    ----------
    name : str
        The name of a set, a point or a node.
    rows : csr (3, n)
        Rows that give the displacement of the mass along x, y and z.
    point : (3,) array
        The location, or the centre of a set; zero for matrices, which have no places [m].
    reach : float
        How far a node of the structure can lie from the nearest of the points on the grid [m]; zero
        if the mass can lie at the location alone.
    axes : (2, 3) array
        Unit vectors along which the mass may lie beside the point: directions in which the
        structure extends most about it.
    slopes : csr (15, n)
        Derivatives of the displacement by the distances s and t along these axes, three rows each:
        by s, by t, twice by s, by s and t, twice by t.
    """

    name: str
    rows: sparse.csr_array
    point: FloatArray
    reach: float
    axes: FloatArray
    slopes: sparse.csr_array

    def rows_beside(self, along: float, across: float) -> sparse.csr_array:
        """Return the rows (3, n) of a mass that lies beside the point by two distances [m]."""
        factors = np.append(1.0, taylor_factors(along, across))
        pieces = sparse.vstack((self.rows, self.slopes))
        return (sparse.kron(factors[np.newaxis], sparse.eye_array(3)) @ pieces).tocsr()


class LossCandidate(NamedTuple):
    """A patch of cells that may have lost stiffness.

    Attributes
    ----------
    name : str
        The name of a set, or where the centre of the patch is.
    terms : dict of int to csr (n, n)
        The contribution of the patch to each stiffness term, by the term's index.
    gauges : tuple of int
        Numbers of the gauges on the patch.
    """

    name: str
    terms: dict[int, sparse.csr_array]
    gauges: tuple[int, ...]


def mass_places(structure: AffineStructure) -> list[MassCandidate]:
    """List the locations where a mass may be added or missing.

    In a mesh they are its named sets of less than half of the nodes, whose mean displacement the
    mass then follows, and the points of a coarse grid. In a structure of matrices they are the
    nodes that its file names. Locations that the supports hold are left out.
    """
    if isinstance(structure, Structure):
        candidates = list(places_of_mesh(structure.mesh))
    elif isinstance(structure, MatrixStructure):
        candidates = list(_places_of_nodes(structure))
    else:
        candidates = []
    places = []
    for candidate in candidates:
        rows = sparse.kron(sparse.csr_array(candidate.weights[np.newaxis]), sparse.eye_array(3))
        unknown_rows = (rows @ structure.expansion).tocsr()
        slopes = sparse.kron(candidate.slopes, sparse.eye_array(3)) @ structure.expansion
        held_count = len([motion for motion in structure.support_motions if motion.spring == 0.0])
        if abs(unknown_rows[:, : structure.unknowns - held_count]).max() > 0.0:
            places.append(
                MassCandidate(
                    name=candidate.name,
                    rows=unknown_rows,
                    point=candidate.point,
                    reach=candidate.reach,
                    axes=candidate.axes,
                    slopes=slopes.tocsr(),
                )
            )
    return places


class MassPlace(NamedTuple):
    """A location by the nodes of a mesh, or of matrices; see `MassCandidate`.

    Attributes
    ----------
    weights : (nodes,) array
        Weights of the nodes in the displacement of the location.
    slopes : csr (5, nodes)
        The same for the derivatives of the displacement.
    """

    name: str
    weights: FloatArray
    point: FloatArray
    reach: float
    axes: FloatArray
    slopes: sparse.csr_array

    @classmethod
    def fixed(cls, name: str, weights: FloatArray, point: FloatArray) -> "MassPlace":
        """Return a location beside which no mass is looked for."""
        no_slopes = sparse.csr_array((DERIVATIVES, len(weights)))
        return cls(name, weights, point, 0.0, np.eye(3)[:2], no_slopes)

    def point_beside(self, along: float, across: float) -> FloatArray:
        """Return the point (3,) [m] of a mass that lies beside the location by two distances."""
        return np.asarray(self.point + along * self.axes[0] + across * self.axes[1])


def places_of_mesh(mesh: StructureMesh) -> Iterator[MassPlace]:
    """Yield the places of a mesh at which a point mass may be added.

    These are first the named sets of less than half of the nodes, without those that the mesher
    makes, then nodes that are spread evenly over the mesh. A mass
    at one of the latter may also lie beside the node, up to the `reach` of the place: there its
    weights follow from their slopes.
    """
    for name, nodes in mesh.node_sets.items():
        is_place = np.all(nodes >= 0) and len(nodes) < LARGEST_NODE_SHARE * len(mesh.points)
        if is_place and not name.startswith(SETS_OF_THE_MESHER):
            weights = set_weights(mesh, name, f"the set {name!r}")
            yield MassPlace.fixed(name, weights, weights @ mesh.points)
    corner_nodes = np.unique(mesh.cells[:, : len(mesh.kind.corners)])
    grid_numbers = _spread_points(
        mesh.points[corner_nodes], GRID_POINTS, LEAST_DISTANCE_OF_POINTS * mesh.size
    )
    # reach: the largest distance of any node from the nearest of these points
    grid = mesh.points[corner_nodes[grid_numbers]]
    distance_from_grid, _ = KDTree(grid).query(mesh.points)
    reach = float(distance_from_grid.max())
    nodes_nearby = KDTree(mesh.points).query_ball_point(grid, FITTED_REACH * reach)
    for node, neighbours in zip(corner_nodes[grid_numbers].tolist(), nodes_nearby, strict=True):
        weights = np.zeros(len(mesh.points))
        weights[node] = 1.0
        point = mesh.points[node]
        axes, slopes = _slopes_about(mesh.points, node, np.array(neighbours), reach)
        name = f"the point {mesh.describe_point(np.round(point, 9))}"
        yield MassPlace(name, weights, point, reach, axes, slopes)


def _slopes_about(
    points: FloatArray, node: int, neighbours: IntArray, reach: float
) -> tuple[FloatArray, sparse.csr_array]:
    """Return two axes at a node, (2, 3), and the weights of derivatives along them, (5, nodes).

    The derivatives are those of the displacement: d/ds, d/dt, d²/ds², d²/ds dt and d²/dt², with the
    distances s and t along the axes, which are the principal axes of the neighbours. The
    displacements of the neighbours relative to the node are fitted by a polynomial of second order
    in s and t and of first order in the distance u across both. Derivatives that the neighbours do
    not determine, such as those across a single row of nodes, are zero.
    """
    arms = points[neighbours] - points[node]  # (neighbours, 3)
    _, _, axes = np.linalg.svd(arms - arms.mean(axis=0), full_matrices=True)
    s, t, u = axes @ arms.T / reach
    terms = np.column_stack((s, t, s**2 / 2.0, s * t, t**2 / 2.0, u))
    coefficients = np.linalg.pinv(terms, rcond=LEAST_SINGULAR_VALUE)[:DERIVATIVES]
    coefficients /= np.array([reach, reach, reach**2, reach**2, reach**2])[:, np.newaxis]
    weights = sparse.lil_array((DERIVATIVES, len(points)))
    weights[:, neighbours] = coefficients
    weights[:, node : node + 1] -= coefficients.sum(axis=1, keepdims=True)
    return axes[:2], weights.tocsr()


def _places_of_nodes(structure: MatrixStructure) -> Iterator[MassPlace]:
    """Yield each node at which the structure file has a load, a mass or an output."""
    design = structure.design
    named_nodes = []
    rows: tuple[MatrixLoad | MatrixMass | NodeOutput, ...] = (
        *design.load,
        *design.mass,
        *design.displacement,
        *design.acceleration,
    )
    for row in rows:
        if row.node is not None:
            named_nodes.append(row.node)
    for node in dict.fromkeys(named_nodes):
        weights = np.zeros(len(structure.nodes))
        weights[structure.nodes.index(node)] = 1.0
        yield MassPlace.fixed(f"node {node}", weights, np.zeros(3))


def _spread_points(
    points: FloatArray, count: int, least_distance: float, preferred: IntArray = NO_POINTS
) -> IntArray:
    """Choose up to `count` points (P, 3) by farthest-point sampling; return their indices.

    No two chosen points are nearer to each other than `least_distance`. Preferred points come
    first, up to half of the count; without any, the first is the point farthest from the mean.
    """
    chosen: list[int] = []
    distance = np.full(len(points), np.inf)
    for number in preferred.tolist():
        if len(chosen) < count // 2 and distance[number] >= least_distance:
            chosen.append(number)
            distance = np.minimum(distance, np.linalg.norm(points - points[number], axis=1))
    if not chosen:
        distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
        chosen.append(int(distance.argmax()))
        distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)) and distance.max() >= least_distance:
        chosen.append(int(distance.argmax()))
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, from_last)
    return np.array(chosen, dtype=np.int64)


def loss_places(structure: AffineStructure) -> list[LossCandidate]:
    """List the patches of a mesh that may have lost stiffness, outside its damage regions.

    These are its small named sets of cells; the other cells are divided into the Voronoi cells of a
    coarse grid. Where possible the gauges are points of this grid: a loss below a gauge changes its
    strain most, which would not show if the gauge were at the edge of a patch. A structure of
    matrices has no patches.
    """
    if not isinstance(structure, Structure):
        return []
    patches = patches_of_mesh(structure.mesh, structure.design.gauge, structure.region_of)
    pairs = [(term.parameter, term.region) for term in structure.stiffness_terms]
    gauge_cells = cells_at_gauges(structure.mesh, structure.design.gauge)
    places = []
    for name, cells in patches.items():
        terms = {}
        for part_number, pair in enumerate(structure.body.parts):
            cells_of_part = cells[structure.body.part[cells] == part_number]
            if len(cells_of_part):
                terms[pairs.index(pair)] = structure.body.stiffness(cells_of_part)
        gauges = np.flatnonzero(np.isin(gauge_cells, cells)).tolist()
        places.append(LossCandidate(name, terms, tuple(gauges)))
    return places


def patches_of_mesh(
    mesh: StructureMesh, gauges: Sequence[Gauge], region_of: IntArray
) -> dict[str, IntArray]:
    """Return the cells of each patch that may lose stiffness, see `loss_places`.

    Parameters
    ----------
    region_of : (nc,) array of int
        Index of the damage region of each cell, -1 for none.
    """
    # named sets of the mesh that are small enough, and do not overlap others
    is_free_cell = region_of < 0
    patches: dict[str, IntArray] = {}
    for name, cells in mesh.cell_sets.items():
        centres = mesh.centres[cells]
        radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max(initial=0.0)
        is_small = len(cells) > 0 and radius <= LARGEST_RADIUS * mesh.size
        if is_small and is_free_cell[cells].all() and not name.startswith(SETS_OF_THE_MESHER):
            patches[name] = cells
            is_free_cell[cells] = False
    # the remaining cells, in patches around points that are spread evenly
    unnamed_cells = np.flatnonzero(is_free_cell)
    if len(unnamed_cells):
        centres = mesh.centres[unnamed_cells]
        gauge_cells = cells_at_gauges(mesh, gauges)
        centre_cells = _spread_points(
            centres,
            GRID_PATCHES,
            LEAST_DISTANCE * mesh.size,
            preferred=np.searchsorted(unnamed_cells, gauge_cells[is_free_cell[gauge_cells]]),
        )
        _, patch_of = KDTree(centres[centre_cells]).query(centres)
        for number, centre_cell in enumerate(centre_cells):
            name = f"around {mesh.describe_point(np.round(centres[centre_cell], 4))}"
            patches[name] = unnamed_cells[patch_of == number]
    return patches


class LoadChange(NamedTuple):
    """The derivative of a force with respect to its position or direction.

    Attributes
    ----------
    control : str
        The control of the force.
    change : str
        "offset" of its position or "tilt" of its direction.
    axis : str
        The axis along which it is offset, or towards which it is tilted.
    vector : (n,) array
        Derivative of the load per unit of the control, and per metre or radian.
    curvature : (n,) array
        Second derivative of the load by the offset, per unit of the control and square metre; zero
        for a tilt.
    """

    control: str
    change: str
    axis: str
    vector: FloatArray
    curvature: FloatArray


def load_changes(structure: AffineStructure) -> list[LoadChange]:
    """Return how the load vector of each force changes if the force is tilted or offset.

    Only forces whose control is in newtons may change. Each of them may be tilted towards each
    axis; a force at a point may also be offset along each axis, on the surface or inside.
    """
    if not isinstance(structure, Structure):
        return []
    mesh = structure.mesh
    changes = []
    for label, load in structure.design.numbered("load"):
        if load.force is None or structure.control_units.get(load.control or "") != "N":
            continue
        force = np.asarray(load.force)
        weights = force_weights(mesh, load, label)
        for axis, direction in zip(AXES, np.eye(3), strict=True):
            # tilt: a force of the same size, perpendicular to the force and towards the axis
            perpendicular = direction - force * (force @ direction) / (force @ force)
            length = float(np.linalg.norm(perpendicular))
            if length > LEAST_SINE:
                tilted_force = np.linalg.norm(force) * perpendicular / length
                vector = structure.expansion.T @ np.outer(weights, tilted_force).ravel()
                no_curvature = np.zeros_like(vector)
                changes.append(LoadChange(load.control, "tilt", axis, vector, no_curvature))
            # offset: first and second derivative of the load by the distance along the axis
            derivatives = _derivatives_of_weights(mesh, load, direction, label)
            if derivatives is not None:
                vector, curvature = [
                    structure.expansion.T @ np.outer(weights, force).ravel()
                    for weights in derivatives
                ]
                changes.append(LoadChange(load.control, "offset", axis, vector, curvature))
    return [change for change in changes if np.any(change.vector)]


def _derivatives_of_weights(
    mesh: StructureMesh, load: MeshLoad, direction: FloatArray, label: str
) -> tuple[FloatArray, FloatArray] | None:
    """Return first and second derivative (nodes,) of the load's nodal weights along a direction.

    They are those of a parabola through three points: the point of the load, and one on either
    side. If one side lies outside the structure, they are those of a line; if both do, the result
    is None.
    """
    if load.point is None:
        return None
    step = OFFSET_STEP * mesh.size
    weights_at_load = point_weights(mesh, load.point, label)
    difference_quotients = []
    for distance in (step, -step):
        point = np.asarray(load.point) + distance / mesh.unit * direction
        with suppress(InvalidDesignError):
            weights = point_weights(mesh, tuple(point.tolist()), label)
            difference_quotients.append((weights - weights_at_load) / distance)
    if not difference_quotients:
        return None
    slope = 0.5 * (difference_quotients[0] + difference_quotients[-1])
    curvature = (difference_quotients[0] - difference_quotients[-1]) / step
    return slope, curvature


def strains_across(structure: AffineStructure) -> list[sparse.csr_array]:
    """Return the matrices (G, n) of the transverse strains and of the shear strains at G gauges."""
    if not isinstance(structure, Structure):
        no_rows = sparse.csr_array((0, structure.unknowns))
        return [no_rows, no_rows]
    factors = strain_factors(structure.mesh, structure.design)
    _, *across = _strains_at_gauges(structure, structure.design.gauge, factors)
    return across


def _strains_at_gauges(
    structure: Structure, gauges: tuple[Gauge, ...], factors: FloatArray | None = None
) -> list[sparse.csr_array]:
    """Return the matrices (G, n) of the strains along G gauges, of those across, and of the shear.

    The shear strain is 2 e45 - e - e_across, where e is the strain along the gauge, e_across the
    strain at 90 degrees to it, and e45 that at 45 degrees.
    """
    rows = []
    for turn in (0.0, 0.5 * np.pi, 0.25 * np.pi):
        turned, _ = gauge_rows(structure.mesh, gauges, turn, factors=factors)
        rows.append((turned @ structure.expansion).tocsr())
    along, across, halfway = rows
    return [along, across, (2.0 * halfway - along - across).tocsr()]


def possible_gauges(structure: AffineStructure) -> tuple[tuple[str, ...], list[sparse.csr_array]]:
    """Return the names of gauges that a user may add to a mesh, and rows that give their strains.

    They lie at points that are spread evenly over the surface, two at right angles at each.

    Returns
    -------
    names : tuple of str
        The point and the direction of each of H gauges.
    rows : list of csr (H, n)
        The strains along the gauges at these points, those across, and the shear strains.
    """
    if not isinstance(structure, Structure):
        return (), [sparse.csr_array((0, structure.unknowns))] * 3
    mesh = structure.mesh
    gauges: list[Gauge] = []
    for rosette in evenly_placed_rosettes(mesh, GAUGE_POINTS):
        crossed = rosette.model_copy(update={"angles": (0.0, 90.0)})
        gauges.extend(crossed.gauges())
    decimals = int(np.ceil(-np.log10(ROUNDING_OF_POINTS * mesh.size)))
    names = []
    for gauge in gauges:
        point = mesh.describe_point(np.round(mesh.unit * np.array(gauge.point), decimals))
        direction = ", ".join(f"{value + 0.0:.3g}" for value in np.round(gauge.direction, 3))
        names.append(f"{point} along ({direction})")
    return tuple(names), _strains_at_gauges(structure, tuple(gauges))


class GaugeShift(NamedTuple):
    """The derivatives of a gauge's strain with respect to its position.

    Attributes
    ----------
    gauge : str
        Name of the gauge.
    axis : str
        "along" the gauge or "across" it.
    rows : csr (2, n)
        First and second derivative of the strain by the distance [1/m and 1/m2].
    """

    gauge: str
    axis: str
    rows: sparse.csr_array


def gauge_shifts(structure: AffineStructure) -> list[GaugeShift]:
    """Return the derivatives of the strain at each gauge with respect to its position.

    They are those of a parabola through three positions of the gauge. If it would reach over an
    edge on one side, they are those of a line through the other two positions; if on both sides,
    there are none.
    """
    if not isinstance(structure, Structure):
        return []
    mesh = structure.mesh
    step = GAUGE_STEP * mesh.size
    shifts = []
    factors = strain_factors(mesh, structure.design).tolist()
    for gauge, factor in zip(structure.design.gauge, factors, strict=True):
        rows_at_gauge, _ = gauge_rows(mesh, (gauge,))
        for axis, direction in GAUGE_AXES.items():
            difference_quotients = []
            for distance in (step, -step):
                offset = (distance * direction[0], distance * direction[1])
                with suppress(InvalidDesignError):
                    rows, _ = gauge_rows(mesh, (gauge,), offset=offset)
                    difference_quotients.append((rows - rows_at_gauge) / distance)
            if not difference_quotients:
                continue
            # the central difference and the second difference; one quotient alone is a line
            slope = (difference_quotients[0] + difference_quotients[-1]) / 2.0
            curvature = (difference_quotients[0] - difference_quotients[-1]) / step
            derivatives = factor * sparse.vstack((slope, curvature)) @ structure.expansion
            shifts.append(GaugeShift(gauge.name, axis, derivatives.tocsr()))
    return shifts
