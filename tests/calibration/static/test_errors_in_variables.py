"""The exact posterior against brute force, an analytic case and simulated experiments."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from calibration.errors import OutsideValidityError, PosteriorError
from calibration.static.errors_in_variables import exact_posterior, log_likelihood, pair_log_likelihoods
from calibration.static.experiments import LoadDisplacementData, published_measurements
from calibration.static.posterior import GaussianPrior
from calibration.static.stiffness_curve import PUBLISHED_LINE, stiffness_line

DATA = published_measurements()
FACTORS = np.linspace(0.85, 1.2, 36)


@pytest.mark.parametrize("measure", ["displacement", "load", "ratio"])
def test_pair_likelihoods_equal_quadrature_over_the_true_displacement(measure):
    true = np.linspace(1e-5, 25e-3, 40_001)  # m
    k = PUBLISHED_LINE.stiffness(FACTORS)
    weight = {"displacement": np.ones_like(true), "load": np.ones_like(true), "ratio": true}[measure]
    brute = np.empty((DATA.count, FACTORS.size))
    for pair, (load, displacement) in enumerate(zip(DATA.load, DATA.displacement, strict=True)):
        of_displacement = norm.pdf(displacement, true, DATA.displacement_standard_deviation) * weight
        for index, stiffness in enumerate(k):
            of_load = norm.pdf(load, stiffness * true, DATA.load_standard_deviation)
            brute[pair, index] = np.trapezoid(of_load * of_displacement, true)
    if measure == "load":
        brute *= k
    if measure == "ratio":
        brute *= 575.2
        ours = pair_log_likelihoods(PUBLISHED_LINE, DATA, FACTORS, "ratio")
        assert ours == pytest.approx(np.log(brute), abs=1e-8)
    total = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, measure=measure)
    assert total == pytest.approx(np.log(brute).sum(axis=0), abs=1e-7)


@pytest.mark.parametrize("zero_offset", [0.0, 1e-4, 5e-3])
def test_a_shared_zero_offset_equals_the_full_covariance(zero_offset):
    expected = np.zeros(FACTORS.size)
    for index, k in enumerate(PUBLISHED_LINE.stiffness(FACTORS)):
        for run in DATA.run_indices:
            of_run = DATA.run == run
            count = int(of_run.sum())
            variance = DATA.load_standard_deviation**2 + (k * DATA.displacement_standard_deviation) ** 2
            covariance = variance * np.eye(count) + (k * zero_offset) ** 2
            residual = DATA.load[of_run] - k * DATA.displacement[of_run]
            expected[index] += multivariate_normal.logpdf(residual, np.zeros(count), covariance)
    ours = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, zero_offset_standard_deviation=zero_offset)
    assert ours == pytest.approx(expected, abs=1e-8)


def test_exact_displacements_on_a_line_give_the_conjugate_gaussian():
    data = dataclasses.replace(DATA, displacement_standard_deviation=0.0)
    prior = GaussianPrior()
    gradient, intercept = 575.2, 101.8
    information = 1.0 / prior.standard_deviation**2
    information += np.sum((gradient * data.displacement / data.load_standard_deviation) ** 2)
    pull = prior.mean / prior.standard_deviation**2
    pull += np.sum(gradient * data.displacement * (data.load - intercept * data.displacement)) / (
        data.load_standard_deviation**2
    )
    posterior = exact_posterior(data)
    assert posterior.mean == pytest.approx(pull / information, abs=1e-10)
    assert posterior.standard_deviation == pytest.approx(information**-0.5, rel=1e-8)


def test_published_pairs():
    posterior = exact_posterior(DATA)
    assert posterior.mean == pytest.approx(1.00797, abs=1e-5)
    assert posterior.standard_deviation == pytest.approx(0.01031, abs=1e-5)
    # The closed form of the paper's filter meets the paper's Table 1 to its last digit.
    ratio = exact_posterior(DATA, measure="ratio")
    assert f"{ratio.mean:.4f} {ratio.standard_deviation:.4f}" == "1.0073 0.0103"


def test_the_grid_does_not_matter():
    coarse, fine = exact_posterior(DATA, grid_size=301), exact_posterior(DATA, grid_size=8001)
    assert coarse.mean == pytest.approx(fine.mean, abs=1e-9)
    assert coarse.standard_deviation == pytest.approx(fine.standard_deviation, rel=1e-7)


@given(load_scale=st.floats(1e-4, 1e4), displacement_scale=st.floats(1e-4, 1e4))
@settings(max_examples=30, deadline=None)
def test_units_do_not_matter(load_scale, displacement_scale):
    data = LoadDisplacementData(
        load=DATA.load * load_scale,
        displacement=DATA.displacement * displacement_scale,
        run=DATA.run,
        load_standard_deviation=DATA.load_standard_deviation * load_scale,
        displacement_standard_deviation=DATA.displacement_standard_deviation * displacement_scale,
    )
    scale = load_scale / displacement_scale
    curve = stiffness_line(575.2 * scale, 101.8 * scale)
    posterior, reference = exact_posterior(data, curve=curve), exact_posterior(DATA)
    assert posterior.mean == pytest.approx(reference.mean, abs=1e-9)
    assert posterior.standard_deviation == pytest.approx(reference.standard_deviation, rel=1e-6)


@given(repeats=st.integers(1, 40), noise=st.floats(0.01, 10.0), factor=st.floats(0.7, 1.3))
@settings(max_examples=40, deadline=None)
def test_more_measurements_shrink_the_variance_and_never_beyond_the_prior(repeats, noise, factor):
    load = np.tile(DATA.load[:4], repeats)
    data = LoadDisplacementData(
        load=load,
        displacement=load / PUBLISHED_LINE.stiffness(factor),
        run=np.arange(load.size),
        load_standard_deviation=DATA.load_standard_deviation * noise,
        displacement_standard_deviation=DATA.displacement_standard_deviation * noise,
    )
    doubled = dataclasses.replace(
        data, load=np.tile(load, 2), displacement=np.tile(data.displacement, 2), run=np.arange(2 * load.size)
    )
    posterior, narrower = exact_posterior(data), exact_posterior(doubled)
    assert narrower.standard_deviation < posterior.standard_deviation
    assert posterior.standard_deviation < 1.02 * GaussianPrior().standard_deviation
    assert np.all(np.isfinite(posterior.density))


def test_measurements_far_from_the_prior_are_followed():
    stiff = dataclasses.replace(
        DATA, displacement=DATA.load / PUBLISHED_LINE.stiffness(1.6), displacement_standard_deviation=1e-6,
        load_standard_deviation=1e-4,
    )  # fmt: skip
    posterior = exact_posterior(stiff)
    assert posterior.mean == pytest.approx(1.6, abs=1e-3)
    assert 0.0 < posterior.standard_deviation < 1e-3


def test_a_posterior_outside_the_curve_is_refused():
    curve = stiffness_line(575.2, 101.8, "narrow model", 0.9, 0.99)
    with pytest.raises(OutsideValidityError, match=r"outside \[0.9, 0.99\], where narrow model"):
        exact_posterior(DATA, curve=curve)


def test_senseless_options_are_refused():
    with pytest.raises(PosteriorError, match="zero offset"):
        log_likelihood(PUBLISHED_LINE, DATA, FACTORS, measure="ratio", zero_offset_standard_deviation=1e-4)


def test_intervals_cover_the_truth_on_virtual_wings():
    generator = np.random.default_rng(2021)
    prior = GaussianPrior()
    repetitions = 200
    covered = 0
    for _ in range(repetitions):
        truth = generator.normal(prior.mean, prior.standard_deviation)
        true_displacement = DATA.load / PUBLISHED_LINE.stiffness(truth)
        data = dataclasses.replace(
            DATA,
            load=DATA.load + generator.normal(0.0, DATA.load_standard_deviation, DATA.count),
            displacement=true_displacement
            + generator.normal(0.0, DATA.displacement_standard_deviation, DATA.count),
        )
        lower, upper = exact_posterior(data, grid_size=401).interval(0.90)
        covered += lower <= truth <= upper
    assert 0.85 <= covered / repetitions <= 0.95
