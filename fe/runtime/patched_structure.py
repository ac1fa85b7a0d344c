"""Stiffness, mass and modes of the wing in one state and under one set of changes.

NumPy and relative imports only: this file is copied into the FMU. The equations are in `docs/patches.md`.
"""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .patch_arrays import PatchArrays

FloatArray = npt.NDArray[np.float64]

ITERATIONS = 3
"""Steps of the subspace iteration for the modes of a patched wing."""
HELD = 1e-7
"""Part of a static shape, relative to it, below which a basis of motion holds it already."""


class StructureTerms(NamedTuple):
    """What the matrices of a structure are the sum of."""

    theta: FloatArray  # (K + 2,) of the stiffness terms
    strips: tuple[tuple[float, FloatArray], ...]  # what is added of a strip's part, its stiffness (n, n)
    spring: float  # added to the root's flapping spring
    masses: tuple[float, float]  # servo, pitot
    points: tuple[tuple[float, FloatArray], ...]  # point mass, weights (P,) of its station


class Modes(NamedTuple):
    """Modes that move: angular frequencies (M,) [rad/s], shapes (n, M), displacements to modes (M, n)."""

    frequency: FloatArray
    shapes: FloatArray
    to_modes: FloatArray


class PatchedStructure:
    """Stiffness and mass of the wing at one state and under one set of changes.

    Parameters
    ----------
    arrays : PatchArrays
        The wing for patches.
    terms : StructureTerms
        State and changes.

    Attributes
    ----------
    stiffness, mass : (n, n) ndarray
        In the basis of the arrays.
    """

    def __init__(self, arrays: PatchArrays, terms: StructureTerms) -> None:
        self._arrays, self._terms = arrays, terms

    @cached_property
    def stiffness(self) -> FloatArray:
        """Stiffness (n, n)."""
        arrays, terms = self._arrays, self._terms
        stiffness = np.tensordot(terms.theta, arrays.stiffness, 1)
        for factor, strip in terms.strips:
            stiffness += factor * strip
        if terms.spring != 0.0:
            stiffness += terms.spring * np.multiply.outer(arrays.flap_row, arrays.flap_row)
        return np.asarray(stiffness)

    @cached_property
    def mass(self) -> FloatArray:
        """Mass (n, n)."""
        arrays = self._arrays
        servo, pitot = self._terms.masses
        mass = arrays.mass[0] + servo * arrays.mass[1] + pitot * arrays.mass[2]
        for added, weights in self._terms.points:
            for rows in arrays.line_rows[:3]:
                row = weights @ rows
                mass += added * np.multiply.outer(row, row)
        return np.asarray(mass)

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.stiffness))

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (n,) or (n, k)."""
        return np.asarray(self._inverse @ loads)

    def modes(self, count: int, held: FloatArray | None = None) -> Modes:
        """Return the first undamped modes, Kapteyn et al. 2021, eq. (16); the tip moves up in each of them.

        The basis that they are found in holds the static shapes of the rows `held` (s, n) as well.
        """
        solutions = None if held is None else self.static(held.T)
        basis = motion_basis(self.static, self.mass, self._arrays.start_shapes, solutions)
        # M x = K x / w^2: the low modes are the largest eigenvalues, which keep all their digits
        to_standard = np.linalg.inv(np.linalg.cholesky(_symmetric(basis.T @ self.stiffness @ basis)))
        mass = _symmetric(basis.T @ self.mass @ basis)
        inverse_square, vectors = np.linalg.eigh(_symmetric(to_standard @ mass @ to_standard.T))
        inverse_square = inverse_square[::-1][:count]
        shapes = basis @ (to_standard.T @ vectors[:, ::-1][:, :count] / np.sqrt(inverse_square))
        shapes = shapes * np.where(self._arrays.tip_row @ shapes < 0.0, -1.0, 1.0)
        return Modes(1.0 / np.sqrt(inverse_square), shapes, shapes.T @ self.mass)


def motion_basis(
    static: Callable[[FloatArray], FloatArray],
    mass: FloatArray,
    start: FloatArray,
    solutions: FloatArray | None = None,
) -> FloatArray:
    """Return a basis of the first modes of a structure, by subspace iteration.

    Parameters
    ----------
    static : callable
        K^-1 of loads (n, k).
    mass : (n, n) ndarray
        M.
    start : (n, r) ndarray
        Modes of a structure near by.
    solutions : (n, s) ndarray, optional
        Static shapes that the basis is to hold as well.

    Returns
    -------
    (n, r + s) ndarray
        Orthonormal; fewer where the modes or other shapes hold a static shape already.
    """
    basis = start
    for _ in range(ITERATIONS):
        basis = np.linalg.qr(static(mass @ basis))[0]
    if solutions is None:
        return np.asarray(basis)
    for shape in (solutions / np.linalg.norm(solutions, axis=0)).T:
        # a static shape is held already but for a small part: two passes
        rest = shape - basis @ (basis.T @ shape)
        rest = rest - basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        # what is held already, or given twice, would add a direction of rounding
        if size > HELD:
            basis = np.concatenate((basis, rest[:, np.newaxis] / size), axis=1)
    return np.asarray(basis)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))
