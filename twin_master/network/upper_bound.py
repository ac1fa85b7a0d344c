"""An upper bound of the return of a decision problem: values at beliefs, and at the corners.

A corner is the belief that is certain of a state. With each control first the return is convex and
of degree one in the belief. So a row of probabilities is worth at most the sum of the values of
beliefs of which it is composed, each times its weight in the row (the sawtooth bound).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.planner import value_iteration

_MOST_PARTS = 4
"""Beliefs of which a row is composed at most, beside the corners."""
_ROUNDED_PROBABILITY = 0.15
"""Smaller probabilities, relative to the largest, are left out of the beliefs that are composed."""
_MOST_PRODUCTS = 1e9
"""Products that are summed to compose all beliefs once, at most."""
_MOST_KEPT_PARTS = 5e7
"""Parts of compositions that are kept at most while the bound settles; each takes 50 bytes."""
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
        Its probability.
    """

    start: Index
    state: Index
    probability: Float


class Composition(NamedTuple):
    """Of which beliefs rows (K, S) are composed, and the bound that follows.

    Attributes
    ----------
    bound : (K,) array
        The upper bound of the return at each row.
    corner_bound : (K, U) array
        The bound by the corners alone, with each control first.
    chosen : (K, U, P) array
        The beliefs that are taken out of each row, one after the other.
    weight : (K, U, P) array
        The weight of each in the row; zero for parts that are not used.
    """

    bound: Float
    corner_bound: Float
    chosen: Index
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
    """Compose rows of beliefs and corners, so that the bound at each row is low.

    Parts are taken out of a row greedily: each is the belief that lowers the bound most, with the
    largest weight that fits into what remains of the row. The corners make up the rest.

    Parameters
    ----------
    rows : (K, S) array
        Rows of probabilities, which need not sum to one.
    corner : (U, S) array
        The bound in each state, with each control first.
    beliefs : SparseBeliefs
        The J beliefs.
    drop : (J, U) array
        The bound at each belief minus that of the corners: zero or less.
    order : (J, U) array
        The beliefs in rising order of `drop`, for each control.
    composition : Composition
        To be filled; `weight` is zero before.
    """
    start, state, probability = beliefs
    bound, corner_bound, chosen, weight = composition
    for row in range(len(rows)):
        corner_bound[row] = corner @ rows[row]
        best = -np.inf
        # The most promising control first: others end as soon as they fall below it.
        for control in np.argsort(-corner_bound[row]):
            total = corner_bound[row, control]
            remaining = rows[row].copy()
            remaining_mass = rows[row].sum()
            for part in range(chosen.shape[2]):
                if total <= best:
                    break
                # The belief that lowers the bound most.
                lowest = 0.0
                lowest_weight = 0.0
                for j in order[:, control]:
                    if remaining_mass * drop[j, control] >= lowest:
                        break  # no later belief lowers it more
                    largest_weight = remaining_mass
                    for i in range(start[j], start[j + 1]):
                        if largest_weight * drop[j, control] >= lowest:
                            break
                        if remaining[state[i]] < largest_weight * probability[i]:
                            largest_weight = remaining[state[i]] / probability[i]
                    if largest_weight * drop[j, control] < lowest:
                        lowest = largest_weight * drop[j, control]
                        lowest_weight = largest_weight
                        chosen[row, control, part] = j
                if lowest_weight == 0.0:
                    break
                # Take it out of the row.
                weight[row, control, part] = lowest_weight
                j = chosen[row, control, part]
                for i in range(start[j], start[j + 1]):
                    rest = remaining[state[i]] - lowest_weight * probability[i]
                    remaining[state[i]] = max(rest, 0.0)
                total = total + lowest
                remaining_mass = remaining_mass - lowest_weight
            best = max(best, total)
        bound[row] = best


@dataclass(frozen=True)
class _NextRows:
    """The compositions of all next beliefs of all beliefs, which sweeps go over.

    Attributes
    ----------
    corner_bound : (N, U) array
        The bound of each next belief by the corners alone; updated in place.
    belief_and_control : (N, U, P) array
        The parts of each next belief: flat indices of a belief and a control in (J, U).
    weight : (N, U, P) array
        Their weights.
    certain_probability : (N, C) array
        The probability of each state that is among the beliefs as a corner.
    first_row : (J U,) array
        The first of the next beliefs of each belief under each control.
    """

    corner_bound: Float
    belief_and_control: Index
    weight: Float
    certain_probability: Float
    first_row: Index


class UpperBound:
    """Upper bound of the return at any belief.

    It is known at some beliefs and at the corners, with each control first. The bound is the
    largest over the controls.

    Parameters
    ----------
    problem : DecisionProblem
        The problem; the bound begins with the return if the state were observed.
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
        """List the beliefs without their zeros, the largest probability first."""
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
        """Update how far the bound at each belief lies below that of the corners."""
        self._drop = np.minimum(self._value - self._beliefs @ self._corner.T, 0.0)
        self._order = np.argsort(self._drop, axis=0)

    def _compose(self, rows: Float) -> Composition:
        """Return of which beliefs rows (K, S) are composed."""
        rows = np.ascontiguousarray(rows)
        shape = (len(rows), len(self._corner))
        composition = Composition(
            bound=np.empty(len(rows)),
            corner_bound=np.empty(shape),
            chosen=np.zeros((*shape, _MOST_PARTS), dtype=np.int64),
            weight=np.zeros((*shape, _MOST_PARTS)),
        )
        _compose_rows(
            rows, self._corner, self._sparse_beliefs, self._drop, self._order, composition
        )
        return composition

    def bound_at(self, rows: Float) -> Float:
        """Return the bound at rows (K, S) of probabilities that need not sum to one: (K,)."""
        return self._compose(rows).bound

    def action_bound(self, belief: Float) -> Float:
        """Return the bound at a belief (S,) with each control first (U,), one step ahead."""
        problem = self._problem
        later = [
            self.bound_at(problem.next_beliefs(belief, control)).sum()
            for control in range(len(self._corner))
        ]
        return np.asarray(belief @ problem.reward + problem.discount * later)

    def improve_at(self, belief: Float) -> None:
        """Improve the bound at a belief (S,) and at simpler beliefs near it.

        These are the corners of its most probable states, and the belief without its improbable
        states. Beliefs of few states fit into many others.
        """
        rounded = np.where(belief < _ROUNDED_PROBABILITY * belief.max(), 0.0, belief)
        corner_count = min(_MOST_PARTS, np.count_nonzero(rounded))
        likely_states = np.argsort(-rounded, kind="stable")[:corner_count]
        corners = np.equal.outer(likely_states, np.arange(len(belief))).astype(np.float64)
        for simple_belief in (*corners, rounded / rounded.sum()):
            if not self._index_of(simple_belief).any():
                self._add_belief(simple_belief)
        is_belief = self._index_of(belief)
        if is_belief.any():
            self._value[is_belief] = np.minimum(self._value[is_belief], self.action_bound(belief))
        else:
            self._add_belief(belief)
        self._update_lists()

    def _index_of(self, belief: Float) -> Index:
        """Return which of the beliefs (J,) is a given one, as truth values."""
        return np.asarray(np.all(self._beliefs == belief, axis=1))

    def _add_belief(self, belief: Float) -> None:
        """Add a belief with its bound; the lists are not updated."""
        self._beliefs = np.vstack((self._beliefs, belief))
        self._value = np.vstack((self._value, self.action_bound(belief)))

    def can_settle(self) -> bool:
        """Return whether time and memory allow to compose all next beliefs of all beliefs."""
        beliefs, states = self._beliefs.shape
        rows = beliefs * sum(len(table) for table in self._problem.likelihood)
        rows_and_controls = rows * len(self._corner)
        is_fast = rows_and_controls * states <= _MOST_PRODUCTS
        return is_fast and rows_and_controls * _MOST_PARTS <= _MOST_KEPT_PARTS

    def settle(self) -> None:
        """Improve the bound at all beliefs at once, until improvements have reached all of them.

        If there is too much to compose, the bound is left as it is.
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
            rows = self._compose_next_rows(corner_states)
            for _ in range(_SWEEPS):
                # Bound of all next beliefs, with the compositions as they are; then of all beliefs.
                drop = self._drop.ravel()[rows.belief_and_control]
                bound = rows.corner_bound + np.einsum("kup,kup->ku", rows.weight, drop)
                later = np.add.reduceat(bound.max(axis=1), rows.first_row)
                later = later.reshape(-1, controls)
                self._value = np.minimum(self._value, reward + problem.discount * later)
                # A belief at a corner is a bound of that corner, and so of rows that contain it.
                corner_value = self._value[corner_beliefs].T
                lowering = np.minimum(corner_value - self._corner[:, corner_states], 0.0)
                self._corner[:, corner_states] += lowering
                rows.corner_bound[:] += rows.certain_probability @ lowering.T
                self._update_drop()

    def _compose_next_rows(self, corner_states: Index) -> _NextRows:
        """Return compositions of all next beliefs; `corner_states` (C,) are known corners."""
        controls = len(self._corner)
        compositions = []
        certain_probabilities = []
        for belief in self._beliefs:
            for control in range(controls):
                rows = self._problem.next_beliefs(belief, control)
                compositions.append(self._compose(rows))
                certain_probabilities.append(rows[:, corner_states])
        row_counts = [len(composition.bound) for composition in compositions]
        chosen = np.concatenate([composition.chosen for composition in compositions])
        return _NextRows(
            corner_bound=np.concatenate([part.corner_bound for part in compositions]),
            belief_and_control=chosen * controls + np.arange(controls)[:, None],
            weight=np.concatenate([composition.weight for composition in compositions]),
            certain_probability=np.concatenate(certain_probabilities),
            first_row=np.cumsum([0, *row_counts[:-1]]),
        )
