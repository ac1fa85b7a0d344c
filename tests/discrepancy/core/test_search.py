"""Fits from far off: phases that slip, valleys, other optima, and errors too small to be names."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from discrepancy.campaign.records import NoiseRecord
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.entry import Prior
from discrepancy.errors import DiscrepancyError, FitError
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import attempt, fit
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.screening import Screen
from discrepancy.judgement.separability import _distance
from discrepancy.location.locate import locate
from discrepancy.search.honest_evidence import left_by, refitted, widened
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PowerStiffness
from tests.discrepancy.rigs import measured
from tests.refusals import Inputs

from . import kit

# ---------------------------------------------------------------- candidates that no fit can follow


def softening(coefficient, reference):
    """A spring of the ninth power that overtakes the rig's own far below its largest motion."""

    def build(setting, values, place):
        port = setting.scales.ports[place]
        size = coefficient * values["stiffening"] * port.stiffness * port.displacement
        return ModelPatch((PowerStiffness(place, size, 9.0, 0, reference * port.displacement),))

    (cubic,) = kit.chosen("cubic_stiffness")
    sizes = (replace(cubic.parameters[0], prior=Prior("normal", -30.0, 30.0)),)
    return Term(replace(cubic, identifier="ninth_power", build=build, parameters=sizes, shape=()), "slide")


@pytest.fixture(scope="module")
def problem():
    return kit.problem_of(*measured("quadratic_damping", 0.02))


@given(
    u=st.floats(-8.0, 8.0), coefficient=st.sampled_from([-1.0, 1.0, 1e100]),
    reference=st.sampled_from([0.01, 0.3]), iterations=st.sampled_from([0, 4]),
)  # fmt: skip
@example(u=-2.66, coefficient=-1.0, reference=0.01, iterations=0)
@settings(max_examples=12, deadline=None)
def test_a_fit_ends_with_finite_numbers_or_a_sentence(problem, u, coefficient, reference, iterations):
    candidate = Candidate((softening(coefficient, reference),))
    start = replace(problem.start(candidate), effect=np.array([u]))
    try:
        found = fit(problem, candidate, start, iterations=iterations)
    except DiscrepancyError:
        assert attempt(problem, candidate, start, iterations=iterations) is None
        assert problem.refusals["ninth_power"].endswith(".")
        return
    assert np.isfinite(found.log_evidence)
    assert np.all(np.isfinite(found.covariance))


def test_what_a_model_can_follow_only_while_it_is_small(problem):
    """It has been outdone by others and is no refusal; the last point that can be followed is compared."""
    none = kit.fitted(problem)
    screen = Screen(problem, none)
    for coefficient, kept in ((-1e-7, 1), (-1e-5, 0)):
        term = softening(coefficient, 0.3)
        problem.refusals.clear()
        assert len(list(Screen(problem, none).changes(term))) == kept
        assert len(problem.refusals) == 1 - kept
    problem.refusals.clear()
    problem.refused(Candidate((term, term)), FitError("Of two, either may be to blame."))
    assert not problem.refusals
    term = softening(-4.5e-8, 0.3)
    last = screen.change(term, np.array([1.0]))
    with pytest.raises(DiscrepancyError):
        screen.change(term, np.array([1.1]))
    assert last.size > 0.0
    assert _distance(screen, last, [last]) == pytest.approx(0.0, abs=1e-5 * last.size)


def test_a_search_tells_what_could_not_be_fitted_and_goes_on():
    effects = [*kit.chosen("quadratic_damping"), *effects_of_file(Inputs(__file__).folder / "explosive.toml")]
    campaign, model = measured("quadratic_damping", 0.02)
    verdict = investigate(campaign, model, effects, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED
    assert [effect.identifier for effect in verdict.effects] == ["quadratic_damping"]
    (left,) = verdict.not_fitted
    assert left.identifier == "explosive"
    assert left.reason.startswith("could not be fitted: ")
    assert left.reason.endswith("is not a finite number at every time.")


# ---------------------------------------------------------------- what is left beside the noise


def ringing(seed, samples, extra=None, **given):
    """Return ring-downs with something added to the first channel, and what their fit leaves."""
    problem = kit.closed_problem(seed=seed, kinds=("ringdown",), samples=samples, extra=extra, **given)
    none = kit.fitted(problem)
    return problem, none, left_by(problem, none)


def covariance(time, size, tau, frequency):
    lag = np.abs(time[:, np.newaxis] - time)
    return np.asarray(size**2 * np.exp(-lag / tau) * np.cos(frequency * lag) + 1e-9 * np.eye(len(time)))


def coloured(size, tau, frequency, seed=8):
    """Return what adds an exact draw of a remainder to the first channel of every trial, noise 0.02."""
    generator = np.random.default_rng(seed)

    def extra(rows):
        root = np.linalg.cholesky(covariance(0.01 * rows, size, tau, frequency))
        return np.asarray(0.02 * root @ generator.standard_normal(len(rows)))

    return extra


@pytest.mark.parametrize("freedom", [inf, 400.0])
def test_white_noise_has_no_remainder(freedom):
    """Forty campaigns of three channels: none has one, and fits stay as they were."""
    wrong = 0
    for seed in range(40):
        problem, found, left = ringing(seed, 150, noise=NoiseRecord(0.02, freedom))
        wrong += left.acts
        assert np.all(left.factor >= 1.0)
        if seed == 0:
            assert refitted(problem, widened(problem, left), found) is found
    assert wrong <= 1


@pytest.mark.parametrize(
    ("size", "tau", "frequency"), [(3.0, 0.15, 0.0), (2.0, 1.5, 9.0), (np.sqrt(0.2), 1e-6, 0.0)]
)
def test_size_time_and_frequency_are_found(size, tau, frequency):
    """And of white noise a fifth above its record a size, and no time over which it forgets."""
    problem, _, left = ringing(4, 900, coloured(size, tau, frequency))
    first = problem.channel_names.index("y1")
    over_noise = np.sqrt(np.mean([data.trial.noise_factor**-2 for data in problem.trials]))
    assert left.size[first] == pytest.approx(size * over_noise, rel=0.2)
    assert left.time[first] == pytest.approx(tau, rel=0.6, abs=0.04)
    assert 2.0 * np.pi * left.frequency[first] == pytest.approx(frequency, abs=1.0)
    assert np.all(np.delete(left.size, first) == 0.0)
    assert not left.is_noise


def test_evidence_under_a_wider_noise_is_that_of_a_campaign_with_such_noise():
    """Optimum, covariance and evidence are those of the same campaign whose records say so."""
    problem, none, left = ringing(4, 300, coloured(3.0, 0.15, 0.0))
    found = refitted(problem, widened(problem, left), none)
    names = problem.campaign.channels
    said = kit.fitted(kit.with_noise(
        problem, **{key: NoiseRecord(0.02 * float(f), inf) for key, f in zip(names, left.factor, strict=True)}
    ))  # fmt: skip
    np.testing.assert_allclose(found.point.shared, said.point.shared, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.covariance, said.covariance, rtol=1e-3, atol=1e-9)
    assert found.log_evidence == pytest.approx(said.log_evidence, abs=0.05)
    assert found.chi_square > 3.0 * said.chi_square  # told against the recorded noise


def test_colour_of_the_noise_is_told_from_a_remainder():
    """The same process in the trials, in the noise record or not."""
    generator = np.random.default_rng(5)
    time = 0.01 * np.arange(200)
    root = np.linalg.cholesky((covariance(time, 1.5, 0.03, 0.0) + np.eye(200)) / (1.0 + 1.5**2))
    scale = 0.02 * np.sqrt(1.0 + 1.5**2)
    for of_noise in (True, False):
        white = generator.standard_normal(len(time))
        samples = scale * root @ white if of_noise else 0.02 * white
        record = NoiseRecord(float(samples.std()), 199.0, samples - samples.mean(), 0.01, "pre-trigger")
        problem, _, _ = ringing(6, 400, coloured(1.5, 0.03, 0.0))
        problem = kit.with_noise(problem, y1=record)
        left = left_by(problem, kit.fitted(problem))
        size = left.size[problem.channel_names.index("y1")]
        # what the record's own autoregression took out is no remainder, nor is what it left
        assert size == (0.0 if of_noise else pytest.approx(1.5, rel=0.5))
        assert left.is_noise is of_noise


def test_colour_of_the_noise_is_no_gap_where_stamps_are_uneven_and_it_stays():
    generator, wrong = np.random.default_rng(5), [0, 0]
    time = 0.01 * np.arange(500)
    root = np.linalg.cholesky((covariance(time, 1.5, 0.03, 0.0) + np.eye(500)) / (1.0 + 1.5**2))
    for seed in range(12):
        samples = 0.02 * np.sqrt(1.0 + 1.5**2) * root @ generator.standard_normal(len(time))
        record = NoiseRecord(float(samples.std()), 499.0, samples - samples.mean(), 0.01, "pre-trigger")
        problem, _, _ = ringing(seed, 400, coloured(1.5, 0.03, 0.0, seed))
        trials = (item.rows(np.sort(generator.permutation(400)[:320])) for item in problem.campaign.trials)
        problem = kit.problem_of(replace(problem.campaign, trials=tuple(trials)), problem.model)
        problem = kit.with_noise(problem, y1=record)
        found = kit.fitted(problem)
        wrong[0] += absolute_gate(problem, replace(found, remainder=left_by(problem, found))).passed is False
        located = locate(residual_set(problem, found))
        assert all(cell.channel != "y1" for cell in located.cells)
        wrong[1] += located.disagrees
    assert max(wrong) <= 1
