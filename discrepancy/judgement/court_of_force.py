"""Hypotheses along the missing force before a court."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.naming import Explained, ForceSearch
from discrepancy.missing_force.shares import ForceShares, Share, missing_force
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import said
from discrepancy.verdict import Gate

from .court import Court


class ByForce(Court):
    """Hypotheses along the missing force."""

    least_end = SEARCH.least_end

    def __init__(self, problem: Problem, found: Search, force: ForceSearch) -> None:
        super().__init__(problem, found)
        self.force, self._of_force = force, ForceShares(force)
        self.has_held_out = self._of_force.has_held_out

    @property
    def nothing(self) -> Explained:
        """Missing forces alone."""
        return self.force.whole

    @property
    def ranked(self) -> Sequence[Explained]:
        """Hypotheses, the most probable first."""
        return self.found.forces

    def share_of(self, item: Any, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of the missing force."""
        return self._of_force.of(item, held_out=held_out)

    def followed(self, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        return self.force.followed(self.force.whole, candidate, effect)

    def freed(self, item: Any) -> Explained | None:
        """Return a single law with a shape of its own, where that was compared."""
        (term,) = item.candidate.terms
        key = Candidate((replace(term, free_shape=True),)).key
        return next((one for one in self.ranked if one.candidate.key == key), None)

    def beside(self, item: Any) -> str:
        """Return what else speaks against a name: nothing."""
        return ""

    def gate(self, item: Any) -> Gate:
        """Return how well the best simulation leaves noise alone."""
        return absolute_gate(self.problem, self.found.best())

    def fitted(self, item: Any) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance."""
        try:
            shown = fit_to(self.problem, item.candidate, self.force.whole_point(item), local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.found.none
        return replace(shown, covariance=item.covariance)

    def left(self, item: Any, share: Share) -> str:
        """Return in words what is left beside a hypothesis."""
        return said("verdict.left_of_force", share=share, unit=self._unit(item))

    def _unit(self, item: Any) -> str:
        """Return the unit of the force at the port of a hypothesis."""
        ports = self.force.ports
        places = [t.place for t in item.candidate.terms if t.place in ports]
        return self.problem.model.port_units(places[0] if places else ports[next(iter(item.processes))])[0]

    def gap(self) -> str:
        """Return size and port of the missing force, and the variable that orders it."""
        missing = missing_force(self.force, self.force.best())
        if missing is None:
            return ""
        told = missing.told
        order = said("verdict.not_ordered")
        if told.ordered_by:
            most = 100.0 * max(told.orders.values())
            order = said("verdict.ordered_by", names=" and ".join(told.ordered_by), share=most)
        return said("verdict.force", told=told, order=order)
