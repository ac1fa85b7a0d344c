"""The element and the assembly against known answers, on bodies of their own."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.cells import CellMesh, hexahedra_20
from fe.elements.elasticity import isotropic_compliance
from fe.elements.kinds import HEXAHEDRA_20
from fe.full.factorisation import Factorisation
from fe.structure.mesh import Surface
from fe.structure.nodal_loads import face_areas

FloatArray = NDArray[np.float64]

AXES = 3
X, Y, Z = range(AXES)
_PATCH_GRADIENT = np.array([[1.0, -0.4, 0.3], [0.2, -0.7, 0.5], [-0.6, 0.1, 0.8]]) * 1e-3


class PatchTestErrors(NamedTuple):
    """Largest relative errors of the patch test.

    Attributes
    ----------
    displacement : float
        Error at the interior nodes.
    strain : float
        Error at the centres of the cells.
    """

    displacement: float
    strain: float


def brick(
    lengths: tuple[float, float, float], cells: tuple[int, int, int], distortion: float = 0.0
) -> CellMesh:
    """Return a brick of 20-node hexahedra with positive Jacobians.

    Parameters
    ----------
    lengths : tuple of float
        Edges [m].
    cells : tuple of int
        Number of cells along each edge.
    distortion : float
        Largest move of the interior vertices, as a fraction of a cell.
    """
    vertex_counts = tuple(count + 1 for count in cells)
    grid = np.indices(vertex_counts).reshape(len(cells), -1).T / np.array(cells)
    cell_index = np.indices(cells).reshape(len(cells), -1).T
    corner_index = cell_index[:, np.newaxis] + np.array(HEXAHEDRA_20.corners)
    i, j, k = np.moveaxis(corner_index, 2, 0)
    corners = np.ravel_multi_index((i, j, k), vertex_counts)
    is_inside = np.all((grid > 1e-9) & (grid < 1.0 - 1e-9), axis=1)
    random = np.random.default_rng(0)
    shift = random.uniform(-distortion, distortion, grid.shape) / np.array(cells)
    points = (grid + shift * is_inside[:, np.newaxis]) * np.array(lengths)
    return hexahedra_20(points, corners)


def _uniform_stiffness(
    body: CellMesh, young_modulus: float, poisson_ratio: float
) -> sparse.csr_array:
    """Return the stiffness of a body of one isotropic material."""
    elasticity = np.asarray(
        np.linalg.inv(isotropic_compliance(young_modulus, poisson_ratio)), dtype=np.float64
    )
    return body.stiffness(np.arange(len(body.cells)), elasticity)


def patch_test() -> PatchTestErrors:
    """Return the errors inside a distorted brick with a linear displacement of its surface.

    The linear displacement is the solution inside, too.
    """
    lengths = (1.0, 0.8, 1.2)
    body = brick(lengths, (3, 3, 3), 0.25)
    stiffness = _uniform_stiffness(body, 1.0, 0.3)
    exact = (body.points @ _PATCH_GRADIENT.T).ravel()
    on_surface = np.isclose(body.points, 0.0) | np.isclose(body.points, lengths)
    free = np.flatnonzero(np.repeat(~on_surface.any(axis=1), AXES))
    fixed = np.setdiff1d(np.arange(body.unknowns), free)
    displacement = exact.copy()
    load = -stiffness[free][:, fixed] @ exact[fixed]
    displacement[free] = Factorisation(stiffness[free][:, free]).solve(load)

    (xx, xy, xz), (_, yy, yz), (_, _, zz) = _PATCH_GRADIENT + _PATCH_GRADIENT.T
    exact_strain = np.array([0.5 * xx, 0.5 * yy, 0.5 * zz, yz, xz, xy])
    strain, *_ = np.moveaxis(body.strains(displacement.reshape(-1, AXES)), 1, 0)
    displacement_error = np.abs(displacement - exact).max() / np.abs(exact).max()
    strain_error = np.abs(strain - exact_strain).max() / np.abs(exact_strain).max()
    return PatchTestErrors(float(displacement_error), float(strain_error))


def rigid_body_values() -> FloatArray:
    """Return the eigenvalues (n,) of the stiffness of an unsupported distorted brick.

    They rise, and are relative to the largest.
    """
    body = brick((1.0, 0.8, 1.2), (2, 2, 2), 0.25)
    eigenvalues = np.linalg.eigvalsh(_uniform_stiffness(body, 1.0, 0.3).toarray())
    return np.asarray(eigenvalues / eigenvalues[-1])


def cantilever_check(cells_along: int = 10) -> float:
    """Return the relative difference of a beam's tip deflection to Timoshenko's.

    A shear force bends a clamped beam of square section. Poisson's ratio is zero, so that the clamp
    does not hold back the section. Then the beam theory with the shear coefficient 5/6 is the
    solution to compare with.

    Parameters
    ----------
    cells_along : int
        Number of cells along the beam.
    """
    length = 2.0
    side = 0.1
    young_modulus = 70e9
    force = 100.0
    body = brick((side, length, side), (2, cells_along, 2))
    second_moment = side**4 / 12.0
    bending = force * length**3 / (3.0 * young_modulus * second_moment)
    shear = force * length / (5.0 / 6.0 * 0.5 * young_modulus * side**2)
    deflection = force * _end_deflection(body, young_modulus, 0.0, length, Z)
    return deflection / (bending + shear) - 1.0


def _end_deflection(
    body: CellMesh, young_modulus: float, poisson_ratio: float, length: float, component: int
) -> float:
    """Return the mean displacement of the end of a beam along a unit force at this end.

    Parameters
    ----------
    body : CellMesh
        The beam, clamped at y = 0.
    young_modulus, poisson_ratio : float
        Young's modulus [Pa] and Poisson's ratio.
    length : float
        Length [m]; the force is at y = `length`.
    component : int
        Direction of the force and of the displacement.
    """
    stiffness = _uniform_stiffness(body, young_modulus, poisson_ratio)
    _, corner_y, _ = np.moveaxis(body.corners, -1, 0)
    end_cells = np.flatnonzero(np.isclose(corner_y.max(axis=1), length))
    end = Surface(end_cells, np.full(len(end_cells), _END_FACE))
    _, weights = face_areas(body, end)
    weights /= weights.sum()
    _, y, _ = body.points.T
    free = np.flatnonzero(np.repeat(y > 1e-9, AXES))
    load = np.zeros(body.unknowns)
    load[component::AXES] = weights
    displacement = np.zeros(body.unknowns)
    displacement[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    return float(displacement[component::AXES] @ weights)


_END_FACE = 4  # of a hexahedron, where its second coordinate is one
MACNEAL_HARDER_SHAPES: tuple[str, ...] = ("regular", "trapezoid", "parallelogram")


def macneal_harder_beam(shape: str, *, across_depth: bool) -> float:
    """Return the tip deflection of MacNeal and Harder's straight slender beam over the exact one.

    The beam has six cells along 6 x 0.2 x 0.1, E = 1e7, nu = 0.3, and a unit shear force at its
    end. See R. H. MacNeal and R. L. Harder, "A proposed standard set of problems to test finite
    element accuracy", Finite Elements in Analysis and Design 1 (1985), table 3.

    Parameters
    ----------
    shape : str
        One of `MACNEAL_HARDER_SHAPES`; the sides of the cells lean by 45 degrees.
    across_depth : bool
        Whether the beam bends across its depth of 0.2, in the plane of the lean, or across its
        width of 0.1.
    """
    length = 6.0
    depth = 0.2
    width = 0.1
    regular = brick((depth, length, width), (1, 6, 1))
    corners = regular.cells[:, : len(HEXAHEDRA_20.corners)]
    points = regular.points[: corners.max() + 1].copy()
    x, y, _ = points.T
    line = np.rint(y).astype(int)
    lean_of_shape = {
        "regular": 0.0 * line,
        "trapezoid": (-1.0) ** line,
        "parallelogram": 1.0 + 0.0 * line,
    }
    is_inner_line = (line > 0) & (line < 6)
    points[:, Y] += np.where(is_inner_line, lean_of_shape[shape] * (x - 0.5 * depth), 0.0)
    body = hexahedra_20(points, corners)
    if across_depth:
        return _end_deflection(body, 1e7, 0.3, length, X) / 0.1081
    return _end_deflection(body, 1e7, 0.3, length, Z) / 0.4321
