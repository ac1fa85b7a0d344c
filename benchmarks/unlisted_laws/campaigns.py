"""Campaigns with a law that the catalogue lacks: excitation, size of the law, and files."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.sizing import size_leaving, unexplained_rms
from benchmarks.unlisted_laws.kinds import KINDS, Kind
from benchmarks.unlisted_laws.rig import (
    ANGULAR_FREQUENCY,
    FORCE,
    INTERVAL,
    LENGTH,
    PARAMETERS,
    STAMPS,
    Excitation,
    FloatArray,
    Tones,
    Truth,
    model_text,
    motion,
)
from discrepancy.campaign.noise_records import pre_trigger_record
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.writing import write_campaign

GAPS = (5.0, 40.0)
"""Rms over the noise that a law leaves beside parameters, releases and zeros."""
NOISE = (0.0025, 0.005)
"""Noise over the largest reading of a channel without the law."""
NOISE_SAMPLES = 400
RELEASES = (LENGTH, 0.6 * LENGTH, 0.8 * LENGTH)
"""Displacements of the releases [m]."""
RELEASE_DEVIATION = 0.01
"""Prior deviation of a release over its displacement."""
FORCE_LEVELS = {True: (0.7, 1.0), False: (0.7, 1.0, 0.85)}
"""Largest command of each forced record over `FORCE`, with and without releases beside them."""
HELD_OUT = 2
"""Index of the trial that is held out."""
TONES = (0.4, 0.75, 1.5)
"""Angular frequencies of the tones of a force over that of the rig, each drawn within 10 %."""
ZERO = 2.0
"""Prior deviation of a zero over the noise."""


@dataclass(frozen=True)
class Experiment:
    """The trials of a campaign, its sensors, and what is true.

    Attributes
    ----------
    kind : Kind
        Kind of the hidden law.
    truth : Truth
        Parameters and hidden law.
    excitations : list of Excitation
        Excitation of each trial; releases come first.
    noise : (C,) array
        Standard deviation of each channel [SI].
    gap : float
        Rms over the noise that the law leaves beside the nuisances.
    """

    kind: Kind
    truth: Truth
    excitations: list[Excitation]
    noise: FloatArray
    gap: float = 0.0


def draw_tones(generator: np.random.Generator, largest: float) -> Tones:
    """Return a force of three tones whose largest magnitude at the samples is `largest` [N]."""
    angular_frequencies = ANGULAR_FREQUENCY * np.array(TONES) * generator.uniform(0.9, 1.1, 3)
    amplitudes = generator.uniform(0.6, 1.4, 3) * generator.choice((-1.0, 1.0), 3)
    peak = max(abs(Tones(amplitudes, angular_frequencies).force(float(t))) for t in STAMPS)
    return Tones(amplitudes * largest / peak, angular_frequencies)


def draw_excitations(kind: Kind, generator: np.random.Generator) -> list[Excitation]:
    """Return the excitations of the trials of a kind, with true releases."""
    excitations = []
    if kind.has_releases:
        for displacement in RELEASES:
            error = RELEASE_DEVIATION * float(generator.standard_normal())
            excitations.append(Excitation(release=displacement * (1.0 + error)))
    for level in FORCE_LEVELS[kind.has_releases]:
        command = draw_tones(generator, level * FORCE)
        rod = draw_tones(generator, level * FORCE) if kind.has_rod else Tones()
        excitations.append(Excitation(command=command, rod=rod))
    return excitations


def readings(kind: Kind, truth: Truth, excitations: list[Excitation]) -> FloatArray:
    """Return the readings (T, n, C) of all trials without errors [SI]."""
    channel_count = 2 if kind.has_accelerometer else 1
    return np.array([motion(truth, excitation)[:, :channel_count] for excitation in excitations])


def nuisances(experiment: Experiment) -> FloatArray:
    """Return the changes (N, K) of the readings by one prior deviation of each nuisance.

    Nuisances are the parameters, the releases and the zeros; the changes are in units of the noise.
    """
    truth = experiment.truth
    bare = readings(experiment.kind, truth, experiment.excitations)
    changes = []
    for name, deviation in PARAMETERS.items():
        moved = replace(truth, **{name: getattr(truth, name) + deviation})
        changes.append(readings(experiment.kind, moved, experiment.excitations) - bare)
    for trial, excitation in enumerate(experiment.excitations):
        if excitation.release:
            change = np.zeros_like(bare)
            change[trial] = RELEASE_DEVIATION * bare[trial]  # without a law the motion is linear
            changes.append(change)
        for channel, noise in enumerate(experiment.noise):
            change = np.zeros_like(bare)
            change[trial, :, channel] = ZERO * noise
            changes.append(change)
    return np.column_stack([(change / experiment.noise).ravel() for change in changes])


def drawn(name: str, seed: int) -> Experiment:
    """Return the campaign of a kind and seed, with a law that leaves a gap within `GAPS`.

    Parameters
    ----------
    name : str
        Name of the kind.
    seed : int
        Seed of the set of campaigns.
    """
    kind = KINDS[name]
    generator = np.random.default_rng([seed, list(KINDS).index(name)])
    factors = {
        parameter: 1.0 + deviation * float(np.clip(generator.standard_normal(), -2.0, 2.0))
        for parameter, deviation in PARAMETERS.items()
    }
    bare_truth = Truth(stiffness=factors["stiffness"], damping=factors["damping"])
    excitations = draw_excitations(kind, generator)
    bare = readings(kind, bare_truth, excitations)
    noise = generator.uniform(*NOISE) * np.abs(bare).max(axis=(0, 1))
    experiment = Experiment(kind, bare_truth, excitations, noise)

    law = kind.laws[seed % len(kind.laws)]
    shape = float(np.exp(generator.uniform(*np.log(kind.shapes))))
    wanted = float(np.exp(generator.uniform(*np.log(GAPS))))
    nuisance_changes = nuisances(experiment)

    def with_size(size: float) -> Truth:
        return replace(bare_truth, law=law, size=size, shape=shape)

    def unexplained(size: float) -> float:
        change = (readings(kind, with_size(size), excitations) - bare) / noise
        return unexplained_rms(change.ravel(), nuisance_changes)

    size, gap = size_leaving(wanted, kind.largest, unexplained)
    return replace(experiment, truth=with_size(size), gap=gap)


def write(folder: Path, experiment: Experiment, seed: int) -> None:
    """Write a campaign and its model file to a folder.

    Parameters
    ----------
    folder : Path
        The folder.
    experiment : Experiment
        Trials, sensors and truth.
    seed : int
        Seed of the errors of the readings.
    """
    kind = experiment.kind
    generator = np.random.default_rng([seed, list(KINDS.values()).index(kind), 1])
    channels = {}
    quantities = (Quantity.DISPLACEMENT, Quantity.ACCELERATION)
    for quantity, noise in zip(quantities, experiment.noise, strict=False):
        at_rest = noise * generator.standard_normal(NOISE_SAMPLES)
        channels[quantity.value] = Channel(
            name=quantity.value,
            quantity=quantity,
            output=quantity.value,
            noise=pre_trigger_record(at_rest, INTERVAL, quantity.value, "the samples at rest"),
            offset_deviation=ZERO * float(noise),
        )
    trials = []
    exact = readings(kind, experiment.truth, experiment.excitations)
    for index, (excitation, values) in enumerate(zip(experiment.excitations, exact, strict=True)):
        zeros = ZERO * experiment.noise * generator.standard_normal(len(channels))
        noise = experiment.noise * generator.standard_normal(values.shape)
        trial = trial_of(kind, excitation, index, tuple(channels))
        trials.append(replace(trial, values=values + zeros + noise))
    campaign = Campaign(
        name="A mass on a spring",
        channels=channels,
        trials=tuple(trials),
        reference_temperature=None,
        parameters={},
        data_hash="",
    )
    write_campaign(campaign, folder)
    text = model_text(has_accelerometer=kind.has_accelerometer, has_rod=kind.has_rod)
    (folder / "model.toml").write_text(text, "utf-8")


def trial_of(kind: Kind, excitation: Excitation, index: int, channels: tuple[str, ...]) -> Trial:
    """Return a trial without readings: a release, or a record under one or two recorded forces.

    Parameters
    ----------
    kind : Kind
        Kind of the hidden law, which says what is recorded.
    excitation : Excitation
        The excitation; of a release the nominal displacement is stated.
    index : int
        Index of the trial.
    channels : tuple of str
        Names of the channels.
    """
    start = 600.0 * index
    held_out = index == HELD_OUT
    if excitation.release:
        release = Release(RELEASES[index], deviation=RELEASE_DEVIATION)
        return Trial.plain(
            f"release {index + 1}",
            TrialKind.RINGDOWN,
            channels,
            STAMPS,
            release=release,
            start=start,
            held_out=held_out,
        )
    name = f"shaker {index + 1}"
    command = np.array([excitation.command.force(float(t)) for t in STAMPS])
    if not kind.has_rod:
        return Trial.plain(
            name,
            TrialKind.FORCED,
            channels,
            STAMPS,
            force=command,
            hold=Hold.SMOOTH,
            begins=Start.STILL,
            start=start,
            held_out=held_out,
        )
    rod = np.array([excitation.rod.force(float(t)) for t in STAMPS])
    inputs = []
    for input_name, values in (("shaker", command), ("rod", rod)):
        inputs.append(
            RecordedInput(name=input_name, quantity=Quantity.FORCE, values=values, hold=Hold.SMOOTH)
        )
    return Trial.plain(
        name,
        TrialKind.DRIVEN,
        channels,
        STAMPS,
        inputs=tuple(inputs),
        begins=Start.STILL,
        start=start,
        held_out=held_out,
    )
