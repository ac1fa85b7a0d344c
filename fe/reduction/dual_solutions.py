"""Approximate dual solutions of the outputs, which make the error bound sharp.

At each anchor, a few dual solutions of each output span a reduced basis of that output, in which
they are combined for each state (Rozza, Huynh and Patera 2008). Displacements and loads are
whitened, see `fe.full.subspace`.
"""

from math import ceil
from typing import NamedTuple

import numpy as np

from fe.full.subspace import solve_near
from fe.runtime.arrays import FloatArray
from reporting.progress import Stage

from .terms import ReductionTerms

OUTPUTS_PER_BATCH = 8
"""Outputs whose dual solutions are evaluated together."""
DUAL_TOLERANCE = 0.01
"""Relative residual of approximate dual solutions at their own states."""
LEAST_DUAL_RESIDUAL = 1e-5
"""Rounding allowance for the residual of a dual solution, relative to its output."""
LEAST_DUAL_LENGTH = 1e-3
"""Shorter directions of an output's dual solutions are dropped, relative to the longest."""


class DualSolutions(NamedTuple):
    """Reduced bases of the dual solutions of O outputs at A anchors, each of M functions.

    Attributes
    ----------
    functions : (A, M, O, n) array
        The functions in whitened coordinates, orthonormal for each output; zero if there are
        fewer than M.
    residual : (A, O, R, R) array
        Field `dual_residual` of `ReducedArrays`.
    stiffness : (A, O, T, M, M) array
        Field `dual_stiffness` of `ReducedArrays`.
    output : (A, O, M) array
        Field `dual_output` of `ReducedArrays`.
    """

    functions: FloatArray
    residual: FloatArray
    stiffness: FloatArray
    output: FloatArray


def dual_solutions(terms: ReductionTerms, outputs: FloatArray, stage: Stage) -> DualSolutions:
    """Solve K psi = l approximately for each output l, and compute the norms of the residuals.

    Parameters
    ----------
    outputs : (n, O) array
        The outputs of the full model, whitened.

    Raises
    ------
    SolutionError
        If conjugate gradients do not converge.
    """
    functions: list[FloatArray] = []
    residuals: list[FloatArray] = []
    stiffness: list[FloatArray] = []
    for anchor in terms.anchors():
        solutions = []
        for theta in anchor:
            solutions.append(_solve_duals(terms, theta, outputs))
            stage.advance(1, "dual solutions")
        directions = _dual_directions(solutions)
        functions.append(directions.transpose(2, 0, 1))
        for residual, projected in _project_duals(terms, outputs, directions):
            residuals.append(residual)
            stiffness.append(projected)
    duals = np.array(functions)
    shape = (len(duals), outputs.shape[1])
    return DualSolutions(
        functions=duals,
        residual=np.array(residuals).reshape(*shape, *residuals[0].shape),
        stiffness=np.array(stiffness).reshape(*shape, *stiffness[0].shape),
        output=np.einsum("no,amon->aom", outputs, duals),
    )


def _solve_duals(terms: ReductionTerms, theta: FloatArray, outputs: FloatArray) -> FloatArray:
    """Return approximate dual solutions (n, O) for stiffness coefficients (T,)."""
    return solve_near(
        terms.factors,
        terms.stiffness_terms,
        np.tile(theta[:, np.newaxis], outputs.shape[1]),
        outputs,
        start=outputs,
        tolerance=DUAL_TOLERANCE,
    )


def _dual_directions(solutions: list[FloatArray]) -> FloatArray:
    """Return orthonormal directions (O, n, M) that span each output's M dual solutions (n, O)."""
    by_output = np.stack(solutions, axis=2).swapaxes(0, 1)
    directions, lengths, _ = np.linalg.svd(by_output, full_matrices=False)
    longest = lengths[:, :1]
    is_long = lengths > LEAST_DUAL_LENGTH * longest
    directions *= is_long[:, np.newaxis]
    return np.asarray(directions)


def _project_duals(
    terms: ReductionTerms, outputs: FloatArray, directions: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the factor of the dual residual and the projected stiffness for each output.

    The factor is that of `_residual_factor`; the projected stiffness is (T, M, M). `outputs`
    (n, O), and the `directions` (O, n, M) of each output, are whitened.
    """
    factors = terms.factors
    size, count = outputs.shape
    displacements = factors.unwhitened(directions.swapaxes(0, 1).reshape(size, -1))
    displacements = displacements.reshape(size, count, -1)
    projections = []
    for batch in np.array_split(np.arange(count), ceil(count / OUTPUTS_PER_BATCH)):
        projections += _project_batch(terms, outputs[:, batch], displacements[:, batch])
    return projections


def _project_batch(
    terms: ReductionTerms, outputs: FloatArray, displacements: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the projections of `_project_duals` for b outputs at once.

    `outputs` (n, b) are whitened; `displacements` (n, b, M) are the directions of each output.
    """
    size, output_count = outputs.shape
    flat = displacements.reshape(size, -1)
    # the images of all directions under each stiffness term
    images_of_terms = []
    for term in terms.stiffness_terms:
        flat_images = term @ flat
        images_of_terms.append(flat_images.reshape(size, output_count, -1))
    images = np.stack(images_of_terms)
    projected_terms = np.einsum("nom,tnok->otmk", displacements, images, optimize=True)
    # the images as whitened forces, all terms of an output side by side
    terms_side_by_side = np.moveaxis(images, 0, 2)
    forces = terms.factors.whitened(terms_side_by_side.reshape(size, -1))
    forces_by_output = forces.reshape(size, output_count, -1).swapaxes(0, 1)
    projections = []
    for output, projected, force in zip(outputs.T, projected_terms, forces_by_output, strict=True):
        # A dropped direction is zero; a one on its diagonal keeps the system solvable. It is added
        # to the last term, which is constant.
        is_dropped = np.diagonal(projected.sum(axis=0)) == 0.0
        projected[-1] += np.diag(is_dropped)
        projections.append((_residual_factor(output, force), projected))
    return projections


def _residual_factor(output: FloatArray, force: FloatArray) -> FloatArray:
    """Return a small matrix from which the norm of each dual residual follows.

    The residual of a dual solution is the output minus a combination of forces, with n rows:
    r = [output, force] c. Its norm is needed for many combinations c. With the QR factorisation
    [output, force] = Q R it is the norm of R c, and R has few rows.

    Parameters
    ----------
    output : (n,) array
        The output, as a whitened force.
    force : (n, T M) array
        The T stiffness terms times the M directions of the dual solutions, as whitened forces.

    Returns
    -------
    (2 + T M, 1 + T M) array
        The factor R, and a last row that adds an allowance for rounding.
    """
    columns = np.column_stack((output, force))
    factor = np.linalg.qr(columns, mode="r")
    # the combination has a one at the output, the first column
    first_column = np.eye(1, columns.shape[1])
    allowance = LEAST_DUAL_RESIDUAL * np.linalg.norm(output) * first_column
    return np.concatenate((factor, allowance))
