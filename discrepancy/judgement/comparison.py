"""How hypotheses are compared where no simulation leaves noise: along the missing force, or by readings.

Both ways tell the same of a hypothesis: its evidence, and the share that it is of what is missing, in trials
that were fitted and in those that were not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import nan
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate
from discrepancy.fits.linearisation import Point
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.fits.wider_noise import noise_levels, refitted
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.hypotheses import Key, key_of
from discrepancy.missing_force.naming import Explained
from discrepancy.missing_force.shares import OF_READINGS, SHORTEST, WINDOWS, ForceShares, Share
from discrepancy.search.starting_points import acts_within, are_related
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate

from .consistency_gate import consistency_gate
from .proof import held_out_gate
from .trial_by_trial import sizes_by_trial

FloatArray = NDArray[np.float64]


class Hypothetic(Protocol):
    """A hypothesis as it is compared: its effects, their scaled unknowns (E,), shared unknowns (Q,)."""

    @property
    def candidate(self) -> Candidate:
        """Its effects."""

    @property
    def effect(self) -> FloatArray:
        """Their scaled unknowns (E,)."""

    @property
    def shared(self) -> FloatArray:
        """Scaled unknowns (Q,) that all trials share."""


H = TypeVar("H", bound=Hypothetic)


class Comparison(Protocol[H]):
    """A way to compare hypotheses.

    `least_end`: lower end of a share that a name needs.
    """

    problem: Problem
    least_end: float

    @property
    def ranked(self) -> Sequence[H]:
        """Hypotheses, the most probable first."""

    @property
    def has_held_out(self) -> bool:
        """Whether there are trials that were not fitted."""

    def score(self, item: H) -> float:
        """Return ln (evidence times prior) [nat]."""

    def gain(self, item: H) -> float:
        """Return the log evidence over no effect at all [nat]."""

    def sizes(self, item: H) -> tuple[float, float, float]:
        """Return log evidence [nat], chi^2 of the readings and its degrees of freedom; nan: not known."""

    def share(self, item: H, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of what is missing."""

    def followed(self, candidate: Candidate, effect: FloatArray) -> H | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""

    def freed(self, item: H) -> H | None:
        """Return a single law with a shape of its own, where that was compared."""

    def gate(self, item: H) -> Gate:
        """Return how well the simulation beside a name leaves noise alone."""

    def against(self, item: H) -> str:
        """Return what else speaks against a name; empty: nothing."""

    def covariance(self, item: H) -> FloatArray:
        """Return that of all unknowns (Q + E, Q + E), shared ones first."""

    def fitted(self, item: H) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    def left(self, item: H, share: Share) -> str:
        """Return in words what is left beside a hypothesis."""


@dataclass
class ByForce:
    """Hypotheses along the missing force."""

    problem: Problem
    found: Search
    least_end: float = SEARCH.least_end

    def __post_init__(self) -> None:
        assert self.found.force is not None
        self.search = self.found.force
        self._shares = ForceShares(self.search)

    @property
    def ranked(self) -> Sequence[Explained]:
        """Hypotheses, the most probable first."""
        return self.found.forces

    @property
    def has_held_out(self) -> bool:
        """Whether there are trials in motion that were not fitted."""
        return self._shares.has_held_out

    def score(self, item: Explained) -> float:
        """Return ln (evidence times prior) [nat]."""
        return self.search.score(item, len(self.found.effects))

    def gain(self, item: Explained) -> float:
        """Return the log evidence over missing forces alone [nat]."""
        return item.evidence - self.search.whole.evidence

    def sizes(self, item: Explained) -> tuple[float, float, float]:
        """Return log evidence [nat]; readings are not compared."""
        return item.evidence, nan, nan

    def share(self, item: Explained, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of the missing force."""
        return self._shares.of(item, held_out=held_out)

    def followed(self, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        return self.search.followed(self.search.whole, candidate, effect)

    def freed(self, item: Explained) -> Explained | None:
        """Return a single law with a shape of its own, where that was compared."""
        (term,) = item.candidate.terms
        key = key_of(Candidate((replace(term, free_shape=True),)))
        return next((one for one in self.ranked if key_of(one.candidate) == key), None)

    def gate(self, item: Explained) -> Gate:
        """Return how well the best simulation leaves noise alone."""
        return absolute_gate(self.problem, self.found.best())

    def against(self, item: Explained) -> str:
        """Return what else speaks against a name: nothing."""
        return ""

    def covariance(self, item: Explained) -> FloatArray:
        """Return that of all unknowns (Q + E, Q + E), shared ones first."""
        return item.told_covariance

    def fitted(self, item: Explained) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance."""
        try:
            shown = fit_to(self.problem, item.candidate, self.search.whole_point(item), local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.found.none
        return replace(shown, covariance=item.told_covariance)

    def left(self, item: Explained, share: Share) -> str:
        """Return in words what is left beside a hypothesis."""
        unit = self.unit(item)
        return f"{share.left:.3g} of {share.whole:.3g} {unit} (rms) are left and unexplained"

    def unit(self, item: Explained) -> str:
        """Return the unit of the force at the port of a hypothesis."""
        ports = self.search.ports
        places = [t.place for t in item.candidate.terms if t.place in ports]
        return self.problem.model.port_unit(places[0] if places else ports[next(iter(item.processes))])


@dataclass
class ByReadings:
    """Hypotheses as whole simulations, each fitted under what the best of them leaves.

    `found`: weighed so.
    """

    problem: Problem
    found: Search
    least_end: float = SEARCH.least_share
    _sets: dict[int, tuple[CandidateFit, ResidualSet]] = field(default_factory=dict)
    _free: dict[Key, CandidateFit] = field(default_factory=dict)

    @property
    def ranked(self) -> Sequence[CandidateFit]:
        """Hypotheses, the most probable first."""
        return sorted(self.found.all().values(), key=lambda item: -self.found.score(item))

    @property
    def has_held_out(self) -> bool:
        """Whether there are trials that were not fitted."""
        return bool(self.problem.campaign.held_out)

    def score(self, item: CandidateFit) -> float:
        """Return ln (evidence times prior) [nat]."""
        return self.found.score(item)

    def gain(self, item: CandidateFit) -> float:
        """Return the log evidence over nothing missing [nat]."""
        return item.log_evidence - self.found.nothing.log_evidence

    def sizes(self, item: CandidateFit) -> tuple[float, float, float]:
        """Return log evidence [nat], chi^2 of the readings and its degrees of freedom."""
        freedom = float(self.problem.counts.sum() - item.spent.sum())
        return item.log_evidence, item.chi_square, freedom

    def residuals(self, item: CandidateFit) -> ResidualSet:
        """Return fitted and held-out trials beside their predictions."""
        if id(item) not in self._sets:
            self._sets[id(item)] = item, residual_set(self.problem, item, sensitivities=False)
        return self._sets[id(item)][1]

    @cached_property
    def _noise(self) -> Mapping[str, float]:
        levels = noise_levels(self.problem, self.found.best())
        return dict(zip(self.problem.channel_names, levels.tolist(), strict=True))

    def share(self, item: CandidateFit, *, held_out: bool) -> Share:
        """Return the share of the gap that a hypothesis closes; sizes are over the noise."""
        sets = [self.residuals(one) for one in (self.found.none, item)]
        parts = [one.held_out if held_out else one.fitted for one in sets]
        rows = []
        assert parts[0] is not None
        assert parts[1] is not None
        for first, second in zip(parts[0].trials, parts[1].trials, strict=True):
            scale = np.array([self._noise[name] for name in first.trial.channels])
            count = len(first.used)
            blocks = min(WINDOWS, max(1, count // SHORTEST)) if first.trial.is_dynamic else 1
            squares = [np.where(one.used, one.standardised, 0.0) ** 2 for one in (first, second)]
            for part in np.array_split(np.arange(count), blocks):
                level = float((first.used[part] * scale).sum())
                rows.append((float(squares[0][part].sum()), float(squares[1][part].sum()), level))
        before, after, noise = np.array(rows).T
        left, whole = (float(np.sqrt(max(one.sum() / noise.sum() - 1.0, 0.0))) for one in (after, before))
        trials = len(parts[0].trials)
        return Share(before, after, noise, held_out, trials, left, whole, OF_READINGS, tested=True)

    def followed(self, candidate: Candidate, effect: FloatArray) -> CandidateFit | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        none = self.found.none
        found = self.found.exact.get(key_of(candidate))
        if found is None:
            found = attempt(self.problem, candidate, Point(none.point.shared, none.point.local, effect))
        return None if found is None else refitted(self.problem, self.found.wide or self.problem, found)

    def add_families(self) -> None:
        """Compare the best law, and those easily taken for it, with shapes of their own too."""
        best = self.found.best()
        if len(best.candidate.terms) != 1 or not self._acts(best):
            return
        (own,) = best.candidate.terms
        singles: dict[tuple[str, str], CandidateFit] = {}
        for item in (*self.found.rough.values(), *self.found.exact.values()):
            (term, *others) = item.candidate.terms or (None,)
            if term is None or others or term.free_shape or not term.effect.shape or not self._acts(item):
                continue
            if term == own or are_related(term.effect, own.effect):
                key = (term.effect.family, term.place)
                singles[key] = max(singles.get(key, item), item, key=self.found.score)
        wide = self.found.wide or self.problem
        joined = dict(self.found.judged)
        for item in singles.values():
            free = free_shape(self.problem, item, 0)
            free = None if free is None else refitted(self.problem, wide, free)
            if free is not None:
                self._free[key_of(item.candidate)] = free
            if free is not None and free.log_evidence > best.log_evidence + SHAPE_GAIN:
                joined[key_of(free.candidate)] = free
        self.found.judge(joined)

    def _acts(self, item: CandidateFit) -> bool:
        return all(acts_within(term.effect, self.problem.setting) for term in item.candidate.terms)

    def freed(self, item: CandidateFit) -> CandidateFit | None:
        """Return a single law with a shape of its own, where that was compared."""
        return item if item.candidate.is_family else self._free.get(key_of(item.candidate))

    def gate(self, item: CandidateFit) -> Gate:
        """Return how well the simulation of a hypothesis leaves noise alone."""
        return absolute_gate(self.problem, item)

    def against(self, item: CandidateFit) -> str:
        """Return what else speaks against a name: sizes that follow the trial, a gate that noise fails."""
        following = [one.sentence() for one in sizes_by_trial(self.problem, item) if one.follows]
        if following or item.remainder is not None:
            return " ".join(following)
        gates: list[Gate] = [consistency_gate(self.problem, item), held_out_gate(self.residuals(item))]
        return next((gate.reason for gate in gates if gate.passed is False), "")

    def covariance(self, item: CandidateFit) -> FloatArray:
        """Return that of all unknowns (Q + E, Q + E), shared ones first."""
        return item.covariance

    def fitted(self, item: CandidateFit) -> CandidateFit:
        """Return the simulation that stands for a hypothesis: itself."""
        return item

    def left(self, item: CandidateFit, share: Share) -> str:
        """Return in words what is left beside a hypothesis."""
        if share.left <= 0.0:
            return "nothing is left beyond the noise"
        return f"what is left is {share.left:.2g} times the noise and unexplained"
