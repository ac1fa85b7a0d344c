"""Fits from far off: phases that slip, valleys, other optima, and errors too small to be names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.records import NoiseRecord, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.other_optima import elsewhere
from discrepancy.fits.problem import Problem
from discrepancy.judgement.naming import name
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from discrepancy.search.growing_records import Beginnings, gap_row
from discrepancy.search.hypotheses import are_related
from discrepancy.verdict import VerdictKind


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


# ---------------------------------------------------------------- fits far from the truth, where phases slip


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


# ---------------------------------------------------------------- optima beside the one that a search found


TRUTH = np.array([0.8, -0.6])
"""Mass and place, in prior deviations."""


def noisy(noise: NoiseRecord | None) -> NoiseRecord:
    """Return a noise thirty times as large."""
    assert noise is not None
    return replace(noise, standard_deviation=30.0 * noise.standard_deviation)


@pytest.mark.parametrize("place", [0.8, 1.2, 1.8])
def test_a_mass_is_found_on_the_other_side_of_an_antinode(place: float) -> None:
    bare, model = campaign(), Cantilever()
    releases = tuple(trial for trial in bare.trials if trial.kind is TrialKind.RINGDOWN)
    # With the readings' small noise, which of its narrow valleys a fit descends depends on the last bits.
    channels = {name: replace(item, noise=noisy(item.noise)) for name, item in bare.channels.items()}
    bare = replace(bare, trials=releases, channels=channels)
    setting = Setting(bare, model, model.scales(bare))
    (effect,) = (item for item in library() if item.identifier == "point_mass")
    (where,) = effect.places(setting)
    term = Term(effect, where)
    for trial in releases:
        patch = Candidate((term,)).patch(setting, TRUTH)
        trial.values[:] = observe(model, bare, trial, patch, Conditions(np.ones(1))).values
    problem = Problem(bare, model, setting)
    none = fit(problem, Candidate(), problem.start(Candidate()))

    def begun_at(begin: float, iterations: int) -> CandidateFit:
        at = Point(none.point.shared, none.point.local, np.array([0.5, begin]))
        return fit(problem, Candidate((term,)), at, iterations=iterations)

    right, stuck = begun_at(-0.5, 20), begun_at(place, 2)
    assert stuck.objective > 1000.0
    assert abs(stuck.point.effect[1] - TRUTH[1]) > 0.3
    found = elsewhere(problem, stuck)
    assert found.objective == pytest.approx(right.objective, abs=0.05)
    np.testing.assert_allclose(found.point.effect, right.point.effect, atol=0.02)
    deviation = np.sqrt(np.diag(found.effect_covariance))
    assert np.all(np.abs(found.point.effect - TRUTH) < 2.0 * deviation)
    assert elsewhere(problem, right) is right


# ---------------------------------------------------------------- errors of instruments that are too small


@pytest.mark.parametrize(("gain", "kind"), [(4e-4, VerdictKind.NOTHING_MISSING), (4e-2, VerdictKind.NAMED)])
def test_a_gain_of_half_a_thousandth_is_no_name(kit, gain: float, kind: VerdictKind) -> None:  # type: ignore[no-untyped-def]
    """Read so finely that it is certain; a gain of four per cent, as certain, is one."""
    bench = kit.chain_bench(amplitudes=(), gain_deviation=0.0)
    channels = {
        key: replace(
            item, noise=NoiseRecord(0.002 * item.noise.standard_deviation, 200.0), offset_deviation=0.0
        )
        for key, item in bench.campaign.channels.items()
        if item.noise is not None
    }
    draw = np.random.default_rng(np.random.SeedSequence(2))  # as `measured` draws the parameters
    known = {
        item.name: (item.mean + item.deviation * float(draw.standard_normal()), 1e-7)
        for item in bench.model.parameters
    }
    fine = replace(bench, campaign=replace(bench.campaign, channels=channels, parameters=known))
    cell = effect_by_identifier("load_cell", library())
    measured = fine.measured(2, fine.patch("load_cell", {"gain_error": gain, "tare_ratio": 0.0}, ""))
    verdict, found, fit = name(fine.problem(measured), (cell,))
    assert verdict.kind is kind, verdict.sentence
    if kind is VerdictKind.NOTHING_MISSING:
        assert "below 0.1 % of what it acts on" in verdict.sentence
        assert verdict.effects == ()
        assert fit is found.none
        assert found.best().candidate.identifiers == ("load_cell",)
