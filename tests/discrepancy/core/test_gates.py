"""Level and power of the gates, on sums and series drawn from their null distributions."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from scipy.stats import binom

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Term
from discrepancy.fits.gates import ABSOLUTE_LEVEL, SHAPE_GAIN, absolute_gate, absolute_tests, shape_gate

DRAWS = 1500


def null_gates(kit, freedom, kinds, samples, draws=DRAWS, gap=0.0):  # type: ignore[no-untyped-def]
    """Return a fit and, at sums drawn under the null (or with a gap), whether the gate passed."""
    noise = NoiseRecord(0.02, freedom)
    problem = kit.closed_problem(seed=1, noise=noise, kinds=kinds, samples=samples)
    found = kit.fitted(problem)
    generator = np.random.default_rng(17)
    left = problem.counts - found.spent
    passed = []
    for _ in range(draws):
        scale = 1.0 if freedom == inf else generator.chisquare(freedom, 3) / freedom
        sums = (1.0 + gap) * generator.chisquare(left) / scale
        residuals = tuple(generator.standard_normal(r.shape) for r in found.residuals)
        passed.append(absolute_gate(problem, replace(found, sums=sums, residuals=residuals)).passed)
    return problem, found, passed


@pytest.mark.parametrize(
    ("freedom", "kinds", "samples"),
    [
        (inf, ("static",), 0),
        (30.0, ("static",), 0),
        *(
            pytest.param(*row, 60, marks=pytest.mark.long)  # between the two above and the one below
            for row in ((inf, ("ringdown",)), (30.0, ("ringdown",)), (200.0, ("static", "ringdown")))
        ),
        (20.0, ("static", "ringdown"), 60),
    ],
)
def test_absolute_gate_has_its_level(kit, freedom: float, kinds: tuple[str, ...], samples: int) -> None:  # type: ignore[no-untyped-def]
    """Rejected at most 1e-3 of the time where nothing is missing; of 1500 draws more than 7 are too many."""
    _, _, passed = null_gates(kit, freedom, kinds, samples)
    assert passed.count(False) <= binom.isf(1e-3, DRAWS, ABSOLUTE_LEVEL)


def test_absolute_gate_has_its_level_with_whiteness(kit) -> None:  # type: ignore[no-untyped-def]
    problem, found, passed = null_gates(kit, 200.0, ("ringdown",), 120, draws=1500)
    assert any(name.startswith("whiteness") for name, _ in absolute_tests(problem, found))
    assert passed.count(False) <= binom.isf(1e-3, 1500, ABSOLUTE_LEVEL)


def test_absolute_gate_rejects_a_gap_in_all_channels(kit) -> None:  # type: ignore[no-untyped-def]
    """A third more variance, spread evenly: 60 samples, 5 channels of record."""
    _, _, passed = null_gates(kit, inf, ("ringdown",), 80, draws=300, gap=0.5)
    assert passed.count(False) > 280


def test_residuals_of_the_truth_pass_and_of_a_gap_fail(kit) -> None:  # type: ignore[no-untyped-def]
    """Fits, not drawn sums: the degrees of freedom that nuisances take are counted right."""
    shares = []
    for seed in range(40):
        problem = kit.closed_problem(seed=100 + seed, noise=NoiseRecord(0.02, inf), samples=40)
        found = kit.fitted(problem)
        assert absolute_gate(problem, found).passed
        shares.append(found.sums.sum() / (problem.counts.sum() - found.spent.sum()))
    assert np.mean(shares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (40 * 200)))
    problem = kit.closed_problem(seed=1, extra=lambda rows: 0.1 * np.sin(2.0 * rows))
    found = kit.fitted(problem)
    gate = absolute_gate(problem, found)
    assert gate.passed is False
    assert gate.statistic < ABSOLUTE_LEVEL


def test_without_a_record_nothing_absolute_is_said_but_of_colour(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=1, known_noise=False, samples=150)
    found = kit.fitted(problem)
    gate = absolute_gate(problem, found)
    assert gate.passed is None
    assert "No noise record" in gate.reason
    wave = 30.0 * np.sin(0.3 * np.arange(150))[:, np.newaxis]
    swung = replace(found, residuals=tuple(r + wave if len(r) == 150 else r for r in found.residuals))
    assert absolute_gate(problem, swung).passed is False


def test_shape_gate_compares_evidence(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=1)
    found = kit.fitted(problem, Term(kit.offset_effect(), "y1"))
    for gain, passes in ((-3.0, True), (SHAPE_GAIN - 0.01, True), (SHAPE_GAIN + 0.01, False)):
        gate = shape_gate(found, replace(found, log_evidence=found.log_evidence + gain))
        assert gate.passed is passes
        assert gate.statistic == pytest.approx(gain)
    assert shape_gate(found, None).passed is True
