"""Proof: what an effect does to the trials, before and after, at the same scale.

Errors and chi-square are of the residuals over the noise alone. What a posterior leaves open is in what is
expected of chi-square, and in the probabilistic scores, never in what is told of the error.

Scores follow Gneiting and Raftery 2007 (J. Am. Stat. Assoc. 102, 359-378); predictions are Gaussian with the
predictive deviations handed over by the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan, sqrt

import numpy as np
from scipy import stats

from discrepancy.campaign.noise_tests import lag_products, ljung_box, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.errors import FitError
from discrepancy.location.residuals import FittedTrial, ResidualSet, mean_square, of_channel
from discrepancy.proof_record import ClosedShare, Proof, Scores
from discrepancy.verdict import Gate

from .closed_share import closed_share, over_noise_of, rms_by_channel

PIT_BINS = 10
"""Bins of the histogram of probability integral transforms."""

SMALLEST_GAP = 2.0
"""A gap to close is at least this many standard deviations of χ² per sample above what is expected."""

HELD_OUT_DEVIATIONS = 3.0
"""Deviations of χ² per sample on held-out trials above what is expected from which on a name does not survive
them."""
COVERAGE = (0.80, 0.97)
"""Share of held-out samples that 90 % intervals must hold."""
LEAST_COVERED = 200
"""Samples from which on that share is judged."""

_ENOUGH_TRIALS = 5  # from which the scatter between trials alone gives the standard error
_PARTS = 16  # of a record, for the error within a trial
_REMAINS = 0.01  # p-value below which something is said to remain


def scores(residuals: ResidualSet, *, seed: int = 0) -> Scores:
    """Return the scores of a set whose trials are all fitted, or all held out.

    Parameters
    ----------
    residuals : ResidualSet
        One or more trials.
    seed : int
        Of the draw that restores what the fit absorbed, for whiteness.

    Raises
    ------
    FitError
        If no sample is used.
    """
    transforms = [item.residual / item.predictive_deviation for item in residuals.trials]
    used = [item.used for item in residuals.trials]
    z = np.concatenate([values[use] for values, use in zip(transforms, used, strict=True)])
    if z.size == 0:
        raise FitError("Scores need at least one used sample, but there is none.")
    density = np.concatenate(
        [log_density(item)[use] for item, use in zip(residuals.trials, used, strict=True)]
    )
    chi_square = chi_square_of(residuals)
    white = residuals.white(np.random.default_rng(seed))
    channels = [ljung_box(series)[1] for _, _, series in residuals.series(white)]
    uniform = stats.norm.cdf(z)
    counts = np.histogram(uniform, bins=PIT_BINS, range=(0.0, 1.0))[0]
    return Scores(
        rms=rms_by_channel(residuals),
        chi_square_per_sample=chi_square.per_sample,
        log_score=float(density.mean()),
        coverage_50=float(np.mean(np.abs(z) <= stats.norm.ppf(0.75))),
        coverage_90=float(np.mean(np.abs(z) <= stats.norm.ppf(0.95))),
        whiteness=min(1.0, len(channels) * min(channels)) if channels else nan,
        sample_count=int(z.size),
        chi_square_expected=chi_square.expected,
        chi_square_deviation=chi_square.deviation,
        pit=tuple(float(value) for value in counts / z.size),
        pit_p_value=_uniformity(transforms, used, counts),
    )


def log_density(item: FittedTrial) -> FloatArray:
    """Return the predictive log density of each sample in units of its noise deviation, (N, C).

    ln N(residual; 0, predictive_deviation^2) + ln s0; a perfect model with exact parameters has
    -(1 + ln 2 pi) / 2 = -1.419 on average.
    """
    z = item.residual / item.predictive_deviation
    spread = item.predictive_deviation / item.noise_deviation
    return np.asarray(-0.5 * np.log(2.0 * np.pi) - np.log(spread) - 0.5 * z**2)


@dataclass(frozen=True)
class ChiSquare:
    """Mean square residual over the noise, and its mean and standard deviation if the model is right."""

    per_sample: float
    expected: float
    deviation: float

    @property
    def beyond(self) -> float:
        """By how many of its deviations it is above what is expected; nan without a noise record."""
        return (self.per_sample - self.expected) / self.deviation

    @property
    def beyond_noise(self) -> float:
        """The same above noise alone, whatever the posterior leaves open."""
        return (self.per_sample - 1.0) * self.expected / self.deviation


def chi_square_of(residuals: ResidualSet) -> ChiSquare:
    """Return χ² per sample of trials that are all fitted, or all held out, against the noise records.

    Channels without a noise record do not count; nan if none has one. The sum of squares of a right model is
    that of the noise, less what the fit absorbs, or plus what its uncertainty adds to held-out trials.
    """
    known = residuals.recorded
    if not known:
        return ChiSquare(nan, nan, nan)
    _, freedom = mean_square(residuals, known)
    if freedom <= 0.0:
        return ChiSquare(nan, nan, nan)
    squares, variances = [], []
    for name in known:
        for item, column, used in of_channel(residuals.trials, name):
            squares.append(item.standardised[used, column] ** 2)
            variances.append(item.expected_variance[used, column])
    expected = float(np.concatenate(variances).mean())
    # Channels may share their record or not; the worst case, that all share the poorest one, is assumed.
    noise_freedom = min(residuals.degrees_of_freedom(name) for name in known)
    deviation = expected * sqrt(2.0 / freedom + 2.0 / noise_freedom)
    return ChiSquare(float(np.concatenate(squares).mean()), expected, deviation)


def correlation_time(series: FloatArray) -> float:
    """Return the samples that count as one, 1 + 2 sum rho_k, with Geyer's initial positive sequence.

    Geyer 1992, Statistical Science 7, 473-483: sums of neighbouring pairs are added while positive. At
    least one.
    """
    count = series.size
    centred = series - series.mean()
    power = float(centred @ centred)
    if count < 4 or power == 0.0:
        return 1.0
    rho = lag_products(centred, count - 1)[0] / power
    pairs = rho[0 : count - 1 : 2] + rho[1:count:2]
    ends = np.flatnonzero(pairs <= 0.0)
    last = int(ends[0]) if ends.size else pairs.size
    return max(1.0, 2.0 * float(pairs[:last].sum()) - 1.0)


def _uniformity(transforms: Sequence[FloatArray], used: Sequence[BoolArray], counts: IntArray) -> float:
    """Return the p-value of Pearson's chi^2 over the bins, thinned by the correlation of |z|."""
    total, effective = 0, 0.0
    for values, use in zip(transforms, used, strict=True):
        for column in range(values.shape[1]):
            series = values[use[:, column], column]
            if series.size:
                slow = max(correlation_time(series), correlation_time(np.abs(series)))
                total += series.size
                effective += series.size / slow
    if effective < PIT_BINS:
        return nan
    expected = total / PIT_BINS
    statistic = float(np.sum((counts - expected) ** 2) / expected) * effective / total
    return float(stats.chi2.sf(statistic, PIT_BINS - 1))


def score_gain(before: ResidualSet, after: ResidualSet) -> tuple[float, float]:
    """Return the gain of the mean predictive log density per sample, and its standard error.

    Trials are the units: the error is that of a ratio over clusters. With fewer than five trials it is at
    least the error within them, from sums over sixteenths of each record (all channels at once, so that
    neighbouring samples may depend on each other); with one trial it is that alone.
    """
    sums, counts, within = [], [], 0.0
    for first, second in zip(before.trials, after.trials, strict=True):
        use = first.used
        finer = np.log(first.noise_deviation / second.noise_deviation)  # where no noise is recorded
        gain = np.where(use, log_density(second) - log_density(first) + finer, 0.0)
        sums.append(float(gain.sum()))
        counts.append(int(use.sum()))
        within += _variance_within(gain.sum(axis=1))
    total = sum(counts)
    mean = sum(sums) / total
    inner = sqrt(within) / total
    if len(sums) == 1:
        return mean, inner
    scatter = sum((s - mean * n) ** 2 for s, n in zip(sums, counts, strict=True))
    outer = sqrt(len(sums) / (len(sums) - 1) * scatter) / total
    return mean, outer if len(sums) >= _ENOUGH_TRIALS else max(outer, inner)


def _variance_within(series: FloatArray) -> float:
    """Return the variance of the sum of a series from differences of neighbouring sums.

    Differences, because the expected gain itself changes slowly along a record, as the motion decays.
    """
    sums = np.array([part.sum() for part in np.array_split(series, min(_PARTS, series.size))])
    if sums.size < 2:
        return 0.0
    return float(0.5 * np.sum(np.diff(sums) ** 2) * sums.size / (sums.size - 1))


def held_out_gate(after: ResidualSet) -> Gate:
    """Judge whether a name survives the trials that it did not see.

    Parameters
    ----------
    after : ResidualSet
        With the effect.

    Returns
    -------
    Gate
        Failed where χ² per sample of the held-out trials lies more than `HELD_OUT_DEVIATIONS` of its
        deviations above what is expected, or the coverage of 90 % intervals is outside `COVERAGE`. `passed`
        is None without a held-out trial or without a noise record.
    """
    if after.held_out is None:
        return _held_out_outcome(None, nan, "No trial was held out.")
    found = scores(after.held_out)
    beyond = chi_square_of(after.held_out).beyond
    if not isfinite(beyond):
        return _held_out_outcome(None, nan, "No noise record to judge them by.")
    if beyond > HELD_OUT_DEVIATIONS:
        reason = f"On held-out trials χ² per sample is {chi_square_text(found)}."
        return _held_out_outcome(False, beyond, reason)
    if found.sample_count >= LEAST_COVERED and not COVERAGE[0] <= found.coverage_90 <= COVERAGE[1]:
        percent = 100.0 * found.coverage_90
        reason = f"90 % intervals hold {percent:.0f} % of the samples of held-out trials."
        return _held_out_outcome(False, beyond, reason)
    return _held_out_outcome(True, beyond, "Held-out trials are predicted within their noise.")


def _held_out_outcome(passed: bool | None, beyond: float, reason: str) -> Gate:
    return Gate("held-out trials", passed, beyond, HELD_OUT_DEVIATIONS, reason)


def chi_square_text(found: Scores) -> str:
    """Return χ² per sample beside what a right model would have."""
    expected = f"{found.chi_square_expected:.3g} ± {found.chi_square_deviation:.2g}"
    return f"{found.chi_square_per_sample:.3g}, where {expected} is expected of a right model"


def told_share(before: ResidualSet, after: ResidualSet) -> tuple[ClosedShare | None, str]:
    """Return the share of the mean square error that a hypothesis takes away, or None and the reason.

    There is none where held-out trials are predicted within their noise without the hypothesis and with it:
    they do not test it. An error beyond the noise counts even where the posterior leaves that much open.

    Parameters
    ----------
    before, after : ResidualSet
        The same trials and samples, without and with the hypothesis.
    """
    closed = closed_share(before, after)
    if closed is None:
        return None, "The model as it was leaves no error at all."
    if closed.trials == "held-out":
        without, with_effect = (_chi_square_by_diagonal(item.held_out or item) for item in (before, after))
        if without.beyond_noise < SMALLEST_GAP and with_effect.beyond_noise <= HELD_OUT_DEVIATIONS:
            found = f"χ² per sample {without.per_sample:.3g}, 1 for noise alone"
            return None, f"Held-out trials show no gap before: {found}."
    return closed, "" if closed.trials == "held-out" else "No trial was held out."


def _chi_square_by_diagonal(residuals: ResidualSet) -> ChiSquare:
    """Return χ² per sample, its deviation without the correlations of what the fit absorbs.

    It is the same whether sensitivities were asked for or not.
    """
    trials = tuple(replace(item, sensitivity=None) for item in residuals.trials)
    return chi_square_of(replace(residuals, trials=trials))


def prove(before: ResidualSet, after: ResidualSet, *, effects: tuple[str, ...] = (), seed: int = 0) -> Proof:
    """Return the proof from the residuals without and with the effect.

    Parameters
    ----------
    before, after : ResidualSet
        The same trials and samples.
    effects : tuple of str
        What is added, as `discrepancy.verdict.effect_label` gives it.
    seed : int
        As of `scores`.

    Raises
    ------
    FitError
        If no sample of one of the roles is used.
    """
    after = over_noise_of(after, before)
    held = [None if one.held_out is None else scores(one.held_out, seed=seed) for one in (before, after)]
    fitted = [scores(one.fitted or one, seed=seed) for one in (before, after)]
    closed, reason = told_share(before, after)
    gain, error = nan, nan
    if before.held_out is not None and after.held_out is not None:
        gain, error = score_gain(before.held_out, after.held_out)
    remaining = _remaining(after.held_out or after.fitted or after, held[1] or fitted[1])
    return Proof(
        held_out_before=held[0],
        held_out_after=held[1],
        fitted_before=fitted[0],
        fitted_after=fitted[1],
        closed=closed,
        log_score_gain=gain,
        log_score_gain_error=error,
        remaining=remaining,
        closed_reason=reason,
        effects=effects,
    )


def _remaining(residuals: ResidualSet, after: Scores) -> str:
    """Return a sentence on what is still not explained."""
    if not isfinite(after.chi_square_per_sample):
        return "Without a noise record it is not known what remains."
    trials = "held-out trials" if residuals.trials[0].trial.held_out else "fitted trials"
    size = f"χ² per sample {after.chi_square_per_sample:.3g} on {trials}"
    known = residuals.recorded
    square, freedom = mean_square(residuals, known)
    if variance_p_value(square, freedom, min(map(residuals.degrees_of_freedom, known))) < _REMAINS:
        by_channel = {name: _channel_chi_square(residuals, name) for name in known}
        worst = max(by_channel, key=lambda name: by_channel[name])
        return f"Still unexplained: {size}, most on {worst} ({by_channel[worst]:.3g})."
    if after.whiteness < _REMAINS:
        return f"The size is that of noise ({size}), but residuals are not white (p = {after.whiteness:.1g})."
    return f"Nothing that these data can show remains ({size})."


def _channel_chi_square(residuals: ResidualSet, name: str) -> float:
    """Return the mean square residual of a channel over the noise."""
    records = of_channel(residuals.trials, name)
    squares = [item.standardised[used, column] ** 2 for item, column, used in records]
    return float(np.concatenate(squares).mean())
