r"""The exact posterior of the Young's modulus factor: both load and displacement are read with errors.

The wing obeys f° = k(e) x°, with true load f° and true displacement x°; the readings are f ~ N(f°, R_f)
and x ~ N(x°, R_x), independent. For one pair and a flat prior on the true displacement,

    L(e) = ∫ N(f; k x°, R_f) N(x; x°, R_x) dx°.

Given e, f - k x = (f - f°) - k (x - x°) is free of x°, so the integrand, as a function of x°, is a Gaussian
in x° times a factor without x°; the integral over the line of the Gaussian in x° is one and leaves

    L(e) = N(f - k(e) x; 0, S(e)),   S(e) = R_f + k(e)^2 R_x,

with its normalising factor S^(-1/2), which depends on e and must stay. (Completing the square: the exponent
is (f - k x)^2 / S + (x° - x̂)^2 / V with x̂ = (x R_f + k f R_x) / S and V = R_x R_f / S, and
sqrt(R_f R_x) = sqrt(S V).)

"Flat" is not one prior. Flat in the true load instead of the true displacement, dx° = df° / k, gives
L(e) k(e). And the density of e = k^-1(f° / x°) for f°, x° drawn about the readings, which the paper's
particle filter takes for the likelihood, is (Hinkley 1969)

    p(e) = |dk/de| ∫ |x°| N(k x°; f, R_f) N(x°; x, R_x) dx° = |dk/de| E|X| N(f - k x; 0, S),  X ~ N(x̂, V).

All three are offered as `measure`; on the published pairs their means lie within 0.0014 of each other.

A zero offset c_r ~ N(0, R_0) that all displacements of one loading run share can be integrated out as well:
the residuals of a run then have the covariance S I + k^2 R_0 1 1'.
"""

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from calibration.errors import OutsideValidityError, said
from reporting.arrays import Float

from .experiments import LoadDisplacementData
from .posterior import PUBLISHED_LINE, GaussianPrior, ScalarPosterior, StiffnessCurve

Measure = Literal["displacement", "load", "ratio"]
"""In which quantity of a pair the prior is flat: true displacement, true load, or the paper's ratio."""

GRID_SIZE = 2001
"""Points of the posterior's grid, over +-10 standard deviations."""

NOTICEABLE_SCORE = 2.0
"""Standard deviations from which a difference between runs, or a pair, is pointed out."""

_REACH = 10.0  # standard deviations
_LARGEST_PROBABILITY_OUTSIDE = 1e-4


def residual_variance(data: LoadDisplacementData, stiffness: ArrayLike) -> Float:
    """Return S = R_f + k^2 R_x [N^2], elementwise in the stiffness [N/m]."""
    k = np.asarray(stiffness, dtype=float)
    return np.asarray(data.load_standard_deviation**2 + (k * data.displacement_standard_deviation) ** 2)


def pair_log_likelihoods(
    curve: StiffnessCurve,
    data: LoadDisplacementData,
    young_modulus_factor: ArrayLike,
    measure: Measure = "displacement",
) -> Float:
    """Return the log likelihood of each pair; as "ratio" the limit of the paper's kernel likelihoods.

    Parameters
    ----------
    curve : StiffnessCurve
        k(e).
    data : LoadDisplacementData
        The measured pairs.
    young_modulus_factor : (N,) array
        Values of e.
    measure : {"displacement", "load", "ratio"}
        See the module's docstring.

    Returns
    -------
    (n_pairs, N) array, log of 1/N
    """
    factor = np.atleast_1d(np.asarray(young_modulus_factor, dtype=float))
    k, load, displacement = curve.stiffness(factor), data.load[:, None], data.displacement[:, None]
    variance = residual_variance(data, k)
    likelihood = -0.5 * ((load - k * displacement) ** 2 / variance + np.log(2.0 * math.pi * variance))
    if measure == "load":
        likelihood += np.log(k)
    if measure == "ratio":
        load_variance, own = data.load_standard_deviation**2, data.displacement_standard_deviation**2
        centre = (displacement * load_variance + k * load * own) / variance
        spread = np.sqrt(load_variance * own / variance)
        # E|X| of X ~ N(centre, spread^2), the mean of the folded Gaussian.
        standard = np.divide(centre, spread, out=np.full_like(centre, np.inf), where=spread > 0.0)
        folded = spread * math.sqrt(2.0 / math.pi) * np.exp(-0.5 * standard**2)
        folded += centre * erf(standard / math.sqrt(2.0))
        likelihood += np.log(folded) + np.log(curve.slope(factor))
    return np.asarray(likelihood)


def log_likelihood(
    curve: StiffnessCurve,
    data: LoadDisplacementData,
    young_modulus_factor: ArrayLike,
    *,
    measure: Measure = "displacement",
    zero_offset_standard_deviation: float = 0.0,
) -> Float:
    """Return the log likelihood (N,) of all pairs.

    Parameters
    ----------
    curve, data, young_modulus_factor, measure
        As in `pair_log_likelihoods`.
    zero_offset_standard_deviation : float
        Standard deviation of the zero offset of the displacement that a loading run shares [m]; of the ratio
        there is no likelihood with one.
    """
    total = pair_log_likelihoods(curve, data, young_modulus_factor, measure).sum(axis=0)
    k = curve.stiffness(np.atleast_1d(young_modulus_factor))
    variance = residual_variance(data, k)
    shared = (k * zero_offset_standard_deviation) ** 2
    for run in data.run_indices:
        of_run = data.run == run
        whole = variance + of_run.sum() * shared  # Sherman and Morrison
        residual = data.load[of_run].sum() - k * data.displacement[of_run].sum()
        total += 0.5 * (shared * residual**2 / (variance * whole) - np.log(whole / variance))
    return np.asarray(total)


def exact_posterior(
    data: LoadDisplacementData,
    *,
    curve: StiffnessCurve = PUBLISHED_LINE,
    prior: GaussianPrior | None = None,
    measure: Measure = "displacement",
    zero_offset_standard_deviation: float = 0.0,
) -> ScalarPosterior:
    """Return p(e | measured pairs) by quadrature on a grid that follows the posterior.

    The grid begins wide enough for the prior and for each pair alone, and is narrowed until it spans ten
    standard deviations of the posterior on either side.

    Parameters
    ----------
    data, curve, measure, zero_offset_standard_deviation
        As in `log_likelihood`.
    prior : GaussianPrior, optional
        Prior of e; the paper's by default.

    Raises
    ------
    OutsideValidityError
        If more than 1e-4 of the posterior lies beyond the range of `curve`.
    """
    prior = prior or GaussianPrior()
    # the first window holds the prior and the estimate of each pair alone, where k(e) > 0
    ratio = data.load / data.displacement
    relative = data.load_standard_deviation / data.load
    relative = 6.0 * (relative + data.displacement_standard_deviation / data.displacement)
    ends = np.concatenate([ratio * np.maximum(1.0 - relative, 0.01), ratio * (1.0 + relative)])
    alone = curve.young_modulus_factor(ends)
    beyond = _REACH * prior.standard_deviation
    lower, upper = min(prior.mean - beyond, alone.min()), max(prior.mean + beyond, alone.max())
    floor = lower = max(lower, curve.young_modulus_factor(1e-3 * ratio.min()))
    for _ in range(60):
        grid = np.linspace(lower, upper, GRID_SIZE)
        log_density = prior.log_density(grid) + log_likelihood(
            curve, data, grid, measure=measure, zero_offset_standard_deviation=zero_offset_standard_deviation
        )
        posterior = ScalarPosterior(grid, np.exp(log_density - log_density.max()))
        spacing = (upper - lower) / (GRID_SIZE - 1)
        reach = _REACH * max(posterior.standard_deviation, spacing)
        narrower = max(posterior.mean - reach, floor), posterior.mean + reach
        if narrower[1] - narrower[0] > 0.99 * (upper - lower):
            break
        lower, upper = narrower
    outside = 1.0 - float(np.diff(posterior.cumulative([curve.lower, curve.upper]))[0])
    if outside > _LARGEST_PROBABILITY_OUTSIDE:
        shown = said("load_test.outside", posterior=posterior, outside=outside, curve=curve)
        raise OutsideValidityError(shown)
    return posterior


class FitQuality(NamedTuple):
    """Residuals of the measured pairs at one stiffness.

    Attributes
    ----------
    standardised_residual : (N,) array
        (k x - f) / sqrt(R_f + k^2 R_x) [1]; positive where the wing bends more than the model.
    remarks : tuple of str
        Sentences on what disagrees; empty if nothing does.
    """

    standardised_residual: Float
    remarks: tuple[str, ...]


def assess_fit(data: LoadDisplacementData, stiffness: float) -> FitQuality:
    """Judge the measured pairs, run by run, at one stiffness [N/m]."""
    scatter = math.sqrt(float(residual_variance(data, stiffness)))
    residual = data.displacement - data.load / stiffness
    standardised = residual * stiffness / scatter
    runs = []
    for index in data.run_indices:
        of_run = residual[data.run == index]
        runs.append((index + 1, float(of_run.mean()), scatter / stiffness / math.sqrt(of_run.size)))
    remarks = []
    for (first, offset, error), (second, other, other_error) in pairwise(runs):
        difference, deviation = abs(offset - other), math.hypot(error, other_error)
        if difference > NOTICEABLE_SCORE * deviation:
            apart = difference * 1e3, difference / deviation, offset * 1e3, other * 1e3
            told = said("disagreements.runs", runs=(first, second), apart=apart)
            remarks.append(told.replace("-", "−"))
    for pair in np.flatnonzero(np.abs(standardised) > NOTICEABLE_SCORE):
        read = pair + 1, data.load[pair], data.displacement[pair] * 1e3
        remarks.append(said("disagreements.pair", read=read, off=abs(standardised[pair])))
    return FitQuality(standardised, tuple(remarks))
