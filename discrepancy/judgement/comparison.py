"""How hypotheses are compared where no simulation leaves noise: along the missing force, or by readings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import nan

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Key, Point
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force import shares
from discrepancy.missing_force.naming import Explained, ForceSearch
from discrepancy.search.honest_evidence import noise_levels, refitted
from discrepancy.search.hypotheses import are_related
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import said
from discrepancy.verdict import Gate

from .conclusion import sizes
from .consistency_gate import consistency_gate, sizes_by_trial
from .court import Court
from .proof import held_out_gate


class ByForce(Court[Explained]):
    """Hypotheses along the missing force."""

    least_end = SEARCH.least_end

    def __init__(self, problem: Problem, found: Search, force: ForceSearch) -> None:
        super().__init__(problem, found)
        self.force, self._of_force = force, shares.ForceShares(force)
        self.has_held_out = self._of_force.has_held_out

    @property
    def ranked(self) -> Sequence[Explained]:
        """Hypotheses, the most probable first."""
        return self.found.forces

    def score(self, item: Explained) -> float:
        """Return ln (evidence times prior) [nat]."""
        return self.force.score(item, len(self.found.effects))

    def sizes(self, item: Explained) -> tuple[float, float, float]:
        """Return log evidence [nat]; readings are not compared."""
        return item.evidence, nan, nan

    def gain(self, item: Explained) -> float:
        """Return the log evidence over missing forces alone [nat]."""
        return item.evidence - self.force.whole.evidence

    def share_of(self, item: Explained, *, held_out: bool) -> shares.Share:
        """Return the share that a hypothesis is of the missing force."""
        return self._of_force.of(item, held_out=held_out)

    def followed(self, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        return self.force.followed(self.force.whole, candidate, effect)

    def freed(self, item: Explained) -> Explained | None:
        """Return a single law with a shape of its own, where that was compared."""
        (term,) = item.candidate.terms
        key = Candidate((replace(term, free_shape=True),)).key
        return next((one for one in self.ranked if one.candidate.key == key), None)

    def gate(self, item: Explained) -> Gate:
        """Return how well the best simulation leaves noise alone."""
        return absolute_gate(self.problem, self.found.best())

    def fitted(self, item: Explained) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance."""
        try:
            shown = fit_to(self.problem, item.candidate, self.force.whole_point(item), local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.found.none
        return replace(shown, covariance=item.covariance)

    def left(self, item: Explained, share: shares.Share) -> str:
        """Return in words what is left beside a hypothesis."""
        return said("verdict.left_of_force", share=share, unit=self._unit(item))

    def _unit(self, item: Explained) -> str:
        """Return the unit of the force at the port of a hypothesis."""
        ports = self.force.ports
        places = [t.place for t in item.candidate.terms if t.place in ports]
        return self.problem.model.port_units(places[0] if places else ports[next(iter(item.processes))])[0]

    def gap(self) -> str:
        """Return size and port of the missing force, and the variable that orders it."""
        missing = shares.missing_force(self.force, self.force.best())
        if missing is None:
            return ""
        told = shares.told_force(missing, self.problem.model)
        order = said("verdict.not_ordered")
        if told.ordered_by:
            most = 100.0 * max(told.orders.values())
            order = said("verdict.ordered_by", names=" and ".join(told.ordered_by), share=most)
        return said("verdict.force", told=told, order=order)


class ByReadings(Court[CandidateFit]):
    """Hypotheses as whole simulations, each fitted under what the best of them leaves."""

    least_end = SEARCH.least_share

    def __init__(self, problem: Problem, found: Search) -> None:
        super().__init__(problem, found)
        self.has_held_out = bool(problem.campaign.held_out)
        self._sets: dict[int, tuple[CandidateFit, ResidualSet]] = {}
        self._free: dict[Key, CandidateFit] = {}

    @property
    def ranked(self) -> Sequence[CandidateFit]:
        """Hypotheses, the most probable first."""
        return sorted(self.found.all().values(), key=lambda item: -self.found.score(item))

    def score(self, item: CandidateFit) -> float:
        """Return ln (evidence times prior) [nat]."""
        return self.found.score(item)

    def sizes(self, item: CandidateFit) -> tuple[float, float, float]:
        """Return log evidence [nat], chi^2 of the readings and its degrees of freedom."""
        return sizes(self.problem, item)

    def gain(self, item: CandidateFit) -> float:
        """Return the log evidence over nothing missing [nat]."""
        return item.log_evidence - self.found.nothing.log_evidence

    def residuals(self, item: CandidateFit) -> ResidualSet:
        """Return fitted and held-out trials beside their predictions."""
        if id(item) not in self._sets:
            self._sets[id(item)] = item, residual_set(self.problem, item, sensitivities=False)
        return self._sets[id(item)][1]

    @cached_property
    def _noise(self) -> Mapping[str, float]:
        levels = noise_levels(self.problem, self.found.best())
        return dict(zip(self.problem.channel_names, levels.tolist(), strict=True))

    def share_of(self, item: CandidateFit, *, held_out: bool) -> shares.Share:
        """Return the share of the gap that a hypothesis closes; sizes are over the noise."""
        sets = [self.residuals(one) for one in (self.found.none, item)]
        pairs = zip(*([i for i in one.trials if i.trial.held_out is held_out] for one in sets), strict=True)
        rows, trials = [], 0
        for first, second in pairs:
            scale = np.array([self._noise[name] for name in first.trial.channels])
            count, trials = len(first.used), trials + 1
            blocks = min(shares.WINDOWS, max(1, count // shares.SHORTEST)) if first.trial.is_dynamic else 1
            squares = [np.where(one.used, one.standardised, 0.0) ** 2 for one in (first, second)]
            for part in np.array_split(np.arange(count), blocks):
                level = float((first.used[part] * scale).sum())
                rows.append((float(squares[0][part].sum()), float(squares[1][part].sum()), level))
        before, after, noise = np.array(rows).T
        left, whole = (float(np.sqrt(max(one.sum() / noise.sum() - 1.0, 0.0))) for one in (after, before))
        return shares.Share(
            before, after, noise, held_out, trials, left, whole, shares.OF_READINGS, tested=True
        )

    def followed(self, candidate: Candidate, effect: FloatArray) -> CandidateFit | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        none = self.found.none
        found = self.found.exact.get(candidate.key)
        if found is None:
            found = attempt(self.problem, candidate, Point(none.point.shared, none.point.local, effect))
        return None if found is None else refitted(self.problem, self.found.wide or self.problem, found)

    def add_families(self) -> None:
        """Compare the best law, and those easily taken for it, with shapes of their own too."""
        best = self.found.best()
        if len(best.candidate.terms) != 1 or not self.acts(best.candidate.terms[0]):
            return
        (own,) = best.candidate.terms
        singles: dict[tuple[str, str], CandidateFit] = {}
        for item in (*self.found.rough.values(), *self.found.exact.values()):
            (term, *others) = item.candidate.terms or (None,)
            if term is None or others or term.free_shape or not term.effect.shape or not self.acts(term):
                continue
            if term == own or are_related(term.effect, own.effect):
                key = (term.effect.family, term.place)
                singles[key] = max(singles.get(key, item), item, key=self.found.score)
        joined = dict(self.found.judged)
        for item in singles.values():
            free = free_shape(self.problem, item, 0)
            free = None if free is None else refitted(self.problem, self.found.wide or self.problem, free)
            if free is not None:
                self._free[item.candidate.key] = free
                if free.log_evidence > best.log_evidence + SHAPE_GAIN:
                    joined[free.candidate.key] = free
        self.found.judged = joined

    def freed(self, item: CandidateFit) -> CandidateFit | None:
        """Return a single law with a shape of its own, where that was compared."""
        return item if item.candidate.is_family else self._free.get(item.candidate.key)

    def gate(self, item: CandidateFit) -> Gate:
        """Return how well the simulation of a hypothesis leaves noise alone."""
        return absolute_gate(self.problem, item)

    def beside(self, item: CandidateFit) -> str:
        """Return what else speaks against a name: sizes that follow the trial, a gate that noise fails."""
        following = [one.sentence() for one in sizes_by_trial(self.problem, item) if one.follows]
        if following or item.remainder is not None:
            return " ".join(following)
        gates: list[Gate] = [consistency_gate(self.problem, item), held_out_gate(self.residuals(item))]
        return next((gate.reason for gate in gates if gate.passed is False), "")

    def fitted(self, item: CandidateFit) -> CandidateFit:
        """Return the simulation that stands for a hypothesis: itself."""
        return item

    def left(self, item: CandidateFit, share: shares.Share) -> str:
        """Return in words what is left beside a hypothesis."""
        return said("verdict.left_of_readings" if share.left > 0.0 else "verdict.nothing_left", share=share)
