"""How reliably the twin steers the paper's mission.

Shown in docs/explanation/benchmarks.md.

`python -m benchmarks.studies.level_turns --missions 300` flies the reduced model of the shipped
wing under many seeds; `--strain-library FOLDER` flies the authors' library instead, `--fmu` the
FMU in a worker process. The true Young's modulus factor is the mean of the calibration;
`--draw-factor` gives every mission a wing of its own, with one of the twin's draws.
`--combinations --strain-library FOLDER` flies all four combinations of asset and twin's model,
without and with a model error in the assumed noise, and prints what the misfit of the models does;
`--markdown` prints the tables for a page. The exit code is 1 if a target is missed.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.studies.misfit import Misfit, find_misfit
from benchmarks.studies.seeds import fly_seeds, outcomes
from fe.runtime.reduced import ReducedModel
from reporting.progress import RichProgress
from twin_master.assets.asset_source import AssetSource, PairedSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.strain_library_source import StrainLibrarySource, load_strain_library
from twin_master.fleet.outcomes import Estimated, Outcomes
from twin_master.mission.flights import fly_side_by_side
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]

WITHIN_TARGET, EARLY_TARGET = 0.98, 0.08
RMS_TARGETS = (0.045, 0.13)
MISFIT = "misfit"
"""The model error of each gauge is the misfit between the two models there."""
SCALED = "scaled"
"""No model error, but predictions that are right for the undamaged wing, gauge by gauge."""
LABELS = {"0": "none", MISFIT: "misfit of each gauge", SCALED: "none, gauges scaled"}
SHOWN = 6
"""Gauges that are shown one by one."""


class ScaledSource(PairedSource):
    """A twin whose predictions are scaled by gauge to the readings of the undamaged asset."""

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the scaled predictions (E, S, U, G)."""
        table = super().observation_table(draws, model)
        controls = load_scenario("paper_level_turns").scenario.control
        undamaged = dict(zip(model.states.names, model.states.coordinates[0].tolist(), strict=True))
        readings = self.open().step(controls[-1].values, undamaged).values
        return np.asarray(table * (readings / table[:, 0, -1].mean(axis=0)))


@dataclass(frozen=True)
class Row:
    """One study with what was flown in it."""

    asset: str
    twin: str
    model_error: str
    first_seed: int
    study: Outcomes

    def cells(self) -> list[tuple[str, bool]]:
        """Return the figures as printed, each with whether it reaches its target."""
        study = self.study
        within, early = study.prompt_fallbacks, study.early_fallbacks
        cells = [
            (percent(within), within.value >= WITHIN_TARGET),
            (percent(early), early.value <= EARLY_TARGET),
        ]
        cells += [
            (points(study.rms[factor]), study.rms[factor].value <= target)
            for factor, target in enumerate(RMS_TARGETS)
        ]
        cells += [(signed(study.bias[factor]), True) for factor in range(len(RMS_TARGETS))]
        evidence = study.log_evidence
        cells.append((f"{evidence.value:.2f} ± {evidence.error:.2f}", True))
        cells.append((percent(study.credible_coverage), True))
        return cells


HEADINGS = (
    "asset",
    "twin's model",
    "model error",
    "first seed",
    "2g within 2 steps",
    "early 2g",
    "rms z1, points",
    "rms z2, points",
    "bias z1, points",
    "bias z2, points",
    "log evidence per step",
    "true state in 90 % set",
)


def percent(figure: Estimated) -> str:
    return f"{100 * figure.value:.1f} ± {100 * figure.error:.1f} %"


def points(figure: Estimated) -> str:
    return f"{100 * figure.value:.2f} ± {100 * figure.error:.2f}"


def signed(figure: Estimated) -> str:
    return f"{100 * figure.value:+.1f} ± {100 * figure.error:.1f}"


def show(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[tuple[str, bool]]], page: bool
) -> None:
    """Print a table for the terminal or for a page; figures that miss their target stand out."""
    if page:
        print(f"| {' | '.join(headings)} |\n|{' --- |' * len(headings)}")
        for row in rows:
            print(f"| {' | '.join(text if fine else f'**{text}**' for text, fine in row)} |")
        print()
        return
    table = Table(*headings, title=title)
    for row in rows:
        table.add_row(*(text if fine else f"[red]{text}[/red]" for text, fine in row))
    Console(width=None if sys.stdout.isatty() else 240).print(table)


def with_model_error(scenario: Scenario, error: float | tuple[float, ...]) -> Scenario:
    observation = scenario.observation.model_copy(update={"model_error": error})
    return scenario.model_copy(update={"observation": observation})


def misfit_rows(
    misfit: Misfit, control: int, states: Sequence[int]
) -> list[list[tuple[str, bool]]]:
    """Return the gauges that move the estimate most, the sum of the others, and the sum of all."""
    bias = 100.0 * misfit.bias_per_sensor[states, control]  # (states, F, G), points
    relative = 100.0 * misfit.relative[states, control]
    order = np.argsort(-np.abs(bias).max(axis=(0, 1)))

    def row(name: str, rms: float, gauges: NDArray[np.int64]) -> list[tuple[str, bool]]:
        cells = [name, f"{100 * rms:.1f} %"]
        for state in range(len(states)):
            cells.append(f"{relative[state, gauges[0]]:+.1f} %" if len(gauges) == 1 else "")
            cells += [f"{value:+.1f}" for value in bias[state][:, gauges].sum(axis=-1)]
        return [(cell, True) for cell in cells]

    def rms(gauges: NDArray[np.int64]) -> float:
        return float(np.sqrt(np.mean(misfit.per_sensor[gauges] ** 2)))

    rows = [
        row(f"{gauge + 1}", misfit.per_sensor[gauge], np.array([gauge])) for gauge in order[:SHOWN]
    ]
    other_gauges = order[SHOWN:]
    return [
        *rows,
        row("the others", rms(other_gauges), other_gauges),
        row("all", rms(order), order),
    ]


def show_misfit(
    scenario: Scenario, wing: AssetSource, library: AssetSource, seed: int, page: bool
) -> Misfit:
    """Print what the library's strains do to a twin that believes the wing's model."""
    knowledge = prepare_knowledge(scenario, wing, seed)
    misfit = find_misfit(scenario, knowledge.model, knowledge.sensor_model, library.open())
    places = ((0.0, 0.0), (0.4, 0.6))
    headings = ["gauge", "rms misfit"]
    for z1, z2 in places:
        headings.append(f"misfit at z1 {100 * z1:.0f} %, z2 {100 * z2:.0f} %")
        headings += ["bias of z1, points", "bias of z2, points"]
    control = scenario.control_names.index(scenario.mission.first_control)
    title = (
        "our model less the library, "
        "and what each gauge adds to the estimate of one step (linearised)"
    )
    states = [knowledge.model.states.index(place) for place in places]
    show(title, headings, misfit_rows(misfit, control, states), page)
    return misfit


def combinations(given: argparse.Namespace, scenario: Scenario, seeds: Sequence[int]) -> list[Row]:
    """Fly the four combinations of asset and twin's model."""
    from fe.reduction.model_cache import reduced_model
    from fe.wing.design import load_design

    wing_model = reduced_model(load_design(), progress=RichProgress())
    library_file = resolve_scenario(
        load_scenario("paper_level_turns"), Overrides(strain_library=given.strain_library)
    )

    def sources(chosen: Scenario) -> dict[str, AssetSource]:
        flown = {"asset": library_file.asset, "belief": library_file.belief}
        library = asset_source(chosen.model_copy(update=flown))
        return {"our wing": ReducedModelSource(chosen, wing_model), "library": library}

    asset_sources = sources(scenario)
    misfit = show_misfit(
        scenario, asset_sources["our wing"], asset_sources["library"], seeds[0], given.markdown
    )
    rows = []
    for first in seeds:
        flown = range(first, first + given.missions)
        for name in given.model_error:
            error = model_error(name, misfit)
            chosen = with_model_error(scenario, error)
            believed_sources = sources(chosen)
            for asset, twin in product(believed_sources, believed_sources):
                if name == SCALED and asset == twin:
                    continue
                kind = ScaledSource if name == SCALED else PairedSource
                source = (
                    believed_sources[asset]
                    if asset == twin
                    else kind(believed_sources[asset], believed_sources[twin])
                )
                study = fly_seeds(chosen, source, flown, calibration_seed=first)
                rows.append(
                    Row(asset, twin, LABELS.get(name) or f"{float(name):g} %", first, study)
                )
    return rows


def model_error(name: str, misfit: Misfit) -> float | tuple[float, ...]:
    """Return the model error of a name on the command line, a fraction."""
    if name == MISFIT:
        return tuple(misfit.per_sensor.tolist())
    return 0.0 if name == SCALED else float(name) / 100.0


def fly_own_wings(
    scenario: Scenario,
    source: AssetSource,
    wing: Callable[[ParameterDraws, int], AssetSource],
    seeds: range,
) -> Outcomes:
    """Fly each mission with a wing whose factor is drawn uniformly from the twin's draws."""
    knowledge = prepare_knowledge(scenario, source, seeds[0])
    chosen = np.random.default_rng(seeds[0]).integers(len(knowledge.draws.values), size=len(seeds))
    assets = [wing(knowledge.draws, index).open() for index in chosen.tolist()]
    truths = [knowledge.truth(seed) for seed in seeds]
    return outcomes(knowledge, fly_side_by_side(knowledge, truths, assets))


def library_wings(scenario: Scenario, folder: Path) -> Callable[[ParameterDraws, int], AssetSource]:
    """Return what gives the authors' wing with one of their samples of the factor."""
    library = load_strain_library(folder)
    return lambda draws, index: StrainLibrarySource(
        scenario, replace(library, strain=library.strain_per_draw[index])
    )


def model_wings(
    scenario: Scenario, wing: ReducedModel
) -> Callable[[ParameterDraws, int], AssetSource]:
    """Return what gives our wing with one of the twin's draws of the factor."""
    return lambda draws, index: ReducedModelSource(
        scenario.model_copy(
            update={
                "asset": scenario.asset.model_copy(
                    update={"parameters": {draws.name: float(draws.values[index])}}
                )
            }
        ),
        wing,
    )


def single(given: argparse.Namespace, scenario: Scenario, seeds: Sequence[int]) -> list[Row]:
    """Fly one asset that the twin knows."""
    with tempfile.TemporaryDirectory() as folder:
        wings: Callable[[ParameterDraws, int], AssetSource] | None = None
        if given.strain_library or given.fmu:
            source: AssetSource = asset_source(scenario)
            if given.draw_factor:
                wings = library_wings(scenario, given.strain_library)
        else:
            from fe.reduction.model_cache import reduced_model
            from fe.wing.design import load_design

            wing = reduced_model(load_design(), progress=RichProgress())
            source = ReducedModelSource(scenario, wing)
            if given.draw_factor:
                wings = model_wings(scenario, wing)
        source.prepare(Path(folder), RichProgress())
        name = "library" if given.strain_library else "our wing, FMU" if given.fmu else "our wing"
        asset = f"{name}, e drawn" if given.draw_factor else name
        error = scenario.observation.model_error
        label = "none" if error == 0.0 else f"{100 * float(np.max(error)):g} %"
        rows = []
        for first in seeds:
            missions = range(first, first + given.missions)
            study = (
                fly_seeds(scenario, source, missions, calibration_seed=first)
                if wings is None
                else fly_own_wings(scenario, source, wings, missions)
            )
            rows.append(Row(asset, name, label, first, study))
        return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=300)
    parser.add_argument(
        "--first-seed", type=int, nargs="+", help="by default the seed of the scenario"
    )
    parser.add_argument("--strain-library", type=Path)
    parser.add_argument("--fmu", action="store_true", help="fly the FMU in a worker process")
    parser.add_argument(
        "--draw-factor",
        action="store_true",
        help="each mission flies a wing with one of the twin's draws of Young's modulus factor, "
        "not the mean",
    )
    parser.add_argument(
        "--decide-on", choices=("filtered", "predicted"), help="instead of the scenario's"
    )
    parser.add_argument(
        "--combinations",
        action="store_true",
        help="fly our wing and the library, each by both twins",
    )
    parser.add_argument(
        "--model-error",
        nargs="+",
        metavar="PERCENT",
        help="model errors in the assumed noise, in percent of the prediction, "
        f"`{MISFIT}` for the misfit of each gauge, or `{SCALED}` for none and predictions "
        "that are right for the undamaged wing; with "
        f"--combinations by default 0, 3, {MISFIT} and {SCALED}",
    )
    parser.add_argument(
        "--at-levels",
        action="store_true",
        help="a twin that takes damage to be at levels, as the paper's",
    )
    parser.add_argument("--markdown", action="store_true", help="print the tables for a page")
    arguments = parser.parse_args()
    if arguments.combinations and (arguments.strain_library is None or arguments.fmu):
        parser.error("--combinations needs --strain-library, and flies no FMU")
    if arguments.draw_factor and (arguments.combinations or arguments.fmu):
        parser.error("--draw-factor goes neither with --combinations nor with --fmu")
    arguments.model_error = arguments.model_error or (
        ["0", "3", MISFIT, SCALED] if arguments.combinations else ["0"]
    )
    for name in arguments.model_error:
        if (
            not (name in (MISFIT, SCALED) and arguments.combinations)
            and not name.replace(".", "", 1).isdigit()
        ):
            parser.error(
                f"--model-error must be a number of percent, or, with --combinations, {MISFIT} or "
                f"{SCALED}, and {name} came"
            )
    library = None if arguments.combinations else arguments.strain_library
    name = "paper_level_turns" if arguments.at_levels else "level_turns"
    scenario = resolve_scenario(load_scenario(name), Overrides(strain_library=library))
    if arguments.decide_on:
        planner = scenario.planner.model_copy(update={"decide_on": arguments.decide_on})
        scenario = scenario.model_copy(update={"planner": planner})
    seeds = arguments.first_seed or [scenario.mission.seed]
    begin = time.perf_counter()
    if arguments.combinations:
        rows = combinations(arguments, scenario, seeds)
    else:
        rows = [
            row
            for name in arguments.model_error
            for row in single(arguments, with_model_error(scenario, float(name) / 100.0), seeds)
        ]
    seconds = time.perf_counter() - begin
    table = [
        [
            *((text, True) for text in (row.asset, row.twin, row.model_error, str(row.first_seed))),
            *row.cells(),
        ]
        for row in rows
    ]
    show(
        f"{arguments.missions} missions each, ± one standard error",
        HEADINGS,
        table,
        arguments.markdown,
    )
    print(
        "targets of 300 missions: 2g within 2 steps >= 98 %, early 2g <= 8 %, "
        "rms <= 4.5 and 13 points; "
        f"{arguments.missions} missions each, {seconds:.1f} s"
    )
    return 0 if all(fine for row in rows for _, fine in row.cells()) else 1


if __name__ == "__main__":
    sys.exit(main())
