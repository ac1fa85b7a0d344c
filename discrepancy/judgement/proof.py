"""Proof: what an effect does to the trials, before and after, at the same scale.

Scores follow Gneiting and Raftery 2007 (J. Am. Stat. Assoc. 102, 359-378); predictions are Gaussian with the
predictive deviations handed over by the fit.
"""

from collections.abc import Sequence
from math import nan, sqrt

import numpy as np
from scipy import stats

from discrepancy.campaign.noise_tests import lag_products, ljung_box, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.errors import FitError, said
from discrepancy.location.residuals import FittedTrial, ResidualSet, mean_square, of_channel
from discrepancy.verdict import Gate, Proof, Scores

PIT_BINS = 10
"""Bins of the histogram of probability integral transforms."""

SMALLEST_GAP = 2.0
"""A gap to close is at least this many standard deviations of χ²/dof above one."""

HELD_OUT_DEVIATIONS = 3.0
"""Deviations of χ²/dof on held-out trials above one from which on a name does not survive them."""
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
    square, deviation = chi_square_per_dof(residuals)
    white = residuals.white(np.random.default_rng(seed))
    channels = [ljung_box(series)[1] for _, _, series in residuals.series(white)]
    uniform = stats.norm.cdf(z)
    counts = np.histogram(uniform, bins=PIT_BINS, range=(0.0, 1.0))[0]
    return Scores(
        rms=_rms(residuals),
        chi_square_per_dof=square,
        log_score=float(density.mean()),
        coverage_50=float(np.mean(np.abs(z) <= stats.norm.ppf(0.75))),
        coverage_90=float(np.mean(np.abs(z) <= stats.norm.ppf(0.95))),
        whiteness=min(1.0, len(channels) * min(channels)) if channels else nan,
        sample_count=int(z.size),
        chi_square_deviation=deviation,
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


def chi_square_per_dof(residuals: ResidualSet) -> tuple[float, float]:
    """Return χ²/dof against the noise records, and its standard deviation if the model is right.

    Channels without a noise record do not count; nan if none has one. Degrees of freedom are the expected
    sum of squares: samples less what the fit absorbs, or plus what its uncertainty adds to held-out trials.
    """
    known = residuals.recorded
    if not known:
        return nan, nan
    square, freedom = mean_square(residuals, known)
    if freedom <= 0.0:
        return nan, nan
    # Channels may share their record or not; the worst case, that all share the poorest one, is assumed.
    noise = min(residuals.degrees_of_freedom(name) for name in known)
    return square, sqrt(2.0 / freedom + 2.0 / noise)


def _rms(residuals: ResidualSet) -> dict[str, float]:
    found: dict[str, float] = {}
    for name in residuals.measured:
        records = of_channel(residuals.trials, name)
        squares = np.concatenate([item.residual[used, column] ** 2 for item, column, used in records])
        found |= {name: sqrt(squares.mean())} if squares.size else {}
    return found


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
        Failed where χ²/dof of the held-out trials lies more than `HELD_OUT_DEVIATIONS` of its deviations
        above one, or the coverage of 90 % intervals is outside `COVERAGE`. `passed` is None without a
        held-out trial or without a noise record.
    """
    outside = after.held_out
    if outside is None:
        return _gate(None, nan, "no_trial")
    found = scores(outside)
    beyond = (found.chi_square_per_dof - 1.0) / found.chi_square_deviation
    if not np.isfinite(beyond):
        return _gate(None, nan, "no_noise_record")
    if beyond > HELD_OUT_DEVIATIONS:
        return _gate(False, beyond, "misfit", found)
    if found.sample_count >= LEAST_COVERED and not COVERAGE[0] <= found.coverage_90 <= COVERAGE[1]:
        return _gate(False, beyond, "coverage", found)
    return _gate(True, beyond, "within")


def _gate(passed: bool | None, beyond: float, say: str, found: Scores | None = None) -> Gate:
    percent = nan if found is None else 100.0 * found.coverage_90
    reason = said(f"proof.{say}", found=found, percent=percent)
    return Gate("held-out trials", passed, beyond, HELD_OUT_DEVIATIONS, reason)


def gap_closed(before: Scores | None, after: Scores | None) -> tuple[float, str]:
    """Return 1 - (χ²_after - 1) / (χ²_before - 1), or nan and the reason.

    A χ²/dof below one after counts as one: fitting noise closes no gap.
    """
    if before is None or after is None:
        return nan, said("proof.no_trial")
    if not np.isfinite(before.chi_square_per_dof):
        return nan, said("proof.no_noise_record_before")
    gap = before.chi_square_per_dof - 1.0
    if gap < SMALLEST_GAP * before.chi_square_deviation:
        return nan, said("proof.no_gap", found=before)
    return 1.0 - max(after.chi_square_per_dof - 1.0, 0.0) / gap, ""


def prove(before: ResidualSet, after: ResidualSet, *, seed: int = 0) -> Proof:
    """Return the proof from the residuals without and with the effect.

    Parameters
    ----------
    before, after : ResidualSet
        The same trials and samples.
    seed : int
        As of `scores`.

    Raises
    ------
    FitError
        If no sample of one of the roles is used.
    """
    outside = (before.held_out, after.held_out)
    held = [None if one is None else scores(one, seed=seed) for one in outside]
    fitted = [scores(one.fitted or one, seed=seed) for one in (before, after)]
    closed, reason = gap_closed(held[0], held[1])
    gain, error = nan, nan
    if outside[0] is not None and outside[1] is not None:
        gain, error = score_gain(outside[0], outside[1])
    remaining = _remaining(outside[1] or after.fitted or after, held[1] or fitted[1])
    return Proof(held[0], held[1], fitted[0], fitted[1], closed, gain, error, remaining, reason)


def _remaining(residuals: ResidualSet, after: Scores) -> str:
    """Return a sentence on what is still not explained."""
    if not np.isfinite(after.chi_square_per_dof):
        return said("proof.not_known")
    where = "held-out" if residuals.trials[0].trial.held_out else "fitted"
    known = residuals.recorded
    square, freedom = mean_square(residuals, known)
    if variance_p_value(square, freedom, min(map(residuals.degrees_of_freedom, known))) < _REMAINS:
        shares = {name: mean_square(residuals, (name,))[0] for name in known}
        worst = max(shares, key=lambda name: shares[name])
        return said("proof.remains", found=after, where=where, worst=worst, share=shares[worst])
    return said("proof.coloured" if after.whiteness < _REMAINS else "proof.nothing", found=after, where=where)
