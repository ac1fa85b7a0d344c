"""Fits against dense linear algebra: Jacobian, evidence, posterior, leverage; and from far off."""

from dataclasses import dataclass, replace
from math import inf, log, pi

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, trapezoid
from scipy.stats import multivariate_normal, norm

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.entry import Prior
from discrepancy.errors import DiscrepancyError, FitError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, fit, try_fit
from discrepancy.fits.normal_equations import cholesky_factor
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.trial_data import shared_unknowns
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PowerStiffness
from tests.costs import once
from tests.discrepancy.rigs import FloatArray, measured
from tests.refusals import Inputs

from . import kit

STEP = 1e-4
TOLERANCE = 0.01  # of the norm of a column: at rest, steps by nuisances are one-sided, 1e-2 of a deviation
CENTRAL = 1e-3  # by effects no curvature is in them: of frequencies nuisances leave less than that errs by
BOTH = Candidate((kit.OFFSET, kit.DRIFT))


def coloured_record():
    samples = 0.02 * np.sqrt(0.51) * kit.coloured(np.random.default_rng(11), (0.7,), 3000)
    return NoiseRecord(float(samples.std()), 2999.0, samples, 0.01, "pre-trigger")


# ---------------------------------------------------------------- derivatives


def check(problem, candidate, effect=None, tolerance=TOLERANCE, spread=0.5):
    """Compare every column of the Jacobian with central differences of the residual."""
    linear = kit.Linear(problem, candidate)
    x = spread * np.random.default_rng(1).standard_normal(linear.size)
    if effect is not None:
        x[problem.shared.unknown_count : problem.shared.unknown_count + candidate.parameter_count] = effect
    point = linear.point(x)
    steps = STEP * np.eye(linear.size)
    numerical = np.stack([(linear.residual(x - e) - linear.residual(x + e)) / (2.0 * STEP) for e in steps])
    columns = np.zeros_like(numerical)
    at, first = 0, problem.shared.unknown_count + candidate.parameter_count
    for number, data in enumerate(problem.trials):
        parts = problem.linearise(number, point, candidate)
        found, index = problem.prediction_derivatives(number, point, parts, candidate)
        rows = data.standardise(found).reshape(len(found), -1)
        local, shared = np.split(rows, [data.unknowns.unknown_count])
        counts = (data.weight > 0.0).ravel()
        assert np.all(local[:, ~counts] == 0.0)
        assert np.all(shared[:, ~counts] == 0.0)
        stop = at + int(counts.sum())
        columns[index, at:stop] = shared[:, counts]
        columns[first : first + len(local), at:stop] = local[:, counts]
        at, first = stop, first + len(local)
    limits = np.full(linear.size, tolerance)
    if tolerance == TOLERANCE:
        limits[problem.shared.unknown_count : problem.shared.unknown_count + candidate.parameter_count] = (
            CENTRAL
        )
    for number, (have, want) in enumerate(zip(columns, numerical, strict=True)):
        error = np.linalg.norm(have - want)
        assert error <= limits[number] * np.linalg.norm(want) + 1e-9, f"unknown {number}: {error}"


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize("noise", [kit.NOISE, coloured_record()], ids=["white", "coloured"])
def test_derivatives_by_all_unknowns_of_the_closed_form(at_rest, noise):
    """Parameters, gains, zeros, initial state, time zero, health of every load level, effect."""
    problem = kit.closed_problem(
        bent=True, noise=noise, gain_deviation=0.1, health=True, at_rest=at_rest, time_zero=0.003,
        left_out={0: ((2, 1),), 2: ((0, 0), (30, 2), (59, 1))}, samples=80,
    )  # fmt: skip
    applies = noise.samples is not None
    assert all(problem.noise_models[name].can_whiten(0.01) is applies for name in problem.channel_names)
    check(problem, BOTH)


@pytest.mark.parametrize(("free", "tolerance"), [(False, TOLERANCE), (True, 0.06)])
def test_derivatives_by_an_effect_on_the_chain(free, tolerance):
    """A law of speed, and its exponent."""
    candidate = Candidate((EffectTerm(kit.chosen("quadratic_damping")[0], "end", free_shape=free),))
    about, spread = (candidate.start_values() + 0.1, 0.2) if free else (0.3, 0.3)
    check(kit.BENCH.problem(1), candidate, effect=about, spread=spread, tolerance=tolerance)


def test_samples_that_do_not_count_change_nothing():
    """Readings left out, and what the whitening filter smears of them, weigh zero whatever they are."""
    problem = kit.closed_problem(noise=coloured_record(), left_out={2: ((30, 1), (31, 1)), 0: ((3, 0),)})
    wild = tuple(
        replace(trial, values=np.where(trial.used, trial.values, 1e6)) for trial in problem.campaign.trials
    )
    other = kit.problem_of(replace(problem.campaign, trials=wild), problem.model)
    linear = kit.Linear(problem)
    point = linear.point(0.3 * np.random.default_rng(0).standard_normal(linear.size))
    for number in range(len(problem.trials)):
        first, second = (
            p.standardised_residual(number, point, p.response_of_candidate(number, point, Candidate()))
            for p in (problem, other)
        )
        np.testing.assert_allclose(first, second, atol=1e-9)
    # nor are they counted as residuals of nought
    for data, item in zip(problem.trials, residual_set(problem, kit.fitted(problem)).trials, strict=True):
        np.testing.assert_array_equal(item.used, data.weight > 0.0)


@pytest.mark.parametrize(("kinds", "factor"), [(("static", "ringdown"), -37.0), (("ringdown",), 37.0)])
def test_a_signal_of_unknown_scale_is_fitted_as_one_whose_scale_is_known(kinds, factor):
    """At rest its sign is seen; of what is let go it is that of the release."""
    problem = kit.closed_problem(seed=4, kinds=kinds, at_rest=len(kinds) > 1, samples=200)
    channels = dict(problem.campaign.channels)
    noise, zero = NoiseRecord(37.0 * 0.02, inf), 37.0 * channels["y2"].offset_deviation
    channels["y2"] = replace(channels["y2"], gain_deviation=inf, noise=noise, offset_deviation=zero)
    trials = tuple(
        replace(trial, values=trial.values * [factor if name == "y2" else 1.0 for name in trial.channels])
        for trial in problem.campaign.trials
    )
    scaled = kit.problem_of(replace(problem.campaign, channels=channels, trials=trials), problem.model)
    found, known = kit.fitted(scaled), kit.fitted(problem)
    assert found.converged
    assert -1.0 < known.chi_square - found.chi_square < 12.0
    np.testing.assert_allclose(found.point.shared[:2], known.point.shared[:2], atol=0.3)
    assert abs(found.point.shared[2]) < 0.7  # the scale is that of the start but for noise and zeros


# ---------------------------------------------------------------- evidence and posterior


@dataclass(frozen=True)
class GaussianCase:
    """A fit of a problem that is linear, and its dense matrices: residual = y - A x."""

    fit: CandidateFit
    linear: kit.Linear
    y: FloatArray
    a: FloatArray
    hessian: FloatArray

    @property
    def covariance(self):
        return np.linalg.inv(self.hessian)


@once
def gaussian_case(terms, zero_deviation, at_rest):
    """Return a fit where two readings are left out, by terms, deviation of the zeros and beginning."""
    problem = kit.closed_problem(
        seed=3,
        effect=0.1,
        offset_deviation=zero_deviation,
        at_rest=at_rest,
        left_out={2: ((4, 1), (17, 0))},
    )
    found = kit.fitted(problem, *terms)
    linear = kit.Linear(problem, found.candidate)
    return GaussianCase(found, linear, *linear.dense())


GAUSSIAN_CASES = pytest.mark.parametrize(
    ("terms", "zero_deviation", "at_rest"),
    [
        ((), 0.05, True),
        ((kit.OFFSET,), 0.05, True),
        ((kit.OFFSET, kit.DRIFT), 0.05, True),
        ((kit.OFFSET, kit.DRIFT), 0.05, False),
        ((), inf, True),
    ],
)


@GAUSSIAN_CASES
def test_the_point_of_a_fit_is_the_gaussian_mean(terms, zero_deviation, at_rest):
    case = gaussian_case(terms, zero_deviation, at_rest)
    point = case.fit.point
    mean = np.linalg.solve(case.hessian, case.a.T @ case.y)
    error = np.concatenate((point.shared, point.effect, *point.local)) - mean
    assert case.fit.converged
    # a fit ends where a step promises less than CONVERGED, 0.01 nats
    assert float(error @ case.hessian @ error) < 0.02


@GAUSSIAN_CASES
def test_the_covariance_of_shared_unknowns_and_effects_is_the_gaussian_one(terms, zero_deviation, at_rest):
    case = gaussian_case(terms, zero_deviation, at_rest)
    count = case.linear.problem.shared.unknown_count + len(terms)
    exact = case.covariance[:count, :count]
    np.testing.assert_allclose(case.fit.covariance, exact, rtol=1e-6, atol=1e-12)


@GAUSSIAN_CASES
def test_the_freedom_that_the_unknowns_took_is_the_leverage(terms, zero_deviation, at_rest):
    """By channel, in the dense hat matrix; its sum is the number of unknowns less what priors fix."""
    case = gaussian_case(terms, zero_deviation, at_rest)
    leverage = np.einsum("ni,ij,nj->n", case.a, case.covariance, case.a)
    by_channel = np.bincount(case.linear.groups, leverage, minlength=3)
    in_all = case.linear.size - case.covariance.diagonal() @ case.linear.precision
    np.testing.assert_allclose(case.fit.absorbed_freedom, by_channel, rtol=1e-8)
    assert case.fit.absorbed_freedom.sum() == pytest.approx(in_all, rel=1e-8)
    assert case.linear.problem.sample_counts.sum() == len(leverage)


@GAUSSIAN_CASES
def test_evidence_is_the_gaussian_one(terms, zero_deviation, at_rest):
    """Free zeros are least squares: their evidence is beside that of another hypothesis only."""
    case = gaussian_case(terms, zero_deviation, at_rest)
    if zero_deviation == inf:
        assert 0.0 in case.linear.precision
        return
    count = len(case.y)
    exact = multivariate_normal(np.zeros(count), np.eye(count) + case.a @ case.a.T).logpdf(case.y)
    assert case.fit.log_evidence - 0.5 * count * log(2.0 * pi) == pytest.approx(exact, abs=0.01)


def test_evidence_with_flat_priors_is_the_limit_of_wide_ones():
    """A flat zero adds a constant to every hypothesis: differences are those of wide priors."""
    flat = kit.closed_problem(seed=9, offset_deviation=inf)
    channels = {name: replace(item, offset_deviation=100.0) for name, item in flat.campaign.channels.items()}
    term = EffectTerm(kit.drift_effect(exponent=3.0, deviation=0.1), "y2")
    one, other = (
        kit.fitted(problem, term).log_evidence - kit.fitted(problem).log_evidence
        for problem in (flat, kit.problem_of(replace(flat.campaign, channels=channels), flat.model))
    )
    assert abs(one) > 0.1
    assert one == pytest.approx(other, abs=0.02)


@pytest.mark.parametrize("freedom", [8.0, 50.0, 0.0])
def test_evidence_with_unknown_variance_against_quadrature(freedom):
    """One unknown (an offset), everything else exact: the evidence is an integral over one number."""
    problem = kit.closed_problem(
        seed=2, effect=0.05, offset_deviation=0.0, kinds=("static",),
        parameters={"slope": (1.0, 1e-9), "curvature": (0.5, 1e-9)},
        noise=NoiseRecord(0.02, freedom) if freedom else None,
    )  # fmt: skip
    found = kit.fitted(problem, EffectTerm(kit.offset_effect(deviation=0.1), "y1"))
    linear = kit.Linear(problem, found.candidate)

    def log_joint(u):
        x = np.zeros(linear.size)
        x[problem.shared.unknown_count] = u
        sums = np.bincount(linear.groups, linear.residual(x) ** 2, minlength=3)
        return -problem.misfit(sums) - 0.5 * u * u - 0.5 * log(2.0 * pi)

    centre, width = found.point.effect[0], float(np.sqrt(found.effect_covariance[0, 0]))
    top = log_joint(centre)
    area, _ = quad(lambda u: np.exp(log_joint(u) - top), centre - 12.0 * width, centre + 12.0 * width)
    # parameters that are known exactly leave their unit prior to the evidence: nothing
    assert found.log_evidence == pytest.approx(top + log(area), abs=0.06)


# ---------------------------------------------------------------- far from the truth


def test_a_curvature_that_is_none_is_refused():
    for wrong in (np.nan, np.inf, -1.0):
        with pytest.raises(FitError, match=r"not finite|singular"):
            cholesky_factor(np.diag([1.0, wrong]))


# ---------------------------------------------------------------- candidates that no fit can follow


def softening(coefficient, reference):
    """A spring of the ninth power that overtakes the rig's own far below its largest motion."""

    def build(setting, values, place):
        port = setting.scales.ports[place]
        size = coefficient * values["stiffening"] * port.stiffness * port.displacement
        return ModelPatch((PowerStiffness(place, size, 9.0, 0, reference * port.displacement),))

    (cubic,) = kit.chosen("cubic_stiffness")
    sizes = (replace(cubic.parameters[0], prior=Prior("normal", -30.0, 30.0)),)
    return EffectTerm(
        replace(cubic, identifier="ninth_power", build=build, parameters=sizes, shape=()), "slide"
    )


@pytest.fixture(scope="module")
def problem():
    return kit.problem_of(*measured(0.02))


@given(
    u=st.floats(-8.0, 8.0),
    coefficient=st.sampled_from([-1.0, 1.0, 1e100]),
    reference=st.sampled_from([0.01, 0.3]),
    iterations=st.sampled_from([0, 4]),
)
@example(u=-2.66, coefficient=-1.0, reference=0.01, iterations=0)
@settings(max_examples=12, deadline=None)
def test_a_fit_ends_with_finite_numbers_or_a_sentence(problem, u, coefficient, reference, iterations):
    candidate = Candidate((softening(coefficient, reference),))
    start = replace(problem.prior_mean_point(candidate), effect=np.array([u]))
    try:
        found = fit(problem, candidate, start, iterations=iterations)
    except DiscrepancyError:
        assert try_fit(problem, candidate, start, iterations=iterations) is None
        assert problem.refusals["ninth_power"].endswith(".")
        return
    numbers = np.append(found.covariance, found.log_evidence)
    assert np.all(np.isfinite(numbers))


@pytest.fixture(scope="module")
def verdict_beside_an_explosive_effect():
    explosive = effects_of_file(Inputs(__file__).folder / "explosive.toml")
    campaign, model = measured(0.02)
    effects = [*kit.chosen("quadratic_damping"), *explosive]
    return investigate(campaign, model, effects, thorough=False).verdict


def test_a_search_goes_on_where_an_effect_could_not_be_fitted(verdict_beside_an_explosive_effect):
    verdict = verdict_beside_an_explosive_effect
    assert verdict.kind is VerdictKind.NAMED
    assert [effect.identifier for effect in verdict.effects] == ["quadratic_damping"]


def test_a_search_tells_what_could_not_be_fitted(verdict_beside_an_explosive_effect):
    (not_fitted,) = verdict_beside_an_explosive_effect.not_fitted
    assert not_fitted.identifier == "explosive"
    assert not_fitted.reason.startswith("could not be fitted: ")
    assert not_fitted.reason.endswith("is not a finite number at every time.")


GAIN = 137.0
"""Gain of the only sensor, which is not stated [V/m]."""


def layout_of_a_free_gain(kind):
    """Return the layout of the shared unknowns of one trial of a signal of unknown scale."""
    trials = (Trial.plain("the trial", kind, ("y1",), 0.01 * np.arange(50.0)),)
    channel = Channel("y1", Quantity.SIGNAL, "y1", kit.NOISE, inf, 0.0)
    campaign = Campaign("rig", {"y1": channel}, trials, None, {}, "")
    return shared_unknowns(campaign, kit.ClosedForm(), trials, {"y1": GAIN})


def test_a_free_gain_is_an_unknown_where_a_recorded_force_sets_the_scale():
    layout = layout_of_a_free_gain(TrialKind.DRIVEN)

    assert layout.gain_channels == ("y1",)
    assert layout.fixed_gain == {}
    assert layout.precision[-1] == 0.0


def test_a_free_gain_is_fixed_where_only_releases_of_unknown_amplitude_show_it():
    layout = layout_of_a_free_gain(TrialKind.RINGDOWN)

    assert layout.fixed_gain == {"y1": GAIN - 1.0}
    assert layout.gain_channels == ()


class HealthySteps:
    """Three readings of a closed form whose losses are zero, with a prior deviation of 0.1."""

    def __init__(self, seed: int) -> None:
        force = np.array([0.5, 1.0, 2.0])
        deviation = np.array([[0.1, 0.0]] * 3)
        trial = kit.blank_trial("steps", TrialKind.STATIC, kit.OUTPUTS, force, health_deviation=deviation)
        noise = 0.02 * np.random.default_rng(seed).standard_normal((3, 3))
        values = force[:, None] * kit.STATIC_SHAPES[0] + noise
        channels = {
            name: Channel(name, Quantity.DISPLACEMENT, name, NoiseRecord(0.02, inf)) for name in kit.OUTPUTS
        }
        parameters = {"curvature": (0.0, 0.0)}
        trials = (replace(trial, values=values),)
        bare = Campaign("steps", channels, trials, None, parameters, "")
        self.problem = kit.problem_of(bare, kit.ClosedForm(bent=True))

    def log_likelihoods(self, slope: float, loss: float) -> FloatArray:
        """Return the log likelihood of each reading row (3,) at a scaled slope and a loss."""
        point = Point(np.array([slope, 0.0]), (np.full(3, loss / 0.1),), np.empty(0))
        response = self.problem.response_of_candidate(0, point, Candidate())
        residual = self.problem.standardised_residual(0, point, response)
        return -0.5 * (residual**2).sum(axis=1)

    def log_evidence(self) -> float:
        """Return the log evidence by quadrature over the slope and, at each slope, over each loss."""
        slopes = np.linspace(-4.0, 4.0, 41)
        losses = np.linspace(0.0, 0.5, 61)
        integrals = []
        for slope in slopes:
            rows = np.array([self.log_likelihoods(slope, loss) for loss in losses])
            joint = np.exp(rows) * norm.pdf(losses, scale=0.1)[:, None]
            integrals.append(norm.pdf(slope) * trapezoid(joint, losses, axis=0).prod())
        return float(np.log(trapezoid(integrals, slopes)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_evidence_counts_no_loss_below_zero(seed):
    steps = HealthySteps(seed)

    fit = kit.fitted(steps.problem)

    assert fit.log_evidence == pytest.approx(steps.log_evidence(), abs=0.1)
