"""Fit of a candidate: the maximum of its posterior, and its Laplace evidence.

A candidate is a hypothesis, which is a set of effects. The maximum is found by the
Levenberg-Marquardt method. Derivatives with respect to the unknowns that all hypotheses share
change little if an effect is added, so a fit may begin with those of a fit without the effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.errors import DiscrepancyError, FitError
from discrepancy.fits.candidate import (
    Candidate,
    FitState,
    Point,
    ResidualProcess,
    TrialDerivatives,
)
from discrepancy.fits.cut_gaussian import TruncatedGaussian
from discrepancy.fits.normal_equations import (
    NormalEquations,
    check_finite,
    cholesky_factor,
    covariance_by_mesh_errors,
    normal_equations,
    solve_factored,
)
from discrepancy.fits.problem import Problem
from discrepancy.fits.trial_data import LARGEST_LOSS
from reporting.words import comma_list

CONVERGED_DECREASE = 1e-2
"""Predicted decrease of the objective by a step below which a fit has converged [nat]."""
NEWTON_DAMPING = 1e-2
"""Damping below which a step is nearly a Gauss-Newton step."""
LARGEST_DAMPING = 1.0
"""Damping above which steps are so short that a small predicted decrease does not mean
convergence."""
HOPELESS_DAMPING = 1e6
"""Damping beyond which a fit ends without convergence."""
MOST_FIT_STEPS = 60
"""Largest number of steps of a fit, unless its caller states another number."""
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-9
"""Damping of the first step, and the least damping of any step."""
LEAST_RAISED_DAMPING = 1e-4
"""Least damping after a step that did not lower the objective."""
GOOD_DECREASE, OUTDATED_DECREASE = 0.5, 0.7
"""Decrease of the objective over the predicted decrease: above the first the damping is reduced
more, and below the second the reused derivatives are outdated."""
STEP_FRACTIONS = (1.0, 0.3)
"""Fractions of a step that are tried before the damping is increased."""


@dataclass(frozen=True, eq=False)
class CandidateFit(FitState):
    """A fitted candidate; its point is the maximum of the posterior.

    Attributes
    ----------
    candidate : Candidate
        The effects that were fitted.
    log_evidence : float
        The Laplace approximation of the log evidence, up to the same constant as the objective
        [nat].
    covariance : (Q + E, Q + E) array
        The posterior covariance of the shared unknowns and effect parameters (scaled) by noise
        alone, with the unknowns of the trials marginalised.
    absorbed_freedom : (channels,) array
        The degrees of freedom that the fitted unknowns absorb in each channel: the trace of the hat
        matrix over the readings of the channel.
    converged : bool
        Whether the predicted decrease of the objective fell below `CONVERGED_DECREASE`.
    mesh_covariance : (E, E) array or None
        The covariance of the effect parameters by errors of a mesh in the readings; None if no
        errors of a mesh are fitted.
    draws : (N, E) array or None
        The posterior draws of the effect parameters, if their posterior is wider than the
        covariance says (see `predictive.with_draws`).
    residual_process : ResidualProcess or None
        The random process of the residuals besides the noise, if hypotheses are compared under a
        wider noise than recorded.
    """

    candidate: Candidate
    log_evidence: float
    covariance: FloatArray
    absorbed_freedom: FloatArray
    converged: bool = True
    mesh_covariance: FloatArray | None = None
    draws: FloatArray | None = field(default=None, repr=False)
    residual_process: ResidualProcess | None = field(default=None, repr=False)

    @property
    def effect(self) -> FloatArray:
        """The scaled effect parameters (E,)."""
        return self.point.effect

    @property
    def shared(self) -> FloatArray:
        """The scaled shared unknowns (Q,)."""
        return self.point.shared

    @property
    def effect_covariance(self) -> FloatArray:
        """The covariance (E, E) of the scaled effect parameters, by noise alone."""
        first_parameter = len(self.covariance) - self.candidate.parameter_count
        return self.covariance[first_parameter:, first_parameter:]

    @property
    def whole_effect_covariance(self) -> FloatArray:
        """The covariance (E, E) of the scaled effect parameters, by noise and errors of a mesh."""
        by_mesh = 0.0 if self.mesh_covariance is None else self.mesh_covariance
        return np.asarray(self.effect_covariance + by_mesh)

    @property
    def chi_square(self) -> float:
        """The sum of the squared residuals of all channels, in units of the noise variance."""
        return float(self.squares_by_channel.sum())


@np.errstate(over="ignore", invalid="ignore")  # a step that is too long is rejected
def fit(
    problem: Problem,
    candidate: Candidate,
    start: Point,
    *,
    nearby_derivatives: tuple[TrialDerivatives, ...] | None = None,
    iterations: int = MOST_FIT_STEPS,
    local_only: bool = False,
    objective_limit: float | None = None,
) -> CandidateFit:
    """Return a candidate at the maximum of its posterior, by Levenberg-Marquardt.

    Parameters
    ----------
    nearby_derivatives : tuple of TrialDerivatives, optional
        The derivatives of each trial with respect to nuisances at a nearby point, used for the
        first steps instead of new ones.
    iterations : int
        The largest number of steps.
    local_only : bool
        Whether only the trials' own unknowns are fitted, as for held-out trials. Shared unknowns
        and effect parameters are then fixed.
    objective_limit : float, optional
        A value of the objective [nat]. The fit ends early, not converged, if it is not expected to
        come below this value.

    Raises
    ------
    FitError
        If the model gives numbers that are not finite at the start, or the normal equations are
        singular.
    """
    descent = _Descent(problem, candidate, local_only)
    damping = FIRST_DAMPING
    state = descent.state_at(_within_bounds(problem, candidate, start), nearby_derivatives)
    if not np.isfinite(state.objective):
        names = comma_list(candidate.identifiers) if candidate.terms else "no effect"
        raise FitError(
            f"The model gives values that are not finite for {names}; check the ranges of its "
            "parameters."
        )
    converged = False
    has_current_derivatives = nearby_derivatives is None
    for _ in range(iterations):
        step, predicted_decrease = descent.damped_step(state, damping)
        next_state = None
        if predicted_decrease >= CONVERGED_DECREASE:
            next_state = descent.descend(state, step)
        if next_state is not None:
            decrease = state.objective - next_state.objective
            # less damping for the next step, the more so the better the predicted decrease was
            reduction = 0.1 if decrease > GOOD_DECREASE * predicted_decrease else 0.5
            damping = max(damping * reduction, LEAST_DAMPING)
            state = next_state
            # a decrease well below the predicted one shows that the derivatives are outdated
            is_outdated = decrease < OUTDATED_DECREASE * predicted_decrease
            if is_outdated:
                state = descent.state_at(state.point)
            has_current_derivatives = is_outdated
            # the further decrease is taken to be at most twice the one predicted for this step
            is_near_newton = damping < NEWTON_DAMPING
            expected_end = state.objective - 2.0 * predicted_decrease
            if objective_limit is not None and is_near_newton and expected_end > objective_limit:
                break
        elif not has_current_derivatives:
            # no step was found with old derivatives: try again with new ones
            state = descent.state_at(state.point)
            has_current_derivatives = True
        elif predicted_decrease < CONVERGED_DECREASE:
            converged = damping < LARGEST_DAMPING
            break
        else:
            damping = max(10.0 * damping, LEAST_RAISED_DAMPING)
            if damping > HOPELESS_DAMPING:
                break
    if not has_current_derivatives:
        state = descent.state_at(state.point)
    return _with_evidence(problem, candidate, state, converged)


def try_fit(
    problem: Problem,
    candidate: Candidate,
    start: Point,
    *,
    nearby_derivatives: tuple[TrialDerivatives, ...] | None = None,
    iterations: int = MOST_FIT_STEPS,
    local_only: bool = False,
    objective_limit: float | None = None,
) -> CandidateFit | None:
    """Return the fit of a candidate by `fit`, or None if it cannot be fitted.

    The reason is then recorded by `Problem.record_refusal`. The parameters are those of `fit`.
    """
    try:
        return fit(
            problem,
            candidate,
            start,
            nearby_derivatives=nearby_derivatives,
            iterations=iterations,
            local_only=local_only,
            objective_limit=objective_limit,
        )
    except DiscrepancyError as cause:
        problem.record_refusal(candidate, cause)
        return None


@np.errstate(over="ignore", invalid="ignore")  # a motion that overflows has no probability
def objective(
    problem: Problem,
    candidate: Candidate,
    point: Point,
    jumps: Sequence[FloatArray] | None = None,
) -> float:
    """Return the negative log posterior of a candidate at a point [nat], up to a constant.

    The constant is the same for all candidates. Values of the point beyond their bounds are moved
    to the bounds.

    Parameters
    ----------
    jumps : sequence of (N, C) array, optional
        The jumps of the response of each trial for small changes of the unknowns, see
        `Problem.standardised_residual`.

    Raises
    ------
    ModelError
        If the model cannot be evaluated with the effects.
    """
    point = _within_bounds(problem, candidate, point)
    trial_indices = range(len(problem.trials))
    responses = [
        problem.response_of_candidate(trial_index, point, candidate)
        for trial_index in trial_indices
    ]
    return _misfit_at(problem, point, responses, jumps).objective


class _Misfit(NamedTuple):
    """The misfit of a point.

    Attributes
    ----------
    objective : float
        The negative log posterior; infinite if the model gives values that are not finite [nat].
    residuals : tuple of (N, C) array
        The standardised residuals of each trial.
    squares_by_channel : (channels,) array
        The sum of squared standardised residuals of each channel.
    """

    objective: float
    residuals: tuple[FloatArray, ...]
    squares_by_channel: FloatArray


def _misfit_at(
    problem: Problem,
    point: Point,
    responses: Sequence[FloatArray],
    jumps: Sequence[FloatArray] | None,
) -> _Misfit:
    """Return the negative log posterior and the residuals at a point.

    `responses` and their `jumps` are (N, C) for each trial, see `Problem.standardised_residual`.
    """
    jumps_of_trials = [None] * len(responses) if jumps is None else jumps
    residuals = tuple(
        problem.standardised_residual(trial_index, point, response, jumps_of_trial)
        for trial_index, (response, jumps_of_trial) in enumerate(
            zip(responses, jumps_of_trials, strict=True)
        )
    )
    squares_by_channel = problem.squares_by_channel(residuals)
    minus_log_prior = 0.5 * float(problem.shared.precision @ point.shared**2)
    minus_log_prior += 0.5 * float(point.effect @ point.effect)
    for data, scaled_values in zip(problem.trials, point.local, strict=True):
        minus_log_prior += 0.5 * float(data.unknowns.precision @ scaled_values**2)
    negative_log_posterior = problem.misfit(squares_by_channel) + minus_log_prior
    if not np.isfinite(negative_log_posterior):
        negative_log_posterior = np.inf
    return _Misfit(negative_log_posterior, residuals, squares_by_channel)


@dataclass
class _Descent:
    """The steps of a Levenberg-Marquardt descent for one candidate.

    Attributes
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    candidate : Candidate
        The effects that are fitted.
    local_only : bool
        Whether only the unknowns of the trials are fitted.
    effect_deviation : (E,) array or None
        The posterior standard deviations of the effect parameters at the last step, which set the
        steps of their finite differences; None before the first step.
    """

    problem: Problem
    candidate: Candidate
    local_only: bool
    effect_deviation: FloatArray | None = None

    def state_at(
        self, point: Point, nearby_derivatives: tuple[TrialDerivatives, ...] | None = None
    ) -> FitState:
        """Return the objective, the residuals and the derivatives of all trials at a point.

        Parameters
        ----------
        nearby_derivatives : tuple of TrialDerivatives, optional
            The derivatives of each trial with respect to nuisances at a nearby point, which are
            reused here; only the response and the derivatives with respect to effect parameters are
            then computed. If left out, all derivatives are computed.
        """
        all_derivatives = tuple(
            self.problem.linearise(
                trial_index,
                point,
                self.candidate,
                nearby_derivatives=nearby_derivatives_of_trial,
                effect_steps=self.effect_deviation,
            )
            for trial_index, nearby_derivatives_of_trial in enumerate(
                nearby_derivatives or [None] * len(self.problem.trials)
            )
        )
        misfit = _misfit_at(
            self.problem,
            point,
            [derivatives_of_trial.response for derivatives_of_trial in all_derivatives],
            [derivatives_of_trial.jumps for derivatives_of_trial in all_derivatives],
        )
        return FitState(
            point=point,
            objective=misfit.objective,
            residuals=misfit.residuals,
            squares_by_channel=misfit.squares_by_channel,
            trial_derivatives=all_derivatives,
        )

    def damped_step(self, state: FitState, damping: float) -> tuple[Point, float]:
        """Return a Levenberg-Marquardt step, and the decrease of the objective that it predicts.

        An unknown at an end of its range is fixed if the step would move it out of the range
        (projected Newton method, Bertsekas 1982, SIAM J. Control Optim. 20, 221-246).

        Parameters
        ----------
        damping : float
            The Levenberg-Marquardt factor d: the matrix H of the normal equations is replaced by
            H + d diag(H).

        Returns
        -------
        step : Point
            The change of each unknown.
        predicted_decrease : float
            The predicted decrease of the objective, g^T s / 2, with the negative gradient g and
            the step s [nat]. It is that of the quadratic model if the step is not damped.
        """
        problem = self.problem
        first_effect = problem.shared.unknown_count
        first_local = first_effect + self.candidate.parameter_count
        precision = problem.noise_precisions(state.squares_by_channel)
        equations = normal_equations(problem, state, self.candidate, precision)
        unknown_count = len(equations.gradient)
        # posterior deviations of the effect parameters: their columns of the inverse matrix
        unit_vectors = np.eye(unknown_count)[:, first_effect:first_local]
        covariance_columns = solve_factored(cholesky_factor(equations.matrix), unit_vectors)
        self.effect_deviation = np.sqrt(np.diag(covariance_columns[first_effect:first_local]))
        # unknowns that may move
        first_free = first_local if self.local_only else 0
        is_free = np.arange(unknown_count) >= first_free
        downhill = check_finite(equations.gradient)[:first_effect]
        is_free[:first_effect] &= ~self._is_held_at_bound(state.point.shared, downhill)
        # Levenberg-Marquardt step
        damped_matrix = equations.matrix + damping * np.diag(np.diag(equations.matrix))
        damped_matrix = damped_matrix[np.ix_(is_free, is_free)]
        step = np.zeros(unknown_count)
        step[is_free] = solve_factored(cholesky_factor(damped_matrix), equations.gradient[is_free])
        predicted_decrease = 0.5 * float(equations.gradient @ step)
        return self._split_step(step), predicted_decrease

    def _is_held_at_bound(self, shared_values: FloatArray, downhill: FloatArray) -> BoolArray:
        """Return which shared unknowns (Q,) are at an end of their range and would leave it.

        `downhill` (Q,) is the direction in which the objective decreases.
        """
        low, high = self.problem.shared.bounds
        is_held_low = (shared_values <= low) & (downhill < 0.0)
        is_held_high = (shared_values >= high) & (downhill > 0.0)
        return np.asarray(is_held_low | is_held_high)

    def _split_step(self, step: FloatArray) -> Point:
        """Return a step of all unknowns (n,) split into shared, effect and local unknowns."""
        first_effect = self.problem.shared.unknown_count
        first_local = first_effect + self.candidate.parameter_count
        local_sizes = [data.unknowns.unknown_count for data in self.problem.trials]
        ends = np.cumsum([first_local, *local_sizes]).tolist()
        return Point(
            shared=step[:first_effect],
            local=tuple(step[begin:end] for begin, end in pairwise(ends)),
            effect=step[first_effect:first_local],
        )

    def descend(self, state: FitState, step: Point) -> FitState | None:
        """Return the state after the largest fraction of a step that lowers the objective.

        The fractions are `STEP_FRACTIONS`; None if all of them fail. The derivatives with respect
        to nuisances remain those before the step.
        """
        jumps = [derivatives.jumps for derivatives in state.trial_derivatives]
        for fraction in STEP_FRACTIONS:
            try:
                point = _move_point(self.problem, self.candidate, state.point, step, fraction)
                if objective(self.problem, self.candidate, point, jumps) < state.objective:
                    return self.state_at(point, state.trial_derivatives)
            except DiscrepancyError:  # the model cannot be evaluated there: try a shorter step
                continue
        return None


def _with_evidence(
    problem: Problem, candidate: Candidate, state: FitState, converged: bool
) -> CandidateFit:
    """Return the fit at a state, with its Laplace evidence, covariance and degrees of freedom.

    The log evidence is -objective - ln(det H) / 2 with the Hessian H = U^T U, up to a constant:
    ln(det H) / 2 is the sum of the logarithms of the diagonal of U. The log posterior probability
    that all stiffness losses of static trials lie within their range is added, so that the evidence
    does not count impossible losses. The degrees of freedom that the fit absorbs in a channel are
    the sum of the leverages of its readings.
    """
    precision = problem.noise_precisions(state.squares_by_channel)
    equations = normal_equations(problem, state, candidate, precision)
    factor = cholesky_factor(equations.matrix)
    covariance = solve_factored(factor, np.eye(len(factor)))
    # effective degrees of freedom: the trace of the hat matrix, channel by channel
    absorbed_freedom = np.zeros(len(problem.channel_names))
    for data, (trial_jacobian, unknown_indices) in zip(
        problem.trials, equations.trials, strict=True
    ):
        trial_covariance = covariance[np.ix_(unknown_indices, unknown_indices)]
        # the diagonal (N C,) of the hat matrix J^T C J, with the derivatives J (unknowns, N C)
        leverage = ((trial_covariance @ trial_jacobian.jacobian) * trial_jacobian.jacobian).sum(
            axis=0
        )
        leverage_by_channel = leverage.reshape(data.weight.shape).sum(axis=0)  # over the samples
        np.add.at(absorbed_freedom, data.channel_indices, leverage_by_channel)
    shared_count = problem.shared.unknown_count + candidate.parameter_count
    log_integral = -state.objective - float(np.log(np.diag(factor)).sum())
    return CandidateFit(
        **vars(state),
        candidate=candidate,
        log_evidence=log_integral + _log_probability_of_losses(problem, equations, covariance),
        covariance=covariance[:shared_count, :shared_count],
        absorbed_freedom=absorbed_freedom,
        converged=converged,
        mesh_covariance=covariance_by_mesh_errors(
            problem, equations, covariance[problem.shared.unknown_count : shared_count]
        ),
    )


def _log_probability_of_losses(
    problem: Problem, equations: NormalEquations, covariance: FloatArray
) -> float:
    """Return ln of the posterior probability that all stiffness losses are possible [nat].

    A loss below zero has no physical meaning. Fits may pass through such losses (see `LEAST_LOSS`),
    but the evidence must not count them: else a hypothesis under which readings determine the
    losses less well gains by each further sample. Trials in motion are left out, as the evidence
    with a missing force has no such limit. `covariance` (n, n) is that of all scaled unknowns.
    """
    mean_losses, scales, unknown_indices = [], [], []
    for data, (trial_jacobian, indices_of_trial) in zip(
        problem.trials, equations.trials, strict=True
    ):
        unknowns = data.unknowns
        if data.trial.is_dynamic or not len(unknowns.health_rows):
            continue
        health = slice(unknowns.indices.health.start, unknowns.indices.health.stop)
        scale = unknowns.scale[health]
        prior_means = data.trial.health[unknowns.health_rows, unknowns.health_columns]
        mean_losses.append(prior_means + scale * trial_jacobian.local_values[health])
        scales.append(scale)
        unknown_indices.append(indices_of_trial[health])
    if not scales:
        return 0.0
    scale, indices = np.concatenate(scales), np.concatenate(unknown_indices)
    losses = TruncatedGaussian(
        mean=np.concatenate(mean_losses),
        covariance=covariance[np.ix_(indices, indices)] * np.outer(scale, scale),
        low=np.zeros(len(scale)),
        high=np.full(len(scale), LARGEST_LOSS),
        log_integral=0.0,
    )
    return losses.log_evidence


def _move_point(
    problem: Problem, candidate: Candidate, point: Point, step: Point, fraction: float
) -> Point:
    """Return the point after a fraction of a step, clipped to the ranges of the unknowns."""
    stepped_point = Point(
        shared=point.shared + fraction * step.shared,
        local=tuple(
            values + fraction * change
            for values, change in zip(point.local, step.local, strict=True)
        ),
        effect=candidate.add_step(point.effect, fraction * step.effect),
    )
    return _within_bounds(problem, candidate, stepped_point)


def _within_bounds(problem: Problem, candidate: Candidate, point: Point) -> Point:
    """Return the point with shared unknowns and effect parameters clipped to their ranges."""
    low, high = problem.shared.bounds
    return replace(
        point,
        shared=np.clip(point.shared, low, high),
        effect=candidate.within_range(point.effect),
    )


def fit_free_shape(
    problem: Problem, canonical_fit: CandidateFit, term_index: int
) -> CandidateFit | None:
    """Return a fit in which the shape parameters of one effect are fitted too.

    The effects that differ only by their shape are a family. `gates.check_shape` compares the
    given fit with the returned one. The fit begins at the canonical shape.

    Parameters
    ----------
    canonical_fit : CandidateFit
        The fit in which all shapes have their canonical values.
    term_index : int
        The index of the effect among the terms of the candidate.

    Returns
    -------
    CandidateFit or None
        The fit; None if the effect has no shape parameters or cannot be fitted.
    """
    terms_with_values = canonical_fit.candidate.split_by_term(canonical_fit.effect)
    term, values = terms_with_values[term_index]
    if not term.effect.shape:
        return None
    canonical_values = [
        parameter.prior.standard_normal(parameter.canonical) for parameter in term.effect.shape
    ]
    terms_with_values[term_index] = (
        replace(term, free_shape=True),
        np.append(values, canonical_values),
    )
    terms, effect_values = zip(*terms_with_values, strict=True)
    start = replace(canonical_fit.point, effect=np.concatenate(effect_values))
    return try_fit(problem, Candidate(terms), start)
