"""What may differ from a structure file: masses, stiffness of patches, loads, and gauges.

They are hypotheses, and no part of the structure file. Places are the sets that the mesh names, and
a grid that is fine enough to say where an engineer has to look.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import InvalidDesignError

from .affine import AffineStructure
from .design import MeshLoad
from .gauges import gauge_rows
from .matrices import MatrixStructure
from .matrix_design import MatrixLoad, MatrixMass, NodeOutput
from .mesh import StructureMesh
from .nodal_loads import force_weights, point_weights, set_weights
from .operators import Structure

GRID_POINTS = 36
"""Largest number of points of the grid at which a mass may be."""
GRID_PATCHES = 12
"""Largest number of patches of the grid that may lose stiffness."""
LEAST_DISTANCE = 0.1
"""Least distance of the middles of patches over the size of the mesh."""
LEAST_DISTANCE_OF_POINTS = 0.07
"""Least distance of points of the grid of masses over the size of the mesh."""
LARGEST_RADIUS = 0.12
"""Radius of a named set of cells, over the size of the mesh, up to which it is a patch."""
LARGEST_NODE_SHARE = 0.5
"""Share of all nodes from which on a named set is no place of a mass, but the structure itself."""
AXES = ("x", "y", "z")
"""Names of the axes."""
LEAST_SINE = 0.1
"""Sine of the angle between a force and an axis below which it is not tilted towards the axis."""
OFFSET_STEP = 0.01
"""Step of the place of a force over the size of the mesh, for its derivative."""
GAUGE_STEP = 0.03
"""Step of the place of a gauge over the size of the mesh: about as far as a gauge may be off, and
larger than a cell of an ordinary mesh, whose strains jump from cell to cell."""
GAUGE_AXES = {"along": (1.0, 0.0), "across": (0.0, 1.0)}
"""Directions in the surface in which a gauge may lie beside its point, as seen from the gauge."""
SETS_OF_THE_MESHER = "gmsh:"
"""Begin of the names of sets that a mesher makes, and no engineer."""
NO_POINTS: IntArray = np.zeros(0, dtype=np.int64)


class MassPlace(NamedTuple):
    """A place where a mass may be.

    Attributes
    ----------
    name : str
        Its name: a set, a point or a node.
    rows : csr (3, n)
        Rows that give the displacement of the mass along x, y and z.
    """

    name: str
    rows: sparse.csr_array


class LossPlace(NamedTuple):
    """A patch that may lose stiffness.

    Attributes
    ----------
    name : str
        Its name: a set, or where its middle is.
    terms : dict of int to csr (n, n)
        Its part of each stiffness term, by the number of the term.
    """

    name: str
    terms: dict[int, sparse.csr_array]


def mass_places(structure: AffineStructure) -> list[MassPlace]:
    """Return the places where a mass may be added or lost.

    Of a mesh these are its named sets of nodes, which a mass moves with on average, and points of a
    grid. Of matrices these are the nodes that the structure file names.
    """
    if isinstance(structure, Structure):
        candidates = list(places_of_mesh(structure.mesh))
    elif isinstance(structure, MatrixStructure):
        candidates = list(_places_of_nodes(structure))
    else:
        candidates = []
    places = []
    for name, weights in candidates:
        rows = sparse.kron(sparse.csr_array(weights[np.newaxis]), sparse.eye_array(3))
        free_rows = (rows @ structure.expansion).tocsr()
        held_count = len([motion for motion in structure.support_motions if motion.spring == 0.0])
        if abs(free_rows[:, : structure.unknowns - held_count]).max() > 0.0:
            places.append(MassPlace(name, free_rows))
    return places


def places_of_mesh(mesh: StructureMesh) -> Iterator[tuple[str, FloatArray]]:
    """Yield names and weights (nodes,) of sets of nodes, then of points of a grid."""
    for name, nodes in mesh.node_sets.items():
        is_place = np.all(nodes >= 0) and len(nodes) < LARGEST_NODE_SHARE * len(mesh.points)
        if is_place and not name.startswith(SETS_OF_THE_MESHER):
            yield name, set_weights(mesh, name, f"the set {name!r}")
    corners = np.unique(mesh.cells[:, list(mesh.kind.corners)])
    for number in _spread_points(
        mesh.points[corners], GRID_POINTS, LEAST_DISTANCE_OF_POINTS * mesh.size
    ):
        node = corners[number]
        weights = np.zeros(len(mesh.points))
        weights[node] = 1.0
        yield f"the point {mesh.place(np.round(mesh.points[node], 9))}", weights


def _places_of_nodes(structure: MatrixStructure) -> Iterator[tuple[str, FloatArray]]:
    """Yield names and weights (nodes,) of the nodes that the design names, each once."""
    design = structure.design
    named = []
    rows: tuple[MatrixLoad | MatrixMass | NodeOutput, ...] = (
        *design.load,
        *design.mass,
        *design.displacement,
        *design.acceleration,
    )
    for row in rows:
        if row.node is not None:
            named.append(row.node)
    for node in dict.fromkeys(named):
        weights = np.zeros(len(structure.nodes))
        weights[structure.nodes.index(node)] = 1.0
        yield f"node {node}", weights


def _spread_points(
    points: FloatArray, count: int, least_distance: float, preferred: IntArray = NO_POINTS
) -> IntArray:
    """Return the numbers of points that are no nearer to each other than a distance, up to a count.

    Preferred points come first, up to half of the count. Each further one is the point farthest
    from those before it; without any, the first is the point farthest from the middle.

    Parameters
    ----------
    points : (P, 3) array
        The points.
    count : int
        Largest number of points to choose.
    least_distance : float
        Least distance of two chosen points.
    preferred : array of int
        Numbers of points that are chosen unless they are too near to another.
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


def loss_places(structure: AffineStructure) -> list[LossPlace]:
    """Return the patches of a mesh that may lose stiffness, outside its damage regions.

    These are its small named sets of cells, and compact patches of a grid on all other cells,
    without overlap. Where there are gauges, the grid has patches around them: a loss below a gauge
    changes its strain most, which a patch with the gauge at its edge could not show. Matrices have
    no cells.
    """
    if not isinstance(structure, Structure):
        return []
    mesh = structure.mesh
    is_open = structure.region_of < 0
    patches: dict[str, IntArray] = {}
    for name, cells in mesh.cell_sets.items():
        centres = mesh.centres[cells]
        radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max(initial=0.0)
        is_small = len(cells) > 0 and radius <= LARGEST_RADIUS * mesh.size
        if is_small and is_open[cells].all() and not name.startswith(SETS_OF_THE_MESHER):
            patches[name] = cells
            is_open[cells] = False
    remaining = np.flatnonzero(is_open)
    if len(remaining):
        centres = mesh.centres[remaining]
        cells_at_gauges = _cells_at_gauges(structure)
        middles = _spread_points(
            centres,
            GRID_PATCHES,
            LEAST_DISTANCE * mesh.size,
            preferred=np.searchsorted(remaining, cells_at_gauges[is_open[cells_at_gauges]]),
        )
        _, patch_of = KDTree(centres[middles]).query(centres)
        for number, middle in enumerate(middles):
            name = f"around {mesh.place(np.round(centres[middle], 4))}"
            patches[name] = remaining[patch_of == number]
    pairs = [(term.parameter, term.region) for term in structure.stiffness_terms]
    places = []
    for name, cells in patches.items():
        terms = {}
        for part, pair in enumerate(structure.body.parts):
            cells_of_part = cells[structure.body.part[cells] == part]
            if len(cells_of_part):
                terms[pairs.index(pair)] = structure.body.stiffness(cells_of_part)
        places.append(LossPlace(name, terms))
    return places


def _cells_at_gauges(structure: Structure) -> IntArray:
    """Return the cell (G,) whose middle is nearest to each gauge."""
    mesh = structure.mesh
    points = [mesh.unit * np.asarray(gauge.point) for gauge in structure.design.gauge]
    if not points:
        return NO_POINTS
    _, cells = KDTree(mesh.centres).query(points)
    return np.asarray(cells, dtype=np.int64)


class LoadChange(NamedTuple):
    """How a force changes with its place or its direction.

    Attributes
    ----------
    control : str
        The control of the force.
    change : str
        "offset" of its place or "tilt" of its direction.
    axis : str
        The axis along which it is offset, or towards which it is tilted.
    vector : (n,) array
        Change of the load per unit of the control, and per metre or radian.
    """

    control: str
    change: str
    axis: str
    vector: FloatArray


def load_changes(structure: AffineStructure) -> list[LoadChange]:
    """Return the changes of the forces of a mesh that controls in newtons set.

    A force at a point may act beside it, on the surface and inside; each force may have another
    direction.
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
            across = direction - force * (force @ direction) / (force @ force)
            length = float(np.linalg.norm(across))
            if length > LEAST_SINE:
                tilted = np.linalg.norm(force) * across / length
                vector = structure.expansion.T @ np.outer(weights, tilted).ravel()
                changes.append(LoadChange(load.control, "tilt", axis, vector))
            gradient = _gradient_of_weights(mesh, load, direction, label)
            if gradient is not None:
                vector = structure.expansion.T @ np.outer(gradient, force).ravel()
                changes.append(LoadChange(load.control, "offset", axis, vector))
    return [change for change in changes if np.any(change.vector)]


def _gradient_of_weights(
    mesh: StructureMesh, load: MeshLoad, direction: FloatArray, label: str
) -> FloatArray | None:
    """Return the change (nodes,) of the weights of a load per metre; None off the structure."""
    if load.point is None:
        return None
    step = OFFSET_STEP * mesh.size
    sides = []
    for sign in (1.0, -1.0):
        point = np.asarray(load.point) + sign * step / mesh.unit * direction
        with suppress(InvalidDesignError):
            sides.append((sign, point_weights(mesh, tuple(point.tolist()), label)))
    if not sides:
        return None
    if len(sides) == 1:
        sides.append((0.0, point_weights(mesh, load.point, label)))
    (first_sign, first), (second_sign, second) = sides
    return np.asarray((first - second) / (step * (first_sign - second_sign)))


def strains_across(structure: AffineStructure) -> list[sparse.csr_array]:
    """Return rows (G, n) of the strains across the gauges of a mesh, and of the shear strains.

    With the strain e45 halfway between both directions the shear is 2 e45 - e - e_across.
    """
    if not isinstance(structure, Structure):
        no_rows = sparse.csr_array((0, structure.unknowns))
        return [no_rows, no_rows]
    along = structure.gauge_output
    rows = []
    for turn in (0.5 * np.pi, 0.25 * np.pi):
        turned, _ = gauge_rows(structure.mesh, structure.design.gauge, turn)
        rows.append((turned @ structure.expansion).tocsr())
    across, halfway = rows
    return [across, (2.0 * halfway - along - across).tocsr()]


class GaugeShift(NamedTuple):
    """How the strain of a gauge changes with its place.

    Attributes
    ----------
    axis : str
        "along" the gauge or "across" it.
    rows : csr (2, n)
        First and second derivative of the strain by the distance [1/m and 1/m2].
    """

    gauge: str
    axis: str
    rows: sparse.csr_array


def gauge_shifts(structure: AffineStructure) -> list[GaugeShift]:
    """Return how the strains of the gauges of a mesh change with the places of the gauges.

    The derivatives are those of a parabola through three places. Where a gauge would reach over an
    edge at one side, it is a straight line through the other two.
    """
    if not isinstance(structure, Structure):
        return []
    mesh = structure.mesh
    step = GAUGE_STEP * mesh.size
    shifts = []
    for gauge in structure.design.gauge:
        middle, _ = gauge_rows(mesh, (gauge,))
        for axis, direction in GAUGE_AXES.items():
            rises = []
            for distance in (step, -step):
                offset = (distance * direction[0], distance * direction[1])
                with suppress(InvalidDesignError):
                    rows, _ = gauge_rows(mesh, (gauge,), offset=offset)
                    rises.append((rows - middle) / distance)
            if not rises:
                continue
            slope = (rises[0] + rises[-1]) / 2.0
            curvature = (rises[0] - rises[-1]) / step
            derivatives = sparse.vstack((slope, curvature)) @ structure.expansion
            shifts.append(GaugeShift(gauge.name, axis, derivatives.tocsr()))
    return shifts
