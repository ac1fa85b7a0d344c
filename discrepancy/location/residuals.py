"""Residuals of a fit, for location, proof, report and files.

Residuals are relative to the noise records. With a Gaussian posterior of the fitted parameters,
linear about the fit, the residuals r of the fitted trials, in units of the noise, have the
covariance I - S S^T. Here S = J L / s0, where J holds the derivatives of the predictions, L L^T is
the posterior covariance and s0 the standard deviation of the noise. Residuals of held-out trials
have the covariance I + S S^T. The diagonal of S S^T is the leverage.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.noise import noise_model
from discrepancy.campaign.noise_tests import SHORTEST_SERIES
from discrepancy.campaign.records import BoolArray, Channel, FloatArray, Trial
from discrepancy.errors import FitError


@dataclass(frozen=True, eq=False)
class FittedTrial:
    """One trial with its prediction by a fit, and the residuals.

    Attributes
    ----------
    trial : Trial
        Readings and inputs; it took part in the fit unless `trial.held_out`.
    prediction : (N, C) ndarray
        The mean of the posterior prediction, with gains and offsets [channel's unit].
    residual : (N, C) ndarray
        Readings minus prediction [channel's unit]; any value where `trial.used` is False.
    noise_deviation : (C,) ndarray
        Standard deviation s0 of each channel's noise [channel's unit]; an estimate without a noise
        record.
    predictive_deviation : (N, C) ndarray
        The standard deviation of a measured value under the posterior prediction, noise included.
    leverage : (N, C) ndarray
        Leverage: if the model is right, a residual has the variance s0^2 (1 - leverage) in a fitted
        trial and s0^2 (1 + leverage) in a held-out one. It is negative in a held-out trial whose
        own nuisances (a release amplitude, an offset) were fitted to it. The sum over the used
        samples of fitted trials is the effective number of parameters.
    rates : (N, C) ndarray or None
        The time derivatives of the prediction of a dynamic trial [channel's unit / s].
    sensitivity : (N, C, P) ndarray or None
        The matrix S = J L / s0 at the top of this module, for the P parameters of the whole fit; in
        a held-out trial without the parameters that were fitted to this trial itself. With S, tests
        allow exactly for what the fit has absorbed; if it is None, for the leverage only.

    Raises
    ------
    FitError
        If a used value is not finite, a deviation is not positive, or a leverage is above one.
    """

    trial: Trial
    prediction: FloatArray
    residual: FloatArray
    noise_deviation: FloatArray
    predictive_deviation: FloatArray
    leverage: FloatArray
    rates: FloatArray | None = None
    sensitivity: FloatArray | None = None

    def __post_init__(self) -> None:
        is_used = self.trial.used
        arrays = [self.prediction, self.residual, self.predictive_deviation, self.leverage]
        if self.rates is not None:
            arrays.append(self.rates)
        are_finite = all(np.all(np.isfinite(array[is_used])) for array in arrays)
        noise_is_positive = np.all(self.noise_deviation > 0.0)
        predictive_is_positive = np.all(self.predictive_deviation[is_used] > 0.0)
        variance_is_possible = np.all(self.expected_variance[is_used] > -1e-9)
        if not (
            are_finite and noise_is_positive and predictive_is_positive and variance_is_possible
        ):
            raise FitError(
                f"The fit of the trial {self.trial.name!r} has values that are not finite, "
                "deviations that are not positive, or a leverage above one."
            )

    @property
    def used(self) -> BoolArray:
        """Whether each of the N samples of C channels is compared with the model, (N, C)."""
        return self.trial.used

    @cached_property
    def standardised(self) -> FloatArray:
        """Residuals in units of the noise, (N, C); nan where not used."""
        return np.where(self.used, self.residual / self.noise_deviation, np.nan)

    @property
    def expected_variance(self) -> FloatArray:
        """Variance of `standardised` if the model is right, (N, C)."""
        return np.asarray(1.0 + self.leverage if self.trial.held_out else 1.0 - self.leverage)

    def column(self, channel: str) -> int:
        """Return the column of a channel; raises ValueError if the trial lacks it."""
        return self.trial.channels.index(channel)


class ChannelFit(NamedTuple):
    """One channel of a fitted trial.

    Attributes
    ----------
    fitted_trial : FittedTrial
        The trial with its prediction and residuals.
    column : int
        The index of the channel in the arrays of the trial.
    used : (N,) ndarray of bool
        False for samples that are left out.
    """

    fitted_trial: FittedTrial
    column: int
    used: BoolArray


class DynamicSeries(NamedTuple):
    """White residuals of a channel in a dynamic trial.

    Attributes
    ----------
    fitted_trial : FittedTrial
        The trial with its prediction and residuals.
    channel : str
        The name of the channel.
    values : (N,) ndarray
        The residuals, in units of the noise.
    """

    fitted_trial: FittedTrial
    channel: str
    values: FloatArray


def channel_fits(trials: Iterable[FittedTrial], channel: str) -> Iterator[ChannelFit]:
    """Yield the column and the used samples of a channel in each trial that records it."""
    for fitted_trial in trials:
        if channel in fitted_trial.trial.channels:
            column = fitted_trial.column(channel)
            yield ChannelFit(fitted_trial, column, fitted_trial.used[:, column])


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """All trials of a campaign with their predictions by one fitted hypothesis.

    Attributes
    ----------
    channels : mapping of str to Channel
        The channels by name, with the noise records that residuals are compared with.
    trials : tuple of FittedTrial
        Trials in the campaign's order.

    Raises
    ------
    FitError
        If there is no trial, or a trial has an unknown channel.
    """

    channels: Mapping[str, Channel]
    trials: tuple[FittedTrial, ...]

    def __post_init__(self) -> None:
        if not self.channel_names or not {*self.channel_names} <= self.channels.keys():
            raise FitError(
                "A set of residuals needs at least one trial, and the channels of all its trials."
            )

    @property
    def fitted(self) -> "ResidualSet | None":
        """The set of the fitted trials; None if there are none."""
        return self._subset_of_role(held_out=False)

    @property
    def held_out(self) -> "ResidualSet | None":
        """The set of the trials that were held out for proof; None if there are none."""
        return self._subset_of_role(held_out=True)

    def _subset_of_role(self, *, held_out: bool) -> "ResidualSet | None":
        """Return only the held-out trials, or only the fitted trials; None if there are none."""
        trials = tuple(
            fitted_trial for fitted_trial in self.trials if fitted_trial.trial.held_out is held_out
        )
        return replace(self, trials=trials) if trials else None

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels of its trials, in the order of their first occurrence."""
        names = [name for fitted_trial in self.trials for name in fitted_trial.trial.channels]
        return tuple(dict.fromkeys(names))

    @property
    def recorded_channels(self) -> tuple[str, ...]:
        """Names of its channels with a noise record."""
        return tuple(name for name in self.channel_names if self.degrees_of_freedom(name) > 0.0)

    def degrees_of_freedom(self, channel: str) -> float:
        """Return the degrees of freedom n0 of a channel's noise record; 0 without a record."""
        noise = self.channels[channel].noise
        return 0.0 if noise is None else noise.degrees_of_freedom

    def whitened_residuals(self, generator: np.random.Generator) -> tuple[FloatArray, ...]:
        """Return residuals that are white with unit variance if the model is right.

        A fit absorbs part of the noise: its residuals r have the covariance I - S S^T. The sum
        r + S z, with one standard normal vector z for all trials, has the covariance I: the
        residual at a draw of the posterior is distributed as the noise itself (Johnson 2007,
        Bayesian Analysis 2(4), 719-734). In held-out trials r contains the error of the parameters,
        which is subtracted; see `_held_out_draw`. Without sensitivities, sqrt(leverage) z is added
        with an independent z for each sample, and residuals with a variance above that of the noise
        are divided by their standard deviation. Samples that are not used are replaced by draws of
        the noise, so that series stay evenly spaced.

        Parameters
        ----------
        generator : Generator
            The source of the random draws.

        Returns
        -------
        tuple of (N, C) ndarray
            The white residuals of each trial.
        """
        draw = generator.standard_normal(self._parameter_count())  # (P,)
        held_out_draw = self._held_out_draw(draw)  # (P,)
        white_residuals = []
        for fitted_trial in self.trials:
            noise = generator.standard_normal(fitted_trial.residual.shape)
            residual = np.nan_to_num(fitted_trial.standardised)  # (N, C)
            if fitted_trial.sensitivity is None:
                absorbed_variance = np.clip(1.0 - fitted_trial.expected_variance, 0.0, 1.0)
                restored_noise = np.sqrt(absorbed_variance) * generator.standard_normal(
                    residual.shape
                )
                residual = residual + restored_noise
                residual = residual / np.sqrt(np.maximum(fitted_trial.expected_variance, 1.0))
            elif fitted_trial.trial.held_out:  # sensitivity is (N, C, P)
                residual = residual - fitted_trial.sensitivity @ held_out_draw
            else:
                residual = residual + fitted_trial.sensitivity @ draw
            white_residuals.append(np.where(fitted_trial.used, residual, noise))
        return tuple(white_residuals)

    def _parameter_count(self) -> int:
        """Return the number P of parameters in the sensitivities; 0 if no trial has them."""
        for fitted_trial in self.trials:
            if fitted_trial.sensitivity is not None:
                return int(fitted_trial.sensitivity.shape[2])
        return 0

    def dynamic_series(self, white_residuals: Sequence[FloatArray]) -> Iterator[DynamicSeries]:
        """Yield the white residuals of each dynamic record that is long enough for serial tests.

        Parameters
        ----------
        white_residuals : sequence of (N, C) ndarray
            The white residuals of each trial, from the method `whitened_residuals`.
        """
        for fitted_trial, values in zip(self.trials, white_residuals, strict=True):
            if not fitted_trial.trial.is_dynamic or len(values) < SHORTEST_SERIES:
                continue
            for column, name in enumerate(fitted_trial.trial.channels):
                if fitted_trial.used[:, column].any():
                    yield DynamicSeries(fitted_trial, name, values[:, column])

    def _held_out_draw(self, draw: FloatArray) -> FloatArray:
        """Return a draw (P,) of the error z of the parameters, given the held-out residuals.

        In held-out trials r = e + S z with the white noise e and z standard normal. Given r, z is
        Gaussian with the precision I + S^T S and the mean (I + S^T S)^-1 S^T r. The residual r
        minus S times a draw of z is distributed as the noise e.

        Parameters
        ----------
        draw : (P,) ndarray
            Independent standard normal variables.
        """
        precision = np.eye(draw.size)
        weighted_residual = np.zeros(draw.size)
        for fitted_trial in self.trials:
            if fitted_trial.trial.held_out and fitted_trial.sensitivity is not None:
                sensitivity = fitted_trial.sensitivity[fitted_trial.used]  # (used samples, P)
                precision += sensitivity.T @ sensitivity
                weighted_residual += sensitivity.T @ fitted_trial.standardised[fitted_trial.used]
        mean = np.linalg.solve(precision, weighted_residual)
        # precision = L L^T, thus L^-T times a standard normal vector has its inverse as covariance
        factor = np.linalg.cholesky(precision)
        return np.asarray(mean + np.linalg.solve(factor.T, draw))


def without_coloured_records(residuals: ResidualSet) -> ResidualSet:
    """Return the set without the records whose coloured noise cannot be whitened.

    These records stay in the set, with all samples marked as not used. Correlated noise in them
    would be taken for a discrepancy of the model.
    """
    noise = {name: noise_model(channel, 1.0) for name, channel in residuals.channels.items()}
    trials = []
    for fitted_trial in residuals.trials:
        trial = fitted_trial.trial
        is_white = [not noise[name].stays_coloured(trial) for name in trial.channels]
        trials.append(
            replace(fitted_trial, trial=replace(trial, used=trial.used & np.array(is_white)))
        )
    return replace(residuals, trials=tuple(trials))


class SumOfSquaresMoments(NamedTuple):
    """Moments of a sum of squares of residuals, if the model is right.

    Attributes
    ----------
    expected_sum : float
        The expected sum of squares, in units of the noise variance.
    degrees_of_freedom : float
        The effective degrees of freedom; 0 if the fit has absorbed all residuals.
    """

    expected_sum: float
    degrees_of_freedom: float


def sum_of_squares_moments(
    records: Iterable[tuple[FloatArray, FloatArray | None]], *, held_out: bool = False
) -> SumOfSquaresMoments:
    """Return the expected sum of squares of residuals, and its effective degrees of freedom.

    If the residuals have the covariance A, the sum has the mean tr A and the variance 2 tr A^2. A
    multiple of a chi-squared variable with the same two moments has (tr A)^2 / tr A^2 degrees of
    freedom (Satterthwaite 1946). Here A = I - S S^T with the sensitivities S; see the text of the
    module. Without sensitivities tr A^2 is replaced by tr A, which is exact if A is a projection.

    Parameters
    ----------
    records : iterable of ((n,) ndarray, (n, P) ndarray or None)
        The expected variances of n residuals in units of the noise variance (the diagonal of A),
        and their sensitivities S, for each trial and channel.
    held_out : bool
        True for residuals of held-out trials, where A = I + S S^T.
    """
    trace = 0.0
    trace_of_square = 0.0
    gram_of_sensitivities: FloatArray | None = None
    for expected_variance, sensitivity in records:
        trace += float(expected_variance.sum())
        if sensitivity is None:
            # A^2 = A for a projection, such as I - S S^T of a linear fit without priors
            trace_of_square += float(expected_variance.sum())
            continue
        # A^2 = I -+ 2 S S^T + (S S^T)^2, thus tr A^2 = n -+ 2 tr S S^T + tr (S^T S)^2. The last
        # term does not split into records: S^T S is summed over them first.
        leverage = np.einsum("np,np->n", sensitivity, sensitivity)
        trace_of_square += float(np.sum(1.0 + (2.0 if held_out else -2.0) * leverage))
        gram_of_record = sensitivity.T @ sensitivity
        gram_of_sensitivities = (
            gram_of_record
            if gram_of_sensitivities is None
            else gram_of_sensitivities + gram_of_record
        )
    if gram_of_sensitivities is not None:
        trace_of_square += float(np.sum(gram_of_sensitivities**2))
    # traces below these limits are rounding errors: the fit has absorbed all residuals
    if trace <= 1e-9 or trace_of_square <= 1e-12:
        return SumOfSquaresMoments(max(trace, 0.0), 0.0)
    return SumOfSquaresMoments(trace, trace**2 / trace_of_square)


class MeanSquareRatio(NamedTuple):
    """A sum of squares of residuals over its expectation.

    Attributes
    ----------
    ratio : float
        The ratio; 1 on average if the model is right, nan if the expectation is zero.
    degrees_of_freedom : float
        The effective degrees of freedom of the sum; see `sum_of_squares_moments`.
    """

    ratio: float
    degrees_of_freedom: float


def mean_square_ratio(residuals: ResidualSet, channels: Sequence[str]) -> MeanSquareRatio:
    """Return the sum of squares of some channels' residuals in all trials over its expectation.

    The trials of the set must be all fitted, or all held out.
    """
    sum_of_squares = 0.0
    records = []
    for name in channels:
        for fitted_trial, column, is_used in channel_fits(residuals.trials, name):
            sum_of_squares += float(np.sum(fitted_trial.standardised[is_used, column] ** 2))
            sensitivity = None
            if fitted_trial.sensitivity is not None:
                sensitivity = fitted_trial.sensitivity[is_used, column]
            records.append((fitted_trial.expected_variance[is_used, column], sensitivity))
    expected_sum, freedom = sum_of_squares_moments(
        records, held_out=residuals.trials[0].trial.held_out
    )
    ratio = sum_of_squares / expected_sum if expected_sum > 0.0 else np.nan
    return MeanSquareRatio(ratio, freedom)
