"""Returns of policies in missions that follow a decision problem."""

from collections.abc import Callable

import numpy as np

from reporting.arrays import Float, Index
from twin_master.network.belief_planning import DecisionProblem

Decide = Callable[[Float, int], Index]
"""Returns the controls (B,) for the beliefs (B, S) before a turn, of that number from 0."""


def simulated_returns(
    problem: DecisionProblem, decide: Decide, missions: int, turns: int, generator: np.random.Generator
) -> Float:
    """Return the discounted returns of missions whose beliefs are exact: (B,).

    A turn counts what is expected of it under the belief, which has the mean of what is drawn and varies
    less. Missions of the same number share what chance brings, whatever is decided and of whatever problem of
    the same states, as long as the generator is the same: returns of two policies differ by less than either
    varies.
    """
    chance = generator.random((turns + 1, 2, missions))
    states = _drawn(np.tile(problem.prior, (missions, 1)), chance[turns, 0])
    belief = np.tile(problem.prior, (missions, 1))
    total, weight = np.zeros(missions), np.ones(missions)
    for turn in range(turns):
        control = decide(belief, turn)
        total += weight * np.einsum("bs,sb->b", belief, problem.reward[:, control])
        weight *= problem.discount[control]
        for chosen in np.unique(control).tolist():
            rows = np.flatnonzero(control == chosen)
            likelihood = problem.likelihood[chosen]
            before = states[rows]
            different, place = np.unique(before, return_inverse=True)
            moves = np.array([problem.transition.row(chosen, state) for state in different.tolist()])
            states[rows] = _drawn(moves[place], chance[turn, 0, rows])
            told = likelihood[:, states[rows] if problem.moves_first else before].T
            seen = _drawn(told, chance[turn, 1, rows])
            after = problem.following(belief[rows], chosen, seen)
            belief[rows] = after / after.sum(axis=1, keepdims=True)
    return total


def _drawn(rows: Float, uniform: Float) -> Index:
    """Return the index of each row of probabilities (B, N) that a share (B,) of its sum reaches."""
    reached = np.cumsum(rows, axis=1)
    return np.asarray((uniform[:, None] * reached[:, -1:] >= reached).sum(axis=1), dtype=np.int64)
