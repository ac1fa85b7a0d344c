r"""The exact posterior of the Young's modulus factor, with errors of load and displacement.

The wing obeys f° = k(e) x°, with true load f° and true displacement x°; the readings are f ~ N(f°,
R_f) and x ~ N(x°, R_x), independent. For one pair and a flat prior on the true displacement,

    L(e) = ∫ N(f; k x°, R_f) N(x; x°, R_x) dx°.

Given e, f - k x = (f - f°) - k (x - x°) is free of x°, so the integrand, as a function of x°, is a
Gaussian in x° times a factor without x°; the integral over the line of the Gaussian in x° is one
and leaves

    L(e) = N(f - k(e) x; 0, S(e)),   S(e) = R_f + k(e)^2 R_x,

with its normalising factor S^(-1/2), which depends on e and must stay. (Completing the square: the
exponent is (f - k x)^2 / S + (x° - x̂)^2 / V with x̂ = (x R_f + k f R_x) / S and V = R_x R_f / S,
and sqrt(R_f R_x) = sqrt(S V).)

"Flat" is not one prior. Flat in the true load instead of the true displacement, dx° = df° / k,
gives L(e) k(e). And the density of e = k^-1(f° / x°) for f°, x° drawn about the readings, which the
paper's particle filter takes for the likelihood, is (Hinkley 1969)

    p(e) = |dk/de| ∫ |x°| N(k x°; f, R_f) N(x°; x, R_x) dx° = |dk/de| E|X| N(f - k x; 0, S)

with X ~ N(x̂, V).

All three are offered as `measure`; on the published pairs their means lie within 0.0014 of each
other.

A zero offset c_r ~ N(0, R_0) that all displacements of one loading run share can be integrated out
as well: the residuals of a run then have the covariance S I + k^2 R_0 1 1'.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calibration.errors import OutsideValidityError
from reporting.arrays import Float

from .experiments import LoadDisplacementData
from .posterior import PUBLISHED_LINE, GaussianPrior, ScalarPosterior, StiffnessCurve

Measure = Literal["displacement", "load", "ratio"]
"""The quantity with a flat prior: true displacement, true load, or their ratio as in the paper."""

GRID_SIZE = 2001
"""Number of points of the posterior's grid, over +-10 standard deviations."""

NOTICEABLE_SCORE = 2.0
"""Score above which a difference between runs, or a pair, is reported [standard deviations]."""

_REACH = 10.0  # of the grid, in standard deviations
_MOST_REFINEMENTS = 60
_LARGEST_PROBABILITY_OUTSIDE = 1e-4


def residual_variance(data: LoadDisplacementData, stiffness: ArrayLike) -> Float:
    """Return S = R_f + k^2 R_x [N^2], elementwise in the stiffness k [N/m]."""
    k = np.asarray(stiffness, dtype=float)
    load_variance = data.load_standard_deviation**2
    return np.asarray(load_variance + (k * data.displacement_standard_deviation) ** 2)


def pair_log_likelihoods(
    curve: StiffnessCurve,
    data: LoadDisplacementData,
    young_modulus_factor: ArrayLike,
    measure: Measure = "displacement",
) -> Float:
    """Return the log likelihood of e for each measured pair of load and displacement.

    Here e is the factor on Young's modulus that is to be calibrated; the wing has the stiffness
    k(e) [N/m]. Both readings of a pair have Gaussian errors. The true displacement is integrated
    out, with a flat prior; the module's docstring derives the formulas. With the measure "ratio"
    the likelihood is the limit for many particles of the kernel density estimate in the paper that
    published the experiment.

    Parameters
    ----------
    young_modulus_factor : (N,) array
        The values of e.
    measure : {"displacement", "load", "ratio"}
        The true quantity of a pair whose prior is flat: displacement, load, or load over
        displacement, which is the stiffness.

    Returns
    -------
    (n_pairs, N) array
        The natural logarithms of the likelihoods, at each of the N values of e.
    """
    factor = np.atleast_1d(np.asarray(young_modulus_factor, dtype=float))
    k = curve.stiffness(factor)
    load = data.load[:, None]
    displacement = data.displacement[:, None]
    variance = residual_variance(data, k)
    squared_score = (load - k * displacement) ** 2 / variance
    log_likelihood = -0.5 * (squared_score + np.log(2.0 * math.pi * variance))
    if measure == "load":
        # A prior that is flat in the true load is k times one that is flat in the displacement.
        log_likelihood += np.log(k)
    if measure == "ratio":
        # The density of a ratio (Hinkley 1969) has the factors |dk/de| and E|X|, where X is the
        # true displacement given both readings. X is Gaussian with this mean and deviation, so |X|
        # is a folded Gaussian.
        load_variance = data.load_standard_deviation**2
        displacement_variance = data.displacement_standard_deviation**2
        mean = (displacement * load_variance + k * load * displacement_variance) / variance
        deviation = np.sqrt(load_variance * displacement_variance / variance)
        mean_displacement = _mean_of_folded_gaussian(mean, deviation)
        log_likelihood += np.log(mean_displacement) + np.log(curve.slope(factor))
    return np.asarray(log_likelihood)


def _mean_of_folded_gaussian(mean: Float, deviation: Float) -> Float:
    """Return E|X| of a Gaussian X ~ N(mean, deviation^2), elementwise."""
    from scipy.special import erf  # slow to import; only the measure "ratio" needs it

    # E|X| = s sqrt(2 / pi) exp(-m^2 / (2 s^2)) + m erf(m / (s sqrt 2)); for s = 0 the score is
    # infinite and E|X| = m
    score = np.divide(mean, deviation, out=np.full_like(mean, np.inf), where=deviation > 0.0)
    folded = deviation * math.sqrt(2.0 / math.pi) * np.exp(-0.5 * score**2)
    folded += mean * erf(score / math.sqrt(2.0))
    return np.asarray(folded)


def log_likelihood(
    curve: StiffnessCurve,
    data: LoadDisplacementData,
    young_modulus_factor: ArrayLike,
    *,
    measure: Measure = "displacement",
    zero_offset_standard_deviation: float = 0.0,
) -> Float:
    """Return the log likelihood (N,) of all pairs of load and displacement at N values of e.

    The pairs are independent, but for an offset of the displacement's zero that the pairs of a
    loading run have in common.

    Parameters
    ----------
    curve, data, young_modulus_factor, measure
        As in `pair_log_likelihoods`.
    zero_offset_standard_deviation : float
        The standard deviation of the displacement's zero offset that the pairs of a loading run
        share [m]. With an offset, the measure "ratio" is not a likelihood.
    """
    log_likelihoods = pair_log_likelihoods(curve, data, young_modulus_factor, measure).sum(axis=0)
    k = curve.stiffness(np.atleast_1d(young_modulus_factor))
    variance = residual_variance(data, k)
    offset_variance = (k * zero_offset_standard_deviation) ** 2  # as a load
    # The covariance of a run is variance * I + offset_variance * 1 1'. Its inverse follows from the
    # formula of Sherman and Morrison, its determinant from the eigenvalue along 1.
    for run in data.run_indices:
        is_in_run = data.run == run
        eigenvalue = variance + is_in_run.sum() * offset_variance
        residual_sum = data.load[is_in_run].sum() - k * data.displacement[is_in_run].sum()
        explained = offset_variance * residual_sum**2 / (variance * eigenvalue)
        log_likelihoods += 0.5 * (explained - np.log(eigenvalue / variance))
    return np.asarray(log_likelihoods)


def exact_posterior(
    data: LoadDisplacementData,
    *,
    curve: StiffnessCurve = PUBLISHED_LINE,
    prior: GaussianPrior | None = None,
    measure: Measure = "displacement",
    zero_offset_standard_deviation: float = 0.0,
) -> ScalarPosterior:
    """Return p(e | measured pairs) by quadrature on a grid that is adapted to the posterior.

    The first grid contains the prior and the estimate by each pair alone. It is narrowed until it
    spans ten standard deviations of the posterior on either side.

    Parameters
    ----------
    data, curve, measure, zero_offset_standard_deviation
        As in `log_likelihood`.
    prior : GaussianPrior, optional
        The prior of e; the paper's by default.

    Raises
    ------
    OutsideValidityError
        If more than 1e-4 of the posterior lies beyond the range of `curve`.
    """
    prior = prior or GaussianPrior()
    grid_lower, grid_upper = _first_grid_limits(data, curve, prior)
    lowest_allowed = grid_lower
    for _ in range(_MOST_REFINEMENTS):
        grid = np.linspace(grid_lower, grid_upper, GRID_SIZE)
        log_density = prior.log_density(grid) + log_likelihood(
            curve,
            data,
            grid,
            measure=measure,
            zero_offset_standard_deviation=zero_offset_standard_deviation,
        )
        posterior = ScalarPosterior(grid, np.exp(log_density - log_density.max()))
        spacing = (grid_upper - grid_lower) / (GRID_SIZE - 1)
        half_width = _REACH * max(posterior.standard_deviation, spacing)
        narrower_lower = max(posterior.mean - half_width, lowest_allowed)
        narrower_upper = posterior.mean + half_width
        # The grid fits the posterior once a further step would hardly narrow it.
        if narrower_upper - narrower_lower > 0.99 * (grid_upper - grid_lower):
            break
        grid_lower, grid_upper = narrower_lower, narrower_upper
    _refuse_posterior_outside(posterior, curve)
    return posterior


def _first_grid_limits(
    data: LoadDisplacementData, curve: StiffnessCurve, prior: GaussianPrior
) -> tuple[float, float]:
    """Return a wide range of e that contains the prior and the estimate of each pair.

    A pair estimates the stiffness by load over displacement, within six standard deviations. The
    lower limit keeps the stiffness k(e) positive.
    """
    stiffness = data.load / data.displacement
    relative_deviation = (
        data.load_standard_deviation / data.load
        + data.displacement_standard_deviation / data.displacement
    )
    relative_reach = 6.0 * relative_deviation
    lower_stiffness = stiffness * np.maximum(1.0 - relative_reach, 0.01)
    upper_stiffness = stiffness * (1.0 + relative_reach)
    estimates = curve.young_modulus_factor(np.concatenate([lower_stiffness, upper_stiffness]))
    prior_reach = _REACH * prior.standard_deviation
    lower = min(prior.mean - prior_reach, estimates.min())
    upper = max(prior.mean + prior_reach, estimates.max())
    least_positive = curve.young_modulus_factor(1e-3 * stiffness.min())
    return max(lower, least_positive), upper


def _refuse_posterior_outside(posterior: ScalarPosterior, curve: StiffnessCurve) -> None:
    """Raise `OutsideValidityError` if a posterior exceeds the range of the stiffness curve."""
    below_lower, below_upper = posterior.cumulative([curve.lower, curve.upper])
    outside = 1.0 - float(below_upper - below_lower)
    if outside > _LARGEST_PROBABILITY_OUTSIDE:
        raise OutsideValidityError(
            f"{outside:.2%} of the posterior e = {posterior.mean:.4g} +- "
            f"{posterior.standard_deviation:.2g} lies outside [{curve.lower:g}, {curve.upper:g}], "
            f"the range in which {curve.name} holds; build the model for a wider range of e, or "
            "check units and prior."
        )


class FitQuality(NamedTuple):
    """Residuals of the measured pairs for one stiffness.

    Attributes
    ----------
    standardised_residual : (N,) array
        (k x - f) / sqrt(R_f + k^2 R_x) [1]; positive where the wing bends more than the model.
    remarks : tuple of str
        Sentences on what disagrees; empty if nothing does.
    """

    standardised_residual: Float
    remarks: tuple[str, ...]


class _RunOffset(NamedTuple):
    """The mean residual displacement of a loading run, with its standard error [m]."""

    number: int
    mean: float
    standard_error: float


def assess_fit(data: LoadDisplacementData, stiffness: float) -> FitQuality:
    """Return the residuals of the measured pairs for a tip stiffness [N/m], and remarks on them."""
    load_deviation = math.sqrt(float(residual_variance(data, stiffness)))
    residual = data.displacement - data.load / stiffness
    standardised = residual * stiffness / load_deviation
    offsets = []
    for run in data.run_indices:
        run_residual = residual[data.run == run]
        error = load_deviation / stiffness / math.sqrt(run_residual.size)
        offsets.append(_RunOffset(run + 1, float(run_residual.mean()), error))
    remarks = [*_run_remarks(offsets), *_pair_remarks(data, standardised)]
    return FitQuality(standardised, tuple(remarks))


def _run_remarks(offsets: Sequence[_RunOffset]) -> list[str]:
    """Return remarks on consecutive runs whose mean residuals differ significantly."""
    remarks = []
    for run, next_run in pairwise(offsets):
        difference = abs(run.mean - next_run.mean)
        deviation = math.hypot(run.standard_error, next_run.standard_error)
        if difference > NOTICEABLE_SCORE * deviation:
            remark = (
                f"Loading runs {run.number} and {next_run.number} differ by {difference * 1e3:.2f} "
                f"mm ({difference / deviation:.1f} standard deviations): their offsets are "
                f"{run.mean * 1e3:+.2f} mm and {next_run.mean * 1e3:+.2f} mm, as if the zero of "
                "the displacement had moved between them."
            )
            remarks.append(remark.replace("-", "−"))
    return remarks


def _pair_remarks(data: LoadDisplacementData, standardised: Float) -> list[str]:
    """Return remarks on pairs whose standardised residuals (N,) are significant."""
    remarks = []
    for index in np.flatnonzero(np.abs(standardised) > NOTICEABLE_SCORE):
        remarks.append(
            f"Pair {index + 1} ({data.load[index]:.3g} N, {data.displacement[index] * 1e3:.3g} mm) "
            f"lies {abs(standardised[index]):.1f} standard deviations from the calibrated line."
        )
    return remarks
