"""Verdicts where no hypothesis is exact; docs/explanation/benchmarks.md shows their counts.

`python -m benchmarks.studies.remainder_naming DIR [--count 24] [--seed 1]` simulates campaigns on
the lumped rig of the blind test. Each hides an effect of the catalogue and a disturbance that no
hypothesis knows: in alternate blocks of four campaigns a random force on one of the masses, or a
small mass on a spring of its own. The disturbance is 3 to 10 % of what the effect does to the
releases (rms, in units of the noise). One campaign in four hides the disturbance alone, at two to
six times the noise. With `--colour` nothing or an effect is hidden in noise of correlation 0.5
whose record has 100 samples. A line is printed for each campaign, then the counts; verdicts go to
DIR/remainder.json.
"""

import argparse
import json
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
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
from benchmarks.blind.effects import DRAWS
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
    "coulomb_friction",
    "quadratic_damping",
    "cubic_stiffness",
    "breathing_crack",
    "free_play",
    "structural_damping",
)
SHARES = (0.03, 0.10)
"""Remainder over the gap that the effect makes (rms over the releases)."""
ALONE = (2.0, 6.0)
"""Remainder over the noise where nothing else is hidden."""
LEAST_GAP = 25.0
"""Gap over the noise of an effect that is to be found, or else the largest of as many draws."""
DRAWN = 20
TRIALS = (
    "load A1",
    "load B1",
    "release 4 mm plus 1",
    "release 12 mm plus 1",
    "release 12 mm minus 1",
    "release 8 mm plus 1",
)
SAMPLES = 400
MEMORY = 0.3
"""Time constant of the random force [s]."""
RESONANCES = (1.6, 14.0)
"""Of the small mass [Hz]; its own damping is that of the rig."""


class LooseRig(LumpedRig):
    """The rig with a small mass on a spring at one of its masses.

    Parameters
    ----------
    mass_ratio : float
        The small mass over the mass that carries it.
    carrier : int
        Index of the mass that carries it.
    frequency : float
        Natural frequency of the small mass on a fixed support [Hz].
    """

    def __init__(self, mass_ratio: float, carrier: int, frequency: float) -> None:
        super().__init__()
        self.mass_ratio = mass_ratio
        self.carrier = carrier
        self.frequency = frequency

    def structure(
        self, parameters: Mapping[str, float], changes: Changes, temperature: float = 0.0
    ) -> Structure:
        """Return the rig at a temperature above the reference [K]."""
        bare = super().structure(parameters, changes, temperature)
        mass = self.mass_ratio * float(bare.mass[self.carrier, self.carrier])
        spring = mass * (2.0 * np.pi * self.frequency) ** 2
        extension = np.zeros(4)
        extension[self.carrier] = 1.0
        extension[3] = -1.0
        return replace(
            bare,
            mass=block_diag(bare.mass, mass),
            stiffness=block_diag(bare.stiffness, 0.0) + spring * np.outer(extension, extension),
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
        plan,
        trials=tuple(replace(trial, rows=row) for trial, row in zip(trials, rows, strict=True)),
    )


def random_force_response(
    work: Workbench, chance: Chance, generator: np.random.Generator, mass: int
) -> Signals:
    """Return the response of the linear rig to a random force on a mass, zero in static trials.

    The force is noise of unit variance a sample, filtered by a low-pass with the time constant
    `MEMORY`; each release has another one. It acts from five seconds before the release.
    """
    structure = work.rig.structure(chance.parameters, Changes())
    w = structure.angular_frequency
    shapes = structure.shapes
    damping = np.diag(structure.alpha + structure.beta * w**2)
    modes = len(w)
    system_matrix = np.block(
        [[np.zeros((modes, modes)), np.eye(modes)], [-np.diag(w**2), -damping]]
    )
    input_vector = np.concatenate((np.zeros(modes), shapes[mass]))[:, None]
    system = (system_matrix, input_vector, np.eye(2 * modes), 0.0 * input_vector)
    response = {}
    for trial in work.plan.trials:
        channels = [work.plan.channels[name] for name in trial.channels]
        if trial.kind != "ringdown":
            response[trial.name] = np.zeros((len(trial.rows), len(channels)))
            continue
        interval = float(trial.rows[1] - trial.rows[0])
        lead = round(5.0 / interval)
        memory = np.exp(-interval / MEMORY)
        noise = generator.standard_normal(lead + len(trial.rows))
        force = lfilter([1.0], [1.0, -memory], noise)
        modal = lsim(system, force, interval * np.arange(len(force)))[1]
        rows = [work.rig.outputs.index(channel.output) for channel in channels]
        values = modal[lead:, :modes] @ (structure.outputs[rows] @ shapes).T
        response[trial.name] = values / np.array([channel.scale for channel in channels])
    return response


def over_noise(plan: CampaignPlan, signals: Signals, reference_signals: Signals) -> float:
    """Return the rms difference of two signals in the releases, in units of the noise."""
    differences = []
    for trial in plan.trials:
        if trial.kind == "ringdown":
            noise = np.array([plan.channels[name].noise for name in trial.channels])
            difference = (signals[trial.name] - reference_signals[trial.name]) / noise
            differences.append(difference.ravel())
    return float(np.sqrt(np.mean(np.concatenate(differences) ** 2)))


@dataclass(frozen=True)
class HiddenEffect:
    """The rig with a hidden effect, or with nothing hidden.

    Attributes
    ----------
    identifiers : list of str
        The effect, or nothing.
    changes : Changes
        Its changes of the rig.
    signals : mapping of str to array
        Readings without noise by trial.
    gap : float
        Rms of what the effect does to the releases, in units of the noise.
    """

    identifiers: list[str]
    changes: Changes
    signals: Signals
    gap: float


@dataclass(frozen=True)
class Disturbance:
    """Readings with a disturbance that no hypothesis knows.

    Attributes
    ----------
    signals : mapping of str to array
        Readings without noise by trial.
    remainder : float
        Rms of what the disturbance does to the releases, in units of the noise.
    mass_ratio : float
        The loose mass over the mass that carries it; 0 without one.
    """

    signals: Signals
    remainder: float
    mass_ratio: float


def hide_effect(
    work: Workbench,
    chance: Chance,
    generator: np.random.Generator,
    identifier: str | None,
) -> HiddenEffect:
    """Draw an effect until its gap is `LEAST_GAP`, or take the largest of as many draws."""
    nominal = reference(work.rig, work.plan, chance).nominal
    hidden = HiddenEffect([], Changes(), nominal, 0.0)
    if identifier is None:
        return hidden
    for _ in range(DRAWN):
        effect = DRAWS[identifier](generator, work.bench)
        signals = finite_signals(work, chance, effect.changes)
        if signals is None or hidden.gap >= LEAST_GAP:
            continue
        gap = over_noise(work.plan, signals, nominal)
        if gap > hidden.gap:
            hidden = HiddenEffect([effect.identifier], effect.changes, signals, gap)
    return hidden


def add_random_force(
    work: Workbench,
    chance: Chance,
    generator: np.random.Generator,
    hidden: HiddenEffect,
    mass: int,
    wanted: float,
) -> Disturbance:
    """Add the response to a random force on a mass, scaled to the remainder `wanted`."""
    response = random_force_response(work, chance, generator, mass)
    nothing = {name: 0.0 * values for name, values in response.items()}
    scale = wanted / over_noise(work.plan, response, nothing)
    signals = {name: values + scale * response[name] for name, values in hidden.signals.items()}
    return Disturbance(signals, wanted, 0.0)


def add_loose_mass(
    work: Workbench,
    chance: Chance,
    hidden: HiddenEffect,
    carrier: int,
    frequency: float,
    wanted: float,
) -> Disturbance:
    """Add a mass on a spring of its own, sized to a remainder within 5 % of `wanted`."""
    mass_ratio = 1e-3
    for _ in range(8):
        rig = LooseRig(mass_ratio, carrier, frequency)
        loose = Workbench(rig, work.plan, lambda _region: work.bench)
        signals = finite_signals(loose, chance, hidden.changes)
        assert signals is not None
        remainder = over_noise(work.plan, signals, hidden.signals)
        disturbance = Disturbance(signals, remainder, mass_ratio)
        if abs(remainder / wanted - 1.0) < 0.05:
            break
        mass_ratio *= min(max(wanted / remainder, 0.1), 10.0)
    return replace(disturbance, mass_ratio=mass_ratio)


def make(out: Path, number: int, seed: int, *, colour: bool) -> dict[str, Any]:
    """Write a campaign and return its truth.

    Parameters
    ----------
    out : Path
        Folder of the study.
    number : int
        Number of the campaign, which decides what is hidden.
    seed : int
        Seed of the study.
    colour : bool
        Whether the noise is coloured, instead of a disturbance.
    """
    generator = np.random.default_rng([seed, number, 7])
    lumped = workbench("lumped")
    work = Workbench(LumpedRig(), short_plan(lumped.plan), lambda _region: lumped.bench)
    chance = draw_chance(generator, work.plan)

    # The hidden effect: none in each fourth campaign
    identifier = HIDDEN[(number - number // 4) % len(HIDDEN)] if number % 4 else None
    hidden = hide_effect(work, chance, generator, identifier)

    # The disturbance
    if hidden.identifiers:
        wanted = hidden.gap * float(generator.uniform(*SHARES))
    else:
        wanted = float(generator.uniform(*ALONE))
    mass = int(generator.integers(3))
    frequency = float(np.exp(generator.uniform(*np.log(RESONANCES))))
    if colour:
        disturbance = Disturbance(hidden.signals, 0.0, 0.0)
    elif number // 4 % 2 == 0:
        disturbance = add_random_force(work, chance, generator, hidden, mass, wanted)
    else:
        disturbance = add_loose_mass(work, chance, hidden, mass, frequency, wanted)

    # Readings
    plan = replace(work.plan, noise_samples=100) if colour else work.plan
    measured = measure(
        generator,
        plan,
        disturbance.signals,
        hidden.changes,
        correlation=0.5 if colour else 0.0,
    )
    truth = {
        "identifiers": hidden.identifiers,
        "gap": hidden.gap,
        "remainder": disturbance.remainder,
        "mass": disturbance.mass_ratio,
        "at": mass,
        "frequency": frequency,
    }
    order = Order(f"case-{number:04d}", "catalogue", "lumped", tuple(hidden.identifiers), seed)
    write_case(Case(order, plan, measured, truth), out / "campaigns", out / "sealed")
    return truth


def judge(out: Path, seed: int, number: int, *, colour: bool) -> dict[str, Any]:
    """Make a campaign, investigate it and return its truth, its verdict and the outcome."""
    truth = make(out, number, seed, colour=colour)
    folder = out / "campaigns" / f"case-{number:04d}"
    begin = time.perf_counter()
    try:
        investigation = investigate(
            read_campaign(folder), model_of(folder), library(), thorough=False
        )
    except DiscrepancyError as error:
        return truth | {"kind": "error", "sentence": str(error), "outcome": "error", "seconds": 0.0}
    verdict = scored(investigation.verdict, truth["identifiers"], investigation.proof)
    return truth | verdict | {"seconds": time.perf_counter() - begin}


def scored(verdict: Verdict, true: list[str], proof: Proof | None) -> dict[str, Any]:
    """Return a verdict and its outcome: its kind if right, else wrong; nothing where nothing is."""
    named = sorted(hypothesis.identifier for hypothesis in verdict.effects)
    families = {hypothesis.identifier: hypothesis.family for hypothesis in library()}
    kind = verdict.kind.value
    if kind == "group":
        members = {name for hypothesis in verdict.group for name in hypothesis.split(" + ")}
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
        "kind": kind,
        "named": named,
        "outcome": outcome,
        "sentence": verdict.sentence,
        "probability": verdict.probability,
        "share": None if closed is None else [closed.low, closed.value, closed.high],
        "hypotheses": [
            [list(hypothesis.identifiers), hypothesis.log_evidence]
            for hypothesis in verdict.hypotheses[:6]
        ],
        "gates": [gate.reason for gate in verdict.gates if gate.has_failed],
    }


def main() -> None:
    """Make the campaigns, name, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--colour", action="store_true")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.out / "campaigns", ignore_errors=True)
    rows = []
    work = partial(judge, arguments.out, arguments.seed, colour=arguments.colour)
    with ProcessPoolExecutor(arguments.jobs, initializer=threadpool_limits, initargs=(1,)) as pool:
        for row in pool.map(work, range(arguments.count)):
            rows.append(row)
            true = ", ".join(row["identifiers"]) or "nothing"
            print(
                f"{true:20s} gap {row['gap']:6.1f} remainder {row['remainder']:5.2f}  "
                f"{row['outcome']:14s} "
                f"{row['seconds']:5.0f} s  {row['sentence']}",
                flush=True,
            )
    for hidden in (True, False):
        counts = Counter(row["outcome"] for row in rows if bool(row["identifiers"]) is hidden)
        print("an effect hidden:" if hidden else "none hidden:", dict(counts))
    (arguments.out / "remainder.json").write_text(
        json.dumps(rows, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
