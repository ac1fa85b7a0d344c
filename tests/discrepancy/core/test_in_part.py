"""Verdicts where what is left is no white noise: simulated campaigns of the chain, all the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from discrepancy.campaign.records import NoiseRecord
from discrepancy.judgement.in_part import explained_share
from discrepancy.judgement.naming import name
from discrepancy.missing_force.shares import OF_READINGS, Share
from discrepancy.verdict import VerdictKind

FloatArray = NDArray[np.float64]
CHOSEN = ("coulomb_friction", "quadratic_damping", "gauge_gain", "unmodelled_mode", "high_pass")
"""A law with its rival, and what else could take a slow remainder for itself."""


@pytest.fixture(scope="module")
def rig(kit):  # type: ignore[no-untyped-def]
    """Three releases, one of them held out, and static trials."""
    return kit.chain_bench(
        amplitudes=(0.02, 0.012, 0.006), samples=300, dynamic_channels=("x3", "g1"), held_out=True
    )


@pytest.fixture(scope="module")
def effects(catalogue):  # type: ignore[no-untyped-def]
    return tuple(effect for effect in catalogue if effect.identifier in CHOSEN)


def remainder(size: float, share: float):  # type: ignore[no-untyped-def]
    """Return what draws white noise with a first order process of so many noises in what moves."""

    def draw(generator: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        white = generator.standard_normal(shape)
        if shape[0] < 50:
            return white
        steps = generator.standard_normal((shape[0] + 200, shape[1])) * np.sqrt(1.0 - share**2)
        return np.asarray(white + size * lfilter([1.0], [1.0, -share], steps, axis=0)[200:])

    return draw


@pytest.mark.long
@pytest.mark.parametrize("seed", [1])
def test_friction_beside_a_remainder_is_named_in_part(rig, effects, seed: int) -> None:  # type: ignore[no-untyped-def]
    truth = {"friction_ratio": 0.02}
    campaign = rig.measured(seed, rig.patch("coulomb_friction", truth, "joint"), noise=remainder(4.0, 0.9))
    verdict, found, fit = name(rig.problem(campaign), effects)
    assert verdict.kind is VerdictKind.NAMED_IN_PART, verdict.sentence
    assert [effect.identifier for effect in verdict.effects] == ["coulomb_friction"]
    assert verdict.explained.trials == "held-out"
    assert 0.5 < verdict.explained.low <= verdict.explained.value <= verdict.explained.high
    assert verdict.explained.left == pytest.approx(4.0, rel=0.5)
    shares = (verdict.explained.effect, verdict.explained.remainder, verdict.explained.noise)
    assert sum(shares) == pytest.approx(1.0)
    assert {item.channel for item in verdict.remainders} == {"x3", "g1"}
    assert "of the gap in 2 trials that were not fitted" in verdict.sentence
    assert verdict.inclusion["coulomb_friction"] >= 0.95
    (estimate,) = verdict.effects[0].parameters
    half = 0.5 * (estimate.high - estimate.low)
    assert abs(estimate.value - truth["friction_ratio"]) < 2.5 * half
    assert fit.remainder is not None
    assert () in found.judged


@pytest.mark.parametrize("seed", [3])
@pytest.mark.long
def test_a_remainder_alone_gets_no_name(rig, effects, seed: int) -> None:  # type: ignore[no-untyped-def]
    verdict, _, _ = name(rig.problem(rig.measured(seed, noise=remainder(5.0, 0.95))), effects)
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert verdict.effects == ()


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.long)])
def test_coloured_noise_with_a_short_record_is_no_gap(rig, effects, seed: int) -> None:  # type: ignore[no-untyped-def]
    """Correlation 0.5 from sample to sample, in the trials and in a record of 100 samples."""
    coloured = remainder(0.0, 0.0)

    def draw(generator: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        if shape[0] < 50:
            return coloured(generator, shape)
        white = generator.standard_normal((shape[0] + 50, shape[1]))
        return np.asarray(np.sqrt(0.75) * lfilter([1.0], [1.0, -0.5], white, axis=0)[50:])

    generator = np.random.default_rng(seed)
    campaign = rig.measured(seed, noise=draw)
    channels = {}
    for key, channel in campaign.channels.items():
        samples = channel.noise.standard_deviation * draw(generator, (100, 1))[:, 0]
        record = NoiseRecord(float(samples.std()), 99.0, samples - samples.mean(), 0.012, "pre-trigger")
        channels[key] = replace(channel, noise=record)
    verdict, _, _ = name(rig.problem(replace(campaign, channels=channels)), effects)
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def test_shares_and_their_interval() -> None:
    """Sums that are known: half of the gap is closed, and the interval holds it; the same blocks always."""
    generator = np.random.default_rng(1)
    noise = np.full(40, 10.0)
    gap = generator.uniform(50.0, 150.0, 40)

    def shares(after: FloatArray) -> Share:
        sizes = (True, 4, 1.0, 2.0)
        return Share(noise + gap, after, noise, *sizes, OF_READINGS, tested=True)

    half = shares(noise + 0.5 * gap * generator.uniform(0.8, 1.2, 40))
    found = explained_share(half)
    assert found.value == pytest.approx(0.5, abs=0.05)
    assert found.low < 0.5 < found.high
    assert found.effect + found.remainder + found.noise == pytest.approx(1.0)
    assert found.trials == "held-out"
    better = shares(noise + 0.3 * gap)
    assert better.told_from(half)
    assert not half.told_from(better)
    closed = explained_share(shares(0.9 * noise))
    assert (closed.value, closed.left, closed.remainder) == (1.0, 0.0, 0.0)
