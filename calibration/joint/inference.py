"""The joint posterior of the digital state, by importance sampling from Laplace's approximation."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError, MassConstraintError, OutsideValidityError, PosteriorError
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import check_count, child_seed
from fe.runtime.reduced import ReducedModel

from .density import JointDensity, masses_of
from .frequency_table import WingTables, tabulate_wing
from .measurement import ModalMeasurement
from .prior import JointPrior, ModelError, WeighedMass
from .result import JointDiagnostics, JointPosterior
from .sampler import (
    Laplace,
    adapted_proposal,
    effective_sample_size,
    laplace,
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
_PURPOSE_PRIOR, _PURPOSE_POSTERIOR = 21, 22


def joint_posterior(
    model: ReducedModel | WingTables,
    static: LoadDisplacementData,
    modal: ModalMeasurement,
    *,
    prior: JointPrior | None = None,
    total_mass: WeighedMass | None = None,
    model_error: ModelError | None = None,
    seed: int = 0,
    count: int = 1000,
) -> JointPosterior:
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
    prior : JointPrior, optional
        `JointPrior()` by default.
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
        If `count` is not 1 to 100,000, or the measurements contradict each other so much that the sampler
        finds no posterior.
    """
    prior = prior or JointPrior()
    total_mass = WeighedMass() if total_mass is None else total_mass
    model_error = ModelError() if model_error is None else model_error
    check_count(count, PosteriorError, most=_MOST_SAMPLES)
    _check(total_mass, model_error)
    tables = model if isinstance(model, WingTables) else tabulate_wing(model)
    table, curve = tables.frequency, tables.stiffness
    density = JointDensity(table, curve, static, modal, total_mass, prior, model_error)
    validity = {
        name: (float(low), float(high))
        for name, (low, high) in zip(
            ("young_modulus_factor", "servo_mass", "pitot_mass"), table.limits, strict=True
        )
    }
    limits = prior.limits(validity)
    alone = exact_posterior(static, curve=curve, prior=prior.young_modulus_factor)
    approximation = _laplace(density, alone.mean, alone.standard_deviation)
    generator = np.random.default_rng(child_seed(seed, _PURPOSE_POSTERIOR))
    draws = _weighted_draws(
        density, approximation, generator, max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    )
    _refuse_limit(draws.quantities[:, 0], draws.weight, limits[0])
    mean = draws.weight @ draws.quantities
    spread = np.sqrt(draws.weight @ (draws.quantities - mean) ** 2)
    chosen = systematic_resampling(draws.weight, generator, count)
    mode, covariance = _five(density, approximation)
    return JointPosterior(
        samples=draws.quantities[chosen],
        prior_samples=prior.samples(validity, np.random.default_rng(child_seed(seed, _PURPOSE_PRIOR)), count),
        frequency=draws.frequency[chosen],
        prior=prior,
        total_mass=total_mass,
        model_error=model_error,
        modal=modal,
        static_source=static.source,
        static_sha256=static.sha256,
        diagnostics=JointDiagnostics(
            proposal_count=draws.proposals,
            effective_sample_size=draws.effective,
            distinct_samples=int(np.unique(chosen).size),
            laplace_mode=mode,
            laplace_covariance=covariance,
            weighted_mean=mean,
            weighted_standard_deviation=spread,
            log_evidence=draws.log_mean - prior.log_mass_inside(limits),
            frequency_table_error=table.error,
        ),
        seed=seed,
    )


class _Draws(NamedTuple):
    """Weighted draws of the five quantities.

    Attributes
    ----------
    quantities : (N, 5) array
        Young's modulus factor, masses [kg] and Rayleigh coefficients [1/s, s].
    frequency : (N, 2) array
        Of the model [Hz].
    weight : (N,) array
        Sums to one.
    proposals : int
        How many were drawn, also those outside the model, whose weight is zero and which are not kept.
    effective : float
        Effective number of draws.
    log_mean : float
        Log of the mean of the unnormalised weights of all proposals.
    """

    quantities: NDArray[np.float64]
    frequency: NDArray[np.float64]
    weight: NDArray[np.float64]
    proposals: int
    effective: float
    log_mean: float


def _weighted_draws(
    density: JointDensity, approximation: Laplace, generator: np.random.Generator, proposals: int
) -> _Draws:
    """Draw from a proposal adapted to the posterior, and weigh; refuse draws that do not describe it."""

    def log_density(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return _log_density(density, points)

    proposal = adapted_proposal(
        log_density, approximation, generator, rounds=_ADAPTATION_ROUNDS, count=_ADAPTATION_COUNT
    )
    points, log_proposal = proposal.draw(generator, proposals)
    standard = generator.standard_normal((proposals, 2))
    inside = density.inside(points)
    points, standard, log_proposal = points[inside], standard[inside], log_proposal[inside]
    logarithm, frequency, damping = density.log_density(points)
    factor = np.linalg.cholesky(damping.covariance)
    coefficients = damping.mean + (factor @ standard[..., None])[..., 0]
    positive = (coefficients >= 0.0).all(axis=1)
    if np.mean(positive) < 0.01:
        first, second = density.modal.damping_ratio
        raise ExperimentDataError(
            f"damping ratios {first:g} and {second:g} need a negative "
            "Rayleigh coefficient, but neither may be negative; check the ring-down records."
        )
    weight, log_mean = normalised(np.where(positive, logarithm - log_proposal, -np.inf))
    effective = effective_sample_size(weight) if math.isfinite(log_mean) else 0.0
    if effective < LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(
            f"only {effective:.0f} of {proposals} draws describe the joint posterior: load test, weighed "
            "total and frequencies contradict each other within the model's range; check them, or allow "
            "the model a larger error of its frequencies."
        )
    quantities = np.column_stack([masses_of(points), coefficients])
    return _Draws(
        quantities, frequency, weight, proposals, effective, log_mean + math.log(points.shape[0] / proposals)
    )


def _log_density(density: JointDensity, points: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = density.inside(points)
    value = np.full(points.shape[0], -np.inf)
    if inside.any():
        value[inside] = density.log_density(points[inside])[0]
    return value


def _refuse_limit(
    factor: NDArray[np.float64], weight: NDArray[np.float64], limits: NDArray[np.float64]
) -> None:
    margin = _LIMIT_MARGIN * float(limits[1] - limits[0])
    for limit in limits.tolist():
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


def _laplace(density: JointDensity, factor: float, factor_deviation: float) -> Laplace:
    """Return mode and covariance of (e, s, t), begun at the mean of the load test's own posterior."""
    (e_low, e_high), servo, pitot = density.table.limits.tolist()
    total = density.total_mass
    least, greatest = 2.0 * servo[0] + pitot[0], 2.0 * servo[1] + pitot[1]
    if not least < total.mass < greatest:
        raise MassConstraintError(
            f"two servos and the pitot tube cannot weigh {total.mass:g} kg: the model takes totals between "
            f"{least:g} and {greatest:g} kg."
        )
    lower = max(servo[0], 0.5 * (total.mass - pitot[1]))
    upper = min(servo[1], 0.5 * (total.mass - pitot[0]))
    factor = min(max(factor, e_low + 1e-6), e_high - 1e-6)
    candidates = np.column_stack(
        [
            np.full(65, factor),
            np.linspace(lower, upper, 67)[1:-1],
            np.full(65, total.mass),
        ]
    )
    start = candidates[int(np.argmax(_log_density(density, candidates)))]
    scale = np.array([factor_deviation, 0.05 * (upper - lower), total.standard_deviation])
    return laplace(lambda points: _log_density(density, points), start, scale)


def _five(density: JointDensity, found: Laplace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mode and covariance of the five quantities: the coefficients follow (e, s, t) linearly."""
    step = 1e-2 * np.sqrt(np.diag(found.covariance))
    lower, upper = density.table.limits[:, 0], density.table.limits[:, 1]

    def coefficients(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return density.damping(density.table.frequency(np.clip(masses_of(points), lower, upper))).mean

    here = density.damping(density.table.frequency(masses_of(found.mode[None, :])))
    shifted = np.vstack([found.mode + np.diag(step), found.mode - np.diag(step)])
    values = coefficients(shifted)
    jacobian = ((values[:3] - values[3:]) / (2.0 * step[:, None])).T  # (2, 3)
    to_five = np.vstack([np.eye(2, 3), [[0.0, -2.0, 1.0]], jacobian])
    covariance = to_five @ found.covariance @ to_five.T
    covariance[3:, 3:] += here.covariance[0]
    mode = np.concatenate([masses_of(found.mode[None, :])[0], here.mean[0]])
    return mode, covariance
