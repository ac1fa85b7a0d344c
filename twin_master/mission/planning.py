"""The plan of a scenario on the belief: what it promises, and what other rules bring."""

import io
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from twin_master.errors import PlanningError, said
from twin_master.network.belief_planning import BeliefPlan, plan_on_belief
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy, value_iteration
from twin_master.network.quantity import RewardModel
from twin_master.network.simulated_missions import Decide, simulated_returns
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

MISSIONS = 400
"""That are simulated for each rule."""
PERIODS = (2, 3, 5, 8, 12, 20)
"""Steps between two inspections of the rules that inspect by the clock."""
_GAP, _PRICED_GAP = 0.005, 0.06
"""Between the bounds of a plan, as a share of the return, and of those that are tried for a limit."""
_HARDEST, _HALVINGS = 2.0**12, 4
"""The largest price of a step beyond the limit, in rewards, and how often the interval of it is halved."""


def discounts(scenario: Scenario) -> Float:
    """Return the discount behind a step under each control (U,): zero where it ends the mission."""
    ends = [scenario.ends(index) for index in range(len(scenario.control))]
    return np.where(ends, 0.0, scenario.planner.gamma)


def expected_plan(
    scenario: Scenario, problem: DecisionProblem, rewards: RewardModel
) -> tuple[BeliefPlan, float]:
    """Return the plan on the belief, and the price of a step beyond a health limit that it is made with.

    Without `planner.limit_probability` there is no price. With it the price is the least, of some that are
    tried, under which the share of such steps stays below: a constraint on the mean by a multiplier, Altman
    1999.

    Raises
    ------
    PlanningError
        No price is high enough.
    """
    first = scenario.control_names.index(scenario.mission.first_control)
    allowed, risk = scenario.planner.limit_probability, _risk(rewards)

    gap = _GAP if allowed is None else _PRICED_GAP

    def priced(price: float) -> tuple[BeliefPlan, float]:
        costly = replace(problem, reward=problem.reward - price * risk)
        return plan_on_belief(costly, first=first, gap=gap), price

    def holds(plan: BeliefPlan) -> bool:
        return allowed is None or risk_of(scenario, problem, rewards, plan.policy) <= allowed

    below, price, found = 0.0, 1.0, priced(0.0)
    if holds(found[0]):
        return found
    while not holds((found := priced(price))[0]):
        below, price = price, 4.0 * price
        if price > _HARDEST:
            raise PlanningError(said("mission.no_plan", allowed=allowed))
    for _ in range(_HALVINGS):
        middle = priced(0.5 * (below + price))
        if holds(middle[0]):
            found, price = middle, middle[1]
        else:
            below = middle[1]
    return found


def _risk(rewards: RewardModel) -> Float:
    """Return the probability of each state and control that a health limit is exceeded (S, U)."""
    beyond = (rewards.health_per_draw < 0.0).astype(np.float64)
    return np.asarray(np.tensordot(rewards.quantity.draw_weight, beyond, axes=1))


def risk_of(
    scenario: Scenario, problem: DecisionProblem, rewards: RewardModel, policy: BeliefPolicy
) -> float:
    """Return the share of steps, discounted, beyond a health limit under a policy, in simulated missions."""
    shares = [
        promised(scenario, replace(problem, reward=reward), policy).mean
        for reward in (_risk(rewards), np.ones_like(problem.reward))
    ]
    return shares[0] / shares[1]


def policy_file(policy: ArrayLike | BeliefPolicy, model: GraphicalModel) -> bytes:
    """Return a policy as files have it: (S, U) in NPY, or on the belief in NPZ, with what it is for."""
    content = io.BytesIO()
    if isinstance(policy, BeliefPolicy):
        np.savez(content, **vars(policy), controls=np.array(model.controls))
    else:
        np.save(content, model.policy(policy))
    return content.getvalue()


def read_policy(path: Path, model: GraphicalModel) -> Float | BeliefPolicy:
    """Return the policy in a file, for the states and controls of a model.

    Raises
    ------
    PlanningError
        It is none, or one for other states or controls.
    """
    try:
        kept = np.load(path, allow_pickle=False)
        if isinstance(kept, np.ndarray):
            return model.policy(kept)
        with kept:
            policy, controls = BeliefPolicy.from_arrays(kept), tuple(kept["controls"].tolist())
    except (OSError, EOFError, ValueError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        # NumPy takes what it does not know for Python objects, and says how to load them unsafely.
        reason = "it is neither NPY nor NPZ" if "pickle" in str(error) else error
        raise PlanningError(said("mission.no_policy", path=path, error=reason)) from None
    if controls != model.controls or policy.vectors.shape[1] != model.states.size:
        own = {"states": policy.vectors.shape[1], "controls": controls}
        raise PlanningError(said("mission.another_policy", path=path, **own, model=model))
    return policy


@dataclass(frozen=True)
class ComparedPolicy:
    """What a rule brings in simulated missions, or by how much more than another one.

    Attributes
    ----------
    name : str
    returns : (B,)
        Of each mission; those of the same number of two rules are met by the same chance.
    """

    name: str
    returns: Float

    @property
    def mean(self) -> float:
        """Expected return."""
        return float(self.returns.mean())

    @property
    def half_width(self) -> float:
        """Of the 95 % interval of the mean."""
        return float(1.96 * self.returns.std() / np.sqrt(len(self.returns)))

    def beyond(self, other: "ComparedPolicy") -> "ComparedPolicy":
        """Return by how much more it brings than another rule, mission by mission."""
        return ComparedPolicy(f"{self.name} beyond {other.name}", self.returns - other.returns)


def promised(scenario: Scenario, problem: DecisionProblem, policy: BeliefPolicy) -> ComparedPolicy:
    """Return what a policy on the belief brings in simulated missions."""
    returns = _simulated(scenario, problem, lambda belief, *_: policy.decide(belief))
    return ComparedPolicy("planned on the belief", returns)


def compared(scenario: Scenario, problem: DecisionProblem) -> tuple[ComparedPolicy, ...]:
    """Return what rules bring that are simpler than a plan on the belief.

    The mode of the policy is decided on the belief that the scenario names. Inspection by the clock takes the
    first action that inspects, and decides as QMDP between.
    """
    known = value_iteration(problem.transition, problem.reward, problem.discount)

    def by_the_clock(every: int) -> Decide:
        def rule(belief: Float, _filtered: Float, step: int) -> Index:
            if step % every == 0:
                return np.full(len(belief), scenario.readings[0][0])
            return np.asarray(np.argmax(belief @ known.action_value, axis=1))

        return rule

    ahead = scenario.planner.decide_on == "predicted"
    rules: dict[str, Decide] = {
        "mode of the policy by states": lambda belief, filtered, _step: np.argmax(
            (belief if ahead else filtered) @ known.policy, axis=1
        ),
        "QMDP": lambda belief, *_: np.argmax(belief @ known.action_value, axis=1),
    }
    for every in PERIODS if scenario.readings else ():
        rules[f"inspection every {every} {scenario.mission.step_name}s"] = by_the_clock(every)
    return tuple(ComparedPolicy(name, _simulated(scenario, problem, rule)) for name, rule in rules.items())


def _simulated(scenario: Scenario, problem: DecisionProblem, rule: Decide) -> Float:
    """Return the returns of simulated missions under a rule, behind the first control of the scenario."""
    first = scenario.control_names.index(scenario.mission.first_control)
    return simulated_returns(
        problem,
        lambda belief, now, step: rule(belief, now, step) if step else np.full(len(belief), first),
        MISSIONS,
        scenario.mission.steps,
        generator(scenario.mission.seed, "damage"),
    )
