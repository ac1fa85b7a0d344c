"""The modal basis of a reduced model, in which the lowest modes are accurate for every state.

A working basis is grown by Davidson corrections until the modes of sampled states have small
residuals in it. The modes of many states, computed in the working basis, are then compressed by a
singular value decomposition. `docs/explanation/reduced_model.md` describes the method and its
accuracy.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from fe.full.factorisation import most_compliant_modes
from fe.full.subspace import ProjectedBasis, affine_product, fewest_directions, project_terms
from fe.runtime.arrays import BoolArray, FloatArray
from fe.runtime.errors import ReductionError
from reporting.progress import Stage

from .terms import STATES_PER_ROUND, ModalCoefficients, ReductionTerms

START_ITERATIONS = 4
"""Number of inverse iterations that start the working basis."""
START_EXTRA_VECTORS = 4
"""Additional vectors in these iterations."""
EXTRA_MODES = 2
"""Modes that are computed in addition to those that are wanted, since modes change their order."""
MODAL_DROP = 1e-6
"""Shorter directions are dropped from the working basis, relative to the vectors of their block."""
RESIDUAL_TOLERANCE = 3e-3
"""Relative residual of the sampled modes in the working basis; frequencies err by about its
square."""
FREQUENCY_TOLERANCE = 1e-5
"""Relative error of a frequency that compression may add."""
MOST_CORRECTIONS = 12
"""Largest number of Davidson corrections for one state."""


class ModalReduction(NamedTuple):
    """The modal basis of a structure, and what the reduced model has in it.

    Attributes
    ----------
    basis : (n, Nm) array
        The basis vectors on the free unknowns of the full model.
    mode_count, stiffness, mass, load, output, followed_shapes
        The fields `modal_stiffness` and so on of `fe.runtime.reduced_arrays.ReducedArrays`.
    """

    basis: FloatArray
    mode_count: int
    stiffness: FloatArray
    mass: FloatArray
    load: FloatArray
    output: FloatArray
    followed_shapes: FloatArray


def projected_modes(
    stiffness_terms: FloatArray, mass_terms: FloatArray, state: ModalCoefficients, count: int
) -> tuple[FloatArray, FloatArray]:
    """Compute the lowest modes of a projected model in a state.

    Parameters
    ----------
    stiffness_terms : (T, k, k) array
        The projected stiffness terms.
    mass_terms : (Q, k, k) array
        The projected mass terms.

    Returns
    -------
    squares : (count,) array
        The squared angular frequencies.
    shapes : (k, count) array
        The mass-normalised shapes.
    """
    stiffness = np.tensordot(state.stiffness, stiffness_terms, 1)
    mass = np.tensordot(state.mass, mass_terms, 1)
    squares, shapes = eigh(stiffness, mass, subset_by_index=[0, count - 1])
    return np.asarray(squares), np.asarray(shapes)


def modal_reduction(terms: ReductionTerms, count: int, stage: Stage) -> ModalReduction:
    """Make a basis for the lowest modes of a structure, and project the structure on it.

    Raises
    ------
    ReductionError
        If the modes of a sampled state do not converge, the structure has too few unknowns for
        the modes, or its masses move in too few ways.
    """
    structure = terms.structure
    mode_count = count + EXTRA_MODES
    if structure.unknowns <= 2 * mode_count:
        raise ReductionError(
            f"{count} modes cannot be computed from {structure.unknowns} unknowns; ask for fewer "
            "modes or refine the mesh."
        )
    working = _start_basis(terms, mode_count)
    try:
        _refine(terms, working, mode_count, stage)
        directions = _compressed_directions(working, terms.compression_states(), count)
    except np.linalg.LinAlgError:
        raise ReductionError(
            f"The masses of {structure.design.name} move in fewer ways than the {mode_count} modes "
            "that are looked for; give its materials a density."
        ) from None
    return _projected_on(terms, working, directions, count)


def _start_basis(terms: ReductionTerms, mode_count: int) -> ProjectedBasis:
    """Return a working basis from a few inverse iterations on random vectors.

    The iterations need not converge, since the refinement corrects the modes.
    """
    structure = terms.structure
    factors = terms.factors
    middle_masses = np.append(1.0, terms.masses.mean(axis=1))
    shape = (structure.unknowns, mode_count + START_EXTRA_VECTORS)
    vectors = np.random.default_rng(1).normal(size=shape)
    for _ in range(START_ITERATIONS):
        shapes = factors.unwhitened(vectors)
        inertia = affine_product(structure.mass_terms, middle_masses, shapes)
        vectors = np.linalg.qr(factors.whitened(inertia))[0]
    working = ProjectedBasis(factors, terms.stiffness_terms, structure.mass_terms, drop=MODAL_DROP)
    working.add(vectors)
    return working


def _refine(terms: ReductionTerms, working: ProjectedBasis, mode_count: int, stage: Stage) -> None:
    """Extend the working basis until the modes of all sampled states have small residuals."""
    states = terms.refinement_states()
    for first in range(0, len(states), STATES_PER_ROUND):
        batch = states[first : first + STATES_PER_ROUND]
        for _ in _refine_states(terms, working, batch, mode_count):
            stage.advance()


def _refine_states(
    terms: ReductionTerms, working: ProjectedBasis, states: list[ModalCoefficients], mode_count: int
) -> Iterator[ModalCoefficients]:
    """Extend a basis by Davidson's method until it holds the modes of all states.

    Yields each state as soon as its modes have converged. See `_davidson_corrections`.
    """
    largest_residual = np.inf
    for _ in range(MOST_CORRECTIONS):
        corrections, relative_norms = _davidson_corrections(terms, working, states, mode_count)
        is_large = relative_norms > RESIDUAL_TOLERANCE
        needs_correction: BoolArray = np.any(is_large.reshape(len(states), -1), axis=1)
        by_state = list(zip(states, needs_correction, strict=True))
        yield from (state for state, corrected in by_state if not corrected)
        if not needs_correction.any():
            return
        largest_residual = float(relative_norms.max())
        working.add(corrections[:, is_large])
        states = [state for state, corrected in by_state if corrected]
    raise ReductionError(
        f"After {MOST_CORRECTIONS} corrections the modes of a sampled state have a residual of "
        f"{largest_residual:.2g}, but {RESIDUAL_TOLERANCE:g} is needed."
    )


def _davidson_corrections(
    terms: ReductionTerms, working: ProjectedBasis, states: list[ModalCoefficients], mode_count: int
) -> tuple[FloatArray, FloatArray]:
    """Return vectors that improve a basis for the modes of S states, and the relative residuals.

    The M modes of each state are computed in the working basis. A mode phi computed in this way has
    the residual r = (K - omega^2 M) phi. Davidson's method adds X^-1 r to the basis, where X
    approximates K; here X is the stiffness of a reference state, which is factorised once. The
    vectors are returned in whitened coordinates, as X^-1/2 r, in which their Euclidean norm is the
    energy norm of X^-1 r.

    Returns
    -------
    corrections : (n, S M) array
        The whitened residuals, one column for each mode. The modes of one state stand side by side.
    relative_norms : (S M,) array
        The relative norm of each residual: the square root of (r, X^-1 r) / (phi, K phi).
    """
    # natural frequencies and modes in the working basis; all states side by side
    modes = [
        projected_modes(working.stiffness, working.mass, state, mode_count) for state in states
    ]
    squared_frequencies = np.concatenate([squares for squares, _ in modes])
    projected_shapes = np.concatenate([mode_shapes for _, mode_shapes in modes], axis=1)
    shapes = working.displacements @ projected_shapes
    # coefficients of the affine terms of K (T, S M) and of M, one column for each mode
    stiffness_of_states = [state.stiffness for state in states]
    mass_of_states = [state.mass for state in states]
    stiffness = np.repeat(stiffness_of_states, mode_count, axis=0).T
    mass = np.repeat(mass_of_states, mode_count, axis=0).T
    # residuals (K - omega^2 M) phi
    residuals = affine_product(terms.stiffness_terms, stiffness, shapes)
    residuals -= affine_product(terms.structure.mass_terms, mass * squared_frequencies, shapes)
    corrections = working.factors.whitened(residuals)
    # modes are mass-normalised, so (phi, K phi) is the squared frequency
    relative_norms = np.linalg.norm(corrections, axis=0) / np.sqrt(squared_frequencies)
    return corrections, relative_norms


def _compressed_directions(
    working: ProjectedBasis, states: list[ModalCoefficients], count: int
) -> FloatArray:
    """Return the fewest directions (k, Nm) of the working basis that keep all frequencies.

    They are singular directions of the modes of all given states.
    """
    modes = [projected_modes(working.stiffness, working.mass, state, count) for state in states]
    squares = np.array([mode_squares for mode_squares, _ in modes])
    shapes = np.concatenate([mode_shapes for _, mode_shapes in modes], axis=1)

    def keeps_frequencies(directions: FloatArray) -> bool:
        stiffness = project_terms(working.stiffness, directions)
        mass = project_terms(working.mass, directions)
        compressed_squares = []
        for state in states:
            state_squares, _ = projected_modes(stiffness, mass, state, count)
            compressed_squares.append(state_squares)
        largest_ratio = np.max(np.array(compressed_squares) / squares)
        # half the error of the square, for small errors
        largest_error = 0.5 * (largest_ratio - 1.0)
        return bool(largest_error <= FREQUENCY_TOLERANCE)

    # The error falls with the number of directions, because the spaces are nested.
    return fewest_directions(shapes, count, keeps_frequencies)


def _projected_on(
    terms: ReductionTerms, working: ProjectedBasis, directions: FloatArray, count: int
) -> ModalReduction:
    """Project a structure on directions (k, Nm) of the working basis: the modal reduction."""
    structure = terms.structure
    stiffness = project_terms(working.stiffness, directions)
    mass = project_terms(working.mass, directions)
    basis = working.displacements @ directions
    load = terms.loads.T @ basis
    if structure.followed_load is None:
        followed_shapes: FloatArray = np.empty((0, basis.shape[1]))
    else:
        squares, shapes = projected_modes(stiffness, mass, _nominal_state(terms), count)
        followed_modes = most_compliant_modes(load[structure.followed_load], squares, shapes)
        followed_shapes = shapes[:, followed_modes].T
    output = np.concatenate((terms.outputs.T @ basis, structure.acceleration_output @ basis))
    return ModalReduction(basis, count, stiffness, mass, load, output, followed_shapes)


def _nominal_state(terms: ReductionTerms) -> ModalCoefficients:
    """Return the state with nominal parameters and masses, and without damage."""
    structure = terms.structure
    no_losses = np.zeros(len(terms.losses))
    return ModalCoefficients(
        stiffness=terms.theta((*structure.parameters.values(), *no_losses)),
        mass=np.array((1.0, *structure.masses.values())),
    )
