"""How often the intervals of a rig's calibration hold the truth; docs/calibration.md shows it.

`python -m benchmarks.studies.rig_coverage --rigs 200` draws chains of one to four masses whose
springs, damping and last mass are parameters, draws their true values from the prior, measures a
load test and a forced motion with noise (its deviation known from twelve degrees of freedom), free
zeros and gain errors of 1 %, calibrates the campaign, and counts how often 90 % intervals hold the
truth. The exit code is 1 if the coverage of springs, damping or masses lies outside 85 to 95 %.
"""

import argparse
import sys

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.studies.coverage import PROBABILITY, TARGET
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Trial, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.model_choice import ModelChoice, ModelKind
from discrepancy.parameters.calibration import calibrate_parameters
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions

DEVIATION = {"spring": 0.05, "damping": 0.3, "mass": 0.05}
FREEDOM, GAIN, ZERO, NOISE = 12, 0.01, 0.3, 0.02  # zero and noise: shares of what a channel shows


def rig(generator: np.random.Generator) -> LumpedModel:
    """Return a chain of masses with parameters for each spring, the damping and the last mass."""
    count = int(generator.integers(1, 5))
    rows = np.eye(count) - np.eye(count, k=-1)
    stiffness = 10.0 ** generator.uniform(3.0, 4.0, count)
    names = [f"spring_{number}" for number in range(1, count + 1)]
    last = np.zeros((count, count))
    last[-1, -1] = generator.uniform(0.5, 2.0)
    mass = np.diag(np.append(generator.uniform(0.5, 2.0, count - 1), 0.0))
    none = np.zeros((count, count)).tolist()
    parts = zip(names, stiffness, rows, strict=True)
    ends = np.eye(count).tolist()
    scaled = {**dict.fromkeys(names, "spring"), "damping": "damping", "last_mass": "mass"}
    return LumpedModel(
        LumpedDescription.parse(
            {
                "format": 1,
                "name": f"Chain of {count}",
                "mass": mass.tolist(),
                "stiffness": none,
                "damping": {"ratios": generator.uniform(0.005, 0.03, count).tolist()},
                "mass_part": [{"name": "last_mass", "matrix": last.tolist()}],
                "stiffness_part": [
                    {"name": name, "matrix": (own * np.outer(row, row)).tolist()}
                    for name, own, row in parts
                ],
                "input": [{"name": "end", "vector": ends[-1]}],
                "output": [{"name": f"x{k}", "vector": end} for k, end in enumerate(ends, start=1)],
                "parameter": [
                    {
                        "name": name,
                        "terms": name,
                        "mean": 1.0,
                        "deviation": DEVIATION[kind],
                        "low": 0.02,
                        "high": 4.0,
                    }
                    for name, kind in scaled.items()
                ],
            }
        )
    )


def measured(model: LumpedModel, truth: np.ndarray, generator: np.random.Generator) -> Campaign:
    """Return a load test and a forced motion under a random force, as measured."""
    outputs = tuple(model.quantities.items())
    names = tuple(model.quantities)
    interval = 0.3 / model.scales(Campaign("", {}, (), None, {}, "")).angular_frequency
    time = interval * np.arange(800, dtype=np.float64)
    force = np.convolve(generator.standard_normal(len(time)), np.hanning(9), "same")
    steps = np.linspace(-50.0, 50.0, 9)
    trials = (
        Trial.plain(
            "load_test", TrialKind.STATIC, names, np.arange(9.0), force=steps, load_place="end"
        ),
        Trial.plain("forced", TrialKind.FORCED, names, time, force=10.0 * force, load_place="end"),
    )
    shown = [
        model.respond(trial, outputs, model.patch, Conditions(truth)).values for trial in trials
    ]
    size = np.abs(shown[1]).max(axis=0)
    gain = 1.0 + GAIN * generator.standard_normal(len(names))
    deviation = NOISE * size
    recorded = deviation / np.sqrt(FREEDOM / generator.chisquare(FREEDOM, len(names)))
    channels = {
        name: Channel(name, quantity, name, NoiseRecord(float(known), FREEDOM), GAIN, np.inf)
        for (name, quantity), known in zip(outputs, recorded, strict=True)
    }
    values = [
        gain * clean
        + ZERO * size * generator.standard_normal(len(names))
        + deviation * generator.standard_normal(clean.shape)
        for clean in shown
    ]
    filled = tuple(
        Trial.plain(
            trial.name,
            trial.kind,
            names,
            trial.time,
            force=trial.force,
            load_place="end",
            values=own,
        )
        for trial, own in zip(trials, values, strict=True)
    )
    return Campaign("virtual rig", channels, filled, None, {}, "0" * 64)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    held: dict[str, list[bool]] = {kind: [] for kind in DEVIATION}
    narrowed: dict[str, list[float]] = {kind: [] for kind in DEVIATION}
    refused = 0
    tail = 0.5 * (1.0 - PROBABILITY)
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.rigs):
        generator = np.random.default_rng([2021, seed])
        model = rig(generator)
        prior = np.array([item.deviation for item in model.parameters])
        truth = 1.0 + prior * generator.standard_normal(len(prior))
        choice = ModelChoice(model, ModelKind.LUMPED, "rig.toml", "0" * 64)
        try:
            found = calibrate_parameters(measured(model, truth, generator), choice, seed=seed)
        except DiscrepancyError as error:
            print(f"rig {seed}: {error}")
            refused += 1
            continue
        lower, upper = np.quantile(found.samples, [tail, 1.0 - tail], axis=0)
        for place, item in enumerate(model.parameters):
            kind = item.name.split("_")[item.name == "last_mass"]
            held[kind].append(bool(lower[place] <= truth[place] <= upper[place]))
            narrowed[kind].append(float(found.samples[:, place].std() / prior[place]))
    title = (
        f"{arguments.rigs - refused} rigs, share of 90 % intervals that hold the truth; "
        f"{refused} refused"
    )
    shown = Table(
        "parameter", "count", "holds", "standard error", "deviation over prior", title=title
    )
    good = refused <= 0.1 * arguments.rigs
    for kind, items in held.items():
        share, count = float(np.mean(items)), len(items)
        standard_error = np.sqrt(PROBABILITY * (1.0 - PROBABILITY) / count)
        good &= TARGET[0] <= share <= TARGET[1]
        left = f"{np.median(narrowed[kind]):.2f}"
        shown.add_row(kind, str(count), f"{share:.1%}", f"{standard_error:.1%}", left)
    Console().print(shown)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
