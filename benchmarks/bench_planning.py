"""Plans under partial observation beside bounds that others have published.

The bounds are figures, not times: other machines computed them.
"""

import time
from collections.abc import Iterator

from benchmarks.measurement import Measurement, compared
from benchmarks.studies.planning import PROBLEMS
from twin_master.network.belief_planning import BeliefPlan, plan_on_belief
from twin_master.network.decision_problem import DecisionProblem

GAP = 1e-4
"""The gap between the bounds at which the plan of the tiger ends, relative to the return."""
SARSOP_RETURN = 19.3714
"""The return of the tiger problem (Kaelbling et al. 1998, discount 0.95) to which SARSOP's bounds
converge at a precision of 1e-6, as the documentation of pomdp-py prints them."""
STORM_BOUNDS = (1.8490, 1.9066)
"""Bounds of the maze of 4 x 3 cells (Parr and Russell 1995) by Storm 2.0, as printed by
`python -m benchmarks.studies.planning --storm --size 200000 --resolution 24`."""


def run() -> Iterator[Measurement]:
    """Measure the return of the plans and the processor time."""
    seconds, plan = timed_plan(PROBLEMS["tiger"](), GAP)
    middle = 0.5 * (plan.lower + plan.upper)
    yield Measurement("tiger: return of the plan", middle, "1", larger_is_better=True).beside(
        "published bounds",
        SARSOP_RETURN,
        peer="SARSOP (Kurniawati et al. 2008), printed by pomdp-py",
        agreement=compared("returns", middle, SARSOP_RETURN, GAP),
    )
    yield Measurement("tiger: plan with a gap of 0.01 %, processor", seconds, "s")

    seconds, plan = timed_plan(PROBLEMS["maze of 4 x 3"](), 1e-2)
    lower, upper = STORM_BOUNDS
    middle = 0.5 * (plan.lower + plan.upper)
    half_width = 0.5 * (upper - lower)
    yield Measurement("maze: return of the plan", middle, "1", larger_is_better=True).beside(
        "middle of the bounds",
        0.5 * (lower + upper),
        peer="Storm 2.0",
        agreement=compared("returns", middle, 0.5 * (lower + upper), half_width / lower),
    )
    yield Measurement("maze: plan with a gap of 1 %, processor", seconds, "s")


def timed_plan(problem: DecisionProblem, gap: float) -> tuple[float, BeliefPlan]:
    """Return the least processor seconds of several, and the plan."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        plan = plan_on_belief(problem, gap=gap, most_beliefs=5000)
        times.append(time.process_time() - begin)
    return min(times), plan
