"""The posterior density of a model's parameters, with all nuisances integrated out.

The nuisances are all other unknowns of a fit: gains, zeros and initial states. They are integrated
by Laplace's method, as a Gaussian about their fitted values.
"""

from contextlib import suppress
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, ModelError
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.cut_gaussian import TruncatedGaussian
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.normal_equations import cholesky_factor, normal_equations, solve_factored
from discrepancy.fits.problem import Problem

NO_EFFECTS = Candidate()
"""The hypothesis that the model lacks nothing."""
FURTHER_STARTS = 4
"""Number of draws of the prior at which further fits begin, to find several optima."""
OPTIMUM_DISTANCE = 3.0
"""Distance of two fits, in standard deviations, from which on they are different optima."""
LARGEST_EVIDENCE_GAP = 10.0
"""Largest difference of log evidence from the best optimum for another one to be kept [nat]."""


class Refusal(NamedTuple):
    """A point within the stated range of the parameters at which the model could not be evaluated.

    Attributes
    ----------
    parameters : (P,) ndarray
        The scaled parameters; nan for those that were being fitted.
    reason : str
        The message of the model.
    """

    parameters: FloatArray
    reason: str


class MarginalPosterior:
    """The posterior density of the parameters, with all nuisances integrated out.

    An instance is a function of the scaled parameters u = (value - prior mean) / prior deviation.
    It returns the energy, -ln p(parameters | campaign) up to a constant [nat].

    Parameters
    ----------
    problem : Problem
        The campaign and model.

    Attributes
    ----------
    parameter_indices : (P,) ndarray of int
        The indices of the calibrated parameters whose prior deviation is not zero and that are no
        nuisances; u has one entry for each of them.
    low, high : (P,) ndarray
        The ends of the model's range as scaled parameters; the prior is truncated there.
    refusals : list of Refusal
        Parameters within the range for which the model could not be evaluated.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        shared = problem.shared
        is_nuisance = [
            parameter.name in problem.model.nuisance_parameters
            for parameter in problem.model.parameters
        ]
        is_uncertain = shared.scale[: shared.parameter_count] > 0.0
        self.parameter_indices = np.flatnonzero(is_uncertain & ~np.array(is_nuisance, dtype=bool))
        self.low, self.high = shared.bounds[:, self.parameter_indices]
        self._start_point = problem.prior_mean_point(NO_EFFECTS)
        self.refusals: list[Refusal] = []

    def physical_values(self, u: FloatArray) -> FloatArray:
        """Return the parameters (..., P) in their units, given scaled parameters u (..., P)."""
        shared = self._problem.shared
        return shared.centre[self.parameter_indices] + shared.scale[self.parameter_indices] * u

    def is_in_range(self, u: FloatArray) -> NDArray[np.bool_]:
        """Return whether points u (..., P) lie within the model's range, (...)."""
        return np.asarray(np.all((u >= self.low) & (u <= self.high), axis=-1))

    def fit_nuisances(
        self,
        u: FloatArray,
        trials: Problem | None = None,
        *,
        is_fixed: NDArray[np.bool_] | None = None,
        start_point: Point | None = None,
    ) -> CandidateFit:
        """Return the fit of the nuisances with parameters fixed at given values.

        Parameters
        ----------
        u : (P,) ndarray
            Scaled parameters.
        trials : Problem, optional
            A problem with other trials of the campaign; that of this density by default.
        is_fixed : (P,) ndarray of bool, optional
            True for parameters that are fixed at `u`, all by default; the others are fitted
            together with the nuisances.
        start_point : Point, optional
            The point at which the fit begins; the best optimum by default, if it is known.

        Raises
        ------
        FitError, ModelError
            If the model cannot be evaluated or fitted with these parameters.
        """
        problem = copy(trials or self._problem)
        shared = problem.shared
        if is_fixed is None:
            is_fixed = np.ones(len(self.parameter_indices), dtype=bool)
        fixed_indices = self.parameter_indices[is_fixed]
        # a parameter is fixed by a prior without deviation, and a range of one value
        prior_arrays = {
            name: getattr(shared, name).copy() for name in ("centre", "low", "high", "scale")
        }
        for array in prior_arrays.values():
            array[fixed_indices] = self.physical_values(u)[is_fixed]
        prior_arrays["scale"][fixed_indices] = 0.0
        problem.shared = replace(shared, **prior_arrays)
        start = start_point
        if start is None:
            start = self._start_point if trials is None else problem.prior_mean_point(NO_EFFECTS)
        start_shared = start.shared.copy()
        start_shared[fixed_indices] = 0.0
        try:
            return fit(problem, NO_EFFECTS, replace(start, shared=start_shared))
        except ModelError as cause:
            self.refusals.append(Refusal(np.where(is_fixed, u, np.nan), str(cause)))
            raise

    def __call__(self, u: FloatArray) -> float:
        """Return the energy at scaled parameters (P,); infinite outside the model's range."""
        if not self.is_in_range(u):
            return np.inf
        try:
            fitted = self.fit_nuisances(u)
        except (FitError, ModelError):
            return np.inf
        # The evidence of the fit does not contain the prior of the fixed parameters, which are
        # standard normal: -ln prior is |u|^2 / 2.
        return 0.5 * float(u @ u) - fitted.log_evidence

    def find_optima(self, seed: int) -> list[CandidateFit]:
        """Return the maxima of the posterior with notable probability, the most probable first.

        Fits begin at the prior mean and at draws of the prior. The evidence of a maximum is that of
        the Gaussian about it, integrated within the model's range.

        Parameters
        ----------
        seed : int
            The seed of the draws from which fits begin.

        Raises
        ------
        FitError, ModelError
            If the model fails at its prior mean.
        """
        problem = self._problem
        fits = [fit(problem, NO_EFFECTS, problem.prior_mean_point(NO_EFFECTS), iterations=40)]
        generator = np.random.default_rng(seed)
        for _ in range(FURTHER_STARTS):
            start = problem.prior_mean_point(NO_EFFECTS)
            start.shared[self.parameter_indices] = generator.standard_normal(
                len(self.parameter_indices)
            )
            with suppress(FitError, ModelError):
                fits.append(fit(problem, NO_EFFECTS, start, iterations=40))
        # the sort is stable: of fits that agree within rounding, the first one stays first
        fits.sort(key=lambda fitted: round(fitted.objective, 3))
        all_fitted = np.ones(len(self.parameter_indices), dtype=bool)
        optima: list[CandidateFit] = []
        for fitted in fits:
            if not any(self._is_same_optimum(optimum, fitted) for optimum in optima):
                evidence = self.laplace_gaussian(fitted, all_fitted).log_evidence
                optima.append(replace(fitted, log_evidence=evidence))
        optima.sort(key=lambda optimum: -optimum.log_evidence)
        best_optimum = optima[0]
        self._start_point = best_optimum.point
        least_evidence = best_optimum.log_evidence - LARGEST_EVIDENCE_GAP
        return [optimum for optimum in optima if optimum.log_evidence > least_evidence]

    def _is_same_optimum(self, first: CandidateFit, second: CandidateFit) -> bool:
        """Return whether two fits are at the same optimum.

        They are if their distance in posterior standard deviations (Mahalanobis) is below
        `OPTIMUM_DISTANCE`.
        """
        indices = self.parameter_indices
        difference = first.point.shared[indices] - second.point.shared[indices]
        covariance = first.covariance[np.ix_(indices, indices)]
        return bool(difference @ np.linalg.solve(covariance, difference) < OPTIMUM_DISTANCE**2)

    def laplace_gaussian(
        self, fitted: CandidateFit, is_fitted: NDArray[np.bool_]
    ) -> TruncatedGaussian:
        """Return the Gaussian approximation of the posterior about a fit, truncated at the range.

        It is that of Laplace's method. If the fit is at an end of the range, the mean of the
        Gaussian lies outside of the range.

        Parameters
        ----------
        fitted : CandidateFit
            The fit.
        is_fitted : (P,) ndarray of bool
            True for the parameters that were fitted, whose density the Gaussian is.
        """
        problem = self._problem
        indices = self.parameter_indices[is_fitted]
        equations = normal_equations(
            problem, fitted, NO_EFFECTS, problem.noise_precisions(fitted.squares_by_channel)
        )
        # the Newton step to the maximum without limits adds gradient @ step / 2 to the log density
        step = solve_factored(cholesky_factor(equations.matrix), equations.gradient)
        return TruncatedGaussian(
            mean=fitted.point.shared[indices] + step[indices],
            covariance=fitted.covariance[np.ix_(indices, indices)],
            low=self.low[is_fitted],
            high=self.high[is_fitted],
            log_integral=fitted.log_evidence + 0.5 * float(equations.gradient @ step),
        )
