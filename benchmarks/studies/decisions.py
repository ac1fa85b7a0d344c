"""What notices are worth to belief and decisions under a fault.

Shown in docs/explanation/notices.md.

`python -m benchmarks.studies.decisions --flights 300` flies the mission of level_turns with a wing
whose gauges or skin are not as the model says. Each seed is flown twice: by the twin of the
scenario, and by the plain filter (`notice = false`). The table shows for each fault the rms error
of z1 and z2 from the step of the fault on, the steps flown at 3g with z1 truly at or above the
limit, and the steps at 2g below the limit, which were needless.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.hidden_effects import LIMIT, beyond_the_limit
from benchmarks.studies.learning import SOFTENING, spoiled, third_region
from fe.reduction.model_cache import reduced_model
from fe.wing.design import load_design
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.scenario.reading import load_scenario

Float = NDArray[np.float64]
FaultFactor = Callable[[int, int], Float]
"""(seed, step) -> factors (G,) of the gauges in a step of the flight with a seed."""

SCENARIO = "level_turns"
BEGINS = 10
"""First step with a fault."""
MOST_STRAINED = 16
"""Index of gauge 17, whose strain is the largest."""


@dataclass(frozen=True)
class FlightErrors:
    """Errors and decisions of a twin over its flights.

    Attributes
    ----------
    rms : (2,) array
        Rms error of z1 and z2 from the step of the fault on [percentage points].
    beyond : int
        Steps with z1 at or above the limit.
    sharp_beyond : int
        Those of them that are flown at 3g.
    below : int
        Steps with z1 below the limit.
    gentle_below : int
        Those of them after which 2g is flown, which was needless.
    """

    rms: Float
    beyond: int
    sharp_beyond: int
    below: int
    gentle_below: int


def factor_of_drawn_gauges(count: int, gain: float, sensors: int, seed: int, step: int) -> Float:
    """Return factors (G,) of the gauges; `count` of them, drawn for a flight, have a gain error."""
    drawn = np.random.default_rng([seed, 2]).permutation(sensors)[:count]
    is_faulty = np.isin(np.arange(sensors), drawn) & (step >= BEGINS)
    return np.where(is_faulty, 1.0 + gain, 1.0)


def fault_factors(sensors: int) -> dict[str, FaultFactor]:
    """Return the faults of the study by name, for a number of gauges."""
    third_region_factor = third_region()
    begin, rate, limit = SOFTENING

    def of_most_strained(_seed: int, step: int) -> Float:
        is_faulty = (np.arange(sensors) == MOST_STRAINED) & (step >= BEGINS)
        return np.where(is_faulty, 2.0 / 3.0, 1.0)

    def of_softening_skin(_seed: int, step: int) -> Float:
        return third_region_factor(min(rate * max(step - begin + 1, 0), limit))

    return {
        "nothing": partial(factor_of_drawn_gauges, 0, 0.0, sensors),
        "a gauge shows 20 % too little": partial(factor_of_drawn_gauges, 1, -0.2, sensors),
        "a gauge shows 33 % too little": partial(factor_of_drawn_gauges, 1, -1.0 / 3.0, sensors),
        "gauge 17, strained most, 33 % too little": of_most_strained,
        "half of the gauges show 33 % too little": partial(
            factor_of_drawn_gauges, sensors // 2, -0.33, sensors
        ),
        "skin between the regions softens, a point a step": of_softening_skin,
    }


def fly_with_fault(
    knowledge: Knowledge, source: ReducedModelSource, fault: FaultFactor, seeds: range
) -> FlightErrors:
    """Fly a mission for each seed with a fault of the gauges, and return errors and decisions.

    Parameters
    ----------
    knowledge : Knowledge
        What the twin knows.
    source : ReducedModelSource
        The asset without the fault.
    fault : callable
        Factors of the gauges.
    seeds : range
        Seeds of the flights.
    """
    scenario = knowledge.scenario
    sharp = scenario.control_names.index("3g")
    squared_errors = []
    counts = np.zeros(4, dtype=int)
    for seed in seeds:
        asset = spoiled(source.open(), partial(fault, seed))
        plant = knowledge.plant(knowledge.truth(seed), asset)
        flight = fly(scenario, knowledge.twin(lag=1), plant)
        error = flight.filtered @ knowledge.model.states.coordinates - flight.state
        squared_errors.append(np.mean(error[BEGINS:] ** 2, axis=0))

        z1 = flight.state[:, 0]
        is_sharp = flight.control_index == sharp
        sharp_beyond, beyond = beyond_the_limit(is_sharp, z1)
        is_below = (z1 < LIMIT)[:-1]
        is_gentle_next = (~is_sharp)[1:]
        counts += [beyond, sharp_beyond, is_below.sum(), (is_below & is_gentle_next).sum()]
    rms = 100.0 * np.sqrt(np.mean(squared_errors, axis=0))
    return FlightErrors(rms, *counts.tolist())


def main() -> int:
    """Print a row for each fault and each twin."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", help="numbers of faults from 0, with commas")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.flights)
    scenario = load_scenario(SCENARIO).scenario
    wing = reduced_model(load_design())
    scenarios = {
        "with notices": scenario,
        "without": scenario.model_copy(update={"notice": None}),
    }
    sources = {twin: ReducedModelSource(flown, wing) for twin, flown in scenarios.items()}
    knowledge = {
        twin: prepare_knowledge(scenarios[twin], source, scenario.mission.seed)
        for twin, source in sources.items()
    }
    faults = list(fault_factors(scenario.observation.count).items())
    if arguments.only is not None:
        faults = [faults[int(number)] for number in arguments.only.split(",")]
    print(
        "| wrong from step 10 on | twin | rms z1, z2 | 3g beyond the limit | needless 2g |\n|"
        + " --- |" * 5
    )
    for name, fault in faults:
        for twin, source in sources.items():
            errors = fly_with_fault(knowledge[twin], source, fault, seeds)
            z1, z2 = errors.rms
            print(
                f"| {name} | {twin} | {z1:.1f}, {z2:.1f} "
                f"| {100 * errors.sharp_beyond / errors.beyond:.1f} % "
                f"| {100 * errors.gentle_below / errors.below:.2f} % |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
