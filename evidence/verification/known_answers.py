"""The element and the assembly against known answers, on bodies of their own."""

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

_PATCH_GRADIENT = np.array([[1.0, -0.4, 0.3], [0.2, -0.7, 0.5], [-0.6, 0.1, 0.8]]) * 1e-3


def brick(
    lengths: tuple[float, float, float], cells: tuple[int, int, int], distortion: float = 0.0
) -> CellMesh:
    """Brick of 20-node hexahedra with positive Jacobians.

    Parameters
    ----------
    lengths : tuple of float
        Edges [m].
    cells : tuple of int
        Number of cells along each edge.
    distortion : float
        Interior vertices move by up to this fraction of a cell.
    """
    grid = np.indices([n + 1 for n in cells]).reshape(3, -1).T / np.array(cells)
    corner = np.indices(cells).reshape(3, -1).T[:, None] + np.array(HEXAHEDRA_20.corners)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(corner, 2, 0)), tuple(n + 1 for n in cells))
    inside = np.all((grid > 1e-9) & (grid < 1.0 - 1e-9), axis=1)
    shift = np.random.default_rng(0).uniform(-distortion, distortion, grid.shape) / np.array(cells)
    points = (grid + shift * inside[:, None]) * np.array(lengths)
    return hexahedra_20(points, numbers)


def _uniform_stiffness(body: CellMesh, young_modulus: float, poisson_ratio: float) -> sparse.csr_array:
    elasticity = np.asarray(
        np.linalg.inv(isotropic_compliance(young_modulus, poisson_ratio)), dtype=np.float64
    )
    return body.stiffness(np.arange(len(body.cells)), elasticity)


def patch_test() -> tuple[float, float]:
    """Impose a linear displacement on the surface of a distorted brick; it must hold inside.

    Returns
    -------
    displacement, strain : float
        Largest errors over the interior nodes and over the centres of the cells, relative.
    """
    body = brick((1.0, 0.8, 1.2), (3, 3, 3), 0.25)
    stiffness = _uniform_stiffness(body, 1.0, 0.3)
    points = body.points
    exact = (points @ _PATCH_GRADIENT.T).ravel()
    edge = np.isclose(points, 0.0) | np.isclose(points, [1.0, 0.8, 1.2])
    free = np.flatnonzero(np.repeat(~edge.any(axis=1), 3))
    fixed = np.setdiff1d(np.arange(body.unknowns), free)
    found = exact.copy()
    found[free] = Factorisation(stiffness[free][:, free]).solve(-stiffness[free][:, fixed] @ exact[fixed])
    strain = body.strains(found.reshape(-1, 3))[:, 0]
    symmetric = _PATCH_GRADIENT + _PATCH_GRADIENT.T
    expected = np.array([*(0.5 * np.diag(symmetric)), symmetric[1, 2], symmetric[0, 2], symmetric[0, 1]])
    moved, strained = np.abs(found - exact).max(), np.abs(strain - expected).max()
    return float(moved / np.abs(exact).max()), float(strained / np.abs(expected).max())


def rigid_body_values() -> FloatArray:
    """Eigenvalues (n,) of the stiffness of an unsupported distorted brick over the largest, rising."""
    body = brick((1.0, 0.8, 1.2), (2, 2, 2), 0.25)
    values = np.linalg.eigvalsh(_uniform_stiffness(body, 1.0, 0.3).toarray())
    return np.asarray(values / values[-1])


def cantilever_check(cells_along: int = 10) -> float:
    """Bend a clamped beam of square section by a shear force: deflection over Timoshenko's, less one.

    Poisson's ratio is zero, so that the clamp does not hold back the section and the beam theory with the
    shear coefficient 5/6 is the solution to compare with.
    """
    length, side, modulus, force = 2.0, 0.1, 70e9, 100.0
    body = brick((side, length, side), (2, cells_along, 2))
    second_moment = side**4 / 12.0
    bending = force * length**3 / (3.0 * modulus * second_moment)
    shear = force * length / (5.0 / 6.0 * 0.5 * modulus * side**2)
    bent = force * _end_deflection(body, modulus, 0.0, length, 2)
    return bent / (bending + shear) - 1.0


def _end_deflection(
    body: CellMesh, young_modulus: float, poisson_ratio: float, length: float, component: int
) -> float:
    """Mean displacement of the end y = `length` along a unit force there; the other end is clamped."""
    stiffness = _uniform_stiffness(body, young_modulus, poisson_ratio)
    on_end = np.flatnonzero(np.isclose(body.corners[:, :, 1].max(axis=1), length))
    _, shares = face_areas(body, Surface(on_end, np.full(len(on_end), _END_FACE)))
    shares /= shares.sum()
    free = np.flatnonzero(np.repeat(body.points[:, 1] > 1e-9, 3))
    load, found = np.zeros(body.unknowns), np.zeros(body.unknowns)
    load[component::3] = shares
    found[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    return float(found[component::3] @ shares)


_END_FACE = 4  # of a hexahedron, where its second coordinate is one
MACNEAL_HARDER_SHAPES: tuple[str, ...] = ("regular", "trapezoid", "parallelogram")


def macneal_harder_beam(shape: str, *, across_depth: bool) -> float:
    """Tip deflection of MacNeal and Harder's straight slender beam over the exact one.

    Six cells along 6 x 0.2 x 0.1, E = 1e7, nu = 0.3, a unit shear force at the end; R. H. MacNeal and
    R. L. Harder, "A proposed standard set of problems to test finite element accuracy", Finite Elements in
    Analysis and Design 1 (1985), table 3.

    Parameters
    ----------
    shape : str
        One of `MACNEAL_HARDER_SHAPES`; the sides of the cells lean by 45 degrees.
    across_depth : bool
        Bend across the depth of 0.2 (in the plane of the lean), otherwise across the width of 0.1.
    """
    length, depth, width = 6.0, 0.2, 0.1
    regular = brick((depth, length, width), (1, 6, 1))
    points = regular.points[: regular.cells[:, :8].max() + 1].copy()
    line = np.rint(points[:, 1]).astype(int)
    lean = {"regular": 0.0 * line, "trapezoid": (-1.0) ** line, "parallelogram": 1.0 + 0.0 * line}[shape]
    inside = (line > 0) & (line < 6)
    points[:, 1] += np.where(inside, lean * (points[:, 0] - 0.5 * depth), 0.0)
    body = hexahedra_20(points, regular.cells[:, :8])
    component, exact = (0, 0.1081) if across_depth else (2, 0.4321)
    return _end_deflection(body, 1e7, 0.3, length, component) / exact
