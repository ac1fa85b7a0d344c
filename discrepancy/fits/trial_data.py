"""Trials with all that is needed to compare them with a model: noise, used samples, and unknowns.

Each unknown is a scaled variable u with the prior N(0, 1), or a flat prior if nothing is known of
it. Its value is centre + scale u. *Shared* unknowns have the same value in all hypotheses and
trials: calibrated parameters and gains of channels. *Local* unknowns belong to one trial: zeros of
its channels, an unknown initial state, the time of release of a ring-down, constants to be added to
recorded inputs, and uncertain health (stiffness losses).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import inf, isinf, prod
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import (
    Campaign,
    FloatArray,
    IntArray,
    Quantity,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.search_settings import SEARCH
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions

FREE_STATE_DEVIATION = 3.0
"""Prior deviation of a free initial state, in units of the release displacement."""
LEAST_LOSS = -0.5
"""Lower limit of an uncertain stiffness loss. A loss below zero has no physical meaning. But with a
limit at zero, the loss of a healthy wing, fits would stop there: by noise about half of the
readings give a loss below zero. The evidence does not count such losses."""
LARGEST_LOSS = 0.95
"""Upper limit of an uncertain stiffness loss."""


class ScaledPrior(NamedTuple):
    """The prior of a shared unknown whose value is centre + scale u.

    Attributes
    ----------
    centre, scale : float
        The prior mean and standard deviation of the value.
    precision : float
        The prior precision of u: 1, or 0 for a flat prior.
    """

    centre: float
    scale: float
    precision: float


@dataclass(frozen=True)
class SharedUnknowns:
    """The layout of the unknowns that all hypotheses and trials share.

    First come the P calibrated parameters, then the gains of channels.

    Attributes
    ----------
    centre : (Q,) array
        The prior means. For a gain, this is the mean of its error, gain - 1.
    scale : (Q,) array
        The prior standard deviations.
    precision : (Q,) array
        The prior precisions of the scaled variables: 1, or 0 for a flat prior.
    low, high : (P,) array
        The ranges of the calibrated parameters.
    gain_channels : tuple of str
        The channels whose gain is unknown.
    fixed_gain : dict of str to float
        The gain errors, by channel, that are not fitted: that of a signal of unknown scale which
        defines the scale of the release amplitudes.
    """

    centre: FloatArray
    scale: FloatArray
    precision: FloatArray
    low: FloatArray
    high: FloatArray
    gain_channels: tuple[str, ...]
    fixed_gain: dict[str, float]

    @property
    def unknown_count(self) -> int:
        """The number Q of shared unknowns."""
        return len(self.scale)

    @property
    def parameter_count(self) -> int:
        """The number P of calibrated parameters."""
        return len(self.low)

    @cached_property
    def bounds(self) -> FloatArray:
        """The least and largest value of each scaled variable, (2, Q).

        They come from the ranges of the calibrated parameters; gains have no limits.
        """
        scaled_ends = np.tile([[-inf], [inf]], self.unknown_count)
        uncertain = np.flatnonzero(self.scale[: self.parameter_count])
        physical_ends = np.array([self.low, self.high])
        centre = self.centre[uncertain]
        scaled_ends[:, uncertain] = (physical_ends[:, uncertain] - centre) / self.scale[uncertain]
        return scaled_ends

    def parameters(self, scaled_values: FloatArray) -> FloatArray:
        """Return the calibrated parameters (P,), given the scaled shared unknowns (Q,).

        Parameters beyond their ranges are clipped.
        """
        values = self.centre + self.scale * scaled_values
        return np.clip(values[: self.parameter_count], self.low, self.high)

    def gains(self, scaled_values: FloatArray, channels: tuple[str, ...]) -> FloatArray:
        """Return the gain errors (C,) of channels, given the scaled shared unknowns (Q,)."""
        values = self.centre + self.scale * scaled_values
        fitted_gains = values[self.parameter_count :]
        gains = self.fixed_gain | dict(zip(self.gain_channels, fitted_gains, strict=True))
        return np.array([gains.get(name, 0.0) for name in channels])


class LocalIndices(NamedTuple):
    """The indices of each kind of unknown among the unknowns of one trial."""

    zeros: range
    initial_state: range
    input_constants: range
    time_zero: range
    health: range


@dataclass(frozen=True)
class LocalUnknowns:
    """The layout of the unknowns of one trial.

    They are zeros, initial state, constants of inputs, time zero and health, in this order.

    Attributes
    ----------
    scale : (L,) array
        The prior standard deviations of the unknowns.
    precision : (L,) array
        The prior precisions of the scaled variables: 1, or 0 for a flat prior.
    zero_columns : (Z,) array of int
        The columns of channels whose zero is unknown.
    initial_shape : tuple of int
        The shape of the unknown entries of the initial state: (R, 1) for displacements, (R, 2) for
        displacements and velocities.
    offset_inputs : (O,) array of int
        The indices of the recorded inputs to which an unknown constant is added.
    has_time_zero : bool
        Whether the time of the release is unknown.
    health_rows, health_columns : (H,) array of int
        The row and column (region) of each uncertain entry of the health, those of the first region
        first.
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
    def unknown_count(self) -> int:
        """The number L of local unknowns."""
        return len(self.scale)

    @property
    def zero_count(self) -> int:
        """The number Z of unknown zeros."""
        return len(self.zero_columns)

    @cached_property
    def indices(self) -> LocalIndices:
        """The indices of each kind of unknown among the local unknowns (L,)."""
        counts = (
            self.zero_count,
            prod(self.initial_shape),
            len(self.offset_inputs),
            int(self.has_time_zero),
            len(self.health_rows),
        )
        ends = list(accumulate(counts))
        return LocalIndices(*map(range, [0, *ends[:-1]], ends))

    def channel_zeros(self, scaled_values: FloatArray, channel_count: int) -> FloatArray:
        """Return the zeros (C,) of the trial's channels, given its scaled unknowns (L,)."""
        zeros = np.zeros(channel_count)
        zeros[self.zero_columns] = (self.scale * scaled_values)[self.indices.zeros]
        return zeros

    def conditions(
        self, trial: Trial, parameters: FloatArray, scaled_values: FloatArray
    ) -> Conditions:
        """Return the conditions of a trial for the model: initial state, health and inputs.

        Parameters
        ----------
        parameters : (P,) array
            The calibrated parameters.
        scaled_values : (L,) array
            The scaled values of the L unknowns of the trial.
        """
        values = self.scale * scaled_values
        # the unknown constants of the inputs; the others are known exactly
        offsets = np.zeros(len(trial.inputs))
        offsets[self.offset_inputs] = values[self.indices.input_constants]
        time_zero = float(values[self.indices.time_zero.start]) if self.has_time_zero else 0.0
        return Conditions(
            parameters=parameters,
            initial=self._initial_states(values),
            clock=(0.0, time_zero),
            health=self._health(trial, values),
            offset=tuple(offsets.tolist()),
        )

    def _initial_states(self, values: FloatArray) -> FloatArray:
        """Return displacements and velocities at the start (R, 2); known velocities are zero."""
        rows, column_count = self.initial_shape
        initial_states = np.zeros((rows, 2))
        initial_entries = values[self.indices.initial_state]
        initial_states[:, :column_count] = initial_entries.reshape(rows, column_count)
        return initial_states

    def _health(self, trial: Trial, values: FloatArray) -> FloatArray:
        """Return the stiffness losses of a trial, corrected by their unknown changes."""
        # a trial in motion is simulated with the stiffness losses at its start
        health = trial.health[:1] if trial.is_dynamic else trial.health
        loss_changes = values[self.indices.health]
        if loss_changes.size:
            health = health.copy()
            uncertain_entries = (self.health_rows, self.health_columns)
            health[uncertain_entries] = np.clip(
                health[uncertain_entries] + loss_changes, LEAST_LOSS, LARGEST_LOSS
            )
        return health


def shared_unknowns(
    campaign: Campaign, model: Model, trials: tuple[Trial, ...], gain_estimates: dict[str, float]
) -> SharedUnknowns:
    """Return the layout of the unknowns that all hypotheses and trials share.

    Parameters
    ----------
    campaign : Campaign
        The campaign, whose `parameters` replace priors of the model.
    trials : tuple of Trial
        The trials that are fitted; only gains of channels in them are unknowns.
    gain_estimates : dict of str to float
        The ratio of readings to model for channels of unknown scale: a first estimate of 1 + gain.
    """
    # calibrated parameters first, then gains
    priors = [ScaledPrior(*prior, 1.0) for prior in model.prior_moments(campaign)]
    used_channels = {name for trial in trials for name in trial.channels}
    gain_channels: list[str] = []
    fixed_gain: dict[str, float] = {}
    for name, channel in campaign.channels.items():
        if name not in used_channels or channel.gain_deviation == 0.0:
            continue
        estimate = gain_estimates.get(name, 1.0) - 1.0
        has_unknown_scale = isinf(channel.gain_deviation)
        if has_unknown_scale and not fixed_gain and _is_scale_of_releases(campaign, name, trials):
            # amplitudes of releases and an unknown gain cannot both be fitted: fix the first gain
            fixed_gain[name] = estimate
            continue
        gain_channels.append(name)
        # flat prior about the first estimate, or a normal prior about a gain error of zero
        if has_unknown_scale:
            gain_scale = max(abs(1.0 + estimate), 1e-12)
            priors.append(ScaledPrior(estimate, gain_scale, 0.0))
        else:
            priors.append(ScaledPrior(0.0, channel.gain_deviation, 1.0))
    centre, scale, precision = np.array(priors, dtype=np.float64).reshape(-1, 3).T
    ranges = [(parameter.low, parameter.high) for parameter in model.parameters]
    low, high = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
    return SharedUnknowns(
        centre=centre,
        scale=scale,
        precision=precision,
        low=low,
        high=high,
        gain_channels=tuple(gain_channels),
        fixed_gain=fixed_gain,
    )


def _is_scale_of_releases(campaign: Campaign, name: str, trials: tuple[Trial, ...]) -> bool:
    """Return whether nothing but the unknown amplitudes of releases sets the scale of a signal.

    It is so if the channel is a signal, all its trials are releases, and no channel of these trials
    has a known gain.
    """
    if campaign.channels[name].quantity is not Quantity.SIGNAL:
        return False
    trials_of_channel = [trial for trial in trials if name in trial.channels]
    has_known_gain = any(
        not isinf(campaign.channels[other].gain_deviation)
        for trial in trials_of_channel
        for other in trial.channels
    )
    are_releases = all(trial.kind is TrialKind.RINGDOWN for trial in trials_of_channel)
    return are_releases and not has_known_gain


def local_unknowns(
    campaign: Campaign, trial: Trial, deviation: FloatArray, model: Model
) -> LocalUnknowns:
    """Return the layout of the unknowns of one trial.

    Parameters
    ----------
    deviation : (C,) array
        The noise deviation of each channel, which scales a zero with a flat prior.
    model : Model
        The model, which gives the magnitudes of an unknown initial state.
    """
    # zeros
    zero_deviations = np.array(
        [campaign.channels[name].offset_deviation for name in trial.channels]
    )
    zero_columns = np.flatnonzero(zero_deviations > 0.0)
    zero_scale = zero_deviations[zero_columns]
    is_flat = np.isinf(zero_scale)
    zero_scale = np.where(is_flat, deviation[zero_columns], zero_scale)
    # initial state and time zero
    release = trial.release if trial.kind is TrialKind.RINGDOWN else None
    initial_shape = (0, 1)
    initial_scale = np.zeros(0)
    time_zero_scale = np.zeros(0)
    if release is not None:
        initial_shape = (release.mode_count, 1 if release.at_rest else 2)
        deviation_of_entries = release.deviation if release.at_rest else FREE_STATE_DEVIATION
        initial_scale = np.full(prod(initial_shape), deviation_of_entries)
        if release.time_zero_deviation > 0.0:
            time_zero_scale = np.full(1, release.time_zero_deviation)
    elif trial.begins is Start.UNKNOWN:
        magnitudes = model.initial_state_magnitudes(campaign, trial)
        initial_shape = (-(-len(magnitudes) // 2), 2)  # rounded up
        initial_scale = FREE_STATE_DEVIATION * np.pad(magnitudes, (0, len(magnitudes) % 2))
    # constants of inputs
    offset_deviations = np.array(
        [recorded_input.offset_deviation for recorded_input in trial.inputs]
    )
    offset_inputs = np.flatnonzero(offset_deviations > 0.0)
    # health, region by region, as its derivatives are taken
    health_deviation = trial.health_deviation[:1] if trial.is_dynamic else trial.health_deviation
    health_columns, health_rows = np.nonzero(health_deviation.T)
    scale = np.concatenate(
        (
            zero_scale,
            initial_scale,
            offset_deviations[offset_inputs],
            time_zero_scale,
            health_deviation[health_rows, health_columns],
        )
    )
    precision = np.concatenate((~is_flat, np.ones(len(scale) - len(is_flat))))
    return LocalUnknowns(
        scale=scale,
        precision=precision,
        zero_columns=zero_columns,
        initial_shape=initial_shape,
        offset_inputs=offset_inputs,
        has_time_zero=bool(time_zero_scale.size),
        health_rows=health_rows,
        health_columns=health_columns,
    )


@dataclass(frozen=True, eq=False)
class TrialData:
    """One trial, ready to be compared with a model.

    Attributes
    ----------
    trial : Trial
        The trial with its clock as measured.
    deviation : (C,) array
        The noise standard deviation s0 of each column [unit of the channel]. If the column is
        whitened, it is that of the whitened samples.
    channel_indices : (C,) array of int
        The index, among the channels of the campaign, of the channel of each column.
    unknowns : LocalUnknowns
        The layout of the unknowns of this trial.
    weight : (N, C) array
        1 for a sample that is compared with the model, else 0.
    noise_models : tuple of NoiseModel
        The noise model of each column.
    mesh_errors : tuple of (N, K) array
        What the errors of a mesh may add to each column, as K independent courses with the standard
        deviation one, in units of the noise: `SEARCH.mesh_error` times the readings of each channel
        of its quantity, since a coarse mesh shifts shapes of modes and displacements. The tuple is
        empty if no errors of a mesh are fitted.
    """

    trial: Trial
    deviation: FloatArray
    channel_indices: IntArray
    unknowns: LocalUnknowns
    weight: FloatArray
    noise_models: tuple[NoiseModel, ...]
    mesh_errors: tuple[FloatArray, ...] = ()

    @property
    def sample_deviation(self) -> FloatArray:
        """The standard deviation (C,) of a single reading, whether or not its noise is whitened."""
        deviations = [noise.static_deviation for noise in self.noise_models]
        return np.asarray(self.trial.noise_factor * np.array(deviations))

    def standardise(self, columns: FloatArray) -> FloatArray:
        """Return readings or their derivatives in units of the noise, whitened.

        Parameters
        ----------
        columns : (..., N, C) array
            Readings, predictions, or derivatives of predictions [unit of the channel].

        Returns
        -------
        (..., N, C) array
            The values over s0, after the whitening filter if the noise of the column is coloured;
            0 for samples that are not compared.
        """
        standardised = columns / self.deviation
        for number, noise in enumerate(self.noise_models):
            if noise.can_whiten(self.trial.whitening_interval):
                standardised[..., number] = noise.whiten(
                    standardised[..., number], self.trial.whitening_interval
                )
        return np.asarray(standardised * self.weight)

    @classmethod
    def prepare(
        cls,
        campaign: Campaign,
        trial: Trial,
        models_by_channel: Mapping[str, NoiseModel],
        model: Model,
    ) -> "TrialData":
        """Return a trial with its noise, its unknowns, and the samples that are compared."""
        channel_names = list(campaign.channels)
        noise_models = tuple(models_by_channel[name] for name in trial.channels)
        # a coloured noise is whitened if its coefficients hold for the sampling interval of the
        # trial; the whitened samples then have the deviation of its innovations
        is_whitened = [noise.can_whiten(trial.whitening_interval) for noise in noise_models]
        sample_deviation = [noise.static_deviation for noise in noise_models]
        innovation_deviation = [noise.standard_deviation for noise in noise_models]
        deviation = trial.noise_factor * np.where(
            is_whitened, innovation_deviation, sample_deviation
        )
        # a whitened sample depends on as many samples before it as the filter has coefficients: it
        # is not compared if one of them is left out
        weight = trial.used.astype(np.float64)
        for column in np.flatnonzero(is_whitened):
            filter_order = len(noise_models[column].autoregression)
            for unused_row in np.flatnonzero(~trial.used[:, column]):
                weight[unused_row : unused_row + filter_order + 1, column] = 0.0
        data = cls(
            trial=trial,
            deviation=deviation,
            channel_indices=np.array([channel_names.index(name) for name in trial.channels]),
            unknowns=local_unknowns(campaign, trial, deviation, model),
            weight=weight,
            noise_models=noise_models,
        )
        if not model.nuisance_parameters:
            return data
        return replace(data, mesh_errors=data._errors_of_mesh(campaign))

    def _errors_of_mesh(self, campaign: Campaign) -> tuple[FloatArray, ...]:
        """Return the errors (N, K) that a mesh may cause in each column, see `mesh_errors`."""
        readings = np.where(self.trial.used, self.trial.values, 0.0)
        quantities = [campaign.channels[name].quantity for name in self.trial.channels]
        errors = []
        for number, quantity in enumerate(quantities):
            is_alike = [other == quantity for other in quantities]
            # the readings of each such channel in the units of this column: (K, N, C)
            in_all_columns = np.repeat(readings.T[is_alike, :, None], len(quantities), axis=2)
            signals = self.standardise(in_all_columns)[..., number].T
            errors.append(SEARCH.mesh_error * signals)
        return tuple(errors)


def stand_in_deviation(campaign: Campaign, name: str) -> float:
    """Return a noise deviation for a channel without a noise record.

    It is a thousandth of the largest range of readings in a record of the channel [its unit].
    """
    ranges = [float(np.ptp(values)) for _, values, _ in campaign.records(name)]
    return 1e-3 * max(1e-12, *ranges)
