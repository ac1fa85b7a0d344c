"""An upper bound of the return of a decision problem, from values at beliefs and at the corners.

A corner is the belief that is certain of a state. For each first control the best return is convex
in the belief, and proportional to it if the row of probabilities is scaled. So if a row is a sum of
beliefs, each times a weight, its return is at most the sum of their values times the weights (the
sawtooth bound, Hauskrecht 2000). Such a sum is here called a composition of the row.

Shapes: J beliefs with a known bound, S states, U controls, K rows, at most P beliefs in a
composition.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.planner import value_iteration

_MOST_PARTS = 4
"""Largest number of beliefs that compose a row; the corners are not counted."""
_ROUNDED_PROBABILITY = 0.15
"""Probabilities below this fraction of the largest are left out of a simplified belief."""
_MOST_PRODUCTS = 1e9
"""Largest number of products that are summed to compose all next beliefs once."""
_MOST_KEPT_PARTS = 5e7
"""Largest number of parts of compositions that are kept while the bound settles.

Each takes 50 bytes."""
_PASSES = 6
"""How often beliefs are composed anew while the bound settles."""
_SWEEPS = 15
"""Sweeps over all beliefs between two compositions."""


class SparseBeliefs(NamedTuple):
    """J beliefs without their zeros, the largest probability of each first.

    Attributes
    ----------
    start : (J + 1,) array
        Belief j has the entries from `start[j]` up to `start[j + 1]`.
    state : (entries,) array
        The state of each entry.
    probability : (entries,) array
        The probability of this state.
    """

    start: Index
    state: Index
    probability: Float


class Composition(NamedTuple):
    """Rows (K, S) written as sums of at most P beliefs and of corners, and the resulting bound.

    Attributes
    ----------
    bound : (K,) array
        The upper bound of the return at each row.
    corner_bound : (K, U) array
        The bound by the corners alone, with each control first.
    belief_index : (K, U, P) array
        The indices of those beliefs among the J, for the bound with each control first.
    weight : (K, U, P) array
        Their weights; zero where fewer than P beliefs are used.
    """

    bound: Float
    corner_bound: Float
    belief_index: Index
    weight: Float


@compiled
def _compose_rows(
    rows: Float,
    corner: Float,
    beliefs: SparseBeliefs,
    drop: Float,
    order: Index,
    composition: Composition,
) -> None:
    """Write rows as sums of beliefs and corners, so that the upper bound at each row is low.

    Beliefs are subtracted from a row greedily: each time the belief that lowers the bound most,
    with the largest weight for which no entry of the remainder is negative. The corners make up the
    remainder.

    Parameters
    ----------
    rows : (K, S) array
        Rows of probabilities, which need not sum to one.
    corner : (U, S) array
        The bound in each state, with each control first.
    drop : (J, U) array
        The bound at each belief minus that of the corners: zero or less.
    order : (J, U) array
        The beliefs in rising order of `drop`, for each control.
    composition : Composition
        The result, filled here; `weight` must be zero before the call.
    """
    start, state, probability = beliefs
    bound, corner_bound, belief_index, weight = composition
    for row in range(len(rows)):
        corner_bound[row] = corner @ rows[row]
        largest_bound = -np.inf
        # Begin with the control of the largest bound by the corners: the search for another control
        # ends as soon as its bound falls below the best one.
        for control in np.argsort(-corner_bound[row]):
            control_bound = corner_bound[row, control]
            remaining = rows[row].copy()
            remaining_mass = rows[row].sum()
            for part in range(belief_index.shape[2]):
                if control_bound <= largest_bound:
                    break
                # The belief that lowers the bound most.
                lowest = 0.0
                lowest_weight = 0.0
                for j in order[:, control]:
                    if remaining_mass * drop[j, control] >= lowest:
                        break  # `order` is rising: no later belief lowers the bound more
                    largest_weight = remaining_mass
                    for i in range(start[j], start[j + 1]):
                        if largest_weight * drop[j, control] >= lowest:
                            break
                        if remaining[state[i]] < largest_weight * probability[i]:
                            largest_weight = remaining[state[i]] / probability[i]
                    if largest_weight * drop[j, control] < lowest:
                        lowest = largest_weight * drop[j, control]
                        lowest_weight = largest_weight
                        belief_index[row, control, part] = j
                if lowest_weight == 0.0:
                    break
                # Subtract it from the row.
                weight[row, control, part] = lowest_weight
                j = belief_index[row, control, part]
                for i in range(start[j], start[j + 1]):
                    remainder = remaining[state[i]] - lowest_weight * probability[i]
                    remaining[state[i]] = max(remainder, 0.0)
                control_bound = control_bound + lowest
                remaining_mass = remaining_mass - lowest_weight
            largest_bound = max(largest_bound, control_bound)
        bound[row] = largest_bound


@dataclass(frozen=True)
class _NextRows:
    """The compositions of the N next beliefs of all J beliefs, for sweeps of value iteration.

    Attributes
    ----------
    corner_bound : (N, U) array
        The bound of each next belief by the corners alone; updated in place.
    belief_and_control : (N, U, P) array
        The beliefs in the composition of each next belief under each control: flat indices into a
        (J, U) array, of a belief and that control.
    weight : (N, U, P) array
        The weights of these beliefs.
    corner_probability : (N, C) array
        The probability, in each next belief, of the C states whose corner is one of the J beliefs.
    first_row : (J U,) array
        The index of the first next belief of each belief under each control.
    """

    corner_bound: Float
    belief_and_control: Index
    weight: Float
    corner_probability: Float
    first_row: Index


class UpperBound:
    """An upper bound of the return at any belief.

    For each first control it is known at some beliefs and at the corners. The bound at a belief is
    the largest over the first controls.

    Parameters
    ----------
    problem : DecisionProblem
        The problem. The first bound is the return of the problem whose state is observed.
    """

    def __init__(self, problem: DecisionProblem) -> None:
        controls, states, _ = problem.transition.shape
        plan = value_iteration(problem.transition, problem.reward, problem.discount)
        self._problem = problem
        self._corner = plan.action_value.T.copy()  # (U, S)
        self._beliefs = np.empty((0, states))  # (J, S)
        self._value = np.empty((0, controls))  # (J, U)
        self._update_lists()

    def _update_lists(self) -> None:
        """Update the sparse form of the beliefs: without zeros, the largest probability first."""
        order = np.argsort(-self._beliefs, axis=1, kind="stable")
        count = np.count_nonzero(self._beliefs, axis=1)
        is_positive = np.arange(self._beliefs.shape[1]) < count[:, None]  # in sorted order
        sorted_probability = np.take_along_axis(self._beliefs, order, axis=1)
        self._sparse_beliefs = SparseBeliefs(
            start=np.concatenate([[0], np.cumsum(count)]),
            state=order[is_positive],
            probability=sorted_probability[is_positive],
        )
        self._update_drop()

    def _update_drop(self) -> None:
        """Update the difference of the bound at each belief from the bound by the corners alone."""
        self._drop = np.minimum(self._value - self._beliefs @ self._corner.T, 0.0)
        self._order = np.argsort(self._drop, axis=0)

    def _compose(self, rows: Float) -> Composition:
        """Write rows (K, S) as sums of beliefs and corners, and return the resulting bounds."""
        rows = np.ascontiguousarray(rows)
        shape = (len(rows), len(self._corner))
        composition = Composition(
            bound=np.empty(len(rows)),
            corner_bound=np.empty(shape),
            belief_index=np.zeros((*shape, _MOST_PARTS), dtype=np.int64),
            weight=np.zeros((*shape, _MOST_PARTS)),
        )
        _compose_rows(
            rows, self._corner, self._sparse_beliefs, self._drop, self._order, composition
        )
        return composition

    def bound_at(self, rows: Float) -> Float:
        """Return the bound at K rows of S probabilities that need not sum to one: (K,)."""
        return self._compose(rows).bound

    def action_bound(self, belief: Float) -> Float:
        """Return the bound at a belief (S,) for each first control, by one Bellman backup: (U,)."""
        problem = self._problem
        bound_later = [
            self.bound_at(problem.next_beliefs(belief, control)).sum()
            for control in range(len(self._corner))
        ]
        return np.asarray(belief @ problem.reward + problem.discount * bound_later)

    def improve_at(self, belief: Float) -> None:
        """Improve the bound at a belief (S,), and at simpler beliefs if they are new.

        The simpler beliefs are the corners of its most probable states, and the belief without its
        improbable states. A belief of few states is a component of many other beliefs.
        """
        rounded = np.where(belief < _ROUNDED_PROBABILITY * belief.max(), 0.0, belief)
        corner_count = min(_MOST_PARTS, np.count_nonzero(rounded))
        likely_states = np.argsort(-rounded, kind="stable")[:corner_count]
        corners = np.equal.outer(likely_states, np.arange(len(belief))).astype(np.float64)
        for simple_belief in (*corners, rounded / rounded.sum()):
            if not self._equals(simple_belief).any():
                self._add_belief(simple_belief)
        is_belief = self._equals(belief)
        if is_belief.any():
            self._value[is_belief] = np.minimum(self._value[is_belief], self.action_bound(belief))
        else:
            self._add_belief(belief)
        self._update_lists()

    def _equals(self, belief: Float) -> Index:
        """Return which of the J beliefs equal a given belief (S,), as truth values (J,)."""
        return np.asarray(np.all(self._beliefs == belief, axis=1))

    def _add_belief(self, belief: Float) -> None:
        """Add a belief (S,) with its bound; the caller must call `_update_lists` afterwards."""
        self._beliefs = np.vstack((self._beliefs, belief))
        self._value = np.vstack((self._value, self.action_bound(belief)))

    def can_settle(self) -> bool:
        """Return whether `settle` takes an acceptable time and memory with the present beliefs."""
        beliefs, states = self._beliefs.shape
        next_beliefs = beliefs * sum(len(table) for table in self._problem.likelihood)
        compositions = next_beliefs * len(self._corner)
        is_fast = compositions * states <= _MOST_PRODUCTS
        return is_fast and compositions * _MOST_PARTS <= _MOST_KEPT_PARTS

    def settle(self) -> None:
        """Improve the bound at all beliefs by sweeps of value iteration.

        The bound at a belief that may follow is a weighted sum of the bounds at known beliefs, its
        composition. The compositions are found anew in each pass, and stay fixed in its sweeps. If
        all that takes too much time or memory (`can_settle`), the bound is not changed.
        """
        if not self.can_settle():
            return
        problem = self._problem
        controls = len(self._corner)
        is_corner = self._beliefs.max(axis=1) == 1.0
        corner_beliefs = np.flatnonzero(is_corner)
        corner_states = np.argmax(self._beliefs[corner_beliefs], axis=1)
        reward = self._beliefs @ problem.reward
        for _ in range(_PASSES):
            next_rows = self._compose_next_rows(corner_states)
            for _ in range(_SWEEPS):
                # Bound at all next beliefs, with fixed compositions. Then a Bellman backup at all
                # beliefs: sum over the next beliefs of each belief and control.
                drop = self._drop.ravel()[next_rows.belief_and_control]
                bound_by_control = next_rows.corner_bound + np.einsum(
                    "kup,kup->ku", next_rows.weight, drop
                )
                bound_later = np.add.reduceat(bound_by_control.max(axis=1), next_rows.first_row)
                bound_later = bound_later.reshape(-1, controls)
                self._value = np.minimum(self._value, reward + problem.discount * bound_later)
                # The value of a belief that is a corner also lowers the bound by the corners: that
                # of a next belief in proportion to its probability of the corner's state.
                corner_value = self._value[corner_beliefs].T
                lowering = np.minimum(corner_value - self._corner[:, corner_states], 0.0)
                self._corner[:, corner_states] += lowering
                next_rows.corner_bound[:] += next_rows.corner_probability @ lowering.T
                self._update_drop()

    def _compose_next_rows(self, corner_states: Index) -> _NextRows:
        """Return the composition of every belief that can follow any of the J beliefs.

        All controls and observations are considered.

        Parameters
        ----------
        corner_states : (C,) array
            The states whose corners are among the J beliefs.
        """
        control_count = len(self._corner)
        compositions = []
        corner_probabilities = []
        for belief in self._beliefs:
            for control in range(control_count):
                rows = self._problem.next_beliefs(belief, control)  # (observations, S)
                compositions.append(self._compose(rows))
                corner_probabilities.append(rows[:, corner_states])
        row_counts = [len(composition.bound) for composition in compositions]
        belief_index = np.concatenate([composition.belief_index for composition in compositions])
        # (N, U, P): the flat index in (J, U) of belief j under control u is j U + u.
        belief_and_control = belief_index * control_count + np.arange(control_count)[:, None]
        return _NextRows(
            corner_bound=np.concatenate([composition.corner_bound for composition in compositions]),
            belief_and_control=belief_and_control,
            weight=np.concatenate([composition.weight for composition in compositions]),
            corner_probability=np.concatenate(corner_probabilities),
            first_row=np.cumsum([0, *row_counts[:-1]]),
        )
