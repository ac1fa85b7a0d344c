"""The joint posterior of a wing's stiffness, masses and damping, by importance sampling."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError, MassConstraintError, OutsideValidityError, PosteriorError
from calibration.result.record import ParameterPrior
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import GaussianPrior, check_count, child_seed
from fe.runtime.reduced import ReducedModel

from .density import JointDensity, masses_of
from .frequency_table import WingTables, tabulate_wing
from .measurement import ModalMeasurement
from .prior import ModelError, WeighedMass, wing_priors
from .sampler import (
    StudentT,
    adapted_proposal,
    effective_sample_size,
    normalised,
    systematic_resampling,
)

LEAST_EFFECTIVE_SAMPLE_SIZE = 200.0
"""A posterior that the weighted draws describe with fewer effective ones is refused."""

_LIMIT_MARGIN = 0.01  # of the range of e
_LARGEST_SHARE_AT_LIMIT = 0.05
_ADAPTATION_ROUNDS = 3
_ADAPTATION_COUNT = 1000
_PROPOSALS_PER_SAMPLE = 20
_MOST_SAMPLES = 100_000  # the proposals of more do not fit into memory
_FEWEST_PROPOSALS = 4_000
_PURPOSE = 22  # of the seed

FloatArray = NDArray[np.float64]


class JointDraws(NamedTuple):
    """p(e, masses, Rayleigh coefficients | load test, weighed total, ring-down) as samples.

    Attributes
    ----------
    samples : (N, 5) array
        Equally weighted samples of the parameters in SI units, in no order.
    mean, standard_deviation : (5,) array
        Of all weighted draws, closer to the posterior's than those of the samples [SI].
    proposals : int
        Weighted draws from which the samples were taken.
    effective : float
        (sum w)^2 / sum w^2 of their weights.
    log_evidence : float
        Log of the probability density of all measurements under priors and model error.
    """

    samples: FloatArray
    mean: FloatArray
    standard_deviation: FloatArray
    proposals: int
    effective: float
    log_evidence: float


def joint_posterior(
    model: ReducedModel | WingTables,
    static: LoadDisplacementData,
    modal: ModalMeasurement,
    *,
    priors: tuple[ParameterPrior, ...] | None = None,
    total_mass: WeighedMass | None = None,
    model_error: ModelError | None = None,
    seed: int = 0,
    count: int = 1000,
) -> JointDraws:
    """Return the posterior of e, masses and Rayleigh coefficients, given all measurements at once.

    The likelihoods are in `calibration.joint.density`; that of the load test is exact (errors in both
    variables) with k(e) of the same model. Samples are taken by importance sampling from a Student-t density
    that follows the posterior of e and the masses; alpha and beta are drawn from their exact conditional.

    Parameters
    ----------
    model : ReducedModel or WingTables
        The wing; the tables of `tabulate_wing` spare a fifth of a second where many posteriors are wanted.
    static : LoadDisplacementData
        The load test.
    modal : ModalMeasurement
        The ring-down.
    priors : tuple of ParameterPrior, optional
        `wing_priors` of the model by default.
    total_mass : WeighedMass, optional
        2 m_servo + m_pitot as weighed; 0.472 kg ± 1 g by default.
    model_error : ModelError, optional
        Relative standard deviation of the model's two frequencies; 1 and 5 % by default. Zero trusts them.
    seed : int
        The same seed gives the same samples.
    count : int
        Number of samples.

    Raises
    ------
    MassConstraintError
        If no masses within the model's range keep the weighed total.
    ExperimentDataError
        If weighed total or model error make no sense, or the damping ratios need negative coefficients.
    OutsideValidityError
        If the load test alone puts e outside the model, or all measurements together press it against the
        end of the model's range.
    PosteriorError
        If `count` is not 1 to 100,000, a prior lies outside its range, or the measurements contradict each
        other so much that the sampler finds no posterior.
    """
    total_mass = WeighedMass() if total_mass is None else total_mass
    model_error = ModelError() if model_error is None else model_error
    check_count(count, PosteriorError, most=_MOST_SAMPLES)
    _check(total_mass, model_error)
    tables = model if isinstance(model, WingTables) else tabulate_wing(model)
    priors = wing_priors(tables.validity) if priors is None else priors
    normaliser = sum(prior.log_share_inside for prior in priors)
    density = JointDensity(tables, static, modal, total_mass, priors, model_error)
    generator = np.random.default_rng(child_seed(seed, _PURPOSE))
    proposal = adapted_proposal(
        density, _begun(density), generator, rounds=_ADAPTATION_ROUNDS, count=_ADAPTATION_COUNT
    )
    proposals = max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    quantities, log_weight = _weighted(density, proposal, generator, proposals)
    weight, log_mean = normalised(log_weight)
    effective = effective_sample_size(weight) if math.isfinite(log_mean) else 0.0
    if effective < LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(
            f"only {effective:.0f} of {proposals} draws describe the joint posterior: load test, weighed "
            "total and frequencies contradict each other within the model's range; check them, or allow "
            "the model a larger error of its frequencies."
        )
    _refuse_limit(quantities[:, 0], weight, priors[0])
    mean = weight @ quantities
    return JointDraws(
        samples=quantities[systematic_resampling(weight, generator, count)],
        mean=mean,
        standard_deviation=np.sqrt(weight @ (quantities - mean) ** 2),
        proposals=proposals,
        effective=effective,
        log_evidence=log_mean + math.log(len(quantities) / proposals) - normaliser,
    )


def _weighted(
    density: JointDensity, proposal: StudentT, generator: np.random.Generator, proposals: int
) -> tuple[FloatArray, FloatArray]:
    """Return draws (N, 5) within the model and the logs of their weights (N,)."""
    points, log_proposal = proposal.draw(generator, proposals)
    standard = generator.standard_normal((proposals, 2))
    inside = density.inside(points)
    points, standard, log_proposal = points[inside], standard[inside], log_proposal[inside]
    logarithm, damping = density.log_density(points)
    factor = np.linalg.cholesky(damping.covariance)
    coefficients = damping.mean + (factor @ standard[..., None])[..., 0]
    positive = (coefficients >= 0.0).all(axis=1)
    if np.mean(positive) < 0.01:
        first, second = density.modal.damping_ratio
        raise ExperimentDataError(
            f"damping ratios {first:g} and {second:g} need a negative "
            "Rayleigh coefficient, but neither may be negative; check the ring-down records."
        )
    quantities = np.column_stack([masses_of(points), coefficients])
    return quantities, np.where(positive, logarithm - log_proposal, -np.inf)


def _refuse_limit(factor: FloatArray, weight: FloatArray, prior: ParameterPrior) -> None:
    margin = _LIMIT_MARGIN * (prior.high - prior.low)
    for limit in (prior.low, prior.high):
        share = float(weight[np.abs(factor - limit) < margin].sum())
        if share > _LARGEST_SHARE_AT_LIMIT:
            raise OutsideValidityError(
                f"{share:.0%} of the joint posterior of e is pressed against {limit:g}, where the model "
                "ends: load test and frequencies contradict each other; check them, or allow the model a "
                "larger error of its frequencies."
            )


def _check(total_mass: WeighedMass, model_error: ModelError) -> None:
    if not all(math.isfinite(value) and value > 0.0 for value in total_mass):
        raise ExperimentDataError(
            f"the weighed total and its standard deviation must be positive and finite, but "
            f"{total_mass.mass:g} kg and {total_mass.standard_deviation:g} kg were given."
        )
    if not all(math.isfinite(value) and 0.0 <= value < 1.0 for value in model_error.frequency):
        raise ExperimentDataError(
            "the model error of a frequency is a relative standard deviation from 0 to below 1 (not "
            f"percent), but {' and '.join(f'{value:g}' for value in model_error.frequency)} were given."
        )


def servo_range(validity: Mapping[str, tuple[float, float]], total_mass: float) -> tuple[float, float]:
    """Return least and greatest mass of a servo with which a model can keep the weighed total [kg].

    Raises
    ------
    MassConstraintError
        If there is none.
    """
    servo, pitot = validity["servo_mass"], validity["pitot_mass"]
    lower = max(servo[0], 0.5 * (total_mass - pitot[1]))
    upper = min(servo[1], 0.5 * (total_mass - pitot[0]))
    if not (math.isfinite(total_mass) and lower < upper):
        least, greatest = 2.0 * servo[0] + pitot[0], 2.0 * servo[1] + pitot[1]
        raise MassConstraintError(
            f"two servos and the pitot tube cannot weigh {total_mass:g} kg: the model takes totals between "
            f"{least:g} and {greatest:g} kg."
        )
    return lower, upper


def _begun(density: JointDensity) -> StudentT:
    """Return where the search of (e, s, t) begins: the best servo mass at the e of the load test alone."""
    total, prior = density.total_mass, density.priors[0]
    lower, upper = servo_range(density.tables.validity, total.mass)
    alone = exact_posterior(
        density.static, curve=density.tables.stiffness, prior=GaussianPrior(prior.mean, prior.deviation)
    )
    factor = min(max(alone.mean, prior.low + 1e-6), prior.high - 1e-6)
    candidates = np.array([(factor, mass, total.mass) for mass in np.linspace(lower, upper, 67)[1:-1]])
    scale = np.array([alone.standard_deviation, 0.05 * (upper - lower), total.standard_deviation])
    return StudentT(candidates[int(np.argmax(density(candidates)))], np.diag(scale**2))
