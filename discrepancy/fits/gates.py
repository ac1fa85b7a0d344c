"""Tests that a name must pass.

The fit against the noise records, and its shape against a free one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.verdict import Gate

from .fitting import CandidateFit
from .problem import Problem

ABSOLUTE_LEVEL = 1e-3
"""Level of the test of absolute fit: a true name fails it this often."""
SHAPE_GAIN = 2.0
"""Log evidence that a free shape may gain before the name gives way to its family [nat]."""


class NamedTest(NamedTuple):
    """The name of a statistical test, as a verdict prints it, and its p-value."""

    name: str
    p_value: float


# ---------------------------------------------------------------- absolute fit


def check_absolute_fit(problem: Problem, fit: CandidateFit) -> Gate:
    """Test whether the residuals of a fit are white noise of the recorded level.

    The tests are those of `absolute_fit_tests`. The least of their p-values is compared with
    `ABSOLUTE_LEVEL` over their number (Holm 1979, Scand. J. Statist. 6, 65-70).

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit to test.

    Returns
    -------
    Gate
        The outcome. `passed` is None where no channel has a noise record and more readings than
        unknowns; whiteness is tested all the same and can fail.
    """
    tests = absolute_fit_tests(problem, fit)
    has_variance_test = any(test.name.startswith("variance") for test in tests)
    has_noise_record = bool(np.any(problem.freedom[problem.counts > 0.0] > 0.0))
    cause = "Too few readings for the unknowns" if has_noise_record else "No noise record"
    worst = min(tests, key=lambda test: test.p_value, default=NamedTest("", np.nan))
    statistic = min(worst.p_value * len(tests), 1.0)
    passed = True if has_variance_test else None
    reason = "What is left agrees with the noise records."
    if not tests:
        reason = f"{cause}: the fit cannot be judged."
    elif statistic < ABSOLUTE_LEVEL:
        passed = False
        reason = f"More is left than noise and priors allow: {worst.name}."
    elif not has_variance_test:
        reason = (
            f"{cause}: only priors and the whiteness of what is left could be judged, and they "
            "agree."
        )
    return Gate("absolute fit", passed, statistic, ABSOLUTE_LEVEL, reason)


def absolute_fit_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return the tests of absolute fit: variances, priors and whiteness.

    The variance of each channel is compared with its noise record by an F test, and all channels
    together by one test.
    """
    # dependent samples of the recorded colour count as fewer independent ones
    samples_per_independent = _recorded_colour_factor(problem, fit) ** 2
    freedom = (problem.counts - fit.spent) / samples_per_independent
    noise_freedom = problem.freedom / samples_per_independent
    is_testable = (problem.freedom > 0.0) & (freedom >= 1.0)
    channels = np.flatnonzero(is_testable)
    tests = []
    for number in channels:
        mean_square = fit.sums[number] / freedom[number] / samples_per_independent[number]
        p_value = noise_tests.variance_p_value(mean_square, freedom[number], noise_freedom[number])
        tests.append(NamedTest(f"variance of {problem.channel_names[number]}", p_value))
    if len(channels) > 1:
        p_value = noise_tests.pooled_variance_p_value(
            np.array([test.p_value for test in tests]), freedom[channels], noise_freedom[channels]
        )
        tests.append(NamedTest("variance of all channels", p_value))
    return [*tests, *prior_tests(problem, fit), *whiteness_tests(problem, fit)]


def _recorded_colour_factor(problem: Problem, fit: CandidateFit) -> FloatArray:
    """Return the noise factor of each channel whose residuals have the recorded colour, else 1.

    See `ResidualProcess.noise_factor`.
    """
    process = fit.residual_process
    if process is None:
        return np.ones(len(problem.channel_names))
    return np.where(process.is_recorded_colour, process.noise_factor, 1.0)


def prior_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return the tests that the unknowns of a fit stayed within their priors.

    A wrong model can fit by leaving the calibrated values, and a law by turning into another one: a
    joint that slips at zero force is a soft joint. The magnitude of an effect is not tested, as it
    may have any value. The tests are conservative: estimates scatter less than the prior.
    """
    shared = problem.shared
    parameters = fit.point.shared[: shared.count]
    has_proper_prior = shared.precision[shared.count :] > 0.0
    gains = fit.point.shared[shared.count :][has_proper_prior]
    tests = []
    if parameters.size:
        p_value = float(chi2.sf(parameters @ parameters, parameters.size))
        tests.append(NamedTest("calibrated parameters beside their priors", p_value))
    if gains.size:
        p_value = float(chi2.sf(gains @ gains, gains.size))
        tests.append(NamedTest("gains beside their priors", p_value))
    for term, values in fit.candidate.split(fit.effect):
        for parameter, u in zip(term.effect.parameters, values.tolist(), strict=False):
            is_uniform = parameter.prior.shape == "uniform"  # its ends are as likely as its middle
            if parameter.magnitude or is_uniform:
                continue
            name = f"{parameter.name} of {term.effect.identifier} beside its prior"
            tests.append(NamedTest(name, float(chi2.sf(u**2, 1))))
    return tests


def whiteness_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return the Ljung-Box test of each channel, over all its records in motion.

    Channels whose noise record is not white itself are left out, as in locating.
    """
    tests = []
    is_white_noise = _recorded_colour_factor(problem, fit) == 1.0
    for channel in np.flatnonzero(is_white_noise).tolist():
        if not problem.tests_whiteness[channel]:
            continue
        records = residual_records(problem, fit, channel)
        if records:
            name = f"whiteness of {problem.channel_names[channel]}"
            tests.append(NamedTest(name, whiteness_p_value(records)))
    return tests


# ---------------------------------------------------------------- residuals of a channel


class ResidualRecord(NamedTuple):
    """The residuals of one channel in one trial in motion.

    Attributes
    ----------
    values : (N,) array
        The standardised residuals.
    is_used : (N,) array of bool
        Whether a sample counts.
    steps : (N - 1,) or (1,) array
        The steps in time between the samples [s]; only their median where the noise is white, as
        they do not matter then.
    """

    values: FloatArray
    is_used: BoolArray
    steps: FloatArray


def residual_records(problem: Problem, fit: CandidateFit, channel: int) -> list[ResidualRecord]:
    """Return the residuals of a channel in each trial in motion that is long enough for tests.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit.
    channel : int
        The index of the channel among those of the campaign.
    """
    records = []
    for data, residual in zip(problem.trials, fit.residuals, strict=True):
        if not data.trial.is_dynamic or len(residual) < noise_tests.SHORTEST_SERIES:
            continue
        for column in np.flatnonzero(data.groups == channel):
            steps = np.diff(data.trial.time)
            if not data.noise[column].stays_coloured(data.trial):
                steps = np.median(steps, keepdims=True)
            record = ResidualRecord(
                values=np.ascontiguousarray(residual[:, column]),
                is_used=data.weight[:, column] > 0.0,
                steps=steps,
            )
            records.append(record)
    return records


def whiteness_p_value(records: Sequence[ResidualRecord]) -> float:
    """Return the p-value of the Ljung-Box test of several records together."""
    p_values = []
    for record in records:
        _, p_value = noise_tests.ljung_box(record.values, record.is_used)
        p_values.append(p_value)
    return noise_tests.combine(p_values)


# ---------------------------------------------------------------- shape and time steps


def check_shape(named_fit: CandidateFit, family_fit: CandidateFit | None) -> Gate:
    """Test whether an effect with a free shape explains more than the effect itself.

    Parameters
    ----------
    named_fit : CandidateFit
        The fit with the canonical shape.
    family_fit : CandidateFit or None
        The fit with the free shape; None where the effect has no shape parameters.
    """
    if family_fit is None:
        reason = "The effect has no shape that could be free."
        return Gate("shape", True, 0.0, SHAPE_GAIN, reason)
    gain = family_fit.log_evidence - named_fit.log_evidence
    passed = gain <= SHAPE_GAIN
    if passed:
        reason = "A free shape explains no more than the named one."
    else:
        reason = f"Its family with a free shape gains {gain:.1f} nats over the name."
    return Gate("shape", passed, gain, SHAPE_GAIN, reason)


def time_step_error(problem: Problem, fit: CandidateFit) -> float:
    """Return the error that the time steps cause in a fit, relative to the noise.

    It is the largest rms change of a channel in a trial when the steps are halved, over the noise
    deviation of the channel.
    """
    largest = 0.0
    for number, data in enumerate(problem.trials):
        if not data.trial.is_dynamic:
            continue
        finer = problem.response_with(number, fit.point, fit.candidate, finer=2)
        change = (finer - fit.responses[number]) / data.deviation
        rms = np.sqrt((change**2).mean(axis=0))
        largest = max(largest, float(rms.max()))
    return largest
