"""The joint posterior: enumeration and an independent sampler as oracles, limits, calibration, bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from calibration.errors import CalibrationError, ExperimentDataError, OutsideValidityError, PosteriorError
from calibration.joint.inference import infer
from calibration.joint.measurement import PUBLISHED_MODES, modal_readings
from calibration.joint.posterior import joint_posterior as joint_posterior_of
from calibration.joint.wing_table import MODEL_ERROR, WingTable, tabulate_wing, weighed, wing_priors
from calibration.result.record import STATE, ParameterPrior, prior_samples
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import published_measurements
from calibration.static.stiffness_curve import PUBLISHED_LINE, stiffness_curve_of, stiffness_line
from fe.runtime.modal_system import rayleigh_damping_ratio

FloatArray = NDArray[np.float64]

LIMITS = np.array([[0.85, 1.15], [0.05, 0.3], [0.0, 0.3]])
CENTRE = np.array([1.0, 0.169, 0.1345])
AT_CENTRE = np.log([5.632, 28.544])
SLOPE = np.array([[0.41, 0.325], [-0.94, -0.69], [-0.98, -0.64]])  # of ln f1, ln f2, as of the shipped wing
VALIDITY = dict(zip(STATE[:3], ((low, high) for low, high in LIMITS.tolist()), strict=True))
PRIORS = wing_priors(VALIDITY)
Priors = tuple[ParameterPrior, ...]
STATIC = published_measurements()
MODAL = PUBLISHED_MODES
TOTAL = weighed()


def modes(value=None, deviation=None):
    """The published modes, some of their values and deviations changed."""
    value, deviation = value or {}, deviation or {}
    return modal_readings(
        [value.get(item.name, item.value) for item in MODAL],
        [deviation.get(item.name, item.deviation) for item in MODAL],
    )


def joint_posterior(wing, static, modal, *, total_mass=TOTAL, **given):
    return joint_posterior_of(wing, static, (total_mass, *modal), **given)


def line_frequency(quantities):
    """Frequencies (N, 2) [Hz] of a wing whose logarithms are linear."""
    return np.exp(AT_CENTRE + (quantities - CENTRE) @ SLOPE)


def line_table():
    """The same wing as tables; the polynomial is exact."""
    half = 0.5 * np.diff(LIMITS, axis=1)[:, 0]
    middle = LIMITS.mean(axis=1)
    coefficient = np.zeros((2, 2, 2, 2))
    coefficient[0, 0, 0] = AT_CENTRE + (middle - CENTRE) @ SLOPE
    coefficient[1, 0, 0], coefficient[0, 1, 0], coefficient[0, 0, 1] = half[:, None] * SLOPE
    curve = stiffness_line(575.2, 101.8, lower=0.85, upper=1.15)
    return WingTable(LIMITS, coefficient, curve)


@pytest.fixture(scope="module")
def tables():
    return line_table()


def log_posterior(unknown, prior, modal):
    """Log of the joint density of e, masses, alpha, beta and both model errors, written with scipy.stats."""
    e, servo, pitot, alpha, beta, *errors = unknown.T
    inside = np.all((unknown[:, :3] >= LIMITS[:, 0]) & (unknown[:, :3] <= LIMITS[:, 1]), axis=1)
    inside &= (alpha >= 0.0) & (beta >= 0.0)
    total = np.where(inside, 0.0, -np.inf)
    for value, given_prior in zip((e, servo, pitot, alpha, beta), prior, strict=True):
        total += stats.norm.logpdf(value, given_prior.mean, given_prior.deviation)
    total += stats.norm.logpdf(2.0 * servo + pitot, 0.472, 1e-3)
    k = PUBLISHED_LINE.stiffness(e)
    for load, displacement in zip(STATIC.load, STATIC.displacement, strict=True):
        spread = np.sqrt(
            STATIC.load_standard_deviation**2 + (k * STATIC.displacement_standard_deviation) ** 2
        )
        total += stats.norm.logpdf(load - k * displacement, 0.0, spread)
    frequency = line_frequency(unknown[:, :3])
    omega = 2.0 * math.pi * frequency
    for mode, (error, tau) in enumerate(zip(errors, MODEL_ERROR, strict=True)):
        total += stats.norm.logpdf(error, 0.0, tau)
        total += stats.norm.logpdf(
            modal[mode].value, frequency[:, mode] * (1.0 + error), modal[mode].deviation
        )
        ratio = 0.5 * (alpha / omega[:, mode] + beta * omega[:, mode])
        total += stats.norm.logpdf(modal[2 + mode].value, ratio, modal[2 + mode].deviation)
    return np.asarray(total)


def stretch_sampler(prior, modal, steps):
    """Sample all seven unknowns by the affine-invariant stretch move (Goodman and Weare 2010)."""
    generator = np.random.default_rng(7)
    half, size = 120, 7
    walkers = np.column_stack(
        [
            generator.normal(1.0, 0.01, 2 * half),
            (servo := generator.normal(0.169, 0.01, 2 * half)),
            0.472 - 2.0 * servo + generator.normal(0.0, 1e-3, 2 * half),
            np.abs(generator.normal(1.0, 0.3, 2 * half)),
            np.abs(generator.normal(7e-4, 1e-4, 2 * half)),
            generator.normal(0.0, 0.01, 2 * half),
            generator.normal(0.0, 0.05, 2 * half),
        ]
    )
    value = log_posterior(walkers, prior, modal)
    kept = []
    for step in range(steps):
        for mine, others in ((slice(0, half), slice(half, None)), (slice(half, None), slice(0, half))):
            stretch = (1.0 + generator.random(half)) ** 2 / 2.0  # density ~ 1 / sqrt(z) on [1/2, 2]
            partner = walkers[others][generator.integers(half, size=half)]
            proposed = partner + stretch[:, None] * (walkers[mine] - partner)
            proposed_value = log_posterior(proposed, prior, modal)
            gain = (size - 1) * np.log(stretch) + proposed_value - value[mine]
            accept = np.log(generator.random(half)) < gain
            walkers[mine] = np.where(accept[:, None], proposed, walkers[mine])
            value[mine] = np.where(accept, proposed_value, value[mine])
        if step >= steps // 4:
            kept.append(walkers.copy())
    return np.concatenate(kept)


@pytest.mark.long
def test_an_independent_sampler_finds_the_same(tables):
    # Ratios that leave little for alpha: the cut at zero matters.
    modal = modal_readings(
        (MODAL[0].value, MODAL[1].value, 0.02, 0.08), (MODAL[0].deviation, MODAL[1].deviation, 0.004, 0.008)
    )
    result = joint_posterior(tables, STATIC, modal, count=8000)
    oracle = stretch_sampler(PRIORS, modal, 1200)[:, :5]
    found, spread = result.mean, result.standard_deviation
    assert np.mean(oracle[:, 3] < 0.1) > 0.03  # the cut is felt
    np.testing.assert_allclose(found, oracle.mean(axis=0), atol=0.06 * spread.max(), rtol=0.03)
    np.testing.assert_array_less(np.abs(found - oracle.mean(axis=0)), 0.08 * spread)
    np.testing.assert_allclose(spread, oracle.std(axis=0), rtol=0.06)
    np.testing.assert_allclose(
        np.corrcoef(result.samples, rowvar=False), np.corrcoef(oracle, rowvar=False), atol=0.06
    )
    np.testing.assert_allclose(
        np.quantile(result.samples, [0.05, 0.95], axis=0),
        np.quantile(oracle, [0.05, 0.95], axis=0),
        atol=0.15 * spread.max(),
        rtol=0.05,
    )


def test_enumeration_finds_mean_deviation_and_evidence(tables):
    # Damping priors far from zero, so that alpha and beta integrate in closed form.
    prior = wing_priors(VALIDITY, damping_alpha=(2.0, 0.3), damping_beta=(8e-4, 1e-4))
    result = joint_posterior(tables, STATIC, MODAL, priors=prior, count=2000)
    e = np.linspace(0.95, 1.07, 31)
    servo = np.linspace(0.09, 0.24, 61)
    total = np.linspace(0.466, 0.478, 25)
    grid = np.stack(np.meshgrid(e, servo, total, indexing="ij"), axis=-1).reshape(-1, 3)
    quantities = grid.copy()
    quantities[:, 2] -= 2.0 * grid[:, 1]
    inside = (quantities[:, 2] > 0.0) & (quantities[:, 2] < 0.3)
    quantities, grid = quantities[inside], grid[inside]
    log_density = np.zeros(len(grid))
    for place, given_prior in enumerate(prior[:3]):
        log_density += stats.norm.logpdf(quantities[:, place], given_prior.mean, given_prior.deviation)
        log_density -= math.log(
            np.diff(stats.norm.cdf(LIMITS[place], given_prior.mean, given_prior.deviation))[0]
        )
    log_density += stats.norm.logpdf(grid[:, 2], 0.472, 1e-3)
    k = PUBLISHED_LINE.stiffness(quantities[:, 0])
    spread = np.sqrt(STATIC.load_standard_deviation**2 + (k * STATIC.displacement_standard_deviation) ** 2)
    for load, displacement in zip(STATIC.load, STATIC.displacement, strict=True):
        log_density += stats.norm.logpdf(load - k * displacement, 0.0, spread)
    frequency = line_frequency(quantities)
    omega = 2.0 * math.pi * frequency
    for mode, tau in enumerate(MODEL_ERROR):
        log_density += stats.norm.logpdf(
            MODAL[mode].value, frequency[:, mode], np.hypot(MODAL[mode].deviation, tau * frequency[:, mode])
        )
    design = np.stack([0.5 / omega, 0.5 * omega], axis=2)
    ratios, deviations = np.array([(item.value, item.deviation) for item in MODAL[2:]]).T
    covariance = design @ np.diag([0.3**2, 1e-4**2]) @ np.swapaxes(design, 1, 2)
    covariance += np.diag(np.square(deviations))
    residual = ratios - design @ np.array([2.0, 8e-4])
    solved = np.linalg.solve(covariance, residual[..., None])[..., 0]
    log_density -= 0.5 * np.sum(residual * solved, axis=1)
    log_density -= 0.5 * np.linalg.slogdet(2.0 * math.pi * covariance)[1]
    weight = np.exp(log_density - log_density.max())
    cell = (e[1] - e[0]) * (servo[1] - servo[0]) * (total[1] - total[0])
    evidence = math.log(weight.sum() * cell) + log_density.max()
    weight /= weight.sum()
    mean = weight @ quantities
    deviation = np.sqrt(weight @ (quantities - mean) ** 2)
    assert result.log_evidence == pytest.approx(evidence, abs=0.02)
    np.testing.assert_array_less(np.abs(result.mean[:3] - mean), 0.02 * deviation)
    np.testing.assert_allclose(result.standard_deviation[:3], deviation, rtol=0.02)


def test_the_papers_posterior_is_the_limit_without_uncertainty(tables):
    """With f1, the ratios and the total exact, and f2 left out, masses follow e as in the paper."""
    exact = modal_readings([item.value for item in MODAL], (1e-5, 1.0, 1e-6, 1e-6))
    result = joint_posterior(
        tables,
        STATIC,
        exact,
        total_mass=weighed(0.472, 1e-7),
        model_error=(0.0, 0.5),
        priors=wing_priors(VALIDITY, servo_mass=(0.157, 1.0), pitot_mass=(0.157, 1.0)),
    )
    e, servo, pitot, alpha, beta = result.samples.T
    assert np.corrcoef(result.samples, rowvar=False)[1, 2] == pytest.approx(-1.0, abs=1e-6)
    assert np.corrcoef(result.samples, rowvar=False)[0, 1] == pytest.approx(-1.0, abs=1e-4)
    np.testing.assert_allclose(2.0 * servo + pitot, 0.472, atol=1e-6)
    # f1 is met exactly: along the weighed total its logarithm moves by (s1 - 2 s2) with the servo mass.
    along = SLOPE[1, 0] - 2.0 * SLOPE[2, 0]
    shift = math.log(5.6492) - AT_CENTRE[0] - SLOPE[0, 0] * (e - 1.0) - SLOPE[2, 0] * (0.472 - 0.4725)
    np.testing.assert_allclose(servo, 0.169 + shift / along, atol=2e-5)
    for row in range(0, 1000, 100):
        frequency = line_frequency(result.samples[row, :3])
        ratio = rayleigh_damping_ratio(alpha[row], beta[row], frequency)
        np.testing.assert_allclose(ratio, [item.value for item in MODAL[2:]], atol=1e-5)


def test_samples_repeat_and_follow_the_seed(tables):
    one, two = (joint_posterior(tables, STATIC, MODAL, seed=3, count=200) for _ in range(2))
    other = joint_posterior(tables, STATIC, MODAL, seed=4, count=200)
    assert one.samples.tobytes() == two.samples.tobytes()
    assert not np.array_equal(one.samples, other.samples)
    assert one.samples.shape == (200, 5)


def test_prior_samples_are_the_prior():
    drawn = prior_samples(PRIORS, 20_000, 1)
    assert drawn[:, 0].mean() == pytest.approx(1.0, abs=1e-3)
    assert drawn[:, 0].std() == pytest.approx(0.05 / 1.96, rel=0.02)
    assert drawn[:, 3].mean() == pytest.approx(3.0 * math.sqrt(2.0 / math.pi), rel=0.02)
    assert np.all(drawn[:, 3:] >= 0.0)
    assert np.all((drawn[:, :3] >= LIMITS[:, 0]) & (drawn[:, :3] <= LIMITS[:, 1]))


def simulate(generator, prior, model_error):
    """Draw a wing from the prior and measure it with Gaussian errors; the last are its displacements [m]."""
    truth = prior_samples(prior, 1, int(generator.integers(2**32)))[0]
    frequency = line_frequency(truth[None, :3])[0]
    ratio = rayleigh_damping_ratio(truth[3], truth[4], frequency)
    wing = frequency * (1.0 + np.array(model_error) * generator.standard_normal(2))
    deviations = (0.06, 0.3), (0.002, 0.004)
    measured = wing + deviations[0] * generator.standard_normal(2)
    measured_ratio = np.maximum(ratio + deviations[1] * generator.standard_normal(2), 1e-4)
    modal = modal_readings((*measured, *measured_ratio), (*deviations[0], *deviations[1]))
    scale = weighed(2.0 * truth[1] + truth[2] + 1e-3 * generator.standard_normal(), 1e-3)
    return truth, modal, scale, STATIC.load / PUBLISHED_LINE.stiffness(truth[0])


@pytest.mark.long
def test_the_truth_has_a_uniform_rank_among_the_samples(tables):
    """Simulation-based calibration: wings from the prior, with the assumed model error."""
    generator = np.random.default_rng(2021)
    prior = wing_priors(VALIDITY, damping_alpha=(1.0, 0.5), damping_beta=(7e-4, 3e-4))
    repetitions, count = 120, 99
    ranks = np.empty((repetitions, 5), dtype=int)
    held = np.zeros(5)
    for repetition in range(repetitions):
        truth, modal, scale, displacement = simulate(generator, prior, MODEL_ERROR)
        static = replace(
            STATIC,
            load=STATIC.load + generator.normal(0.0, STATIC.load_standard_deviation, STATIC.count),
            displacement=displacement
            + generator.normal(0.0, STATIC.displacement_standard_deviation, STATIC.count),
        )
        result = joint_posterior(
            tables, static, modal, priors=prior, total_mass=scale, seed=repetition, count=count
        )
        ranks[repetition] = np.sum(result.samples < truth, axis=0)
        lower, upper = np.quantile(result.samples, [0.05, 0.95], axis=0)
        held += (lower <= truth) & (truth <= upper)
    assert 0.85 < held.mean() / repetitions < 0.94
    assert np.all(held / repetitions > 0.79)
    for place in range(5):
        counted = np.histogram(ranks[:, place], bins=np.linspace(-0.5, count + 0.5, 9))[0]
        assert stats.chisquare(counted).pvalue > 1e-3, STATE[place]


def test_model_error_is_what_it_says(tables):
    """Without model error f2 drags the masses along; with it, f2 is left to miss by 4.5 %."""
    sharp = modes(deviation={"frequency_1": 0.001, "frequency_2": 0.03})
    allowed = joint_posterior(tables, STATIC, sharp)
    wide = joint_posterior(tables, STATIC, sharp, model_error=(0.02, 0.05))
    assert wide.standard_deviation[1] > 1.4 * allowed.standard_deviation[1]
    assert line_frequency(allowed.samples[:, :3])[:, 1].mean() == pytest.approx(28.6, abs=0.15)
    trusting = joint_posterior(tables, STATIC, MODAL, model_error=(0.0, 0.0))
    assert trusting.log_evidence < allowed.log_evidence - 0.5
    with pytest.raises(OutsideValidityError, match=r"pressed against 1\.15, where the model ends"):
        joint_posterior(tables, STATIC, sharp, model_error=(0.0, 0.0))


@settings(max_examples=15, deadline=None)
@given(
    first=st.floats(5.0, 6.5),
    ratio=st.floats(4.5, 5.6),
    zeta=st.floats(0.005, 0.1),
    error=st.floats(1e-4, 0.2),
    total=st.floats(0.2, 0.7),
)
def test_every_measurement_gives_a_posterior_or_a_clear_refusal(first, ratio, zeta, error, total):
    modal = modal_readings(
        (first, first * ratio, zeta, 0.05), (error * first, error * first * ratio, 0.2 * zeta, 0.01)
    )
    try:
        result = joint_posterior(line_table(), STATIC, modal, total_mass=weighed(total, 1e-3), count=100)
    except CalibrationError as refusal:
        known = "contradict" in str(refusal) or "negative Rayleigh" in str(refusal)
        if not known:
            raise
        return
    assert np.all(np.isfinite(result.samples))
    assert np.all((result.samples[:, :3] >= LIMITS[:, 0]) & (result.samples[:, :3] <= LIMITS[:, 1]))
    assert np.all(result.samples[:, 3:] >= 0.0)
    assert abs(2.0 * result.mean[1] + result.mean[2] - total) < 5e-3


@pytest.mark.parametrize(
    ("changed", "kind", "sentence"),
    [
        ({"count": 0}, PosteriorError, "must be positive, but 0 were asked"),
        ({"count": 10**40}, PosteriorError, "at most 100,000 samples"),
        ({"total_mass": weighed(2.0)}, ExperimentDataError, "cannot weigh 2 kg"),
        ({"total_mass": weighed(0.472, 0.0)}, ExperimentDataError, "weighed_mass and its standard"),
        ({"model_error": (0.01, 5.0)}, ExperimentDataError, "relative standard deviation from 0 to below 1"),
        ({"priors": wing_priors(VALIDITY, servo_mass=(5.0, 0.1))}, PosteriorError, "prior of servo_mass"),
        (
            {"static": replace(STATIC, displacement=STATIC.displacement * 0.7)},
            OutsideValidityError,
            "outside",
        ),
        (
            {"modal": modal_readings((5.6492, 29.9699, 0.01, 0.3), (0.06, 0.3, 1e-4, 1e-3))},
            ExperimentDataError,
            "negative Rayleigh coefficient",
        ),
    ],
)
def test_refusals(tables, changed, kind, sentence):
    with pytest.raises(kind, match=sentence):
        joint_posterior(tables, **{"static": STATIC, "modal": MODAL, **changed})


@pytest.mark.parametrize(
    ("value", "deviation", "sentence"),
    [
        ({"frequency_2": math.nan}, {}, "frequency_2 and its standard deviation must be positive"),
        ({"damping_ratio_2": 16.0}, {}, "damping ratio of 16 lets nothing swing"),
        ({"frequency_1": 30.0, "frequency_2": 5.6}, {}, "must lie below the second"),
        ({}, {"damping_ratio_1": 0.0}, "damping_ratio_1 and its standard deviation"),
    ],
)
def test_readings_that_cannot_be(value, deviation, sentence):
    with pytest.raises(ExperimentDataError, match=sentence):
        modes(value, deviation)


def test_a_table_is_asked_within_its_limits_alone(tables):
    with pytest.raises(OutsideValidityError, match=r"mass of each servo is 0\.4 kg, .* 0\.05 to 0\.3 kg"):
        tables.frequency([[1.0, 0.4, 0.1]])


def test_any_model_is_inferred():
    """Two lines through one point: the posterior of a linear model is the Gaussian of its closed form."""
    priors = tuple(ParameterPrior(name, "1", 1.0, 2.0, -50.0, 50.0, "here") for name in "ab")
    design, read, spread = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-4]]), np.array([3.0, 3.0002]), 1e-5
    found = infer(priors, lambda ab: (read - ab @ design.T, np.full((len(ab), 2), spread)), count=4000)
    precision = design.T @ design / spread**2 + np.eye(2) / 4.0
    mean = np.linalg.solve(precision, design.T @ read / spread**2 + 0.25)
    deviation = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(found.mean, mean, atol=0.02 * deviation.max())
    np.testing.assert_allclose(found.standard_deviation, deviation, rtol=0.02)
    assert found.effective > 0.8 * found.proposals
    covariance = design @ (4.0 * np.eye(2)) @ design.T + spread**2 * np.eye(2)
    expected = stats.multivariate_normal.logpdf(read, design @ np.ones(2), covariance)
    assert found.log_evidence == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_our_wing():
    from fe.reduction.model_cache import reduced_model

    model = reduced_model()
    wing = tabulate_wing(model)
    assert wing.error < 1e-5
    generator = np.random.default_rng(5)
    points = wing.limits[:, 0] + generator.random((20, 3)) * np.diff(wing.limits)[:, 0]
    for point, found in zip(points.tolist(), wing.frequency(points), strict=True):
        shapes = model.modes(
            young_modulus_factor=point[0], stiffness_loss=(0.0, 0.0), servo_mass=point[1], pitot_mass=point[2]
        )
        np.testing.assert_allclose(found, shapes.frequency[list(shapes.followed)], rtol=1e-5)
    result = joint_posterior(wing, STATIC, MODAL)
    mean, deviation = result.mean, result.standard_deviation
    # Within a tenth of its deviation e is what the load test alone says; the masses follow from f1 there.
    alone = exact_posterior(
        STATIC, curve=stiffness_curve_of(model.tip_stiffness, model.validity["young_modulus_factor"])
    )
    assert mean[0] == pytest.approx(alone.mean, abs=0.1 * alone.standard_deviation)
    assert mean[1:3] == pytest.approx([0.1685, 0.135], abs=2e-3)
    assert deviation[1] == pytest.approx(0.0142, abs=5e-4)
    assert mean[3] == pytest.approx(1.033, abs=0.02)
    assert mean[4] == pytest.approx(7.58e-4, rel=0.02)
    assert result.effective > 15_000
