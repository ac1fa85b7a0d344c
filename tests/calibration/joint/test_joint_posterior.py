"""The joint posterior against enumeration, limits and bad input; readings of ring-downs."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from calibration.dynamics.records import RingDownRecord, read_records
from calibration.dynamics.trials import amplitude_dependence, fit_trials
from calibration.errors import ExperimentDataError, OutsideValidityError
from calibration.joint.measured_modes import PUBLISHED_MODES, measured_modes, modal_readings
from calibration.joint.posterior import joint_posterior
from calibration.joint.wing_table import MODEL_ERROR, WingTable, weighed_mass, wing_priors
from calibration.result.record import STATE
from calibration.static.experiments import published_measurements
from calibration.static.posterior import PUBLISHED_LINE, stiffness_line
from tests.calibration.decays import free_decay
from tests.costs import once

LIMITS = np.array([[0.85, 1.15], [0.05, 0.3], [0.0, 0.3]])
"""Where the model is valid: factor of the modulus, servo mass and pitot mass [kg]."""
CENTRE = np.array([1.0, 0.169, 0.1345])
LOG_FREQUENCIES_AT_CENTRE = np.log([5.632, 28.544])
SLOPES = np.array([[0.41, 0.325], [-0.94, -0.69], [-0.98, -0.64]])
"""Of ln f1, ln f2 by the three quantities, as of the shipped wing."""
VALIDITY = dict(zip(STATE[:3], ((low, high) for low, high in LIMITS.tolist()), strict=True))
LOAD_TEST = published_measurements()


# ---------------------------------------------------------------- a wing in closed form


def line_frequencies(quantities):
    """Return frequencies (N, 2) [Hz] of a wing whose logarithms are linear."""
    return np.exp(LOG_FREQUENCIES_AT_CENTRE + (quantities - CENTRE) @ SLOPES)


def make_line_table():
    """Return the same wing as tables, whose polynomial is exact."""
    low, high = LIMITS.T
    half_width = 0.5 * (high - low)
    middle = LIMITS.mean(axis=1)
    slope_over_half_width = half_width[:, None] * SLOPES
    coefficient = np.zeros((2, 2, 2, 2))  # by powers of the three parameters, and by mode
    coefficient[0, 0, 0] = LOG_FREQUENCIES_AT_CENTRE + (middle - CENTRE) @ SLOPES
    for parameter, powers in enumerate([(1, 0, 0), (0, 1, 0), (0, 0, 1)]):
        coefficient[powers] = slope_over_half_width[parameter]
    curve = stiffness_line(575.2, 101.8, lower=0.85, upper=1.15)
    return WingTable(LIMITS, coefficient, curve)


LINE_TABLE = make_line_table()


def published_modes(**deviations):
    """Return the published modes, some of their deviations changed."""
    changed = [deviations.get(mode.name, mode.deviation) for mode in PUBLISHED_MODES]
    return modal_readings([mode.value for mode in PUBLISHED_MODES], changed)


def draw_posterior(modes=PUBLISHED_MODES, load_test=LOAD_TEST, total_mass=None, **options):
    """Return samples of the posterior of the wing in closed form, with published readings."""
    weight = weighed_mass() if total_mass is None else total_mass
    return joint_posterior(LINE_TABLE, load_test, (weight, *modes), **options)


# ---------------------------------------------------------------- enumeration

ALPHA_PRIOR = (2.0, 0.3)
BETA_PRIOR = (8e-4, 1e-4)
"""Means and deviations; far from zero, so that the posteriors of alpha and beta are Gaussians."""
PRIORS = wing_priors(VALIDITY, damping_alpha=ALPHA_PRIOR, damping_beta=BETA_PRIOR)


@dataclass(frozen=True)
class Grid:
    """Points of an enumeration within the limits.

    Attributes
    ----------
    quantities : (N, 3) array
        Factor of the modulus, servo mass and pitot mass.
    total_mass : (N,) array
        Mass of two servos and the pitot tube [kg].
    """

    quantities: NDArray[np.float64]
    total_mass: NDArray[np.float64]


def enumerate_grid():
    factor, servo, total = np.meshgrid(
        np.linspace(0.95, 1.07, 31),
        np.linspace(0.09, 0.24, 61),
        np.linspace(0.466, 0.478, 25),
        indexing="ij",
    )
    pitot = total - 2.0 * servo
    is_inside = (pitot > 0.0) & (pitot < 0.3)
    quantities = np.column_stack([factor[is_inside], servo[is_inside], pitot[is_inside]])
    return Grid(quantities, total[is_inside])


def log_prior(quantities):
    """Return the log density of Gaussians that are cut off at the limits."""
    log_density = np.zeros(len(quantities))
    for values, prior, limits in zip(quantities.T, PRIORS[:3], LIMITS, strict=True):
        low, high = stats.norm.cdf(limits, prior.mean, prior.deviation)
        log_density += stats.norm.logpdf(values, prior.mean, prior.deviation)
        log_density -= math.log(high - low)
    return log_density


def log_likelihood_of_loads(factor):
    """Return the log density of the load test, with errors of load and displacement."""
    stiffness = PUBLISHED_LINE.stiffness(factor)
    deviation = np.hypot(
        LOAD_TEST.load_standard_deviation,
        stiffness * LOAD_TEST.displacement_standard_deviation,
    )
    log_density = np.zeros(len(factor))
    for load, displacement in zip(LOAD_TEST.load, LOAD_TEST.displacement, strict=True):
        log_density += stats.norm.logpdf(load - stiffness * displacement, 0.0, deviation)
    return log_density


def log_likelihood_of_frequencies(frequencies):
    """Return the log density of both frequencies, with errors of readings and of the model."""
    log_density = np.zeros(len(frequencies))
    for frequency, mode, model_error in zip(
        frequencies.T, PUBLISHED_MODES[:2], MODEL_ERROR, strict=True
    ):
        deviation = np.hypot(mode.deviation, model_error * frequency)
        log_density += stats.norm.logpdf(mode.value, frequency, deviation)
    return log_density


@dataclass(frozen=True)
class DampingPosterior:
    """The Gaussian posterior of alpha and beta at each point of a grid.

    Attributes
    ----------
    log_evidence : (N,) array
    mean, variance : (N, 2) array
    """

    log_evidence: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


def damping_posterior(frequencies):
    """Return the posterior by linear regression: the ratios are linear in alpha and beta."""
    prior_mean, prior_deviation = np.transpose([ALPHA_PRIOR, BETA_PRIOR])
    omega = 2.0 * math.pi * frequencies
    design = np.stack([0.5 / omega, 0.5 * omega], axis=2)
    ratios = np.array([mode.value for mode in PUBLISHED_MODES[2:]])
    deviations = np.array([mode.deviation for mode in PUBLISHED_MODES[2:]])

    # prior covariance of (alpha, beta) with the ratios, and covariance of the ratios
    cross = np.diag(prior_deviation**2) @ np.swapaxes(design, 1, 2)
    covariance = design @ cross + np.diag(deviations**2)
    residual = ratios - design @ prior_mean
    solved = np.linalg.solve(covariance, residual[..., None])[..., 0]
    reduction = np.einsum(
        "nij,nji->ni", cross, np.linalg.solve(covariance, np.swapaxes(cross, 1, 2))
    )

    _, log_determinant = np.linalg.slogdet(2.0 * math.pi * covariance)
    return DampingPosterior(
        log_evidence=-0.5 * np.sum(residual * solved, axis=1) - 0.5 * log_determinant,
        mean=prior_mean + (cross @ solved[..., None])[..., 0],
        variance=prior_deviation**2 - reduction,
    )


@dataclass(frozen=True)
class Moments:
    """Mean and deviation of modulus factor, servo mass, pitot mass, alpha and beta."""

    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]


@pytest.fixture(scope="module")
def enumerated():
    """Moments of the posterior by a sum over a grid of factor, servo mass and weighed total."""
    grid = enumerate_grid()
    factor, _, _ = grid.quantities.T
    frequencies = line_frequencies(grid.quantities)
    damping = damping_posterior(frequencies)
    log_density = (
        stats.norm.logpdf(grid.total_mass, 0.472, 1e-3)
        + log_prior(grid.quantities)
        + log_likelihood_of_loads(factor)
        + log_likelihood_of_frequencies(frequencies)
        + damping.log_evidence
    )
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    points = np.hstack([grid.quantities, damping.mean])
    mean = weight @ points
    variance = weight @ (points - mean) ** 2
    variance[3:] += weight @ damping.variance
    return Moments(mean=mean, deviation=np.sqrt(variance))


def test_samples_have_the_moments_of_an_enumeration(enumerated):
    samples = draw_posterior(priors=PRIORS, count=20_000)

    error = np.abs(samples.mean(axis=0) - enumerated.mean)
    np.testing.assert_array_less(error, 0.02 * enumerated.deviation)
    np.testing.assert_allclose(samples.std(axis=0), enumerated.deviation, rtol=0.02)


def test_the_same_seed_draws_the_same_bytes():
    samples = draw_posterior(seed=3, count=200).tobytes()

    assert samples == draw_posterior(seed=3, count=200).tobytes()
    assert samples != draw_posterior(seed=4, count=200).tobytes()


# ---------------------------------------------------------------- what is refused


def test_a_total_mass_that_the_wing_cannot_have_is_refused():
    with pytest.raises(ExperimentDataError, match="cannot weigh 2 kg"):
        draw_posterior(total_mass=weighed_mass(2.0))


def test_a_wing_far_stiffer_than_the_model_is_refused():
    stiff = replace(LOAD_TEST, displacement=LOAD_TEST.displacement * 0.7)

    with pytest.raises(OutsideValidityError, match="outside"):
        draw_posterior(load_test=stiff)


def test_damping_ratios_without_rayleigh_coefficients_are_refused():
    overdamped = modal_readings((5.6492, 29.9699, 0.01, 0.3), (0.06, 0.3, 1e-4, 1e-3))

    with pytest.raises(ExperimentDataError, match="negative Rayleigh coefficient"):
        draw_posterior(overdamped)


def test_a_posterior_at_the_end_of_the_model_is_refused():
    sharp = published_modes(frequency_1=0.001, frequency_2=0.03)

    with pytest.raises(OutsideValidityError, match=r"lies at 1\.15, the limit of the model"):
        draw_posterior(sharp, model_error=(0.0, 0.0))


def test_a_reading_without_uncertainty_is_refused():
    with pytest.raises(ExperimentDataError, match=r"damping_ratio_1 .* without any unc"):
        published_modes(damping_ratio_1=0.0)


@pytest.mark.parametrize(
    ("quantities", "sentence"),
    [
        ([1.0, 0.4, 0.1], r"mass of each servo is 0\.4 kg, .* 0\.05 to 0\.3 kg"),
        ([1.5, 0.17, 0.1], r"modulus of the skin, e is 1\.5"),
    ],
)
def test_frequencies_outside_the_table_are_refused(quantities, sentence):
    with pytest.raises(OutsideValidityError, match=sentence):
        LINE_TABLE.frequency([quantities])


# ---------------------------------------------------------------- what the ring-down is made to say

TIME = np.arange(0.0, 6.4, 1.0 / 250.0)
F1 = 5.65
F2 = 29.0
ZETA1 = 0.028
ZETA2 = 0.05
DECAY_RATE = 2.0 * math.pi * F1 * ZETA1
"""Of the first mode [1/s]."""
NOISE = 1e-4
AMPLITUDE = 0.012


def readings_by_name(trials):
    """Return what `measured_modes` reads, by name."""
    return {reading.name: reading for reading in measured_modes(trials)}


def record_trials(seed, softening=0.0, scatter=0.0):
    """Return five records of two modes.

    Parameters
    ----------
    seed : int
    softening : float
        By how much the first frequency falls with every factor e of the amplitude [Hz].
    scatter : float
        Standard deviation of the first frequency from record to record [Hz].
    """
    generator = np.random.default_rng(seed)
    records = []
    for trial in range(5):
        # f(t) = F1 + softening (ln A(0) - ln A(t)) - middle, integrated over time
        half_change = 0.5 * softening * DECAY_RATE
        frequency = F1 - half_change * TIME[-1] + scatter * generator.standard_normal()
        phase = 2.0 * math.pi * (frequency * TIME + half_change * TIME**2)
        first = AMPLITUDE * np.exp(-DECAY_RATE * TIME) * np.cos(phase)
        signal = first + free_decay(TIME, F2, ZETA2, 0.008)
        signal += generator.normal(0.0, NOISE, TIME.size)
        records.append(RingDownRecord(TIME, signal, source=f"drawn {trial + 1}"))
    return tuple(records)


def test_the_frequency_of_a_wing_that_softens_has_the_deviation_of_its_course():
    softening = 0.07
    trials = fit_trials(record_trials(1, softening), frequencies_fitted=True, start=-1.0)

    deviation = readings_by_name(trials)["frequency_1"].deviation

    # Windows of 0.8 s from 0.4 s on, as far as the mode stands above the noise
    end_of_mode = math.log(AMPLITUDE / (4.0 * NOISE)) / DECAY_RATE
    middles = np.arange(0.8, min(5.6, end_of_mode) + 0.4, 0.4)
    log_amplitude_deviation = DECAY_RATE * middles.std()
    assert deviation == pytest.approx(softening * log_amplitude_deviation, rel=0.25)


def test_frequencies_of_spectral_peaks_carry_their_bias():
    """Skirts of the first mode move the second peak: the authors' procedure is off, and says so."""
    records = record_trials(2)
    by_peak = readings_by_name(fit_trials(records, start=-1.0))["frequency_2"]
    by_fit = readings_by_name(fit_trials(records, frequencies_fitted=True, start=-1.0))[
        "frequency_2"
    ]

    bias = abs(by_peak.value - F2)
    assert bias > 5.0 * by_fit.deviation
    assert 0.5 * bias < by_peak.deviation < 2.0 * bias


def values_of(trials, reading):
    """Return the values and standard errors of a reading in each trial."""
    name = reading.name[:-2]
    mode = int(reading.name[-1]) - 1
    modes = [trial.modes[mode] for trial in trials]
    values = np.array([getattr(mode, name) for mode in modes])
    errors = np.array([mode.standard_error[name] for mode in modes])
    return values, errors


@once
def fit_scattered(count, scatter):
    """Return the fits of some trials with scattered frequencies, which take seconds."""
    records = record_trials(1, scatter=scatter)[:count]
    return fit_trials(records, frequencies_fitted=True, start=-1.0)


@pytest.mark.parametrize(("count", "scatter"), [(1, 0.05), (2, 0.05), (5, 0.05), (5, 0.0)])
def test_a_reading_is_the_mean_of_the_trials(count, scatter):
    trials = fit_scattered(count, scatter)

    for reading in measured_modes(trials):
        values, _ = values_of(trials, reading)
        assert reading.value == pytest.approx(np.mean(values))


@pytest.mark.parametrize(("count", "widening"), [(2, 4.0), (5, 2.0)])
def test_trials_that_scatter_beyond_their_fits_widen_the_error_of_the_mean(count, widening):
    trials = fit_scattered(count, scatter=0.05)

    reading = readings_by_name(trials)["frequency_1"]

    values, _ = values_of(trials, reading)
    variance = widening * np.var(values, ddof=1)
    assert reading.deviation == pytest.approx(math.sqrt(variance / count), rel=1e-9)


def test_a_single_trial_has_the_error_of_its_fit():
    trials = fit_scattered(1, scatter=0.05)

    reading = readings_by_name(trials)["frequency_1"]

    _, (error,) = values_of(trials, reading)
    assert reading.deviation == pytest.approx(error, rel=1e-9)


def test_trials_of_a_linear_wing_have_statistical_errors_alone():
    trials = fit_scattered(5, scatter=0.0)

    for reading in measured_modes(trials):
        _, errors = values_of(trials, reading)
        expected = math.sqrt(np.mean(errors**2) / 5)
        assert reading.deviation == pytest.approx(expected, rel=1e-9), reading.name


# ---------------------------------------------------------------- the published records


@pytest.fixture(scope="module")
def published_trials(reference):
    return fit_trials(read_records(reference))


def test_the_published_records_have_the_published_modes(published_trials):
    for reading, published in zip(measured_modes(published_trials), PUBLISHED_MODES, strict=True):
        assert reading.deviation == pytest.approx(published.deviation, rel=0.02), reading.name
        if reading.name.startswith("frequency"):
            assert reading.value == pytest.approx(published.value, rel=3e-3)


def test_the_published_wing_softens_with_the_amplitude(published_trials):
    """The wing is not linear: as the amplitude falls, frequency rises and damping falls."""
    first, *_, last = amplitude_dependence(published_trials[0])

    assert first.amplitude > 10.0 * last.amplitude
    assert first.frequency < 5.58 < 5.70 < last.frequency < 5.80
    assert first.damping_ratio > 1.2 * last.damping_ratio
