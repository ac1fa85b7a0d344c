"""Optima beside the one that a search found: a mass that lies elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.records import NoiseRecord, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.other_optima import elsewhere
from discrepancy.fits.problem import Problem
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe

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
