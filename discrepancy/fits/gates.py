"""Statistical tests that a fit must pass before its effects are named by a verdict.

The residuals are compared with the noise records, and the law of an effect with the same law of
free shape. A *name* is an effect of the catalogue that the verdict says is missing in the model.
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

ABSOLUTE_FIT_LEVEL = 1e-3
"""Level of the test of absolute fit: the probability that a true hypothesis fails it."""
GAIN = "gain_error"
"""Name of the parameter of an effect that is the relative error of a sensor or a load cell."""
LEAST_SHAPE_GAIN = 2.0
"""Gain of log evidence by a free shape above which a verdict names the family of the effect, and
not the effect [nat]."""


class NamedTest(NamedTuple):
    """A statistical test of a fit.

    Attributes
    ----------
    name : str
        What is tested.
    p_value : float
        Its p-value.
    failure : str
        The sentence of a verdict if the test fails.
    """

    name: str
    p_value: float
    failure: str


# ---------------------------------------------------------------- absolute fit


def check_absolute_fit(problem: Problem, fit: CandidateFit) -> Gate:
    """Test whether the residuals of a fit are white noise of the recorded level.

    The tests are those of `absolute_fit_tests`. The least of their p-values, multiplied by the
    number of tests (Bonferroni's correction, the first step of Holm 1979, Scand. J. Statist. 6,
    65-70), is compared with `ABSOLUTE_FIT_LEVEL`.

    Returns
    -------
    Gate
        The outcome. If no variance could be compared with a noise record, `passed` is None, or
        False if one of the other tests (priors, whiteness) fails.
    """
    tests = absolute_fit_tests(problem, fit)
    if not tests:
        reason = f"{_lacking_for_variance(problem)}: the fit cannot be judged."
        return _absolute_fit_gate(None, np.nan, reason)
    worst_test = min(tests, key=lambda test: test.p_value)
    corrected_p_value = min(worst_test.p_value * len(tests), 1.0)
    if corrected_p_value < ABSOLUTE_FIT_LEVEL:
        return _absolute_fit_gate(False, corrected_p_value, worst_test.failure)
    if not any(test.name.startswith("variance") for test in tests):
        reason = (
            f"{_lacking_for_variance(problem)}: only the priors and the whiteness of the residuals "
            "could be judged, and both agree with the fit."
        )
        return _absolute_fit_gate(None, corrected_p_value, reason)
    reason = "The residuals agree with the noise records."
    return _absolute_fit_gate(True, corrected_p_value, reason)


def _absolute_fit_gate(passed: bool | None, corrected_p_value: float, reason: str) -> Gate:
    """Return the outcome of the test of absolute fit, see `Gate`."""
    return Gate("absolute fit", passed, corrected_p_value, ABSOLUTE_FIT_LEVEL, reason)


def _lacking_for_variance(problem: Problem) -> str:
    """Return what a comparison of variances with the noise records lacks, to begin a sentence."""
    has_noise_record = bool(np.any(problem.record_freedom[problem.sample_counts > 0.0] > 0.0))
    return "Too few readings for the unknowns" if has_noise_record else "No noise record"


def absolute_fit_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return the p-values of all tests of absolute fit: variances, priors and whiteness.

    The residual variance of each channel is compared with its noise record by an F test, and those
    of all channels together by one more test. A channel without a noise record, or with less than
    one degree of freedom left, is not tested.
    """
    # correlated residuals count as fewer independent ones: all degrees of freedom are divided
    samples_per_independent = _recorded_colour_factor(problem, fit) ** 2
    residual_freedom = (problem.sample_counts - fit.absorbed_freedom) / samples_per_independent
    record_freedom = problem.record_freedom / samples_per_independent
    is_testable = (problem.record_freedom > 0.0) & (residual_freedom >= 1.0)
    testable_channels = np.flatnonzero(is_testable)
    tests = []
    for channel in testable_channels:
        # sum of squares / (samples - absorbed freedom): the division of `residual_freedom` by
        # samples_per_independent cancels here
        mean_square = (
            fit.squares_by_channel[channel]
            / residual_freedom[channel]
            / samples_per_independent[channel]
        )
        p_value = noise_tests.variance_p_value(
            mean_square, residual_freedom[channel], record_freedom[channel]
        )
        name = problem.channel_names[channel]
        failure = f"The residuals of {name} are larger than its noise record allows."
        tests.append(NamedTest(f"variance of {name}", p_value, failure))
    if len(testable_channels) > 1:
        p_value = noise_tests.pooled_variance_p_value(
            np.array([test.p_value for test in tests]),
            residual_freedom[testable_channels],
            record_freedom[testable_channels],
        )
        failure = "The residuals of all channels are larger than their noise records allow."
        tests.append(NamedTest("variance of all channels", p_value, failure))
    return [*tests, *prior_tests(problem, fit), *whiteness_tests(problem, fit)]


def _recorded_colour_factor(problem: Problem, fit: CandidateFit) -> FloatArray:
    """Return the noise factor of each channel, (channels,).

    It is `ResidualProcess.noise_factor` if the residuals are correlated in time as the noise record
    of the channel is, and 1 otherwise. Its square is the number of samples per independent sample.
    """
    process = fit.residual_process
    if process is None:
        return np.ones(len(problem.channel_names))
    return np.where(process.is_recorded_colour, process.noise_factor, 1.0)


def prior_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return the tests of whether the unknowns of a fit are consistent with their priors.

    A wrong model can fit the readings if calibrated parameters move far from their priors. A wrong
    law can fit them with extreme parameters, which make it another law: a joint that slips at zero
    force is a soft joint. The tests are:

    - One χ² test of all calibrated parameters together.
    - A test that fails (p = 0) if a calibrated parameter is at the end of its range.
    - One χ² test of all gains that have a prior, together.
    - A χ² test of each effect parameter. Magnitudes, free shapes and parameters with a uniform
      prior are left out, as they may have any value. Gain errors are tested although they are
      magnitudes: if a sensor seems to read twice as much, it is more often the structure that
      differs at its place.

    The χ² tests are conservative, since estimates scatter less than the prior.
    """
    # scaled unknowns are standard normal under their prior: their sum of squares is χ²
    layout = problem.shared
    parameter_deviations = fit.point.shared[: layout.parameter_count]
    has_proper_prior = layout.precision[layout.parameter_count :] > 0.0
    gain_deviations = fit.point.shared[layout.parameter_count :][has_proper_prior]
    tests = []
    if parameter_deviations.size:
        p_value = float(
            chi2.sf(parameter_deviations @ parameter_deviations, parameter_deviations.size)
        )
        failure = "The fit moves calibrated parameters far outside their priors."
        tests.append(NamedTest("calibrated parameters", p_value, failure))
        # beyond the end of its range a parameter would fit better: the point is no maximum, and
        # Laplace's approximation of the evidence is wrong
        low, high = layout.bounds
        is_at_end = (fit.point.shared <= low) | (fit.point.shared >= high)
        if is_at_end[: layout.parameter_count].any():
            failure = "The fit moves a calibrated parameter to the end of its range."
            tests.append(NamedTest("ranges of calibrated parameters", 0.0, failure))
    if gain_deviations.size:
        p_value = float(chi2.sf(gain_deviations @ gain_deviations, gain_deviations.size))
        failure = "The fit moves gains far outside their priors."
        tests.append(NamedTest("gains", p_value, failure))
    for term, values in fit.candidate.split_by_term(fit.effect):
        # the values of free shape parameters follow those of the effect, and are not tested
        for parameter, scaled_value in zip(term.effect.parameters, values.tolist(), strict=False):
            # the ends of a uniform prior are as probable as its middle
            is_uniform = parameter.prior.shape == "uniform"
            is_gain = parameter.name == GAIN
            if is_uniform or (parameter.magnitude and not is_gain):
                continue
            name = f"{parameter.name} of {term.effect.identifier}"
            failure = f"The fit moves the {name} far outside its prior"
            if is_gain:
                failure += f" ({100.0 * parameter.prior.value(scaled_value):+.3g} %)"
            tests.append(NamedTest(name, float(chi2.sf(scaled_value**2, 1)), f"{failure}."))
    return tests


def whiteness_tests(problem: Problem, fit: CandidateFit) -> list[NamedTest]:
    """Return for each channel the test of whether its residuals are white (Ljung-Box).

    The residuals of a channel in all dynamic trials are tested together. A channel is left out if
    its noise record is not white, or if its residuals are correlated in time as that record is.
    """
    tests = []
    # `_recorded_colour_factor` is 1 unless residuals have the correlation of the noise record
    may_be_white = _recorded_colour_factor(problem, fit) == 1.0
    for channel in np.flatnonzero(may_be_white).tolist():
        if not problem.is_whiteness_tested[channel]:
            continue
        records = residual_records(problem, fit, channel)
        if records:
            name = problem.channel_names[channel]
            failure = f"The residuals of {name} are not white noise."
            tests.append(NamedTest(f"whiteness of {name}", whiteness_p_value(records), failure))
    return tests


# ---------------------------------------------------------------- residuals of a channel


class ResidualRecord(NamedTuple):
    """The residuals of one channel in one trial in motion.

    Attributes
    ----------
    values : (N,) array
        The standardised residuals.
    is_used : (N,) array of bool
        Whether a sample is compared with the model.
    steps : (N - 1,) or (1,) array
        The time steps between the samples [s]; only their median, (1,), if the standardised noise
        is white.
    """

    values: FloatArray
    is_used: BoolArray
    steps: FloatArray


def residual_records(problem: Problem, fit: CandidateFit, channel: int) -> list[ResidualRecord]:
    """Return the standardised residuals of one channel, one record for each trial in motion.

    Trials with fewer samples than `noise_tests.SHORTEST_SERIES` are left out.

    Parameters
    ----------
    channel : int
        The index of the channel among those of the campaign.
    """
    records = []
    for data, residual in zip(problem.trials, fit.residuals, strict=True):
        if not data.trial.is_dynamic or len(residual) < noise_tests.SHORTEST_SERIES:
            continue
        for column in np.flatnonzero(data.channel_indices == channel):
            steps = np.diff(data.trial.time)
            if not data.noise_models[column].stays_coloured(data.trial):
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
    return noise_tests.combine_p_values(p_values)


# ---------------------------------------------------------------- shape and time steps


def check_shape(canonical_fit: CandidateFit, free_fit: CandidateFit | None) -> Gate:
    """Test whether an effect explains as much as the same effect with a free shape.

    The test passes if the free shape gains at most `LEAST_SHAPE_GAIN`, or if there is no fit with a
    free shape (None).
    """
    if free_fit is None:
        reason = "The effect has no shape that could be free."
        return Gate("shape", True, 0.0, LEAST_SHAPE_GAIN, reason)
    gain = free_fit.log_evidence - canonical_fit.log_evidence
    passed = gain <= LEAST_SHAPE_GAIN
    if passed:
        reason = "A free shape explains no more than the named one."
    else:
        reason = f"Its family with a free shape gains {gain:.1f} nats over the name."
    return Gate("shape", passed, gain, LEAST_SHAPE_GAIN, reason)


def time_step_error(problem: Problem, fit: CandidateFit) -> float:
    """Return the error of the time integration in a fit, in standard deviations of the noise.

    Every trial in motion is simulated again with time steps of half the length. The rms change of
    each channel is divided by the standard deviation of its noise. The largest of these ratios is
    returned; it is 0 without trials in motion.

    Parameters
    ----------
    fit : CandidateFit
        The fit, with the responses that were simulated with the usual time steps.
    """
    largest_error = 0.0
    for trial_index, data in enumerate(problem.trials):
        if not data.trial.is_dynamic:
            continue
        # refinement=2 makes two time steps of each
        finer_response = problem.response_of_candidate(
            trial_index, fit.point, fit.candidate, refinement=2
        )
        standardised_change = (finer_response - fit.responses[trial_index]) / data.deviation
        rms_changes = np.sqrt((standardised_change**2).mean(axis=0))
        largest_error = max(largest_error, float(rms_changes.max()))
    return largest_error
