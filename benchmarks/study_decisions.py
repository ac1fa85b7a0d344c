"""What belief and decision are worth while something is wrong: with notices and without.

`python -m benchmarks.study_decisions --flights 300` flies the mission of level_turns with a wing whose gauges
or skin are not as the model says, under many seeds, by the twin of the scenario and by the plain filter
(`notice = false`). Printed for each: rms error of z1 and z2 from the step of the fault on, steps flown at 3g
with z1 truly at or above the limit, and steps at 2g below it, which were needless.
"""

import argparse
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.study_hidden_effects import LIMIT, beyond_the_limit
from benchmarks.study_learning import SOFTENING, spoiled, third_region
from fe.reduction.model_cache import reduced_model
from fe.wing.design import load_design
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.scenario.reading import load_scenario

Float = NDArray[np.float64]
Fault = Callable[[int, int], Float]
"""What the gauges show more (G,) in a flight of a seed in a step."""

SCENARIO = "level_turns"
BEGINS = 10
"""Step from which on something is wrong."""


def gauges_off(count: int, gain: float, sensors: int, seed: int, step: int) -> Float:
    """Return what the gauges show more where `count` of them, drawn for each flight, are off."""
    chosen = np.random.default_rng([seed, 2]).permutation(sensors)[:count]
    return np.where(np.isin(np.arange(sensors), chosen) & (step >= BEGINS), 1.0 + gain, 1.0)


def faults(sensors: int) -> dict[str, Fault]:
    """Return what may be wrong, by name."""
    softer, (begin, rate, limit) = third_region(), SOFTENING
    return {
        "nothing": partial(gauges_off, 0, 0.0, sensors),
        "a gauge shows 20 % too little": partial(gauges_off, 1, -0.2, sensors),
        "a gauge shows 33 % too little": partial(gauges_off, 1, -1.0 / 3.0, sensors),
        "gauge 17, strained most, 33 % too little": lambda _seed, step: np.where(
            (np.arange(sensors) == 16) & (step >= BEGINS), 2.0 / 3.0, 1.0
        ),
        "half of the gauges show 33 % too little": partial(gauges_off, sensors // 2, -0.33, sensors),
        "skin between the regions softens, a point a step": lambda _seed, step: softer(
            min(rate * max(step - begin + 1, 0), limit)
        ),
    }


def flown(
    knowledge: Knowledge, source: ReducedModelSource, fault: Fault, seeds: range
) -> tuple[Float, Float]:
    """Return rms of z1 and z2 in points, and steps: at 3g beyond the limit, beyond, at 2g below, below."""
    scenario, squares, steps = knowledge.scenario, [], np.zeros(4)
    sharp = scenario.control_names.index("3g")
    for seed in seeds:
        asset = spoiled(source.open(), partial(fault, seed))
        flight = fly(scenario, knowledge.twin(lag=1), knowledge.plant(knowledge.truth(seed), asset))
        state = flight.state
        error = flight.filtered @ knowledge.model.states.coordinates - state
        squares.append(np.mean(error[BEGINS:] ** 2, axis=0))
        beyond = beyond_the_limit(flight.control_index == sharp, state[:, 0])
        below = (state[:, 0] < LIMIT)[:-1]
        gentle = below & (flight.control_index != sharp)[1:]
        steps += [*beyond, gentle.sum(), below.sum()]
    return 100.0 * np.sqrt(np.mean(squares, axis=0)), steps


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", help="numbers of faults from 0, with commas")
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.flights)
    scenario, wing = load_scenario(SCENARIO).scenario, reduced_model(load_design())
    plain = scenario.model_copy(update={"notice": None})
    cases = [*faults(scenario.observation.count).items()]
    chosen = range(len(cases)) if given.only is None else map(int, given.only.split(","))
    print(
        "| wrong from step 10 on | twin | rms z1, z2 | 3g beyond the limit | needless 2g |\n|" + " --- |" * 5
    )
    sources = [(kind, ReducedModelSource(kind, wing)) for kind in (scenario, plain)]
    twins = [(prepare_knowledge(kind, source, scenario.mission.seed), source) for kind, source in sources]
    for name, fault in (cases[number] for number in chosen):
        for way, (knowledge, source) in zip(("with notices", "without"), twins, strict=True):
            (z1, z2), (sharp, beyond, gentle, below) = flown(knowledge, source, fault, seeds)
            print(
                f"| {name} | {way} | {z1:.1f}, {z2:.1f} | {100 * sharp / beyond:.1f} % "
                f"| {100 * gentle / below:.2f} % |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
