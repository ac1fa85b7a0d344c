"""Simulated missions: the returns of policies, and the probability to leave a control."""

from collections.abc import Callable

import numpy as np

from reporting.arrays import Float, Index
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.planner import BeliefPolicy

FUTURES = 200
"""Number of futures that are simulated for each twin."""
Decide = Callable[[Float, Float, int], Index]
"""Returns the controls (B,) of a step, given two beliefs (B, S) and the number of the step, from 0.

The first belief is about the states in the step, the second about those in the step before; both
are given all observations up to the step before. In the first step both are the prior; in a problem
whose state moves before it is observed, both are always the same.
"""


def simulated_returns(
    problem: DecisionProblem,
    decide: Decide,
    missions: int,
    steps: int,
    generator: np.random.Generator,
) -> Float:
    """Return the discounted returns (B,) of simulated missions.

    The reward of a step is its expectation under the exact belief: it has the same mean as the
    reward of the drawn state, and a smaller variance. With an equal generator, mission number b has
    the same random numbers for every policy, and for every problem of the same states (common
    random numbers). So the difference of the returns of two policies varies less than either of
    them.

    Parameters
    ----------
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
    uniform_transition, uniform_observation = uniform.swapaxes(0, 1)
    belief = np.tile(problem.prior, (missions, 1))
    states = _draw_indices(belief, uniform_transition[steps])
    filtered_beliefs = belief.copy()
    returns = np.zeros(missions)
    discount_product = np.ones(missions)
    for step in range(steps):
        control = decide(belief, filtered_beliefs, step)
        returns += discount_product * np.einsum("bs,sb->b", belief, problem.reward[:, control])
        discount_product *= problem.discount[control]
        for control_index in np.unique(control).tolist():
            missions_with_control = np.flatnonzero(control == control_index)
            likelihood = problem.likelihood[control_index]
            # Draw the next state, and the observation.
            states_before = states[missions_with_control]
            distinct, index_of_distinct = np.unique(states_before, return_inverse=True)
            distributions = [
                problem.transition.row(control_index, state) for state in distinct.tolist()
            ]
            next_probability = np.array(distributions)[index_of_distinct]
            states[missions_with_control] = _draw_indices(
                next_probability, uniform_transition[step, missions_with_control]
            )
            observed_states = (
                states[missions_with_control] if problem.moves_first else states_before
            )
            observation = _draw_indices(
                likelihood[:, observed_states].T, uniform_observation[step, missions_with_control]
            )
            # Correct the belief.
            unnormalized = problem.next_beliefs(
                belief[missions_with_control], control_index, observation
            )
            if problem.moves_first:
                unnormalized_filtered = unnormalized
            else:
                unnormalized_filtered = belief[missions_with_control] * likelihood[observation]
            filtered_beliefs[missions_with_control] = _normalize(unnormalized_filtered)
            belief[missions_with_control] = _normalize(unnormalized)
    return returns


def leaving_probability(
    problem: DecisionProblem,
    policy: BeliefPolicy,
    belief: Float,
    control: int,
    steps: int,
    generator: np.random.Generator,
) -> Float:
    """Return the probability that a policy chooses another control within some steps: (B,).

    It is estimated as the fraction of simulated futures of a twin in which that happens.

    Parameters
    ----------
    problem : DecisionProblem
        A problem whose state is observed before it moves.
    belief : (B, S) array
        The belief of each twin before the first of the steps.
    control : int
        The control in force until the policy chooses another one.
    steps : int
        The number of decisions; the first one is by `belief`.
    generator : numpy.random.Generator
        Draws observations; all twins have the same random numbers.
    """
    fraction = np.empty(len(belief))
    uniform = generator.random((steps - 1, FUTURES))
    for twin, twin_belief in enumerate(belief):
        beliefs = np.tile(twin_belief, (FUTURES, 1))
        has_left = policy.decide(beliefs) != control
        # All futures begin with the same belief, and so with the same first decision. If this is
        # another control, no further step is needed.
        later_steps = uniform[:0] if has_left.all() else uniform
        for uniform_of_step in later_steps:
            probability = beliefs @ problem.likelihood[control].T
            observation = _draw_indices(probability, uniform_of_step)
            beliefs = _normalize(problem.next_beliefs(beliefs, control, observation))
            has_left |= policy.decide(beliefs) != control
        fraction[twin] = has_left.mean()
    return fraction


def _normalize(rows: Float) -> Float:
    """Return rows of B missions, each divided by its sum."""
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
