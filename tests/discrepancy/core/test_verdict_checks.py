"""What trials say against a verdict, unknown beginnings, and the record of proof beside residuals.nc."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, Trial, TrialKind
from discrepancy.files.verdict import read_verdict
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.judgement.closed_share import percent_with_interval, rms_errors_text
from discrepancy.judgement.conclusion import VerdictOutcome
from discrepancy.judgement.moved_unknowns import moved_sentence, moved_unknowns
from discrepancy.judgement.verdict_checks import check_against_trials, far_held_out_records, unfitted_records
from discrepancy.report.figures import ReportInput
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_folder import write_verdict_folder
from discrepancy.workflow import investigate
from fe.runtime.patch import PowerDamping
from tests.discrepancy.bench import Bench
from tests.discrepancy.rigs import ORIGIN, chosen, integrated, measured, model_of, simulated
from tests.refusals import Inputs

from . import kit
from .test_workflow import MODEL, NOISE, held_by_a_spring, pushed

PENDULUM = model_of(Inputs(__file__).text("pendulum.toml"))
ANGLE_NOISE = 1e-3


def swings(**beginnings):
    """Return free swings of the pendulum from angles [rad]; those whose name holds "held" are held out."""
    generator, time = np.random.default_rng(2), np.arange(0.0, 6.0, 0.01)
    trials = []
    for name, angle in beginnings.items():

        def rate(_, state):
            return [state[1], -(0.0044 * state[1] + 1.03 * 1.75 * np.sin(state[0])) / 0.1]

        angles = integrated(rate, time, [angle, 0.0])[:, :1]
        values = angles + ANGLE_NOISE * generator.standard_normal(angles.shape)
        given = {"load_place": "torque", "begins": Start.UNKNOWN, "held_out": "held" in name}
        force = np.zeros(len(time))
        trials.append(
            Trial.plain(name, TrialKind.FORCED, ("angle",), time, values=values, force=force, **given)
        )
    channel = Channel("angle", Quantity.ANGLE, "angle", NoiseRecord(ANGLE_NOISE, 500.0))
    return Campaign("swings", {"angle": channel}, tuple(trials), None, {}, "0" * 64)


def test_a_right_pendulum_is_found_with_nothing_missing_from_unknown_beginnings():
    """Held out is a swing from 126 degrees, which a fit of the beginning from rest does not reach."""
    found = investigate(swings(first=0.785, held=2.2), PENDULUM, chosen("coulomb_friction"), thorough=False)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING, found.verdict.sentence
    errors = [float(np.sqrt(np.mean(item.residual**2))) for item in found.before.trials]
    assert max(errors) < 1.5 * ANGLE_NOISE


def test_beginnings_are_taken_from_the_first_readings_where_a_fit_from_rest_fails():
    problem = kit.problem_of(swings(far=2.2), PENDULUM)
    start = problem.prior_mean_point(Candidate())
    start = replace(start, shared=np.array([1.5, 0.5]))  # the parameters are those of the readings
    from_rest = fit(problem, Candidate(), start, local_only=True)
    count = float(problem.sample_counts.sum())
    assert from_rest.chi_square > 1e3 * count
    assert refit_from_first_readings(problem, from_rest, local_only=True).chi_square < 1.2 * count


# ---------------------------------------------------------------- held-out trials far off


def test_a_held_out_trial_far_off_vetoes_that_nothing_is_missing():
    """What is fitted agrees with the model; the trial held out is fourteen noises off."""
    campaign = pushed(MODEL, (1.01, 0.9))
    off = np.sin(np.linspace(0.0, 30.0, 201))[:, None] * 14.0 * np.sqrt(2.0) * NOISE
    for trial in campaign.held_out:
        trial.values[:] += off
    verdict = investigate(campaign, MODEL, chosen("coulomb_friction"), thorough=False).verdict
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "not those held out: it misses x in 'second' by" in verdict.sentence
    assert verdict.effects == verdict.resembles == ()


def test_what_the_fitted_trials_leave_open_vetoes_nothing():
    held = Bench(held_out=(False, True)).fit(np.random.default_rng(1))
    far = [replace(item, residual=10.0 * item.residual) for item in held.trials]
    assert far_held_out_records(replace(held, trials=tuple(far)))
    wide = [replace(item, leverage=item.leverage + 100.0 * item.trial.held_out) for item in far]
    assert far_held_out_records(replace(held, trials=tuple(wide))) == []


# ---------------------------------------------------------------- fits that are none


def test_a_fit_that_leaves_more_than_the_signal_is_not_fitted():
    fitted = Bench().fit(np.random.default_rng(1))
    assert unfitted_records(fitted) == ()
    first, *others = fitted.trials
    wrong = replace(first, residual=2.0 * first.trial.values)
    (record, *_) = unfitted_records(replace(fitted, trials=(wrong, *others)))
    assert record.trial == first.trial.name
    assert record.left > record.varies


def test_a_channel_of_noise_alone_is_fitted():
    fitted = Bench().fit(np.random.default_rng(1))
    first, *others = fitted.trials
    quiet = replace(first, trial=replace(first.trial, values=first.residual.copy()))
    assert unfitted_records(replace(fitted, trials=(quiet, *others))) == ()


def test_a_model_that_is_not_fitted_gives_no_evidence_of_a_force():
    """The sign of the force is wrong: what is left is twice the signal, and no force is told."""
    campaign = pushed(MODEL, (1.0, 1.0))
    trials = [replace(trial, force=-trial.force) for trial in campaign.trials]
    found = investigate(replace(campaign, trials=tuple(trials)), MODEL, chosen("quadratic_damping"))
    assert found.verdict.kind is VerdictKind.UNEXPLAINED
    assert found.verdict.sentence.startswith("The model does not fit: its residuals of x in 'first'")
    assert found.verdict.force is None


# ---------------------------------------------------------------- what the null hypothesis moves


def test_parameters_that_the_model_moves_beyond_two_deviations_are_named_with_their_figures():
    model = held_by_a_spring(stiffness=0.004, damping=0.2)
    problem = kit.problem_of(pushed(model, (1.03, 1.0)), model)
    none = fit(problem, Candidate(), problem.prior_mean_point(Candidate()))
    (moved,) = moved_unknowns(problem, none)
    assert moved.name == "stiffness"
    assert moved.deviations == pytest.approx((moved.value - moved.stated) / moved.deviation)
    assert moved.deviations == pytest.approx(7.5, abs=0.3)
    told = (
        f"the model moves 'stiffness' from 1 ± 0.004 to {moved.value:.4g} ({moved.deviations:.1f} deviations)"
    )
    assert told in moved_sentence([moved])
    assert told in investigate(problem.campaign, model, chosen("load_cell"), thorough=False).verdict.sentence


def test_gains_and_zeros_are_named_too():
    problem = kit.closed_problem(seed=1)
    none = kit.fitted(problem)
    names = {item.name for item in moved_unknowns(problem, none)}
    far = replace(none.point, shared=none.point.shared + 3.0, local=tuple(u + 3.0 for u in none.point.local))
    moved = {item.name for item in moved_unknowns(problem, replace(none, point=far))}
    assert {f"gain of {name}" for name in problem.shared.gain_channels} <= moved
    assert len(moved) > len(names)


# ---------------------------------------------------------------- one record of proof


FRICTION, CUBIC = "coulomb_friction", "cubic_stiffness"
ROOT, CRACK = "root_compliance", "breathing_crack"


def rig(drag=0.0, kind="laboratory", **changes):
    campaign, model = measured(drag, kind)
    channels = {name: replace(item, **changes) for name, item in campaign.channels.items()}
    return replace(campaign, channels=channels), model


def slow_friction(slow):
    friction = PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0)
    return replace(pushed(MODEL, (1.01, 0.9), friction, slow=slow), events=()), MODEL


def with_fault():
    campaign, model = rig()
    for trial in campaign.trials:
        if "displacement" in trial.channels:
            trial.values[:, trial.channels.index("displacement")] = 1.0
    return campaign, model


def compliant_root(share):
    """Return static trials of a chain whose root is more compliant, which a crack there resembles."""
    model = LumpedModel.load("three_mass_chain")
    return simulated(model, "static", 3, (ROOT, {"compliance_share": share}, "")), model


CAMPAIGNS = {
    "named": (lambda: rig(0.01), ("quadratic_damping", FRICTION)),
    "named without a noise record": (lambda: rig(0.01, noise=None), ("quadratic_damping",)),
    "named in part": (lambda: slow_friction(1.0), (FRICTION, "quadratic_damping")),
    "named of ring-downs": (lambda: rig(0.01, "ringdown"), ("quadratic_damping", FRICTION)),
    "without its effect": (lambda: rig(0.01), (FRICTION, CUBIC)),
    "a drift alone": (lambda: rig(0.01), ("stiffness_drift",)),
    "coloured remainder": (lambda: slow_friction(3.0), ("quadratic_damping",)),
    "nothing missing": (rig, (FRICTION, "quadratic_damping")),
    "wide gains": (lambda: rig(0.01, gain_deviation=0.3), ("quadratic_damping", "gauge_gain")),
    "two rivals": (lambda: rig(0.002), ("quadratic_damping", FRICTION, "structural_damping")),
    "data error": (with_fault, (FRICTION,)),
    "group": (lambda: compliant_root(0.11), (ROOT, CRACK)),
    "below limit": (lambda: compliant_root(0.05), (ROOT, CRACK)),
}
ENDS_IN = {"group": VerdictKind.GROUP, "below limit": VerdictKind.BELOW_LIMIT}
"""Kinds of verdict of campaigns that are there for these."""


@pytest.mark.parametrize("case", CAMPAIGNS)
def test_the_record_of_proof_is_what_the_residuals_show(case, tmp_path):
    """In thirteen campaigns: share and errors of sentence and file are those of residuals.nc."""
    made, effects = CAMPAIGNS[case]
    found = investigate(*made(), chosen(*effects), thorough=False)
    assert found.verdict.kind is ENDS_IN.get(case, found.verdict.kind), found.verdict.sentence
    write_verdict_folder(tmp_path / "verdict", ReportInput(found, ORIGIN), report=False)
    stored = read_verdict(tmp_path / "verdict")
    if stored.proof is None:
        assert found.fit is None or not found.fit.candidate.terms
        return
    proof, after = stored.proof, stored.residuals.held_out or stored.residuals
    before = found.before.held_out or found.before
    scores = proof.held_out_after or proof.fitted_after
    for name in after.channel_names:
        pairs = [
            (item.residual[:, item.column(name)], item.used[:, item.column(name)])
            for item in after.trials
            if name in item.trial.channels
        ]
        residual = np.concatenate([values[used] for values, used in pairs])
        assert scores.rms[name] == pytest.approx(np.sqrt(np.mean(residual**2)))
    if proof.closed is None:
        return
    noise = {item.trial.name: item.noise_deviation for item in before.trials}
    total = [
        sum(
            float(np.sum((item.residual / noise[item.trial.name])[item.used] ** 2))
            for item in residuals.trials
        )
        for residuals in (before, after)
    ]
    assert proof.closed.value == pytest.approx(1.0 - total[1] / total[0])
    assert not proof.has_grown
    if stored.verdict.kind in (VerdictKind.NAMED_IN_PART, VerdictKind.UNEXPLAINED):
        assert percent_with_interval(proof.closed) in stored.verdict.sentence
        old = proof.held_out_before or proof.fitted_before
        assert rms_errors_text(after.channels, old.rms, scores.rms) in stored.verdict.sentence


def test_a_hypothesis_with_which_the_error_grows_is_not_named():
    """The outcome of a search names an effect at ten times its size: nothing is named, nothing to apply."""
    found = investigate(*rig(0.01), chosen("quadratic_damping"), thorough=False)
    verdict, fit_of_name = found.verdict, found.fit
    assert verdict.kind is VerdictKind.NAMED
    candidate = fit_of_name.candidate
    values = candidate.add_step(fit_of_name.effect, np.full(candidate.parameter_count, 4.0))
    worse = fit(found.problem, candidate, replace(fit_of_name.point, effect=values), iterations=0)
    outcome = check_against_trials(VerdictOutcome(verdict, found.search, worse))
    assert outcome.verdict.kind is VerdictKind.UNEXPLAINED
    assert outcome.verdict.effects == outcome.verdict.resembles == ()
    assert outcome.fit is found.search.no_effect
    assert "larger (rms of" in outcome.verdict.sentence
