"""Evidence of hypotheses under a noise that is as large as the residuals of the best hypothesis.

The search itself uses the recorded noise, which shows best how far a fit is from the truth. But the
residuals of a model of a real structure are never white noise of the recorded level (Kennedy and
O'Hagan 2001, J. R. Stat. Soc. B 63, 425-464). Log evidence under the recorded noise then differs by
thousands of nats between hypotheses that such a model cannot tell apart.

In that case hypotheses are compared under a *wider noise*. Its variance is that of the residuals of
the best hypothesis, times the number of samples per independent sample: the sum of squares of N
samples with the autocorrelation rho_k is as certain as that of N / (1 + 2 sum rho_k^2) independent
ones (Bartlett 1946, Suppl. J. R. Stat. Soc. 8, 27-41). This correlation is considered in trials in
motion only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import CandidateKey, ResidualProcess
from discrepancy.fits.fitting import MOST_FIT_STEPS, CandidateFit, try_fit
from discrepancy.fits.gates import ResidualRecord, residual_records, whiteness_p_value
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import report_each
from .strategy import Search

LEAST_P_VALUE = 1e-3
"""Least p-value with which residuals are taken as noise of the recorded level, or as white."""
LARGEST_INTERVAL_DIFFERENCE = 0.25
"""Largest relative difference of sampling intervals with which a noise record is compared with
residuals."""
OSCILLATION_MINIMUM = -0.25
"""Autocorrelation at its first minimum below which a process oscillates."""
LARGEST_CORRELATION_DIFFERENCE = 3.0
"""Largest difference between the correlations of residuals and of the noise record with which they
agree [standard deviations]."""
LEAST_WHITE_SHARE = 1e-12
"""Least variance of an unrecorded noise, as a fraction of the residuals' mean square."""
SECOND_DIFFERENCES = 6.0
"""Variance of the second differences of white noise over its own: 1 + 4 + 1 by their weights."""


# ---------------------------------------------------------------- residual process of a fit


@dataclass(frozen=True)
class _ChannelProcess:
    """The residual process of one channel; `ResidualProcess` defines the attributes.

    The defaults are those of white noise.
    """

    amplitude: float = 0.0
    noise_factor: float = 1.0
    correlation_time: float = 0.0
    frequency: float = 0.0
    is_recorded_colour: bool = False


def estimate_residual_process(problem: Problem, fit: CandidateFit) -> ResidualProcess:
    """Return the random process in the residuals of a fit besides the recorded noise.

    Parameters
    ----------
    problem : Problem
        The campaign and model under the recorded noise.
    """
    noise_levels = unrecorded_noise_levels(problem, fit)
    channels = []
    for channel in range(len(problem.channel_names)):
        channels.append(_channel_process(problem, fit, channel, float(noise_levels[channel])))
    return ResidualProcess(
        amplitude=np.array([process.amplitude for process in channels]),
        noise_factor=np.array([process.noise_factor for process in channels]),
        correlation_time=np.array([process.correlation_time for process in channels]),
        frequency=np.array([process.frequency for process in channels]),
        is_recorded_colour=np.array([process.is_recorded_colour for process in channels]),
    )


def _channel_process(
    problem: Problem, fit: CandidateFit, channel: int, noise_level: float
) -> _ChannelProcess:
    """Return the random process in the residuals of one channel besides white noise.

    `noise_level` is the variance of the noise over s0^2, with s0 its recorded deviation or, without
    a record, a stand-in.
    """
    records = residual_records(problem, fit, channel)
    if not records:
        return _ChannelProcess()
    residual_series = [record.values for record in records]
    sample_count = sum(float(record.is_used.sum()) for record in records)
    residual_freedom = max(sample_count - fit.absorbed_freedom[channel], 1.0)
    has_record = problem.record_freedom[channel] > 0.0
    mean_square = _sum_of_squares(residual_series) / residual_freedom
    sampling_interval = max(float(np.median(record.steps)) for record in records)
    recorded_colour = _recorded_colour(
        problem, problem.channel_names[channel], records, sampling_interval
    )
    # compare the variance of the residuals with the noise record
    is_larger = False
    if has_record:
        p_value = noise_tests.variance_p_value(
            mean_square,
            residual_freedom / recorded_colour.samples_per_independent,
            problem.record_freedom[channel] / recorded_colour.samples_per_independent,
        )
        is_larger = p_value < LEAST_P_VALUE
    # white noise of the recorded level: no process
    if not is_larger and whiteness_p_value(records) > LEAST_P_VALUE:
        return _ChannelProcess()
    # compare their correlation with that of the noise record
    autocorrelation, white_variance = noise_tests.autocorrelation(residual_series)
    correlation_deviation = np.sqrt(1.0 / sample_count + recorded_colour.variance)
    correlation_difference = abs(autocorrelation[0] - recorded_colour.correlation)
    has_record_colour = (
        correlation_difference < LARGEST_CORRELATION_DIFFERENCE * correlation_deviation
    )
    is_recorded_colour = bool(not is_larger and has_record_colour)
    # noise factor: variance of the residuals times samples per independent sample
    if is_recorded_colour:
        wide_variance = 1.0
    elif has_record:
        wide_variance = max(mean_square, 1.0)
    else:
        wide_variance = mean_square
    noise_factor = np.sqrt(
        wide_variance * noise_tests.statistical_inefficiency(autocorrelation, white_variance)
    )
    process = _ChannelProcess(noise_factor=noise_factor, is_recorded_colour=is_recorded_colour)
    # the process is what the residuals have besides the noise
    process_variance = mean_square / noise_level - 1.0
    if is_recorded_colour or process_variance <= 0.0:
        return process
    return _add_correlation_in_time(
        process, process_variance, autocorrelation, white_variance, sampling_interval
    )


def _add_correlation_in_time(
    process: _ChannelProcess,
    variance_ratio: float,
    autocorrelation: FloatArray,
    white_variance: FloatArray,
    interval: float,
) -> _ChannelProcess:
    """Return a process with its amplitude, correlation time and frequency.

    The residuals of the channel are the sum of white noise and this process. The process oscillates
    if its autocorrelation has a deep first minimum; otherwise its frequency is zero.

    Parameters
    ----------
    process : _ChannelProcess
        The process without these three values.
    variance_ratio : float
        The variance of the process divided by the variance of the white noise.
    autocorrelation : (K,) array
        The autocorrelation of the residuals at lags of 1 to K samples.
    white_variance : (K,) array
        The variance that each estimate in `autocorrelation` would have for white residuals.
    interval : float
        The interval between successive samples [s].
    """
    # White noise adds to the variance of the residuals, but not to their correlation. So the
    # correlation of the process is larger by the ratio of the variances.
    residuals_over_process = (1.0 + variance_ratio) / variance_ratio
    correlation_time = interval * noise_tests.statistical_inefficiency(
        autocorrelation, white_variance, residuals_over_process
    )
    frequency = 0.0
    process_autocorrelation = autocorrelation * residuals_over_process
    # the first lag after which the autocorrelation rises; argmax returns the first lag of all if it
    # never rises
    first_minimum = int(np.argmax(np.diff(process_autocorrelation) > 0.0))
    if process_autocorrelation[first_minimum] < OSCILLATION_MINIMUM:
        # the first minimum is at half a period; index 0 is a lag of one interval
        frequency = 0.5 / ((first_minimum + 1) * interval)
        # The correlation time was computed from squared autocorrelations. An oscillation multiplies
        # them by a squared cosine, whose mean is a half, so that the time came out half as long.
        correlation_time *= 2.0
    return replace(
        process,
        amplitude=np.sqrt(variance_ratio),
        correlation_time=correlation_time,
        frequency=frequency,
    )


def _sum_of_squares(series: Sequence[FloatArray]) -> float:
    """Return the sum of squares of several series (N,)."""
    return sum(float(values @ values) for values in series)


def unrecorded_noise_levels(problem: Problem, fit: CandidateFit) -> FloatArray:
    """Return the noise variance of each channel over s0^2, (channels,); 1 with a noise record.

    Without a record the variance is estimated from the second differences of the residuals. The
    second differences of white noise have six times the variance of the noise, while a slow process
    contributes hardly anything.
    """
    levels = np.ones(len(problem.channel_names))
    for channel in np.flatnonzero(problem.record_freedom == 0.0):
        records = residual_records(problem, fit, int(channel))
        residual_series = [record.values for record in records]
        differences = [np.diff(values, 2) for values in residual_series]
        mean_square = _sum_of_squares(residual_series) / max(
            sum(len(values) for values in residual_series), 1
        )
        difference_count = max(sum(len(values) for values in differences), 1)
        white_variance = _sum_of_squares(differences) / SECOND_DIFFERENCES / difference_count
        if mean_square > 0.0:
            levels[channel] = min(max(white_variance, LEAST_WHITE_SHARE * mean_square), mean_square)
        else:  # the channel is in trials at rest only
            levels[channel] = 1.0 / problem.noise_precisions(fit.squares_by_channel)[channel]
    return levels


class _RecordedColour(NamedTuple):
    """The correlation in time that residuals have if they are noise as in the noise record.

    Attributes
    ----------
    correlation : float
        The correlation of neighbouring samples; nan if it is not known.
    variance : float
        The variance of this estimate.
    samples_per_independent : float
        The number of samples per independent sample.
    """

    correlation: float
    variance: float
    samples_per_independent: float


def _recorded_colour(
    problem: Problem, name: str, records: Sequence[ResidualRecord], interval: float
) -> _RecordedColour:
    """Return the correlation in time that the residuals of a channel have if they are its noise.

    It comes from the noise record, at the time steps of the residuals, as a mean over their
    records. If residuals are whitened, the noise record is passed through the same filter first.
    The correlation is nan if there are no noise samples, or if their interval differs from
    that of the residuals, `interval` [s], by more than `LARGEST_INTERVAL_DIFFERENCE`.
    """
    unknown_colour = _RecordedColour(np.nan, 0.0, 1.0)
    record = problem.campaign.channels[name].noise
    noise_model = problem.noise_models[name]
    if record is None or record.samples is None or record.interval is None:
        return unknown_colour
    if not np.any(record.samples):
        return unknown_colour
    centred_record = record.samples - record.samples.mean()
    if abs(record.interval - interval) > LARGEST_INTERVAL_DIFFERENCE * interval:
        return unknown_colour
    colours = []
    for residuals in records:
        is_whitened = len(residuals.steps) == 1
        comparable_noise = (
            noise_model.whiten(centred_record, record.interval) if is_whitened else centred_record
        )
        autocorrelation, white_variance = noise_tests.autocorrelation([comparable_noise])
        if is_whitened:
            correlation = float(autocorrelation[0])
            samples_per_independent = 1.0
        else:
            # correlation of the record at the steps of the residuals
            lag_numbers = np.arange(1 + len(autocorrelation))
            correlation_at_steps = np.interp(
                residuals.steps / record.interval, lag_numbers, np.r_[1.0, autocorrelation]
            )
            correlation = float(np.mean(correlation_at_steps))
            samples_per_independent = noise_tests.statistical_inefficiency(
                autocorrelation, white_variance
            )
        colours.append(
            _RecordedColour(correlation, 1.0 / len(centred_record), samples_per_independent)
        )
    return _RecordedColour(*np.mean(colours, axis=0).tolist())


# ---------------------------------------------------------------- fits under the wider noise


def with_wide_noise(problem: Problem, process: ResidualProcess) -> Problem:
    """Return the problem under the wider noise of a residual process.

    It is the given problem if the process is white noise of the recorded level.
    """
    return problem.with_wider_noise(process.noise_factor) if process.is_present else problem


def refit_under_wide_noise(
    problem: Problem, wide_problem: Problem, fit: CandidateFit, *, iterations: int = MOST_FIT_STEPS
) -> CandidateFit | None:
    """Return the fit of a hypothesis under a wider noise.

    Point, evidence and covariance come from the fit under the wider noise. The residuals are those
    at this point relative to the recorded noise, and the residual process describes them.

    Parameters
    ----------
    problem : Problem
        The problem under the recorded noise.
    wide_problem : Problem
        The problem under the wider noise.
    iterations : int
        The largest number of steps.

    Returns
    -------
    CandidateFit or None
        The fit; the given one if both problems are the same. None if the hypothesis cannot be
        fitted under the wider noise: its evidence under the recorded noise could not be compared
        with that of others under the wider noise.
    """
    if wide_problem is problem:
        return fit
    wide_fit = try_fit(wide_problem, fit.candidate, fit.point, iterations=iterations)
    if wide_fit is None:
        return None
    # without iterations: residuals at the same point, relative to the recorded noise
    recorded_fit = try_fit(problem, fit.candidate, wide_fit.point, iterations=0)
    if recorded_fit is None:
        return None
    process = estimate_residual_process(problem, recorded_fit)
    return replace(
        recorded_fit,
        log_evidence=wide_fit.log_evidence,
        covariance=wide_fit.covariance,
        converged=wide_fit.converged,
        residual_process=process if process.is_present else None,
    )


# ---------------------------------------------------------------- hypotheses compared under it

LARGEST_ROUND_COUNT = 3
"""Largest number of times that the wider noise is taken from another best hypothesis."""


def compare_under_wide_noise(search: Search) -> None:
    """Fit the most probable hypotheses under the wider noise of the best one's residuals.

    Sets `wide_problem` and `wide_fits` of the search, so that these fits alone are compared from
    then on. The fit without effect is always one of them. The others are chosen by their expected
    score, which is computed from their present residuals. If another hypothesis is the best one
    under the wider noise, the noise is computed again from its residuals, in at most
    `LARGEST_ROUND_COUNT` rounds; after the last one the noise is that of the best fit before it.
    """
    best_fit = search.best()
    probable_fits = _best_fits_of_probable_sets(search)
    for _ in range(LARGEST_ROUND_COUNT):
        process = estimate_residual_process(search.problem, best_fit)
        search.wide_problem = with_wide_noise(search.problem, process)
        search.wide_fits = {}  # those of the last round were made under another noise
        wide_fits = _fit_under_wide_noise(search, search.wide_problem, probable_fits)
        best_wide_fit = max(wide_fits.values(), key=search.score)
        if best_wide_fit.candidate.key == best_fit.candidate.key:
            break
        best_fit = best_wide_fit
    search.wide_fits = wide_fits


def _best_fits_of_probable_sets(search: Search) -> list[CandidateFit]:
    """Return the best fit of each of the most probable sets of one, two and three effects.

    `SEARCH.most_weighed_sets` limits the number of sets of each length.
    """
    best_by_set: dict[tuple[str, ...], CandidateFit] = {}
    for fit in search.compared_fits().values():
        identifiers = fit.candidate.identifiers
        if identifiers and (
            identifiers not in best_by_set
            or search.score(fit) > search.score(best_by_set[identifiers])
        ):
            best_by_set[identifiers] = fit
    probable_fits: list[CandidateFit] = []
    for length, count in enumerate(SEARCH.most_weighed_sets, start=1):
        fits_of_length = [fit for fit in best_by_set.values() if len(fit.candidate.terms) == length]
        probable_fits += sorted(fits_of_length, key=lambda fit: -search.score(fit))[:count]
    return probable_fits


def _fit_under_wide_noise(
    search: Search, wide_problem: Problem, fits: Sequence[CandidateFit]
) -> dict[CandidateKey, CandidateFit]:
    """Return the hypotheses that are compared under a wider noise, fitted under it.

    They are the model without effect, the given fits with the highest expected scores, and the
    subsets of the best of these, so that each of its effects can be shown to be needed.
    """
    # choose by the expected score under the wider noise
    fits_with_scores = [(fit, _expected_score(search, wide_problem, fit)) for fit in fits]
    fits_with_scores.sort(key=lambda fit_and_score: fit_and_score[1], reverse=True)
    least_score = fits_with_scores[0][1] - SEARCH.weighed_range if fits_with_scores else 0.0
    promising_fits = [
        fit for fit, score in fits_with_scores[: SEARCH.most_weighed_fits] if score > least_score
    ]
    # fit the model without effect, and the chosen hypotheses
    wide_fits: dict[CandidateKey, CandidateFit] = {}
    _add_wide_fit(wide_fits, search, wide_problem, search.no_effect)
    for fit in report_each(
        search.on_progress,
        promising_fits,
        lambda fit: f"weighing {fit.candidate.description} with its remainder",
    ):
        _add_wide_fit(wide_fits, search, wide_problem, search.fit_to_convergence(fit))
    # fit the subsets of the best set
    leading_names = set(max(wide_fits.values(), key=search.score).candidate.identifiers)
    for fit in list(search.compared_fits().values()):
        names = set(fit.candidate.identifiers)
        if names and names < leading_names and fit.candidate.key not in wide_fits:
            _add_wide_fit(wide_fits, search, wide_problem, search.fit_to_convergence(fit))
    return wide_fits


def _add_wide_fit(
    wide_fits: dict[CandidateKey, CandidateFit],
    search: Search,
    wide_problem: Problem,
    fit: CandidateFit,
) -> None:
    """Fit a hypothesis under the wider noise, and add this fit to `wide_fits`.

    A hypothesis that cannot be fitted under the wider noise is left out. The hypothesis without
    effects (without terms) is evaluated at the point of `fit` instead, without any step of the
    iteration, since all others are compared with it.
    """
    wide_fit = refit_under_wide_noise(search.problem, wide_problem, fit)
    if wide_fit is None and not fit.candidate.terms:
        wide_fit = refit_under_wide_noise(search.problem, wide_problem, fit, iterations=0)
    if wide_fit is not None:
        wide_fits[fit.candidate.key] = wide_fit


def _expected_score(search: Search, wide_problem: Problem, fit: CandidateFit) -> float:
    """Return the score that a fit should have under a wider noise, without fitting it again [nat].

    Only the misfit of its present residuals is computed for the wider noise; the other terms of the
    score are those under the recorded noise.
    """
    problem = search.problem
    scaled_residuals = []
    for data, wide_data, residual in zip(
        problem.trials, wide_problem.trials, fit.residuals, strict=True
    ):
        # residuals are in recorded noise deviations: convert them to deviations of the wider noise
        scaled_residuals.append(data.deviation / wide_data.deviation * residual)
    wide_sums = problem.squares_by_channel(scaled_residuals)
    return (
        search.score(fit) + problem.misfit(fit.squares_by_channel) - wide_problem.misfit(wide_sums)
    )
