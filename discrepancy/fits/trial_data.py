"""A trial ready to be compared: noise of its channels, samples that count, unknowns.

Each unknown is a scaled variable u with prior N(0, 1), or flat where nothing is known; the value is
centre + scale u. Global ones, which every hypothesis shares: calibrated parameters, gains of channels. Local
to a trial: zeros of its channels, initial state and time zero of a ring-down, an unknown initial state and
constants of inputs of a driven trial, health where it is uncertain.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from math import inf, isinf, prod

import numpy as np

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import Campaign, FloatArray, IntArray, Quantity, Start, Trial, TrialKind
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions

FREE_MOTION = 3.0
"""Prior deviation of a free initial state, in units of the release displacement."""
LEAST_LOSS, LARGEST_LOSS = -0.5, 0.95
"""Limits of an uncertain stiffness loss. A loss below zero means nothing, but a limit at zero, where most of
a flight is, would stop fits: half of the readings of a healthy wing pull below it."""


@dataclass(frozen=True)
class GlobalUnknowns:
    """Layout of the global unknowns: calibrated parameters, then gains of channels.

    Attributes
    ----------
    centre, scale, precision : (Q,) ndarray
        Prior means (of gains their errors), deviations, and precisions of the scaled variables: 1, or 0 for a
        flat prior.
    low, high : (P,) ndarray
        Ranges of the calibrated parameters.
    gain_channels : tuple of str
        Channels whose gain is unknown.
    fixed_gain : dict of str to float
        Gain errors of signals that define the scale of the release amplitudes, which are not fitted.
    """

    centre: FloatArray
    scale: FloatArray
    precision: FloatArray
    low: FloatArray
    high: FloatArray
    gain_channels: tuple[str, ...]
    fixed_gain: dict[str, float]

    @property
    def size(self) -> int:
        """Number of global unknowns."""
        return len(self.scale)

    @property
    def count(self) -> int:
        """Number P of calibrated parameters."""
        return len(self.low)

    @cached_property
    def ends(self) -> FloatArray:
        """Least and greatest of the scaled variables (2, Q), by the ranges of the model."""
        found = np.tile([[-inf], [inf]], self.size)
        free = np.flatnonzero(self.scale[: self.count])
        ends = np.array([self.low, self.high])
        found[:, free] = (ends[:, free] - self.centre[free]) / self.scale[free]
        return found

    def parameters(self, u: FloatArray) -> FloatArray:
        """Return the calibrated parameters, kept within the range of the model."""
        return np.clip((self.centre + self.scale * u)[: self.count], self.low, self.high)

    def gains(self, u: FloatArray, channels: tuple[str, ...]) -> FloatArray:
        """Return the gain errors (C,) of channels."""
        values = (self.centre + self.scale * u)[self.count :]
        found = self.fixed_gain | dict(zip(self.gain_channels, values, strict=True))
        return np.array([found.get(name, 0.0) for name in channels])


@dataclass(frozen=True)
class LocalUnknowns:
    """Unknowns of one trial: zeros, initial state, constants of inputs, time zero, health, in this order.

    Attributes
    ----------
    scale, precision : (L,) ndarray
        Value of a unit of each scaled variable, and its prior precision.
    zero_columns : (Z,) ndarray of int
        Columns whose zero is unknown.
    initial_shape : tuple of int
        (R, 1) or (R, 2): entries of the initial state that are unknown.
    offset_inputs : (O,) ndarray of int
        Recorded inputs that lack a constant.
    has_time_zero : bool
        Whether it is unknown.
    health_rows, health_columns : (H,) ndarray of int
        Uncertain entries of the health, those of the first region first.
    """

    scale: FloatArray
    precision: FloatArray
    zero_columns: IntArray
    initial_shape: tuple[int, int]
    offset_inputs: IntArray
    has_time_zero: bool
    health_rows: IntArray
    health_columns: IntArray

    @property
    def size(self) -> int:
        """Number of local unknowns."""
        return len(self.scale)

    @property
    def zeros(self) -> int:
        """Number Z of unknown zeros."""
        return len(self.zero_columns)

    @cached_property
    def ends(self) -> list[int]:
        """Where zeros, initial state, constants of inputs and time zero end."""
        counts = (self.zeros, prod(self.initial_shape), len(self.offset_inputs), self.has_time_zero)
        return list(accumulate(counts))

    def zero(self, u: FloatArray, columns: int) -> FloatArray:
        """Return the zeros (C,) of the trial's channels."""
        values = np.zeros(columns)
        values[self.zero_columns] = (self.scale * u)[: self.zeros]
        return values

    def conditions(self, trial: Trial, parameters: FloatArray, u: FloatArray) -> Conditions:
        """Return the conditions of the trial's response."""
        _, entries, constants, time_zero, losses = np.split(self.scale * u, self.ends)
        rows, width = self.initial_shape
        initial, offset = np.zeros((rows, 2)), np.zeros(len(trial.inputs))
        initial[:, :width] = entries.reshape(rows, width)
        offset[self.offset_inputs] = constants
        health = trial.health[:1] if trial.is_dynamic else trial.health
        if losses.size:
            health = health.copy()
            entry = (self.health_rows, self.health_columns)
            health[entry] = np.clip(health[entry] + losses, LEAST_LOSS, LARGEST_LOSS)
        times = (0.0, float(time_zero.sum()))
        return Conditions(parameters, initial, times, health, tuple(offset.tolist()))


def global_unknowns(
    campaign: Campaign, model: Model, trials: tuple[Trial, ...], unit_responses: dict[str, float]
) -> GlobalUnknowns:
    """Return the layout of the global unknowns.

    Parameters
    ----------
    campaign : Campaign
        Its `parameters` replace priors of the model.
    model : Model
        With calibrated parameters.
    trials : tuple of Trial
        Trials that are fitted; only gains of channels in them are unknowns.
    unit_responses : dict of str to float
        For signals of unknown scale: data over model, as a first estimate of 1 + gain.
    """
    rows = [(*prior, 1.0) for prior in model.stated(campaign)]  # centre, scale, precision
    used = {name for trial in trials for name in trial.channels}
    names: list[str] = []
    fixed: dict[str, float] = {}
    for name, channel in campaign.channels.items():
        estimate = unit_responses.get(name, 1.0) - 1.0
        free = isinf(channel.gain_deviation)
        if name not in used or channel.gain_deviation == 0.0:
            continue
        if free and channel.quantity is Quantity.SIGNAL and not fixed:
            fixed[name] = estimate  # it defines the scale of the release amplitudes
            continue
        names.append(name)
        flat = (estimate, max(abs(1.0 + estimate), 1e-12), 0.0)
        rows.append(flat if free else (0.0, channel.gain_deviation, 1.0))
    centre, scale, precision = np.array(rows, dtype=np.float64).reshape(-1, 3).T
    ranges = np.array([(item.low, item.high) for item in model.parameters], dtype=np.float64)
    low, high = ranges.reshape(-1, 2).T
    return GlobalUnknowns(centre, scale, precision, low, high, tuple(names), fixed)


def local_unknowns(campaign: Campaign, trial: Trial, deviation: FloatArray, model: Model) -> LocalUnknowns:
    """Return the layout of the unknowns of one trial; `deviation` (C,) scales zeros nothing is known of."""
    zeros = np.array([campaign.channels[name].offset_deviation for name in trial.channels])
    columns = np.flatnonzero(zeros > 0.0)
    free = np.isinf(zeros[columns])
    release = trial.release if trial.kind is TrialKind.RINGDOWN else None
    shape, entries, time_zero = (0, 1), np.zeros(0), np.zeros(0)
    if release is not None:
        shape = (release.mode_count, 1 if release.at_rest else 2)
        entries = np.full(prod(shape), release.deviation if release.at_rest else FREE_MOTION)
        time_zero = np.full(int(release.time_zero_deviation > 0.0), release.time_zero_deviation)
    elif trial.begins is Start.UNKNOWN:
        sizes = model.initial_sizes(campaign, trial)
        shape = (-(-len(sizes) // 2), 2)
        entries = FREE_MOTION * np.pad(sizes, (0, len(sizes) % 2))
    offsets = np.array([item.offset_deviation for item in trial.inputs])
    inputs = np.flatnonzero(offsets > 0.0)
    uncertain = trial.health_deviation[:1] if trial.is_dynamic else trial.health_deviation
    of_health, rows = np.nonzero(uncertain.T)  # region by region, as their derivatives are taken
    known = np.where(free, deviation[columns], zeros[columns])
    scale = np.concatenate((known, entries, offsets[inputs], time_zero, uncertain[rows, of_health]))
    precision = np.concatenate((~free, np.ones(len(scale) - len(free))))
    return LocalUnknowns(scale, precision, columns, shape, inputs, bool(time_zero.size), rows, of_health)


@dataclass(frozen=True, eq=False)
class TrialData:
    """One trial, ready to be compared.

    Attributes
    ----------
    trial : Trial
        As measured.
    deviation : (C,) ndarray
        s0 of each column, of the whitened samples in dynamic trials [channel's unit].
    groups : (C,) ndarray of int
        Noise group (channel number) of each column.
    unknowns : LocalUnknowns
        Of this trial.
    weight : (N, C) ndarray
        1 where a sample counts, else 0.
    """

    trial: Trial
    deviation: FloatArray
    groups: IntArray
    unknowns: LocalUnknowns
    weight: FloatArray
    noise: tuple[NoiseModel, ...]

    def standardised(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) over s0, whitened in time, zero where a sample does not count."""
        scaled = columns / self.deviation
        for number, noise in enumerate(self.noise):
            if noise.applies(self.trial.whitened_at):
                scaled[..., number] = noise.whiten(scaled[..., number], self.trial.whitened_at)
        return np.asarray(scaled * self.weight)

    @classmethod
    def of(
        cls, campaign: Campaign, trial: Trial, models: Mapping[str, NoiseModel], model: Model
    ) -> "TrialData":
        """Return a trial of a campaign with its noise, by the noise models of the channels."""
        names = list(campaign.channels)
        noise = tuple(models[name] for name in trial.channels)
        whitened = [item.applies(trial.whitened_at) for item in noise]
        single, innovation = [m.static_deviation for m in noise], [m.standard_deviation for m in noise]
        deviation = trial.noise_factor * np.where(whitened, innovation, single)
        groups = np.array([names.index(name) for name in trial.channels])
        weight = trial.used.astype(np.float64)
        for number in np.flatnonzero(whitened):  # the filter smears what is left out over its order
            for row in np.flatnonzero(~trial.used[:, number]):
                weight[row : row + len(noise[number].autoregression) + 1, number] = 0.0
        return cls(trial, deviation, groups, local_unknowns(campaign, trial, deviation, model), weight, noise)


def stand_in(campaign: Campaign, name: str) -> float:
    """Return what stands in for a noise deviation of which nothing is known: a thousandth of the range."""
    return 1e-3 * max(1e-12, *(float(np.ptp(values)) for _, values, _ in campaign.records(name)))
