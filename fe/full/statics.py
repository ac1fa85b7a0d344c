"""Static response of the full model: Kapteyn et al. 2021, eqs. (13) and (15)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import norm

from fe.runtime.errors import SolutionError
from fe.runtime.state import Losses

from .cholesky import Cholesky
from .operators import AffineOperators

FloatArray = NDArray[np.float64]

BACKWARD_ERROR_LIMIT = 1e-12
"""Largest backward error max|b - K u| / (|K| max|u| + max|b|) of an accepted solution, in maximum norms."""
CORRECTION_LIMIT = 1e-4
"""Largest change |du| / |u| that one step of iterative refinement may still make.

Thin cells make the condition number about 1e10, so that about 1e-6 is what double precision reaches.
"""


class Factorisation:
    """Factorised symmetric positive definite matrix.

    Parameters
    ----------
    matrix : csr or csc (n, n)
        The matrix; a copy of it is kept for the residual.

    Raises
    ------
    SolutionError
        If the matrix is not positive definite.
    """

    def __init__(self, matrix: sparse.sparray) -> None:
        self._matrix = matrix.tocsr()
        self._norm = float(norm(self._matrix, np.inf))
        try:
            self._factors = Cholesky(self._matrix)
        except SolutionError as error:
            raise SolutionError(
                "The stiffness matrix cannot be factorised; some part of the structure is not held or has no "
                f"stiffness. {error}"
            ) from None

    def raw_solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k) without the residual check, for iterations that check their own."""
        return self._factors.solve(right_hand_side)

    def whitened(self, right_hand_side: FloatArray) -> FloatArray:
        """Vectors (n,) or (n, k) of the length that functionals have in the norm dual to the matrix."""
        return self._factors.whitened(right_hand_side)

    def solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k), refined once, its backward error and its accuracy checked.

        Raises
        ------
        SolutionError
            If the backward error exceeds `BACKWARD_ERROR_LIMIT` or refinement still changes the solution by
            more than `CORRECTION_LIMIT`.
        """
        solution = self.raw_solve(right_hand_side)
        correction = self.raw_solve(right_hand_side - self._matrix @ solution)
        solution = solution + correction
        error = self.backward_error(solution, right_hand_side)
        change = float(np.linalg.norm(correction)) / max(float(np.linalg.norm(solution)), 1e-300)
        if not (error <= BACKWARD_ERROR_LIMIT and change <= CORRECTION_LIMIT):
            raise SolutionError(
                f"The static solution has a backward error of {error:.2g} (at most {BACKWARD_ERROR_LIMIT:g}) "
                f"and is accurate to {change:.2g} (at most {CORRECTION_LIMIT:g}); the stiffness matrix is "
                "nearly singular, some part of the structure is hardly held."
            )
        return solution

    def backward_error(self, solution: FloatArray, right_hand_side: FloatArray) -> float:
        """Backward error max|b - K u| / (|K| max|u| + max|b|), in maximum norms (0 for a zero load)."""
        scale = self._norm * float(np.abs(solution).max()) + float(np.abs(right_hand_side).max())
        residual = float(np.abs(right_hand_side - self._matrix @ solution).max())
        return residual / scale if scale > 0.0 else residual


@dataclass(frozen=True)
class StaticSolution:
    """Static response of the full model.

    Attributes
    ----------
    displacement : (n,)
        Free unknowns [m, rad].
    strain : (gauges,) dimensionless
        Strain at the gauges, positive in compression.
    load_point_displacement, tip_displacement : float
        Upward displacement at the place of the static test and at the tip [m].
    """

    displacement: FloatArray
    strain: FloatArray
    load_point_displacement: float
    tip_displacement: float


def solve_static(
    operators: AffineOperators,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
    load_factor: float = 1.0,
    tip_force: float = 0.0,
) -> StaticSolution:
    """Solve K(e, z) u = f, Kapteyn et al. 2021, eq. (13), and evaluate the gauge strains, eq. (15).

    Parameters
    ----------
    operators : AffineOperators
        The model.
    young_modulus_factor, stiffness_loss
        As of `fe.runtime.state.DigitalState`.
    load_factor : float
        Load factor of the turn [1].
    tip_force : float
        Upward force at the place of the static test [N].

    Raises
    ------
    SolutionError
        If the solution is not accurate.
    """
    factors = Factorisation(operators.stiffness(young_modulus_factor, stiffness_loss))
    displacement = factors.solve(operators.load(load_factor, tip_force))
    return static_outputs(operators, displacement)


def static_outputs(operators: AffineOperators, displacement: FloatArray) -> StaticSolution:
    """Evaluate the outputs of a displacement (n,) of the free unknowns."""
    return StaticSolution(
        displacement=displacement,
        strain=np.asarray(operators.gauge_output @ displacement),
        load_point_displacement=float(operators.displacement_output @ displacement),
        tip_displacement=float(operators.tip_displacement_output @ displacement),
    )


def tip_stiffness(
    operators: AffineOperators,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
) -> float:
    """Stiffness [N/m] of the static test: force near the tip over the displacement there."""
    solution = solve_static(operators, young_modulus_factor, stiffness_loss, load_factor=0.0, tip_force=1.0)
    return 1.0 / solution.load_point_displacement
