"""What is left beside the noise: found as it is, and evidence under it that counts independent samples."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from numpy.typing import NDArray

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.search.honest_evidence import left_by, refitted, widened

FloatArray = NDArray[np.float64]


def covariance(time: FloatArray, size: float, tau: float, frequency: float) -> FloatArray:
    lag = np.abs(time[:, np.newaxis] - time)
    return np.asarray(size**2 * np.exp(-lag / tau) * np.cos(frequency * lag) + 1e-9 * np.eye(len(time)))


def coloured(size: float, tau: float, frequency: float, seed: int = 8):  # type: ignore[no-untyped-def]
    """Return what adds an exact draw of a remainder to the first channel of every trial, noise 0.02."""
    generator = np.random.default_rng(seed)

    def extra(rows: FloatArray) -> FloatArray:
        root = np.linalg.cholesky(covariance(0.01 * rows, size, tau, frequency))
        return np.asarray(0.02 * root @ generator.standard_normal(len(rows)))

    return extra


def none_of(problem: Problem):  # type: ignore[no-untyped-def]
    return fit(problem, Candidate(), problem.start(Candidate()))


@pytest.mark.parametrize("freedom", [inf, 400.0])
def test_white_noise_has_no_remainder(kit, freedom: float) -> None:  # type: ignore[no-untyped-def]
    """Forty campaigns of three channels: none has one, and fits stay as they were."""
    noise = NoiseRecord(0.02, freedom)
    wrong = 0
    for seed in range(40):
        problem = kit.closed_problem(seed=seed, kinds=("ringdown",), samples=150, noise=noise)
        found = none_of(problem)
        left = left_by(problem, found)
        wrong += left.acts
        if seed == 0:
            assert refitted(problem, widened(problem, left), found) is found
    assert wrong <= 1


def test_white_noise_beyond_its_record_forgets_at_once(kit) -> None:  # type: ignore[no-untyped-def]
    """Noise a fifth above its record: of some size, and no time over which it forgets."""
    generator = np.random.default_rng(4)
    problem = kit.closed_problem(
        seed=3, kinds=("ringdown",), samples=600,
        extra=lambda rows: 0.02 * np.sqrt(0.2) * generator.standard_normal(len(rows)),
    )  # fmt: skip
    left = left_by(problem, none_of(problem))
    first = problem.channel_names.index("y1")
    assert left.size[first] == pytest.approx(np.sqrt(0.2), rel=0.3)
    assert left.time[first] < 0.05
    assert np.all(left.factor >= 1.0)


@pytest.mark.parametrize(("size", "tau", "frequency"), [(3.0, 0.15, 0.0), (2.0, 1.5, 9.0)])
def test_size_time_and_frequency_are_found(kit, size: float, tau: float, frequency: float) -> None:  # type: ignore[no-untyped-def]
    extra = coloured(size, tau, frequency)
    problem = kit.closed_problem(seed=4, kinds=("ringdown",), samples=900, extra=extra)
    left = left_by(problem, none_of(problem))
    first = problem.channel_names.index("y1")
    assert left.size[first] == pytest.approx(size, rel=0.4)
    assert left.time[first] == pytest.approx(tau, rel=0.6)
    assert 2.0 * np.pi * left.frequency[first] == pytest.approx(frequency, abs=1.0)
    assert np.all(np.delete(left.size, first) == 0.0)
    assert not left.is_noise


def test_evidence_under_a_wider_noise_is_that_of_a_campaign_with_such_noise(kit) -> None:  # type: ignore[no-untyped-def]
    """Optimum, covariance and evidence are those of the same campaign whose records say so."""
    problem = kit.closed_problem(seed=4, kinds=("ringdown",), samples=300, extra=coloured(3.0, 0.15, 0.0))
    none = none_of(problem)
    left = left_by(problem, none)
    found = refitted(problem, widened(problem, left), none)
    channels = {
        name: replace(item, noise=NoiseRecord(0.02 * float(factor), inf))
        for (name, item), factor in zip(problem.campaign.channels.items(), left.factor, strict=True)
    }
    campaign = replace(problem.campaign, channels=channels)
    said = none_of(Problem(campaign, problem.model, replace(problem.setting, campaign=campaign)))
    np.testing.assert_allclose(found.point.shared, said.point.shared, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.covariance, said.covariance, rtol=1e-3, atol=1e-9)
    assert found.log_evidence == pytest.approx(said.log_evidence, abs=0.05)
    assert found.chi_square > 3.0 * said.chi_square  # told against the recorded noise


def test_evidence_counts_independent_samples(kit) -> None:  # type: ignore[no-untyped-def]
    """A drift of the same channel gains much by white noise from a slow remainder, and little beside it."""
    gains = []
    for seed in range(6):
        problem = kit.closed_problem(
            seed=seed, kinds=("ringdown",), samples=400, extra=coloured(4.0, 0.4, 0.0, seed),
            offset_deviation=0.0,
        )  # fmt: skip
        candidate = Candidate((Term(kit.drift_effect(channel="y1"), "y1"),))
        none, drift = none_of(problem), fit(problem, candidate, problem.start(candidate))
        wide = widened(problem, left_by(problem, drift))
        pair = [refitted(problem, wide, item).log_evidence for item in (none, drift)]
        gains.append((drift.log_evidence - none.log_evidence, pair[1] - pair[0]))
    white, honest = np.array(gains).T
    assert white.max() > 20.0
    assert honest.max() < 4.0


def test_colour_of_the_noise_is_told_from_a_remainder(kit) -> None:  # type: ignore[no-untyped-def]
    """The same process in the trials, in the noise record or not."""
    generator = np.random.default_rng(5)
    time = 0.01 * np.arange(200)
    root = np.linalg.cholesky((covariance(time, 1.5, 0.03, 0.0) + np.eye(200)) / (1.0 + 1.5**2))
    scale = 0.02 * np.sqrt(1.0 + 1.5**2)
    for of_noise in (True, False):
        white = generator.standard_normal(len(time))
        samples = scale * root @ white if of_noise else 0.02 * white
        record = NoiseRecord(float(samples.std()), 199.0, samples - samples.mean(), 0.01, "pre-trigger")
        problem = kit.closed_problem(seed=6, kinds=("ringdown",), samples=400, extra=coloured(1.5, 0.03, 0.0))
        channels = dict(problem.campaign.channels)
        channels["y1"] = replace(channels["y1"], noise=record)
        campaign = replace(problem.campaign, channels=channels)
        problem = Problem(campaign, problem.model, replace(problem.setting, campaign=campaign))
        left = left_by(problem, none_of(problem))
        first = problem.channel_names.index("y1")
        if of_noise:  # what the record's own autoregression took out is no remainder, nor is what it left
            assert left.size[first] == 0.0
        else:
            assert left.size[first] == pytest.approx(1.5, rel=0.5)
        assert left.is_noise is of_noise
