"""Whether sound data pass: campaigns with nothing wrong, through `check`, the fit and `locate`.

`python -m benchmarks.study_nulls --campaigns 200` draws one to three kinds of trials of a shipped rig, their
rows, stamps (even, jittered, with gaps, on a logger's clock), noise (white or coloured; its deviation known
from a record, a number or nothing), zeros, gain errors, units and digits, and parameters from the prior.
Nothing is hidden, so whatever is found is a false alarm. Locating and the fit are asked where noise that is
coloured has a record. Exit code 1 if more than `FATAL` of the campaigns have a fatal fault, or more than
`LOCATED` of those with white noise disagree, have discoveries in their map or are not explained.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from discrepancy.campaign.noise_records import pre_trigger_record, repeat_record
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, Hold, NoiseRecord, Start, Trial, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.checks.model_check import check_against_model, prior_mean
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.location.locate import locate
from discrepancy.model_choice import load_model
from discrepancy.search.honest_evidence import left_by
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

FATAL, LOCATED = 0.01, 0.05
MODELS = ("single_mass_rig", "three_mass_chain")
LONGEST, LOUDEST, RECORD = 1500, 0.1, 200
"""Samples of a trial, and noise over what a channel shows, up to which the fit is asked; samples of a
record of coloured noise from which on it is."""
KINDS = (TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FORCED)
UNITS = {"displacement": ("m", "mm", "um"), "strain": ("1", "microstrain", "percent")}


def coloured(generator: np.random.Generator, time: np.ndarray, correlation: float) -> np.ndarray:
    """Return noise of unit variance at times, in intervals, over each of which it is so correlated."""
    kept = correlation ** np.diff(time, prepend=-np.inf)
    fresh = np.sqrt(1.0 - kept**2) * generator.standard_normal(len(time))
    return np.array(
        [*accumulate(zip(kept, fresh, strict=True), lambda x, step: step[0] * x + step[1], initial=0.0)]
    )[1:]


def stamps(generator: np.random.Generator, interval: float, count: int) -> np.ndarray:
    """Return times [s]: even, jittered by a third of the interval, or with a fifth of the samples lost."""
    time, kind = interval * np.arange(count), generator.integers(3)
    if kind == 1:
        time = time + interval * generator.uniform(-0.3, 0.3, count)
    if kind == 2:
        time = time[np.sort(generator.permutation(count)[: max(int(0.8 * count), 10)])]
    return np.asarray(time - time[0])


def planned(
    generator: np.random.Generator, kind: TrialKind, name: str, outputs: Sequence[str], model: Model,
    samples: float,
) -> Trial:  # fmt: skip
    """Return a trial without its readings; in time with so many samples a period."""
    scales = model.scales(Campaign("", {}, (), None, {}, ""))
    rate, size = scales.angular_frequency, scales.length * 10.0 ** generator.uniform(-2.8, -1.6)
    given: dict[str, Any] = {"load_place": str(generator.choice(model.load_places))}
    given["start"] = float(generator.uniform(0.0, 5000.0))
    if kind is TrialKind.STATIC:
        count = int(generator.integers(1, 14))
        levels = (
            np.linspace(0.0, 1.0, count),
            generator.uniform(-1.0, 1.0, count),
            generator.uniform(0.8, 1.0, count),
        )
        force = levels[generator.integers(3)] * size * scales.tip_stiffness
        factor = float(generator.choice([1.0, 1.0, 0.3, 2.0]))
        time = given["start"] + 60.0 * np.arange(count)
        return Trial.plain(name, kind, tuple(outputs), time, force=force, noise_factor=factor, **given)
    count = max(int(generator.uniform(4.5, 25.0) * samples), 10)
    time = stamps(generator, 2.0 * np.pi / rate / samples, count)
    if kind is TrialKind.RINGDOWN:
        aside = size * generator.choice([-1.0, 1.0]) * generator.uniform(0.3, 1.0)
        modes = int(generator.integers(1, 4))
        release = Release(
            float(aside), float(generator.choice([0.02, 0.05, 0.2])), bool(generator.random() < 0.6), modes
        )
        return Trial.plain(name, kind, tuple(outputs), time, release=release, **given)
    course = (
        np.sin(rate * generator.uniform(0.2, 3.0) * time),
        coloured(generator, np.arange(float(len(time))), 0.8),
        1.0 * (time > 0.2 * time[-1]),
        np.sin(rate * (0.3 + time / time[-1]) * time),
    )
    force = course[generator.integers(4)] * size * scales.tip_stiffness * generator.uniform(0.1, 1.0)
    begins = generator.choice(np.array([Start.SETTLED, Start.STILL, Start.UNKNOWN], dtype=object))
    hold = Hold.SMOOTH if generator.random() < 0.5 else None
    time = time + float(generator.choice([0.0, generator.uniform(0.0, 10.0)]))  # a logger's clock
    return Trial.plain(name, kind, tuple(outputs), time, force=force, begins=begins, hold=hold, **given)


def shown(generator: np.random.Generator, bare: Campaign, model: Model) -> dict[str, np.ndarray]:
    """Return what each trial shows without noise, at true parameters and initial states."""
    values = [
        np.clip(generator.normal(item.mean, item.deviation), item.low, item.high) for item in model.parameters
    ]
    found = {}
    for trial in bare.trials:
        initial = prior_mean(bare, model, trial).initial.copy()
        if trial.release is not None:
            spread = trial.release.deviation * generator.standard_normal()
            if trial.release.at_rest:
                initial[0, 0] = spread
            else:
                initial = 0.3 * generator.standard_normal(initial.shape)
                initial[0, 0] = 1.0 + spread
        truth = Conditions(np.array(values), initial, (0.0, 0.0), trial.health)
        found[trial.name] = observe(model, bare, trial, ModelPatch(), truth).values
    return found


def campaign(generator: np.random.Generator, model: Model) -> tuple[Campaign, dict[str, float]]:
    """Return a sound campaign, and its correlation, noise and digits."""
    outputs = [str(name) for name in generator.permutation(list(model.quantities))]
    outputs = outputs[: int(generator.integers(1, len(outputs) + 1))]
    kinds = [KINDS[k] for k in generator.permutation(3)[: int(generator.integers(1, 4))]]
    samples = float(generator.choice([8, 12, 20, 50, 90]))
    interval = 2.0 * np.pi / model.scales(Campaign("", {}, (), None, {}, "")).angular_frequency / samples
    trials = tuple(
        planned(generator, kind, f"{kind.value} {number}", outputs, model, samples)
        for kind in kinds
        for number in range(int(generator.integers(1, 4)))
    )
    named = {name: Channel(name, model.quantities[name], name) for name in outputs}
    bare = Campaign("sound", named, trials, None, {}, "0" * 64)
    clean = shown(generator, bare, model)
    correlation = float(generator.choice([0.0, 0.0, 0.0, 0.5, 0.9, 0.98]))
    share, digits = 10.0 ** generator.uniform(-3.0, -0.7), float(generator.choice([0.0, 0.0, 0.0, 0.3, 2.0]))
    values = {name: np.empty_like(own) for name, own in clean.items()}
    channels = {}
    for column, (name, channel) in enumerate(named.items()):
        size = max(float(np.abs(own[:, column]).max()) for own in clean.values())
        deviation = max(share * size, 1e-9)
        zero = float(generator.choice([0.0, deviation, 5.0 * deviation, np.inf]))
        gain = float(generator.choice([0.0, 0.005, 0.05]))
        record = coloured(generator, np.arange(float(generator.choice([40, 200, 1000]))), correlation)
        sources = (
            pre_trigger_record(deviation * record, interval, name, "noise.csv"),
            NoiseRecord(deviation * float(np.sqrt(generator.chisquare(50) / 50.0)), 50.0),
            NoiseRecord(deviation),
            None,
        )
        unit = str(generator.choice(UNITS.get(channel.quantity.value, ("",))))
        noise = sources[generator.integers(len(sources))]
        channels[name] = replace(channel, noise=noise, gain_deviation=gain, offset_deviation=zero, unit=unit)
        true_gain = 1.0 + gain * generator.standard_normal()
        for trial in trials:
            own = clean[trial.name][:, column]
            rest = coloured(generator, trial.time / interval, correlation)  # none is left between levels
            moved = generator.standard_normal() * (zero if np.isfinite(zero) else 2.0 * size)
            read = true_gain * own + moved + deviation * trial.noise_factor * rest
            digit = digits * deviation
            values[trial.name][:, column] = np.round(read / digit) * digit if digit else read
    read_trials = tuple(replace(trial, values=values[trial.name]) for trial in trials)
    repeated = {
        name: item if item.noise is not None else replace(item, noise=repeat_record(item, read_trials))
        for name, item in channels.items()
    }
    told = {"correlation": correlation, "noise": share, "digits": digits}
    return replace(bare, channels=repeated, trials=read_trials), told


def located(sound: Campaign, model: Model, seed: int) -> list[str]:
    """Return what the fit and `locate` say against a campaign, or that it is nothing."""
    problem = Problem(sound, model, Setting(sound, model, model.scales(sound)))
    found = fit(problem, Candidate(), problem.start(Candidate()))
    where = locate(residual_set(problem, found), seed=seed)
    gate = absolute_gate(problem, replace(found, remainder=left_by(problem, found)))
    wrong = {"not explained": gate.passed is False, "disagrees": where.disagrees}
    wrong["discovery in the map"] = any(cell.significant for cell in where.cells)
    return [name for name, is_wrong in wrong.items() if is_wrong] or ["nothing"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    given = parser.parse_args()
    models = [load_model(name) for name in MODELS]
    alarms: dict[str, Counter[str]] = {"all": Counter(), "white": Counter(), "coloured": Counter()}
    count: Counter[str] = Counter()
    for seed in range(given.first_seed, given.first_seed + given.campaigns):
        generator = np.random.default_rng([2026, seed])
        model = models[generator.integers(len(models))]
        try:
            sound, told = campaign(generator, model)
            marked = mark_outliers(sound)
            faults = [*check_data(marked), *check_against_model(marked, model)]
            count["all"] += 1
            alarms["all"].update({f"{item.kind.value}, fatal" for item in faults if item.fatal})
            alarms["all"]["any fatal"] += any(item.fatal for item in faults)
            alarms["all"]["samples left out"] += any(not trial.used.all() for trial in marked.trials)
            noises = [item.noise for item in marked.channels.values()]
            recorded = all(
                noise is not None and noise.samples is not None and len(noise.samples) >= RECORD
                for noise in noises
            )
            long = max(len(trial.time) for trial in marked.trials) > LONGEST
            unclear = told["noise"] > LOUDEST or told["digits"] > 0.0 or long
            if not unclear and (recorded or not told["correlation"]):
                colour = "coloured" if told["correlation"] else "white"
                alarms[colour].update(located(marked, model, seed))
                count[colour] += 1
        except DiscrepancyError as error:
            print(f"campaign {seed}: {error}")
            alarms["all"]["refused"] += 1
    title = f"{given.campaigns} sound campaigns, seeds from {given.first_seed}: what was found all the same"
    table = Table("campaigns", "finding", "found", "of", title=title)
    for group, found in alarms.items():
        for name, number in sorted(found.items(), key=lambda item: -item[1]):
            table.add_row(group, name, str(number), str(count[group]))
    Console().print(table)
    of_white = [number for name, number in alarms["white"].items() if name != "nothing"]
    worst = max(of_white, default=0) / max(count["white"], 1)
    return 0 if alarms["all"]["any fatal"] <= FATAL * count["all"] and worst <= LOCATED else 1


if __name__ == "__main__":
    sys.exit(main())
