"""Fit of a candidate.

The maximum of the posterior by Levenberg-Marquardt, and its Laplace evidence.

The derivatives with respect to what all hypotheses share change little with an effect. So a fit may
begin with those of the fit that it extends.
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
"""A fit ends where the step promises to lower the objective by less than this [nat]."""
WHOLE_STEP = 1e-2
"""Damping below which a step is nearly that of Gauss and Newton."""
LARGEST_DAMPING = 1.0
"""Damping above which steps are so short that a small promise does not mean convergence."""
HOPELESS_DAMPING = 1e6
"""Damping beyond which a fit ends without convergence."""
STEP_FRACTIONS = (1.0, 0.3)
"""Fractions of a step that are tried before the damping grows."""


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
        The degrees of freedom that the unknowns took from each channel.
    converged : bool
        Whether the last step was short enough.
    draws : (N, E) array or None
        Posterior draws of the effect parameters, where their posterior is wider than the covariance
        says (see `predictive.with_draws`).
    residual_process : ResidualProcess or None
        What the fit leaves beside the noise, where hypotheses are compared under a wider noise.
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


@np.errstate(over="ignore", invalid="ignore")  # a step that is too long is taken back
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
        The effects that may act.
    start : Point
        The point from which the fit begins.
    known : tuple of TrialDerivatives, optional
        Derivatives with respect to shared unknowns and those of the trials that are near enough to
        begin with.
    iterations : int
        The largest number of steps.
    local_only : bool
        Whether only the unknowns of the trials are fitted (held-out trials), and shared unknowns
        and effects stay.
    give_up : float, optional
        A value of the objective; a fit without prospect of coming below it ends early, not
        converged.

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
    has_new_derivatives = known is None
    for _ in range(iterations):
        step, promised = descent.step(state, damping)
        next_state = None
        if promised >= CONVERGED:
            next_state = descent.next_state(state, step)
        if next_state is not None:
            gain = state.objective - next_state.objective
            damping = max(damping * (0.1 if gain > 0.5 * promised else 0.5), 1e-9)
            state = next_state
            has_new_derivatives = gain < 0.7 * promised
            if has_new_derivatives:  # the gain is poor: the derivatives have grown old
                state = descent.state(state.point)
            is_near_newton = damping < WHOLE_STEP
            if (
                give_up is not None
                and is_near_newton
                and state.objective - 2.0 * promised > give_up
            ):
                break
        elif not has_new_derivatives:
            state = descent.state(state.point)
            has_new_derivatives = True
        elif promised < CONVERGED:
            converged = damping < LARGEST_DAMPING
            break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > HOPELESS_DAMPING:
                break
    if not has_new_derivatives:
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
    """Return what `fit` returns, or None if the candidate cannot be fitted.

    The reason is recorded by `Problem.record_refusal`.
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
    """Return the negative log posterior of a candidate at a point [nat].

    It is up to a constant that all candidates share.

    Raises
    ------
    ModelError
        If the structure cannot carry the effects.
    """
    point = _within_bounds(problem, point)
    numbers = range(len(problem.trials))
    responses = [problem.response_with(number, point, candidate) for number in numbers]
    return _misfit_at(problem, point, responses).objective


class _Misfit(NamedTuple):
    """The negative log posterior [nat], the residuals of each trial, their squares by channel."""

    objective: float
    residuals: tuple[FloatArray, ...]
    sums: FloatArray


def _misfit_at(problem: Problem, point: Point, responses: Sequence[FloatArray]) -> _Misfit:
    """Return the negative log posterior and the residuals, given the response of each trial."""
    residuals = tuple(
        problem.residual(number, point, response) for number, response in enumerate(responses)
    )
    sums = problem.sums_by_channel(residuals)
    prior = 0.5 * float(problem.shared.precision @ point.shared**2)
    prior += 0.5 * float(point.effect @ point.effect)
    for data, u in zip(problem.trials, point.local, strict=True):
        prior += 0.5 * float(data.unknowns.precision @ u**2)
    value = problem.misfit(sums) + prior
    if not np.isfinite(value):
        value = np.inf
    return _Misfit(value, residuals, sums)


@dataclass
class _Descent:
    """The descent of a fit.

    States and steps of a candidate, and the last deviations of its effects.

    Attributes
    ----------
    problem : Problem
        The campaign and model.
    candidate : Candidate
        The effects that are fitted.
    local_only : bool
        Whether only the unknowns of the trials are fitted.
    effect_deviation : (E,) array or None
        The posterior deviations of the effect parameters at the last step, over which their finite
        differences are taken; None before the first step.
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
            Derivatives with respect to shared unknowns and those of the trials that are near
            enough; only the response and the derivatives with respect to effects are computed then.
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
        """Return the damped step from a state, and the decrease of the objective it promises [nat].

        An unknown at the end of its range that would leave it is held there (projected Newton
        method, Bertsekas 1982, SIAM J. Control Optim. 20, 221-246).
        """
        problem = self.problem
        first_effect = problem.shared.size
        first_local = first_effect + self.candidate.size
        precision = problem.precisions(state.sums)
        equations = normal_equations(problem, state, self.candidate, precision)
        size = len(equations.gradient)
        # posterior deviations of the effect parameters
        effect_columns = np.eye(size)[:, first_effect:first_local]
        covariance = solve_factored(cholesky_factor(equations.matrix), effect_columns)
        self.effect_deviation = np.sqrt(np.diag(covariance[first_effect:first_local]))
        # unknowns that may move
        low, high = problem.shared.ends
        shared = state.point.shared
        downhill = check_finite(equations.gradient)[:first_effect]
        is_held_low = (shared <= low) & (downhill < 0.0)
        is_held_high = (shared >= high) & (downhill > 0.0)
        is_free = np.arange(size) >= (first_local if self.local_only else 0)
        is_free[:first_effect] &= ~(is_held_low | is_held_high)
        # Levenberg-Marquardt step
        damped = equations.matrix + damping * np.diag(np.diag(equations.matrix))
        damped = damped[np.ix_(is_free, is_free)]
        step = np.zeros(size)
        step[is_free] = solve_factored(cholesky_factor(damped), equations.gradient[is_free])
        promised = 0.5 * float(equations.gradient @ step)
        return self._step_by_kind(step), promised

    def _step_by_kind(self, step: FloatArray) -> Point:
        """Return the step of all unknowns (n,) as that of shared, effect and local unknowns."""
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
        """Return the state after a step or a fraction of it; None if none lowers the objective."""
        for fraction in STEP_FRACTIONS:
            try:
                point = _point_after(self.problem, self.candidate, state.point, step, fraction)
                if objective(self.problem, self.candidate, point) < state.objective:
                    return self.state(point, state.linearisations)
            except DiscrepancyError:  # the structure cannot carry it: try a shorter step
                continue
        return None


def _with_evidence(
    problem: Problem, candidate: Candidate, state: FitState, converged: bool
) -> CandidateFit:
    """Return the fit at a state, with its Laplace evidence, covariance and degrees of freedom."""
    precision = problem.precisions(state.sums)
    equations = normal_equations(problem, state, candidate, precision)
    factor = cholesky_factor(equations.matrix)
    covariance = solve_factored(factor, np.eye(len(factor)))
    # degrees of freedom: the trace of the hat matrix, channel by channel
    spent = np.zeros(len(problem.channel_names))
    for data, (rows, index) in zip(problem.trials, equations.trials, strict=True):
        trial_covariance = covariance[np.ix_(index, index)]
        leverage = ((trial_covariance @ rows.rows) * rows.rows).sum(axis=0)
        np.add.at(spent, data.groups, leverage.reshape(data.weight.shape).sum(axis=0))
    size = problem.shared.size + candidate.size
    return CandidateFit(
        **vars(state),
        candidate=candidate,
        log_evidence=-state.objective - float(np.log(np.diag(factor)).sum()),
        covariance=covariance[:size, :size],
        spent=spent,
        converged=converged,
    )


def _point_after(
    problem: Problem, candidate: Candidate, point: Point, step: Point, fraction: float
) -> Point:
    """Return the point after a fraction of a step, within the bounds of the unknowns."""
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
    """Return a fit in which the shape of one effect is free: the family of the effect.

    The fit begins at the canonical shape. It is what the shape gate compares a name with.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    named_fit : CandidateFit
        The fit with canonical shapes.
    number : int
        The index of the effect among the terms of the candidate.

    Returns
    -------
    CandidateFit or None
        None where the effect has no shape parameters, or the structure cannot carry it.
    """
    parts = named_fit.candidate.split(named_fit.effect)
    term, values = parts[number]
    if not term.effect.shape:
        return None
    canonical = [parameter.prior.normal(parameter.canonical) for parameter in term.effect.shape]
    parts[number] = (replace(term, free_shape=True), np.append(values, canonical))
    terms, effect_values = zip(*parts, strict=True)
    start = replace(named_fit.point, effect=np.concatenate(effect_values))
    return attempt(problem, Candidate(terms), start)
