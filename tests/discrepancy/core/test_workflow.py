"""The whole way on simulated campaigns of the chain; responses are remembered of the trial asked for."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.errors import CampaignDataError
from discrepancy.fits.candidate import Candidate
from discrepancy.judgement.separability import as_predicted
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate, open_hypotheses, patch_draws, solver_share, without_port
from fe.runtime.patch import ModelPatch


@pytest.fixture(scope="module")
def laboratory(kit):  # type: ignore[no-untyped-def]
    """Static trials and releases; one of each held out."""
    return kit.chain_bench(amplitudes=(0.004, 0.003, 0.002), samples=200, held_out=True)


@pytest.fixture(scope="module")
def effects(catalogue):  # type: ignore[no-untyped-def]
    chosen = ("quadratic_damping", "gauge_gain", "load_cell", "stiffness_drift", "coulomb_friction")
    return tuple(effect for effect in catalogue if effect.identifier in chosen)


@pytest.fixture(scope="module")
def damped(laboratory):  # type: ignore[no-untyped-def]
    patch = laboratory.patch("quadratic_damping", {"equivalent_damping_ratio": 0.01}, "end")
    return laboratory.measured(21, patch)


@pytest.fixture(scope="module")
def found(laboratory, damped, effects):  # type: ignore[no-untyped-def]
    return investigate(damped, laboratory.model, effects, seed=3)


def spoilt(campaign, change):  # type: ignore[no-untyped-def]
    """Return the campaign with the readings of each trial changed in place."""
    trials = [replace(trial, values=trial.values.copy()) for trial in campaign.trials]
    for trial in trials:
        change(trial)
    return replace(campaign, trials=tuple(trials))


def test_an_effect_is_named_and_proved_on_trials_not_used(found) -> None:  # type: ignore[no-untyped-def]
    assert found.verdict.kind is VerdictKind.NAMED, found.verdict.sentence
    assert found.proof is not None
    assert found.proof.gap_closed >= 0.9
    assert 0.8 <= found.proof.held_out_after.chi_square_per_dof <= 1.2
    assert found.proof.log_score_gain > 0.0
    assert found.location is not None
    assert not any("time steps cost" in remark for remark in found.verdict.remarks)
    assert solver_share(found.problem, found.fit) < 0.1


def test_draws_of_the_patch_have_the_posteriors_spread(found) -> None:  # type: ignore[no-untyped-def]
    (draws,) = patch_draws(found.problem, found.fit, seed=1, count=300)
    term = found.fit.candidate.terms[0]
    values = np.array([draw.primitives[0].coefficient for draw in draws])
    spread = float(np.sqrt(found.fit.effect_covariance[0, 0]))
    ends = [
        Candidate((term,)).patch(found.problem.setting, found.fit.point.effect + side * spread).primitives[0]
        for side in (-1.0, 1.0)
    ]
    assert values.std() == pytest.approx(0.5 * (ends[1].coefficient - ends[0].coefficient), rel=0.2)
    again = patch_draws(found.problem, found.fit, seed=1, count=300)[0]
    assert again == draws


def test_wrong_readings_at_the_ends_of_records_are_left_out(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    """A heavily damped line would explain the first one; held-out records are judged as well."""
    campaign = laboratory.measured(21)

    def change(trial) -> None:  # type: ignore[no-untyped-def]
        if trial.is_dynamic:
            noise = campaign.channels[trial.channels[0]].noise.standard_deviation
            trial.values[0 if trial.held_out else -1, 0] += 30.0 * noise

    found = investigate(spoilt(campaign, change), laboratory.model, effects, thorough=False)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING, found.verdict.sentence
    for trial in found.campaign.trials:
        if trial.is_dynamic:
            row = 0 if trial.held_out else len(trial.time) - 1
            assert not trial.used[row, 0]
            assert trial.used.sum() >= trial.used.size - 2
            assert any(repr(trial.name) in text and "left out" in text for text in found.campaign.remarks)


def test_open_hypotheses_are_different_sets(found) -> None:  # type: ignore[no-untyped-def]
    items = open_hypotheses(found.search, count=4)
    sets = [fit.candidate.identifiers for fit, _ in items]
    assert len(set(sets)) == len(sets)
    assert [p for _, p in items] == sorted((p for _, p in items), reverse=True)


def test_the_same_seed_gives_the_same_verdict(laboratory, damped, effects, found) -> None:  # type: ignore[no-untyped-def]
    again = investigate(damped, laboratory.model, effects, seed=3)
    assert again.verdict.sentence == found.verdict.sentence
    assert again.verdict.probability == found.verdict.probability
    assert again.proof.gap_closed == found.proof.gap_closed
    assert again.fit.point.effect.tobytes() == found.fit.point.effect.tobytes()


def test_nothing_missing_ends_without_proof_or_experiment(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    result = investigate(laboratory.measured(22), laboratory.model, effects)
    assert result.verdict.kind is VerdictKind.NOTHING_MISSING, result.verdict.sentence
    assert result.proof is None
    assert result.verdict.next_experiments == ()


def test_microstrain_for_strain_is_an_error_of_the_data(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    """Not an effect."""

    def change(trial) -> None:  # type: ignore[no-untyped-def]
        trial.values[:, trial.channels.index("g1")] *= 1e6

    result = investigate(spoilt(laboratory.measured(23), change), laboratory.model, effects)
    assert result.verdict.kind is VerdictKind.DATA_ERROR, result.verdict.sentence
    assert result.search is None


def test_an_open_verdict_comes_with_experiments(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    chosen = tuple(effect for effect in catalogue if effect.identifier in ("clock_error", "load_cell"))
    patch = bench.patch("clock_error", {"rate_error": 0.005, "phase_zero": 0.0})
    result = investigate(bench.measured(1, patch), bench.model, chosen)
    assert result.verdict.kind is VerdictKind.GROUP, result.verdict.sentence
    for item in result.verdict.next_experiments:
        assert 0.0 < item.information <= np.log(3.0) + 1e-9


def test_a_parameter_that_the_model_lacks_is_refused(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    misspelt = replace(laboratory.measured(1), parameters={"stifness_factor": (1.0, 0.01)})
    with pytest.raises(CampaignDataError, match=r"'stifness_factor'.*stiffness_factor"):
        investigate(misspelt, laboratory.model, effects)


def test_a_gain_far_from_its_prior_is_remarked_on(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    """A displacement sensor with a wrong gain beside gauges has no entry: the nuisance takes it, far out."""
    campaign = laboratory.measured(1)

    def change(trial) -> None:  # type: ignore[no-untyped-def]
        if "x2" in trial.channels:
            trial.values[:, trial.channels.index("x2")] *= 1.05

    wrong = spoilt(campaign, change)
    found = investigate(wrong, laboratory.model, effects[:1], thorough=False)
    assert any("The gain of the channel 'x2'" in remark for remark in found.verdict.remarks)
    plain = investigate(campaign, laboratory.model, effects[:1], thorough=False)
    assert not any("of its stated deviations" in remark for remark in plain.verdict.remarks)


def test_data_without_any_noise_end_with_a_verdict(laboratory, effects) -> None:  # type: ignore[no-untyped-def]
    """What the model says, to the last bit, and no noise record: nothing to weigh the rest by."""
    setting = Setting(laboratory.campaign, laboratory.model, laboratory.model.scales(laboratory.campaign))
    exact = as_predicted(laboratory.campaign, laboratory.model, setting)
    trials = tuple(trial for trial in exact.trials if not trial.held_out)
    channels = {name: replace(item, noise=None) for name, item in exact.channels.items()}
    found = investigate(replace(exact, trials=trials, channels=channels), laboratory.model, effects)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING
    assert "No noise record" in found.verdict.sentence


def test_effects_that_lack_a_port_are_remarked_on_with_the_port_to_declare() -> None:
    chain = LumpedModel.load("three_mass_chain")
    plan = plan_for(chain, ("x3", "x1"), "end")
    campaign = example_campaign(chain, "ringdown", 1, plan)
    assert without_port(Setting(campaign, chain, chain.scales(campaign)), library()) == []
    bare = LumpedModel(chain.description.model_copy(update={"port": ()}))
    (remark,) = without_port(Setting(campaign, bare, bare.scales(campaign)), library())
    assert remark.startswith("Not tested for lack of a port: Coulomb friction, ")
    assert "joint micro-slip (Iwan) and Bouc-Wen hysteresis; declare a [[port]]" in remark
    assert "vector = [0, 0, 1] between the ground and 'end'" in remark
    assert "drift" not in remark
    static = example_campaign(chain, "static", 1, plan)
    (remark,) = without_port(Setting(static, bare, bare.scales(static)), library())
    assert "Coulomb" not in remark  # a port would not help: there is no motion


# ---------------------------------------------------------------- remembered responses


def test_trials_that_came_and_went_are_not_mistaken_for_each_other(kit) -> None:  # type: ignore[no-untyped-def]
    """Trials of proposals live briefly; their addresses are used again."""
    problem = kit.closed_problem()
    template = problem.campaign.trials[0]
    channels = problem.campaign.channels
    outputs = tuple((channels[name].output, channels[name].quantity) for name in template.channels)
    memo = problem.model
    plain = memo.patched(ModelPatch())
    conditions = Conditions(np.array([1.0, 0.5]), health=np.zeros((9, 2)))
    for number in range(200):
        trial = replace(template, force=float(number) * template.force)
        got = memo.respond(trial, outputs, ModelPatch(), conditions).values
        np.testing.assert_array_equal(got, plain.respond(trial, outputs, ModelPatch(), conditions).values)
        del trial
        gc.collect(0)
