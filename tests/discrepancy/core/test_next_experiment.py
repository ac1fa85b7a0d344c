"""Mutual information against its limits and brute force; proposals that separate what is open."""

from __future__ import annotations

from dataclasses import replace
from math import inf, log

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.judgement.next_experiment import (
    Proposal,
    mutual_information,
    next_experiments,
    oscillates,
    proposals,
)

TIGHT = {"slope": (1.0, 1e-9), "curvature": (0.5, 1e-9)}


def one_reading(kit, shift):  # type: ignore[no-untyped-def]
    """One reading of unit noise; two hypotheses: nothing, or an offset of `shift` noise deviations."""
    channel = Channel("y1", Quantity.DISPLACEMENT, "y1", NoiseRecord(0.02, inf))
    trial = kit.blank_trial("one", TrialKind.STATIC, ("y1",), np.array([1.0]))
    trial = replace(trial, values=np.full((1, 1), 1.5))
    given = Campaign("", {"y1": channel}, (trial,), None, TIGHT, "")
    model = kit.ClosedForm()
    problem = Problem(given, model, Setting(given, model, model.scales(given)))
    none = fit(problem, Candidate(), problem.start(Candidate()))
    candidate = Candidate((Term(kit.offset_effect(deviation=0.02), "y1"),))
    other = fit(problem, candidate, problem.start(candidate))
    known = replace(
        other,
        point=Point(none.point.shared, none.point.local, np.array([shift])),
        covariance=np.diag([1.0, 1.0, 1e-12]),
    )
    return problem, Proposal(trial, "", "", 1.0), [none, known]


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("weight", [0.5, 0.2])
def test_information_of_one_reading_against_quadrature(kit, shift: float, weight: float) -> None:  # type: ignore[no-untyped-def]
    problem, proposal, fits = one_reading(kit, shift)
    weights = np.array([weight, 1.0 - weight])
    got = mutual_information(problem, proposal, fits, weights)

    def density(y: float) -> float:
        parts = weights * norm.pdf(y, [0.0, shift])
        share = parts / parts.sum()
        return float(np.sum(parts * (np.log(share) - np.log(weights))))

    exact, _ = quad(density, -8.0, 8.0 + shift)
    entropy = -float(weights @ np.log(weights))
    assert 0.0 <= got <= entropy
    # 300 outcomes each: standard error about 0.02
    assert got == pytest.approx(exact, abs=0.06)


def test_information_has_its_limits(kit) -> None:  # type: ignore[no-untyped-def]
    half = np.array([0.5, 0.5])
    problem, proposal, fits = one_reading(kit, 40.0)
    assert mutual_information(problem, proposal, fits, half) == pytest.approx(log(2.0), abs=1e-6)
    assert mutual_information(problem, proposal, [fits[0], fits[0]], half) == pytest.approx(0.0, abs=1e-9)
    weights = np.array([0.2, 0.3, 0.5])
    three = [fits[0], fits[1], fits[1]]
    merged = -0.2 * log(0.2) - 0.8 * log(0.8)
    assert mutual_information(problem, proposal, three, weights) == pytest.approx(merged, abs=1e-6)


def test_what_a_nuisance_hides_tells_nothing(kit) -> None:  # type: ignore[no-untyped-def]
    """An offset of two deviations under a free zero."""
    problem, proposal, fits = one_reading(kit, 2.0)
    channels = {"y1": replace(problem.campaign.channels["y1"], offset_deviation=inf)}
    given = replace(problem.campaign, channels=channels)
    free = Problem(given, problem.model, problem.setting)
    assert mutual_information(free, proposal, fits, np.array([0.5, 0.5])) < 0.02


@pytest.fixture(scope="module")
def one_amplitude(kit):  # type: ignore[no-untyped-def]
    """Releases from one amplitude only, of a chain that stiffens a little."""
    test = kit.chain_bench(static=False, amplitudes=(0.01, 0.01), samples=160)
    patch = test.patch("cubic_stiffness", {"stiffening": 0.01}, "end")
    return test.problem(test.measured(3, patch))


def test_another_amplitude_decides_between_amplitude_and_time(one_amplitude, catalogue) -> None:  # type: ignore[no-untyped-def]
    """Stiffening with amplitude and drift with time look alike in releases from one amplitude."""
    problem, fits = one_amplitude, []
    for identifier, place in (("cubic_stiffness", "end"), ("stiffness_drift", "")):
        candidate = Candidate((Term(effect_by_identifier(identifier, catalogue), place),))
        fits.append(fit(problem, candidate, problem.start(candidate)))
    weights = np.array([0.5, 0.5])
    information = {
        item.trial.name: mutual_information(problem, item, fits, weights)
        for item in proposals(problem.campaign, problem)
    }
    assert all(0.0 <= value <= log(2.0) + 1e-9 for value in information.values())
    same = Proposal(problem.campaign.trials[0], "", "", 1.0)
    again = mutual_information(problem, same, fits, weights)
    assert information["release at twice the largest amplitude so far"] > again
    best = next_experiments(problem, [(item, 0.5) for item in fits])
    assert best
    # a longer record may do as well, for less; of all repetitions another amplitude comes first
    assert "amplitude" in next(item.description for item in best if item.cost >= 1.0)
    assert information["release at twice the largest amplitude so far"] > 0.95 * log(2.0)
    assert list(best) == sorted(best, key=lambda item: -item.information / item.cost)
    assert next_experiments(problem, [(item, 0.5) for item in fits]) == best  # seeded


def test_proposals_are_trials_of_the_kinds_that_were_done(bench) -> None:  # type: ignore[no-untyped-def]
    problem = bench.problem(bench.measured(1))
    found = list(proposals(problem.campaign, problem))
    kinds = {item.trial.kind for item in found}
    assert kinds == {TrialKind.STATIC, TrialKind.RINGDOWN}
    assert len({item.description for item in found}) == len(found)
    for item in found:
        assert item.cost > 0.0
        assert len(item.trial.time) == len(item.trial.values)
    longer = next(item.trial for item in found if item.trial.name == "longer record")
    before = max((t for t in problem.campaign.trials if t.release), key=lambda t: t.release.displacement)
    assert longer.interval == pytest.approx(before.interval)
    assert len(longer.time) == 3 * len(before.time)


def test_no_longer_record_of_what_does_not_swing(bench) -> None:  # type: ignore[no-untyped-def]
    problem = bench.problem(bench.measured(1))
    none = fit(problem, Candidate(), problem.start(Candidate()))
    assert oscillates(problem, none)
    decay = tuple(
        replace(part, response=np.exp(-data.trial.time)[:, np.newaxis] * np.ones(part.response.shape[1]))
        for data, part in zip(problem.trials, none.linearisations, strict=True)
    )
    assert not oscillates(problem, replace(none, linearisations=decay))
    names = [item.trial.name for item in proposals(problem.campaign, problem, swings=False)]
    assert names
    assert "longer record" not in names


def test_without_a_record_the_rest_stands_for_the_noise(kit) -> None:  # type: ignore[no-untyped-def]
    """The information does not depend on the scale that stands in for an unknown noise."""
    found = []
    for known in (True, False):
        problem = kit.closed_problem(seed=13, effect=0.05, known_noise=known)
        none = kit.fitted(problem, iterations=40)
        other = kit.fitted(problem, Term(kit.offset_effect(), "y1"), iterations=40)
        proposal = Proposal(problem.campaign.trials[0], "", "", 1.0)
        found.append(mutual_information(problem, proposal, [other, none], np.array([0.5, 0.5])))
    assert 0.0 < found[0] < log(2.0)
    assert found[1] == pytest.approx(found[0], abs=0.1)
