"""How often campaigns without a fault raise a false alarm.

Shown in docs/explanation/benchmarks.md.

`python -m benchmarks.studies.nulls --campaigns 200` draws one to three kinds of trials of a shipped
rig: their rows, stamps (even, jittered, with gaps, on a logger's clock), noise (white or coloured;
its deviation known from a record, a number or nothing), zeros, gain errors, units and digits, and
parameters from the prior. Nothing is hidden, so every finding of `check`, the fit and
`locate` is a false alarm. Locating and the fit run where coloured noise has a record. The exit code
is 1 if more than `FATAL` of the campaigns have a fatal fault, or more than `LOCATED` of those with
white noise disagree, have discoveries in their map or are not explained.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from discrepancy.campaign.noise_records import pre_trigger_record, repeat_record
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    NoiseRecord,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.catalogue.entry import Setting
from discrepancy.checks.model_check import check_against_model, prior_conditions
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.location.locate import locate
from discrepancy.model_choice import load_model
from discrepancy.search.wide_noise import estimate_residual_process
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

Float = NDArray[np.float64]

FATAL = 0.01
"""Largest share of campaigns with a fatal fault."""
LOCATED = 0.05
"""Largest share of campaigns with white noise and a finding of the fit or of `locate`."""
MODELS = ("single_mass_rig", "three_mass_chain")
LONGEST = 1500
"""Most samples of a trial for which the fit runs."""
LOUDEST = 0.1
"""Largest noise, over the largest reading of a channel, for which the fit runs."""
RECORD = 200
"""Least samples of a noise record for which the fit runs with coloured noise."""
KINDS = (TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FORCED)
UNITS = {"displacement": ("m", "mm", "um"), "strain": ("1", "microstrain", "percent")}


@dataclass(frozen=True)
class NoiseTruth:
    """True noise of a campaign.

    Attributes
    ----------
    correlation : float
        Correlation over one interval.
    share : float
        Standard deviation over the largest reading of a channel.
    digits : float
        Last digit of the readings, over the standard deviation; 0 without rounding.
    """

    correlation: float
    share: float
    digits: float


def coloured_noise(generator: np.random.Generator, time: Float, correlation: float) -> Float:
    """Return unit noise (n,) of first order at times (n,) [intervals].

    `correlation` is that of two samples one interval apart.
    """
    memory = correlation ** np.diff(time, prepend=-np.inf)
    innovation = np.sqrt(1.0 - memory**2) * generator.standard_normal(len(time))
    noise = np.empty(len(time))
    value = 0.0
    for index in range(len(time)):
        value = memory[index] * value + innovation[index]
        noise[index] = value
    return noise


def sample_times(generator: np.random.Generator, interval: float, count: int) -> Float:
    """Return times [s]: even, jittered by a third of an interval, or without a fifth of samples."""
    time = interval * np.arange(count)
    kind = generator.integers(3)
    if kind == 1:
        time = time + interval * generator.uniform(-0.3, 0.3, count)
    if kind == 2:
        time = time[np.sort(generator.permutation(count)[: max(int(0.8 * count), 10)])]
    return np.asarray(time - time[0])


def draw_load_test(
    generator: np.random.Generator,
    name: str,
    outputs: tuple[str, ...],
    start: float,
    size: float,
    stiffness: float,
) -> Trial:
    """Return a static trial without readings, with 1 to 13 forces."""
    count = int(generator.integers(1, 14))
    levels = (
        np.linspace(0.0, 1.0, count),
        generator.uniform(-1.0, 1.0, count),
        generator.uniform(0.8, 1.0, count),
    )
    force = levels[generator.integers(3)] * size * stiffness
    factor = float(generator.choice([1.0, 1.0, 0.3, 2.0]))
    time = start + 60.0 * np.arange(count, dtype=np.float64)
    return Trial.plain(name, TrialKind.STATIC, outputs, time, force=force, noise_factor=factor)


def draw_release(
    generator: np.random.Generator, name: str, outputs: tuple[str, ...], time: Float, size: float
) -> Trial:
    """Return a ring-down without readings, released from up to `rms_over_noise` [m]."""
    deflection = size * generator.choice([-1.0, 1.0]) * generator.uniform(0.3, 1.0)
    mode_count = int(generator.integers(1, 4))
    deviation = float(generator.choice([0.02, 0.05, 0.2]))
    at_rest = bool(generator.random() < 0.6)
    release = Release(float(deflection), deviation, at_rest, mode_count)
    return Trial.plain(name, TrialKind.RINGDOWN, outputs, time, release=release)


def draw_forced_motion(
    generator: np.random.Generator,
    name: str,
    outputs: tuple[str, ...],
    time: Float,
    frequency: float,
    size: float,
    stiffness: float,
) -> Trial:
    """Return a forced trial without readings: a tone, noise, a step or a sweep of a force.

    Parameters
    ----------
    generator : numpy.random.Generator
        Random numbers.
    name : str
        Name of the trial.
    outputs : tuple of str
        Channels.
    time : (n,) array
        Times from zero [s].
    frequency : float
        Angular frequency of the rig [rad/s].
    size, stiffness : float
        Static deflection under the largest force [m], and stiffness [N/m].
    """
    courses = (
        np.sin(frequency * generator.uniform(0.2, 3.0) * time),
        coloured_noise(generator, np.arange(float(len(time))), 0.8),
        1.0 * (time > 0.2 * time[-1]),
        np.sin(frequency * (0.3 + time / time[-1]) * time),
    )
    course = courses[generator.integers(4)]
    force = course * size * stiffness * generator.uniform(0.1, 1.0)
    begins = generator.choice(np.array([Start.SETTLED, Start.STILL, Start.UNKNOWN], dtype=object))
    hold = Hold.SMOOTH if generator.random() < 0.5 else None
    clock_start = float(generator.choice([0.0, generator.uniform(0.0, 10.0)]))
    return Trial.plain(
        name,
        TrialKind.FORCED,
        outputs,
        time + clock_start,
        force=force,
        begins=begins,
        hold=hold,
    )


def draw_trial(
    generator: np.random.Generator,
    kind: TrialKind,
    name: str,
    outputs: Sequence[str],
    model: Model,
    samples_per_period: float,
) -> Trial:
    """Return a trial of a kind without its readings.

    Parameters
    ----------
    generator : numpy.random.Generator
        Random numbers.
    kind : TrialKind
        Static, ring-down or forced.
    name : str
        Name of the trial.
    outputs : sequence of str
        Channels.
    model : Model
        The rig.
    samples_per_period : float
        Samples in a period of the rig, for trials in time.
    """
    scales = model.scales(Campaign("", {}, (), None, {}, ""))
    frequency = scales.angular_frequency
    size = scales.length * 10.0 ** generator.uniform(-2.8, -1.6)
    assert model.load_places is not None, "a shipped rig names the places of its loads"
    load_place = str(generator.choice(model.load_places))
    start = float(generator.uniform(0.0, 5000.0))
    channels = tuple(outputs)
    stiffness = scales.tip_stiffness
    if kind is TrialKind.STATIC:
        trial = draw_load_test(generator, name, channels, start, size, stiffness)
    else:
        count = max(int(generator.uniform(4.5, 25.0) * samples_per_period), 10)
        time = sample_times(generator, 2.0 * np.pi / frequency / samples_per_period, count)
        if kind is TrialKind.RINGDOWN:
            trial = draw_release(generator, name, channels, time, size)
        else:
            trial = draw_forced_motion(generator, name, channels, time, frequency, size, stiffness)
    return replace(trial, load_place=load_place, start=start)


def readings_without_noise(
    generator: np.random.Generator, bare: Campaign, model: Model
) -> dict[str, Float]:
    """Return readings (n, C) by trial for drawn parameters and initial states, without errors."""
    values = [
        np.clip(generator.normal(prior.mean, prior.deviation), prior.low, prior.high)
        for prior in model.parameters
    ]
    readings = {}
    for trial in bare.trials:
        initial = prior_conditions(bare, model, trial).initial.copy()
        if trial.release is not None:
            deviation = trial.release.deviation * generator.standard_normal()
            if trial.release.at_rest:
                initial[0, 0] = deviation
            else:
                initial = 0.3 * generator.standard_normal(initial.shape)
                initial[0, 0] = 1.0 + deviation
        truth = Conditions(np.array(values), initial, (0.0, 0.0), trial.health)
        readings[trial.name] = observe(model, bare, trial, ModelPatch(), truth).values
    return readings


def draw_plan(generator: np.random.Generator, model: Model) -> tuple[Campaign, float]:
    """Return a campaign without readings, and the interval of its records [s]."""
    outputs = [str(name) for name in generator.permutation(list(model.quantities))]
    outputs = outputs[: int(generator.integers(1, len(outputs) + 1))]
    kinds = [KINDS[k] for k in generator.permutation(3)[: int(generator.integers(1, 4))]]
    samples_per_period = float(generator.choice([8, 12, 20, 50, 90]))
    scales = model.scales(Campaign("", {}, (), None, {}, ""))
    interval = 2.0 * np.pi / scales.angular_frequency / samples_per_period
    trials = []
    for kind in kinds:
        for number in range(int(generator.integers(1, 4))):
            name = f"{kind.value} {number}"
            trials.append(draw_trial(generator, kind, name, outputs, model, samples_per_period))
    channels = {name: Channel(name, model.quantities[name], name) for name in outputs}
    return Campaign("sound", channels, tuple(trials), None, {}, "0" * 64), interval


def draw_channel(
    generator: np.random.Generator,
    channel: Channel,
    deviation: float,
    interval: float,
    correlation: float,
) -> Channel:
    """Return a channel with what a campaign file states of it: zero, gain, unit and noise.

    Parameters
    ----------
    generator : numpy.random.Generator
        Random numbers.
    channel : Channel
        The channel with name and quantity.
    deviation : float
        True standard deviation of its noise.
    interval : float
        Interval of records [s].
    correlation : float
        Correlation of the noise over one interval.
    """
    zero = float(generator.choice([0.0, deviation, 5.0 * deviation, np.inf]))
    gain = float(generator.choice([0.0, 0.005, 0.05]))
    samples = np.arange(float(generator.choice([40, 200, 1000])))
    record = coloured_noise(generator, samples, correlation)
    known_noise = (
        pre_trigger_record(deviation * record, interval, channel.name, "noise.csv"),
        NoiseRecord(deviation * float(np.sqrt(generator.chisquare(50) / 50.0)), 50.0),
        NoiseRecord(deviation),
        None,
    )
    unit = str(generator.choice(UNITS.get(channel.quantity.value, ("",))))
    noise = known_noise[generator.integers(len(known_noise))]
    return replace(channel, noise=noise, gain_deviation=gain, offset_deviation=zero, unit=unit)


def draw_campaign(generator: np.random.Generator, model: Model) -> tuple[Campaign, NoiseTruth]:
    """Return a campaign on a model without faults or hidden effects, and its true noise."""
    bare, interval = draw_plan(generator, model)
    exact = readings_without_noise(generator, bare, model)
    noise = NoiseTruth(
        correlation=float(generator.choice([0.0, 0.0, 0.0, 0.5, 0.9, 0.98])),
        share=10.0 ** generator.uniform(-3.0, -0.7),
        digits=float(generator.choice([0.0, 0.0, 0.0, 0.3, 2.0])),
    )
    readings = {name: np.empty_like(values) for name, values in exact.items()}
    channels = {}
    for column, (name, bare_channel) in enumerate(bare.channels.items()):
        largest = max(float(np.abs(values[:, column]).max()) for values in exact.values())
        deviation = max(noise.share * largest, 1e-9)
        channel = draw_channel(generator, bare_channel, deviation, interval, noise.correlation)
        channels[name] = channel
        true_gain = 1.0 + channel.gain_deviation * generator.standard_normal()
        zero = channel.offset_deviation
        zero_deviation = zero if np.isfinite(zero) else 2.0 * largest
        digit = noise.digits * deviation
        for trial in bare.trials:
            # The load levels of a static trial are so far apart that no correlation is left
            noise_values = coloured_noise(generator, trial.time / interval, noise.correlation)
            offset = generator.standard_normal() * zero_deviation
            values = (
                true_gain * exact[trial.name][:, column]
                + offset
                + deviation * trial.noise_factor * noise_values
            )
            readings[trial.name][:, column] = np.round(values / digit) * digit if digit else values
    trials = tuple(replace(trial, values=readings[trial.name]) for trial in bare.trials)
    for name, channel in channels.items():
        if channel.noise is None:
            channels[name] = replace(channel, noise=repeat_record(channel, trials))
    return replace(bare, channels=channels, trials=trials), noise


def findings(campaign: Campaign, model: Model, seed: int) -> list[str]:
    """Return what the fit and `locate` find wrong with a campaign, or that it is nothing."""
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    best = fit(problem, Candidate(), problem.prior_mean_point(Candidate()))
    location = locate(residual_set(problem, best), seed=seed)
    gate = check_absolute_fit(
        problem, replace(best, residual_process=estimate_residual_process(problem, best))
    )
    is_found = {
        "not explained": gate.has_failed,
        "disagrees": location.disagrees,
        "discovery in the map": any(cell.significant for cell in location.cells),
    }
    return [name for name, value in is_found.items() if value] or ["nothing"]


def is_clear(campaign: Campaign, noise: NoiseTruth) -> bool:
    """Return whether a campaign is such that the fit must find nothing wrong."""
    records = [channel.noise for channel in campaign.channels.values()]
    has_records = all(
        record is not None and record.samples is not None and len(record.samples) >= RECORD
        for record in records
    )
    is_long = max(len(trial.time) for trial in campaign.trials) > LONGEST
    if noise.share > LOUDEST or noise.digits > 0.0 or is_long:
        return False
    return has_records or not noise.correlation


@dataclass
class Alarms:
    """Findings in all campaigns, and in those with white and coloured noise that are fitted.

    Attributes
    ----------
    counts : dict of str to Counter
        Number of campaigns with each finding, by group.
    campaigns : Counter
        Number of campaigns by group.
    """

    counts: dict[str, Counter[str]] = field(
        default_factory=lambda: {"all": Counter(), "white": Counter(), "coloured": Counter()}
    )
    campaigns: Counter[str] = field(default_factory=Counter)

    def check(self, campaign: Campaign, noise: NoiseTruth, model: Model, seed: int) -> None:
        """Check, and where that is fair fit and locate, a campaign, and count what is found."""
        marked = mark_outliers(campaign)
        faults = [*check_data(marked), *check_against_model(marked, model)]
        fatal = {f"{fault.kind.value}, fatal" for fault in faults if fault.fatal}
        counts = self.counts["all"]
        self.campaigns["all"] += 1
        counts.update(fatal)
        counts["any fatal"] += bool(fatal)
        counts["samples left out"] += any(not trial.used.all() for trial in marked.trials)
        if is_clear(marked, noise):
            colour = "coloured" if noise.correlation else "white"
            self.counts[colour].update(findings(marked, model, seed))
            self.campaigns[colour] += 1

    @property
    def are_few(self) -> bool:
        """Whether the shares of false alarms are at most `FATAL` and `LOCATED`."""
        white = [count for name, count in self.counts["white"].items() if name != "nothing"]
        worst = max(white, default=0) / max(self.campaigns["white"], 1)
        return self.counts["all"]["any fatal"] <= FATAL * self.campaigns["all"] and worst <= LOCATED


def main() -> int:
    """Run the study; return 1 if there are too many false alarms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    models = [load_model(name) for name in MODELS]
    alarms = Alarms()
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.campaigns):
        generator = np.random.default_rng([2026, seed])
        model = models[generator.integers(len(models))]
        try:
            campaign, noise = draw_campaign(generator, model)
            alarms.check(campaign, noise, model, seed)
        except DiscrepancyError as error:
            print(f"campaign {seed}: {error}")
            alarms.counts["all"]["refused"] += 1
    title = (
        f"{arguments.campaigns} sound campaigns, seeds from {arguments.first_seed}: "
        "what was found all the same"
    )
    table = Table("campaigns", "finding", "found", "of", title=title)
    for group, counts in alarms.counts.items():
        for name, number in counts.most_common():
            table.add_row(group, name, str(number), str(alarms.campaigns[group]))
    Console().print(table)
    return 0 if alarms.are_few else 1


if __name__ == "__main__":
    sys.exit(main())
