"""Fits from far off: valleys that the phases of a record bend, and sizes that begin at next to nothing."""

from __future__ import annotations

import numpy as np
import pytest

from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit


@pytest.mark.parametrize("share", [0.01, 0.03])
def test_fits_reach_the_optimum_from_next_to_no_effect(bench, catalogue, share: float) -> None:  # type: ignore[no-untyped-def]
    """The frequency has to move by many widths of the likelihood, and nuisances hold it back at first."""
    values = {"compliance_share": share}
    problem = bench.problem(bench.measured(4, bench.patch("root_compliance", values)))
    effect = next(item for item in catalogue if item.identifier == "root_compliance")
    candidate = Candidate((Term(effect),))
    truth = np.array([item.prior.normal(values[item.name]) for item in effect.parameters])
    none = fit(problem, Candidate(), problem.start(Candidate()))
    near = fit(problem, candidate, Point(none.point.shared, none.point.local, truth), iterations=40)
    small = truth.copy()
    small[0] = -5.0
    far = fit(problem, candidate, Point(none.point.shared, none.point.local, small), iterations=40)
    assert near.converged
    assert far.converged
    assert far.objective == pytest.approx(near.objective, abs=0.2)
    deviation = np.sqrt(np.diag(near.effect_covariance))
    np.testing.assert_allclose(far.point.effect, near.point.effect, atol=0.3 * deviation.max())
    assert none.objective > near.objective + 25.0


def test_differences_reach_as_far_as_a_parameter_may_lie(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    """An effect that is known to a thousandth of its prior keeps that deviation whatever the first step."""
    problem = bench.problem(bench.measured(4, bench.patch("root_compliance", {"compliance_share": 0.3})))
    effect = next(item for item in catalogue if item.identifier == "root_compliance")
    candidate = Candidate((Term(effect),))
    found = fit(problem, candidate, problem.start(candidate), iterations=40)
    deviation = float(np.sqrt(found.effect_covariance[0, 0]))
    step = found.point.effect + np.array([deviation])
    moved = fit(problem, candidate, Point(found.point.shared, found.point.local, step), iterations=40)
    assert moved.objective == pytest.approx(found.objective, abs=0.05)
    assert float(np.sqrt(moved.effect_covariance[0, 0])) == pytest.approx(deviation, rel=0.05)
