"""Planning on the belief for a scenario, and the returns of the plan and of simpler rules."""

import io
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from reporting.words import comma_list
from twin_master.errors import PlanningError
from twin_master.network.belief_planning import BeliefPlan, plan_on_belief
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy, value_iteration
from twin_master.network.quantity import RewardModel
from twin_master.network.simulated_missions import Decide, simulated_returns
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import POLICY_NAMES
from twin_master.seeds import generator

MISSIONS = 400
"""Number of missions that are simulated for each rule."""
INSPECTION_PERIODS = (2, 3, 5, 8, 12, 20)
"""Steps between two inspections, for the rules that inspect at fixed intervals."""
_GAP = 0.005
"""Relative gap between the bounds of a plan at which its search ends."""
_GAP_OF_PRICED_PLANS = 0.06
"""The same, coarser to save time, if several prices are tried to keep a health limit."""
_LARGEST_PRICE = 2.0**12
"""Largest price of a step beyond the health limit, in rewards."""
_BISECTIONS = 4
"""How often the interval of the price is halved."""


def discounts(scenario: Scenario) -> Float:
    """Return the discount factor of each of U controls; zero if the control ends the mission."""
    ends = [scenario.ends(index) for index in range(len(scenario.control))]
    return np.where(ends, 0.0, scenario.planner.gamma)


def plan_within_limit(
    scenario: Scenario, problem: DecisionProblem, rewards: RewardModel
) -> BeliefPlan:
    """Return the plan on the belief that exceeds the health limit no more often than allowed.

    The scenario may bound the fraction of steps beyond the limit (`planner.limit_probability`).
    Such a constraint on a mean is met by a Lagrange multiplier (Altman 1999): a price of each step
    beyond the limit. The plan has the lowest of the tried prices for which the bound holds.

    Parameters
    ----------
    problem : DecisionProblem
        The decision problem of the mission, without a price.

    Raises
    ------
    PlanningError
        If the bound does not hold even for the largest price.
    """
    first_control = scenario.control_names.index(scenario.mission.first_control)
    allowed_probability = scenario.planner.limit_probability
    probability_beyond = _probability_beyond_limit(rewards)

    def plan_with_price(price: float) -> BeliefPlan:
        priced_problem = replace(problem, reward=problem.reward - price * probability_beyond)
        gap = _GAP if allowed_probability is None else _GAP_OF_PRICED_PLANS
        return plan_on_belief(priced_problem, first=first_control, gap=gap)

    def keeps_limit(candidate: BeliefPlan) -> bool:
        if allowed_probability is None:
            return True
        fraction = fraction_beyond_limit(scenario, problem, rewards, candidate.policy)
        return fraction <= allowed_probability

    without_price = plan_with_price(0.0)
    if keeps_limit(without_price):
        return without_price

    # Raise the price until the bound holds.
    too_low = 0.0
    price = 1.0
    cheapest_plan = plan_with_price(price)
    while not keeps_limit(cheapest_plan):
        too_low = price
        price = 4.0 * price
        if price > _LARGEST_PRICE:
            raise PlanningError(
                f"no plan keeps the probability beyond a health limit at {allowed_probability:g}: "
                "allow more, or give the scenario a gentler control or a repair"
            )
        cheapest_plan = plan_with_price(price)

    # Bisect between the largest price known to be too low and the lowest price that suffices.
    for _ in range(_BISECTIONS):
        middle_price = 0.5 * (too_low + price)
        plan = plan_with_price(middle_price)
        if keeps_limit(plan):
            cheapest_plan = plan
            price = middle_price
        else:
            too_low = middle_price
    return cheapest_plan


def _probability_beyond_limit(rewards: RewardModel) -> Float:
    """Return the probability, over the draws, that the health limit is exceeded: (S, U)."""
    is_beyond = (rewards.health_per_draw < 0.0).astype(np.float64)
    return np.asarray(np.tensordot(rewards.quantity.draw_weight, is_beyond, axes=1))


def fraction_beyond_limit(
    scenario: Scenario, problem: DecisionProblem, rewards: RewardModel, policy: BeliefPolicy
) -> float:
    """Return the discounted fraction of steps beyond the health limit under a policy.

    It is estimated in simulated missions: the return of a reward of one for each step beyond the
    limit, divided by the return of a reward of one for every step.
    """
    beyond_limit = replace(problem, reward=_probability_beyond_limit(rewards))
    all_steps = replace(problem, reward=np.ones_like(problem.reward))
    steps_beyond = simulate_policy(scenario, beyond_limit, policy).mean
    return steps_beyond / simulate_policy(scenario, all_steps, policy).mean


def encode_policy(policy: ArrayLike | BeliefPolicy, model: GraphicalModel) -> bytes:
    """Return a policy as the content of a policy file.

    A policy by states is an NPY file with one array (S, U). A policy on the belief is an NPZ
    archive with an array for each field of `BeliefPolicy`, and `controls`, the names of its
    controls.
    """
    content = io.BytesIO()
    if isinstance(policy, BeliefPolicy):
        np.savez(content, **vars(policy), controls=np.array(model.controls))
    else:
        np.save(content, model.policy(policy))
    return content.getvalue()


def read_policy(path: Path, model: GraphicalModel) -> Float | BeliefPolicy:
    """Return the policy in a policy file, for the states and controls of a model.

    Raises
    ------
    PlanningError
        If the file is not a policy, or its policy is for other states or controls.
    """
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):  # NPY: a policy by states (S, U)
            return model.policy(content)  # refuses another shape
        with content:
            policy = BeliefPolicy.from_arrays(content)
            controls = tuple(content["controls"].tolist())
    except FileNotFoundError:
        raise PlanningError(
            f"there is no file {path} with a policy: give a file of `uav-twin plan --out`, or a "
            f"name, which is {POLICY_NAMES}; if it is the copy in a run folder, fly the run again"
        ) from None
    except (OSError, EOFError, ValueError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        # AttributeError: the archive holds a member that is not an array.
        reason = str(error)
        if "pickle" in reason:
            # NumPy takes an unknown file for pickled Python objects, and its message advises to
            # allow these, which would be unsafe.
            reason = "it is neither NPY nor NPZ"
        raise PlanningError(
            f"{path} is not a policy such as `uav-twin plan --out` writes ({reason}): give such a "
            "file; if it is the copy in a run folder, fly the run again"
        ) from None
    state_count = policy.vectors.shape[1]
    if controls != model.controls or state_count != model.states.size:
        raise PlanningError(
            f"{path} is for {state_count} states and the controls {comma_list(controls)}, but the "
            f"scenario has {model.states.size} and {comma_list(model.controls)}: plan it anew"
        )
    return policy


@dataclass(frozen=True)
class ComparedPolicy:
    """The returns of a rule in simulated missions, or their difference to another rule's.

    Attributes
    ----------
    name : str
        The name of the rule.
    returns : (B,) array
        The return of each mission. Missions of the same number meet the same random numbers under
        all rules.
    """

    name: str
    returns: Float

    @property
    def mean(self) -> float:
        """The expected return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """The standard error of the mean."""
        return float(self.returns.std() / np.sqrt(len(self.returns)))

    @property
    def half_width(self) -> float:
        """The half width of the 95 % interval of the mean."""
        return 1.96 * self.standard_error

    def beyond(self, other_policy: "ComparedPolicy") -> "ComparedPolicy":
        """Return the differences of the returns to another rule's, mission by mission."""
        return ComparedPolicy(
            f"{self.name} beyond {other_policy.name}", self.returns - other_policy.returns
        )


def simulate_policy(
    scenario: Scenario, problem: DecisionProblem, policy: BeliefPolicy
) -> ComparedPolicy:
    """Return the returns of a policy on the belief in simulated missions."""
    returns = simulate_decisions(
        scenario, problem, lambda belief, _filtered, _step: policy.decide(belief)
    )
    return ComparedPolicy("planned on the belief", returns)


def compare_simple_rules(
    scenario: Scenario, problem: DecisionProblem
) -> tuple[ComparedPolicy, ...]:
    """Return the simulated returns of rules that are simpler than a plan on the belief.

    - "Mode of the policy by states": the control that the optimal policy of known states takes with
      the largest probability under the belief.
    - QMDP: the control with the largest expected value if the state were known after this step.
    - Inspections at fixed intervals, if there are any: the first control that inspects, and QMDP in
      between.
    """
    plan = value_iteration(problem.transition, problem.reward, problem.discount)
    decides_on_predicted = scenario.planner.decide_on == "predicted"

    def mode_of_policy(belief: Float, filtered_belief: Float, _step: int) -> Index:
        decided_on = belief if decides_on_predicted else filtered_belief
        return np.asarray(np.argmax(decided_on @ plan.policy, axis=1))

    def qmdp(belief: Float, _filtered: Float, _step: int) -> Index:
        return np.asarray(np.argmax(belief @ plan.action_value, axis=1))

    def inspect_every(period: int) -> Decide:
        inspecting_control = scenario.inspection_readings[0].control_index

        def rule(belief: Float, filtered_belief: Float, step: int) -> Index:
            if step % period == 0:
                return np.full(len(belief), inspecting_control)
            return qmdp(belief, filtered_belief, step)

        return rule

    rules: dict[str, Decide] = {"mode of the policy by states": mode_of_policy, "QMDP": qmdp}
    if scenario.inspection_readings:
        for period in INSPECTION_PERIODS:
            name = f"inspection every {period} {scenario.mission.step_name}s"
            rules[name] = inspect_every(period)
    compared = []
    for name, rule in rules.items():
        compared.append(ComparedPolicy(name, simulate_decisions(scenario, problem, rule)))
    return tuple(compared)


def simulate_decisions(scenario: Scenario, problem: DecisionProblem, rule: Decide) -> Float:
    """Return the discounted returns (B,) of simulated missions under a rule.

    The control of the first step is that of the scenario; the rule decides on the later ones.
    """
    first_control = scenario.control_names.index(scenario.mission.first_control)

    def decide(belief: Float, filtered_belief: Float, step: int) -> Index:
        if step == 0:
            return np.full(len(belief), first_control)
        return rule(belief, filtered_belief, step)

    return simulated_returns(
        problem,
        decide,
        MISSIONS,
        scenario.mission.steps,
        generator(scenario.mission.seed, "damage"),
    )
