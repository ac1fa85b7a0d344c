"""The posterior of a wing's stiffness, masses and damping under all its readings together.

Unknown are e, the servo mass s, the pitot mass p and the Rayleigh coefficients (alpha, beta). Known are the
load test, the weighed total T of 2 s + p, and frequencies y and damping ratios z of two modes. With the
model's frequencies f_i(e, s, p) and relative model errors delta_i ~ N(0, tau_i^2), which leave in closed
form,

    T ~ N(2 s + p, s_T^2),   y_i ~ N(f_i, s_i^2 + tau_i^2 f_i^2),   z_i ~ N(zeta_i, r_i^2),

zeta_i by Kapteyn et al. 2021, eq. (18), at the model's own frequencies, as in eq. (25): the coefficients
belong to the model and give *its* modes the measured damping. Pairs of the load test have errors in both
readings (`calibration.static.errors_in_variables`).

Before it: what the ring-down says of the two flapwise modes, with all that makes it uncertain.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtri, softmax
from scipy.stats import multivariate_t

from calibration.dynamics.damped_cosine import DampedCosines, RingDownMode
from calibration.dynamics.trials import (
    PUBLISHED_DAMPING_RATIOS,
    PUBLISHED_FREQUENCIES,
    Fits,
    RingDownFit,
    amplitude_dependence,
)
from calibration.errors import ExperimentDataError, OutsideValidityError, PosteriorError, said
from calibration.joint.wing_table import MODEL_ERROR, QUANTITIES, WingTable, wing_priors
from calibration.result.record import ParameterPrior, Reading
from calibration.static.errors_in_variables import exact_posterior, residual_variance
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import GaussianPrior, Seed, child_seed
from reporting.arrays import Float

MODAL = ("frequency_1", "frequency_2", "damping_ratio_1", "damping_ratio_2")
"""What a ring-down tells of a wing."""

_NAMES = ("frequency", "damping_ratio")
_SIGNIFICANT_SCATTER = 0.95
_SIGNIFICANT_DIFFERENCE = 2.0  # standard errors
_LATER_STARTS = (0.04, 0.08)  # s; one and two and a half periods of the second mode
_FEWEST_WINDOWS = 6
_SAME_MODE = 0.2  # relative change of its frequency beyond which a fit has found something else
_VISIBLE = 1.0  # amplitude of the second mode at the later start, over the residuals


def modal_readings(values: Sequence[float], deviations: Sequence[float]) -> tuple[Reading, ...]:
    """Return readings of f1, f2 [Hz], zeta1 and zeta2 [1].

    Raises
    ------
    ExperimentDataError
        If an uncertainty comes out as zero, as for a drawn record without noise.
    """
    for name, value, deviation in zip(MODAL, values, deviations, strict=True):
        if not deviation > 0.0:
            raise ExperimentDataError(said("joint.positive", name=name, value=value))
    return tuple(map(Reading, MODAL, ["ring-down"] * 4, values, deviations))


def measured_modes(trials: Fits) -> tuple[Reading, ...]:
    """Return mean frequencies and damping ratios of fitted trials, statistical and systematic uncertainty.

    *Statistical*: the standard error of the mean over the trials, from the least-squares fits; where the
    trials scatter more than these explain (chi-square at 5 %), from their scatter, widened as Student's t.

    *Systematic*, added in quadrature. Each term counts only where it exceeds twice its own standard error,
    so that a linear wing is given none by chance:

    - the first mode over the amplitude: frequency and damping ratio of sliding windows against the logarithm
      of the amplitude, the slope times the spread of the amplitude. The linear model stands for a wing that
      softens, and no single amplitude is the right one;
    - the second mode over the choice of the fit: both modes fitted anew with free frequencies, from where the
      record was cropped (only if the frequencies had been taken from the spectrum) and from 40 and 80 ms
      later; root mean square of what these differ by.

    Parameters
    ----------
    trials : Fits
        Fitted records, by `calibration.dynamics.trials.fit_trials`.

    Raises
    ------
    ExperimentDataError
        As `modal_readings`.
    """
    means = [_mean_of([fit.modes[mode] for fit in trials], name) for name in _NAMES for mode in (0, 1)]
    softening = _amplitude_terms(trials)
    choice = _choice_terms(trials, means[1][0], means[3][0])
    systematic = softening[0], choice[0], softening[1], choice[1]
    deviations = [math.hypot(error, term) for (_, error), term in zip(means, systematic, strict=True)]
    return modal_readings([mean for mean, _ in means], deviations)


def _mean_of(modes: Sequence[RingDownMode], name: str) -> tuple[float, float]:
    """Return the mean of the trials and its standard error."""
    values, errors = [getattr(item, name) for item in modes], [item.standard_error[name] for item in modes]
    count = len(values)
    mean = math.fsum(values) / count
    expected = math.fsum(error**2 for error in errors) / count
    found = math.fsum((value - mean) ** 2 for value in values)  # (count - 1) times the variance
    if count > 1 and found > expected * float(chdtri(count - 1, 1.0 - _SIGNIFICANT_SCATTER)):
        # The variance of Student's t with n - 1 degrees; up to three trials it has none, take three's twice.
        widening = (count - 1) / (count - 3) if count > 3 else 4.0
        return mean, math.sqrt(widening * found / (count - 1) / count)
    return mean, math.sqrt(expected / count)


def _amplitude_terms(trials: Fits) -> tuple[float, float]:
    """Return what the amplitude does to frequency [Hz] and damping ratio [1] of the first mode."""
    points = [point for fit in trials for point in amplitude_dependence(fit)]
    if len(points) < _FEWEST_WINDOWS:
        return 0.0, 0.0
    logarithm = np.log([point.amplitude for point in points])
    logarithm -= logarithm.mean()
    spread = float(logarithm.std())
    if not spread > 0.0:
        return 0.0, 0.0
    terms = []
    for name in _NAMES:
        value = np.array([getattr(point, name) for point in points])
        slope = float(logarithm @ value / (logarithm @ logarithm))
        rest = value - value.mean() - slope * logarithm
        # Windows overlap by half: two of them count as one.
        error = math.sqrt(2.0 * float(rest @ rest) / (len(points) - 2) / float(logarithm @ logarithm))
        terms.append(_beyond_chance(slope * spread, error * spread))
    return terms[0], terms[1]


def _choice_terms(trials: Fits, frequency: float, ratio: float) -> tuple[float, float]:
    """Return what the choice of the fit does to frequency [Hz] and damping ratio [1] of the second mode."""
    delays = (*(() if trials[0].free else (0.0,)), *_LATER_STARTS)
    terms = []
    for delay in delays:
        found = [refitted for fit in trials if (refitted := _refit(fit, delay)) is not None]
        if len(found) < len(trials):
            continue  # the mode has died away by then
        others = [_mean_of(found, name) for name in _NAMES]
        pairs = zip(others, (frequency, ratio), strict=True)
        terms.append([_beyond_chance(other - first, error) for (other, error), first in pairs])
    if not terms:
        return 0.0, 0.0
    square = np.mean(np.square(terms), axis=0)
    return math.sqrt(float(square[0])), math.sqrt(float(square[1]))


def _beyond_chance(difference: float, error: float) -> float:
    if abs(difference) <= _SIGNIFICANT_DIFFERENCE * error:
        return 0.0
    return math.sqrt(difference**2 - error**2)


def _refit(fit: RingDownFit, delay: float) -> RingDownMode | None:
    """Return the second mode of a record begun later, or None where it is gone by then."""
    record = fit.record
    after = record.time >= record.time[0] + delay
    model = DampedCosines(record.time[after], record.signal[after], record.averaging_width)
    solution = model.fit(np.array([mode.pole for mode in fit.modes]))
    found, before = solution.modes[1], fit.modes[1]
    same = abs(found.damped_frequency / before.damped_frequency - 1.0) < _SAME_MODE
    decays = 0.0 < -found.pole.real < found.pole.imag
    return found if same and decays and found.amplitude >= _VISIBLE * float(solution.deviation[0]) else None


PUBLISHED_MODES = modal_readings(
    (*PUBLISHED_FREQUENCIES, *PUBLISHED_DAMPING_RATIOS), (0.062, 0.63, 0.0039, 0.0162)
)
"""The published means of the five trials, with the uncertainty that our records of them show.

The paper gives no uncertainty. These are the standard deviations that `measured_modes` finds in the same five
trials read off the published plots, frequencies from the spectral peaks as in the paper.
"""


Comparison = Callable[[Float], tuple[Float, Float]]
"""Parameters (N, P) within their ranges to differences (N, R) and their standard deviations (N, R)."""

LEAST_EFFECTIVE_SAMPLE_SIZE = 200.0
"""A posterior that the weighted draws describe with fewer effective ones is refused."""

_FREEDOM = 10.0  # of the Student-t proposals: tails heavier than those of the posterior, a cut-off Gaussian
_INFLATION = 1.05  # of the proposal's covariance over the posterior's
_PILOT_COUNT, _PROPOSALS_PER_SAMPLE, _FEWEST_PROPOSALS = 2_000, 20, 4_000
_INSIDE = 0.1  # prior deviations from an end of the range at which the search begins at least
_PURPOSE = 22  # of the seed


def infer(
    priors: tuple[ParameterPrior, ...], compare: Comparison, *, seed: Seed = 0, count: int = 1000
) -> Float:
    """Return equally weighted samples (count, P) of the posterior under everything that was read [units].

    Proposals are Student-t densities in coordinates in which the posterior at its optimum is round, so that
    parameters of which the readings tell next to one combination alone are sampled as well as others. The
    first draws tell the moments for those that are kept.

    Parameters
    ----------
    priors : tuple of ParameterPrior
        Normal distributions, cut off at their ranges.
    compare : callable
        Differences of all readings from the model, and their standard deviations.
    seed : int or SeedSequence
        The same seed gives the same samples.
    count : int
        Number of samples.

    Raises
    ------
    PosteriorError
        If the readings contradict each other so much that no posterior is found.
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSE))
    mean, deviation, low, high = np.array(
        [(item.mean, item.deviation, item.low, item.high) for item in priors]
    ).T
    ends = (low - mean) / deviation, (high - mean) / deviation

    def values(u: Float) -> Float:
        # within the range to the last digit, whatever rounding does
        return np.asarray(np.clip(mean + deviation * u, low, high))

    def energy(u: Float) -> tuple[Float, Float]:
        """Return what is squared (N, R + P), and logs of scale (N,), at scaled parameters (N, P)."""
        difference, spread = compare(values(u))
        return np.hstack([difference / spread, u]), np.log(spread).sum(axis=1)

    start = np.clip(0.0, ends[0] + _INSIDE, ends[1] - _INSIDE)
    best = least_squares(lambda u: energy(u[None])[0][0], start, bounds=ends, x_scale="jac")
    _, singular, rows = np.linalg.svd(best.jac, full_matrices=False)
    stretch = rows / singular[:, None]

    def drawn(centre: Float, covariance: Float, size: int) -> tuple[Float, Float]:
        """Return draws in round coordinates (N, P) and their weights (N,)."""
        proposal = multivariate_t(centre, covariance, _FREEDOM)
        points = proposal.rvs(size, generator).reshape(size, -1)
        u = best.x + points @ stretch
        squared, scale = energy(u)
        log_weight = -0.5 * np.sum(squared**2, axis=1) - scale - proposal.logpdf(points)
        return points, softmax(np.where(np.all((u >= ends[0]) & (u <= ends[1]), axis=1), log_weight, -np.inf))

    points, weight = drawn(np.zeros(len(priors)), np.eye(len(priors)), _PILOT_COUNT)
    covariance = _INFLATION * np.cov(points.T, aweights=weight)
    proposals = max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    points, weight = drawn(weight @ points, covariance, proposals)
    effective = 1.0 / float(np.sum(weight**2))
    if not effective >= LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(said("joint.effective", effective=effective, proposals=proposals))
    chosen = np.searchsorted(np.cumsum(weight), (np.arange(count) + generator.random()) / count)
    return values(best.x + points[generator.permutation(np.minimum(chosen, proposals - 1))] @ stretch)


_LIMIT_MARGIN = 0.01  # of the range of e
_LARGEST_SHARE_AT_LIMIT = 0.05
_HARDLY = 2.33  # standard deviations that one in a hundred exceeds


def joint_posterior(
    wing: WingTable,
    static: LoadDisplacementData,
    readings: Sequence[Reading],
    *,
    priors: tuple[ParameterPrior, ...] | None = None,
    model_error: tuple[float, float] = MODEL_ERROR,
    seed: int = 0,
    count: int = 1000,
) -> Float:
    """Return samples (count, 5) of e, masses and Rayleigh coefficients, given all measurements at once.

    Parameters
    ----------
    wing : WingTable
        The wing, by `tabulate_wing`.
    static : LoadDisplacementData
        The load test.
    readings : sequence of Reading
        The weighed mass and both modes are needed; what does not follow from the parameters is left aside.
    priors : tuple of ParameterPrior, optional
        `wing_priors` of the model by default.
    model_error : (float, float)
        Relative standard deviation of the model's two frequencies about the wing's. Zero trusts them.
    seed : int
        The same seed gives the same samples.
    count : int
        Number of samples.

    Raises
    ------
    ExperimentDataError
        If no masses within the model's range keep the weighed total, or the damping ratios need negative
        coefficients.
    OutsideValidityError
        If the load test alone puts e outside the model, or all measurements together press it against the
        end of the model's range.
    PosteriorError
        See `infer`.
    """
    priors = wing_priors(wing.validity) if priors is None else priors
    errors = {"frequency_1": model_error[0], "frequency_2": model_error[1]}
    columns = {figure.name: at for at, figure in enumerate(QUANTITIES[1:], start=1)}
    kept = {item.name: item for item in readings if item.name in columns}
    _refuse_negative(kept)
    servo_range(wing.validity, kept["weighed_mass"].value)
    exact_posterior(static, curve=wing.stiffness, prior=GaussianPrior(priors[0].mean, priors[0].deviation))
    read, spread = np.array([(item.value, item.deviation) for item in kept.values()]).T
    relative = np.array([errors.get(name, 0.0) for name in kept])
    places = [columns[name] for name in kept]

    def compare(states: Float) -> tuple[Float, Float]:
        outputs = wing.outputs(states)
        stiffness, shown = outputs[:, :1], outputs[:, places]
        pairs = static.load - stiffness * static.displacement
        scatter = np.broadcast_to(np.sqrt(residual_variance(static, stiffness)), pairs.shape)
        return np.hstack([pairs, read - shown]), np.hstack([scatter, np.hypot(spread, relative * shown)])

    samples = infer(priors, compare, seed=seed, count=count)
    limits = priors[0].low, priors[0].high
    for limit in limits:
        share = float(np.mean(np.abs(samples[:, 0] - limit) < _LIMIT_MARGIN * (limits[1] - limits[0])))
        if share > _LARGEST_SHARE_AT_LIMIT:
            raise OutsideValidityError(said("joint.limit", share=share, limit=limit))
    return samples


def _refuse_negative(readings: Mapping[str, Reading]) -> None:
    """Refuse damping ratios that hardly allow two coefficients of which neither is negative."""
    omega = 2.0 * math.pi * np.array([readings[f"frequency_{mode}"].value for mode in (1, 2)])
    inverse = np.linalg.inv(0.5 * np.column_stack([1.0 / omega, omega]))
    ratios = [readings[f"damping_ratio_{mode}"] for mode in (1, 2)]
    coefficients = inverse @ [item.value for item in ratios]
    spread = np.sqrt(inverse**2 @ [item.deviation**2 for item in ratios])
    if np.any(coefficients + _HARDLY * spread < 0.0):
        raise ExperimentDataError(said("joint.negative", ratios=ratios))


def servo_range(validity: Mapping[str, tuple[float, float]], total_mass: float) -> tuple[float, float]:
    """Return least and greatest mass of a servo with which a model can keep the weighed total [kg].

    Raises
    ------
    ExperimentDataError
        If there is none.
    """
    servo, pitot = validity["servo_mass"], validity["pitot_mass"]
    lower = max(servo[0], 0.5 * (total_mass - pitot[1]))
    upper = min(servo[1], 0.5 * (total_mass - pitot[0]))
    if not (math.isfinite(total_mass) and lower < upper):
        least, greatest = 2.0 * servo[0] + pitot[0], 2.0 * servo[1] + pitot[1]
        raise ExperimentDataError(said("joint.total", total=total_mass, ends=(least, greatest)))
    return lower, upper
