"""Draws from the posterior of effect parameters, where the curvature at its optimum says too little.

Hysteresis far below its slip force shows one combination of its parameters only: the posterior is a long,
bent ridge with many small optima on it, and the curvature at one of them says nothing of its length. The
nuisances adapt to first order at every draw (`Screen.rise`), so that a draw costs one evaluation of the
model; where a record's phases bend the valley, the misfit rises faster than it would if they adapted fully,
so that only posteriors that are wider than Gaussian are drawn from.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import NINETY
from discrepancy.errors import DiscrepancyError

from .fitting import LARGEST_EFFECT, CandidateFit
from .problem import Problem
from .screening import Screen

LEAST_RISE = 0.6
"""Rise of the misfit [nat] at the ends of a Gaussian 90 % interval below which the posterior is drawn from;
NINETY^2 / 2 = 1.35 is expected."""
SEED = 20211
WALKERS, SWEEPS, BLOCKS, LARGEST_STRETCH = 12, 50, 5, 2.0
"""Of the ensemble: members, moves of each in a block, largest number of blocks, and the largest stretch."""
SETTLED = 0.15
"""Share of its width by which an interval may differ between the last two blocks."""
DOUBLINGS = 8


def with_draws(problem: Problem, fit: CandidateFit) -> CandidateFit:
    """Return a fit with draws of its effect parameters if their posterior is wider than its covariance.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    fit : CandidateFit
        With covariance.

    Returns
    -------
    CandidateFit
        As it was where the misfit rises enough at the ends of the intervals along all principal directions;
        else with `draws`. The same fit gives the same draws.
    """
    if not fit.candidate.size:
        return fit
    screen = Screen(problem, fit, record_noise=False)
    centre = fit.point.effect

    def energy(effect: FloatArray) -> float:
        if np.abs(effect).max() > LARGEST_EFFECT:
            return np.inf
        try:
            rise = screen.rise(effect)
        except DiscrepancyError:  # more than the structure can carry
            return np.inf
        return rise + 0.5 * float(effect @ effect - centre @ centre)

    spread, directions = np.linalg.eigh(fit.effect_covariance)
    axes = directions * np.sqrt(np.maximum(spread, 0.0))
    rises = [energy(centre + side * NINETY * axis) for axis in axes.T for side in (-1.0, 1.0)]
    if min(rises) > LEAST_RISE:
        return fit
    reached = np.stack([_reached(energy, centre, axis) for axis in axes.T], axis=1)
    return replace(fit, draws=ensemble(energy, centre, reached))


def _reached(energy: Callable[[FloatArray], float], centre: FloatArray, axis: FloatArray) -> FloatArray:
    """Return an axis, doubled while the misfit rises by less than at one deviation."""
    for _ in range(DOUBLINGS):
        if min(energy(centre - axis), energy(centre + axis)) > 0.5:
            break
        axis = 2.0 * axis
    return axis


def ensemble(
    energy: Callable[[FloatArray], float],
    centre: FloatArray,
    axes: FloatArray,
    *,
    seed: int = SEED,
) -> FloatArray:
    """Return draws by stretch moves of an ensemble (Goodman and Weare 2010, CAMCoS 5 (1), 65-80).

    Blocks of moves are added until the central 90 % of the last two agree in every coordinate, at most
    `BLOCKS`. Along a ridge that is bent and a hundred times longer than wide five blocks are too few, and
    draws cover a part of it.

    Parameters
    ----------
    energy : callable
        -ln of the density at a point (E,), infinite where it vanishes.
    centre : (E,) ndarray
        Where the ensemble begins.
    axes : (E, E) ndarray
        Columns along which it is spread at first.
    seed : int
        Of the moves.

    Returns
    -------
    (N, E) ndarray
        Draws of all members in the last block.
    """
    generator = np.random.default_rng(seed)
    size = len(centre)
    count = max(WALKERS, 4 * size)
    walkers = centre + generator.standard_normal((count, size)) @ axes.T
    values = np.array([energy(walker) for walker in walkers])
    stranded = ~np.isfinite(values)
    walkers[stranded], values[stranded] = centre, energy(centre)
    half = count // 2
    block = np.empty((0, size))
    for _ in range(BLOCKS):
        before, kept = block, []
        for _ in range(SWEEPS):
            for moving, others in ((range(half), (half, count)), (range(half, count), (0, half))):
                for index in moving:
                    other = walkers[generator.integers(*others)]
                    root = np.sqrt(LARGEST_STRETCH)
                    stretch = (1.0 / root + generator.random() * (root - 1.0 / root)) ** 2
                    proposal = other + stretch * (walkers[index] - other)
                    value = energy(proposal)
                    chance = (size - 1) * np.log(stretch) + values[index] - value
                    if np.log(generator.random()) < chance:
                        walkers[index], values[index] = proposal, value
            kept.append(walkers.copy())
        block = np.concatenate(kept)
        if len(before):
            old, new = (np.quantile(draws, (0.05, 0.95), axis=0) for draws in (before, block))
            if np.all(np.abs(old - new) <= SETTLED * (new[1] - new[0])):
                break
    return block
