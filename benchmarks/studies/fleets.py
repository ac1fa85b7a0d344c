"""What a fleet learns about its probabilities to worsen; docs/how_to/fleets.md shows the figures.

    python -m benchmarks.studies.fleets coverage --fleets 200
    python -m benchmarks.studies.fleets groups --fleets 40
    python -m benchmarks.studies.fleets half --twins 1000
    python -m benchmarks.studies.fleets spread --fleets 20

`coverage`: how often 95 % intervals hold the truth. `groups`: what groups gain from each other.
`half`: what flying with the learnt probabilities is worth. `spread`: how often all intervals of
`fleet learn` hold the truth if each asset has a stiffness of its own. Every mission flies the
reduced model in this process; each part prints its table.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.reduction.model_cache import reduced_model
from scenarios import scenario_files
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    grid_evidence,
    scaled,
)
from twin_master.fleet.learning.grid_density import Axes, logistic
from twin_master.fleet.learning.learn import learn_fleet
from twin_master.fleet.learning.posterior import LikelihoodGrid, likelihood_grid, shared_posterior
from twin_master.fleet.members import Member
from twin_master.fleet.storage.store import stored_variables
from twin_master.mission.flights import Flights, fly_side_by_side
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.network.inference import predict
from twin_master.scenario.reading import load_scenario, parse_scenario
from uav_twin import fly_fleet

Float = NDArray[np.float64]

ASSUMED = {"2g": 0.05, "3g": 0.10}
AHEAD = 10


def knowledge(true: dict[str, float], believed: dict[str, float], *, fixed: bool) -> Knowledge:
    """Return what twins of `growing_damage` know, whose damage grows with other probabilities.

    With `fixed`, noise and parameter are those of the true assets, so that rates are all that is
    unknown.
    """
    table = load_scenario("growing_damage").scenario.to_dict()
    table["transition"]["probability"] = believed
    table["truth"]["probability"] = true
    table.pop("notice")  # with it a twin takes thirty times as long
    if fixed:
        table["observation"]["standard_deviation"] = table["truth"]["noise"]["standard_deviation"]
        mean = table["asset"]["parameters"]["young_modulus_factor"]
        table["calibration"] |= {"source": "fixed", "mean": mean, "curve": "published"}
    scenario = parse_scenario(table, "study")
    return prepare_knowledge(scenario, ReducedModelSource(scenario, reduced_model()), 0)


def flights(known: Knowledge, first: int, count: int) -> Flights:
    """Fly some twins under seeds that follow each other."""
    asset = ReducedModelSource(known.scenario, reduced_model()).open()
    truths = [known.truth(seed) for seed in range(first, first + count)]
    return fly_side_by_side(known, truths, [asset] * count)


def learnt(known: Knowledge, flown: Flights) -> LikelihoodGrid:
    """Return the likelihood of the probabilities to worsen."""
    worsening = TransitionFamily.learnable(known.scenario)
    control = flown.control_index
    rows = flown.observation_rows.reshape(control.size, -1)
    log_likelihood_of_states = known.sensor_model.log_likelihood_sequence(rows, control.ravel())
    likelihood, _ = scaled(log_likelihood_of_states.reshape(flown.filtered.shape))

    def log_likelihood(axes: Axes) -> Float:
        probabilities = tuple(logistic(axis) for axis in axes)
        evidence = grid_evidence(worsening, probabilities, likelihood, flown.control_index)
        return np.asarray(evidence.sum(axis=0).reshape([len(axis) for axis in axes]))

    return likelihood_grid(log_likelihood, len(worsening.names))


def coverage(fleets: int, twins: int) -> None:
    """Print how often the 95 % interval of each probability holds the true one of a fleet."""
    generator = np.random.default_rng(1)
    inside = np.zeros((fleets, 2), dtype=bool)
    for fleet in range(fleets):
        rates = np.exp(generator.uniform(np.log(0.02), np.log(0.2), 2))
        fleet_knowledge = knowledge(
            dict(zip(ASSUMED, rates.tolist(), strict=True)), ASSUMED, fixed=True
        )
        grid = learnt(fleet_knowledge, flights(fleet_knowledge, 1000 * fleet, twins))
        for number, (marginal, rate) in enumerate(zip(grid.marginals, rates.tolist(), strict=True)):
            low, high = marginal.interval()
            inside[fleet, number] = low <= rate <= high
    for name, column in zip(ASSUMED, inside.T, strict=True):
        share = column.mean()
        print(
            f"| {name}, {fleets} fleets of {twins} "
            f"| {100 * share:.1f} ± {error(share, fleets):.1f} % |"
        )
    share = inside.mean()
    print(f"| both | {100 * share:.1f} ± {error(share, inside.size):.1f} % |")


def error(share: float, count: int) -> float:
    """Return the standard error of a share in percent."""
    return float(100.0 * np.sqrt(share * (1.0 - share) / count))


def groups(fleets: int, twins: int) -> None:
    """Print rms error and coverage of the rates of 12 groups of 5 twins, alone and shared."""
    generator = np.random.default_rng(2)
    errors: dict[str, list[float]] = {"alone": [], "shared": []}
    inside: dict[str, list[bool]] = {"alone": [], "shared": []}
    for fleet in range(fleets):
        grids, rates = [], []
        for group in range(12):
            true = generator.beta(0.08 * 60.0, 0.92 * 60.0, 2)
            group_knowledge = knowledge(
                dict(zip(ASSUMED, true.tolist(), strict=True)), ASSUMED, fixed=True
            )
            grids.append(
                learnt(
                    group_knowledge, flights(group_knowledge, 10_000 * fleet + 100 * group, twins)
                )
            )
            rates.append(true)
        marginals_of = {
            "alone": [grid.marginals for grid in grids],
            "shared": shared_posterior(grids).groups,
        }
        for way, posteriors in marginals_of.items():
            for true, marginals in zip(rates, posteriors, strict=True):
                for rate, marginal in zip(true.tolist(), marginals, strict=True):
                    low, high = marginal.interval()
                    errors[way].append(marginal.mean - rate)
                    inside[way].append(low <= rate <= high)
    for way, deviations in errors.items():
        rms = float(np.sqrt(np.mean(np.square(deviations))))
        share = float(np.mean(inside[way]))
        print(f"| {way} | {rms:.4f} | {100 * share:.1f} ± {error(share, len(deviations)):.1f} % |")


def half(twins: int) -> None:
    """Print early fallbacks and prediction scores where true rates are half of the assumed."""
    true = {name: 0.5 * rate for name, rate in ASSUMED.items()}
    teacher = knowledge(true, ASSUMED, fixed=False)
    flown = flights(teacher, 0, twins)
    means = [marginal.mean for marginal in learnt(teacher, flown).marginals]
    learnt_rates = dict(zip(ASSUMED, means, strict=True))
    print("learnt", {name: round(rate, 4) for name, rate in learnt_rates.items()})
    scores = {}
    for twin, believed in (("assumed", ASSUMED), ("learnt", learnt_rates), ("known", true)):
        twin_knowledge = knowledge(true, believed, fixed=False)
        later = flights(twin_knowledge, 100_000, twins)
        members = [Member(row, "", 0, {}) for row in range(twins)]
        early = float(stored_variables(twin_knowledge, later, members)["early"].mean())
        scores[twin] = score(twin_knowledge, later)
        print(
            f"| {twin} | {100 * early:.1f} ± {error(early, twins):.1f} % "
            f"| {scores[twin].mean():.3f} |"
        )
    for twin in ("assumed", "known"):
        gain = scores["learnt"] - scores[twin]
        print(
            f"learnt against {twin}: {gain.mean():.3f} "
            f"± {gain.std(ddof=1) / np.sqrt(twins):.3f} a prediction"
        )


def spread(fleets: int, twins: int) -> None:
    """Print how often intervals of `fleet learn` hold the truth if assets differ in stiffness."""
    mean, deviation = 1.0, 0.01
    truths = {**ASSUMED, "mean": mean, "spread": deviation}
    deviations: dict[str, list[float]] = {name: [] for name in truths}
    inside: dict[str, list[bool]] = {name: [] for name in truths}
    scenario = scenario_files()["growing_damage"].read_text(encoding="utf-8")
    for seed in range(fleets):
        with TemporaryDirectory() as folder:
            # Without notices a twin flies thirty times as fast.
            Path(folder, "quiet.toml").write_text(f"notice = false\n{scenario}", encoding="utf-8")
            Path(folder, "fleet.toml").write_text(
                f"""format = 1
[fleet]
name = "spread"
seed = {seed}
[[group]]
name = "wings"
scenario = "quiet.toml"
count = {twins}
parameters = {{ young_modulus_factor = {{ mean = {mean}, standard_deviation = {deviation} }} }}
""",
                encoding="utf-8",
            )
            flown = fly_fleet(Path(folder, "fleet.toml"), Path(folder, "flown"))
            lessons = learn_fleet(flown.folder)["groups"]["wings"]
        found = {**lessons["probability"], **lessons["population"]}
        for name, truth in truths.items():
            posterior = found[name]
            inside[name].append(posterior["lower_95"] <= truth <= posterior["upper_95"])
            deviations[name].append((posterior["mean"] - truth) / posterior["standard_deviation"])
    for name, hits in inside.items():
        print(
            f"| {name}, {fleets} fleets of {twins} | {sum(hits)} of {fleets} "
            f"| {np.mean(deviations[name]):.2f} ± {fleets**-0.5:.2f} |"
        )


def score(known: Knowledge, flown: Flights) -> Float:
    """Return the mean log probability of the true state ten steps ahead, of each twin: (B,)."""
    model = known.model
    steps = flown.state.shape[1]
    result = np.zeros(len(flown.state))
    begins = range(5, steps - AHEAD, 10)
    for twin in range(len(result)):
        for begin in begins:
            control = int(flown.control_index[twin, begin])
            ahead = predict(model, flown.filtered[twin, begin], control, known.plan.policy, AHEAD)
            state = model.states.index(tuple(flown.state[twin, begin + AHEAD]))
            result[twin] += np.log(max(float(ahead.predicted[-1, state]), 1e-12)) / len(begins)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("coverage", "groups", "half", "spread"))
    parser.add_argument("--fleets", type=int, default=200)
    parser.add_argument("--twins", type=int)
    arguments = parser.parse_args()
    if arguments.part == "half":
        half(arguments.twins or 1000)
        return
    if arguments.part == "spread":
        spread(arguments.fleets, arguments.twins or 2000)
        return
    parts: dict[str, Any] = {"coverage": coverage, "groups": groups}
    parts[arguments.part](
        arguments.fleets, arguments.twins or (50 if arguments.part == "coverage" else 5)
    )


if __name__ == "__main__":
    main()
