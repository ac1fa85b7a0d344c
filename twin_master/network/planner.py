"""Policies, and planning by value iteration: Kapteyn et al. 2021, eq. (36)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import AnyArray, Float, Index, nan_where_masked, product_of_each
from reporting.words import comma_list
from twin_master.errors import PlanningError
from twin_master.network.kernels import sweep_bellman
from twin_master.network.transition import (
    TransitionModel,
    check_shape,
    checked_beliefs,
    checked_controls,
)

LARGEST_SOLVED = 1000
"""States up to which the value of a policy is the solution of a dense linear system."""
_WARM_UP_SWEEPS = 1000
"""Sweeps of value iteration before policy iteration, if values of policies are solved for."""
_MOST_EVALUATION_SWEEPS = 10_000_000
"""Sweeps at most to iterate the value of a policy to rounding."""
_LARGEST_DISCOUNT = 1.0 - 1e-12
"""Beyond this, rounding of the transition (1e-16) changes the value by more than 1e-4 of it."""
_EPSILON = float(np.finfo(np.float64).eps)
_ROUNDING = 16.0 * _EPSILON
"""Rounding error of a sum of rewards and values, relative to the size of its terms."""
_RELATIVE_ROUNDING_OF_SWEEP = 4e-16
"""Rounding error of a sweep, relative to the largest value."""


@dataclass(frozen=True)
class BeliefPolicy:
    """A policy that decides by the belief before a step, given N plans (alpha vectors).

    The vector of a plan has its expected return from each of S states. The policy takes the first
    control of the plan whose expected return under the belief is the largest.

    Attributes
    ----------
    vectors : (N, S) array
        The expected return of each plan from each state.
    control : (N,) array
        The index of the control with which each plan begins.
    """

    vectors: Float
    control: Index

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(nan_where_masked(self.vectors))):
            raise PlanningError(
                "the returns of plans must be finite, but some are NaN, masked or infinite"
            )
        control = checked_controls(self.control, np.iinfo(np.int64).max)
        object.__setattr__(self, "control", control)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, AnyArray], prefix: str = "") -> BeliefPolicy:
        """Return the policy whose two arrays were read from a file.

        Parameters
        ----------
        arrays : dict of str to array
            All arrays of the file by name. Those of the policy are named `{prefix}vectors` (N, S)
            and `{prefix}control` (N,).
        prefix : str
            The text before `vectors` and `control` in the two names.

        Raises
        ------
        PlanningError
            If one of the two arrays is missing, or they have no common length N, or the controls
            are not integers.
        """
        before = "a policy on the belief has `vectors` and `control`: "
        with PlanningError.instead_of(KeyError, before=before, after=" is missing"):
            vectors = arrays[f"{prefix}vectors"]
            control = arrays[f"{prefix}control"]
        is_integer = control.dtype.kind in "iu"
        if vectors.ndim != 2 or control.shape != vectors.shape[:1] or not is_integer:
            raise PlanningError(
                "a policy must have vectors (N, S) and a control for each, but their shapes are "
                f"({comma_list(vectors.shape)}) and ({comma_list(control.shape)})"
            )
        return cls(np.asarray(vectors, dtype=np.float64), np.asarray(control, dtype=np.int64))

    def value(self, belief: ArrayLike) -> Float:
        """Return the expected return of the best plan under each belief: (..., S) -> (...)."""
        return np.asarray(product_of_each(checked_beliefs(belief), self.vectors.T).max(axis=-1))

    def action_value(self, belief: ArrayLike, controls: int) -> Float:
        """Return the return of the best plan that begins with each control: (..., S) -> (..., U).

        It is minus infinity for a control with which no plan begins.
        """
        expected_returns = product_of_each(checked_beliefs(belief), self.vectors.T)  # (..., N)
        best_returns: Float = np.full((*expected_returns.shape[:-1], controls), -np.inf)
        for control in np.unique(self.control).tolist():
            has_control = self.control == control
            best_returns[..., control] = expected_returns[..., has_control].max(axis=-1)
        return best_returns

    def decide(self, belief: ArrayLike) -> Index:
        """Return the index of the control to take under each belief: (..., S) -> (...)."""
        best_plan = np.argmax(product_of_each(checked_beliefs(belief), self.vectors.T), axis=-1)
        return np.asarray(self.control[best_plan])


@dataclass(frozen=True)
class RiskPolicy:
    """A policy that takes the hardest control whose risk is below a level.

    The risk of a control is the probability, under the belief, that it is harder than the best
    control of the state. If no state explains the sensors, each control has the risk that it has in
    its worst state.

    Attributes
    ----------
    beyond_limit : (S, U) array
        The probability that a control is beyond the limit in a state; zero for one control at
        least, so that one is always allowed.
    hardest_first : (U,) array
        The indices of the controls from the hardest to the gentlest.
    level : float
        The risk below which a control is allowed, in (0, 1].
    """

    beyond_limit: Float
    hardest_first: Index
    level: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, AnyArray], prefix: str = "") -> RiskPolicy:
        """Return the policy whose fields were stored as arrays, each named `{prefix}{field}`."""
        return cls(
            np.asarray(arrays[f"{prefix}beyond_limit"], dtype=np.float64),
            np.asarray(arrays[f"{prefix}hardest_first"], dtype=np.int64),
            float(arrays[f"{prefix}level"]),
        )

    def risk(self, belief: ArrayLike, unexplained: ArrayLike = 0.0) -> Float:
        """Return the probability of each control to be beyond the limit: (..., S) -> (..., U).

        Parameters
        ----------
        belief : (..., S) array
            The belief about the state, given that some state explains the sensors.
        unexplained : (...) array
            The probability that no state explains the sensors.
        """
        doubt = np.asarray(unexplained, dtype=np.float64)[..., None]
        explained_risk = product_of_each(checked_beliefs(belief), self.beyond_limit)
        worst_risk = self.beyond_limit.max(axis=0)
        return np.asarray((1.0 - doubt) * explained_risk + doubt * worst_risk)

    def decide(self, belief: ArrayLike, unexplained: ArrayLike = 0.0) -> Index:
        """Return the index of the control to take: beliefs (..., S) -> (...), as for `risk`."""
        is_allowed = self.risk(belief, unexplained)[..., self.hardest_first] < self.level
        return np.asarray(self.hardest_first[np.argmax(is_allowed, axis=-1)])


@dataclass(frozen=True)
class Hold:
    """The rule that a harder control is taken only if it is proposed several times in a row.

    Attributes
    ----------
    proposals : int
        The number of proposals in a row that a change to a harder control needs.
    hardness : (U,) array
        The rank of each control, larger for a harder one.
    """

    proposals: int
    hardness: Index

    def apply(
        self, probability: Float, control: Index, proposals_before: Index
    ) -> tuple[Float, Index]:
        """Hold back changes to harder controls that were not yet proposed often enough in a row.

        As long as a change is held back, the probabilities of all harder controls are added to that
        of the control in force.

        Parameters
        ----------
        probability : (B, U) array
            The probability of each next control by the policy.
        control : (B,) array
            The indices of the controls in force.
        proposals_before : (B,) array
            How often in a row a harder control than the one in force was proposed before.

        Returns
        -------
        probability : (B, U) array
            The probability of each next control.
        proposals : (B,) array
            How often in a row a harder control was proposed, this step included.
        """
        hardness_in_force = self.hardness[control]
        is_harder = self.hardness > hardness_in_force[:, None]  # (B, U)
        twins = np.arange(len(control))
        proposes_harder = is_harder[twins, np.argmax(probability, axis=1)]
        proposals = np.where(proposes_harder, proposals_before + 1, 0)
        is_held = proposes_harder & (proposals < self.proposals)
        held_back = np.where(is_held[:, None] & is_harder, probability, 0.0)
        held_probability = probability - held_back
        held_probability[twins, control] += held_back.sum(axis=1)
        return held_probability, np.asarray(proposals, dtype=np.int64)


@dataclass(frozen=True)
class PlannedPolicy:
    """A policy of S states and U controls with its value.

    Attributes
    ----------
    value : (S,) array
        The expected discounted reward from each state.
    action_value : (S, U) array
        The expected discounted reward from each state if the control is taken first.
    policy : (S, U) array
        p(U | D), row-stochastic.
    iterations : int
        The number of sweeps of value iteration; zero if the policy was given.
    on_belief : BeliefPolicy, RiskPolicy or None
        A policy that decides by the belief. If it is given, `policy` serves only to predict.
    """

    value: Float
    action_value: Float
    policy: Float
    iterations: int
    on_belief: BeliefPolicy | RiskPolicy | None = None

    @cached_property
    def control_index(self) -> Index:
        """The control to take in each state (S,): the mode of the policy, the first of equals."""
        return np.asarray(np.argmax(self.policy, axis=1), dtype=np.int64)


def ration_controls(
    transition: TransitionModel,
    filtered_belief: Float,
    control_in_force: Index,
    chosen_controls: Index,
    policy: BeliefPolicy,
    scarce: Sequence[int],
    budget: int,
) -> Index:
    """Return the next controls (B,) if at most `budget` twins may have a scarce control.

    The twins that gain most by a scarce control get it: the gain is its expected return minus that
    of the best other control. A twin that wanted one and gets none takes its best other control.

    Parameters
    ----------
    transition : TransitionModel
        The transitions between S states.
    filtered_belief : (B, S) array
        p(D_t | o_0..o_t).
    control_in_force : (B,) array
    chosen_controls : (B,) array
        The next controls that were decided for each twin alone.
    policy : BeliefPolicy
        The policy that has decided on the controls.
    scarce : sequence of int
        The scarce controls, such as inspections.
    budget : int
        The largest number of scarce controls.
    """
    requesting_twins = np.flatnonzero(np.isin(chosen_controls, scarce))
    if len(requesting_twins) <= budget:
        return chosen_controls
    predicted_beliefs = [
        transition.forward(int(control_in_force[twin]), filtered_belief[twin])
        for twin in requesting_twins
    ]
    # gain of the best scarce control over the best other one, for each requesting twin
    action_value = policy.action_value(np.array(predicted_beliefs), transition.shape[0])
    other_action_value = action_value.copy()
    other_action_value[:, scarce] = -np.inf
    gain = action_value[:, scarce].max(axis=1) - other_action_value.max(axis=1)
    # all but the `budget` twins with the largest gains take their best other control
    refused_positions = np.argsort(-gain, kind="stable")[budget:]
    rationed = chosen_controls.copy()
    rationed[requesting_twins[refused_positions]] = np.argmax(
        other_action_value[refused_positions], axis=1
    )
    return rationed


@dataclass(frozen=True)
class _ValueIteration:
    """The result of value iteration.

    Attributes
    ----------
    value : (S,) array
        The value of each state.
    sweeps : int
        The number of sweeps.
    change : float
        The largest change of the value of a state in the last sweep.
    converged : bool
        Whether this change is as small as the tolerance requires.
    """

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
        The transitions between S states under U controls.
    reward : (S, U) array
        The expected reward of one step.
    discount : (U,) array
        The discount factor gamma of each control, in [0, 1).
    """

    transition: TransitionModel
    reward: Float
    discount: Float

    @classmethod
    def from_arrays(
        cls, transition: TransitionModel, reward: ArrayLike, discount: ArrayLike
    ) -> _DecisionProcess:
        """Return the problem with checked rewards (S, U) and discounts, one or (U,).

        Raises
        ------
        PlanningError
            If shapes do not fit, a reward is not finite, or a discount is not between 0 and
            1 - 1e-12.
        """
        controls, states, _ = transition.shape
        rewards = np.array(nan_where_masked(reward), order="C")
        check_shape("rewards", rewards.shape, states, controls, error=PlanningError)
        is_finite = np.isfinite(rewards)
        if not np.all(is_finite):
            position = tuple(int(i) for i in np.argwhere(~is_finite)[0])
            raise PlanningError(
                f"reward at (state, control) {position} is {rewards[position]}; expected finite "
                "rewards"
            )
        factors = np.array(nan_where_masked(discount))
        in_range = np.all((factors >= 0.0) & (factors < 1.0))
        if factors.shape not in ((), (controls,)) or not in_range:
            raise PlanningError(
                f"there must be one discount factor in [0, 1), or one for each of {controls} "
                f"controls, but {factors} was given"
            )
        if factors.max() > _LARGEST_DISCOUNT:
            raise PlanningError(
                f"the discount factor {float(factors.max())!r} is so close to 1 that rounding "
                "decides the value; expected at most 1 - 1e-12. Take a smaller one."
            )
        return cls(transition, rewards, np.full(controls, factors))

    @property
    def has_direct_solution(self) -> bool:
        """Whether there are few enough states to solve a dense linear system for a value."""
        return len(self.reward) <= LARGEST_SOLVED

    def iterate_value(
        self,
        tolerance: float,
        most_sweeps: int,
        policy: Float | None = None,
        start: Float | None = None,
    ) -> _ValueIteration:
        """Compute the value of the best, or of a given, policy by sweeps of the Bellman equation.

        The sweeps end when the value is known to a tolerance or to rounding, or after
        `most_sweeps`.

        Parameters
        ----------
        tolerance : float
            The largest error of the value, relative to the largest reward.
        most_sweeps : int
            The number of sweeps after which to stop.
        policy : (S, U) array, optional
            The policy whose value is computed; the best one by default.
        start : (S,) array, optional
            The value to begin with; zero by default.
        """
        states, controls = self.reward.shape
        largest_reward = float(np.abs(self.reward).max()) or 1.0  # 1 if all rewards are zero
        gamma = float(self.discount.max())
        # The error |V_k - V*| is at most gamma / (1 - gamma) times the change |V_k - V_{k-1}|.
        # Below rounding nothing changes any more.
        allowed_change = tolerance * largest_reward * (1.0 - gamma)
        rounding = _RELATIVE_ROUNDING_OF_SWEEP * largest_reward / (1.0 - gamma)
        largest_change = max(allowed_change, rounding)

        value = np.zeros(states) if start is None else start.copy()
        no_policy = np.empty((0, controls))  # no rows: the kernel takes the best control
        action_value = np.empty_like(self.reward)
        sweeps, change = sweep_bellman(
            self.transition.backward_lists,
            self.reward,
            self.discount,
            no_policy if policy is None else policy.copy(),
            largest_change,
            most_sweeps,
            value,
            action_value,
        )
        return _ValueIteration(value, sweeps, change, converged=change <= largest_change)

    def check_converged(self, result: _ValueIteration) -> None:
        """Refuse a value that is not known to the tolerance.

        Raises
        ------
        PlanningError
            If value iteration stopped while the value still changed by more than that.
        """
        if not result.converged:
            raise PlanningError(
                f"value iteration still changes by {result.change:.3g} after {result.sweeps} "
                f"sweeps with discount {float(self.discount.max())}; allow more sweeps or a larger "
                "tolerance"
            )

    def action_value(self, value: Float) -> Float:
        """Return the expected return of each control in each state: (S, U).

        Parameters
        ----------
        value : (S,) array
            The expected return from each state after the step.
        """
        expected_returns = [
            self.transition.expected_value(control, value) for control in range(len(self.discount))
        ]
        return np.asarray(self.reward + self.discount * np.stack(expected_returns, axis=1))

    def rounding_error(self, value: Float) -> Float:
        """Return the largest rounding error of an action value in each of S states: (S,).

        It is proportional to the sum of the absolute values of the rewards and expected returns.
        """
        absolute_process = replace(self, reward=np.abs(self.reward))
        size_of_terms = absolute_process.action_value(np.abs(value))
        return np.asarray(_ROUNDING * size_of_terms.max(axis=1))

    def evaluate(self, policy: Float, start: Float | None = None) -> Float:
        """Return the value (S,) of a policy: the solution V of V = r + gamma P V.

        r (S,) are the expected rewards and P (S, S) the transitions under the policy.

        Parameters
        ----------
        policy : (S, U) array
            p(U | D), row-stochastic.
        start : (S,) array, optional
            The value from which the iteration begins, if there are too many states to solve the
            linear system.
        """
        if not self.has_direct_solution:
            result = self.iterate_value(0.0, _MOST_EVALUATION_SWEEPS, policy, start)
            self.check_converged(result)
            return result.value
        states = len(self.reward)
        discounted = np.zeros((states, states))  # gamma P
        for control, discount in enumerate(self.discount):
            states_with_control = np.flatnonzero(policy[:, control])
            weight = discount * policy[states_with_control, control]
            next_state = self.transition.rows(
                np.full_like(states_with_control, control), states_with_control
            )
            discounted[states_with_control] += weight[:, None] * next_state
        reward = np.sum(policy * self.reward, axis=1)
        return np.asarray(np.linalg.solve(np.eye(states) - discounted, reward))

    def improve_policy(self, control: Index, start: Float) -> tuple[Index, Float]:
        """Find the best control in each state by policy iteration (Howard 1960).

        Returns the controls (S,) and their value (S,).

        Parameters
        ----------
        control : (S,) array
            The controls to begin with.
        start : (S,) array
            An estimate of their value.
        """
        states = np.arange(len(control))
        one_hot = np.eye(len(self.discount))  # rows are policies that take one control for certain
        value = self.evaluate(one_hot[control], start)
        while True:
            action_value = self.action_value(value)
            gain = action_value.max(axis=1) - action_value[states, control]
            is_gain_real = gain > self.rounding_error(value)
            better_control = np.where(is_gain_real, np.argmax(action_value, axis=1), control)
            if np.array_equal(better_control, control):
                return control, value
            better_value = self.evaluate(one_hot[better_control], value)
            if not better_value.sum() > value.sum():  # an improvement by rounding alone
                return control, value
            control = better_control
            value = better_value


def value_iteration(
    transition: TransitionModel | ArrayLike,
    reward: ArrayLike,
    discount: ArrayLike,
    *,
    tolerance: float = 1e-12,
    max_iterations: int = 100_000,
) -> PlannedPolicy:
    """Return the best policy and its value: Bellman's equation, Kapteyn et al. 2021, eq. (36).

    Value iteration finds a first policy, and policy iteration improves it until no control is
    better by more than rounding. The value is that of the returned policy: the solution of a linear
    system with up to 1,000 states, and iterated to rounding with more.

    Parameters
    ----------
    transition : TransitionModel, or (U, S, S) array
        The transitions, row-stochastic.
    reward : (S, U) array
        The expected reward of one step.
    discount : float or (U,) array
        The discount factor gamma in [0, 1), for all controls or for each: zero if nothing comes
        after a control. The value has a relative rounding error of about 1e-16 / (1 - gamma).
    tolerance : float
        The error of the value at which value iteration ends, relative to the largest reward. It is
        bounded from the last change of the value by the contraction.
    max_iterations : int
        The largest number of sweeps of value iteration. With up to 1,000 states policy iteration
        goes on from there; with more the plan is refused.

    Returns
    -------
    PlannedPolicy
        Among controls that are equally good but for rounding, the policy takes the first.

    Raises
    ------
    PlanningError
        If shapes do not fit, a reward is not finite, the discount is not between 0 and 1 - 1e-12,
        or value iteration with more than 1,000 states did not converge.
    InvalidModelError
        If a row of the transition does not sum to one.
    """
    if not isinstance(transition, TransitionModel):
        transition = TransitionModel((nan_where_masked(transition),))
    problem = _DecisionProcess.from_arrays(transition, reward, discount)
    most_sweeps = max_iterations
    if problem.has_direct_solution:
        most_sweeps = min(max_iterations, _WARM_UP_SWEEPS)
    iteration = problem.iterate_value(tolerance, most_sweeps)
    if not problem.has_direct_solution:
        problem.check_converged(iteration)
    greedy = np.argmax(problem.action_value(iteration.value), axis=1)
    control, value = problem.improve_policy(greedy, iteration.value)

    # Take the first of controls that are equally good but for rounding, so that the policy does not
    # depend on rounding.
    action_value = problem.action_value(value)
    least_of_equals = action_value.max(axis=1) - problem.rounding_error(value)
    first_of_equals = np.argmax(action_value >= least_of_equals[:, None], axis=1)
    policy = np.eye(len(problem.discount))[first_of_equals]
    if not np.array_equal(first_of_equals, control):
        value = problem.evaluate(policy, value)
        action_value = problem.action_value(value)
    return PlannedPolicy(value, action_value, policy, iteration.sweeps)


def evaluate_policy(
    transition: TransitionModel, reward: ArrayLike, discount: ArrayLike, policy: Float
) -> PlannedPolicy:
    """Compute the value of a given policy, and return both as if the policy had been planned.

    Parameters
    ----------
    transition, reward, discount
        As `value_iteration`.
    policy : (S, U) array
        p(U | D), row-stochastic.
    """
    problem = _DecisionProcess.from_arrays(transition, reward, discount)
    value = problem.evaluate(policy)
    return PlannedPolicy(value, problem.action_value(value), policy, iterations=0)
