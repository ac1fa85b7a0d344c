"""What teaching in flight is worth; docs/how_to/watch.md shows the figures.

`python -m benchmarks.studies.teaching` flies level_turns with each of several hidden effects in
the FMU, and watches the recorded strains three times: by a twin that is never taught, by one that
is (`uav-twin watch --teach`: alarm, search, trial, adoption), and by one that knew the effect from
the start. Printed are the alarm, the verdicts, the adoption, the rms error of z1 and z2 in points
after the adoption (without one, from step 30 on), and the decisions for 3g there with z1 truly at
or above the limit. The wing with nothing hidden shows what the healthy twin does.
"""

import argparse
import tempfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import uav_twin
from benchmarks.studies.hidden_effects import beyond_the_limit, fly_mission, patch_text
from fe.runtime.patch import (
    LocalStiffnessLoss,
    PointMass,
    Primitive,
    SensorGain,
    SensorSaturation,
    SupportCompliance,
)
from reporting.files import atomic_write_text
from reporting.progress import SilentProgress
from scenarios import scenario_files
from twin_master.feeds.feed_choice import file_feed
from twin_master.mission.journal import JOURNAL_NAME, records
from twin_master.scenario.reading import load_scenario
from twin_master.watch.tutor import Tutor
from twin_master.watch.workflow import begin_watch
from uav_twin.cause_search import DiscrepancySearch

HIDDEN: dict[str, tuple[Primitive, ...]] = {
    "nothing": (),
    "skin from 0.45 to 0.85 m has lost 15 %": (LocalStiffnessLoss(0.15, 0.45, 0.4),),
    "skin from 0.45 to 0.85 m has lost 30 %": (LocalStiffnessLoss(0.3, 0.45, 0.4),),
    "gauge 17 shows 12 % too little": (SensorGain("strain[17]", -0.12),),
    "point mass of 0.2 kg at 1.6 m": (PointMass(0.2, 1.6),),
    "root compliance of 3e-5 rad/(N m)": (SupportCompliance("root", "rx", 3e-5),),
    "all gauges saturate softly at 4000 microstrain": (SensorSaturation("*", 4e-3, "strain"),),
}
STEPS = 50
WITHOUT = 30
"""First step that is compared where nothing was adopted."""


@dataclass(frozen=True)
class Watched:
    """A watch of a mission: mean (T, 2) of z1 and z2, and whether it chose 3g (T,)."""

    mean: NDArray[np.float64]
    sharp: NDArray[np.bool_]
    records: list[dict[str, Any]]


def scenario_of(place: Path, known: tuple[Primitive, ...]) -> Path:
    """Write the scenario of a watch whose twin knows some effects."""
    lines = []
    skipping = False
    for line in scenario_files()["level_turns"].read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            skipping = line.strip("[]").split(".")[0] in ("asset", "truth", "reference")
        if not skipping:
            lines.append(
                line.replace(
                    "standard_deviation_microstrain = 125", "standard_deviation_microstrain = 150"
                )
            )
    text = "\n".join([*lines, "", "[notice]", ""])
    if known:
        file = atomic_write_text(place / "known.json", patch_text(known))
        text = text.replace("[belief]\n", f'[belief]\npatch = "{file.resolve().as_posix()}"\n')
    return atomic_write_text(place / f"watched_{len(known)}.toml", text)


def watched(run: Path, folder: Path, scenario: Path, *, teach: bool) -> Watched:
    """Watch the strains of a run."""
    loaded = load_scenario(scenario)
    with begin_watch(loaded.scenario, loaded.file, folder, SilentProgress()) as watch:
        feed = file_feed(run / "run.nc", watch.scenario)
        if teach:
            with closing(Tutor(watch, DiscrepancySearch(), wait=True)) as tutor:
                watch.run(feed, lambda _decision: None, tutor.teach)
        else:
            watch.run(feed, lambda _decision: None)
    lines = [record for record, *_ in records(folder / JOURNAL_NAME)]
    steps = [record for record in lines if "filtered" in record]
    filtered, chosen = (
        np.array([step[key] for step in steps]) for key in ("filtered", "next_control")
    )
    mean = filtered @ watch.models[0].knowledge.model.states.coordinates
    return Watched(mean, chosen == watch.scenario.control_names.index("3g"), lines)


def said(records: list[dict[str, Any]]) -> tuple[str, int]:
    """Return what happened, and the first step behind the adoption."""
    words = []
    first = WITHOUT
    for record in records:
        if "verdict" in record:
            verdict = record["verdict"]
            words.append(f"{verdict['from_step']} to {verdict['to_step']}: {verdict['kind']}")
        elif "model" in record:
            first = record["step"] + 1
            words.append(f"believed from {record['model']['from_step']} on at {record['step']}")
        else:
            alarm = any(notice["kind"] == "alarm" for notice in record.get("notices", ()))
            words += [f"alarm at {record['step']}"] if alarm else []
    return "; ".join(words) or "no alarm", first


def study(name: str, seed: int, work: Path) -> None:
    """Fly a mission, watch it three times, and print how well its health was known."""
    hidden = HIDDEN[name]
    place = work / f"{[*HIDDEN].index(name)}_{seed}"
    place.mkdir()
    fly_mission(place / "run", seed, hidden, scenario="level_turns", steps=STEPS)
    truth = np.asarray(uav_twin.open_run(place / "run")["truth/state"].values)
    plain = scenario_of(place, ())
    taught = watched(place / "run", place / "taught", plain, teach=True)
    known = hidden
    ways = {
        "never taught": watched(place / "run", place / "never", plain, teach=False),
        "taught": taught,
        "knew": watched(place / "run", place / "knew", scenario_of(place, known), teach=False),
    }
    events, first = said(taught.records)
    errors = {
        way: 100.0 * np.sqrt(np.mean((watch.mean[first:] - truth[first:]) ** 2, axis=0))
        for way, watch in ways.items()
    }
    # What is decided behind a step is in force in the next one.
    decided = {
        way: "{} of {}".format(
            *beyond_the_limit(np.append(False, watch.sharp[first:-1]), truth[first:, 0])
        )
        for way, watch in ways.items()
    }
    figures = ", ".join(
        f"{way} {z1:.2f} {z2:.2f}, {decided[way]}" for way, (z1, z2) in errors.items()
    )
    print(
        f"{name}, seed {seed}: {events}. From step {first} on rms of z1, z2, 3g: {figures}",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=2021)
    parser.add_argument("--only", help="numbers of hidden effects from 0, with commas")
    arguments = parser.parse_args()
    names = (
        [*HIDDEN]
        if arguments.only is None
        else [[*HIDDEN][int(number)] for number in arguments.only.split(",")]
    )
    with tempfile.TemporaryDirectory() as work:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
            for name in names:
                study(name, seed, Path(work))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
