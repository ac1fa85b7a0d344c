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

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError, FitError
from discrepancy.fits.candidate import (
    Candidate,
    FitState,
    Point,
    ResidualProcess,
    TrialDerivatives,
)
from discrepancy.fits.normal_equations import (
    check_finite,
    cholesky_factor,
    normal_equations,
    solve_factored,
)
from discrepancy.fits.problem import Problem
from reporting.words import comma_list

LARGEST_EFFECT = 8.0
"""Effect parameters stay within this many prior deviations of their median."""
CONVERGED = 1e-2
"""Predicted decrease of the objective by a step below which a fit has converged [nat]."""
WHOLE_STEP = 1e-2
"""Damping below which a step is nearly a Gauss-Newton step."""
LARGEST_DAMPING = 1.0
"""Damping above which steps are so short that a small predicted decrease does not mean
convergence."""
HOPELESS_DAMPING = 1e6
"""Damping beyond which a fit ends without convergence."""
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
        The posterior covariance of the shared unknowns and effect parameters (scaled), with the
        unknowns of the trials marginalised.
    spent : (channels,) array
        The degrees of freedom that the fitted unknowns absorb in each channel: the trace of the hat
        matrix over the readings of the channel.
    converged : bool
        Whether the predicted decrease of the objective fell below `CONVERGED`.
    draws : (N, E) array or None
        Posterior draws of the effect parameters, if their posterior is wider than the covariance
        says (see `predictive.with_draws`).
    residual_process : ResidualProcess or None
        The random process of the residuals besides the noise, if hypotheses are compared under a
        wider noise than recorded.
    """

    candidate: Candidate
    log_evidence: float
    covariance: FloatArray
    spent: FloatArray
    converged: bool = True
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
        """The covariance (E, E) of the scaled effect parameters."""
        first = len(self.covariance) - self.candidate.size
        return self.covariance[first:, first:]

    @property
    def chi_square(self) -> float:
        """The sum of squared standardised residuals."""
        return float(self.sums.sum())


@np.errstate(over="ignore", invalid="ignore")  # a step that is too long is rejected
def fit(
    problem: Problem,
    candidate: Candidate,
    start: Point,
    *,
    known: tuple[TrialDerivatives, ...] | None = None,
    iterations: int = 60,
    local_only: bool = False,
    give_up: float | None = None,
) -> CandidateFit:
    """Return a candidate at the maximum of its posterior, by Levenberg-Marquardt.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    candidate : Candidate
        The effects whose parameters are fitted.
    start : Point
        The point from which the fit begins.
    known : tuple of TrialDerivatives, optional
        Derivatives of each trial with respect to nuisances at a nearby point, used for the first
        steps instead of new ones.
    iterations : int
        The largest number of steps.
    local_only : bool
        Whether only the trials' own unknowns are fitted, as for held-out trials. Shared unknowns
        and effect parameters are then fixed.
    give_up : float, optional
        A value of the objective [nat]. The fit ends early, not converged, if it is not expected to
        come below this value.

    Raises
    ------
    FitError
        If the model gives numbers that are not finite at the start, or the normal equations are
        singular.
    """
    descent = _Descent(problem, candidate, local_only)
    damping = 1e-3
    state = descent.state(_within_bounds(problem, start), known)
    if not np.isfinite(state.objective):
        names = comma_list(candidate.identifiers) if candidate.terms else "no effect"
        raise FitError(
            f"The model gives values that are not finite for {names}; check the ranges of its "
            "parameters."
        )
    converged = False
    has_current_derivatives = known is None
    for _ in range(iterations):
        step, promised_decrease = descent.step(state, damping)
        next_state = None
        if promised_decrease >= CONVERGED:
            next_state = descent.next_state(state, step)
        if next_state is not None:
            decrease = state.objective - next_state.objective
            damping = max(damping * (0.1 if decrease > 0.5 * promised_decrease else 0.5), 1e-9)
            state = next_state
            # a decrease well below the predicted one shows that the derivatives are outdated
            has_current_derivatives = decrease < 0.7 * promised_decrease
            if has_current_derivatives:
                state = descent.state(state.point)
            # the further decrease is taken to be at most twice the one predicted for this step
            is_near_newton = damping < WHOLE_STEP
            if (
                give_up is not None
                and is_near_newton
                and state.objective - 2.0 * promised_decrease > give_up
            ):
                break
        elif not has_current_derivatives:  # no step was found with old derivatives
            state = descent.state(state.point)
            has_current_derivatives = True
        elif promised_decrease < CONVERGED:
            converged = damping < LARGEST_DAMPING
            break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > HOPELESS_DAMPING:
                break
    if not has_current_derivatives:
        state = descent.state(state.point)
    return _with_evidence(problem, candidate, state, converged)


def attempt(
    problem: Problem,
    candidate: Candidate,
    start: Point,
    *,
    known: tuple[TrialDerivatives, ...] | None = None,
    iterations: int = 60,
    local_only: bool = False,
    give_up: float | None = None,
) -> CandidateFit | None:
    """Return the fit of a candidate by `fit`, or None if it cannot be fitted.

    The reason is then recorded by `Problem.record_refusal`. The parameters are those of `fit`.
    """
    try:
        return fit(
            problem,
            candidate,
            start,
            known=known,
            iterations=iterations,
            local_only=local_only,
            give_up=give_up,
        )
    except DiscrepancyError as cause:
        problem.record_refusal(candidate, cause)
        return None


@np.errstate(over="ignore", invalid="ignore")  # a motion that overflows has no probability
def objective(problem: Problem, candidate: Candidate, point: Point) -> float:
    """Return the negative log posterior of a candidate at a point, up to a constant [nat].

    The constant is the same for all candidates.

    Raises
    ------
    ModelError
        If the model cannot be evaluated with the effects.
    """
    point = _within_bounds(problem, point)
    numbers = range(len(problem.trials))
    responses = [problem.response_with(number, point, candidate) for number in numbers]
    return _misfit_at(problem, point, responses).objective


class _Misfit(NamedTuple):
    """The misfit of a point.

    Attributes
    ----------
    objective : float
        The negative log posterior; infinite if the model gives values that are not finite [nat].
    residuals : tuple of (N, C) array
        The standardised residuals of each trial.
    sums : (channels,) array
        The sum of squared standardised residuals of each channel.
    """

    objective: float
    residuals: tuple[FloatArray, ...]
    sums: FloatArray


def _misfit_at(problem: Problem, point: Point, responses: Sequence[FloatArray]) -> _Misfit:
    """Return the negative log posterior and the residuals at a point.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    point : Point
        The values of all unknowns.
    responses : sequence of (N, C) array
        The response of the model in each trial at the point.
    """
    residuals = tuple(
        problem.residual(number, point, response) for number, response in enumerate(responses)
    )
    sums = problem.sums_by_channel(residuals)
    prior_energy = 0.5 * float(problem.shared.precision @ point.shared**2)
    prior_energy += 0.5 * float(point.effect @ point.effect)
    for data, u in zip(problem.trials, point.local, strict=True):
        prior_energy += 0.5 * float(data.unknowns.precision @ u**2)
    negative_log_posterior = problem.misfit(sums) + prior_energy
    if not np.isfinite(negative_log_posterior):
        negative_log_posterior = np.inf
    return _Misfit(negative_log_posterior, residuals, sums)


@dataclass
class _Descent:
    """The steps of a Levenberg-Marquardt descent for one candidate.

    Attributes
    ----------
    problem : Problem
        The campaign and model.
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

    def state(self, point: Point, known: tuple[TrialDerivatives, ...] | None = None) -> FitState:
        """Return the objective and the derivatives at a point.

        Parameters
        ----------
        point : Point
            The values of all unknowns.
        known : tuple of TrialDerivatives, optional
            Derivatives of each trial with respect to nuisances at a nearby point. If given, only
            the response and the derivatives with respect to effect parameters are computed.
        """
        derivatives = tuple(
            self.problem.linearise(
                number,
                point,
                self.candidate,
                known=known_derivatives,
                effect_steps=self.effect_deviation,
            )
            for number, known_derivatives in enumerate(known or [None] * len(self.problem.trials))
        )
        misfit = _misfit_at(self.problem, point, [trial.response for trial in derivatives])
        return FitState(
            point=point,
            objective=misfit.objective,
            residuals=misfit.residuals,
            sums=misfit.sums,
            linearisations=derivatives,
        )

    def step(self, state: FitState, damping: float) -> tuple[Point, float]:
        """Return a Levenberg-Marquardt step, and the decrease of the objective that it predicts.

        An unknown at an end of its range is fixed if the step would move it out of the range
        (projected Newton method, Bertsekas 1982, SIAM J. Control Optim. 20, 221-246).

        Parameters
        ----------
        state : FitState
            The point with its residuals and derivatives.
        damping : float
            The factor on the diagonal of the matrix that is added to it.

        Returns
        -------
        step : Point
            The change of each unknown.
        promised_decrease : float
            The predicted decrease of the objective: half of the gradient times the step, which is
            that of the quadratic model for a step without damping [nat].
        """
        problem = self.problem
        first_effect = problem.shared.size
        first_local = first_effect + self.candidate.size
        precision = problem.precisions(state.sums)
        equations = normal_equations(problem, state, self.candidate, precision)
        size = len(equations.gradient)
        # posterior deviations of the effect parameters: their columns of the inverse matrix
        unit_vectors = np.eye(size)[:, first_effect:first_local]
        covariance_columns = solve_factored(cholesky_factor(equations.matrix), unit_vectors)
        self.effect_deviation = np.sqrt(np.diag(covariance_columns[first_effect:first_local]))
        # unknowns that may move
        low, high = problem.shared.ends
        shared = state.point.shared
        downhill = check_finite(equations.gradient)[:first_effect]
        is_held_low = (shared <= low) & (downhill < 0.0)
        is_held_high = (shared >= high) & (downhill > 0.0)
        is_free = np.arange(size) >= (first_local if self.local_only else 0)
        is_free[:first_effect] &= ~(is_held_low | is_held_high)
        # Levenberg-Marquardt step
        damped_matrix = equations.matrix + damping * np.diag(np.diag(equations.matrix))
        damped_matrix = damped_matrix[np.ix_(is_free, is_free)]
        step = np.zeros(size)
        step[is_free] = solve_factored(cholesky_factor(damped_matrix), equations.gradient[is_free])
        promised_decrease = 0.5 * float(equations.gradient @ step)
        return self._step_by_kind(step), promised_decrease

    def _step_by_kind(self, step: FloatArray) -> Point:
        """Return a step of all unknowns (n,) split into shared, effect and local unknowns."""
        first_effect = self.problem.shared.size
        first_local = first_effect + self.candidate.size
        local_sizes = [data.unknowns.size for data in self.problem.trials]
        ends = np.cumsum([first_local, *local_sizes]).tolist()
        return Point(
            shared=step[:first_effect],
            local=tuple(step[begin:end] for begin, end in pairwise(ends)),
            effect=step[first_effect:first_local],
        )

    def next_state(self, state: FitState, step: Point) -> FitState | None:
        """Return the state after a step or a fraction of it, with old derivatives by nuisances.

        None if no fraction in `STEP_FRACTIONS` lowers the objective.
        """
        for fraction in STEP_FRACTIONS:
            try:
                point = _point_after(self.problem, self.candidate, state.point, step, fraction)
                if objective(self.problem, self.candidate, point) < state.objective:
                    return self.state(point, state.linearisations)
            except DiscrepancyError:  # the model cannot be evaluated there: try a shorter step
                continue
        return None


def _with_evidence(
    problem: Problem, candidate: Candidate, state: FitState, converged: bool
) -> CandidateFit:
    """Return the fit at a state, with its Laplace evidence, covariance and degrees of freedom.

    The log evidence is -objective - ln(det H) / 2 with the Hessian H = U^T U, up to a constant:
    ln(det H) / 2 is the sum of the logarithms of the diagonal of U.
    """
    precision = problem.precisions(state.sums)
    equations = normal_equations(problem, state, candidate, precision)
    factor = cholesky_factor(equations.matrix)
    covariance = solve_factored(factor, np.eye(len(factor)))
    # degrees of freedom: the trace of the hat matrix, channel by channel
    spent_freedom = np.zeros(len(problem.channel_names))
    for data, (trial_rows, unknown_indices) in zip(problem.trials, equations.trials, strict=True):
        trial_covariance = covariance[np.ix_(unknown_indices, unknown_indices)]
        leverage = ((trial_covariance @ trial_rows.rows) * trial_rows.rows).sum(axis=0)
        np.add.at(spent_freedom, data.groups, leverage.reshape(data.weight.shape).sum(axis=0))
    shared_count = problem.shared.size + candidate.size
    return CandidateFit(
        **vars(state),
        candidate=candidate,
        log_evidence=-state.objective - float(np.log(np.diag(factor)).sum()),
        covariance=covariance[:shared_count, :shared_count],
        spent=spent_freedom,
        converged=converged,
    )


def _point_after(
    problem: Problem, candidate: Candidate, point: Point, step: Point, fraction: float
) -> Point:
    """Return the point after a fraction of a step, clipped to the ranges of the unknowns."""
    stepped = Point(
        shared=point.shared + fraction * step.shared,
        local=tuple(u + fraction * du for u, du in zip(point.local, step.local, strict=True)),
        effect=candidate.stepped(point.effect, fraction * step.effect),
    )
    return _within_bounds(problem, stepped)


def _within_bounds(problem: Problem, point: Point) -> Point:
    """Return the point with shared unknowns and effect parameters clipped to their ranges."""
    low, high = problem.shared.ends
    return replace(
        point,
        shared=np.clip(point.shared, low, high),
        effect=np.clip(point.effect, -LARGEST_EFFECT, LARGEST_EFFECT),
    )


def fit_free_shape(problem: Problem, named_fit: CandidateFit, number: int) -> CandidateFit | None:
    """Return a fit in which the shape parameters of one effect are fitted too.

    The effects that differ only by their shape are a family. `gates.check_shape` compares the
    given fit with the returned one. The fit begins at the canonical shape.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    named_fit : CandidateFit
        The fit in which all shapes have their canonical values.
    number : int
        The index of the effect among the terms of the candidate.

    Returns
    -------
    CandidateFit or None
        The fit; None if the effect has no shape parameters or cannot be fitted.
    """
    terms_with_values = named_fit.candidate.split(named_fit.effect)
    term, values = terms_with_values[number]
    if not term.effect.shape:
        return None
    canonical = [
        parameter.prior.standard_normal(parameter.canonical) for parameter in term.effect.shape
    ]
    terms_with_values[number] = (replace(term, free_shape=True), np.append(values, canonical))
    terms, effect_values = zip(*terms_with_values, strict=True)
    start = replace(named_fit.point, effect=np.concatenate(effect_values))
    return attempt(problem, Candidate(terms), start)
