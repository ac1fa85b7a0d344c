"""Places of a structure where a mass may be added or lost, and patches that may lose stiffness.

They are hypotheses, and no part of the structure file: the sets that the mesh names, and a grid
that is fine enough to say where an engineer has to look.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from fe.runtime.arrays import FloatArray, IntArray

from .affine import AffineStructure
from .matrices import MatrixStructure
from .matrix_design import MatrixLoad, MatrixMass, NodeOutput
from .mesh import StructureMesh
from .nodal_loads import set_weights
from .operators import Structure

GRID_POINTS = 12
"""Largest number of points of the grid at which a mass may be."""
GRID_PATCHES = 12
"""Largest number of patches of the grid that may lose stiffness."""
LEAST_DISTANCE = 0.1
"""Least distance of points of a grid, and of middles of its patches, over the size of the mesh."""
LARGEST_RADIUS = 0.12
"""Radius of a named set of cells, over the size of the mesh, up to which it is a patch."""
SETS_OF_THE_MESHER = "gmsh:"
"""Begin of the names of sets that a mesher makes, and no engineer."""


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
        candidates = list(_places_of_mesh(structure.mesh))
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


def _places_of_mesh(mesh: StructureMesh) -> Iterator[tuple[str, FloatArray]]:
    """Yield names and weights (nodes,) of sets of nodes, then of points of a grid."""
    for name in mesh.node_sets:
        if not name.startswith(SETS_OF_THE_MESHER) and np.all(mesh.node_sets[name] >= 0):
            yield name, set_weights(mesh, name, f"the set {name!r}")
    corners = np.unique(mesh.cells[:, list(mesh.kind.corners)])
    for number in _spread_points(mesh.points[corners], GRID_POINTS, LEAST_DISTANCE * mesh.size):
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


def _spread_points(points: FloatArray, count: int, least_distance: float) -> IntArray:
    """Return the numbers of points that are no nearer to each other than a distance, up to a count.

    Each is the point farthest from those before it, the first the one farthest from the middle.
    """
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    chosen: list[int] = []
    for _ in range(min(count, len(points))):
        chosen.append(int(distance.argmax()))
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = from_last if len(chosen) == 1 else np.minimum(distance, from_last)
        if distance.max() < least_distance:
            break
    return np.array(chosen, dtype=np.int64)


def loss_places(structure: AffineStructure) -> list[LossPlace]:
    """Return the patches of a mesh that may lose stiffness, outside its damage regions.

    These are its small named sets of cells, and compact patches of a grid on all other cells,
    without overlap. Matrices have no cells.
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
        middles = _spread_points(centres, GRID_PATCHES, LEAST_DISTANCE * mesh.size)
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
