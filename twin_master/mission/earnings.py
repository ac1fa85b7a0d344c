"""Earned rewards of a flight, its discounted return, and its steps beyond the limit.

This is the only computation of earned rewards: runs, fleets and watches store its result.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float, Index, product_of_each
from reporting.words import between, rounded
from twin_master.mission.planning import ComparedPolicy, discounts, simulate_decisions
from twin_master.mission.preparation import Knowledge
from twin_master.network.twin import DecisionRule
from twin_master.scenario.mission import Reference
from twin_master.scenario.schema import Scenario


@dataclass(frozen=True)
class Earnings:
    """The earnings of flights in each of T steps; NaN where no step was flown.

    Attributes
    ----------
    reward : (..., T) array
        The reward for which controls are planned, eq. (36) [1].
    health : (..., T) array
        The health reward, eq. (9), below zero beyond a health limit [1].
    beyond_limit : (..., T) array
        The probability that the control is harder than the best control of the state [1].
    needless : (..., T) array
        The probability that it is gentler than that [1].
    """

    reward: Float
    health: Float
    beyond_limit: Float
    needless: Float

    @classmethod
    def concatenate(cls, spans: Sequence["Earnings"]) -> "Earnings":
        """Return the earnings of successive spans of one flight."""
        joined = {name: np.concatenate([vars(span)[name] for span in spans]) for name in FIELDS}
        return cls(**joined)


FIELDS = ("reward", "health", "beyond_limit", "needless")
"""The fields of `Earnings`, which are the names of variables in stores."""


def earnings(knowledge: Knowledge, control: Index, belief: Float, state: Float) -> Earnings:
    """Return what the controls of flights earn in each step; see `Earnings`.

    Where the true state is known, the earnings are those in this state: rewards are interpolated
    between the levels of the state, the other values are those of the nearest level. Elsewhere they
    are expected values under the filtered belief.

    Parameters
    ----------
    control : (..., T) array
        The indices of the controls in force; negative in steps that were not flown.
    belief : (..., T, S) array
        The filtered beliefs.
    state : (..., T, F) array
        The true state, SI; NaN where it is not known.
    """
    states = knowledge.model.states
    controls = len(knowledge.model.controls)
    # Each state has 4 U columns, U for each field of `Earnings`: reward and health reward of all
    # controls, then whether they are beyond the limit, and whether they are needless.
    rewards = np.hstack(
        [knowledge.planning_reward, knowledge.rewards.planning_reward(1.0, 0.0)]
    )  # (S, 2 U)
    columns_by_state = np.hstack([rewards, knowledge.is_beyond_limit, knowledge.is_needless])
    is_flown = control >= 0
    is_state_known = is_flown & np.isfinite(state).all(axis=-1)
    earned_by_controls = np.full((*control.shape, 4 * controls), np.nan)
    known_states = state[is_state_known]
    earned_by_controls[is_state_known] = np.hstack(
        [
            states.interpolate(rewards, known_states),
            columns_by_state[states.nearest(known_states), 2 * controls :],
        ]
    )
    is_believed = is_flown & ~is_state_known
    earned_by_controls[is_believed] = product_of_each(belief[is_believed], columns_by_state)
    # of all U controls, take the one that was in force
    earned_by_field = earned_by_controls.reshape(*control.shape, 4, controls)
    control_in_force = np.maximum(control, 0)[..., None, None]
    reward, health, beyond_limit, needless = np.moveaxis(
        np.take_along_axis(earned_by_field, control_in_force, axis=-1).squeeze(axis=-1), -1, 0
    )
    return Earnings(reward, health, beyond_limit, needless)


def discounted_return(scenario: Scenario, reward: Float, control: Index) -> Float:
    """Return the discounted sum of the rewards of flights: (..., T) -> (...).

    Steps that were not flown earn nothing; a flight without a step has the return NaN.

    Parameters
    ----------
    scenario : Scenario
        The scenario, which has the discount factor of a step.
    reward : (..., T) array
        The reward of each step, see `Earnings`.
    control : (..., T) array
        The indices of the controls in force; negative in steps that were not flown.
    """
    factor = discounts(scenario)[control]
    factor_before = np.ones_like(factor)
    factor_before[..., 1:] = np.cumprod(factor[..., :-1], axis=-1)
    is_flown = control >= 0
    earned = np.where(is_flown, factor_before * reward, 0.0).sum(axis=-1)
    return np.where(is_flown.any(axis=-1), earned, np.nan)


def promised_return(knowledge: Knowledge) -> ComparedPolicy:
    """Return the returns of a twin's policy in missions that are simulated with its own model.

    They are what `uav-twin plan` expects of a policy. A flight earns something else if damage grows
    otherwise than in the model, or if the sensors are not those of the model.
    """
    returns = simulate_decisions(
        knowledge.scenario, knowledge.problem, _SimulatedDecisions(knowledge).decide
    )
    return ComparedPolicy(knowledge.scenario.planner.policy_name, returns)


def return_reference(knowledge: Knowledge) -> tuple[Reference, ...]:
    """Return the expected return of a mission as a reference value for the summary.

    The result is empty unless the policy was planned on the belief, goes by risk or was given. The
    range of 95 % of the simulated missions is given too, as one mission differs from the mean by
    chance.
    """
    if knowledge.plan.on_belief is None and knowledge.policy is None:
        return ()
    expected_return = promised_return(knowledge)
    low, high = np.quantile(expected_return.returns, [0.025, 0.975]).tolist()
    deviation = float(expected_return.returns.std())
    mean_text = rounded(expected_return.mean, deviation)
    value = f"{mean_text} on average, {between(low, high, deviation)} in 95 %"
    source = (
        f"{len(expected_return.returns)} missions under this policy, simulated by the twin's model"
    )
    return (Reference(figure="return", value=value, source=source),)


class _SimulatedDecisions:
    """The decisions of B twins in simulated missions, with the proposals that a `Hold` counts."""

    def __init__(self, knowledge: Knowledge) -> None:
        scenario = knowledge.scenario
        self._rule = DecisionRule(
            knowledge.model.transition,
            knowledge.plan.policy,
            knowledge.plan.on_belief,
            looks_ahead=scenario.planner.decide_on == "predicted",
            hold=knowledge.hold,
        )
        self._first_control = scenario.control_names.index(scenario.mission.first_control)
        self._control: Index = np.empty(0, dtype=np.int64)
        self._proposals: Index = np.empty(0, dtype=np.int64)

    def decide(self, belief: Float, filtered_belief: Float, step: int) -> Index:
        """Return the controls of a step after the first one, see `Decide`."""
        if step == 1:
            self._control = np.full(len(belief), self._first_control)
            self._proposals = np.zeros(len(belief), dtype=np.int64)
        probability = self._rule.probabilities(filtered_belief, self._control, predicted=belief)
        _, self._control, self._proposals = self._rule.decide(
            probability, self._control, self._proposals
        )
        return self._control
