"""The posterior of a wing's stiffness, masses and damping given all its readings.

Unknown are e, the servo mass s, the pitot mass p and the Rayleigh coefficients (alpha, beta).
Measured are the load test, the weighed total T of 2 s + p, and frequencies y_i and damping ratios
z_i of two modes. The model's frequencies f_i(e, s, p) have relative errors delta_i ~ N(0, tau_i^2),
which are integrated out in closed form:

    T ~ N(2 s + p, s_T^2),   y_i ~ N(f_i, s_i^2 + tau_i^2 f_i^2),   z_i ~ N(zeta_i, r_i^2),

with zeta_i by Kapteyn et al. 2021, eq. (18), at the model's own frequencies, as in eq. (25): the
coefficients belong to the model and give *its* modes the measured damping. Pairs of the load test
have errors in both readings (`calibration.static.errors_in_variables`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import softmax
from scipy.stats import multivariate_t

from calibration.errors import ExperimentDataError, OutsideValidityError, PosteriorError
from calibration.joint.wing_table import MODEL_ERROR, QUANTITIES, WingTable, wing_priors
from calibration.result.record import ParameterPrior, QuantityReading
from calibration.static.errors_in_variables import exact_posterior, residual_variance
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import GaussianPrior, Seed, child_seed
from reporting.arrays import Float


class Comparison(NamedTuple):
    """R readings compared with the model at N states.

    Attributes
    ----------
    difference : (N, R) array
        The readings minus the model's values.
    deviation : (N, R) array
        The standard deviations of these differences.
    """

    difference: Float
    deviation: Float


LEAST_EFFECTIVE_SAMPLE_SIZE = 200.0
"""Smallest effective sample size of weighted draws that describe a posterior."""

_DEGREES_OF_FREEDOM = 10.0  # of Student's t as proposal: heavier tails than a truncated Gaussian
_INFLATION = 1.05  # of the proposal's covariance over the posterior's
_PILOT_COUNT = 2_000
_PROPOSALS_PER_SAMPLE = 20
_FEWEST_PROPOSALS = 4_000
_START_MARGIN = 0.1  # from the ends of the ranges to the start, in prior standard deviations
_PURPOSE = 22  # of the seed


def infer(
    priors: tuple[ParameterPrior, ...],
    compare: Callable[[Float], Comparison],
    *,
    seed: Seed = 0,
    count: int = 1000,
) -> Float:
    """Return equally weighted samples of the posterior given all readings, by importance sampling.

    The proposal is Student's t in whitened coordinates, in which the posterior near its maximum has
    unit covariance. Parameters that the readings determine only in combination are thus sampled as
    well as others. The mean and the covariance of the proposal are those of the draws of a pilot
    run.

    Parameters
    ----------
    priors : tuple of ParameterPrior
        The priors of P parameters: Gaussians, truncated to the ranges of the parameters.
    compare : callable
        Compares all readings with the model in states (N, P) within their ranges.

    Returns
    -------
    (count, P) array
        The samples, in the units of the parameters.

    Raises
    ------
    PosteriorError
        If the readings contradict each other so much that no posterior is found.
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSE))
    posterior = _WhitenedPosterior(priors, compare)
    dimension = len(priors)
    pilot_draws = posterior.draw(np.zeros(dimension), np.eye(dimension), _PILOT_COUNT, generator)
    covariance = _INFLATION * np.cov(pilot_draws.points.T, aweights=pilot_draws.weight)
    proposal_count = max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    mean = pilot_draws.weight @ pilot_draws.points
    draws = posterior.draw(mean, covariance, proposal_count, generator)
    # Effective sample size of weighted draws (Kish): 1 / sum of squared weights
    effective = 1.0 / float(np.sum(draws.weight**2))
    if not effective >= LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(
            f"only {effective:.0f} of {proposal_count} draws describe the posterior: the readings "
            "contradict each other within the model's range; check them, or allow the model a "
            "larger error."
        )
    # Systematic resampling (Kitagawa 1996): equally spaced levels of the cumulative weight, with
    # one random offset. The samples are shuffled.
    probability_levels = (np.arange(count) + generator.random()) / count
    indices = np.searchsorted(np.cumsum(draws.weight), probability_levels)
    indices = np.minimum(indices, proposal_count - 1)  # rounding of the cumulative sum
    return posterior.states(draws.points[generator.permutation(indices)])


class _WeightedDraws(NamedTuple):
    """Draws in whitened coordinates (N, P) and their weights (N,), whose sum is 1."""

    points: Float
    weight: Float


class _WhitenedPosterior:
    """A posterior density in coordinates in which it is roughly a standard Gaussian.

    There are three kinds of coordinates: the state x in the units of the parameters; u, with
    x = prior mean + prior standard deviation * u; and the whitened points v, with
    u = optimum + v @ whitening, where the optimum is the maximum of the posterior.
    """

    def __init__(
        self, priors: tuple[ParameterPrior, ...], compare: Callable[[Float], Comparison]
    ) -> None:
        self._compare = compare
        self._mean = np.array([prior.mean for prior in priors])
        self._deviation = np.array([prior.deviation for prior in priors])
        self._low = np.array([prior.low for prior in priors])
        self._high = np.array([prior.high for prior in priors])
        self._lower_u = (self._low - self._mean) / self._deviation
        self._upper_u = (self._high - self._mean) / self._deviation

        start = np.clip(0.0, self._lower_u + _START_MARGIN, self._upper_u - _START_MARGIN)
        optimum = least_squares(
            lambda u: self._residuals(u[None])[0][0],
            start,
            bounds=(self._lower_u, self._upper_u),
            x_scale="jac",
        )
        self._optimum_u = optimum.x
        # Gauss-Newton: the posterior of u has the covariance (J.T @ J)^-1 = W.T @ W with J = U S
        # V.T and the whitening W = S^-1 V.T.
        _, singular_values, right_vectors = np.linalg.svd(optimum.jac, full_matrices=False)
        self._whitening = right_vectors / singular_values[:, None]

    def states(self, points: Float) -> Float:
        """Return the states (N, P) at whitened coordinates (N, P)."""
        return self._states(self._optimum_u + points @ self._whitening)

    def _states(self, u: Float) -> Float:
        """Return the states (N, P) at coordinates u (N, P), limited to their ranges."""
        # Rounding must not put a state outside its range.
        return np.asarray(np.clip(self._mean + self._deviation * u, self._low, self._high))

    def _residuals(self, u: Float) -> tuple[Float, Float]:
        """Return the terms of the negative log posterior at coordinates u (N, P).

        Returns
        -------
        residuals : (N, R + P) array
            The standardised residuals of the R readings, and u itself: the residuals of the priors.
        log_scale : (N,) array
            The sum of the logarithms of the readings' standard deviations, which depend on the
            state.
        """
        difference, deviation = self._compare(self._states(u))
        log_scale = np.log(deviation).sum(axis=1)
        return np.hstack([difference / deviation, u]), log_scale

    def draw(
        self, mean: Float, covariance: Float, size: int, generator: np.random.Generator
    ) -> _WeightedDraws:
        """Draw `size` points from Student's t, and weight them by the posterior.

        `mean` (P,) and `covariance` (P, P) are the mean and the shape matrix of the proposal, in
        whitened coordinates.
        """
        proposal = multivariate_t(mean, covariance, _DEGREES_OF_FREEDOM)
        points = proposal.rvs(size, generator).reshape(size, -1)
        u = self._optimum_u + points @ self._whitening
        residual, log_scale = self._residuals(u)
        log_posterior = -0.5 * np.sum(residual**2, axis=1) - log_scale
        # Importance weight: posterior over proposal, zero outside the ranges of the parameters
        log_weight = log_posterior - proposal.logpdf(points)
        is_within_range = (u >= self._lower_u) & (u <= self._upper_u)
        is_inside: NDArray[np.bool_] = np.all(is_within_range, axis=1)
        weight = softmax(np.where(is_inside, log_weight, -np.inf))
        return _WeightedDraws(points, weight)


_LIMIT_MARGIN = 0.01  # of the range of e
_LARGEST_FRACTION_AT_LIMIT = 0.05
_IMPROBABLE = 2.33  # standard deviations that one in a hundred exceeds


def joint_posterior(
    wing: WingTable,
    static: LoadDisplacementData,
    readings: Sequence[QuantityReading],
    *,
    priors: tuple[ParameterPrior, ...] | None = None,
    model_error: tuple[float, float] = MODEL_ERROR,
    seed: int = 0,
    count: int = 1000,
) -> Float:
    """Return samples of e, masses and Rayleigh coefficients given all measurements.

    Parameters
    ----------
    readings : sequence of QuantityReading
        The weighed mass and the readings of both modes; others are ignored.
    priors : tuple of ParameterPrior, optional
        The priors; `wing_priors` of the model by default.
    model_error : (float, float)
        The relative standard deviations tau_1, tau_2 of the model's frequencies about the wing's.

    Returns
    -------
    (count, 5) array
        The samples of e [1], servo mass and pitot mass [kg], alpha [1/s] and beta [s].

    Raises
    ------
    ExperimentDataError
        If no masses within the model's range have the weighed total, or the damping ratios need
        negative coefficients.
    OutsideValidityError
        If the load test alone puts e outside the model's range, or all measurements together press
        it against the end of this range.
    PosteriorError
        If the readings contradict each other, see `infer`.
    """
    if priors is None:
        priors = wing_priors(wing.validity)
    prior_of_e = priors[0]
    reading_of = _readings_of_outputs(readings)
    _refuse_negative_damping(reading_of)
    servo_range(wing.validity, reading_of["weighed_mass"].value)
    # The load test alone must put e inside the range of the model.
    prior = GaussianPrior(prior_of_e.mean, prior_of_e.deviation)
    exact_posterior(static, curve=wing.stiffness, prior=prior)

    compare = _comparison_with_wing(wing, static, list(reading_of.values()), model_error)
    samples = infer(priors, compare, seed=seed, count=count)
    samples_of_e, *_ = samples.T
    _refuse_samples_at_limits(samples_of_e, prior_of_e)
    return samples


def _readings_of_outputs(readings: Sequence[QuantityReading]) -> dict[str, QuantityReading]:
    """Return the readings of a wing's outputs by name, without its stiffness."""
    names = {quantity.name for quantity in QUANTITIES[1:]}
    return {reading.name: reading for reading in readings if reading.name in names}


def _comparison_with_wing(
    wing: WingTable,
    static: LoadDisplacementData,
    readings: Sequence[QuantityReading],
    model_error: tuple[float, float],
) -> Callable[[Float], Comparison]:
    """Return a function that compares the readings with a wing in states (N, 5).

    Its `Comparison` has the pairs of the load test first. `model_error` are the relative standard
    deviations of the model's two frequencies.
    """
    output_names = [quantity.name for quantity in QUANTITIES]
    columns = [output_names.index(reading.name) for reading in readings]
    relative_errors = {"frequency_1": model_error[0], "frequency_2": model_error[1]}
    relative_error = np.array([relative_errors.get(reading.name, 0.0) for reading in readings])
    value = np.array([reading.value for reading in readings])
    deviation = np.array([reading.deviation for reading in readings])

    def compare(states: Float) -> Comparison:
        outputs = wing.outputs(states)
        stiffness = outputs[:, :1]
        predicted_values = outputs[:, columns]
        # A load differs from k x by R_f + k^2 R_x, see `residual_variance`; a frequency by the
        # reading's error and the model's.
        load_difference = static.load - stiffness * static.displacement
        load_deviation = np.sqrt(residual_variance(static, stiffness))
        reading_deviation = np.hypot(deviation, relative_error * predicted_values)
        return Comparison(
            difference=np.hstack([load_difference, value - predicted_values]),
            deviation=np.hstack(
                [np.broadcast_to(load_deviation, load_difference.shape), reading_deviation]
            ),
        )

    return compare


def _refuse_samples_at_limits(e: Float, prior: ParameterPrior) -> None:
    """Raise `OutsideValidityError` if samples of e (N,) accumulate at an end of its range."""
    margin = _LIMIT_MARGIN * (prior.high - prior.low)
    for limit in (prior.low, prior.high):
        fraction = float(np.mean(np.abs(e - limit) < margin))
        if fraction > _LARGEST_FRACTION_AT_LIMIT:
            raise OutsideValidityError(
                f"{fraction:.0%} of the joint posterior of e lies at {limit:g}, the limit of the "
                "model: load test and frequencies contradict each other; check them, or allow the "
                "model a larger error of its frequencies."
            )


def _refuse_negative_damping(readings: Mapping[str, QuantityReading]) -> None:
    """Raise `ExperimentDataError` if damping ratios almost surely need a negative coefficient."""
    omega = 2.0 * math.pi * np.array([readings[f"frequency_{mode}"].value for mode in (1, 2)])
    # Ratios zeta_i = (alpha / omega_i + beta omega_i) / 2, solved for alpha and beta
    inverse = np.linalg.inv(0.5 * np.column_stack([1.0 / omega, omega]))
    ratio_1 = readings["damping_ratio_1"]
    ratio_2 = readings["damping_ratio_2"]
    coefficients = inverse @ [ratio_1.value, ratio_2.value]
    # Variances add with squared factors, for independent errors of the two ratios.
    deviations = np.sqrt(inverse**2 @ [ratio_1.deviation**2, ratio_2.deviation**2])
    if np.any(coefficients + _IMPROBABLE * deviations < 0.0):
        raise ExperimentDataError(
            f"damping ratios {ratio_1.value:g} and {ratio_2.value:g} need a negative Rayleigh "
            "coefficient, but neither may be negative; check the ring-down records."
        )


def servo_range(
    validity: Mapping[str, tuple[float, float]], total_mass: float
) -> tuple[float, float]:
    """Return the range of servo masses for which the model can have the weighed total mass [kg].

    Parameters
    ----------
    validity : mapping of str to (float, float)
        The ranges of `servo_mass` and `pitot_mass` in the model [kg].
    total_mass : float
        The weighed mass of two servos and the pitot tube [kg].

    Raises
    ------
    ExperimentDataError
        If there is no such mass.
    """
    least_servo, greatest_servo = validity["servo_mass"]
    least_pitot, greatest_pitot = validity["pitot_mass"]
    lower = max(least_servo, 0.5 * (total_mass - greatest_pitot))
    upper = min(greatest_servo, 0.5 * (total_mass - least_pitot))
    if not (math.isfinite(total_mass) and lower < upper):
        least_total = 2.0 * least_servo + least_pitot
        greatest_total = 2.0 * greatest_servo + greatest_pitot
        raise ExperimentDataError(
            f"two servos and the pitot tube cannot weigh {total_mass:g} kg: the model takes totals "
            f"between {least_total:g} and {greatest_total:g} kg."
        )
    return lower, upper
