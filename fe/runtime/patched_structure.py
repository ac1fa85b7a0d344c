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


class Modes(NamedTuple):
    """Modes that move: angular frequencies (M,) [rad/s], shapes (n, M), displacements to modes (M, n)."""

    angular_frequency: FloatArray
    shapes: FloatArray
    to_modes: FloatArray

    @property
    def frequency(self) -> FloatArray:
        """Natural frequencies (M,) [Hz]."""
        return np.asarray(self.angular_frequency / (2.0 * np.pi))


class PatchedStructure:
    """Stiffness and mass (n, n) of the wing at one state and under one set of changes.

    Parameters
    ----------
    arrays : PatchArrays
        The wing for patches, in whose basis they are.
    stiffness, mass : (n, n) ndarray
        As `fe.runtime.patched_wing.PatchedWing` gives them.
    """

    def __init__(self, arrays: PatchArrays, stiffness: FloatArray, mass: FloatArray) -> None:
        self._arrays, self.stiffness, self.mass = arrays, stiffness, mass

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
