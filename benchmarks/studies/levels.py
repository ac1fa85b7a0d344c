"""How well beliefs hold a truth between the levels of their states.

Shown in docs/how_to/scenarios.md.

`python -m benchmarks.studies.levels --missions 300` flies the wing, the bracket and the stiffened
panel with damage that grows between levels, at the mean rate of the twin: a little in every step
("creeps"), or in the steps in which the twin's damage grows, by anything up to two levels
("jumps"). The noise is what the twin assumes. A twin whose states stand for intervals
(`observation.between_levels`) is compared with one whose states stand for the levels themselves:
how often 90 % sets hold the level nearest to the truth, how many states they have, the rms error,
and in how many of the first `--watched` missions notices raise an alarm though nothing is wrong.
The exit code is 1 if the coverage of the former lies outside 85 to 95 %.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from benchmarks.studies.level_turns import show
from reporting.progress import SilentProgress
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.gauges.gauge_watch import WatchfulEstimator
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.network.estimator import Carried
from twin_master.network.graphical_model import build_graphical_model
from twin_master.network.inference import ExactFilter
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]
Index = NDArray[np.int64]

NAMES = ("level_turns", "bracket", "stiffened_panel")
TARGET = (0.85, 0.95)
PROBABILITY = 0.9
FINER = 5
"""Intervals between two levels at whose ends the asset is evaluated; linear in between."""
HEADINGS = (
    "scenario",
    "damage",
    "a state stands for",
    "truth in 90 % set",
    "states in it",
    "rms error, points",
    "alarms",
)


@dataclass(frozen=True)
class Study:
    """Missions of one scenario: truth (T, B, F), belief (T, B, S), and the share with alarms."""

    truth: Float
    belief: Float
    levels: tuple[tuple[float, ...], ...]
    alarmed: float

    @property
    def held(self) -> tuple[float, float]:
        """Share of steps whose 90 % set holds the nearest state, and the mean set size."""
        nearest = [
            np.abs(self.truth[..., f, None] - np.array(level)).argmin(axis=-1)
            for f, level in enumerate(self.levels)
        ]
        state = np.ravel_multi_index(nearest, tuple(len(level) for level in self.levels))
        order = np.argsort(-self.belief, axis=-1, kind="stable")
        reached = np.cumsum(np.take_along_axis(self.belief, order, axis=-1), axis=-1)
        size = (reached < PROBABILITY).sum(axis=-1) + 1
        rank = np.argmax(order == state[..., None], axis=-1)
        return float(np.mean(rank < size)), float(size.mean())

    @property
    def rms(self) -> Float:
        """Root mean square error of each factor (F,)."""
        grid = np.stack(
            [axis.ravel() for axis in np.meshgrid(*self.levels, indexing="ij")], axis=-1
        )
        return np.asarray(np.sqrt(np.mean((self.belief @ grid - self.truth) ** 2, axis=(0, 1))))


def grown(
    law: str, probability: Float, factors: int, step: float, random: np.random.Generator
) -> Float:
    """Return the growth of damage (B, F) in a step, at the mean rate of the twin."""
    shape = (len(probability), factors)
    if law == "creeps":
        return random.gamma(2.0, 0.5 * step * probability[:, None], shape)
    return np.where(
        random.random(shape) < probability[:, None], 2.0 * step * random.random(shape), 0.0
    )


def readings(scenario: Scenario, source: AssetSource, mean: float) -> RegularGridInterpolator:
    """Return an interpolator of noise-free readings between the levels: (B, F) -> (B, U, G)."""
    fine = [
        np.interp(
            np.arange(FINER * (len(s.levels) - 1) + 1) / FINER, np.arange(len(s.levels)), s.levels
        )
        for s in scenario.state
    ]
    states = tuple(
        s.model_copy(
            update={"levels": tuple(values.tolist()), "prior": (1.0,) + (0.0,) * (len(values) - 1)}
        )
        for s, values in zip(scenario.state, fine, strict=True)
    )
    # States alone: transitions between so many are not needed.
    still = scenario.transition.model_copy(
        update={"probability": dict.fromkeys(scenario.control_names, 0.0)}
    )
    model = build_graphical_model(
        scenario.model_copy(update={"state": states, "transition": still})
    )
    name = scenario.calibration.parameter
    value = float(getattr(scenario.asset, "parameters", {}).get(name, mean))
    table = source.observation_table(
        ParameterDraws(name, np.array([value]), value, 0.0, "true"), model
    )[0]
    return RegularGridInterpolator(fine, table.reshape(*model.states.shape, *table.shape[1:]))


def fly(
    knowledge: Knowledge, shown: RegularGridInterpolator, law: str, missions: int, watched: int
) -> Study:
    scenario = knowledge.scenario
    sensors = knowledge.sensor_model
    model = knowledge.model
    random = np.random.default_rng(2021)
    levels = tuple(factor.levels for factor in model.states.factors)
    highest = np.array([level[-1] for level in levels])
    spacing = levels[0][1] - levels[0][0]
    probability = np.array([float(p) for p in scenario.transition.probability.values()])  # type: ignore[arg-type]
    control = np.full(missions, scenario.control_names.index(scenario.mission.first_control))
    truth, belief = np.zeros((missions, len(levels))), np.tile(model.prior, (missions, 1))
    estimator = WatchfulEstimator(ExactFilter(model, sensors), sensors, knowledge.draws.values)
    carried: list[Carried | None] = [None] * watched
    alarmed = np.zeros(watched, dtype=bool)
    truths, beliefs = [], []
    for step in range(scenario.mission.steps):
        if step:
            growth = grown(law, probability[control], len(levels), spacing, random)
            truth = np.minimum(truth + growth, highest)
            belief = np.einsum("bi,bij->bj", belief, model.transition.matrix[control])
        observed = shown(truth)[np.arange(missions), control]
        observed = observed + random.standard_normal(observed.shape) * sensors.standard_deviation
        log_belief = np.log(belief.clip(1e-300)) + sensors.log_likelihood_sequence(
            observed, control
        )
        belief = np.exp(log_belief - log_belief.max(axis=1, keepdims=True))
        belief /= belief.sum(axis=1, keepdims=True)
        for b in range(watched):
            estimate = estimator.step(carried[b], observed[b], int(control[b]), step)
            carried[b] = estimate.carried
            alarmed[b] |= any(notice.kind == "alarm" for notice in estimate.notices)
        truths.append(truth)
        beliefs.append(belief)
        control = np.argmax(belief @ knowledge.plan.policy, axis=1)
    return Study(
        np.array(truths), np.array(beliefs), levels, float(alarmed.mean()) if watched else np.nan
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=300)
    parser.add_argument("--watched", type=int, default=60)
    parser.add_argument("--scenario", nargs="+", default=NAMES)
    parser.add_argument("--markdown", action="store_true", help="print the table for a page")
    arguments = parser.parse_args()
    rows: list[list[tuple[str, bool]]] = []
    for name in arguments.scenario:
        resolved = resolve_scenario(load_scenario(name), Overrides())
        source = asset_source(resolved)
        with tempfile.TemporaryDirectory() as folder:
            source.prepare(Path(folder), SilentProgress())
            twins = [
                prepare_knowledge(
                    resolved.model_copy(
                        update={
                            "observation": resolved.observation.model_copy(
                                update={"between_levels": on}
                            )
                        }
                    ),
                    source,
                    resolved.mission.seed,
                )
                for on in (False, True)
            ]
            shown = readings(resolved, source, twins[0].draws.mean)
        for law in ("creeps", "jumps"):
            for knowledge in twins:
                study = fly(
                    knowledge,
                    shown,
                    law,
                    arguments.missions,
                    min(arguments.watched, arguments.missions),
                )
                held, size = study.held
                interval = knowledge.scenario.observation.between_levels
                rows.append(
                    [
                        (name, True),
                        (law, True),
                        ("its interval" if interval else "its level", True),
                        (f"{100 * held:.1f} %", not interval or TARGET[0] <= held <= TARGET[1]),
                        (f"{size:.2f}", True),
                        (", ".join(f"{100 * error:.1f}" for error in study.rms), True),
                        (f"{100 * study.alarmed:.0f} %", True),
                    ]
                )
    show(f"{arguments.missions} missions each", HEADINGS, rows, arguments.markdown)
    return 0 if all(fine for row in rows for _, fine in row) else 1


if __name__ == "__main__":
    sys.exit(main())
