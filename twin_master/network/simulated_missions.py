"""Simulated missions: the returns of policies, and the probability to leave a control."""

from collections.abc import Callable

import numpy as np

from reporting.arrays import Float, Index
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.planner import BeliefPolicy

LIVES = 200
"""Lives that are drawn for each twin."""
Decide = Callable[[Float, Float, int], Index]
"""Decides the controls (B,) of a step.

It is called with the beliefs (B, S) about the states of the step, those about the states of the
step before, both given all observations up to that one, and the number of the step, from 0.
"""


def simulated_returns(
    problem: DecisionProblem,
    decide: Decide,
    missions: int,
    steps: int,
    generator: np.random.Generator,
) -> Float:
    """Return the discounted returns of B missions whose beliefs are exact: (B,).

    A step counts its expected reward under the belief, which has the mean of the drawn reward and
    varies less. A mission of a certain number has the same random numbers for every policy, and for
    every problem of the same states, if the generator is the same. So returns of two policies
    differ by less than either varies.

    Parameters
    ----------
    problem : DecisionProblem
        The problem.
    decide : callable
        The policy, see `Decide`.
    missions : int
        The number B of missions.
    steps : int
        The number of steps of each.
    generator : numpy.random.Generator
        Draws states and observations.
    """
    # For each step and mission one number for the transition and one for the observation; the last
    # row draws the first state.
    uniform = generator.random((steps + 1, 2, missions))
    uniform_transition = uniform[:, 0]
    uniform_observation = uniform[:, 1]
    belief = np.tile(problem.prior, (missions, 1))
    states = _draw_indices(belief, uniform_transition[steps])
    filtered = belief.copy()
    total = np.zeros(missions)
    weight = np.ones(missions)  # product of the discounts
    for step in range(steps):
        control = decide(belief, filtered, step)
        total += weight * np.einsum("bs,sb->b", belief, problem.reward[:, control])
        weight *= problem.discount[control]
        for one_control in np.unique(control).tolist():
            rows = np.flatnonzero(control == one_control)
            likelihood = problem.likelihood[one_control]
            # Draw the next state, and the observation.
            states_before = states[rows]
            next_probability = _rows_of_states(problem, one_control, states_before)
            states[rows] = _draw_indices(next_probability, uniform_transition[step, rows])
            observed_states = states[rows] if problem.moves_first else states_before
            observation = _draw_indices(
                likelihood[:, observed_states].T, uniform_observation[step, rows]
            )
            # Correct the belief.
            unnormalized = problem.next_beliefs(belief[rows], one_control, observation)
            if problem.moves_first:
                unnormalized_filtered = unnormalized
            else:
                unnormalized_filtered = belief[rows] * likelihood[observation]
            filtered[rows] = _normalize(unnormalized_filtered)
            belief[rows] = _normalize(unnormalized)
    return total


def leaving_probability(
    problem: DecisionProblem,
    policy: BeliefPolicy,
    belief: Float,
    control: int,
    steps: int,
    generator: np.random.Generator,
) -> Float:
    """Return the fraction of lives in which a policy leaves a control within some steps: (B,).

    Parameters
    ----------
    problem : DecisionProblem
        A problem whose state is observed before it moves.
    policy : BeliefPolicy
        The policy.
    belief : (B, S) array
        The belief of each twin before the first of the steps.
    control : int
        The control in force until it is left.
    steps : int
        The number of decisions; the first one is by `belief`.
    generator : numpy.random.Generator
        Draws observations; all twins have the same random numbers.
    """
    fraction = np.empty(len(belief))
    uniform = generator.random((steps - 1, LIVES))
    for twin, twin_belief in enumerate(belief):
        rows = np.tile(twin_belief, (LIVES, 1))
        has_left = policy.decide(rows) != control
        # All lives begin with the same belief: if the first decision leaves, all have left.
        later_steps = uniform[:0] if has_left.all() else uniform
        for uniform_of_step in later_steps:
            probability = rows @ problem.likelihood[control].T
            observation = _draw_indices(probability, uniform_of_step)
            rows = _normalize(problem.next_beliefs(rows, control, observation))
            has_left |= policy.decide(rows) != control
        fraction[twin] = has_left.mean()
    return fraction


def _rows_of_states(problem: DecisionProblem, control: int, states: Index) -> Float:
    """Return p(next state | state, control) for states (B,): (B, S)."""
    distinct, position = np.unique(states, return_inverse=True)
    rows = [problem.transition.row(control, state) for state in distinct.tolist()]
    return np.array(rows)[position]


def _normalize(rows: Float) -> Float:
    """Return rows (B, S) divided by their sums."""
    return np.asarray(rows / rows.sum(axis=1, keepdims=True))


def _draw_indices(rows: Float, uniform: Float) -> Index:
    """Return an index drawn from each row of probabilities, which need not sum to one.

    Parameters
    ----------
    rows : (B, N) array
        Probabilities up to a factor of the row.
    uniform : (B,) array
        Random numbers between 0 and 1: the fraction of the row's sum that is reached.
    """
    cumulative = np.cumsum(rows, axis=1)
    is_passed = uniform[:, None] * cumulative[:, -1:] >= cumulative
    return np.asarray(is_passed.sum(axis=1), dtype=np.int64)
