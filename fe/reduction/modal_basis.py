"""Offline: a small basis in which the first eigenmodes are accurate for every stiffness and mass.

First a working basis is grown by Davidson corrections until the modes of sampled states have small residuals
in it; then the modes of many states, computed in the working basis, are compressed by singular values.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import eigh

from fe.full.subspace import Norm, ProjectedBasis
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.structure.affine import affine_sum

from .settings import TOGETHER, ModalSettings
from .terms import ModalState, ReductionTerms

START_ITERATIONS = 4


def eigenmodes(
    terms: Sequence[FloatArray], theta: FloatArray, mass_theta: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return squared angular frequencies and mass-normalised shapes of the first modes of projected terms."""
    pair = (np.tensordot(values, part, 1) for values, part in zip((theta, mass_theta), terms, strict=True))
    values, vectors = eigh(*pair, subset_by_index=[0, count - 1])
    return np.asarray(values), np.asarray(vectors)


def modal_basis(
    system: ReductionTerms, norm: Norm, settings: ModalSettings, advance: Callable[[], object]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Make a basis for the first modes of any structure.

    Parameters
    ----------
    system : ReductionTerms
        The full model, where the working basis is refined, and whose modes are compressed together.
    norm : Norm
        The energy norm of one of its stiffnesses.
    settings : ModalSettings
        Accuracy.
    advance : callable
        Called after each sampled state.

    Returns
    -------
    basis : (n, Nm) ndarray
        The basis.
    stiffness, mass : (T, Nm, Nm), (1 + P, Nm, Nm) ndarray
        The terms in it.

    Raises
    ------
    ReductionError
        If the modes of a sampled state do not converge, or there are too few unknowns for the modes.
    """
    unknowns = system.stiffness_terms[0].shape[0]
    count = settings.mode_count + 2  # two more, because modes change places
    if unknowns <= 2 * count:
        raise ReductionError(
            f"{settings.mode_count} modes cannot be had from {unknowns} unknowns; ask for fewer or refine."
        )
    working = ProjectedBasis(norm, (system.stiffness_terms, system.mass_terms), drop=1e-6)
    matrix = affine_sum(system.middle_mass, system.mass_terms)
    # inverse iteration on a block; what it leaves is refined below
    vectors = np.random.default_rng(1).normal(size=(unknowns, count + 4))
    for _ in range(START_ITERATIONS):
        vectors = np.linalg.qr(norm.riesz(np.asarray(matrix @ vectors)))[0]
    working.extend(vectors)
    sampled = system.sampled_modes()
    for first in range(0, len(sampled), TOGETHER):
        _refine(system, norm, working, sampled[first : first + TOGETHER], count, settings, advance)
    basis = _compress(working, system.compressed_modes(), count, settings)
    stiffness, mass = (
        # What rounding made of the symmetry of large entries is averaged out.
        0.5 * (terms + terms.transpose(0, 2, 1))
        for terms in (basis.T @ inner @ basis for inner in working.inner)
    )
    return working.vectors @ basis, stiffness, mass


def _refine(
    system: ReductionTerms,
    norm: Norm,
    working: ProjectedBasis,
    states: list[ModalState],
    count: int,
    settings: ModalSettings,
    advance: Callable[[], object],
) -> None:
    """Add Davidson corrections X^-1 (K - omega^2 M) phi until all modes of the states are found well."""
    open_states = [(*state, system.stiffness(state[0]), system.mass(state[1])) for state in states]
    largest = np.inf
    for _ in range(settings.most_corrections):
        modes = [
            eigenmodes(working.inner, theta, mass_theta, count) for theta, mass_theta, _, _ in open_states
        ]
        residual = []
        for (_, _, stiffness, mass), (square, coefficients) in zip(open_states, modes, strict=True):
            shape = working.vectors @ coefficients
            residual.append(stiffness @ shape - (mass @ shape) * square)
        residuals = np.concatenate(residual, axis=1)
        correction = norm.riesz(residuals)
        # (r, X^-1 r) / (phi, K phi); phi is mass-normalised
        squares = np.concatenate([square for square, _ in modes])
        sizes = np.sqrt(np.einsum("ik,ik->k", residuals, correction) / squares)
        too_large = sizes > settings.residual_tolerance
        still = too_large.reshape(len(open_states), count).any(axis=1)
        for _ in range(int(np.sum(~still))):
            advance()
        if not still.any():
            return
        largest = float(sizes.max())
        working.extend(correction[:, np.flatnonzero(too_large)])
        open_states = [state for state, chosen in zip(open_states, still, strict=True) if chosen]
    raise ReductionError(
        f"The modes of a sampled state reached a residual of {largest:.2g} only, "
        f"{settings.residual_tolerance:.2g} was asked for; allow more corrections."
    )


def _compress(
    working: ProjectedBasis, states: list[ModalState], count: int, settings: ModalSettings
) -> FloatArray:
    """Return the fewest singular directions (k, Nm) of many states' modes that keep every frequency."""
    modes = [eigenmodes(working.inner, *state, count) for state in states]
    kept = settings.mode_count
    snapshots = np.concatenate(
        [shape[:, :kept] / np.linalg.norm(shape[:, :kept], axis=0) for _, shape in modes], axis=1
    )
    directions, singular, _ = np.linalg.svd(snapshots, full_matrices=False)
    most = int(np.sum(singular > 1e-7 * singular[0]))

    def good(size: int) -> bool:
        smaller = [directions[:, :size].T @ inner @ directions[:, :size] for inner in working.inner]
        worst = max(
            float(np.max(eigenmodes(smaller, *state, kept)[0] / square[:kept]))
            for state, (square, _) in zip(states, modes, strict=True)
        )
        return 0.5 * (worst - 1.0) <= settings.frequency_tolerance

    # the error falls with size, because the bases are nested
    return directions[:, : bisect_left(range(most), True, kept, key=good)]
