"""Bounds of plans on the belief beside an independent solver.

Shown in docs/how_to/planning.md.

`python -m benchmarks.studies.planning` plans public problems and the inspected wing, and prints
both bounds of the return from the prior, and the seconds. `--storm` adds the bounds of Storm's
belief exploration (Bork, Katoen and Quatmann 2022; `stormpy` of PyPI), which unfolds the beliefs
for a lower bound, and puts them on a grid for an upper one.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from twin_master.network.belief_planning import plan_on_belief
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.transition import TransitionModel


def tiger(discount: float = 0.95) -> DecisionProblem:
    """Kaelbling, Littman and Cassandra 1998: listen, or open one of two doors."""
    moves = np.array([np.eye(2), np.full((2, 2), 0.5), np.full((2, 2), 0.5)])
    reward = np.array([[-1.0, -100.0, 10.0], [-1.0, 10.0, -100.0]])
    heard = np.array([[0.85, 0.15], [0.15, 0.85]])
    nothing = np.full((2, 2), 0.5)
    return DecisionProblem(
        TransitionModel((moves,)),
        reward,
        np.full(3, discount),
        (heard, nothing, nothing),
        np.array([0.5, 0.5]),
        moves_first=True,
    )


def maze(discount: float = 0.95) -> DecisionProblem:
    """Return the maze of 4 x 3 cells of Parr and Russell 1995; moves slip, side walls are seen."""
    cells = [(x, y) for y in range(3) for x in range(4) if (x, y) != (1, 1)]
    good, bad = cells.index((3, 2)), cells.index((3, 1))
    ways = [(0, 1), (1, 0), (0, -1), (-1, 0)]
    start = np.array([number not in (good, bad) for number in range(11)], dtype=float)
    start /= start.sum()

    def reached(x: int, y: int, way: int) -> int:
        to = x + ways[way % 4][0], y + ways[way % 4][1]
        return cells.index(to if to in cells else (x, y))

    moves, likelihood = np.zeros((4, 11, 11)), np.zeros((6, 11))
    for number, (x, y) in enumerate(cells):
        for way in range(4):
            for turned, share in ((0, 0.8), (1, 0.1), (-1, 0.1)):
                moves[way, number, reached(x, y, way + turned)] += share
        wall_left, wall_right = (reached(x, y, way) == number for way in (3, 1))
        likelihood[2 * wall_left + wall_right, number] = 1.0
    for number, symbol in ((good, 4), (bad, 5)):
        moves[:, number] = start
        likelihood[:, number] = np.eye(6)[symbol]
    reward = np.full((11, 4), -0.04)
    reward[good] = 1.0
    reward[bad] = -1.0
    return DecisionProblem(
        TransitionModel((moves,)),
        reward,
        np.full(4, discount),
        (likelihood,) * 4,
        start,
        moves_first=True,
    )


def rock_sample(
    size: int, rocks: tuple[tuple[int, int], ...], start: tuple[int, int], discount: float = 0.95
) -> DecisionProblem:
    """Return RockSample of Smith and Simmons 2004: a rover inspects rocks and takes good ones."""
    qualities = 2 ** len(rocks)
    end, controls = size * size * qualities, 5 + len(rocks)
    moves = np.zeros((controls, end + 1, end + 1))
    reward, good_probability = np.zeros((end + 1, controls)), np.zeros((len(rocks), end + 1))
    moves[:, end, end] = 1.0
    for x, y, good in itertools.product(range(size), range(size), range(qualities)):
        state = (y * size + x) * qualities + good
        for control, (rightwards, upwards) in enumerate([(0, 1), (1, 0), (0, -1), (-1, 0)]):
            a, b = min(max(x + rightwards, 0), size), min(max(y + upwards, 0), size - 1)
            moves[control, state, end if a == size else (b * size + a) * qualities + good] = 1.0
            reward[state, control] = 10.0 * (a == size)
        rock = rocks.index((x, y)) if (x, y) in rocks else None
        remaining = good if rock is None else good & ~(1 << rock)
        moves[4, state, state - good + remaining] = 1.0
        reward[state, 4] = 0.0 if rock is None else 10.0 if remaining != good else -10.0
        moves[5:, state, state] = 1.0
        for number, (a, b) in enumerate(rocks):
            right_one = 0.5 + 0.5 * 2.0 ** (-np.hypot(x - a, y - b) / 20.0)
            good_probability[number, state] = right_one if good >> number & 1 else 1.0 - right_one
    prior = np.zeros(end + 1)
    prior[(start[1] * size + start[0]) * qualities :][:qualities] = 1.0 / qualities
    likelihood = (np.ones((1, end + 1)),) * 5 + tuple(
        np.array([row, 1.0 - row]) for row in good_probability
    )
    return DecisionProblem(
        TransitionModel((moves,)),
        reward,
        np.full(controls, discount),
        likelihood,
        prior,
        moves_first=True,
    )


def wing() -> DecisionProblem:
    """Return the decision problem of `inspected_wing`."""
    from fe.reduction.model_cache import reduced_model
    from fe.wing.design import load_design
    from twin_master.assets.reduced_model import ReducedModelSource
    from twin_master.mission.preparation import prepare_knowledge
    from twin_master.scenario.reading import load_scenario

    scenario = load_scenario("inspected_wing").scenario
    planner = scenario.planner.model_copy(update={"policy": "mode"})
    source = ReducedModelSource(scenario, reduced_model(load_design()))
    by_mode = scenario.model_copy(update={"planner": planner})
    return prepare_knowledge(by_mode, source, scenario.mission.seed).problem


PROBLEMS: dict[str, Callable[[], DecisionProblem]] = {
    "tiger": tiger,
    "maze of 4 x 3": maze,
    "RockSample[4,4]": lambda: rock_sample(4, ((1, 0), (3, 1), (2, 1), (1, 3)), (0, 2)),
    "wing": wing,
}


def write_drn(problem: DecisionProblem, path: Path) -> float:
    """Write a problem as Storm reads it, and return what its values are too large by.

    A state is one with what was observed last, the discount a way to a sink; rewards are moved up
    to zero.
    """
    table = problem.transition.matrix
    discount = float(problem.discount[0])
    controls = len(table)
    most = max(len(rows) for rows in problem.likelihood)
    lift = max(0.0, -float(problem.reward.min()))
    place = {
        (int(state), most): 2 + number for number, state in enumerate(np.flatnonzero(problem.prior))
    }
    share = " ".join(
        f"\n\t\t{to} : {float(problem.prior[state])!r}" for (state, _), to in place.items()
    )
    text = [f"state 0 {{{most + 1}}} init\n\taction a [0]{share}"]
    text += [f"state 1 {{{most + 2}}} sink\n\taction a [0]\n\t\t1 : 1"]
    waiting = list(place)
    while len(text) < 2 + len(waiting):
        state, symbol = waiting[len(text) - 2]
        lines = [f"state {len(text)} {{{symbol}}}"]
        for control in range(controls):
            to = np.flatnonzero(table[control, state])
            likelihood = problem.likelihood[control]
            symbol_likelihood = (
                likelihood[:, to] if problem.moves_first else likelihood[:, [state] * len(to)]
            )
            reached = {1: 1.0 - discount}
            for k, column in zip(*np.nonzero(symbol_likelihood), strict=True):
                key = int(to[column]), int(k)
                if key not in place:
                    place[key] = 2 + len(waiting)
                    waiting.append(key)
                reached[place[key]] = float(
                    discount * table[control, state, key[0]] * symbol_likelihood[k, column]
                )
            lines.append(f"\taction u{control} [{float(problem.reward[state, control] + lift)!r}]")
            lines += [f"\t\t{number} : {share!r}" for number, share in sorted(reached.items())]
        text.append("\n".join(lines))
    head = f"@type: POMDP\n@parameters\n\n@reward_models\nr\n@nr_states\n{len(text)}\n"
    path.write_text(
        f"{head}@nr_choices\n{2 + controls * len(waiting)}\n@model\n" + "\n".join(text) + "\n",
        encoding="utf-8",
    )
    return lift / (1.0 - discount)


def by_storm(problem: DecisionProblem, size: int, resolution: int) -> tuple[float, float]:
    """Return Storm's lower and upper bound: of so many beliefs, and of a grid."""
    import stormpy
    from stormpy import io, pomdp

    with TemporaryDirectory() as folder:
        file = Path(folder, "problem.drn")
        lift = write_drn(problem, file)
        options = io.DirectEncodingParserOptions()
        options.build_choice_labeling = True
        model = stormpy.build_model_from_drn(str(file), options=options)
    goal = stormpy.parse_properties('Rmax=? [F "sink"]')[0]
    below = pomdp.verify_with_belief_unfolding(model, goal, max_exploration_size=size)
    above = pomdp.verify_with_belief_discretization(model, goal, resolution)
    return below.value - lift, above.value - lift


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--storm", action="store_true", help="with Storm's bounds; needs stormpy")
    parser.add_argument("--size", type=int, default=100_000, help="beliefs that Storm unfolds")
    parser.add_argument("--resolution", type=int, default=8, help="of Storm's grid")
    arguments = parser.parse_args()
    for name, make_problem in PROBLEMS.items():
        problem = make_problem()
        begun = time.process_time()
        plan = plan_on_belief(problem)
        seconds = time.process_time() - begun
        gap = (plan.upper - plan.lower) / abs(plan.upper)
        line = (
            f"{name}: {plan.lower:.4f} to {plan.upper:.4f}, gap {100 * gap:.2f} %, {seconds:.1f} s"
        )
        if arguments.storm:
            line += ", Storm {:.4f} to {:.4f}".format(
                *by_storm(problem, arguments.size, arguments.resolution)
            )
        print(line, flush=True)


if __name__ == "__main__":
    main()
