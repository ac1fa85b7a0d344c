"""A trial ready to be compared: noise of its channels, own unknowns, samples that count."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.noise import NoiseModel, noise_model
from discrepancy.campaign.records import Campaign, FloatArray, Trial
from discrepancy.models.interface import Model

from .unknowns import LocalUnknowns, local_unknowns

IntArray = NDArray[np.int64]


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

    @cached_property
    def by_zero(self) -> FloatArray:
        """Standardised derivatives (C, N) by each channel's zero, nought without one; they never change."""
        scale = np.zeros(len(self.deviation))
        scale[self.unknowns.zero_columns] = self.unknowns.zero_scale
        return np.ascontiguousarray(self.standardised(np.broadcast_to(scale, self.weight.shape)).T)

    @cached_property
    def steps(self) -> FloatArray:
        """Time since the sample before (N,) [s], of a dynamic trial; nought at the first."""
        trial = self.trial
        even = np.full(len(trial.time), trial.interval)
        given = np.diff(trial.time, prepend=trial.time[0])
        # stamps are rounded: samples that are even within that share one step
        found = even if np.all(np.abs(given[1:] - even[1:]) < 1e-3 * even[1:]) else given
        return np.concatenate((np.zeros(1), found[1:]))

    def standardised(self, columns: FloatArray, channels: Sequence[int] | None = None) -> FloatArray:
        """Return columns (..., N, C) over s0, whitened in time, zero where a sample does not count.

        With `channels`, the columns are theirs only.
        """
        chosen = range(len(self.deviation)) if channels is None else channels
        at = slice(None) if channels is None else list(channels)
        scaled = columns / self.deviation[at]
        interval = self.trial.whitened_at
        if interval is not None:
            for number, channel in enumerate(chosen):
                noise = self.noise[channel]
                if noise.applies(interval):
                    scaled[..., number] = noise.whiten(scaled[..., number], interval)
        return np.asarray(scaled * self.weight[:, at])

    @classmethod
    def of(
        cls, campaign: Campaign, trial: Trial, models: Mapping[str, NoiseModel], model: Model
    ) -> "TrialData":
        """Return a trial of a campaign with its noise, by the noise models of the channels."""
        names = list(campaign.channels)
        noise = tuple(models[name] for name in trial.channels)
        interval = trial.whitened_at
        deviation = trial.noise_factor * np.array(
            [
                item.standard_deviation
                if interval is not None and item.applies(interval)
                else item.static_deviation
                for item in noise
            ]
        )
        groups = np.array([names.index(name) for name in trial.channels])
        weight = trial.used.astype(np.float64)
        if interval is not None:  # the filter smears what is left out over its order
            for number, item in enumerate(noise):
                if item.applies(interval):
                    for row in np.flatnonzero(~trial.used[:, number]):
                        weight[row : row + len(item.autoregression) + 1, number] = 0.0
        return cls(trial, deviation, groups, local_unknowns(campaign, trial, deviation, model), weight, noise)


def noise_models(campaign: Campaign) -> dict[str, NoiseModel]:
    """Return the noise of every channel of a campaign."""
    return {
        name: noise_model(channel, stand_in(campaign, name)) for name, channel in campaign.channels.items()
    }


def stand_in(campaign: Campaign, name: str) -> float:
    """Return what stands in for a noise deviation of which nothing is known: a thousandth of the range."""
    spans = [
        float(np.ptp(trial.values[:, trial.channels.index(name)]))
        for trial in campaign.trials
        if name in trial.channels
    ]
    return 1e-3 * max([*spans, 1e-12])


def shortened(trial: Trial, count: int) -> Trial:
    """Return the first rows of a trial."""
    rows = ("values", "used", "time", "force", "load_factor", "temperature", "health", "health_deviation")
    inputs = tuple(replace(item, values=item.values[:count]) for item in trial.inputs)
    return replace(trial, inputs=inputs, **{name: getattr(trial, name)[:count] for name in rows})
