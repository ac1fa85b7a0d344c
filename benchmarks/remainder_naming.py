"""Names where no hypothesis is exact: `python -m benchmarks.remainder_naming DIR [--count 24] [--seed 1]`.

Campaigns on the lumped rig of the blind test, by its simulator: an effect of the catalogue is hidden, and
beside it what no hypothesis knows, so that it is 3 to 10 % of what the effect does to the releases (rms, in
units of the noise): by turns of four campaigns a random force on one of the masses, or a small mass on a
spring of its own. One campaign in four hides that alone, at two to six times the noise. With `--colour`
nothing or an effect is hidden in noise of correlation 0.5 whose record has 100 samples. A line for each
campaign, then the counts; verdicts go to DIR/remainder.json.
"""

import argparse
import json
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import lfilter, lsim
from threadpoolctl import threadpool_limits

from benchmarks.blind.cases import Case, Order, Workbench, finite_signals, workbench
from benchmarks.blind.changes import Changes
from benchmarks.blind.detectability import reference
from benchmarks.blind.effects import DRAWS, Hidden
from benchmarks.blind.instruments import Chance, Signals, draw_chance, measure
from benchmarks.blind.lumped_rig import LumpedRig
from benchmarks.blind.plan import CampaignPlan, TrialPlan
from benchmarks.blind.structure import Release, Structure
from benchmarks.blind.writing import write_case
from benchmarks.blind_naming import model_of
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.errors import DiscrepancyError
from discrepancy.proof_record import Proof
from discrepancy.verdict import Verdict
from discrepancy.workflow import investigate

FloatArray = NDArray[np.float64]

HIDDEN = (
    "coulomb_friction", "quadratic_damping", "cubic_stiffness", "breathing_crack", "free_play",
    "structural_damping",
)  # fmt: skip
SHARES = (0.03, 0.10)
"""Remainder over the gap that the effect makes (rms over the releases)."""
ALONE = (2.0, 6.0)
"""Remainder over the noise where nothing else is hidden."""
LEAST_GAP = 25.0
"""Gap over the noise of an effect that is to be found, or else the largest of as many draws."""
DRAWN = 20
TRIALS = (
    "load A1", "load B1", "release 4 mm plus 1", "release 12 mm plus 1", "release 12 mm minus 1",
    "release 8 mm plus 1",
)  # fmt: skip
SAMPLES = 400
FORGETS = 0.3
"""Time over which the random force does [s]."""
RESONANCES = (1.6, 14.0)
"""Of the small mass [Hz]; its own damping is that of the rig."""


class LooseRig(LumpedRig):
    """The rig with a small mass on a spring at one of its masses.

    Parameters
    ----------
    share : float
        Of the mass that carries it.
    at : int
        Which carries it.
    frequency : float
        At which it would swing alone [Hz].
    """

    def __init__(self, share: float, at: int, frequency: float) -> None:
        super().__init__()
        self.share, self.at, self.frequency = share, at, frequency

    def structure(
        self, parameters: Mapping[str, float], changes: Changes, temperature: float = 0.0
    ) -> Structure:
        """Return the rig at a temperature above the reference [K]."""
        bare = super().structure(parameters, changes, temperature)
        mass = self.share * float(bare.mass[self.at, self.at])
        spring = mass * (2.0 * np.pi * self.frequency) ** 2
        between = np.zeros(4)
        between[self.at], between[3] = 1.0, -1.0
        return replace(
            bare,
            mass=block_diag(bare.mass, mass),
            stiffness=block_diag(bare.stiffness, 0.0) + spring * np.outer(between, between),
            outputs=np.column_stack((bare.outputs, np.zeros(len(bare.outputs)))),
            ports={name: np.append(vector, 0.0) for name, vector in bare.ports.items()},
            modes=4,
        )

    def respond(
        self,
        structure: Structure,
        changes: Changes,
        trial: TrialPlan,
        amplitude: float = 0.0,
        place_error: float = 0.0,
        split: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (n, C) of a trial."""
        end = structure.ports["end"]
        if trial.kind == "static":
            return structure.static(end[:, None] * trial.rows, changes.laws), trial.rows
        release = Release(amplitude, end, end, trial.rows)
        if changes.is_linear and split == 1:
            return structure.free_ringdown(release), trial.rows
        outputs, _ = structure.fine_ringdown(release, changes.laws, split)
        return outputs, np.linspace(trial.rows[0], trial.rows[-1], len(outputs))


def short_plan(plan: CampaignPlan) -> CampaignPlan:
    """Return two static trials and four releases of 1.6 s, one of them held out."""
    trials = [trial for trial in plan.trials if trial.name in TRIALS]
    rows = [trial.rows[:SAMPLES] if trial.kind == "ringdown" else trial.rows for trial in trials]
    return replace(
        plan, trials=tuple(replace(trial, rows=row) for trial, row in zip(trials, rows, strict=True))
    )


def pushed(work: Workbench, chance: Chance, generator: np.random.Generator, at: int) -> Signals:
    """Return what a random force does to the linear rig, another one in each release."""
    structure = work.rig.structure(chance.parameters, Changes())
    w, shapes = structure.angular_frequency, structure.shapes
    damping = np.diag(structure.alpha + structure.beta * w**2)
    count = len(w)
    matrix = np.block([[np.zeros((count, count)), np.eye(count)], [-np.diag(w**2), -damping]])
    force = np.concatenate((np.zeros(count), shapes[at]))[:, None]
    found = {}
    for trial in work.plan.trials:
        columns = [work.rig.outputs.index(work.plan.channels[name].output) for name in trial.channels]
        scales = np.array([work.plan.channels[name].scale for name in trial.channels])
        found[trial.name] = np.zeros((len(trial.rows), len(columns)))
        if trial.kind != "ringdown":
            continue
        interval = float(trial.rows[1] - trial.rows[0])
        before = round(5.0 / interval)
        kept = np.exp(-interval / FORGETS)
        series = lfilter([1.0], [1.0, -kept], generator.standard_normal(before + len(trial.rows)))
        system = (matrix, force, np.eye(2 * count), 0.0 * force)
        modal = lsim(system, series, interval * np.arange(len(series)))[1]
        values = modal[before:, :count] @ (structure.outputs[columns] @ shapes).T
        found[trial.name] = values / scales
    return found


def over_noise(plan: CampaignPlan, one: Signals, other: Signals) -> float:
    """Return the rms difference of releases over the noise."""
    parts = []
    for trial in plan.trials:
        if trial.kind == "ringdown":
            noise = np.array([plan.channels[name].noise for name in trial.channels])
            parts.append(((one[trial.name] - other[trial.name]) / noise).ravel())
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def make(out: Path, number: int, seed: int, *, colour: bool) -> dict[str, Any]:
    """Write a campaign, and return what is true of it."""
    generator = np.random.default_rng([seed, number, 7])
    known = workbench("lumped")
    work = Workbench(LumpedRig(), short_plan(known.plan), lambda item: known.bench)
    chance = draw_chance(generator, work.plan)
    nominal = reference(work.rig, work.plan, chance).nominal
    hidden: list[Hidden] = []
    signals, gap, changes = nominal, 0.0, Changes()
    identifier = HIDDEN[(number - number // 4) % len(HIDDEN)]
    for _ in range(DRAWN if number % 4 else 0):
        effect = DRAWS[identifier](generator, work.bench)
        drawn = finite_signals(work, chance, effect.changes)
        if drawn is not None and gap < LEAST_GAP and over_noise(work.plan, drawn, nominal) > gap:
            hidden, signals, changes = [effect], drawn, effect.changes
            gap = over_noise(work.plan, drawn, nominal)
    wanted = gap * float(generator.uniform(*SHARES)) if hidden else float(generator.uniform(*ALONE))
    at, frequency = int(generator.integers(3)), float(np.exp(generator.uniform(*np.log(RESONANCES))))
    mass, left = 0.0, 0.0
    if number // 4 % 2 == 0 and not colour:
        push = pushed(work, chance, generator, at)
        size = wanted / over_noise(work.plan, push, {name: 0.0 * values for name, values in push.items()})
        signals, left = {name: values + size * push[name] for name, values in signals.items()}, wanted
    elif not colour:
        bare, mass = signals, 1e-3
        for _ in range(8):
            loose = Workbench(LooseRig(mass, at, frequency), work.plan, lambda item: work.bench)
            found = finite_signals(loose, chance, changes)
            assert found is not None
            signals, left = found, over_noise(work.plan, found, bare)
            if abs(left / wanted - 1.0) < 0.05:
                break
            mass *= min(max(wanted / left, 0.1), 10.0)
    plan = replace(work.plan, noise_samples=100) if colour else work.plan
    measured = measure(generator, plan, signals, changes, correlation=0.5 if colour else 0.0)
    truth = {
        "identifiers": [item.identifier for item in hidden], "gap": gap, "remainder": left,
        "mass": mass, "at": at, "frequency": frequency,
    }  # fmt: skip
    order = Order(f"case-{number:04d}", "catalogue", "lumped", tuple(truth["identifiers"]), seed)
    write_case(Case(order, plan, measured, truth), out / "campaigns", out / "sealed")
    return truth


def judge(out: Path, seed: int, number: int, *, colour: bool) -> dict[str, Any]:
    """Make a campaign, name what it lacks and return truth and verdict."""
    truth = make(out, number, seed, colour=colour)
    folder = out / "campaigns" / f"case-{number:04d}"
    began = time.perf_counter()
    try:
        found = investigate(read_campaign(folder), model_of(folder), library(), thorough=False)
    except DiscrepancyError as error:
        return truth | {"kind": "error", "sentence": str(error), "outcome": "error", "seconds": 0.0}
    return (
        truth
        | scored(found.verdict, truth["identifiers"], found.proof)
        | {"seconds": time.perf_counter() - began}
    )


def scored(verdict: Verdict, true: list[str], proof: Proof | None) -> dict[str, Any]:
    """Return what a verdict says and its outcome: its kind if right, else wrong; nothing where nothing is."""
    named = sorted(item.identifier for item in verdict.effects)
    families = {item.identifier: item.family for item in library()}
    kind = verdict.kind.value
    if kind == "group":
        members = {name for item in verdict.group for name in item.split(" + ")}
        outcome = "group" if true and true[0] in members else "wrong"
    elif kind in ("named", "named in part", "family"):
        right = named == true or (
            verdict.family != "" and bool(true) and families[true[0]] in verdict.family.split(", ")
        )
        outcome = kind if right else "wrong"
    else:
        outcome = kind if true or kind == "unexplained" else "nothing"
    closed = None if proof is None else proof.closed
    return {
        "kind": kind, "named": named, "outcome": outcome, "sentence": verdict.sentence,
        "probability": verdict.probability,
        "share": None if closed is None else [closed.low, closed.value, closed.high],
        "hypotheses": [[list(item.identifiers), item.log_evidence] for item in verdict.hypotheses[:6]],
        "gates": [gate.reason for gate in verdict.gates if gate.passed is False],
    }  # fmt: skip


def main() -> None:
    """Make the campaigns, name, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--colour", action="store_true")
    given = parser.parse_args()
    shutil.rmtree(given.out / "campaigns", ignore_errors=True)
    rows = []
    work = partial(judge, given.out, given.seed, colour=given.colour)
    with ProcessPoolExecutor(given.jobs, initializer=threadpool_limits, initargs=(1,)) as pool:
        for row in pool.map(work, range(given.count)):
            rows.append(row)
            true = ", ".join(row["identifiers"]) or "nothing"
            print(
                f"{true:20s} gap {row['gap']:6.1f} remainder {row['remainder']:5.2f}  {row['outcome']:14s} "
                f"{row['seconds']:5.0f} s  {row['sentence']}", flush=True,
            )  # fmt: skip
    for hidden in (True, False):
        counts = Counter(row["outcome"] for row in rows if bool(row["identifiers"]) is hidden)
        print("an effect hidden:" if hidden else "none hidden:", dict(counts))
    (given.out / "remainder.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
