"""Returns of policies in missions that follow a decision problem."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from twin_master.network.belief_planning import DecisionProblem

__all__ = ["simulated_returns"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]
Decide = Callable[[Float, int], Index]
"""Returns the controls (B,) for the beliefs (B, S) before a turn, of that number from 0."""


def simulated_returns(
    problem: DecisionProblem, decide: Decide, missions: int, turns: int, generator: np.random.Generator
) -> Float:
    """Return the discounted returns of missions whose beliefs are exact: (B,)."""
    states = generator.choice(len(problem.prior), missions, p=problem.prior)
    belief = np.tile(problem.prior, (missions, 1))
    total, weight = np.zeros(missions), np.ones(missions)
    for turn in range(turns):
        control = decide(belief, turn)
        total += weight * problem.reward[states, control]
        weight *= problem.discount[control]
        for chosen in np.unique(control).tolist():
            rows = np.flatnonzero(control == chosen)
            likelihood = problem.likelihood[chosen]
            before = states[rows]
            different, place = np.unique(before, return_inverse=True)
            moves = np.array([problem.transition.row(chosen, state) for state in different.tolist()])
            states[rows] = _drawn(moves[place], generator)
            seen = _drawn(likelihood[:, states[rows] if problem.moves_first else before].T, generator)
            after = problem.following(belief[rows], chosen, seen)
            belief[rows] = after / after.sum(axis=1, keepdims=True)
    return total


def _drawn(rows: "Float | list[Float]", generator: np.random.Generator) -> Index:
    """Return one index drawn from each row of probabilities (B, N)."""
    reached = np.cumsum(rows, axis=1)
    uniform = generator.random(len(reached)) * reached[:, -1]
    return np.asarray((uniform[:, None] >= reached).sum(axis=1), dtype=np.int64)
