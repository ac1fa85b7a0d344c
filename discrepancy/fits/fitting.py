"""Fit of a candidate: maximum of the posterior by Levenberg-Marquardt, and its Laplace evidence.

The derivatives by what all hypotheses share change little with an effect: a fit may begin with those of the
fit that it extends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray, IntArray
from discrepancy.errors import DiscrepancyError, FitError, said
from discrepancy.fits.candidate import Candidate, Linearisation, Point, Remainder, State
from discrepancy.fits.problem import Problem

LEAST_PRECISION = 1e-12
"""Of an unknown of which neither prior nor readings tell anything."""


def finite(values: FloatArray) -> FloatArray:
    """Return values as they are.

    Raises
    ------
    FitError
        If one of them is not finite.
    """
    if not np.all(np.isfinite(values)):
        raise FitError("The model gives values or derivatives that are not finite where a fit has come to.")
    return values


def upper_factor(matrix: FloatArray) -> FloatArray:
    """Return U (n, n) of a symmetric matrix U^T U; what stands below its diagonal means nothing.

    Raises
    ------
    FitError
        If it is not finite or not positive definite.
    """
    try:
        return np.asarray(cho_factor(finite(matrix), check_finite=False)[0])
    except np.linalg.LinAlgError as cause:
        raise FitError("The normal equations of a fit are singular; a parameter has no influence.") from cause


def solved(factor: FloatArray, right: FloatArray) -> FloatArray:
    """Return (U^T U)^-1 b for columns b (n, ...)."""
    return np.asarray(cho_solve((factor, False), right, check_finite=False))


@dataclass(frozen=True, eq=False)
class TrialRows:
    """What the unknowns that touch a trial do to its readings, over their noise.

    Attributes
    ----------
    rows : (L + K, N C) ndarray
        By the L unknowns of the trial, then by K of the shared ones and effect parameters.
    index : (K,) ndarray of int
        Which these are.
    root : (C,) ndarray
        Of the precision of each channel.
    residual : (N C,) ndarray
        Over the noise.
    value, prior : (L,) ndarray
        Of the trial's unknowns, and the precision of their prior.
    """

    rows: FloatArray
    index: IntArray
    root: FloatArray
    residual: FloatArray
    value: FloatArray
    prior: FloatArray

    def followed(self) -> tuple[FloatArray, FloatArray]:
        """Return the factor of the own unknowns, and what they (L, K) do less of as others do more."""
        own, others = np.split(self.rows, [len(self.prior)])
        factor = upper_factor(own @ own.T + np.diag(self.prior + LEAST_PRECISION))
        return factor, solved(factor, own @ others.T)


def trial_rows(
    problem: Problem, number: int, found: State, candidate: Candidate, precision: FloatArray
) -> TrialRows:
    """Return the derivatives of a trial at a state, by precisions (channels,) of all channels."""
    data, point = problem.trials[number], found.point
    columns, index = problem.columns(number, point, found.linearisations[number], candidate)
    root = np.sqrt(precision[data.groups])
    residual = (found.residuals[number] * root).ravel()
    rows = (data.standardised(columns) * root).reshape(len(columns), residual.size)
    return TrialRows(rows, index, root, residual, point.local[number], data.unknowns.precision)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of shared unknowns, effect parameters, and the unknowns of each trial, in this order.

    Attributes
    ----------
    trials : list of (TrialRows, (M,) ndarray of int)
        Of each trial, and which of all unknowns its rows belong to.
    matrix, gradient : (n, n), (n,) ndarray
        With prior.
    """

    trials: list[tuple[TrialRows, IntArray]]
    matrix: FloatArray
    gradient: FloatArray


def normal_equations(
    problem: Problem,
    found: State,
    candidate: Candidate,
    precision: FloatArray,
    effect_precision: FloatArray | None = None,
) -> NormalEquations:
    """Return the normal equations of a problem.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : State
        Where they are taken.
    candidate : Candidate
        Its effect parameters are unknowns.
    precision : (channels,) ndarray
        Of the noise of each channel.
    effect_precision : (E,) ndarray, optional
        Of the prior of the effect parameters; one if left out.
    """
    numbers = range(len(problem.trials))
    trials = [trial_rows(problem, number, found, candidate, precision) for number in numbers]
    at = problem.shared.size + candidate.size
    effect_prior = np.ones(candidate.size) if effect_precision is None else effect_precision
    prior = np.concatenate((problem.shared.precision, effect_prior, *(item.prior for item in trials)))
    shared = (found.point.shared, found.point.effect[: candidate.size])
    matrix = np.diag(prior + LEAST_PRECISION)
    gradient = -prior * np.concatenate((*shared, *(item.value for item in trials)))
    placed = []
    for item in trials:
        place = np.concatenate((at + np.arange(len(item.prior)), item.index))
        at += len(item.prior)
        matrix[np.ix_(place, place)] += item.rows @ item.rows.T
        gradient[place] += item.rows @ item.residual
        placed.append((item, place))
    return NormalEquations(placed, matrix, gradient)


LARGEST_EFFECT = 8.0
"""Effect parameters stay within this many prior deviations of their median."""
CONVERGED = 1e-2
"""A step that promises less than this [nat] ends a fit."""
WHOLE_STEP, LARGEST_DAMPING = 1e-2, 1.0
"""Damping below which a step is nearly that of Gauss and Newton, and above which it is a mere trial."""
STEP_SHARES = (1.0, 0.3)
"""Shares of a step that are tried before the damping grows."""


@dataclass(frozen=True, eq=False)
class CandidateFit(State):
    """A fitted candidate.

    Attributes
    ----------
    candidate : Candidate
        What was fitted; the point is the maximum of the posterior.
    log_evidence : float
        Laplace, up to the same constant as the objective [nat].
    covariance : (Q + E, Q + E) ndarray
        Of global unknowns and effect parameters (scaled), local ones marginalised.
    spent : (channels,) ndarray
        Degrees of freedom that the unknowns took from each channel.
    converged : bool
        Whether the last step was short enough.
    draws : (N, E) ndarray or None
        Of the scaled effect parameters, where they are wider than their covariance (see `posterior`).
    remainder : Remainder or None
        What it leaves beside the noise, where hypotheses are compared under a wider one.
    """

    candidate: Candidate
    log_evidence: float
    covariance: FloatArray
    spent: FloatArray
    converged: bool = True
    draws: FloatArray | None = field(default=None, repr=False)
    remainder: Remainder | None = field(default=None, repr=False)

    @property
    def effect(self) -> FloatArray:
        """Scaled effect parameters (E,)."""
        return self.point.effect

    @property
    def shared(self) -> FloatArray:
        """Global unknowns (Q,)."""
        return self.point.shared

    @property
    def effect_covariance(self) -> FloatArray:
        """Covariance (E, E) of the scaled effect parameters."""
        first = len(self.covariance) - self.candidate.size
        return self.covariance[first:, first:]

    @property
    def chi_square(self) -> float:
        """Sum of squared standardised residuals."""
        return float(self.sums.sum())


@np.errstate(over="ignore", invalid="ignore")  # of a step too long, which is taken back
def fit(
    problem: Problem,
    candidate: Candidate,
    start: Point,
    *,
    known: tuple[Linearisation, ...] | None = None,
    iterations: int = 60,
    local_only: bool = False,
    give_up: float | None = None,
) -> CandidateFit:
    """Fit a candidate.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    candidate : Candidate
        What may act.
    start : Point
        Where to begin.
    known : tuple of Linearisation, optional
        Derivatives by shared and local unknowns that are near enough to begin with.
    iterations : int
        Largest number of steps.
    local_only : bool
        Shared unknowns and effects stay: only the trials' own nuisances are fitted (held-out trials).
    give_up : float, optional
        A fit whose objective has no prospect of coming below this ends early, not converged.

    Raises
    ------
    FitError
        If the model gives numbers that are not finite at the start, or none of which a curvature can be made.
    """
    descent = _Descent(problem, candidate, local_only)
    damping = 1e-3
    state = descent.state(_bounded(problem, start), known)
    if not np.isfinite(state.objective):
        names = candidate.identifiers or "no effect"
        raise FitError(said("models.not_finite", names=names))
    converged, fresh = False, known is None
    for _ in range(iterations):
        step, promised = descent.step(state, damping)
        following = None if promised < CONVERGED else descent.following(state, step)
        if following is not None:
            gain = state.objective - following.objective
            damping = max(damping * (0.1 if gain > 0.5 * promised else 0.5), 1e-9)
            state, fresh = following, False
            if gain < 0.7 * promised:  # derivatives have grown old
                state, fresh = descent.state(state.point), True
            if give_up is not None and damping < WHOLE_STEP and state.objective - 2.0 * promised > give_up:
                break
        elif not fresh:
            state, fresh = descent.state(state.point), True
        elif promised < CONVERGED:
            converged = damping < LARGEST_DAMPING  # else only short steps are left to promise little
            break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e6:
                break
    if not fresh:
        state = descent.state(state.point)
    return _finished(problem, candidate, state, converged)


def attempt(problem: Problem, candidate: Candidate, start: Point, **options: Any) -> CandidateFit | None:
    """Return what `fit` does, or None where the candidate cannot be what the fit comes to; why, is kept."""
    try:
        return fit(problem, candidate, start, **options)
    except DiscrepancyError as cause:
        problem.refused(candidate, cause)
        return None


@np.errstate(over="ignore", invalid="ignore")  # a motion beyond all numbers has no probability
def objective(problem: Problem, candidate: Candidate, point: Point) -> float:
    """Return -ln posterior of a candidate at a point, up to a constant shared by all candidates [nat].

    Raises
    ------
    ModelError
        If the structure cannot carry the effects.
    """
    point = _bounded(problem, point)
    responses = [problem.answer(number, point, candidate) for number in range(len(problem.trials))]
    return _compared(problem, point, responses)[0]


def _compared(
    problem: Problem, point: Point, responses: Sequence[FloatArray]
) -> tuple[float, tuple[FloatArray, ...], FloatArray]:
    """Return -ln posterior, residuals of each trial, and their sums of squares by channel."""
    residuals = tuple(problem.residual(number, point, one) for number, one in enumerate(responses))
    sums = problem.group_sums(residuals)
    prior = 0.5 * float(problem.shared.precision @ point.shared**2)
    prior += 0.5 * float(point.effect @ point.effect)
    for data, u in zip(problem.trials, point.local, strict=True):
        prior += 0.5 * float(data.unknowns.precision @ u**2)
    value = problem.misfit(sums) + prior
    return value if np.isfinite(value) else np.inf, residuals, sums


@dataclass
class _Descent:
    """What a descent needs at every point: problem, candidate, and the steps of its derivatives."""

    problem: Problem
    candidate: Candidate
    local_only: bool
    deviation: FloatArray | None = None  # (E,) of the effect parameters, once known

    def state(self, point: Point, known: tuple[Linearisation, ...] | None = None) -> State:
        """Return objective and derivatives at a point; `known` are derivatives by nuisances, near enough."""
        parts = tuple(
            self.problem.linearise(number, point, self.candidate, known=near, effect_steps=self.deviation)
            for number, near in enumerate(known or [None] * len(self.problem.trials))
        )
        compared = _compared(self.problem, point, [part.response for part in parts])
        return State(point, *compared, parts)

    def step(self, state: State, damping: float) -> tuple[Point, float]:
        """Return the step and the decrease it promises [nat], and keep the deviations of the effects.

        What is at the end of its range and would leave it stays (Bertsekas 1982, SIAM J. Control Optim. 20).
        """
        problem, first = self.problem, self.problem.shared.size
        own = first + self.candidate.size
        found = normal_equations(problem, state, self.candidate, problem.precisions(state.sums))
        size = len(found.gradient)
        effects = np.eye(size)[:, first:own]
        self.deviation = np.sqrt(np.diag(solved(upper_factor(found.matrix), effects)[first:own]))
        low, high = problem.shared.ends
        at, downhill = state.point.shared, finite(found.gradient)[:first]
        held = ((at <= low) & (downhill < 0.0)) | ((at >= high) & (downhill > 0.0))
        free = np.arange(size) >= (own if self.local_only else 0)
        free[:first] &= ~held
        damped = (found.matrix + damping * np.diag(np.diag(found.matrix)))[np.ix_(free, free)]
        step = np.zeros(size)
        step[free] = solved(upper_factor(damped), found.gradient[free])
        ends = np.cumsum([own, *(data.unknowns.size for data in problem.trials)])
        local = tuple(step[a:b] for a, b in pairwise(ends.tolist()))
        return Point(step[:first], local, step[first:own]), 0.5 * float(found.gradient @ step)

    def following(self, state: State, step: Point) -> State | None:
        """Return the state after a step, or None if none better was found."""
        for share in STEP_SHARES:
            try:
                ahead = _ahead(self.problem, self.candidate, state.point, step, share)
                if objective(self.problem, self.candidate, ahead) < state.objective:
                    return self.state(ahead, state.linearisations)
            except DiscrepancyError:  # outside what the structure can carry: a shorter step
                continue
        return None


def _finished(problem: Problem, candidate: Candidate, state: State, converged: bool) -> CandidateFit:
    size = problem.shared.size + candidate.size
    equations = normal_equations(problem, state, candidate, problem.precisions(state.sums))
    factor = upper_factor(equations.matrix)
    whole, spent = solved(factor, np.eye(len(factor))), np.zeros(len(problem.channel_names))
    for data, (item, place) in zip(problem.trials, equations.trials, strict=True):
        leverage = ((whole[np.ix_(place, place)] @ item.rows) * item.rows).sum(axis=0)
        np.add.at(spent, data.groups, leverage.reshape(data.weight.shape).sum(axis=0))
    return CandidateFit(
        **vars(state), candidate=candidate, covariance=whole[:size, :size], spent=spent, converged=converged,
        log_evidence=-state.objective - float(np.log(np.diag(factor)).sum()),
    )  # fmt: skip


def _ahead(problem: Problem, candidate: Candidate, point: Point, step: Point, share: float) -> Point:
    """Return the point a share of a step ahead."""
    local = tuple(u + share * du for u, du in zip(point.local, step.local, strict=True))
    effect = candidate.stepped(point.effect, share * step.effect)
    return _bounded(problem, Point(point.shared + share * step.shared, local, effect))


def _bounded(problem: Problem, point: Point) -> Point:
    return replace(
        point,
        shared=np.clip(point.shared, *problem.shared.ends),
        effect=np.clip(point.effect, -LARGEST_EFFECT, LARGEST_EFFECT),
    )


def free_shape(problem: Problem, named: CandidateFit, number: int) -> CandidateFit | None:
    """Fit the family of one effect of a fit: its shape free, from the canonical one.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    named : CandidateFit
        With canonical shapes.
    number : int
        Of the effect among its terms.

    Returns
    -------
    CandidateFit or None
        None where no shape is to free, or the structure cannot follow.
    """
    parts = named.candidate.parts(named.effect)
    term, values = parts[number]
    if not term.effect.shape:
        return None
    canonical = [item.prior.normal(item.canonical) for item in term.effect.shape]
    parts[number] = replace(term, free_shape=True), np.append(values, canonical)
    terms, begin = zip(*parts, strict=True)
    start = replace(named.point, effect=np.concatenate(begin))
    return attempt(problem, Candidate(terms), start)
