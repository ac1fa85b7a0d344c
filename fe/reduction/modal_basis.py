"""Offline: a small basis in which the first eigenmodes are accurate for every stiffness and mass.

First a working basis is grown by Davidson corrections until the modes of sampled states have small residuals
in it; then the modes of many states, computed in the working basis, are compressed by singular values.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import eigh

from fe.full.affine import AffineSum, AffineSystem, affine_sum
from fe.full.subspace import Norm, OrthonormalBasis
from fe.runtime.errors import ReductionError

from .settings import MOST_GRID_REGIONS, ModalSettings

FloatArray = npt.NDArray[np.float64]

ModalState = tuple[FloatArray, FloatArray]
"""Coefficients of the stiffness terms (T,) and of the mass terms (1 + P,)."""

START_ITERATIONS = 4


@dataclass(frozen=True)
class ModalData:
    """Modal part of a reduced model: `basis` (n, Nm) and the dense arrays of `ReducedModel`."""

    basis: FloatArray
    stiffness: FloatArray
    mass: FloatArray
    followed_shapes: FloatArray
    mode_count: int


class MatrixTerms(Protocol):
    """What the modes of a structure are made of: terms csr (n, n) of its stiffness and mass."""

    @property
    def stiffness_terms(self) -> tuple[sparse.csr_array, ...]:
        """Terms of the stiffness."""

    @property
    def mass_terms(self) -> tuple[sparse.csr_array, ...]:
        """Terms of the mass."""


class _WorkingBasis:
    """Basis orthonormal in the reference norm, with the projected terms."""

    def __init__(self, system: MatrixTerms, norm: Norm, together: int) -> None:
        self.system, self.norm = system, norm
        self.sums = tuple(
            partial(affine_sum, terms=terms) if together == 1 else AffineSum(terms).matrix
            for terms in (system.stiffness_terms, system.mass_terms)
        )
        self.basis = OrthonormalBasis(system.stiffness_terms[0].shape[0], norm, drop=1e-6)
        self.stiffness = np.empty((len(system.stiffness_terms), 0, 0))
        self.mass = np.empty((len(system.mass_terms), 0, 0))

    def extend(self, vectors: FloatArray) -> None:
        """Add vectors (n, k) and project the terms on them."""
        before = self.basis.size
        self.basis.extend(vectors, self.norm.product(vectors))
        new = self.basis.vectors[:, before:]
        for name, terms in (("stiffness", self.system.stiffness_terms), ("mass", self.system.mass_terms)):
            old = getattr(self, name)
            grown = np.empty((len(terms), self.basis.size, self.basis.size))
            grown[:, :before, :before] = old
            for row, term in zip(grown, terms, strict=True):
                row[:, before:] = self.basis.vectors.T @ (term @ new)
                row[before:, :] = row[:, before:].T
            setattr(self, name, grown)

    def modes(self, theta: FloatArray, mass_theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return squared angular frequencies (count,) and coefficients (k, count) of the first modes."""
        return eigenmodes(self.stiffness, self.mass, theta, mass_theta, count)


def eigenmodes(
    stiffness: FloatArray, mass: FloatArray, theta: FloatArray, mass_theta: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return the first modes of projected terms: squared angular frequencies and mass-normalised shapes."""
    values, vectors = eigh(
        np.tensordot(theta, stiffness, 1), np.tensordot(mass_theta, mass, 1), subset_by_index=[0, count - 1]
    )
    return np.asarray(values), np.asarray(vectors)


def loss_corners(regions: int) -> list[tuple[int, ...]]:
    """Return which end of its range each loss takes, (K,) of 0 and 1, where modes are computed.

    All corners up to `MOST_GRID_REGIONS`; beyond, all healthy, all damaged, each region alone damaged, and
    each alone healthy.
    """
    if regions <= MOST_GRID_REGIONS:
        return list(itertools.product((0, 1), repeat=regions))
    alone = [tuple(int(number == chosen) for number in range(regions)) for chosen in range(regions)]
    others = [tuple(1 - end for end in corner) for corner in alone]
    return [(0,) * regions, *alone, *others, (1,) * regions]


def sampled_states(box: FloatArray) -> list[ModalState]:
    """Return the states at which the working basis is refined: `loss_corners`, with e and masses mixed in.

    Each entry holds the coefficients of the stiffness terms (K + 2,) and of the mass terms (3,).
    """
    e, losses, (servo, pitot) = box[0], box[1:-4], box[-4:-2]
    states = []
    for number, ends in enumerate(loss_corners(len(losses))):
        remaining = [1.0 - loss[end] for loss, end in zip(losses, ends, strict=True)]
        for flip in (0, 1):
            corner = (number + flip) % 2
            states.append(
                (
                    np.array((e[(sum(ends) + flip) % 2], *remaining, 1.0)),
                    np.array((1.0, servo[corner], pitot[(corner + number // 2 + flip) % 2])),
                )
            )
    middle = np.array((e.mean(), *(1.0 - loss.mean() for loss in losses), 1.0))
    states.append((middle, np.array((1.0, servo.mean(), pitot.mean()))))
    return states


def compression_states(box: FloatArray) -> list[ModalState]:
    """Return the states whose modes are compressed together: a grid over the whole box.

    With more than `MOST_GRID_REGIONS` the losses are `loss_corners`, the same halfway.
    """
    e, losses, (servo, pitot) = box[0], box[1:-4], box[-4:-2]
    levels = [(loss[0], loss.mean(), loss[1]) for loss in losses]
    if len(losses) <= MOST_GRID_REGIONS:
        choices = list(itertools.product((0, 1, 2), repeat=len(losses)))
    else:
        corners = loss_corners(len(losses))
        choices = sorted({tuple(end * level for end in ends) for ends in corners for level in (1, 2)})
    return [
        (
            np.array((a, *(1.0 - level[i] for level, i in zip(levels, chosen, strict=True)), 1.0)),
            np.array((1.0, s, p)),
        )
        for a in e
        for chosen in choices
        for s in servo
        for p in (pitot[0], pitot.mean(), pitot[1])
    ]


def reduce_modes(
    system: AffineSystem,
    norm: Norm,
    reference: FloatArray,
    box: FloatArray,
    nominal_masses: tuple[float, float],
    settings: ModalSettings,
    advance: Callable[[], object],
    together: int = 1,
) -> ModalData:
    """Make the modal basis.

    Parameters
    ----------
    system : AffineSystem
        The full model.
    norm : Norm
        Energy norm at `reference`.
    reference : (K + 1,) ndarray
        (e, 1 - z1, ...) of the norm.
    box : (K + 5, 2) ndarray
        Validity box, `fe.runtime.state.wing_names`.
    nominal_masses : tuple of float
        Servo and pitot mass at which the flapwise modes are named, at e = 1 and no loss [kg].
    settings : ModalSettings
        Accuracy.
    advance : callable
        Called after each sampled state.
    together : int
        As of `modal_basis`.

    Raises
    ------
    ReductionError
        If the modes of a sampled state do not converge, or there are too few unknowns for the modes.
    """
    basis, stiffness, mass = modal_basis(
        system,
        norm,
        np.array((1.0, *np.mean(box[-4:-2], axis=1))),
        sampled_states(box),
        compression_states(box),
        settings,
        advance,
        together,
    )
    data = ModalData(basis, stiffness, mass, np.empty((2, 0)), settings.mode_count)
    shapes = _flapwise(data, system, nominal_masses)
    return ModalData(data.basis, stiffness, mass, shapes, settings.mode_count)


def modal_basis(
    system: MatrixTerms,
    norm: Norm,
    middle: FloatArray,
    sampled: list[ModalState],
    compression: list[ModalState],
    settings: ModalSettings,
    advance: Callable[[], object],
    together: int = 1,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Make a basis for the first modes of any structure.

    Parameters
    ----------
    system : MatrixTerms
        The full model.
    norm : Norm
        The energy norm of one of its stiffnesses.
    middle : (1 + P,) ndarray
        Coefficients of the mass terms with which the search begins.
    sampled, compression : list of ModalState
        Where the working basis is refined, and whose modes are compressed together.
    settings, advance
        As of `reduce_modes`, as are the errors.
    together : int
        How many states are refined at once; one repeats the shipped wing to the bit.

    Returns
    -------
    basis : (n, Nm) ndarray
        The basis.
    stiffness, mass : (T, Nm, Nm), (1 + P, Nm, Nm) ndarray
        The terms in it.
    """
    unknowns = system.stiffness_terms[0].shape[0]
    count = settings.mode_count + 2  # two more, because modes change places
    if unknowns <= 2 * count:
        raise ReductionError(
            f"{settings.mode_count} modes cannot be had from {unknowns} unknowns; ask for fewer or refine."
        )
    working = _WorkingBasis(system, norm, together)
    matrix = affine_sum(middle, system.mass_terms)
    # inverse iteration on a block; what it leaves is refined below
    vectors = np.random.default_rng(1).normal(size=(unknowns, count + 4))
    for _ in range(START_ITERATIONS):
        vectors = np.linalg.qr(norm.riesz(np.asarray(matrix @ vectors)))[0]
    working.extend(vectors)
    for first in range(0, len(sampled), together):
        _refine(working, sampled[first : first + together], count, settings, advance)
    basis = _compress(working, compression, count, settings)
    stiffness, mass = (
        # What rounding made of the symmetry of large entries is averaged out.
        0.5 * (terms + terms.transpose(0, 2, 1))
        for terms in (basis.T @ working.stiffness @ basis, basis.T @ working.mass @ basis)
    )
    return working.basis.vectors @ basis, stiffness, mass


def _refine(
    working: _WorkingBasis,
    states: list[ModalState],
    count: int,
    settings: ModalSettings,
    advance: Callable[[], object],
) -> None:
    """Add Davidson corrections X^-1 (K - omega^2 M) phi until all modes of the states are found well."""
    open_states = [
        (*state, *(sums(values) for sums, values in zip(working.sums, state, strict=True)))
        for state in states
    ]
    largest = np.inf
    for _ in range(settings.most_corrections):
        modes = [working.modes(theta, mass_theta, count) for theta, mass_theta, _, _ in open_states]
        residual = []
        for (_, _, stiffness, mass), (square, coefficients) in zip(open_states, modes, strict=True):
            shape = working.basis.vectors @ coefficients
            residual.append(stiffness @ shape - (mass @ shape) * square)
        residuals = np.concatenate(residual, axis=1)
        correction = working.norm.riesz(residuals)
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
    working: _WorkingBasis, states: list[ModalState], count: int, settings: ModalSettings
) -> FloatArray:
    """Return the fewest singular directions (k, Nm) of many states' modes that keep every frequency."""
    modes = [working.modes(*state, count) for state in states]
    kept = settings.mode_count
    snapshots = np.concatenate(
        [shape[:, :kept] / np.linalg.norm(shape[:, :kept], axis=0) for _, shape in modes], axis=1
    )
    directions, singular, _ = np.linalg.svd(snapshots, full_matrices=False)
    most = int(np.sum(singular > 1e-7 * singular[0]))

    def added_error(size: int) -> float:
        basis = directions[:, :size]
        stiffness, mass = basis.T @ working.stiffness @ basis, basis.T @ working.mass @ basis
        return max(
            float(np.max(eigenmodes(stiffness, mass, *state, kept)[0] / square[:kept]))
            for state, (square, _) in zip(states, modes, strict=True)
        )

    low, high = kept, most  # the error falls with size, because the bases are nested
    while low < high:
        middle = (low + high) // 2
        if 0.5 * (added_error(middle) - 1.0) <= settings.frequency_tolerance:
            high = middle
        else:
            low = middle + 1
    return np.asarray(directions[:, :low])


def _flapwise(data: ModalData, system: AffineSystem, nominal_masses: tuple[float, float]) -> FloatArray:
    """Return the shapes (2, Nm) of the first and second flapwise bending of the healthy wing.

    They are the two modes that contribute most to the compliance under the tip force.
    """
    square, shapes = eigenmodes(
        data.stiffness,
        data.mass,
        np.ones(len(data.stiffness)),
        np.array((1.0, *nominal_masses)),
        data.mode_count,
    )
    contribution = (system.load_tip @ data.basis @ shapes) ** 2 / square
    chosen = np.sort(np.argsort(contribution)[-2:])
    return np.asarray(shapes[:, chosen].T)
