"""The remainder: filter against dense Gaussians, inference against the truth, evidence that is honest."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from numpy.typing import NDArray

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import is_noise_colour
from discrepancy.fits.problem import Problem
from discrepancy.fits.remainder import Remainder, filter_gains, innovations, kernels
from discrepancy.fits.remainder_inference import RemainderPrior, infer, with_remainder

FloatArray = NDArray[np.float64]


def covariance(time: FloatArray, size: float, tau: float, frequency: float) -> FloatArray:
    lag = np.abs(time[:, np.newaxis] - time)
    return np.asarray(size**2 * np.exp(-lag / tau) * np.cos(frequency * lag) + np.eye(len(time)))


@pytest.mark.parametrize("frequency", [0.0, 7.0])
@pytest.mark.parametrize("uneven", [False, True])
def test_the_filter_is_the_dense_gaussian(frequency: float, uneven: bool) -> None:
    """Any time stamps, samples left out: x' C^-1 x, x' C^-1 y and ln det C."""
    generator = np.random.default_rng(3)
    time = np.cumsum(generator.uniform(0.005, 0.2, 80)) if uneven else 0.05 * np.arange(80)
    used = generator.random(80) > 0.15
    used[0] = not uneven
    steps = np.diff(time, prepend=time[0])
    columns = np.where(used, generator.standard_normal((3, 80)), 0.0)
    dense = covariance(time[used], 2.5, 0.6, frequency)
    expected = columns[:, used] @ np.linalg.solve(dense, columns[:, used].T)
    gains, half = filter_gains(steps, used, 2.5, 0.6, frequency)
    white = kernels()[1](columns, gains, used)
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-10)
    assert half == pytest.approx(0.5 * np.linalg.slogdet(dense)[1], rel=1e-12)
    square, again = innovations(columns[0], steps, used, 2.5, 0.6, frequency)
    assert square == pytest.approx(expected[0, 0], rel=1e-10)
    assert again == pytest.approx(half, rel=1e-12)


def test_fit_and_evidence_are_those_of_the_dense_gaussian(kit) -> None:  # type: ignore[no-untyped-def]
    """With exact noise all is Gaussian: optimum, covariance and evidence by dense algebra."""
    problem = kit.closed_problem(seed=2, kinds=("ringdown",), samples=50, left_out={0: [(7, 0), (8, 0)]})
    channels = len(problem.channel_names)
    remainder = replace(Remainder.none(channels), size=np.full(channels, 1.7), time=np.full(channels, 0.08))
    candidate = Candidate()
    start = replace(problem.start(candidate), remainder=remainder)
    found = fit(problem, candidate, start)
    linear = kit.Linear(problem, candidate)
    y, a = linear.dense()
    blocks = []
    for data in problem.trials:
        dense = np.zeros((data.weight.size, data.weight.size))
        index = np.arange(data.weight.size).reshape(data.weight.shape)
        for column in range(data.weight.shape[1]):
            at = index[:, column]
            dense[np.ix_(at, at)] = covariance(data.trial.time, 1.7, 0.08, 0.0)
        used = (data.weight > 0.0).ravel()
        blocks.append(dense[np.ix_(used, used)])
    size = sum(len(block) for block in blocks)
    whole = np.zeros((size, size))
    at = 0
    for block in blocks:
        whole[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    precision = linear.precision + 1e-12
    matrix = a.T @ np.linalg.solve(whole, a) + np.diag(precision)
    x = np.linalg.solve(matrix, a.T @ np.linalg.solve(whole, y))
    rest = y - a @ x
    objective = 0.5 * rest @ np.linalg.solve(whole, rest) + 0.5 * x @ (precision * x)
    objective += 0.5 * np.linalg.slogdet(whole)[1]
    evidence = -objective - 0.5 * np.linalg.slogdet(matrix)[1]
    assert found.objective == pytest.approx(objective, abs=2e-2)
    assert found.log_evidence == pytest.approx(evidence, abs=2e-2)
    shared = problem.shared.size
    np.testing.assert_allclose(found.covariance, np.linalg.inv(matrix)[:shared, :shared], rtol=1e-3)


def coloured(size: float, tau: float, frequency: float, interval: float):  # type: ignore[no-untyped-def]
    """Return what adds an exact draw of a remainder to the first channel of every trial, noise 0.02."""
    generator = np.random.default_rng(8)

    def extra(rows: FloatArray) -> FloatArray:
        dense = covariance(interval * rows, size, tau, frequency) - np.eye(len(rows))
        root = np.linalg.cholesky(dense + 1e-9 * np.eye(len(rows)))
        return np.asarray(0.02 * root @ generator.standard_normal(len(rows)))

    return extra


@pytest.mark.parametrize("freedom", [inf, 400.0])
def test_white_noise_has_no_remainder(kit, freedom: float) -> None:  # type: ignore[no-untyped-def]
    """Forty campaigns of three channels: none has one, and fits stay as they were."""
    noise = NoiseRecord(0.02, freedom)
    wrong = 0
    for seed in range(40):
        problem = kit.closed_problem(seed=seed, kinds=("ringdown",), samples=150, noise=noise)
        found = fit(problem, Candidate(), problem.start(Candidate()))
        prior = RemainderPrior.of(problem, found)
        wrong += infer(problem, found, prior).remainder.acts
        if seed == 0:
            assert with_remainder(problem, found, prior) is found
    assert wrong <= 1


@pytest.mark.parametrize(("size", "tau", "frequency"), [(3.0, 0.15, 0.0), (2.0, 1.5, 9.0)])
def test_size_time_and_frequency_are_found(kit, size: float, tau: float, frequency: float) -> None:  # type: ignore[no-untyped-def]
    extra = coloured(size, tau, frequency, 0.01)
    problem = kit.closed_problem(seed=4, kinds=("ringdown",), samples=900, extra=extra)
    none = fit(problem, Candidate(), problem.start(Candidate()))
    found = with_remainder(problem, none, RemainderPrior.of(problem, none))
    assert found is not None
    assert found.point.remainder is not None
    sizes, times, frequencies = (
        getattr(found.point.remainder, name) for name in ("size", "time", "angular_frequency")
    )
    first = problem.channel_names.index("y1")
    assert sizes[first] == pytest.approx(size, rel=0.4)
    assert times[first] == pytest.approx(tau, rel=0.6)
    assert frequencies[first] == pytest.approx(frequency, abs=1.0)
    assert np.all(np.delete(sizes, first) == 0.0)
    # what is left is white, of the size of the noise
    assert found.sums[first] / problem.counts[first] == pytest.approx(1.0, abs=0.15)
    assert found.log_evidence > none.log_evidence + 100.0


def test_evidence_counts_independent_samples(kit) -> None:  # type: ignore[no-untyped-def]
    """A drift of the same channel gains much by white noise from a slow remainder, and little beside it."""
    gains = []
    for seed in range(6):
        generator = np.random.default_rng(seed)

        def extra(rows: FloatArray, generator: np.random.Generator = generator) -> FloatArray:
            root = np.linalg.cholesky(
                covariance(0.01 * rows, 4.0, 0.4, 0.0) - (1.0 - 1e-9) * np.eye(len(rows))
            )
            return np.asarray(0.02 * root @ generator.standard_normal(len(rows)))

        problem = kit.closed_problem(
            seed=seed, kinds=("ringdown",), samples=400, extra=extra, offset_deviation=0.0
        )
        candidate = Candidate((Term(kit.drift_effect(channel="y1"), "y1"),))
        none = fit(problem, Candidate(), problem.start(Candidate()))
        with_drift = fit(problem, candidate, problem.start(candidate))
        prior = RemainderPrior.of(problem, none)
        pair = [with_remainder(problem, item, prior) for item in (none, with_drift)]
        assert pair[0] is not None
        assert pair[1] is not None
        gains.append(
            (with_drift.log_evidence - none.log_evidence, pair[1].log_evidence - pair[0].log_evidence)
        )
    white, honest = np.array(gains).T
    assert white.max() > 20.0
    assert honest.max() < 4.0


def test_colour_of_the_noise_is_told_from_a_remainder(kit) -> None:  # type: ignore[no-untyped-def]
    """The same process in the trials, in the noise record or not."""
    generator = np.random.default_rng(5)
    time = 0.01 * np.arange(200)
    dense = covariance(time, 1.5, 0.03, 0.0) / (1.0 + 1.5**2)
    root = np.linalg.cholesky(dense)

    def extra(rows: FloatArray) -> FloatArray:
        dense = covariance(0.01 * rows, 1.5, 0.03, 0.0) - (1.0 - 1e-9) * np.eye(len(rows))
        colour = np.linalg.cholesky(dense)
        return np.asarray(0.02 * colour @ generator.standard_normal(len(rows)))

    scale = 0.02 * np.sqrt(1.0 + 1.5**2)
    for coloured in (True, False):
        white = generator.standard_normal(len(time))
        samples = scale * root @ white if coloured else 0.02 * white
        record = NoiseRecord(float(samples.std()), 199.0, samples - samples.mean(), 0.01, "pre-trigger")
        problem = kit.closed_problem(seed=6, kinds=("ringdown",), samples=400, extra=extra)
        channels = dict(problem.campaign.channels)
        channels["y1"] = replace(channels["y1"], noise=record)
        problem = Problem(
            replace(problem.campaign, channels=channels), problem.model,
            replace(problem.setting, campaign=replace(problem.campaign, channels=channels)),
        )  # fmt: skip
        none = fit(problem, Candidate(), problem.start(Candidate()))
        found = with_remainder(problem, none, RemainderPrior.of(problem, none))
        assert found is not None
        remainder = found.point.remainder
        first = problem.channel_names.index("y1")
        if coloured:  # what the record's own autoregression took out is no remainder, nor is what it left
            assert remainder is None or remainder.beyond_noise[first] == 0.0
        else:
            assert remainder is not None
            assert remainder.beyond_noise[first] == pytest.approx(1.5, rel=0.5)
        assert is_noise_colour(found) is coloured
