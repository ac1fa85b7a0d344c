"""Optima beside the one that a search found: a mass that lies elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.linearisation import Point
from discrepancy.fits.other_optima import elsewhere
from discrepancy.fits.problem import Problem
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe

TRUTH = np.array([0.8, -0.6])
"""Mass and place, in prior deviations."""


def test_a_mass_is_found_on_the_other_side_of_an_antinode() -> None:
    bare, model = campaign(), Cantilever()
    releases = tuple(trial for trial in bare.trials if trial.kind is TrialKind.RINGDOWN)
    bare = replace(bare, trials=releases)
    setting = Setting(bare, model, model.scales(bare))
    (effect,) = (item for item in library() if item.identifier == "point_mass")
    (place,) = effect.places(setting)
    term = Term(effect, place)
    for trial in releases:
        patch = Candidate((term,)).patch(setting, TRUTH)
        trial.values[:] = observe(model, bare, trial, patch, Conditions(np.ones(1))).values
    problem = Problem(bare, model, setting)
    none = fit(problem, Candidate(), problem.start(Candidate()))

    def begun_at(place: float) -> CandidateFit:
        at = Point(none.point.shared, none.point.local, np.array([0.5, place]))
        return fit(problem, Candidate((term,)), at)

    stuck = begun_at(1.2)
    assert stuck.objective > 1000.0
    assert abs(stuck.point.effect[1] - TRUTH[1]) > 0.3
    found = elsewhere(problem, stuck)
    np.testing.assert_allclose(found.point.effect, TRUTH, atol=2e-3)
    right = begun_at(-0.5)
    assert elsewhere(problem, right) is right
