"""Gates that a name must pass: absolute fit against the noise record, shape against its family."""

import numpy as np
from scipy.stats import chi2

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.verdict import Gate

from .fitting import CandidateFit
from .problem import Problem

ABSOLUTE_LEVEL = 1e-3
"""Level of the absolute gate; a true name fails it this often."""
SHAPE_GAIN = 2.0
"""Log evidence that the free-shape family may gain before the name gives way to it [nat]."""


def absolute_gate(problem: Problem, fit: CandidateFit) -> Gate:
    """Judge whether what is left is what the noise records say, and white.

    Tests, by Holm together at `ABSOLUTE_LEVEL`: the sum over all channels, F of each channel against its
    record, Ljung-Box of each channel over its dynamic records.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        What is judged.

    Returns
    -------
    Gate
        `passed` is None where no channel has a noise record and more readings than unknowns; whiteness is
        judged all the same and can fail.
    """
    tests = absolute_tests(problem, fit)
    known = any(name.startswith("variance") for name, _ in tests)
    recorded = bool(np.any(problem.freedom[problem.counts > 0.0] > 0.0))
    why = "Too few readings for the unknowns" if recorded else "No noise record"
    name, least = min(tests, key=lambda test: test[1], default=("", np.nan))
    statistic, passed = min(least * len(tests), 1.0), True if known else None
    reason = "What is left agrees with the noise records."
    if not tests:
        reason = f"{why}: the fit cannot be judged."
    elif statistic < ABSOLUTE_LEVEL:
        passed, reason = False, f"More is left than noise and priors allow: {name}."
    elif not known:
        reason = f"{why}: only priors and the whiteness of what is left could be judged, and they agree."
    return Gate("absolute fit", passed, statistic, ABSOLUTE_LEVEL, reason)


def absolute_tests(problem: Problem, fit: CandidateFit) -> list[tuple[str, float]]:
    """Return name and p-value of each test of the absolute gate."""
    tests: list[tuple[str, float]] = []
    samples = _dependent(problem, fit) ** 2
    freedom, recorded = (problem.counts - fit.spent) / samples, problem.freedom / samples
    known = np.flatnonzero((problem.freedom > 0.0) & (freedom >= 1.0))
    p_values = []
    for number in known:
        square = fit.sums[number] / freedom[number] / samples[number]
        p_values.append(noise_tests.variance_p_value(square, freedom[number], recorded[number]))
        tests.append((f"variance of {problem.channel_names[number]}", p_values[-1]))
    if len(known) > 1:
        together = noise_tests.pooled_variance_p_value(np.array(p_values), freedom[known], recorded[known])
        tests.append(("variance of all channels", together))
    return [*tests, *prior_tests(problem, fit), *whiteness_tests(problem, fit)]


def _dependent(problem: Problem, fit: CandidateFit) -> FloatArray:
    """Return by how much (channels,) noise of a colour that its record admits is wider than white noise."""
    left = fit.remainder
    return np.ones(len(problem.channel_names)) if left is None else np.where(left.of_noise, left.factor, 1.0)


def prior_tests(problem: Problem, fit: CandidateFit) -> list[tuple[str, float]]:
    """Return name and p-value of the tests that unknowns stayed within their priors.

    A wrong model can fit by leaving what was calibrated, and a law by becoming another one: a joint that
    slips at nothing is a soft one. An effect's size may be what it will. Conservative: estimates scatter less
    than the prior.
    """
    count = problem.shared.count
    proper = problem.shared.precision[count:] > 0.0
    groups = {
        "calibrated parameters beside their priors": fit.point.shared[:count],
        "gains beside their priors": fit.point.shared[count:][proper],
    }
    tests = [(name, float(chi2.sf(u @ u, u.size))) for name, u in groups.items() if u.size]
    for term, part in fit.candidate.parts(fit.effect):
        tests += [
            (f"{item.name} of {term.effect.identifier} beside its prior", float(chi2.sf(u**2, 1)))
            for item, u in zip(term.effect.parameters, part.tolist(), strict=False)
            if not item.magnitude and item.prior.shape != "uniform"  # whose ends are no less likely
        ]
    return tests


def whiteness_tests(problem: Problem, fit: CandidateFit) -> list[tuple[str, float]]:
    """Return name and p-value of the Ljung-Box test of each channel, its dynamic records combined.

    Channels whose noise record is not white itself are left out, as in locating.
    """
    tests = []
    for channel in np.flatnonzero(_dependent(problem, fit) == 1.0).tolist():
        if not problem.tests_whiteness[channel]:
            continue
        series, used, _ = records_of(problem, fit, channel)
        if series:
            tests.append((f"whiteness of {problem.channel_names[channel]}", whiteness(series, used)))
    return tests


def whiteness(series: list[FloatArray], used: list[BoolArray]) -> float:
    """Return the p-value of the Ljung-Box test of records together, of which some samples count."""
    return noise_tests.combine([p_value for _, p_value in map(noise_tests.ljung_box, series, used)])


def records_of(
    problem: Problem, fit: CandidateFit, channel: int
) -> tuple[list[FloatArray], list[BoolArray], list[FloatArray]]:
    """Return the residuals of a channel in motion, which samples of them count, and steps in time [s].

    Of records whose noise is white they are one.
    """
    series, used, steps = [], [], []
    for data, residual in zip(problem.trials, fit.residuals, strict=True):
        for column in np.flatnonzero(data.groups == channel) if data.trial.is_dynamic else ():
            if len(residual) >= noise_tests.SHORTEST_SERIES:
                series.append(np.ascontiguousarray(residual[:, column]))
                used.append(data.weight[:, column] > 0.0)
                taken, coloured = np.diff(data.trial.time), data.noise[column].stays_coloured(data.trial)
                steps.append(taken if coloured else np.median(taken, keepdims=True))
    return series, used, steps


def shape_gate(named: CandidateFit, family: CandidateFit | None) -> Gate:
    """Judge whether the free-shape family explains more than the named effect.

    Parameters
    ----------
    named, family : CandidateFit
        With canonical and with free shape; None where the effect has no shape to free.
    """
    if family is None:
        return Gate("shape", True, 0.0, SHAPE_GAIN, "The effect has no shape that could be free.")
    gain = family.log_evidence - named.log_evidence
    passed, reason = gain <= SHAPE_GAIN, "A free shape explains no more than the named one."
    if not passed:
        reason = f"Its family with a free shape gains {gain:.1f} nats over the name."
    return Gate("shape", passed, gain, SHAPE_GAIN, reason)


def solver_share(problem: Problem, fit: CandidateFit) -> float:
    """Return the largest rms change of a channel when the time steps are halved, over its noise."""
    largest = 0.0
    for number, data in enumerate(problem.trials):
        if not data.trial.is_dynamic:
            continue
        finer = problem.answer(number, fit.point, fit.candidate, finer=2)
        change = (finer - fit.responses[number]) / data.deviation
        largest = max(largest, float(np.sqrt((change**2).mean(axis=0)).max()))
    return largest
