"""The missing force of simulated rigs: where it is, how large, and what a law is of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.open_rigs.campaigns import drawn, write
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.force import missing_force
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.model_choice import load_model
from discrepancy.models.fmu import FmuModel
from discrepancy.models.ported import refined, shows_ports
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import checked, investigate
from fe.runtime.patch import ModelPatch

CART, CART_IN_AIR, SERVO, STORES = 0, 5, 12, 14
"""Campaigns of seed 1: friction on a rail, drag, a cubic spring in a closed loop, Torricelli's outflow."""


def problem_of(folder: Path, number: int) -> Problem:
    """Write a campaign of the blind rigs and return it with its model."""
    folder = folder / "campaign"
    bench, truth, _ = drawn(number, 1)
    write(folder, bench, truth, "plain", (1, number))
    model = load_model(folder / "model.toml")
    campaign, faults = checked(read_campaign(folder), model)
    assert not faults
    return Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))


@pytest.mark.parametrize(
    ("number", "effect", "port"),
    [
        (CART, "coulomb_friction", "rail"),
        (CART_IN_AIR, "quadratic_damping", "rail"),
        (SERVO, "cubic_stiffness", "bearing"),
        (STORES, "outflow", "lower outlet"),
    ],
)
def test_the_law_of_the_missing_force_is_ahead_of_all_others(
    tmp_path: Path, number: int, effect: str, port: str
) -> None:
    problem = problem_of(tmp_path, number)
    search = ForceSearch(problem)
    at = search.locate()
    assert max(at, key=lambda name: at[name].evidence) == port
    effects = [item for item in library() if item.unavailable(problem.setting) is None]
    first, second = search.name(effects)[:2]
    assert (first.term.effect.identifier, first.term.place) == (effect, port)
    assert first.evidence > second.evidence + 10.0
    assert first.evidence > search.best().evidence + 10.0
    left, force = (
        np.concatenate(items) for items in (first.seen.left, [m.force for m in first.seen.motions])
    )
    assert np.mean(left**2) < 0.05 * np.mean(force**2)


def test_a_report_opens_with_the_missing_force(tmp_path: Path) -> None:
    problem_of(tmp_path, CART)
    found = investigate(tmp_path / "campaign", tmp_path / "campaign" / "model.toml")
    missing = found.missing
    assert missing is not None
    assert missing.port == "rail"
    assert missing.law == "Coulomb friction"
    assert missing.share is not None
    assert missing.share > 0.9
    for item in missing.courses:  # a step: its size hardly varies where the cart moves
        moving = np.abs(item.speed) > 0.2
        sizes = np.abs(item.force[moving])
        assert np.std(sizes) < 0.2 * np.mean(sizes)
        assert np.all(np.sign(item.force[moving]) == np.sign(item.speed[moving]))
        assert np.all(item.deviation > 0.0)
    assert f"{missing.size:.3g} N" in missing.sentence
    assert "Coulomb friction is" in missing.sentence
    assert len(missing_force_figure(missing).axes) == 6


def test_a_rig_without_a_gap_misses_no_force(tmp_path: Path) -> None:
    """The same campaign with the model's own response and noise alone as its readings."""
    problem = problem_of(tmp_path, CART)
    random = np.random.default_rng(8)
    start = problem.start(Candidate())
    for number, data in enumerate(problem.trials):
        bare, _ = problem.response(number, start.shared, start.local[number], ModelPatch())
        response = problem.prediction(number, start, bare)
        data.trial.values[:] = response + random.standard_normal(response.shape) * data.deviation
    assert missing_force(problem, fit(problem, Candidate(), start)) is None
    found = investigate(problem.campaign, problem.model.inner)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING
    assert found.missing is None


def test_a_finer_trial_has_the_inputs_of_the_coarse_one(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, SERVO)
    trial = problem.trials[0].trial
    finer = refined(trial, 4)
    np.testing.assert_array_equal(finer.time[::4], trial.time)
    for one, other in zip(trial.inputs, finer.inputs, strict=True):
        np.testing.assert_allclose(other.values[::4], one.values, rtol=1e-12)
    model = problem.model.inner
    data, start = problem.trials[0], problem.start(Candidate())
    conditions = data.unknowns.conditions(trial, problem.shared.parameters(start.shared), start.local[0])
    coarse, fine = (model.port_motion(item, conditions)[0] for item in (trial, finer))  # type: ignore[attr-defined]
    np.testing.assert_allclose(fine[::4], coarse, atol=1e-6 * np.ptp(coarse))


def test_models_that_do_not_tell_how_ports_move_show_no_force() -> None:
    assert not shows_ports(FmuModel)


def test_a_verdict_that_is_no_law_at_a_port_shows_no_force(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, CART)
    (gain,) = (item for item in library() if item.identifier == "gauge_gain")
    candidate = Candidate((Term(gain, "x"),))
    assert missing_force(problem, fit(problem, candidate, problem.start(candidate))) is None
