"""Proof of an effect: errors and scores of the trials without and with it, on the same scale.

Errors and χ² are those of residuals over the noise deviation alone. The uncertainty of the fitted
unknowns enters the expected value of χ² and the probabilistic scores, but not the stated errors.

Scores follow Gneiting and Raftery 2007 (J. Am. Stat. Assoc. 102, 359-378); predictions are Gaussian
with the predictive deviations of the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan, sqrt

import numpy as np
from scipy import stats

from discrepancy.campaign.noise_tests import lag_products, ljung_box, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.errors import FitError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.location.residuals import FittedTrial, ResidualSet, channel_fits, mean_square_ratio
from discrepancy.proof_record import ClosedShare, ErrorComparison, Proof, Scores
from discrepancy.search.fitted_candidates import FittedCandidates
from discrepancy.verdict import Gate

from .closed_share import closed_share, residuals_with_noise_of, rms_by_channel

PIT_BINS = 10
"""Bins of the histogram of probability integral transforms."""
LEAST_EXCESS_DEVIATIONS = 2.0
"""Least excess of χ² per sample over that of noise, in its standard deviations, for held-out trials
to test a hypothesis."""
HELD_OUT_DEVIATIONS = 3.0
"""Excess of χ² per sample of held-out trials over its expected value, in standard deviations, above
which a hypothesis fails."""
COVERAGE = (0.80, 0.97)
"""Least and largest fraction of held-out samples that may lie within their 90 % intervals."""
LEAST_SAMPLES_FOR_COVERAGE = 200
"""Least number of samples for that fraction to be tested."""
ENOUGH_TRIALS = 5
"""Least number of trials for the scatter between them alone to give the error of a score."""
PARTS_OF_RECORD = 16
"""Parts of a record whose scatter gives the error within a trial."""
REMAINING_LEVEL = 0.01
"""p-value below which a gap is said to remain."""


# ---------------------------------------------------------------- scores


def compute_scores(residuals: ResidualSet, *, seed: int = 0) -> Scores:
    """Return the scores of trials that are all fitted, or all held out.

    Parameters
    ----------
    residuals : ResidualSet
        One or more trials with their predictions.
    seed : int
        The seed of the random numbers that are added to residuals of a fit to make them white, see
        `ResidualSet.whitened_residuals`.

    Raises
    ------
    FitError
        If no sample is used.
    """
    # residuals over their predictive deviations: standard normal if the predictions are right
    standardised = [
        fitted_trial.residual / fitted_trial.predictive_deviation
        for fitted_trial in residuals.trials
    ]
    used_by_trial = [fitted_trial.used for fitted_trial in residuals.trials]
    used_standardised = np.concatenate(
        [values[is_used] for values, is_used in zip(standardised, used_by_trial, strict=True)]
    )
    if used_standardised.size == 0:
        raise FitError(
            "Scores need at least one used sample, but these trials have none; check their gaps "
            "and the faults that were found in them."
        )
    log_densities = [
        log_density(fitted_trial)[fitted_trial.used] for fitted_trial in residuals.trials
    ]
    chi_square = chi_square_of(residuals)
    white_residuals = residuals.whitened_residuals(np.random.default_rng(seed))
    p_values = [
        ljung_box(series.values).p_value for series in residuals.dynamic_series(white_residuals)
    ]
    bin_counts, _ = np.histogram(stats.norm.cdf(used_standardised), bins=PIT_BINS, range=(0.0, 1.0))
    return Scores(
        rms=rms_by_channel(residuals),
        chi_square_per_sample=chi_square.per_sample,
        log_score=float(np.concatenate(log_densities).mean()),
        coverage_50=float(np.mean(np.abs(used_standardised) <= stats.norm.ppf(0.75))),
        coverage_90=float(np.mean(np.abs(used_standardised) <= stats.norm.ppf(0.95))),
        # Bonferroni's correction: the least p-value times the number of series
        whiteness=min(1.0, len(p_values) * min(p_values)) if p_values else nan,
        sample_count=int(used_standardised.size),
        chi_square_expected=chi_square.expected,
        chi_square_deviation=chi_square.deviation,
        pit=tuple(float(share) for share in bin_counts / used_standardised.size),
        pit_p_value=_uniformity_p_value(standardised, used_by_trial, bin_counts),
    )


def log_density(fitted_trial: FittedTrial) -> FloatArray:
    """Return the predictive log density (N, C) of each sample, in units of its noise deviation.

    It is ln N(residual; 0, predictive_deviation^2) + ln s0. A perfect model with exact parameters
    has -(1 + ln 2 pi) / 2 = -1.419 on average.
    """
    deviations = fitted_trial.residual / fitted_trial.predictive_deviation
    relative_deviation = fitted_trial.predictive_deviation / fitted_trial.noise_deviation
    return np.asarray(-0.5 * np.log(2.0 * np.pi) - np.log(relative_deviation) - 0.5 * deviations**2)


@dataclass(frozen=True)
class ChiSquare:
    """χ² per sample of residuals, and its mean and standard deviation if the model is right.

    Attributes
    ----------
    per_sample : float
        The mean square of the residuals over the noise variance.
    expected, deviation : float
        Its mean and standard deviation if the model is right.
    """

    per_sample: float
    expected: float
    deviation: float

    @property
    def excess(self) -> float:
        """The difference from the expected value in deviations; nan without a noise record."""
        return (self.per_sample - self.expected) / self.deviation

    @property
    def excess_over_noise(self) -> float:
        """The difference from noise alone (1) in deviations, without posterior uncertainty.

        The deviation is proportional to the expected value, so that of noise alone is
        deviation / expected.
        """
        return (self.per_sample - 1.0) * self.expected / self.deviation


def chi_square_of(residuals: ResidualSet) -> ChiSquare:
    """Return χ² per sample of trials that are all fitted, or all held out.

    Residuals are compared with the noise records, and channels without a record do not count. All
    values are nan if no channel has one, or if the residuals have no degrees of freedom left. The
    expected mean square of a right model is that of the noise, 1, minus what the fit absorbs in
    fitted trials, plus what the uncertainty of the fit adds in held-out trials.
    """
    undetermined = ChiSquare(per_sample=nan, expected=nan, deviation=nan)
    channels = residuals.recorded_channels
    if not channels:
        return undetermined
    degrees_of_freedom = mean_square_ratio(residuals, channels).degrees_of_freedom
    if degrees_of_freedom <= 0.0:
        return undetermined
    squares = []
    variances = []
    for name in channels:
        for fitted_trial, column, is_used in channel_fits(residuals.trials, name):
            squares.append(fitted_trial.standardised[is_used, column] ** 2)
            variances.append(fitted_trial.expected_variance[is_used, column])
    expected = float(np.concatenate(variances).mean())
    # Channels may share a noise record or not. The worst case is assumed: all share the record with
    # the fewest degrees of freedom.
    freedom_of_record = min(residuals.degrees_of_freedom(name) for name in channels)
    # A mean square of n degrees of freedom has the relative variance 2 / n. Those of the residuals
    # and of the record add up.
    relative_variance = 2.0 / degrees_of_freedom + 2.0 / freedom_of_record
    return ChiSquare(
        per_sample=float(np.concatenate(squares).mean()),
        expected=expected,
        deviation=expected * sqrt(relative_variance),
    )


def samples_per_independent_sample(series: FloatArray) -> float:
    """Return how many samples of a correlated series (N,) count as one independent sample.

    The number is 1 + 2 sum rho_k, with the autocorrelation rho_k at the lag of k samples, and at
    least 1. The sum is Geyer's initial positive sequence (Geyer 1992, Statistical Science
    7, 473-483): sums of neighbouring pairs are added while they are positive.
    """
    count = series.size
    centred_series = series - series.mean()
    sum_of_squares = float(centred_series @ centred_series)
    if count < 4 or sum_of_squares == 0.0:
        return 1.0
    autocorrelation = lag_products(centred_series, count - 1)[0] / sum_of_squares
    pair_sums = autocorrelation[0 : count - 1 : 2] + autocorrelation[1:count:2]
    nonpositive = np.flatnonzero(pair_sums <= 0.0)
    # autocorrelation[0] = 1, so that 1 + 2 (sum over k >= 1) = 2 (sum over k >= 0) - 1
    positive_count = int(nonpositive[0]) if nonpositive.size else pair_sums.size
    return max(1.0, 2.0 * float(pair_sums[:positive_count].sum()) - 1.0)


def _uniformity_p_value(
    standardised: Sequence[FloatArray], used_by_trial: Sequence[BoolArray], counts: IntArray
) -> float:
    """Return the p-value of Pearson's χ² test that a histogram is uniform over its bins.

    Correlated samples count as fewer independent ones. How many is estimated from the standardised
    residuals (N, C) of each trial, where they are used. The p-value is nan with fewer independent
    samples than bins.
    """
    sample_count = 0
    independent_count = 0.0
    for values, is_used in zip(standardised, used_by_trial, strict=True):
        for column in range(values.shape[1]):
            series = values[is_used[:, column], column]
            if series.size:
                samples_per_independent = max(
                    samples_per_independent_sample(series),
                    samples_per_independent_sample(np.abs(series)),
                )
                sample_count += series.size
                independent_count += series.size / samples_per_independent
    if independent_count < PIT_BINS:
        return nan
    expected_per_bin = sample_count / PIT_BINS
    # Pearson's statistic of n dependent samples is too large by n / (number of independent ones)
    statistic = (
        float(np.sum((counts - expected_per_bin) ** 2) / expected_per_bin)
        * independent_count
        / sample_count
    )
    return float(stats.chi2.sf(statistic, PIT_BINS - 1))


def score_gain(residuals_before: ResidualSet, residuals_after: ResidualSet) -> tuple[float, float]:
    """Return the gain of the mean predictive log density per sample, and its standard error [nat].

    The standard error is that of a ratio over clusters, and the trials are the clusters. With fewer
    than five trials it is at least the error within the trials, and with one trial it is just that.
    The error within a trial comes from sums over sixteenths of its record, so that neighbouring
    samples and the channels may depend on each other.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        The same trials without and with the effect.
    """
    trial_sums = []
    trial_counts = []
    variance_within = 0.0
    for without_effect, with_effect in zip(
        residuals_before.trials, residuals_after.trials, strict=True
    ):
        is_used = without_effect.used
        # densities are in units of the noise deviation, which differs for channels without a record
        noise_ratio = np.log(without_effect.noise_deviation / with_effect.noise_deviation)
        gain = log_density(with_effect) - log_density(without_effect) + noise_ratio
        gain = np.where(is_used, gain, 0.0)
        trial_sums.append(float(gain.sum()))
        trial_counts.append(int(is_used.sum()))
        variance_within += _variance_of_sum(gain.sum(axis=1))
    sample_count = sum(trial_counts)
    mean_gain = sum(trial_sums) / sample_count
    error_within = sqrt(variance_within) / sample_count
    if len(trial_sums) == 1:
        return mean_gain, error_within
    squared_scatter = sum(
        (trial_sum - mean_gain * count) ** 2
        for trial_sum, count in zip(trial_sums, trial_counts, strict=True)
    )
    # standard error of a ratio estimate over clusters, with trials as clusters
    error_between = sqrt(len(trial_sums) / (len(trial_sums) - 1) * squared_scatter) / sample_count
    if len(trial_sums) >= ENOUGH_TRIALS:
        return mean_gain, error_between
    return mean_gain, max(error_between, error_within)


def _variance_of_sum(series: FloatArray) -> float:
    """Return the variance of the sum of a correlated series (N,), from sums over its parts.

    Differences of neighbouring sums are used, because the expected value changes slowly along a
    record as the motion decays. A difference has twice the variance of a sum.
    """
    series_parts = np.array_split(series, min(PARTS_OF_RECORD, series.size))
    part_sums = np.array([part_of_series.sum() for part_of_series in series_parts])
    if part_sums.size < 2:
        return 0.0
    # half the mean squared difference is the variance of one part's sum; times the number of parts
    return float(0.5 * np.sum(np.diff(part_sums) ** 2) * part_sums.size / (part_sums.size - 1))


# ---------------------------------------------------------------- the test on held-out trials


def check_held_out(residuals_after: ResidualSet) -> Gate:
    """Test whether a hypothesis predicts the held-out trials.

    Parameters
    ----------
    residuals_after : ResidualSet
        All trials with their predictions by the hypothesis.

    Returns
    -------
    Gate
        It fails if χ² per sample of the held-out trials is more than `HELD_OUT_DEVIATIONS` of its
        deviations above what is expected. It also fails if the coverage of 90 % intervals is
        outside `COVERAGE`, given at least `LEAST_SAMPLES_FOR_COVERAGE` samples. `passed` is None
        without a held-out trial or without a noise record.
    """
    if residuals_after.held_out is None:
        return _held_out_gate(None, nan, "No trial was held out.")
    held_out_scores = compute_scores(residuals_after.held_out)
    excess = chi_square_of(residuals_after.held_out).excess
    if not isfinite(excess):
        return _held_out_gate(None, nan, "There is no noise record to judge them by.")
    if excess > HELD_OUT_DEVIATIONS:
        reason = f"On held-out trials χ² per sample is {chi_square_text(held_out_scores)}."
        return _held_out_gate(False, excess, reason)
    least_coverage, largest_coverage = COVERAGE
    is_covered = least_coverage <= held_out_scores.coverage_90 <= largest_coverage
    if held_out_scores.sample_count >= LEAST_SAMPLES_FOR_COVERAGE and not is_covered:
        percent = 100.0 * held_out_scores.coverage_90
        reason = f"90 % intervals hold {percent:.0f} % of the samples of held-out trials."
        return _held_out_gate(False, excess, reason)
    return _held_out_gate(True, excess, "Held-out trials are predicted within their noise.")


def _held_out_gate(passed: bool | None, excess: float, reason: str) -> Gate:
    """Return the outcome of the test on held-out trials."""
    return Gate("held-out trials", passed, excess, HELD_OUT_DEVIATIONS, reason)


def chi_square_text(trial_scores: Scores) -> str:
    """Return χ² per sample in words, with the value that is expected of a right model."""
    expected_text = (
        f"{trial_scores.chi_square_expected:.3g} ± {trial_scores.chi_square_deviation:.2g}"
    )
    per_sample = f"{trial_scores.chi_square_per_sample:.3g}"
    return f"{per_sample}, where {expected_text} is expected of a right model"


# ---------------------------------------------------------------- proof of a verdict


def compare_errors(residuals_before: ResidualSet, residuals_after: ResidualSet) -> ErrorComparison:
    """Return the errors of the deciding trials without and with a hypothesis.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        The same trials and samples, without and with the hypothesis.
    """
    share, reason = _closed_share_or_reason(residuals_before, residuals_after)
    return ErrorComparison(
        closed=share,
        closed_reason=reason,
        rms_before=rms_by_channel(
            residuals_before.held_out or residuals_before.fitted or residuals_before
        ),
        rms_after=rms_by_channel(
            residuals_after.held_out or residuals_after.fitted or residuals_after
        ),
    )


def errors_of_fit(search: FittedCandidates, fit: CandidateFit) -> ErrorComparison:
    """Return the errors of the deciding trials without effect and with a fit of a search.

    They are computed once for each fit and size of the time steps.
    """
    key = (fit, search.problem.refinement)
    if key not in search.errors_by_fit:
        residuals_before = search.residuals(search.no_effect)
        search.errors_by_fit[key] = compare_errors(residuals_before, search.residuals(fit))
    return search.errors_by_fit[key]


def _closed_share_or_reason(
    residuals_before: ResidualSet, residuals_after: ResidualSet
) -> tuple[ClosedShare | None, str]:
    """Return the share of the mean square error that a hypothesis removes, or None and the reason.

    There is no share if held-out trials are predicted within their noise both without and with the
    hypothesis, as they do not test it. An error beyond the noise is counted even if it is within
    the uncertainty of the posterior.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        The same trials and samples, without and with the hypothesis.

    Returns
    -------
    share : ClosedShare or None
        The share of the mean square error that the hypothesis removes.
    reason : str
        The reason why there is no share, or why it is that of fitted trials; else empty.
    """
    share = closed_share(residuals_before, residuals_after)
    if share is None:
        return None, "The unchanged model leaves no error at all."
    if share.trials != "held-out":
        return share, "No trial was held out."
    chi_square_before = _chi_square_by_diagonal(residuals_before.held_out or residuals_before)
    chi_square_after = _chi_square_by_diagonal(residuals_after.held_out or residuals_after)
    has_no_gap_before = chi_square_before.excess_over_noise < LEAST_EXCESS_DEVIATIONS
    if has_no_gap_before and chi_square_after.excess_over_noise <= HELD_OUT_DEVIATIONS:
        chi_square = f"χ² per sample {chi_square_before.per_sample:.3g}, 1 for noise alone"
        return None, (
            "The held-out trials do not test it: the unchanged model predicts them within their "
            f"noise ({chi_square})."
        )
    return share, ""


def _chi_square_by_diagonal(residuals: ResidualSet) -> ChiSquare:
    """Return χ² per sample, with a deviation that neglects correlations caused by the fit.

    So it does not depend on whether sensitivities were computed.
    """
    trials = tuple(replace(fitted_trial, sensitivity=None) for fitted_trial in residuals.trials)
    return chi_square_of(replace(residuals, trials=trials))


def prove_effects(
    residuals_before: ResidualSet,
    residuals_after: ResidualSet,
    *,
    errors: ErrorComparison | None = None,
    effects: tuple[str, ...] = (),
    seed: int = 0,
) -> Proof:
    """Return the proof of an effect: errors and scores without and with it.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        The same trials and samples, without and with the effect.
    errors : ErrorComparison, optional
        Their errors, if they are known already, as the sentence of a verdict states them.
    effects : tuple of str
        The labels of the effects that are added, see `discrepancy.verdict.effect_label`.
    seed : int
        The seed of the draw for the test of whiteness, see `compute_scores`.

    Raises
    ------
    FitError
        If no sample of the fitted or of the held-out trials is used.
    """
    # the same noise deviation for both, so that errors and scores can be compared
    residuals_after = residuals_with_noise_of(residuals_after, residuals_before)
    held_out_before = _held_out_scores(residuals_before, seed)
    held_out_after = _held_out_scores(residuals_after, seed)
    fitted_before = compute_scores(residuals_before.fitted or residuals_before, seed=seed)
    fitted_after = compute_scores(residuals_after.fitted or residuals_after, seed=seed)
    errors = errors or compare_errors(residuals_before, residuals_after)
    gain = nan
    gain_error = nan
    if residuals_before.held_out is not None and residuals_after.held_out is not None:
        gain, gain_error = score_gain(residuals_before.held_out, residuals_after.held_out)
    decisive_trials = residuals_after.held_out or residuals_after.fitted or residuals_after
    return Proof(
        held_out_before=held_out_before,
        held_out_after=held_out_after,
        fitted_before=fitted_before,
        fitted_after=fitted_after,
        closed=errors.closed,
        log_score_gain=gain,
        log_score_gain_error=gain_error,
        remaining=_remaining_sentence(decisive_trials, held_out_after or fitted_after),
        closed_reason=errors.closed_reason,
        effects=effects,
    )


def _held_out_scores(residuals: ResidualSet, seed: int) -> Scores | None:
    """Return the scores of the held-out trials; None if there is none."""
    return None if residuals.held_out is None else compute_scores(residuals.held_out, seed=seed)


def _remaining_sentence(residuals: ResidualSet, scores: Scores) -> str:
    """Return a sentence on what remains after the effect, given the residuals and their scores.

    The trials must be either all held out, or all fitted.
    """
    if not isfinite(scores.chi_square_per_sample):
        return "Without a noise record it is not known what remains."
    trials = "held-out trials" if residuals.trials[0].trial.held_out else "fitted trials"
    chi_square_phrase = f"χ² per sample {scores.chi_square_per_sample:.3g} on {trials}"
    channels = residuals.recorded_channels
    # Are the residuals larger than the noise? The mean square has the expectation one for noise.
    mean_square, degrees_of_freedom = mean_square_ratio(residuals, channels)
    noise_freedom = min(residuals.degrees_of_freedom(name) for name in channels)
    size_p_value = variance_p_value(mean_square, degrees_of_freedom, noise_freedom)
    if size_p_value < REMAINING_LEVEL:
        by_channel = {name: _channel_chi_square(residuals, name) for name in channels}
        worst = max(by_channel, key=lambda name: by_channel[name])
        return f"Still unexplained: {chi_square_phrase}, most on {worst} ({by_channel[worst]:.3g})."
    # `whiteness` is the p-value of a test whether successive residuals are independent.
    if scores.whiteness < REMAINING_LEVEL:
        return (
            f"The size is that of noise ({chi_square_phrase}), but residuals are not white "
            f"(p = {scores.whiteness:.1g})."
        )
    return f"These data show no remaining error ({chi_square_phrase})."


def _channel_chi_square(residuals: ResidualSet, name: str) -> float:
    """Return the mean square residual of a channel over its noise variance."""
    squares = []
    for fitted_trial, column, is_used in channel_fits(residuals.trials, name):
        squares.append(fitted_trial.standardised[is_used, column] ** 2)
    return float(np.concatenate(squares).mean())
