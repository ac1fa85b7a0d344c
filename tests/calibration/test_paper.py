"""The load test: densities on a grid, the exact posterior; the paper's filter, its masses, its figures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from calibration.errors import ExperimentDataError, OutsideValidityError, PosteriorError
from calibration.joint.measured_modes import PUBLISHED_MODES
from calibration.joint.wing_table import TOTAL_MASS, weighed
from calibration.paper.load_test import calibrate_static, particle_filter
from calibration.paper.procedure import fit_masses
from calibration.static.errors_in_variables import assess_fit, exact_posterior, log_likelihood
from calibration.static.experiments import published_measurements
from calibration.static.posterior import (
    PUBLISHED_LINE,
    TABLE_TOLERANCE,
    GaussianPrior,
    ScalarPosterior,
    stiffness_curve_of,
    stiffness_line,
)
from tests.refusals import Inputs

DATA = published_measurements()


def test_table_1_of_the_paper():
    """And the same seed gives the same bits."""
    posterior = particle_filter(DATA, seed=0)
    assert posterior.mean == pytest.approx(1.0073, abs=0.002)
    assert posterior.standard_deviation == pytest.approx(0.0103, abs=0.001)
    # Far closer than the paper's digits require: the filter without its sampling noise is known.
    limit = exact_posterior(DATA, measure="ratio")
    assert f"{limit.mean:.4f} {limit.standard_deviation:.4f}" == "1.0073 0.0103"
    assert posterior.mean == pytest.approx(limit.mean, abs=2e-4)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, abs=1e-4)
    assert posterior.stiffness.mean == pytest.approx(575.2 * posterior.mean + 101.8)
    assert posterior.stiffness.standard_deviation == pytest.approx(
        575.2 * posterior.standard_deviation
    )
    # readings whose ratio has heavy tails
    vague = replace(DATA, displacement_standard_deviation=2e-3)
    posterior = particle_filter(vague, seed=0, particle_count=200_000)
    limit = exact_posterior(vague, measure="ratio")
    assert posterior.mean == pytest.approx(limit.mean, abs=1e-3)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, rel=0.02)

    first, again, other = (
        particle_filter(DATA, seed=seed, particle_count=20_000) for seed in (7, 7, 8)
    )
    assert first.mean == again.mean != other.mean
    assert np.array_equal(first.density, again.density)
    assert np.array_equal(first.likelihood, again.likelihood)


@pytest.mark.parametrize(
    ("change", "count", "prior", "words"),
    [
        (
            {"displacement": DATA.displacement * 0.5},
            2000,
            GaussianPrior(),
            "no particle explains pair",
        ),
        ({}, 100, GaussianPrior(0.93, 0.015), "effectively remain"),
    ],
)
def test_refusals_of_the_filter(change, count, prior, words):
    with pytest.raises(PosteriorError, match=words):
        particle_filter(replace(DATA, **change), seed=0, prior=prior, particle_count=count)


# -------------------------------- calibration step 2 as a whole: record, quality of fit, report, files


def test_step_2_of_the_paper():
    """Tip stiffness of Fig. 5, the offset between its runs, and what other assumptions would give."""
    result = calibrate_static(seed=3, particle_count=40_000)
    exact, prior = result.tip_stiffness_exact, result.tip_stiffness_prior
    assert prior.mean == pytest.approx(677.0, abs=0.01)
    assert prior.standard_deviation == pytest.approx(575.2 * 0.05 / 1.96, rel=1e-4)
    assert exact.mean == pytest.approx(575.2 * result.exact.mean + 101.8, abs=1e-6)
    assert exact.standard_deviation == pytest.approx(
        575.2 * result.exact.standard_deviation, rel=1e-6
    )
    assert exact.interval() == pytest.approx(
        PUBLISHED_LINE.stiffness(result.exact.interval()), abs=1e-3
    )
    assert result.particle.stiffness.mean == pytest.approx(681.2, abs=0.6)
    assert "differ by 0.47 mm" in result.quality.remarks[0]
    chi_square = float(np.sum(result.quality.standardised_residual**2))
    assert chi_square == pytest.approx(11.76, abs=0.05)
    perfect = assess_fit(replace(DATA, displacement=DATA.load / 680.0), 680.0)
    assert perfect.remarks == ()
    assert perfect.standardised_residual == pytest.approx(np.zeros(8), abs=1e-10)
    means = [posterior.mean for posterior in result.alternatives.values()]
    assert means == pytest.approx([1.00868, 1.00730, 1.01337], abs=1e-4)
    # the assumption of a shared offset alone is wide enough to reach the end of a short curve
    line = stiffness_line(575.2, 101.8, "short", 0.9, 1.06)
    assert [*calibrate_static(line, particle_count=20_000).alternatives] == [
        "flat in load",
        "ratio",
    ]


MASSES = {"servo_mass": (0.05, 0.3), "pitot_mass": (0.0, 0.3)}
READ = (weighed(), *PUBLISHED_MODES)


def line_model(states):
    """Frequencies of a wing whose logarithms are linear, with the reference model's slopes [Hz]."""
    factor, servo, pitot = states.T
    assert pitot == pytest.approx(TOTAL_MASS - 2.0 * servo)
    first = 5.632 * factor**0.4114 * np.exp(-0.5075 * (pitot - 0.1345))
    second = 28.544 * factor**0.3244 * np.exp(-0.2925 * (pitot - 0.1345))
    return np.column_stack([first, second])


@given(factor=st.floats(0.97, 1.05))
def test_masses_of_a_closed_solution(factor):
    result = fit_masses(line_model, np.array([factor]), MASSES, READ)
    # The first frequency answers more strongly, so the error of (19), (20) is least where it is met exactly.
    pitot = 0.1345 + math.log(5.632 * factor**0.4114 / 5.6492) / 0.5075
    assert result.samples[0, 2] == pytest.approx(pitot, abs=1e-6)
    assert 2.0 * result.samples[0, 1] + result.samples[0, 2] == pytest.approx(0.472, abs=1e-15)
    assert result.frequency[0, 0] == pytest.approx(5.6492, rel=1e-6)


@pytest.mark.parametrize(("changed", "words"), Inputs(__file__).refused("masses"))
def test_refusals_of_masses(changed, words):
    read = tuple(replace(item, value=changed.get(item.name, item.value)) for item in READ)
    with pytest.raises(ExperimentDataError, match=words):
        fit_masses(line_model, np.ones(1), MASSES, read)


# ---------------------------------------------------------------- densities on a grid


def gaussian(mean=1.0, deviation=0.02, size=2001):
    prior = GaussianPrior(mean, deviation)
    grid = mean + deviation * np.linspace(-10.0, 10.0, size)
    return prior, ScalarPosterior(grid, np.exp(prior.log_density(grid)) * 7.0)


def test_moments_quantiles_and_intervals_of_a_gaussian():
    prior, posterior = gaussian()
    assert posterior.mean == pytest.approx(1.0, abs=1e-12)
    assert posterior.standard_deviation == pytest.approx(0.02, rel=1e-9)
    probability = np.array([1e-6, 0.025, 0.3, 0.5, 0.99])
    assert posterior.quantile(probability) == pytest.approx(prior.quantile(probability), abs=2e-6)
    assert posterior.interval(0.95) == pytest.approx(
        (1 - 1.959964 * 0.02, 1 + 1.959964 * 0.02), abs=1e-6
    )
    value = np.array([0.95, 1.0, 1.01])
    below = norm.cdf(value, prior.mean, prior.standard_deviation)
    assert posterior.cumulative(value) == pytest.approx(below, abs=1e-5)


def test_samples_repeat_bit_for_bit_and_follow_the_density():
    """One in each stratum, in random order."""
    _, posterior = gaussian()
    samples = posterior.samples(5, 20_000)
    assert np.array_equal(samples, posterior.samples(np.random.SeedSequence(5), 20_000))
    assert not np.array_equal(samples, posterior.samples(6, 20_000))
    assert samples.mean() == pytest.approx(1.0, abs=6e-4)
    assert samples.std() == pytest.approx(0.02, rel=0.03)
    samples = posterior.samples(5, 100)
    strata = np.floor(posterior.cumulative(samples) * 100.0 + 1e-9).astype(int).tolist()
    assert sorted(strata) == list(range(100)) != strata
    assert abs(samples.mean() - 1.0) < 2e-4


# ---------------------------------------------------------------- stiffness curves


RANGE = (0.9, 1.1)


def test_a_table_meets_its_model_within_the_stated_error():
    """And continues smoothly beyond its ends: a spring with another, both on a root spring, no line."""
    calls = []

    def tip_stiffness(young_modulus_factor):
        calls.append(young_modulus_factor)
        return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8000.0)

    curve = stiffness_curve_of(tip_stiffness, RANGE)
    assert (curve.lower, curve.upper) == (0.9, 1.1)
    assert len(calls) < 600
    factor = np.linspace(0.9, 1.1, 997)
    exact = np.array([tip_stiffness(value) for value in factor])
    assert np.abs(curve.stiffness(factor) / exact - 1.0).max() < 3.0 * TABLE_TOLERANCE
    slope = (curve.stiffness(factor + 1e-6) - curve.stiffness(factor - 1e-6)) / 2e-6
    assert curve.slope(factor[1:-1]) == pytest.approx(slope[1:-1], rel=1e-4)
    for end in RANGE:
        below, at, above = curve.stiffness([end - 1e-6, end, end + 1e-6])
        assert at - below == pytest.approx(above - at, rel=1e-3)
    anywhere = np.linspace(0.3, 1.9, 33)
    assert curve.young_modulus_factor(curve.stiffness(anywhere)) == pytest.approx(
        anywhere, abs=1e-7
    )


def test_a_rough_curve_is_refused():
    with pytest.raises(PosteriorError, match="too rough"):
        stiffness_curve_of(lambda e: 600.0 + 100.0 * e + 5.0 * (70.0 * e // 1.0), RANGE)


# ---------------------------------------------------------------- the exact posterior


FACTORS = np.linspace(0.85, 1.2, 36)


@pytest.mark.parametrize("measure", ["displacement", "load", "ratio"])
def test_pair_likelihoods_equal_quadrature_over_the_true_displacement(measure):
    true = np.linspace(1e-5, 25e-3, 40_001)  # m
    k = PUBLISHED_LINE.stiffness(FACTORS)
    weight = true if measure == "ratio" else 1.0
    brute = np.empty((DATA.count, FACTORS.size))
    for pair, (load, displacement) in enumerate(zip(DATA.load, DATA.displacement, strict=True)):
        of_displacement = (
            norm.pdf(displacement, true, DATA.displacement_standard_deviation) * weight
        )
        for index, stiffness in enumerate(k):
            of_load = norm.pdf(load, stiffness * true, DATA.load_standard_deviation)
            brute[pair, index] = np.trapezoid(of_load * of_displacement, true)
    brute = brute * {"load": k, "ratio": 575.2}.get(measure, 1.0)
    total = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, measure=measure)
    assert total == pytest.approx(np.log(brute).sum(axis=0), abs=1e-7)


@pytest.mark.parametrize("zero_offset", [0.0, 1e-4, 5e-3])
def test_a_shared_zero_offset_equals_the_full_covariance(zero_offset):
    expected = np.zeros(FACTORS.size)
    for index, k in enumerate(PUBLISHED_LINE.stiffness(FACTORS)):
        for run in DATA.run_indices:
            of_run = DATA.run == run
            count = int(of_run.sum())
            variance = (
                DATA.load_standard_deviation**2 + (k * DATA.displacement_standard_deviation) ** 2
            )
            covariance = variance * np.eye(count) + (k * zero_offset) ** 2
            residual = DATA.load[of_run] - k * DATA.displacement[of_run]
            expected[index] += multivariate_normal.logpdf(residual, np.zeros(count), covariance)
    ours = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, zero_offset_standard_deviation=zero_offset)
    assert ours == pytest.approx(expected, abs=1e-8)


def test_published_pairs():
    posterior = exact_posterior(DATA)
    assert posterior.mean == pytest.approx(1.00797, abs=1e-5)
    assert posterior.standard_deviation == pytest.approx(0.01031, abs=1e-5)
    # measurements far from the prior are followed
    stiff = replace(
        DATA, displacement=DATA.load / PUBLISHED_LINE.stiffness(1.6), displacement_standard_deviation=1e-6,
        load_standard_deviation=1e-4,
    )  # fmt: skip
    posterior = exact_posterior(stiff)
    assert posterior.mean == pytest.approx(1.6, abs=1e-3)
    assert 0.0 < posterior.standard_deviation < 1e-3
    curve = stiffness_line(575.2, 101.8, "narrow model", 0.9, 0.99)
    with pytest.raises(OutsideValidityError, match=r"outside \[0.9, 0.99\], where narrow model"):
        exact_posterior(DATA, curve=curve)
