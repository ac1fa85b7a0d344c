"""Candidates that no fit can follow: values that overflow, formulas that have no number."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from discrepancy.catalogue.entry import Effect, Prior, Setting
from discrepancy.catalogue.library import effect_by_identifier, library, load_catalogue
from discrepancy.errors import DiscrepancyError, FitError
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.elimination import Cholesky
from discrepancy.fits.fitting import attempt, fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.separability import _distance
from discrepancy.search.growing_records import Beginnings
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PowerStiffness
from tests.discrepancy.rigs import FEW, measured
from tests.refusals import Inputs

EXPLOSIVE = Inputs(__file__).text("explosive.toml")


def softening(coefficient: float, reference: float) -> Effect:
    """A spring of the ninth power that overtakes the rig's own far below its largest motion."""

    def build(setting: Setting, values: object, place: str) -> ModelPatch:
        port = setting.scales.ports[place]
        size = coefficient * values["stiffening"] * port.stiffness * port.displacement  # type: ignore[index]
        return ModelPatch((PowerStiffness(place, size, 9.0, 0, reference * port.displacement),))

    cubic = effect_by_identifier("cubic_stiffness", library())
    sizes = (replace(cubic.parameters[0], prior=Prior("normal", -30.0, 30.0)),)
    return replace(cubic, identifier="ninth_power", build=build, parameters=sizes, shape=())


@pytest.fixture(scope="module")
def problem() -> Problem:
    campaign, model = measured("quadratic_damping", 0.02)
    return Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))


@given(
    u=st.floats(-8.0, 8.0), coefficient=st.sampled_from([-1.0, 1.0, 1e100]),
    reference=st.sampled_from([0.01, 0.3]), iterations=st.sampled_from([0, 4]),
)  # fmt: skip
@example(u=-2.66, coefficient=-1.0, reference=0.01, iterations=0)
@settings(max_examples=12, deadline=None)
def test_a_fit_ends_with_finite_numbers_or_a_sentence(
    problem: Problem, u: float, coefficient: float, reference: float, iterations: int
) -> None:
    effect = softening(coefficient, reference)
    candidate = Candidate((Term(effect, effect.places(problem.setting)[0]),))
    start = replace(problem.start(candidate), effect=np.array([u]))
    try:
        found = fit(problem, candidate, start, iterations=iterations)
    except DiscrepancyError:
        assert attempt(problem, candidate, start, iterations=iterations) is None
        assert problem.refusals["ninth_power"].endswith(".")
        return
    assert np.isfinite(found.log_evidence)
    assert np.all(np.isfinite(found.covariance))


@pytest.mark.parametrize(("coefficient", "kept"), [(-1e-7, 1), (-1e-5, 0)])
def test_what_can_be_carried_at_any_size_is_no_refusal(
    problem: Problem, coefficient: float, kept: int
) -> None:
    """An effect that the structure carries while it is small has only been outdone by others."""
    effect = softening(coefficient, 0.3)
    candidate = Candidate((Term(effect, effect.places(problem.setting)[0]),))
    none = fit(problem, Candidate(), problem.start(Candidate()))
    problem.refusals.clear()
    assert len(list(Screen(problem, none).changes(candidate.terms[0]))) == kept
    assert len(problem.refusals) == 1 - kept
    problem.refusals.clear()
    problem.refused(candidate.plus(candidate.terms[0]), FitError("Of two, either may be to blame."))
    assert not problem.refusals


def test_the_last_point_that_a_model_can_follow_is_compared_all_the_same(problem: Problem) -> None:
    effect = softening(-4.5e-8, 0.3)
    term = Term(effect, effect.places(problem.setting)[0])
    screen = Screen(problem, fit(problem, Candidate(), problem.start(Candidate())))
    last = screen.change(term, np.array([1.0]))
    with pytest.raises(DiscrepancyError):
        screen.change(term, np.array([1.1]))
    assert last.size > 0.0
    assert _distance(screen, last, [last]) == pytest.approx(0.0, abs=1e-5 * last.size)


def test_nothing_is_sought_beside_a_base_that_the_beginnings_cannot_follow(problem: Problem) -> None:
    effect = softening(-1.0, 0.01)
    candidate = Candidate((Term(effect, effect.places(problem.setting)[0]),))
    none = fit(problem, Candidate(), problem.start(Candidate()))
    base = replace(none, candidate=candidate, point=replace(none.point, effect=np.array([4.0])))
    assert Beginnings(problem).screen(none) is not None
    assert Beginnings(problem).scan(base, FEW) == []


def test_a_search_tells_what_could_not_be_fitted_and_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(EXPLOSIVE, encoding="utf-8")
    chosen = [
        effect
        for effect in load_catalogue([file], installed=False)
        if effect.identifier in ("quadratic_damping", "explosive")
    ]
    campaign, model = measured("quadratic_damping", 0.02)
    verdict = investigate(campaign, model, chosen, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED
    assert [effect.identifier for effect in verdict.effects] == ["quadratic_damping"]
    (left,) = verdict.not_fitted
    assert left.identifier == "explosive"
    assert left.reason.startswith("could not be fitted: ")
    assert left.reason.endswith("is not a finite number at every time.")


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0])
def test_a_curvature_that_is_none_is_a_fit_error(wrong: float) -> None:
    matrix = np.diag([1.0, wrong])
    with pytest.raises(FitError, match=r"not finite|singular"):
        Cholesky.of(matrix)


def test_a_factor_solves() -> None:
    generator = np.random.default_rng(4)
    root = generator.standard_normal((4, 6))
    matrix, right = root @ root.T, generator.standard_normal((4, 2))
    found = Cholesky.of(matrix)
    np.testing.assert_allclose(matrix @ found.solve(right), right, atol=1e-10)
    np.testing.assert_allclose(found.half(right).T @ found.half(right), right.T @ found.solve(right))
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(matrix)[1])
    assert Cholesky.of(np.zeros((0, 0))).solve(np.zeros((0, 2))).shape == (0, 2)
