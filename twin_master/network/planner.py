"""Planning by value iteration on the Bellman equation, Kapteyn et al. 2021, eq. (36), and what is decided."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index
from twin_master.errors import PlanningError, said
from twin_master.network.kernels import sweep
from twin_master.network.transition import TransitionModel, expect_shape


@dataclass(frozen=True)
class BeliefPolicy:
    """What to do by the belief before a turn: the control of the vector that is largest there.

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
        """Return the same by the control of the first turn: (..., U), minus infinity without a vector."""
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
        Sweeps until convergence.
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
        Control in force in turn t.
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


def _swept(
    transition: TransitionModel,
    reward: ArrayLike,
    discount: ArrayLike,
    policy: Float | None = None,
    tolerance: float = 0.0,
    most: int = 10_000_000,
) -> tuple[Float, Float, int, float]:
    """Iterate the Bellman equation until the value is known to a tolerance, or to rounding.

    Returns
    -------
    tuple of (S,), (S, U), int, float
        Value of a policy, the best one by default; the same if a control is taken first; sweeps; how well
        both are known.
    """
    rewards = np.array(reward, dtype=np.float64, order="C")
    expect_shape("rewards", rewards.shape, *transition.shape[1::-1], error=PlanningError)
    if not np.all(np.isfinite(rewards)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(rewards))[0])
        raise PlanningError(said("network.reward", where=where, reward=rewards[where]))
    factors = np.array(discount, dtype=np.float64)
    if factors.shape not in ((), rewards.shape[1:]) or not np.all((factors >= 0.0) & (factors < 1.0)):
        raise PlanningError(said("network.discount", controls=rewards.shape[1], factors=factors))
    each, largest = np.full(rewards.shape[1], factors), float(factors.max())
    scale = float(np.abs(rewards).max()) or 1.0
    # |V_k - V*| <= gamma / (1 - gamma) |V_k - V_{k-1}|; below rounding nothing changes any more.
    limit = max(tolerance * scale * (1.0 - largest), 4e-16 * scale / (1.0 - largest))
    rows = np.empty((0, len(each))) if policy is None else policy.copy()
    value, first = np.zeros(len(rewards)), np.empty_like(rewards)
    sweeps, change = sweep(transition.backward_lists, rewards, each, rows, limit, most, value, first)
    if change > limit:
        raise PlanningError(said("network.sweeps", change=change, sweeps=most, largest=largest))
    return value, first, sweeps, max(tolerance * scale, limit / (1.0 - largest))


def value_iteration(
    transition: TransitionModel | ArrayLike,
    reward: ArrayLike,
    discount: ArrayLike,
    *,
    tolerance: float = 1e-12,
    max_iterations: int = 100_000,
) -> PlannedPolicy:
    """Iterate the Bellman equation (36) until the value is known to `tolerance`.

    Parameters
    ----------
    transition : TransitionModel, or (U, S, S) dimensionless
        Row-stochastic.
    reward : (S, U)
        Expected reward of one step.
    discount : float or (U,)
        gamma, in [0, 1), for all controls or for each: zero where nothing comes after a control.
    tolerance : float
        Largest error of the value, relative to the largest reward (bounded from the last change of the value
        by the contraction; rounding adds about 1e-16 / (1 - discount)).
    max_iterations : int
        Sweeps after which to give up.

    Returns
    -------
    PlannedPolicy
        Where several controls are as good to the tolerance, the first of them.

    Raises
    ------
    PlanningError
        If shapes do not fit, a reward is not finite, the discount is outside [0, 1), or it did not converge.
    InvalidModelError
        If a row of the transition does not sum to one.
    """
    if not isinstance(transition, TransitionModel):
        transition = TransitionModel((np.asarray(transition, dtype=np.float64),))
    value, action_value, sweeps, error = _swept(transition, reward, discount, None, tolerance, max_iterations)
    best = action_value.max(axis=1, keepdims=True)
    control_index = np.argmax(action_value >= best - 2.0 * error, axis=1)
    return PlannedPolicy(value, action_value, np.eye(action_value.shape[1])[control_index], sweeps)


def given_policy(
    transition: TransitionModel, reward: ArrayLike, discount: ArrayLike, policy: Float
) -> PlannedPolicy:
    """Return a policy that was made elsewhere, with its value, iterated to rounding.

    Parameters
    ----------
    transition, reward, discount
        As `value_iteration`.
    policy : (S, U)
        p(U | D), row-stochastic.
    """
    value, action_value, sweeps, _ = _swept(transition, reward, discount, policy)
    return PlannedPolicy(value, action_value, policy, sweeps)
