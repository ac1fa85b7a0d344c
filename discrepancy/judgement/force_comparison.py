"""Comparison of hypotheses that were estimated with the force that they leave missing."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, fit, try_fit
from discrepancy.missing_force.gap_share import GapShare
from discrepancy.missing_force.port_force import HISTORIES, MissingForce, missing_force
from discrepancy.missing_force.shares import ForceShares
from discrepancy.search.fitted_candidates import ComparedHypothesis
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from fe.runtime.laws.interface import PortForce

from .comparison import Comparison


class ForceComparison(Comparison[Estimate]):
    """A comparison of hypotheses by the force that they leave missing.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.
    force_search : ForceSearch
        The search for the missing force.
    """

    least_low_end = SEARCH.least_low_end

    def __init__(self, search: Search, force_search: ForceSearch) -> None:
        super().__init__(search)
        self.force_search = force_search
        self._force_shares = ForceShares(force_search)
        self.has_held_out = self._force_shares.has_held_out

    @property
    def no_effect(self) -> Estimate:
        """The hypothesis of free missing forces without any effect."""
        return self.best_of_set(())

    @property
    def log_evidence_of_nothing(self) -> float:
        """The log evidence of the model as it is, without a missing force [nat]."""
        return self.no_effect.log_evidence_without_force

    @property
    def ranked_hypotheses(self) -> Sequence[Estimate]:
        """All hypotheses, the most probable first."""
        return self.search.force_estimates

    def _compute_gap_share(self, hypothesis: Estimate, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains."""
        return self._force_shares.gap_share(hypothesis, held_out=held_out)

    def fit_candidate(self, candidate: Candidate, effect_values: FloatArray) -> Estimate | None:
        """Return the estimate of a further candidate, from scaled effect parameters (E,).

        None if the candidate is not possible.
        """
        return self.force_search.estimate_effects(
            self.force_search.estimate_without_effects, candidate, effect_values
        )

    def fit_with_free_shape(self, hypothesis: Estimate) -> Estimate | None:
        """Return the hypothesis of a single law with its shape free; None if there is none."""
        (term,) = hypothesis.candidate.terms
        return self.hypothesis_of(Candidate((replace(term, free_shape=True),)))

    def simulation_of_best_fit(self, hypothesis: Estimate) -> CandidateFit:
        """Return the simulation of a hypothesis, fitted to the readings from its estimate.

        It is the fit without effect if the hypothesis cannot be simulated.
        """
        candidate = hypothesis.candidate
        if candidate.key not in self.search.exact_fits:
            simulation = try_fit(self.problem, candidate, self.force_search.point(hypothesis))
            if simulation is None:
                return self.search.no_effect
            self.search.record_fit(simulation, exact=True)
        return self.search.exact_fits[candidate.key]

    def failed_check_reason(self, hypothesis: Estimate) -> str:
        """Return why a law of the present motion may not be named; empty if it may.

        It may not if the missing force depends on the history of the motion, that is on a relaxed
        displacement. A law without memory, above all one with a free exponent, then explains most
        of the force, but would be a false name.
        """
        if hypothesis.leaves_no_force or self._missing_force is None:
            return ""
        force = self._missing_force.at_port
        relaxed = [name for name in force.ordered_by if name.startswith(HISTORIES)]
        patch = hypothesis.candidate.patch(self.problem.setting, hypothesis.effect)
        laws_at_port = [
            law for law in patch if isinstance(law, PortForce) and law.port == force.port
        ]
        if not relaxed or not laws_at_port or any(law.hysteretic for law in laws_at_port):
            return ""
        return (
            f"the force follows {relaxed[0]}: it depends on the past motion, and its law on the "
            "present one alone"
        )

    @cached_property
    def _missing_force(self) -> MissingForce | None:
        """The missing force without any effect, where it is most probable; None without one."""
        return missing_force(self.force_search, self.force_search.best_port_estimate)

    def _compute_simulation(self, hypothesis: Estimate) -> CandidateFit:
        """Return the simulation with the parameters of a hypothesis, and their covariance.

        If the hypothesis leaves no force, it is fitted to the readings. Else its force is not all
        of the gap, and only the trials' own unknowns are fitted.
        """
        if hypothesis.leaves_no_force:
            return self.simulation_of_best_fit(hypothesis)
        start = self.force_search.point(hypothesis)
        try:
            simulation = fit(self.problem, hypothesis.candidate, start, local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.search.no_effect
        return replace(simulation, covariance=hypothesis.covariance)

    def record_values(self, hypothesis: Estimate) -> ComparedHypothesis:
        """Return the hypothesis with the values of its fit to the readings if it leaves no force.

        These are the values of the name. The estimate of a body that sticks may end before it has
        converged, and is then wider.
        """
        simulation = self.search.exact_fits.get(hypothesis.candidate.key)
        if simulation is None or not hypothesis.leaves_no_force:
            return hypothesis
        return replace(simulation, log_evidence=hypothesis.log_evidence)

    def unexplained_text(self, hypothesis: Estimate, share: GapShare) -> str:
        """Return in words how much of the missing force a hypothesis does not explain."""
        unit = self._force_unit(hypothesis)
        return (
            f"{share.remaining_rms:.3g} of {share.total_rms:.3g} {unit} (rms) of the missing force"
        )

    def _force_unit(self, hypothesis: Estimate) -> str:
        """Return the unit of the force at the port of a hypothesis's law.

        If no law acts at a port, it is that of the first missing force.
        """
        ports = self.force_search.ported.ports
        law_ports = [term.port for term in hypothesis.candidate.terms if term.port in ports]
        port = law_ports[0] if law_ports else ports[next(iter(hypothesis.processes))]
        force_unit, *_ = self.problem.model.port_units(port)
        return force_unit
