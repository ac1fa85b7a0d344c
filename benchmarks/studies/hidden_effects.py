"""Missions with an effect unknown to the twin; docs/discrepancy_missions.md shows the figures.

`python -m benchmarks.studies.hidden_effects --seeds 5` flies the scenario growing_damage with each
of several hidden effects in the FMU of the wing. The run folder alone is then read as a campaign
and investigated. The named effect, or the most probable member of a group, goes into the twin's
model, and the mission is flown again with the same seed. A drift cannot stand in a table of
predicted strains; there the readings are corrected before the twin sees them, with the temperature
that the run recorded. Printed are the verdict of each mission and, before and after: the rms error
of the health estimate in points, the share of turns whose 90 % set of states holds the truth, and
the turns at 3g with z1 truly at or above the limit. The table compares the missions that were
flown again.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.studies.wing_in_air import depends_on_temperature, scenario_in_air
from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.sources.from_run import run_campaign, run_model
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import (
    InertiaRelief,
    LocalStiffnessLoss,
    ModelPatch,
    PointMass,
    Primitive,
    SensorDrift,
    SensorGain,
    ThermalStrain,
    Washout,
)
from fmu_asset.packing.patch_file import SCHEMA
from reporting.files import atomic_write_text
from reporting.progress import SilentProgress
from scenarios import scenario_files
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.resolution import (
    Overrides,
    asset_source,
    resolve_scenario,
)
from twin_master.fleet.store import in_credible_set
from twin_master.mission.loop import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.run_folder import create_run_folder
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import groups_of
from twin_master.store.writing import write_run

TURNS = 50
LIMIT = 0.6 - 1e-9
"""z1 from which on the policy of the wing without an effect leaves 3g."""


@dataclass(frozen=True)
class Hidden:
    """An effect that a mission hides.

    Attributes
    ----------
    identifier : str
        Of the catalogue; empty: nothing is hidden.
    place : str
        Channel that it acts on; empty where there is no choice.
    primitives : tuple of Primitive
        What the FMU carries.
    text : str
        For people.
    """

    identifier: str
    place: str
    primitives: tuple[Primitive, ...]
    text: str


HIDDEN = (
    Hidden("", "", (), "nothing"),
    Hidden(
        "gauge_zero_drift",
        "g17",
        (SensorDrift("strain[17]", -8e-4, float(TURNS)),),
        "gauge 17 drifts to -800 microstrain",
    ),
    Hidden(
        "gauge_gain", "g17", (SensorGain("strain[17]", -0.12),), "gauge 17 shows 12 % too little"
    ),
    Hidden("washout", "", (Washout(0.08, 1.0),), "washout of 8 % per g at the tip"),
    Hidden(
        "local_stiffness_loss",
        "",
        (LocalStiffnessLoss(0.15, 0.45, 0.4),),
        "skin from 0.45 to 0.85 m has lost 15 %",
    ),
    Hidden(
        "thermal_strain",
        "*",
        (ThermalStrain("*", 15e-6),),
        "all gauges show 15 microstrain/K, swing of 20 K",
    ),
    Hidden(
        "inertia_relief",
        "",
        (InertiaRelief(0.25),),
        "structure's weight relieves the lift by 25 % more",
    ),
    Hidden("point_mass", "", (PointMass(0.2, 2.0),), "0.2 kg at 2 m"),
    Hidden("point_mass", "", (PointMass(0.5, 2.0),), "0.5 kg at 2 m"),
)


@dataclass(frozen=True)
class Flown:
    """How well a twin knew its wing in one mission.

    Attributes
    ----------
    rms : (2,) ndarray
        Of the mean of z1, z2 less the truth [1].
    coverage : float
        Share of turns whose 90 % set of states holds the truth.
    decided : (2,) ndarray
        Turns flown at 3g with z1 truly at or above the limit, behind the first of them, and turns
        beyond it.
    """

    rms: NDArray[np.float64]
    coverage: float
    decided: NDArray[np.int64]


@dataclass(frozen=True)
class Case:
    """One mission with one hidden effect."""

    hidden: Hidden
    seed: int
    verdict: Verdict
    before: Flown
    after: Flown | None
    seconds: float


def patch_text(primitives: Sequence[Primitive], channels: dict[str, str] | None = None) -> str:
    """Return a patch file of one effect."""
    effects = [{"id": "hidden", "primitives": ModelPatch(tuple(primitives)).to_list()}]
    return json.dumps({"schema": SCHEMA, "effects": effects, "channels": channels or {}})


def fly_mission(
    folder: Path,
    seed: int,
    hidden: Sequence[Primitive] = (),
    known: Sequence[Primitive] = (),
    scenario: str = "growing_damage",
    turns: int = TURNS,
    draws: int = 100,
) -> Flown:
    """Fly a mission into a run folder, without its report.

    Parameters
    ----------
    folder : Path
        Made; the scenario is written beside it.
    seed : int
        Of the run.
    hidden : sequence of Primitive
        What the wing has and its readings show; channels are outputs of the FMU.
    known : sequence of Primitive
        What the twin's model has.
    scenario : str
        A shipped one.
    turns : int
        Length of the mission.
    draws : int
        Of the calibrated parameter.
    """
    lines = {}
    for name, primitives in (("asset", hidden), ("belief", known)):
        if primitives and not depends_on_temperature(hidden):
            file = atomic_write_text(
                folder.with_name(f"{folder.name}_{name}.json"), patch_text(primitives)
            )
            lines[name] = f'patch = "{file.name}"\n'
    text = scenario_files()[scenario].read_text(encoding="utf-8")
    text = text.replace("steps = 50", f"steps = {turns}", 1)
    text = text.replace("draws = 100", f"draws = {draws}", 1)
    if depends_on_temperature(hidden):
        text = scenario_in_air(text, folder.parent, f"{folder.name}_wing", patch_text(hidden))
    else:
        for name, line in lines.items():
            text = text.replace(f"[{name}]\n", f"[{name}]\n{line}", 1)
    loaded = load_scenario(atomic_write_text(folder.with_name(f"{folder.name}.toml"), text))
    resolved = resolve_scenario(loaded, Overrides(seed=seed, in_process=True))
    source = asset_source(resolved)
    source.check()
    portable = resolved.portable()
    config = {
        "kind": "uav-twin run",
        "format": 1,
        "scenario": portable.to_dict(),
        "scenario_file": {"name": loaded.path.name, "sha256": loaded.content_hash},
    }
    with create_run_folder(folder, config, source.files()):
        pass
    source.prepare(folder, SilentProgress())
    return _fly(folder, portable.moved(folder), source, seed)


def _fly(folder: Path, scenario: Scenario, source: AssetSource, seed: int) -> Flown:
    knowledge = prepare_knowledge(scenario, source, seed)
    truth = knowledge.truth(seed)
    asset = source.open()
    try:
        flight = fly(scenario, knowledge.twin(), knowledge.plant(truth, asset))
        units = asset.units
    finally:
        asset.close()
    result = MissionResult(scenario, knowledge, flight, truth, units)
    attributes = {
        "title": scenario.mission.title,
        "scenario": scenario.mission.name,
        "seed": seed,
        "parameter": knowledge.draws.name,
    }
    write_run(folder, groups_of(result), attributes)
    state = flight.state
    error = flight.filtered @ knowledge.model.states.coordinates - state
    held = in_credible_set(knowledge.model, flight.filtered, state, 0.9)
    sharp = flight.control_index == scenario.control_names.index("3g")
    return Flown(
        np.sqrt(np.mean(error**2, axis=0)),
        float(np.mean(held)),
        beyond_the_limit(sharp, state[:, 0]),
    )


def beyond_the_limit(sharp: NDArray[np.bool_], z1: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the turns at 3g with z1 at or above the limit, and all such turns.

    The first of them is left out: its control was decided before.
    """
    beyond = (z1 >= LIMIT)[:-1]
    return np.array([np.sum(beyond & sharp[1:]), np.sum(beyond)])


def outputs_of(patch: ModelPatch) -> tuple[Primitive, ...]:
    """Return primitives whose channels g1, g2, ... are renamed to FMU outputs strain[1], ..."""
    found = []
    for item in patch:
        channel = getattr(item, "channel", "")
        if channel.startswith("g"):
            item = replace(item, channel=f"strain[{channel[1:]}]")  # type: ignore[call-arg]
        found.append(item)
    return tuple(found)


def undone(item: Primitive) -> Primitive | None:
    """Return a correction of readings for an effect that drifts with time; None for others."""
    if isinstance(item, SensorDrift):
        return replace(item, amplitude=-item.amplitude)
    if isinstance(item, ThermalStrain):
        return replace(item, coefficient=-item.coefficient)
    return None


def investigated(folder: Path, seed: int, effects: Sequence[Effect] | None = None) -> Verdict:
    """Return the verdict on the run in a folder, by the whole catalogue or some of its effects."""
    return investigate(
        run_campaign(folder), run_model(folder)[0], effects, seed=seed, thorough=False
    ).verdict


def believed(verdict: Verdict) -> tuple[NamedEffect, ...]:
    """Return the effects for the twin: those named, or the most probable member of a group."""
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY):
        return verdict.effects
    if verdict.kind is VerdictKind.GROUP and verdict.hypotheses:
        return verdict.hypotheses[0].effects
    return ()


def study(
    hidden: Hidden,
    seed: int,
    work: Path,
    turns: int = TURNS,
    effects: Sequence[Effect] | None = None,
    again: bool = True,
) -> Case:
    """Fly with a hidden effect, find it, and fly again with what was found if that is asked for."""
    began = perf_counter()
    place = work / f"{HIDDEN.index(hidden)}_{seed}"
    before = fly_mission(
        place.with_name(place.name + "_before"), seed, hidden.primitives, turns=turns
    )
    verdict = investigated(place.with_name(place.name + "_before"), seed, effects)
    after = None
    chosen = believed(verdict)
    if chosen and again:
        found = outputs_of(sum((effect.patch for effect in chosen), ModelPatch()))
        corrections = tuple(item for item in map(undone, found) if item is not None)
        known = tuple(item for item in found if undone(item) is None)
        after = fly_mission(
            place.with_name(place.name + "_after"),
            seed,
            (*hidden.primitives, *corrections),
            known,
            turns=turns,
        )
    return Case(hidden, seed, verdict, before, after, perf_counter() - began)


def outcome(hidden: Hidden, verdict: Verdict) -> str:
    """Return "named", "in the group", "wrong" if another is named, or the kind of the verdict."""
    if not hidden.identifier:
        return "none" if verdict.kind is VerdictKind.NOTHING_MISSING else verdict.kind.value
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY):
        names = [(effect.identifier, effect.place) for effect in verdict.effects]
        return "named" if names == [(hidden.identifier, hidden.place)] else f"wrong: {names}"
    if verdict.kind is VerdictKind.GROUP:
        return (
            "in the group"
            if hidden.identifier in verdict.group
            else f"wrong group: {verdict.group}"
        )
    return verdict.kind.value


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=2021)
    parser.add_argument("--only", help="identifiers of hidden effects, with commas")
    parser.add_argument("--turns", type=int, default=TURNS)
    parser.add_argument("--once", action="store_true", help="do not fly again with what was found")
    parser.add_argument(
        "--catalogue", help="identifiers of effects that are looked for, with commas"
    )
    arguments = parser.parse_args()
    effects = [
        effect_by_identifier(item, library())
        for item in (arguments.catalogue or "").split(",")
        if item
    ]
    console = Console(width=150)
    heads = ("rms z1, z2 {}", "90 % sets", "3g beyond the limit")
    table = Table(
        "hidden", "verdicts", *(head.format(when) for when in ("before", "after") for head in heads)
    )
    chosen = [
        item
        for item in HIDDEN
        if arguments.only is None or item.identifier in arguments.only.split(",")
    ]
    with tempfile.TemporaryDirectory() as folder:
        for hidden in chosen:
            cases = []
            for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
                case = study(
                    hidden, seed, Path(folder), arguments.turns, effects or None, not arguments.once
                )
                cases.append(case)
                after = (
                    ""
                    if case.after is None
                    else f"{100 * case.after.rms} {case.after.coverage:.2f} {case.after.decided}"
                )
                console.print(
                    f"{hidden.text}, seed {seed}: {case.verdict.kind.value}: "
                    f"{case.verdict.sentence} rms {100 * case.before.rms} "
                    f"{case.before.coverage:.2f} {case.before.decided}; "
                    f"after {after} ({case.seconds:.1f} s)"
                )
            table.add_row(*_row(hidden, cases))
    console.print(table)
    return 0


def _row(hidden: Hidden, cases: Sequence[Case]) -> tuple[str, ...]:
    counts = Counter(outcome(hidden, case.verdict) for case in cases)
    again = [case for case in cases if case.after is not None]
    before, after = (
        [case.before for case in again or cases],
        [case.after for case in again if case.after],
    )
    verdicts = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    return (hidden.text, verdicts, *_shown(before), *_shown(after))


def _shown(flown: Sequence[Flown]) -> tuple[str, str, str]:
    if not flown:
        return "", "", ""
    values = 100.0 * np.sqrt(np.mean([item.rms**2 for item in flown], axis=0))
    sharp, beyond = np.sum([item.decided for item in flown], axis=0)
    coverage = np.mean([item.coverage for item in flown])
    return f"{values[0]:.1f}, {values[1]:.1f} points", f"{coverage:.2f}", f"{sharp} of {beyond}"


if __name__ == "__main__":
    raise SystemExit(main())
