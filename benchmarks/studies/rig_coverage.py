"""How often the intervals of a rig's calibration hold the truth.

Shown in docs/explanation/calibration.md.

`python -m benchmarks.studies.rig_coverage --rigs 200` draws chains of one to four masses whose
springs, damping and last mass are parameters, draws their true values from the prior, measures a
load test and a forced motion with noise (its deviation known from twelve degrees of freedom), free
zeros and gain errors of 1 %, calibrates the campaign, and counts how often 90 % intervals hold the
truth. The exit code is 1 if the coverage of springs, damping or masses lies outside 85 to 95 %.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.studies.coverage import PROBABILITY, TAIL, TARGET
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Trial, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.model_choice import ModelChoice, ModelKind
from discrepancy.parameters.calibration import calibrate_parameters
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions

DEVIATION = {"spring": 0.05, "damping": 0.3, "mass": 0.05}
"""Prior standard deviation of each kind of parameter."""
FREEDOM = 12
"""Degrees of freedom of the known noise."""
GAIN = 0.01
"""Standard deviation of gains."""
ZERO = 0.3
"""Standard deviation of zeros, over the largest reading of a channel."""
NOISE = 0.02
"""Standard deviation of the noise, over the largest reading of a channel."""
ALLOWED_REFUSALS = 0.1
"""Largest share of rigs whose calibration may be refused."""


def rig(generator: np.random.Generator) -> LumpedModel:
    """Return a chain of masses with parameters for each spring, the damping and the last mass."""
    count = int(generator.integers(1, 5))
    rows = np.eye(count) - np.eye(count, k=-1)
    stiffness = 10.0 ** generator.uniform(3.0, 4.0, count)
    names = [f"spring_{number}" for number in range(1, count + 1)]
    last = np.zeros((count, count))
    last[-1, -1] = generator.uniform(0.5, 2.0)
    mass = np.diag(np.append(generator.uniform(0.5, 2.0, count - 1), 0.0))
    ends = np.eye(count).tolist()
    kinds = {**dict.fromkeys(names, "spring"), "damping": "damping", "last_mass": "mass"}
    springs = [
        {"name": name, "matrix": (value * np.outer(row, row)).tolist()}
        for name, value, row in zip(names, stiffness, rows, strict=True)
    ]
    parameters = [
        {
            "name": name,
            "terms": name,
            "mean": 1.0,
            "deviation": DEVIATION[kind],
            "low": 0.02,
            "high": 4.0,
        }
        for name, kind in kinds.items()
    ]
    table = {
        "format": 1,
        "name": f"Chain of {count}",
        "mass": mass.tolist(),
        "stiffness": np.zeros((count, count)).tolist(),
        "damping": {"ratios": generator.uniform(0.005, 0.03, count).tolist()},
        "mass_part": [{"name": "last_mass", "matrix": last.tolist()}],
        "stiffness_part": springs,
        "input": [{"name": "end", "vector": ends[-1]}],
        "output": [{"name": f"x{k}", "vector": end} for k, end in enumerate(ends, start=1)],
        "parameter": parameters,
    }
    return LumpedModel(LumpedDescription.parse(table))


def measured_campaign(
    model: LumpedModel, truth: NDArray[np.float64], generator: np.random.Generator
) -> Campaign:
    """Simulate a load test and a forced motion of a rig, and measure them with errors.

    Parameters
    ----------
    model : LumpedModel
        The rig.
    truth : (P,) array
        True values of its parameters.
    generator : numpy.random.Generator
        Random numbers.
    """
    outputs = tuple(model.quantities.items())
    names = tuple(model.quantities)

    # Trials without noise
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
    exact = [
        model.respond(trial, outputs, model.patch, Conditions(truth)).values for trial in trials
    ]

    # Gains, zeros and noise; the deviation of the noise is known from few samples
    amplitude = np.abs(exact[1]).max(axis=0)
    gain = 1.0 + GAIN * generator.standard_normal(len(names))
    deviation = NOISE * amplitude
    known_deviation = deviation / np.sqrt(FREEDOM / generator.chisquare(FREEDOM, len(names)))
    channels = {
        name: Channel(name, quantity, name, NoiseRecord(float(known), FREEDOM), GAIN, np.inf)
        for (name, quantity), known in zip(outputs, known_deviation, strict=True)
    }
    measured = []
    for trial, values in zip(trials, exact, strict=True):
        zero = ZERO * amplitude * generator.standard_normal(len(names))
        noise = deviation * generator.standard_normal(values.shape)
        measured.append(
            Trial.plain(
                trial.name,
                trial.kind,
                names,
                trial.time,
                force=trial.force,
                load_place="end",
                values=gain * values + zero + noise,
            )
        )
    return Campaign("virtual rig", channels, tuple(measured), None, {}, "0" * 64)


@dataclass
class Results:
    """Calibrations of all rigs, by kind of parameter.

    Attributes
    ----------
    held : dict of str to list of bool
        Whether the interval of a parameter holds its true value.
    narrowed : dict of str to list of float
        Posterior over prior standard deviation of a parameter.
    refused : int
        Number of rigs whose calibration was refused.
    """

    held: dict[str, list[bool]]
    narrowed: dict[str, list[float]]
    refused: int = 0


def kind_of(parameter: str) -> str:
    """Return the kind of a parameter: spring, damping or mass."""
    if parameter == "last_mass":
        return "mass"
    return parameter.split("_")[0]


def calibrate_rigs(seeds: range) -> Results:
    """Draw, measure and calibrate a rig for each seed."""
    results = Results({kind: [] for kind in DEVIATION}, {kind: [] for kind in DEVIATION})
    for seed in seeds:
        generator = np.random.default_rng([2021, seed])
        model = rig(generator)
        prior = np.array([parameter.deviation for parameter in model.parameters])
        truth = 1.0 + prior * generator.standard_normal(len(prior))
        choice = ModelChoice(model, ModelKind.LUMPED, "rig.toml", "0" * 64)
        campaign = measured_campaign(model, truth, generator)
        try:
            posterior = calibrate_parameters(campaign, choice, seed=seed)
        except DiscrepancyError as error:
            print(f"rig {seed}: {error}")
            results.refused += 1
            continue
        lower, upper = np.quantile(posterior.samples, [TAIL, 1.0 - TAIL], axis=0)
        deviation = posterior.samples.std(axis=0)
        for index, parameter in enumerate(model.parameters):
            kind = kind_of(parameter.name)
            results.held[kind].append(bool(lower[index] <= truth[index] <= upper[index]))
            results.narrowed[kind].append(float(deviation[index] / prior[index]))
    return results


def main() -> int:
    """Run the study; return 1 if a coverage lies outside `TARGET` or many rigs are refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    results = calibrate_rigs(range(arguments.first_seed, arguments.first_seed + arguments.rigs))
    title = (
        f"{arguments.rigs - results.refused} rigs, share of 90 % intervals that hold the truth; "
        f"{results.refused} refused"
    )
    table = Table(
        "parameter", "count", "holds", "standard error", "deviation over prior", title=title
    )
    passes = results.refused <= ALLOWED_REFUSALS * arguments.rigs
    for kind, held in results.held.items():
        coverage = float(np.mean(held))
        standard_error = np.sqrt(PROBABILITY * (1.0 - PROBABILITY) / len(held))
        narrowed = np.median(results.narrowed[kind])
        table.add_row(
            kind, str(len(held)), f"{coverage:.1%}", f"{standard_error:.1%}", f"{narrowed:.2f}"
        )
        if not TARGET[0] <= coverage <= TARGET[1]:
            passes = False
    Console().print(table)
    return 0 if passes else 1


if __name__ == "__main__":
    sys.exit(main())
