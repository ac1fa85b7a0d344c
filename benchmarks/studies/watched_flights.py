"""Whether two versions of the package give the same notices, beliefs and decisions.

`python -m benchmarks.studies.watched_flights --write FILE` flies `growing_damage` and
`level_turns` with notices, side by side, and writes what the twins concluded. The same command of
another version with `--compare FILE` flies the same flights and prints the largest differences. A
quarter of the flights has no fault. In the other quarters a gauge shows 20 % too much or too
little, half of the gauges show 33 % too little, or wires break. The figures are in
docs/explanation/notices.md.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.reduction.model_cache import reduced_model
from reporting.arrays import AnyArray
from twin_master.assets.asset_source import Asset, AssetReading, StatelessAsset
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.mission.flights import Flights, fly_side_by_side
from twin_master.mission.plant import Truth
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario

Float = NDArray[np.float64]

SCENARIOS = ("growing_damage", "level_turns")
KINDS = 4
"""Nothing is wrong, a gauge is off, half of the gauges are off, wires break."""
FAULTY_ASSETS = 8
"""Wings with a fault of their own of each kind."""


def with_gains(asset: Asset, gains: Float) -> StatelessAsset:
    """Return an asset whose gauges show factors `gains` (G,) times their values."""
    return StatelessAsset(
        lambda control, health: AssetReading(asset.step(control, health).values * gains)
    )


def break_wires(truth: Truth, random: np.random.Generator) -> None:
    """Let a gauge show absurd values from some step on, and another one nothing."""
    steps, gauges = truth.noise.shape
    absurd, lost = random.permutation(gauges)[:2]
    truth.noise[random.integers(steps) :, absurd] += 0.02
    truth.noise[random.integers(steps) :, lost] = np.nan


def fly(name: str, flights: int) -> Flights:
    """Return the flights of a shipped scenario, a quarter of each kind."""
    scenario = load_scenario(name).scenario
    source = ReducedModelSource(scenario, reduced_model())
    knowledge = prepare_knowledge(scenario, source, scenario.mission.seed)
    asset = source.open()
    gauges = scenario.observation.count
    random = np.random.default_rng(1)
    one_gauge_off = []
    half_off = []
    for number in range(FAULTY_ASSETS):
        gains = np.ones(gauges)
        gains[random.integers(gauges)] = 1.2 if number % 2 == 0 else 0.8
        one_gauge_off.append(with_gains(asset, gains))
        half_off.append(with_gains(asset, np.where(random.permutation(gauges) % 2, 0.67, 1.0)))

    truths = []
    assets = []
    for seed in range(flights):
        kind = seed % KINDS
        truth = knowledge.truth(seed)
        if kind == KINDS - 1:
            break_wires(truth, np.random.default_rng([seed, 3]))
        truths.append(truth)
        number = seed // KINDS % FAULTY_ASSETS
        assets.append([asset, one_gauge_off[number], half_off[number], asset][kind])
    return fly_side_by_side(knowledge, truths, assets)


def conclusions(flights: Flights) -> dict[str, AnyArray]:
    """Return what the twins concluded, by name."""
    notices = [
        " ".join(f"{step} {notice.kind} {notice.sensors};" for step, notice in notices)
        for notices in flights.notices
    ]
    evidence = []
    for notices_of_twin in flights.notices:
        evidence += [notice.value for _, notice in notices_of_twin if notice.kind == "alarm"]
    return {
        "belief": flights.filtered,
        "unexplained": flights.unexplained,
        "control": flights.control_index,
        "notices": np.array(notices),
        "log evidence of alarms": np.log(np.array(evidence, dtype=np.float64)),
    }


def main() -> int:
    """Write the conclusions of this version, or compare them with those of another one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--write", type=Path, help="file for the conclusions of this version")
    parser.add_argument("--compare", type=Path, help="file with the conclusions of another version")
    arguments = parser.parse_args()
    present: dict[str, AnyArray] = {}
    for name in SCENARIOS:
        for key, array in conclusions(fly(name, arguments.flights // len(SCENARIOS))).items():
            present[f"{name} {key}"] = array
    if arguments.write is not None:
        np.savez(arguments.write, **present)  # type: ignore[arg-type]
    if arguments.compare is None:
        return 0
    with np.load(arguments.compare) as former:
        are_same = [print_difference(name, present[name], former[name]) for name in present]
    return 0 if all(are_same) else 1


def print_difference(name: str, present: AnyArray, former: AnyArray) -> bool:
    """Print how far an array is from that of another version; return false if it should not be."""
    if present.shape != former.shape:
        print(f"{name}: {present.size} numbers, and {former.size} in the other version")
        return False
    if present.dtype.kind == "f":
        print(f"{name}: largest difference {np.nanmax(np.abs(present - former)):.2g}")
        return True
    same = np.count_nonzero(present == former)
    print(f"{name}: {same} of {present.size} are the same")
    return bool(same == present.size)


if __name__ == "__main__":
    raise SystemExit(main())
