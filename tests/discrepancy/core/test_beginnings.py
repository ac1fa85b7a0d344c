"""Fits far from the truth, where phases slip."""

from __future__ import annotations

import numpy as np
import pytest

from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.search.growing_records import Beginnings, gap_row
from discrepancy.search.hypotheses import are_related


@pytest.mark.parametrize(
    ("hidden", "values", "taken"),
    [
        ("joint_micro_slip", {"stiffness_share": 0.3, "slip_ratio": 0.2}, "bouc_wen_hysteresis"),
        pytest.param(
            "bouc_wen_hysteresis",
            {"stiffness_share": 0.3, "yield_ratio": 0.3},
            "joint_micro_slip",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_relative_is_reached_from_what_is_taken_for_it(bench, catalogue, hidden, values, taken) -> None:  # type: ignore[no-untyped-def]
    problem = bench.problem(bench.measured(3, bench.patch(hidden, values, "joint")))
    by_name = {effect.identifier: effect for effect in catalogue}

    def near(identifier: str, scaled: list[float]):  # type: ignore[no-untyped-def]
        candidate = Candidate((Term(by_name[identifier], "joint"),))
        start = problem.start(candidate)
        return fit(problem, candidate, Point(start.shared, start.local, np.array(scaled)), iterations=40)

    truth = [item.prior.normal(values[item.name]) for item in by_name[hidden].parameters]
    best, imitation = near(hidden, truth), near(taken, [0.0] * 2)
    assert imitation.objective > best.objective + 20.0

    related = [effect for effect in catalogue if are_related(effect, by_name[taken])]
    assert by_name[hidden] in related
    assert by_name[taken] not in related
    found = Beginnings(problem).related(imitation, related)
    first = min(found, key=lambda item: item.objective)
    assert first.candidate.identifiers == (hidden,)
    assert first.objective == pytest.approx(best.objective, abs=0.1)


def test_a_record_is_followed_until_its_gap_has_begun() -> None:
    residual = np.random.default_rng(1).standard_normal((500, 2))
    residual[:40] = 0.0  # blanks
    assert gap_row(residual) == 500
    residual[300:, 1] += 6.0
    assert 300 <= gap_row(residual) <= 305
