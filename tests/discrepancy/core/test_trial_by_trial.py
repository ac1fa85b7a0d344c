"""Sizes of an effect by trial: alike where one law acts, apart where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.judgement.consistency_gate import LARGE_SCATTER, SizeByTrial, sizes_by_trial


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
