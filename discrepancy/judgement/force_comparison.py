"""Comparison of hypotheses by how well their force agrees with the missing force.

The missing force is estimated from the readings without any law.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.missing_force.gap_share import GapShare
from discrepancy.missing_force.port_force import missing_force
from discrepancy.missing_force.shares import ForceShares
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate

from .comparison import Comparison


class ForceComparison(Comparison[Estimate]):
    """A comparison of hypotheses by how well their force agrees with the missing force.

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
        """The hypothesis of free missing forces without any law."""
        return self.force_search.estimate_without_effects

    @property
    def ranked_hypotheses(self) -> Sequence[Estimate]:
        """All hypotheses, the most probable first."""
        return self.search.force_estimates

    def _compute_gap_share(self, hypothesis: Estimate, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains."""
        return self._force_shares.gap_share(hypothesis, held_out=held_out)

    def fit_candidate(self, candidate: Candidate, effect: FloatArray) -> Estimate | None:
        """Return the fit of a further candidate, from scaled effect parameters (E,).

        None if the candidate cannot be fitted.
        """
        return self.force_search.estimate_effects(
            self.force_search.estimate_without_effects, candidate, effect
        )

    def fit_with_free_shape(self, hypothesis: Estimate) -> Estimate | None:
        """Return the hypothesis of a single law with its shape free; None if there is none."""
        (term,) = hypothesis.candidate.terms
        key = Candidate((replace(term, free_shape=True),)).key
        return next(
            (
                ranked_hypothesis
                for ranked_hypothesis in self.ranked_hypotheses
                if ranked_hypothesis.candidate.key == key
            ),
            None,
        )

    def start_point(self, hypothesis: Estimate) -> Point:
        """Return the values of all unknowns of a hypothesis as fitted to the missing force."""
        return self.force_search.point(hypothesis)

    def failed_check_reason(self, hypothesis: Estimate) -> str:
        """Return an empty reason, as there are no further tests with a missing force."""
        return ""

    def check_fit(self, hypothesis: Estimate) -> Gate:
        """Test whether the residuals of the best simulation are noise as in the noise records."""
        return check_absolute_fit(self.problem, self.search.best())

    def _compute_simulation(self, hypothesis: Estimate) -> CandidateFit:
        """Return the simulation with the parameters of a hypothesis, and their covariance.

        Only the trials' own unknowns are fitted. It is the fit without effect if the hypothesis
        cannot be simulated.
        """
        start = self.start_point(hypothesis)
        try:
            simulation = fit(self.problem, hypothesis.candidate, start, local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.search.no_effect
        return replace(simulation, covariance=hypothesis.covariance)

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
        ports = self.force_search.ports
        law_ports = [term.place for term in hypothesis.candidate.terms if term.place in ports]
        port = law_ports[0] if law_ports else ports[next(iter(hypothesis.processes))]
        force_unit, *_ = self.problem.model.port_units(port)
        return force_unit

    def gap_sentence(self) -> str:
        """Return a sentence on the size and port of the missing force, and on what it depends."""
        force_of_best_port = missing_force(self.force_search, self.force_search.best_port_estimate)
        if force_of_best_port is None:
            return ""
        force = force_of_best_port.at_port
        return (
            f"A force of {force.rms:.3g} {force.unit} (rms) is missing at {force.port!r}; "
            f"{force.dependence}."
        )
