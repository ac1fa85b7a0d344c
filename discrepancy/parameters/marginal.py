"""The posterior density of a model's parameters, the nuisances of the measurement integrated out.

At each value of the parameters gains, zeros, initial states and the like are fitted anew and integrated by
Laplace's formula: exact where the readings depend on them linearly and the noise is known.
"""

from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import FitError, ModelError
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem

FloatArray = NDArray[np.float64]

NOTHING = Candidate()
STARTS = 4
"""Draws of the prior from which a fit begins, besides its mean: another optimum may lie apart."""
APART, COMPARABLE = 3.0, 10.0
"""Optima are two where they lie more deviations apart than this, and tell where the evidence of the lesser
is within so many nats."""


class Marginal:
    """-ln p(parameters | campaign) up to a constant [nat], over u = (value - prior mean) / deviation.

    Parameters
    ----------
    problem : Problem
        Campaign and model.

    Attributes
    ----------
    free : (P,) ndarray of int
        Which calibrated parameters have a prior deviation; u is of these.
    low, high : (P,) ndarray
        Ends of the model's range as scaled parameters; the prior is cut off there.
    refused : list of (ndarray, str)
        Where within the range the model could not be had: scaled parameters (P,), NaN for those that were
        fitted, and why.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        shared = problem.shared
        self.free = np.flatnonzero(shared.parameter_scale > 0.0)
        mean, scale = shared.parameter_mean[self.free], shared.parameter_scale[self.free]
        self.low = (shared.parameter_low[self.free] - mean) / scale
        self.high = (shared.parameter_high[self.free] - mean) / scale
        self._near = problem.start(NOTHING)
        self.refused: list[tuple[FloatArray, str]] = []

    def values(self, u: FloatArray) -> FloatArray:
        """Return parameters (..., P) of scaled ones [units]."""
        shared = self._problem.shared
        return shared.parameter_mean[self.free] + shared.parameter_scale[self.free] * u

    def inside(self, u: FloatArray) -> NDArray[np.bool_]:
        """Return which scaled parameters (..., P) lie within the model's range."""
        return np.asarray(np.all((u >= self.low) & (u <= self.high), axis=-1))

    def fitted(
        self,
        u: FloatArray,
        trials: Problem | None = None,
        *,
        fixed: NDArray[np.bool_] | None = None,
        near: Point | None = None,
    ) -> CandidateFit:
        """Return the fit of the nuisances alone at scaled parameters (P,).

        Parameters
        ----------
        u : (P,) ndarray
            Scaled parameters.
        trials : Problem, optional
            Other trials of the campaign.
        fixed : (P,) ndarray of bool, optional
            Those that stay at `u`; the others are fitted with the nuisances. All of them if left out.
        near : Point, optional
            Where to begin.

        Raises
        ------
        FitError, ModelError
            If the model cannot have these parameters.
        """
        problem = copy(trials or self._problem)
        shared = problem.shared
        held = self.free if fixed is None else self.free[fixed]
        mean, scale = shared.parameter_mean.copy(), shared.parameter_scale.copy()
        low, high = shared.parameter_low.copy(), shared.parameter_high.copy()
        mean[self.free] = np.where(np.isin(self.free, held), self.values(u), mean[self.free])
        scale[held], low[held], high[held] = 0.0, mean[held], mean[held]
        problem.shared = replace(
            shared, parameter_mean=mean, parameter_scale=scale, parameter_low=low, parameter_high=high
        )
        start = near or (self._near if trials is None else problem.start(NOTHING))
        at = start.shared.copy()
        at[held] = 0.0
        try:
            return fit(problem, NOTHING, replace(start, shared=at))
        except ModelError as cause:
            self.refused.append((np.where(np.isin(self.free, held), u, np.nan), str(cause)))
            raise

    def __call__(self, u: FloatArray) -> float:
        """Return the energy at scaled parameters (P,); infinite outside the model's range."""
        if not self.inside(u):
            return np.inf
        try:
            found = self.fitted(u)
        except (FitError, ModelError):
            return np.inf
        return 0.5 * float(u @ u) - found.log_evidence

    def optima(self, seed: int) -> list[CandidateFit]:
        """Return the maxima of the posterior that tell, the most probable first.

        Raises
        ------
        FitError, ModelError
            If the model fails at its prior mean.
        """
        problem = self._problem
        found = [self._within(fit(problem, NOTHING, problem.start(NOTHING), iterations=40))]
        generator = np.random.default_rng(seed)
        for _ in range(STARTS):
            u = np.clip(generator.standard_normal(len(self.free)), self.low, self.high)
            shared = problem.start(NOTHING).shared
            shared[self.free] = u
            try:
                other = fit(
                    problem, NOTHING, Point(shared, problem.start(NOTHING).local, np.empty(0)), iterations=40
                )
            except (FitError, ModelError):
                continue
            other = self._within(other)
            near = [item for item in found if self._same(item, other)]
            if not near:
                found.append(other)
            elif other.objective < near[0].objective - 1e-3:
                found[next(at for at, item in enumerate(found) if item is near[0])] = other
        found.sort(key=lambda item: -item.log_evidence)
        best = found[0]
        self._near = best.point
        return [item for item in found if item.log_evidence > best.log_evidence - COMPARABLE]

    def _within(self, found: CandidateFit) -> CandidateFit:
        """Return a fit at the end of the range where its last step ended beyond it."""
        shared = found.point.shared.copy()
        shared[self.free] = np.clip(shared[self.free], self.low, self.high)
        return replace(found, point=replace(found.point, shared=shared))

    def _same(self, first: CandidateFit, second: CandidateFit) -> bool:
        free = self.free
        shift = first.point.shared[free] - second.point.shared[free]
        covariance = first.covariance[np.ix_(free, free)]
        return bool(shift @ np.linalg.solve(covariance, shift) < APART**2)
