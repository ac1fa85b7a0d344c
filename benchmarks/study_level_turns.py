"""How reliably the twin steers: the paper's mission under many seeds.

`python -m benchmarks.study_level_turns --missions 300` flies the reduced model of the shipped wing;
`--strain-library FOLDER` flies the authors' library instead, `--fmu` the FMU in a worker process.
Exit code 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from reporting.progress import RichProgress
from twin_master.asset_source import AssetSource, ReducedModelSource
from twin_master.resolution import Overrides, asset_source, resolve_scenario
from twin_master.scenario_file import load_scenario
from twin_master.study import Study, fly_many


def interval(share: float, missions: int) -> str:
    """Return a share with its standard error, in percent."""
    return f"{100 * share:.1f} ± {100 * np.sqrt(share * (1 - share) / missions):.1f} %"


def table_of(study: Study, states: tuple[str, ...]) -> tuple[Table, bool]:
    missions = len(study.seeds)
    rms = 100.0 * study.rms_error
    rows = [
        ("fallback within 2 steps", interval(study.share_within(2), missions), ">= 98 %",
         study.share_within(2) >= 0.98),
        ("2g before the damage", interval(study.early_share, missions), "<= 8 %", study.early_share <= 0.08),
    ]  # fmt: skip
    for name, value, target in zip(states, rms, (4.5, 13.0), strict=True):
        rows.append(
            (f"filtered rms error of {name}", f"{value:.2f} points", f"<= {target} points", value <= target)
        )
    table = Table("figure", "found", "wanted", "reached", title=f"{missions} missions")
    for name, found, wanted, reached in rows:
        table.add_row(name, found, wanted, "yes" if reached else "NO")
    return table, all(row[3] for row in rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=300)
    parser.add_argument("--first-seed", type=int, help="by default the seed of the scenario")
    parser.add_argument("--strain-library", type=Path)
    parser.add_argument("--fmu", action="store_true", help="fly the FMU in a worker process")
    parser.add_argument("--decide-on", choices=("filtered", "predicted"), help="instead of the scenario's")
    given = parser.parse_args()
    scenario = resolve_scenario(load_scenario("level_turns"), Overrides(strain_library=given.strain_library))
    if given.decide_on:
        planner = scenario.planner.model_copy(update={"decide_on": given.decide_on})
        scenario = scenario.model_copy(update={"planner": planner})
    with tempfile.TemporaryDirectory() as folder:
        if given.strain_library or given.fmu:
            source: AssetSource = asset_source(scenario)
        else:
            from fe.cache import reduced_model
            from fe.design import load_design

            source = ReducedModelSource(scenario, reduced_model(load_design(), progress=RichProgress()))
        source.prepare(Path(folder), RichProgress())
        first = scenario.mission.seed if given.first_seed is None else given.first_seed
        begin = time.perf_counter()
        study = fly_many(scenario, source, range(first, first + given.missions), calibration_seed=first)
        seconds = time.perf_counter() - begin
    table, reached = table_of(study, scenario.state_names)
    console = Console()
    console.print(table)
    console.print(f"seeds {first} to {study.seeds[-1]}, {seconds:.1f} s")
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())
