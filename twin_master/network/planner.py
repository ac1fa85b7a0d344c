"""Planning: value iteration on the Bellman equation, Kapteyn et al. 2021, eq. (36)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fe.compilation import compiled
from twin_master.errors import PlanningError
from twin_master.network.distributions import stochastic_matrix
from twin_master.network.graphical_model import deterministic_policy
from twin_master.network.transition import TransitionModel

__all__ = ["PlannedPolicy", "evaluate_policy", "given_policy", "value_iteration"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class PlannedPolicy:
    """A planned policy.

    Attributes
    ----------
    value : (S,)
        Expected discounted reward from each state.
    action_value : (S, U)
        The same, if the given control is taken first.
    control_index : (S,)
        The control to take in each state.
    policy : (S, U)
        The same as a row-stochastic matrix p(U | D).
    iterations : int
        Sweeps until convergence; 0 for a policy that was given.
    """

    value: Float
    action_value: Float
    control_index: Index
    policy: Float
    iterations: int


def _checked(
    transition: TransitionModel | ArrayLike, reward: ArrayLike, discount: float
) -> tuple[TransitionModel, Float]:
    """Return the transitions and the reward (S, U)."""
    if not isinstance(transition, TransitionModel):
        matrix = stochastic_matrix(transition, name="transition[control, state]")
        if matrix.ndim != 3 or matrix.shape[1] != matrix.shape[2]:
            raise PlanningError(
                f"expected transitions of shape (controls, states, states), got {matrix.shape}"
            )
        transition = TransitionModel((matrix,))
    rewards = np.array(reward, dtype=np.float64, order="C")
    if rewards.shape != transition.shape[1::-1]:
        raise PlanningError(
            f"expected rewards of shape {transition.shape[1::-1]} (states, controls), as the transitions "
            f"have, got {rewards.shape}"
        )
    if not np.all(np.isfinite(rewards)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(rewards))[0])
        raise PlanningError(
            f"reward at (state, control) {where} is {rewards[where]}; expected finite rewards"
        )
    if not 0.0 <= discount < 1.0:
        raise PlanningError(f"expected a discount factor in [0, 1), got {discount}")
    return transition, rewards


@compiled
def _sweep(
    discounted: Float, reward: Float, limit: float, max_iterations: int, value: Float, action_value: Float
) -> tuple[int, float]:
    """Sweep until the value changes by no more than `limit`; return the sweeps and the last change.

    `action_value` belongs to the value that it is returned with.
    """
    controls, states, _ = discounted.shape
    change = np.inf
    iterations = 0
    while True:
        for state in range(states):
            for control in range(controls):
                total = reward[state, control]
                for following in range(states):
                    total += discounted[control, state, following] * value[following]
                action_value[state, control] = total
        if change <= limit or iterations == max_iterations:
            return iterations, change
        change = 0.0
        for state in range(states):
            improved = action_value[state, 0]
            for control in range(1, controls):
                improved = max(improved, action_value[state, control])
            change = max(change, abs(improved - value[state]))
            value[state] = improved
        iterations += 1


def _action_value(transition: TransitionModel, reward: Float, discount: float, value: Float) -> Float:
    """Return the reward of each control first and the value afterwards: (S, U)."""
    later = [transition.expected(control, value) for control in range(reward.shape[1])]
    result: Float = reward + discount * np.stack(later, axis=1)
    return result


def _product_sweep(
    transition: TransitionModel, reward: Float, discount: float, limit: float, max_iterations: int
) -> tuple[Float, Float, int, float]:
    """Sweep over a product of tables as `_sweep` over one; return value, action value, sweeps and change."""
    value: Float = np.zeros(len(reward))
    change, iterations = np.inf, 0
    while True:
        action_value = _action_value(transition, reward, discount, value)
        if change <= limit or iterations == max_iterations:
            return value, action_value, iterations, change
        improved = action_value.max(axis=1)
        change = float(np.abs(improved - value).max())
        value, iterations = improved, iterations + 1


def value_iteration(
    transition: TransitionModel | ArrayLike,
    reward: ArrayLike,
    discount: float,
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
    discount : float
        gamma, in [0, 1).
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
    InvalidDistributionError
        If a row of the transition does not sum to one.
    """
    model, rewards = _checked(transition, reward, discount)
    scale = float(np.abs(rewards).max()) or 1.0
    # |V_k - V*| <= gamma / (1 - gamma) |V_k - V_{k-1}|; below rounding nothing changes any more.
    limit = max(tolerance * scale * (1.0 - discount), 4e-16 * scale / (1.0 - discount))
    value, action_value = np.zeros(len(rewards)), np.empty_like(rewards)
    if model.is_product:
        value, action_value, iterations, change = _product_sweep(
            model, rewards, discount, limit, max_iterations
        )
    else:
        discounted = discount * model.matrix
        iterations, change = _sweep(discounted, rewards, limit, max_iterations, value, action_value)
    if change > limit:
        raise PlanningError(
            f"value iteration still changes by {change:.3g} after {max_iterations} sweeps with discount "
            f"{discount}; allow more sweeps or a larger tolerance"
        )
    tie = 2.0 * max(tolerance * scale, limit / (1.0 - discount))
    best = action_value.max(axis=1, keepdims=True)
    control_index = np.argmax(action_value >= best - tie, axis=1).astype(np.int64)
    return PlannedPolicy(
        value=value,
        action_value=action_value,
        control_index=control_index,
        policy=deterministic_policy(control_index, rewards.shape[1]),
        iterations=iterations,
    )


def evaluate_policy(
    transition: TransitionModel | ArrayLike, reward: ArrayLike, discount: float, policy: ArrayLike
) -> Float:
    """Return the exact value (S,) of a policy: one linear solve, or iterated to rounding over a product.

    Parameters
    ----------
    transition, reward, discount
        As `value_iteration`.
    policy : (S, U)
        p(U | D), row-stochastic.
    """
    model, rewards = _checked(transition, reward, discount)
    rows = stochastic_matrix(policy, name="policy[state]")
    if rows.shape != rewards.shape:
        raise PlanningError(f"expected a policy of shape {rewards.shape}, got {rows.shape}")
    expected = np.einsum("su,su->s", rows, rewards)
    if not model.is_product:
        closed_loop = np.einsum("su,ust->st", rows, model.matrix)
        result: Float = np.linalg.solve(np.eye(len(expected)) - discount * closed_loop, expected)
        return result
    value: Float = np.zeros_like(expected)
    # Each sweep shrinks the error by the discount at least.
    for _ in range(int(np.ceil(np.log(1e-17) / np.log(discount))) if discount > 0.0 else 1):
        value = np.einsum("su,su->s", rows, _action_value(model, rewards, discount, value))
    return value


def given_policy(
    transition: TransitionModel | ArrayLike, reward: ArrayLike, discount: float, policy: ArrayLike
) -> PlannedPolicy:
    """Return a policy that was made elsewhere, with its exact value.

    Parameters
    ----------
    transition, reward, discount
        As `value_iteration`.
    policy : (S, U)
        p(U | D), row-stochastic; `control_index` is its mode, the first of equals.
    """
    value = evaluate_policy(transition, reward, discount, policy)
    model, rewards = _checked(transition, reward, discount)
    rows = stochastic_matrix(policy, name="policy[state]")
    if model.is_product:
        action_value = _action_value(model, rewards, discount, value)
    else:
        action_value = rewards + discount * np.einsum("ust,t->su", model.matrix, value)
    return PlannedPolicy(value, action_value, np.argmax(rows, axis=1).astype(np.int64), rows, 0)
