"""Residuals of a fit: what the fit hands on to locating, proof, report and files.

Everything is relative to the noise records. With a Gaussian posterior of the fitted parameters, linear about
the fit, the residuals r of the fitted trials, in units of the noise, have the covariance I - S S^T, where
S = J L / s0, J the derivatives of the predictions and L L^T the posterior covariance; residuals of held-out
trials have I + S S^T. The diagonal of S S^T is the leverage.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.noise import (
    NOISE_RECORD_LEVEL,
    noise_model,
    record_at_rest,
    whiteness_is_tested,
)
from discrepancy.campaign.noise_tests import SHORTEST_SERIES
from discrepancy.campaign.records import BoolArray, Channel, FloatArray, Trial
from discrepancy.errors import FitError, said


@dataclass(frozen=True, eq=False)
class FittedTrial:
    """One trial beside its prediction.

    Attributes
    ----------
    trial : Trial
        Measured values and inputs; `trial.held_out` says whether it took part in the fit.
    prediction : (N, C) ndarray
        Mean of the posterior prediction, with gains and offsets [channel's unit].
    residual : (N, C) ndarray
        Measured less predicted [channel's unit]; anything where `trial.used` is False.
    noise_deviation : (C,) ndarray
        s0 of each channel [channel's unit]; an estimate where the channel has no noise record.
    predictive_deviation : (N, C) ndarray
        Standard deviation of a measured value under the posterior prediction, noise included.
    leverage : (N, C) ndarray
        A residual has the variance s0^2 (1 - leverage) in a fitted trial, s0^2 (1 + leverage) in a held-out
        one if the model is right. Negative in a held-out trial whose own nuisances (a release amplitude, an
        offset) were fitted to it. The sum over the used samples of fitted trials is the effective number of
        parameters.
    rates : (N, C) ndarray or None
        Time derivatives of the prediction, dynamic trials [channel's unit / s].
    sensitivity : (N, C, P) ndarray or None
        S of the module's text, one column for each parameter of the whole fit, alike in all its trials
        (held-out trials: without what was fitted to themselves). With it tests allow exactly for what the fit
        has absorbed; without it for the leverage only.

    Raises
    ------
    FitError
        If shapes do not agree, or a used value is not finite.
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
        used = self.trial.used
        parts = (self.prediction, self.residual, self.predictive_deviation, self.leverage, self.rates)
        finite = all(np.all(np.isfinite(part[used])) for part in parts if part is not None)
        positive = np.all(self.noise_deviation > 0.0) and np.all(self.predictive_deviation[used] > 0.0)
        if not (finite and positive and np.all(self.expected_variance[used] > -1e-9)):
            raise FitError(said("models.bad_fit", self=self))

    @property
    def used(self) -> BoolArray:
        """Samples that count, (N, C)."""
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


def of_channel(trials: Iterable[FittedTrial], channel: str) -> Iterator[tuple[FittedTrial, int, BoolArray]]:
    """Yield the trials that have a channel, its column in each, and which samples of it count (N,)."""
    for item in trials:
        if channel in item.trial.channels:
            yield item, item.column(channel), item.used[:, item.column(channel)]


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """All trials of a campaign beside their predictions by one fitted hypothesis.

    Attributes
    ----------
    channels : mapping of str to Channel
        By name; their noise records are what residuals are compared with.
    trials : tuple of FittedTrial
        In the campaign's order.

    Raises
    ------
    FitError
        If there is no trial, a trial has an unknown channel, or sensitivities differ in their parameters.
    """

    channels: Mapping[str, Channel]
    trials: tuple[FittedTrial, ...]

    def __post_init__(self) -> None:
        if not self.measured or not {*self.measured} <= self.channels.keys():
            raise FitError("A set of residuals needs at least one trial, and the channels of all its trials.")

    @property
    def fitted(self) -> "ResidualSet | None":
        """The trials that were fitted, or None."""
        return self._where(held_out=False)

    @property
    def held_out(self) -> "ResidualSet | None":
        """The trials kept for proof, or None."""
        return self._where(held_out=True)

    def _where(self, *, held_out: bool) -> "ResidualSet | None":
        trials = tuple(item for item in self.trials if item.trial.held_out is held_out)
        return replace(self, trials=trials) if trials else None

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the channels in its trials, in the order in which they come."""
        return tuple(dict.fromkeys(name for item in self.trials for name in item.trial.channels))

    @property
    def recorded(self) -> tuple[str, ...]:
        """Those with a noise record."""
        return tuple(name for name in self.measured if self.degrees_of_freedom(name) > 0.0)

    def degrees_of_freedom(self, channel: str) -> float:
        """Return n0 of a channel's noise record; zero without a record."""
        noise = self.channels[channel].noise
        return 0.0 if noise is None else noise.degrees_of_freedom

    def white(self, generator: np.random.Generator) -> tuple[FloatArray, ...]:
        """Return residuals that are white with unit variance if the model is right, (N, C) by trial.

        A residual at a draw of the posterior is distributed as the noise itself (Johnson 2007, Bayesian
        Analysis 2(4), 719-734): r + S z with z standard normal, one z for all trials, restores exactly what
        the fit has absorbed; held-out trials lose the error of the parameters alike. Without sensitivities
        what the fit has absorbed is restored sample by sample, r + sqrt(leverage) z, and residuals of a
        larger variance than the noise are divided by their deviation. Samples that are not used are drawn
        from the noise, so that series keep their even spacing.
        """
        columns = (item.sensitivity.shape[2] for item in self.trials if item.sensitivity is not None)
        draw = generator.standard_normal(next(columns, 0))
        outside = self._held_out_draw(draw)
        white = []
        for item in self.trials:
            filler = generator.standard_normal(item.residual.shape)
            residual = np.nan_to_num(item.standardised)
            if item.sensitivity is None:
                absorbed = np.clip(1.0 - item.expected_variance, 0.0, 1.0)
                residual = residual + np.sqrt(absorbed) * generator.standard_normal(residual.shape)
                residual = residual / np.sqrt(np.maximum(item.expected_variance, 1.0))
            elif item.trial.held_out:
                residual = residual - item.sensitivity @ outside
            else:
                residual = residual + item.sensitivity @ draw
            white.append(np.where(item.used, residual, filler))
        return tuple(white)

    def series(self, white: Sequence[FloatArray]) -> Iterator[tuple[FittedTrial, str, FloatArray]]:
        """Yield trial, channel and its white residuals (N,) of all that are long enough for tests in time.

        `white` is what the method of this name returned.
        """
        for item, values in zip(self.trials, white, strict=True):
            if item.trial.is_dynamic and len(values) >= SHORTEST_SERIES:
                for column, name in enumerate(item.trial.channels):
                    if item.used[:, column].any():
                        yield item, name, values[:, column]

    def _held_out_draw(self, draw: FloatArray) -> FloatArray:
        """Return a draw of the parameters' error given the held-out trials.

        There r = e + S z: given r, z is Gaussian with the precision I + S^T S, and r less S times a draw of
        it is distributed as e.
        """
        precision, along = np.eye(draw.size), np.zeros(draw.size)
        for item in self.trials:
            if item.trial.held_out and item.sensitivity is not None:
                part = item.sensitivity[item.used]
                precision += part.T @ part
                along += part.T @ item.standardised[item.used]
        root = np.linalg.cholesky(precision)
        return np.asarray(np.linalg.solve(precision, along) + np.linalg.solve(root.T, draw))


def without_colour(residuals: ResidualSet) -> ResidualSet:
    """Return a set without the records whose noise is coloured and could not be whitened: it tells no gap."""
    noise = {name: noise_model(channel, 1.0) for name, channel in residuals.channels.items()}

    def kept(trial: Trial) -> Trial:
        white = [not noise[name].stays_coloured(trial) for name in trial.channels]
        return replace(trial, used=trial.used & np.array(white))

    trials = (replace(item, trial=kept(item.trial)) for item in residuals.trials)
    return replace(residuals, trials=tuple(trials))


def quadratic_moments(
    items: Iterable[tuple[FloatArray, FloatArray | None]], *, held_out: bool = False
) -> tuple[float, float]:
    """Return mean and effective degrees of freedom of a sum of squares of residuals.

    Parameters
    ----------
    items : iterable of ((n,) ndarray, (n, P) ndarray or None)
        Expected variance of the residuals and their sensitivities, by trial and channel.
    held_out : bool
        Whether they are of held-out trials, where A = I + S S^T.

    Returns
    -------
    mean, degrees_of_freedom : float
        With A = I - S S^T the covariance: tr A and (tr A)^2 / tr A^2 (Satterthwaite 1946), so that the sum
        over its mean is about chi^2 over the degrees of freedom.
    """
    mean, square, count = 0.0, 0.0, 0
    cross: FloatArray | None = None
    for expected, sensitive in items:
        mean += float(expected.sum())
        if sensitive is None:
            square += float(expected.sum())
            continue
        leverage = np.einsum("np,np->n", sensitive, sensitive)
        square += float(np.sum(1.0 + (2.0 if held_out else -2.0) * leverage))
        count += expected.size
        part = sensitive.T @ sensitive
        cross = part if cross is None else cross + part
    if cross is not None:
        square += float(np.sum(cross**2))
    if mean <= 1e-9 or square <= 1e-12:
        return max(mean, 0.0), 0.0
    return mean, mean**2 / square


# ---------------------------------------------------------------- few omnibus tests

SERIAL = (noise_tests.ljung_box, noise_tests.cumulative_periodogram)
"""Tests of whiteness."""


@dataclass(frozen=True)
class OmnibusTest:
    """One test of the whole set.

    Attributes
    ----------
    name : str
        "variance", "Ljung-Box", "cumulative periodogram" or "Fisher g".
    p_value : float
        Over all trials and channels; nan if it could not be applied.
    statistic : float
        Variance: mean square over its expectation; else the statistic of the place with the least p-value.
    where : str
        That place.
    rejected : bool
        By Holm's rule over all tests.
    """

    name: str
    p_value: float
    statistic: float
    where: str
    rejected: bool = False


def noise_groups(residuals: ResidualSet) -> dict[str, tuple[str, ...]]:
    """Return channels by noise record: those whose stated records are equal share one.

    Channels without a noise record are left out.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in residuals.recorded:
        channel = residuals.channels[name]
        noise = channel.noise
        assert noise is not None
        own = () if noise.source == "stated" else (name,)
        key = (channel.quantity, noise.standard_deviation, noise.degrees_of_freedom, *own)
        groups.setdefault(key, []).append(name)
    return {names[0]: tuple(names) for names in groups.values()}


def mean_square(residuals: ResidualSet, channels: Sequence[str]) -> tuple[float, float]:
    """Return the sum of squares of channels over its expectation, and its effective degrees of freedom.

    The trials of the set are all fitted, or all held out.
    """
    total, parts, held_out = 0.0, [], residuals.trials[0].trial.held_out
    for name in channels:
        for item, column, used in of_channel(residuals.trials, name):
            total += float(np.sum(item.standardised[used, column] ** 2))
            sensitive = None if item.sensitivity is None else item.sensitivity[used, column]
            parts.append((item.expected_variance[used, column], sensitive))
    mean, freedom = quadratic_moments(parts, held_out=held_out)
    return (total / mean if mean > 0.0 else np.nan), freedom


def variance_test(residuals: ResidualSet) -> OmnibusTest:
    """Return the test of the mean squares against the noise records; nan without any record.

    Each noise record gives one p-value, Bonferroni's over all its trials and each kind of trial (few static
    readings would drown in thousands of samples of ring-downs); these are combined. Each channel in each
    trial gives one more, for a gap in one place only.
    """
    parts = [residuals, *_by_kind(residuals)]
    of_groups, of_places, worst = [], [], ("", 2.0)
    total, weight = 0.0, 0.0
    for names in noise_groups(residuals).values():
        noise_freedom = residuals.degrees_of_freedom(names[0])
        found = []
        for part in parts:
            square, freedom = mean_square(part, names)
            if freedom >= 0.5:
                found.append(noise_tests.variance_p_value(square, freedom, noise_freedom))
                if part is residuals:
                    total, weight = total + square * freedom, weight + freedom
        if found:
            of_groups.append(min(1.0, len(found) * min(found)))
        for item in residuals.trials:
            single = replace(residuals, trials=(item,))
            for name in names:
                square, freedom = mean_square(single, (name,))
                if freedom < 0.5:
                    continue
                of_places.append(noise_tests.variance_p_value(square, freedom, noise_freedom))
                worst = min(worst, (f"{item.trial.name}, {name}", of_places[-1]), key=lambda pair: pair[1])
    if not of_groups:
        return OmnibusTest("variance", np.nan, np.nan, "")
    p = noise_tests.combine(of_groups)
    if len(of_places) > 1:
        p = min(1.0, 2.0 * min(p, len(of_places) * min(of_places)))
    # Far from the truth the fit may leave no degree of freedom to the whole, but some to a trial.
    return OmnibusTest("variance", p, total / weight if weight > 0.0 else np.nan, worst[0])


def _by_kind(residuals: ResidualSet) -> tuple[ResidualSet, ...]:
    """Return the set split by the kind of its trials; nothing if there is one kind only."""
    kinds = list(dict.fromkeys(item.trial.kind for item in residuals.trials))
    if len(kinds) < 2:
        return ()
    return tuple(
        replace(residuals, trials=tuple(i for i in residuals.trials if i.trial.kind is kind))
        for kind in kinds
    )


def serial_tests(
    residuals: ResidualSet, white: Sequence[FloatArray], coloured: Sequence[str] = ()
) -> tuple[OmnibusTest, ...]:
    """Return Ljung-Box, cumulative periodogram and Fisher g over all series of dynamic trials.

    Parameters
    ----------
    residuals : ResidualSet
        The set.
    white : sequence of (N, C) ndarray
        What its `white` returned.
    coloured : sequence of str
        Channels whose noise record itself is not white: they are left out.
    """
    found: dict[str, list[tuple[float, float, str]]] = {
        "Ljung-Box": [], "cumulative periodogram": [], "Fisher g": [],
    }  # fmt: skip
    for item, name, series in residuals.series(white):
        if name in coloured:
            continue
        where = f"{item.trial.name}, {name}"
        found["Ljung-Box"].append((*noise_tests.ljung_box(series), where))
        found["cumulative periodogram"].append((*noise_tests.cumulative_periodogram(series), where))
        share, p, place = noise_tests.fisher_g(series)
        frequency = place / (len(series) * item.trial.interval)
        found["Fisher g"].append((share, p, f"{where}, {frequency:.4g} Hz"))
    tests = []
    for name, rows in found.items():
        if not rows:
            tests.append(OmnibusTest(name, np.nan, np.nan, ""))
            continue
        worst = min(rows, key=lambda row: row[1])
        tests.append(OmnibusTest(name, noise_tests.combine([row[1] for row in rows]), worst[0], worst[2]))
    return tuple(tests)


def coloured_noise(residuals: ResidualSet) -> dict[str, str]:
    """Return channels whose noise record itself is not white, with one sentence each."""
    remarks = {}
    for name, channel in residuals.channels.items():
        series = record_at_rest(channel)
        if series is None or channel.noise is None or whiteness_is_tested(channel):
            continue
        share, line, place = noise_tests.fisher_g(series)
        if line < NOISE_RECORD_LEVEL:
            interval = channel.noise.interval
            at = f" at {place / (series.size * interval):.4g} Hz" if interval else ""
            remarks[name] = said("location.line_in_noise", name=name, at=at, percent=100.0 * share)
        else:
            remarks[name] = said("location.coloured_noise", name=name)
    return remarks
