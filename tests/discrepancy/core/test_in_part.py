"""Verdicts with reserves: names in part, look-alikes, sizes that differ by trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from discrepancy.campaign.records import NoiseRecord
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.judgement.consistency_gate import LARGE_SCATTER, SizeByTrial, sizes_by_trial
from discrepancy.judgement.in_part import explained_share
from discrepancy.judgement.naming import name
from discrepancy.judgement.when import look_alike_remark, with_untested
from discrepancy.missing_force.shares import OF_READINGS, Share
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch

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


# ---------------------------------------------------------------- the remark on what a name does not exclude


def verdict_on(catalogue, *identifiers: str, kind: VerdictKind = VerdictKind.NAMED) -> Verdict:  # type: ignore[no-untyped-def]
    known = {effect.identifier: effect for effect in catalogue}
    effects = tuple(
        NamedEffect(i, known[i].name, "", known[i].family, (), (), ModelPatch()) for i in identifiers
    )
    return Verdict(kind, "-", 0.99, 20.0, effects=effects)


def test_declared_likenesses_are_told_from_those_left_out(catalogue) -> None:  # type: ignore[no-untyped-def]
    whole = look_alike_remark(verdict_on(catalogue, "inertia_relief"), catalogue)
    assert "washout" in whole
    assert "not compared" not in whole
    rest = [effect for effect in catalogue if effect.identifier != "washout"]
    less = look_alike_remark(verdict_on(catalogue, "inertia_relief"), rest)
    assert "washout was not compared" in less


def test_a_group_says_last_what_these_trials_cannot_test(kit, catalogue) -> None:  # type: ignore[no-untyped-def]
    bench = kit.chain_bench(amplitudes=())
    setting = Setting(bench.campaign, bench.model, bench.model.scales(bench.campaign))
    group = replace(verdict_on(catalogue, "load_cell", kind=VerdictKind.GROUP), sentence="Either is missing.")
    sentence = with_untested(group, setting, catalogue).sentence
    assert sentence.startswith("Either is missing. ")
    named = [effect.name for effect in catalogue if effect.name in sentence]
    assert named
    able = [effect for effect in catalogue if effect.unavailable(setting) is None]
    assert not {effect.name for effect in able} & set(named)
    single = verdict_on(catalogue, "load_cell")
    assert with_untested(single, setting, catalogue) is single


def test_likeness_counts_both_ways(catalogue) -> None:  # type: ignore[no-untyped-def]
    """The place of a load declares the load cell; so does what only others declare."""
    for effect in catalogue:
        for other in effect.confusable:
            text = look_alike_remark(verdict_on(catalogue, other), catalogue)
            assert effect.identifier in text


def test_members_of_a_set_are_no_likenesses_of_each_other(catalogue) -> None:  # type: ignore[no-untyped-def]
    text = look_alike_remark(verdict_on(catalogue, "inertia_relief", "washout"), catalogue)
    assert " do together, within the noise" in text
    compared = text.split("look alike,")[1]
    assert "washout" not in compared
    assert "inertia_relief" not in compared


@pytest.mark.parametrize("kind", [kind for kind in VerdictKind if kind is not VerdictKind.NAMED])
def test_only_names_are_remarked_on(catalogue, kind: VerdictKind) -> None:  # type: ignore[no-untyped-def]
    assert look_alike_remark(verdict_on(catalogue, "load_cell", kind=kind), catalogue) is None


# ---------------------------------------------------------------- sizes of an effect by trial


def test_cochrans_q_and_the_scatter_beyond_it_against_their_definitions() -> None:
    generator = np.random.default_rng(1)
    deviations = np.full(6, 0.05)
    alike, apart = [], []
    for _ in range(400):
        noise = deviations * generator.standard_normal(6)
        alike.append(SizeByTrial("drag", tuple("abcdef"), noise, deviations))
        real = 0.4 * generator.standard_normal(6)
        apart.append(SizeByTrial("drag", tuple("abcdef"), noise + real, deviations))
    assert np.mean([item.statistic for item in alike]) == pytest.approx(5.0, abs=0.5)
    assert np.mean([item.p_value < 0.1 for item in alike]) == pytest.approx(0.1, abs=0.05)
    assert alike[0].p_value == pytest.approx(chi2.sf(alike[0].statistic, 5))
    assert not any(item.follows for item in alike)
    assert np.sqrt(np.mean([item.scatter**2 for item in apart])) == pytest.approx(0.4, abs=0.04)
    assert np.mean([item.follows for item in apart]) > 0.9


@pytest.mark.parametrize("sizes", [(0.02, 0.02, 0.02), (0.02, 0.05, 0.012)])
def test_friction_of_another_size_in_each_release_follows_the_trial(kit, sizes: tuple[float, ...]) -> None:  # type: ignore[no-untyped-def]
    bench = kit.chain_bench(static=False, dynamic_channels=("x3",))
    parts = [
        bench.measured(3, bench.patch("coulomb_friction", {"friction_ratio": size}, "joint"))
        for size in sizes
    ]
    trials = tuple(part.trials[number] for number, part in enumerate(parts))
    problem = bench.problem(replace(parts[0], trials=trials))
    friction = Candidate((Term(effect_by_identifier("coulomb_friction", library()), "joint"),))
    (found,) = sizes_by_trial(problem, fit(problem, friction, problem.start(friction), iterations=40))
    assert found.trials == ("release 0", "release 1", "release 2")
    assert found.follows is (len(set(sizes)) > 1)
    if found.follows:
        assert found.scatter > LARGE_SCATTER
        assert np.argmax(found.shares) == 1
        assert "follows the trial" in found.sentence()
        assert "'release 1'" in found.sentence()
    else:
        assert np.all(np.abs(found.shares) < 0.1)
