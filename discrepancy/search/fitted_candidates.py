"""The candidates that a search has fitted, with their scores and probabilities."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.estimation.log_prior import log_prior
from discrepancy.fits.candidate import Candidate, CandidateKey
from discrepancy.fits.fitting import CandidateFit, try_fit
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.location.residuals import ResidualSet
from discrepancy.proof_record import ErrorComparison
from discrepancy.search_settings import SEARCH


class ComparedHypothesis(Protocol):
    """A fitted hypothesis: a simulation (`CandidateFit`), or a fit to the missing force."""

    @property
    def candidate(self) -> Candidate:
        """The effects."""

    @property
    def effect(self) -> FloatArray:
        """The scaled effect parameters (E,)."""

    @property
    def shared(self) -> FloatArray:
        """The scaled shared unknowns (Q,)."""

    @property
    def covariance(self) -> FloatArray:
        """The covariance (Q + E, Q + E) of shared unknowns and effect parameters."""

    @property
    def log_evidence(self) -> float:
        """The log evidence [nat]."""

    def __hash__(self) -> int:
        """Return the hash of the object, by its identity: two fits are never equal."""


@dataclass
class FittedCandidates:
    """The candidates that a search has fitted so far, with their probabilities.

    Attributes
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    effects : tuple of Effect
        The effects of the catalogue that can act in the campaign.
    no_effect : CandidateFit
        The fit of the model without effect.
    exact_fits : dict of CandidateKey to CandidateFit
        The candidates that were fitted to convergence.
    rough_fits : dict of CandidateKey to CandidateFit
        The candidates that were fitted by few steps only; their evidence is approximate.
    wide_fits : dict of CandidateKey to CandidateFit
        The candidates that were fitted under a wider noise than recorded; if there are any, only
        these are compared.
    errors_by_fit : dict of (CandidateFit, int) to ErrorComparison
        The errors of trials without effect and with a fit, by the fit and the refinement of the
        time steps. They are added when a verdict asks for them.
    """

    problem: Problem
    effects: tuple[Effect, ...]
    no_effect: CandidateFit
    exact_fits: dict[CandidateKey, CandidateFit] = field(default_factory=dict)
    rough_fits: dict[CandidateKey, CandidateFit] = field(default_factory=dict)
    wide_fits: dict[CandidateKey, CandidateFit] = field(default_factory=dict)
    errors_by_fit: dict[tuple[CandidateFit, int], ErrorComparison] = field(
        init=False, repr=False, default_factory=dict
    )
    _residuals: dict[tuple[CandidateFit, int], ResidualSet] = field(
        init=False, repr=False, default_factory=dict
    )

    def __post_init__(self) -> None:
        self.exact_fits[()] = self.no_effect

    def score(self, hypothesis: ComparedHypothesis) -> float:
        """Return ln (evidence times prior) of a hypothesis, up to a constant [nat].

        Each effect beyond the first also has to explain more than errors of a mesh may leave.
        """
        candidate = hypothesis.candidate
        prior = log_prior(candidate, len(self.effects), self.problem.setting)
        further_count = max(len(candidate.terms) - 1, 0)
        return hypothesis.log_evidence + prior - further_count * self._mesh_error_misfit

    @cached_property
    def _mesh_error_misfit(self) -> float:
        """The misfit that an error of `SEARCH.mesh_error` in each reading causes [nat].

        It is zero if the model has no mesh, or if all trials are at rest. A mesh predicts a large
        effect with a small error, which looks like a second, small effect.
        """
        in_motion = any(data.trial.is_dynamic for data in self.problem.trials)
        if not self.problem.model.nuisance_parameters or not in_motion:
            return 0.0
        squares = 0.0
        for data in self.problem.trials:
            squares += float(np.nansum((data.trial.values / data.deviation) ** 2))
        return 0.5 * SEARCH.mesh_error**2 * squares

    def compared_fits(self) -> dict[CandidateKey, CandidateFit]:
        """Return the fits that the comparison of candidates uses, one for each candidate.

        They are the fits under the wider noise if there are any; otherwise the exact fit of each
        candidate, or its rough fit if it has no exact one.
        """
        return self.wide_fits or {**self.rough_fits, **self.exact_fits}

    def best(self) -> CandidateFit:
        """Return the fit with the highest score; rough fits do not count.

        It is one of the fits under the wider noise if there are any, else one of the exact fits.
        """
        return max((self.wide_fits or self.exact_fits).values(), key=self.score)

    def residuals(self, fit: CandidateFit) -> ResidualSet:
        """Return the residuals of a fit in the fitted and the held-out trials.

        They are computed once for each fit and size of the time steps, without sensitivities.
        """
        key = (fit, self.problem.refinement)
        if key not in self._residuals:
            self._residuals[key] = residual_set(self.problem, fit, sensitivities=False)
        return self._residuals[key]

    def fitted_effects(self) -> frozenset[str]:
        """Return the identifiers of all effects that were fitted, alone or with others."""
        identifiers: set[str] = set()
        for fits in (self.rough_fits, self.exact_fits, self.wide_fits):
            for fit in fits.values():
                identifiers.update(term.effect.identifier for term in fit.candidate.terms)
        return frozenset(identifiers)

    @property
    def compared_no_effect(self) -> CandidateFit:
        """The fit without effect, under the same noise as the other compared candidates."""
        return self.wide_fits.get((), self.no_effect)

    def record_fit(self, fit: CandidateFit, *, exact: bool) -> CandidateFit:
        """Store a fit unless an earlier fit of the same candidate has more evidence.

        Returns
        -------
        CandidateFit
            The fit that is kept, the new one or the earlier one.
        """
        fits = self.exact_fits if exact else self.rough_fits
        key = fit.candidate.key
        if key not in fits or fits[key].log_evidence < fit.log_evidence:
            fits[key] = fit
        return fits[key]

    def is_unexplained(self) -> bool:
        """Return whether the best candidate fails the test of absolute fit, or cannot be tested."""
        return not check_absolute_fit(self.problem, self.best()).passed

    def fit_to_convergence(self, rough_fit: CandidateFit) -> CandidateFit:
        """Return a candidate fitted to convergence from a rough fit, and record the fit.

        If the candidate was fitted to convergence before, the fit is repeated only if the rough fit
        has more evidence by `SEARCH.refit_gain`. A candidate that has a fit under the wider noise
        is not fitted again: that fit is returned.
        """
        key = rough_fit.candidate.key
        if key in self.wide_fits:
            return self.wide_fits[key]
        earlier_fit = self.exact_fits.get(key)
        if earlier_fit is not None:
            gained_evidence = rough_fit.log_evidence - earlier_fit.log_evidence
            if gained_evidence <= SEARCH.refit_gain:
                return earlier_fit
        converged_fit = try_fit(self.problem, rough_fit.candidate, rough_fit.point)
        # the rough fit may be at a point from which the model cannot be fitted further
        return self.record_fit(converged_fit or rough_fit, exact=True)
