"""Planning on the belief: value iteration at points, between a lower and an upper bound of the return.

The lower bound are vectors, each the return of a plan from each state; the upper one are values at beliefs,
joined like the teeth of a saw to those at the corners. Beliefs are visited where the bounds differ most:
Smith and Simmons 2005, heuristic search value iteration; Kurniawati et al. 2008, SARSOP.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from twin_master.errors import PlanningError
from twin_master.network.planner import BeliefPolicy, evaluate_policy, value_iteration
from twin_master.network.transition import TransitionModel

__all__ = ["BeliefPlan", "DecisionProblem", "plan_on_belief"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_STEP = 1e-12
"""What a bound improves by at least."""
_DEEPEST = 1000
"""Turns that a descent looks ahead at most."""
MOST_BELIEFS = 1000
"""Beliefs to improve the bounds at, where the gap stays wider than asked for."""
_SHARE = 0.9
"""Of the gap of the prior that a descent leaves alone, so that it is short while the gap is wide."""
_INFORMED = 200
"""Sweeps of the informed bound; each is a bound."""


@dataclass(frozen=True)
class DecisionProblem:
    """What is decided on: a partially observed Markov decision problem of finite size.

    In a turn the state is observed under the control, and then moves; or it moves and is observed then.

    Attributes
    ----------
    transition : TransitionModel
        Of U controls and S states.
    reward : (S, U)
        Of one turn.
    discount : (U,)
        In [0, 1): what the return behind a turn counts; zero where nothing comes behind it.
    likelihood : tuple of (K, S), dimensionless
        For each control p(observation | state): columns sum to one; K may differ from control to control.
    prior : (S,)
        Belief before the first turn.
    moves_first : bool
        Whether what is observed in a turn is of the state that it leads to.
    """

    transition: TransitionModel
    reward: Float
    discount: Float
    likelihood: tuple[Float, ...]
    prior: Float
    moves_first: bool = False

    def __post_init__(self) -> None:
        controls, states, _ = self.transition.shape
        wrong = [table.shape for table in self.likelihood if table.shape[1:] != (states,)]
        if self.reward.shape != (states, controls) or len(self.likelihood) != controls or wrong:
            raise PlanningError(
                f"expected rewards of shape {(states, controls)} and for each control observations of "
                f"{states} columns, got {self.reward.shape} and {[t.shape for t in self.likelihood]}"
            )
        if any(np.any(np.abs(table.sum(axis=0) - 1.0) > 1e-9) for table in self.likelihood):
            raise PlanningError("the observations of each state must have probabilities that sum to one")

    def following(self, belief: Float, control: int, observed: Index | None = None) -> Float:
        """Return the probabilities of observations times the beliefs behind them: (K, S).

        Of all observations behind one belief (S,), or of one observation (B,) behind each of (B, S).
        """
        likelihood = self.likelihood[control]
        likelihood = likelihood if observed is None else likelihood[observed]
        if self.moves_first:
            return np.asarray(likelihood * self.transition.forward(control, belief))
        return self.transition.forward(control, likelihood * belief)

    def behind(self, control: int, chosen: Index, vectors: Float) -> Float:
        """Return the mean of vectors (N, S), one chosen for each observation (K,), behind a turn: (S,)."""
        likelihood, expected = self.likelihood[control], self.transition.expected
        if self.moves_first:
            return expected(control, np.einsum("ks,ks->s", likelihood, vectors[chosen]))
        result: Float = np.zeros(len(self.prior))
        for number in np.unique(chosen).tolist():
            result += likelihood[chosen == number].sum(axis=0) * expected(control, vectors[number])
        return result


@compiled
def _saw(rows: Float, corner: Float, point: Float, drop: Float, result: Float) -> None:
    """Fill result (K,) with the upper bound at rows (K, S), which need not sum to one.

    point (J, S) are beliefs, drop (J,) is by how much their value lies below that of the corners.
    """
    for row in range(rows.shape[0]):
        lowest = 0.0
        for j in range(point.shape[0]):
            share = np.inf
            for state in range(rows.shape[1]):
                if point[j, state] > 0.0:
                    share = min(share, rows[row, state] / point[j, state])
                    if share * drop[j] >= lowest:
                        break
            lowest = min(lowest, share * drop[j])
        total = lowest
        for state in range(rows.shape[1]):
            total += rows[row, state] * corner[state]
        result[row] = total


@dataclass
class _Bounds:
    """Lower and upper bound of the return from every belief."""

    problem: DecisionProblem
    vectors: Float
    control: Index
    corner: Float
    point: Float
    value: Float

    @classmethod
    def of(cls, problem: DecisionProblem) -> "_Bounds":
        """Begin with one control for ever below, and with a state that is told behind each turn above."""
        controls, states, _ = problem.transition.shape
        always = [np.tile(row, (states, 1)) for row in np.eye(controls)]
        blind = [evaluate_policy(problem.transition, problem.reward, problem.discount, row) for row in always]
        corner = _informed(problem).max(axis=0)
        return cls(problem, np.array(blind), np.arange(controls), corner, np.empty((0, states)), np.empty(0))

    def upper(self, rows: Float) -> Float:
        """Return the upper bound at rows (K, S) that need not sum to one: (K,)."""
        result = np.empty(len(rows))
        drop = np.minimum(self.value - self.point @ self.corner, 0.0)
        _saw(np.ascontiguousarray(rows), self.corner, self.point, drop, result)
        return result

    def lower(self, rows: Float) -> Float:
        """Return the lower bound likewise."""
        result: Float = (rows @ self.vectors.T).max(axis=1)
        return result

    def look(self, belief: Float) -> tuple[list[Float], Float]:
        """Return what may follow each control, and the upper bound of the return with that control first."""
        after = [self.problem.following(belief, u) for u in range(len(self.problem.discount))]
        later = np.array([self.upper(rows).sum() for rows in after])
        return after, belief @ self.problem.reward + self.problem.discount * later

    def backup(self, after: list[Float]) -> Float:
        """Return the vector of each control with the best that is known behind it: (U, S)."""
        found = self.problem.reward.T.copy()
        for u, rows in enumerate(after):
            chosen = np.argmax(rows @ self.vectors.T, axis=1)
            found[u] += self.problem.discount[u] * self.problem.behind(u, chosen, self.vectors)
        return found

    def update(self, belief: Float) -> None:
        """Improve both bounds at a belief."""
        after, above = self.look(belief)
        found = self.backup(after)
        best = int(np.argmax(found @ belief))
        if found[best] @ belief > self.lower(belief[None])[0] + _STEP:
            kept = ~np.all(self.vectors <= found[best], axis=1)
            self.vectors = np.vstack((self.vectors[kept], found[best]))
            self.control = np.append(self.control[kept], best)
        value = float(above.max())
        if value < self.upper(belief[None])[0] - _STEP:
            if belief.max() > 1.0 - _STEP:
                self.corner[np.argmax(belief)] = value
            else:
                kept = np.any(self.point != belief, axis=1)
                self.point = np.vstack((self.point[kept], belief))
                self.value = np.append(self.value[kept], value)

    def descend(self, belief: Float, first: int | None, gap: float) -> list[Float]:
        """Return beliefs one behind the other, where the bounds differ by more than the gap allows."""
        path: list[Float] = []
        while len(path) < _DEEPEST:
            path.append(belief)
            after, above = self.look(belief)
            control = int(np.argmax(above)) if first is None or len(path) > 1 else first
            rows, gap = after[control], gap / max(float(self.problem.discount[control]), _STEP)
            excess = self.upper(rows) - self.lower(rows) - gap * rows.sum(axis=1)
            next_one = int(np.argmax(excess))
            if excess[next_one] <= 0.0:
                break
            belief = rows[next_one] / rows[next_one].sum()
        return path

    def at(self, belief: Float, first: int | None) -> tuple[float, float]:
        """Return lower and upper bound at a belief, under a first control where one is given."""
        if first is None:
            return float(self.lower(belief[None])[0]), float(self.upper(belief[None])[0])
        rows = self.problem.following(belief, first)
        now, later = float(belief @ self.problem.reward[:, first]), float(self.problem.discount[first])
        return now + later * float(self.lower(rows).sum()), now + later * float(self.upper(rows).sum())


def _informed(problem: DecisionProblem) -> Float:
    """Return the fast informed bound (U, S): the state is told behind each turn; Hauskrecht 2000."""
    plan = value_iteration(problem.transition, problem.reward, problem.discount)
    value, expected = plan.action_value.T, problem.transition.expected
    for _ in range(_INFORMED):
        before = value
        later = [
            sum(np.max([expected(u, seen * row) for row in before], axis=0) for seen in table)
            if problem.moves_first
            else np.max([expected(u, row) for row in before], axis=0)
            for u, table in enumerate(problem.likelihood)
        ]
        value = problem.reward.T + problem.discount[:, None] * np.array(later)
    return np.asarray(value)


@dataclass(frozen=True)
class BeliefPlan:
    """A plan on the belief.

    Attributes
    ----------
    policy : BeliefPolicy
        A vector of each control at each belief that was visited, as far as none is better everywhere.
    lower, upper : float
        Bounds of the expected discounted return from the prior, of the best policy; that of the plan is the
        lower one at least.
    beliefs : (B, S)
        Visited.
    trials : int
        Descents from the prior.
    """

    policy: BeliefPolicy
    lower: float
    upper: float
    beliefs: Float
    trials: int


def plan_on_belief(
    problem: DecisionProblem,
    *,
    first: int | None = None,
    gap: float = 0.005,
    most_beliefs: int = MOST_BELIEFS,
) -> BeliefPlan:
    """Plan until the bounds of the return from the prior are close, or enough beliefs have been visited.

    Parameters
    ----------
    problem : DecisionProblem
    first : int, optional
        Control of the first turn, where that is not decided on.
    gap : float
        Between the bounds at the end, as a share of the return.
    most_beliefs : int
        Beliefs to improve the bounds at, counted each time.
    """
    bounds, visited, trials = _Bounds.of(problem), list[Float](), 0
    lower, upper = bounds.at(problem.prior, first)
    while upper - lower > gap * max(abs(lower), abs(upper)) and len(visited) < most_beliefs:
        path = bounds.descend(problem.prior, first, _SHARE * (upper - lower))
        for belief in reversed(path):
            bounds.update(belief)
        visited += path
        trials += 1
        lower, upper = bounds.at(problem.prior, first)
    beliefs = np.unique(np.array(visited or [problem.prior]), axis=0)
    return BeliefPlan(_policy(bounds, beliefs), lower, upper, beliefs, trials)


def _policy(bounds: _Bounds, beliefs: Float) -> BeliefPolicy:
    """Return for each control the vectors that are largest at some belief."""
    controls = range(len(bounds.problem.discount))
    after = ([bounds.problem.following(belief, u) for u in controls] for belief in beliefs)
    found = np.array([bounds.backup(rows) for rows in after])  # (B, U, S)
    kept = []
    for control in controls:
        vectors = np.vstack((bounds.vectors[bounds.control == control], found[:, control]))
        kept.append(vectors[np.unique(np.argmax(beliefs @ vectors.T, axis=1))])
    return BeliefPolicy(np.vstack(kept), np.repeat(np.arange(len(kept)), [len(each) for each in kept]))
