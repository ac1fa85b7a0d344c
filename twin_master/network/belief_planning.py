"""Planning on the belief: value iteration at points, between a lower and an upper bound.

The lower bound of the return is a set of vectors, each with the return of one plan from each state.
The upper bound is a set of values at beliefs. Beliefs are visited where the bounds differ most:
Smith and Simmons 2005, heuristic search value iteration; Kurniawati et al. 2008, SARSOP. Now and
then both bounds are improved at all visited beliefs: Pineau et al. 2003; Poupart et al. 2011.
"""

from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.planner import BeliefPolicy, evaluate_policy
from twin_master.network.upper_bound import UpperBound

_LEAST_IMPROVEMENT = 1e-12
"""Smallest improvement of a bound that counts, so that rounding does not add vectors."""
_LEAST_DISCOUNT = 1e-12
"""Least factor by which an allowed gap is divided; a control may discount by zero."""
_LONGEST_DESCENT = 1000
"""Largest number of steps that a descent looks ahead."""
MOST_BELIEFS = 180
"""Largest number of beliefs at which the bounds are improved before planning ends."""
MOST_UNSETTLED = 1000
"""The same if the upper bound cannot settle, because that takes too much time or memory."""
_GAP_OF_DESCENT = 0.9
"""Fraction of the gap at the prior that a descent allows, so that it is short for a wide gap."""
_FIRST_SETTLING = 32
"""Beliefs that are visited before the bounds settle for the first time."""
_SETTLING_GROWTH = 1.6
"""Factor by which the number of visited beliefs grows until the bounds settle again."""
_RAISING_SWEEPS = 3
"""Sweeps of the lower bound over all visited beliefs when the bounds settle."""


class _Bounds:
    """The lower and the upper bound of the return at every belief.

    The lower bound begins with plans that take one control for ever.
    """

    def __init__(self, problem: DecisionProblem) -> None:
        controls, states, _ = problem.transition.shape
        self.problem = problem
        self.upper = UpperBound(problem)
        values = []
        for is_control in np.eye(controls):
            policy = np.tile(is_control, (states, 1))
            plan = evaluate_policy(problem.transition, problem.reward, problem.discount, policy)
            values.append(plan.value)
        self.vectors = np.array(values)  # (N, S)
        self.control = np.arange(controls)  # (N,), the first control of each vector

    def lower_bound_at(self, rows: Float) -> Float:
        """Return the lower bound at K rows of S probabilities that need not sum to one: (K,)."""
        return np.asarray((rows @ self.vectors.T).max(axis=1))

    def backup(self, control: int, rows: Float) -> Float:
        """Return the vector (S,) of a plan: a control, then the best plan for each observation.

        Parameters
        ----------
        control : int
            The first control.
        rows : (K, S) array
            The next belief after each of K observations, at which the best known plan is chosen.
        """
        best_plans = np.argmax(rows @ self.vectors.T, axis=1)
        expected_return_later = self.problem.expected_vector(control, best_plans, self.vectors)
        discount = self.problem.discount[control]
        return np.asarray(self.problem.reward[:, control] + discount * expected_return_later)

    def raise_lower_bound_at(self, belief: Float) -> None:
        """Improve the lower bound at a belief (S,), by the vector of the best control there."""
        problem = self.problem
        controls = range(len(problem.discount))
        next_rows = [problem.next_beliefs(belief, control) for control in controls]
        return_later = np.array([self.lower_bound_at(rows).sum() for rows in next_rows])
        action_value = belief @ problem.reward + problem.discount * return_later
        best_control = int(np.argmax(action_value))
        present_bound = self.lower_bound_at(belief[None])[0]
        if action_value[best_control] > present_bound + _LEAST_IMPROVEMENT:
            vector = self.backup(best_control, next_rows[best_control])
            # A vector is dropped if the new one is at least as large in every state.
            is_needed = ~np.all(self.vectors <= vector, axis=1)
            self.vectors = np.vstack((self.vectors[is_needed], vector))
            self.control = np.append(self.control[is_needed], best_control)

    def descend(self, belief: Float, first: int | None, allowed_gap: float) -> list[Float]:
        """Return a path of beliefs along which the bounds differ by more than allowed.

        It is the descent of heuristic search value iteration (Smith and Simmons 2005). Each step
        takes the control of the largest upper bound, and then the observation whose belief adds
        most to the difference of the bounds beyond the allowed one.

        Parameters
        ----------
        belief : (S,) array
            The belief to begin with.
        first : int or None
            The control of the first step, if it is prescribed.
        allowed_gap : float
            The allowed difference of the bounds at the first belief.

        Returns
        -------
        list of (S,) arrays
            The beliefs in the order of the steps, the given one first.
        """
        path = [belief]
        while len(path) < _LONGEST_DESCENT:
            if first is not None and len(path) == 1:
                control = first
            else:
                control = int(np.argmax(self.upper.action_bound(belief)))
            # A difference one step later is discounted, so that a larger one is allowed there.
            allowed_gap /= max(float(self.problem.discount[control]), _LEAST_DISCOUNT)
            # A row for each observation. Beliefs, and so the gaps, are multiplied by its
            # probability.
            weighted_beliefs = self.problem.next_beliefs(belief, control)
            weighted_gaps = self.upper.bound_at(weighted_beliefs) - self.lower_bound_at(
                weighted_beliefs
            )
            observation_probability = weighted_beliefs.sum(axis=1)
            excess = weighted_gaps - allowed_gap * observation_probability
            observation = int(np.argmax(excess))
            if excess[observation] <= 0.0:
                break
            belief = weighted_beliefs[observation] / observation_probability[observation]
            path.append(belief)
        return path

    def bounds_at(self, belief: Float, first: int | None) -> tuple[float, float]:
        """Return lower and upper bound of the return at a belief (S,).

        If a first control is given, it is taken in the first step.
        """
        if first is None:
            row = belief[None]
            lower = float(self.lower_bound_at(row)[0])
            upper = float(self.upper.bound_at(row)[0])
            return lower, upper
        rows = self.problem.next_beliefs(belief, first)
        reward = float(belief @ self.problem.reward[:, first])
        discount = float(self.problem.discount[first])
        lower = reward + discount * float(self.lower_bound_at(rows).sum())
        upper = reward + discount * float(self.upper.bound_at(rows).sum())
        return lower, upper


@dataclass(frozen=True)
class BeliefPlan:
    """A plan on the belief.

    Attributes
    ----------
    policy : BeliefPolicy
        The vectors of each control that are largest at some visited belief.
    lower, upper : float
        Bounds of the expected discounted return from the prior under the best policy. The return of
        the plan is the lower one at least.
    """

    policy: BeliefPolicy
    lower: float
    upper: float


def plan_on_belief(
    problem: DecisionProblem,
    *,
    first: int | None = None,
    gap: float = 0.005,
    most_beliefs: int | None = None,
) -> BeliefPlan:
    """Plan on the belief by heuristic search between a lower and an upper bound of the return.

    The search ends when the bounds at the prior are close, or when the largest number of beliefs
    has been visited.

    Parameters
    ----------
    first : int, optional
        The control of the first step, if it is prescribed.
    gap : float
        The difference of the bounds at the end, as a fraction of the return.
    most_beliefs : int, optional
        The largest number of visits to beliefs. If left out, it is 180, or 1000 if the upper bound
        cannot settle.
    """
    # Descend from the prior to beliefs at which the bounds differ most; then improve both bounds at
    # these beliefs, the last one first, because earlier bounds follow from later ones.
    bounds = _Bounds(problem)
    visited: list[Float] = []
    next_settling = _FIRST_SETTLING
    lower, upper = bounds.bounds_at(problem.prior, first)
    most_visits = most_beliefs or MOST_BELIEFS
    while upper - lower > gap * max(abs(lower), abs(upper)) and len(visited) < most_visits:
        path = bounds.descend(problem.prior, first, _GAP_OF_DESCENT * (upper - lower))
        for belief in reversed(path):
            bounds.raise_lower_bound_at(belief)
            bounds.upper.improve_at(belief)
        visited += path
        if not most_beliefs:
            most_visits = MOST_BELIEFS if bounds.upper.can_settle() else MOST_UNSETTLED
        # now and then, improve the bounds at all visited beliefs
        if len(visited) >= min(next_settling, most_visits):
            next_settling = int(_SETTLING_GROWTH * len(visited))
            bounds.upper.settle()
            for belief in visited * _RAISING_SWEEPS:
                bounds.raise_lower_bound_at(belief)
        lower, upper = bounds.bounds_at(problem.prior, first)
    beliefs = np.unique(np.array(visited or [problem.prior]), axis=0)
    return BeliefPlan(_policy_at(bounds, beliefs), lower, upper)


def _policy_at(bounds: _Bounds, beliefs: Float) -> BeliefPolicy:
    """Return the policy of the vectors that are best at some beliefs (B, S).

    A vector has the return by state if one control is taken first. For each control, the policy has
    the vectors that give the largest return at one of the beliefs.
    """
    vectors_by_control = []
    for control in range(len(bounds.problem.discount)):
        backups = []
        for belief in beliefs:
            rows = bounds.problem.next_beliefs(belief, control)
            backups.append(bounds.backup(control, rows))
        vectors_of_control = bounds.vectors[bounds.control == control]
        vectors = np.vstack((vectors_of_control, np.array(backups)))
        largest = np.unique(np.argmax(beliefs @ vectors.T, axis=1))
        vectors_by_control.append(vectors[largest])
    counts = [len(vectors) for vectors in vectors_by_control]
    controls = np.repeat(np.arange(len(counts)), counts)
    return BeliefPolicy(np.vstack(vectors_by_control), controls)
