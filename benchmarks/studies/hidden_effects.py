"""Missions with an effect unknown to the twin.

Shown in docs/explanation/discrepancy_missions.md.

`python -m benchmarks.studies.hidden_effects --seeds 5` flies the scenario growing_damage with each
of several hidden effects in the FMU of the wing. The run folder alone is then read as a campaign
and investigated. The named effect, or the most probable member of a group, goes into the twin's
model, and the mission is flown again with the same seed. A drift cannot stand in a table of
predicted strains; there the readings are corrected before the twin sees them, with the temperature
that the run recorded. Printed are the verdict of each mission and, before and after: the rms error
of the health estimate in points, the share of steps whose 90 % set of states holds the truth, and
the steps at 3g with z1 truly at or above the limit. The table compares the missions that were
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
from twin_master.fleet.storage.store import in_credible_set
from twin_master.mission.flights import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.run_folder import create_run_folder
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import run_groups
from twin_master.store.writing import write_run

STEPS = 50
LIMIT = 0.6 - 1e-9
"""z1 from which on the policy of the wing without an effect leaves 3g."""


@dataclass(frozen=True)
class MissionEffect:
    """An effect that a mission hides.

    Attributes
    ----------
    identifier : str
        Identifier in the catalogue; empty if nothing is hidden.
    place : str
        Channel that the effect acts on; empty where there is no choice.
    primitives : tuple of Primitive
        Primitives in the FMU of the wing.
    text : str
        Description for the table.
    """

    identifier: str
    place: str
    primitives: tuple[Primitive, ...]
    text: str


HIDDEN: tuple[MissionEffect, ...] = (
    MissionEffect("", "", (), "nothing"),
    MissionEffect(
        "gauge_zero_drift",
        "g17",
        (SensorDrift("strain[17]", -8e-4, float(STEPS)),),
        "gauge 17 drifts to -800 microstrain",
    ),
    MissionEffect(
        "gauge_gain", "g17", (SensorGain("strain[17]", -0.12),), "gauge 17 shows 12 % too little"
    ),
    MissionEffect("washout", "", (Washout(0.08, 1.0),), "washout of 8 % per g at the tip"),
    MissionEffect(
        "local_stiffness_loss",
        "",
        (LocalStiffnessLoss(0.15, 0.45, 0.4),),
        "skin from 0.45 to 0.85 m has lost 15 %",
    ),
    MissionEffect(
        "thermal_strain",
        "*",
        (ThermalStrain("*", 15e-6),),
        "all gauges show 15 microstrain/K, swing of 20 K",
    ),
    MissionEffect(
        "inertia_relief",
        "",
        (InertiaRelief(0.25),),
        "structure's weight relieves the lift by 25 % more",
    ),
    MissionEffect("point_mass", "", (PointMass(0.2, 2.0),), "0.2 kg at 2 m"),
    MissionEffect("point_mass", "", (PointMass(0.5, 2.0),), "0.5 kg at 2 m"),
)


@dataclass(frozen=True)
class MissionErrors:
    """Errors and decisions of a twin in one mission.

    Attributes
    ----------
    rms : (2,) array
        Rms error of the mean of z1 and z2 [1].
    coverage : float
        Share of steps whose 90 % set of states holds the truth.
    sharp_beyond, beyond : int
        Steps at 3g with z1 truly at or above the limit, and all steps with z1 there.
    """

    rms: NDArray[np.float64]
    coverage: float
    sharp_beyond: int
    beyond: int

    def __str__(self) -> str:
        """Return the errors for a line of the study."""
        return f"{100 * self.rms} {self.coverage:.2f} [{self.sharp_beyond} {self.beyond}]"


@dataclass(frozen=True)
class Case:
    """A hidden effect, the verdict on its mission, and the errors before and after its adoption.

    Attributes
    ----------
    hidden : MissionEffect
        The hidden effect.
    seed : int
        Seed of the mission.
    verdict : Verdict
        Verdict on the run.
    before, after : MissionErrors
        Errors without and with the named effect in the twin's model; `after` is None if nothing
        was named.
    seconds : float
        Time of missions and search [s].
    """

    hidden: MissionEffect
    seed: int
    verdict: Verdict
    before: MissionErrors
    after: MissionErrors | None
    seconds: float


def patch_text(primitives: Sequence[Primitive], channels: dict[str, str] | None = None) -> str:
    """Return a patch file of one effect."""
    effects = [{"id": "hidden", "primitives": ModelPatch(tuple(primitives)).to_list()}]
    return json.dumps({"schema": SCHEMA, "effects": effects, "channels": channels or {}})


def scenario_text(
    folder: Path,
    hidden: Sequence[Primitive],
    known: Sequence[Primitive],
    scenario: str,
    steps: int,
    draws: int,
) -> str:
    """Return a shipped scenario with patches of asset and belief; see `fly_mission`."""
    text = scenario_files()[scenario].read_text(encoding="utf-8")
    text = text.replace("steps = 50", f"steps = {steps}", 1)
    text = text.replace("draws = 100", f"draws = {draws}", 1)
    if depends_on_temperature(hidden):
        return scenario_in_air(text, folder.parent, f"{folder.name}_wing", patch_text(hidden))
    for table, primitives in (("asset", hidden), ("belief", known)):
        if primitives:
            patch = folder.with_name(f"{folder.name}_{table}.json")
            file = atomic_write_text(patch, patch_text(primitives))
            text = text.replace(f"[{table}]\n", f'[{table}]\npatch = "{file.name}"\n', 1)
    return text


def fly_mission(
    folder: Path,
    seed: int,
    hidden: Sequence[Primitive] = (),
    known: Sequence[Primitive] = (),
    scenario: str = "growing_damage",
    steps: int = STEPS,
    draws: int = 100,
) -> MissionErrors:
    """Fly a mission into a run folder, without its report.

    Parameters
    ----------
    folder : Path
        Run folder to make; the scenario is written beside it.
    seed : int
        Seed of the run.
    hidden : sequence of Primitive
        Effects of the wing and its readings; channels are outputs of the FMU.
    known : sequence of Primitive
        Effects in the twin's model.
    scenario : str
        Name of a shipped scenario.
    steps : int
        Length of the mission.
    draws : int
        Draws of the calibrated parameter.
    """
    text = scenario_text(folder, hidden, known, scenario, steps, draws)
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
    return _fly(folder, portable.with_paths_from(folder), source, seed)


def _fly(folder: Path, scenario: Scenario, source: AssetSource, seed: int) -> MissionErrors:
    """Fly a prepared mission, store its run in a folder, and return the errors of the twin."""
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
    write_run(folder, run_groups(result), attributes)
    error = flight.filtered @ knowledge.model.states.coordinates - flight.state
    is_covered = in_credible_set(knowledge.model, flight.filtered, flight.state, 0.9)
    is_sharp = flight.control_index == scenario.control_names.index("3g")
    sharp_beyond, beyond = beyond_the_limit(is_sharp, flight.state[:, 0])
    return MissionErrors(
        rms=np.sqrt(np.mean(error**2, axis=0)),
        coverage=float(np.mean(is_covered)),
        sharp_beyond=sharp_beyond,
        beyond=beyond,
    )


def beyond_the_limit(is_sharp: NDArray[np.bool_], z1: NDArray[np.float64]) -> tuple[int, int]:
    """Return the numbers of steps at 3g with z1 at or above the limit, and of all such steps.

    The first step with z1 there is left out, because its control was decided before.

    Parameters
    ----------
    is_sharp : (T,) array
        Whether a step is flown at 3g.
    z1 : (T,) array
        True loss of region 1.
    """
    is_beyond = (z1 >= LIMIT)[:-1]
    return int(np.sum(is_beyond & is_sharp[1:])), int(np.sum(is_beyond))


def outputs_of(patch: ModelPatch) -> tuple[Primitive, ...]:
    """Return primitives whose channels g1, g2, ... are renamed to FMU outputs strain[1], ..."""
    primitives = []
    for primitive in patch:
        channel = getattr(primitive, "channel", "")
        if channel.startswith("g"):
            primitive = replace(primitive, channel=f"strain[{channel[1:]}]")  # type: ignore[call-arg]
        primitives.append(primitive)
    return tuple(primitives)


def correction(primitive: Primitive) -> Primitive | None:
    """Return a primitive that undoes an effect which drifts with time; None for other effects."""
    if isinstance(primitive, SensorDrift):
        return replace(primitive, amplitude=-primitive.amplitude)
    if isinstance(primitive, ThermalStrain):
        return replace(primitive, coefficient=-primitive.coefficient)
    return None


def investigate_run(folder: Path, seed: int, effects: Sequence[Effect] | None = None) -> Verdict:
    """Return the verdict on the run in a folder, by the whole catalogue or some of its effects."""
    campaign = run_campaign(folder)
    model = run_model(folder)[0]
    return investigate(campaign, model, effects, seed=seed, thorough=False).verdict


def believed(verdict: Verdict) -> tuple[NamedEffect, ...]:
    """Return the effects for the twin: those named, or the most probable member of a group."""
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY):
        return verdict.effects
    if verdict.kind is VerdictKind.GROUP and verdict.hypotheses:
        return verdict.hypotheses[0].effects
    return ()


def fly_with_named_effects(
    folder: Path,
    seed: int,
    hidden: MissionEffect,
    named: Sequence[NamedEffect],
    steps: int,
) -> MissionErrors:
    """Fly the mission of a hidden effect again with the named effects in the twin's model.

    Effects that drift with time are corrected in the readings instead.
    """
    patch = sum((effect.patch for effect in named), ModelPatch())
    known = []
    corrections = []
    for primitive in outputs_of(patch):
        undone = correction(primitive)
        if undone is None:
            known.append(primitive)
        else:
            corrections.append(undone)
    return fly_mission(folder, seed, (*hidden.primitives, *corrections), known, steps=steps)


def study(
    hidden: MissionEffect,
    seed: int,
    work: Path,
    steps: int = STEPS,
    effects: Sequence[Effect] | None = None,
    again: bool = True,
) -> Case:
    """Fly with a hidden effect, investigate the run, and fly again with the named effects.

    Parameters
    ----------
    hidden : MissionEffect
        The hidden effect.
    seed : int
        Seed of the mission.
    work : Path
        Folder for the runs.
    steps : int
        Length of the mission.
    effects : sequence of Effect, optional
        Effects of the search; the whole catalogue by default.
    again : bool
        Whether to fly again.
    """
    begin = perf_counter()
    name = f"{HIDDEN.index(hidden)}_{seed}"
    before = fly_mission(work / f"{name}_before", seed, hidden.primitives, steps=steps)
    verdict = investigate_run(work / f"{name}_before", seed, effects)
    after = None
    named = believed(verdict)
    if named and again:
        after = fly_with_named_effects(work / f"{name}_after", seed, hidden, named, steps)
    return Case(hidden, seed, verdict, before, after, perf_counter() - begin)


def outcome(hidden: MissionEffect, verdict: Verdict) -> str:
    """Return "named", "in the group", "wrong" if another is named, or the kind of the verdict."""
    if not hidden.identifier:
        return "none" if verdict.kind is VerdictKind.NOTHING_MISSING else verdict.kind.value
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY):
        names = [(effect.identifier, effect.place) for effect in verdict.effects]
        return "named" if names == [(hidden.identifier, hidden.place)] else f"wrong: {names}"
    if verdict.kind is VerdictKind.GROUP:
        is_member = hidden.identifier in verdict.group
        return "in the group" if is_member else f"wrong group: {verdict.group}"
    return verdict.kind.value


def main() -> int:
    """Print the verdict on each mission, and a table of the hidden effects."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=2021)
    parser.add_argument("--only", help="identifiers of hidden effects, with commas")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--once", action="store_true", help="do not fly again with what was found")
    parser.add_argument(
        "--catalogue", help="identifiers of effects that are looked for, with commas"
    )
    arguments = parser.parse_args()
    effects = None
    if arguments.catalogue:
        names = arguments.catalogue.split(",")
        effects = [effect_by_identifier(name, library()) for name in names if name]
    chosen = HIDDEN
    if arguments.only is not None:
        names = arguments.only.split(",")
        chosen = tuple(hidden for hidden in HIDDEN if hidden.identifier in names)
    table = Table(
        "hidden",
        "verdicts",
        "rms z1, z2 before",
        "90 % sets",
        "3g beyond the limit",
        "rms z1, z2 after",
        "90 % sets",
        "3g beyond the limit",
    )
    console = Console(width=150)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    with tempfile.TemporaryDirectory() as folder:
        for hidden in chosen:
            cases = []
            for seed in seeds:
                case = study(
                    hidden, seed, Path(folder), arguments.steps, effects, not arguments.once
                )
                cases.append(case)
                console.print(
                    f"{hidden.text}, seed {seed}: {case.verdict.kind.value}: "
                    f"{case.verdict.sentence} rms {case.before}; "
                    f"after {case.after or ''} ({case.seconds:.1f} s)"
                )
            table.add_row(*_row(hidden, cases))
    console.print(table)
    return 0


def _row(hidden: MissionEffect, cases: Sequence[Case]) -> tuple[str, ...]:
    """Return the row of a hidden effect; its errors are those of missions flown again."""
    counts = Counter(outcome(hidden, case.verdict) for case in cases)
    verdicts = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    flown_again = [case for case in cases if case.after is not None]
    before = [case.before for case in flown_again or cases]
    after = [case.after for case in flown_again if case.after is not None]
    return (hidden.text, verdicts, *_cells(before), *_cells(after))


def _cells(missions: Sequence[MissionErrors]) -> tuple[str, str, str]:
    """Return rms error, coverage and decisions of missions, as cells of the table."""
    if not missions:
        return "", "", ""
    z1, z2 = 100.0 * np.sqrt(np.mean([mission.rms**2 for mission in missions], axis=0))
    coverage = np.mean([mission.coverage for mission in missions])
    sharp_beyond = sum(mission.sharp_beyond for mission in missions)
    beyond = sum(mission.beyond for mission in missions)
    return f"{z1:.1f}, {z2:.1f} points", f"{coverage:.2f}", f"{sharp_beyond} of {beyond}"


if __name__ == "__main__":
    raise SystemExit(main())
