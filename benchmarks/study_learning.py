"""What learning in operation is worth: the paper's mission with wings that were never calibrated.

`python -m benchmarks.study_learning --missions 3000 --first-seed 0` draws e of each wing from the prior of
the scenario `level_turns_learning` and flies its mission twice from the same seeds: by a twin that learns,
and by one that averages over e anew in each turn. Exit code 1 if the learning twin misses a target.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import numpy as np

from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.wing.design import load_design
from twin_master.assets.wing_model import ReducedModelSource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.study import Estimated, Study, mission_outcome

SCENARIO = "level_turns_learning"
REACH = (0.9, 1.1)
"""Range of e in which the reduced model is valid: the prior leaves it in one wing of ten thousand."""
TARGETS = {"early": 0.08, "within": 0.98, "z1": 0.045, "z2": 0.13, "coverage": (0.85, 0.95)}


@dataclass(frozen=True)
class Result:
    """Missions of one kind of twin; `covered` says whether the 90 % interval of e held its true value."""

    study: Study
    covered: Estimated
    error_of_e: float
    seconds_per_turn: float


def factor_of(scenario: Scenario, seed: int) -> float:
    """Return e of the wing of a mission, from the prior of the scenario."""
    calibration = scenario.calibration
    assert calibration.mean is not None
    assert calibration.standard_deviation is not None
    normal = float(np.random.default_rng([seed, 1]).standard_normal())
    return float(np.clip(calibration.mean + calibration.standard_deviation * normal, *REACH))


def with_factor(scenario: Scenario, wing: ReducedModel, e: float) -> ReducedModelSource:
    """Return the wing with its own e."""
    asset = scenario.asset.model_copy(update={"parameters": {scenario.calibration.parameter: e}})
    return ReducedModelSource(scenario.model_copy(update={"asset": asset}), wing)


def fly_wings(knowledge: Knowledge, wing: ReducedModel, seeds: range) -> Result:
    """Fly one mission with each wing."""
    scenario, outcomes, covered, errors, seconds = knowledge.scenario, [], [], [], 0.0
    for seed in seeds:
        e = factor_of(scenario, seed)
        asset = with_factor(scenario, wing, e).open()
        twin = knowledge.twin()
        plant = knowledge.plant(knowledge.truth(seed), asset)
        begin = time.process_time()
        flight = fly(scenario, twin, plant)
        seconds += time.process_time() - begin
        outcomes.append(mission_outcome(knowledge, flight))
        # What was learnt at the end: the belief is pure, so the last turn can be asked again.
        learnt = twin.revise(twin.turns - 1, twin.observed(twin.turns - 1)).learnt
        if scenario.calibration.parameter in learnt:
            found = learnt[scenario.calibration.parameter]
            covered.append(found.lower <= e <= found.upper)
            errors.append(found.mean - e)
    share = float(np.mean(covered)) if covered else float("nan")
    spread = float(np.sqrt(share * (1.0 - share) / max(len(covered), 1)))
    root = float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")
    per_turn = seconds / (len(seeds) * scenario.mission.steps)
    return Result(Study.of(tuple(seeds), outcomes), Estimated(share, spread), root, per_turn)


def show(name: str, result: Result) -> None:
    """Print a line of the table."""
    study = result.study
    within, early, z1, z2 = study.within(2), study.early_fallback, study.rms(0), study.rms(1)
    print(
        f"| {name} | {100 * early.value:.1f} ± {100 * early.error:.1f} % "
        f"| {100 * within.value:.1f} ± {100 * within.error:.1f} % "
        f"| {100 * z1.value:.2f} ± {100 * z1.error:.2f} | {100 * z2.value:.2f} ± {100 * z2.error:.2f} "
        f"| {100 * result.covered.value:.1f} ± {100 * result.covered.error:.1f} % "
        f"| {100 * result.error_of_e:.2f} % | {1.0 / result.seconds_per_turn:.0f} |",
        flush=True,
    )


def reached(result: Result) -> bool:
    """Return whether every target is reached."""
    study, covered = result.study, result.covered.value
    return (
        study.early_share <= TARGETS["early"]
        and study.share_within(2) >= TARGETS["within"]
        and study.rms(0).value <= TARGETS["z1"]
        and study.rms(1).value <= TARGETS["z2"]
        and TARGETS["coverage"][0] <= covered <= TARGETS["coverage"][1]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=0)
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.missions)
    scenario = load_scenario(SCENARIO).scenario
    wing = reduced_model(load_design())
    knowledge = prepare_knowledge(scenario, ReducedModelSource(scenario, wing), seeds[0])
    print(
        "| twin | early 2g | 2g within 2 turns | rms z1, points | rms z2, points | 90 % interval holds e "
        f"| rms of e | turns a second |\n|{' --- |' * 8}"
    )
    learning = fly_wings(knowledge, wing, seeds)
    show("learns", learning)
    anew = scenario.model_copy(update={"learning": None})
    show(
        "averages anew",
        fly_wings(prepare_knowledge(anew, ReducedModelSource(anew, wing), seeds[0]), wing, seeds),
    )
    return 0 if reached(learning) else 1


if __name__ == "__main__":
    sys.exit(main())
