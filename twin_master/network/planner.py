"""Planning by value iteration on the Bellman equation, Kapteyn et al. 2021, eq. (36), and what is decided."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index
from twin_master.errors import PlanningError, said
from twin_master.network.kernels import sweep
from twin_master.network.transition import TransitionModel, expect_shape


@dataclass(frozen=True)
class BeliefPolicy:
    """What to do by the belief before a step: the control of the vector that is largest there.

    Attributes
    ----------
    vectors : (N, S)
        Expected return of a plan that begins with a control, from each state.
    control : (N,)
        That control.
    """

    vectors: Float
    control: Index

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> "BeliefPolicy":
        """Return the policy of arrays by the names of its attributes, as a file has them.

        Raises
        ------
        PlanningError
            They are none.
        """
        before = "a policy on the belief has `vectors` and `control`: "
        with PlanningError.instead_of(KeyError, before=before, after=" is missing"):
            vectors, control = arrays[f"{prefix}vectors"], arrays[f"{prefix}control"]
        if vectors.ndim != 2 or control.shape != vectors.shape[:1] or control.dtype.kind not in "iu":
            raise PlanningError(said("network.vectors", vectors=vectors.shape, controls=control.shape))
        return cls(np.asarray(vectors, dtype=np.float64), np.asarray(control, dtype=np.int64))

    def value(self, belief: ArrayLike) -> Float:
        """Return the expected return from beliefs (..., S): (...)."""
        return np.asarray((np.asarray(belief) @ self.vectors.T).max(axis=-1))

    def action_value(self, belief: ArrayLike, controls: int) -> Float:
        """Return the same by the control of the first step: (..., U), minus infinity without a vector."""
        every = np.asarray(belief) @ self.vectors.T
        result: Float = np.full((*every.shape[:-1], controls), -np.inf)
        for control in np.unique(self.control).tolist():
            result[..., control] = every[..., self.control == control].max(axis=-1)
        return result

    def decide(self, belief: ArrayLike) -> Index:
        """Return the control for beliefs (..., S): (...)."""
        return np.asarray(self.control[np.argmax(np.asarray(belief) @ self.vectors.T, axis=-1)])


@dataclass(frozen=True)
class PlannedPolicy:
    """A planned policy.

    Attributes
    ----------
    value : (S,)
        Expected discounted reward from each state.
    action_value : (S, U)
        The same, if the given control is taken first.
    policy : (S, U)
        Row-stochastic, p(U | D).
    iterations : int
        Sweeps of value iteration; zero where the policy was given.
    on_belief : BeliefPolicy or None
        What decides by the belief in the place of `policy`, which then predicts alone.
    """

    value: Float
    action_value: Float
    policy: Float
    iterations: int
    on_belief: BeliefPolicy | None = None

    @cached_property
    def control_index(self) -> Index:
        """The control to take in each state (S,): the mode of the policy, the first of equals."""
        return np.asarray(np.argmax(self.policy, axis=1), dtype=np.int64)


def decision(
    transition: TransitionModel, filtered: Float, control: Index, policy: Float,
    on_belief: BeliefPolicy | None = None, *, ahead: bool = False,
) -> Float:  # fmt: skip
    """Return the probability of each next control of B twins (B, U), of each what it would be alone.

    Parameters
    ----------
    transition : TransitionModel
    filtered : (B, S)
        p(D_t | o_0..o_t).
    control : (B,)
        Control in force in step t.
    policy : (S, U)
        p(U | D), which is averaged over the belief.
    on_belief : BeliefPolicy, optional
        Decides in its place by p(D_{t+1} | o_0..o_t).
    ahead : bool
        Average over that belief, too.
    """
    belief = filtered
    if ahead or on_belief is not None:
        pairs = zip(control.tolist(), filtered, strict=True)
        belief = np.stack([transition.forward(in_force, row) for in_force, row in pairs])
    if on_belief is not None:
        return np.eye(policy.shape[1])[[on_belief.decide(row) for row in belief]]
    # One product for each twin, so that its last bit does not depend on how many there are.
    return np.asarray(np.matmul(belief[:, None, :], policy)[:, 0])


def rationed(
    transition: TransitionModel, filtered: Float, before: Index, chosen: Index, policy: BeliefPolicy,
    scarce: Sequence[int], budget: int,
) -> Index:  # fmt: skip
    """Return the next controls (B,) of which so many at most are scarce: those that are worth most.

    A scarce control is worth what its return is above that of the best other one, which is taken where the
    budget is spent.

    Parameters
    ----------
    transition, filtered
        As of `decision`.
    before, chosen : (B,)
        Controls in force, and those that were decided.
    policy : BeliefPolicy
    scarce : sequence of int
        Controls of which there are few, such as inspections.
    budget : int
        How many.
    """
    wanting = np.flatnonzero(np.isin(chosen, scarce))
    if len(wanting) <= budget:
        return chosen
    ahead = np.array([transition.forward(int(before[twin]), filtered[twin]) for twin in wanting])
    value = policy.action_value(ahead, transition.shape[0])
    others = value.copy()
    others[:, scarce] = -np.inf
    gain = value[:, scarce].max(axis=1) - others.max(axis=1)
    late = np.argsort(-gain, kind="stable")[budget:]
    result = chosen.copy()
    result[wanting[late]] = np.argmax(others[late], axis=1)
    return result


LARGEST_SOLVED = 1000
"""States up to which the value of a policy is solved for; beyond it is iterated to rounding."""
_WARM_UP = 1000
"""Sweeps before policies are improved, where the value of a policy is solved for."""
_MOST_EVALUATION_SWEEPS = 10_000_000
_LARGEST_DISCOUNT = 1.0 - 1e-12
"""Beyond it rounding of the transition alone, 1e-16, changes the value by more than 1e-4 of its size."""
_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
"""Of the terms of a sum of rewards and values: what rounding may change of it."""


class _Sweeps(NamedTuple):
    """Value iteration as far as it went: the value (S,), sweeps, and the last change of the value."""

    value: Float
    sweeps: int
    change: float
    converged: bool


@dataclass(frozen=True)
class _DecisionProcess:
    """A Markov decision process: the state is known when a control is chosen.

    Attributes
    ----------
    transition : TransitionModel
        Of U controls and S states.
    reward : (S, U) array
        Expected reward of one step.
    discount : (U,) array
        gamma of each control, in [0, 1).
    """

    transition: TransitionModel
    reward: Float
    discount: Float

    @classmethod
    def checked(
        cls, transition: TransitionModel, reward: ArrayLike, discount: ArrayLike
    ) -> "_DecisionProcess":
        """Return the problem of what a caller gives.

        Raises
        ------
        PlanningError
            If shapes do not fit, a reward is not finite, or a discount is not between 0 and 1 - 1e-12.
        """
        rewards = np.array(reward, dtype=np.float64, order="C")
        expect_shape("rewards", rewards.shape, *transition.shape[1::-1], error=PlanningError)
        if not np.all(np.isfinite(rewards)):
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(rewards))[0])
            raise PlanningError(said("network.reward", where=where, reward=rewards[where]))
        factors = np.array(discount, dtype=np.float64)
        if factors.shape not in ((), rewards.shape[1:]) or not np.all((factors >= 0.0) & (factors < 1.0)):
            raise PlanningError(said("network.discount", controls=rewards.shape[1], factors=factors))
        if factors.max() > _LARGEST_DISCOUNT:
            raise PlanningError(
                f"the discount factor {float(factors.max())!r} is so close to 1 that rounding decides the"
                " value; expected at most 1 - 1e-12. Take a smaller one."
            )
        return cls(transition, rewards, np.full(rewards.shape[1], factors))

    @property
    def is_solved(self) -> bool:
        """Whether the value of a policy is the solution of a dense linear system."""
        return len(self.reward) <= LARGEST_SOLVED

    def sweep(
        self, tolerance: float, most: int, policy: Float | None = None, start: Float | None = None
    ) -> _Sweeps:
        """Iterate the Bellman equation until the value is known to a tolerance, or to rounding.

        Parameters
        ----------
        tolerance : float
            Largest error of the value, relative to the largest reward.
        most : int
            Sweeps after which to stop.
        policy : (S, U) array, optional
            Whose value is asked for; that of the best policy by default.
        start : (S,) array, optional
            Value to begin with; zero by default.
        """
        states, controls = self.reward.shape
        scale, contraction = float(np.abs(self.reward).max()) or 1.0, float(self.discount.max())
        # |V_k - V*| <= gamma / (1 - gamma) |V_k - V_{k-1}|; below rounding nothing changes any more.
        limit = max(tolerance * scale * (1.0 - contraction), 4e-16 * scale / (1.0 - contraction))
        rows = np.empty((0, controls)) if policy is None else policy.copy()
        value = np.zeros(states) if start is None else start.copy()
        lists, first = self.transition.backward_lists, np.empty_like(self.reward)
        sweeps, change = sweep(lists, self.reward, self.discount, rows, limit, most, value, first)
        return _Sweeps(value, sweeps, change, converged=change <= limit)

    def expect_converged(self, result: _Sweeps) -> None:
        """Refuse a value that still changes.

        Raises
        ------
        PlanningError
            If the value is not known to the tolerance.
        """
        if not result.converged:
            largest = float(self.discount.max())
            raise PlanningError(
                said("network.sweeps", change=result.change, sweeps=result.sweeps, largest=largest)
            )

    def action_value(self, value: Float) -> Float:
        """Return what each control is worth in each state (S, U) if a value (S,) follows."""
        following = [self.transition.expected(control, value) for control in range(len(self.discount))]
        return np.asarray(self.reward + self.discount * np.stack(following, axis=1))

    def rounding(self, value: Float) -> Float:
        """Return the difference (S,) that rounding may make between equally good controls in each state."""
        sizes = replace(self, reward=np.abs(self.reward)).action_value(np.abs(value))
        return np.asarray(_ROUNDING * sizes.max(axis=1))

    def value_of(self, policy: Float, start: Float | None = None) -> Float:
        """Return the value (S,) of a policy (S, U): V = r + gamma P V with its rewards and transitions.

        Parameters
        ----------
        policy : (S, U) array
            p(U | D), row-stochastic.
        start : (S,) array, optional
            Where an iteration begins, if there are too many states to solve for.
        """
        if not self.is_solved:
            result = self.sweep(0.0, _MOST_EVALUATION_SWEEPS, policy, start)
            self.expect_converged(result)
            return result.value
        states = len(self.reward)
        discounted = np.zeros((states, states))
        for control, discount in enumerate(self.discount):
            chosen = np.flatnonzero(policy[:, control])
            weight = discount * policy[chosen, control]
            following = self.transition.rows(np.full_like(chosen, control), chosen)
            discounted[chosen] += weight[:, None] * following
        reward = np.sum(policy * self.reward, axis=1)
        return np.asarray(np.linalg.solve(np.eye(states) - discounted, reward))

    def improved(self, control: Index, start: Float) -> tuple[Index, Float]:
        """Return the best controls (S,) and their value (S,), by policy iteration (Howard 1960).

        Parameters
        ----------
        control : (S,) array
            Controls to begin with.
        start : (S,) array
            About their value.
        """
        states, every = np.arange(len(control)), np.eye(len(self.discount))
        value = self.value_of(every[control], start)
        while True:
            action_value = self.action_value(value)
            gain = action_value.max(axis=1) - action_value[states, control]
            better = np.where(gain > self.rounding(value), np.argmax(action_value, axis=1), control)
            if np.array_equal(better, control):
                return control, value
            better_value = self.value_of(every[better], value)
            if not better_value.sum() > value.sum():  # an improvement by rounding alone
                return control, value
            control, value = better, better_value


def value_iteration(
    transition: TransitionModel | ArrayLike,
    reward: ArrayLike,
    discount: ArrayLike,
    *,
    tolerance: float = 1e-12,
    max_iterations: int = 100_000,
) -> PlannedPolicy:
    """Return the best policy and its value, by value iteration on the Bellman equation (36).

    Value iteration finds a policy; policy iteration improves it until no control is better by more than
    rounding. The value is that of the policy that is returned: the solution of its linear equations, or with
    more than 1,000 states iterated to rounding.

    Parameters
    ----------
    transition : TransitionModel, or (U, S, S) dimensionless
        Row-stochastic.
    reward : (S, U)
        Expected reward of one step.
    discount : float or (U,)
        gamma, in [0, 1), for all controls or for each: zero where nothing comes after a control. Rounding of
        the value is about 1e-16 / (1 - gamma) of its size.
    tolerance : float
        Error of the value at which value iteration ends, relative to the largest reward (bounded from the
        last change of the value by the contraction).
    max_iterations : int
        Sweeps of value iteration at most. With up to 1,000 states policy iteration goes on from there; with
        more the plan is refused.

    Returns
    -------
    PlannedPolicy
        Where several controls are equally good but for rounding, the first of them.

    Raises
    ------
    PlanningError
        If shapes do not fit, a reward is not finite, the discount is not between 0 and 1 - 1e-12, or value
        iteration with more than 1,000 states did not converge.
    InvalidModelError
        If a row of the transition does not sum to one.
    """
    if not isinstance(transition, TransitionModel):
        transition = TransitionModel((np.asarray(transition, dtype=np.float64),))
    problem = _DecisionProcess.checked(transition, reward, discount)
    most = min(max_iterations, _WARM_UP) if problem.is_solved else max_iterations
    swept = problem.sweep(tolerance, most)
    if not problem.is_solved:
        problem.expect_converged(swept)
    greedy = np.argmax(problem.action_value(swept.value), axis=1)
    control, value = problem.improved(greedy, swept.value)
    action_value = problem.action_value(value)
    least = action_value.max(axis=1) - problem.rounding(value)
    first_of_equals = np.argmax(action_value >= least[:, None], axis=1)
    policy = np.eye(len(problem.discount))[first_of_equals]
    if not np.array_equal(first_of_equals, control):
        value = problem.value_of(policy, value)
        action_value = problem.action_value(value)
    return PlannedPolicy(value, action_value, policy, swept.sweeps)


def given_policy(
    transition: TransitionModel, reward: ArrayLike, discount: ArrayLike, policy: Float
) -> PlannedPolicy:
    """Return a policy that was made elsewhere, with its value.

    Parameters
    ----------
    transition, reward, discount
        As `value_iteration`.
    policy : (S, U)
        p(U | D), row-stochastic.
    """
    problem = _DecisionProcess.checked(transition, reward, discount)
    value = problem.value_of(policy)
    return PlannedPolicy(value, problem.action_value(value), policy, 0)
