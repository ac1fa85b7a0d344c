"""Evidence under a noise as wide as what the best hypothesis leaves.

The search itself goes by the noise as recorded: how far a fit is from the truth shows best there.
Where no hypothesis leaves noise, thousands of nats separate what a model of a real structure cannot
separate.

No model of a real structure leaves white noise (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63,
425-464). Where none does, hypotheses are compared under a noise that is as wide as what the best of
them leaves, and that counts as many samples as are independent: the sum of squares of N samples of
autocorrelation rho_k is as certain as that of N / (1 + 2 sum rho_k^2) independent ones (Bartlett
1946, Suppl. J. R. Stat. Soc. 8, 27-41). Trials at rest have no such correlation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import CandidateKey, ResidualProcess
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.gates import ResidualRecord, residual_records, whiteness_p_value
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .starts import with_progress
from .strategy import Search

LEVEL = 1e-3
"""p-value below which residuals are more than noise, or not white."""
NEAR = 0.25
"""Relative difference of sampling intervals up to which a noise record is compared with
residuals."""
SWINGS = -0.25
"""Autocorrelation at its first minimum below which a process swings."""
LIKE_RECORD = 3.0
"""Deviations within which the correlation of residuals is that of the noise record."""
LEAST_WHITE = 1e-12
"""Least share of the residuals' mean square that is taken for noise where no noise is recorded."""
SECOND_DIFFERENCES = 6.0
"""Variance of the second differences of white noise over its own."""


# ---------------------------------------------------------------- what a fit leaves


@dataclass
class _ChannelProcess:
    """The residual process of one channel, with the meaning of `ResidualProcess`.

    At first white noise.
    """

    amplitude: float = 0.0
    noise_factor: float = 1.0
    correlation_time: float = 0.0
    frequency: float = 0.0
    is_recorded_colour: bool = False


def residual_process_of(problem: Problem, fit: CandidateFit) -> ResidualProcess:
    """Return the random process that describes what a fit leaves beside the recorded noise.

    Parameters
    ----------
    problem : Problem
        The campaign and model under the recorded noise.
    fit : CandidateFit
        The fit.
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
    """Return the residual process of a channel.

    Parameters
    ----------
    problem : Problem
        The campaign and model under the recorded noise.
    fit : CandidateFit
        The fit.
    channel : int
        The index of the channel.
    noise_level : float
        The variance of the noise, relative to s0^2.
    """
    process = _ChannelProcess()
    records = residual_records(problem, fit, channel)
    if not records:
        return process
    series = [record.values for record in records]
    sample_count = sum(float(record.is_used.sum()) for record in records)
    # size of the residuals against the noise record
    freedom = max(sample_count - fit.spent[channel], 1.0)
    noise_freedom = problem.freedom[channel]
    has_record = noise_freedom > 0.0
    variance = _sum_of_squares(series) / freedom
    interval = max(float(np.median(record.steps)) for record in records)
    colour = _recorded_colour(problem, problem.channel_names[channel], records, interval)
    is_larger = False
    if has_record:
        p_value = noise_tests.variance_p_value(
            variance, freedom / colour.times_fewer, noise_freedom / colour.times_fewer
        )
        is_larger = p_value < LEVEL
    if not is_larger and whiteness_p_value(records) > LEVEL:
        return process
    # factor on the noise, by the number of independent samples
    rho, chance = noise_tests.autocorrelation(series)
    uncertainty = np.sqrt(1.0 / sample_count + colour.variance)
    has_record_colour = abs(rho[0] - colour.correlation) < LIKE_RECORD * uncertainty
    process.is_recorded_colour = bool(not is_larger and has_record_colour)
    if process.is_recorded_colour:
        wide_variance = 1.0
    elif has_record:
        wide_variance = max(variance, 1.0)
    else:
        wide_variance = variance
    process.noise_factor = np.sqrt(wide_variance * noise_tests.times_fewer(rho, chance))
    # the process beside the noise
    variance_beside_noise = variance / noise_level - 1.0
    if process.is_recorded_colour or variance_beside_noise <= 0.0:
        return process
    ratio = (1.0 + variance_beside_noise) / variance_beside_noise
    process.amplitude = np.sqrt(variance_beside_noise)
    process.correlation_time = interval * noise_tests.times_fewer(rho, chance, ratio)
    process_rho = rho * ratio
    first_minimum = int(np.argmax(np.diff(process_rho) > 0.0))
    if process_rho[first_minimum] < SWINGS:
        process.frequency = 0.5 / ((first_minimum + 1) * interval)
        process.correlation_time *= 2.0  # the mean of a squared cosine is a half
    return process


def _sum_of_squares(series: Sequence[FloatArray]) -> float:
    """Return the sum of squares of several series (N,)."""
    return sum(float(values @ values) for values in series)


def unrecorded_noise_levels(problem: Problem, fit: CandidateFit) -> FloatArray:
    """Return the noise variance (channels,) relative to s0^2: 1 where a noise record is there.

    Without a record it is estimated from the second differences of the residuals. Those of white
    noise have six times its variance, and hardly any of what is slow.
    """
    levels = np.ones(len(problem.channel_names))
    for channel in np.flatnonzero(problem.freedom == 0.0):
        records = residual_records(problem, fit, int(channel))
        series = [record.values for record in records]
        differences = [np.diff(values, 2) for values in series]
        mean_square = _sum_of_squares(series) / max(sum(len(values) for values in series), 1)
        difference_count = max(sum(len(values) for values in differences), 1)
        white = _sum_of_squares(differences) / SECOND_DIFFERENCES / difference_count
        if mean_square > 0.0:
            levels[channel] = min(max(white, LEAST_WHITE * mean_square), mean_square)
        else:  # the channel is in trials at rest only
            levels[channel] = 1.0 / problem.precisions(fit.sums)[channel]
    return levels


class _RecordedColour(NamedTuple):
    """The colour that the noise of a channel has in its residuals, as its record says.

    Attributes
    ----------
    correlation : float
        The correlation of neighbouring samples; nan if it is not known.
    variance : float
        The variance of this estimate.
    times_fewer : float
        By how many times the independent samples are fewer than the samples.
    """

    correlation: float
    variance: float
    times_fewer: float


def _recorded_colour(
    problem: Problem, name: str, records: Sequence[ResidualRecord], interval: float
) -> _RecordedColour:
    """Return the colour that noise as in a channel's record has in the residuals.

    Where the noise is whitened, that is what the whitening filter leaves of the record.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    name : str
        The name of the channel.
    records : sequence of ResidualRecord
        The residuals of the channel.
    interval : float
        Their sampling interval [s].
    """
    unknown = _RecordedColour(np.nan, 0.0, 1.0)
    record = problem.campaign.channels[name].noise
    noise = problem.noise[name]
    if record is None or record.samples is None or record.interval is None:
        return unknown
    if not np.any(record.samples):
        return unknown
    centred = record.samples - record.samples.mean()
    if abs(record.interval - interval) > NEAR * interval:
        return unknown
    colours = []
    for residuals in records:
        is_white = len(residuals.steps) == 1
        values = noise.whiten(centred, record.interval) if is_white else centred
        rho, chance = noise_tests.autocorrelation([values])
        if is_white:
            correlation = float(rho[0])
            times_fewer = 1.0
        else:
            # correlation of the record at the steps of the residuals
            lags = np.arange(1 + len(rho))
            at_steps = np.interp(residuals.steps / record.interval, lags, np.r_[1.0, rho])
            correlation = float(np.mean(at_steps))
            times_fewer = noise_tests.times_fewer(rho, chance)
        colours.append(_RecordedColour(correlation, 1.0 / len(centred), times_fewer))
    return _RecordedColour(*np.mean(colours, axis=0).tolist())


# ---------------------------------------------------------------- fits under the wider noise


def with_wide_noise(problem: Problem, process: ResidualProcess) -> Problem:
    """Return the problem under the noise that a residual process makes.

    The same one if it is white.
    """
    return problem.widened(process.noise_factor) if process.is_present else problem


def refit_under_wide_noise(
    problem: Problem, wide_problem: Problem, fit: CandidateFit, *, iterations: int = 60
) -> CandidateFit | None:
    """Return a hypothesis at its maximum under a wider noise.

    Evidence and covariance are those under the wider noise. Everything else is stated against the
    recorded noise, with the residual process that the hypothesis leaves.

    Parameters
    ----------
    problem : Problem
        The problem under the recorded noise.
    wide_problem : Problem
        The problem under the wider noise.
    fit : CandidateFit
        The fit of the hypothesis.
    iterations : int
        The largest number of steps.

    Returns
    -------
    CandidateFit or None
        None if the hypothesis cannot be fitted so: evidence under two noises is not compared.
    """
    if wide_problem is problem:
        return fit
    wide_fit = attempt(wide_problem, fit.candidate, fit.point, iterations=iterations)
    if wide_fit is None:
        return None
    recorded_fit = attempt(problem, fit.candidate, wide_fit.point, iterations=0)
    if recorded_fit is None:
        return None
    process = residual_process_of(problem, recorded_fit)
    return replace(
        recorded_fit,
        log_evidence=wide_fit.log_evidence,
        covariance=wide_fit.covariance,
        converged=wide_fit.converged,
        residual_process=process if process.is_present else None,
    )


# ---------------------------------------------------------------- hypotheses compared under it

ROUNDS = 3
"""Number of times that another hypothesis may turn out to be the best one."""


def compare_under_wide_noise(search: Search) -> None:
    """Fit the hypotheses that matter under the noise that the best of them leaves.

    Compare these from now on.

    The fit without effect is always one of them. Which others matter is decided by their residuals
    as they are, before anything is fitted again. The search's `wide_problem` and `wide_fits` are
    set.
    """
    best = search.best()
    chosen = _most_probable_sets(search)
    for _ in range(ROUNDS):
        process = residual_process_of(search.problem, best)
        search.wide_problem = with_wide_noise(search.problem, process)
        search.wide_fits = {}
        wide_fits = _fits_under(search, search.wide_problem, chosen)
        leading = max(wide_fits.values(), key=search.score)
        if leading.candidate.key == best.candidate.key:
            break
        best = leading
    search.wide_fits = wide_fits


def _most_probable_sets(search: Search) -> list[CandidateFit]:
    """Return the best fit of each set of effects, for the most probable sets of each length."""
    best: dict[tuple[str, ...], CandidateFit] = {}
    for fit in search.compared_fits().values():
        names = fit.candidate.identifiers
        if names and (names not in best or search.score(fit) > search.score(best[names])):
            best[names] = fit
    chosen: list[CandidateFit] = []
    for length, count in enumerate(SEARCH.weighed_sets, start=1):
        of_length = [fit for fit in best.values() if len(fit.candidate.terms) == length]
        chosen += sorted(of_length, key=lambda fit: -search.score(fit))[:count]
    return chosen


def _fits_under(
    search: Search, wide_problem: Problem, chosen: Sequence[CandidateFit]
) -> dict[CandidateKey, CandidateFit]:
    """Return the most promising hypotheses fitted under a wider noise.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.
    wide_problem : Problem
        The problem under the wider noise.
    chosen : sequence of CandidateFit
        The fits to choose from.
    """
    expected = [(fit, _expected_score(search, wide_problem, fit)) for fit in chosen]
    expected.sort(key=lambda entry: entry[1], reverse=True)
    least = expected[0][1] - SEARCH.weighed_within if expected else 0.0
    promising = [fit for fit, score in expected[: SEARCH.weighed_fits] if score > least]
    wide_fits: dict[CandidateKey, CandidateFit] = {}
    _add_wide_fit(wide_fits, search, wide_problem, search.no_effect)
    for fit in with_progress(
        search.on_progress,
        promising,
        lambda fit: f"weighing {fit.candidate.description} with its remainder",
    ):
        _add_wide_fit(wide_fits, search, wide_problem, search.fit_exactly(fit))
    # the subsets of the leading set: each of its effects has to earn its place
    leading_names = set(max(wide_fits.values(), key=search.score).candidate.identifiers)
    for fit in list(search.compared_fits().values()):
        names = set(fit.candidate.identifiers)
        if names and names < leading_names and fit.candidate.key not in wide_fits:
            _add_wide_fit(wide_fits, search, wide_problem, search.fit_exactly(fit))
    return wide_fits


def _add_wide_fit(
    wide_fits: dict[CandidateKey, CandidateFit],
    search: Search,
    wide_problem: Problem,
    fit: CandidateFit,
) -> None:
    """Add a hypothesis under a wider noise, if it can be fitted so.

    The model without effect is added as it stands if it cannot.
    """
    wide_fit = refit_under_wide_noise(search.problem, wide_problem, fit)
    if wide_fit is None and not fit.candidate.terms:
        wide_fit = refit_under_wide_noise(search.problem, wide_problem, fit, iterations=0)
    if wide_fit is not None:
        wide_fits[fit.candidate.key] = wide_fit


def _expected_score(search: Search, wide_problem: Problem, fit: CandidateFit) -> float:
    """Return the score of a fit under a wider noise if nothing of it changes [nat]."""
    problem = search.problem
    scaled_residuals = []
    for data, wide_data, residual in zip(
        problem.trials, wide_problem.trials, fit.residuals, strict=True
    ):
        scaled_residuals.append(data.deviation / wide_data.deviation * residual)
    wide_sums = problem.sums_by_channel(scaled_residuals)
    return search.score(fit) + problem.misfit(fit.sums) - wide_problem.misfit(wide_sums)
