"""How often the intervals of a wing's calibration hold the truth.

Shown in docs/explanation/calibration.md.

`python -m benchmarks.studies.coverage --wings 200` draws wings from the prior of the calibration,
simulates the experiments on each (load test, weighing, five ring-down records with noise), fits
the records, and counts how often 90 % intervals hold the truth: those of the joint posterior, and
those of the paper's procedure on the same measurements. The frequencies of a wing differ from the
model's by a draw of the assumed model error, so the intervals are right if the calibration is;
`--exact-model` leaves these differences out. The exit code is 1 if the coverage of the joint
posterior lies outside 85 to 95 %.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.studies.paper.masses import fit_masses
from calibration.dynamics.trials import fit_trials
from calibration.errors import CalibrationError, ExperimentDataError
from calibration.joint.measured_modes import measured_modes
from calibration.joint.posterior import joint_posterior
from calibration.joint.wing_table import MODEL_ERROR, WingTable, tabulate_wing, wing_priors
from calibration.result.record import STATE, QuantityReading, prior_samples
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import LoadDisplacementData
from calibration.virtual_wing import VirtualWing, measure_load_test, measure_ring_down, weigh
from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState, Geometry
from reporting.progress import RichProgress

PROBABILITY = 0.90
TAIL = 0.5 * (1.0 - PROBABILITY)
"""Probability below, and above, an interval."""
TARGET = (0.85, 0.95)
"""Lowest and highest coverage that passes."""
SAMPLING_RATE = 250.0  # Hz
DURATION = 6.4  # s
NOISE = 3e-4  # V, 3 % of the first mode
PAPER_SAMPLES = 40
ALLOWED_REFUSALS = 0.1

# Wings whose second mode is seen in a record: weak as the default prior is, it has wings without
# damping and
# wings that do not ring. Everything else is the default.
DAMPING = {"damping_alpha": (1.0, 0.3), "damping_beta": (6e-4, 1.5e-4)}


@dataclass(frozen=True, eq=False)
class MeasuredWing:
    """A virtual wing with its measurements.

    Attributes
    ----------
    truth : (5,) array
        True values of `STATE`.
    static : LoadDisplacementData
        Its load test.
    readings : tuple of QuantityReading
        Its weight, frequencies and damping.
    """

    truth: NDArray[np.float64]
    static: LoadDisplacementData
    readings: tuple[QuantityReading, ...]


@dataclass
class Results:
    """Results of all wings: intervals that hold the truth, their widths, refusals and seconds.

    Attributes
    ----------
    held, held_paper : list of (5,) bool array
        For each wing, whether the intervals of the joint posterior and of the paper's procedure
        hold the truth.
    widths : list of (5,) array
        Widths of the intervals of the joint posterior.
    width_ratios : list of (5,) array
        Widths of the paper's intervals over those of the joint posterior.
    without_modes, refused, refused_paper : int
        Wings whose records do not show two modes, and wings refused by each calibration.
    seconds : dict of str to float
        Total time by stage [s].
    """

    held: list[NDArray[np.bool_]] = field(default_factory=list)
    held_paper: list[NDArray[np.bool_]] = field(default_factory=list)
    widths: list[NDArray[np.float64]] = field(default_factory=list)
    width_ratios: list[NDArray[np.float64]] = field(default_factory=list)
    without_modes: int = 0
    refused: int = 0
    refused_paper: int = 0
    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(
            ("measuring and fitting", "joint posterior", "paper's procedure"), 0.0
        )
    )

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage, unless it raises."""
        begin = time.perf_counter()
        yield
        self.seconds[stage] += time.perf_counter() - begin


def measure(
    model: ReducedModel, seed: int, model_error: tuple[float, float], *, frequencies_fitted: bool
) -> MeasuredWing:
    """Draw a wing from the prior and measure it.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    seed : int
        Seed of the wing and its measurements.
    model_error : (float, float)
        Relative standard deviations of the first two frequencies from the model's.
    frequencies_fitted : bool
        Whether ring-downs are fitted; otherwise frequencies come from the spectrum.
    """
    generator = np.random.default_rng([2021, seed])
    prior_seed = int(generator.integers(2**32))
    truth = prior_samples(wing_priors(model.validity, **DAMPING), 1, prior_seed)[0]
    state = DigitalState(Geometry(), *truth.tolist())
    first, second = (np.array(model_error) * generator.standard_normal(2)).tolist()
    wing = VirtualWing(model, state, (first, second))
    records = measure_ring_down(
        wing, seed, sampling_rate=SAMPLING_RATE, duration=DURATION, noise=NOISE
    )
    load_test = measure_load_test(wing, seed)
    weight = weigh(state, seed)
    modes = measured_modes(fit_trials(records, frequencies_fitted=frequencies_fitted))
    return MeasuredWing(truth, load_test, (weight, *modes))


def paper_interval(table: WingTable, wing: MeasuredWing, seed: int) -> NDArray[np.float64]:
    """Return intervals (2, 5) of the procedure of Kapteyn et al. 2021, eqs. (19), (20), (25)."""
    alone = exact_posterior(wing.static, curve=table.stiffness)
    factors = alone.samples(seed, PAPER_SAMPLES)
    result = fit_masses(table.frequency, factors, table.validity, wing.readings)
    return np.asarray(np.quantile(result.samples, [TAIL, 1.0 - TAIL], axis=0))


def holds(interval: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of the intervals (2, 5) hold the truth (5,)."""
    lower, upper = interval
    return np.asarray((lower <= truth) & (truth <= upper))


def calibrate_wings(
    model: ReducedModel,
    seeds: range,
    wing_error: tuple[float, float],
    assumed_error: tuple[float, float],
    *,
    frequencies_fitted: bool,
) -> Results:
    """Measure and calibrate a wing for each seed; see `measure` for the parameters.

    `assumed_error` is the model error that the calibration assumes.
    """
    table = tabulate_wing(model)
    priors = wing_priors(model.validity, **DAMPING)
    results = Results()
    for seed in seeds:
        try:
            with results.timed("measuring and fitting"):
                wing = measure(model, seed, wing_error, frequencies_fitted=frequencies_fitted)
        except ExperimentDataError:
            results.without_modes += 1
            continue
        try:
            with results.timed("joint posterior"):
                samples = joint_posterior(
                    table,
                    wing.static,
                    wing.readings,
                    priors=priors,
                    model_error=assumed_error,
                    seed=seed,
                )
        except CalibrationError as error:
            print(f"wing {seed}: {error}")
            results.refused += 1
            continue
        interval = np.quantile(samples, [TAIL, 1.0 - TAIL], axis=0)
        width = interval[1] - interval[0]
        results.held.append(holds(interval, wing.truth))
        results.widths.append(width)
        try:
            with results.timed("paper's procedure"):
                interval = paper_interval(table, wing, seed)
        except CalibrationError:
            results.refused_paper += 1
            continue
        results.held_paper.append(holds(interval, wing.truth))
        results.width_ratios.append((interval[1] - interval[0]) / width)
    return results


def print_results(results: Results, coverage: NDArray[np.float64]) -> None:
    """Print a table of the coverage (5,) of the joint posterior beside the paper's procedure."""
    count = len(results.held)
    paper_coverage = np.mean(results.held_paper, axis=0)
    width = np.median(results.widths, axis=0)
    ratio = np.median(results.width_ratios, axis=0)
    table = Table(
        "quantity",
        "joint posterior",
        "wanted",
        "reached",
        "the paper's procedure",
        "width, joint",
        "width, paper's over joint",
        title=f"{count} wings, share of 90 % intervals that hold the truth",
    )
    for index, name in enumerate(STATE):
        table.add_row(
            name,
            f"{100 * coverage[index]:.1f} %",
            "85 to 95 %",
            "yes" if TARGET[0] <= coverage[index] <= TARGET[1] else "NO",
            f"{100 * paper_coverage[index]:.1f} %",
            f"{width[index]:.3g}",
            f"{ratio[index]:.2f}",
        )
    standard_error = 100.0 * np.sqrt(PROBABILITY * (1.0 - PROBABILITY) / count)
    console = Console(width=160)
    console.print(table)
    console.print(f"binomial standard error of a calibrated share: {standard_error:.1f} points")
    console.print(
        f"{results.without_modes} wings whose records do not show two modes, "
        f"{results.refused} refused by the joint posterior, "
        f"{results.refused_paper} refused by the paper's procedure (not counted for it)"
    )
    seconds = [
        f"{stage} {total / max(count, 1):.2f} s a wing" for stage, total in results.seconds.items()
    ]
    console.print(", ".join(seconds))


def main() -> int:
    """Run the study; return 1 if the coverage is outside `TARGET` or too many wings are refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wings", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--exact-model", action="store_true", help="wings without model error")
    parser.add_argument(
        "--trusting", action="store_true", help="the calibration assumes no model error"
    )
    parser.add_argument(
        "--peaks", action="store_true", help="frequencies from the spectrum, as the paper"
    )
    arguments = parser.parse_args()
    results = calibrate_wings(
        reduced_model(progress=RichProgress()),
        range(arguments.first_seed, arguments.first_seed + arguments.wings),
        wing_error=(0.0, 0.0) if arguments.exact_model else MODEL_ERROR,
        assumed_error=(0.0, 0.0) if arguments.trusting else MODEL_ERROR,
        frequencies_fitted=not arguments.peaks,
    )
    coverage = np.mean(results.held, axis=0)
    print_results(results, coverage)
    is_calibrated = bool(np.all((coverage >= TARGET[0]) & (coverage <= TARGET[1])))
    few_refused = results.without_modes + results.refused <= ALLOWED_REFUSALS * arguments.wings
    return 0 if is_calibrated and few_refused else 1


if __name__ == "__main__":
    sys.exit(main())
