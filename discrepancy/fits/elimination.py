"""Normal equations of a fit; the trials' own unknowns are eliminated trial by trial (Schur complement)."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .candidate import Candidate
from .cholesky import Cholesky
from .derivatives import TrialDerivatives
from .linearisation import Linearisation, Point
from .problem import Problem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class TrialBlock:
    """Normal equations of one trial."""

    local: FloatArray  # (L, L) with prior
    cross: FloatArray  # (L, K)
    shared: FloatArray  # (K, K)
    local_gradient: FloatArray  # (L,)
    shared_gradient: FloatArray  # (K,)
    derivatives: TrialDerivatives
    products: FloatArray  # (C, M, M) of the derivatives of each channel
    precision: FloatArray  # (C,) of each channel

    @property
    def index(self) -> IntArray:
        """Which shared unknowns (K,) the trial knows."""
        return self.derivatives.index

    @cached_property
    def factor(self) -> Cholesky:
        """Of the trial's own unknowns."""
        return Cholesky.of(self.local)

    @cached_property
    def followed(self) -> FloatArray:
        """What the trial's own unknowns (L, K) do less of where the shared ones do more."""
        return self.factor.solve(self.cross)


class Fitted(Protocol):
    """Where a candidate stands: a fit, or a state on the way to it."""

    @property
    def point(self) -> Point:
        """Values of all unknowns."""

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """Of each trial, standardised."""

    @property
    def linearisations(self) -> tuple[Linearisation, ...]:
        """Of each trial."""


def trial_block(
    problem: Problem, number: int, found: Fitted, candidate: Candidate, precision: FloatArray
) -> TrialBlock:
    """Return the normal equations of a trial, by precisions of all channels."""
    data, point = problem.trials[number], found.point
    derivatives = problem.derivatives(number, point, found.linearisations[number], candidate)
    products = derivatives.products()
    weights = precision[data.groups]
    normal = derivatives.normal(products, weights)
    gradient = derivatives.onto(found.residuals[number].T * weights[:, np.newaxis])
    u, prior, count = point.local[number], data.unknowns.precision, derivatives.local_size
    return TrialBlock(
        local=normal[:count, :count] + np.diag(prior + 1e-12),
        cross=normal[:count, count:],
        shared=normal[count:, count:],
        local_gradient=gradient[:count] - prior * u,
        shared_gradient=gradient[count:],
        derivatives=derivatives,
        products=products,
        precision=weights,
    )


def trial_blocks(
    problem: Problem, found: Fitted, candidate: Candidate, precision: FloatArray
) -> list[TrialBlock]:
    """Return the normal equations of all trials."""
    numbers = range(len(problem.trials))
    return [trial_block(problem, number, found, candidate, precision) for number in numbers]


class Eliminated(NamedTuple):
    """Normal equations of shared unknowns and effect parameters, the trials' own unknowns eliminated.

    Attributes
    ----------
    blocks : list of TrialBlock
        Of each trial.
    matrix, gradient : (Q + E, Q + E), (Q + E,) ndarray
        With prior.
    """

    blocks: list[TrialBlock]
    matrix: FloatArray
    gradient: FloatArray


def eliminated(problem: Problem, found: Fitted, candidate: Candidate, precision: FloatArray) -> Eliminated:
    """Return the normal equations of a problem."""
    blocks = trial_blocks(problem, found, candidate, precision)
    prior = np.concatenate((problem.shared.precision, np.ones(candidate.size)))
    matrix = np.diag(prior + 1e-12)
    gradient = -prior * np.concatenate((found.point.shared, found.point.effect))[: len(prior)]
    for block in blocks:
        matrix[np.ix_(block.index, block.index)] += block.shared - block.cross.T @ block.followed
        np.add.at(gradient, block.index, block.shared_gradient - block.followed.T @ block.local_gradient)
    return Eliminated(blocks, matrix, gradient)
