"""Planning on the belief: value iteration at points, between a lower and an upper bound of the return.

The lower bound are vectors, each the return of a plan from each state; the upper one are values at beliefs,
the corners among them, that others are composed of. Beliefs are visited where the bounds differ most: Smith
and Simmons 2005, heuristic search value iteration; Kurniawati et al. 2008, SARSOP. Now and then both bounds
settle at all of them, as of a problem of so many states: Pineau et al. 2003; Poupart et al. 2011. Last the
returns of policies in simulated missions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.network.planner import BeliefPolicy, given_policy, value_iteration
from twin_master.network.transition import TransitionModel

_STEP = 1e-12
"""What a bound improves by at least."""
_DEEPEST = 1000
"""Steps that a descent looks ahead at most."""
MOST_BELIEFS, MOST_UNSETTLED = 180, 1000
"""Beliefs to improve the bounds at, where the gap stays wider than asked for; where they cannot settle."""
_SHARE = 0.9
"""Of the gap of the prior that a descent leaves alone, so that it is short while the gap is wide."""
_PARTS = 4
"""Beliefs that a belief is composed of at most, beside the corners."""
_ROUNDED = 0.15
"""Share of the largest probability below which others are left out of the beliefs that are composed."""
_FIRST, _GROWTH = 32, 1.6
"""Beliefs that are visited before the bounds settle at all of them, and their growth until they do again."""
_LARGEST = 1e9
"""Products that are summed up to compose all beliefs once, at most."""
_MOST_PARTS = 5e7
"""Parts of composed beliefs that are kept while the bounds settle, at most; each takes some 50 bytes."""
_PASSES, _SWEEPS, _RAISED = 6, 15, 3
"""How often beliefs are composed anew then, sweeps in between, and sweeps of the lower bound."""


@dataclass(frozen=True)
class DecisionProblem:
    """What is decided on: a partially observed Markov decision problem of finite size.

    In a step the state is observed under the control, and then moves; or it moves and is observed then.

    Attributes
    ----------
    transition : TransitionModel
        Of U controls and S states.
    reward : (S, U)
        Of one step.
    discount : (U,)
        In [0, 1): what the return behind a step counts; zero where nothing comes behind it.
    likelihood : tuple of (K, S), dimensionless
        For each control p(observation | state): columns sum to one; K may differ from control to control.
    prior : (S,)
        Belief before the first step.
    moves_first : bool
        Whether what is observed in a step is of the state that it leads to.
    """

    transition: TransitionModel
    reward: Float
    discount: Float
    likelihood: tuple[Float, ...]
    prior: Float
    moves_first: bool = False

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
        """Return the mean of vectors (N, S), one chosen for each observation (K,), behind a step: (S,)."""
        likelihood, expected = self.likelihood[control], self.transition.expected
        if self.moves_first:
            return expected(control, np.einsum("ks,ks->s", likelihood, vectors[chosen]))
        result: Float = np.zeros(len(self.prior))
        for number in np.unique(chosen).tolist():
            result += likelihood[chosen == number].sum(axis=0) * expected(control, vectors[number])
        return result


@compiled
def _composed(
    rows: Float, corner: Float, start: Index, state: Index, probability: Float, drop: Float, order: Index,
    plain: Float, chosen: Index, share: Float,
) -> Float:  # fmt: skip
    """Return the upper bound at rows (K, S), which need not sum to one: (K,).

    corner (U, S) bounds the return with each control first in each state; start (J + 1,), state and
    probability are beliefs without their zeros, drop (J, U) is by how much the bounds there lie below those
    of the corners, and order (J, U) the order in which it rises. Filled are what the corners alone give,
    plain (K, U), the beliefs that are taken out of a row one after the other, chosen (K, U, P), each the one
    that lowers the bound most, and how much of each fits into it, share (K, U, P).
    """
    result = np.empty(len(rows))
    for row in range(len(rows)):
        plain[row] = corner @ rows[row]
        best = -np.inf
        for control in np.argsort(-plain[row]):
            total, left, mass = plain[row, control], rows[row].copy(), rows[row].sum()
            for part in range(chosen.shape[2]):
                if total <= best:
                    break
                lowest, fits = 0.0, 0.0
                for j in order[:, control]:
                    if mass * drop[j, control] >= lowest:
                        break
                    most = mass
                    for i in range(start[j], start[j + 1]):
                        if most * drop[j, control] >= lowest:
                            break
                        if left[state[i]] < most * probability[i]:
                            most = left[state[i]] / probability[i]
                    if most * drop[j, control] < lowest:
                        lowest, fits = most * drop[j, control], most
                        chosen[row, control, part] = j
                if fits == 0.0:
                    break
                share[row, control, part] = fits
                j = chosen[row, control, part]
                for i in range(start[j], start[j + 1]):
                    left[state[i]] = max(left[state[i]] - fits * probability[i], 0.0)
                total, mass = total + lowest, mass - fits
            best = max(best, total)
        result[row] = best
    return result


class _Upper:
    """Upper bound of the return: at beliefs and at the corners, with each control first.

    With each control it is convex and of degree one: a belief has at most what those have together that it is
    composed of. The largest over the controls is the bound.
    """

    def __init__(self, problem: DecisionProblem) -> None:
        controls, states, _ = problem.transition.shape
        plan = value_iteration(problem.transition, problem.reward, problem.discount)
        self._problem, self._corner = problem, plan.action_value.T.copy()  # as if the state were told
        self._point, self._value = np.empty((0, states)), np.empty((0, controls))
        self._index()

    def _index(self) -> None:
        """List the beliefs without their zeros, the largest probability first."""
        order = np.argsort(-self._point, axis=1, kind="stable")
        count = np.count_nonzero(self._point, axis=1)
        inside = np.arange(self._point.shape[1]) < count[:, None]
        start = np.concatenate([[0], np.cumsum(count)])
        self._sparse = start, order[inside], np.take_along_axis(self._point, order, axis=1)[inside]
        self._lower()

    def _lower(self) -> None:
        """Tell by how much the bound at each belief lies below that of the corners."""
        self._drop = np.minimum(self._value - self._point @ self._corner.T, 0.0)
        self._order = np.argsort(self._drop, axis=0)

    def _compose(self, rows: Float) -> tuple[Float, Float, Index, Float]:
        shape = len(rows), len(self._corner)
        plain, chosen = np.empty(shape), np.zeros((*shape, _PARTS), dtype=np.int64)
        share = np.zeros(chosen.shape)
        rows = np.ascontiguousarray(rows)
        bound = _composed(rows, self._corner, *self._sparse, self._drop, self._order, plain, chosen, share)
        return bound, plain, chosen, share

    def at(self, rows: Float) -> Float:
        """Return the bound at rows (K, S) that need not sum to one: (K,)."""
        return self._compose(rows)[0]

    def look(self, belief: Float) -> Float:
        """Return the bound with each control first (U,), by what may follow."""
        problem = self._problem
        later = [self.at(problem.following(belief, u)).sum() for u in range(len(self._corner))]
        return np.asarray(belief @ problem.reward + problem.discount * later)

    def improve(self, belief: Float) -> None:
        """Improve the bound at a belief, and know it near by: without what is improbable, and at the corners.

        Beliefs of few states fit into many others.
        """
        rounded = np.where(belief < _ROUNDED * belief.max(), 0.0, belief)
        likely = np.argsort(-rounded, kind="stable")[: min(_PARTS, np.count_nonzero(rounded))]
        corners = np.equal.outer(likely, np.arange(len(belief))).astype(np.float64)
        for point in (*corners, rounded / rounded.sum(), belief):
            same = np.all(self._point == point, axis=1)
            if not same.any():
                self._point = np.vstack((self._point, point))
                self._value = np.vstack((self._value, self.look(point)))
            elif point is belief:
                self._value[same] = np.minimum(self._value[same], self.look(point))
        self._index()

    def settles(self) -> bool:
        """Return whether time and memory allow to compose what follows all beliefs."""
        rows = len(self._point) * sum(len(table) for table in self._problem.likelihood)
        looked = rows * len(self._corner)
        return looked * self._point.shape[1] <= _LARGEST and looked * _PARTS <= _MOST_PARTS

    def settle(self) -> None:
        """Improve the bound at all beliefs at once, until what each has of the others has gone round.

        Where there is too much to compose the bound is left as it is.
        """
        problem, controls = self._problem, len(self._corner)
        if not self.settles():
            return
        certain = np.flatnonzero(self._point.max(axis=1) == 1.0)
        corners = np.argmax(self._point[certain], axis=1)
        now = self._point @ problem.reward
        for _ in range(_PASSES):
            after = (problem.following(belief, u) for belief in self._point for u in range(controls))
            parts = [(*self._compose(rows)[1:], rows[:, corners]) for rows in after]
            begins = np.cumsum([0, *(len(part[0]) for part in parts[:-1])])
            plain, chosen, share, inside = (np.concatenate(column) for column in zip(*parts, strict=True))
            place = chosen * controls + np.arange(controls)[:, None]
            for _ in range(_SWEEPS):
                every = plain + np.einsum("kup,kup->ku", share, self._drop.ravel()[place])
                later = np.add.reduceat(every.max(axis=1), begins).reshape(-1, controls)
                self._value = np.minimum(self._value, now + problem.discount * later)
                lower = np.minimum(self._value[certain].T - self._corner[:, corners], 0.0)
                self._corner[:, corners] += lower
                plain += inside @ lower.T
                self._lower()


class _Bounds:
    """Lower and upper bound of the return from every belief; they begin with one control for ever below."""

    def __init__(self, problem: DecisionProblem) -> None:
        controls, states, _ = problem.transition.shape
        always = [np.tile(row, (states, 1)) for row in np.eye(controls)]
        blind = [
            given_policy(problem.transition, problem.reward, problem.discount, row).value for row in always
        ]
        self.problem, self.upper = problem, _Upper(problem)
        self.vectors, self.control = np.array(blind), np.arange(controls)

    def lower(self, rows: Float) -> Float:
        """Return the lower bound at rows (K, S) that need not sum to one: (K,)."""
        return np.asarray((rows @ self.vectors.T).max(axis=1))

    def backup(self, control: int, rows: Float) -> Float:
        """Return the vector (S,) of a control with the best that is known behind it at rows (K, S)."""
        chosen = np.argmax(rows @ self.vectors.T, axis=1)
        later = self.problem.behind(control, chosen, self.vectors)
        return np.asarray(self.problem.reward[:, control] + self.problem.discount[control] * later)

    def raise_at(self, belief: Float) -> None:
        """Improve the lower bound at a belief."""
        after = [self.problem.following(belief, u) for u in range(len(self.problem.discount))]
        later = np.array([self.lower(rows).sum() for rows in after])
        below = belief @ self.problem.reward + self.problem.discount * later
        best = int(np.argmax(below))
        if below[best] > self.lower(belief[None])[0] + _STEP:
            found = self.backup(best, after[best])
            kept = ~np.all(self.vectors <= found, axis=1)
            self.vectors = np.vstack((self.vectors[kept], found))
            self.control = np.append(self.control[kept], best)

    def descend(self, belief: Float, first: int | None, gap: float) -> list[Float]:
        """Return beliefs one behind the other, where the bounds differ by more than the gap allows."""
        path: list[Float] = []
        while len(path) < _DEEPEST:
            path.append(belief)
            control = first if first is not None and len(path) == 1 else np.argmax(self.upper.look(belief))
            rows = self.problem.following(belief, int(control))
            gap /= max(float(self.problem.discount[control]), _STEP)
            excess = self.upper.at(rows) - self.lower(rows) - gap * rows.sum(axis=1)
            next_one = int(np.argmax(excess))
            if excess[next_one] <= 0.0:
                break
            belief = rows[next_one] / rows[next_one].sum()
        return path

    def at(self, belief: Float, first: int | None) -> tuple[float, float]:
        """Return lower and upper bound at a belief, under a first control where one is given."""
        if first is None:
            return float(self.lower(belief[None])[0]), float(self.upper.at(belief[None])[0])
        rows = self.problem.following(belief, first)
        now, later = float(belief @ self.problem.reward[:, first]), float(self.problem.discount[first])
        return now + later * float(self.lower(rows).sum()), now + later * float(self.upper.at(rows).sum())


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
    """Plan until the bounds of the return from the prior are close, or enough beliefs have been visited.

    Parameters
    ----------
    problem : DecisionProblem
    first : int, optional
        Control of the first step, where that is not decided on.
    gap : float
        Between the bounds at the end, as a share of the return.
    most_beliefs : int, optional
        Beliefs to improve the bounds at, counted each time; if left out 180, or 1000 where there is too much
        for the bounds to settle.
    """
    bounds, visited, settled = _Bounds(problem), list[Float](), _FIRST
    lower, upper = bounds.at(problem.prior, first)
    most = most_beliefs or MOST_BELIEFS
    while upper - lower > gap * max(abs(lower), abs(upper)) and len(visited) < most:
        path = bounds.descend(problem.prior, first, _SHARE * (upper - lower))
        for belief in reversed(path):
            bounds.raise_at(belief)
            bounds.upper.improve(belief)
        visited += path
        most = most_beliefs or (MOST_BELIEFS if bounds.upper.settles() else MOST_UNSETTLED)
        if len(visited) >= min(settled, most):
            settled = int(_GROWTH * len(visited))
            bounds.upper.settle()
            for belief in visited * _RAISED:
                bounds.raise_at(belief)
        lower, upper = bounds.at(problem.prior, first)
    beliefs = np.unique(np.array(visited or [problem.prior]), axis=0)
    return BeliefPlan(_policy(bounds, beliefs), lower, upper)


def _policy(bounds: _Bounds, beliefs: Float) -> BeliefPolicy:
    """Return for each control the vectors that are largest at some belief."""
    controls = range(len(bounds.problem.discount))
    after = ([bounds.problem.following(belief, u) for u in controls] for belief in beliefs)
    found = np.array([[bounds.backup(u, rows[u]) for u in controls] for rows in after])  # (B, U, S)
    kept = []
    for control in controls:
        vectors = np.vstack((bounds.vectors[bounds.control == control], found[:, control]))
        kept.append(vectors[np.unique(np.argmax(beliefs @ vectors.T, axis=1))])
    return BeliefPolicy(np.vstack(kept), np.repeat(np.arange(len(kept)), [len(each) for each in kept]))


Decide = Callable[[Float, Float, int], Index]
"""Returns the controls (B,) of a step for the beliefs (B, S) of its states and of those of the step before,
given all observations up to that one, and for its number from 0."""


def simulated_returns(
    problem: DecisionProblem, decide: Decide, missions: int, steps: int, generator: np.random.Generator
) -> Float:
    """Return the discounted returns of missions whose beliefs are exact: (B,).

    A step counts what is expected of it under the belief, which has the mean of what is drawn and varies
    less. Missions of the same number share what chance brings, whatever is decided and of whatever problem of
    the same states, as long as the generator is the same: returns of two policies differ by less than either
    varies.
    """
    chance = generator.random((steps + 1, 2, missions))
    states = _drawn(np.tile(problem.prior, (missions, 1)), chance[steps, 0])
    belief = np.tile(problem.prior, (missions, 1))
    filtered = belief.copy()
    total, weight = np.zeros(missions), np.ones(missions)
    for step in range(steps):
        control = decide(belief, filtered, step)
        total += weight * np.einsum("bs,sb->b", belief, problem.reward[:, control])
        weight *= problem.discount[control]
        for chosen in np.unique(control).tolist():
            rows = np.flatnonzero(control == chosen)
            likelihood = problem.likelihood[chosen]
            before = states[rows]
            different, place = np.unique(before, return_inverse=True)
            moves = np.array([problem.transition.row(chosen, state) for state in different.tolist()])
            states[rows] = _drawn(moves[place], chance[step, 0, rows])
            told = likelihood[:, states[rows] if problem.moves_first else before].T
            seen = _drawn(told, chance[step, 1, rows])
            after = problem.following(belief[rows], chosen, seen)
            now = after if problem.moves_first else belief[rows] * likelihood[seen]
            filtered[rows] = now / now.sum(axis=1, keepdims=True)
            belief[rows] = after / after.sum(axis=1, keepdims=True)
    return total


LIVES = 200
"""That are drawn of each twin."""


def leaving_probability(
    problem: DecisionProblem, policy: BeliefPolicy, belief: Float, control: int, steps: int,
    generator: np.random.Generator,
) -> Float:  # fmt: skip
    """Return the share of lives in which a policy leaves a control within some steps: (B,).

    Parameters
    ----------
    problem : DecisionProblem
        Whose state is observed before it moves.
    policy : BeliefPolicy
    belief : (B, S)
        Before the first of the steps.
    control : int
        In force until it is left.
    steps : int
        In which is decided, the first one by the belief that is given.
    generator : numpy.random.Generator
        The lives of all twins share what chance brings.
    """
    result, chance = np.empty(len(belief)), generator.random((steps - 1, LIVES))
    for twin, own in enumerate(belief):
        rows = np.tile(own, (LIVES, 1))
        left = policy.decide(rows) != control
        for uniform in chance[: 0 if left.all() else None]:
            seen = _drawn(rows @ problem.likelihood[control].T, uniform)
            after = problem.following(rows, control, seen)
            rows = after / after.sum(axis=1, keepdims=True)
            left |= policy.decide(rows) != control
        result[twin] = left.mean()
    return result


def _drawn(rows: Float, uniform: Float) -> Index:
    """Return the index of each row of probabilities (B, N) that a share (B,) of its sum reaches."""
    reached = np.cumsum(rows, axis=1)
    return np.asarray((uniform[:, None] * reached[:, -1:] >= reached).sum(axis=1), dtype=np.int64)
