"""Readings of instruments: hidden faults, then gains, zeros and noise as in any campaign."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.plan import CampaignPlan, TrialPlan
from benchmarks.blind.structure import Structure

FloatArray = NDArray[np.float64]
Signals = dict[str, FloatArray]

FILTER_SPLIT = 8
"""Rows per sample where a channel has a filter."""
NOISE_FREEDOM = 200
"""Degrees of freedom of noise deviations that are stated in the campaign file."""
RELEASE_ERROR, RELEASE_PLACE_ERROR = 0.02, 0.004
"""Standard deviations of a release's amplitude [1] and place [m]."""


class Rig(Protocol):
    """A structure that campaigns are made of."""

    name: str
    outputs: tuple[str, ...]

    def structure(
        self, parameters: Mapping[str, float], changes: Changes, temperature: float = 0.0
    ) -> Structure:
        """Return the structure at a temperature above the reference."""

    def respond(
        self,
        structure: Structure,
        changes: Changes,
        trial: TrialPlan,
        amplitude: float = 0.0,
        place_error: float = 0.0,
        split: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs of a trial in SI units."""


@dataclass(frozen=True)
class Chance:
    """What is drawn of the rig and the day, whatever is hidden: parameters, releases."""

    parameters: Mapping[str, float]
    amplitude: Mapping[str, float] = field(default_factory=dict)
    place_error: Mapping[str, float] = field(default_factory=dict)


def draw_chance(generator: np.random.Generator, plan: CampaignPlan) -> Chance:
    """Draw the calibrated parameters from their prior, within 2.5 deviations, and the releases."""
    parameters = {}
    for name, (mean, deviation) in plan.priors.items():
        z = float(generator.standard_normal())
        while abs(z) > 2.5:
            z = float(generator.standard_normal())
        parameters[name] = mean + deviation * z
    rings = [trial for trial in plan.trials if trial.kind == "ringdown"]
    return Chance(
        parameters,
        {
            t.name: t.release * (1.0 + RELEASE_ERROR * float(generator.standard_normal()))
            for t in rings
        },
        {t.name: RELEASE_PLACE_ERROR * float(generator.standard_normal()) for t in rings},
    )


def true_signals(rig: Rig, plan: CampaignPlan, chance: Chance, changes: Changes) -> Signals:
    """Return readings without noise by trial, arrays (rows, channels) in the channels' units."""
    temperatures = {trial.temperature for trial in plan.trials}
    structures = {t: rig.structure(chance.parameters, changes, t) for t in temperatures}
    filtered = {
        name for fault in changes.faults if fault.kind == "high_pass" for name in fault.channels
    }
    index = {output: k for k, output in enumerate(rig.outputs)}
    signals = {}
    for trial in plan.trials:
        split = 1
        if trial.kind == "ringdown" and filtered & set(trial.channels):
            split = FILTER_SPLIT
        amplitude = chance.amplitude.get(trial.name, 0.0)
        outputs, _ = rig.respond(
            structures[trial.temperature],
            changes,
            trial,
            amplitude,
            chance.place_error.get(trial.name, 0.0),
            split,
        )
        columns = [index[plan.channels[name].output] for name in trial.channels]
        scales = np.array([plan.channels[name].scale for name in trial.channels])
        values = outputs[:, columns] / scales
        for fault in changes.faults:
            for column, name in enumerate(trial.channels):
                if name in fault.channels:
                    _apply(
                        fault,
                        values[:, column],
                        plan,
                        trial,
                        amplitude,
                        plan.channels[name].scale,
                        split,
                    )
        signals[trial.name] = values[::split]
    return signals


def _apply(
    fault: Fault,
    values: FloatArray,
    plan: CampaignPlan,
    trial: TrialPlan,
    amplitude: float,
    scale: float,
    split: int,
) -> None:
    """Apply a fault in place to the values of a channel [its unit]; the fault's numbers are SI."""
    ring = trial.kind == "ringdown"
    times = (
        np.linspace(trial.rows[0], trial.rows[-1], len(values)) if ring else trial.campaign_times
    )
    first = fault.numbers[0]
    if fault.kind == "gain":
        values *= 1.0 + first
    elif fault.kind == "drift":
        since = times + trial.start if ring else times
        values += first * (since / plan.duration) ** fault.numbers[1]
    elif fault.kind == "thermal":
        values += first * trial.temperature / scale
    elif fault.kind == "offset" and trial.kind == "static" and trial.run == fault.run:
        values += first / scale
    elif fault.kind == "line" and ring:
        angle = 2.0 * np.pi * first * times
        values += fault.numbers[1] * np.cos(angle) + fault.numbers[2] * np.sin(angle)
    elif fault.kind == "mode" and ring:
        _, ratio, cosine, sine = fault.numbers
        w = 2.0 * np.pi * first
        angle = w * np.sqrt(1.0 - ratio**2) * times
        wave = cosine * np.cos(angle) + sine * np.sin(angle)
        values += amplitude * np.exp(-ratio * w * times) * wave
    elif fault.kind == "high_pass" and ring:
        step = (times[-1] - times[0]) / (len(times) - 1)
        memory = float(np.exp(-step / first))
        rise = np.diff(values, prepend=values[0]) * first / step * (1.0 - memory)
        values[:] = lfilter([1.0], [1.0, -memory], rise)


@dataclass(frozen=True)
class Measured:
    """A measured campaign.

    Attributes
    ----------
    values : mapping of str to (rows, channels)
        By trial, in the channels' units.
    noise : mapping of str to (n,)
        Noise record, by channel of ring-downs.
    stated : mapping of str to float
        Noise deviations that the campaign file states, by channel.
    """

    values: Signals
    noise: Signals
    stated: Mapping[str, float]


def coloured(generator: np.random.Generator, count: int, correlation: float) -> FloatArray:
    """Return unit noise (count,) of a first-order autoregression with correlation `correlation`."""
    white = generator.standard_normal(count + 50)
    return np.asarray(lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white))[50:]


def measure(
    generator: np.random.Generator,
    plan: CampaignPlan,
    signals: Signals,
    changes: Changes,
    correlation: float = 0.0,
    noise_factor: float = 1.0,
) -> Measured:
    """Add gains, zeros and noise to true signals.

    Parameters
    ----------
    generator : numpy Generator
        Source of chance.
    plan : CampaignPlan
        Channels and trials.
    signals : Signals
        `true_signals`.
    changes : Changes
        Lines in them are in the noise record too, with another phase.
    correlation : float
        Between successive samples of the noise of ring-downs and of the noise record.
    noise_factor : float
        True noise over the one that the channels are planned with.
    """
    gain = {
        c.name: 1.0 + c.gain * float(generator.standard_normal()) for c in plan.channels.values()
    }
    values = {}
    for trial in plan.trials:
        channels = [plan.channels[name] for name in trial.channels]
        clean = signals[trial.name]
        noise = np.empty_like(clean)
        for column in range(clean.shape[1]):
            noise_correlation = correlation if trial.kind == "ringdown" else 0.0
            noise[:, column] = coloured(generator, len(clean), noise_correlation)
        zero = np.array([c.offset for c in channels]) * generator.standard_normal(len(channels))
        deviation = noise_factor * np.array([c.noise for c in channels])
        values[trial.name] = clean * [gain[c.name] for c in channels] + zero + noise * deviation
    record = {}
    times = np.arange(plan.noise_samples) / plan.rate
    for name in plan.dynamic_channels:
        samples = (
            noise_factor * plan.channels[name].noise * coloured(generator, len(times), correlation)
        )
        for fault in changes.faults:
            if fault.kind == "line" and name in fault.channels:
                size = float(np.hypot(fault.numbers[1], fault.numbers[2]))
                phase = float(generator.uniform(0.0, 2.0 * np.pi))
                samples = samples + size * np.cos(2.0 * np.pi * fault.numbers[0] * times + phase)
        record[name] = samples
    spread = np.sqrt(generator.chisquare(NOISE_FREEDOM, len(plan.channels)) / NOISE_FREEDOM)
    stated = {
        c.name: c.noise * float(s) for c, s in zip(plan.channels.values(), spread, strict=True)
    }
    return Measured(values, record, stated)
